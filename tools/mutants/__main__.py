"""Every small change of the code that decides about torque is noticed by a test, or listed with the reason why not.

    python -m tools.mutants                     all modules, those killed before are not made again
    python -m tools.mutants limits supervisor   some of them, by the last part of their name
    python -m tools.mutants --fresh --jobs 2

What is equal to what stands is in tools/mutants/equal.toml. Exit status 0 when nothing else survives and every row of
that list does.
"""

import argparse
import hashlib
import os
import subprocess
import sys
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from tools.mutants.change import Mutant, mutants

ROOT = Path(__file__).resolve().parents[2]
OUT = ROOT / "out" / "mutants"
EQUAL = Path(__file__).with_name("equal.toml")


class Target(NamedTuple):
    """A module and the tests that hold it."""

    file: str
    tests: tuple[str, ...]
    compiled: bool = True  # run with numba; kernels that are changed are run by the interpreter


TARGETS = (
    Target("rtctl/arm/bounds.py", ("test_guards_alone",), False),
    Target("rtctl/arm/guards.py", ("test_guards_alone",), False),
    Target("rtctl/arm/least_change.py", ("test_guards_alone",), False),
    Target("rtctl/arm/nearby.py", ("test_guards_alone",), False),
    Target("rtctl/arm/scaling.py", ("test_guards_alone",), False),
    Target("rtctl/arm/limits.py", ("test_arm_limits",), False),
    Target("rtctl/arm/faults.py", ("test_faults_alone",), False),
    Target("rtctl/arm/own_loop.py", ("test_own_loop",), False),
    Target("rtctl/arm/supervision.py", ("test_arm_supervision", "test_faults")),
    Target("rtctl/control/faults.py", ("test_faults_alone",), False),
    Target("rtctl/control/supervisor.py", ("test_supervisor",), False),
    Target("rtctl/protocol/e2e.py", ("test_e2e",), False),
    Target("rtctl/protocol/mit.py", ("test_mit",), False),
    Target("rtctl/protocol/signing.py", ("test_signing",), False),
    Target("firmware_sim/drive.py", ("test_drive",), False),
)


class Equal(NamedTuple):
    """A change that changes nothing, and why."""

    module: str
    scope: str
    was: str
    becomes: str
    why: str

    def is_of(self, file: str, mutant: Mutant) -> bool:
        """Return whether it is about this mutant."""
        return (self.module, self.scope, self.was, self.becomes) == (file, mutant.scope, mutant.was, mutant.becomes)


def equals() -> list[Equal]:
    """Return the list of those that are equal."""
    return [Equal(**row) for row in tomllib.loads(EQUAL.read_text(encoding="utf-8")).get("equal", ())]


def stamp(target: Target) -> str:
    """Return what results depend on: the module and its tests."""
    text = b"".join((ROOT / name).read_bytes() for name in (target.file, *map(_path, target.tests)))
    return hashlib.sha256(text).hexdigest()[:16]


def _path(test: str) -> str:
    return f"tests/{test}.py"


def judge(target: Target, jobs: int, fresh: bool) -> int:
    """Try the mutants of a module; print what survives and return how many rows that is, wrong ones of the list too."""
    from tools.mutants.session import Job, run

    source = (ROOT / target.file).read_text(encoding="utf-8")
    OUT.mkdir(parents=True, exist_ok=True)
    known = OUT / f"{target.file.replace('/', '.')}.{stamp(target)}.jsonl"
    if fresh:
        known.unlink(missing_ok=True)
    made = mutants(source)
    print(f"{target.file}: {len(made)} mutants", flush=True)
    terminal = sys.stdout
    job = Job(ROOT / target.file, source, made, known, jobs, lambda text: print(text, file=terminal, flush=True))
    trials = run(job, [_path(test) for test in target.tests])
    if trials.trouble:
        print(f"{target.file}: {trials.trouble}")
        return 1
    listed = [row for row in equals() if row.module == target.file]
    wrong = [m for m in trials.survivors if not any(row.is_of(target.file, m) for row in listed)]
    stale = [row for row in listed if not any(row.is_of(target.file, m) for m in trials.survivors)]
    for m in sorted(wrong, key=lambda m: m.line):
        print(f"{target.file}:{m.line}: {m.scope}: {m.was!r} -> {m.becomes!r} survives")
    for row in stale:
        print(f"{target.file}: {row.scope}: {row.was!r} -> {row.becomes!r} is listed as equal and does not survive")
    equal = len(trials.survivors) - len(wrong)
    print(
        f"{target.file}: {len(made)} mutants, {len(made) - equal - len(wrong)} killed, {equal} equal, {len(wrong)} left"
    )
    return len(wrong) + len(stale)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return its exit code."""
    parser = argparse.ArgumentParser(prog="python -m tools.mutants", description="Small changes, each noticed.")
    parser.add_argument("names", nargs="*", help="of modules: limits, drive, arm/faults (all)")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="at once (%(default)s)")
    parser.add_argument("--fresh", action="store_true", help="forget what was killed before")
    parser.add_argument("--here", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args(argv)
    targets = [t for t in TARGETS if not args.names or any(t.file.endswith(f"/{n}.py") for n in args.names)]
    if not targets:
        parser.error(f"got {' '.join(args.names)}, wanted some of {' '.join(t.file for t in TARGETS)}")
    if args.here:
        return 1 if judge(targets[0], args.jobs, args.fresh) else 0
    left = 0
    for target in targets:  # a process of its own: the interpreter or numba, and nothing of another's tests
        name = target.file.removesuffix(".py").partition("/")[2]
        command = [sys.executable, "-m", "tools.mutants", name, "--here", "--jobs", str(args.jobs)]
        command += ["--fresh"] if args.fresh else []
        env = {**os.environ, "NUMBA_DISABLE_JIT": "0" if target.compiled else "1"}
        left += subprocess.run(command, cwd=ROOT, env=env, check=False).returncode != 0
    print(f"{len(targets)} modules, {left} with survivors")
    return 1 if left else 0


if __name__ == "__main__":
    sys.exit(main())

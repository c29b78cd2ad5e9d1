"""Random scenarios over the robots, judged by pybullet; exit status 0 only when every criterion holds.

python -m tools.stress --robots panda --count 20
python -m tools.stress --only panda:17 --out /tmp/stress
python -m tools.stress --count 500 --jobs 2 --json stress.json
"""

import argparse
import json
import math
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

from rtctl.errors import EXIT_FAILED, EXIT_OK, RtctlError
from tools.stress.judge import failures
from tools.stress.play import Seen, play, robot_of
from tools.stress.scene import scenario_of, toml_of

ROBOTS = ("planar4", "puma560", "panda", "ur5", "openarm")
Case = tuple[str, int, int]  # robot, seed, index
Result = tuple[Seen, list[str]]


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return its exit code."""
    args = _arguments(argv)
    try:
        cases = _cases(args)
        begun = time.monotonic()
        results = []
        for result in _played(cases, args.jobs):
            results.append(result)
            _tell(result, args.verbose)
            if result[1]:
                print(f"    rtctl sim {_saved(result, args.seed, args.out)}", flush=True)
    except RtctlError as error:
        print(f"stress: {error}", file=sys.stderr)
        return error.exit_code
    print(table(results))
    print(
        f"{len(results)} scenarios, {sum(s.duration for s, _ in results):.0f} s simulated in "
        f"{time.monotonic() - begun:.0f} s"
    )
    if args.json:
        rows = [{**plain(s), "failures": f} for s, f in results]
        args.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    return EXIT_FAILED if any(f for _, f in results) else EXIT_OK


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m tools.stress", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--robots", default=",".join(ROBOTS), help="comma-separated names of files in configs/")
    parser.add_argument("--count", type=int, default=500, help="scenarios over all robots together")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument("--first", type=int, default=0, metavar="INDEX", help="leave out each robot's before this one")
    parser.add_argument("--only", metavar="ROBOT:INDEX", help="this scenario alone")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write what was seen of every scenario")
    parser.add_argument("--out", type=Path, default=Path("out/stress"), help="where scenarios that fail are written")
    parser.add_argument("--verbose", action="store_true", help="a line for every scenario")
    args = parser.parse_args(argv)
    if args.count < 1 or args.jobs < 1 or args.first < 0:
        parser.error("--count and --jobs: at least 1; --first: at least 0")
    return args


def _cases(args: argparse.Namespace) -> list[Case]:
    if args.only:
        robot, _, index = args.only.partition(":")
        if not index.isdigit():
            raise SystemExit(f"stress: --only: got {args.only}, wanted ROBOT:INDEX")
        return [(robot, args.seed, int(index))]
    robots = [name for name in args.robots.split(",") if name]
    share = [(args.count - j - 1) // len(robots) + 1 for j in range(len(robots))]
    cases = [(r, args.seed, k) for r, n in zip(robots, share, strict=True) for k in range(args.first, n)]
    if not cases:
        raise SystemExit(f"stress: --first: got {args.first}, wanted less than the {max(share, default=0)} of a robot")
    return cases  # robot by robot: a process derives each only once


def run(case: Case) -> Result:
    """Return what was seen of one scenario and what it broke."""
    name, seed, index = case
    robot, config = robot_of(name)
    seen = play(scenario_of(robot, config, seed, index), index)
    return seen, failures(robot, seen)


def _played(cases: list[Case], jobs: int) -> Iterator[Result]:
    if jobs == 1 or len(cases) == 1:
        yield from map(run, cases)
        return
    with ProcessPoolExecutor(jobs) as pool:
        yield from pool.map(run, cases)


def _tell(result: Result, verbose: bool) -> None:
    seen, broken = result
    if verbose or broken:
        end = "arrived" if seen.arrived else f"{outcome(seen)} {seen.detail} {1e3 * seen.error:.0f} mm short"
        line = (
            f"{seen.robot}:{seen.case} {end}; clearance {1e3 * seen.clearance:.0f} mm, tau {seen.torque:.2f}, "
            f"speed {seen.joint_speed:.3f}, tip {seen.tip_speed:.3f}, margin {seen.margin:.3f}"
        )
        print(line + "".join(f"\n    FAILED: {b}" for b in broken), flush=True)


def _saved(result: Result, seed: int, folder: Path) -> Path:
    """Write the scenario of a result, so that `rtctl sim` plays it; return its file."""
    seen, broken = result
    robot, config = robot_of(seen.robot)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{seen.robot}_{seed}_{seen.case}.toml"
    path.write_text(toml_of(scenario_of(robot, config, seed, seen.case), "; ".join(broken)), encoding="utf-8")
    return path


def outcome(seen: Seen) -> str:
    """Return one word for the end of a run."""
    if seen.contact is not None:
        return "contact"
    if seen.arrived:
        return "arrived"
    return "stopped" if seen.stopped else seen.status


def table(results: list[Result]) -> str:
    """Return the figures by robot as Markdown."""
    rows = [
        "| robot | scenarios | arrived | contacts: arm's / run down | violations | largest torque, rate, joint speed, "
        "tip speed over their limits | least joint margin [rad] | not arrived, and why |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name in dict.fromkeys(s.robot for s, _ in results):
        rows.append(_row(name, [r for r in results if r[0].robot == name]))
    return "\n".join(rows)


def _row(name: str, results: list[Result]) -> str:
    seen = [s for s, _ in results]
    arrived = sum(s.arrived for s in seen)
    arms = sum(any("ran into" in x or "touched itself" in x for x in f) for _, f in results)
    down = sum(s.contact is not None for s in seen) - arms
    broken = sum(len(f) for _, f in results) - arms
    worst = ", ".join(f"{max(getattr(s, k) for s in seen):.3f}" for k in ("torque", "rate", "joint_speed", "tip_speed"))
    why = Counter(outcome(s) for s in seen if not s.arrived)
    short = ", ".join(f"{n} {word}" for word, n in why.most_common()) or "none"
    return (
        f"| {name} | {len(seen)} | {100.0 * arrived / len(seen):.0f} % | {arms} / {down} | {broken} | {worst} | "
        f"{min(s.margin for s in seen):.3f} | {short} |"
    )


def plain(seen: Seen) -> dict[str, Any]:
    """Return what was seen as JSON can hold it."""
    out = dict(seen._asdict())
    out["contact"] = None if seen.contact is None else seen.contact._asdict()
    return {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in out.items()}


if __name__ == "__main__":
    sys.exit(main())

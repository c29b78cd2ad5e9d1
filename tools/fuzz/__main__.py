"""Every decoder against bytes that others choose, for a bounded time.

    python -m tools.fuzz                          # a minute for each
    python -m tools.fuzz ring message --seconds 600 --seed 2

Seeds are what each takes gladly, and tests/golden/fuzz/NAME/: bytes that once were a failure. What fails is made as
short as it goes and written there; the tests play all of them. Exit status 0 when nothing failed.
"""

import argparse
import random
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from zlib import crc32

from tools.fuzz.targets import ROOT, TARGETS, Target, made

KEPT = ROOT / "tests" / "golden" / "fuzz"
BATCH = 20  # cases between two looks at the clock
SHORTER_S = 20.0  # [s] for making a failure shorter


def kept(name: str) -> list[Path]:
    """Return the files of bytes that once were a failure of a target."""
    return sorted((KEPT / name).glob("*"))


def failure(target: Target, data: bytes) -> str:
    """Return the traceback that bytes give, '' for none."""
    try:
        target.take(data)
    except Exception:
        return traceback.format_exc(limit=-3)
    return ""


def run(target: Target, going: Callable[[int], bool], seed: int) -> tuple[int, bytes, str]:
    """Return how many cases were tried while `going(cases)`, and the first failure: its bytes and its traceback."""
    seeds = [*target.seeds(), *(path.read_bytes() for path in kept(target.name))]
    rng, count = random.Random(f"{target.name} {seed}"), 0
    for data in seeds:
        if said := failure(target, data):
            return count, data, said
    while going(count):
        for _ in range(BATCH):
            data, count = made(target, seeds, rng), count + 1
            if said := failure(target, data):
                return count, data, said
    return count, b"", ""


def shorter(target: Target, data: bytes) -> bytes:
    """Return fewer bytes that fail, too."""
    end, step = time.monotonic() + SHORTER_S, max(1, len(data) // 2)
    while step and time.monotonic() < end:
        at = 0
        while at < len(data) and time.monotonic() < end:
            less = data[:at] + data[at + step :]
            if failure(target, less):
                data = less
            else:
                at += step
        step //= 2
    return data


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return its exit code."""
    parser = argparse.ArgumentParser(prog="python -m tools.fuzz", description="Decoders against any bytes.")
    parser.add_argument("names", nargs="*", help=f"of {' '.join(TARGETS)} (all)")
    parser.add_argument("--seconds", type=float, default=60.0, help="for each (%(default)s)")
    parser.add_argument("--seed", type=int, default=int(time.time()), help="the time")
    args = parser.parse_args(argv)
    if unknown := set(args.names) - set(TARGETS):
        parser.error(f"got {' '.join(sorted(unknown))}, wanted some of {' '.join(TARGETS)}")
    failed = 0
    for name in args.names or TARGETS:
        target, end = TARGETS[name], time.monotonic() + args.seconds
        count, data, said = run(target, lambda cases, end=end: time.monotonic() < end, args.seed)  # type: ignore[misc]
        print(f"{name:10s} {count:8d} cases, seed {args.seed}: {'fails' if said else 'all as promised'}", flush=True)
        if said:
            failed += 1
            data = shorter(target, data)
            path = KEPT / name / f"{crc32(data):08x}.bin"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
            print(f"{said}{path}: {len(data)} bytes")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())

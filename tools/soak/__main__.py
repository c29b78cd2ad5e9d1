"""A soak: rate, memory and queues over a long run, in lockstep (accelerated) or in real time.

    python -m tools.soak                       a rover, 20 minutes of 50 Hz set-points, a few minutes of this machine
    python -m tools.soak --arm                 an arm: daemon, recorder and drives as processes, and their logs
    python -m tools.soak --realtime --minutes 60

Exit status 0 when no tick, set-point or goal was missed, nothing was touched, and neither memory, descriptors nor any
queue grew from the second quarter of the run to its last.
"""

import argparse
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from tools.soak import arm, rover


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return its exit code."""
    parser = argparse.ArgumentParser(prog="python -m tools.soak", description="Rate, memory and queues, a long time.")
    parser.add_argument("--arm", action="store_true", help="an arm on CAN, in place of the rover")
    parser.add_argument("--config", help="robot file (configs/rover.toml, configs/panda.toml)")
    parser.add_argument("--minutes", type=float, default=20.0, help="of robot time (%(default)s)")
    parser.add_argument("--realtime", action="store_true", help="no faster than the clock")
    args = parser.parse_args(argv)
    if args.arm:
        with tempfile.TemporaryDirectory(prefix="rtctl-soak-") as folder:
            config = Path(args.config or "configs/panda.toml")
            return 0 if arm.judged(arm.soak(Path(folder), config, args.minutes, args.realtime)) else 1
    return 0 if rover.judged(*rover.soak(Path(args.config or "configs/rover.toml"), args.minutes, args.realtime)) else 1


if __name__ == "__main__":
    sys.exit(main())

"""MotionBenchMaker's problems played by the controller: a table by set, beside what others have published.

python -m tools.benchmark --data panda.json.gz,ur5.json.gz --per-set 4 --plan never
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from rtctl.cli import main as rtctl

PUBLISHED = (
    (
        "cuRobo 0.7.6, RTX 6000 Ada",
        "800, Panda",
        "100 %",
        "median 31 ms, mean 42 ms, p98 161 ms",
        "curobo.org: Benchmarks & Profiling, November 2024",
    ),
    (
        "VAMP's RRT-Connect, one core of a desktop PC",
        "Panda's",
        "-",
        "median 35 us",
        "Thomason, Kingston, Kavraki, ICRA 2024; readme of KavrakiLab/vamp",
    ),
)
ABOUT = """
What others have published of problems of the same archive, on their machines. They plan alone: geometry and joint
goals, no moving arm; the times are of planning."""


def published() -> str:
    """Return the figures of others as Markdown."""
    rows = [("system", "problems", "solved", "time to a way", "source"), ("---",) * 5, *PUBLISHED]
    return "\n".join([ABOUT, "", *("| " + " | ".join(row) + " |" for row in rows)])


def main(argv: Sequence[str] | None = None) -> int:
    """Play the problems as a campaign; return its exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m tools.benchmark", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", metavar="FILE[,FILE]", required=True, help="problems, see docs/benchmark.md")
    parser.add_argument("--per-set", metavar="N", type=int, default=0, help="problems of each set; default: all")
    parser.add_argument("--skip", metavar="N", type=int, default=0, help="problems of each set left out before them")
    parser.add_argument("--plan", choices=("auto", "never"), default="auto", help="with the planner, or reactive alone")
    parser.add_argument("--out", metavar="DIR", default="", help="default: out/benchmark_PLAN_N")
    args, rest = parser.parse_known_args(argv)  # the rest is of `rtctl campaign run`
    out = args.out or f"out/benchmark_{args.plan}_{args.per_set or 'all'}_after_{args.skip}"
    files = ",".join(str(Path(file).resolve()) for file in args.data.split(","))
    options = [f"data={files}", f"plan={args.plan}", f"per-set={args.per_set}", f"skip={args.skip}"]
    words = [word for option in options for word in ("--option", option)]
    code = rtctl(["campaign", "run", "tools.benchmark.source", "--out", out, *words, *rest])
    print(published())
    return code


if __name__ == "__main__":
    sys.exit(main())

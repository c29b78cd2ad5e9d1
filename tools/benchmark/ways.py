"""Ways alone to the goals of the problems: when the first is there and when the last, how long they take, how near.

python -m tools.benchmark.ways --data panda.json.gz --per-set 4 --skip 1 --seeds 2
"""

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rtctl.app.plan import ways
from rtctl.app.postures import Site, site_of, skin_of
from rtctl.app.way import way_of
from rtctl.arm.kinematics import clearance_of
from rtctl.arm.robot import Robot
from rtctl.arm.task import within
from rtctl.campaign.case import Asked
from rtctl.campaign.robots import ready
from rtctl.errors import PlanError
from rtctl.spec.obstacles import shape_of
from rtctl.spec.read import convert
from rtctl.spec.scenario import Scenario
from rtctl.types import Goal, Task
from rtctl.world import obstacle_table
from tools.benchmark.source import source
from tools.stress.certificate import duration


def problem(arm: Robot, told: Scenario) -> tuple[Site, Goal]:
    """Return the site and the goal of a scene."""
    shapes, asked = tuple(shape_of(o) for o in told.obstacle), told.goal[0]
    obstacles = obstacle_table.with_static(obstacle_table.empty(arm.slots), shapes).obstacles
    goal = Goal(np.array(asked.position_m), np.array(asked.wxyz), within(Task.POSE, arm.axes)[0], 0.005, 0.02)
    return site_of(arm, obstacles, np.array(told.start_q_rad)), goal


def main(argv: Sequence[str] | None = None) -> int:
    """Print a line for each problem and seed, and the figures of all."""
    parser = argparse.ArgumentParser(prog="python -m tools.benchmark.ways", description=__doc__)
    parser.add_argument("--data", metavar="FILE", required=True, help="problems, see docs/benchmark.md")
    parser.add_argument("--per-set", metavar="N", type=int, default=4, help="problems of each set; default: 4")
    parser.add_argument("--skip", metavar="N", type=int, default=0, help="problems of each set left out before them")
    parser.add_argument("--seeds", metavar="N", type=int, default=1, help="of each problem; default: 1")
    args = parser.parse_args(argv)
    options = {"data": str(Path(args.data).resolve()), "plan": "auto", "per-set": str(args.per_set)}
    rows: list[tuple[float, float, float, float]] = []
    lost = 0
    print("| set | problem | seed | first way [s] | last [s] | it takes [s] | links keep [mm] |\n" + "|---" * 7 + "|")
    for case in source.cases(Asked((), range(1), 0, {**options, "skip": str(args.skip)})):
        arm = ready(case.robot, case.config).setup.build()
        told: Scenario = convert({**source.scene(case).table, "robot": case.robot}, Scenario, str(case.number))
        site, goal = problem(arm, told)
        for seed in range(args.seeds + (not rows)):  # the first of all is not counted: it compiles
            began = time.perf_counter()
            try:
                found = [(path, time.perf_counter() - began) for path in ways(site, goal, seed, within=np.inf)]
            except PlanError as error:
                lost += 1
                print(f"| {case.set} | {case.number} | {seed} | {error} |", flush=True)
                continue
            path = found[-1][0]
            near = way_of(site, path).Q
            rho = float(clearance_of(site.chain, skin_of(arm.body), near, site.obstacles, 2.0 * arm.avoid.rho0).min())
            rows.append((found[0][1], found[-1][1], duration(arm, path), 1e3 * rho))
            told_so = " | ".join(f"{value:.3f}" for value in rows[-1][:3])
            print(f"| {case.set} | {case.number} | {seed} | {told_so} | {rows[-1][3]:.1f} |", flush=True)
    first, last, takes, _ = np.array(rows[1:]).T
    print(f"found {len(rows) - 1} of {len(rows) - 1 + lost}")
    for name, values in (("first way", first), ("last", last), ("it takes", takes)):
        print(f"{name}: median {np.median(values):.3f} s, p95 {np.quantile(values, 0.95):.3f} s")
    return 0


if __name__ == "__main__":
    sys.exit(main())

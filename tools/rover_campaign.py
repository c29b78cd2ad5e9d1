"""Seeded runs of the rover double: the four worlds from many headings, and sensors that lie or know nothing.

    python -m tools.rover_campaign worlds --seeds 20        # arrives, keeps clear, as fast as an autopilot's own
    python -m tools.rover_campaign sight --runs 400         # knows little, or lies: touches nothing, says why
    python -m tools.rover_campaign sight --long             # a vehicle of 2 m by 0.7 m, steered as its outline
    python -m tools.rover_campaign bias --seeds 3           # `arrived` agrees with the autopilot's own position

The double's truth judges: distances of the hull to the solids, which the controller never sees. Exit code 1 when a run
fails; `--json` prints every run.
"""

import argparse
import json
import math
import statistics
import sys
from collections.abc import Iterator
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import msgspec
import numpy as np

from rtctl.app.sim import simulate_scenario
from rtctl.errors import RtctlError
from rtctl.spec.scenario import FaultTable, Scenario, TimedGoal, load_scenario

ROOT = Path(__file__).resolve().parent.parent
ROVER = ROOT / "configs" / "rover.toml"
WORLDS = {"disc": 22.8, "three": 26.5, "wall": 25.8, "u": 32.1}  # [s] that an autopilot's own avoidance needed
LONG = "footprint_m = [[1.2, 0.35], [-0.8, 0.35], [-0.8, -0.35], [1.2, -0.35]]"  # [m]
CLEARANCE = 0.6  # [m] clearance_m of the config
NEAR = 2.0  # [m] of the goal, where the clock stops
SPARE = 5.0  # [s] beyond what the autopilot needed, for a run to end in
HEADING = math.radians(60.0)
EXPLAINED = ("blind", "shadowed", "local_minimum", "arrived")
SIGHT_DURATION, SIGHT_START = 16.0, 4.0  # [s], [m] nearer to what stands in the way
BIASES = (0.0, 0.05, 0.1, 0.15, 0.2)  # [m/s]


class Case(NamedTuple):
    """One run to be made."""

    kind: str
    world: str
    scenario: Scenario
    robot: Path = ROVER


class Run(NamedTuple):
    """What came of it."""

    kind: str
    world: str
    seed: int
    fine: bool
    arrived: bool
    near_s: float | None  # to within NEAR of the goal
    arrived_s: float | None
    clearance: float
    contacts: int
    error: float  # [m] from the goal at the end, by the truth
    why: str  # the last status and the faults


def of_world(name: str) -> Scenario:
    """Return a shipped world."""
    return load_scenario(file_of(name))


def file_of(name: str) -> Path:
    """Return a shipped world's file."""
    return ROOT / "configs" / "worlds" / f"{name}.toml"


def worlds(seeds: int) -> Iterator[Case]:
    """Yield the four worlds with start headings within HEADING."""
    for name in WORLDS:
        for seed in range(seeds):
            heading = float(np.random.default_rng([1, seed]).uniform(-HEADING, HEADING))
            play = replaced(of_world(name), seed=seed, start_pose=(0.0, 0.0, heading), duration_s=WORLDS[name] + SPARE)
            yield Case("worlds", name, play)


def sight(runs: int) -> Iterator[Case]:
    """Yield runs whose range sensor knows nothing, knows less than it should, or lies."""
    kinds = ("blind90", "unknown", "zeros", "frame")
    for seed in range(runs):
        random, kind = np.random.default_rng([2, seed]), kinds[seed % len(kinds)]
        name = tuple(WORLDS)[seed // len(kinds) % len(WORLDS)]
        begin = float(random.uniform(-180.0, 180.0))
        at = float(random.uniform(0.0, 8.0))
        fault = {
            "blind90": FaultTable(at_s=at * (seed // 16 % 2), kind="scan_blind", from_deg=begin, to_deg=begin + 90.0),
            "unknown": FaultTable(at_s=at, kind="scan_unknown"),
            "zeros": FaultTable(
                at_s=0.0, kind="scan_zero", from_deg=begin, to_deg=begin + float(random.uniform(5, 180))
            ),
            "frame": FaultTable(at_s=0.0, kind="scan_frame", value=float(random.integers(3))),
        }[kind]
        heading = float(random.uniform(-HEADING, HEADING))
        pose = (SIGHT_START, float(random.uniform(-1.0, 1.0)), heading)
        yield Case(
            kind, name, replaced(of_world(name), seed=seed, start_pose=pose, fault=(fault,), duration_s=SIGHT_DURATION)
        )


def bias(seeds: int) -> Iterator[Case]:
    """Yield short ways over free ground whose reported speed is off."""
    for much in BIASES:
        for seed in range(seeds):
            angle = float(np.random.default_rng([3, seed]).uniform(-HEADING, HEADING))
            goal = TimedGoal(at_s=0.5, position_m=(6.0 * math.cos(angle), 6.0 * math.sin(angle), 0.0))
            play = replaced(
                of_world("disc"),
                seed=seed,
                goal=(goal,),
                duration_s=12.0,
                fault=(FaultTable(at_s=0.0, kind="speed_bias", value=much),),
            )
            yield Case(f"bias {much:g}", "disc", play)


def long_robot(folder: Path) -> Path:
    """Return the config, in a folder, of a rover whose footprint is LONG."""
    path = folder / "long.toml"
    path.write_text("\n".join(LONG if line.startswith("radius_m") else line for line in ROVER.read_text().split("\n")))
    return path


def replaced(scenario: Scenario, **changes: Any) -> Scenario:
    """Return a scenario with other values."""
    return msgspec.structs.replace(scenario, **changes)


def played(case: Case) -> Run:
    """Return what came of a run, judged by the truth."""
    scenario, places = case.scenario, list[tuple[float, float, float, float]]()  # t, x, y, v

    def watch(servo: Any, truth: Any, turn: Any) -> None:
        places.append((truth.time, truth.x, truth.y, truth.v))

    try:
        found = simulate_scenario(scenario, case.robot, file_of(case.world), watch=watch)
    except RtctlError as error:  # it did not even start
        refuses = case.kind != "worlds" and not case.kind.startswith("bias")  # to start blind: that says why it stands
        return Run(case.kind, case.world, scenario.seed, refuses, False, None, None, math.inf, 0, math.inf, str(error))
    track, goal = np.array(places), np.array((scenario.goal[-1].position_m or (0.0, 0.0, 0.0))[:2])
    away = np.hypot(*(track[:, 1:3] - goal).T)
    given = float(found["goals"][-1]["at_s"]) if found["goals"] else math.inf
    said = [(name, detail) for _, name, detail in found["statuses"] if name in EXPLAINED]
    last = " ".join(said[-1]).strip() if said else found["statuses"][-1][1] if found["statuses"] else "no goal"
    near = track[away <= NEAR, 0]
    says = "arrived" if any(name == "arrived" for name, _ in said) else ""
    run = Run(
        case.kind,
        case.world,
        scenario.seed,
        False,
        says == "arrived",
        float(near[0]) - given if len(near) else None,
        found["time_to_goal_s"],
        found["min_clearance_m"]["all"],
        found["contacts"],
        float(away[-1]),
        "; ".join([last, *found["faults"]]),
    )
    moves = float(np.abs(track[-50:, 3]).max()) > 0.1
    return run._replace(fine=judged(run, bool(said) or bool(found["faults"]) or moves))


def judged(run: Run, explained: bool) -> bool:
    """Return whether a run is as it must be."""
    if run.contacts or run.clearance <= 0.0:
        return False
    if run.kind == "worlds":
        return run.arrived and run.clearance >= CLEARANCE
    if run.kind.startswith("bias"):
        return run.arrived and run.error <= 0.3 + 0.05
    return explained


def table(runs: list[Run]) -> list[str]:
    """Return the figures as lines of a Markdown table."""
    lines = [
        "| runs | n | fine | arrived | median s to 2 m | slowest | autopilot's own | least clearance m | touched |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for name in dict.fromkeys((r.kind, r.world) for r in runs):
        group = [r for r in runs if (r.kind, r.world) == name]
        near = [r.near_s for r in group if r.near_s is not None]
        own = f"{WORLDS[name[1]]:g}" if name[0] == "worlds" else ""
        middle, most = (f"{statistics.median(near):.1f}", f"{max(near):.1f}") if near else ("", "")
        least, touched = f"{min(r.clearance for r in group):.2f}", sum(r.contacts > 0 for r in group)
        counts = (len(group), sum(r.fine for r in group), sum(r.arrived for r in group))
        cells = (f"{name[0]}, {name[1]}", *counts, middle, most, own, least, touched)
        lines.append(f"| {' | '.join(map(str, cells))} |")
    return lines


def main(arguments: list[str] | None = None) -> int:
    """Run a campaign; exit code 1 when a run is not as it must be."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("campaign", choices=("worlds", "sight", "bias"))
    parser.add_argument("--seeds", type=int, default=20, help="of worlds and bias")
    parser.add_argument("--runs", type=int, default=400, help="of sight")
    parser.add_argument("--world", choices=tuple(WORLDS), help="of worlds alone")
    parser.add_argument("--long", action="store_true", help="a footprint of 2 m by 0.7 m instead of a disc")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--json", action="store_true", help="every run as a line of JSON")
    args = parser.parse_args(arguments)
    if args.campaign == "sight":
        cases = list(sight(args.runs))
    else:
        cases = list(worlds(args.seeds) if args.campaign == "worlds" else bias(args.seeds))
        cases = [case for case in cases if args.world in (None, case.world)]
    with TemporaryDirectory() as folder, get_context("spawn").Pool(args.jobs) as pool:
        robot, runs = long_robot(Path(folder)) if args.long else ROVER, []
        cases = [case._replace(robot=robot) for case in cases]
        for run in pool.imap(played, cases):
            runs.append(run)
            if args.json:
                print(json.dumps(run._asdict()), flush=True)
    print("\n".join(table(runs)))
    for run in runs:
        if not run.fine:
            print(f"failed: {run.kind}, {run.world}, seed {run.seed}: {run}", file=sys.stderr)
    slow = False
    for name, own in WORLDS.items():
        near = [run.near_s or math.inf for run in runs if (run.kind, run.world) == ("worlds", name)]
        slow = slow or bool(near and statistics.median(near) > own)
    return 0 if all(run.fine for run in runs) and not slow else 1


if __name__ == "__main__":
    sys.exit(main())

"""The same runs in both engines, pybullet and MuJoCo: what they agree on, and by how much they differ.

    python -m tools.engines                         # the shipped scenarios of arms, the demo among them
    python -m tools.engines --scenes 5 --seed 1     # and random scenes of the stress set, so many for each arm
    python -m tools.engines configs/demo.toml

Two runs agree when they arrive at the same goals, without contact in both or in neither, each goal within TIME of each
other's time, the least distance to every obstacle within NEAR. Scenes whose fate hangs on a hair (who escapes to the
left or to the right) need not agree, so these are counted, not required: exit 1 is for the shipped ones.
"""

import argparse
import sys
from pathlib import Path

from msgspec.structs import replace

from firmware_sim.reality import ENGINES
from rtctl.app.sim import simulate_scenario
from rtctl.campaign import scenes
from rtctl.plain import Json
from rtctl.spec.plant import PlantTable
from rtctl.spec.read import convert
from rtctl.spec.scenario import Scenario, load_scenario, robot_file
from tools.stress.play import CONFIGS, robot_of

TIME = 0.05  # [s]
NEAR = 0.002  # [m]
ROBOTS = ("panda", "ur5", "planar4", "puma560", "openarm_e2e")


def both(scenario: Scenario, where: Path, source: Path) -> tuple[Json, Json]:
    """Return the figures of a scenario in pybullet and in MuJoCo."""
    plants = [replace(scenario.plant or PlantTable(), engine=engine) for engine in ENGINES]
    first, second = (simulate_scenario(replace(scenario, plant=plant), where, source) for plant in plants)
    return first, second


def differ(first: Json, second: Json) -> tuple[float, float, str]:
    """Return the largest difference of a goal's time [s], of a clearance [m], and in what two runs do not agree, ''."""
    pairs = list(zip(first["goals"], second["goals"], strict=True))
    times = [abs(a["time_to_goal_s"] - b["time_to_goal_s"]) for a, b in pairs if a["arrived"] and b["arrived"]]
    near = first["min_clearance_m"], second["min_clearance_m"]
    gaps = [abs(near[0][name] - near[1][name]) for name in near[0].keys() & near[1].keys()]
    time, gap = max(times, default=0.0), max(gaps, default=0.0)
    if [a["arrived"] for a, _ in pairs] != [b["arrived"] for _, b in pairs]:
        return time, gap, "goals"
    if (first["contacts"] > 0) != (second["contacts"] > 0):
        return time, gap, "contacts"
    return time, gap, "time" if time > TIME else "clearance" if gap > NEAR else ""


def shipped() -> list[Path]:
    """Return the scenarios of arms that are shipped."""
    found = [CONFIGS / "demo.toml", *sorted((CONFIGS / "scenarios").glob("*.toml"))]
    return [path for path in found if load_scenario(path).goal]


def row(name: str, runs: tuple[Json, Json]) -> str:
    """Print a row of the table; return in what the runs do not agree."""
    time, gap, reason = differ(*runs)
    goals = [f"{sum(g['arrived'] for g in run['goals'])} of {len(run['goals'])}" for run in runs]
    touched = [str(run["contacts"]) for run in runs]
    cells = (
        name,
        " / ".join(goals),
        " / ".join(touched),
        f"{time * 1e3:.0f} ms",
        f"{gap * 1e3:.2f} mm",
        reason or "agree",
    )
    print("| " + " | ".join(cells) + " |", flush=True)
    return reason


def main(arguments: list[str] | None = None) -> int:
    """Print the table; return 1 when a shipped scenario does not agree."""
    parser = argparse.ArgumentParser(prog="python -m tools.engines", description=__doc__.partition("\n")[0])
    parser.add_argument("files", nargs="*", type=Path, help="scenarios (the shipped ones)")
    parser.add_argument("--scenes", type=int, default=0, help="random scenes for each arm (0)")
    parser.add_argument("--seed", type=int, default=1)
    asked = parser.parse_args(arguments)
    print("| run | arrived | contacts | time | clearance | |\n|---|---|---|---|---|---|")
    failed = 0
    for path in asked.files or shipped():
        scenario = load_scenario(path)
        failed += bool(row(path.stem, both(scenario, robot_file(scenario, path), path)))
    agreed = 0
    for name in ROBOTS if asked.scenes else ():
        robot, config = robot_of(name)
        for number in range(asked.scenes):
            table = scenes.scenario_of(robot, config, asked.seed, number)
            scenario = convert(table | {"robot": f"{name}.toml"}, Scenario, f"{name} {number}")
            where = CONFIGS / f"{name}.toml"
            agreed += not row(f"{name}:{asked.seed}:{number}", both(scenario, where, where))
    if asked.scenes:
        print(f"\n{agreed} of {asked.scenes * len(ROBOTS)} random scenes agree")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())

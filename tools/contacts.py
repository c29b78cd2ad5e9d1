"""How often an arm that nobody touches says `collision`: its scenario again and again, with loads that nobody told of.

    python -m tools.contacts --hours 1                 # of simulated time, shared by the five arms
    python -m tools.contacts --hours 0.2 --arms panda --seed 7
    python -m tools.contacts --hours 0.1 --push 15     # with a push [N] at the forearm instead: is it noticed?
    python -m tools.contacts --hours 0.1 --ratio 0.05  # with another collision_ratio than the file's

Each run draws a payload up to the file's payload_max_kg, its centre within 5 cm of the tip, and Coulomb friction of
each joint up to friction_ratio of its tau_max: the bounds that the file declares. Exit code 1 when any run without a
push says `collision`.
"""

import argparse
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import msgspec
import numpy as np

from rtctl import design
from rtctl.app.sim import simulate_scenario
from rtctl.campaign.robots import Variant, text_of
from rtctl.spec.plant import PlantTable
from rtctl.spec.robot import Config
from rtctl.spec.scenario import FaultTable, Scenario, load_scenario

ROOT = Path(__file__).resolve().parent.parent
SCENARIOS = {
    "panda": "demo",
    "planar4": "scenarios/planar4",
    "puma560": "scenarios/puma560",
    "ur5": "scenarios/ur5",
    "openarm_e2e": "scenarios/openarm_e2e",
}
FOREARMS = {
    "panda": "panda_link5",
    "planar4": "link_3",
    "puma560": "link_4",
    "ur5": "forearm_link",
    "openarm_e2e": "link_5",
}
CENTRE = 0.05  # [m] of a payload from the tip, each way
PUSH_TIME = 0.3  # [s]
QUICK = 0.0205  # [s] 20 ms, and half a period


class Counted(NamedTuple):
    """What the runs of one arm came to."""

    arm: str
    runs: int
    seconds: float  # simulated
    collisions: list[str]
    other: list[str]  # faults beside
    delays: list[float]  # [s] from a push to `collision`


def drawn(config: Config, rng: np.random.Generator) -> PlantTable:
    """Return loads within what a file declares."""
    most = [config.safety.friction_ratio * j.tau_max_Nm for j in config.robot.joints]
    return PlantTable(
        payload_kg=float(rng.uniform(0.0, config.robot.payload_max_kg)),
        payload_com_m=tuple(rng.uniform(-CENTRE, CENTRE, 3).tolist()),
        coulomb_Nm=tuple(float(rng.uniform(0.0, m)) for m in most),
    )


def pushed(arm: str, scenario: Scenario, newton: float, rng: np.random.Generator) -> FaultTable:
    """Return a push in a random direction half a second after one of the scenario's goals."""
    at = float(scenario.goal[int(rng.integers(len(scenario.goal)))].at_s) + 0.5
    direction = rng.normal(size=3)
    if arm == "planar4":
        direction[2] = 0.0
    way: Any = tuple((direction / np.linalg.norm(direction)).tolist())
    return FaultTable(at_s=at, kind="push", duration_s=PUSH_TIME, link=FOREARMS[arm], newton=newton, direction=way)


def counted(arm: str, where: Path, seconds: float, seed: int, newton: float) -> Counted:
    """Return what runs of an arm, its file at `where`, come to until so many seconds are played; told as they end."""
    source = ROOT / "configs" / f"{SCENARIOS[arm]}.toml"
    config, scenario, rng = design.load(where), load_scenario(source), np.random.default_rng(seed)
    runs, played, collisions, other, delays = 0, 0.0, [], [], []
    while played < seconds:
        fault = (pushed(arm, scenario, newton, rng),) if newton > 0.0 else ()
        plant = None if newton > 0.0 else drawn(config, rng)
        play = msgspec.structs.replace(scenario, plant=plant, fault=fault)
        if fault:
            play = msgspec.structs.replace(play, duration_s=fault[0].at_s + PUSH_TIME)
        said: list[tuple[float, str]] = []

        def watch(servo: Any, truth: Any, turn: Any, said: list[tuple[float, str]] = said) -> None:
            names = servo.vehicle.names(servo.memory.in_force)
            if not said and any(name.startswith("collision") for name in names):
                said.append((truth.time, servo.robot.links[servo.memory.contact_link]))

        found = simulate_scenario(play, where, source, watch=watch)
        runs, played = runs + 1, played + play.duration_s
        if fault:
            delays.append(said[0][0] - fault[0].at_s if said else float("inf"))
        elif said:
            collisions.append(f"run {runs}: {said[0][0]:.3f} s, {said[0][1]}, {plant}")
        other += [name for name in found["faults"] if not name.startswith("collision")]
        ends = f"push {1e3 * delays[-1]:.0f} ms" if fault else f"collisions {len(collisions)}"
        print(f"{arm} run {runs}: {played:.0f} s, {ends}, {found['faults']}", flush=True)
    return Counted(arm, runs, played, collisions, other, delays)


def file_of(arm: str, ratio: float | None, folder: Path) -> Path:
    """Return an arm's file, or one beside it in which `collision_ratio` is another."""
    plain = ROOT / "configs" / f"{arm}.toml"
    if ratio is None:
        return plain
    file = folder / plain.name
    file.write_text(text_of(plain, Variant("", {("safety", "collision_ratio"): ratio})), encoding="utf-8")
    return file


def main(arguments: list[str] | None = None) -> int:
    """Play and count; exit code 1 when an arm that nobody touched said `collision`."""
    parser = argparse.ArgumentParser(
        prog="tools.contacts", description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--hours", type=float, default=1.0, help="of simulated time (%(default)s)")
    parser.add_argument("--arms", nargs="+", choices=sorted(SCENARIOS), default=list(SCENARIOS))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--push", type=float, default=0.0, metavar="N", help="push the forearm while it moves")
    parser.add_argument("--ratio", type=float, metavar="R", help="collision_ratio of every arm; default: its file's")
    chosen = parser.parse_args(arguments)
    share = 3600.0 * chosen.hours / len(chosen.arms)
    with TemporaryDirectory() as folder:
        files = {arm: file_of(arm, chosen.ratio, Path(folder)) for arm in chosen.arms}
        found = [counted(arm, file, share, chosen.seed, chosen.push) for arm, file in files.items()]
    for c in found:
        line = f"{c.arm:8} {c.runs:4} runs {c.seconds:7.0f} s  "
        if chosen.push > 0.0:
            quick, ever = sum(d <= QUICK for d in c.delays), sum(map(np.isfinite, c.delays))
            line += f"noticed within 20 ms {quick} of {c.runs}, at all {ever}"
        else:
            line += f"collisions {len(c.collisions)}  other faults {', '.join(sorted(set(c.other))) or 'none'}"
        print(line)
    for text in (t for c in found for t in c.collisions):
        print(f"  {text}")
    return int(any(c.collisions for c in found) and chosen.push <= 0.0)


if __name__ == "__main__":
    sys.exit(main())

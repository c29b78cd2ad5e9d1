"""Seeded faults of sensors, drives and bus while arms move: what the plant does from the detection on.

    python -m tools.stop_campaign --runs 1000                    # five arms, every fault, brakes ideal and slipping
    python -m tools.stop_campaign --runs 50 --arms ur5 --brakes none
    python -m tools.stop_campaign --only 17 --json               # one run of the thousand again

The plant's truth judges, never what the controller believes. Exit code 1 when a bound is broken; arms without brakes
are played and printed, and have no bound: nothing of the program holds them yet.
"""

import argparse
import json
import math
import sys
from collections.abc import Iterator, Sequence
from multiprocessing import get_context
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from rtctl import design
from rtctl.app.sim import simulate_scenario
from rtctl.plain import Json
from rtctl.spec.plant import PlantTable
from rtctl.spec.scenario import FaultTable, Scenario, TimedGoal
from rtctl.types import F64, Drive, State, Truth

ROOT = Path(__file__).resolve().parent.parent
ARMS = ("planar4", "puma560", "panda", "ur5", "openarm")
KINDS = (
    "drive_fault",
    "overheat",
    "watchdog",
    "silent",
    "drop",
    "corrupt_crc",
    "corrupt_command",
    "weak",
    "stuck_encoder",
    "false_velocity",
    "encoder_jump",
    "reboot",
)
FIRST, LATEST, AFTER = 0.4, 1.4, 1.0  # [s] of the goal; of the fault; played after it
SLIPS = 0.6  # of a joint's rating: the torque at which a worn brake slips
KNOCK = 5e-3  # [s] after the brakes close, in which one that holds a heavy joint throws the lighter ones
FASTER = 0.3  # [rad/s] above the speed at the detection
WAY = {"ideal": 0.05, "slipping": 0.10, "none": math.inf}  # [m] of the tip from the detection on
Brakes = Literal["ideal", "slipping", "none"]


class Case(NamedTuple):
    """One run to be made."""

    number: int
    arm: str
    brakes: Brakes
    scenario: Scenario


class Run(NamedTuple):
    """What came of it, by the plant."""

    number: int
    arm: str
    brakes: str
    kind: str
    joint: int
    at: float  # [s]
    noticed: float  # [s] from the fault until the arm left RUN, nan: it did not
    faster: float  # [rad/s] of any joint above its speed then, but for the knock of the brakes
    way: float  # [m] of the tip from then on
    beyond: float  # [rad] past a joint limit
    contacts: int  # that the run without the fault had not

    @property
    def fine(self) -> bool:
        """Whether the bounds hold."""
        if self.brakes == "none" or math.isnan(self.noticed):
            return True
        return self.faster <= FASTER and self.way <= WAY[self.brakes] and self.beyond <= 0.0 and self.contacts == 0


class _Course:
    """Watches a run."""

    def __init__(self, q_min: F64, q_max: F64, fault: float) -> None:
        self.q_min, self.q_max, self.fault = q_min, q_max, fault
        self.onset: Truth | None = None
        self.closed = math.inf
        self.faster = self.way = 0.0
        self.beyond, self.contacts = -math.inf, 0

    def __call__(self, servo: object, truth: Truth, turn: object) -> None:
        """Take one period into account."""
        state, drive = servo.memory.state, turn.command.drive  # type: ignore[attr-defined]
        self.contacts = truth.contacts
        self.beyond = max(self.beyond, float(np.maximum(self.q_min - truth.q, truth.q - self.q_max).max()))
        if self.onset is None:
            if truth.time < self.fault or state == State.RUN:
                return
            self.onset = truth
        if drive == Drive.DISABLE:
            self.closed = min(self.closed, truth.time)
        if not self.closed <= truth.time < self.closed + KNOCK:
            self.faster = max(self.faster, float((np.abs(truth.qd) - np.abs(self.onset.qd)).max()))
        self.way = max(self.way, float(np.linalg.norm(truth.tip - self.onset.tip)))


def cases(runs: int, arms: Sequence[str], brakes: Sequence[Brakes], seed: int) -> Iterator[Case]:
    """Yield the runs: arms, faults and brakes in turn, joints, instants and goals at random."""
    rng = np.random.default_rng(seed)
    for number in range(runs):
        arm, kind = arms[number % len(arms)], KINDS[number // len(arms) % len(KINDS)]
        held = brakes[number // (len(arms) * len(KINDS)) % len(brakes)]
        config = design.load(ROOT / "configs" / f"{arm}.toml")
        robot = design.build(config, ROOT / "configs" / f"{arm}.toml")
        low, high = robot.q_min + 0.35, robot.q_max - 0.35
        posture = np.clip(robot.home + rng.uniform(-0.5, 0.5, robot.n), np.minimum(low, high), np.maximum(low, high))
        tip = robot.body.evaluate(posture, np.zeros(robot.n), robot.points, robot.own).x
        slip = tuple((SLIPS * robot.tau_rated).tolist())
        fault = FaultTable(
            at_s=float(rng.uniform(FIRST + 0.1, LATEST)), kind=kind, joint=int(rng.integers(-1, robot.n))
        )
        scenario = Scenario(
            robot=arm,
            duration_s=fault.at_s + AFTER,
            seed=number,
            goal=(TimedGoal(at_s=FIRST, position_m=tuple(tip.tolist())),),
            fault=(fault,),
            plant=PlantTable(brake=slip if held == "slipping" else held),
        )
        yield Case(number, arm, held, scenario)


def play(case: Case) -> Run:
    """Play a run, and the same without its fault where anything was touched."""
    path = ROOT / "configs" / f"{case.arm}.toml"
    robot, fault = design.build(design.load(path), path), case.scenario.fault[0]
    course = _Course(robot.q_min, robot.q_max, fault.at_s)
    simulate_scenario(case.scenario, path, path, watch=course)
    touched = course.contacts
    if touched:
        sound = Scenario(
            robot=case.arm, duration_s=case.scenario.duration_s, seed=case.scenario.seed, goal=case.scenario.goal
        )
        alone = _Course(robot.q_min, robot.q_max, fault.at_s)
        simulate_scenario(sound, path, path, watch=alone)
        touched = max(touched - alone.contacts, 0)
    noticed = course.onset.time - fault.at_s if course.onset is not None else math.nan
    joint = fault.joint if isinstance(fault.joint, int) else -1
    return Run(
        case.number,
        case.arm,
        case.brakes,
        fault.kind,
        joint,
        fault.at_s,
        noticed,
        course.faster,
        course.way,
        course.beyond,
        touched,
    )


def table(runs: Sequence[Run]) -> list[str]:
    """Return the worst of each fault and kind of brakes, as Markdown."""
    rows = [
        "| fault | brakes | runs | noticed | faster [rad/s] | way [m] | past a limit [rad] | contacts | broken |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for kind, brakes in dict.fromkeys((r.kind, r.brakes) for r in runs):
        these = [r for r in runs if (r.kind, r.brakes) == (kind, brakes)]
        rows.append(
            f"| {kind} | {brakes} | {len(these)} | {sum(not math.isnan(r.noticed) for r in these)} "
            f"| {max(r.faster for r in these):.2f} | {max(r.way for r in these):.3f} "
            f"| {max(0.0, *(r.beyond for r in these)):.3f} | {sum(r.contacts for r in these)} "
            f"| {' '.join(str(r.number) for r in these if not r.fine)} |"
        )
    return rows


def told(run: Run) -> Json:
    """Return a run as JSON."""
    return {**run._asdict(), "fine": run.fine}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return its exit code."""
    parser = argparse.ArgumentParser(prog="python -m tools.stop_campaign", description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--arms", nargs="+", choices=ARMS, default=ARMS)
    parser.add_argument("--brakes", nargs="+", choices=tuple(WAY), default=("ideal", "slipping"))
    parser.add_argument("--only", type=int, help="the number of one run")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--json", action="store_true", help="a line of JSON for each run")
    args = parser.parse_args(argv)
    todo = [c for c in cases(args.runs, args.arms, args.brakes, args.seed) if args.only in (None, c.number)]
    runs = []
    with get_context("spawn").Pool(min(args.workers, len(todo))) as pool:
        for run in pool.imap(play, todo):
            runs.append(run)
            if args.json:
                print(json.dumps(told(run)), flush=True)
    print("\n".join(table(runs)))
    broken = [run for run in runs if not run.fine]
    print(f"{len(runs)} runs, {len(broken)} beyond a bound")
    return 1 if broken else 0


if __name__ == "__main__":
    sys.exit(main())

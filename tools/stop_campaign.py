"""Seeded faults of sensors, drives and bus while arms move: what the plant does from the detection on.

    python -m tools.stop_campaign --runs 1000                    # five arms, every fault, brakes ideal, slipping, none
    python -m tools.stop_campaign --runs 50 --arms ur5 --brakes none
    python -m tools.stop_campaign --only 17 --json               # one run of the thousand again

The plant's truth judges, never what the controller believes. Exit code 1 when a bound is broken. Which joints of an arm
without brakes can be held follows from the fault alone: not those whose drive gives nothing or whose encoder lies. The
others may not gather speed, and with all of them held the tip is lowered slowly; one that falls may not fall further
than it would by itself, all others locked.
"""

import argparse
import json
import math
import sys
import tempfile
from collections.abc import Iterator, Sequence
from multiprocessing import get_context
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from rtctl import design
from rtctl.app.sim import simulate_scenario
from rtctl.arm.robot import Robot
from rtctl.plain import Json
from rtctl.spec.plant import PlantTable
from rtctl.spec.scenario import FaultTable, Scenario, TimedGoal
from rtctl.types import F64, Drive, State, Truth

ROOT = Path(__file__).resolve().parent.parent
ARMS = ("planar4", "puma560", "panda", "ur5", "openarm_e2e")
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
FALLS = ("drive_fault", "overheat", "watchdog", "corrupt_command", "stuck_encoder", "false_velocity", "reboot")
FIRST, LATEST = 0.4, 1.4  # [s] of the goal; of the fault
AFTER = {"ideal": 1.0, "slipping": 1.0, "none": 2.2}  # [s] played after it
SOON = 0.7  # [s] in which joints without brakes come to rest
LANDS = 0.6  # [rad] of a joint that falls, after which it may come to its end and shake the others
LOWERED = 0.15  # [m/s] of the tip of an arm that is lowered
FREE = 1.1, 0.03  # times, and [rad] more, than a joint falls by itself
SLIPS = 0.6  # of a joint's rating: the torque at which a worn brake slips
KNOCK = 5e-3  # [s] after the brakes close, in which one that holds a heavy joint throws the lighter ones
FASTER = 0.3  # [rad/s] above the speed at the detection
WAY = {"ideal": 0.05, "slipping": 0.10, "none": math.inf}  # [m] of the tip from the detection on; none: lowered
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
    held: float = 0.0  # [rad/s] without brakes: of joints that can be held, above their speed at the detection
    sinks: float = 0.0  # [m/s] of the tip where all of them are held
    falls: float = 0.0  # way of one that is not, over what it may fall

    @property
    def fine(self) -> bool:
        """Whether the bounds hold."""
        if math.isnan(self.noticed):
            return True
        if self.brakes == "none":
            return self.held <= FASTER and self.sinks <= LOWERED and self.falls <= 1.0
        return self.faster <= FASTER and self.way <= WAY[self.brakes] and self.beyond <= 0.0 and self.contacts == 0


class _Course:
    """Watches a run."""

    def __init__(self, q_min: F64, q_max: F64, fault: float) -> None:
        self.q_min, self.q_max, self.fault = q_min, q_max, fault
        self.onset: Truth | None = None
        self.closed = math.inf
        self.faster = self.way = 0.0
        self.beyond, self.contacts = -math.inf, 0
        self.rows: list[tuple[float, F64, F64, F64]] = []  # time [s], q, qd, tip from the onset on

    def __call__(self, servo: object, truth: Truth, turn: object) -> None:
        """Take one period into account."""
        state, drive = servo.memory.state, turn.command.drive  # type: ignore[attr-defined]
        self.contacts = truth.contacts
        self.beyond = max(self.beyond, float(np.maximum(self.q_min - truth.q, truth.q - self.q_max).max()))
        if self.onset is None:
            if truth.time < self.fault or state == State.RUN:
                return
            self.onset = truth
        self.rows.append((truth.time, truth.q.copy(), truth.qd.copy(), truth.tip.copy()))
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
            duration_s=fault.at_s + AFTER[held],
            seed=number,
            goal=(TimedGoal(at_s=FIRST, position_m=tuple(tip.tolist())),),
            fault=(fault,),
            plant=PlantTable(brake=slip if held == "slipping" else held),
        )
        yield Case(number, arm, held, scenario)


def play(case: Case) -> Run:
    """Play a run, and the same without its fault where anything was touched."""
    with tempfile.TemporaryDirectory(prefix="rtctl-stops-") as folder:
        path = ROOT / "configs" / f"{case.arm}.toml"
        return _played(case, path if case.brakes != "none" else _bare(path, Path(folder)))


def _bare(path: Path, folder: Path) -> Path:
    """Write the file of an arm without its brakes; return its path."""
    text = path.read_text(encoding="utf-8").replace("brake = true", "brake = false")
    for urdf in path.parent.glob("*.urdf"):
        text = text.replace(f'urdf = "{urdf.name}"', f'urdf = "{urdf}"')
    (folder / path.name).write_text(text, encoding="utf-8")
    return folder / path.name


def _played(case: Case, path: Path) -> Run:
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
    bare = _unbraked(robot, course, fault.kind, joint) if case.brakes == "none" and course.rows else (0.0, 0.0, 0.0)
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
        *bare,
    )


def _unbraked(robot: Robot, course: _Course, kind: str, joint: int) -> tuple[float, float, float]:
    """Return the figures held, sinks and falls of a run."""
    t = np.array([row[0] for row in course.rows])
    q, qd, tip = (np.array([row[k] for row in course.rows]) for k in (1, 2, 3))
    t = t - t[0]
    lost = [j for j in range(robot.n) if kind in FALLS and joint in (-1, j)]
    kept = [j for j in range(robot.n) if j not in lost]
    lands = len(t)
    if lost:
        far = (
            (np.abs(q[:, lost] - q[0, lost]) > LANDS)
            | (q[:, lost] < course.q_min[lost])
            | (q[:, lost] > course.q_max[lost])
        )
        lands = int(far.any(axis=1).argmax()) or len(t)
    held = 0.0
    if kept:
        held = float((np.abs(qd[:lands, kept]) - np.abs(qd[0, kept])).max())
        if (t[:lands] > SOON).any():
            held = max(held, float(np.abs(qd[:lands, kept][t[:lands] > SOON]).max()))
    speed = np.linalg.norm(np.diff(tip, axis=0), axis=1) / np.diff(t)
    sinks = float(speed[t[1:] > SOON].max()) if not lost and (t[1:] > SOON).any() else 0.0
    falls = 0.0
    if len(lost) == 1 and lands > 1:
        way, free = np.abs(q[:lands, lost[0]] - q[0, lost[0]]), _falling(robot, q[0], qd[0], lost[0], t[:lands])
        falls = float((way / (FREE[0] * free + FREE[1])).max())
    return held, sinks, falls


def _falling(robot: Robot, q: F64, qd: F64, joint: int, t: F64) -> F64:
    """Return how far (T,) [rad] a joint falls by itself, all others locked: A qdd = -g - (dA/dq) qd^2 / 2."""
    q, start, way, still, v = q.copy(), q[joint], np.zeros(len(t)), np.zeros(robot.n), float(qd[joint])
    for k in range(1, len(t)):
        ahead = q.copy()
        ahead[joint] += 1e-4
        now, then = (robot.body.evaluate(x, still, robot.points, robot.own) for x in (q, ahead))
        A, slope = now.A[joint, joint], (then.A[joint, joint] - now.A[joint, joint]) / 1e-4
        v += (t[k] - t[k - 1]) * (-now.g[joint] - 0.5 * slope * v * v) / A
        q[joint] += (t[k] - t[k - 1]) * v
        way[k] = max(way[k - 1], abs(q[joint] - start))
    return way


def table(runs: Sequence[Run]) -> list[str]:
    """Return the worst of each fault and kind of brakes, as Markdown."""
    rows = [
        "| fault | brakes | runs | noticed | faster [rad/s] | way [m] | past a limit [rad] | contacts "
        "| held [rad/s] | lowered [m/s] | of a free fall | broken |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for kind, brakes in dict.fromkeys((r.kind, r.brakes) for r in runs):
        these = [r for r in runs if (r.kind, r.brakes) == (kind, brakes)]
        rows.append(
            f"| {kind} | {brakes} | {len(these)} | {sum(not math.isnan(r.noticed) for r in these)} "
            f"| {max(r.faster for r in these):.2f} | {max(r.way for r in these):.3f} "
            f"| {max(0.0, *(r.beyond for r in these)):.3f} | {sum(r.contacts for r in these)} "
            f"| {max(r.held for r in these):.2f} | {max(r.sinks for r in these):.3f} "
            f"| {max(r.falls for r in these):.2f} "
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
    parser.add_argument("--brakes", nargs="+", choices=tuple(WAY), default=("ideal", "slipping", "none"))
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

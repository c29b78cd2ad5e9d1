"""One scenario played as `rtctl sim` plays it, watched by an oracle of its own on the plant."""

from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from firmware_sim.plant import Contact, Plant
from rtctl import design as cfg
from rtctl.app.arm import ARM, ArmServo
from rtctl.app.arm_link import ArmLink, link_spec
from rtctl.app.arm_scene import ArmFeed, ArmTally, ArmTurn
from rtctl.app.guide import Guide
from rtctl.app.servo import Servo
from rtctl.app.simulator import open_simulator
from rtctl.arm import faults
from rtctl.arm.robot import Robot
from rtctl.design import Config
from rtctl.hal.can.transport import InProcess
from rtctl.hal.clock import lockstep
from rtctl.spec.read import convert
from rtctl.spec.scenario import Scenario
from rtctl.types import F64, Severity, Status, Truth

CONFIGS = Path(__file__).parents[2] / "configs"
REST = 0.3  # [s] that an arm is watched at its goal when nothing moves any more
LOOK = 10  # periods between two measurements of all clearances; contacts are seen in every period
RECENT = 0.05  # [s] before a contact in which the arm must have been at its limit


class Seen(NamedTuple):
    """What an oracle saw of one run, up to its first contact."""

    robot: str
    case: int  # index of the scenario
    duration: float  # [s] played
    arrived: bool
    error: float  # [m] at the end
    time_to_goal: float  # [s], infinite when it did not arrive
    contact: Contact | None  # the first
    retreat: float  # [m/s] of the arm's point at it
    can_retreat: float  # [m/s] that its joints allow at SPEED_BAND of their speed, those at a limit left out
    finite: bool
    torque: float  # largest ratio to the rating
    rate: float
    joint_speed: float
    tip_speed: float  # largest ratio to v_max
    margin: float  # [rad] least to any joint limit
    clearance: float  # [m] least
    own: float  # [m] least between links
    recent_torque: float  # largest ratio within RECENT of the end
    recent_speed: float
    recent_tip: float
    stopped: str  # the worst reaction, '' while it runs
    faults: tuple[str, ...]
    status: str
    detail: str
    statuses: tuple[tuple[float, str, str], ...]
    diagnosis: str  # '' when the status is borne out by the geometry, else what is wrong with it
    digest: str


def robot_of(name: str) -> tuple[Robot, Config]:
    """Return a robot of configs/ and its config, derived once a process."""
    return robot_at(CONFIGS / f"{name}.toml")


@cache
def robot_at(path: Path) -> tuple[Robot, Config]:
    """Return the robot of a file and its config, derived once a process."""
    config = cfg.load(path)
    return cfg.build(config, path), config


class Watch(ArmTally):
    """Figures of every period from the plant itself; clearances are measured every LOOK periods."""

    def __init__(self, robot: Robot, plant: Plant) -> None:
        super().__init__(robot)
        self.plant = plant
        self.finite = True
        self.worst_tau = 0.0
        self.ticks = 0
        self.trace: list[tuple[float, float, float]] = []  # torque, joint speed, tip speed ratios, a row a period
        self.path_of: list[F64] = []  # tip, a row a period
        self.turn_of: list[F64] = []  # its quaternion

    def truth(self) -> Truth:
        """Return the truth of now; clearances as last measured."""
        plant = self.plant
        if self.ticks % LOOK == 0:
            self._clear, self._own = plant.clearances(), plant.self_clearance()
        tip, wxyz = plant.tip_pose()
        q, qd = np.array(plant.q), np.array(plant.qd)
        return Truth(plant.time_ns * 1e-9, q, qd, q, tip, wxyz, self._clear, self._own, len(plant.contacts))

    def add(self, truth: Truth, turn: ArmTurn) -> None:
        """Take one period into account."""
        before = self.tip
        super().add(truth, turn)
        self.ticks += 1
        robot, tau = self.robot, turn.command.tau
        self.finite &= bool(np.isfinite(truth.q).all() and np.isfinite(truth.qd).all() and np.isfinite(tau).all())
        self.finite &= _numbers(turn.record)
        step = 0.0 if before is None else float(np.linalg.norm(truth.tip - before)) / robot.dt
        self.trace.append(
            (
                float((np.abs(tau) / robot.tau_max).max()),
                float((np.abs(truth.qd) / robot.qd_max).max()),
                step / robot.motion.v_max,
            )
        )
        self.path_of.append(truth.tip)
        self.turn_of.append(truth.tip_wxyz)


def _numbers(record: Any) -> bool:
    """Return whether a record holds numbers; distances may be infinite where there is no obstacle."""
    for field in record.dtype.names:
        values = record[field]
        if values.dtype.kind == "f" and np.isnan(values).any():
            return False
        if values.dtype.kind == "f" and field != "rho" and not np.isfinite(values).all():
            return False
    return True


def play(table: dict[str, Any], index: int, path: Path | None = None, guided: bool = True) -> Seen:
    """Return what was seen of a scenario given as tables; it ends with its first contact, or settled at the goal.

    path: the robot file, in place of the one in configs/. guided: False leaves the law alone.
    """
    name = table["robot"]
    path = path or CONFIGS / f"{name}.toml"
    robot, config = robot_at(path)
    scenario: Scenario = convert(table, Scenario, f"{name}:{index}")
    simulator: Any = open_simulator(path, scenario, CONFIGS / "stress.toml")
    link = ArmLink(link_spec(config), InProcess.of(simulator))
    try:
        servo = Servo(ARM, robot, link, None, link.greet(lockstep=True))
        watch = Watch(robot, simulator.plant)
        _run(servo, scenario, simulator, watch, guided)
        return _seen(servo, watch, name, index)
    finally:
        link.close()


def _run(servo: ArmServo, scenario: Scenario, simulator: Any, watch: Watch, guided: bool) -> None:
    robot = servo.robot
    guide = Guide(robot, robot.plans, scenario.seed) if guided else None
    feed = ArmFeed(robot, scenario, simulator, watch, guide)
    moving = any(not s.still for s in simulator.plant.solids)
    for slot in lockstep():
        truth = watch.truth()
        if truth.time >= scenario.duration_s or watch.plant.contacts:
            return
        if not moving and watch.legs and 0.0 <= watch.legs[-1].reached < truth.time - REST:
            return
        turn = servo.turn(slot, feed.request(servo.memory, truth))
        if not watch.plant.contacts:  # a blow moves the arm otherwise than its motors did
            watch.add(watch.truth(), turn)


def _seen(servo: ArmServo, watch: Watch, name: str, index: int) -> Seen:
    from tools.stress.judge import diagnosis

    robot, m, plant = servo.robot, servo.memory, watch.plant
    figures = watch.figures()
    contact = plant.contacts[0] if plant.contacts else None
    retreat, can = (0.0, 0.0) if contact is None else _retreat(robot, plant, contact)
    recent = np.array(watch.trace[-round(RECENT / robot.dt) :])
    whole = np.array(watch.trace)
    statuses = tuple((t + watch.offset, n, d) for t, n, d in servo.events)
    of_goal = [(n, d) for _, n, d in statuses if n.upper() in Status.__members__]
    status, detail = of_goal[-1] if of_goal else ("none", "")
    arrived = bool(figures["arrived"])
    wrong = "" if arrived or contact is not None else diagnosis(servo, watch, status, detail)
    return Seen(
        robot=name,
        case=index,
        duration=watch.ticks * robot.dt,
        arrived=arrived,
        error=figures["final_error_m"] if figures["final_error_m"] is not None else np.inf,
        time_to_goal=figures["time_to_goal_s"] if figures["time_to_goal_s"] is not None else np.inf,
        contact=contact,
        retreat=retreat,
        can_retreat=can,
        finite=watch.finite,
        torque=figures["max_torque_ratio"],
        rate=figures["max_torque_rate_ratio"],
        joint_speed=figures["max_joint_speed_ratio"],
        tip_speed=float(whole[:, 2].max()),
        margin=figures["min_joint_margin_rad"],
        clearance=min(watch.clearance.values(), default=np.inf),
        own=watch.own,
        recent_torque=float(recent[:, 0].max()),
        recent_speed=float(recent[:, 1].max()),
        recent_tip=float(recent[:, 2].max()),
        stopped=m.reaction.name if m.reaction > Severity.NONE else "",
        faults=tuple(faults.names(servo.faults_seen)),
        status=status,
        detail=detail,
        statuses=statuses,
        diagnosis=wrong,
        digest=servo.digest.hexdigest(),
    )


def _retreat(robot: Robot, plant: Plant, contact: Contact) -> tuple[float, float]:
    """Return the speed with which the arm's point fled and the one its joints allow [m/s], just before the contact."""
    row = np.array(contact.row if contact.row else np.zeros(robot.n))
    q = np.array(plant._before[0])
    room = np.where(row > 0.0, robot.q_max - q, q - robot.q_min)
    free = np.minimum(robot.qd_max, np.sqrt(2.0 * robot.braking * np.maximum(room, 0.0)))
    return -contact.arm_m_s, float(np.abs(row) @ free)

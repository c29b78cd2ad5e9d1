"""A Panda behind virtual drives, in this process: played by a scenario, or driven tick by tick."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from msgspec.structs import astuple
from numpy.typing import NDArray

from firmware_sim.simulator import open_simulator
from rtctl import design as cfg
from rtctl.app.arm import ARM
from rtctl.app.arm_link import ArmLink, first_feedback, link_spec
from rtctl.app.arm_scene import ArmFeed, ArmTally, ArmTurn
from rtctl.app.servo import Servo
from rtctl.app.sim import simulate
from rtctl.arm import faults
from rtctl.arm.memory import Memory
from rtctl.arm.pipe import initial, tick
from rtctl.arm.robot import Robot
from rtctl.hal.can.transport import InProcess
from rtctl.hal.clock import Slot
from rtctl.kernel.rotations import quat_of
from rtctl.spec.read import convert
from rtctl.spec.scenario import Scenario, scenario_dict
from rtctl.types import (
    F64,
    Command,
    Drive,
    Feedback,
    Goal,
    ObstacleEdit,
    Record,
    Request,
    Shape,
    State,
    Task,
    Truth,
    Verb,
)
from rtctl.world.primitives import Obstacles
from tests.arms import PANDA_HOME

ROOT = Path(__file__).resolve().parent.parent
PANDA = ROOT / "configs" / "panda.toml"
DOWN = np.array([0.0, 1.0, 0.0, 0.0])  # the hand points down


@cache
def _robot(path: Path) -> Robot:
    return cfg.build(cfg.load(path), path)


def robot(path: Path = PANDA) -> Robot:
    """Return the robot of a config; the Panda takes seconds to derive, so it is derived once."""
    return _robot(path)


def changed(folder: Path, name: str = "panda", **values: object) -> Path:
    """Write a copy of the Panda's file with top-level keys of its tables replaced; return its path."""
    lines = []
    for line in PANDA.read_text().splitlines():
        key = line.partition(" = ")[0]
        lines.append(f"{key} = {values[key]}" if key in values else line)
    path = folder / f"{name}.toml"
    path.write_text("\n".join(lines) + "\n")
    return path


class Run(NamedTuple):
    """What happened, a row a period."""

    robot: Robot
    t: F64  # (T,) [s] simulated
    q: F64  # (T, n) true
    qd: F64  # (T, n)
    tip: F64  # (T, 3)
    record: NDArray[Any]  # (T,) records of the tick
    requests: list[Request]
    figures: dict[str, Any]  # of sim.Tally
    events: list[tuple[float, str, str]]
    memory: Memory  # at the end
    digest: str

    def since(self, t: float) -> "Run":
        """Return the rows from time t [s] on."""
        k = int(np.searchsorted(self.t, t))
        return self._replace(
            t=self.t[k:],
            q=self.q[k:],
            qd=self.qd[k:],
            tip=self.tip[k:],
            record=self.record[k:],
            requests=self.requests[k:],
        )


def play(scenario: dict[str, Any], path: Path = PANDA) -> Run:
    """Return the run of a scenario given as the tables of its TOML, with what each period was."""
    play_of: Scenario = convert({"robot": "panda", **scenario}, Scenario, "scenario")
    arm = robot(path)
    with lab(path=path, scenario=scenario_dict(play_of)) as here:
        tally = ArmTally(arm)
        feed = ArmFeed(arm, play_of, here.simulator, tally)
        truths: list[Truth] = []
        while here.simulator.time < play_of.duration_s:
            turn = here.step(feed.request(here.memory, here.simulator.truth()))
            truths.append(here.simulator.truth())
            tally.add(truths[-1], turn)
        return Run(
            arm,
            np.array([x.time for x in truths]),
            np.array([x.q for x in truths]),
            np.array([x.qd for x in truths]),
            np.array([x.tip for x in truths]),
            np.concatenate([turn.record for turn in here.turns]),
            here.requests,
            tally.figures(),
            here.servo.events,
            here.servo.memory,
            here.servo.digest.hexdigest(),
        )


class Lab:
    """Servo, link, drives and plant of one arm; keeps every turn."""

    def __init__(self, path: Path, simulator: Any) -> None:
        """`simulator` is firmware_sim's; rtctl knows it by its protocol alone."""
        self.robot, self.simulator = robot(path), simulator
        self.link = ArmLink(link_spec(cfg.load(path)), InProcess.of(self.simulator))
        self.first = self.link.greet(lockstep=True)
        self.servo = Servo(ARM, self.robot, self.link, None, self.first)
        self.turns: list[ArmTurn] = []
        self.requests: list[Request] = []
        self.slot = 0

    @property
    def memory(self) -> Memory:
        """What the last tick left."""
        return self.servo.memory

    def step(self, request: Request = Request(), missed: int = 0) -> ArmTurn:  # noqa: B008 - a frozen value
        """Play one slot, after `missed` ones in which nothing was sent."""
        for _ in range(missed):
            self.simulator.advance()
        self.slot += missed
        turn = self.servo.turn(Slot(self.slot, missed, 0.0), request)
        self.slot += 1
        self.turns.append(turn)
        self.requests.append(request)
        return turn

    def run(self, seconds: float) -> None:
        """Play slots in which nobody asks for anything."""
        for _ in range(round(seconds / self.robot.dt)):
            self.step()

    def until(self, state: State, seconds: float = 5.0) -> None:
        """Play slots until the supervisor is in `state`."""
        for _ in range(round(seconds / self.robot.dt)):
            if self.memory.state == state:
                return
            self.step()
        assert self.memory.state == state

    def running(self) -> "Lab":
        """Arm; return when the law drives the arm."""
        self.step(Request(Verb.ARM))
        self.until(State.RUN)
        return self

    def ask(self, position: Sequence[float] | F64, wxyz: F64 | None = None) -> ArmTurn:
        """Give a goal."""
        return self.step(Request(goal=goal(self.memory, position, wxyz)))


@contextmanager
def lab(
    start_q: Sequence[float] | None = None,
    path: Path = PANDA,
    scenario: dict[str, Any] | None = None,
    inject: Sequence[str] = (),
) -> Iterator[Lab]:
    """Open an arm at rest at start_q (n,) [rad], at the config's home if none is given."""
    simulator = open_simulator(path, scenario, start_q, inject=inject)
    try:
        yield Lab(path, simulator)
    finally:
        simulator.close()


def goal(memory: Memory, position: Sequence[float] | F64, wxyz: F64 | None = None, tolerance: float = 0.003) -> Goal:
    """Return a goal of position alone, or of a pose."""
    task = Task.POSITION if wxyz is None else Task.POSE
    return Goal(np.array(position, np.float64), quat_of(memory.tip.R) if wxyz is None else wxyz, task, tolerance, 0.015)


def sphere(name: str, position: Sequence[float] | F64, radius: float, velocity: Sequence[float] = (0, 0, 0)) -> Shape:
    """Return a ball."""
    return Shape(
        name,
        "sphere",
        np.array([radius, 0.0, 0.0, 0.0]),
        np.array(position, np.float64),
        np.array([1.0, 0.0, 0.0, 0.0]),
        np.array(velocity, np.float64),
        np.zeros(3),
    )


def seen(*shapes: Shape, age: float = 0.0) -> Request:
    """Return what a camera tells of these shapes."""
    return Request(obstacles=tuple(ObstacleEdit(s.name, s, age) for s in shapes))


# ---- the tick alone, at feedback that is made up


def healthy(q: F64, slot: int, dt: float = 1e-3, **changes: Any) -> Feedback:
    """Return what a healthy, enabled arm at rest at q (n,) [rad] reports at a slot."""
    n = len(q)
    zero = np.zeros(n)
    return Feedback(
        slot=slot,
        missed=0,
        q=q.astype(np.float64),
        qd=zero,
        tau=zero,
        age=np.full(n, dt),
        replies=np.ones(n, np.int64),
        drive=np.ones(n, np.int64),
        link=0,
        lateness=0.0,
        compute=0.0,
    )._replace(**changes)


def at_rest(arm: Robot, q: F64, **changes: Any) -> Memory:
    """Return the memory of an arm at rest at q (n,) [rad]."""
    return initial(arm, first_feedback(q))._replace(**changes)


class Standing:
    """The tick of an arm that stands still, holds itself and echoes what it is sent; anything can be said to it."""

    def __init__(self, state: State = State.RUN, q: F64 = PANDA_HOME, arm: Robot | None = None) -> None:
        self.robot = robot() if arm is None else arm
        self.q, self.slot = q, 0
        self.enabled = state != State.IDLE
        first = at_rest(self.robot, q)
        gravity = first.model.g  # already held: nothing has to build up
        self.memory: Memory = first._replace(state=state, sent=np.tile(gravity, (4, 1)), speed_scale=1.0)
        self.command = Command(Drive.TORQUE, gravity)
        self.record: Record

    def tick(self, request: Request = Request(), **said: Any) -> Memory:  # noqa: B008 - a frozen value
        """Play one slot in which the feedback is healthy but for what is `said`."""
        feedback = healthy(self.q, self.slot, tau=self.command.tau, drive=np.full(7, int(self.enabled)))._replace(
            **said
        )
        self.slot += 1 + feedback.missed
        self.memory, self.command, self.record = tick(self.robot, self.memory, feedback, request)
        if self.command.drive != Drive.TORQUE:
            self.enabled = self.command.drive == Drive.ENABLE
        return self.memory

    def ticks(self, count: int, **said: Any) -> Memory:
        """Play slots in which nobody asks for anything."""
        for _ in range(count):
            self.tick(**said)
        return self.memory

    def ask(self, verb: Verb, **said: Any) -> str:
        """Return why a verb was refused, '' if it was not."""
        return self.tick(Request(verb), **said).refusal

    def state(self) -> State:
        """Return the supervisor's state."""
        return self.memory.state

    def drive(self) -> Drive:
        """Return what the drives were asked last."""
        return self.command.drive

    @property
    def present(self) -> set[str]:
        """Names of the faults in force."""
        return set(faults.names(self.memory.in_force))


def same(a: Any, b: Any) -> bool:
    """Return whether two values, however nested, agree to the bit."""
    if isinstance(a, np.ndarray):
        return isinstance(b, np.ndarray) and a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
    if isinstance(a, Memory) and isinstance(b, Memory):
        return same(astuple(a), astuple(b))
    if isinstance(a, tuple | list):
        return type(a) is type(b) and len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, float | np.floating):
        return np.float64(a).tobytes() == np.float64(b).tobytes()
    return bool(a == b)


def without(obstacles: Obstacles, slot: int) -> Obstacles:
    """Return the obstacles with a slot inactive."""
    active = obstacles.active.copy()
    active[slot] = False
    return obstacles._replace(active=active)


def leaves(value: Any, visit: Callable[[NDArray[Any]], None]) -> None:
    """Call `visit` with every array inside nested tuples."""
    if isinstance(value, Memory):
        value = astuple(value)
    if isinstance(value, np.ndarray):
        visit(value)
    elif isinstance(value, tuple | list):
        for each in value:
            leaves(each, visit)


def recorded(folder: Path, scene: str) -> dict[str, Any]:
    """Play a scene of the Panda, given as TOML, into folder/run.mcap; return its figures. The robot is built once."""
    (folder / "scene.toml").write_text(scene)
    arm = robot()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cfg, "build", lambda config, path: arm)
        return simulate(folder / "scene.toml", log=folder / "run.mcap")

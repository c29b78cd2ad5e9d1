"""A scenario played to a simulated rover: what the controller is told and when, and the figures of what came of it."""

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol, TypeAlias, cast

import numpy as np

from rtctl.app.rover_link import RoverLink, open_link
from rtctl.app.simulator import open_simulator
from rtctl.app.tally import Leg, kept, number, of_way
from rtctl.app.vehicle import Said, Turn
from rtctl.control.goals import RESTS
from rtctl.errors import ConfigError
from rtctl.hal.mavlink.wire import InProcess
from rtctl.plain import Json
from rtctl.rover import turn
from rtctl.rover.memory import BaseMemory
from rtctl.rover.robot import Base
from rtctl.rover.signals import BaseCommand, BaseFeedback
from rtctl.spec.base import BaseConfig
from rtctl.spec.goal import streamed
from rtctl.spec.scenario import Scenario, goal_of
from rtctl.types import F64, Goal, Request, State, Task, Verb

RoverTurn: TypeAlias = Turn[BaseFeedback, BaseCommand]
UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])
SHOWN = frozenset(("state", "fault", "vehicle"))  # events that are no statuses


class RoverTruth(Protocol):
    """The simulator's own account of a period."""

    @property
    def time(self) -> float: ...  # [s] of the scenario
    @property
    def x(self) -> float: ...  # [m] east
    @property
    def y(self) -> float: ...  # [m] north
    @property
    def v(self) -> float: ...  # [m/s]
    @property
    def yaw(self) -> float: ...  # [rad]
    @property
    def clearance(self) -> dict[str, float]: ...  # [m] of the outline, by obstacle
    @property
    def contacts(self) -> int: ...


class RoverSimulator(Protocol):
    """Autopilot and vehicle in lockstep."""

    def exchange(self, packets: list[bytes]) -> list[bytes]: ...  # one servo period
    def truth(self) -> RoverTruth: ...


class RoverTally:
    """Figures of a run, from the truth of each period."""

    def __init__(self) -> None:
        self.legs: list[Leg] = []
        self.path = self.speed = 0.0
        self.clearance: dict[str, float] = {}
        self.contacts = 0
        self._at: F64 | None = None

    def add(self, truth: RoverTruth) -> None:
        """Take one period into account."""
        at = np.array([truth.x, truth.y])
        if self._at is not None:
            self.path += float(np.hypot(*(at - self._at)))
        self._at = at
        self.speed, self.contacts = max(self.speed, abs(truth.v)), truth.contacts
        for name, d in truth.clearance.items():
            self.clearance[name] = min(d, self.clearance.get(name, np.inf))
        if self.legs:
            self.legs[-1] = _advanced(self.legs[-1], at, truth.yaw, truth.time)

    def figures(self) -> Json:
        """Return the figures under their published names."""
        return of_way(
            self.legs,
            self.path,
            self.speed,
            self.clearance,
            self.contacts,
            turned=any(leg.goal.task & Task.RZ for leg in self.legs),
        )


def _advanced(leg: Leg, at: F64, yaw: float, now: float) -> Leg:
    along = leg.goal.position[:2] - leg.start
    e = float(np.hypot(*(leg.goal.position[:2] - at)))
    turned = abs(turn.left(leg.goal, yaw))
    there = e <= leg.goal.tolerance and turned <= leg.goal.tolerance_rot
    return leg.advanced(now, there, along, at - leg.start, e, turned)


class RoverFeed:
    """What the controller is told and when: arming, and the scenario's goals. Obstacles its sensor must see."""

    def __init__(self, base: Base, scenario: Scenario, tally: RoverTally) -> None:
        self.base, self.tally = base, tally
        self.pending = list(scenario.goal)
        self.waiting: tuple[Goal, float, F64] | None = None

    def request(self, m: BaseMemory, truth: RoverTruth) -> Request:
        """Return the request of this period."""
        if self.waiting is not None and not m.refusal:
            self.tally.legs.append(Leg(*self.waiting))
        self.waiting = None
        verb = Verb.ARM if m.state == State.IDLE and m.tick < 0 else Verb.NONE
        goal = None
        if self.pending and truth.time >= self.pending[0].at_s and m.state == State.RUN:
            goal = goal_of(self.pending.pop(0), UPRIGHT, self.base.tolerance, self.base.tolerance_rot)
            self.waiting = (goal, truth.time, np.array([truth.x, truth.y]))
        return Request(verb, goal)


class RoverPlay:
    """A scenario in the simulator: the feed, the tally, and the truth of now."""

    arm_time = 5.0  # [s]

    def __init__(self, base: Base, scenario: Scenario, rover: RoverSimulator, link: RoverLink) -> None:
        """`link` ends in the simulator."""
        self.robot, self.link, self.rover = base, link, rover
        self.tally = RoverTally()
        self.feed = RoverFeed(base, scenario, self.tally)
        self.truth: RoverTruth = rover.truth()

    @property
    def kept(self) -> float:
        """How long [s] the last of all goals has been kept, 0 before."""
        return kept(self.tally.legs, len(self.feed.pending), self.truth.time)

    def look(self) -> float:
        """Take the truth of now; return the scenario's time [s]."""
        self.truth = self.rover.truth()
        return self.truth.time

    def request(self, memory: BaseMemory) -> Request:
        """Return the request of this period."""
        return self.feed.request(memory, self.truth)

    def add(self, turn: RoverTurn) -> None:
        """Take the period that has passed into account."""
        self.truth = self.rover.truth()
        self.tally.add(self.truth)

    def figures(self, events: Sequence[Said]) -> Json:
        """Return the figures, what the controller said, [t, name, detail], and what the vehicle said."""
        return {
            **self.tally.figures(),
            "statuses": [[number(t), name, detail] for t, name, detail in events if name not in SHOWN],
            "vehicle": [[number(t), detail] for t, name, detail in events if name == "vehicle"],
        }


def open_play(config: BaseConfig, path: Path, base: Base, scenario: Scenario, source: Path) -> RoverPlay:
    """Return a scenario of the file `source` and the rover that plays it. Raises RtctlError."""
    if scenario.plant is not None:
        raise ConfigError(f"{source}: plant", "a table", "nothing: that is for arms")
    if scenario.start_q_rad is not None:
        raise ConfigError(f"{source}: start_q_rad", "angles", "nothing: a base has start_pose")
    for k, goal in enumerate(scenario.goal):
        if found := streamed(goal):
            raise ConfigError(f"{source}: goal[{k}].{found[0]}", f"{found[1]}", RESTS)
    rover = cast(RoverSimulator, open_simulator(path, scenario, source))
    return RoverPlay(base, scenario, rover, open_link(config, path, InProcess(rover.exchange, base.dt)))

"""A scenario played to a simulated arm: what the controller is told and when, and the figures of what came of it."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TypeAlias

import numpy as np

from rtctl.app.guide import Guide, seen_of
from rtctl.app.tally import Leg, kept, number, of_way
from rtctl.app.vehicle import Link, Said, Turn
from rtctl.arm import task
from rtctl.arm.memory import Memory
from rtctl.arm.robot import Robot
from rtctl.control.firas import rooms_of
from rtctl.control.goals import moves
from rtctl.design.assets import load_assets
from rtctl.errors import ConfigError
from rtctl.kernel.rotations import R_of, exp3, quat_of
from rtctl.plain import Json
from rtctl.spec.obstacles import refuse_rooms
from rtctl.spec.scenario import Scenario, goal_of
from rtctl.types import (
    F64,
    GOAL_TIMEOUT,
    Advice,
    Command,
    Drive,
    Feedback,
    Goal,
    Grip,
    ObstacleEdit,
    Request,
    Shape,
    Simulator,
    State,
    Truth,
    Verb,
)

ArmTurn: TypeAlias = Turn[Feedback, Command]
CAMERA_HZ = 50.0  # rate at which moving obstacles are reported to the controller
SHOWN = frozenset(("state", "fault"))  # events that are no statuses


class ArmTally:
    """Figures of a run, from the truth of each period."""

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        self.legs: list[Leg] = []
        self.tip: F64 | None = None
        self.tau: F64 | None = None
        self.path = self.speed = 0.0
        zero = np.zeros(robot.n)
        self.torque, self.step, self.joint_speed = zero.copy(), zero.copy(), zero.copy()  # largest of each joint
        self.lowest, self.highest = zero + np.inf, zero - np.inf  # [rad]
        self.own = np.inf
        self.clearance: dict[str, float] = {}
        self.contacts = 0
        self.offset = 0.0  # [s] scenario time less the servo's

    def add(self, truth: Truth, turn: ArmTurn) -> None:
        """Take one period into account."""
        robot = self.robot
        self.offset = truth.time - (turn.feedback.slot + 1) * robot.dt
        if self.tip is not None:
            step = math.dist(truth.tip, self.tip)
            self.path, self.speed = self.path + step, max(self.speed, step / robot.dt)
        self.tip = truth.tip.copy()
        driven = turn.command.drive == Drive.TORQUE
        if driven and self.tau is not None:
            np.maximum(self.step, np.abs(turn.command.tau - self.tau), out=self.step)
        self.tau = turn.command.tau if driven else None
        np.maximum(self.torque, np.abs(turn.command.tau), out=self.torque)
        np.maximum(self.joint_speed, np.abs(truth.qd), out=self.joint_speed)
        np.minimum(self.lowest, truth.q, out=self.lowest)
        np.maximum(self.highest, truth.q, out=self.highest)
        self.own, self.contacts = min(self.own, truth.self_clearance), truth.contacts
        for name, d in truth.clearance.items():
            self.clearance[name] = min(d, self.clearance.get(name, np.inf))
        if self.legs:
            self.legs[-1] = _advanced(self.legs[-1], truth)

    def figures(self) -> Json:
        """Return the figures under their published names."""
        robot = self.robot
        margin = np.minimum(self.lowest - robot.q_min, robot.q_max - self.highest)
        return {
            **of_way(self.legs, self.path, self.speed, self.clearance, self.contacts, turned=True),
            "min_self_clearance_m": number(self.own),
            "min_joint_margin_rad": number(float(margin.min())),
            "max_torque_ratio": number(float((self.torque / robot.tau_rated).max())),
            "max_torque_rate_ratio": number(float((self.step / (robot.tau_rate * robot.dt)).max())),
            "max_joint_speed_ratio": number(float((self.joint_speed / robot.qd_max).max())),
        }


def _advanced(leg: Leg, truth: Truth) -> Leg:
    goal = _now(leg.goal, truth.time - leg.at)
    e, e_rot = task.error_of(goal, truth.tip, R_of(truth.tip_wxyz))
    along = task.point_of(goal, leg.start) - leg.start
    offset = task.point_of(goal._replace(position=truth.tip), leg.start) - leg.start  # what is free has no line
    there = e <= goal.tolerance and e_rot <= goal.tolerance_rot
    return leg.advanced(truth.time, there, along, offset, e, e_rot)


def _now(goal: Goal, age: float) -> Goal:
    """Return where a goal is that was given `age` [s] ago."""
    if not moves(goal):
        return goal
    t = min(age, goal.timeout or GOAL_TIMEOUT)
    x = goal.position if goal.velocity is None else goal.position + goal.velocity * t
    return goal._replace(
        position=x, wxyz=goal.wxyz if goal.omega is None else quat_of(exp3(goal.omega * t) @ R_of(goal.wxyz))
    )


class ArmFeed:
    """What the controller is told and when: arming, the scenario's goals, and a camera's view of its obstacles."""

    def __init__(
        self, robot: Robot, scenario: Scenario, simulator: Simulator, tally: ArmTally, guide: Guide | None = None
    ) -> None:
        """`guide` advises; without one the law is alone, unless the scenario asks for a plan of each goal."""
        self.robot, self.simulator, self.tally = robot, simulator, tally
        self.pending = list(scenario.goal)
        self.grips = sorted(scenario.grip, key=lambda g: g.at_s)
        self.waiting: tuple[Goal, float, F64] | None = None  # given to the tick, its refusal not yet seen
        self.last: dict[str, Shape | None] = {}
        self.frames = 0
        planned = Guide(robot, True, scenario.seed, at_once=True) if scenario.planner else guide
        self.guide: Guide | None = planned
        self.events: list[tuple[float, str, str]] = []  # of the guide; (time [s], name, detail)

    def request(self, m: Memory, truth: Truth) -> Request:
        """Return the request of this period."""
        if self.waiting is not None and not m.refusal:
            self.tally.legs.append(Leg(*self.waiting))
            if self.guide is not None:
                self.guide.begin()
        self.waiting = None
        verb = Verb.NONE
        if m.state == State.IDLE and m.tick < 0:
            verb = Verb.RECOVER if _outside(self.robot, m.joints.q) else Verb.ARM
        goal = None
        due = self.pending and truth.time >= self.pending[0].at_s
        if due and m.state == State.RUN and not m.outside:
            goal = goal_of(self.pending.pop(0), quat_of(m.tip.R), self.robot.tolerance, self.robot.tolerance_rot)
            goal = goal._replace(task=task.within(goal.task, self.robot.axes)[0])
            self.waiting = (goal, truth.time, truth.tip.copy())
            return Request(verb, goal, self._seen(truth), grip=self._grip(m, truth))
        return Request(verb, None, self._seen(truth), advice=self._advice(m, truth), grip=self._grip(m, truth))

    def _grip(self, m: Memory, truth: Truth) -> Grip | None:
        """Return what grippers are asked now; what is due before the arm runs waits."""
        if not self.grips or m.state != State.RUN or truth.time < self.grips[0].at_s:
            return None
        asked = self.grips.pop(0)
        return Grip(asked.closed, asked.force_N)

    def _advice(self, m: Memory, truth: Truth) -> Advice | None:
        if self.guide is None or not self.guide.due(m.tick):
            return None
        advice = self.guide.advise(seen_of(m))
        self.events += [(truth.time, name, text) for name, text in self.guide.events]
        self.guide.events.clear()
        return advice

    def _seen(self, truth: Truth) -> tuple[ObstacleEdit, ...]:
        """Return what a camera reports: everything at first, then at its rate what moves, appears or is gone."""
        if truth.time * CAMERA_HZ < self.frames and self.frames:
            return ()
        self.frames = int(truth.time * CAMERA_HZ) + 1
        seen = []
        known = {shape.name for shape in self.robot.obstacles}  # the config's own need no camera, and take none
        for edit in self.simulator.obstacles():
            old = self.last.get(edit.name)
            if edit.name in known:
                continue
            if edit.shape is not None and old is not None and _same_and_still(edit.shape, old):
                continue
            self.last[edit.name] = edit.shape
            seen.append(edit)
        return tuple(seen)


def _same_and_still(a: Shape, b: Shape) -> bool:
    """Return whether an obstacle rests where it was seen to rest before."""
    moving = a.velocity.any() or a.omega.any() or b.velocity.any()
    return not moving and bool((a.position == b.position).all())


def _outside(robot: Robot, q: F64) -> bool:
    """Return whether a joint is beyond its limits at q (n,) [rad], as the drives tell it: so the tick will judge."""
    return bool(((q < robot.q_min) | (q > robot.q_max)).any())


class ArmPlay:
    """A scenario in the simulator: the feed, the tally, and the truth of now."""

    arm_time = 2.0  # [s]

    def __init__(self, robot: Robot, scenario: Scenario, simulator: Simulator, link: Link[Feedback, Command]) -> None:
        """`link` ends in the simulator; `robot` knows the scenario's meshes, see `scenario_robot`."""
        self.robot, self.link, self.simulator = robot, link, simulator
        self.tally = ArmTally(robot)
        self.feed = ArmFeed(robot, scenario, simulator, self.tally, Guide(robot, robot.plans, scenario.seed))
        self.truth: Truth = simulator.truth()

    @property
    def kept(self) -> float:
        """How long [s] the last of all goals has been kept, 0 before."""
        return kept(self.tally.legs, len(self.feed.pending), self.truth.time)

    def look(self) -> float:
        """Take the truth of now; return the scenario's time [s]."""
        self.truth = self.simulator.truth()
        return self.truth.time

    def request(self, memory: Memory) -> Request:
        """Return the request of this period."""
        return self.feed.request(memory, self.truth)

    def add(self, turn: ArmTurn) -> None:
        """Take the period that has passed into account."""
        self.truth = self.simulator.truth()
        self.tally.add(self.truth, turn)

    def figures(self, events: Sequence[Said]) -> Json:
        """Return the figures, and what the controller and the planner said, [t, name, detail]."""
        said = [(t + self.tally.offset, name, detail) for t, name, detail in events if name not in SHOWN]
        in_order = sorted(said + self.feed.events, key=lambda event: event[0])
        return {**self.tally.figures(), "statuses": [[number(t), name, detail] for t, name, detail in in_order]}


def scenario_robot(robot: Robot, scenario: Scenario, path: Path) -> Robot:
    """Return the robot with the meshes of a scenario file's obstacles. Raises ConfigError."""
    start = scenario.start_q_rad
    if start is not None and len(start) != robot.n:
        raise ConfigError(f"{path}: start_q_rad", f"{len(start)} angles", f"{robot.n}, one a joint of {robot.name}")
    for k, goal in enumerate(scenario.goal):
        if goal.heading_rad is not None:
            place = f"{path}: goal[{k}].heading_rad"
            raise ConfigError(place, f"{goal.heading_rad:g}", "rpy_rad or wxyz: an arm has no heading")
    refuse_rooms(scenario.obstacle, rooms_of(robot.avoid), str(path))
    return robot._replace(meshes=load_assets((), scenario.obstacle, path, robot.meshes).meshes)

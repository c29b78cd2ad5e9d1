"""The global planner: a far goal into a stream of sub-goals for the same goal interface (OMPL, joint space).

RRT-Connect over the joints; a posture is free when every point subjected to the potential keeps a clearance from every
obstacle, no two links come near, and no joint enters its limit zone. The clearance begins at the field's influence, so
that a planned path feels no repulsion at all, and is relaxed in steps where there is no room for that; near the start
and the goal it falls to what these have. Seeded: equal inputs give equal paths.
"""

import time
from collections.abc import Callable, Iterator
from functools import partial
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from ompl import base, geometric, util

from rtctl.arm.model import Model
from rtctl.arm.robot import Robot
from rtctl.arm.task import selection, task_error
from rtctl.arm.task import within as able
from rtctl.errors import PlanError
from rtctl.kernel.rotations import quat_of
from rtctl.types import F64, Goal, Task
from rtctl.world.primitives import Obstacles, distances

ROOM = (1.0, 0.65, 0.4)  # fractions of influence and limit zone that a path keeps, tried in this order
EDGE = 0.06  # [rad] between two checked postures of an edge
FINE = 0.015  # [rad] between those of the finished path
BETWEEN = 0.8  # fraction of the room that a finished path has between the postures of its edges
RELAX = 0.3  # [m/rad] by which the clearance grows from that of start or goal
CHECKS = 30_000  # postures looked at, a step of ROOM
WITHIN = 60.0  # [s]; a plan that takes longer depends on the machine
SEEDS = 60  # random starts of the inverse kinematics
NEAREST = 0.8  # of the field's clearance that a goal posture must have
ENDS = 8  # goal postures offered to the planner
REACHED = 1e-4  # [m], and ten times that [rad], of the inverse kinematics
THERE = 0.01  # [m] tolerance of a sub-goal, which is passed long before
SPACING = 0.08  # [m] between sub-goals at most
TURN = 0.35  # [rad] that a joint, and the hand, may turn between sub-goals
CORRIDOR = 0.008  # [m] that the straight line between sub-goals may leave the planned path
STRETCH = 1.0  # [rad] longest edge of the tree


class Site(NamedTuple):
    """What a plan is made in."""

    robot: Robot
    obstacles: Obstacles
    start: F64  # (n,) [rad]


class Room(NamedTuple):
    """What a posture must keep free of."""

    rho: float  # [m] to obstacles
    own: float  # [m] between links
    low: F64  # (n,) [rad]
    high: F64  # (n,) [rad]


def plan(
    robot: Robot, q: F64, goal: Goal, obstacles: Obstacles, seed: int = 0, checks: int = CHECKS, within: float = WITHIN
) -> list[Goal]:
    """Return sub-goals that lead the arm from posture q (n,) [rad] to `goal`; the last one is `goal` itself.

    Each carries the posture it was planned with. The same `seed` gives the same path; `checks` bounds the postures
    looked at, a step of ROOM, and `within` [s] the time, whichever comes first. Raises PlanError, which says why.
    """
    task, why = able(goal.task, robot.axes)
    if why:
        raise PlanError(f"plan: {why}")
    goal = goal._replace(task=task)
    path = plan_joints(Site(robot, obstacles, np.array(q, np.float64)), goal, seed, checks, within)
    return sub_goals(robot, path, goal)


def plan_joints(site: Site, goal: Goal, seed: int, checks: int = CHECKS, within: float = WITHIN) -> F64:
    """Return the postures (k, n) [rad] of a path from the start to one that has the goal. Raises PlanError."""
    rho, own = _nearness(site, site.start)
    if min(rho, own) <= 0.0:
        raise PlanError(f"plan: the arm is in contact where it starts, {min(rho, own):.3f} m")
    rng = np.random.default_rng(seed)
    end, why = time.monotonic() + within, ""
    util.noOutputHandler()
    for share in ROOM:
        room = _room(site, share)
        ends, why = _goal_postures(site, goal, room, rng)
        free = _Free(site, room, ends)
        path = _searched(site, room, ends, free, seed, partial(_spent, free, checks, end))
        if path is not None:
            path = _shortened(path, free, rng)
            if free.along(path, FINE, BETWEEN):
                return path
        if time.monotonic() > end:
            raise PlanError(f"plan: no path to {_text(goal)} found in {within:g} s")
    raise PlanError(why or f"plan: no path to {_text(goal)} found in {checks} postures a try")


def sub_goals(robot: Robot, path: F64, goal: Goal) -> list[Goal]:
    """Return goals along a path (k, n) [rad], dense enough that straight lines between them stay beside it."""
    fine = _resampled(path, FINE)
    poses = [_evaluated(robot, q) for q in fine]
    goals, last = [], 0
    for k in range(1, len(fine)):
        if k + 1 < len(fine) and _may_skip(poses, fine, last, k + 1):
            continue
        x, R = poses[k].x, poses[k].R
        goals.append(Goal(x.copy(), quat_of(R), robot.axes, THERE, 10.0 * THERE, posture=fine[k].copy()))
        last = k
    return [*goals[:-1], goal._replace(posture=fine[-1].copy())]


def _may_skip(poses: list[Model], fine: F64, a: int, b: int) -> bool:
    """Return whether the straight line from pose a to pose b is short and stays near the poses between."""
    line = poses[b].x - poses[a].x
    length = float(np.linalg.norm(line))
    if length > SPACING or float(np.abs(fine[b] - fine[a]).max()) > TURN:
        return False
    u = line / length if length > 0.0 else line
    between = np.array([poses[k].x for k in range(a + 1, b)]) - poses[a].x
    off = between - np.outer(np.clip(between @ u, 0.0, length), u)
    return bool((np.linalg.norm(off, axis=1) <= CORRIDOR).all())


# -- what is free --------------------------------------------------------------------------------------------------


def _nearness(site: Site, q: F64) -> tuple[float, float]:
    """Return the least distance [m] of the arm to obstacles, and to itself, at q (n,)."""
    robot = site.robot
    rho, _ = distances(robot.body.placed(q, robot.points), robot.points.radius, site.obstacles)
    own = robot.body.own_distances(q, robot.own)
    return float(rho.min()), float(own.min()) if len(own) else np.inf


def _room(site: Site, share: float) -> Room:
    """Return what a path keeps free of: a share of influences and zones, never less than the clearances."""
    r, q = site.robot, site.start
    zone = np.maximum(share * r.limit.rho0, r.limit.rho_min)
    return Room(
        max(share * r.avoid.rho0, 1.2 * r.avoid.rho_min),
        max(share * r.self_avoid.rho0, r.self_avoid.rho_min),
        np.minimum(r.q_min + zone, q),
        np.maximum(r.q_max - zone, q),
    )


class _Free:
    """Whether a posture is free; counts how often it was asked."""

    def __init__(self, site: Site, room: Room, ends: list[F64]) -> None:
        self.site, self.room, self.asked = site, room, 0
        self.anchors = np.array([site.start, *ends])
        self.near = np.array([_nearness(site, q) for q in self.anchors])

    def __call__(self, q: F64, share: float = 1.0) -> bool:
        """Return whether q (n,) keeps a share of the room, relaxed towards what start and ends have."""
        self.asked += 1
        grown = 0.999 * self.near + RELAX * np.abs(self.anchors - q).max(axis=1)[:, None]
        robot = self.site.robot
        rho, _ = distances(robot.body.placed(q, robot.points), robot.points.radius, self.site.obstacles)
        if rho.min() < share * min(self.room.rho, grown[:, 0].min()):
            return False
        own = robot.body.own_distances(q, robot.own)
        return not len(own) or bool(own.min() >= share * min(self.room.own, grown[:, 1].min()))

    def along(self, path: F64, step: float, share: float = 1.0) -> bool:
        """Return whether every posture of a path (k, n), a joint's step [rad] apart at most, is free."""
        return all(self(q, share) for q in _resampled(path, step))


# -- the search ----------------------------------------------------------------------------------------------------


def _searched(
    site: Site, room: Room, ends: list[F64], free: "_Free", seed: int, stop: Callable[[], bool]
) -> F64 | None:
    """Return a path (k, n): a straight edge where one is free, else RRT-Connect's; None when that is stopped first."""
    for q in ends:
        edge = np.array([site.start, q])
        if free.along(edge, EDGE):
            return edge
    if not ends:
        return None
    util.RNG.setSeed(seed + 1)  # before anything that draws is made
    n = site.robot.n
    space = _space(room)
    info = base.SpaceInformation(space)
    info.setStateValidityChecker(lambda state: free(np.array([state[i] for i in range(n)])))
    info.setup()
    problem = base.ProblemDefinition(info)
    problem.addStartState(_state(space, site.start))
    goals = base.GoalStates(info)
    for q in ends:
        goals.addState(_state(space, q))
    problem.setGoal(goals)
    planner = geometric.RRTConnect(info)
    planner.setRange(STRETCH)
    planner.setProblemDefinition(problem)
    planner.setup()
    planner.solve(base.PlannerTerminationCondition(stop))
    if not problem.hasExactSolution():
        return None
    states = problem.getSolutionPath().getStates()
    return np.array([[state[i] for i in range(n)] for state in states])


def _spent(free: "_Free", checks: int, end: float) -> bool:
    return free.asked > checks or time.monotonic() > end


def _space(room: Room) -> base.RealVectorStateSpace:
    n = len(room.low)
    space, bounds = base.RealVectorStateSpace(n), base.RealVectorBounds(n)
    for i in range(n):
        bounds.setLow(i, float(room.low[i]) - 1e-9)
        bounds.setHigh(i, float(room.high[i]) + 1e-9)
    space.setBounds(bounds)
    space.setLongestValidSegmentFraction(EDGE / space.getMaximumExtent())
    return space


def _state(space: base.RealVectorStateSpace, q: F64) -> base.State:
    state = space.allocState()
    for i, value in enumerate(q):
        state[i] = float(value)
    return state


def _shortened(path: F64, free: _Free, rng: np.random.Generator, tries: int = 150) -> F64:
    """Return the path with random shortcuts taken where they are free."""
    for _ in range(tries):
        fine = _resampled(path, EDGE * 2.0)
        if len(fine) < 3:
            break
        a, b = sorted(rng.integers(0, len(fine), 2).tolist())
        if b - a < 2:
            continue
        if free.along(np.array([fine[a], fine[b]]), EDGE):
            path = np.concatenate([fine[: a + 1], fine[b:]])
    return path


def _resampled(path: F64, step: float) -> F64:
    """Return the path (k, n) with postures no more than a joint's `step` [rad] apart."""
    out = [path[:1]]
    for a, b in pairwise(path):
        count = max(1, int(np.ceil(np.abs(b - a).max() / step)))
        out.append(a + (b - a) * (np.arange(1, count + 1) / count)[:, None])
    return np.concatenate(out)


# -- postures that have the goal -------------------------------------------------------------------------------------


def _goal_postures(site: Site, goal: Goal, room: Room, rng: np.random.Generator) -> tuple[list[F64], str]:
    """Return free postures that have the goal, the best first, and why there are none ('' when there are).

    Good is near the start and far from obstacles: past the influence a goal casts no shadow.
    """
    robot = site.robot
    found: list[tuple[float, F64]] = []
    solved = 0
    for q0 in _seeds(site, rng):
        q = _inverse(robot, q0, goal, room)
        if q is None:
            continue
        solved += 1
        rho, own = _nearness(site, q)
        new = all(np.abs(q - other).max() > 0.1 for _, other in found)
        if new and rho >= NEAREST * robot.avoid.rho_min and own >= robot.self_avoid.rho_min:
            found.append((float(np.abs(q - site.start).max()) - 3.0 * min(rho / robot.avoid.rho0, 1.0), q))
    if not solved:
        return [], f"plan: no posture within the joint limits was found that has the goal {_text(goal)}"
    if not found:
        return [], f"plan: every posture found that has the goal {_text(goal)} touches something"
    return [q for _, q in sorted(found, key=lambda pair: pair[0])][:ENDS], ""


def _seeds(site: Site, rng: np.random.Generator) -> Iterator[F64]:
    yield site.start
    yield site.robot.home
    for _ in range(SEEDS):
        yield rng.uniform(site.robot.q_min, site.robot.q_max)


def _inverse(robot: Robot, q: F64, goal: Goal, room: Room) -> F64 | None:
    """Return a posture that has the goal, by damped least squares from q; None when that ends elsewhere."""
    q = np.clip(q, room.low, room.high)
    for _ in range(80):
        m = _evaluated(robot, q)
        e, e_rot = task_error(int(goal.task), goal.axis, goal.position, goal.wxyz, m.x, m.R)
        if np.linalg.norm(e) < REACHED and np.linalg.norm(e_rot) < 10.0 * REACHED:
            return q
        S = selection(int(goal.task), goal.axis, m.R)
        J = S @ m.J
        step = J.T @ np.linalg.solve(J @ J.T + 1e-4 * np.eye(len(S)), S @ np.concatenate([e, e_rot]))
        q = np.clip(q + step * min(1.0, 0.4 / max(float(np.abs(step).max()), 1e-9)), room.low, room.high)
    return None


def _evaluated(robot: Robot, q: F64) -> Model:
    return robot.body.evaluate(q, np.zeros(robot.n), robot.points)


def _text(goal: Goal) -> str:
    """Return what is asked for in words, the position first."""
    if not int(goal.task) & int(Task.POSITION):
        return "of that orientation"
    return " ".join(f"{c:.3f}" for c in goal.position) + " m"

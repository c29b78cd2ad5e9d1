"""The global planner: a far goal into a way of postures, or a stream of sub-goals for the goal interface.

RRT-Connect over the joints: OMPL's where there is much room; where there is little, one that is compiled whole
(`search`), since a narrow way takes many looks. A posture is free when every point subjected to the potential keeps a
clearance from every obstacle, no two links come near, and no joint enters its limit zone. The clearance begins at the
field's influence, so that a planned path feels no repulsion at all, and is relaxed in steps where there is no room for
that; near the start and the goal it falls to what these have. Edges are tested by one compiled call each. Seeded: equal
inputs give equal paths.
"""

import time
from collections.abc import Callable
from functools import partial
from itertools import pairwise

import numpy as np
from ompl import base, geometric, util

from rtctl.app.postures import SEEDS, Ending, Site, along, endings, site_of, skin_of
from rtctl.arm.freedom import Body, Room, body_of, first_blocked
from rtctl.arm.kinematics import clearance_of
from rtctl.arm.model import Model
from rtctl.arm.robot import Robot
from rtctl.arm.search import connected
from rtctl.arm.task import within as able
from rtctl.design.report import WAY_ROOM
from rtctl.errors import PlanError
from rtctl.kernel.rotations import quat_of
from rtctl.types import F64, Goal, Task
from rtctl.world.primitives import Obstacles

ROOM = (1.0, 0.65, 0.4, 0.25, 0.0)  # fractions of influence and limit zone that a path keeps, tried in this order
EDGE = 0.06  # [rad] between two checked postures of an edge
FINE = 0.015  # [rad] between those of the finished path
BETWEEN = 0.8  # fraction of the room that a finished path has between the postures of its edges
HARDER = 6  # times as many starts, in the last of these steps
CHECKS = 1500  # edges looked at, in the first of these steps
LOOKS = {0.65: 10, 0.4: 10, 0.25: 40, 0.0: 40}  # times as many postures, in the others
AROUND = (0.5, 1.0, 2.0)  # [rad] around start and ends that samples are drawn from, in turn: joints that may turn
# twice have a hundred times more room elsewhere
REACH = 1.0  # [rad] towards a sample
WITHIN = 60.0  # [s]; a plan that takes longer depends on the machine
NEAREST = 0.8  # of the field's clearance that a goal posture should have
THERE = 0.01  # [m] tolerance of a sub-goal, which is passed long before
SPACING = 0.08  # [m] between sub-goals at most
TURN = 0.35  # [rad] that a joint, and the hand, may turn between sub-goals
CORRIDOR = 0.008  # [m] that the straight line between sub-goals may leave the planned path
STRETCH = 1.0  # [rad] longest edge of the tree
FAR = 10.0  # [m] of a clearance that nothing bounds


def plan(
    robot: Robot, q: F64, goal: Goal, obstacles: Obstacles, seed: int = 0, checks: int = CHECKS, within: float = WITHIN
) -> list[Goal]:
    """Return sub-goals that lead the arm from posture q (n,) [rad] to `goal`; the last one is `goal` itself.

    Each carries the posture it was planned with. The same `seed` gives the same path; `checks` bounds the edges looked
    at, a step of ROOM, and `within` [s] the time, whichever comes first. Raises PlanError, which says why.
    """
    task, why = able(goal.task, robot.axes)
    if why:
        raise PlanError(f"plan: {why}")
    goal = goal._replace(task=task)
    path = plan_joints(site_of(robot, obstacles, q), goal, seed, checks, within)
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
        ends, why = _goal_postures(site, goal, share, seed, (1 if share else HARDER) * SEEDS)
        free = _Free(site, share, ends)
        for step in (EDGE, FINE) if ends else ():  # finer, where something was passed between two looks
            path = _straight(site, ends, free, step)
            if path is None and share in LOOKS:
                path = _through(site, ends, free, rng, step, LOOKS[share] * checks * (1 if step == EDGE else 2))
            elif path is None and step == EDGE:
                path = _searched(site, ends, free, seed, partial(_spent, free, checks, end))
            if path is None:
                break
            path = _shortened(path, free, rng, step)
            if free.along(path, FINE, BETWEEN):
                return path
        if time.monotonic() > end:
            raise PlanError(f"plan: no path to {_text(goal)} found in {within:g} s")
    raise PlanError(why or f"plan: no path to {_text(goal)} found in {LOOKS[0.0] * checks} postures")


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
    own = robot.body.own_distances(q, robot.own)
    rho = float(clearance_of(site.chain, robot.points, q[None], site.obstacles)[0])
    return min(rho, FAR), min(float(own.min()), FAR) if len(own) else FAR


class _Free:
    """Whether postures and edges keep a share of the influences and zones, never less than the clearances."""

    def __init__(self, site: Site, share: float, ends: list[F64]) -> None:
        r, q = site.robot, site.start
        zone = np.maximum(share * r.limit.rho0, 1.5 * r.limit.rho_min)
        anchors = np.array([q, *ends])
        self.low = np.minimum(r.q_min + zone, anchors.min(axis=0))
        self.high = np.maximum(r.q_max - zone, anchors.max(axis=0))
        self.body: Body = body_of(r, None if share else skin_of(r.body))  # the last try looks at the links themselves
        self.obstacles, self.asked = site.obstacles, 0
        self.room = Room(
            max(share * r.avoid.rho0, WAY_ROOM * r.avoid.rho_min),
            max(share * r.self_avoid.rho0, r.self_avoid.rho_min),
            anchors,
            np.array([_nearness(site, each) for each in anchors]),
        )

    def all(self, Q: F64, share: float = 1.0) -> bool:
        """Return whether all postures (b, n) keep a share of the room, relaxed towards what start and ends have."""
        self.asked += 1
        return first_blocked(self.body, Q, self.obstacles, self.room, share) < 0

    def along(self, path: F64, step: float, share: float = 1.0) -> bool:
        """Return whether every posture of a path (k, n), a joint's step [rad] apart at most, is free."""
        return self.all(_resampled(path, step), share)


# -- the search ----------------------------------------------------------------------------------------------------


def _straight(site: Site, ends: list[F64], free: _Free, step: float) -> F64 | None:
    """Return the first straight edge (2, n) to an end that is free."""
    return next((edge for q in ends if free.along(edge := np.array([site.start, q]), step)), None)


def _through(site: Site, ends: list[F64], free: _Free, rng: np.random.Generator, step: float, looks: int) -> F64 | None:
    """Return a path (k, n) that the compiled search finds within so many postures looked at, a step [rad] apart."""
    roots, n = np.array([site.start, *ends]), site.robot.n
    around = np.resize(np.repeat(AROUND, 2), looks // 4)[:, None]  # each tree grows towards samples of each
    low, high = np.maximum(free.low, roots.min(axis=0) - around), np.minimum(free.high, roots.max(axis=0) + around)
    samples = low + rng.random((len(around), n)) * (high - low)
    counts, reach = np.array([0, looks]), round(REACH / step)
    path = connected(free.body, roots, samples, site.obstacles, free.room, step, reach, counts)
    return path if len(path) else None


def _searched(site: Site, ends: list[F64], free: _Free, seed: int, stop: Callable[[], bool]) -> F64 | None:
    """Return a path (k, n) of OMPL's RRT-Connect, None when that is stopped first."""
    util.RNG.setSeed(seed + 1)  # before anything that draws is made
    n = site.robot.n
    space = _space(free)
    info = base.SpaceInformation(space)
    info.setStateValidityChecker(lambda state: free.all(_joints(state, n)[None]))
    validator = _Edges(info, free, n)
    info.setMotionValidator(validator)
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
    return np.array([_joints(state, n) for state in states])


class _Edges(base.MotionValidator):  # type: ignore[misc]
    """Tests an edge of the tree by one compiled call."""

    def __init__(self, info: base.SpaceInformation, free: _Free, n: int) -> None:
        super().__init__(info)
        self.free, self.n = free, n

    def checkMotion(self, a: base.State, b: base.State) -> bool:
        """Return whether the straight line between two states is free."""
        return self.free.all(along(_joints(a, self.n), _joints(b, self.n), EDGE))


def _spent(free: _Free, checks: int, end: float) -> bool:
    return free.asked > checks or time.monotonic() > end


def _joints(state: base.State, n: int) -> F64:
    return np.array([state[i] for i in range(n)])


def _space(free: _Free) -> base.RealVectorStateSpace:
    n = len(free.low)
    space, bounds = base.RealVectorStateSpace(n), base.RealVectorBounds(n)
    for i in range(n):
        bounds.setLow(i, float(free.low[i]) - 1e-9)
        bounds.setHigh(i, float(free.high[i]) + 1e-9)
    space.setBounds(bounds)
    space.setLongestValidSegmentFraction(EDGE / space.getMaximumExtent())
    return space


def _state(space: base.RealVectorStateSpace, q: F64) -> base.State:
    state = space.allocState()
    for i, value in enumerate(q):
        state[i] = float(value)
    return state


def _shortened(path: F64, free: _Free, rng: np.random.Generator, step: float, tries: int = 150) -> F64:
    """Return the path with random shortcuts taken where they are free."""
    for _ in range(tries):
        fine = _resampled(path, 2.0 * EDGE)
        if len(fine) < 3:
            break
        a, b = sorted(rng.integers(0, len(fine), 2).tolist())
        if b - a < 2:
            continue
        if free.all(along(fine[a], fine[b], step)):
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


def _goal_postures(site: Site, goal: Goal, share: float, seed: int, seeds: int) -> tuple[list[F64], str]:
    """Return free postures that have the goal, the best first, and why there are none ('' when there are).

    Those with a clearance to spare come alone, where there are some.
    """
    found: list[Ending] = endings(site, goal, seed, share, seeds)
    if not found:
        nothing = site.obstacles._replace(active=np.zeros_like(site.obstacles.active))
        if endings(site._replace(obstacles=nothing), goal, seed, 0.0):
            return [], f"plan: every posture found that has the goal {_text(goal)} touches something"
        return [], f"plan: no posture within the joint limits was found that has the goal {_text(goal)}"
    fine = [e.q for e in found if e.rho >= NEAREST * site.robot.avoid.rho_min]
    return fine or [e.q for e in found], ""


def _evaluated(robot: Robot, q: F64) -> Model:
    return robot.body.evaluate(q, np.zeros(robot.n), robot.points)


def _text(goal: Goal) -> str:
    """Return what is asked for in words, the position first."""
    if not int(goal.task) & int(Task.POSITION):
        return "of that orientation"
    return " ".join(f"{c:.3f}" for c in goal.position) + " m"

"""The global planner: a far goal into a way of postures, or a stream of sub-goals for the goal interface.

RRT-Connect over the joints, compiled whole (`search`). A posture is free when every point subjected to the potential
keeps a clearance from every obstacle, no two links come near, and no joint enters its limit zone. The clearance begins
at the field's influence, so that a planned path feels no repulsion at all, and is relaxed in steps where there is no
room for that; near the start and the goal it falls to what these have. Of the ways to several postures of the goal the
quickest is taken, at the speeds that joints and tip may have. Seeded: equal inputs give equal paths.
"""

import time
from collections.abc import Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from rtctl.app.postures import SEEDS, SKIN, Ending, Site, endings, site_of, skin_of
from rtctl.arm.freedom import SPARE, Body, Room, body_of, first_blocked
from rtctl.arm.kinematics import clearance_of
from rtctl.arm.model import Model
from rtctl.arm.osc import JOINT_RATE, LEAD_TURN
from rtctl.arm.robot import Robot
from rtctl.arm.search import Bounds, Speeds, connected, lasts, quicker
from rtctl.arm.task import within as able
from rtctl.design.report import WAY_ROOM
from rtctl.errors import PlanError
from rtctl.kernel.rotations import quat_of
from rtctl.types import F64, I64, Goal, Task
from rtctl.world.primitives import Obstacles

CHECKS = 1500  # postures looked at, times those of LOOKS
# Fractions of influence and limit zone that a path keeps, in the order tried, and how long: first little work in each.
LOOKS = ((1.0, 1), (0.65, 2), (0.4, 2), (0.25, 4), (0.0, 4), (0.25, 40), (0.0, 40))
EDGE = 0.06  # [rad] between two checked postures of an edge
FINE = 0.015  # [rad] between those of the finished path
BETWEEN = 1.0 / WAY_ROOM  # fraction of the room that a finished path has between the postures of its edges
HARDER = 6  # times as many starts for the goal's postures, where they are hard to find and in the last of these steps
STRAIGHT = 3  # ends of straight paths that are made quicker
OTHERS, SIDE = 6, 3000  # more paths looked for, and postures looked at for all of these
HOPE = 0.9  # of the time of the straight way to an end, that a path to it may take
ROUGH, DRAWS = 300, 2400  # attempts to make a path quicker: of each, and of the best
SHORTCUTS = 30  # postures looked at for each of these, at most
AROUND = (0.5, 1.0, 2.0)  # [rad] around start and ends that samples are drawn from, in turn: joints that may turn
# twice have a hundred times more room elsewhere
REACH = 1.0  # [rad] towards a sample
WITHIN = 60.0  # [s]; a plan that takes longer depends on the machine
NEAREST = 0.8  # of the field's clearance that a goal posture should have
THERE = 0.01  # [m] tolerance of a sub-goal, which is passed long before
SPACING = 0.08  # [m] between sub-goals at most
TURN = 0.35  # [rad] that a joint, and the hand, may turn between sub-goals
CORRIDOR = 0.008  # [m] that the straight line between sub-goals may leave the planned path
FAR = 10.0  # [m] of a clearance that nothing bounds


def plan(
    robot: Robot, q: F64, goal: Goal, obstacles: Obstacles, seed: int = 0, checks: int = CHECKS, within: float = WITHIN
) -> list[Goal]:
    """Return sub-goals that lead the arm from posture q (n,) [rad] to `goal`; the last one is `goal` itself.

    Each carries the posture it was planned with. The same `seed` gives the same path; `checks` bounds the postures
    looked at, for a step of LOOKS, and `within` [s] the time, whichever comes first. Raises PlanError, which says why.
    """
    task, why = able(goal.task, robot.axes)
    if why:
        raise PlanError(f"plan: {why}")
    goal = goal._replace(task=task)
    path = plan_joints(site_of(robot, obstacles, q), goal, seed, checks, within)
    return sub_goals(robot, path, goal)


def plan_joints(site: Site, goal: Goal, seed: int, checks: int = CHECKS, within: float = WITHIN) -> F64:
    """Return the postures (k, n) [rad] of a path from the start to one that has the goal. Raises PlanError."""
    *_, path = ways(site, goal, seed, checks, within)
    return path


def ways(site: Site, goal: Goal, seed: int, checks: int = CHECKS, within: float = WITHIN) -> Iterator[F64]:
    """Yield a path as `plan_joints` returns, as soon as there is one, then a quicker one. Raises PlanError."""
    warm(site)  # what is compiled now is not counted as time
    _start_is_free(site)
    rng, end = np.random.default_rng(seed), time.monotonic() + within
    searches: dict[tuple[float, int], _Search | None] = {}
    for step, (share, times) in enumerate(LOOKS):
        hard = share == 0.0 and (step + 1 == len(LOOKS) or not any(searches.values()))
        seeds = HARDER * SEEDS if hard else SEEDS
        if (share, seeds) not in searches:
            ends = _goal_postures(site, goal, share, seed, seeds)
            searches[share, seeds] = _Search(site, share, ends, rng) if ends else None
        search = searches[share, seeds]
        way = search.first(times * checks) if search else None
        if search and way is not None:
            yield way
            yield search.quicker(way)
            return
        if time.monotonic() > end:
            raise PlanError(f"plan: no path to {_text(goal)} found in {within:g} s")
    raise PlanError(
        f"plan: no path to {_text(goal)} found in {LOOKS[-1][1] * checks} postures"
        if any(searches.values())
        else _why_none(site, goal, seed)
    )


def warm(site: Site) -> None:
    """Run what is compiled once, upon nothing."""
    robot, anchors = site.robot, site.start[None]
    body, room = body_of(robot), Room(0.0, 0.0, anchors, np.zeros((1, 3)))
    counts, bounds = np.zeros(2, np.int64), Bounds(robot.q_min, robot.q_max)
    first_blocked(body, anchors, site.obstacles, room, 1.0)
    connected(body, anchors, np.zeros((0, robot.n)), site.obstacles, room, 1.0, 1, counts)
    tries, speeds = np.zeros((0, 3 + robot.n)), speeds_of(robot)
    quicker(body, anchors, tries, site.obstacles, room, bounds, speeds, 1.0, counts)
    lasts(site.chain, anchors, speeds)


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


def _start_is_free(site: Site) -> None:
    rho, own, links = _nearness(site, site.start)
    if rho <= 0.0:  # the points stand out of the links, which may be clear all the same
        rho = SKIN if links > -SKIN else links
    if min(rho, own) <= 0.0:
        raise PlanError(f"plan: the arm is in contact where it starts, {min(rho, own):.3f} m")


def _nearness(site: Site, q: F64) -> tuple[float, float, float]:
    """Return the least distance [m] of the arm to obstacles, and to itself, at q (n,), and of its skin to obstacles."""
    robot = site.robot
    own = robot.body.own_distances(q, robot.own)
    rho = float(clearance_of(site.chain, robot.points, q[None], site.obstacles, 1.1 * robot.avoid.rho0)[0])
    links = FAR
    if rho < SPARE * robot.avoid.rho_min:
        links = float(clearance_of(site.chain, skin_of(robot.body), q[None], site.obstacles, robot.avoid.rho0)[0])
    return min(rho, FAR), min(float(own.min()), FAR) if len(own) else FAR, links


class Found(NamedTuple):
    """A path that is free."""

    path: F64  # (k, n) [rad]
    takes: float  # [s], what its end lacks in room counted as well


class _Free:
    """Whether postures and edges keep a share of the influences and zones, never less than the clearances."""

    def __init__(self, site: Site, share: float, ends: list[F64]) -> None:
        r, q = site.robot, site.start
        zone = np.maximum(share * r.limit.rho0, 1.5 * r.limit.rho_min)
        anchors = np.array([q, *ends])
        self.low = np.minimum(r.q_min + zone, anchors.min(axis=0))
        self.high = np.maximum(r.q_max - zone, anchors.max(axis=0))
        self.obstacles = site.obstacles
        self.room = Room(
            max(share * r.avoid.rho0, WAY_ROOM * r.avoid.rho_min),
            max(share * r.self_avoid.rho0, WAY_ROOM * r.self_avoid.rho_min),
            anchors,
            np.array([_nearness(site, each) for each in anchors]),
        )
        # the last try looks at the links themselves, and so do all where points may be nearer than the clearance
        links = share == 0.0 or bool(self.room.near[:, 0].min() < SPARE * r.avoid.rho_min)
        self.body: Body = body_of(r, skin_of(r.body) if links else None, share == 0.0)

    def all(self, Q: F64, share: float = 1.0) -> bool:
        """Return whether all postures (b, n) keep a share of the room, relaxed towards what start and ends have."""
        return first_blocked(self.body, Q, self.obstacles, self.room, share) < 0

    def along(self, path: F64, step: float, share: float = 1.0) -> bool:
        """Return whether every posture of a path (k, n), a joint's step [rad] apart at most, is free."""
        return self.all(_resampled(path, step), share)


# -- the search ----------------------------------------------------------------------------------------------------


class _Search:
    """For one share of the room: the postures of the goal that keep it, and the paths to them."""

    def __init__(self, site: Site, share: float, ends: list[Ending], rng: np.random.Generator) -> None:
        """ends: one at least."""
        self.site, self.ends, self.rng = site, [e.q for e in ends], rng
        self.free, self.speeds = _Free(site, share, self.ends), speeds_of(site.robot)
        self.lacks = {e.q.tobytes(): e.lacks for e in ends}
        straight = [self._found(np.array([site.start, q])) for q in self.ends]
        self.straight = sorted(straight, key=lambda each: each.takes)

    def first(self, looks: int) -> F64 | None:
        """Return the first path (k, n), None where none is found in so many postures looked at.

        Edges are looked at again more finely where something was passed between two looks.
        """
        for each in self.straight:
            if self.free.along(each.path, EDGE) and self._usable(each.path):
                return each.path
        for step, times in ((EDGE, 1), (FINE, 2)):
            path = self._through(self.ends, step, np.array([0, times * looks]))
            if path is None or self._usable(path):
                return path
        return None

    def quicker(self, first: F64) -> F64:
        """Return the path (k, n) to one of the ends that takes least, within a bounded number of looks."""
        counts, out = np.array([0, SIDE]), []
        if len(first) == 2:
            out = [each for each in self.straight if self.free.along(each.path, EDGE)][:STRAIGHT]
        paths = [each.path for each in out] or [first]
        out = sorted((self._found(self._cut(path, EDGE, ROUGH)) for path in paths), key=_takes)
        for k in range(OTHERS):
            hopeful = [each for each in self.straight if HOPE * each.takes < out[0].takes]
            if not hopeful or counts[0] >= SIDE:
                break
            counts[1] = min(SIDE, counts[0] + SIDE // 4)
            path = self._through([hopeful[k % len(hopeful)].path[-1]], EDGE, counts)
            if path is not None:
                out = sorted([*out, self._found(self._cut(path, EDGE, ROUGH))], key=_takes)
        best = [self._cut(out[0].path, EDGE, DRAWS), *(each.path for each in out)]
        return next((path for path in best if self._usable(path)), first)

    def _found(self, path: F64) -> Found:
        return Found(path, lasts(self.site.chain, path, self.speeds) + self.lacks[path[-1].tobytes()])

    def _usable(self, path: F64) -> bool:
        return self.free.along(path, FINE, BETWEEN)

    def _through(self, ends: list[F64], step: float, counts: I64) -> F64 | None:
        """Return a path (k, n) that the compiled search finds, None for none.

        step: [rad] between two postures looked at; counts: (2,) how many there were, added to, and how many may be.
        """
        free, roots = self.free, np.array([self.site.start, *ends])
        # each tree grows towards samples of each
        around = np.resize(np.repeat(AROUND, 2), int(counts[1] - counts[0]) // 4)[:, None]
        low, high = np.maximum(free.low, roots.min(axis=0) - around), np.minimum(free.high, roots.max(axis=0) + around)
        samples = low + self.rng.random((len(around), self.site.robot.n)) * (high - low)
        path = connected(free.body, roots, samples, free.obstacles, free.room, step, round(REACH / step), counts)
        return path if len(path) else None

    def _cut(self, path: F64, step: float, draws: int) -> F64:
        """Return the path with pieces that are quicker taken where they are free."""
        free, n = self.free, self.site.robot.n
        tries = np.concatenate([self.rng.random((draws, 3)), self.rng.standard_normal((draws, n))], axis=1)
        counts, bounds = np.array([0, SHORTCUTS * draws]), Bounds(free.low, free.high)
        return quicker(free.body, path, tries, free.obstacles, free.room, bounds, self.speeds, step, counts)


def _takes(found: Found) -> float:
    return found.takes


def speeds_of(robot: Robot) -> Speeds:
    """Return how fast a robot goes along a way."""
    m = robot.motion
    return Speeds(m.speed_margin * robot.qd_max, m.v_max, LEAD_TURN * m.w_max, JOINT_RATE)


def _resampled(path: F64, step: float) -> F64:
    """Return the path (k, n) with postures no more than a joint's `step` [rad] apart."""
    out = [path[:1]]
    for a, b in pairwise(path):
        count = max(1, int(np.ceil(np.abs(b - a).max() / step)))
        out.append(a + (b - a) * (np.arange(1, count + 1) / count)[:, None])
    return np.concatenate(out)


# -- postures that have the goal -------------------------------------------------------------------------------------


def _goal_postures(site: Site, goal: Goal, share: float, seed: int, seeds: int) -> list[Ending]:
    """Return free postures that have the goal, the best first.

    Those with a clearance to spare come alone, where there are some.
    """
    found = endings(site, goal, seed, share, seeds)
    return [e for e in found if e.rho >= NEAREST * site.robot.avoid.rho_min] or found


def _why_none(site: Site, goal: Goal, seed: int) -> str:
    """Return why no posture was found that has the goal."""
    nothing = site.obstacles._replace(active=np.zeros_like(site.obstacles.active))
    if endings(site._replace(obstacles=nothing), goal, seed, 0.0):
        return f"plan: every posture found that has the goal {_text(goal)} touches something"
    return f"plan: no posture within the joint limits was found that has the goal {_text(goal)}"


def _evaluated(robot: Robot, q: F64) -> Model:
    return robot.body.evaluate(q, np.zeros(robot.n), robot.points)


def _text(goal: Goal) -> str:
    """Return what is asked for in words, the position first."""
    if not int(goal.task) & int(Task.POSITION):
        return "of that orientation"
    return " ".join(f"{c:.3f}" for c in goal.position) + " m"

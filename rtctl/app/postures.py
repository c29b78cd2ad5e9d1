"""The goal's own posture: joints that have a goal, free of limits and obstacles, near in time, and on a way there.

Inverse kinematics from many starts (damped least squares, compiled); of what it finds the least cost is taken, the time
to go there and what it lacks in room. Counts bound the work, not time: equal inputs give equal postures.
"""

from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import numpy as np

from rtctl.arm.kinematics import Chain, chain_of, clearance_of, postures_of, target_of
from rtctl.arm.outlook import Around, Pace, rollout
from rtctl.arm.points import Points
from rtctl.arm.rigid_body import RigidBody
from rtctl.arm.robot import Robot
from rtctl.design.solids import solids_of, surface
from rtctl.kernel.rotations import R_of, exp3, quat_of
from rtctl.plain import Json
from rtctl.types import B1, F64, I64, Goal
from rtctl.world.primitives import Obstacles, advance, distances_into
from rtctl.world.rooms import count_rooms, farthest

SEEDS = 48  # random starts
ENDS = 8  # postures returned at most
ALIKE = 0.1  # [rad] within which two are one
TIGHT = 1.5  # [s] that a posture without any room is worth: one as far away but free is better
REACHED, REACHED_ROT = 1e-4, 1e-3  # [m], [rad] within which a posture has a goal
SLACK = 0.1  # of the goal's tolerances, the same for one that is nowhere else to be had
ASIDE = 0.4  # of these, by which that is looked for beside the goal
DIRECTIONS, MORE_SEEDS = 12, 3  # in which it is, and times as many starts for all of them
HAIR = 0.05  # of the clearance from joint limits, that no posture is without
SKIN = 0.005  # [m] by which a clearance of the links may be understated
FINE = 5e-4  # [m] the same where pieces of their surface are divided
STEP = 0.05  # [s] of a rollout
TURN = 2.0 * np.pi
SLOTS = Obstacles._fields[:10]  # what there is of each obstacle; the rest are bodies that they share


class Site(NamedTuple):
    """What a posture or a way is looked for in."""

    robot: Robot
    chain: Chain
    obstacles: Obstacles  # the active ones alone
    start: F64  # (n,) [rad]


class Ending(NamedTuple):
    """A posture that has the goal."""

    q: F64  # (n,) [rad]
    rho: float  # [m] from the points to obstacles, as the config's influence and clearance count it
    clear: bool  # the links keep the clearance from them
    cost: float  # [s]
    lacks: float = 0.0  # [s] of that, what it lacks in room


def packed(obstacles: Obstacles) -> Obstacles:
    """Return the slots that are in use alone."""
    return _chosen(obstacles, np.flatnonzero(obstacles.active))


def _chosen(obstacles: Obstacles, k: I64) -> Obstacles:
    return obstacles._replace(**{name: getattr(obstacles, name)[k] for name in SLOTS})


def swept(site: Site, times: Sequence[float]) -> Site:
    """Return the site with what moves where it will be at each of the times [s] too, unless it will be at the start."""
    o = site.obstacles
    rests, moves = [_chosen(o, np.flatnonzero((o.v.any(axis=1) | o.w.any(axis=1)) == moving)) for moving in (0, 1)]
    found, robot = [rests, moves], site.robot
    for t in times:
        there = advance(moves, t)
        for k in range(len(there.active)):
            one = _chosen(there, np.array([k]))
            if clearance_of(site.chain, robot.points, site.start[None], one)[0] > 1.5 * robot.avoid.rho_min:
                found.append(one)
    joined: Json = {name: np.concatenate([getattr(each, name) for each in found]) for name in SLOTS}
    return site._replace(obstacles=o._replace(**joined))


def site_of(robot: Robot, obstacles: Obstacles, start: F64) -> Site:
    """Return the site with the slots that are in use."""
    return Site(robot, chain_of(robot.body), packed(obstacles), np.array(start, np.float64))


def endings(site: Site, goal: Goal, seed: int, zone: float = 1.0, seeds: int = SEEDS) -> list[Ending]:
    """Return postures that have the goal and touch nothing, the best first; none where none is found.

    zone: share of the zones of joint limits that they keep free of, and more than their clearance, if the start does;
    0: none but HAIR of that, and the goal but for a share of its tolerances, for one that is nowhere else to be had.
    """
    if zone:
        return _endings(site, (goal,), seed, zone, seeds, 0.0)
    return _endings(site, (goal,), seed, zone, seeds, SLACK) or _endings(
        site, _beside(goal, seed), seed, zone, MORE_SEEDS * seeds, SLACK
    )


def _beside(goal: Goal, seed: int) -> tuple[Goal, ...]:
    """Return goals ASIDE of its tolerances beside a goal, in all directions."""
    out, R = [], R_of(goal.wxyz)
    for way in np.random.default_rng(seed).standard_normal((DIRECTIONS, 2, 3)):
        aside, turn = ASIDE * way / np.linalg.norm(way, axis=1)[:, None]
        there, turned = goal.position + goal.tolerance * aside, exp3(goal.tolerance_rot * turn) @ R
        out.append(goal._replace(position=there, wxyz=quat_of(turned)))
    return tuple(out)


def _endings(site: Site, goals: Sequence[Goal], seed: int, zone: float, seeds: int, slack: float) -> list[Ending]:
    """Return `endings` that have one of these goals within a share of its tolerances."""
    robot = site.robot
    margin = np.maximum(zone * robot.limit.rho0, 1.5 * robot.limit.rho_min) if zone else HAIR * robot.limit.rho_min
    low, high = np.minimum(robot.q_min + margin, site.start), np.maximum(robot.q_max - margin, site.start)
    rng = np.random.default_rng(seed)
    starts = np.concatenate([[site.start, robot.q_rest, robot.home], rng.uniform(low, high, (seeds, robot.n))])
    far, turned = max(REACHED, slack * goals[0].tolerance), max(REACHED_ROT, slack * goals[0].tolerance_rot)
    some = [
        postures_of(site.chain, starts[k :: len(goals)], target_of(goal), low, high, far, turned)
        for k, goal in enumerate(goals)
    ]
    found, has = (np.concatenate(each) for each in zip(*some, strict=True))
    found = _unwound(site, found[has], low, high)
    rho = clearance_of(site.chain, robot.points, found, site.obstacles, 1.1 * robot.avoid.rho0)  # farther is as good
    out: list[Ending] = []
    for k in np.argsort([_cost(site, q, r) for q, r in zip(found, rho, strict=True)], kind="stable"):
        q = found[k]
        if len(out) == ENDS or rho[k] <= 0.0:
            break
        if any(np.abs(q - other.q).max() < ALIKE for other in out):
            continue
        own = robot.body.own_distances(q, robot.own)
        if not len(own) or own.min() >= robot.self_avoid.rho_min:
            clear = bool(links_clear(site, q[None], rho[k : k + 1])[0])
            cost = _cost(site, q, float(rho[k]))
            out.append(Ending(q, float(rho[k]), clear, cost, cost - _away(site, q)))
    return out


@cache
def _surface_of(body: RigidBody) -> tuple[Points, I64]:
    solids = [s for s in solids_of(body) if s.link > 0]
    parts = [surface(s, SKIN * np.sqrt(3.0)) for s in solids]  # a triangle's points are within edge/sqrt(3) of a corner
    firsts = np.cumsum([0, *(len(samples) for samples, _ in parts)])
    link = np.repeat([s.link for s in solids], np.diff(firsts)).astype(np.int64)
    skin = Points(link, np.concatenate([samples for samples, _ in parts]), np.full(len(link), SKIN), ())
    return skin, np.concatenate([first + triangles for first, (_, triangles) in zip(firsts[:-1], parts, strict=True)])


def skin_of(body: RigidBody) -> Points:
    """Return balls about samples of the links' surface that cover it, and stand out of it by their radius at most."""
    return _surface_of(body)[0]


def links_clear(site: Site, Q: F64, rho: F64) -> B1:
    """Return in which postures (b, n) the links keep the clearance; rho (b,) [m] of the points there."""
    keep = site.robot.avoid.rho_min
    out: B1 = rho >= keep
    near = np.flatnonzero(~out & (rho > 0.0))
    if len(near) and len(site.obstacles.active):
        links = clearance_of(site.chain, skin_of(site.robot.body), Q[near], site.obstacles)
        out[near] = links >= keep
        for k in near[(links < keep) & (links > keep - SKIN)]:
            out[k] = links_keep(site, Q[k])
    return out


def links_keep(site: Site, q: F64) -> bool:
    """Return whether the links keep the clearance at a posture q (n,), to FINE.

    A piece of their surface whose ball keeps it does; one whose middle does not, does not; others are divided.
    """
    keep, (skin, triangles) = site.robot.avoid.rho_min, _surface_of(site.robot.body)
    rho = _distances(site, q, skin)
    pieces = triangles[(rho < keep)[triangles].any(axis=1)]
    link, corners = skin.link[pieces[:, 0]], skin.local[pieces]
    while len(link):
        middle = corners.mean(axis=1)
        radius = np.linalg.norm(corners - middle[:, None], axis=2).max(axis=1)
        near = _distances(site, q, Points(link, middle, radius, ())) < keep
        link, corners, middle, radius = link[near], corners[near], middle[near], radius[near]
        if (_distances(site, q, Points(link, middle, np.minimum(radius, FINE), ())) < keep).any():
            return False
        link, corners = np.repeat(link, 4), quartered(corners)
    return True


def quartered(corners: F64) -> F64:
    """Return the triangles (4 t, 3, 3) that triangles (t, 3, 3) consist of, divided at the middles of their edges."""
    between = 0.5 * (corners + np.roll(corners, -1, axis=1))
    a, b, c = (np.stack([corners[:, k], between[:, k], between[:, k - 1]], axis=1) for k in range(3))
    return np.stack([a, b, c, between], axis=1).reshape(-1, 3, 3)


def _distances(site: Site, q: F64, points: Points) -> F64:
    """Return the distance (m,) [m] of each point to the obstacles, as `clearance_of` counts it."""
    o, P = site.obstacles, np.ascontiguousarray(site.robot.body.placed(q, points).T)
    rho = np.empty((len(o.active), 4, len(points.link)))
    distances_into(P, points.radius, o, farthest(o.room, o.active, 2.0 * site.robot.avoid.rho_min), rho)
    count_rooms(o.room, rho)
    least: F64 = rho[:, 0].min(axis=0, initial=np.inf)
    return least


def _cost(site: Site, q: F64, rho: float) -> float:
    """Return the time [s] to a posture, and what its lack of room counts."""
    robot = site.robot
    room = min(max(rho, 0.0) / robot.avoid.rho0, 1.0)
    touching = 100.0 if rho <= 0.0 else 0.0
    margin = np.minimum(q - robot.q_min, robot.q_max - q) / robot.limit.rho0
    return _away(site, q) + TIGHT * (1.0 - room) + TIGHT * (1.0 - min(float(margin.min()), 1.0)) + touching


def _away(site: Site, q: F64) -> float:
    """Return the time [s] straight to a posture."""
    return float((np.abs(q - site.start) / site.robot.qd_max).max())


def _unwound(site: Site, Q: F64, low: F64, high: F64) -> F64:
    """Return the postures with every joint that turns at the turn nearest to the start."""
    out = Q.copy()
    for i in np.flatnonzero(~site.chain.slides[1:]):
        for turns in (-2.0, -1.0, 1.0, 2.0):
            other = Q[:, i] + turns * TURN
            nearer: B1 = (np.abs(other - site.start[i]) < np.abs(out[:, i] - site.start[i])) & (other >= low[i])
            nearer &= other <= high[i]
            out[nearer, i] = other[nearer]
    return out


def inertia_of(site: Site) -> F64:
    """Return the joint-space inertia (n, n) [kg m2] of the arm at the start."""
    return site.robot.body.evaluate(site.start, np.zeros(site.robot.n), site.robot.points).A


def previewed(site: Site, goal: Goal, rest: F64, A: F64, keep: float | None = None) -> tuple[F64, bool]:
    """Return the postures (k, n), STEP apart, in which the tip would go to a goal, and whether it gets there.

    A (n, n): what the joints share the tip's way by. keep [m]: what rests is kept off so far; None: gone through.
    """
    robot, p, points = site.robot, site.robot.motion, site.robot.points
    margin, o = 0.4 * robot.limit.rho0, site.obstacles
    beside = np.flatnonzero(~(o.v.any(axis=1) | o.w.any(axis=1)) & (keep is not None))
    return rollout(
        site.chain,
        site.start,
        rest,
        target_of(goal),
        robot.q_min + margin,
        robot.q_max - margin,
        Pace(p.v_max, p.w_max, p.speed_margin * robot.qd_max, p.qdd_posture / p.d_q, p.k_q / p.d_q, A),
        Around(points.link, points.local, points.radius, _chosen(o, beside), keep or 0.0),
        STEP,
    )


def free_of_all(site: Site, q: F64) -> bool:
    """Return whether a posture is felt by no limit, no obstacle and no other link."""
    robot = site.robot
    margin = np.minimum(q - robot.q_min, robot.q_max - q)
    rho = clearance_of(site.chain, robot.points, q[None], site.obstacles)[0]
    return bool(
        (margin >= robot.limit.rho0).all()
        and rho >= robot.avoid.rho0
        and own_room(site, q[None]) >= robot.self_avoid.rho0
    )


def own_room(site: Site, Q: F64) -> float:
    """Return the least distance [m] between links in some of the postures Q (b, n), inf where none are near."""
    robot = site.robot
    if not len(robot.own.pairs):
        return np.inf
    return min(float(robot.body.own_distances(q, robot.own).min()) for q in Q[:: max(1, len(Q) // 12)])


def along(a: F64, b: F64, step: float) -> F64:
    """Return postures from a to b (n,), no joint's more than a step [rad] apart; without a."""
    count = max(1, int(np.ceil(np.abs(b - a).max() / step)))
    out: F64 = a + (b - a) * (np.arange(1, count + 1) / count)[:, None]
    return out


def straight_room(site: Site, a: F64, b: F64, step: float = 0.06) -> float:
    """Return the least distance [m] to obstacles, or to what the arm's links keep of each other, between two postures.

    Nothing or less where links come nearer to each other than their clearance.
    """
    robot = site.robot
    Q = along(a, b, step)
    rho = float(clearance_of(site.chain, robot.points, Q, site.obstacles).min())
    return 0.0 if rho > 0.0 and own_room(site, Q) < robot.self_avoid.rho_min else rho

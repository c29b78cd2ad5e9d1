"""Whether postures are free: many at once, the arm's spheres against the obstacles and its hulls against each other."""

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from rtctl.arm.apart import hulls_apart
from rtctl.arm.kinematics import Chain, chain_of, placements
from rtctl.arm.points import Points
from rtctl.arm.robot import Robot
from rtctl.arm.self_collision import Hulls, not_apart
from rtctl.kernel import kernel
from rtctl.types import B1, F64, I64
from rtctl.world.primitives import Obstacles, distances_into
from rtctl.world.rooms import count_rooms, farthest

BALLS = 0.005  # [m] that the points keep all the same: one that touches stops the arm
SPARE = 1.1  # of the clearance, that links keep at the postures looked at, so that they keep it in between
RELAX = 0.3  # [m/rad] by which what must be kept free grows from what an anchor has
LEAVES = 0.1  # [m/rad] the same up to the clearance, where an anchor has less


GROUP = 8  # points in a ball that is looked at first, at most
KNOWN = 8  # skins of which is kept what lies within the points

_KNOWN: dict[tuple[int, bytes, bytes, bytes], tuple[Points, tuple[F64, F64, I64]]] = {}  # of `_within`


class Skin(NamedTuple):
    """Balls about the links' surface, those within each point together; empty: the points alone count."""

    local: F64  # (s, 3) [m] in the link of the point
    radius: F64  # (s,) [m]
    start: I64  # (m + 1,) of each point's; (0,) for none
    keep: float  # [m] the clearance
    overhang: float  # [m] by which points stand out of links at most
    instead: bool  # where points do not keep their room it is enough that the links keep the clearance


class Groups(NamedTuple):
    """Balls that hold some points of a link each: most are far from everything, and their points need no look."""

    start: I64  # (g + 1,) of each group's points
    centre: F64  # (g, 3) [m] in the link of the points
    radius: F64  # (g,) [m]


class Body(NamedTuple):
    """What of an arm can touch something."""

    chain: Chain
    link: I64  # (m,) of the points, as in `Points`, a group after the other
    local: F64  # (m, 3) [m]
    radius: F64  # (m,) [m]
    groups: Groups
    pairs: I64  # (L, 2) of hulls
    hulls: Hulls
    apart: float  # [m] clearance between them
    skin: Skin


class Room(NamedTuple):
    """What a posture must keep free of; near the anchors no more than these have."""

    rho: float  # [m] to obstacles, as the config's influence and clearance count it
    own: float  # [m] between links
    anchors: F64  # (a, n) [rad]
    near: F64  # (a, 3) [m] rho and own there, and rho of the links' skin


def body_of(robot: Robot, skin: Points | None = None, instead: bool = True) -> Body:
    """Return what of a robot can touch something; skin: balls that cover the links' surface, or the points alone."""
    own = robot.own
    points, groups = _grouped(robot.points)
    arrays = (np.zeros((0, 3)), np.zeros(0), np.zeros(0, np.int64)) if skin is None else _within(points, skin)
    return Body(
        chain_of(robot.body),
        points.link,
        points.local,
        points.radius,
        groups,
        own.pairs,
        own.arrays,
        robot.self_avoid.rho_min,
        Skin(*arrays, robot.avoid.rho_min, robot.coverage.overhang, instead),
    )


def _grouped(points: Points) -> tuple[Points, Groups]:
    """Return the points in the order of their groups, and these: halves of links, and of those, until they are few."""
    todo, order, sizes = [np.flatnonzero(points.link == link) for link in np.unique(points.link)], [], []
    while todo:
        some = todo.pop()
        if len(some) > GROUP:
            x = points.local[some]
            some = some[np.argsort(x[:, np.ptp(x, axis=0).argmax()], kind="stable")]
            todo += [some[: len(some) // 2], some[len(some) // 2 :]]
        else:
            order.append(some)
            sizes.append(len(some))
    turned = np.concatenate([np.zeros(0, np.int64), *order])
    there = Points(points.link[turned], points.local[turned], points.radius[turned], ())
    start = np.cumsum([0, *sizes]).astype(np.int64)
    centre, radius = np.empty((len(sizes), 3)), np.empty(len(sizes))
    for g, (a, b) in enumerate(pairwise(start)):
        centre[g] = 0.5 * (there.local[a:b].min(axis=0) + there.local[a:b].max(axis=0))
        radius[g] = (np.linalg.norm(there.local[a:b] - centre[g], axis=1) + there.radius[a:b]).max()
    return there, Groups(start, centre, radius)


def _within(points: Points, skin: Points) -> tuple[F64, F64, I64]:
    """Return places and radii of the balls within each of the points, and where each point's begin."""
    key = (id(skin.local), points.link.tobytes(), points.local.tobytes(), points.radius.tobytes())
    if key in _KNOWN:
        return _KNOWN[key][1]
    of_link = {link: np.flatnonzero(skin.link == link) for link in np.unique(points.link)}
    found = []
    for link, centre, radius in zip(points.link, points.local, points.radius, strict=True):
        near = of_link[link]
        away = np.linalg.norm(skin.local[near] - centre, axis=1)
        found.append(near[away <= radius + skin.radius[near]])
    order, start = np.concatenate(found), np.cumsum([0, *map(len, found)])
    if len(_KNOWN) == KNOWN:
        del _KNOWN[next(iter(_KNOWN))]
    _KNOWN[key] = skin, (skin.local[order], skin.radius[order], start.astype(np.int64))
    return _KNOWN[key][1]


@kernel
def _places(local: F64, link: I64, which: I64, R: F64, t: F64) -> F64:
    """Return (3, k) [m] where `which` (k,) of the places local (m, 3) of links (m,) are."""
    P = np.empty((3, which.shape[0]))
    for s in range(which.shape[0]):
        x, l = local[which[s]], link[which[s]]
        for i in range(3):
            P[i, s] = t[l, i] + R[l, i, 0] * x[0] + R[l, i, 1] * x[1] + R[l, i, 2] * x[2]
    return P


@kernel
def _only(obstacles: Obstacles, active: B1) -> Obstacles:
    return Obstacles(
        obstacles.kind,
        active,
        obstacles.R,
        obstacles.p,
        obstacles.v,
        obstacles.w,
        obstacles.dims,
        obstacles.group,
        obstacles.margin,
        obstacles.room,
        obstacles.mesh,
        obstacles.clouds,
    )


@kernel
def _near(body: Body, R: F64, t: F64, obstacles: Obstacles, far: float, need: float, near: B1) -> I64:
    """Return the points (k,) that may be nearer than need [m] to some obstacle, and mark which in near (K,)."""
    groups, m = body.groups, body.link.shape[0]
    count, found, these = groups.radius.shape[0], np.empty(m, np.int64), 0
    P, rho = np.empty((3, count)), np.empty((near.shape[0], 4, count))
    for g in range(count):
        x, l = groups.centre[g], body.link[groups.start[g]]
        for i in range(3):
            P[i, g] = t[l, i] + R[l, i, 0] * x[0] + R[l, i, 1] * x[1] + R[l, i, 2] * x[2]
    distances_into(P, groups.radius, obstacles, far, rho)
    count_rooms(obstacles.room, rho)
    near[:] = False
    for g in range(count):
        some = False
        for o in range(near.shape[0]):
            if rho[o, 0, g] < need:
                near[o] = some = True
        if some:
            for j in range(groups.start[g], groups.start[g + 1]):
                found[these] = j
                these += 1
    return found[:these].copy()


@kernel
def _skin_keeps(body: Body, j: int, R: F64, t: F64, obstacles: Obstacles, near: B1, rho: float) -> bool:
    """Return whether the links' surface within point j keeps rho [m] from every obstacle, as the config's count.

    near (K,): those that it may be nearer to; the others are left out.
    """
    first, count, l = body.skin.start[j], body.skin.start[j + 1] - body.skin.start[j], body.link[j]
    P, out = np.empty((3, count)), np.empty((near.shape[0], 4, count))
    for s in range(count):
        x = body.skin.local[first + s]
        for i in range(3):
            P[i, s] = t[l, i] + R[l, i, 0] * x[0] + R[l, i, 1] * x[1] + R[l, i, 2] * x[2]
    those, far = _only(obstacles, near), farthest(obstacles.room, near, rho)
    distances_into(P, body.skin.radius[first : first + count], those, far, out)
    count_rooms(obstacles.room, out)
    for o in range(out.shape[0]):
        if near[o]:
            for s in range(count):
                if out[o, 0, s] < rho:
                    return False
    return True


@kernel
def _kept(has: float, away: float, share: float, clearance: float) -> float:
    """Return what must be kept free [m], a joint's `away` [rad] from a posture that has no more than `has` [m].

    A share of that and what it grows by, but no less than these where they are less than the clearance.
    """
    slow = min(away, max(0.0, clearance - has) / LEAVES)
    grown = has - 0.001 * abs(has) + LEAVES * slow + RELAX * (away - slow)
    return max(share * grown, min(grown, clearance)) if grown > 0.0 else grown


@kernel
def _kept_by(body: Body, these: I64, R: F64, t: F64, obstacles: Obstacles, asked: tuple[float, float, float]) -> bool:
    """Return whether points (k,) keep free of obstacles what is asked of them [m], of the links [m], and the share."""
    skin, covered = body.skin, body.skin.start.shape[0] > 0
    free, keep, share = asked
    K, count = obstacles.active.shape[0], these.shape[0]
    radius, rho, near = np.empty(count), np.empty((K, 4, count)), np.empty(K, np.bool_)
    for s in range(count):
        radius[s] = body.radius[these[s]]
    far = farthest(obstacles.room, obstacles.active, max(free, keep))
    distances_into(_places(body.local, body.link, these, R, t), radius, obstacles, far, rho)
    count_rooms(obstacles.room, rho)
    most = max(keep - skin.overhang, min(free, share * BALLS))  # that is asked of the points themselves
    for s in range(count):
        least = np.inf
        for o in range(K):
            least = min(least, rho[o, 0, s])
        if least >= free and (least >= keep or not covered):
            continue
        if not covered or (least < free and not skin.instead) or least < most:
            return False
        for o in range(K):
            wide = obstacles.room[o, 0] != 0.0  # counts otherwise
            near[o] = obstacles.active[o] and (wide or rho[o, 0, s] < keep + 2.0 * skin.radius[0])
        if not _skin_keeps(body, these[s], R, t, obstacles, near, keep):
            return False
    return True


@kernel
def first_blocked(body: Body, Q: F64, obstacles: Obstacles, room: Room, share: float) -> int:
    """Return the first found of the postures Q (b, n) that does not keep a share of the room, -1 for none.

    They are looked at in the order of a bisection, so that what is blocked is found early. The whole of the room, 1.0,
    is asked of postures of a search, and SPARE of the clearance of the links; a share of what lies between these.
    """
    b, n, skin, covered = Q.shape[0], Q.shape[1], body.skin, body.skin.start.shape[0] > 0
    R, t, near = np.empty((n + 1, 3, 3)), np.empty((n + 1, 3)), np.empty(obstacles.active.shape[0], np.bool_)
    far = farthest(obstacles.room, obstacles.active, room.rho)
    more = 2.0 * skin.radius[0] if covered else 0.0  # by which balls of the skin stand out of the points at most
    stride = 1
    while stride < b:
        stride *= 2
    first = True
    while stride >= 1:
        start = 0 if first else stride
        for k in range(start, b, stride if first else 2 * stride):
            free, own, keep = share * room.rho, share * room.own, (1.0 if share < 1.0 else SPARE) * skin.keep
            for a in range(room.anchors.shape[0]):
                away = 0.0
                for i in range(n):
                    away = max(away, abs(room.anchors[a, i] - Q[k, i]))
                free = min(free, _kept(room.near[a, 0], away, share, skin.keep))
                own = min(own, _kept(room.near[a, 1], away, share, body.apart))
                keep = min(keep, _kept(room.near[a, 2], away, share, skin.keep))
            placements(body.chain, Q[k], R, t)
            these = _near(body, R, t, obstacles, far, max(free, keep + more) if covered else free, near)
            if these.shape[0] > 0 and not _kept_by(body, these, R, t, _only(obstacles, near), (free, keep, share)):
                return k
            if body.pairs.shape[0] > 0:
                for s in not_apart(body.pairs, body.hulls, own, R, t):
                    if not hulls_apart(body.pairs[s, 0], body.pairs[s, 1], body.hulls, own, R, t):
                        return k
        first = False
        stride //= 2
    return -1

"""Whether postures are free: many at once, the arm's spheres against the obstacles and its hulls against each other."""

from typing import NamedTuple

import numpy as np

from rtctl.arm.apart import hulls_apart
from rtctl.arm.kinematics import Chain, chain_of, placements
from rtctl.arm.points import Points
from rtctl.arm.robot import Robot
from rtctl.arm.self_collision import Hulls, not_apart
from rtctl.kernel import kernel
from rtctl.types import F64, I64
from rtctl.world.primitives import Obstacles, distances_into
from rtctl.world.rooms import count_rooms, farthest

BALLS = 0.005  # [m] that the points keep all the same: one that touches stops the arm
RELAX = 0.3  # [m/rad] by which what must be kept free grows from what an anchor has


class Skin(NamedTuple):
    """Balls about the links' surface, those within each point together; empty: the points alone count."""

    local: F64  # (s, 3) [m] in the link of the point
    radius: F64  # (s,) [m]
    start: I64  # (m + 1,) of each point's; (0,) for none
    keep: float  # [m] that it keeps where the points do not keep their room
    overhang: float  # [m] by which points stand out of links at most


class Body(NamedTuple):
    """What of an arm can touch something."""

    chain: Chain
    link: I64  # (m,) of the points, as in `Points`
    local: F64  # (m, 3) [m]
    radius: F64  # (m,) [m]
    pairs: I64  # (L, 2) of hulls
    hulls: Hulls
    skin: Skin


class Room(NamedTuple):
    """What a posture must keep free of; near the anchors no more than these have."""

    rho: float  # [m] to obstacles, as the config's influence and clearance count it
    own: float  # [m] between links
    anchors: F64  # (a, n) [rad]
    near: F64  # (a, 2) [m] rho and own there


def body_of(robot: Robot, skin: Points | None = None) -> Body:
    """Return what of a robot can touch something; skin: balls that cover the links' surface, or the points alone."""
    points, own = robot.points, robot.own
    return Body(
        chain_of(robot.body),
        points.link,
        points.local,
        points.radius,
        own.pairs,
        own.arrays,
        Skin(np.zeros((0, 3)), np.zeros(0), np.zeros(0, np.int64), 0.0, 0.0) if skin is None else _within(robot, skin),
    )


def _within(robot: Robot, skin: Points) -> Skin:
    points, found = robot.points, []
    for link, centre, radius in zip(points.link, points.local, points.radius, strict=True):
        away = np.linalg.norm(skin.local - centre, axis=1)
        found.append(np.flatnonzero((skin.link == link) & (away <= radius + skin.radius)))
    order, start = np.concatenate(found), np.cumsum([0, *map(len, found)])
    keep, overhang = robot.avoid.rho_min, robot.coverage.overhang
    return Skin(skin.local[order], skin.radius[order], start.astype(np.int64), keep, overhang)


@kernel
def _skin_keeps(body: Body, j: int, R: F64, t: F64, obstacles: Obstacles, rho: float) -> bool:
    """Return whether the links' surface within point j keeps rho [m] from every obstacle, as the config's count."""
    first, count, l = body.skin.start[j], body.skin.start[j + 1] - body.skin.start[j], body.link[j]
    P, out = np.empty((3, count)), np.empty((obstacles.active.shape[0], 4, count))
    for s in range(count):
        x = body.skin.local[first + s]
        for i in range(3):
            P[i, s] = t[l, i] + R[l, i, 0] * x[0] + R[l, i, 1] * x[1] + R[l, i, 2] * x[2]
    far = farthest(obstacles.room, obstacles.active, rho)
    distances_into(P, body.skin.radius[first : first + count], obstacles, far, out)
    count_rooms(obstacles.room, out)
    for o in range(out.shape[0]):
        for s in range(count):
            if out[o, 0, s] < rho:
                return False
    return True


@kernel
def first_blocked(body: Body, Q: F64, obstacles: Obstacles, room: Room, share: float) -> int:
    """Return the first found of the postures Q (b, n) that does not keep a share of the room, -1 for none.

    They are looked at in the order of a bisection, so that what is blocked is found early.
    """
    b, n, m = Q.shape[0], Q.shape[1], body.link.shape[0]
    R, t, P = np.empty((n + 1, 3, 3)), np.empty((n + 1, 3)), np.empty((3, m))
    rho = np.empty((obstacles.active.shape[0], 4, m))
    far = farthest(obstacles.room, obstacles.active, room.rho)
    stride = 1
    while stride < b:
        stride *= 2
    first = True
    while stride >= 1:
        start = 0 if first else stride
        for k in range(start, b, stride if first else 2 * stride):
            free, own = room.rho, room.own
            for a in range(room.anchors.shape[0]):
                away = 0.0
                for i in range(n):
                    away = max(away, abs(room.anchors[a, i] - Q[k, i]))
                free = min(free, 0.999 * room.near[a, 0] + RELAX * away)
                own = min(own, 0.999 * room.near[a, 1] + RELAX * away)
            placements(body.chain, Q[k], R, t)
            for j in range(m):
                l = body.link[j]
                for i in range(3):
                    P[i, j] = t[l, i] + R[l, i, 0] * body.local[j, 0] + R[l, i, 1] * body.local[j, 1]
                    P[i, j] += R[l, i, 2] * body.local[j, 2]
            distances_into(P, body.radius, obstacles, far, rho)
            count_rooms(obstacles.room, rho)
            keep = share * min(free, body.skin.keep)
            most = max(keep - body.skin.overhang, share * min(free, BALLS))  # that is asked of the points themselves
            for j in range(m):
                least = np.inf
                for o in range(rho.shape[0]):
                    least = min(least, rho[o, 0, j])
                if least >= share * free:
                    continue
                if body.skin.start.shape[0] == 0 or least < most:
                    return k
                if not _skin_keeps(body, j, R, t, obstacles, keep):
                    return k
            if body.pairs.shape[0] > 0:
                for s in not_apart(body.pairs, body.hulls, share * own, R, t):
                    if not hulls_apart(body.pairs[s, 0], body.pairs[s, 1], body.hulls, share * own, R, t):
                        return k
        first = False
        stride //= 2
    return -1

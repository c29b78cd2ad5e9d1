"""Whether postures are free: many at once, the arm's spheres against the obstacles and its hulls against each other."""

from typing import NamedTuple

import numpy as np

from rtctl.arm.kinematics import Chain, chain_of, placements
from rtctl.arm.robot import Robot
from rtctl.arm.self_collision import Hulls, not_apart
from rtctl.kernel import kernel
from rtctl.types import F64, I64
from rtctl.world.primitives import Obstacles, distances_into

RELAX = 0.3  # [m/rad] by which what must be kept free grows from what an anchor has


class Body(NamedTuple):
    """What of an arm can touch something."""

    chain: Chain
    link: I64  # (m,) of the points, as in `Points`
    local: F64  # (m, 3) [m]
    radius: F64  # (m,) [m]
    pairs: I64  # (L, 2) of hulls
    hulls: Hulls


class Room(NamedTuple):
    """What a posture must keep free of; near the anchors no more than these have."""

    rho: float  # [m] to obstacles
    own: float  # [m] between links
    anchors: F64  # (a, n) [rad]
    near: F64  # (a, 2) [m] rho and own there


def body_of(robot: Robot) -> Body:
    """Return what of a robot can touch something."""
    points, own = robot.points, robot.own
    return Body(chain_of(robot.body), points.link, points.local, points.radius, own.pairs, own.arrays)


@kernel
def first_blocked(body: Body, Q: F64, obstacles: Obstacles, room: Room, share: float) -> int:
    """Return the first found of the postures Q (b, n) that does not keep a share of the room, -1 for none.

    They are looked at in the order of a bisection, so that what is blocked is found early.
    """
    b, n, m = Q.shape[0], Q.shape[1], body.link.shape[0]
    R, t, P = np.empty((n + 1, 3, 3)), np.empty((n + 1, 3)), np.empty((3, m))
    rho = np.empty((obstacles.active.shape[0], 4, m))
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
            distances_into(P, body.radius, obstacles, room.rho, rho)
            for o in range(rho.shape[0]):
                for j in range(m):
                    if rho[o, 0, j] < share * free:
                        return k
            if body.pairs.shape[0] > 0 and not_apart(body.pairs, body.hulls, share * own, R, t).shape[0] > 0:
                return k
        first = False
        stride //= 2
    return -1

"""How near the arm is to itself: exact distances between the convex hulls of links that can meet.

Neighbouring links always touch, and many others never can; a field between those would push for nothing. Which pairs
remain is found once, over postures within the joint limits. Spheres or capsules as stand-ins overstate the nearness of
a compact arm's forearm and hand by centimetres, so the distance itself is measured, by GJK, behind bounding spheres.
"""

from typing import Any, NamedTuple

import coal
import numpy as np

from rtctl.kernel import kernel
from rtctl.types import B1, F64, I64


class Hull(NamedTuple):
    """The convex hull of one URDF link's collision geometry, in the frame of the joint that carries it."""

    link: int  # 0 is the base
    name: str
    shape: Any  # coal's
    centre: F64  # (3,) [m] of a ball around it
    radius: float  # [m]


class Own:
    """The hulls, the pairs that are watched, and coal's work objects."""

    def __init__(self, hulls: list[Hull], pairs: I64, reach: float) -> None:
        """pairs (L, 2): indices of hulls, far link first. reach [m]: pairs farther apart than this are not measured."""
        self.hulls, self.pairs, self.reach = hulls, pairs, reach
        self.names = tuple((hulls[i].name, hulls[j].name) for i, j in pairs)
        self._link: I64 = np.array([h.link for h in hulls], np.int64)
        self._centre: F64 = np.array([h.centre for h in hulls]).reshape(-1, 3)
        self._radius: F64 = np.array([h.radius for h in hulls])
        self._at = [coal.Transform3s() for _ in hulls]
        self._request, self._result = coal.DistanceRequest(True, True), coal.DistanceResult()

    def measure(self, Rj: F64, tj: F64, Jw: F64, iv: I64, chain: B1) -> tuple[F64, F64]:
        """Return rho (L,) [m], negative in contact, and d rho/d q (L, n); inf and zeros for pairs beyond `reach`.

        Rj (links, 3, 3), tj (links, 3): placements; Jw (6, nv): joint twists at the world's
        origin; iv, chain: RigidBody's.
        """
        rho = _bounds(self.pairs, self._link, self._centre, self._radius, Rj, tj)
        near = np.flatnonzero(rho < self.reach)
        rows = np.zeros((len(self.pairs), chain.shape[1]))
        placed: set[int] = set()
        for s in near:
            i, j = int(self.pairs[s, 0]), int(self.pairs[s, 1])
            for k in (i, j):
                if k not in placed:
                    placed.add(k)
                    self._at[k].setTransform(Rj[self._link[k]], tj[self._link[k]])
            self._result.clear()
            rho[s] = coal.distance(
                self.hulls[i].shape, self._at[i], self.hulls[j].shape, self._at[j], self._request, self._result
            )
            n = -np.asarray(self._result.normal)  # coal's points from the first to the second
            a, b = np.asarray(self._result.getNearestPoint1()), np.asarray(self._result.getNearestPoint2())
            _gradient(n, a, b, self._link[i], self._link[j], Jw, iv, chain, rows[s])
        rho[rho >= self.reach] = np.inf
        return rho, rows


@kernel
def _bounds(pairs: I64, link: I64, centre: F64, radius: F64, Rj: F64, tj: F64) -> F64:
    """Return a lower bound (L,) [m] of each pair's distance from the balls around the hulls."""
    world = np.empty((link.shape[0], 3))
    for k in range(link.shape[0]):
        for r in range(3):
            world[k, r] = tj[link[k], r]
            for c in range(3):
                world[k, r] += Rj[link[k], r, c] * centre[k, c]
    out = np.empty(pairs.shape[0])
    for s in range(pairs.shape[0]):
        i, j = pairs[s, 0], pairs[s, 1]
        d = 0.0
        for r in range(3):
            d += (world[i, r] - world[j, r]) ** 2
        out[s] = np.sqrt(d) - radius[i] - radius[j]
    return out


@kernel
def _gradient(n: F64, a: F64, b: F64, far: int, near: int, Jw: F64, iv: I64, chain: B1, row: F64) -> None:
    """Write n^T (J_a - J_b) to row (n,): a on link `far`, b on link `near`, n from b to a."""
    for k in range(iv.shape[0]):
        c = iv[k]
        row[k] = 0.0
        for p, link, sign in ((a, far, 1.0), (b, near, -1.0)):
            if chain[link, k]:
                vx = Jw[0, c] + Jw[4, c] * p[2] - Jw[5, c] * p[1]
                vy = Jw[1, c] + Jw[5, c] * p[0] - Jw[3, c] * p[2]
                vz = Jw[2, c] + Jw[3, c] * p[1] - Jw[4, c] * p[0]
                row[k] += sign * (n[0] * vx + n[1] * vy + n[2] * vz)


def nothing() -> Own:
    """Return no pairs: self-collision avoidance switched off."""
    return Own([], np.zeros((0, 2), np.int64), 0.0)

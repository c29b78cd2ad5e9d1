"""How near the arm is to itself: exact distances between the convex hulls of links that can meet.

Neighbouring links always touch, and many others never can; a field between those would push for nothing. Which pairs
remain is found once, over postures within the joint limits. Spheres or capsules as stand-ins overstate the nearness of
a compact arm's forearm and hand by centimetres, so the distance itself is measured, by GJK, but only for pairs that no
plane is found to hold farther apart than is asked about.
"""

from typing import NamedTuple

import coal
import numpy as np

from rtctl.kernel import kernel
from rtctl.types import B1, F64, I64

PLANES = 12  # tried between two hulls before their distance is measured; most of those far apart need one or two
SLACK = 1e-5  # [m] by which a plane must hold hulls farther apart than `reach`: ten times GJK's tolerance of 1e-6


class Hull(NamedTuple):
    """The convex hull of one URDF link's collision geometry, in the frame of the joint that carries it."""

    link: int  # 0 is the base
    name: str
    shape: coal.CollisionGeometry
    corners: F64  # (v, 3) [m] points whose hull it is
    centre: F64  # (3,) [m] of a ball around it
    radius: float  # [m]


class Own:
    """The hulls, the pairs that are watched, and coal's work objects."""

    def __init__(self, hulls: list[Hull], pairs: I64, reach: float) -> None:
        """pairs (L, 2): indices of hulls, far link first. reach [m]: pairs farther apart than this are not measured."""
        self.hulls, self.pairs, self.reach = hulls, pairs, reach
        self.names = tuple((hulls[i].name, hulls[j].name) for i, j in pairs)
        self.arrays = Hulls(
            link=np.array([h.link for h in hulls], np.int64),
            centre=np.array([h.centre for h in hulls]).reshape(-1, 3),
            radius=np.array([h.radius for h in hulls]),
            first=np.cumsum([0, *(len(h.corners) for h in hulls)]).astype(np.int64),
            corners=np.ascontiguousarray(np.concatenate([np.zeros((0, 3)), *(h.corners for h in hulls)])),
        )
        self._at = [coal.Transform3s() for _ in hulls]
        self._request, self._result = coal.DistanceRequest(True, True), coal.DistanceResult()

    def near(self, Rj: F64, tj: F64) -> I64:
        """Return the pairs (k,) that are not proven to be farther apart than `reach`; arguments as in `measure`."""
        return not_apart(self.pairs, self.arrays, self.reach + SLACK, Rj, tj)

    def meet(self, Rj: F64, tj: F64, met: B1) -> None:
        """Set in met (L,) what is nearer than `reach`; what is set already is not measured again."""
        for s in self.near(Rj, tj):
            if not met[s]:
                met[s] = self._exact(s, Rj, tj) < self.reach

    def distances(self, Rj: F64, tj: F64) -> F64:
        """Return rho (L,) [m] as `measure` does."""
        rho = np.full(len(self.pairs), np.inf)
        for s in self.near(Rj, tj):
            rho[s] = self._exact(s, Rj, tj)
        rho[rho >= self.reach] = np.inf
        return rho

    def measure(self, Rj: F64, tj: F64, Jw: F64, iv: I64, chain: B1) -> tuple[F64, F64]:
        """Return rho (L,) [m], negative in contact, and d rho/d q (L, n); inf and zeros for pairs beyond `reach`.

        Rj (links, 3, 3), tj (links, 3): placements; Jw (6, nv): joint twists at the world's
        origin; iv, chain: RigidBody's.
        """
        rho = np.full(len(self.pairs), np.inf)
        rows = np.zeros((len(self.pairs), chain.shape[1]))
        for s in self.near(Rj, tj):
            d = self._exact(s, Rj, tj)
            if d < self.reach:
                rho[s] = d
                n = -np.asarray(self._result.normal)  # coal's points from the first to the second
                a, b = np.asarray(self._result.getNearestPoint1()), np.asarray(self._result.getNearestPoint2())
                far, near = self.arrays.link[self.pairs[s]]
                _gradient(n, a, b, far, near, Jw, iv, chain, rows[s])
        return rho, rows

    def _exact(self, s: int, Rj: F64, tj: F64) -> float:
        """Return the distance [m] of a pair by GJK; normal and nearest points stand in the result afterwards."""
        i, j = int(self.pairs[s, 0]), int(self.pairs[s, 1])
        for k in (i, j):
            link = self.hulls[k].link
            self._at[k].setTransform(Rj[link], tj[link])
        self._result.clear()
        return float(
            coal.distance(
                self.hulls[i].shape, self._at[i], self.hulls[j].shape, self._at[j], self._request, self._result
            )
        )


class Hulls(NamedTuple):
    """All hulls of an arm as arrays."""

    link: I64  # (H,)
    centre: F64  # (H, 3) [m] of a ball around each
    radius: F64  # (H,) [m]
    first: I64  # (H + 1,) index of each hull's first corner
    corners: F64  # (V, 3) [m]


@kernel
def not_apart(pairs: I64, hulls: Hulls, reach: float, Rj: F64, tj: F64) -> I64:
    """Return the pairs (k,) whose hulls no tried plane holds farther apart than reach [m]; balls are tried first."""
    world = np.empty((hulls.link.shape[0], 3))
    for k in range(hulls.link.shape[0]):
        link = hulls.link[k]
        for r in range(3):
            world[k, r] = tj[link, r]
            for c in range(3):
                world[k, r] += Rj[link, r, c] * hulls.centre[k, c]
    found = np.empty(pairs.shape[0], np.int64)
    count = 0
    for s in range(pairs.shape[0]):
        i, j = pairs[s, 0], pairs[s, 1]
        d = np.empty(3)
        for r in range(3):
            d[r] = world[i, r] - world[j, r]
        within = np.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]) - hulls.radius[i] - hulls.radius[j] < reach
        if within and not _apart(i, j, hulls, reach, Rj, tj, d):
            found[count] = s
            count += 1
    return found[:count].copy()


@kernel
def _apart(i: int, j: int, hulls: Hulls, reach: float, Rj: F64, tj: F64, towards: F64) -> bool:
    """Return whether a plane is found that holds hulls i and j farther apart than reach [m].

    For any unit d the least d.(a - b) over corners a of i and b of j is a lower bound of the distance. d is the
    direction of v, a point of the set of all a - b that comes nearer to the origin by each support point found
    (Gilbert 1966); `towards` (3,) is the first. False says nothing but that none of PLANES planes did.
    """
    a, b, d, w = np.empty(3), np.empty(3), towards.copy(), np.empty(3)
    v = np.zeros(3)
    for step in range(PLANES):
        length = np.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
        if length < reach and (step > 0 or length < 1e-9):
            return False  # v itself is that near
        _support(hulls, i, Rj, tj, d, -1.0, a)
        _support(hulls, j, Rj, tj, d, 1.0, b)
        for r in range(3):
            w[r] = a[r] - b[r]
        if (d[0] * w[0] + d[1] * w[1] + d[2] * w[2]) / length > reach:
            return True
        if step == 0:
            for r in range(3):
                v[r] = w[r]
        else:  # the point nearest to the origin on the line from v to w
            top, bottom = 0.0, 0.0
            for r in range(3):
                top += v[r] * (v[r] - w[r])
                bottom += (v[r] - w[r]) ** 2
            if top <= 0.0 or bottom == 0.0:
                return False  # v is the nearest point of all
            share = min(1.0, top / bottom)
            for r in range(3):
                v[r] += share * (w[r] - v[r])
        for r in range(3):
            d[r] = v[r]
    return False


@kernel
def _support(hulls: Hulls, k: int, Rj: F64, tj: F64, d: F64, sign: float, out: F64) -> None:
    """Write to out (3,) the corner of hull k that lies farthest along sign d."""
    link = hulls.link[k]
    x = sign * (Rj[link, 0, 0] * d[0] + Rj[link, 1, 0] * d[1] + Rj[link, 2, 0] * d[2])
    y = sign * (Rj[link, 0, 1] * d[0] + Rj[link, 1, 1] * d[1] + Rj[link, 2, 1] * d[2])
    z = sign * (Rj[link, 0, 2] * d[0] + Rj[link, 1, 2] * d[1] + Rj[link, 2, 2] * d[2])
    best, most = hulls.first[k], -np.inf
    for c in range(hulls.first[k], hulls.first[k + 1]):
        along = hulls.corners[c, 0] * x + hulls.corners[c, 1] * y + hulls.corners[c, 2] * z
        if along > most:
            best, most = c, along
    p = hulls.corners[best]
    for r in range(3):
        out[r] = tj[link, r] + Rj[link, r, 0] * p[0] + Rj[link, r, 1] * p[1] + Rj[link, r, 2] * p[2]


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

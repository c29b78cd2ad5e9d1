"""Whether two hulls of an arm are farther apart than a distance, where the planes of `self_collision` say nothing.

The algorithm of Gilbert, Johnson and Keerthi (IEEE J. Robotics and Automation 4(2), 1988) on the set of all a - b, a of
the one hull and b of the other: of a simplex of its corners the point v nearest to the origin is found, the corner that
lies farthest against v joins the simplex, and what does not hold v leaves it. |v| is never less than the distance,
v.w/|v| of that corner w never more, so that both answers are sure as soon as either is known.
"""

import numpy as np

from rtctl.arm.self_collision import Hulls
from rtctl.kernel import kernel
from rtctl.types import F64

STEPS = 40  # corners looked at; a few are enough
CLOSE = 1e-9  # of |v|^2, that v is nearer to than the distance: then it is that


@kernel
def hulls_apart(i: int, j: int, hulls: Hulls, reach: float, Rj: F64, tj: F64) -> bool:
    """Return whether hulls i and j are farther apart than reach [m], which is more than nothing.

    Rj (n + 1, 3, 3), tj (n + 1, 3) [m]: where the links are.
    """
    Y, v, w = np.empty((4, 3)), np.empty(3), np.empty(3)
    _corner(i, j, hulls, np.array([1.0, 0.0, 0.0]), Rj, tj, v)
    Y[0], size = v, 1
    for _ in range(STEPS):
        square = v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
        if square < reach * reach:
            return False
        _corner(i, j, hulls, v, Rj, tj, w)
        along = v[0] * w[0] + v[1] * w[1] + v[2] * w[2]
        if along > reach * np.sqrt(square):
            return True
        if square - along <= CLOSE * square:
            return False
        Y[size] = w
        size = nearest_of(Y, size + 1, v)
        if size == 4:
            return False  # the origin lies within
    return False


@kernel
def _corner(i: int, j: int, hulls: Hulls, v: F64, Rj: F64, tj: F64, out: F64) -> None:
    """Write to out (3,) of all a - b the one that lies farthest against v (3,)."""
    out[:] = 0.0
    for hull, sign in ((i, 1.0), (j, -1.0)):
        link = hulls.link[hull]
        R, d = Rj[link], np.zeros(3)
        for c in range(3):
            for r in range(3):
                d[c] -= sign * R[r, c] * v[r]
        best, most = hulls.first[hull], -np.inf
        for k in range(hulls.first[hull], hulls.first[hull + 1]):
            x = hulls.corners[k]
            along = x[0] * d[0] + x[1] * d[1] + x[2] * d[2]
            if along > most:
                best, most = k, along
        x = hulls.corners[best]
        for r in range(3):
            out[r] += sign * (tj[link, r] + R[r, 0] * x[0] + R[r, 1] * x[1] + R[r, 2] * x[2])


@kernel
def nearest_of(Y: F64, size: int, v: F64) -> int:
    """Write to v (3,) the point of the hull of rows of Y (4, 3) nearest to the origin; return how many span it.

    size: how many rows. Those that span it come first in Y then. Each part of the simplex is tried: the nearest point
    of its plane counts where it lies within the part.
    """
    least, best = np.inf, 0
    point, found = np.empty(3), np.empty(3)
    for part in range(1, 1 << size):
        if _nearest_within(Y, size, part, point):
            square = point[0] * point[0] + point[1] * point[1] + point[2] * point[2]
            if square < least:
                least, best = square, part
                found[:] = point
    v[:] = found
    count = 0
    for k in range(size):
        if best >> k & 1:
            Y[count] = Y[k]
            count += 1
    return count


@kernel
def _nearest_within(Y: F64, size: int, part: int, out: F64) -> bool:
    """Write the point of the plane of rows of Y, bits of `part`, nearest to the origin; return whether it is in it.

    y_0 + sum l_k (y_k - y_0) with (y_i - y_0).(y_k - y_0) l_k = -(y_i - y_0).y_0, by Gauss.
    """
    E, first, count = np.empty((3, 3)), -1, 0
    for k in range(size):
        if part >> k & 1:
            if first < 0:
                first = k
            else:
                for r in range(3):
                    E[count, r] = Y[k, r] - Y[first, r]
                count += 1
    G = np.empty((3, 4))
    for a in range(count):
        for b in range(count):
            G[a, b] = E[a, 0] * E[b, 0] + E[a, 1] * E[b, 1] + E[a, 2] * E[b, 2]
        G[a, 3] = -(E[a, 0] * Y[first, 0] + E[a, 1] * Y[first, 1] + E[a, 2] * Y[first, 2])
    for a in range(count):
        pivot = G[a, a]
        if not pivot > 1e-14:  # [m2] flat: a smaller part says the same
            return False
        for b in range(count):
            if b != a:
                f = G[b, a] / pivot
                for c in range(4):
                    if c == 3 or c < count:
                        G[b, c] -= f * G[a, c]
    rest = 1.0
    out[:] = Y[first]
    for a in range(count):
        share = G[a, 3] / G[a, a]
        rest -= share
        if share < 0.0:
            return False
        for r in range(3):
            out[r] += share * E[a, r]
    return rest >= 0.0

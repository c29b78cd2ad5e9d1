"""Points near obstacles whose approach may have to be stopped: which they are, and bounds for them that cost little.

Of each obstacle and link the nearest point counts, and those about as near. Few of them bind, so a row of equations is
made for a point only when accelerations pass a bound that is cheap and never above the true one.
"""

import math
from typing import NamedTuple

from rtctl.arm.bounds import JERK_SHARE, approach_bound
from rtctl.arm.field import NORMAL, RHO, MovingPoints
from rtctl.control.firas import Field
from rtctl.kernel import leaf_kernel
from rtctl.types import F64, I64

APPROACH_ZONE = 0.5  # of the influence, within which an approach is guarded; farther out v_max can be given up
LINK_BAND = 0.02  # [m] beyond the nearest point of a link, within which its points count too: a link also turns
CANDIDATES_MAX = 2048  # points near obstacles that are looked at; what comes later in the table is not
# of a candidate's bound: below the true one; the true one; and its row is at hand
CHEAP, EXACT, MADE = 0, 1, 2
_BELOW = 1.0 - 1e-9  # takes a bound of the jerk below what rounding may have added to it
KEPT = 5  # of Field.rooms: [m] that an approach is stopped before
_V, _B = 3, 6  # rows of Field.points: velocity, mobility


class Candidates(NamedTuple):
    """Points near obstacles, in ascending order of slot, then of point."""

    place: I64  # (3, c) slot, point, state as above
    most: F64  # (c,) of row qdd, never above the true bound
    points: F64  # (4, m) for candidates' points: acceleration [m/s2] (3), bound of |row|/tau_rate; -1 for the others
    best: F64  # (n + 1,) work, by link


class Nearby(NamedTuple):
    """The points near obstacles, with what their rows are made of."""

    found: Candidates
    size: int  # how many
    seen: Field
    points: MovingPoints
    qd: F64  # (n,)
    braking: float  # [m/s2]
    tau_rate: F64  # (n,) [Nm/s]


@leaf_kernel
def nearby_in(
    whole: I64, real: F64, points: MovingPoints, seen: Field, qd: F64, braking: float, tau_rate: F64
) -> Nearby:
    """Return the points near obstacles in flat arrays, (3 c + 1,) and (c + 4 m + n + 1,) for c candidates at most."""
    c, m = (whole.shape[0] - 1) // 3, points.radius.shape[0]
    found = Candidates(whole[: 3 * c].reshape(3, c), real[:c], real[c : c + 4 * m].reshape(4, m), real[c + 4 * m :])
    return Nearby(found, whole[3 * c], seen, points, qd, braking, tau_rate)


@leaf_kernel
def candidates(seen: Field, points: MovingPoints, share: float, out: Candidates) -> int:
    """List the points within a share of an obstacle's influence that are the nearest of their link, or nearly so.

    Returns how many: of each obstacle and link the nearest point and those within LINK_BAND of it, in the zone.
    """
    count = 0
    for k in range(seen.leader.shape[0]):
        if seen.leader[k] < 0:
            continue
        zone = share * seen.rooms[k, 0] + seen.rooms[k, KEPT]
        if not seen.rho_min[k] < zone:
            continue
        first, end = count, count
        for i in range(seen.near_count[k]):
            j = seen.near[k, i]
            if seen.pairs[k, RHO, j] < zone and end < out.place.shape[1]:
                out.place[1, end] = j
                out.best[points.link[j]] = zone - LINK_BAND
                end += 1
        for c in range(first, end):
            j = out.place[1, c]
            out.best[points.link[j]] = min(out.best[points.link[j]], seen.pairs[k, RHO, j])
        for c in range(first, end):
            j = out.place[1, c]
            if seen.pairs[k, RHO, j] < out.best[points.link[j]] + LINK_BAND:
                out.place[0, count], out.place[1, count], out.place[2, count] = k, j, 0
                count += 1
    return count


@leaf_kernel
def cheap_bounds(size: int, near: Nearby) -> None:
    """Write bounds of row qdd that are never above the true ones, for `size` candidates, from what the field knows.

    row = -n^T Jp, so the speed is -n . v and the mobility n^T B n. The jerk is at least what it would be if one joint
    moved the point along n with all of its column: |row_i| <= |Jp_i|.
    """
    if size == 0:
        return
    out, seen, points, tau_rate = near.found, near.seen, near.points, near.tau_rate
    for j in range(points.radius.shape[0]):
        out.points[3, j] = -1.0
    for c in range(size):
        k, j = out.place[0, c], out.place[1, c]
        if out.points[3, j] < 0.0:
            steepest = 0.0
            for i in range(tau_rate.shape[0]):
                x, y, z = points.Jp[j, 0, i], points.Jp[j, 1, i], points.Jp[j, 2, i]
                steepest = max(steepest, (x * x + y * y + z * z) / (tau_rate[i] * tau_rate[i]))
            out.points[3, j] = max(math.sqrt(steepest), 1e-9)
        x, y, z = seen.pairs[k, NORMAL, j], seen.pairs[k, NORMAL + 1, j], seen.pairs[k, NORMAL + 2, j]
        X = seen.points
        speed = -(x * X[_V, j] + y * X[_V + 1, j] + z * X[_V + 2, j])
        b = x * x * X[_B, j] + y * y * X[_B + 1, j] + z * z * X[_B + 2, j]
        b += 2.0 * (x * y * X[_B + 3, j] + x * z * X[_B + 4, j] + y * z * X[_B + 5, j])
        jerk = _BELOW * JERK_SHARE * max(b, 0.0) / out.points[3, j]
        bound = approach_bound(seen.pairs[k, RHO, j] - seen.rooms[k, KEPT], speed, math.inf, near.braking, jerk)
        out.most[c] = bound - 1e-9 * (1.0 + abs(bound))


@leaf_kernel
def look_near(near: Nearby, share: float) -> int:
    """List the points that approach an obstacle within a share of its influence, with cheap bounds; return how many.

    It is the arm's own approach -n . Jp qd alone that is bounded; what comes towards it is for the field to flee.
    """
    size = candidates(near.seen, near.points, share, near.found)
    cheap_bounds(size, near)
    return size


@leaf_kernel
def accelerate(x: F64, near: Nearby) -> None:
    """Write the accelerations Jp x of the candidates' points."""
    X, Jp = near.found.points, near.points.Jp
    for j in range(X.shape[1]):
        if X[3, j] >= 0.0:
            for i in range(3):
                s = 0.0
                for d in range(x.shape[0]):
                    s += Jp[j, i, d] * x[d]
                X[i, j] = s


@leaf_kernel
def towards(c: int, near: Nearby) -> float:
    """Return row qdd of a candidate, with the accelerations that `accelerate` left."""
    k, j, X, pairs = near.found.place[0, c], near.found.place[1, c], near.found.points, near.seen.pairs
    s: float = pairs[k, NORMAL, j] * X[0, j] + pairs[k, NORMAL + 1, j] * X[1, j] + pairs[k, NORMAL + 2, j] * X[2, j]
    return -s

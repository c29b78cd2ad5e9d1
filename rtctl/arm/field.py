"""The artificial potential field: repulsion of points on every link from obstacles (Khatib 1986).

    f = lambda (a + d) n,    lambda = 1 / (n^T J A^-1 J^T n),    tau_obstacles = sum over points and obstacles of J^T f

with a, d of `firas`, the true distance rho and its unit normal n = d rho/d p. lambda a is the force that gives the
point the acceleration a along n. Below 1/m_max = b0 the mobility b = n^T J A^-1 J^T n gives lambda = b/b0^2, which goes
to zero: a point that hardly moves cannot flee, and the arm is not to be flung about for it. So no pair exceeds
2 m_max a(rho_num).

The points of a link share one repulsion by default: each term is weighted by its part of their sum of a (`blend`). The
paper's own forms may be chosen instead: the plain sum (`SUM`), and f = Lambda_j (a + d) n with the whole inertia of the
point (`TASK`, see `point_inertia`).

An obstacle that comes towards a point widens rho0 by its own speed along n times the look-ahead. Its own, not the
closing speed: the arm's motion would otherwise feed back into the zone and break the energy balance that eta comes
from.
"""

import math
from typing import NamedTuple

from rtctl.arm.joint_field import LEAST_REACH, joint_limit_field, own_field, self_collision
from rtctl.arm.point_inertia import times_inertia
from rtctl.control.firas import (
    CAPPED,
    CONTACT,
    SUM,
    TASK,
    Field,
    FieldParams,
    LimitParams,
    eta_of,
    field_buffers,
    field_params,
    firas,
    limit_params,
    put_room,
    rho_num_of,
)
from rtctl.kernel import leaf_kernel
from rtctl.types import F64, I64
from rtctl.world.primitives import Obstacles, distances_into, speed_bound
from rtctl.world.rooms import OWN_CLEARANCE, OWN_INFLUENCE, widest

__all__ = [
    "CAPPED",
    "CONTACT",
    "SUM",
    "TASK",
    "Field",
    "FieldParams",
    "LimitParams",
    "MovingPoints",
    "eta_of",
    "field",
    "field_buffers",
    "field_params",
    "joint_limit_field",
    "limit_params",
    "move_points",
    "own_field",
    "rho_num_of",
    "self_collision",
]


APART = 0.5  # of the way to its place in the goal's posture, by which a point's influences are wider than there
APART_LED = 0.0  # while the joints are led: the way to a posture that is a moment ahead is known to be free

# Rows of Field.points and Field.pairs.
_P, _V, _B, _F = 0, 3, 6, 12
RHO, NORMAL, ACCELERATION, FORCE = 0, 1, 4, 5


class MovingPoints(NamedTuple):
    """The points of one evaluation; the first m of P and Jp count."""

    P: F64  # (>= m, 3) [m] where they were
    Jp: F64  # (>= m, 3, n)
    B: F64  # (m, 3, 3) [1/kg] mobility, Jp A^-1 Jp^T
    radius: F64  # (m,) [m]
    link: I64  # (m,) in 0..n


class Ends(NamedTuple):
    """Where the points are in a posture that has the goal; without one both are empty."""

    P: F64  # (m, 3) [m]
    rho: F64  # (K, m) [m] from each obstacle there
    least: float  # [m] below which no influence shrinks, of obstacles with the config's clearance
    apart: float  # APART, or APART_LED
    beside: float  # [m] from its place, within which a point's influences are no wider than there
    own: F64  # (L,) [m] between the links of the arm there


@leaf_kernel
def _reach(ends: Ends, k: int, j: int, points: F64, rho0: float, least: float) -> float:
    """Return the influence [m] of the obstacle in slot k on point j: at the goal the clearance that it has there.

    The field then vanishes in the goal's posture, which is the minimum of the whole potential (goals non-reachable with
    obstacles nearby: Ge and Cui 2000). Away from it influence grows by less than the distance: a point beside its place
    is not pushed about it, |e| away at the same height it feels `apart` |e| at most.
    """
    x, y, z = points[_P, j] - ends.P[j, 0], points[_P + 1, j] - ends.P[j, 1], points[_P + 2, j] - ends.P[j, 2]
    reach = ends.rho[k, j] + ends.apart * max(math.sqrt(x * x + y * y + z * z) - ends.beside, 0.0)
    bounded: float = min(max(reach, least), rho0)
    return bounded


@leaf_kernel
def move_points(points: MovingPoints, dq: F64, qd: F64, X: F64) -> None:
    """Write the positions now, P + Jp dq [m], and the velocities Jp qd into the first six rows of X (>= 6, m).

    dq = q - q of the evaluation. Between evaluations the neglected term is half the centripetal acceleration times
    dt^2: 0.03 mm at 2 rad/s, 250 Hz.
    """
    Jp = points.Jp
    for j in range(points.radius.shape[0]):
        x, y, z, u, v, w = points.P[j, 0], points.P[j, 1], points.P[j, 2], 0.0, 0.0, 0.0
        for d in range(dq.shape[0]):  # six sums side by side: none waits for another
            x += Jp[j, 0, d] * dq[d]
            y += Jp[j, 1, d] * dq[d]
            z += Jp[j, 2, d] * dq[d]
            u += Jp[j, 0, d] * qd[d]
            v += Jp[j, 1, d] * qd[d]
            w += Jp[j, 2, d] * qd[d]
        X[_P, j], X[_P + 1, j], X[_P + 2, j] = x, y, z
        X[_V, j], X[_V + 1, j], X[_V + 2, j] = u, v, w


@leaf_kernel
def _load(B: F64, X: F64) -> None:
    """Fill the rows of mobilities; zero the forces."""
    for j in range(X.shape[1]):
        X[_B, j], X[_B + 1, j], X[_B + 2, j] = B[j, 0, 0], B[j, 1, 1], B[j, 2, 2]
        X[_B + 3, j], X[_B + 4, j], X[_B + 5, j] = B[j, 0, 1], B[j, 0, 2], B[j, 1, 2]
        X[_F, j], X[_F + 1, j], X[_F + 2, j] = 0.0, 0.0, 0.0


# error_model: see firas; the divisor here is at least 1/m_max.
@leaf_kernel
def _repel(obstacles: Obstacles, k: int, params: FieldParams, out: Field, ends: Ends) -> None:
    """Write a and lambda (a + d) of every near point against the obstacle in slot k, zero of the others.

    With TASK a + d alone: its inertia is no number, see `_add_forces`.
    What moves keeps its whole influence: it will not be where it is now.
    rho_dot = n . (point velocity - surface velocity); the surface point is x = P - rho n, and n . (w x n) = 0.
    """
    p, v, w, points, pairs = obstacles.p, obstacles.v, obstacles.w, out.points, out.pairs
    rho0, rho_min, rho_num = out.rooms[k, 0], out.rooms[k, 1], out.rooms[k, 2]
    eta, k_d = out.rooms[k, 3], out.rooms[k, 4]
    thinnest = ends.least if rho_min == params.rho_min else ends.least * rho_min / params.rho_min
    look_ahead, soft, floor = params.look_ahead, params.v_smooth, 1.0 / params.m_max
    heavy, whole = params.m_max * params.m_max, int(params.forms) & TASK != 0
    px, py, pz, vx, vy, vz, wx, wy, wz = p[k, 0], p[k, 1], p[k, 2], v[k, 0], v[k, 1], v[k, 2], w[k, 0], w[k, 1], w[k, 2]
    rests = vx == 0.0 and vy == 0.0 and vz == 0.0 and wx == 0.0 and wy == 0.0 and wz == 0.0
    near_goal = rests and ends.P.shape[0] > 0
    for j in range(points.shape[1]):
        pairs[k, ACCELERATION, j] = 0.0
        pairs[k, FORCE, j] = 0.0
    for i in range(out.near_count[k]):
        j = out.near[k, i]
        x, y, z = pairs[k, NORMAL, j], pairs[k, NORMAL + 1, j], pairs[k, NORMAL + 2, j]
        dx, dy, dz = points[_P, j] - px, points[_P + 1, j] - py, points[_P + 2, j] - pz
        towards = x * (vx + wy * dz - wz * dy) + y * (vy + wz * dx - wx * dz) + z * (vz + wx * dy - wy * dx)
        rho_dot = x * points[_V, j] + y * points[_V + 1, j] + z * points[_V + 2, j] - towards
        wide = 0.0 if towards <= 0.0 else (0.5 * towards * towards / soft if towards < soft else towards - 0.5 * soft)
        reach = _reach(ends, k, j, points, rho0, thinnest) if near_goal else rho0 + look_ahead * wide
        if pairs[k, RHO, j] >= reach:
            continue
        clearance, least = min(rho_min, reach / LEAST_REACH), min(rho_num, reach / LEAST_REACH)
        thin = least / rho_num  # a zone thinner than rho_num is as steep as the others at most
        a, d = firas(pairs[k, RHO, j], rho_dot, reach, clearance, least, thin * thin * thin * thin * eta, k_d)
        b = x * x * points[_B, j] + y * y * points[_B + 1, j] + z * z * points[_B + 2, j]
        b += 2.0 * (x * y * points[_B + 3, j] + x * z * points[_B + 4, j] + y * z * points[_B + 5, j])
        pairs[k, ACCELERATION, j] = a
        pairs[k, FORCE, j] = (a + d) * (1.0 if whole else b * heavy if b <= floor else 1.0 / b)


@leaf_kernel
def _near_points(pairs: F64, k: int, cutoff: float, near: I64) -> int:
    """List the points whose distance in slot k is not beyond the cut-off (a NaN is not), ascending; return how many."""
    count = 0
    for j in range(pairs.shape[2]):
        near[k, count] = j
        count += 0 if pairs[k, RHO, j] >= cutoff else 1
    return count


@leaf_kernel
def _least(pairs: F64, k: int) -> tuple[float, int]:
    """Return the least distance in slot k and its first point; a NaN wins, so that it is seen."""
    a, b, c, d = math.inf, math.inf, math.inf, math.inf  # four chains: a compare waits for the one before it
    m, nan = pairs.shape[2], 0.0
    for j in range(0, m - 3, 4):
        p, q, r, s = pairs[k, RHO, j], pairs[k, RHO, j + 1], pairs[k, RHO, j + 2], pairs[k, RHO, j + 3]
        a, b, c, d = (p if p < a else a), (q if q < b else b), (r if r < c else c), (s if s < d else d)
        nan += 0.0 * (p + q + r + s)
    for j in range(m - m % 4, m):
        p = pairs[k, RHO, j]
        a = p if p < a else a
        nan += 0.0 * p
    least = nan + min(min(a, b), min(c, d))
    for j in range(m):
        if pairs[k, RHO, j] == least or pairs[k, RHO, j] != pairs[k, RHO, j]:
            return least, j
    return least, 0


@leaf_kernel
def _yield_to_nearer(k: int, slots: int, group: I64, out: Field) -> int:
    """Zero the points of slot k for which another part of its union is nearer; return the union's first near slot."""
    leader, pairs = k, out.pairs
    for l in range(slots):
        if l == k or out.leader[l] < 0 or group[l] != group[k]:
            continue
        leader = min(leader, l)
        for i in range(out.near_count[k]):
            j = out.near[k, i]
            if pairs[l, RHO, j] < pairs[k, RHO, j] or (l < k and pairs[l, RHO, j] == pairs[k, RHO, j]):
                pairs[k, ACCELERATION, j] = 0.0
                pairs[k, FORCE, j] = 0.0
    return leader


@leaf_kernel
def _gather(k: int, link: I64, out: Field) -> int:
    """Add the accelerations of slot k to the shares of its union; return the flags."""
    flags, leader, pairs, rho_num = 0, out.leader[k], out.pairs, out.rooms[k, 2]
    if leader == k:
        for l in range(out.share.shape[1]):
            out.share[k, l] = 0.0
    for i in range(out.near_count[k]):
        j = out.near[k, i]
        if pairs[k, ACCELERATION, j] != 0.0:
            out.share[leader, link[j]] += pairs[k, ACCELERATION, j]
            if pairs[k, RHO, j] <= rho_num:
                flags |= CAPPED if pairs[k, RHO, j] > 0.0 else CAPPED | CONTACT
    return flags


@leaf_kernel
def _add_forces(k: int, link: I64, params: FieldParams, out: Field) -> None:
    """Add the forces of slot k on the points, blended over the points of each link, or plainly."""
    pairs, points, leader = out.pairs, out.points, out.leader[k]
    fx, fy, fz = 0.0, 0.0, 0.0
    blend, whole, floor = int(params.forms) & SUM == 0, int(params.forms) & TASK != 0, 1.0 / params.m_max
    for i in range(out.near_count[k]):
        j = out.near[k, i]
        f = pairs[k, FORCE, j]
        if f == 0.0:
            continue
        if blend:
            f *= pairs[k, ACCELERATION, j] / out.share[leader, link[j]]
        x, y, z = f * pairs[k, NORMAL, j], f * pairs[k, NORMAL + 1, j], f * pairs[k, NORMAL + 2, j]
        if whole:
            x, y, z = times_inertia(points, j, x, y, z, floor)
        fx, fy, fz = fx + x, fy + y, fz + z
        points[_F, j] += x
        points[_F + 1, j] += y
        points[_F + 2, j] += z
    out.force[k, 0], out.force[k, 1], out.force[k, 2] = fx, fy, fz


@leaf_kernel
def _add_torques(Jp: F64, points: F64, tau: F64) -> None:
    """Add sum_j Jp_j^T F_j to tau."""
    for j in range(points.shape[1]):
        x, y, z = points[_F, j], points[_F + 1, j], points[_F + 2, j]
        if x != 0.0 or y != 0.0 or z != 0.0:
            for d in range(tau.shape[0]):
                tau[d] += Jp[j, 0, d] * x + Jp[j, 1, d] * y + Jp[j, 2, d] * z


@leaf_kernel
def _near(radius: F64, obstacles: Obstacles, params: FieldParams, prefilter: bool, out: Field) -> bool:
    """Measure all distances; mark the slots within the widest influence in `leader` (>= 0); return whether any is."""
    room = obstacles.room
    cutoff = widest(room, obstacles.active, params.rho0) + params.look_ahead * speed_bound(obstacles)
    distances_into(out.points, radius, obstacles, cutoff if prefilter else math.inf, out.pairs)
    any_near = False
    for k in range(obstacles.active.shape[0]):
        out.rho_min[k], out.nearest[k], out.leader[k] = math.inf, -1, -1
        out.force[k, 0], out.force[k, 1], out.force[k, 2] = 0.0, 0.0, 0.0
        if obstacles.active[k]:
            out.rho_min[k], out.nearest[k] = _least(out.pairs, k)
            if not out.rho_min[k] >= cutoff:
                out.leader[k], out.near_count[k] = k, _near_points(out.pairs, k, cutoff, out.near)
                put_room(params, room[k, OWN_INFLUENCE], room[k, OWN_CLEARANCE], out.rooms, k)
                any_near = True
    return any_near


@leaf_kernel
def field(
    points: MovingPoints,
    dq: F64,
    qd: F64,
    obstacles: Obstacles,
    params: FieldParams,
    out: Field,
    prefilter: bool,
) -> int:
    """Return `field_to` no posture in particular."""
    nowhere = Ends(points.P[:0], out.share[:0], 0.0, APART, 0.0, out.tau[:0])
    return field_to(points, dq, qd, obstacles, params, out, prefilter, nowhere)


@leaf_kernel
def field_to(
    points: MovingPoints,
    dq: F64,
    qd: F64,
    obstacles: Obstacles,
    params: FieldParams,
    out: Field,
    prefilter: bool,
    ends: Ends,
) -> int:
    """Repulsion of the points from the obstacles; writes all of `out` (Khatib 1986, eq. 18 to 21).

    dq: (n,) [rad] since the points were evaluated; qd: (n,).
    params.forms: without SUM the terms of a link and obstacle are weighted with a_j / sum a_j, so that a link covered
    by many spheres feels one repulsion; with TASK a point's force is its whole Lambda a n, else the least that gives it
    the acceleration a along n. prefilter: False measures every pair exactly, to the same bits.
    ends: influences shrink towards what the points have there, see `_reach`.
    Returns flags CAPPED | CONTACT.
    """
    flags, unions, slots = 0, False, obstacles.active.shape[0]
    for d in range(out.tau.shape[0]):
        out.tau[d] = 0.0
    move_points(points, dq, qd, out.points)
    if not _near(points.radius, obstacles, params, prefilter, out):
        return flags
    _load(points.B, out.points)
    for k in range(slots):
        unions |= out.leader[k] >= 0 and obstacles.group[k] != k
    for k in range(slots):
        if out.leader[k] >= 0:
            _repel(obstacles, k, params, out, ends)
            if unions:
                out.leader[k] = _yield_to_nearer(k, slots, obstacles.group, out)
            flags |= _gather(k, points.link, out)
    for k in range(slots):
        if out.leader[k] >= 0:
            _add_forces(k, points.link, params, out)
    _add_torques(points.Jp, out.points, out.tau)
    return flags

"""The artificial potential field: repulsion of points on every link from obstacles (Khatib 1986).

    f = lambda (a + d) n,    lambda = 1 / (n^T J A^-1 J^T n),    tau_obstacles = sum over points and obstacles of J^T f

with a, d of `firas`, the true distance rho and its unit normal n = d rho/d p. lambda a is the force that gives the
point the acceleration a along n. Below 1/m_max = b0 the mobility b = n^T J A^-1 J^T n gives lambda = b/b0^2, which goes
to zero: a point that hardly moves cannot flee, and the arm is not to be flung about for it. So no pair exceeds
2 m_max a(rho_num). An obstacle that
comes towards a point widens rho0 by its own speed along n times the look-ahead. Its own, not the closing speed: the
arm's motion would otherwise feed back into the zone and break the energy balance that eta comes from.
"""

import math

from rtctl.arm.joint_field import joint_limit_field, own_field
from rtctl.control.firas import (
    CAPPED,
    CONTACT,
    Field,
    FieldParams,
    LimitParams,
    eta_of,
    field_buffers,
    field_params,
    firas,
    limit_params,
    rho_num_of,
)
from rtctl.kernel import ieee_kernel, kernel
from rtctl.types import F64, I64
from rtctl.world.primitives import Obstacles, distances_into, speed_bound

__all__ = [
    "CAPPED",
    "CONTACT",
    "Field",
    "FieldParams",
    "LimitParams",
    "eta_of",
    "field",
    "field_buffers",
    "field_params",
    "joint_limit_field",
    "limit_params",
    "own_field",
    "rho_num_of",
]


# Rows of Field.points and Field.pairs.
_P, _V, _B, _F = 0, 3, 6, 12
_RHO, _N, _A, _PUSH = 0, 1, 4, 5


@kernel
def _load(Jp: F64, B: F64, qd: F64, points: F64) -> None:
    """Fill the rows of point velocities Jp qd and mobilities; zero the forces."""
    for j in range(points.shape[1]):
        for i in range(3):
            s = 0.0
            for d in range(qd.shape[0]):
                s += Jp[j, i, d] * qd[d]
            points[_V + i, j] = s
            points[_B + i, j] = B[j, i, i]
            points[_F + i, j] = 0.0
        points[_B + 3, j], points[_B + 4, j], points[_B + 5, j] = B[j, 0, 1], B[j, 0, 2], B[j, 1, 2]


# error_model: see firas; the divisor here is at least 1/m_max.
@ieee_kernel
def _repel(points: F64, p: F64, v: F64, w: F64, k: int, params: FieldParams, pairs: F64) -> None:
    """Write a and lambda (a + d) of every point against the obstacle in slot k.

    rho_dot = n . (point velocity - surface velocity); the surface point is x = P - rho n, and n . (w x n) = 0.
    """
    rho0, rho_min, rho_num, eta, k_d = params.rho0, params.rho_min, params.rho_num, params.eta, params.k_d
    look_ahead, soft, floor = params.look_ahead, params.v_smooth, 1.0 / params.m_max
    heavy = params.m_max * params.m_max
    px, py, pz, vx, vy, vz, wx, wy, wz = p[k, 0], p[k, 1], p[k, 2], v[k, 0], v[k, 1], v[k, 2], w[k, 0], w[k, 1], w[k, 2]
    for j in range(points.shape[1]):
        x, y, z = pairs[k, _N, j], pairs[k, _N + 1, j], pairs[k, _N + 2, j]
        dx, dy, dz = points[_P, j] - px, points[_P + 1, j] - py, points[_P + 2, j] - pz
        towards = x * (vx + wy * dz - wz * dy) + y * (vy + wz * dx - wx * dz) + z * (vz + wx * dy - wy * dx)
        rho_dot = x * points[_V, j] + y * points[_V + 1, j] + z * points[_V + 2, j] - towards
        wide = 0.0 if towards <= 0.0 else (0.5 * towards * towards / soft if towards < soft else towards - 0.5 * soft)
        a, d = firas(pairs[k, _RHO, j], rho_dot, rho0 + look_ahead * wide, rho_min, rho_num, eta, k_d)
        b = x * x * points[_B, j] + y * y * points[_B + 1, j] + z * z * points[_B + 2, j]
        b += 2.0 * (x * y * points[_B + 3, j] + x * z * points[_B + 4, j] + y * z * points[_B + 5, j])
        pairs[k, _A, j] = a
        pairs[k, _PUSH, j] = (a + d) * (b * heavy if b <= floor else 1.0 / b)


@kernel
def _least(pairs: F64, k: int) -> tuple[float, int]:
    """Return the least distance in slot k and its first point; a NaN wins, so that it is seen."""
    a, b, c, d = math.inf, math.inf, math.inf, math.inf  # four chains: a compare waits for the one before it
    m, nan = pairs.shape[2], 0.0
    for j in range(0, m - 3, 4):
        p, q, r, s = pairs[k, _RHO, j], pairs[k, _RHO, j + 1], pairs[k, _RHO, j + 2], pairs[k, _RHO, j + 3]
        a, b, c, d = (p if p < a else a), (q if q < b else b), (r if r < c else c), (s if s < d else d)
        nan += 0.0 * (p + q + r + s)
    for j in range(m - m % 4, m):
        p = pairs[k, _RHO, j]
        a = p if p < a else a
        nan += 0.0 * p
    least = nan + min(min(a, b), min(c, d))
    for j in range(m):
        if pairs[k, _RHO, j] == least or pairs[k, _RHO, j] != pairs[k, _RHO, j]:
            return least, j
    return least, 0


@kernel
def _yield_to_nearer(k: int, near: I64, group: I64, pairs: F64) -> int:
    """Zero the points of slot k for which another part of its union is nearer; return the union's first near slot."""
    leader = k
    for l in range(near.shape[0]):
        if l == k or near[l] < 0 or group[l] != group[k]:
            continue
        leader = min(leader, l)
        for j in range(pairs.shape[2]):
            if pairs[l, _RHO, j] < pairs[k, _RHO, j] or (l < k and pairs[l, _RHO, j] == pairs[k, _RHO, j]):
                pairs[k, _A, j] = 0.0
                pairs[k, _PUSH, j] = 0.0
    return leader


@kernel
def _gather(k: int, leader: int, link: I64, rho_num: float, pairs: F64, share: F64) -> int:
    """Add the accelerations of slot k to the shares of its union; return the flags."""
    flags = 0
    if leader == k:
        share[k, :] = 0.0
    for j in range(link.shape[0]):
        if pairs[k, _A, j] != 0.0:
            share[leader, link[j]] += pairs[k, _A, j]
            if pairs[k, _RHO, j] <= rho_num:
                flags |= CAPPED if pairs[k, _RHO, j] > 0.0 else CAPPED | CONTACT
    return flags


@kernel
def _add_forces(k: int, link: I64, blend: bool, out: Field) -> None:
    """Add the forces of slot k on the points, blended over the points of each link."""
    pairs, points, leader = out.pairs, out.points, out.leader[k]
    fx, fy, fz = 0.0, 0.0, 0.0
    for j in range(link.shape[0]):
        f = pairs[k, _PUSH, j]
        if f == 0.0:
            continue
        if blend:
            f *= pairs[k, _A, j] / out.share[leader, link[j]]
        x, y, z = f * pairs[k, _N, j], f * pairs[k, _N + 1, j], f * pairs[k, _N + 2, j]
        fx, fy, fz = fx + x, fy + y, fz + z
        points[_F, j] += x
        points[_F + 1, j] += y
        points[_F + 2, j] += z
    out.force[k, 0], out.force[k, 1], out.force[k, 2] = fx, fy, fz


@kernel
def _add_torques(Jp: F64, points: F64, tau: F64) -> None:
    """Add sum_j Jp_j^T F_j to tau."""
    for j in range(points.shape[1]):
        x, y, z = points[_F, j], points[_F + 1, j], points[_F + 2, j]
        if x != 0.0 or y != 0.0 or z != 0.0:
            for d in range(tau.shape[0]):
                tau[d] += Jp[j, 0, d] * x + Jp[j, 1, d] * y + Jp[j, 2, d] * z


@kernel
def _near(P: F64, radius: F64, obstacles: Obstacles, params: FieldParams, prefilter: bool, out: Field) -> bool:
    """Measure all distances; mark the slots within the widest influence in `leader` (>= 0); return whether any is."""
    for j in range(radius.shape[0]):
        for i in range(3):
            out.points[_P + i, j] = P[j, i]
    cutoff = params.rho0 + params.look_ahead * speed_bound(obstacles)
    distances_into(out.points, radius, obstacles, cutoff if prefilter else math.inf, out.pairs)
    any_near = False
    for k in range(obstacles.active.shape[0]):
        out.rho_min[k], out.nearest[k], out.leader[k] = math.inf, -1, -1
        out.force[k, 0], out.force[k, 1], out.force[k, 2] = 0.0, 0.0, 0.0
        if obstacles.active[k]:
            out.rho_min[k], out.nearest[k] = _least(out.pairs, k)
            if not out.rho_min[k] >= cutoff:
                out.leader[k] = k
                any_near = True
    return any_near


@kernel
def field(
    P: F64,
    Jp: F64,
    B: F64,
    qd: F64,
    radius: F64,
    link: I64,
    obstacles: Obstacles,
    params: FieldParams,
    out: Field,
    blend: bool,
    prefilter: bool,
) -> int:
    """Repulsion of the points from the obstacles; writes tau, rho_min, nearest, force, pairs of `out`.

    P: (>= m, 3) [m]; Jp: (>= m, 3, n); B: (m, 3, 3) [1/kg]; qd: (n,); radius: (m,) [m]; link: (m,) in 0..n.
    blend: per link and obstacle the terms are weighted with a_j / sum a_j, so that a link covered by many spheres
    feels one repulsion; False: the paper's plain sum. prefilter: False measures every pair exactly, to the same bits.
    Returns flags CAPPED | CONTACT.
    """
    flags = 0
    out.tau[:] = 0.0
    if not _near(P, radius, obstacles, params, prefilter, out):
        return flags
    _load(Jp, B, qd, out.points)
    slots = obstacles.active.shape[0]
    unions = False
    for k in range(slots):
        unions |= out.leader[k] >= 0 and obstacles.group[k] != k
    for k in range(slots):
        if out.leader[k] >= 0:
            _repel(out.points, obstacles.p, obstacles.v, obstacles.w, k, params, out.pairs)
            if unions:
                out.leader[k] = _yield_to_nearer(k, out.leader, obstacles.group, out.pairs)
            flags |= _gather(k, out.leader[k], link, params.rho_num, out.pairs, out.share)
    for k in range(slots):
        if out.leader[k] >= 0:
            _add_forces(k, link, blend, out)
    _add_torques(Jp, out.points, out.tau)
    return flags

"""Operational-space motion: straight-line speed-limited goals, decoupled by Lambda, posture in the null space.

Khatib 1987 (the operational space formulation) and 1986 (the speed-limited goal field), equation numbers of the
1986 paper where one exists. World axes; tip rows are [linear; angular].
"""

from typing import NamedTuple

import numpy as np

from rtctl.kernel import kernel
from rtctl.kernel.linalg import matmul, matvec, symmetric_eigen, tmatvec
from rtctl.types import F64

SPEED_FLOOR = 0.2  # fraction of qd_max that the null space cannot take from the tip: it never stands still for it


class MotionParams(NamedTuple):
    """Gains and bounds of the motion task."""

    k_p: float  # [1/s2] stiffness of a unit mass
    k_v: float  # [1/s] damping of a unit mass, 2 zeta sqrt(k_p)
    v_max: float  # [m/s]
    a_max: float  # [m/s2] of the commanded velocity
    w_max: float  # [rad/s]
    alpha_max: float  # [rad/s2]
    k_q: float  # [1/s2] posture stiffness
    d_q: float  # [1/s] posture damping, > 0
    qdd_posture: F64  # (n,) [rad/s2] bound of the posture spring: d_q times the speed at which a joint may drift
    epsilon: float  # [1/kg] eigenvalue of J A^-1 J^T below which Lambda is damped
    length: float  # [m] that makes angular rows comparable to linear ones
    speed_margin: float  # fraction of qd_max that the commanded motion may use


class OperationalSpace(NamedTuple):
    """What one parameter evaluation means for the task. Rows of an unconstrained subspace are zero."""

    Lambda: F64  # (6, 6) kinetic energy matrix [kg, kg m, kg m2], damped near singularities
    Jbar: F64  # (n, 6) dynamically consistent inverse A^-1 J^T Lambda
    NT: F64  # (n, n) null-space projector of torques I - J^T Jbar^T
    sigma_min: float  # smallest eigenvalue of the scaled J A^-1 J^T [1/kg]
    damped: bool


@kernel
def damped_reciprocal(s: float, epsilon: float) -> float:
    """Return 1/s, smoothly turned to 0 as s falls from epsilon to 0; at most 2.3/epsilon.

    s / (s^2 + mu^2) with mu = epsilon/4 (1 - (s/epsilon)^2)^2: value, slope and curvature agree with 1/s at
    epsilon, so nothing switches there; the peak is 1/(2 mu) = 2/epsilon at most.
    """
    if s <= 0.0:
        return 0.0
    if s >= epsilon:
        return 1.0 / s
    r = 1.0 - (s / epsilon) ** 2
    mu = 0.25 * epsilon * r * r
    return s / (s * s + mu * mu)


@kernel
def _operational_space(
    J: F64, A_inv: F64, Lambda_inv: F64, S: F64, epsilon: float, length: float
) -> tuple[F64, F64, F64, float, bool]:
    n, m = J.shape[1], S.shape[0]
    scale = np.ones(6)
    for i in range(3, 6):
        scale[i] = length
    G = np.empty((6, 6))
    for i in range(6):
        for j in range(6):
            G[i, j] = scale[i] * Lambda_inv[i, j] * scale[j]
    values, V = symmetric_eigen(matmul(S, matmul(G, S.T.copy())))  # unit rows of S pick exactly
    W = matmul(S.T.copy(), V)  # (6, m) eigenvectors in world axes
    sigma_min = np.inf
    Lambda = np.zeros((6, 6))
    for k in range(m):
        sigma_min = min(sigma_min, values[k])
        f = damped_reciprocal(values[k], epsilon)
        for i in range(6):
            for j in range(6):
                Lambda[i, j] += scale[i] * W[i, k] * f * W[j, k] * scale[j]
    Jbar = matmul(A_inv, matmul(J.T.copy(), Lambda))
    NT = np.zeros((n, n))
    for i in range(n):
        NT[i, i] = 1.0
        for j in range(n):
            for k in range(6):
                NT[i, j] -= J[k, i] * Jbar[j, k]
    return Lambda, Jbar, NT, sigma_min, sigma_min < epsilon


def operational_space(J: F64, A_inv: F64, Lambda_inv: F64, S: F64, p: MotionParams) -> OperationalSpace:
    """Return Lambda = S^T (S J A^-1 J^T S^T)^-1 S with its spectrum damped below `p.epsilon`, and what follows from it.

    J (6, n) tip Jacobian, A_inv (n, n) [1/(kg m2)], Lambda_inv (6, 6) = J A^-1 J^T, S (k, 6) orthonormal rows of
    `task.selection` that do not mix linear with angular axes. What S leaves out belongs to the null space. Damping acts
    on the eigenvalues, so the well-conditioned directions keep their exact inertia.
    """
    return OperationalSpace(*_operational_space(J, A_inv, Lambda_inv, S, p.epsilon, p.length))


@kernel
def approach_speed(d: float, k: float, v_max: float, a_max: float) -> float:
    """Return the speed towards a goal at distance d: min(v_max, k d) with its slope bounded by a_max.

    k = k_p/k_v gives the paper's nu * xd_d (eq. 8); where k d would brake harder than a_max, the braking parabola
    sqrt(2 a_max (d - a_max/(2 k^2))) that touches the line k d at d = a_max/k^2 takes over.
    """
    knee = a_max / (k * k)
    v = k * d if d <= knee else np.sqrt(2.0 * a_max * (d - 0.5 * knee))
    return min(v, v_max)


@kernel
def _towards(ref: F64, target: F64, step: float) -> F64:
    """Return ref moved to target by at most `step` along the straight line between them."""
    diff = target - ref
    size = np.sqrt(diff[0] * diff[0] + diff[1] * diff[1] + diff[2] * diff[2])
    if size <= step:
        return target.copy()
    moved: F64 = ref + diff * (step / size)
    return moved


@kernel
def _desired(e: F64, k: float, v_max: float, a_max: float) -> F64:
    d = np.sqrt(e[0] * e[0] + e[1] * e[1] + e[2] * e[2])
    if d < 1e-12:
        return np.zeros(3)
    v: F64 = e * (approach_speed(d, k, v_max, a_max) / d)
    return v


@kernel
def velocity_reference(
    e: F64,
    e_rot: F64,
    v_ref: F64,
    w_ref: F64,
    Jbar: F64,
    qd_free: F64,
    qd_max: F64,
    k: float,
    v_max: float,
    a_max: float,
    w_max: float,
    alpha_max: float,
    margin: float,
    dt: float,
) -> tuple[F64, F64]:
    """Return the slewed velocity references v_ref (3,) [m/s], w_ref (3,) [rad/s] of this tick.

    e = x_goal - x [m], e_rot the rotation vector to the goal [rad]. The pair is scaled as one so that no joint is asked
    for more than margin * qd_max (qd = Jbar [v; w] + qd_free, the latter (n,) of the null space [rad/s]): near a
    singularity, or while the posture moves, the tip slows; it does not leave its line.
    """
    v = _desired(e, k, v_max, a_max)
    w = _desired(e_rot, k, w_max, alpha_max)
    scale = 1.0
    for i in range(Jbar.shape[0]):
        qd = 0.0
        for j in range(3):
            qd += Jbar[i, j] * v[j] + Jbar[i, 3 + j] * w[j]
        bound = max(margin * qd_max[i] - (qd_free[i] if qd > 0.0 else -qd_free[i]), SPEED_FLOOR * qd_max[i])
        if abs(qd) * scale > bound:
            scale = bound / abs(qd)
    return _towards(v_ref, v * scale, a_max * dt), _towards(w_ref, w * scale, alpha_max * dt)


@kernel
def motion_torque(
    J: F64,
    Jdqd: F64,
    Lambda: F64,
    NT: F64,
    A: F64,
    xd: F64,
    omega: F64,
    v_ref: F64,
    w_ref: F64,
    q: F64,
    qd: F64,
    q_rest: F64,
    k_v: float,
    k_q: float,
    d_q: float,
    qdd_posture: F64,
) -> tuple[F64, F64, F64, F64, F64]:
    """Return (F (6,), tau_drive, tau_brake, tau_rest, tau_damp), the torques (n,) [Nm].

    F*_m = -k_v (xd - nu xd_d);  tau_motion = J^T Lambda (F*_m - Jd qd) = tau_drive + tau_brake
    tau_posture = NT A (k_q (q_rest - q) - d_q qd) = tau_rest + tau_damp

    Each is split into the part that drives (scaled back first when torque runs out) and the part that only
    takes energy out (kept).
    """
    n = q.shape[0]
    drive, brake = np.empty(6), np.empty(6)
    for i in range(3):
        drive[i], drive[3 + i] = k_v * v_ref[i], k_v * w_ref[i]
        brake[i], brake[3 + i] = -k_v * xd[i], -k_v * omega[i]
    spring, damper = np.empty(n), np.empty(n)
    for i in range(n):
        spring[i] = min(max(k_q * (q_rest[i] - q[i]), -qdd_posture[i]), qdd_posture[i])
        damper[i] = -d_q * qd[i]
    tau_drive = tmatvec(J, matvec(Lambda, drive))
    tau_brake = tmatvec(J, matvec(Lambda, brake - Jdqd))
    return drive + brake, tau_drive, tau_brake, matvec(NT, matvec(A, spring)), matvec(NT, matvec(A, damper))

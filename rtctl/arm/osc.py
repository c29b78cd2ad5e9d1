"""Operational-space motion: straight-line speed-limited goals, decoupled by Lambda, posture in the null space.

Khatib 1987 (the operational space formulation) and 1986 (the speed-limited goal field), equation numbers of the
1986 paper where one exists. World axes; tip rows are [linear; angular].
"""

import math
from typing import NamedTuple

import numpy as np

from rtctl.kernel import kernel, leaf_kernel
from rtctl.kernel.linalg import matmul, symmetric_eigen
from rtctl.types import F64

JOINT_RATE = 4.0  # [1/s] of full speed, at which joints that head for a posture change theirs
LEAD_TURN = 1.5  # of w_max, that the tool may turn at then: it is not what is asked for, but what comes of it
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


@leaf_kernel
def approach_speed(d: float, k: float, v_max: float, a_max: float) -> float:
    """Return the speed towards a goal at distance d: min(v_max, k d) with its slope bounded by a_max.

    k = k_p/k_v gives the paper's nu * xd_d (eq. 8); where k d would brake harder than a_max, the braking parabola
    sqrt(2 a_max (d - a_max/(2 k^2))) that touches the line k d at d = a_max/k^2 takes over.
    """
    knee = a_max / (k * k)
    v = k * d if d <= knee else math.sqrt(2.0 * a_max * (d - 0.5 * knee))
    return min(v, v_max)


class Twist(NamedTuple):
    """A velocity of the tip, or a way to go, in world axes."""

    linear: F64  # (3,) [m/s or m]
    angular: F64  # (3,) [rad/s or rad, a rotation vector]


@leaf_kernel
def _speed_per_distance(e: F64, k: float, v_max: float, a_max: float) -> float:
    """Return the wanted speed along e (3,) over its length, 0 for none."""
    d = math.sqrt(e[0] * e[0] + e[1] * e[1] + e[2] * e[2])
    return 0.0 if d < 1e-12 else approach_speed(d, k, v_max, a_max) / d


@leaf_kernel
def _slew(reference: F64, e: F64, speed: float, scale: float, step: float, out: F64) -> None:
    """Write the reference (3,) moved to e speed scale by at most `step` along the straight line between them."""
    dx = e[0] * speed * scale - reference[0]
    dy = e[1] * speed * scale - reference[1]
    dz = e[2] * speed * scale - reference[2]
    size = math.sqrt(dx * dx + dy * dy + dz * dz)
    if size <= step:
        for i in range(3):
            out[i] = e[i] * speed * scale
        return
    f = step / size
    out[0], out[1], out[2] = reference[0] + dx * f, reference[1] + dy * f, reference[2] + dz * f


@leaf_kernel
def velocity_reference(
    error: Twist,
    previous: Twist,
    actual: Twist,
    Jbar: F64,
    qd: F64,
    qd_max: F64,
    p: MotionParams,
    dt: float,
    out: Twist,
) -> None:
    """Write the slewed velocity references of this tick, [m/s] and [rad/s], into `out`.

    error: the way to the goal, x_goal - x [m] and the rotation vector [rad]; previous: the references of the last tick;
    actual: the tip's velocity, of which the joints' velocities qd (n,) leave qd - Jbar [xd; omega] to the null space.
    The pair is scaled as one so that no joint is asked for more than speed_margin * qd_max (n,): near a singularity, or
    while the posture moves, the tip slows; it does not leave its line.
    """
    k = p.k_p / p.k_v
    v, w = (
        _speed_per_distance(error.linear, k, p.v_max, p.a_max),
        _speed_per_distance(error.angular, k, p.w_max, p.alpha_max),
    )
    scale = 1.0
    for i in range(Jbar.shape[0]):
        asked = tip = 0.0
        for j in range(3):
            asked += Jbar[i, j] * (error.linear[j] * v) + Jbar[i, 3 + j] * (error.angular[j] * w)
        for j in range(3):
            tip += Jbar[i, j] * actual.linear[j]
        for j in range(3):
            tip += Jbar[i, 3 + j] * actual.angular[j]
        free = qd[i] - tip
        bound = max(p.speed_margin * qd_max[i] - (free if asked > 0.0 else -free), SPEED_FLOOR * qd_max[i])
        if abs(asked) * scale > bound:
            scale = bound / abs(asked)
    _slew(previous.linear, error.linear, v, scale, p.a_max * dt, out.linear)
    _slew(previous.angular, error.angular, w, scale, p.alpha_max * dt, out.angular)


@leaf_kernel
def joint_reference(J: F64, e: F64, qd_max: F64, p: MotionParams, dt: float, reference: F64) -> None:
    """Move the reference (n,) [rad/s] of joints that head for a posture, e (n,) [rad] away, on by a tick.

    The form of eq. 8 in joint space: straight to it, no joint beyond speed_margin qd_max (n,), nor the tip beyond its
    own speeds; in units of those speeds, where full speed is reached in 1/JOINT_RATE.
    """
    n, away = e.shape[0], 0.0
    for i in range(n):
        away = max(away, abs(e[i]) / (p.speed_margin * qd_max[i]))
    speed = 0.0 if away < 1e-9 else approach_speed(away, p.k_p / p.k_v, 1.0, JOINT_RATE) / away
    linear = angular = 0.0
    for r in range(6):
        s = 0.0
        for i in range(n):
            s += J[r, i] * e[i]
        linear += s * s if r < 3 else 0.0
        angular += s * s if r > 2 else 0.0
    if speed * math.sqrt(linear) > p.v_max:
        speed = p.v_max / math.sqrt(linear)
    if speed * math.sqrt(angular) > LEAD_TURN * p.w_max:
        speed = LEAD_TURN * p.w_max / math.sqrt(angular)
    size = 0.0
    for i in range(n):
        d = (e[i] * speed - reference[i]) / (p.speed_margin * qd_max[i])
        size += d * d
    size, step = math.sqrt(size), JOINT_RATE * dt
    share = step / size if size > step else 1.0
    for i in range(n):
        reference[i] += share * (e[i] * speed - reference[i])


@leaf_kernel
def joint_torque(A: F64, qd: F64, reference: F64, k_v: float, out: F64) -> None:
    """Write the torques A k_v (r - qd) of joints that follow a reference r (n,) [rad/s] into rows of out (4, n)."""
    n = qd.shape[0]
    for i in range(n):
        spring = damper = 0.0
        for j in range(n):
            spring += A[i, j] * (k_v * reference[j])
            damper += A[i, j] * (-k_v * qd[j])
        out[POSTURE_SPRING, i], out[POSTURE_DAMPER, i] = spring, damper


class TaskDynamics(NamedTuple):
    """The inertia that the motion task works on."""

    J: F64  # (6, n) tip Jacobian
    Jdqd: F64  # (6,) its velocity product
    A: F64  # (n, n) joint-space kinetic energy matrix
    Lambda: F64  # (6, 6) of `OperationalSpace`
    NT: F64  # (n, n)


# rows of the torques that `motion_torque` writes, (4, n) [Nm]
TASK_DRIVE, TASK_BRAKE, POSTURE_SPRING, POSTURE_DAMPER = 0, 1, 2, 3


@leaf_kernel
def motion_torque(
    at: TaskDynamics, actual: Twist, reference: Twist, q: F64, qd: F64, q_rest: F64, p: MotionParams, F: F64, out: F64
) -> None:
    """Write F*_m (6,) [m/s2, rad/s2] and the torques (4, n) [Nm] by the rows above (Khatib 1986 eq. 8, 1987).

    F*_m = -k_v (xd - nu xd_d);  tau_motion = J^T Lambda (F*_m - Jd qd) = drive + brake
    tau_posture = NT A (k_q (q_rest - q) - d_q qd) = spring + damper

    Each is split into the part that drives (scaled back first when torque runs out) and the part that only
    takes energy out (kept).
    """
    n = q.shape[0]
    for i in range(3):
        F[i] = p.k_v * reference.linear[i] + -p.k_v * actual.linear[i]
        F[3 + i] = p.k_v * reference.angular[i] + -p.k_v * actual.angular[i]
    for r in range(4):
        for k in range(n):
            out[r, k] = 0.0
    for i in range(6):
        drive = brake = 0.0
        for j in range(3):
            drive += at.Lambda[i, j] * (p.k_v * reference.linear[j])
            brake += at.Lambda[i, j] * (-p.k_v * actual.linear[j] - at.Jdqd[j])
        for j in range(3):
            drive += at.Lambda[i, 3 + j] * (p.k_v * reference.angular[j])
            brake += at.Lambda[i, 3 + j] * (-p.k_v * actual.angular[j] - at.Jdqd[3 + j])
        for k in range(n):
            out[TASK_DRIVE, k] += at.J[i, k] * drive
            out[TASK_BRAKE, k] += at.J[i, k] * brake
    for i in range(n):
        spring = damper = 0.0
        for j in range(n):
            bound = p.qdd_posture[j]
            spring += at.A[i, j] * min(max(p.k_q * (q_rest[j] - q[j]), -bound), bound)
            damper += at.A[i, j] * (-p.d_q * qd[j])
        for k in range(n):
            out[POSTURE_SPRING, k] += at.NT[k, i] * spring
            out[POSTURE_DAMPER, k] += at.NT[k, i] * damper

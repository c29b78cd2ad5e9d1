"""The law: every torque of one tick, from the last parameter evaluation and the state now.

    tau = tau_motion + tau_obstacles + tau_limits + tau_posture + h + g

Sorted for the permitter into what drives towards the goal and what must be kept.
"""

from typing import Any, NamedTuple

import numpy as np
from numba import njit

from rtctl.control.field import CAPPED, Field, FieldParams, LimitParams, field, joint_limit_field, own_field
from rtctl.control.linalg import matvec
from rtctl.control.model import Model
from rtctl.control.osc import MotionParams, OperationalSpace, motion_torque, velocity_reference
from rtctl.control.primitives import Obstacles
from rtctl.control.robot import JOINTS_MAX, Robot
from rtctl.types import F64, I64, Cut, Record

SPEED_BAND = 0.9  # fraction of qd_max that the guard lets joints have
LEAST_SHARE = 0.2  # of tau_max that the field may use however heavy the arm
SPEED_HORIZON = 0.02  # [s] within which it wants a bound kept: ten times what two periods of delay at 1 kHz bear
_CAP, _SPEED, _SINGULAR = (int(c) for c in (Cut.FIELD_CAP, Cut.SPEED, Cut.SINGULAR))


class Law(NamedTuple):
    """The torques [Nm], all (n,), and what the field saw."""

    F: F64  # (6,) [m/s2, rad/s2] F*_m
    v_ref: F64  # (3,) [m/s]
    w_ref: F64  # (3,) [rad/s]
    tau_motion: F64
    tau_posture: F64
    tau_obstacles: F64  # self-collision included
    tau_limits: F64  # of joint position and speed
    drive: F64  # pursues the goal or the posture
    keep: F64  # dissipates, repels, carries
    rho: F64  # (K,) [m] smallest distance of any PSP, inf where there is no obstacle
    force: F64  # (K, 3) [N]
    nearest: I64  # (K,) PSP
    rho_self: float  # [m]
    cut: int  # Cut.FIELD_CAP, Cut.SPEED, Cut.SINGULAR


@njit(cache=True, fastmath=False)
def moved_points(P: F64, Jp: F64, dq: F64) -> F64:
    """Return the PSPs now, P + Jp dq, (r, 3) [m]; dq = q - q of the evaluation.

    Between evaluations the neglected term is half the centripetal acceleration times dt^2: 0.03 mm at 2 rad/s, 250 Hz.
    """
    rows, n = P.shape[0], dq.shape[0]
    X = P.copy()
    for r in range(rows):
        for i in range(3):
            for k in range(n):
                X[r, i] += Jp[r, i, k] * dq[k]
    return X


@njit(cache=True, fastmath=False)
def guard(
    A: F64, A_inv: F64, tau: F64, q: F64, qd: F64, q_min: F64, q_max: F64, qd_max: F64, braking: F64
) -> tuple[F64, bool]:
    """Return the torque (n,) [Nm] that keeps every joint's speed where it can still stop, and whether any acts.

    A velocity damper (Faverjon): qdd_i <= (v_i - qd_i)/T with v_i = min(SPEED_BAND qd_max, sqrt(2 braking (q_max - q)))
    and the same downwards, imposed on qdd = A^-1 tau, `tau` being all torque but gravity and Coriolis. A delta with
    delta the missing acceleration changes the offending joints alone.
    """
    n = qd.shape[0]
    delta = np.zeros(n)
    acts = False
    for i in range(n):
        qdd = 0.0
        for k in range(n):
            qdd += A_inv[i, k] * tau[k]
        up = min(SPEED_BAND * qd_max[i], np.sqrt(2.0 * braking[i] * max(0.0, q_max[i] - q[i])))
        down = min(SPEED_BAND * qd_max[i], np.sqrt(2.0 * braking[i] * max(0.0, q[i] - q_min[i])))
        high, low = (up - qd[i]) / SPEED_HORIZON, (-down - qd[i]) / SPEED_HORIZON
        if qdd > high or qdd < low:
            acts = True
            delta[i] = high - qdd if qdd > high else low - qdd
    return matvec(A, delta), acts


@njit(cache=True, fastmath=False)
def tip_guard(J: F64, Jdqd: F64, A_inv: F64, tau: F64, xd: F64, v_max: float, floor: float) -> tuple[F64, bool]:
    """Return the torque (n,) [Nm] that keeps the tip's speed below v_max [m/s], and whether it acts.

    Along u = xd/|xd| the acceleration u^T (J A^-1 tau + Jd qd) may be (v_max - |xd|)/T at most; the excess is taken off
    by a force along u with the effective mass there, 1/max(u^T J A^-1 J^T u, floor). The motion task never asks for
    more than v_max; a field that shoves the arm may.
    """
    n = tau.shape[0]
    guard_tau = np.zeros(n)
    speed = np.sqrt(xd[0] * xd[0] + xd[1] * xd[1] + xd[2] * xd[2])
    if speed < 0.5 * v_max:
        return guard_tau, False
    row = (J[0] * xd[0] + J[1] * xd[1] + J[2] * xd[2]) / speed
    accel = (Jdqd[0] * xd[0] + Jdqd[1] * xd[1] + Jdqd[2] * xd[2]) / speed
    mobility = 0.0
    for i in range(n):
        for k in range(n):
            accel += row[i] * A_inv[i, k] * tau[k]
            mobility += row[i] * A_inv[i, k] * row[k]
    excess = accel - (v_max - speed) / SPEED_HORIZON
    if excess <= 0.0:
        return guard_tau, False
    for i in range(n):
        guard_tau[i] = -excess / max(mobility, floor) * row[i]
    return guard_tau, True


@njit(cache=True, fastmath=False)
def bounded(tau: F64, load: F64, tau_max: F64) -> F64:
    """Return tau (n,) [Nm] scaled as one to what every joint has left beside its load (n,), at least LEAST_SHARE.

    A field that asks for more than the motors have must lose strength, not direction: clamped joint by joint it would
    push somewhere else.
    """
    scale = 1.0
    for i in range(tau.shape[0]):
        room = max(tau_max[i] - abs(load[i]), LEAST_SHARE * tau_max[i])
        if abs(tau[i]) * scale > room:
            scale = room / abs(tau[i])
    return tau * scale


@njit(cache=True, fastmath=False)
def opposed(tau: F64, others: F64, tau_max: F64) -> F64:
    """Return tau (n,) [Nm] scaled as one to what every joint has left in its direction beside all others (n,).

    Braking that opposes a field may use the field's torque as well as the motor's: measured against the load alone, as
    `bounded` does, it could stop a field that pushes at its bound but not what the field has set in motion.
    """
    scale = 1.0
    for i in range(tau.shape[0]):
        ahead = others[i] if tau[i] > 0.0 else -others[i]
        room = max(tau_max[i] - ahead, LEAST_SHARE * tau_max[i])
        if abs(tau[i]) * scale > room:
            scale = room / abs(tau[i])
    return tau * scale


@njit(cache=True, fastmath=False)
def diagonal(A: F64) -> F64:
    """Return the diagonal (n,) of a matrix (n, n)."""
    out = np.empty(A.shape[0])
    for i in range(A.shape[0]):
        out[i] = A[i, i]
    return out


def evaluate_law(
    robot: Robot,
    model: Model,
    space: OperationalSpace,
    obstacles: Obstacles,
    q: F64,
    qd: F64,
    xd: F64,
    omega: F64,
    e: F64,
    e_rot: F64,
    v_ref: F64,
    w_ref: F64,
    q_rest: F64,
    pace: float,
) -> Law:
    """Return the torques that take the tip along e (3,) [m] and e_rot (3,) [rad], and off whatever is near.

    q, qd (n,) now; xd, omega (3,) the tip's velocity; v_ref, w_ref (3,) the references of the previous tick;
    q_rest (n,) the posture; pace: the fraction of qd_max that joints may have. e = e_rot = 0 with nonzero references
    brakes along the path.
    """
    task, torques, rho, force, nearest, rho_own, cut = _evaluate(
        robot.constants, robot.points.radius, robot.points.link, robot.scratch,
        model, space, obstacles, q, qd, xd, omega, e, e_rot, v_ref, w_ref, q_rest, pace,
    )  # fmt: skip
    motion, posture, field_torque, limits, drive, keep = torques
    return Law(
        task[:6], task[6:9], task[9:], motion, posture, field_torque, limits, drive, keep,
        rho, force, nearest, rho_own, cut,
    )  # fmt: skip


def prepared(robot: Robot) -> Robot:
    """Return the robot with the constants of the law as one record: numba takes one array in a tenth of the time.

    Arrays over joints are padded to JOINTS_MAX: one layout, whatever the arm. numba names compiled code by a number
    that it gives each record type in each process, so that of two layouts from its cache one would run as the other.
    Whoever replaces a gain or bound of a robot prepares it anew.
    """
    groups: dict[str, Any] = {
        "motion": robot.motion,
        "avoid": robot.avoid,
        "own": robot.self_avoid,
        "limit": robot.limit,
    }
    values = {f"{group}_{k}": v for group, params in groups.items() for k, v in params._asdict().items()}
    values |= {k: getattr(robot, k) for k in ("q_min", "q_max", "qd_max", "tau_max", "braking", "dt")}
    constants = np.zeros(1, [(k, np.float64, (JOINTS_MAX,) * np.ndim(v)) for k, v in values.items()])
    for k, v in values.items():
        if np.ndim(v):
            constants[k][0, : robot.n] = v
        else:
            constants[k] = v
    return robot._replace(constants=constants)


@njit(cache=True, fastmath=False)
def _params(c: Any, n: int) -> tuple[MotionParams, FieldParams, FieldParams, LimitParams]:
    """Return the parameters that `prepared` put into the record c."""
    return (
        MotionParams(
            c.motion_k_p, c.motion_k_v, c.motion_v_max, c.motion_a_max, c.motion_w_max, c.motion_alpha_max,
            c.motion_k_q, c.motion_d_q, c.motion_qdd_posture[:n].copy(), c.motion_epsilon, c.motion_length,
            c.motion_speed_margin,
        ),
        FieldParams(
            c.avoid_rho0, c.avoid_rho_min, c.avoid_rho_num, c.avoid_eta, c.avoid_k_d, c.avoid_look_ahead,
            c.avoid_v_smooth, c.avoid_m_max,
        ),
        FieldParams(
            c.own_rho0, c.own_rho_min, c.own_rho_num, c.own_eta, c.own_k_d, c.own_look_ahead, c.own_v_smooth,
            c.own_m_max,
        ),
        LimitParams(
            c.limit_rho0[:n].copy(), c.limit_rho_min[:n].copy(), c.limit_rho_num[:n].copy(), c.limit_eta[:n].copy(),
            c.limit_k_d[:n].copy(),
        ),
    )  # fmt: skip


@njit(cache=True, fastmath=False)
def _evaluate(
    constants: Record, radius: F64, link: I64, seen: Field,
    model: Model, space: OperationalSpace, obstacles: Obstacles, q: F64, qd: F64, xd: F64, omega: F64,
    e: F64, e_rot: F64, v_ref: F64, w_ref: F64, q_rest: F64, pace: float,
) -> tuple[F64, F64, F64, F64, I64, float, int]:  # fmt: skip
    """Return F, v_ref and w_ref in a row (12,), the torques of `Law` (6, n), and its other fields.

    One compiled call with few results: crossing the border costs as much as a term, and a tenth of that per array.
    """
    c, n = constants[0], q.shape[0]
    p, avoid, self_avoid, limit = _params(c, n)
    q_min, q_max, tau_max, braking = c.q_min[:n].copy(), c.q_max[:n].copy(), c.tau_max[:n].copy(), c.braking[:n].copy()
    qd_max, dt = pace * c.qd_max[:n], c.dt
    qd_free = qd - matvec(space.Jbar, np.concatenate((xd, omega)))
    v, w = velocity_reference(
        e, e_rot, v_ref, w_ref, space.Jbar, qd_free, qd_max, p.k_p / p.k_v, p.v_max, p.a_max, p.w_max, p.alpha_max,
        p.speed_margin, dt,
    )  # fmt: skip
    F, tau_drive, tau_brake, tau_rest, tau_damp = motion_torque(
        model.J, model.Jdqd, space.Lambda, space.NT, model.A, xd, omega, v, w, q, qd, q_rest,
        p.k_v, p.k_q, p.d_q, p.qdd_posture,
    )  # fmt: skip
    dq = q - model.q
    X = moved_points(model.P, model.Jp, dq)
    flags = field(X, model.Jp, model.B, qd, radius, link, obstacles, avoid, seen, True, True)
    tau_own, rho_own, own_flags = own_field(model.own_rho, model.own_row, dq, qd, model.A_inv, self_avoid)
    tau_limits = np.empty(q.shape[0])
    joint_limit_field(q, qd, q_min, q_max, diagonal(model.A), limit, tau_limits)
    load = model.g + model.h
    tau_obstacles = bounded(seen.tau + tau_own, load, tau_max)
    tau_limits = bounded(tau_limits, load, tau_max)
    drive, keep = tau_drive + tau_rest, tau_brake + tau_damp + tau_obstacles + tau_limits
    tau_tip, hasty = tip_guard(model.J, model.Jdqd, model.A_inv, drive + keep, xd, p.v_max, p.epsilon)
    tau_tip = bounded(tau_tip, load, tau_max)
    keep = keep + tau_tip
    tau_guard, fast = guard(model.A, model.A_inv, drive + keep, q, qd, q_min, q_max, qd_max, braking)
    tau_guard = opposed(tau_guard, load + drive + keep, tau_max)
    cut = _CAP if (flags | own_flags) & CAPPED else 0
    cut |= _SPEED if fast or hasty else 0
    cut |= _SINGULAR if space.damped else 0
    torques = np.empty((6, q.shape[0]))
    torques[0], torques[1] = tau_drive + tau_brake, tau_rest + tau_damp
    torques[2], torques[3] = tau_obstacles, tau_limits + tau_tip + tau_guard
    torques[4], torques[5] = drive, load + keep + tau_guard
    task = np.concatenate((F, v, w))
    return task, torques, seen.rho_min.copy(), seen.force.copy(), seen.nearest.copy(), rho_own, cut

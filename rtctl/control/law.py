"""The law: every torque of one tick, from the last parameter evaluation and the state now.

    tau = tau_motion + tau_obstacles + tau_limits + tau_posture + h + g

Sorted for the permitter into what drives towards the goal and what must be kept.
"""

from typing import Any, NamedTuple

import numpy as np
from numba import njit

from rtctl.control.field import CAPPED, Field, FieldParams, LimitParams, field, joint_limit_field, own_field
from rtctl.control.guards import approach_rows, fitting, guarded, joint_bounds, tip_row, yielding
from rtctl.control.linalg import matvec
from rtctl.control.model import Model
from rtctl.control.osc import MotionParams, OperationalSpace, motion_torque, velocity_reference
from rtctl.control.primitives import Obstacles
from rtctl.control.robot import JOINTS_MAX, Robot
from rtctl.types import F64, I64, Cut, Record

_CAP, _SPEED, _SINGULAR = (int(c) for c in (Cut.FIELD_CAP, Cut.SPEED, Cut.SINGULAR))
_SCALED = int(Cut.MOTION_SCALED)


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
    cut: int  # Cut.FIELD_CAP, Cut.SPEED, Cut.SINGULAR, Cut.MOTION_SCALED


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
    values |= {k: getattr(robot, k) for k in ("q_min", "q_max", "qd_max", "tau_max", "tau_rate", "braking", "dt")}
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
    tau_rate, qd_max, dt = c.tau_rate[:n].copy(), pace * c.qd_max[:n], c.dt
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
    tau_obstacles = seen.tau + tau_own
    tau_obstacles *= fitting(tau_obstacles, load, tau_max)
    tau_limits *= fitting(tau_limits, load, tau_max)
    drive, keep = tau_drive + tau_rest, tau_brake + tau_damp + tau_obstacles + tau_limits
    share = yielding(drive, load + keep, tau_max)  # before the guards: they judge what will be sent
    drive = share * drive
    low, high = joint_bounds(model.A, q, qd, q_min, q_max, qd_max, braking, tau_rate)
    near, near_bounds = approach_rows(
        seen.leader, link, seen.pairs, model.Jp, model.own_rho, model.own_row, dq, model.A_inv, qd, avoid.rho0,
        self_avoid.rho_min, p.a_max, tau_rate,
    )  # fmt: skip
    rows, bounds = np.empty((near.shape[0] + 1, q.shape[0])), np.empty(near.shape[0] + 1)
    rows[0], bounds[0] = tip_row(model.J, model.Jdqd, model.A_inv, xd, p.v_max, tau_rate)
    rows[1:], bounds[1:] = near, near_bounds
    net, guards = guarded(model.A, model.A_inv, drive + keep, load, tau_max, low, high, rows, bounds)
    tau_guard = net - drive - keep
    cut = _CAP if (flags | own_flags) & CAPPED else 0
    cut |= _SPEED if guards else 0
    cut |= _SINGULAR if space.damped else 0
    cut |= _SCALED if share < 1.0 else 0
    torques = np.empty((6, q.shape[0]))
    torques[0], torques[1] = share * tau_drive + tau_brake, share * tau_rest + tau_damp
    torques[2], torques[3] = tau_obstacles, tau_limits + tau_guard
    torques[4], torques[5] = drive, load + keep + tau_guard
    task = np.concatenate((F, v, w))
    return task, torques, seen.rho_min.copy(), seen.force.copy(), seen.nearest.copy(), rho_own, cut

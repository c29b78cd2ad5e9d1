"""The law: every torque of one tick, from the last parameter evaluation and the state now.

    tau = tau_motion + tau_obstacles + tau_limits + tau_posture + h + g

Sorted for the permitter into what drives towards the goal and what must be kept.
"""

from typing import Any, NamedTuple

import numpy as np

from rtctl.arm.escape import STALL
from rtctl.arm.field import CAPPED, Field, FieldParams, LimitParams, field, joint_limit_field, own_field
from rtctl.arm.flat import field_in, field_sizes
from rtctl.arm.guards import approach_rows, fitting, guarded, joint_bounds, tip_row, yielding
from rtctl.arm.model import Model
from rtctl.arm.osc import MotionParams, OperationalSpace, motion_torque, velocity_reference
from rtctl.arm.robot import JOINTS_MAX, Arm, Robot
from rtctl.kernel import kernel
from rtctl.kernel.linalg import matvec
from rtctl.types import F64, I32, I64, Cut, Record
from rtctl.world.primitives import Obstacles

_CAP, _SPEED, _SINGULAR = (int(c) for c in (Cut.FIELD_CAP, Cut.SPEED, Cut.SINGULAR))
_SCALED = int(Cut.MOTION_SCALED)


REVIEW = 0.5  # [s] between two diagnoses of an arm that rests
_BARE = (  # of Robot
    "q_min", "q_max", "qd_max", "tau_max", "tau_rate", "tau_lsb", "braking", "viscous", "q_rest", "dt", "model_dt",
    "carry", "escape",
)  # fmt: skip

# rows of Law.torques, (7, n) [Nm]; the first five as the record has them
MOTION = 0
OBSTACLES = 1  # self-collision included
LIMITS = 2  # of joint position and speed
POSTURE = 3
LOAD = 4  # h + g
DRIVE = 5  # pursues the goal or the posture
KEEP = 6  # dissipates, repels, carries


class Law(NamedTuple):
    """The torques [Nm], and what the field saw."""

    task: F64  # (12,) F, v_ref, w_ref below
    torques: F64  # (7, n) [Nm] the rows above
    seen: F64  # (4 K,) rho, then force, below
    nearest: I32  # (K,) PSP
    rho_self: float  # [m]
    cut: int  # Cut.FIELD_CAP, Cut.SPEED, Cut.SINGULAR, Cut.MOTION_SCALED

    def row(self, i: int) -> F64:
        """Return a row (n,) [Nm] of the torques."""
        row: F64 = self.torques[i]
        return row

    @property
    def F(self) -> F64:
        """F*_m (6,) [m/s2, rad/s2]."""
        return self.task[:6]

    @property
    def v_ref(self) -> F64:
        """(3,) [m/s] of this tick."""
        return self.task[6:9]

    @property
    def w_ref(self) -> F64:
        """(3,) [rad/s] of this tick."""
        return self.task[9:]

    @property
    def rho(self) -> F64:
        """(K,) [m] smallest distance of any PSP, inf where there is no obstacle."""
        return self.seen[: self.nearest.shape[0]]

    @property
    def force(self) -> F64:
        """(K, 3) [N] on the arm."""
        return self.seen[self.nearest.shape[0] :].reshape(-1, 3)

    @property
    def tau_motion(self) -> F64:
        """(n,) [Nm], as are the rows that follow."""
        return self.row(MOTION)

    @property
    def tau_posture(self) -> F64:
        """Row POSTURE."""
        return self.row(POSTURE)

    @property
    def tau_obstacles(self) -> F64:
        """Row OBSTACLES."""
        return self.row(OBSTACLES)

    @property
    def tau_limits(self) -> F64:
        """Row LIMITS."""
        return self.row(LIMITS)

    @property
    def drive(self) -> F64:
        """Row DRIVE."""
        return self.row(DRIVE)

    @property
    def keep(self) -> F64:
        """Row KEEP."""
        return self.row(KEEP)


@kernel
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


@kernel
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
    return Law(*_evaluate(
        robot.constants, robot.points.radius, robot.points.link, robot.scratch,
        model, space, obstacles, q, qd, xd, omega, e, e_rot, v_ref, w_ref, q_rest, pace,
    ))  # fmt: skip


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
        "estimator": robot.estimator,
        "joint": robot.joint_filter,
        "safety": robot.safety,
        "stop": robot.stop,
    }
    values = {f"{group}_{k}": v for group, params in groups.items() for k, v in params._asdict().items()}
    values |= {k: getattr(robot, k) for k in _BARE}
    values |= {
        "axes": int(robot.axes),
        "escape_ticks": round(STALL / robot.dt),
        "review_ticks": round(REVIEW / robot.dt),
    }
    constants = np.zeros(
        1, np.dtype((np.record, [(k, np.float64, (JOINTS_MAX,) * np.ndim(v)) for k, v in values.items()]))
    )
    for k, v in values.items():
        if np.ndim(v):
            constants[k][0, : robot.n] = v
        else:
            constants[k] = v
    m = len(robot.points.radius)
    reals, wholes = field_sizes(robot.slots, m, robot.n)
    work = np.zeros(reals), np.zeros(wholes, np.int64)
    arm = Arm(constants, robot.points.radius, robot.points.link, *work)
    return robot._replace(constants=constants, arm=arm, scratch=field_in(*work, robot.n, m))


@kernel
def motion_params(c: Any) -> MotionParams:
    """Return the parameters of the motion task in the record c; what it has of joints is padded."""
    return MotionParams(
        c.motion_k_p, c.motion_k_v, c.motion_v_max, c.motion_a_max, c.motion_w_max, c.motion_alpha_max, c.motion_k_q,
        c.motion_d_q, c.motion_qdd_posture, c.motion_epsilon, c.motion_length, c.motion_speed_margin,
    )  # fmt: skip


@kernel
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


@kernel
def _evaluate(
    constants: Record, radius: F64, link: I64, seen: Field,
    model: Model, space: OperationalSpace, obstacles: Obstacles, q: F64, qd: F64, xd: F64, omega: F64,
    e: F64, e_rot: F64, v_ref: F64, w_ref: F64, q_rest: F64, pace: float,
) -> tuple[F64, F64, F64, I32, float, int]:  # fmt: skip
    """Return the fields of `Law`.

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
        self_avoid.rho_min, p.v_max, p.a_max, tau_rate,
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
    torques = np.empty((7, n))
    torques[MOTION], torques[POSTURE] = share * tau_drive + tau_brake, share * tau_rest + tau_damp
    torques[OBSTACLES], torques[LIMITS], torques[LOAD] = tau_obstacles, tau_limits + tau_guard, load
    torques[DRIVE], torques[KEEP] = drive, load + keep + tau_guard
    task = np.concatenate((F, v, w))
    seen_by = np.concatenate((seen.rho_min, seen.force.copy().reshape(-1)))
    return task, torques, seen_by, seen.nearest.astype(np.int32), rho_own, cut

"""The constants of the law as one record, and its readers: what a robot's config says, as compiled code takes it.

numba takes one array in a tenth of the time of many.
"""

from typing import NamedTuple

import numpy as np

from rtctl.arm.bounds import ApproachParams, MotionLimits
from rtctl.arm.escape import STALL
from rtctl.arm.field import FieldParams, LimitParams
from rtctl.arm.osc import MotionParams
from rtctl.arm.robot import JOINTS_MAX, Robot
from rtctl.kernel import kernel, leaf_kernel
from rtctl.types import F64, Record, RecordRow

REVIEW = 0.5  # [s] between two diagnoses of an arm that rests
_BARE = (  # of Robot
    "q_min", "q_max", "qd_max", "tau_max", "tau_rate", "tau_lsb", "braking", "viscous", "q_rest", "dt", "model_dt",
    "carry", "escape", "payload_max", "friction_max", "noticeable", "tolerance", "tolerance_rot", "coulomb",
    "viscous_told", "collision", "collision_hard", "brakeless",
)  # fmt: skip


def constants_of(robot: Robot) -> Record:
    """Return the record of a robot's constants, an array of one.

    Arrays over joints are padded to JOINTS_MAX: one layout, whatever the arm. numba names compiled code by a number
    that it gives each record type in each process, so that of two layouts from its cache one would run as the other.
    """
    groups: dict[str, NamedTuple] = {
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
    return constants


@kernel
def motion_params(c: RecordRow) -> MotionParams:
    """Return the parameters of the motion task in the record c; what it has of joints is padded."""
    return MotionParams(
        c.motion_k_p,
        c.motion_k_v,
        c.motion_v_max,
        c.motion_a_max,
        c.motion_w_max,
        c.motion_alpha_max,
        c.motion_k_q,
        c.motion_d_q,
        c.motion_qdd_posture,
        c.motion_epsilon,
        c.motion_length,
        c.motion_speed_margin,
    )


class Params(NamedTuple):
    """The parameters of the law."""

    motion: MotionParams
    avoid: FieldParams
    self_collision: FieldParams
    limit: LimitParams
    dt: float


@leaf_kernel
def params_of(c: RecordRow, n: int) -> Params:
    """Return the parameters of n joints in the record c."""
    return Params(
        MotionParams(
            c.motion_k_p,
            c.motion_k_v,
            c.motion_v_max,
            c.motion_a_max,
            c.motion_w_max,
            c.motion_alpha_max,
            c.motion_k_q,
            c.motion_d_q,
            c.motion_qdd_posture[:n],
            c.motion_epsilon,
            c.motion_length,
            c.motion_speed_margin,
        ),
        FieldParams(
            c.avoid_rho0,
            c.avoid_rho_min,
            c.avoid_rho_num,
            c.avoid_eta,
            c.avoid_k_d,
            c.avoid_look_ahead,
            c.avoid_v_smooth,
            c.avoid_m_max,
            c.avoid_forms,
            c.avoid_v_max,
            c.avoid_damping_ratio,
            c.avoid_dt,
            c.avoid_added,
            c.avoid_overhang,
        ),
        FieldParams(
            c.own_rho0,
            c.own_rho_min,
            c.own_rho_num,
            c.own_eta,
            c.own_k_d,
            c.own_look_ahead,
            c.own_v_smooth,
            c.own_m_max,
            c.own_forms,
            c.own_v_max,
            c.own_damping_ratio,
            c.own_dt,
            c.own_added,
            c.own_overhang,
        ),
        LimitParams(
            c.limit_rho0[:n],
            c.limit_rho_min[:n],
            c.limit_rho_num[:n],
            c.limit_eta[:n],
            c.limit_k_d[:n],
        ),
        c.dt,
    )


@leaf_kernel
def motion_limits(c: RecordRow, n: int, speed_scale: float, qd_max: F64) -> MotionLimits:
    """Return the limits of n joints in the record c; qd_max (n,) is where the speeds of this tick are put."""
    for i in range(n):
        qd_max[i] = speed_scale * c.qd_max[i]
    return MotionLimits(c.q_min[:n], c.q_max[:n], qd_max, c.braking[:n], c.tau_max[:n], c.tau_rate[:n])


@leaf_kernel
def approach_params(c: RecordRow) -> ApproachParams:
    return ApproachParams(c.avoid_rho0, c.own_rho_min, c.motion_v_max, c.motion_a_max)

"""The filters' noise and steady states, found once when a robot is built."""

import math

import numpy as np

from rtctl.arm.estimator import Covariance, Design, EstimatorParams, JointParams, correct, matrix, propagate
from rtctl.kernel import kernel
from rtctl.types import F64

CYCLES = 20_000  # at most; a servo's filters repeat within some hundreds
UNCHANGED = 1e-10  # relative change of a covariance in one cycle that counts as none


def tip_params(J: F64, P: F64, sigma_a: float, sigma_alpha: float) -> EstimatorParams:
    """Return the tip filter's noise from the joint filters' covariance, the worst axis i of sum_k J_ik^2 var_k.

    J: (6, n) at a typical configuration, such as home. P: (n, 2, 2) from `design_joint`. sigma_a [m/s2]: what F* does
    not explain of the tip's acceleration; sigma_alpha [rad/s2].
    """
    variance = [[sum(J[i, k] ** 2 * P[k, d, d] for k in range(len(P))) for i in range(6)] for d in range(2)]
    worst = [[math.sqrt(max(row[:3])), math.sqrt(max(row[3:]))] for row in variance]
    return EstimatorParams(sigma_a, sigma_alpha, worst[1][0], worst[1][1], worst[0][0], worst[0][1])


def design(params: EstimatorParams, dt: float, ratio: int, age: float) -> Design:
    """Return the tip filter's steady state, found by running the filter until it repeats.

    dt [s]: servo period, a velocity update each. ratio: servo periods per pose update. age [s] of a pose.
    """
    Q, P, velocity, pose = _steady(params.sigma_a, params.r_v, params.r_x, dt, ratio, age, True)
    Q_rot, P_rot, velocity_rot, pose_rot = _steady(
        params.sigma_alpha, params.r_omega, params.r_rot, dt, ratio, age, True
    )
    return Design(Q, Q_rot, P, P_rot, velocity, velocity_rot, pose, pose_rot)


def design_joint(params: JointParams, dt: float, age: float) -> F64:
    """Return the joint filters' steady covariance (n, 2, 2), found by running the filter until it repeats.

    dt [s]: servo period. age [s] of a reply when it is used: one period.
    """
    rows = zip(params.sigma_qdd, params.r_q, params.r_qd, strict=True)
    return np.array([_steady(s, r_qd, r_q, dt, 1, age, params.has_qd)[1] for s, r_q, r_qd in rows]).reshape(-1, 2, 2)


def _steady(
    sigma: float, r_v: float, r_x: float, dt: float, ratio: int, age: float, has_velocity: bool
) -> tuple[F64, F64, F64, F64]:
    """Return Q, P and the two gains of one axis once a cycle of updates leaves its covariance as it was."""
    Q = np.array([[0.25 * dt**4, 0.5 * dt**3], [0.5 * dt**3, dt**2]]) * (sigma * sigma)
    P, gain_velocity, gain_pose = _repeat(sigma, r_v, r_x, dt, ratio, age, has_velocity)
    # Rounded: what remains of the first cycles must not tell by which path the steady state was reached.
    return Q, _round(P), _round(gain_velocity), _round(gain_pose)


@kernel
def _repeats(before: float, now: float) -> bool:
    return abs(now - before) <= UNCHANGED * abs(before)


@kernel
def _repeat(
    sigma: float, r_v: float, r_x: float, dt: float, ratio: int, age: float, has_velocity: bool
) -> tuple[F64, F64, F64]:
    """Return covariance (2, 2) and gains (2,), (2,) after cycles of `ratio` steps that change it no more."""
    P = Covariance(r_x * r_x, 0.0, 0.0, r_v * r_v)
    gain_velocity, gain_pose = np.zeros(2), np.zeros(2)
    for _ in range(CYCLES):
        before = P
        for _ in range(ratio):
            P = propagate(P, dt, sigma)
            if has_velocity:
                _, gain_velocity[0], gain_velocity[1], P = correct(P, 0.0, 1.0, r_v)
        _, gain_pose[0], gain_pose[1], P = correct(P, 1.0, -age, r_x)
        if _repeats(before.xx, P.xx) and _repeats(before.xv, P.xv) and _repeats(before.vv, P.vv):
            break
    return matrix(P), gain_velocity, gain_pose


def _round(values: F64) -> F64:
    """Return values to nine significant digits."""
    return np.array([float(f"{v:.8e}") for v in values.flat]).reshape(values.shape)

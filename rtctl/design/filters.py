"""The filters' noise and steady states, found once when a robot is built."""

import math
from typing import NamedTuple

import numpy as np

from rtctl.arm.estimator import Covariance, Design, EstimatorParams, JointParams, correct, matrix, propagate
from rtctl.kernel import kernel
from rtctl.types import F64

SLOW = 3e-3  # [s] a servo period beyond it is long: what nobody knew of since a reply is no longer lost in its noise
CYCLES = 20_000  # at most; a servo's filters repeat within some hundreds
UNCHANGED = 1e-10  # relative change of a covariance in one cycle that counts as none


def tip_params(J: F64, P: F64, sigma_a: float, sigma_alpha: float, late: F64 | None = None) -> EstimatorParams:
    """Return the tip filter's noise from the joint filters' covariance, the worst axis i of sum_k J_ik^2 var_k.

    J: (6, n) at a typical configuration, such as home. P: (n, 2, 2) from `design_joint`, measured: what is not known of
    the newest accelerations is in the tip's own prediction, too. sigma_a [m/s2]: what F* does not explain of the tip's
    acceleration; sigma_alpha [rad/s2]. late: (n,) [rad], see `lateness`; by default none.
    """
    variance = [[sum(J[i, k] ** 2 * P[k, d, d] for k in range(len(P))) for i in range(6)] for d in range(2)]
    worst = [[math.sqrt(max(row[:3])), math.sqrt(max(row[3:]))] for row in variance]
    far = (J * J) @ (np.zeros(len(P)) if late is None else late * late)
    late_x, late_rot = math.sqrt(far[:3].max()), math.sqrt(far[3:].max())
    return EstimatorParams(sigma_a, sigma_alpha, worst[1][0], worst[1][1], worst[0][0], worst[0][1], late_x, late_rot)


def lateness(params: JointParams, dt: float, model_dt: float) -> F64:
    """Return how far (n,) [rad] joints may be from where the tip has been carried, when its pose is evaluated.

    An acceleration that nobody knew of is seen a servo period dt [s] late. For all of a model period the tip is carried
    by a speed that lacks it, and then the joints' positions jump by what it did. Joints that a reply corrects as they
    are now have it in their own noise.
    """
    late: F64 = params.sigma_qdd * dt * (model_dt + 0.5 * dt) if params.as_then else np.zeros_like(params.sigma_qdd)
    return late


def design(params: EstimatorParams, dt: float, ratio: int, age: float) -> Design:
    """Return the tip filter's steady state, found by running the filter until it repeats.

    dt [s]: servo period, a velocity update each. ratio: servo periods per pose update. age [s] of a pose.
    """
    Q, P, velocity, pose = _steady(params.sigma_a, params.r_v, params.r_x, dt, ratio, age)
    Q_rot, P_rot, velocity_rot, pose_rot = _steady(params.sigma_alpha, params.r_omega, params.r_rot, dt, ratio, age)
    return Design(Q, Q_rot, P, P_rot, velocity, velocity_rot, pose, pose_rot)


class JointDesign(NamedTuple):
    """The joint filters' steady covariances, each (n, 2, 2) of (q, qd)."""

    measured: F64  # at the instant that a reply tells of
    now: F64  # when it is used: what a filter may start from


def design_joint(params: JointParams, dt: float, age: float) -> JointDesign:
    """Return the joint filters' steady state, found by running them until they repeat.

    dt [s]: servo period. age [s] of a reply when it is used: one period.
    """
    rows = zip(params.sigma_qdd, params.r_q, params.r_qd, strict=True)
    since = min(age, dt) if params.as_then else 0.0
    found = [_repeat_joint(*row, dt, age, since, params.has_qd) for row in rows]
    measured, now = ([_round(each[k]) for each in found] for k in range(2))
    return JointDesign(np.array(measured).reshape(-1, 2, 2), np.array(now).reshape(-1, 2, 2))


def _steady(sigma: float, r_v: float, r_x: float, dt: float, ratio: int, age: float) -> tuple[F64, F64, F64, F64]:
    """Return Q, P and the two gains of one axis once a cycle of updates leaves its covariance as it was."""
    Q = np.array([[0.25 * dt**4, 0.5 * dt**3], [0.5 * dt**3, dt**2]]) * (sigma * sigma)
    P, gain_velocity, gain_pose = _repeat(sigma, r_v, r_x, dt, ratio, age)
    # Rounded: what remains of the first cycles must not tell by which path the steady state was reached.
    return Q, _round(P), _round(gain_velocity), _round(gain_pose)


@kernel
def _repeats(before: float, now: float) -> bool:
    return abs(now - before) <= UNCHANGED * abs(before)


@kernel
def _repeat(sigma: float, r_v: float, r_x: float, dt: float, ratio: int, age: float) -> tuple[F64, F64, F64]:
    """Return covariance (2, 2) and gains (2,), (2,) after cycles of `ratio` steps that change it no more."""
    P = Covariance(r_x * r_x, 0.0, 0.0, r_v * r_v)
    gain_velocity, gain_pose = np.zeros(2), np.zeros(2)
    for _ in range(CYCLES):
        before = P
        for _ in range(ratio):
            P = propagate(P, dt, sigma)
            _, gain_velocity[0], gain_velocity[1], P = correct(P, 0.0, 1.0, r_v)
        _, gain_pose[0], gain_pose[1], P = correct(P, 1.0, -age, r_x)
        if _repeats(before.xx, P.xx) and _repeats(before.xv, P.xv) and _repeats(before.vv, P.vv):
            break
    return matrix(P), gain_velocity, gain_pose


@kernel
def _repeat_joint(
    sigma: float, r_q: float, r_qd: float, dt: float, age: float, since: float, has_qd: bool
) -> tuple[F64, F64]:
    """Return the covariances (2, 2) of a joint when it is measured and when that is used, once they change no more."""
    now = Covariance(r_q * r_q, 0.0, 0.0, r_qd * r_qd)
    P = now
    for _ in range(CYCLES):
        before = now
        _, _, _, P = correct(propagate(now, dt - since, sigma), 1.0, since - age, r_q)
        if has_qd:
            _, _, _, P = correct(P, 0.0, 1.0, r_qd)
        now = propagate(P, since, sigma)
        if _repeats(before.xx, now.xx) and _repeats(before.xv, now.xv) and _repeats(before.vv, now.vv):
            break
    return matrix(P), matrix(now)


def _round(values: F64) -> F64:
    """Return values to nine significant digits."""
    return np.array([float(f"{v:.8e}") for v in values.flat]).reshape(values.shape)

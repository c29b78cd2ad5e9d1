"""Estimators that carry the state between measurements: the tip's pose and velocity, and each joint's.

Every axis is the unit mass that the law's decoupling promises: state (x, xd), input the commanded acceleration F*,
process noise what the model does not know of it, held constant over a step. One 2 x 2 covariance serves all axes
that share their noise. Their steady states are found when a robot is designed; filterpy is the oracle of both in
the tests. Pure: an estimate goes in and a new one comes out; a NaN goes through and is the caller's to find.
"""

import math
from typing import NamedTuple

import numpy as np

from rtctl.kernel import kernel
from rtctl.kernel.linalg import matvec
from rtctl.kernel.rotations import compose, error, exp3, orthonormal
from rtctl.types import B1, F64, I64


class EstimatorParams(NamedTuple):
    """Standard deviations of the tip filter, per axis."""

    sigma_a: float  # [m/s2] acceleration that F* does not explain
    sigma_alpha: float  # [rad/s2]
    r_v: float  # [m/s] of xd = J qd
    r_omega: float  # [rad/s]
    r_x: float  # [m] of x = fk(q)
    r_rot: float  # [rad]
    late_x: float = 0.0  # [m] by which x may come late: no noise to the filter, and no surprise; see `tip_params`
    late_rot: float = 0.0  # [rad]


class TipEstimate(NamedTuple):
    """The tip at one instant, and how sure the filter is of it."""

    x: F64  # (3,) [m]
    xd: F64  # (3,) [m/s]
    P: F64  # (2, 2) covariance of (x, xd), the same for each axis
    R: F64  # (3, 3)
    omega: F64  # (3,) [rad/s] in the world frame
    P_rot: F64  # (2, 2) covariance of (rotation error, omega)


class Design(NamedTuple):
    """The tip filter in its steady state; gains act on (x, xd) or (rotation, omega)."""

    Q: F64  # (2, 2) process noise of one step
    Q_rot: F64  # (2, 2)
    P: F64  # (2, 2) after a pose update: what a filter may start from
    P_rot: F64  # (2, 2)
    gain_velocity: F64  # (2,) just before that pose update
    gain_velocity_rot: F64  # (2,)
    gain_pose: F64  # (2,)
    gain_pose_rot: F64  # (2,)


class JointParams(NamedTuple):
    """Noise of the joint filters."""

    sigma_qdd: F64  # (n,) [rad/s2] acceleration that the input does not explain
    r_q: F64  # (n,) [rad] standard deviation of a measured position: LSB / sqrt(12) of the encoder
    r_qd: F64  # (n,) [rad/s] of a measured velocity
    has_qd: bool  # the drive reports a velocity worth using
    as_then: bool = False  # a reply corrects the joint as it was when it was measured, not as it is a period later


class JointEstimate(NamedTuple):
    """Every joint at one instant."""

    q: F64  # (n,) [rad]
    qd: F64  # (n,) [rad/s]
    P: F64  # (n, 2, 2) covariance of (q, qd)


def start(x: F64, R: F64, design: Design) -> TipEstimate:
    """Return the estimate of a tip at rest, as sure as the filter will be in its steady state."""
    return TipEstimate(x.copy(), np.zeros(3), design.P.copy(), R.copy(), np.zeros(3), design.P_rot.copy())


def joint_start(q: F64, P: F64) -> JointEstimate:
    """Return the estimate of joints at rest; P: (n, 2, 2), from `design_joint`."""
    return JointEstimate(q.copy(), np.zeros_like(q), P.copy())


class Covariance(NamedTuple):
    """A covariance (2, 2) of (x, xd), in numbers: kernels make no array of it."""

    xx: float
    xv: float
    vx: float
    vv: float


@kernel
def covariance(P: F64) -> Covariance:
    """Return a covariance (2, 2) in numbers."""
    return Covariance(P[0, 0], P[0, 1], P[1, 0], P[1, 1])


@kernel
def matrix(P: Covariance) -> F64:
    """Return a covariance as an array (2, 2)."""
    out = np.empty((2, 2))
    out[0, 0], out[0, 1], out[1, 0], out[1, 1] = P.xx, P.xv, P.vx, P.vv
    return out


@kernel
def propagate(P: Covariance, dt: float, sigma: float) -> Covariance:
    """Return F P F^T + Q for F = [1 dt; 0 1] and an acceleration of deviation sigma, constant over the step."""
    q = sigma * sigma * dt * dt
    p01 = P.xv + dt * P.vv
    off = p01 + 0.5 * dt * q
    return Covariance(P.xx + dt * (P.xv + p01) + 0.25 * dt * dt * q, off, off, P.vv + q)


@kernel
def correct(P: Covariance, h0: float, h1: float, r: float) -> tuple[float, float, float, Covariance]:
    """Return S, the gains and the covariance after a scalar measurement h0 x + h1 xd of deviation r (Joseph form)."""
    g0 = P.xx * h0 + P.xv * h1
    g1 = P.vx * h0 + P.vv * h1
    S = h0 * g0 + h1 * g1 + r * r
    k0, k1 = g0 / S, g1 / S
    m00, m01, m10, m11 = 1.0 - k0 * h0, -k0 * h1, -k1 * h0, 1.0 - k1 * h1  # I - K H
    a00, a01 = m00 * P.xx + m01 * P.vx, m00 * P.xv + m01 * P.vv
    a10, a11 = m10 * P.xx + m11 * P.vx, m10 * P.xv + m11 * P.vv
    off = a00 * m10 + a01 * m11 + k0 * k1 * r * r
    return (
        S,
        k0,
        k1,
        Covariance(a00 * m00 + a01 * m01 + k0 * k0 * r * r, off, off, a10 * m10 + a11 * m11 + k1 * k1 * r * r),
    )


@kernel
def predict(est: TipEstimate, a: F64, alpha: F64, dt: float, params: EstimatorParams) -> TipEstimate:
    """Return the estimate dt later: x += xd dt + a dt^2/2, xd += a dt, R <- exp(omega dt + alpha dt^2/2) R.

    a: (3,) [m/s2] and alpha: (3,) [rad/s2], the commanded F*. dt [s].
    """
    x, xd, omega, turn = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for i in range(3):
        x[i] = est.x[i] + dt * (est.xd[i] + 0.5 * dt * a[i])
        xd[i] = est.xd[i] + dt * a[i]
        turn[i] = dt * (est.omega[i] + 0.5 * dt * alpha[i])
        omega[i] = est.omega[i] + dt * alpha[i]
    R = orthonormal(compose(exp3(turn), est.R))
    P = matrix(propagate(covariance(est.P), dt, params.sigma_a))
    return TipEstimate(x, xd, P, R, omega, matrix(propagate(covariance(est.P_rot), dt, params.sigma_alpha)))


@kernel
def predict_by_model(est: TipEstimate, J: F64, Jdqd: F64, qdd: F64, dt: float, params: EstimatorParams) -> TipEstimate:
    """Return the estimate dt [s] later, by the acceleration J qdd + Jdqd; J (6, n), Jdqd (6,), qdd (n,) [rad/s2]."""
    a = matvec(J, qdd) + Jdqd
    return predict(est, a[:3], a[3:], dt, params)


@kernel
def update_velocity(est: TipEstimate, xd: F64, omega: F64, params: EstimatorParams) -> tuple[TipEstimate, float]:
    """Return the estimate after a measured twist J qd, and its normalised innovation.

    The innovation is root mean square over the six axes in standard deviations: about 1 when the noise is as stated.
    xd: (3,) [m/s]. omega: (3,) [rad/s].
    """
    S, k0, k1, P = correct(covariance(est.P), 0.0, 1.0, params.r_v)
    S_rot, l0, l1, P_rot = correct(covariance(est.P_rot), 0.0, 1.0, params.r_omega)
    x1, xd1, omega1, turn = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    total = 0.0
    for i in range(3):
        y, y_rot = xd[i] - est.xd[i], omega[i] - est.omega[i]
        x1[i], xd1[i] = est.x[i] + k0 * y, est.xd[i] + k1 * y
        turn[i], omega1[i] = l0 * y_rot, est.omega[i] + l1 * y_rot
        total += y * y / S + y_rot * y_rot / S_rot
    R = orthonormal(compose(exp3(turn), est.R))
    return TipEstimate(x1, xd1, matrix(P), R, omega1, matrix(P_rot)), math.sqrt(total / 6.0)


@kernel
def update_pose(est: TipEstimate, x: F64, R: F64, age: float, params: EstimatorParams) -> tuple[TipEstimate, float]:
    """Return the estimate after a pose fk(q) measured `age` [s] ago, and its normalised innovation.

    The measurement is of x - age xd, so that its age is neither a bias nor false certainty. x: (3,) [m]. R: (3, 3).
    """
    S, k0, k1, P = correct(covariance(est.P), 1.0, -age, params.r_x)
    S_rot, l0, l1, P_rot = correct(covariance(est.P_rot), 1.0, -age, params.r_rot)
    x1, xd1, omega1, turn = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for i in range(3):
        turn[i] = -age * est.omega[i]
    y_rot = error(compose(exp3(turn), est.R), R)
    late, late_rot, total = params.late_x * params.late_x, params.late_rot * params.late_rot, 0.0
    for i in range(3):
        y = x[i] - (est.x[i] - age * est.xd[i])
        x1[i], xd1[i] = est.x[i] + k0 * y, est.xd[i] + k1 * y
        turn[i], omega1[i] = l0 * y_rot[i], est.omega[i] + l1 * y_rot[i]
        total += y * y / (S + late) + y_rot[i] * y_rot[i] / (S_rot + late_rot)
    turned = orthonormal(compose(exp3(turn), est.R))
    return TipEstimate(x1, xd1, matrix(P), turned, omega1, matrix(P_rot)), math.sqrt(total / 6.0)


@kernel
def _moved_on(
    q: float, qd: float, P: Covariance, qdd: float, dt: float, sigma: float
) -> tuple[float, float, Covariance]:
    """Return position, speed and their covariance dt [s] later; qdd [rad/s2] but for what has deviation sigma."""
    return q + dt * (qd + 0.5 * dt * qdd), qd + dt * qdd, propagate(P, dt, sigma)


@kernel
def joint_step(
    est: JointEstimate, qdd: F64, q: F64, qd: F64, age: F64, replies: I64 | B1, dt: float, params: JointParams
) -> tuple[JointEstimate, F64]:
    """Return the joints dt later, corrected by what the drives measured `age` ago, and normalised innovations (n,).

    qdd: (n,) [rad/s2] acceleration the model expects, zero when unknown. q, qd: (n,) measured. age: (n,) [s].
    replies: (n,) measurements that this cycle brought of each joint; those without coast, with innovation 0.

    As it was then: an acceleration that is not known has not acted on what was measured before it. Were it taken to
    have, a position that is ahead would say that the joint was braked since, and turn the filter the wrong way: within
    the encoder's noise at 1 kHz, and all there is at 100 Hz. See `design.filters.SLOW`.
    """
    n = q.shape[0]
    q1, qd1, P, innovation = np.empty(n), np.empty(n), np.empty((n, 2, 2)), np.zeros(n)
    for i in range(n):
        sigma = params.sigma_qdd[i]
        since = min(age[i], dt) if params.as_then and replies[i] > 0 else 0.0  # of the step, after the measurement
        t = age[i] - since  # and that much older it is than where the step has come to
        position, speed, C = _moved_on(est.q[i], est.qd[i], covariance(est.P[i]), qdd[i], dt - since, sigma)
        if replies[i] > 0:
            y = q[i] - (position - t * speed + 0.5 * t * t * qdd[i])
            S, k0, k1, C = correct(C, 1.0, -t, params.r_q[i])
            position, speed = position + k0 * y, speed + k1 * y
            innovation[i] = abs(y) / math.sqrt(S)
            if params.has_qd:
                y = qd[i] - (speed - t * qdd[i])
                S, k0, k1, C = correct(C, 0.0, 1.0, params.r_qd[i])
                position, speed = position + k0 * y, speed + k1 * y
                innovation[i] = max(innovation[i], abs(y) / math.sqrt(S))
            if since > 0.0:
                position, speed, C = _moved_on(position, speed, C, qdd[i], since, sigma)
        q1[i], qd1[i] = position, speed
        P[i, 0, 0], P[i, 0, 1], P[i, 1, 0], P[i, 1, 1] = C.xx, C.xv, C.vx, C.vv
    return JointEstimate(q1, qd1, P), innovation

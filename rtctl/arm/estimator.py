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


class JointEstimate(NamedTuple):
    """Every joint at one instant."""

    q: F64  # (n,) [rad]
    qd: F64  # (n,) [rad/s]
    P: F64  # (n, 2, 2) covariance of (q, qd)


def start(x: F64, R: F64, design: Design) -> TipEstimate:
    """Return the estimate of a tip at rest, as sure as the filter will be in its steady state."""
    return TipEstimate(x.copy(), np.zeros(3), design.P.copy(), R.copy(), np.zeros(3), design.P_rot.copy())


def predict(est: TipEstimate, a: F64, alpha: F64, dt: float, params: EstimatorParams) -> TipEstimate:
    """Return the estimate dt later: x += xd dt + a dt^2/2, xd += a dt, R <- exp(omega dt + alpha dt^2/2) R.

    a: (3,) [m/s2] and alpha: (3,) [rad/s2], the commanded F*. dt [s].
    """
    return TipEstimate(*_predict(*est, a, alpha, dt, params.sigma_a, params.sigma_alpha))


def update_velocity(est: TipEstimate, xd: F64, omega: F64, params: EstimatorParams) -> tuple[TipEstimate, float]:
    """Return the estimate after a measured twist J qd, and its normalised innovation.

    The innovation is root mean square over the six axes in standard deviations: about 1 when the noise is as stated.
    xd: (3,) [m/s]. omega: (3,) [rad/s].
    """
    *fields, innovation = _update_velocity(*est, xd, omega, params.r_v, params.r_omega)
    return TipEstimate(*fields), innovation


def update_pose(est: TipEstimate, x: F64, R: F64, age: float, params: EstimatorParams) -> tuple[TipEstimate, float]:
    """Return the estimate after a pose fk(q) measured `age` [s] ago, and its normalised innovation.

    The measurement is of x - age xd, so that its age is neither a bias nor false certainty. x: (3,) [m]. R: (3, 3).
    """
    *fields, innovation = _update_pose(*est, x, R, age, params.r_x, params.r_rot)
    return TipEstimate(*fields), innovation


def joint_start(q: F64, P: F64) -> JointEstimate:
    """Return the estimate of joints at rest; P: (n, 2, 2), from `design_joint`."""
    return JointEstimate(q.copy(), np.zeros_like(q), P.copy())


def joint_step(
    est: JointEstimate, qdd: F64, q: F64, qd: F64, age: F64, replies: I64 | B1, dt: float, params: JointParams
) -> tuple[JointEstimate, F64]:
    """Return the joints dt later, corrected by what the drives measured `age` ago, and normalised innovations (n,).

    qdd: (n,) [rad/s2] acceleration the model expects, zero when unknown. q, qd: (n,) measured. age: (n,) [s].
    replies: (n,) measurements that this cycle brought of each joint; those without coast, with innovation 0.
    """
    noise = (params.sigma_qdd, params.r_q, params.r_qd)
    *fields, innovation = filter_joints(*est, qdd, q, qd, age, replies, dt, *noise, params.has_qd)
    return JointEstimate(*fields), innovation


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
def _predict(
    x: F64,
    xd: F64,
    P: F64,
    R: F64,
    omega: F64,
    P_rot: F64,
    a: F64,
    alpha: F64,
    dt: float,
    sigma_a: float,
    sigma_alpha: float,
) -> tuple[F64, F64, F64, F64, F64, F64]:
    x1, xd1, omega1, turn = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for i in range(3):
        x1[i] = x[i] + dt * (xd[i] + 0.5 * dt * a[i])
        xd1[i] = xd[i] + dt * a[i]
        turn[i] = dt * (omega[i] + 0.5 * dt * alpha[i])
        omega1[i] = omega[i] + dt * alpha[i]
    R1 = orthonormal(compose(exp3(turn), R))
    P1 = matrix(propagate(covariance(P), dt, sigma_a))
    return x1, xd1, P1, R1, omega1, matrix(propagate(covariance(P_rot), dt, sigma_alpha))


@kernel
def _update_velocity(
    x: F64,
    xd: F64,
    P: F64,
    R: F64,
    omega: F64,
    P_rot: F64,
    xd_measured: F64,
    omega_measured: F64,
    r_v: float,
    r_omega: float,
) -> tuple[F64, F64, F64, F64, F64, F64, float]:
    S, k0, k1, P1 = correct(covariance(P), 0.0, 1.0, r_v)
    S_rot, l0, l1, P_rot1 = correct(covariance(P_rot), 0.0, 1.0, r_omega)
    x1, xd1, omega1, turn = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    total = 0.0
    for i in range(3):
        y, y_rot = xd_measured[i] - xd[i], omega_measured[i] - omega[i]
        x1[i], xd1[i] = x[i] + k0 * y, xd[i] + k1 * y
        turn[i], omega1[i] = l0 * y_rot, omega[i] + l1 * y_rot
        total += y * y / S + y_rot * y_rot / S_rot
    R1 = orthonormal(compose(exp3(turn), R))
    return x1, xd1, matrix(P1), R1, omega1, matrix(P_rot1), math.sqrt(total / 6.0)


@kernel
def _update_pose(
    x: F64,
    xd: F64,
    P: F64,
    R: F64,
    omega: F64,
    P_rot: F64,
    x_measured: F64,
    R_measured: F64,
    age: float,
    r_x: float,
    r_rot: float,
) -> tuple[F64, F64, F64, F64, F64, F64, float]:
    S, k0, k1, P1 = correct(covariance(P), 1.0, -age, r_x)
    S_rot, l0, l1, P_rot1 = correct(covariance(P_rot), 1.0, -age, r_rot)
    x1, xd1, omega1, turn = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for i in range(3):
        turn[i] = -age * omega[i]
    y_rot = error(compose(exp3(turn), R), R_measured)
    total = 0.0
    for i in range(3):
        y = x_measured[i] - (x[i] - age * xd[i])
        x1[i], xd1[i] = x[i] + k0 * y, xd[i] + k1 * y
        turn[i], omega1[i] = l0 * y_rot[i], omega[i] + l1 * y_rot[i]
        total += y * y / S + y_rot[i] * y_rot[i] / S_rot
    R1 = orthonormal(compose(exp3(turn), R))
    return x1, xd1, matrix(P1), R1, omega1, matrix(P_rot1), math.sqrt(total / 6.0)


@kernel
def filter_joints(
    q: F64,
    qd: F64,
    P: F64,
    qdd: F64,
    q_measured: F64,
    qd_measured: F64,
    age: F64,
    replies: I64 | B1,
    dt: float,
    sigma_qdd: F64,
    r_q: F64,
    r_qd: F64,
    has_qd: bool,
) -> tuple[F64, F64, F64, F64]:
    n = q.shape[0]
    q1, qd1, P1, innovation = np.empty(n), np.empty(n), np.empty((n, 2, 2)), np.zeros(n)
    for i in range(n):
        position = q[i] + dt * (qd[i] + 0.5 * dt * qdd[i])
        speed = qd[i] + dt * qdd[i]
        C = propagate(Covariance(P[i, 0, 0], P[i, 0, 1], P[i, 1, 0], P[i, 1, 1]), dt, sigma_qdd[i])
        if replies[i] > 0:
            t = age[i]
            y = q_measured[i] - (position - t * speed + 0.5 * t * t * qdd[i])
            S, k0, k1, C = correct(C, 1.0, -t, r_q[i])
            position, speed = position + k0 * y, speed + k1 * y
            innovation[i] = abs(y) / math.sqrt(S)
            if has_qd:
                y = qd_measured[i] - (speed - t * qdd[i])
                S, k0, k1, C = correct(C, 0.0, 1.0, r_qd[i])
                position, speed = position + k0 * y, speed + k1 * y
                innovation[i] = max(innovation[i], abs(y) / math.sqrt(S))
        q1[i], qd1[i] = position, speed
        P1[i, 0, 0], P1[i, 0, 1], P1[i, 1, 0], P1[i, 1, 1] = C.xx, C.xv, C.vx, C.vv
    return q1, qd1, P1, innovation


@kernel
def predict_tip(
    x: F64, xd: F64, P: F64, R: F64, omega: F64, P_rot: F64, J: F64, Jdqd: F64, qdd: F64, dt: float, p: EstimatorParams
) -> tuple[F64, F64, F64, F64, F64, F64]:
    """Return the fields of a TipEstimate dt [s] later, by the acceleration J qdd + Jdqd."""
    a = matvec(J, qdd) + Jdqd
    return _predict(x, xd, P, R, omega, P_rot, a[:3], a[3:], dt, p.sigma_a, p.sigma_alpha)


@kernel
def correct_by_twist(
    x: F64, xd: F64, P: F64, R: F64, omega: F64, P_rot: F64, twist: F64, p: EstimatorParams
) -> tuple[F64, F64, F64, F64, F64, F64, float]:
    """Return the fields of a TipEstimate after `update_velocity` with a twist (6,), and its innovation."""
    return _update_velocity(x, xd, P, R, omega, P_rot, twist[:3], twist[3:], p.r_v, p.r_omega)


@kernel
def correct_by_pose(
    x: F64, xd: F64, P: F64, R: F64, omega: F64, P_rot: F64, x_measured: F64, R_measured: F64, p: EstimatorParams
) -> tuple[F64, F64, F64, F64, F64, F64, float]:
    """Return the fields of a TipEstimate after `update_pose` with a pose of this instant, and its innovation."""
    return _update_pose(x, xd, P, R, omega, P_rot, x_measured, R_measured, 0.0, p.r_x, p.r_rot)

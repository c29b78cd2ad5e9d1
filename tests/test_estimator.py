"""The filters, against filterpy step by step, and against trajectories that are known exactly."""

import hashlib
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from filterpy.common import Q_discrete_white_noise
from filterpy.kalman import KalmanFilter
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from rtctl.arm.estimator import (
    Design,
    EstimatorParams,
    JointEstimate,
    JointParams,
    TipEstimate,
    joint_start,
    joint_step,
    predict,
    start,
    update_pose,
    update_velocity,
)
from rtctl.design.filters import design, design_joint, lateness, tip_params
from rtctl.types import F64
from tests.lab import robot

ROOT = Path(__file__).resolve().parent.parent
DT, RATIO = 1e-3, 4
PARAMS = EstimatorParams(sigma_a=5.0, sigma_alpha=20.0, r_v=5e-3, r_omega=1e-2, r_x=3e-4, r_rot=5e-4)
DESIGN = design(PARAMS, DT, RATIO, 0.0)
LSB_Q, LSB_QD = 25.0 / 65535, 90.0 / 4095  # of a 16 and a 12 bit field
ZERO = np.zeros(3)


def joint_params(n: int, has_qd: bool, sigma: float = 20.0, as_then: bool = False) -> JointParams:
    return JointParams(np.full(n, sigma), np.full(n, LSB_Q / 12**0.5), np.full(n, LSB_QD / 12**0.5), has_qd, as_then)


def axis_filter(x: float, xd: float, P: F64) -> KalmanFilter:
    kf = KalmanFilter(dim_x=2, dim_z=1, dim_u=1)
    kf.x, kf.P = np.array([[x], [xd]]), P.copy()
    return kf


def step(kf: KalmanFilter, a: float, dt: float, sigma: float) -> None:
    kf.predict(
        u=np.array([[a]]),
        B=np.array([[0.5 * dt * dt], [dt]]),
        F=np.array([[1.0, dt], [0.0, 1.0]]),
        Q=Q_discrete_white_noise(2, dt, sigma * sigma),
    )


def measure(kf: KalmanFilter, z: float, h: tuple[float, float], r: float) -> float:
    """Update; return the innovation in standard deviations."""
    kf.update(z, R=r * r, H=np.array([h]))
    return float(kf.y[0, 0] / np.sqrt(kf.S[0, 0]))


def steady(sigma: float, r_v: float, r_x: float, ratio: int, age: float) -> tuple[F64, F64, F64]:
    """Return covariance and gains of filterpy's filter once a cycle of updates leaves them as they were."""
    kf = axis_filter(0.0, 0.0, np.diag([r_x * r_x, r_v * r_v]))
    gain_velocity = np.zeros(2)
    for _ in range(20_000):
        before = kf.P.copy()
        for _ in range(ratio):
            step(kf, 0.0, DT, sigma)
            measure(kf, 0.0, (0.0, 1.0), r_v)
            gain_velocity = kf.K[:, 0].copy()
        measure(kf, 0.0, (1.0, -age), r_x)
        if np.allclose(kf.P, before, rtol=1e-10, atol=0.0):
            break
    return kf.P, gain_velocity, kf.K[:, 0]


@pytest.mark.parametrize("age", [0.0, 2e-3])
def test_the_tips_steady_state_is_filterpys(age: float) -> None:
    d, p = design(PARAMS, DT, RATIO, age), PARAMS
    for mine, theirs in zip(
        (d.P, d.gain_velocity, d.gain_pose), steady(p.sigma_a, p.r_v, p.r_x, RATIO, age), strict=True
    ):
        assert_allclose(mine, theirs, rtol=1e-8)
    for mine, theirs in zip(
        (d.P_rot, d.gain_velocity_rot, d.gain_pose_rot),
        steady(p.sigma_alpha, p.r_omega, p.r_rot, RATIO, age),
        strict=True,
    ):
        assert_allclose(mine, theirs, rtol=1e-8)
    assert (Q_discrete_white_noise(2, DT, p.sigma_a**2) == d.Q).all()


@pytest.mark.parametrize("has_qd", [True, False])
def test_a_joints_steady_covariance_is_filterpys(has_qd: bool) -> None:
    for dt, age, as_then in ((DT, DT, False), (1e-2, 1e-2, True), (1e-2, 6e-3, True)):
        p = joint_params(1, has_qd, as_then=as_then)
        since = age if as_then else 0.0  # measured within a step, which goes on after it
        kf = axis_filter(0.0, 0.0, np.diag([p.r_q[0] ** 2, p.r_qd[0] ** 2]))
        for _ in range(3_000):
            step(kf, 0.0, dt - since, p.sigma_qdd[0])
            measure(kf, 0.0, (1.0, since - age), p.r_q[0])
            if has_qd:
                measure(kf, 0.0, (0.0, 1.0), p.r_qd[0])
            measured = kf.P.copy()
            step(kf, 0.0, since, p.sigma_qdd[0])
        found = design_joint(p, dt, age)
        assert_allclose(found.measured[0], measured, rtol=1e-7)
        assert_allclose(found.now[0], kf.P, rtol=1e-7)


def test_each_axis_of_the_tip_is_filterpys_filter_step_by_step() -> None:
    rng = np.random.default_rng(0)
    P = np.array([[1e-4, 2e-5], [2e-5, 1e-2]])
    est = TipEstimate(rng.normal(size=3), rng.normal(size=3), P, np.eye(3), ZERO, P)
    axes = [axis_filter(est.x[i], est.xd[i], P) for i in range(3)]
    for k in range(800):
        dt, a = DT * rng.integers(1, 4), rng.normal(scale=10.0, size=3)
        est = predict(est, a, ZERO, dt, PARAMS)
        for i, kf in enumerate(axes):
            step(kf, a[i], dt, PARAMS.sigma_a)
        xd = est.xd + rng.normal(scale=PARAMS.r_v, size=3)
        est, normalised = update_velocity(est, xd, ZERO, PARAMS)
        nu = [measure(kf, xd[i], (0.0, 1.0), PARAMS.r_v) for i, kf in enumerate(axes)]
        assert normalised == pytest.approx(np.sqrt(np.square(nu).sum() / 6.0), abs=1e-9)  # no rotation: its three are 0
        if k % RATIO == 0:
            age, x = rng.uniform(0.0, 5e-3), est.x + rng.normal(scale=PARAMS.r_x, size=3)
            est, normalised = update_pose(est, x, np.eye(3), age, PARAMS)
            nu = [measure(kf, x[i], (1.0, -age), PARAMS.r_x) for i, kf in enumerate(axes)]
            assert normalised == pytest.approx(np.sqrt(np.square(nu).sum() / 6.0), abs=1e-9)
        for i, kf in enumerate(axes):
            assert_allclose([est.x[i], est.xd[i]], kf.x[:, 0], rtol=1e-9, atol=1e-9)
            assert_allclose(est.P, kf.P, rtol=1e-9, atol=1e-15)


def test_turning_about_one_axis_is_filterpys_filter_step_by_step() -> None:
    rng = np.random.default_rng(1)
    axis = np.array([2.0, -1.0, 2.0]) / 3.0
    P = np.array([[1e-4, 1e-5], [1e-5, 1e-2]])
    est = TipEstimate(ZERO, ZERO, P, np.eye(3), 0.3 * axis, P)
    kf = axis_filter(0.0, 0.3, P)
    for k in range(800):
        alpha = rng.normal(scale=5.0)
        est = predict(est, ZERO, alpha * axis, DT, PARAMS)
        step(kf, alpha, DT, PARAMS.sigma_alpha)
        rate = kf.x[1, 0] + rng.normal(scale=PARAMS.r_omega)
        est, normalised = update_velocity(est, est.xd, rate * axis, PARAMS)
        assert normalised == pytest.approx(abs(measure(kf, rate, (0.0, 1.0), PARAMS.r_omega)) / 6**0.5, abs=1e-9)
        if k % RATIO == 0:
            age, angle = rng.uniform(0.0, 5e-3), kf.x[0, 0] + rng.normal(scale=PARAMS.r_rot)
            R = Rotation.from_rotvec(angle * axis).as_matrix()
            est, normalised = update_pose(est, est.x - age * est.xd, R, age, PARAMS)
            assert normalised == pytest.approx(abs(measure(kf, angle, (1.0, -age), PARAMS.r_rot)) / 6**0.5, abs=1e-8)
        assert_allclose(est.R, Rotation.from_rotvec(kf.x[0, 0] * axis).as_matrix(), rtol=0.0, atol=1e-9)
        assert est.omega == pytest.approx(kf.x[1, 0] * axis, abs=1e-9)
        assert_allclose(est.P_rot, kf.P, rtol=1e-9, atol=1e-15)


def test_the_design_is_where_the_compiled_filter_settles() -> None:
    P0 = np.diag([1.0, 1.0])
    still = TipEstimate(ZERO, ZERO, np.zeros((2, 2)), np.eye(3), ZERO, np.zeros((2, 2)))
    after = predict(still, ZERO, ZERO, DT, PARAMS)
    assert_allclose(after.P, DESIGN.Q, rtol=1e-12)
    assert_allclose(after.P_rot, DESIGN.Q_rot, rtol=1e-12)
    est = still._replace(P=P0, P_rot=P0)
    for _ in range(3000):
        for k in range(RATIO):
            est = predict(est, ZERO, ZERO, DT, PARAMS)
            before_velocity = est
            est, _ = update_velocity(est, ZERO, ZERO, PARAMS)
            if k == RATIO - 1:
                est, _ = update_pose(est, ZERO, np.eye(3), 0.0, PARAMS)
    assert_allclose(est.P, DESIGN.P, rtol=1e-6)
    assert_allclose(est.P_rot, DESIGN.P_rot, rtol=1e-6)
    unit, _ = update_velocity(before_velocity, np.ones(3), np.array([1e-6, 0.0, 0.0]), PARAMS)
    assert [unit.x[0], unit.xd[0]] == pytest.approx(DESIGN.gain_velocity, rel=1e-6)
    assert unit.omega[0] / 1e-6 == pytest.approx(DESIGN.gain_velocity_rot[1], rel=1e-6)
    before_pose, _ = update_velocity(before_velocity, ZERO, ZERO, PARAMS)
    unit, _ = update_pose(before_pose, np.ones(3), Rotation.from_rotvec([1e-6, 0, 0]).as_matrix(), 0.0, PARAMS)
    assert [unit.x[1], unit.xd[1]] == pytest.approx(DESIGN.gain_pose, rel=1e-6)
    assert unit.omega[0] / 1e-6 == pytest.approx(DESIGN.gain_pose_rot[1], rel=1e-6)


def test_noise_as_stated_gives_an_innovation_of_one_and_errors_as_the_covariance_says() -> None:
    rng = np.random.default_rng(2)
    x, xd, R, omega = (
        np.array([0.4, 0.1, 0.5]),
        np.array([0.3, -0.2, 0.1]),
        Rotation.identity(),
        np.array([1.0, 0.5, -2.0]),
    )
    est = start(x, np.eye(3), DESIGN)._replace(xd=xd, omega=omega)
    innovations, errors = [], []
    for k in range(8000):
        a, alpha = np.sin(k * DT + np.arange(3)), np.cos(2 * k * DT + np.arange(3))
        real, real_rot = (
            a + rng.normal(scale=PARAMS.sigma_a, size=3),
            alpha + rng.normal(scale=PARAMS.sigma_alpha, size=3),
        )
        x, R = x + DT * xd + 0.5 * DT**2 * real, Rotation.from_rotvec(DT * omega + 0.5 * DT**2 * real_rot) * R
        xd, omega = xd + DT * real, omega + DT * real_rot
        est = predict(est, a, alpha, DT, PARAMS)
        v, w = xd + rng.normal(scale=PARAMS.r_v, size=3), omega + rng.normal(scale=PARAMS.r_omega, size=3)
        est, nu = update_velocity(est, v, w, PARAMS)
        innovations.append(nu)
        if k % RATIO == 0:
            seen = Rotation.from_rotvec(rng.normal(scale=PARAMS.r_rot, size=3)) * R
            est, nu = update_pose(est, x + rng.normal(scale=PARAMS.r_x, size=3), seen.as_matrix(), 0.0, PARAMS)
            innovations.append(nu)
        turn = (Rotation.from_matrix(est.R) * R.inv()).as_rotvec()
        sigma = np.sqrt([est.P[0, 0], est.P[1, 1], est.P_rot[0, 0], est.P_rot[1, 1]])
        errors.append(
            np.concatenate(
                [e / s for e, s in zip((est.x - x, est.xd - xd, turn, est.omega - omega), sigma, strict=True)]
            )
        )
    assert np.sqrt(np.mean(np.square(innovations))) == pytest.approx(1.0, abs=0.03)
    assert np.sqrt(np.mean(np.square(errors), axis=0)) == pytest.approx(np.ones(12), abs=0.15)
    assert max(innovations) < 3.0  # over six axes; a bound of eight leaves room
    assert_allclose(est.R @ est.R.T, np.eye(3), rtol=0.0, atol=1e-14)


def test_an_old_pose_is_no_bias_on_a_moving_tip() -> None:
    v, w, age = np.array([0.5, -0.3, 0.2]), np.array([0.4, 1.0, -0.6]), 4e-3
    est = start(ZERO, np.eye(3), DESIGN)._replace(xd=v, omega=w)
    for k in range(1, 4001):
        est = predict(est, ZERO, ZERO, DT, PARAMS)
        est, nu = update_velocity(est, v, w, PARAMS)
        if k % RATIO == 0:
            then = k * DT - age
            est, nu = update_pose(est, v * then, Rotation.from_rotvec(w * then).as_matrix(), age, PARAMS)
            assert nu < 1e-6
    assert est.x == pytest.approx(v * 4.0, abs=1e-9)
    assert_allclose(est.R, Rotation.from_rotvec(w * 4.0).as_matrix(), rtol=0.0, atol=1e-9)
    taken_for_new = start(ZERO, np.eye(3), DESIGN)._replace(xd=v, omega=w)
    for k in range(1, 401):
        taken_for_new = predict(taken_for_new, ZERO, ZERO, DT, PARAMS)
        if k % RATIO == 0:
            taken_for_new, nu = update_pose(taken_for_new, v * (k * DT - age), np.eye(3), 0.0, PARAMS)
    assert np.linalg.norm(taken_for_new.x - v * 0.4) > 1e-4  # the same pose without its age drags the tip behind


def test_a_pose_that_jumps_is_an_innovation_in_proportion() -> None:
    est = start(ZERO, np.eye(3), DESIGN)
    sizes = [update_pose(est, np.array([d, 0.0, 0.0]), np.eye(3), 0.0, PARAMS)[1] for d in (1e-3, 1e-2, 1e-1)]
    assert sizes[1:] == pytest.approx([10.0 * sizes[0], 100.0 * sizes[0]], rel=1e-9)
    assert sizes[2] > 50.0
    turned = Rotation.from_rotvec([0.0, 0.0, 3.0]).as_matrix()
    assert update_pose(est, ZERO, turned, 0.0, PARAMS)[1] > 500.0


def test_what_is_not_a_number_is_passed_on_to_be_found() -> None:
    est = start(ZERO, np.eye(3), DESIGN)
    nan = np.full(3, np.nan)
    assert np.isnan(update_velocity(est, nan, ZERO, PARAMS)[1])
    assert np.isnan(update_pose(est, nan, np.eye(3), 0.0, PARAMS)[1])
    assert np.isnan(update_pose(est, ZERO, np.full((3, 3), np.nan), 0.0, PARAMS)[1])
    assert np.isnan(predict(est, nan, ZERO, DT, PARAMS).x).all()


def test_an_estimate_goes_in_unchanged_and_shares_nothing_with_the_next() -> None:
    est = start(np.ones(3), np.eye(3), DESIGN)
    kept = [field.copy() for field in est]
    later = predict(est, np.ones(3), np.ones(3), DT, PARAMS)
    update_velocity(later, np.ones(3), ZERO, PARAMS)
    update_pose(est, ZERO, np.eye(3), 0.0, PARAMS)
    assert all((a == b).all() for a, b in zip(est, kept, strict=True))
    assert not any(np.shares_memory(a, b) for a in est for b in later)


@pytest.mark.parametrize(("period", "as_then"), [(DT, False), (DT, True), (1.0 / 225.0, True)])
@pytest.mark.parametrize("has_qd", [True, False])
def test_each_joint_is_filterpys_filter_step_by_step(has_qd: bool, period: float, as_then: bool) -> None:
    n, rng = 7, np.random.default_rng(3)
    params = joint_params(n, has_qd, as_then=as_then)._replace(sigma_qdd=rng.uniform(5.0, 50.0, n))
    P = np.array([[[1e-6, 1e-6], [1e-6, 1e-3]]] * n)
    est = JointEstimate(rng.normal(size=n), rng.normal(size=n), P)
    bank = [axis_filter(est.q[i], est.qd[i], P[i]) for i in range(n)]
    for _ in range(400):
        dt, qdd = period * rng.integers(1, 3), rng.normal(scale=20.0, size=n)
        age, fresh = rng.uniform(0.0, 3.0 * period, n), rng.random(n) < 0.9
        q, qd = est.q + rng.normal(scale=LSB_Q, size=n), est.qd + rng.normal(scale=LSB_QD, size=n)
        est, innovation = joint_step(est, qdd, q, qd, age, fresh, dt, params)
        for i, kf in enumerate(bank):
            since = min(age[i], dt) if fresh[i] and as_then else 0.0  # of the step, after the measurement
            late, expected = age[i] - since, 0.0
            step(kf, qdd[i], dt - since, params.sigma_qdd[i])
            if fresh[i]:  # where it is older than that, the known acceleration is a known offset
                offset = 0.5 * late**2 * qdd[i]
                expected = abs(measure(kf, q[i] - offset, (1.0, -late), params.r_q[i]))
                if has_qd:
                    expected = max(expected, abs(measure(kf, qd[i] + late * qdd[i], (0.0, 1.0), params.r_qd[i])))
                step(kf, qdd[i], since, params.sigma_qdd[i])
            assert_allclose([est.q[i], est.qd[i]], kf.x[:, 0], rtol=1e-9, atol=1e-9)
            assert_allclose(est.P[i], kf.P, rtol=1e-9, atol=1e-15)
            assert innovation[i] == pytest.approx(expected, rel=1e-8, abs=1e-9)


@pytest.mark.parametrize("dt", [1.0 / 225.0, 1e-2])
def test_accelerations_as_stated_are_a_surprise_of_one_to_old_replies_at_slow_rates(dt: float) -> None:
    rng, params = np.random.default_rng(6), joint_params(1, True, as_then=True)
    q, qd = np.zeros(1), np.zeros(1)
    est = joint_start(q, design_joint(params, dt, dt).now)
    age, fresh, surprises, errors = np.full(1, dt), np.ones(1, np.bool_), [], []
    for _ in range(20_000):
        seen = q + rng.normal(scale=params.r_q, size=1), qd + rng.normal(scale=params.r_qd, size=1)  # a period old
        qdd = rng.normal(scale=params.sigma_qdd, size=1)
        q, qd = q + dt * qd + 0.5 * dt * dt * qdd, qd + dt * qdd
        est, innovation = joint_step(est, np.zeros(1), *seen, age, fresh, dt, params)
        surprises.append(innovation[0])
        errors.append([(est.q[0] - q[0]) / est.P[0, 0, 0] ** 0.5, (est.qd[0] - qd[0]) / est.P[0, 1, 1] ** 0.5])
    # the larger of two normal numbers: 1 + 2/pi in the mean of its square
    assert np.mean(np.square(surprises)) == pytest.approx(1.0 + 2.0 / np.pi, rel=0.04)
    assert np.std(errors, axis=0) == pytest.approx([1.0, 1.0], rel=0.04)


@pytest.mark.parametrize(("dt", "ratio"), [(1.0 / 225.0, 2), (1e-2, 1)])
def test_a_lasting_acceleration_that_nobody_knew_of_is_less_than_what_a_pose_may_come_late_by(
    dt: float, ratio: int
) -> None:
    """A joint of lever 1 m that is accelerated by twice its deviation: true, by its parabola, the tip's by the arc."""
    p = joint_params(1, True, as_then=True)
    qdd, P = 2.0 * p.sigma_qdd[0], design_joint(p, dt, dt)
    J = np.zeros((6, 1))
    J[0, 0] = 1.0
    tip = tip_params(J, P.measured, 5.0, 20.0, lateness(p, dt, ratio * dt))._replace(r_rot=1.0, r_omega=1.0)
    est, arm = start(ZERO, np.eye(3), design(tip, dt, ratio, 0.0)), joint_start(np.zeros(1), P.now)
    surprises, age, fresh = [], np.full(1, dt), np.ones(1, np.bool_)
    for k in range(1, 41):
        then = (k - 1) * dt
        arm, _ = joint_step(
            arm, np.zeros(1), np.full(1, 0.5 * qdd * then**2), np.full(1, qdd * then), age, fresh, dt, p
        )
        est = predict(est, ZERO, ZERO, dt, tip)
        est, _ = update_velocity(est, J[:3, 0] * arm.qd[0], ZERO, tip)
        if k % ratio == 0:
            est, surprise = update_pose(est, J[:3, 0] * arm.q[0], np.eye(3), 0.0, tip)
            surprises.append(surprise)
    assert max(surprises) < 3.0


@pytest.mark.parametrize("has_qd", [True, False])
def test_the_joint_design_is_where_the_compiled_bank_settles(has_qd: bool) -> None:
    params = joint_params(3, has_qd)._replace(sigma_qdd=np.array([5.0, 20.0, 80.0]))
    P = design_joint(params, DT, DT).now
    zero, age, fresh = np.zeros(3), np.full(3, DT), np.ones(3, np.bool_)
    est = joint_start(zero, np.array([np.diag([1e-2, 1.0])] * 3))
    for _ in range(5000):
        est, _ = joint_step(est, zero, zero, zero, age, fresh, DT, params)
    assert_allclose(est.P, P, rtol=1e-6)


def trajectory(t: F64) -> tuple[F64, F64, F64]:
    """Return q, qd, qdd of an arm at work: slow swings and a quick wiggle, up to 2 rad/s and 12 rad/s2."""
    terms = ((0.8, 1.1, 0.0), (0.15, 5.0, 1.0), (0.02, 18.0, 2.0))
    q = sum(a * np.sin(w * t + p) for a, w, p in terms)
    qd = sum(a * w * np.cos(w * t + p) for a, w, p in terms)
    qdd = sum(-a * w * w * np.sin(w * t + p) for a, w, p in terms)
    return np.asarray(q), np.asarray(qd), np.asarray(qdd)


def followed(params: JointParams, knows_qdd: bool) -> tuple[F64, F64, F64]:
    """Return times, and errors of q and qd at each slot, from quantised replies that are one period old."""
    t: F64 = np.asarray(np.arange(1, 8001) * DT, dtype=np.float64)
    q, qd, qdd = trajectory(t)
    q_then, qd_then, _ = trajectory(t - DT)
    seen, seen_d = np.round(q_then / LSB_Q) * LSB_Q, np.round(qd_then / LSB_QD) * LSB_QD
    est = joint_start(q[:1], design_joint(params, DT, DT).now)._replace(qd=qd[:1])
    out = np.empty((2, len(t)))
    age, fresh = np.full(1, DT), np.ones(1, np.bool_)
    for k in range(len(t)):
        expected = qdd[k : k + 1] if knows_qdd else np.zeros(1)
        est, _ = joint_step(est, expected, seen[k : k + 1], seen_d[k : k + 1], age, fresh, DT, params)
        out[0, k], out[1, k] = est.q[0] - q[k], est.qd[0] - qd[k]
    return t, out[0], out[1]


def lag(t: F64, error: F64, slope: F64) -> float:
    """Return the delay [s] that explains most of an error: error = -lag * slope, least squares."""
    return float(-(error * slope).sum() / (slope * slope).sum())


@pytest.mark.parametrize(
    ("has_qd", "knows_qdd", "q_rms", "qd_rms", "qd_lag"),
    [
        (True, True, 0.3 * LSB_Q, 0.02, 2e-4),
        (False, True, 0.3 * LSB_Q, 0.02, 2e-4),
        (True, False, 0.5 * LSB_Q, 0.04, 6e-3),
    ],
)
def test_a_quantised_encoder_gives_position_and_speed_of_now(
    has_qd: bool, knows_qdd: bool, q_rms: float, qd_rms: float, qd_lag: float
) -> None:
    params = joint_params(1, has_qd, sigma=5.0 if knows_qdd else 20.0)
    t, e, e_d = followed(params, knows_qdd)
    _, qd, qdd = trajectory(t)
    assert np.sqrt(np.mean(e**2)) < q_rms
    assert np.sqrt(np.mean(e_d**2)) < qd_rms
    assert abs(lag(t, e, qd)) < 5e-5  # a reply one period old would show 1e-3
    assert abs(lag(t, e_d, qdd)) < qd_lag
    naive = np.diff(np.round(trajectory(t)[0] / LSB_Q) * LSB_Q) / DT - qd[1:]
    assert np.sqrt(np.mean(e_d**2)) < 0.35 * np.sqrt(np.mean(naive**2))


def test_a_joint_at_rest_has_no_speed() -> None:
    params = joint_params(2, False)
    seen = np.round(np.array([0.3, -1.2]) / LSB_Q) * LSB_Q
    est = joint_start(seen + 0.4 * LSB_Q, design_joint(params, DT, DT).now)
    zero, age, fresh = np.zeros(2), np.full(2, DT), np.ones(2, np.bool_)
    for _ in range(800):
        est, _ = joint_step(est, zero, seen, zero, age, fresh, DT, params)
    assert est.qd == pytest.approx(zero, abs=1e-9)
    assert est.q == pytest.approx(seen, abs=1e-9)


def test_a_joint_that_does_not_reply_coasts_and_grows_unsure() -> None:
    params = joint_params(2, True)
    est = JointEstimate(np.array([1.0, 1.0]), np.array([0.5, 0.5]), design_joint(params, DT, DT).now)
    silent, age = np.array([False, True]), np.full(2, DT)
    for k in range(1, 11):
        seen = 1.0 + 0.5 * (k - 1) * DT
        est, innovation = joint_step(est, np.zeros(2), np.full(2, seen), np.full(2, 0.5), age, silent, DT, params)
        assert innovation[0] == 0.0
    assert est.q == pytest.approx(np.full(2, 1.005), abs=1e-9)
    assert est.P[0, 0, 0] > est.P[1, 0, 0]
    assert est.P[0, 1, 1] > est.P[1, 1, 1]
    far = np.array([1.2, 1.2])
    _, innovation = joint_step(est, np.zeros(2), far, np.full(2, 0.5), age, ~np.zeros(2, np.bool_), DT, params)
    assert innovation[1] > innovation[0] > 8.0  # an unsure joint is surprised less


@pytest.mark.parametrize("name", ["openarm", "openarm_e2e", "panda", "planar4", "puma560", "ur5"])
def test_at_the_rates_of_the_shipped_arms_a_reply_is_as_of_now_and_no_pose_is_late(name: str) -> None:
    """What their logs hold is replayed to the bit: the filters of slow rates begin below them."""
    arm = robot(ROOT / "configs" / f"{name}.toml")
    assert not arm.joint_filter.as_then
    assert (arm.estimator.late_x, arm.estimator.late_rot) == (0.0, 0.0)


def test_the_tips_noise_is_what_noisy_joints_give() -> None:
    rng = np.random.default_rng(4)
    J, n = rng.normal(scale=0.5, size=(6, 7)), 7
    P = np.array([np.diag([(1e-4 * (k + 1)) ** 2, (1e-2 * (k + 1)) ** 2]) for k in range(n)])
    params = tip_params(J, P, 5.0, 20.0)
    scale = 1.0 + np.arange(n)
    seen = np.std(rng.normal(scale=1e-4 * scale, size=(40_000, n)) @ J.T, axis=0)
    assert [params.r_x, params.r_rot] == pytest.approx([seen[:3].max(), seen[3:].max()], rel=0.02)
    assert [params.r_v, params.r_omega] == pytest.approx([100.0 * params.r_x, 100.0 * params.r_rot], rel=1e-9)
    assert (params.sigma_a, params.sigma_alpha) == (5.0, 20.0)
    assert (params.late_x, params.late_rot) == (0.0, 0.0)
    late = tip_params(J, P, 5.0, 20.0, 1e-4 * scale)
    assert [late.late_x, late.late_rot] == pytest.approx([params.r_x, params.r_rot], rel=1e-9)
    assert late[:6] == params[:6]


def _digest() -> str:
    rng = np.random.default_rng(5)
    P = np.array([[1e-4, 1e-5], [1e-5, 1e-2]])
    est = TipEstimate(ZERO, ZERO, P, np.eye(3), ZERO, P)
    params = joint_params(7, True)
    joints, ready = joint_start(np.zeros(7), np.array([P] * 7)), np.ones(7, np.bool_)
    for k in range(200):
        est = predict(est, rng.normal(size=3), rng.normal(size=3), DT, PARAMS)
        est, _ = update_velocity(est, rng.normal(size=3), rng.normal(size=3), PARAMS)
        if k % RATIO == 0:
            est, _ = update_pose(est, rng.normal(size=3), np.eye(3), 1e-3, PARAMS)
        q, qd, qdd = rng.normal(size=(3, 7))
        joints, _ = joint_step(joints, qdd, q, qd, np.full(7, DT), ready, DT, params)
    return hashlib.sha256(b"".join(field.tobytes() for field in (*est, *joints))).hexdigest()


def test_another_process_without_the_compiler_gives_the_same_bits() -> None:
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1", "PYTHONPATH": str(ROOT)}
    script = "from tests.test_estimator import _digest; print(_digest())"
    run = subprocess.run([sys.executable, "-c", script], env=environment, cwd=ROOT, capture_output=True, text=True)
    assert run.stdout.strip().splitlines()[-1:] == [_digest()], run.stderr


def test_the_design_repeats_and_a_better_sensor_makes_a_surer_filter() -> None:
    assert all((a == b).all() for a, b in zip(design(PARAMS, DT, RATIO, 0.0), DESIGN, strict=True))
    better: Design = design(PARAMS._replace(r_x=1e-4, r_v=1e-3), DT, RATIO, 0.0)
    assert np.diag(better.P)[0] < np.diag(DESIGN.P)[0]
    assert np.diag(better.P)[1] < np.diag(DESIGN.P)[1]

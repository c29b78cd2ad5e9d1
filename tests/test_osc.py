"""The motion task against numpy's linear algebra and closed-form motion."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtctl.arm import osc
from rtctl.kernel.linalg import matmul, matvec, symmetric_eigen, tmatvec

RNG = np.random.default_rng(3)
P = osc.MotionParams(200.0, 2 * np.sqrt(200.0), 0.5, 5.0, 1.5, 15.0, 10.0, 6.0, np.full(7, 20.0), 0.02, 0.2, 0.8)


def arm(n: int = 7, rank: int = 6):
    J = RNG.normal(size=(6, n))
    J[rank:] = RNG.normal(size=(6 - rank, rank)) @ J[:rank]
    L = RNG.normal(size=(n, n))
    A = L @ L.T + np.eye(n)
    return J, A, np.linalg.inv(A)


@pytest.mark.parametrize("m", [1, 3, 6])
def test_the_eigen_decomposition_is_that_of_lapack(m):
    S = RNG.normal(size=(m, m))
    S = S + S.T
    values, V = symmetric_eigen(S)
    np.testing.assert_allclose(np.sort(values), np.linalg.eigvalsh(S), atol=1e-12)
    np.testing.assert_allclose(V @ np.diag(values) @ V.T, S, atol=1e-12)
    np.testing.assert_allclose(V.T @ V, np.eye(m), atol=1e-13)


def test_products_are_those_of_numpy():
    M, N, v, w = RNG.normal(size=(6, 7)), RNG.normal(size=(7, 4)), RNG.normal(size=7), RNG.normal(size=6)
    np.testing.assert_allclose(matvec(M, v), M @ v, rtol=1e-13)
    np.testing.assert_allclose(tmatvec(M, w), M.T @ w, rtol=1e-13)
    np.testing.assert_allclose(matmul(M, N), M @ N, rtol=1e-13)


@pytest.mark.parametrize("rows", [3, 6])
def test_lambda_is_the_inverse_of_the_mobility_away_from_singularities(rows):
    J, _, A_inv = arm()
    mobility = J @ A_inv @ J.T
    space = osc.operational_space(J, A_inv, mobility, np.eye(6)[:rows], P._replace(epsilon=1e-9))
    np.testing.assert_allclose(space.Lambda[:rows, :rows], np.linalg.inv(mobility[:rows, :rows]), rtol=1e-8)
    assert not space.damped
    assert not space.Lambda[rows:].any()


def test_null_space_torque_does_not_accelerate_the_tip():
    J, _, A_inv = arm()
    space = osc.operational_space(J, A_inv, J @ A_inv @ J.T, np.eye(6), P._replace(epsilon=1e-9))
    tau = space.NT @ RNG.normal(size=7)
    assert np.abs(tau).max() > 0.01
    np.testing.assert_allclose(J @ A_inv @ tau, 0.0, atol=1e-9)


def test_a_singular_arm_gets_a_finite_lambda_that_is_exact_in_the_other_directions():
    J, _, A_inv = arm(rank=5)
    mobility = J @ A_inv @ J.T
    space = osc.operational_space(J, A_inv, mobility, np.eye(6), P._replace(length=1.0))
    assert space.damped
    assert np.isfinite(space.Lambda).all()
    # directions with an eigenvalue above the threshold are inverted exactly: check on the range of the mobility
    w, V = np.linalg.eigh(mobility)
    for k in np.flatnonzero(w > P.epsilon):
        np.testing.assert_allclose(space.Lambda @ V[:, k], V[:, k] / w[k], atol=1e-7 * np.abs(space.Lambda).max())


@given(st.floats(1e-12, 1.0), st.floats(1e-3, 1.0))
def test_the_damped_reciprocal_is_bounded_and_exact_above_its_threshold(s, epsilon):
    f = osc.damped_reciprocal(s, epsilon)
    assert 0.0 <= f <= 2.28 / epsilon
    if s >= epsilon:
        assert f == 1.0 / s
    assert f <= 1.0 / s


def test_the_damped_reciprocal_has_no_step_in_value_or_slope_at_its_threshold():
    h = 1e-6
    below = [osc.damped_reciprocal(0.1 - k * h, 0.1) for k in range(3)]
    above = [osc.damped_reciprocal(0.1 + k * h, 0.1) for k in range(3)]
    assert abs(below[0] - above[0]) < 1e-9
    assert abs((below[0] - below[1]) - (above[1] - above[0])) / h < 1e-2


@given(st.floats(0.0, 3.0))
def test_the_approach_speed_never_passes_v_max_nor_the_paper_law(d):
    v = osc.approach_speed(d, P.k_p / P.k_v, P.v_max, P.a_max)
    assert 0.0 <= v <= P.v_max
    assert v <= P.k_p / P.k_v * d + 1e-12


@settings(max_examples=30)
@given(st.floats(0.5, 20.0), st.floats(0.05, 2.0))
def test_following_the_approach_speed_never_brakes_harder_than_a_max(a_max, v_max):
    d, h, previous = 2.0, 1e-4, None
    while d > 1e-4:
        v = osc.approach_speed(d, 7.07, v_max, a_max)
        if previous is not None:
            assert (previous - v) / h <= a_max * 1.01
        previous, d = v, d - v * h


def reference(e, v_ref, qd_max, dt=1e-3, qd=np.zeros(7)):  # noqa: B008 - read only
    Jbar = np.zeros((7, 6))
    Jbar[0, 0] = 2.0
    zero, out = np.zeros(3), osc.Twist(np.empty(3), np.empty(3))
    still = osc.Twist(zero, zero)
    osc.velocity_reference(osc.Twist(e, zero), osc.Twist(v_ref, zero), still, Jbar, qd, qd_max, P, dt, out)
    return out.linear


def test_a_goal_that_jumps_does_not_make_the_reference_jump():
    v = np.array([0.0, 0.5, 0.0])
    after = reference(np.array([1.0, 0.0, 0.0]), v, np.full(7, 10.0))
    assert np.linalg.norm(after - v) <= 5.0 * 1e-3 * (1 + 1e-9)


def test_the_reference_points_at_the_goal_at_v_max():
    v = np.zeros(3)
    for _ in range(500):
        v = reference(np.array([0.6, 0.8, 0.0]), v, np.full(7, 10.0))
    np.testing.assert_allclose(v, [0.3, 0.4, 0.0], atol=1e-9)


def test_the_reference_slows_on_its_line_when_a_joint_would_be_too_fast():
    v = np.zeros(3)
    for _ in range(500):
        v = reference(np.array([0.6, 0.8, 0.0]), v, np.full(7, 0.5))
    assert 2.0 * v[0] <= 0.8 * 0.5 + 1e-9
    np.testing.assert_allclose(v[1] / v[0], 0.8 / 0.6, rtol=1e-9)


def test_the_motion_torque_accelerates_the_tip_as_asked():
    J, A, A_inv = arm()
    space = osc.operational_space(J, A_inv, J @ A_inv @ J.T, np.eye(6), P._replace(epsilon=1e-9))
    qd, Jdqd = RNG.normal(size=7), RNG.normal(size=6)
    xd, omega, v, w = J[:3] @ qd, J[3:] @ qd, RNG.normal(size=3), RNG.normal(size=3)
    q, rest = RNG.normal(size=7), RNG.normal(size=7)
    at, F, parts = osc.TaskDynamics(J, Jdqd, A, space.Lambda, space.NT), np.empty(6), np.empty((4, 7))
    osc.motion_torque(at, osc.Twist(xd, omega), osc.Twist(v, w), q, qd, rest, P, F, parts)
    qdd = A_inv @ parts.sum(axis=0)
    np.testing.assert_allclose(J @ qdd + Jdqd, F, atol=1e-8)
    np.testing.assert_allclose(F, P.k_v * (np.concatenate((v, w)) - np.concatenate((xd, omega))), rtol=1e-12)


def test_damping_parts_only_take_energy_out():
    J, A, A_inv = arm()
    space = osc.operational_space(J, A_inv, J @ A_inv @ J.T, np.eye(6), P)
    zero3, zero6, zero7 = np.zeros(3), np.zeros(6), np.zeros(7)
    for _ in range(20):
        qd = RNG.normal(size=7)
        at, parts = osc.TaskDynamics(J, zero6, A, space.Lambda, space.NT), np.empty((4, 7))
        moving, still = osc.Twist(J[:3] @ qd, J[3:] @ qd), osc.Twist(zero3, zero3)
        osc.motion_torque(at, moving, still, zero7, qd, zero7, P, np.empty(6), parts)
        brake, damp = parts[osc.TASK_BRAKE], parts[osc.POSTURE_DAMPER]
        assert brake @ qd <= 1e-9
        assert damp @ qd <= 1e-6 * np.abs(damp).max()

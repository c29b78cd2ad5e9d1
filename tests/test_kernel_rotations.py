"""Rotations, against scipy's and against what a rotation must do."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rtctl.kernel import rotations
from rtctl.types import F64

UNIT = st.integers(0, 2**32 - 1).map(lambda seed: _unit(np.random.default_rng(seed)))
ANGLES = (0.0, 1e-300, 1e-12, 1e-8, 9.99e-5, 1.0e-4, 1.01e-4, 1e-3, 0.1, 1.0, 3.0, math.pi - 1e-3, math.pi - 1e-7)


def _unit(rng: np.random.Generator) -> F64:
    v = rng.normal(size=3)
    return np.asarray(v / np.linalg.norm(v))


def _wxyz(rotation: Rotation) -> F64:
    return np.asarray(rotation.as_quat(canonical=True, scalar_first=True))


@given(axis=UNIT, angle=st.floats(0.0, 20.0))
def test_exp_is_scipys_rotation_at_any_angle(axis: F64, angle: float) -> None:
    assert rotations.exp3(axis * angle) == pytest.approx(
        Rotation.from_rotvec(axis * angle).as_matrix(), abs=2e-15 * (9 + angle)
    )


@pytest.mark.parametrize("angle", ANGLES)
def test_log_undoes_exp_to_rounding_even_at_the_seams_of_its_series(angle: float) -> None:
    rng = np.random.default_rng(3)
    for _ in range(50):
        w = angle * _unit(rng)
        # an entry of R holds an angle near pi, or a tiny one, to about its own rounding
        assert rotations.log3(rotations.exp3(w)) == pytest.approx(w, rel=1e-11, abs=1e-15)


def test_log_is_smooth_across_the_end_of_its_series() -> None:
    axis = _unit(np.random.default_rng(0))
    angles = 2.0 * np.linspace(0.99e-4, 1.01e-4, 101)  # the series ends at |v| = 1e-4, so at an angle of 2e-4
    lengths = [np.linalg.norm(rotations.log3(rotations.exp3(axis * a))) for a in angles]
    assert np.diff(lengths) == pytest.approx(np.diff(angles), abs=1e-15)


@pytest.mark.parametrize("axis", [*np.eye(3), -np.eye(3)[1], *(_unit(np.random.default_rng(s)) for s in range(20))])
def test_half_a_turn_has_a_log_of_length_pi_about_the_axis_or_its_opposite(axis: F64) -> None:
    R = 2.0 * np.outer(axis, axis) - np.eye(3)  # half a turn without any of the module's formulas
    w = rotations.log3(R)
    assert np.linalg.norm(w) == pytest.approx(math.pi, rel=1e-12)
    assert abs(w @ axis) == pytest.approx(math.pi, rel=1e-12)


@given(axis=UNIT, angle=st.floats(-math.pi, math.pi))
def test_quaternion_and_matrix_are_scipys(axis: F64, angle: float) -> None:
    rotation = Rotation.from_rotvec(axis * angle)
    quaternion = rotations.quat_of(rotation.as_matrix())
    assert quaternion[0] >= 0.0
    assert abs(quaternion @ _wxyz(rotation)) == pytest.approx(1.0, abs=1e-14)  # either sign is the same rotation
    assert rotations.R_of(_wxyz(rotation)) == pytest.approx(rotation.as_matrix(), abs=1e-15)
    assert rotations.R_of(-3.0 * _wxyz(rotation)) == pytest.approx(rotation.as_matrix(), abs=1e-15)


@given(a=UNIT, b=UNIT, alpha=st.floats(0.0, 3.0), beta=st.floats(0.0, 3.0))
def test_error_turns_one_frame_into_the_other_in_the_world(a: F64, b: F64, alpha: float, beta: float) -> None:
    R, R_goal = Rotation.from_rotvec(a * alpha), Rotation.from_rotvec(b * beta)
    w = rotations.error(R.as_matrix(), R_goal.as_matrix())
    assert (Rotation.from_rotvec(w) * R).as_matrix() == pytest.approx(R_goal.as_matrix(), abs=1e-13)
    assert np.linalg.norm(w) <= math.pi * (1.0 + 1e-15)


def test_a_frame_turning_at_a_known_rate_shows_that_rate() -> None:
    omega, R = np.array([0.3, -0.2, 0.5]), Rotation.from_rotvec([1.0, 2.0, -0.5])
    later = Rotation.from_rotvec(omega * 1e-3) * R
    assert rotations.error(R.as_matrix(), later.as_matrix()) / 1e-3 == pytest.approx(omega, abs=1e-11)


def test_compose_is_the_matrix_product() -> None:
    rng = np.random.default_rng(0)
    A, B = rng.normal(size=(3, 3)), rng.normal(size=(3, 3))
    assert rotations.compose(A, B) == pytest.approx(np.einsum("ij,jk->ik", A, B), abs=1e-15)


def test_orthonormal_returns_a_rotation_beside_one_that_drifted() -> None:
    rng = np.random.default_rng(1)
    R = Rotation.random(random_state=4).as_matrix()
    mended = rotations.orthonormal(R + 1e-9 * rng.normal(size=(3, 3)))
    assert mended @ mended.T == pytest.approx(np.eye(3), abs=1e-15)
    assert mended == pytest.approx(R, abs=5e-9)


def test_not_a_number_stays_not_a_number() -> None:
    assert np.isnan(rotations.log3(np.full((3, 3), np.nan))).all()
    assert np.isnan(rotations.exp3(np.full(3, np.nan))).all()

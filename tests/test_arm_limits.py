"""The limiter's promises, whatever it is handed."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from rtctl.arm.limits import TorqueBounds, TorqueParts, limit_torque, slew_reference
from rtctl.types import LimitFlag

N, DT = 3, 1e-3
MAX, RATE, D = np.array([80.0, 40.0, 10.0]), np.array([1000.0, 1000.0, 300.0]), np.array([10.0, 5.0, 1.0])
BOUNDS = TorqueBounds(MAX, RATE, np.zeros(N), D)
anything = arrays(np.float64, N, elements=st.floats(allow_nan=True, allow_infinity=True, width=64))
sane = arrays(np.float64, N, elements=st.floats(-200.0, 200.0))


@given(anything, anything, anything, sane)
def test_what_leaves_is_finite_within_magnitude_and_slew_whatever_comes_in(drive, keep, qd, reference):
    p = limit_torque(TorqueParts(drive, keep), qd, reference, BOUNDS, DT)
    assert np.isfinite(p.tau).all()
    assert (np.abs(p.tau) <= MAX).all()
    start = np.clip(reference, -MAX, MAX)
    assert (np.abs(p.tau - start) <= RATE * DT * (1 + 1e-9) + 1e-12).all()


@given(anything)
def test_a_torque_reference_that_is_not_finite_gives_zero_torque_there(reference):
    p = limit_torque(TorqueParts(np.ones(N), np.zeros(N)), np.zeros(N), reference, BOUNDS, DT)
    bad = ~np.isfinite(reference)
    assert (p.tau[bad] == 0.0).all()
    assert bool(p.flags & LimitFlag.NON_FINITE) == bool(bad.any())


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("where", ["drive", "keep"])
def test_one_bad_number_damps_every_joint(bad, where):
    parts = {"drive": np.ones(N), "keep": np.ones(N)}
    parts[where][1] = bad
    qd = np.array([0.1, -0.1, 0.01])
    p = limit_torque(TorqueParts(**parts), qd, -D * qd, BOUNDS, DT)
    assert p.flags & LimitFlag.NON_FINITE
    np.testing.assert_allclose(p.tau, [-1.0, 0.5, -0.01])


@given(sane, sane)
def test_motion_gives_way_before_what_must_be_kept(drive, keep):
    keep = np.clip(keep, -MAX, MAX)
    p = limit_torque(TorqueParts(drive, keep), np.zeros(N), keep, BOUNDS._replace(tau_rate=np.full(N, 1e9)), DT)
    # the drive is scaled as one: tau - keep stays parallel to it, by the largest factor in [0, 1] that fits
    np.testing.assert_allclose(p.tau, keep + p.scale * drive, atol=1e-9)
    more = min(1.0, p.scale + 1e-6)
    assert p.scale == 1.0 or (np.abs(keep + more * drive) > MAX * (1 - 1e-12)).any()


@given(arrays(np.float64, N, elements=st.floats(-9.0, 9.0)))
def test_a_torque_within_all_bounds_is_not_touched(tau):
    p = limit_torque(TorqueParts(tau, np.zeros(N)), np.zeros(N), tau, BOUNDS, DT)
    np.testing.assert_array_equal(p.tau, tau)
    assert p.flags == 0


def test_the_slew_starts_from_what_the_drive_really_applies():
    sent, echo = np.array([30.0, 5.0, 1.0]), np.array([30.0, 0.0, 1.2])
    np.testing.assert_allclose(slew_reference(sent, echo, RATE, np.zeros(N), DT, 1), [30.0, 1.0, 1.0])
    np.testing.assert_allclose(slew_reference(sent, echo, RATE, np.full(N, 0.05), DT, 2), [30.0, 2.05, 1.0])


@given(sane, sane)
def test_a_step_that_is_too_large_is_shortened_on_every_joint_alike(wanted, reference):
    """The torque moves from where it is straight towards what is wanted, and no shorter than the slowest joint must."""
    p = limit_torque(TorqueParts(np.zeros(N), wanted), np.zeros(N), reference, BOUNDS, DT)
    start, step = np.clip(reference, -MAX, MAX), RATE * DT
    away = np.clip(wanted, -MAX, MAX) - start
    share = min([1.0, *(step[i] / abs(away[i]) for i in range(N) if abs(away[i]) > step[i])])
    np.testing.assert_allclose(p.tau, start + share * away, atol=1e-9)
    assert bool(p.flags & LimitFlag.SLEW) == (share < 1.0)


def test_a_joint_without_a_reference_does_not_hold_up_the_others():
    reference = np.array([np.nan, 0.9, 0.9])
    p = limit_torque(TorqueParts(np.zeros(N), np.ones(N)), np.zeros(N), reference, BOUNDS, DT)
    np.testing.assert_allclose(p.tau, [0.0, 1.0, 1.0])

"""The limiter's promises, whatever it is handed."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from rtctl.arm.limits import TorqueBounds, TorqueParts, command_torque, limit_torque, slew_follows_echo, slew_reference
from rtctl.types import Feedback, LimitFlag

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


def limited(drive: list[float], keep: list[float], reference: list[float] | None = None, dt: float = 1.0):
    """Return what is sent where only the magnitude bounds, unless a reference and a period say otherwise."""
    wide = BOUNDS if reference is not None else BOUNDS._replace(tau_rate=np.full(N, 1e9))
    start = np.zeros(N) if reference is None else np.array(reference)
    return limit_torque(TorqueParts(np.array(drive), np.array(keep)), np.zeros(N), start, wide, dt)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_what_is_left_of_a_small_drive_beside_a_large_load(sign):
    p = limited([sign * 0.5, 0.0, sign * 1.0], [sign * 79.8, 0.0, sign * 9.8])
    np.testing.assert_allclose(p.tau, [sign * 79.9, 0.0, sign * 10.0])
    assert p.scale == pytest.approx(0.2)
    assert p.flags == LimitFlag.MOTION_SCALED
    np.testing.assert_allclose(p.tau_wanted, [sign * 80.3, 0.0, sign * 10.8])


def test_a_load_beyond_the_motor_takes_nothing_from_joints_that_have_room():
    p = limited([0.0, 3.0, 0.0], [90.0, 0.0, 0.0])
    np.testing.assert_allclose(p.tau, [80.0, 3.0, 0.0])
    assert p.scale == 1.0
    assert p.flags == LimitFlag.MAGNITUDE


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_rounding_of_a_sum_is_cut_and_not_told_and_more_is(sign):
    ulp = limited([0.0] * N, [sign * float(np.nextafter(80.0, 81.0)), 0.0, 0.0])
    assert (ulp.tau[0], ulp.flags) == (sign * 80.0, 0)
    more = limited([0.0] * N, [0.0, 0.0, sign * 10.0 * (1.0 + 1e-6)])
    assert (more.tau[2], more.flags) == (sign * 10.0, LimitFlag.MAGNITUDE)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_weak_motor_is_bounded_on_its_own_side(sign):
    weak = TorqueBounds(np.full(N, 0.25), np.full(N, 1e9), np.zeros(N), D)
    p = limit_torque(TorqueParts(np.zeros(N), np.full(N, sign * 0.5)), np.zeros(N), np.zeros(N), weak, 1.0)
    np.testing.assert_array_equal(p.tau, np.full(N, sign * 0.25))


def test_a_step_as_large_as_may_be_is_no_limit():
    p = limited([0.0] * N, [1.0, -1.0, 0.25], [0.0, 0.0, 0.0], DT)
    np.testing.assert_array_equal(p.tau, [1.0, -1.0, 0.25])
    assert p.flags == 0


@given(sane)
def test_a_step_from_nothing_is_within_its_bound_to_the_bit(wanted):
    p = limited([0.0] * N, wanted.tolist(), [0.0] * N, DT)
    assert (np.abs(p.tau) <= RATE * DT).all()


def test_of_a_torque_that_is_no_number_nothing_is_left_to_drive():
    p = limited([np.nan, 0.0, 0.0], [0.0] * N)
    assert (p.scale, p.flags) == (0.0, LimitFlag.NON_FINITE)


def test_the_slew_follows_the_echo_where_more_than_its_rounding_lies_between_on_any_joint():
    sent, lsb = np.array([3.0, -2.0, 0.5]), np.array([0.5, 0.25, 0.5])
    assert slew_follows_echo(sent, sent, lsb) is False
    assert not slew_follows_echo(sent - lsb, sent, lsb)  # by as much as the rounding, and no more
    for i in range(N):
        for way in (2.0, -2.0):
            moved = sent.copy()
            moved[i] += way * lsb[i]
            assert slew_follows_echo(moved, sent, lsb), (i, way)


@pytest.mark.parametrize(("age", "lag"), [([0.0, 0.0, 0.0], 1), ([1e-3, 0.0, 1e-3], 1), ([0.0, 3e-3, 1e-3], 3)])
def test_a_command_starts_from_what_was_sent_last_as_far_as_the_oldest_echo_allows(age, lag):
    sent = np.array([[6.0, 1.0, 0.0], [5.0, 1.0, 0.0], [4.0, 1.0, 0.0], [3.0, 1.0, 0.0]])
    echo = np.array([0.0, 1.0, 0.0])
    feedback = Feedback(0, 0, np.zeros(N), np.zeros(N), echo, np.array(age), np.ones(N, int), np.ones(N, int), 0, 0, 0)
    wanted = np.array([10.0, 1.0, 0.0])
    bounds = BOUNDS._replace(tau_lsb=np.full(N, 0.25))
    out, follows = command_torque(TorqueParts(np.zeros(N), wanted), np.zeros(N), sent, feedback, bounds, DT)
    assert follows
    np.testing.assert_allclose(out.tau, [lag * 1.0 + 0.25 + 1.0, 1.0, 0.0])  # RATE * DT is 1 Nm on the first
    same = command_torque(
        TorqueParts(np.zeros(N), wanted), np.zeros(N), sent, feedback._replace(tau=sent[0]), bounds, DT
    )
    assert not same[1]
    np.testing.assert_allclose(same[0].tau, [7.0, 1.0, 0.0])


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_rounding_of_a_shortened_step_does_not_pass_the_bound(sign):
    """0.3 / 37 times 37 is more than 0.3."""
    bounds = TorqueBounds(np.full(N, 80.0), np.full(N, 0.6), np.zeros(N), D)
    p = limit_torque(TorqueParts(np.zeros(N), np.full(N, sign * 37.0)), np.zeros(N), np.zeros(N), bounds, 0.5)
    np.testing.assert_array_equal(p.tau, np.full(N, sign * 0.3))

"""Which goals are taken, and when one is reached."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from rtctl.arm.hot import fresh, record_of
from rtctl.arm.progress import Progress, arrived, at_rest, stall_timer, take_drift, time_left
from rtctl.arm.target import DIAGNOSE, Target, progress_timers
from rtctl.control.goals import refusal
from rtctl.types import Goal, State, Task
from tests.lab import robot

FAR = np.full(3, np.inf)
NAMES = ("", "crate", "")
UNIT = np.array([1.0, 0.0, 0.0, 0.0])
STUCK = Progress(error=0.05, error_rot=0.0, speed=0.0, rate=0.0)


def goal(position: tuple[float, ...] = (0.5, 0.0, 0.4), wxyz: np.ndarray = UNIT, task: Task = Task.POSE) -> Goal:
    return Goal(np.array(position), wxyz, task, 0.003, 0.015)


def refused(g: Goal, rho: np.ndarray = FAR) -> str:
    return refusal(g, np.array([0.0, 0.0, 0.3]), 0.9, rho, NAMES)


def test_a_free_goal_within_reach_is_taken():
    assert refused(goal()) == ""


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("where", range(3))
def test_a_goal_that_is_not_finite_is_refused(bad: float, where: int):
    position = [0.5, 0.0, 0.4]
    position[where] = bad
    assert "finite" in refused(goal(tuple(position)))
    wxyz = UNIT.copy()
    wxyz[where] = bad
    assert "finite" in refused(goal(wxyz=wxyz))


@pytest.mark.parametrize("wxyz", [np.zeros(4), np.full(4, 1.0), np.array([0.9, 0.0, 0.0, 0.0])])
def test_an_orientation_that_is_no_unit_quaternion_is_refused(wxyz: np.ndarray):
    assert "unit quaternion" in refused(goal(wxyz=wxyz))


def test_reach_is_measured_from_the_base():
    assert refused(goal((0.0, 0.0, 1.19))) == ""
    assert "reach of 0.900 m" in refused(goal((0.0, 0.0, 1.21)))
    assert "got 0.950 m" in refused(goal((0.0, 0.0, -0.65)))


def test_a_goal_inside_an_obstacle_is_refused_by_its_name_and_one_on_the_surface_is_not():
    rho = FAR.copy()
    rho[1] = -0.02
    assert refused(goal(), rho) == "goal: lies 0.020 m inside obstacle crate"
    rho[1] = 0.0
    assert refused(goal(), rho) == ""


def test_arrived_means_within_both_tolerances_and_slow():
    near = STUCK._replace(error=0.0029, error_rot=0.0149, speed=0.04, rate=0.1)
    assert arrived(near, 0.003, 0.015)
    changes: list[dict[str, Any]] = [{"error": 0.0031}, {"error_rot": 0.0151}, {"speed": 0.06}, {"rate": 0.3}]
    for change in changes:
        assert not arrived(near._replace(**change), 0.003, 0.015)


def test_at_rest_is_slow_in_both():
    assert at_rest(STUCK)
    assert not at_rest(STUCK._replace(speed=0.02))
    assert not at_rest(STUCK._replace(rate=0.1))


def test_what_is_left_is_the_slower_of_way_and_turn():
    assert time_left(STUCK, 0.5, 1.0) == 0.1
    assert time_left(STUCK._replace(error_rot=0.3), 0.5, 1.0) == 0.3


@pytest.mark.parametrize(
    ("pace", "until"), [(0.0, 2.0), (0.03, 2.0 / 0.75), (0.06, 4.0), (0.12, math.inf), (0.2, math.inf)]
)
def test_who_comes_nearer_more_slowly_than_an_eighth_of_full_speed_is_idle_the_sooner(pace: float, until: float):
    dt, waited, nearest, left = 0.01, 0.0, 10.0, 10.0
    for k in range(1, 1000):
        left -= pace * dt
        waited, nearest = stall_timer(waited, STUCK, left, nearest, dt, 2.0), min(nearest, left)
        if waited >= 2.0 - 1e-9:
            assert k * dt == pytest.approx(until, abs=2 * dt)
            return
    assert until == math.inf


def test_who_moves_fast_is_less_and_less_idle():
    assert stall_timer(1.0, STUCK._replace(speed=0.05), 1.0, 1.0, 0.01, 2.0) == pytest.approx(0.98)
    assert stall_timer(0.01, STUCK._replace(speed=0.05), 1.0, 1.0, 0.01, 2.0) == 0.0


def test_who_turns_on_the_spot_is_idle_unless_it_turns_to_its_goal():
    assert stall_timer(1.0, STUCK._replace(rate=0.6), 1.0, 1.0, 0.01, 2.0) == pytest.approx(1.01)
    assert stall_timer(1.0, STUCK._replace(rate=0.6), 0.99, 1.0, 0.01, 2.0) < 0.95
    assert stall_timer(1.0, STUCK, 1.0, 1.0, 0.01, 2.0) == pytest.approx(1.01)


def test_near_the_goal_half_of_what_is_left_is_enough():
    assert stall_timer(1.0, STUCK, 0.0199, 0.02, 0.02, 2.0) == pytest.approx(1.0)
    assert stall_timer(1.0, STUCK, 0.1999, 0.2, 0.02, 2.0) == pytest.approx(1.018)


def test_who_turned_back_gains_nothing_until_it_is_nearer_than_ever():
    assert stall_timer(1.0, STUCK, 0.9, 0.5, 0.01, 2.0) == pytest.approx(1.01)


def seconds_until_asked(velocity: Callable[[float], float]) -> float:
    """Return when it is asked what holds an arm that goes to and fro 50 mm beside its goal, at a velocity of the time.

    It is inf if that is not within 10 s.
    """
    arm = robot()
    c, m = arm.constants[0], record_of(fresh())[0]
    m.has_goal, m.state, m.nearest = 1, int(State.RUN), np.inf
    target = Target(int(Task.POSITION), np.zeros(3), UNIT, np.zeros(3), 0.003, 0.015)
    for k in range(round(10.0 / arm.dt)):
        m.tick += 1
        m.xd[1] = velocity(k * arm.dt)
        if progress_timers(c, m, target, STUCK._replace(speed=abs(m.xd[1]))) == DIAGNOSE:
            return k * arm.dt
    return math.inf


@pytest.mark.parametrize("hertz", [3.0, 5.0, 20.0])
def test_who_trembles_is_asked_what_holds_it_as_soon_as_who_rests(hertz: float):
    assert 1.9 < seconds_until_asked(lambda t: 0.1 * math.sin(math.tau * hertz * t)) < 2.3
    assert seconds_until_asked(lambda t: 0.1) == math.inf  # who goes round something is not


def test_one_tick_that_is_not_a_number_does_not_spoil_the_drift():
    drift = np.array([0.1, 0.1, 0.1])
    take_drift(drift, np.array([np.nan, np.inf, 0.1]), 1e-3)
    for _ in range(2000):
        take_drift(drift, np.array([0.3, 0.2, 0.1]), 1e-3)
    assert drift == pytest.approx([0.3, 0.2, 0.1], abs=1e-3)

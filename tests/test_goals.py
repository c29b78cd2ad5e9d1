"""Which goals are taken, and what the controller says holds it."""

from typing import Any

import numpy as np
import pytest

from rtctl.control.goals import Progress, arrived, at_rest, diagnose, refusal
from rtctl.types import Cut, Goal, Status, Task

FAR = np.full(3, np.inf)
NAMES = ("", "crate", "")
UNIT = np.array([1.0, 0.0, 0.0, 0.0])
STALL = 100

STUCK = Progress(
    error=0.05,
    error_rot=0.0,
    speed=0.0,
    rate=0.0,
    goal_rho=FAR,
    rho=FAR,
    force=np.zeros(3),
    tau_limits=np.zeros(7),
    tau_max=np.full(7, 80.0),
    tau_wanted=np.full(7, 10.0),
    damped=False,
    cut=0,
    rho0=0.1,
)


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
    assert arrived(near, goal())
    changes: list[dict[str, Any]] = [{"error": 0.0031}, {"error_rot": 0.0151}, {"speed": 0.06}, {"rate": 0.3}]
    for change in changes:
        assert not arrived(near._replace(**change), goal())


def test_at_rest_is_slow_in_both():
    assert at_rest(STUCK)
    assert not at_rest(STUCK._replace(speed=0.02))
    assert not at_rest(STUCK._replace(rate=0.1))


def test_a_resting_arm_is_given_time_before_it_is_said_to_be_held():
    assert diagnose(STUCK, goal(), STALL - 1, STALL) == (Status.MOVING, -1)
    assert diagnose(STUCK, goal(), STALL, STALL)[0] != Status.MOVING


def test_arriving_goes_before_everything():
    there = STUCK._replace(error=0.001, cut=int(Cut.MAGNITUDE), damped=True)
    assert diagnose(there, goal(), 10 * STALL, STALL) == (Status.ARRIVED, -1)


def pushed(slot: int, newton: float) -> np.ndarray:
    force = np.zeros(3)
    force[slot] = newton
    return force


def limited(joint: int, torque: float) -> np.ndarray:
    tau = np.zeros(7)
    tau[joint] = torque
    return tau


@pytest.mark.parametrize(
    ("change", "status", "blocker"),
    [
        ({"cut": int(Cut.MOTION_SCALED), "tau_wanted": limited(3, -90.0)}, Status.SATURATED, 3),
        ({"cut": int(Cut.MAGNITUDE), "tau_wanted": limited(5, 90.0)}, Status.SATURATED, 5),
        ({"goal_rho": np.array([np.inf, 0.05, np.inf]), "force": pushed(1, 20.0)}, Status.SHADOWED, 1),
        ({"force": pushed(1, 20.0)}, Status.LOCAL_MINIMUM, 1),
        ({"tau_limits": limited(4, -20.0)}, Status.LIMITED, 4),
        ({"damped": True}, Status.SINGULAR, -1),
        ({}, Status.LOCAL_MINIMUM, -1),
    ],
)
def test_what_holds_the_arm_is_named(change: dict[str, Any], status: Status, blocker: int):
    assert diagnose(STUCK._replace(**change), goal(), STALL, STALL) == (status, blocker)


def test_an_obstacle_near_the_goal_that_does_not_push_casts_no_shadow():
    near = STUCK._replace(goal_rho=np.array([np.inf, 0.05, np.inf]))
    assert diagnose(near, goal(), STALL, STALL)[0] != Status.SHADOWED

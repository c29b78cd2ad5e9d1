"""Which goals a vehicle takes."""

import math

import numpy as np

from rtctl.types import F64, Goal

FASTEST, LONGEST = 100.0, 3600.0  # [m/s, rad/s] of a goal, [s] of its time-out
RESTS = "a goal that rests: a base follows no stream"


def moves(goal: Goal) -> bool:
    """Return whether there is nothing to arrive at."""
    return goal.velocity is not None or goal.omega is not None


def refusal(goal: Goal, base: F64, reach: float, goal_rho: F64, names: tuple[str, ...]) -> str:
    """Return why a goal cannot be taken, '' when it can.

    base (3,) [m] is the shoulder the reach [m] is measured from; goal_rho (K,) [m] from the goal to each obstacle.
    """
    if not (np.isfinite(goal.position).all() and np.isfinite(goal.wxyz).all()):
        return "goal: got a number that is not finite, wanted finite ones"
    if abs(math.hypot(*goal.wxyz) - 1.0) > 1e-3:
        return f"goal: got wxyz {goal.wxyz}, wanted a unit quaternion"
    if not all(each is None or bool((np.abs(each) <= FASTEST).all()) for each in (goal.velocity, goal.omega)):
        return f"goal: got a velocity of {goal.velocity} m/s, {goal.omega} rad/s, wanted numbers up to {FASTEST:g}"
    if goal.timeout is not None and not 0.0 < goal.timeout <= LONGEST:
        return f"goal: got a time-out of {goal.timeout} s, wanted one up to {LONGEST:g} s"
    d = math.dist(goal.position, base)
    if d > reach:
        return f"goal: got {d:.3f} m from the base, wanted at most the arm's reach of {reach:.3f} m"
    k = int(goal_rho.argmin())
    if goal_rho[k] < 0.0:
        return f"goal: lies {-goal_rho[k]:.3f} m inside obstacle {names[k]}"
    return ""

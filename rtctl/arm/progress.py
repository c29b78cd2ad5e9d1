"""Goals: which are taken, and when one is reached."""

import math
from typing import NamedTuple

from rtctl.arm.estimator import TipEstimate
from rtctl.arm.task import selected, task_error
from rtctl.kernel import kernel
from rtctl.kernel.reductions import norm
from rtctl.types import F64, Goal

STILL_SPEED = 1e-2  # [m/s] and, times 4, [rad/s]: a resting tip seems this fast at most: speeds come in steps
GAIN = 0.12  # of full speed: who comes nearer more slowly is held by something
DRIFT_TIME = 0.2  # [s] over which the tip's velocity is averaged: who trembles at 2 Hz or more gets nowhere


class Progress(NamedTuple):
    """How far the tip is from its goal, and how fast."""

    error: float  # [m]
    error_rot: float  # [rad], 0 for a position task
    speed: float  # [m/s] of the tip
    rate: float  # [rad/s] of the tip, 0 for a position task


@kernel
def progress_of(task: int, axis: F64, position: F64, wxyz: F64, x: F64, R: F64, xd: F64, omega: F64) -> Progress:
    """Return how far the tip at x, R is from a goal and how fast it is, along what the task constrains."""
    e, e_rot = task_error(task, axis, position, wxyz, x, R)
    v, w = selected(task, axis, R, xd, omega)
    return Progress(norm(e), norm(e_rot), norm(v), norm(w))


def progress(goal: Goal, tip: TipEstimate) -> Progress:
    """Return how far the tip is from a goal and how fast it is, along what the goal constrains."""
    return progress_of(int(goal.task), goal.axis, goal.position, goal.wxyz, tip.x, tip.R, tip.xd, tip.omega)


@kernel
def arrived(p: Progress, tolerance: float, tolerance_rot: float) -> bool:
    """Return whether the tip rests within the goal's tolerances [m], [rad]."""
    return p.error <= tolerance and p.error_rot <= tolerance_rot and p.speed < 0.05 and p.rate < 0.2


@kernel
def at_rest(p: Progress) -> bool:
    """Return whether the tip is still."""
    return p.speed < STILL_SPEED and p.rate < 4.0 * STILL_SPEED


@kernel
def take_drift(drift: F64, xd: F64, dt: float) -> None:
    """Move drift (3,) [m/s], the tip's velocity averaged over DRIFT_TIME, on by a tick of dt [s] at xd (3,) [m/s].

    A tip that is driven to and fro across a place where two links or obstacles change their nearest points is fast, but
    its drift is not.
    """
    for i in range(3):
        behind = xd[i] - drift[i]
        drift[i] = drift[i] + behind * min(dt / DRIFT_TIME, 1.0) if math.isfinite(behind) else 0.0


@kernel
def slow(p: Progress) -> bool:
    """Return whether the tip goes nowhere at this speed. How fast it turns says nothing: to the goal is what counts."""
    return p.speed < 4.0 * STILL_SPEED


@kernel
def time_left(p: Progress, v_max: float, w_max: float) -> float:
    """Return the time [s] that the goal is away at full speed [m/s], [rad/s]."""
    return max(p.error / v_max, p.error_rot / w_max)


@kernel
def stall_timer(before: float, p: Progress, left: float, nearest: float, dt: float, window: float) -> float:
    """Return for how long [s] the goal has not come nearer, `before` until a tick of dt [s] ago.

    left [s] away now, `nearest` it ever was. At GAIN of full speed the time stands still, faster it falls; half of what
    was left in a `window` [s] is enough: the last of a way is slow. It also falls while the tip moves fast, twice as
    quickly as it grew. p.speed is that of the drift where this is less: who trembles gets nowhere all the same.
    """
    if not slow(p):
        return max(0.0, before - 2.0 * dt)
    needed = min(GAIN, 0.5 * nearest / window)
    return max(0.0, before + dt - max(0.0, nearest - left) / max(needed, 1e-9))

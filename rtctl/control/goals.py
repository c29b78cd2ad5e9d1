"""Goals: which are taken, and what the controller says of its progress (its level of competence)."""

import math
from typing import NamedTuple

import numpy as np

from rtctl.types import F64, Cut, Goal, Status

STILL_SPEED = 1e-2  # [m/s] and, times 4, [rad/s]: a resting tip seems this fast at most: speeds come in steps


class Progress(NamedTuple):
    """What the diagnosis looks at, all of this tick."""

    error: float  # [m]
    error_rot: float  # [rad], 0 for a position task
    speed: float  # [m/s] of the tip
    rate: float  # [rad/s] of the tip
    goal_rho: F64  # (K,) [m] from the goal to each obstacle's surface, inf where there is none
    rho: F64  # (K,) [m] from the arm to each
    force: F64  # (K,) [N] magnitude of each obstacle's push
    tau_limits: F64  # (n,) [Nm] of the joint-limit potential
    tau_max: F64  # (n,) [Nm]
    tau_wanted: F64  # (n,) [Nm]
    damped: bool  # Lambda is being damped
    cut: int  # types.Cut
    rho0: float  # [m] influence


def refusal(goal: Goal, base: F64, reach: float, goal_rho: F64, names: tuple[str, ...]) -> str:
    """Return why a goal cannot be taken, '' when it can.

    base (3,) [m] is the shoulder the reach [m] is measured from; goal_rho (K,) [m] from the goal to each obstacle.
    """
    if not (np.isfinite(goal.position).all() and np.isfinite(goal.wxyz).all()):
        return "goal: got a number that is not finite, wanted finite ones"
    if abs(math.hypot(*goal.wxyz) - 1.0) > 1e-3:
        return f"goal: got wxyz {goal.wxyz}, wanted a unit quaternion"
    d = math.dist(goal.position, base)
    if d > reach:
        return f"goal: got {d:.3f} m from the base, wanted at most the arm's reach of {reach:.3f} m"
    k = int(goal_rho.argmin())
    if goal_rho[k] < 0.0:
        return f"goal: lies {-goal_rho[k]:.3f} m inside obstacle {names[k]}"
    return ""


def arrived(p: Progress, goal: Goal) -> bool:
    """Return whether the tip rests within the goal's tolerances."""
    return p.error <= goal.tolerance and p.error_rot <= goal.tolerance_rot and p.speed < 0.05 and p.rate < 0.2


def at_rest(p: Progress) -> bool:
    """Return whether the tip is still."""
    return p.speed < STILL_SPEED and p.rate < 4.0 * STILL_SPEED


def diagnose(p: Progress, goal: Goal, still: int, stall_ticks: int) -> tuple[Status, int]:
    """Return the status and what holds the arm: an obstacle slot, a joint index, or -1.

    An arm that rests short of its goal for `stall_ticks` is held by something. The causes are tried from the one
    that hides the others: torque that ran out, then joint limits, then a lost direction, then obstacles.
    """
    if arrived(p, goal):
        return Status.ARRIVED, -1
    if still < stall_ticks:
        return Status.MOVING, -1
    ratio = np.abs(p.tau_wanted) / p.tau_max
    if p.cut & (Cut.MAGNITUDE | Cut.MOTION_SCALED):
        return Status.SATURATED, int(ratio.argmax())
    nearest = int(p.goal_rho.argmin())
    pushing = int(p.force.argmax())
    if p.goal_rho[nearest] < p.rho0 and p.force[pushing] > 0.0:
        return Status.SHADOWED, nearest
    share = np.abs(p.tau_limits) / p.tau_max
    if float(share.max()) > 0.02 and p.force[pushing] < 1.0:
        return Status.LIMITED, int(share.argmax())
    if p.force[pushing] > 0.0:
        return Status.LOCAL_MINIMUM, pushing
    if float(share.max()) > 1e-3:
        return Status.LIMITED, int(share.argmax())
    if p.damped:
        return Status.SINGULAR, -1
    return Status.LOCAL_MINIMUM, -1

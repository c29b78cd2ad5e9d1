"""Turning on the spot: to the heading that a goal asks for.

Wheels that turn on the spot sweep the circle about the origin that holds the footprint, and nothing else.
"""

import math

from rtctl.rover.estimator import wrapped
from rtctl.rover.memory import BaseMemory
from rtctl.rover.robot import Base
from rtctl.types import Goal, Status, Task

GAIN = 1.5  # [1/s] of the yaw rate to the angle that is left
FULL = 0.3  # of the tolerance, within which an angle counts as none: a turn ends, and does not creep
BEGIN = 0.5  # of the goal's tolerance that a turn begins within: the wheels slip while they turn
SETTLED = 1.0  # [s] at rest after which the whole tolerance will do


def heading_of(goal: Goal) -> float:
    """Return the heading [rad] of a goal counter-clockwise from east, NaN of one that has none."""
    if not goal.task & Task.RZ:
        return math.nan
    return 2.0 * math.atan2(float(goal.wxyz[3]), float(goal.wxyz[0]))


def left(goal: Goal, yaw: float) -> float:
    """Return the angle [rad] from yaw to the goal's heading the shorter way round, 0 where the goal has none."""
    heading = heading_of(goal)
    return 0.0 if math.isnan(heading) else wrapped(heading - yaw)


def refusal(base: Base, goal: Goal) -> str:
    """Return why a base cannot take a goal's orientation, '' when it can."""
    turn = goal.task & (Task.ORIENTATION | Task.DIRECTION)
    if turn not in (Task(0), Task.RZ):
        return "goal: got an orientation, wanted heading_rad alone: a base turns in no other way"
    if not turn:
        return ""
    r = base.limits.radius
    if r > 0.0:
        return f"goal: got a heading, wanted none: this base turns in circles of {r:g} m, not on the spot"
    if base.world_velocity:
        return "goal: got a heading, wanted none: PX4 takes a velocity and turns as it thinks best"
    return ""


def wanted(base: Base, m: BaseMemory) -> float:
    """Return the heading [rad] that the base is to turn to where it stands, NaN while it has none to turn to."""
    if m.goal is None or m.status == Status.ARRIVED:
        return math.nan
    away = math.dist(m.goal.position[:2], m.here.x)
    turning = not math.isnan(m.turn)
    settled = turning or m.rest * base.dt >= SETTLED
    near = away <= m.goal.tolerance * (1.0 if settled else BEGIN) and math.hypot(*m.here.v) < 0.3
    return heading_of(m.goal) if near else math.nan


def rate(base: Base, angle: float, tolerance: float) -> float:
    """Return the yaw rate [rad/s] for an angle [rad] that is left: braked at half alpha_max, none when it is small."""
    size = abs(angle)
    if size <= FULL * tolerance:
        return 0.0
    fast = min(base.limits.w_max, GAIN * size, math.sqrt(base.limits.alpha_max * size))
    return math.copysign(fast, angle)

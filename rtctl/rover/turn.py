"""Turning on the spot: to the heading that a goal asks for, and to see what the base has not seen.

A base that stands because the way ahead is unknown faces where it wants to go, then brings the nearest place that it
has not seen into the sectors that know something, one place after another, and faces its way again. What was seen
counts for `seen` [s]: a sensor that is blind over a wide angle needs that to be long. After LOOKS from one place the
base stands for good.

Wheels that turn on the spot sweep the circle about the origin that holds the footprint, and nothing else.
"""

import math

import numpy as np

from rtctl.rover import law, legs, occupancy
from rtctl.rover.estimator import wrapped
from rtctl.rover.memory import NO_LOOK, BaseMemory, Look
from rtctl.rover.robot import Base
from rtctl.types import F64, Goal, Status, Task

GAIN = 3.0  # [1/s] of the yaw rate to the angle that is left
FULL = 0.3  # of the tolerance, within which an angle counts as none: a turn ends, and does not creep
BEGIN = 0.5  # of the goal's tolerance that a turn begins within: the wheels slip while they turn
LOOK_AFTER = 0.3  # [s] for which what was not seen has held the base, before it looks
LOOKS = 6  # from one place
STEP = 0.3  # [m] away that is another place
FRESH = 0.75  # of the time that what was seen counts for, after which it is looked at anew
FACING = 0.15  # [rad] from where it wants to go that counts as facing it
LOOK_TOLERANCE = 0.1  # [rad]
LEAVE = 0.25  # [rad] off the heading of its leg at which the base stops and turns to it again
SLIDES = 0.15  # [m/s] above which it does not turn
SLACK = 0.6  # [s] beside turning and lag for a scan to come
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


def onto_leg(base: Base, m: BaseMemory) -> float:
    """Return the heading [rad] of the leg that the base is to turn to, NaN while it faces along it, or has none.

    It comes to rest first: a base that turns while it slides sweeps more than its outline.
    """
    heading = legs.heading(m.way)
    if math.isnan(heading):
        return math.nan
    turning = not math.isnan(m.turn)
    if abs(wrapped(heading - m.here.yaw)) <= (FULL * LOOK_TOLERANCE if turning else LEAVE):
        return math.nan
    return m.here.yaw if math.hypot(*m.here.v) > SLIDES else heading


def rate(base: Base, m: BaseMemory, yaw: float) -> float:
    """Return the yaw rate [rad/s] to m.turn from yaw [rad]: braked at half alpha_max, none when little is left."""
    asked = m.goal is not None and m.turn == heading_of(m.goal) and m.turn != m.look.heading
    angle, tolerance = wrapped(m.turn - yaw), m.goal.tolerance_rot if asked and m.goal is not None else LOOK_TOLERANCE
    if abs(angle) <= FULL * tolerance:
        return 0.0
    fast = min(base.limits.w_max, GAIN * abs(angle), math.sqrt(base.limits.alpha_max * abs(angle)))
    return math.copysign(fast, angle)


def look_around(base: Base, m: BaseMemory) -> BaseMemory:
    """Return the memory with the look that is being made: begun, gone on with, or ended."""
    if m.goal is None or not len(m.way.corners) or base.limits.radius > 0.0 or base.world_velocity:
        return m._replace(look=NO_LOOK)
    aim, look = _bearing(m.here.x, m.way.corners[0]), m.look
    if math.dist(look.at, m.here.x) > STEP:
        m = m._replace(look=look._replace(made=0, at=m.here.x))
    oldest = m.tick - round(FRESH * base.safety.seen / base.dt)
    if math.isnan(look.heading):
        held = m.blind * base.dt >= LOOK_AFTER and math.hypot(*m.here.v) < 0.1
        turns = max(abs(m.w), abs(m.here.yaw_rate)) >= 0.1  # the law turns by itself
        if not held or turns or m.v_ref @ _unit(aim) <= 0.0:
            return m
    elif m.tick < look.until and not _over(m, oldest):
        return m
    return m._replace(look=_next(base, m, aim, oldest))


def _over(m: BaseMemory, oldest: int) -> bool:
    """Return whether a look has shown what it was made for, or has come to its heading."""
    if np.isfinite(m.look.place).all() and occupancy.known(m.chart, m.look.place, oldest):
        return True
    return abs(wrapped(m.look.heading - m.here.yaw)) <= LOOK_TOLERANCE


def _next(base: Base, m: BaseMemory, aim: float, oldest: int) -> Look:
    """Return the look that comes now; `aim` [rad] is where the base wants to go."""
    made, heading, far = m.look.made, aim, law.way_to_rest(base)
    facing = abs(wrapped(aim - m.here.yaw)) <= FACING
    place = occupancy.unseen_ahead(m.chart, m.here.x, _unit(aim), base.margins.hull, far, oldest)
    if place is not None and (facing or made > 0):
        heading = _into_view(base, m, place) if made < LOOKS else math.nan
    else:
        place = None
    if math.isnan(heading) or (place is None and facing):
        return m.look._replace(heading=math.nan)
    takes = abs(wrapped(heading - m.here.yaw)) / base.limits.w_max + 2.0 * base.margins.turn_lag + SLACK
    place = NO_LOOK.place if place is None else place
    return m.look._replace(heading=heading, until=m.tick + round(takes / base.dt), place=place, made=made + 1)


def _into_view(base: Base, m: BaseMemory, place: F64) -> float:
    """Return the nearest heading [rad] at which a place (2,) [m] is in sectors that know something, NaN: none."""
    f = m.last
    if f.scan_step == 0.0:
        return math.nan
    around = round(2.0 * math.pi / abs(f.scan_step))
    known = np.zeros(around, np.bool_)
    known[: len(f.scan)] = f.scan[:around] >= 0.0
    wide = math.ceil(0.7 * occupancy.CELL / max(math.dist(place, m.here.x), occupancy.CELL) / abs(f.scan_step)) + 1
    sees = np.logical_and.reduce([np.roll(known, k) for k in range(-wide, wide + 1)])
    headings = _bearing(m.here.x, place) - f.scan_start - f.scan_step * np.flatnonzero(sees)
    if not len(headings):
        return math.nan
    turns = np.remainder(headings - m.here.yaw + math.pi, 2.0 * math.pi) - math.pi
    return wrapped(m.here.yaw + float(turns[np.abs(turns).argmin()]))


def _bearing(x: F64, to: F64) -> float:
    return math.atan2(to[1] - x[1], to[0] - x[0])


def _unit(angle: float) -> F64:
    return np.array([math.cos(angle), math.sin(angle)])

"""What one tick of the base leaves to the next, as one value."""

import math
from typing import NamedTuple

import numpy as np

from rtctl.rover.estimator import Estimate
from rtctl.rover.faults import Counters
from rtctl.rover.occupancy import Chart
from rtctl.rover.path import Way
from rtctl.rover.signals import BaseFeedback
from rtctl.types import F64, I64, Goal, Severity, State, Status
from rtctl.world.obstacle_table import World


class Look(NamedTuple):
    """A turn on the spot that is made to see."""

    heading: float  # [rad] that is turned to, NaN: no look is being made
    until: int  # tick at which it is given up
    place: F64  # (2,) [m] that is to be seen, infinite: none
    made: int  # from where it stands
    at: F64  # (2,) [m] there


NO_LOOK = Look(math.nan, 0, np.full(2, math.inf), 0, np.zeros(2))


class BaseMemory(NamedTuple):
    """Everything a tick knows of the past."""

    tick: int
    # supervisor
    state: State
    since: int  # tick of entering the state
    reaction: Severity
    off: bool  # SAFE_STOP does not stream any more
    hold_asked: bool  # SAFE_STOP asked for the autopilot's hold mode
    in_force: int
    good: I64  # (faults,)
    counters: Counters
    entered: bool  # our mode was seen since ARMED
    mine: bool  # we armed the vehicle and nobody took it since
    leaving: bool
    done: bool
    refusal: str
    # estimate
    here: Estimate
    innovation: float  # [m] of the last report
    unheard: float  # [s] since the last position
    jump: bool
    rest: int  # ticks at rest
    last: BaseFeedback  # of the previous tick
    # task
    goal: Goal | None
    goal_rho: F64  # (K,)
    status: Status
    blocker: int
    turn: float  # [rad] heading that is turned to on the spot, NaN: none
    look: Look
    nearest: float  # [m] least length of way to the goal so far
    still: int  # ticks since that became less
    # world
    world: World
    chart: Chart
    free: F64  # (SIZE, SIZE) [m] as of the last look for a way
    scans: tuple[F64, ...]  # (m, 2) [m] returns of the last scan of each sensor, in the world
    way: Way
    due: int  # tick at which the way is looked for anew
    rho: F64  # (K,) [m] to each known obstacle
    rho_seen: float  # [m] to the nearest return
    # command
    v_ref: F64  # (2,) [m/s]
    v: float  # [m/s] last sent
    w: float  # [rad/s]
    allowed_seen: float  # [m/s] by what was seen ahead
    blind: int  # ticks that this has held the base
    dark: int  # ticks that what was not seen has held a turn of an outline that is no circle
    unfixed: float  # [s] without a GPS that there was
    asked: F64  # (2,) [m/s, rad/s] twist that was asked for, as late as it takes effect, smoothed
    did: F64  # (2,) the twist that came of it, smoothed alike
    unanswered: F64  # (2,) [s] for which little of it came
    sent: F64  # (h, 2) the last twists [m/s, rad/s], newest first: what is still on its way to the wheels

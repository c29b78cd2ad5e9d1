"""The fault table: what can go wrong at run time, how it is seen, and what the arm does about it.

Faults are values. Each tick `detect` says which are present; `TABLE.latch` keeps those that only an operator may clear.
The row numbers are those of the published catalogue; docs/faults.md has the table that is printed from FAULTS.
"""

from typing import NamedTuple

import numpy as np

from rtctl.arm import detection
from rtctl.control.faults import Fault, FaultTable
from rtctl.kernel import kernel
from rtctl.types import B1, F64, I64, Feedback, Link, Severity, State

JUMP_WINDOW = 50  # cycles in which a second jump makes a fault of a glitch
PASSIVE_TIME = 1.0  # [s] for which the arm moves on with a controller that is error-passive

FAULT_CODES = {
    0x8: "over-voltage",
    0x9: "under-voltage",
    0xA: "over-current",
    0xB: "MOS hot",
    0xC: "coil hot",
    0xD: "communication lost",
    0xE: "overload",
}


MOTION = ("position", "speed")  # what an encoder tells
ALL = (*MOTION, "torque")

FAULTS = (
    Fault("feedback_stale", 2, Severity.SS2, "A", "a joint was silent for more than 3 periods"),
    Fault("feedback_lost", 2, Severity.SS1, "R", "a joint was silent for more than 10 periods", (*MOTION, "link")),
    Fault("duplicate_reply", 4, Severity.LOG, "A", "a joint answered more than once in a cycle"),
    Fault("disorder", 5, Severity.SS2, "R", "replies keep overtaking each other"),
    Fault("corrupt_frames", 6, Severity.SS2, "R", "3 of 10 cycles had a frame with a wrong CRC, length or id"),
    Fault("foreign_command", 8, Severity.SS1, "L", "somebody else sends our command ids", ("torque",)),
    Fault("rx_overflow", 9, Severity.LOG, "A", "the receive queue overflowed"),
    Fault("error_passive", 10, Severity.LOG, "A", "the controller went error-passive"),
    Fault("bus_off", 11, Severity.SS1, "R", "the controller went bus-off", ("link",)),
    Fault("send_failed", 12, Severity.SS1, "R", "commands were dropped in two ticks running", ("link",)),
    Fault("link_down", 13, Severity.SS1, "R", "the interface is down or gone", ("link",)),
    Fault("drive_fault", 15, Severity.SS1, "R", "a drive reports a fault"),
    Fault("drive_disabled", 17, Severity.SS1, "R", "a drive left the enabled state by itself"),
    Fault("torque_mismatch", 18, Severity.SS1, "R", "a drive's torque is not the one it was sent", ("torque",)),
    Fault(
        "encoder_stuck",
        19,
        Severity.SS1,
        "R",
        "a position stands still though the joint must move",
        ("position", "speed"),
    ),
    Fault(
        "encoder_jump",
        20,
        Severity.SS1,
        "R",
        "a position jumped twice by more than the joint can move",
        ("position", "speed"),
    ),
    Fault(
        "velocity_mismatch",
        21,
        Severity.SS1,
        "R",
        "a joint's speed is not that of its positions",
        ("position", "speed"),
    ),
    Fault("not_finite", 25, Severity.SS1, "L", "a state or torque was not finite", MOTION),
    Fault("deadline", 30, Severity.SS2, "R", "3 slots running, or 10 periods, were missed"),
    Fault("goal_in_obstacle", 43, Severity.SS2, "A", "the goal lies inside an obstacle"),
    Fault("contact", 44, Severity.SS2, "R", "an obstacle touches a point of the arm"),
    Fault("feed_stale", 45, Severity.SS2, "A", "a moving obstacle was not observed for too long"),
    Fault("outside_limits", 50, Severity.SS1, "R", "a joint is beyond its limit"),
    Fault("overspeed", 50, Severity.SS1, "R", "a joint is faster than its limit allows"),
    Fault(
        "innovation",
        21,
        Severity.SS1,
        "R",
        "measurement and estimate disagree beyond the bound",
        ("position", "speed", "torque"),
    ),
    Fault("log_degraded", 51, Severity.LOG, "A", "the log cannot be written; arming is refused"),
    Fault("collision", 24, Severity.SS2, "R", "something pushes the arm that nobody told of"),
    Fault("collision_hard", 24, Severity.SS1, "R", "something struck the arm"),
    Fault("goal_stale", 47, Severity.SS2, "A", "no goal of a stream came within the time-out of the last"),
    Fault("error_passive_long", 10, Severity.SS2, "A", "the controller has been error-passive for a second"),
)
TABLE = FaultTable.of(FAULTS)
BIT, names, severity = TABLE.bit, TABLE.names, TABLE.severity
REFUSES_ARMING = ~BIT["duplicate_reply"]  # every other fault, while present, refuses arming
AUTOMATIC = TABLE.automatic
STOPS, BRAKES = (  # bits of the faults that ask for SS2 or more: those that an operator must reset, and all
    sum(1 << i for i, fault in enumerate(FAULTS) if fault.severity >= Severity.SS2 and fault.clear in clear)
    for clear in ("RL", "ARL")
)
DISTRUST = sum(  # bits of the faults after which a torque that follows from the measurements may drive the arm away
    1 << i for i, fault in enumerate(FAULTS) if {"position", "speed", "torque"} & set(fault.untrue)
)
ASTRAY = DISTRUST | BIT["contact"] | BIT["outside_limits"]  # while it stops: it does not go as it should
_DISABLED, _TORQUE, _FAULT, _JUMPS = detection.DISABLED, detection.TORQUE, detection.FAULT, (1 << JUMP_WINDOW) - 1
_CORRUPT, _SEND_FAILED, _DERATED, _PASSIVE = (
    int(Link.CORRUPT),
    int(Link.SEND_FAILED),
    int(Link.DERATED),
    int(Link.ERROR_PASSIVE),
)  # plain integers: a flag's & is slow
_BY_LINK = tuple(
    (int(flag), BIT[name])
    for flag, name in (
        (Link.DUPLICATE, "duplicate_reply"),
        (Link.DISORDER, "disorder"),
        (Link.FOREIGN_COMMAND, "foreign_command"),
        (Link.OVERFLOW, "rx_overflow"),
        (Link.ERROR_PASSIVE, "error_passive"),
        (Link.BUS_OFF, "bus_off"),
        (Link.DOWN, "link_down"),
        (Link.LOG_DEGRADED, "log_degraded"),
    )
)


class _Bits(NamedTuple):
    """The bits of the faults that `detect` finds in the evidence, as compiled code reads them."""

    feedback_stale: int = BIT["feedback_stale"]
    feedback_lost: int = BIT["feedback_lost"]
    corrupt_frames: int = BIT["corrupt_frames"]
    send_failed: int = BIT["send_failed"]
    drive_fault: int = BIT["drive_fault"]
    drive_disabled: int = BIT["drive_disabled"]
    torque_mismatch: int = BIT["torque_mismatch"]
    encoder_stuck: int = BIT["encoder_stuck"]
    velocity_mismatch: int = BIT["velocity_mismatch"]
    encoder_jump: int = BIT["encoder_jump"]
    not_finite: int = BIT["not_finite"]
    deadline: int = BIT["deadline"]
    goal_in_obstacle: int = BIT["goal_in_obstacle"]
    contact: int = BIT["contact"]
    feed_stale: int = BIT["feed_stale"]
    outside_limits: int = BIT["outside_limits"]
    overspeed: int = BIT["overspeed"]
    innovation: int = BIT["innovation"]
    collision: int = BIT["collision"]
    collision_hard: int = BIT["collision_hard"]
    goal_stale: int = BIT["goal_stale"]
    error_passive_long: int = BIT["error_passive_long"]


_B = _Bits()


class Bounds(NamedTuple):
    """The bounds of SafetyParams that compare with one number of the evidence."""

    stale_periods: float
    lost_periods: float
    feed_timeout: float  # [s]


class SafetyParams(NamedTuple):
    """Bounds of the detectors."""

    stale_periods: int  # SS2 beyond it
    lost_periods: int  # SS1 beyond it
    torque_tolerance: F64  # (n,) [Nm] of sent against echoed torque
    friction: F64  # (n,) [Nm] that may hold a joint against the model
    velocity_tolerance: F64  # (n,) [rad/s] of the filtered difference of speeds
    speed_tolerance: float  # overspeed beyond this fraction of qd_max
    limit_tolerance: float  # [rad] beyond a joint limit before it is a fault
    innovation_max: float  # [standard deviations]
    feed_timeout: float  # [s] of a moving obstacle's observation
    creep: float = 0.1  # [m/s] speed that observed obstacles may have beside the one that is told


class Evidence(NamedTuple):
    """What the pipe tells the detectors beside the link's flags."""

    flags: int  # of `detection`
    age: float  # [s] oldest reply of a joint
    feed_age: float  # [s] oldest observation of a moving obstacle
    missed: int  # slots
    active: bool  # drives are meant to be enabled
    powered: bool  # torque flows, or is being switched on
    implausible: bool  # a joint's position is further than it can have moved
    slew_follows_echo: bool  # the slew follows the echo, not what was sent
    armed_outside: bool  # recovery: being outside the limits is known and allowed
    not_finite: bool
    has_goal: bool
    innovation: float


class Counters(NamedTuple):
    """Consecutive or windowed occurrences; plain integers so that replay carries them."""

    corrupt_window: int = 0  # last 10 cycles, one bit each
    send_failed: int = 0
    disabled: int = 0
    mismatch: int = 0
    slew_follows_echo: int = 0
    jumps: int = 0  # last JUMP_WINDOW cycles, one bit each
    missed: int = 0
    innovation: int = 0
    passive: int = 0


@kernel
def implausible_positions(
    q: F64, age: F64, replies: I64, q_previous: F64, age_previous: F64, qd_max: F64, elapsed: float, dt: float
) -> B1:
    """Return which joints (n,) report a position [rad] that they cannot have reached since the last plausible one.

    q_previous was `age_previous` [s] old `elapsed` [s] ago, q is `age` [s] old now; dt [s] is the servo period.
    """
    out = np.zeros(q.shape[0], np.bool_)
    for i in range(q.shape[0]):
        apart = elapsed + age_previous[i] - age[i]  # of the two measurements
        reach = 1.5 * qd_max[i] * max(apart, dt) + 2e-3  # two quantisation steps of a coarse encoder
        out[i] = replies[i] > 0 and np.isfinite(q[i]) and abs(q[i] - q_previous[i]) > reach
    return out


@kernel
def _count(bits: int) -> int:
    """Return how many bits are set."""
    count = 0
    while bits:
        bits &= bits - 1
        count += 1
    return count


@kernel
def _grown(count: int, here: bool) -> int:
    """Return how many ticks running something is there."""
    return count + 1 if here else 0


@kernel
def counted(link: int, e: Evidence, c: Counters, innovation_max: float) -> Counters:
    """Return the counters after a tick; link: types.Link of it."""
    flags, active = e.flags, e.active
    corrupt = 1 if link & _CORRUPT else 0
    gives = active and flags & _FAULT == 0  # a drive that reports a fault gives no torque, and has said so
    return Counters(
        ((c.corrupt_window << 1) | corrupt) & 0x3FF,
        _grown(c.send_failed, link & _SEND_FAILED != 0),
        _grown(c.disabled, active and flags & _DISABLED != 0),
        _grown(c.mismatch, gives and flags & _TORQUE != 0),
        _grown(c.slew_follows_echo, gives and e.slew_follows_echo and link & _DERATED == 0),
        ((c.jumps << 1) | (1 if e.implausible else 0)) & _JUMPS if active else 0,
        _grown(c.missed, e.missed != 0),
        _grown(c.innovation, active and not e.innovation <= innovation_max),
        _grown(c.passive, link & _PASSIVE != 0),
    )


@kernel
def detect(link: int, e: Evidence, n: Counters, p: Bounds, dt: float) -> int:
    """Return the bits of the faults present at this tick; link: types.Link of it; n: the counters with it counted."""
    flags, active = e.flags, e.active
    half = 0.5 * dt  # ages are whole periods; half a one keeps rounding out of the comparison
    bits = 0
    if e.age > p.stale_periods * dt + half:
        bits |= _B.feedback_stale
    if e.age > p.lost_periods * dt + half or flags & detection.UNHEARD:
        bits |= _B.feedback_lost
    if _count(n.corrupt_window) >= 3:
        bits |= _B.corrupt_frames
    if n.send_failed >= 2:
        bits |= _B.send_failed
    if flags & detection.FAULT:
        bits |= _B.drive_fault
    if n.disabled >= 5:
        bits |= _B.drive_disabled
    if n.mismatch >= 5 or n.slew_follows_echo >= 5:
        bits |= _B.torque_mismatch
    if flags & detection.STUCK:
        bits |= _B.encoder_stuck
    if flags & detection.DISAGREE:
        bits |= _B.velocity_mismatch
    if _count(n.jumps) >= 2:
        bits |= _B.encoder_jump
    if e.not_finite or flags & detection.NOT_FINITE:
        bits |= _B.not_finite
    if e.powered and (n.missed >= 3 or e.missed >= 10):
        bits |= _B.deadline
    if e.has_goal and flags & detection.GOAL_INSIDE:
        bits |= _B.goal_in_obstacle
    if e.has_goal and flags & detection.GOAL_OLD:
        bits |= _B.goal_stale
    if active and flags & detection.CONTACT:
        bits |= _B.contact
    if e.feed_age > p.feed_timeout:
        bits |= _B.feed_stale
    if active and flags & detection.OUTSIDE and not e.armed_outside:
        bits |= _B.outside_limits
    if active and flags & detection.FAST:
        bits |= _B.overspeed
    if n.innovation >= 5 or flags & detection.UNEXPLAINED:
        bits |= _B.innovation
    if active and flags & (detection.TOUCHED | detection.STRUCK):
        bits |= _B.collision_hard if flags & detection.STRUCK else _B.collision
    if n.passive * dt > PASSIVE_TIME - half:
        bits |= _B.error_passive_long
    for flag, bit in _BY_LINK:
        if link & flag:
            bits |= bit
    return bits


def describe(bits: int, feedback: Feedback, joints: tuple[str, ...], state: State, link: str = "") -> str:
    """Return one line that names each fault: for drive faults the joint and its code, for contacts the link."""
    at = f" at {link}" if link else ""
    details = {"collision": at, "collision_hard": at}
    if bits & BIT["drive_fault"]:
        codes = [f"{joints[i]}: {FAULT_CODES.get(int(d), hex(int(d)))}" for i, d in enumerate(feedback.drive) if d > 1]
        details["drive_fault"] = f" ({', '.join(codes) or 'cleared since'})"
    return TABLE.describe(bits, state, details)

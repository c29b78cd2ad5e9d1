"""The fault table: what can go wrong at run time, how it is seen, and what the arm does about it.

Faults are values. Each tick `detect` says which are present; `TABLE.latch` keeps those that only an operator may clear.
The row numbers are those of the published catalogue; docs/faults.md has the table that is printed from FAULTS.
"""

from typing import NamedTuple

import numpy as np

from rtctl.arm import detection
from rtctl.control.faults import Fault, FaultTable
from rtctl.kernel import kernel
from rtctl.kernel.reductions import any_set
from rtctl.types import B1, F64, I64, Feedback, Link, Severity, State

JUMP_WINDOW = 50  # cycles in which a second jump makes a fault of a glitch

FAULT_CODES = {
    0x8: "over-voltage",
    0x9: "under-voltage",
    0xA: "over-current",
    0xB: "MOS hot",
    0xC: "coil hot",
    0xD: "communication lost",
    0xE: "overload",
}


FAULTS = (
    Fault("feedback_stale", 2, Severity.SS2, "A", "a joint was silent for more than 3 periods"),
    Fault("feedback_lost", 2, Severity.SS1, "R", "a joint was silent for more than 10 periods"),
    Fault("duplicate_reply", 4, Severity.LOG, "A", "a joint answered more than once in a cycle"),
    Fault("disorder", 5, Severity.SS2, "R", "replies keep overtaking each other"),
    Fault("corrupt_frames", 6, Severity.SS2, "R", "3 of 10 cycles had a frame with a wrong CRC, length or id"),
    Fault("foreign_command", 8, Severity.SS1, "L", "somebody else sends our command ids"),
    Fault("rx_overflow", 9, Severity.LOG, "A", "the receive queue overflowed"),
    Fault("error_passive", 10, Severity.LOG, "A", "the controller went error-passive"),
    Fault("bus_off", 11, Severity.SS1, "R", "the controller went bus-off"),
    Fault("send_failed", 12, Severity.SS1, "R", "commands were dropped in two ticks running"),
    Fault("link_down", 13, Severity.SS1, "R", "the interface is down or gone"),
    Fault("drive_fault", 15, Severity.SS1, "R", "a drive reports a fault"),
    Fault("drive_disabled", 17, Severity.SS1, "R", "a drive left the enabled state by itself"),
    Fault("torque_mismatch", 18, Severity.SS1, "R", "a drive's torque is not the one it was sent"),
    Fault("encoder_stuck", 19, Severity.SS1, "R", "a position stands still though the joint must move"),
    Fault("encoder_jump", 20, Severity.SS1, "R", "a position jumped twice by more than the joint can move"),
    Fault("velocity_mismatch", 21, Severity.SS1, "R", "a joint's speed is not that of its positions"),
    Fault("not_finite", 25, Severity.SS1, "L", "a state or torque was not finite"),
    Fault("deadline", 30, Severity.SS2, "R", "3 slots running, or 10 periods, were missed"),
    Fault("goal_in_obstacle", 43, Severity.SS2, "A", "the goal lies inside an obstacle"),
    Fault("contact", 44, Severity.SS2, "R", "an obstacle touches a point of the arm"),
    Fault("feed_stale", 45, Severity.SS2, "A", "a moving obstacle was not observed for too long"),
    Fault("outside_limits", 50, Severity.SS1, "R", "a joint is beyond its limit"),
    Fault("overspeed", 50, Severity.SS1, "R", "a joint is faster than its limit allows"),
    Fault("innovation", 21, Severity.SS1, "R", "measurement and estimate disagree beyond the bound"),
    Fault("log_degraded", 51, Severity.LOG, "A", "the log cannot be written; arming is refused"),
)
TABLE = FaultTable.of(FAULTS)
BIT, names, severity = TABLE.bit, TABLE.names, TABLE.severity
REFUSES_ARMING = ~BIT["duplicate_reply"]  # every other fault, while present, refuses arming
_CORRUPT, _SEND_FAILED, _DERATED = (
    int(Link.CORRUPT),
    int(Link.SEND_FAILED),
    int(Link.DERATED),
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

    seen: int  # flags of `notice`
    age: float  # [s] oldest reply of a joint
    feed_age: float  # [s] oldest observation of a moving obstacle
    missed: int  # slots
    active: bool  # drives are meant to be enabled
    powered: bool  # torque flows, or is being switched on
    jumped: bool  # a joint's position was dropped: further than it can have moved
    pulled: bool  # the slew follows the echo, not what was sent
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
    pulled: int = 0
    jumps: int = 0  # last JUMP_WINDOW cycles, one bit each
    missed: int = 0
    innovation: int = 0


@kernel
def jumped(
    q: F64, age: F64, replies: I64, q_previous: F64, age_previous: F64, qd_max: F64, elapsed: float, dt: float
) -> B1:
    """Return which joints (n,) report a position [rad] that they cannot have reached since the last one believed.

    q_previous was `age_previous` [s] old `elapsed` [s] ago, q is `age` [s] old now; dt [s] is the servo period.
    """
    out = np.zeros(q.shape[0], np.bool_)
    for i in range(q.shape[0]):
        apart = elapsed + age_previous[i] - age[i]  # of the two measurements
        reach = 1.5 * qd_max[i] * max(apart, dt) + 2e-3  # two quantisation steps of a coarse encoder
        out[i] = replies[i] > 0 and np.isfinite(q[i]) and abs(q[i] - q_previous[i]) > reach
    return out


def detect(link: int, e: Evidence, c: Counters, p: SafetyParams, dt: float) -> tuple[int, Counters]:
    """Return the bits of the faults present at this tick and the counters for the next; link: types.Link of it."""
    seen, active = e.seen, e.active
    half = 0.5 * dt  # ages are whole periods; half a one keeps rounding out of the comparison
    n = Counters(
        ((c.corrupt_window << 1) | bool(link & _CORRUPT)) & 0x3FF,
        c.send_failed + 1 if link & _SEND_FAILED else 0,
        c.disabled + 1 if active and seen & detection.DISABLED else 0,
        c.mismatch + 1 if active and seen & detection.TORQUE else 0,
        c.pulled + 1 if active and e.pulled and not link & _DERATED else 0,
        ((c.jumps << 1) | e.jumped) & ((1 << JUMP_WINDOW) - 1) if active else 0,
        c.missed + 1 if e.missed else 0,
        c.innovation + 1 if active and not e.innovation <= p.innovation_max else 0,
    )
    present = {
        "feedback_stale": e.age > p.stale_periods * dt + half,
        "feedback_lost": e.age > p.lost_periods * dt + half or seen & detection.UNHEARD,
        "corrupt_frames": n.corrupt_window.bit_count() >= 3,
        "send_failed": n.send_failed >= 2,
        "drive_fault": seen & detection.FAULT,
        "drive_disabled": n.disabled >= 5,
        "torque_mismatch": n.mismatch >= 5 or n.pulled >= 5,
        "encoder_stuck": seen & detection.STUCK,
        "velocity_mismatch": seen & detection.DISAGREE,
        "encoder_jump": n.jumps.bit_count() >= 2,
        "not_finite": e.not_finite or seen & detection.NOT_FINITE,
        "deadline": e.powered and (n.missed >= 3 or e.missed >= 10),
        "goal_in_obstacle": e.has_goal and seen & detection.GOAL_INSIDE,
        "contact": active and seen & detection.CONTACT,
        "feed_stale": e.feed_age > p.feed_timeout,
        "outside_limits": active and seen & detection.OUTSIDE and not e.armed_outside,
        "overspeed": active and seen & detection.FAST,
        "innovation": n.innovation >= 5,
    }
    bits = 0
    if any(present.values()):
        bits = sum(BIT[name] for name, here in present.items() if here)
    if link:
        bits |= sum(bit for flag, bit in _BY_LINK if link & flag)
    return bits, n


@kernel
def any_jumped(
    q: F64, age: F64, replies: I64, q_previous: F64, age_previous: F64, qd_max: F64, elapsed: float, dt: float
) -> bool:
    """Return whether `jumped` is true of any joint."""
    return any_set(jumped(q, age, replies, q_previous, age_previous, qd_max, elapsed, dt))


def describe(bits: int, feedback: Feedback, joints: tuple[str, ...], state: State) -> str:
    """Return one line that names each fault and, for drive faults, the joint and its code."""
    if not bits & BIT["drive_fault"]:
        return TABLE.describe(bits, state)
    codes = [f"{joints[i]}: {FAULT_CODES.get(int(d), hex(int(d)))}" for i, d in enumerate(feedback.drive) if d > 1]
    return TABLE.describe(bits, state, {"drive_fault": f" ({', '.join(codes) or 'cleared since'})"})

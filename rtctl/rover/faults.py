"""The base's fault table: rows 58 to 69 of the catalogue beside those it shares with the arm."""

import math
from typing import NamedTuple

from rtctl.control.faults import Fault, FaultTable
from rtctl.rover.robot import SafetyParams
from rtctl.rover.signals import BaseFeedback
from rtctl.types import Link, Severity

FAULTS = (
    Fault(
        "frames_refused", 58, Severity.LOG, "A", "frames came that are unsigned, forged, replayed or not the vehicle's"
    ),
    Fault("heartbeat_late", 62, Severity.SS2, "A", "the vehicle's heartbeat is late"),
    Fault("heartbeat_lost", 62, Severity.SS1, "R", "the vehicle's heartbeat is gone"),
    Fault("rebooted", 63, Severity.SS1, "R", "the autopilot started anew"),
    Fault("mode_taken", 64, Severity.SS1, "R", "a person or another program chose another mode"),
    Fault("disarmed", 64, Severity.SS1, "R", "the vehicle was disarmed by somebody else"),
    Fault("engage_refused", 65, Severity.LOG, "A", "the autopilot refused mode or arming, or did not answer"),
    Fault("estimator_bad", 66, Severity.SS2, "R", "the autopilot's own estimator has lost its position"),
    Fault("position_jump", 67, Severity.SS2, "R", "the position jumped further than the base can move"),
    Fault("position_stale", 69, Severity.SS2, "A", "position or attitude came too late"),
    Fault("position_lost", 69, Severity.SS1, "R", "position or attitude stopped coming"),
    Fault("scan_stale", 45, Severity.SS2, "A", "the range sensor's scan is too old"),
    Fault("feed_stale", 45, Severity.SS2, "A", "a moving obstacle was not observed for too long"),
    Fault("contact", 44, Severity.SS2, "R", "something touches the footprint"),
    Fault("goal_in_obstacle", 43, Severity.SS2, "A", "the goal lies inside an obstacle"),
    Fault("not_finite", 25, Severity.SS1, "L", "a state or command was not finite"),
    Fault("deadline", 30, Severity.SS2, "R", "3 slots running, or 10 periods, were missed"),
    Fault("send_failed", 12, Severity.SS1, "R", "frames were dropped in many ticks running"),
    Fault("link_down", 13, Severity.SS1, "R", "the link is closed or gone"),
    Fault("log_degraded", 51, Severity.LOG, "A", "the log cannot be written; arming is refused"),
    Fault("uplink_lost", 70, Severity.SS1, "R", "the vehicle is heard but answers nothing: it does not hear us"),
    Fault("no_effect", 71, Severity.SS2, "R", "the vehicle does not do what it is asked for"),
    Fault("gps_lost", 72, Severity.SS2, "A", "the vehicle's GPS has no fix: it reckons its position"),
    Fault("scan_wrong", 73, Severity.SS2, "R", "the scan turns with or against the vehicle: its frame is wrong"),
)
TABLE = FaultTable.of(FAULTS)
BIT, names, severity = TABLE.bit, TABLE.names, TABLE.severity
REFUSES_ARMING = ~(BIT["frames_refused"] | BIT["engage_refused"])
GPS_HOLD = 2.0  # [s] of reckoning, slowly, before the base holds: an EKF drifts by less than half a metre in it
SEND_TICKS = 10  # a UDP stack drops one now and then


class Evidence(NamedTuple):
    """What the pipe tells the detectors beside the feedback."""

    active: bool  # we stream set-points, or are braking
    engaged: bool  # the vehicle is armed in our mode on our request
    taken: bool  # a mode not ours was entered while we drove, by the feedback of this tick
    engage_failed: bool
    jump: bool
    not_finite: bool
    contact: bool
    goal_inside: bool
    feed_age: float  # [s]
    reboots: int  # as of the previous tick
    no_effect: bool  # little came of what was asked for, for long
    unfixed: float  # [s] without a GPS that there was


class Counters(NamedTuple):
    """Consecutive occurrences."""

    send_failed: int = 0
    missed: int = 0


def detect(f: BaseFeedback, e: Evidence, c: Counters, p: SafetyParams) -> tuple[int, Counters]:
    """Return the bits of the faults present at this tick and the counters for the next."""
    n = Counters(
        send_failed=c.send_failed + 1 if f.link & Link.SEND_FAILED else 0,
        missed=c.missed + 1 if f.missed else 0,
    )
    age = max(f.position_age, f.attitude_age)
    numbers = (*f.position, *f.velocity, f.yaw, f.yaw_rate)
    present = {
        "frames_refused": f.refused > 0,
        "heartbeat_late": f.heartbeat_age > p.heartbeat_hold,
        "heartbeat_lost": f.heartbeat_age > p.heartbeat_stop,
        "rebooted": f.reboots != e.reboots,
        "mode_taken": e.taken,
        "disarmed": e.engaged and not f.armed,
        "engage_refused": e.engage_failed,
        "estimator_bad": not f.healthy,
        "position_jump": e.jump,
        "position_stale": age > p.position_hold,
        "position_lost": age > p.position_stop,
        "scan_stale": p.scan and not f.known_age <= p.scan_stale,
        "feed_stale": e.feed_age > p.feed_timeout,
        "contact": e.contact and e.active,
        "goal_in_obstacle": e.goal_inside,
        "not_finite": e.not_finite or not all(map(math.isfinite, numbers)),
        "deadline": n.missed >= 3 or f.missed >= 10,
        "send_failed": n.send_failed >= SEND_TICKS,
        "link_down": bool(f.link & Link.DOWN),
        "log_degraded": bool(f.link & Link.LOG_DEGRADED),
        "uplink_lost": f.uplink_age > p.heartbeat_stop and f.heartbeat_age <= p.heartbeat_hold,
        "no_effect": e.no_effect and e.active,
        "gps_lost": e.unfixed > GPS_HOLD,
        "scan_wrong": p.scan and f.scan_wrong,
    }
    return sum(BIT[name] for name, here in present.items() if here), n

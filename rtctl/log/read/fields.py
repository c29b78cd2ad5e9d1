"""What the fields of a tick are, and in which unit: for people, axes, tables and units of files."""

import struct
from enum import Enum
from typing import NamedTuple, TypeAlias

import numpy as np

Number: TypeAlias = np.floating | np.integer | np.bool_
ULPS = 1_000_000  # beyond this many, units of the last place say nothing


class Field(NamedTuple):
    """A field of `arm.record` or `rover.record`."""

    unit: str  # '' for numbers without one
    text: str


FIELDS: dict[str, Field] = {
    "tick": Field("", "index of the tick since the start"),
    "slot": Field("", "index on the absolute grid"),
    "time": Field("s", "robot time, slot times period"),
    "missed": Field("", "slots skipped before this one"),
    "link": Field("", "flags of the bus, types.Link"),
    "q": Field("rad", "joint positions that the drives replied"),
    "qd": Field("rad/s", "joint speeds that the drives replied"),
    "tau_measured": Field("Nm", "joint torques that the drives replied"),
    "age": Field("s", "age of each joint's newest reply"),
    "replies": Field("", "replies of each joint in this cycle, 1 is healthy"),
    "drive": Field("", "status code of each drive"),
    "verb": Field("", "what the operator asked, types.Verb"),
    "lateness": Field("s", "how late this wake-up was"),
    "compute": Field("s", "time the previous turn took"),
    "x": Field("m", "tip position, estimated, world frame"),
    "xd": Field("m/s", "tip velocity, estimated"),
    "wxyz": Field("", "tip orientation, unit quaternion"),
    "omega": Field("rad/s", "tip angular velocity"),
    "innovation": Field("sigma", "disagreement of measurement and estimate"),
    "goal": Field("m", "position of the goal, or of the hold"),
    "goal_wxyz": Field("", "orientation of the goal"),
    "goal_axis": Field("", "axis of the tool that a direction is for, tip's frame"),
    "task": Field("", "what of the motion the goal constrains, types.Task"),
    "F": Field("m/s2, rad/s2", "command vector F* of the motion task"),
    "error": Field("m", "distance to the goal along the axes of the task"),
    "error_rot": Field("rad", "angle to the goal"),
    "sigma_min": Field("1/kg", "smallest eigenvalue of J A^-1 J^T"),
    "rho": Field("m", "smallest distance of the arm to each obstacle slot, inf where none"),
    "force": Field("N", "repulsion of each obstacle slot, summed over points"),
    "point": Field("", "the arm's point nearest to each obstacle slot"),
    "tau_motion": Field("Nm", "torque of the motion task"),
    "tau_obstacles": Field("Nm", "torque of the repulsion"),
    "tau_limits": Field("Nm", "torque that keeps joints off their limits"),
    "tau_posture": Field("Nm", "torque of the posture"),
    "tau_gravity": Field("Nm", "torque against gravity and Coriolis forces"),
    "tau_wanted": Field("Nm", "sum of the parts"),
    "tau_sent": Field("Nm", "torque that was sent, after the limits"),
    "command": Field("", "what was asked of the drives, types.Drive"),
    "cut": Field("", "protections that altered the torque, types.LimitFlag"),
    "state": Field("", "supervisor's state, types.State"),
    "status": Field("", "what holds the arm from its goal, types.Status"),
    "blocker": Field("", "obstacle slot or joint that holds it, -1 none"),
    "holders": Field("", "everything that holds it: bits of obstacle slots or joints"),
    "escape": Field("", "phase of the escape from a local minimum, arm.escape.Phase"),
    "severity": Field("", "worst reaction in force, types.Severity"),
    "faults": Field("", "faults in force, bit i is faults.FAULTS[i] of its vehicle"),
    "model_evaluated": Field("", "1 where the model was evaluated anew"),
    # what only a base has; the fields that it shares with an arm mean the same
    "goal_heading": Field("rad", "heading that a base's goal asks for, NaN: none"),
    "position": Field("m", "position that the autopilot told, east and north of its origin"),
    "velocity": Field("m/s", "velocity that the autopilot told, east and north"),
    "yaw": Field("rad", "heading that the autopilot told, counter-clockwise from east"),
    "yaw_rate": Field("rad/s", "turning rate that the autopilot told"),
    "position_age": Field("s", "age of the newest position"),
    "attitude_age": Field("s", "age of the newest attitude"),
    "fresh": Field("", "positions that came in this cycle"),
    "reset": Field("", "reset counter of the autopilot's estimator"),
    "scan": Field("m", "distance in each sector, inf: nothing there, negative: unknown"),
    "scan_start": Field("rad", "direction of sector 0 in the body's frame, counter-clockwise"),
    "scan_step": Field("rad", "angle to the next sector, negative: clockwise"),
    "scan_reach": Field("m", "range of the scan, what inf stands for"),
    "scan_age": Field("s", "age of the scan"),
    "scans": Field("", "1 where a scan came in this cycle"),
    "sensor": Field("", "sensor that the scan is of, by its place in the config"),
    "scan_offset": Field("m", "place of that sensor, ahead and to the left of the origin"),
    "scan_wrong": Field("", "1 where a sensor's frame contradicts the vehicle's motion"),
    "known_age": Field("s", "age of the newest scan or beam that knew anything"),
    "beams": Field("m", "distances of single sensors at 45 degree steps clockwise from the front, negative: unknown"),
    "beam_reach": Field("m", "range of the single sensors, what inf stands for"),
    "heartbeat_age": Field("s", "age of the newest heartbeat"),
    "uplink_age": Field("s", "time since we sent the newest thing that was answered"),
    "fix_lost": Field("", "1 where the satellite fix was had and is lost"),
    "quality": Field("", "quality of the autopilot's estimate by its own variances, 1 calm, 0 useless"),
    "ours": Field("", "1 where the mode is the one that we command in"),
    "mode": Field("", "custom_mode of the autopilot"),
    "armed": Field("", "1 where the autopilot is armed"),
    "reboots": Field("", "reboots of the autopilot since the start"),
    "healthy": Field("", "1 where the autopilot says that its position can be used"),
    "word": Field("", "the autopilot's answer to what was asked, types.Word"),
    "lost": Field("", "messages missing in this cycle, by their sequence"),
    "refused": Field("", "frames dropped in this cycle: unsigned, forged, replayed, unknown"),
    "heading": Field("rad", "heading, estimated"),
    "way": Field("m", "corners of the way to the goal"),
    "corners": Field("", "how many corners the way has"),
    "way_length": Field("m", "length of the way that is left"),
    "way_short": Field("m", "what the way ends short of the goal"),
    "push_told": Field("m/s2", "repulsion of each told obstacle"),
    "rho_seen": Field("m", "distance to the nearest thing seen, inf where none"),
    "push_seen": Field("m/s2", "repulsion of what is seen"),
    "xd_d": Field("m/s", "velocity towards the goal"),
    "v_ref": Field("m/s", "velocity asked for, east and north"),
    "allowed": Field("m/s", "speed that obstacles and brakes allow"),
    "allowed_seen": Field("m/s", "speed that what was seen allows"),
    "bias": Field("m/s", "speed that the autopilot tells at rest, estimated"),
    "asked": Field("m/s, rad/s", "speed and turning rate asked, delayed as the vehicle delays them"),
    "did": Field("m/s, rad/s", "speed and turning rate measured"),
    "v": Field("m/s", "speed sent"),
    "w": Field("rad/s", "turning rate sent"),
    "v_world": Field("m/s", "velocity sent, east and north"),
}


def called(kind: type[Enum], value: int) -> str:
    """Return the name of an enum's value, the number where it has none: a log may be of another version."""
    found = kind._value2member_map_.get(value)
    return found.name if found is not None else str(value)


def unit_of(name: str) -> str:
    """Return a field's unit, '' where it has none or is not known."""
    return FIELDS[name].unit if name in FIELDS else ""


def size_of(name: str, a: Number, b: Number) -> str:
    """Return how far two values of a field are apart, in its unit and in units of the last place."""
    if not isinstance(a, np.floating):
        return str(int(b) - int(a))
    unit = unit_of(name)
    apart = _ulps(float(a), float(b))
    steps = f" ({apart:+d} ulp)" if abs(apart) < ULPS else ""
    return f"{float(b) - float(a):.3g}{' ' if unit else ''}{unit}{steps}"


def _ulps(a: float, b: float) -> int:
    """Return how many doubles lie between two; the order of the bits is the order of the numbers."""
    one, two = (struct.unpack("<q", struct.pack("<d", x))[0] for x in (a, b))
    one, two = (x if x >= 0 else -(x & 0x7FFFFFFFFFFFFFFF) for x in (one, two))
    return int(two - one)

"""What the fields of a tick are, and in which unit: for people, axes, tables and units of files."""

import struct
from enum import Enum
from typing import NamedTuple, TypeAlias

import numpy as np

Number: TypeAlias = np.floating | np.integer | np.bool_
ULPS = 1_000_000  # beyond this many, units of the last place say nothing


class Field(NamedTuple):
    """A field of `control.record`."""

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
    "goal_heading": Field("rad", "heading that a base's goal asks for, NaN: none"),
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
    "escape": Field("", "phase of the escape from a local minimum, control.escape.Phase"),
    "severity": Field("", "worst reaction in force, types.Severity"),
    "faults": Field("", "faults in force, bit i is control.faults.FAULTS[i]"),
    "model_evaluated": Field("", "1 where the model was evaluated anew"),
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

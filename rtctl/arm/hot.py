"""What the servo level knows of the past, as one flat record of a fixed layout, `HOT`.

So it crosses into compiled code as one argument, and its bytes are the checkpoint's. Python reads and writes it here;
`memory.Memory` has its fields as properties.
"""

import struct
from collections.abc import Callable
from typing import Any

import numpy as np

from rtctl.arm.encoders import MONITORS
from rtctl.arm.escape import DIRECTIONS, Escape
from rtctl.arm.faults import Counters
from rtctl.arm.robot import JOINTS_MAX
from rtctl.plain import Json
from rtctl.types import F64, GOAL_TIMEOUT, I64, Goal, Record, RecordRow, Severity, State, Status, Task

FAULTS_MAX = 64  # bits of a word
MEASURED_POSTURE = 2  # `has_posture`: the links in it are known to keep the clearance
_JOINT, _INT, _REAL = (JOINTS_MAX,), "<i8", "<f8"

# One layout whatever the arm: arrays over joints are padded; see `law.prepared`.
HOT = np.dtype(
    (
        np.record,
        [
            ("tick", _INT),
            # supervisor
            ("state", _INT),  # types.State
            ("since", _INT),  # tick of entering the state
            ("reaction", _INT),  # types.Severity of SAFE_STOP and FAULT, NONE elsewhere
            ("onset", _REAL, _JOINT),  # [rad/s] speeds on entering the state
            ("onset_faults", _INT),  # bits of the faults present then
            ("off", _INT),  # SAFE_STOP has cut the torque and will not give it back
            ("present", _INT),  # bits of the faults seen this tick
            ("in_force", _INT),  # bits of the faults
            ("good", _INT, (FAULTS_MAX,)),  # ticks since each was present
            ("counters", _INT, (len(Counters._fields),)),
            ("parking", _INT),  # the goal is to park, then to disarm
            # a stop by the drives' own loops; see `own_loop`
            ("sinks", _INT),  # STOPPING lowers the arm before it cuts the torque
            ("own_phase", _INT),
            ("own_since", _INT),  # tick of its beginning
            ("own_p", _REAL, _JOINT),  # [rad]
            ("own_v", _REAL, _JOINT),  # [rad/s]
            ("own_kp", _REAL, _JOINT),  # [Nm/rad]
            ("own_kd", _REAL, _JOINT),  # [Nms/rad]
            ("own_t", _REAL, _JOINT),  # [Nm] the torque beside
            ("own_g", _REAL, _JOINT),  # [Nm] of it gravity's
            ("own_untrue", _INT),  # it began since a drive gave another torque than it was told
            ("lost", _INT),  # bits of the joints that cannot be held
            ("no_position", _INT),  # bits of the joints whose position is untrue
            ("no_speed", _INT),  # and whose speed is
            ("clear_until", _INT),  # tick until which latched drive faults are being cleared
            ("recovering", _INT),  # armed outside the joint limits, on request
            ("outside", _INT),  # a joint is beyond its limits
            ("leaving", _INT),  # SIGTERM came
            ("done", _INT),  # nothing more to do: the daemon may leave
            # estimates
            ("q", _REAL, _JOINT),  # [rad]
            ("qd", _REAL, _JOINT),  # [rad/s]
            ("P", _REAL, (JOINTS_MAX, 2, 2)),  # covariance of (q, qd)
            ("x", _REAL, (3,)),  # [m] the tip
            ("xd", _REAL, (3,)),  # [m/s]
            ("P_tip", _REAL, (2, 2)),
            ("R", _REAL, (3, 3)),
            ("omega", _REAL, (3,)),  # [rad/s]
            ("P_rot", _REAL, (2, 2)),
            ("innovation", _REAL),  # normalised, largest of this tick
            ("task", _INT),  # types.Task that `space` was evaluated for
            ("axis", _REAL, (3,)),  # of the tool that goes with it
            ("evaluated", _INT),  # the model, this tick
            ("phase", _REAL),  # model periods since the last evaluation was due, in (-1, 0]
            ("qdd", _REAL, _JOINT),  # [rad/s2] predicted from the torque of the last command
            ("q_previous", _REAL, _JOINT),  # [rad] of the last feedback
            ("age_previous", _REAL, _JOINT),  # [s] how old it was
            ("encoder_monitors", _REAL, (MONITORS, JOINTS_MAX)),  # on the encoders; see `encoders.monitor_encoders`
            ("rest", _INT),  # ticks all joints have been at rest
            # task
            ("has_goal", _INT),
            ("goal", _REAL, (3,)),  # as types.Goal
            ("goal_wxyz", _REAL, (4,)),
            ("goal_task", _INT),
            ("goal_tolerance", _REAL),
            ("goal_tolerance_rot", _REAL),
            ("goal_axis", _REAL, (3,)),
            ("goal_v", _REAL, (3,)),  # [m/s] as told; see `stream`
            ("goal_w", _REAL, (3,)),  # [rad/s]
            ("goal_a", _REAL, (3,)),  # [m/s2] as seen from goal to goal
            ("goal_alpha", _REAL, (3,)),  # [rad/s2]
            ("goal_lead", _REAL, (3,)),  # [m/s] at which the tip is led
            ("goal_turn", _REAL, (3,)),  # [rad/s]
            ("goal_age", _REAL),  # [s] since it was taken, where it has a time-out
            ("goal_gap", _REAL),  # [s] how old the one before became
            ("goal_timeout", _REAL),  # [s], 0 none
            ("has_posture", _INT),  # 0 none, 1 some, MEASURED_POSTURE
            ("goal_posture", _REAL, _JOINT),
            ("lead_until", _INT),  # tick until which the joints head for that posture
            ("lead", _REAL, _JOINT),  # [rad/s] reference of that
            ("hold", _REAL, (3,)),  # where the tip stays without a goal
            ("hold_wxyz", _REAL, (4,)),
            ("hold_task", _INT),
            ("hold_axis", _REAL, (3,)),
            ("hold_tolerance", _REAL),
            ("hold_tolerance_rot", _REAL),
            ("q_rest", _REAL, _JOINT),  # [rad] posture of the hold
            ("v_ref", _REAL, (3,)),  # [m/s]
            ("w_ref", _REAL, (3,)),  # [rad/s]
            ("status", _INT),  # types.Status
            ("blocker", _INT),  # obstacle slot or joint index that holds the arm most, -1 for none
            ("blockers", "<u8"),  # bits of all that hold it
            ("escape_phase", _INT),  # as escape.Escape
            ("escape_hit", _REAL),
            ("escape_n", _REAL, (3,)),
            ("escape_b", _REAL, (3,)),
            ("escape_costs", _REAL, (DIRECTIONS,)),
            ("escape_ticks", _INT),
            ("escape_slow", _INT),
            ("still", _INT),  # ticks the tip has been at rest
            ("nearest", _REAL),  # [s] at full speed: the least that the goal was away
            ("stall_timer", _REAL),  # [s] for which it has not come nearer; see `progress.stall_timer`
            ("drift", _REAL, (3,)),  # [m/s] of the tip; see `progress.take_drift`
            # torque
            ("tau_obstacles", _REAL, _JOINT),  # [Nm] of the last tick
            ("sent", _REAL, (4, JOINTS_MAX)),  # [Nm] the last commands, newest first
            ("limit_flags", _INT),  # types.LimitFlag of the last tick
            ("slew_follows_echo", _INT),  # the slew starts from the echo: the drive does not give what it is sent
            ("speed_scale", _REAL),  # fraction of qd_max that joints may have
            # disturbance
            ("external", _REAL, _JOINT),  # [Nm] torque that neither drives nor model give; see `disturbance`
            ("lasting", _REAL, _JOINT),  # [Nm] the part of it that lasts
            ("noticed", _INT),  # it is more than rounding: what lasts is carried, from now on
            ("settled", _INT),  # and stays as it is: the arm is at rest where it shall be
            ("qd_measured", _REAL, _JOINT),  # [rad/s] of the last feedback
            ("external_moving", _REAL, _JOINT),  # [Nm] as slow, hardly following where an encoder stands still
            ("payload", _REAL, (4,)),  # [kg] and its centre [m] in the tip's frame, as told
            # contact; see `collision`
            ("track", _REAL, _JOINT),  # [Nm] the part of `external` that is none
            ("unsure", _REAL, _JOINT),  # [Nm] that a payload may be accelerated with
            ("expected", _REAL, _JOINT),  # [Nm] of a payload that was told and may be taken up now
            ("steady", _REAL, _JOINT),  # [s] for which each joint has not been slow
            ("v_before", _REAL, (3,)),  # [m/s] v_ref of the tick before
            ("w_before", _REAL, (3,)),  # [rad/s]
            ("touches", _INT),  # ticks for which a contact has been seen
            ("contact_level", _INT),  # of this tick: none, touched, struck
            ("contact_link", _INT),  # of the last contact, numbered as the model does
            # a hand guides the arm
            ("floating", _INT),
            ("float_weight", _REAL),  # [N] at the tip
            ("float_rest", _REAL, _JOINT),  # [Nm] that lasted beside it
            # another law drives the arm
            ("driven", _INT),  # in this tick
            ("drive", _REAL, _JOINT),  # [Nm] that it asks for
            ("drive_given", _REAL, _JOINT),  # [Nm] of that; zero in a tick without it
        ],
    )
)
_JOINTS = (
    "onset",
    "own_p",
    "own_v",
    "own_kp",
    "own_kd",
    "own_t",
    "own_g",
    "qdd",
    "q_previous",
    "age_previous",
    "q_rest",
    "tau_obstacles",
    "external",
    "lasting",
    "qd_measured",
    "external_moving",
    "lead",
    "track",
    "unsure",
    "expected",
    "steady",
    "float_rest",
    "drive",
    "drive_given",
    "sent",
    "encoder_monitors",
)
_FLAGS = (
    "off",
    "sinks",
    "parking",
    "recovering",
    "outside",
    "leaving",
    "done",
    "evaluated",
    "slew_follows_echo",
    "noticed",
    "settled",
    "floating",
    "driven",
)
_STREAM = tuple(f"goal_{name}" for name in ("v", "w", "a", "alpha", "lead", "turn", "age", "gap", "timeout"))
_ENUMS = {"state": State, "reaction": Severity, "status": Status, "task": Task}


def record_of(hot: F64) -> Record:
    """Return the record (1,) of HOT in a memory's flat array: a plain array crosses in a tenth of a record's time."""
    return np.frombuffer(hot, HOT)


def _reader(name: str) -> Callable[[F64, int], Any]:
    """Return what reads a field from a flat array: a record of numpy takes ten times as long for a number."""
    assert HOT.fields is not None
    field, offset = HOT[name], HOT.fields[name][1]
    if field.shape:
        part, joints = slice(offset // 8, (offset + field.itemsize) // 8), name in _JOINTS
        return lambda hot, n: hot[part].view(field.base).reshape(field.shape)[..., : n if joints else None]
    unpack = struct.Struct({"f": "<d", "i": "<q", "u": "<Q"}[field.kind]).unpack_from
    means = bool if name in _FLAGS else _ENUMS.get(name)
    if means is None:
        return lambda hot, n: unpack(hot.data, offset)[0]
    return lambda hot, n: means(unpack(hot.data, offset)[0])


READERS = {name: _reader(name) for name in HOT.names or ()}


def places_of(*names: str) -> I64:
    """Return where the numbers of some fields are in a memory's flat array, one behind the other."""
    assert HOT.fields is not None
    fields = [(HOT[name], HOT.fields[name][1]) for name in names]
    return np.concatenate([np.arange(at // 8, (at + field.itemsize) // 8) for field, at in fields])


def fresh() -> F64:
    """Return the flat array of a record of zeros."""
    return np.zeros(HOT.itemsize // 8)


def write(hot: F64, changes: Json) -> None:
    """Write values into the record by the names that `Memory` has for them."""
    h = record_of(hot)[0]
    for name, value in changes.items():
        if name == "joints":
            n = len(value.q)
            h["q"][:n], h["qd"][:n], h["P"][:n] = value
        elif name == "tip":
            for key, each in zip(("x", "xd", "P_tip", "R", "omega", "P_rot"), value, strict=True):
                h[key] = each
        elif name == "goal":
            _write_goal(h, value)
        elif name == "hold":
            h["hold"], h["hold_wxyz"], h["hold_task"] = value.position, value.wxyz, int(value.task)
            h["hold_axis"], h["hold_tolerance"], h["hold_tolerance_rot"] = (
                value.axis,
                value.tolerance,
                value.tolerance_rot,
            )
        elif name == "escape":
            for key, each in zip(Escape._fields, value, strict=True):
                h[f"escape_{key}"] = each
        elif name == "good":
            h["good"][: len(value)] = value
        elif name == "counters":
            h["counters"][:] = value
        elif np.ndim(value) and name in (*_JOINTS, "sent", "encoder_monitors"):
            h[name][..., : np.shape(value)[-1]] = value
        else:
            h[name] = value


def _write_goal(h: RecordRow, goal: Goal | None) -> None:
    h["has_goal"] = goal is not None
    if goal is None:
        for name in ("goal", "goal_wxyz", "goal_axis", "goal_task", "goal_tolerance", "goal_tolerance_rot", *_STREAM):
            h[name] = 0
        h["has_posture"], h["goal_posture"], h["lead_until"] = 0, 0.0, 0
        return
    h["goal"], h["goal_wxyz"], h["goal_axis"] = goal.position, goal.wxyz, goal.axis
    h["goal_task"], h["goal_tolerance"], h["goal_tolerance_rot"] = int(goal.task), goal.tolerance, goal.tolerance_rot
    h["goal_v"], h["goal_w"] = (0.0 if each is None else each for each in (goal.velocity, goal.omega))
    h["goal_timeout"] = goal.timeout or (GOAL_TIMEOUT if h["goal_v"].any() or h["goal_w"].any() else 0.0)
    h["has_posture"] = goal.posture is not None
    h["goal_posture"], h["lead_until"] = 0.0, 0
    if goal.posture is not None:
        h["goal_posture"][: len(goal.posture)] = goal.posture

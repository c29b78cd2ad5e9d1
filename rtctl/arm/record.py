"""The record of one tick: everything it took in and gave out, as one fixed-size struct.

The ring, the log and the replay all carry these bytes; a field added here appears in all of them.
"""

import struct
from functools import cache
from typing import NamedTuple

import numpy as np

from rtctl.arm.estimator import TipEstimate
from rtctl.kernel.rotations import quat_of
from rtctl.types import F64, I32, Feedback, Goal, Record


@cache
def record_dtype(n: int, slots: int) -> np.dtype[np.void]:
    """Return the packed little-endian dtype of a tick of n joints and `slots` obstacle slots."""
    f, joint, obstacle = "<f8", (n,), (slots,)
    return np.dtype(
        [
            ("tick", "<u8"),
            ("slot", "<u8"),  # index on the absolute grid
            ("time", f),  # [s] robot time = slot * period
            ("missed", "<u4"),
            ("link", "<u4"),  # types.Link
            # what came in
            ("q", f, joint),
            ("qd", f, joint),
            ("tau_measured", f, joint),
            ("age", f, joint),
            ("replies", "<u4", joint),
            ("drive", "<i4", joint),
            ("verb", "<u4"),  # types.Verb
            ("lateness", f),
            ("compute", f),
            # estimate and task
            ("x", f, (3,)),
            ("xd", f, (3,)),
            ("wxyz", f, (4,)),
            ("omega", f, (3,)),
            ("innovation", f),  # normalised, of the estimator
            ("goal", f, (3,)),
            ("goal_wxyz", f, (4,)),
            ("goal_axis", f, (3,)),  # of the tool, for a direction
            ("task", "<u4"),  # types.Task
            ("F", f, (6,)),  # F*_m of the motion task, acceleration [m/s2, rad/s2]
            ("error", f),  # [m] to the goal, along the axes of the task
            ("error_rot", f),  # [rad] to the goal
            ("sigma_min", f),  # smallest eigenvalue of J A^-1 J^T
            # obstacles by slot
            ("rho", f, obstacle),  # smallest distance to any PSP, inf when inactive
            ("force", f, (slots, 3)),  # [N] summed over PSPs
            ("point", "<i4", obstacle),  # the nearest PSP
            # torque
            ("tau_motion", f, joint),
            ("tau_obstacles", f, joint),
            ("tau_limits", f, joint),
            ("tau_posture", f, joint),
            ("tau_gravity", f, joint),
            ("tau_wanted", f, joint),
            ("tau_sent", f, joint),
            ("command", "<u4"),  # types.Drive
            ("cut", "<u4"),  # types.Cut
            ("state", "<u4"),  # types.State
            ("status", "<u4"),  # types.Status
            ("blocker", "<i4"),  # obstacle slot (>= 0) or -1; for LIMITED and SATURATED the joint index
            ("holders", "<u8"),  # bits of all that hold the arm, likewise
            ("escape", "<u4"),  # arm.escape.Phase
            ("severity", "<u4"),  # types.Severity
            ("faults", "<u8"),  # bit i = arm.faults.FAULTS[i]
            ("model_evaluated", "<u4"),
        ]
    )


# the runs of scalars between the arrays
_HEAD = struct.Struct("<QQdII")  # tick, slot, time, missed, link
_ASKED = struct.Struct("<Idd")  # verb, lateness, compute
_ERRORS = struct.Struct("<ddd")  # error, error_rot, sigma_min
_TAIL = struct.Struct("<IIIIiQIIQI")  # from command on
_F64, _U32, _I32 = struct.Struct("<d"), np.dtype("<u4"), np.dtype("<i4")
_TASK = struct.Struct("<I")


class Tail(NamedTuple):
    """The scalars that end a record, in its order."""

    command: int
    cut: int
    state: int
    status: int
    blocker: int
    holders: int
    escape: int
    severity: int
    faults: int
    model_evaluated: bool


def make_record(
    n: int, slots: int, tick: int, time: float, feedback: Feedback, verb: int, tip: TipEstimate, innovation: float,
    goal: Goal, F: F64, errors: tuple[float, float, float], seen: F64, nearest: I32, parts: F64, wanted: F64, sent: F64,
    tail: Tail,
) -> Record:  # fmt: skip
    """Return the record of one tick, read-only. All arrays are C-contiguous.

    errors: error [m], error_rot [rad], sigma_min [1/kg]. seen: (4 slots,) rho [m], then force (slots, 3) [N].
    parts: (5, n) [Nm] from tau_motion to tau_gravity; wanted, sent: (n,) [Nm].
    Assigning to the fields one by one takes numpy ten times as long as joining their bytes.
    """
    f = feedback
    raw = b"".join((
        _HEAD.pack(tick, f.slot, time, f.missed, f.link), f.q.tobytes(), f.qd.tobytes(), f.tau.tobytes(),
        f.age.tobytes(), f.replies.astype(_U32).tobytes(), f.drive.astype(_I32).tobytes(),
        _ASKED.pack(verb, f.lateness, f.compute),
        tip.x.tobytes(), tip.xd.tobytes(), quat_of(tip.R).tobytes(), tip.omega.tobytes(), _F64.pack(innovation),
        goal.position.tobytes(), goal.wxyz.tobytes(), goal.axis.tobytes(), _TASK.pack(goal.task), F.tobytes(),
        _ERRORS.pack(*errors), seen.tobytes(), nearest.tobytes(), parts.tobytes(), wanted.tobytes(),
        sent.tobytes(), _TAIL.pack(*tail),
    ))  # fmt: skip
    return np.frombuffer(raw, record_dtype(n, slots))

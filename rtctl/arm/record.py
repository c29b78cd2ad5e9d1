"""The record of one tick: everything it took in and gave out, as one fixed-size struct.

The ring, the log and the replay all carry these bytes; a field added here appears in all of them.
"""

from functools import cache
from typing import NamedTuple

import numpy as np

from rtctl.kernel import kernel
from rtctl.kernel.rotations import quat_of
from rtctl.types import F64, I32, U32, Feedback, Record, RecordRow

SEEN = ("q", "qd", "tau", "age", "status")  # of a gripper, the rows of Feedback.grippers
GRIPPER = (*SEEN, "target", "torque", "p")  # and of what it remembers: asked for [rad], at most [Nm], reference [rad]


@cache
def record_dtype(n: int, slots: int, grippers: int = 0) -> np.dtype[np.void]:
    """Return the packed little-endian dtype of a tick of n joints, `slots` obstacle slots and so many grippers."""
    f, joint, obstacle, gripper = "<f8", (n,), (slots,), (grippers,)
    held = [(f"gripper_{name}", f, gripper) for name in GRIPPER] if grippers else []
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
            ("cut", "<u4"),  # types.LimitFlag
            ("state", "<u4"),  # types.State
            ("status", "<u4"),  # types.Status
            ("blocker", "<i4"),  # obstacle slot (>= 0) or -1; for LIMITED and SATURATED the joint index
            ("holders", "<u8"),  # bits of all that hold the arm, likewise
            ("escape", "<u4"),  # arm.escape.Phase
            ("severity", "<u4"),  # types.Severity
            ("faults", "<u8"),  # bit i = arm.faults.FAULTS[i]
            ("model_evaluated", "<u4"),
            *held,
        ]
    )


_WORD = 0xFFFFFFFF
SCALARS = record_dtype(0, 0).itemsize  # bytes of what does not depend on joints and slots


def with_grippers(record: Record, seen: F64, memory: F64) -> Record:
    """Return a record with g grippers behind it; seen (5, g) as in Feedback, memory (10, g) as in Memory."""
    tail = np.concatenate((seen, memory[: len(GRIPPER) - len(SEEN)]))
    n, slots = record["q"].shape[1], record["rho"].shape[1]
    both = bytearray(record.tobytes() + tail.astype("<f8").tobytes())
    return np.frombuffer(both, record_dtype(n, slots, seen.shape[1]))


def grippers_seen(records: Record) -> F64:
    """Return Feedback.grippers (T, 5, g) of T records."""
    if "gripper_q" not in (records.dtype.names or ()):
        return np.zeros((len(records), len(SEEN), 0))
    return np.stack([records[f"gripper_{name}"] for name in SEEN], axis=1)


class Outcome(NamedTuple):
    """What a record says beside the memory, the feedback and the law."""

    verb: int  # types.Verb
    command: int  # types.Drive
    goal: F64  # (3,) [m]
    goal_wxyz: F64  # (4,)
    goal_axis: F64  # (3,)
    task: int  # types.Task
    tau_wanted: F64  # (n,) [Nm]


@kernel
def _put(out: U32, at: int, raw: U32) -> int:
    """Write words to out from `at` on; return where they end."""
    for i in range(raw.shape[0]):
        out[at + i] = raw[i]
    end: int = at + raw.shape[0]
    return end


@kernel
def _put_reals(out: U32, at: int, values: F64) -> int:
    return _put(out, at, values.view(np.uint32))


@kernel
def _put_record(out: U32, at: int, values: F64, longs: F64) -> int:
    """Write an array of a record, through a work array `longs` at least as long: a record's own may lie anywhere."""
    for i in range(values.shape[0]):
        longs[i] = values[i]
    return _put(out, at, longs[: values.shape[0]].view(np.uint32))


@kernel
def pack(
    m: RecordRow,
    f: Feedback,
    o: Outcome,
    errors: tuple[float, float, float],
    F: F64,
    torques: F64,
    seen: F64,
    nearest: I32,
    dt: float,
) -> U32:
    """Return the record of one tick in words of four bytes, of which every field is a whole number.

    m: the memory after it. errors: error [m], error_rot [rad], sigma_min [1/kg]. seen: (4 slots,) rho [m], then force
    (slots, 3) [N]. torques: (5, n) [Nm] from tau_motion to tau_gravity.
    """
    n, slots = f.q.shape[0], nearest.shape[0]
    out = np.empty((SCALARS + 96 * n + 36 * slots) // 4, np.uint32)
    reals, longs = np.empty(max(n, 4)), np.empty(1, np.uint64)
    long, real = longs.view(np.uint32), reals[:1].view(np.uint32)
    longs[0] = m.tick
    at = _put(out, 0, long)
    longs[0] = f.slot
    at = _put(out, at, long)
    reals[0] = f.slot * dt
    at = _put(out, at, real)
    out[at], out[at + 1] = f.missed, f.link
    at += 2
    for values in (f.q, f.qd, f.tau, f.age):
        at = _put_reals(out, at, values)
    for i in range(n):
        out[at + i], out[at + n + i] = f.replies[i], f.drive[i] & _WORD
    at += 2 * n
    out[at] = o.verb
    reals[0] = f.lateness
    at = _put(out, at + 1, real)
    reals[0] = f.compute
    at = _put(out, at, real)
    at = _put_record(out, at, m.x, reals)
    at = _put_record(out, at, m.xd, reals)
    at = _put_reals(out, at, quat_of(m.R))
    at = _put_record(out, at, m.omega, reals)
    reals[0] = m.innovation
    at = _put(out, at, real)
    for values in (o.goal, o.goal_wxyz, o.goal_axis):
        at = _put_reals(out, at, values)
    out[at] = o.task
    at = _put_reals(out, at + 1, F)
    for value in errors:
        reals[0] = value
        at = _put(out, at, real)
    at = _put_reals(out, at, seen)
    at = _put(out, at, nearest.view(np.uint32))
    for r in range(torques.shape[0]):
        at = _put_reals(out, at, torques[r])
    at = _put_reals(out, at, o.tau_wanted)
    at = _put_record(out, at, m.sent[0, :n], reals)
    out[at], out[at + 1], out[at + 2], out[at + 3] = o.command, m.limit_flags, m.state, m.status
    out[at + 4] = m.blocker & _WORD
    longs[0] = m.blockers
    at = _put(out, at + 5, long)
    out[at], out[at + 1] = m.escape_phase, m.reaction
    longs[0] = m.in_force
    at = _put(out, at + 2, long)
    out[at] = m.evaluated
    return out

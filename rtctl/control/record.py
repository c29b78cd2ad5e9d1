"""The record of one tick: everything it took in and gave out, as one fixed-size struct.

The ring, the log and the replay all carry these bytes; a field added here appears in all of them.
"""

import struct
from collections.abc import Callable, Mapping
from functools import cache
from operator import itemgetter, methodcaller
from typing import Any, NamedTuple

import numpy as np

from rtctl.types import Record

_CODE = {"<u8": "Q", "<u4": "I", "<i4": "i", "<f8": "d"}  # of a scalar field in `struct`


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
            ("severity", "<u4"),  # types.Severity
            ("faults", "<u8"),  # bit i = control.faults.FAULTS[i]
            ("model_evaluated", "<u4"),
        ]
    )


class _Step(NamedTuple):
    """One or more neighbouring fields: their values out of a mapping, and these as bytes."""

    get: Callable[[Mapping[str, Any]], Any]
    to_bytes: Callable[[Any], bytes]


@cache
def _steps(n: int, slots: int) -> tuple[_Step, ...]:
    """Return how to write a record from its start to its end: runs of scalars at once, arrays one by one."""
    dtype = record_dtype(n, slots)
    steps: list[_Step] = []
    run: list[str] = []
    for name in (*(dtype.names or ()), ""):  # the empty name ends the last run
        if name and not dtype[name].shape:
            run.append(name)
            continue
        if run:
            steps.append(_scalars(run, [dtype[each].str for each in run]))
            run = []
        if name:
            base = dtype[name].base
            steps.append(_Step(itemgetter(name), methodcaller("tobytes") if base == np.float64 else _integers(base)))
    return tuple(steps)


def _scalars(names: list[str], types: list[str]) -> _Step:
    layout = struct.Struct("<" + "".join(_CODE[each] for each in types))
    if len(names) == 1:
        return _Step(itemgetter(*names), layout.pack)
    return _Step(itemgetter(*names), lambda values: layout.pack(*values))


def _integers(base: "np.dtype[Any]") -> Callable[[Any], bytes]:
    return lambda values: bytes(values.astype(base).data)


def make_record(n: int, slots: int, **values: Any) -> Record:
    """Return the record of one tick, read-only; `values` are float64 and integer arrays and numbers by field name.

    Assigning to the fields one by one takes numpy three times as long.
    """
    raw = b"".join([to_bytes(get(values)) for get, to_bytes in _steps(n, slots)])
    return np.frombuffer(raw, record_dtype(n, slots))

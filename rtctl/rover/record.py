"""One tick of the base as one struct: everything that came in and went out."""

from collections.abc import Sequence
from functools import cache
from typing import TypeAlias

import numpy as np

from rtctl.plain import Json
from rtctl.rover.path import CORNERS
from rtctl.rover.robot import SECTORS
from rtctl.rover.signals import BaseFeedback
from rtctl.types import F64, Record

Number: TypeAlias = float | Sequence[float] | F64


@cache
def base_dtype(slots: int) -> "np.dtype[np.void]":
    """Return the dtype of a record; names shared with the arm's record mean the same."""
    f, i, u = "<f8", "<i4", "<u4"
    return np.dtype(
        [
            ("tick", u), ("slot", "<u8"), ("time", f), ("missed", u), ("link", u),
            # what came in
            ("position", f, (2,)), ("velocity", f, (2,)), ("yaw", f), ("yaw_rate", f), ("position_age", f),
            ("attitude_age", f), ("fresh", i), ("reset", i), ("scan", f, (SECTORS,)), ("scan_start", f),
            ("scan_step", f), ("scan_reach", f), ("scan_age", f), ("scans", i), ("sensor", i),
            ("scan_offset", f, (2,)), ("scan_wrong", u), ("known_age", f), ("beams", f, (8,)), ("beam_reach", f),
            ("heartbeat_age", f), ("uplink_age", f), ("fix_lost", u), ("quality", f),
            ("ours", u), ("mode", u), ("armed", u), ("reboots", u), ("healthy", u), ("word", i),
            ("lost", u), ("refused", u), ("verb", u), ("lateness", f), ("compute", f),
            # estimate and task
            ("x", f, (3,)), ("xd", f, (3,)), ("heading", f), ("innovation", f), ("goal", f, (3,)), ("goal_heading", f),
            ("error", f), ("error_rot", f),
            ("way", f, (CORNERS, 2)), ("corners", i), ("way_length", f), ("way_short", f),
            # obstacles
            ("rho", f, (slots,)), ("push_told", f, (slots, 2)), ("rho_seen", f), ("push_seen", f, (2,)),
            # command
            ("xd_d", f, (2,)), ("v_ref", f, (2,)), ("allowed", f), ("allowed_seen", f), ("bias", f, (2,)),
            ("asked", f, (2,)), ("did", f, (2,)), ("v", f), ("w", f), ("v_world", f, (2,)),
            ("command", u), ("state", u), ("status", u), ("blocker", i), ("severity", u), ("faults", "<u8"),
        ]
    )  # fmt: skip


def make_base_record(slots: int, **values: Number) -> Record:
    """Return the record of one tick, read-only."""
    record = np.zeros((), base_dtype(slots))
    for name, value in values.items():
        record[name] = value
    record.flags.writeable = False
    return record


def feedback_from(row: Record) -> BaseFeedback:
    """Return the feedback that a record was made from: with the requests of the log all that a replay needs."""
    kinds = {int: int, bool: bool, float: float}
    values: Json = {}
    for name, kind in BaseFeedback.__annotations__.items():
        value = row[name]
        values[name] = np.array(value) if value.shape else kinds[kind](value)
    return BaseFeedback(**values)

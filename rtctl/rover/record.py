"""One tick of the base as one struct: everything that came in and went out."""

import math
from collections.abc import Sequence
from functools import cache
from typing import TypeAlias

import numpy as np

from rtctl.plain import Json
from rtctl.rover import turn
from rtctl.rover.law import Push
from rtctl.rover.memory import BaseMemory
from rtctl.rover.path import CORNERS
from rtctl.rover.robot import SECTORS, Base
from rtctl.rover.signals import BaseCommand, BaseFeedback
from rtctl.types import F64, Record, Request

Number: TypeAlias = float | Sequence[float] | F64
Judged: TypeAlias = tuple[F64, Push, F64, float]  # v_ref wanted, field, xd_d, allowed speed


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


def recorded(
    base: Base, m: BaseMemory, f: BaseFeedback, request: Request, judged: Judged, command: BaseCommand
) -> Record:
    """Return the record of a tick: everything that came in and went out."""
    v_ref, push, xd_d, allowed = judged
    goal = m.goal.position if m.goal is not None else np.array([*m.here.x, 0.0])
    corners = np.zeros((CORNERS, 2))
    corners[: len(m.way.corners)] = m.way.corners
    return make_base_record(
        base.slots,
        tick=m.tick,
        slot=max(f.slot, 0),
        time=f.slot * base.dt,
        missed=f.missed,
        link=f.link,
        position=f.position,
        velocity=f.velocity,
        yaw=f.yaw,
        yaw_rate=f.yaw_rate,
        position_age=f.position_age,
        attitude_age=f.attitude_age,
        fresh=f.fresh,
        reset=f.reset,
        scan=f.scan,
        scan_start=f.scan_start,
        scan_step=f.scan_step,
        scan_reach=f.scan_reach,
        scan_age=f.scan_age,
        scans=f.scans,
        sensor=f.sensor,
        scan_offset=f.scan_offset,
        scan_wrong=f.scan_wrong,
        known_age=f.known_age,
        beams=f.beams,
        beam_reach=f.beam_reach,
        heartbeat_age=f.heartbeat_age,
        uplink_age=f.uplink_age,
        fix_lost=f.fix_lost,
        quality=f.quality,
        ours=f.ours,
        mode=f.mode,
        armed=f.armed,
        reboots=f.reboots,
        healthy=f.healthy,
        word=f.word,
        lost=f.lost,
        refused=f.refused,
        verb=request.verb,
        lateness=f.lateness,
        compute=f.compute,
        x=[*m.here.x, 0.0],
        xd=[*m.here.v, 0.0],
        heading=m.here.yaw,
        innovation=m.innovation,
        goal=goal,
        goal_heading=math.nan if m.goal is None else turn.heading_of(m.goal),
        error=float(np.hypot(*(goal[:2] - m.here.x))),
        error_rot=0.0 if m.goal is None else turn.left(m.goal, m.here.yaw),
        way=corners,
        corners=len(m.way.corners),
        way_length=m.way.length,
        way_short=m.way.short,
        rho=push.rho,
        push_told=push.known,
        rho_seen=push.rho_sensed,
        push_seen=push.sensed,
        xd_d=xd_d,
        v_ref=v_ref,
        allowed=allowed,
        allowed_seen=m.allowed_seen,
        bias=m.here.b,
        asked=m.asked,
        did=m.did,
        v=command.v,
        w=command.w,
        v_world=command.velocity,
        command=command.ask,
        state=m.state,
        status=m.status,
        blocker=m.blocker,
        severity=m.reaction,
        faults=m.in_force,
    )


def feedback_from(row: Record) -> BaseFeedback:
    """Return the feedback that a record was made from: with the requests of the log all that a replay needs."""
    kinds = {int: int, bool: bool, float: float}
    values: Json = {}
    for name, kind in BaseFeedback.__annotations__.items():
        value = row[name]
        values[name] = np.array(value) if value.shape else kinds[kind](value)
    return BaseFeedback(**values)

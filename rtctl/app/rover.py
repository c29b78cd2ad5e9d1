"""The mobile base as the daemon and the simulation put it together: its link, its tick's names, its ways to stop."""

import math
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from rtctl.app.servo import Machine, Servo, Sink
from rtctl.design.assets import files_named
from rtctl.design.rover import key_of
from rtctl.hal.clock import Slot
from rtctl.hal.mavlink.keys import Keys
from rtctl.hal.mavlink.link import MavLink, MavSpec
from rtctl.hal.mavlink.ranging import ANY, ANY_BEAM, SensorSpec
from rtctl.hal.mavlink.wire import Wire, open_wire
from rtctl.hal.messages import Bounds
from rtctl.log.entry import Kind
from rtctl.log.header import SCENE_FILE, Header, make_header, meshes_to_files, scene_text
from rtctl.log.record.meshes import MESHES, archive
from rtctl.rover import faults
from rtctl.rover.memory import BaseMemory
from rtctl.rover.pipe import initial, tick
from rtctl.rover.record import base_dtype, make_base_record
from rtctl.rover.robot import Base
from rtctl.rover.signals import Ask, BaseCommand, BaseFeedback
from rtctl.spec.base import BaseConfig, streams
from rtctl.types import State, Status, Task

LINK = "vehicle"  # the link's name in the log
MAV_TX, MAV_RX = int(Kind.MAV_TX), int(Kind.MAV_RX)
SIMULATED_WAIT = 120.0  # [s] of simulated time
WORDS = 5  # of the vehicle, the newest, that `rtctl status` shows
FAREWELL = 3.0  # [s] of zero twist at most, when a turn raised
STILL = 0.1  # [m/s]
EPOCH = 1_790_000_000 * 10**9  # [ns] Unix time at which simulations begin
ANGLE_TOLERANCE = 3.2  # [rad] a base's goals have no orientation


def open_link(config: BaseConfig, path: Path, wire: Wire | None = None) -> MavLink:
    """Return the opened link of a checked config; a simulator's `wire` brings its own clock. Raises RtctlError.

    A real vehicle is waited for unless `handshake_s` bounds it; a simulated one for SIMULATED_WAIT.
    """
    c = config.link
    key, line = key_of(config, path), streams(config)
    state = None if c.state_file is None else Path(c.state_file)
    if state is not None and not state.is_absolute():
        state = path.parent / state
    spec = MavSpec(
        place=str(path),
        autopilot=c.autopilot,
        system=c.system_id,
        component=c.component_id,
        vehicle=c.vehicle_id,
        period=1.0 / config.loop.servo_hz,
        timeout=c.handshake_s or (math.inf if wire is None else SIMULATED_WAIT),
        scan=config.avoid.scan == "required",
        sensors=sensors_of(config),
        quick=math.inf if line is None else line.quick,
        every=1 if line is None else line.every,
    )
    if wire is None:
        return MavLink(spec, open_wire(c.url), Keys(key, state, c.signing_link_id))
    simulated = wire
    return MavLink(spec, wire, Keys(key, state, c.signing_link_id, lambda: EPOCH + round(1e9 * simulated.now())))


def sensors_of(config: BaseConfig) -> tuple[SensorSpec, ...]:
    """Return the range sensors that are listened to: those of the config, or whoever speaks first."""
    return tuple(
        SensorSpec(s.name, s.system, s.component, s.message, s.yaw_rad, s.offset_m, s.frame, s.min_m, s.max_m)
        for s in config.sensor
    ) or (ANY, ANY_BEAM)


def machine_of(link: MavLink) -> Machine:
    """Return the base's functions for the loop around the tick; what the vehicle says becomes news."""

    def news(base: Base, before: BaseMemory, after: BaseMemory, feedback: BaseFeedback) -> list[tuple[str, str]]:
        found = _news(before, after)
        while link.news:
            found.append(("vehicle", link.news.popleft()))
        return found

    return Machine(initial=initial, tick=tick, news=news, harmless=_harmless, rx=MAV_RX, tx=MAV_TX)


def _harmless(command: BaseCommand) -> BaseCommand:
    """Return what a dry run sends: heartbeats alone."""
    return command._replace(ask=Ask.SILENCE, v=0.0, w=0.0)


def _news(before: BaseMemory, after: BaseMemory) -> list[tuple[str, str]]:
    """Return what changed in this tick, as (name, detail): states, faults, statuses, refusals."""
    found = []
    if after.verdict:
        found.append(("rejected", after.verdict))
    fresh = after.in_force & ~before.in_force
    if fresh:
        found.append(("fault", faults.TABLE.describe(fresh, after.state) + _numbers(fresh, after)))
    if after.state != before.state:
        found.append(("state", after.state.name))
    if (after.status, after.blocker) != (before.status, before.blocker) and after.status != Status.NO_GOAL:
        found.append((after.status.name.lower(), blocker_name(after)))
    return found


def blocker_name(m: BaseMemory) -> str:
    """Return the name of the obstacle that holds the base, '' for none that has one."""
    if m.status == Status.BLIND:
        return unseen(m)
    return m.world.names[m.blocker] if m.blocker >= 0 else ""


def unseen(m: BaseMemory) -> str:
    """Return in words which sectors of the last scan are unknown, in degrees clockwise from the front."""
    f = m.last
    width = abs(math.degrees(f.scan_step))
    front = np.degrees(-(f.scan_start + f.scan_step * np.arange(len(f.scan))))
    around = round(360.0 / width) if width > 0.0 else 0
    dark = sorted(float(round(a % 360.0, 1)) for a in front[:around][f.scan[:around] < 0.0])
    if not dark:
        return "where it would go has not been seen"
    if len(dark) >= around:
        return "no sector of the scan is known"
    spans: list[list[float]] = []
    for angle in dark:
        if spans and angle - spans[-1][1] <= 1.5 * width:
            spans[-1][1] = angle
        else:
            spans.append([angle, angle])
    if len(spans) > 1 and spans[0][0] + 360.0 - spans[-1][1] <= 1.5 * width:
        spans[0][0] = spans.pop()[0]
    return "not seen: " + ", ".join(f"{a - 0.5 * width:g} to {b + 0.5 * width:g} deg" for a, b in spans)


def _numbers(fresh: int, m: BaseMemory) -> str:
    """Return the numbers that belong to faults which have just come."""
    found = ""
    if fresh & faults.BIT["no_effect"]:
        found += f"; asked {m.asked[0]:.2f} m/s and {m.asked[1]:.2f} rad/s, did {m.did[0]:.2f} and {m.did[1]:.2f}"
    if fresh & faults.BIT["uplink_lost"]:
        found += f"; nothing that we sent in the last {m.last.uplink_age:.1f} s was answered"
    return found


def bounds_of(base: Base, link: MavLink) -> Bounds:
    """Return what goals are held to; places in latitude and longitude go through the vehicle's origin."""
    return Bounds((0.0, 0.0, 0.0), base.reach, base.tolerance, ANGLE_TOLERANCE, Task.X | Task.Y, link.local)


def header_of(config: BaseConfig, path: Path, base: Base, start: BaseFeedback, **extra: str) -> Header:
    """Return the header of a log: what replay needs beside the ticks, the handshake's pose included."""
    pose = np.array([*start.position, start.yaw])
    whole = start._replace(slot=max(start.slot, 0))  # a record has no slot before the first
    first = make_base_record(base.slots, **whole._asdict()).tobytes().hex()  # all of it, for a replay
    files: dict[str, str | bytes] = {
        SCENE_FILE: scene_text(np.column_stack([base.points, base.point_radius]).tolist(), base.obstacles)
    }
    files |= meshes_to_files(base.meshes)
    if packed := archive("", path.parent, (), files_named(config), path.resolve().parent):
        files[MESHES] = packed
    header = make_header(
        base.name, (), base.slots, base.dt, config=path.read_text(encoding="utf-8"), buses=(),
        extra={"pose_handshake": pose.tobytes().hex(), "kind": "base", "start": first, **extra},
        files=files,
    )  # fmt: skip
    return header._replace(dtype=base_dtype(base.slots), links=(LINK,))


def status(servo: Servo, log: dict[str, Any]) -> dict[str, Any]:
    """Return what `rtctl status` shows."""
    m: Any = servo.memory
    base: Any = servo.robot
    link: Any = servo.link
    goal, last = m.goal, m.last
    seen = {"scan": float(m.rho_seen)} if np.isfinite(m.rho_seen) else {}
    told = {n: float(d) for n, d in zip(m.world.names, m.rho, strict=True) if n and np.isfinite(d)}
    return {
        "robot": base.name,
        "state": m.state.name,
        "status": m.status.name.lower(),
        "detail": blocker_name(m),
        "tick": m.tick,
        "time_s": m.tick * base.dt,
        "x_m": [float(m.here.x[0]), float(m.here.x[1]), 0.0],
        "yaw_rad": float(m.here.yaw),
        "speed_m_s": float(np.hypot(*m.here.v)),
        "goal_m": None if goal is None else goal.position,
        "error_m": None if goal is None else float(np.hypot(*(goal.position[:2] - m.here.x))),
        "error_rad": None,
        "way_m": float(m.way.length) if np.isfinite(m.way.length) else None,
        "clearance_m": {**seen, **told},
        "vehicle": {
            "mode": last.mode, "ours": bool(last.ours), "armed": bool(last.armed), "healthy": bool(last.healthy),
            "position_age_s": _finite(last.position_age), "scan_age_s": _finite(last.scan_age),
            "heartbeat_age_s": _finite(last.heartbeat_age), "streams_hz": dict(link.talk.rates),
            "frames": dict(link.counts), "uplink_age_s": _finite(last.uplink_age),
            "known_age_s": _finite(last.known_age), "fix_lost": bool(last.fix_lost), "quality": float(last.quality),
            "firmware": None if link.view.firmware is None else ".".join(map(str, link.view.firmware)),
            "words": _words(servo),
        },
        "missed": servo.missed,
        "lateness_s": servo.lateness,
        "compute_s": servo.compute,
        "faults": list(faults.names(m.in_force)),
        "log": log,
    }  # fmt: skip


def _words(servo: Servo) -> list[list[Any]]:
    """Return the newest words of the vehicle and about it, [s, text]."""
    said = [[now, detail] for now, name, detail in servo.events[-200:] if name in ("vehicle", "fault")]
    return said[-WORDS:]


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def fallback(servo: Servo, sink: Sink, slots: Iterator[Slot]) -> None:
    """A turn raised: zero twist until the vehicle rests, from the feedback alone; `farewell` then lets go."""
    link: Any = servo.link
    dt: float = servo.robot.dt
    for k, slot in enumerate(slots):
        f: BaseFeedback = link.read(slot.slot, slot.missed, slot.lateness, 0.0)
        sink.put_many(MAV_RX, link.received, time.monotonic_ns())
        if not f.ours or not f.armed or k * dt > FAREWELL or (k > 5 and np.hypot(*f.velocity) < STILL):
            return
        command = BaseCommand(Ask.DRIVE, 0.0, 0.0, np.zeros(2))
        sink.put_many(MAV_TX, link.write(command), time.monotonic_ns())


def farewell(servo: Servo, sink: Sink) -> None:
    """End with zero twist and the vehicle's own hold mode while the mode is ours, then disarm what we armed."""
    m: Any = servo.memory
    link: Any = servo.link
    mine, period = bool(m.mine) and m.state != State.IDLE, servo.robot.dt
    asks = [Ask.HOLD] * round(1.0 / period) + ([Ask.DISARM] * round(1.0 / period) if mine else [])
    for ask in asks:
        f: BaseFeedback = link.read(-1, 0, 0.0, 0.0)
        sink.put_many(MAV_RX, link.received, time.monotonic_ns())
        if f.ours if ask == Ask.HOLD else f.armed:
            command = BaseCommand(ask, 0.0, 0.0, np.zeros(2))
            sink.put_many(MAV_TX, link.write(command), time.monotonic_ns())
            time.sleep(period)

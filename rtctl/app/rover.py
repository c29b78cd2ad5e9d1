"""The rover as a vehicle: what the loop around its tick, the daemon, the simulation and replay need of it."""

import math
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TypeAlias

import msgspec
import numpy as np

from rtctl.app.rover_link import RoverLink, open_link
from rtctl.app.rover_log import header_of, rebuild
from rtctl.app.rover_scene import open_play
from rtctl.app.vehicle import Event, Link, Said, Setup, Silent, Sink, Vehicle, clearances
from rtctl.design.rover import build
from rtctl.hal.clock import Slot
from rtctl.hal.messages import Bounds
from rtctl.hal.service import bus_resource
from rtctl.log.entry import Kind
from rtctl.plain import Json
from rtctl.rover import faults, turn
from rtctl.rover.memory import BaseMemory
from rtctl.rover.pipe import initial, tick, warm
from rtctl.rover.robot import Base
from rtctl.rover.signals import Ask, BaseCommand, BaseFeedback
from rtctl.spec.base import load as load_config
from rtctl.types import State, Status, Task

Radio: TypeAlias = Link[BaseFeedback, BaseCommand]
MAV_TX, MAV_RX = int(Kind.MAV_TX), int(Kind.MAV_RX)
ZERO_TWIST_TIME = 3.0  # [s] of zero twist at most, when a turn raised
REST_SPEED = 0.1  # [m/s]
WORDS = 5  # of the vehicle, the newest, that `rtctl status` shows


def load(path: Path, timeout: float | None = None) -> Setup[Base, BaseMemory, BaseFeedback, BaseCommand]:
    """Return what a rover's file says; timeout [s] for its vehicle in place of the file's. Raises ConfigError."""
    config = load_config(path)
    if timeout is not None:
        config = msgspec.structs.replace(config, link=msgspec.structs.replace(config.link, handshake_s=timeout))
    return Setup(
        name=config.robot.name,
        loop=config.loop,
        console=config.console,
        log=config.log,
        resource=(bus_resource("mavlink", config.link.url), "link.url"),
        place=config.link.url,
        build=lambda: build(config, path),
        open=lambda: open_link(config, path),
        header=lambda base, start, link: header_of(config, path, base, start),
        simulate=lambda scenario, source: open_play(config, path, build(config, path), scenario, source),
    )


def events(base: Base, before: BaseMemory, after: BaseMemory, feedback: BaseFeedback) -> list[Event]:
    """Return what changed in this tick, as (name, detail): states, faults, statuses, refusals."""
    found: list[Event] = []
    if after.refusal:
        found.append(("rejected", after.refusal))
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
        return unseen(m) if math.isnan(m.look.heading) else f"turns to look: {unseen(m)}"
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


def bounds(base: Base, link: Radio) -> Bounds:
    """Return what goals are held to; places in latitude and longitude go through the vehicle's origin."""
    local = link.local if isinstance(link, RoverLink) else None
    axes = Task.X | Task.Y | Task.ORIENTATION  # the tick says which of them it cannot take
    return Bounds((0.0, 0.0, 0.0), base.reach, base.tolerance, base.tolerance_rot, axes, local)


def status(base: Base, m: BaseMemory, link: Radio, said: Sequence[Said]) -> Json:
    """Return what `rtctl status` shows of a rover."""
    goal = m.goal
    seen = {"scan": float(m.rho_seen)} if np.isfinite(m.rho_seen) else {}
    return {
        "detail": blocker_name(m),
        "x_m": [float(m.here.x[0]), float(m.here.x[1]), 0.0],
        "yaw_rad": float(m.here.yaw),
        "speed_m_s": float(np.hypot(*m.here.v)),
        "goal_m": None if goal is None else goal.position,
        "error_m": None if goal is None else float(np.hypot(*(goal.position[:2] - m.here.x))),
        "goal_heading_rad": None if goal is None else _finite(turn.heading_of(goal)),
        "error_rad": None if goal is None or not goal.task & Task.RZ else abs(turn.left(goal, m.here.yaw)),
        "way_m": float(m.way.length) if np.isfinite(m.way.length) else None,
        "clearance_m": {**seen, **clearances(m)},
        "vehicle": {**_autopilot(m.last, link), "words": _words(said)},
    }


def _autopilot(last: BaseFeedback, link: Radio) -> Json:
    """Return what is known of the autopilot and the radio."""
    found: Json = {
        "mode": last.mode,
        "ours": bool(last.ours),
        "armed": bool(last.armed),
        "healthy": bool(last.healthy),
        "position_age_s": _finite(last.position_age),
        "scan_age_s": _finite(last.scan_age),
        "heartbeat_age_s": _finite(last.heartbeat_age),
        "uplink_age_s": _finite(last.uplink_age),
        "known_age_s": _finite(last.known_age),
        "fix_lost": bool(last.fix_lost),
        "quality": float(last.quality),
    }
    if isinstance(link, RoverLink):
        firmware = link.view.firmware
        found |= {
            "streams_hz": dict(link.talk.rates),
            "frames": dict(link.counts),
            "firmware": None if firmware is None else ".".join(map(str, firmware)),
        }
    return found


def _words(said: Sequence[Said]) -> list[tuple[float, str]]:
    """Return the newest words of the vehicle and about it, (s, text)."""
    return [(now, detail) for now, name, detail in said[-200:] if name in ("vehicle", "fault")][-WORDS:]


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def fallback(base: Base, m: BaseMemory, link: Radio, sink: Sink, slots: Iterator[Slot], lockstep: bool) -> None:
    """A turn raised: zero twist until the vehicle rests, from the feedback alone; `farewell` then lets go."""
    for k, slot in enumerate(slots):
        f = link.read(slot.slot, slot.missed, slot.lateness, 0.0)
        sink.put_many(MAV_RX, link.received, time.monotonic_ns())
        rests = k > 5 and bool(np.hypot(*f.velocity) < REST_SPEED)
        if not f.ours or not f.armed or k * base.dt > ZERO_TWIST_TIME or rests:
            return
        sink.put_many(MAV_TX, link.write(BaseCommand(Ask.DRIVE, 0.0, 0.0, np.zeros(2))), time.monotonic_ns())


def farewell(base: Base, m: BaseMemory, link: Radio, sink: Sink) -> None:
    """End with zero twist and the vehicle's own hold mode while the mode is ours, then disarm what we armed."""
    mine, ticks = bool(m.mine) and m.state != State.IDLE, round(1.0 / base.dt)
    for ask in [Ask.HOLD] * ticks + ([Ask.DISARM] * ticks if mine else []):
        f = link.read(-1, 0, 0.0, 0.0)
        sink.put_many(MAV_RX, link.received, time.monotonic_ns())
        if f.ours if ask == Ask.HOLD else f.armed:
            sink.put_many(MAV_TX, link.write(BaseCommand(ask, 0.0, 0.0, np.zeros(2))), time.monotonic_ns())
            time.sleep(base.dt)


ROVER = Vehicle(
    rx=MAV_RX,
    tx=MAV_TX,
    load=load,
    warm=warm,
    compile_part=lambda base, part: None,  # it has few kernels
    bounds=bounds,
    initial=initial,
    tick=lambda base, memory, feedback, request: tick(base, memory, feedback, request),  # looked up when called
    flagged=lambda feedback, flags: feedback._replace(link=feedback.link | flags),
    harmless=lambda command: command._replace(ask=Ask.SILENCE, v=0.0, w=0.0),  # heartbeats alone
    events=events,
    names=faults.names,
    status=status,
    adviser=lambda base, lockstep: Silent(),
    misplaced=lambda base, memory, edit: "",  # what is beside a base it sees for itself
    fallback=fallback,
    farewell=farewell,
    rebuild=rebuild,
    checkpoints=None,
    keeps_step=False,
    takes_law=False,
)

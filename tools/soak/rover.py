"""A rover on a long way: to and fro between two goals around a disc, in this process."""

import gc
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

from firmware_sim.rover import open_rover
from rtctl.app.rover import ROVER
from rtctl.app.rover_link import open_link
from rtctl.app.servo import Servo
from rtctl.design.rover import build
from rtctl.hal.clock import Slot
from rtctl.hal.mavlink.wire import InProcess
from rtctl.rover.faults import names
from rtctl.spec.base import load
from rtctl.types import Goal, Request, State, Status, Task, Verb
from tools.soak.growth import GROWTH, quarters, resident

DISC = {"name": "disc", "type": "cylinder", "radius_m": 1.0, "length_m": 2.0, "position_m": [8.0, 0.0, 0.0]}
GOALS = ((16.0, 0.0), (0.0, 0.0))
STEP = 60.0  # [s] between lines


class Sample(NamedTuple):
    """One minute."""

    minute: int
    setpoints: float  # [Hz] of robot time
    memory: float  # [MB] resident
    queue: int  # things that wait anywhere in the link
    goals: int
    compute: float  # [ms] p99 of a turn


def soak(config_file: Path, minutes: float, realtime: bool) -> tuple[list[Sample], int, list[str]]:
    """Return a sample a minute, contacts and the names of faults."""
    config = load(config_file)
    base = build(config, config_file)
    rover = open_rover(config_file, {"obstacle": [DISC]}, wait=True)
    link = open_link(config, config_file, InProcess(rover.exchange, base.dt))
    start = link.handshake()
    servo = Servo(ROVER, base, link, None, start, stamp=lambda now: 0)
    samples: list[Sample] = []
    ticks, every = round(60.0 * minutes / base.dt), round(STEP / base.dt)
    sent = goals = 0
    times: list[float] = []
    gc.collect()
    begun = time.monotonic()
    for slot in range(ticks):
        m = servo.memory
        verb = Verb.ARM if slot == 0 else Verb.NONE
        goal = None
        if m.state == State.RUN and (m.goal is None or m.status == Status.ARRIVED):
            goals += m.goal is not None
            goal = Goal(np.array([*GOALS[goals % 2], 0.0]), np.array([1.0, 0.0, 0.0, 0.0]), Task.POSITION, 0.3, 0.1)
        turn = servo.turn(Slot(slot, 0, 0.0), Request(verb, goal))
        times.append(servo.compute)
        sent += sum(frame[7] == 84 for frame in turn.frames)
        servo.events.clear()
        if (slot + 1) % every == 0:
            done = sum(s.goals for s in samples)
            waiting = len(link.events) + len(link.view.asked) + len(link.talk._waiting) + len(rover.autopilot.outbox)
            minute = len(samples) + 1
            samples.append(
                Sample(minute, sent / STEP, resident(), waiting, goals - done, 1e3 * float(np.percentile(times, 99)))
            )
            s = samples[-1]
            told = f"{s.setpoints:6.2f} Hz  {s.memory:7.1f} MB  {s.queue:3d} waiting  {s.goals:2d} goals"
            print(f"{minute:3d} min  {told}  turn p99 {s.compute:5.2f} ms", flush=True)
            sent, times = 0, []
        if realtime:
            time.sleep(max(0.0, begun + (slot + 1) * base.dt - time.monotonic()))
    return samples[1:] if len(samples) > 2 else samples, rover.truth().contacts, list(names(servo.faults_seen))


def judged(samples: list[Sample], contacts: int, faults: list[str]) -> bool:
    """Print what a run came to; return whether nothing was missed, touched or grew."""
    before, after = quarters([s.memory for s in samples])
    rates, queue = [s.setpoints for s in samples], max(s.queue for s in samples)
    print(
        f"set-points {min(rates):.2f} to {max(rates):.2f} Hz, memory {before:.1f} then {after:.1f} MB, "
        f"at most {queue} waiting, {sum(s.goals for s in samples)} goals, {contacts} contacts, "
        f"faults: {', '.join(faults) or 'none'}"
    )
    steady = max(rates) - min(rates) < 0.05 and abs(after - before) < GROWTH and queue < 40
    return steady and not contacts and not faults

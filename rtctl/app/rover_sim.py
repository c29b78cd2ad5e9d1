"""`rtctl sim` of a mobile base: the daemon's own servo and link on MAVLink bytes, the virtual rover in lockstep."""

import time
from pathlib import Path
from typing import Any

import numpy as np

from rtctl.app.rover import header_of, machine_of, open_link
from rtctl.app.servo import Servo
from rtctl.app.simulator import open_simulator
from rtctl.app.tally import Leg, number, of_way
from rtctl.design.rover import build
from rtctl.errors import ConfigError
from rtctl.hal.clock import lockstep
from rtctl.hal.mavlink.wire import InProcess
from rtctl.rover import faults
from rtctl.rover.memory import BaseMemory
from rtctl.rover.robot import Base
from rtctl.spec.base import load
from rtctl.spec.scenario import Scenario, goal_of
from rtctl.types import F64, Goal, Request, State, Verb

ARM_TIME = 5.0  # [s] within which the vehicle must be running
UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])
SHOWN = frozenset(("state", "fault", "vehicle"))  # events that are no statuses


class Tally:
    """Figures of a run, from the truth of each period."""

    def __init__(self) -> None:
        self.legs: list[Leg] = []
        self.path = self.speed = 0.0
        self.clearance: dict[str, float] = {}
        self.contacts = 0
        self.track: list[tuple[float, float, float, float, float]] = []  # t, x, y, yaw, v
        self._at: F64 | None = None

    def add(self, truth: Any, keep: bool) -> None:
        """Take one period into account."""
        at = np.array([truth.x, truth.y])
        if self._at is not None:
            self.path += float(np.hypot(*(at - self._at)))
        self._at = at
        self.speed, self.contacts = max(self.speed, abs(truth.v)), truth.contacts
        if keep:
            self.track.append((truth.time, truth.x, truth.y, truth.yaw, truth.v))
        for name, d in truth.clearance.items():
            self.clearance[name] = min(d, self.clearance.get(name, np.inf))
        if self.legs:
            self.legs[-1] = _advanced(self.legs[-1], at, truth.time)

    def figures(self) -> dict[str, Any]:
        """Return the figures under their published names."""
        return of_way(self.legs, self.path, self.speed, self.clearance, self.contacts, turned=False)


def _advanced(leg: Leg, at: F64, now: float) -> Leg:
    along = leg.goal.position[:2] - leg.start
    e = float(np.hypot(*(leg.goal.position[:2] - at)))
    return leg.advanced(now, e <= leg.goal.tolerance, along, at - leg.start, e)


class Feed:
    """What the controller is told and when: arming, and the scenario's goals. Obstacles its sensor must see."""

    def __init__(self, base: Base, scenario: Scenario, tally: Tally) -> None:
        self.base, self.tally = base, tally
        self.pending = list(scenario.goal)
        self.waiting: tuple[Goal, float, F64] | None = None

    def request(self, m: BaseMemory, truth: Any) -> Request:
        """Return the request of this period."""
        if self.waiting is not None and not m.verdict:
            self.tally.legs.append(Leg(*self.waiting))
        self.waiting = None
        verb = Verb.ARM if m.state == State.IDLE and m.tick < 0 else Verb.NONE
        goal = None
        if self.pending and truth.time >= self.pending[0].at_s and m.state == State.RUN:
            goal = goal_of(self.pending.pop(0), UPRIGHT, self.base.tolerance, 0.1)
            self.waiting = (goal, truth.time, np.array([truth.x, truth.y]))
        return Request(verb, goal)


def simulate_base(
    scenario: Scenario, where: Path, source: str, log: str | Path | None, realtime: bool, track: bool = False
) -> dict[str, Any]:
    """Return the figures of a scenario of the base whose config is `where`; `track` adds where it went."""
    config = load(where)
    base = build(config, where)
    if scenario.start_q_rad is not None:
        raise ConfigError(f"{source}: start_q_rad", "angles", "nothing: a base has start_pose")
    rover: Any = open_simulator(where, scenario, source)
    link = open_link(config, where, InProcess(rover.exchange, base.dt))
    sink = None
    try:
        start = link.handshake()
        if log is not None:
            from rtctl.log.record.writer import McapSink

            sink = McapSink(Path(log), header_of(config, where, base, start))
        machine = machine_of(link)
        robot: Any = base
        bytes_link: Any = link
        servo = Servo(
            robot, bytes_link, sink, np.zeros(0), stamp=lambda now: round(now * 1e9), machine=machine, start=start
        )
        tally = Tally()
        begun = time.perf_counter()
        ticks = _play(servo, scenario, rover, tally, realtime, track)
        elapsed = time.perf_counter() - begun
    finally:
        if sink is not None:
            sink.close("end")
        link.close()
    figures = {
        **tally.figures(),
        "statuses": [[number(t), name, detail] for t, name, detail in servo.events if name not in SHOWN],
        "vehicle": [[number(t), detail] for t, name, detail in servo.events if name == "vehicle"],
        "mode_final": servo.memory.state.name,
        "faults": list(faults.names(servo.faults_seen)),
        "ticks": ticks,
        "missed": servo.missed,
        "realtime_factor": number(ticks * base.dt / elapsed),
        "digest": servo.digest.hexdigest(),
    }
    return figures | ({"track": tally.track} if track else {})


def _play(servo: Servo, scenario: Scenario, rover: Any, tally: Tally, realtime: bool, track: bool) -> int:
    """Run the servo in lockstep until the scenario is over; return the ticks it took."""
    base: Any = servo.robot
    memory: Any = servo.memory
    feed = Feed(base, scenario, tally)
    ticks, begun = 0, time.monotonic()
    for slot in lockstep():
        truth = rover.truth()
        if truth.time >= scenario.duration_s or slot.slot * base.dt > scenario.duration_s + ARM_TIME:
            break
        memory = servo.memory
        servo.turn(slot, feed.request(memory, truth))
        tally.add(rover.truth(), track)
        ticks += 1
        if realtime:
            time.sleep(max(0.0, begun + ticks * base.dt - time.monotonic()))
    return ticks

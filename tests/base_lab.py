"""A rover in the test's own process: autopilot double, link, servo, and what tests ask of them."""

from pathlib import Path
from typing import Any

import numpy as np

from firmware_sim import plane
from firmware_sim.rover import Rover, open_rover
from rtctl.app.rover import ROVER as VEHICLE
from rtctl.app.rover_link import open_link
from rtctl.app.servo import Servo
from rtctl.design.rover import build
from rtctl.hal.clock import Slot
from rtctl.hal.mavlink.wire import InProcess
from rtctl.rover import faults
from rtctl.rover.signals import Ask
from rtctl.spec.base import load
from rtctl.types import Goal, ObstacleEdit, Request, State, Status, Task, Verb

CONFIGS = Path(__file__).parents[1] / "configs"
ROVER, ROVER_PX4 = CONFIGS / "rover.toml", CONFIGS / "rover_px4.toml"
UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])
FAR_DISC = {"name": "far", "type": "cylinder", "radius_m": 1.0, "length_m": 2.0, "position_m": [60.0, 60.0, 0.0]}


def goal_at(x: float, y: float, tolerance: float = 0.3) -> Goal:
    """Return the goal of being at x, y [m]."""
    return Goal(np.array([x, y, 0.0]), UPRIGHT, Task.POSITION, tolerance, 0.1)


class BaseLab:
    """One rover and the controller that drives it, in lockstep."""

    def __init__(self, config=ROVER, obstacles=(FAR_DISC,), inject=(), relay=None, pose=(0.0, 0.0, 0.0), sink=None):
        """`relay` is given the packets of each period, both ways, and returns those that arrive."""
        self.config = load(config)
        self.base = build(self.config, config)
        self.rover: Rover = open_rover(
            config, {"obstacle": list(obstacles), "start_pose": list(pose)}, inject, wait=True
        )
        self.relay = relay
        self.sent: list[bytes] = []  # of the last period
        self.link = open_link(self.config, Path(config), InProcess(self._exchange, self.base.dt))
        self.start = self.link.greet(lockstep=True)
        self.servo = Servo(VEHICLE, self.base, self.link, sink, self.start, stamp=lambda now: round(now * 1e9))
        self.slot = 0
        self.asks: list[Ask] = []
        self.least = np.inf
        self.records: list[Any] = []

    def _exchange(self, packets: list[bytes]) -> list[bytes]:
        self.sent = packets
        if self.relay is None:
            return self.rover.exchange(packets)
        self.rover.hear(self.relay("up", packets))
        return self.relay("down", self.rover.advance())

    @property
    def m(self):
        return self.servo.memory

    @property
    def faults(self) -> tuple[str, ...]:
        return faults.names(self.m.in_force)

    @property
    def seen(self) -> tuple[str, ...]:
        return faults.names(self.servo.faults_seen)

    def tick(self, verb: Verb = Verb.NONE, goal: Goal | None = None, obstacles: tuple[ObstacleEdit, ...] = ()):
        turn = self.servo.turn(Slot(self.slot, 0, 0.0), Request(verb, goal, obstacles))
        self.slot += 1
        self.asks.append(turn.command.ask)
        self.records.append(turn.record)
        clearance = self.rover.truth().clearance
        self.least = min(self.least, *clearance.values()) if clearance else self.least
        return turn

    def run(self, seconds: float, until=None) -> bool:
        """Tick for so long, or until a condition holds; return whether it came to hold."""
        for _ in range(round(seconds / self.base.dt)):
            self.tick()
            if until is not None and until():
                return True
        return until is None

    def armed(self) -> "BaseLab":
        """Arm and wait for RUN."""
        self.tick(Verb.ARM)
        assert not self.m.refusal, self.m.refusal
        assert self.run(5.0, lambda: self.m.state == State.RUN), (self.m.state, self.faults, list(self.link.events))
        return self

    def driving(self, x: float = 40.0, y: float = 0.0, seconds: float = 3.0) -> "BaseLab":
        """Arm, give a goal far away, and drive for a while."""
        self.armed().tick(goal=goal_at(x, y))
        assert not self.m.refusal, self.m.refusal
        self.run(seconds)
        return self

    def arrive(self, x: float, y: float, seconds: float = 60.0) -> bool:
        """Give a goal and return whether the base says that it has arrived."""
        self.tick(goal=goal_at(x, y))
        assert not self.m.refusal, self.m.refusal
        return self.run(seconds, lambda: self.m.status == Status.ARRIVED)

    @property
    def speed(self) -> float:
        return abs(self.rover.truth().v)


class Relay:
    """A poor radio in user space: packets are lost, late, and overtake each other; the same every time."""

    def __init__(self, period: float, loss: float = 0.0, delay: float = 0.0, jitter: float = 0.0, seed: int = 0):
        """`delay` and `jitter` [s] each way; `jitter` is added to every fourth packet alone: those are overtaken."""
        self.random = np.random.default_rng(seed)
        self.period, self.loss, self.delay, self.jitter = period, loss, delay, jitter
        self.cycle = {"up": 0, "down": 0}
        self.held: dict[str, list[tuple[float, int, bytes]]] = {"up": [], "down": []}
        self.count = self.lost = 0

    def __call__(self, way: str, packets: list[bytes]) -> list[bytes]:
        self.cycle[way] += 1
        now = self.cycle[way] * self.period
        for packet in packets:
            self.count += 1
            if self.random.random() < self.loss:
                self.lost += 1
                continue
            late = self.delay + (self.jitter if self.random.random() < 0.25 else 0.0)
            self.held[way].append((now + late, self.count, packet))
        due = sorted(entry for entry in self.held[way] if entry[0] <= now + 1e-9)
        self.held[way] = [entry for entry in self.held[way] if entry[0] > now + 1e-9]
        return [packet for _, _, packet in due]


def some_world(seed: int, size: float = 14.0, solids: int = 10) -> tuple[list[dict[str, Any]], list[np.ndarray]]:
    """Return ten random discs and boxes around the origin, and 20 places that are free."""
    random = np.random.default_rng(seed)
    tables: list[dict[str, Any]] = []
    while len(tables) < solids:
        x, y = random.uniform(-size, size, 2)
        if np.hypot(x, y) < 4.5:
            continue
        place: dict[str, Any] = {"name": f"o{len(tables)}", "position_m": [float(x), float(y), 0.0]}
        if random.random() < 0.5:
            place |= {"type": "cylinder", "radius_m": float(random.uniform(0.4, 1.5)), "length_m": 2.0}
        else:
            a, b, yaw = random.uniform((0.8, 0.8, 0.0), (4.0, 2.0, np.pi))
            place |= {"type": "box", "size_m": [float(a), float(b), 2.0], "rpy_rad": [0.0, 0.0, float(yaw)]}
        tables.append(place)
    there = plane.solids_at(tables, 0.0)
    places: list[np.ndarray] = []
    while len(places) < 20:
        at = random.uniform(-size, size, 2)
        near = places[-1] if places else np.zeros(2)
        if np.hypot(*(at - near)) < 0.8 * size and min(plane.distance(s, at[None])[0] for s in there) > 1.5:
            places.append(at)
    return tables, places

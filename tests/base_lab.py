"""A rover in the test's own process: autopilot double, link, servo, and what tests ask of them."""

from pathlib import Path
from typing import Any

import numpy as np

from firmware_sim.rover import Rover, open_rover
from rtctl.base import machine_of, open_link
from rtctl.config.base import load
from rtctl.config.base_derive import build
from rtctl.control.base import faults
from rtctl.control.base.signals import Ask
from rtctl.hal.clock import Slot
from rtctl.hal.wire import InProcess
from rtctl.servo import Servo
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
        self.start = self.link.handshake()
        machine = machine_of(self.link)
        self.servo = Servo(self.base, self.link, sink, np.zeros(0), stamp=lambda now: round(now * 1e9),
                           machine=machine, start=self.start)  # fmt: skip
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
        assert not self.m.verdict, self.m.verdict
        assert self.run(5.0, lambda: self.m.state == State.RUN), (self.m.state, self.faults, list(self.link.news))
        return self

    def driving(self, x: float = 40.0, y: float = 0.0, seconds: float = 3.0) -> "BaseLab":
        """Arm, give a goal far away, and drive for a while."""
        self.armed().tick(goal=goal_at(x, y))
        assert not self.m.verdict, self.m.verdict
        self.run(seconds)
        return self

    def arrive(self, x: float, y: float, seconds: float = 60.0) -> bool:
        """Give a goal and return whether the base says that it has arrived."""
        self.tick(goal=goal_at(x, y))
        assert not self.m.verdict, self.m.verdict
        return self.run(seconds, lambda: self.m.status == Status.ARRIVED)

    @property
    def speed(self) -> float:
        return abs(self.rover.truth().v)

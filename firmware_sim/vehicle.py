"""A wheeled vehicle on the plane as it answers an autopilot: dead time, then a lag of speed, a swing of the yaw rate.

Measured on a simulated ArduPilot skid-steer rover that shares no code with this: first motion 0.32 s after the first
set-point, 90 % of 1.5 m/s at 1.5 s, the yaw rate changes its sign 0.40 s after the set-point did and overshoots.
"""

import math
from collections import deque
from typing import NamedTuple


class Traits(NamedTuple):
    """What the vehicle can do."""

    drive: str  # skid | ackermann | holonomic
    v_max: float  # [m/s]
    w_max: float  # [rad/s]
    a_max: float  # [m/s2]
    dead: float = 0.32  # [s] from a set-point to the first motion
    lag: float = 0.50  # [s] time constant of speed
    turn_rate: float = 12.0  # [rad/s] natural frequency of the yaw rate
    turn_damping: float = 0.5  # its damping ratio: it overshoots by a sixth
    radius: float = 0.0  # [m] smallest turn


class Vehicle:
    """Pose (x east, y north, yaw counter-clockwise from east) and body velocity."""

    def __init__(self, traits: Traits, x: float = 0.0, y: float = 0.0, yaw: float = 0.0) -> None:
        self.traits, self.x, self.y, self.yaw = traits, x, y, yaw
        self.v = self.side = self.w = self.alpha = 0.0  # forward, to the left [m/s], turning [rad/s], [rad/s2]
        self.grip = self.turn_grip = 1.0  # of the speed and the yaw rate asked for, what the ground gives
        self._asked: deque[tuple[float, float, float]] = deque()

    @property
    def velocity(self) -> tuple[float, float]:
        """Velocity east, north [m/s]."""
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        return c * self.v - s * self.side, s * self.v + c * self.side

    def step(self, v: float, side: float, w: float, dt: float) -> None:
        """Move on by dt [s], asked for a body velocity v, side [m/s] and a yaw rate w [rad/s]."""
        t = self.traits
        self._asked.append((v, side, w))
        waiting = max(1, round(t.dead / dt))
        while len(self._asked) > waiting:
            self._asked.popleft()
        v, side, w = self._asked[0] if len(self._asked) == waiting else (0.0, 0.0, 0.0)
        v = self.grip * min(max(v, -t.v_max), t.v_max)
        w = self.turn_grip * min(max(w, -t.w_max), t.w_max)
        side = min(max(side, -t.v_max), t.v_max) if t.drive == "holonomic" else 0.0
        self.v += _approach(v - self.v, t.lag, t.a_max, dt)
        self.side += _approach(side - self.side, t.lag, t.a_max, dt)
        if t.drive == "ackermann":
            bound = abs(self.v) / max(t.radius, 1e-3)
            w = min(max(w, -bound), bound)
        parts = max(1, math.ceil(4.0 * t.turn_rate * dt))
        for _ in range(parts):  # of a step each, so that coarse periods stay stable
            h = dt / parts
            self.alpha += h * (t.turn_rate**2 * (w - self.w) - 2.0 * t.turn_damping * t.turn_rate * self.alpha)
            self.w += h * self.alpha
        if t.drive == "ackermann":
            self.w = min(max(self.w, -bound), bound)
        middle = self.yaw + 0.5 * dt * self.w
        self.x += dt * (math.cos(middle) * self.v - math.sin(middle) * self.side)
        self.y += dt * (math.sin(middle) * self.v + math.cos(middle) * self.side)
        self.yaw = math.remainder(self.yaw + dt * self.w, 2.0 * math.pi)


def _approach(error: float, lag: float, a_max: float, dt: float) -> float:
    return min(max(error * dt / lag, -a_max * dt), a_max * dt)

"""A gripper's drive and its jaws: one degree of freedom with friction, end stops, and maybe a thing between the jaws.

J qdd = tau - B qd - mu sign(qd) - k (q beyond a stop or the thing); the thing is stiff and does not move. Its drive is
the scalar `Drive`, without a brake.
"""

import math
from typing import Any, NamedTuple

from firmware_sim.drive import NS, Drive, Rating

INERTIA = 1.8e-3  # [kg m^2] of the rotor through a gear of 10, the jaws included
VISCOUS = 0.02  # [Nms/rad]
COULOMB = 0.1  # [Nm]
STIFF = 400.0  # [Nm/rad] of stops and things
DAMPED = 0.4  # [Nms/rad] of the same
BEYOND = 0.05  # [rad] of its ends outside which it stops


class GripperSetting(NamedTuple):
    """A gripper as the simulator needs it."""

    name: str
    rating: Rating
    open: float  # [rad]
    closed: float  # [rad]


class Finger:
    """Owns a drive and the angle of its shaft."""

    def __init__(self, setting: GripperSetting, thing: float) -> None:
        """thing: at this share of the way something is between the jaws, above 1 nothing is. It starts open."""
        self.setting, self.drive = setting, Drive(setting.rating)
        ends = sorted((setting.open, setting.closed))
        at = setting.open + thing * (setting.closed - setting.open)
        self.low, self.high = ends[0] - BEYOND, ends[1] + BEYOND
        if thing <= 1.0 and setting.closed > setting.open:
            self.high = at
        elif thing <= 1.0:
            self.low = at
        self.q, self.qd = setting.open, 0.0
        self.pressed = 0.0  # [Nm] between shaft and stop or thing
        self.drive.sense(self.q, self.qd)

    def step(self, dt_ns: int) -> None:
        """Run drive and jaws for a physics step."""
        dt = dt_ns / NS
        given = self.drive.actuate(dt_ns)
        beyond = self.q - min(max(self.q, self.low), self.high)
        self.pressed = STIFF * beyond + (DAMPED * self.qd if beyond else 0.0)
        drive = 0.0 if self.drive.brake else given.torque
        free = self.qd + dt / INERTIA * (drive - VISCOUS * self.qd - self.pressed)
        rub = dt / INERTIA * COULOMB
        self.qd = math.copysign(max(abs(free) - rub, 0.0), free)
        self.q += dt * self.qd
        self.drive.sense(self.q, self.qd)


def gripper_settings(table: list[dict[str, Any]], rating: Any) -> tuple[GripperSetting, ...]:
    """Return the grippers of a robot file; rating: makes one of a row's keys."""
    return tuple(
        GripperSetting(g.get("name", "gripper"), rating(g), float(g["open_rad"]), float(g["closed_rad"])) for g in table
    )

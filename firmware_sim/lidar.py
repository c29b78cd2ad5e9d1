"""The range sensor's driver: a component of its own on the vehicle's link, with a clock of its own.

No ArduPilot sends OBSTACLE_DISTANCE. What sends it is a lidar's driver on another computer: another component id, Unix
time in `time_usec`, its own view of frames, and sectors that know nothing.
"""

import math
import random
from typing import Any

from firmware_sim import plane
from firmware_sim.mav import Endpoint

SECTORS, RAYS, REACH, HZ = 72, 5, 12.0, 10.0
NEAREST = 0.20  # [m] it measures nothing closer
NOISE = 0.02  # [m]
DELAY = 0.04  # [s] from the middle of a turn to the message
UNKNOWN, BODY, GLOBAL = 65535, 12, 0  # of OBSTACLE_DISTANCE; MAV_FRAME
ZEROES = 0.05  # share of sectors that a spurious zero comes in
COMPONENT = 195


class Lidar:
    """What one range sensor says of a world, and how wrongly."""

    def __init__(self, endpoint: Endpoint, seed: int) -> None:
        self.end, self.random = endpoint, random.Random(seed)
        self.blind = self.unknown = False  # nothing is sent; everything is sent as unknown
        self.hidden: list[tuple[float, float]] = []  # [deg] clockwise from the front: sectors that know nothing
        self.zeroes: list[tuple[float, float]] = []  # [deg] where spurious zeros come
        self.frame = BODY
        self.turned = self.mirrored = False  # numbers count from north; numbers count counter-clockwise
        self._due = self._beat_due = 0.0
        self._held: list[tuple[float, Any]] = []  # [s] when it is said

    def step(
        self, now: float, epoch: float, pose: tuple[float, float, float], solids: list[plane.Solid]
    ) -> list[bytes]:
        """Return what it says at `now` [s] of its own time; pose east, north [m], yaw [rad]."""
        if now >= self._beat_due:
            self._beat_due = now + 1.0
            self._held.append((now, self.end.codec.heartbeat_encode(18, 8, 0, 0, 4)))
        if now >= self._due:
            self._due = now + 1.0 / HZ
            if not self.blind:
                self._held.append((now + DELAY, self._scan(epoch + now, pose, solids)))
        due = [message for at, message in self._held if at <= now]
        self._held = [each for each in self._held if each[0] > now]
        return [self.end.pack(message, epoch + now) for message in due]

    def _scan(self, unix: float, pose: tuple[float, float, float], solids: list[plane.Solid]) -> Any:
        x, y, yaw = pose
        begin = 0.5 * math.pi if self.turned else yaw  # of sector 0, counter-clockwise from east
        ranges = plane.scan(solids, x, y, begin, SECTORS, RAYS, REACH)
        width = 360.0 / SECTORS
        cells = []
        for k, d in enumerate(ranges):
            noisy = d + self.random.gauss(0.0, NOISE)
            cell = round(100.0 * REACH) + 1 if not math.isfinite(d) else min(max(round(100.0 * noisy), 1), 1200)
            if noisy < NEAREST:
                cell = UNKNOWN
            ahead = math.degrees(yaw - begin) + k * width  # clockwise from the front
            if self.unknown or any(_within(ahead, *gap) for gap in self.hidden):
                cell = UNKNOWN
            elif any(_within(ahead, *gap) for gap in self.zeroes) and self.random.random() < ZEROES:
                cell = 0
            cells.append(cell)
        if self.mirrored:
            cells = [cells[-k] for k in range(SECTORS)]
        return self.end.codec.obstacle_distance_encode(
            round(unix * 1e6),
            0,
            cells,
            round(width),
            round(100.0 * NEAREST),
            round(100.0 * REACH),
            width,
            0.0,
            self.frame,
        )


def _within(angle: float, low: float, high: float) -> bool:
    """Tell whether an angle [deg] lies on the way clockwise from low to high."""
    return high - low >= 360.0 or (angle - low) % 360.0 <= (high - low) % 360.0

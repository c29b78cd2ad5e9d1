"""Range sensors as sources of their own: who may speak, in which frame the numbers are, and whether they turn rightly.

A lidar's driver is another component of the vehicle's system than its autopilot, with its own idea of `frame`, its own
clock and sectors that know nothing. What a sector says is one of three: something there, nothing up to the reach,
unknown. Angles leave here as the body's, counter-clockwise from the front.
"""

import math
from collections import deque
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from rtctl.hal.mavlink.message import Message
from rtctl.rover.robot import SECTORS
from rtctl.types import F64

NOTHING, UNKNOWN = math.inf, -1.0
UNKNOWN_RAW = 65535
BODY_FRAMES = (8, 9, 12)
SILENT = 2.0  # [s] after which another component may take the place of one that was not named
BEAM_STALE = 0.5  # [s]
STAMP_WRONG = 2.0  # [s] between a stamp and the arrival beyond which the stamp is of another clock
TRAVEL, TURN = 0.7, 0.25  # [m], [rad] between two scans that are compared
FEW = 4  # returns below which a comparison says nothing
CAP = 1.5  # [m] that one return counts at most
OFF = 0.35  # [m] of mean distance between where returns were and are, beyond which the frame may be wrong
BETTER = 0.5  # of it that another frame must leave to be believed
STRIKES = 2  # comparisons running


class SensorSpec(NamedTuple):
    """One range sensor of the config."""

    name: str
    system: int | None  # None: the vehicle's
    component: int | None  # None: any, while only one speaks
    message: str  # OBSTACLE_DISTANCE | DISTANCE_SENSOR
    yaw: float  # [rad] of its front in the body's frame
    offset: tuple[float, float]  # [m] ahead, to the left
    frame: str  # "as sent" | "body" | "north"
    low: float  # [m] below it nothing is measured; what the sender says counts when it is more
    high: float  # [m]


ANY = SensorSpec("scan", None, None, "OBSTACLE_DISTANCE", 0.0, (0.0, 0.0), "as sent", 0.0, math.inf)
ANY_BEAM = ANY._replace(name="beams", message="DISTANCE_SENSOR")


class Scan(NamedTuple):
    """One turn of one sensor."""

    sensor: int
    ranges: F64  # (SECTORS,) [m] infinite: nothing up to the reach; negative: unknown
    start: float  # [rad] of sector 0 in the body's frame, counter-clockwise
    step: float  # [rad]
    reach: float  # [m]
    at: float  # [s] when it was taken, by our clock


NO_SCAN = Scan(0, np.full(SECTORS, UNKNOWN), 0.0, -2.0 * math.pi / SECTORS, 0.0, -math.inf)


class Pose(NamedTuple):
    """Where the vehicle says that it is."""

    x: F64  # (2,) [m]
    yaw: float  # [rad]


class Ranging:
    """The newest of every range sensor; `take` is given each message of the vehicle's system that passed all checks."""

    def __init__(self, specs: tuple[SensorSpec, ...], say: Callable[[str], None]) -> None:
        self.specs, self.say = specs, say
        self.scan = NO_SCAN  # of this cycle, or the last one there was
        self.fresh = 0  # scans that came in this cycle
        self.known_at = -math.inf  # [s] when a scan was taken that knew anything
        self.beams, self.beams_at = np.full(8, UNKNOWN), np.full(8, -math.inf)
        self.beam_reach = 0.0
        self.wrong = False  # a sensor's frame contradicts the vehicle's motion
        self._waiting: deque[Scan] = deque(maxlen=8)
        self._speaker: dict[int, tuple[int, int]] = {}  # sensor -> who speaks for it
        self._heard: dict[int, float] = {}
        self._told: set[tuple[int, tuple[int, int]]] = set()
        self._checks = [Check(spec, say) for spec in specs]

    def cycle(self) -> None:
        """Begin a cycle: one scan that waits is its own."""
        self.fresh = 0

    def next(self) -> None:
        """Let the next scan that waits be the cycle's."""
        if self._waiting:
            self.scan, self.fresh = self._waiting.popleft(), 1

    def wants(self, name: str) -> bool:
        """Return whether a message is a range sensor's."""
        return name in ("OBSTACLE_DISTANCE", "DISTANCE_SENSOR")

    def take(
        self, message: Message, source: tuple[int, int], vehicle: int, pose: Pose, stamp: float, now: float
    ) -> bool:
        """Take a sensor's message that came at `now` [s], `stamp` [s] its own time by our clock; False: of nobody."""
        k = self._sensor(message.get_type(), source, vehicle, now)
        if k is None:
            return False
        self._heard[k] = now
        if message.get_type() == "DISTANCE_SENSOR":
            self._beam(self.specs[k], message, now)
            return True
        found = self._obstacles(k, message, pose.yaw, stamp if 0.0 <= now - stamp < STAMP_WRONG else now)
        if found is not None:
            self._waiting.append(found)
            if bool((found.ranges >= 0.0).any()):
                self.known_at = max(self.known_at, found.at)
            self.wrong = self._checks[k].judge(found, self.specs[k], message.frame in BODY_FRAMES, pose) or self.wrong
        return True

    def _sensor(self, kind: str, source: tuple[int, int], vehicle: int, now: float) -> int | None:
        """Return the sensor that a source speaks for; one that is not named has the first that speaks."""
        for k, spec in enumerate(self.specs):
            if spec.message != kind or source[0] != (vehicle if spec.system is None else spec.system):
                continue
            if spec.component == source[1]:
                return k
            if spec.component is not None:
                continue
            speaker = self._speaker.get(k)
            if speaker not in (None, source) and now - self._heard[k] < SILENT:
                if (k, source) not in self._told:
                    self._told.add((k, source))
                    self.say(f"range sensor {spec.name}: {source} speaks beside {speaker} and is not heard: name both")
                continue
            if speaker != source:
                self.say(f"range sensor {spec.name}: {kind} of component {source[1]} of system {source[0]}")
                self._speaker[k] = source
            return k
        return None

    def _obstacles(self, k: int, m: Message, yaw: float, at: float) -> Scan | None:
        """72 sectors clockwise from angle_offset; max + 1: nothing there; 65535 and below the minimum: unknown."""
        spec = self.specs[k]
        increment = math.radians(m.increment_f if m.increment_f != 0.0 else m.increment)
        offset = math.radians(m.angle_offset)
        if not (math.isfinite(increment) and math.isfinite(offset)) or increment == 0.0:
            return None
        raw = np.array(m.distances[:SECTORS], np.float64)
        count = min(SECTORS, int(2.0 * math.pi / abs(increment) + 1e-6))
        reach = min(0.01 * m.max_distance, spec.high)
        metres = np.where((raw > m.max_distance) | (0.01 * raw > reach), NOTHING, 0.01 * raw)
        metres[(raw == UNKNOWN_RAW) | (raw == 0.0) | (metres < max(0.01 * m.min_distance, spec.low))] = UNKNOWN
        ranges = np.full(SECTORS, UNKNOWN)
        ranges[:count] = metres[:count]
        body = spec.frame == "body" or (spec.frame == "as sent" and m.frame in BODY_FRAMES)
        start = spec.yaw - offset if body else 0.5 * math.pi - offset - yaw
        return Scan(k, ranges, math.remainder(start, 2.0 * math.pi), -increment, reach, at)

    def _beam(self, spec: SensorSpec, m: Message, now: float) -> None:
        if m.orientation >= 8 or m.signal_quality == 1:
            return
        k = (m.orientation - round(spec.yaw / (0.25 * math.pi))) % 8
        cm, low, high = (
            m.current_distance,
            max(m.min_distance, 100.0 * spec.low),
            min(m.max_distance, 100.0 * spec.high),
        )
        self.beams[k] = UNKNOWN if cm < low or cm == 0 else 0.01 * cm if cm < high else NOTHING
        self.beams_at[k], self.beam_reach = now, 0.01 * high
        if self.beams[k] >= 0.0:
            self.known_at = max(self.known_at, now)

    def beams_now(self, now: float) -> F64:
        """Return the single sensors' ranges (8,) [m], clockwise from the front, unknown where stale."""
        return np.where(now - self.beams_at <= BEAM_STALE, self.beams, UNKNOWN)


class Check:
    """Whether what a sensor sees stays where it is while the vehicle moves.

    Returns are laid into the world by the frame that counts and by those that a sender may have meant instead. Where
    the vehicle has moved, only the right one lays them where they were.
    """

    def __init__(self, spec: SensorSpec, say: Callable[[str], None]) -> None:
        self.name, self.say = spec.name, say
        self._pose: Pose | None = None
        self._points: dict[str, F64] = {}
        self._strikes = 0
        self.wrong = False

    def judge(self, scan: Scan, spec: SensorSpec, said_body: bool, pose: Pose) -> bool:
        """Return whether the frame of the scans is wrong."""
        if self.wrong:
            return True
        body = spec.frame == "body" or (spec.frame == "as sent" and said_body)
        meant = {"body": scan.start, "north": scan.start + 0.5 * math.pi - pose.yaw}
        if not body:
            meant = {"north": scan.start, "body": scan.start + pose.yaw - 0.5 * math.pi}
        points = {name: laid(scan, start, scan.step, spec, pose) for name, start in meant.items()}
        points["mirrored"] = laid(scan, -scan.start, -scan.step, spec, pose)
        counts = "body" if body else "north"
        before = self._pose
        if before is not None:
            turned = abs(math.remainder(pose.yaw - before.yaw, 2.0 * math.pi))
            if math.hypot(*(pose.x - before.x)) < TRAVEL and turned < TURN:
                return False
            self._compare(points, counts)
        self._pose, self._points = pose, points
        return self.wrong

    def _compare(self, points: dict[str, F64], counts: str) -> None:
        off = {name: apart(p, self._points[name]) for name, p in points.items()}
        if math.isnan(off[counts]):
            return
        best = min((name for name in off if name != counts), key=lambda name: off[name])
        against = off[counts] > OFF and off[best] < BETTER * off[counts]
        self._strikes = self._strikes + 1 if against else 0
        if self._strikes >= STRIKES:
            self.wrong = True
            how = {"mirrored": "against", "north": "with"}.get(best, "against")
            self.say(
                f"range sensor {self.name}: what rests moves by {off[counts]:.2f} m as {counts} numbers, by "
                f"{off[best]:.2f} m as {best} ones: the scan turns {how} the vehicle; set frame in [[sensor]]"
            )


def laid(scan: Scan, start: float, step: float, spec: SensorSpec, pose: Pose) -> F64:
    """Return the points (m, 2) [m] in the world that a scan touched, its sector 0 at the body angle `start` [rad]."""
    hit = np.flatnonzero((scan.ranges >= 0.0) & np.isfinite(scan.ranges))
    angle = pose.yaw + start + step * hit
    c, s = math.cos(pose.yaw), math.sin(pose.yaw)
    at = pose.x + np.array([c * spec.offset[0] - s * spec.offset[1], s * spec.offset[0] + c * spec.offset[1]])
    points: F64 = at + scan.ranges[hit, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return points


def apart(a: F64, b: F64) -> float:
    """Return the mean distance [m] of points a (m, 2) to the nearest of b (n, 2), each at most CAP; NaN: too few."""
    if min(len(a), len(b)) < FEW:
        return math.nan
    d = np.sqrt(((a[:, None, :] - b[None, :, :]) ** 2).sum(axis=2))
    return float(np.minimum(d.min(axis=1), CAP).mean())

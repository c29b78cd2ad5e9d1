"""What the vehicle's messages say, as values with their ages. NED, degrees and centimetres end here: ENU and SI inside.

east, north = y, x of NED        yaw = pi/2 - yaw of NED        yaw rate = -yaw rate of NED
"""

import math
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np

from rtctl.rover.estimator import wrapped
from rtctl.rover.robot import SECTORS

REBOOT = 2.0  # [s] by which time since boot must fall: messages that overtake each other are late by less
ROUND_TRIPS = 10  # kept of TIMESYNC
STEP = 0.25  # [s] that the vehicle's clock may differ from what was agreed, before it is agreed anew
NOTHING, UNKNOWN = math.inf, -1.0
BEAM_STALE = 0.5  # [s]
BODY_FRAMES = (8, 9, 12)
METRES = {"ardupilot": 111318.84502145034, "px4": 6371000.0 * math.pi / 180.0}  # a degree, as each autopilot projects
GOOD_EKF = 1 | 2  # attitude and horizontal velocity
POSITION_EKF = 8 | 16  # relative or absolute horizontal position
BAD_EKF = 128 | 1024  # constant position, uninitialised (ArduPilot); constant position, GPS glitch (PX4)
EKF_VARIANCE = 0.8  # ArduPilot's own failsafe threshold
RATIO = 1.0  # PX4: innovation over its gate


def enu(x: float, y: float) -> tuple[float, float]:
    """Return (east, north) of (north, east); its own inverse."""
    return y, x


def enu_yaw(yaw: float) -> float:
    """Return the yaw counter-clockwise from east of one clockwise from north; its own inverse."""
    return wrapped(0.5 * math.pi - yaw)


class Clock:
    """The vehicle's time since boot against ours, from TIMESYNC round trips; the shortest trip is believed."""

    def __init__(self) -> None:
        self._trips: deque[tuple[float, float]] = deque(maxlen=ROUND_TRIPS)
        self.round_trip = math.inf

    def answer(self, sent: float, theirs: float, now: float) -> None:
        """Take one round trip into account, all in [s]."""
        trip = now - sent
        if not 0.0 <= trip < 5.0:
            return
        offset = theirs - 0.5 * (sent + now)
        if self._trips and abs(offset - self.offset) > STEP + 0.5 * trip:  # the vehicle's clock jumped
            self._trips.clear()
        self._trips.append((trip, offset))
        self.round_trip = min(self._trips)[0]

    @property
    def offset(self) -> float:
        """Theirs - ours [s], NaN while not known."""
        return min(self._trips)[1] if self._trips else math.nan

    def ours(self, theirs: float, now: float) -> float:
        """Return our time of a moment of theirs; `now` while clocks are not agreed, or where it lies ahead."""
        at = theirs - self.offset
        return now if math.isnan(at) or at > now else at


class View:
    """The newest state of the vehicle; `take` is given every message that passed all checks."""

    def __init__(self, say: Callable[[str], None]) -> None:
        self.say = say
        self.clock = Clock()
        self.position, self.velocity = np.zeros(2), np.zeros(2)
        self.position_at = self.attitude_at = self.scan_at = self.heartbeat_at = -math.inf
        self.yaw = self.yaw_rate = 0.0
        self.fresh = self.scans = self.reset = 0
        self.scan = np.full(SECTORS, UNKNOWN)
        self.scan_start, self.scan_step, self.scan_reach = 0.0, -2.0 * math.pi / SECTORS, 0.0
        self.beams, self.beams_at = np.full(8, UNKNOWN), np.full(8, -math.inf)
        self.mode, self.armed, self.healthy = -1, False, False
        self.reboots = 0
        self.origin: tuple[float, float] | None = None  # [deg] latitude, longitude of (0, 0)
        self.parameters: dict[str, float] = {}
        self.asked: deque[int] = deque(maxlen=ROUND_TRIPS)  # ts1 of our TIMESYNC on their way
        self._boot = -math.inf  # newest time since boot [s]
        self._fallen = 0
        self._newest: dict[str, float] = {}
        self._text: dict[int, dict[int, str]] = {}
        self._odometry = False
        self._handlers: dict[str, Callable[[Any, float], None]] = {
            "HEARTBEAT": self._heartbeat, "LOCAL_POSITION_NED": self._local, "ODOMETRY": self._odometry_ned,
            "ATTITUDE": self._attitude, "EKF_STATUS_REPORT": self._ekf, "ESTIMATOR_STATUS": self._estimator,
            "OBSTACLE_DISTANCE": self._obstacles, "DISTANCE_SENSOR": self._beam, "STATUSTEXT": self._status_text,
            "PARAM_VALUE": self._parameter, "GPS_GLOBAL_ORIGIN": self._global_origin, "TIMESYNC": self._timesync,
        }  # fmt: skip

    def cycle(self) -> None:
        """Begin a cycle: nothing has come in it yet."""
        self.fresh = self.scans = 0

    def take(self, message: Any, now: float) -> None:
        """Take a message of the vehicle that came at `now` [s]."""
        handler = self._handlers.get(message.get_type())
        if handler is not None:
            handler(message, now)

    def _in_order(self, kind: str, boot: float) -> bool:
        """Return whether a message is newer than all of its kind before; notice that the vehicle started anew."""
        if boot < self._boot - REBOOT:
            self._fallen += 1
            if self._fallen < 2:
                return False
            self.say("the autopilot started anew")
            self.reboots += 1
            self.clock, self._newest, self._boot, self._fallen = Clock(), {}, -math.inf, 0
            self.healthy = False
        elif boot >= self._boot:
            self._fallen, self._boot = 0, boot
        if boot <= self._newest.get(kind, -math.inf):
            return False
        self._newest[kind] = boot
        return True

    def _heartbeat(self, m: Any, now: float) -> None:
        self.heartbeat_at, self.mode, self.armed = now, int(m.custom_mode), bool(m.base_mode & 128)

    def _local(self, m: Any, now: float) -> None:
        boot = 1e-3 * m.time_boot_ms
        if self._in_order("LOCAL_POSITION_NED", boot) and not self._odometry and _finite(m.x, m.y, m.vx, m.vy):
            self._moved(enu(m.x, m.y), enu(m.vx, m.vy), self.clock.ours(boot, now))

    def _moved(self, position: tuple[float, float], velocity: tuple[float, float], at: float) -> None:
        self.position, self.velocity, self.position_at = np.array(position), np.array(velocity), at
        self.fresh += 1

    def _odometry_ned(self, m: Any, now: float) -> None:
        """ODOMETRY carries a reset counter; where it comes in the local frame it goes before LOCAL_POSITION_NED."""
        boot = 1e-6 * m.time_usec
        if not self._in_order("ODOMETRY", boot) or m.frame_id not in (1, 20) or not _finite(m.x, m.y, m.vx, m.vy, *m.q):
            return
        self._odometry = True
        velocity = (m.vx, m.vy)
        if m.child_frame_id in BODY_FRAMES:
            yaw = _yaw_of(m.q)
            c, s = math.cos(yaw), math.sin(yaw)
            velocity = (c * m.vx - s * m.vy, s * m.vx + c * m.vy)
        self.reset = int(m.reset_counter)
        self._moved(enu(m.x, m.y), enu(*velocity), self.clock.ours(boot, now))

    def _attitude(self, m: Any, now: float) -> None:
        boot = 1e-3 * m.time_boot_ms
        if self._in_order("ATTITUDE", boot) and _finite(m.yaw, m.yawspeed):
            self.yaw, self.yaw_rate, self.attitude_at = enu_yaw(m.yaw), -m.yawspeed, self.clock.ours(boot, now)

    def _ekf(self, m: Any, now: float) -> None:
        calm = max(m.velocity_variance, m.pos_horiz_variance, m.compass_variance) < EKF_VARIANCE
        self.healthy = _usable(m.flags) and calm

    def _estimator(self, m: Any, now: float) -> None:
        self.healthy = _usable(m.flags) and max(m.vel_ratio, m.pos_horiz_ratio) < RATIO

    def _obstacles(self, m: Any, now: float) -> None:
        """72 sectors clockwise from angle_offset; max + 1 is nothing there, 65535 unknown."""
        increment = math.radians(m.increment_f if m.increment_f != 0.0 else m.increment)
        offset = math.radians(m.angle_offset)
        if not _finite(increment, offset) or increment == 0.0:
            return
        raw = np.array(m.distances[:SECTORS], np.float64)
        count = min(SECTORS, int(2.0 * math.pi / abs(increment) + 1e-6))
        scan = np.full(SECTORS, UNKNOWN)
        scan[:count] = np.where(raw > m.max_distance, NOTHING, 0.01 * raw)[:count]
        scan[:count][raw[:count] == 65535] = UNKNOWN
        start = -offset if m.frame in BODY_FRAMES else enu_yaw(offset) - self.yaw
        self.scan, self.scan_start, self.scan_step = scan, start, -increment
        self.scan_reach = 0.01 * m.max_distance
        age = now - self.clock.ours(1e-6 * m.time_usec, now)
        self.scan_at = now - (age if age < 2.0 else 0.0)  # a sensor's driver may stamp with another clock
        self.scans += 1

    def _beam(self, m: Any, now: float) -> None:
        if m.orientation < 8 and m.signal_quality != 1:
            there = m.min_distance <= m.current_distance < m.max_distance
            self.beams[m.orientation] = 0.01 * m.current_distance if there else UNKNOWN
            self.beams_at[m.orientation] = now

    def beams_now(self, now: float) -> np.ndarray[Any, np.dtype[np.float64]]:
        """Return the single sensors' ranges (8,) [m], unknown where stale."""
        return np.where(now - self.beams_at <= BEAM_STALE, self.beams, UNKNOWN)

    def _status_text(self, m: Any, now: float) -> None:
        """Texts come in chunks of 50 bytes, joined by their id."""
        text = m.text if isinstance(m.text, str) else m.text.decode("ascii", "replace")
        if m.id == 0:
            self.say(text)
            return
        parts = self._text.setdefault(m.id, {})
        parts[m.chunk_seq] = text
        if len(text) < 50 and all(k in parts for k in range(m.chunk_seq + 1)):
            self.say("".join(parts[k] for k in sorted(parts)))
            del self._text[m.id]
        elif len(self._text) > 8:
            self._text.pop(next(iter(self._text)))

    def _parameter(self, m: Any, now: float) -> None:
        name = m.param_id if isinstance(m.param_id, str) else m.param_id.decode("ascii", "replace")
        self.parameters[name.rstrip("\0")] = float(m.param_value)

    def _global_origin(self, m: Any, now: float) -> None:
        self.origin = (1e-7 * m.latitude, 1e-7 * m.longitude)

    def _timesync(self, m: Any, now: float) -> None:
        if m.tc1 > 0 and m.ts1 in self.asked:  # an answer to ours: ts1 is what we sent
            self.asked.remove(m.ts1)
            self._in_order("TIMESYNC", 1e-9 * m.tc1)  # an autopilot that started anew has forgotten its streams
            self.clock.answer(1e-9 * m.ts1, 1e-9 * m.tc1, now)


def local_of(origin: tuple[float, float], latitude: float, longitude: float, autopilot: str) -> tuple[float, float]:
    """Return (east, north) [m] of a place [deg], projected as the autopilot does for distances of some km."""
    degree = METRES[autopilot]
    north = (latitude - origin[0]) * degree
    east = (longitude - origin[1] + 180.0) % 360.0 - 180.0
    return east * degree * math.cos(math.radians(0.5 * (latitude + origin[0]))), north


def _finite(*numbers: float) -> bool:
    return all(map(math.isfinite, numbers))


def _usable(flags: int) -> bool:
    return flags & GOOD_EKF == GOOD_EKF and bool(flags & POSITION_EKF) and not flags & BAD_EKF


def _yaw_of(q: Any) -> float:
    w, x, y, z = q
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))

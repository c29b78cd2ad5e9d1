"""What the vehicle's messages say, as values with their ages. NED, degrees and centimetres end here: ENU and SI inside.

east, north = y, x of NED        yaw = pi/2 - yaw of NED        yaw rate = -yaw rate of NED
"""

import math
from collections import deque
from collections.abc import Callable, Iterable

import numpy as np

from rtctl.hal.mavlink.message import Message
from rtctl.hal.mavlink.ranging import Pose, Ranging, SensorSpec
from rtctl.rover.estimator import wrapped

REBOOT = 2.0  # [s] by which time since boot must fall: messages that overtake each other are late by less
ROUND_TRIPS = 10  # kept of TIMESYNC
STEP = 0.25  # [s] that the vehicle's clock may differ from what was agreed, before it is agreed anew
HOME_APART = 0.5  # [m] between home and origin from which it is seen what the local position is relative to
HOME_LOOKS = 5  # at both
GOOD_FIX = 3  # of GPS_RAW_INT: three dimensions
CALM_VARIANCE, CALM_RATIO = 0.4, 0.5  # of the autopilot's estimator: below it there is nothing to be slow for
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

    def __init__(self, say: Callable[[str], None], sensors: tuple[SensorSpec, ...], autopilot: str) -> None:
        self.say, self.autopilot = say, autopilot
        self.ranging = Ranging(sensors, say)
        self.clock = Clock()
        self.position, self.velocity = np.zeros(2), np.zeros(2)
        self.position_at = self.attitude_at = self.heartbeat_at = -math.inf
        self.uplink_at = math.nan  # [s] when we sent the newest thing that the vehicle has answered
        self.quality = 1.0  # of its estimator, by its own variances: 1 calm, 0 at its own failsafe's threshold
        self.fix = -1  # of its GPS; negative: it told of none
        self.fixed = False  # it has had one
        self.firmware: tuple[int, int, int] | None = None
        self.home: tuple[float, float] | None = None  # [deg]
        self.relative_to_home = False  # the local position is, as firmware before 4.1 tells it
        self.yaw = self.yaw_rate = 0.0
        self.fresh = self.reset = 0
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
        self._home_looks = 0
        self._handlers: dict[str, Callable[[Message, float], None]] = {
            "HEARTBEAT": self._heartbeat, "LOCAL_POSITION_NED": self._local, "ODOMETRY": self._odometry_ned,
            "ATTITUDE": self._attitude, "EKF_STATUS_REPORT": self._ekf, "ESTIMATOR_STATUS": self._estimator,
            "STATUSTEXT": self._status_text, "GPS_RAW_INT": self._gps, "GLOBAL_POSITION_INT": self._global,
            "HOME_POSITION": self._home, "AUTOPILOT_VERSION": self._version,
            "PARAM_VALUE": self._parameter, "GPS_GLOBAL_ORIGIN": self._global_origin, "TIMESYNC": self._timesync,
        }  # fmt: skip

    def cycle(self) -> None:
        """Begin a cycle: nothing has come in it yet."""
        self.fresh = 0
        self.ranging.cycle()

    def sensed(self, message: Message, source: tuple[int, int], vehicle: int, now: float) -> bool:
        """Take a range sensor's message of any component; return whether it is one that is listened to."""
        if not self.ranging.wants(message.get_type()):
            return False
        stamp = self.clock.ours(1e-6 * message.time_usec, now) if message.get_type() == "OBSTACLE_DISTANCE" else now
        return self.ranging.take(message, source, vehicle, Pose(self.position, self.yaw), stamp, now)

    def take(self, message: Message, now: float) -> None:
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
            self.fix, self.fixed, self.uplink_at = -1, False, math.nan
            self.healthy = False
        elif boot >= self._boot:
            self._fallen, self._boot = 0, boot
        if boot <= self._newest.get(kind, -math.inf):
            return False
        self._newest[kind] = boot
        return True

    def answered(self, sent: float) -> None:
        """Take it that the vehicle has heard what we sent at `sent` [s]."""
        self.uplink_at = sent if math.isnan(self.uplink_at) else max(self.uplink_at, sent)

    def _heartbeat(self, m: Message, now: float) -> None:
        self.heartbeat_at, self.mode, self.armed = now, int(m.custom_mode), bool(m.base_mode & 128)

    def _local(self, m: Message, now: float) -> None:
        boot = 1e-3 * m.time_boot_ms
        if self._in_order("LOCAL_POSITION_NED", boot) and not self._odometry and _finite(m.x, m.y, m.vx, m.vy):
            self._moved(enu(m.x, m.y), enu(m.vx, m.vy), self.clock.ours(boot, now))

    def _moved(self, position: tuple[float, float], velocity: tuple[float, float], at: float) -> None:
        self.position, self.velocity, self.position_at = np.array(position), np.array(velocity), at
        self.fresh += 1

    def _odometry_ned(self, m: Message, now: float) -> None:
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

    def _attitude(self, m: Message, now: float) -> None:
        boot = 1e-3 * m.time_boot_ms
        if self._in_order("ATTITUDE", boot) and _finite(m.yaw, m.yawspeed):
            self.yaw, self.yaw_rate, self.attitude_at = enu_yaw(m.yaw), -m.yawspeed, self.clock.ours(boot, now)

    def _ekf(self, m: Message, now: float) -> None:
        worst = max(m.velocity_variance, m.pos_horiz_variance, m.compass_variance)
        self.healthy = _usable(m.flags) and worst < EKF_VARIANCE
        self.quality = _calm(worst, CALM_VARIANCE, EKF_VARIANCE)

    def _estimator(self, m: Message, now: float) -> None:
        worst = max(m.vel_ratio, m.pos_horiz_ratio)
        self.healthy = _usable(m.flags) and worst < RATIO
        self.quality = _calm(worst, CALM_RATIO, RATIO)

    def _gps(self, m: Message, now: float) -> None:
        self.fix = int(m.fix_type)
        self.fixed = self.fixed or self.fix >= GOOD_FIX

    @property
    def fix_lost(self) -> bool:
        """Return whether a GPS that had a fix has none: the autopilot reckons on and says so seconds later."""
        return self.fixed and 0 <= self.fix < GOOD_FIX

    def _home(self, m: Message, now: float) -> None:
        self.home = (1e-7 * m.latitude, 1e-7 * m.longitude)

    def _global(self, m: Message, now: float) -> None:
        """Notice what LOCAL_POSITION_NED is relative to: old firmware tells it from home, which moves."""
        if self.origin is None or self.home is None or self._odometry:
            return
        place = (1e-7 * m.lat, 1e-7 * m.lon)
        by_origin, by_home = (
            np.array(local_of(zero, *place, self.autopilot)) - self.position for zero in (self.origin, self.home)
        )
        apart = float(np.hypot(*(by_origin - by_home)))
        if apart < HOME_APART:
            return
        from_home = bool(np.hypot(*by_home) < 0.3 * apart)
        self._home_looks = self._home_looks + 1 if from_home != self.relative_to_home else 0
        if self._home_looks >= HOME_LOOKS:
            self.relative_to_home, self._home_looks = from_home, 0
            self.say(f"LOCAL_POSITION_NED is relative to {'home, which moves' if from_home else 'the origin'}")

    def _version(self, m: Message, now: float) -> None:
        v = int(m.flight_sw_version)
        firmware = (v >> 24 & 0xFF, v >> 16 & 0xFF, v >> 8 & 0xFF)
        if firmware != self.firmware and v:  # 0: it does not say
            self.firmware = firmware
            self.say(f"firmware {'.'.join(map(str, firmware))}" + _implied(self.autopilot, firmware))

    def _status_text(self, m: Message, now: float) -> None:
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

    def _parameter(self, m: Message, now: float) -> None:
        name = m.param_id if isinstance(m.param_id, str) else m.param_id.decode("ascii", "replace")
        self.parameters[name.rstrip("\0")] = float(m.param_value)

    def _global_origin(self, m: Message, now: float) -> None:
        self.origin = (1e-7 * m.latitude, 1e-7 * m.longitude)

    def _timesync(self, m: Message, now: float) -> None:
        if m.tc1 > 0 and m.ts1 in self.asked:  # an answer to ours: ts1 is what we sent
            self.asked.remove(m.ts1)
            self.answered(1e-9 * m.ts1)
            self._in_order("TIMESYNC", 1e-9 * m.tc1)  # an autopilot that started anew has forgotten its streams
            self.clock.answer(1e-9 * m.ts1, 1e-9 * m.tc1, now)


def _calm(worst: float, calm: float, bad: float) -> float:
    return min(max((bad - worst) / (bad - calm), 0.0), 1.0) if math.isfinite(worst) else 0.0


def _implied(autopilot: str, firmware: tuple[int, int, int]) -> str:
    """Return what follows from a firmware's version."""
    if autopilot == "ardupilot" and firmware < (4, 1, 0):
        return ": its local position is relative to home, which moves while it is disarmed"
    if autopilot == "ardupilot" and firmware >= (4, 7, 0):
        return ": SYSID_MYGCS is called MAV_GCS_SYSID"
    return ""


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


def _yaw_of(q: Iterable[float]) -> float:
    w, x, y, z = q
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))

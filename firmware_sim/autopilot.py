"""An autopilot that drives the virtual vehicle: what ArduPilot Rover in GUIDED and a PX4 rover in OFFBOARD do.

Heartbeats, modes, arming checks, streams, parameters, set-points and their time-outs, as the MAVLink common set has
them. It believes nobody: what it is told is checked again here.
"""

import math
import random
from typing import Any, NamedTuple

from firmware_sim.mav import Endpoint
from firmware_sim.telemetry import STREAMS
from firmware_sim.vehicle import Vehicle

GUIDED, HOLD, MANUAL = 15, 4, 0  # custom modes of ArduPilot Rover
OFFBOARD, LOITER, PX4_MANUAL = 6 << 16, 4 << 16 | 3 << 24, 1 << 16
SCHEDULER_HZ = 40.0  # the fastest stream of a 50 Hz scheduler
UNASKED_HZ = 4.0  # of what it streams when nobody may ask
DEAD_RECKONING = 8.0  # [s] that ArduPilot goes on by its wheels and gyroscopes without a GPS, and says nothing
BIAS_TURN = 0.05  # [rad/s] by which the bias of the reported speed turns
EPOCH = 1.79e9  # [s] Unix time when the simulation begins; in real time it is what the clock says
COAST = 3.0  # [s] that ArduPilot goes on with the last set-point
GCS_SILENCE = 5.7  # [s] until the GCS failsafe holds, when it is on
PARAMETERS = {
    "ardupilot": {"AVOID_ENABLE": 0.0, "OA_TYPE": 0.0, "PRX1_TYPE": 0.0, "FS_GCS_ENABLE": 0.0, "MAV_GCS_SYSID": 245.0},
    "px4": {"COM_OF_LOSS_T": 1.0, "COM_OBL_RC_ACT": 0.0},
}
ACCEPTED, BUSY, DENIED, UNSUPPORTED, FAILED = range(5)


class Wanted(NamedTuple):
    """A set-point as it was taken."""

    at: float  # [s]
    v: float  # [m/s]
    side: float
    w: float  # [rad/s]
    course: float | None  # [rad] to turn to first, of a world velocity


class Autopilot:
    """One vehicle's autopilot; time is what `step` makes of it."""

    def __init__(self, kind: str, vehicle: Vehicle, endpoint: Endpoint, gcs: int, seed: int = 0) -> None:
        self.random = random.Random(seed)
        self.bias, self.bias_angle = 0.1, self.random.uniform(-math.pi, math.pi)  # [m/s], [rad] of the reported speed
        self.drift = 0.0  # [m/s] by which the reported position walks away
        self.cold = 0.0  # [s] after boot without a position
        self.gps_lost_at: float | None = None  # [s]
        self.rates_denied = self.home_relative = self.frozen = False
        self.home = (vehicle.x, vehicle.y)
        self.kind, self.vehicle, self.end, self.gcs = kind, vehicle, endpoint, gcs
        self.parameters = dict(PARAMETERS[kind])
        self.time = self.booted = 0.0  # [s]
        self.offset = (0.0, 0.0)  # [m] east, north: what its estimator is off by
        self.resets = 0
        self.estimator_bad = self.arming_refused = self.silent = self.mute = self.proximity_dead = False
        self.aborted = ""  # why it died
        self.epoch = EPOCH
        self.stick: tuple[float, float] | None = None  # [m/s, rad/s] a person drives
        self.log: list[tuple[float, str]] = []
        self.boot()

    def boot(self) -> None:
        """Start anew: disarmed, holding, streams forgotten."""
        self.booted = self.time
        self.mode = HOLD if self.kind == "ardupilot" else LOITER
        self.armed = False
        self.wanted: Wanted | None = None
        self.arrivals: list[float] = []  # [s] of set-points
        self.intervals: dict[int, float] = {}  # [s]
        self.due: dict[int, float] = {}
        self.heartbeat_due = self.time
        self.heard = self.time
        self.driving = False
        self.outbox: list[Any] = []

    @property
    def uptime(self) -> float:
        """Time [s] since it booted."""
        return self.time - self.booted

    @property
    def positioned(self) -> bool:
        """Tell whether its estimator has a position: not while it is cold, nor long after the GPS was lost."""
        reckoning = self.gps_lost_at is None or self.time - self.gps_lost_at < DEAD_RECKONING
        return self.uptime >= self.cold and reckoning

    @property
    def ours(self) -> int:
        """The mode in which set-points count."""
        return GUIDED if self.kind == "ardupilot" else OFFBOARD

    def note(self, text: str) -> None:
        """Say something to whoever reads."""
        self.log.append((self.time, text))
        raw = text.encode()
        identity = len(self.log) % 65535 + 1 if len(raw) > 50 else 0
        for k in range(0, len(raw), 50):
            self.outbox.append(self.end.codec.statustext_encode(4, raw[k : k + 50], identity, k // 50))

    # -- hearing -------------------------------------------------------------------------------------------------

    def hear(self, message: Any) -> None:
        """Take one message that was accepted."""
        if self.aborted:
            return
        name = message.get_type()
        source = (message.get_srcSystem(), message.get_srcComponent())
        if name == "HEARTBEAT" and source[0] == self.gcs:
            self.heard = self.time
        target = getattr(message, "target_system", 1), getattr(message, "target_component", 1)
        if target[0] not in (0, 1) or target[1] not in (0, 1):
            return
        if name == "COMMAND_LONG":
            result = self._command(message)
            ack = self.end.codec.command_ack_encode(message.command, result, 0, 0, *source)
            self.outbox.append(ack)
        elif name == "SET_POSITION_TARGET_LOCAL_NED":
            self._setpoint(message)
        elif name == "PARAM_REQUEST_READ":
            self._parameter(message.param_id)
        elif name == "TIMESYNC" and message.tc1 == 0:
            self.outbox.append(self.end.codec.timesync_encode(max(1, round(self.uptime * 1e9)), message.ts1))

    def _parameter(self, name: Any) -> None:
        text = name if isinstance(name, str) else name.decode()
        if text in self.parameters:  # an unknown name is silence
            value = self.parameters[text]
            self.outbox.append(self.end.codec.param_value_encode(text.encode(), value, 9, len(self.parameters), 0))

    def _command(self, m: Any) -> int:
        if m.command == 511:
            return self._interval(int(m.param1), m.param2)
        if m.command == 512:
            if int(m.param1) not in STREAMS:
                return DENIED
            if int(m.param1) in (49, 242, 32, 33) and not self.positioned:
                return FAILED
            self.outbox.append(STREAMS[int(m.param1)](self))
            return ACCEPTED
        if m.command == 176:
            return self._enter(m)
        if m.command == 400:
            return self._arm(m.param1 == 1.0, m.param2 == 21196.0)
        return UNSUPPORTED

    def _interval(self, message: int, microseconds: float) -> int:
        if self.rates_denied:
            return DENIED
        mine = {"ardupilot": (331, 230), "px4": (193,)}[self.kind]
        if message not in STREAMS or message in mine:
            return FAILED
        if microseconds > 0.0 and 1e6 / microseconds > SCHEDULER_HZ + 0.1:
            return DENIED
        if microseconds <= 0.0:
            self.intervals.pop(message, None)
        else:
            self.intervals[message] = 1e-6 * microseconds
            self.due[message] = self.time
        return ACCEPTED

    def _enter(self, m: Any) -> int:
        if not int(m.param1) & 1:
            return UNSUPPORTED
        mode = int(m.param2) if self.kind == "ardupilot" else int(m.param2) << 16 | int(m.param3) << 24
        if mode == self.ours:
            if self.estimator_bad or not self.positioned:
                self.note("Mode change to GUIDED failed: requires position")
                return FAILED
            if self.kind == "px4" and not self._offered():
                self.note("Switching to Offboard denied: no set-points")
                return DENIED
        elif mode not in (HOLD, MANUAL, LOITER, PX4_MANUAL):
            return DENIED
        self._switch(mode)
        return ACCEPTED

    def _offered(self) -> bool:
        """Tell whether set-points came faster than 2 Hz for more than a second."""
        recent = [t for t in self.arrivals if t > self.time - 1.0]
        return len(recent) > 2 and self.arrivals[0] <= self.time - 1.0 and self.time - recent[-1] < 0.5

    def _switch(self, mode: int) -> None:
        if mode != self.mode:
            self.mode, self.wanted = mode, None
            self.heartbeat_due = self.time  # a change is told at once

    def _arm(self, arm: bool, force: bool) -> int:
        if not arm:
            if abs(self.vehicle.v) > 0.3 and not force:
                return DENIED
            self.armed = False
        else:
            reason = self._unready()
            if reason:
                self.note(f"Arm: {reason}")
                return FAILED
            self.armed = True
            self.home = (self.vehicle.x + self.offset[0], self.vehicle.y + self.offset[1])
        self.heartbeat_due = self.time
        return ACCEPTED

    def _unready(self) -> str:
        if self.estimator_bad or not self.positioned:
            return "Need Position Estimate"
        if self.arming_refused:
            return "Radio failsafe on, hardware safety switch is on and the battery is below its arming voltage"
        if self.parameters.get("PRX1_TYPE") == 2.0 and self.proximity_dead:
            return "PRX1: No Data"
        return ""

    def _setpoint(self, m: Any) -> None:
        numbers = (m.vx, m.vy, m.yaw_rate)
        if not all(map(math.isfinite, numbers)):
            self.aborted = "a set-point that is not finite"
            return
        self.arrivals = [*self.arrivals[-200:], self.time]
        if self.mode != self.ours or not self.armed or m.type_mask & 0x38:
            return  # dropped silently
        if self.kind == "px4":
            frame_yaw = 0.0 if m.coordinate_frame == 1 else self.vehicle.yaw
            north, east = m.vx, m.vy
            course = math.atan2(north, east) + frame_yaw
            speed = math.hypot(north, east)
            self.wanted = Wanted(self.time, speed, 0.0, 0.0, course if speed > 0.05 else None)
            if self.vehicle.traits.drive == "holonomic":
                c, s = math.cos(self.vehicle.yaw), math.sin(self.vehicle.yaw)
                self.wanted = Wanted(self.time, c * east + s * north, c * north - s * east, 0.0, None)
        elif m.coordinate_frame in (8, 9):
            forward = m.vx if m.vy == 0.0 else math.hypot(m.vx, m.vy)
            if m.type_mask & 0x800:  # velocity alone: it turns towards it, for ever when it points back
                turn = math.copysign(self.vehicle.traits.w_max, 1.0) if m.vx < 0.0 else 0.0
                self.wanted = Wanted(self.time, max(forward, 0.0), 0.0, turn, None)
            else:
                self.wanted = Wanted(self.time, forward, 0.0, -m.yaw_rate, None)

    # -- acting --------------------------------------------------------------------------------------------------

    def step(self, dt: float) -> list[bytes]:
        """Move on by dt [s]; return what it says, as packets."""
        self.time += dt
        if self.aborted:
            self.vehicle.step(0.0, 0.0, 0.0, dt)
            return []
        self._failsafes()
        v, side, w = self._motion()
        self.vehicle.step(v, side, w, dt)
        self._wander(dt)
        self._emit()
        out, self.outbox = self.outbox, []
        unix = self.epoch + self.time
        return [] if self.silent else [self.end.pack(m, unix) for m in out]

    def _wander(self, dt: float) -> None:
        """Let the estimator's errors grow: a bias of the speed that turns, a drift, a position that is reckoned."""
        self.bias_angle += BIAS_TURN * dt
        east, north = self.bias_now()
        rate = self.drift
        if self.gps_lost_at is not None:
            self.offset = (self.offset[0] + east * dt, self.offset[1] + north * dt)
        if rate:
            angle = 0.1 * self.time
            self.offset = (self.offset[0] + rate * math.cos(angle) * dt, self.offset[1] + rate * math.sin(angle) * dt)
        if not self.armed:
            self.home = (self.vehicle.x + self.offset[0], self.vehicle.y + self.offset[1])

    def bias_now(self) -> tuple[float, float]:
        """Return the bias [m/s] of the reported speed, east and north."""
        return self.bias * math.cos(self.bias_angle), self.bias * math.sin(self.bias_angle)

    def _failsafes(self) -> None:
        if self.parameters.get("FS_GCS_ENABLE") and self.time - self.heard > GCS_SILENCE and self.mode == GUIDED:
            self.note("GCS failsafe: HOLD")
            self._switch(HOLD)
        if self.kind == "px4" and self.mode == OFFBOARD:
            last = self.arrivals[-1] if self.arrivals else -math.inf
            if self.time - last > self.parameters["COM_OF_LOSS_T"]:
                self.note("Offboard lost: Hold")
                self._switch(LOITER)

    def _motion(self) -> tuple[float, float, float]:
        if self.stick is not None and self.mode in (MANUAL, PX4_MANUAL):
            return self.stick[0], 0.0, self.stick[1]
        wanted = self.wanted
        if not self.armed or self.mode != self.ours or wanted is None:
            return 0.0, 0.0, 0.0
        if self.kind == "ardupilot" and self.time - wanted.at > COAST:
            return 0.0, 0.0, 0.0
        if wanted.course is None:
            return wanted.v, wanted.side, wanted.w
        error = math.remainder(wanted.course - self.vehicle.yaw, 2.0 * math.pi)
        if self.vehicle.traits.drive != "ackermann":  # turns on the spot before it drives, as PX4's differential rover
            self.driving = abs(error) < (0.785 if self.driving else 0.175)
        else:
            self.driving = True
        return (wanted.v if self.driving else 0.0), 0.0, 2.0 * error

    # -- telling -------------------------------------------------------------------------------------------------

    def _emit(self) -> None:
        if self.time >= self.heartbeat_due and not self.mute:
            self.heartbeat_due = self.time + 1.0
            autopilot = 3 if self.kind == "ardupilot" else 12
            base = 1 | (128 if self.armed else 0) | (8 if self.mode == self.ours else 0)
            status = 4 if self.armed else 3
            self.outbox.append(self.end.codec.heartbeat_encode(10, autopilot, base, self.mode, status))
        asked = dict.fromkeys((32, 30, 193, 24), 1.0 / UNASKED_HZ) if self.rates_denied else self.intervals
        for message, interval in asked.items():
            if message in (32, 33, 331) and (self.frozen or not self.positioned):
                continue
            due = self.due.setdefault(message, self.time)
            if self.time >= due - 1e-9:
                self.due[message] += interval * max(1, math.ceil((self.time - due) / interval))
                self.outbox.append(STREAMS[message](self))

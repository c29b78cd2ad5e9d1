"""What the virtual autopilot tells: its streams, encoded as ArduPilot and PX4 do, with its estimator's errors."""

import math
import random
from collections.abc import Callable
from typing import Any, Protocol

from firmware_sim.mav import Endpoint
from firmware_sim.vehicle import Vehicle

POSITION_NOISE, SPEED_NOISE = 0.005, 0.02  # [m], [m/s]
FIRMWARE = {"ardupilot": 0x040500FF, "px4": 0x010E00FF}  # 4.5.0, 1.14.0
OLD_FIRMWARE = 0x040000FF  # its local position is relative to home
ORIGIN = (-35.363262, 149.165237)  # [deg] of local (0, 0)


class Told(Protocol):
    """What is told of an autopilot; see `autopilot.Autopilot`."""

    kind: str
    vehicle: Vehicle
    end: Endpoint
    random: random.Random
    offset: tuple[float, float]
    home: tuple[float, float]
    home_relative: bool
    estimator_bad: bool
    gps_lost_at: float | None
    cold: float
    resets: int

    @property
    def uptime(self) -> float:
        """Time [s] since it booted."""

    @property
    def positioned(self) -> bool:
        """Tell whether its estimator has a position."""

    def bias_now(self) -> tuple[float, float]:
        """Return the bias [m/s] of the reported speed, east and north."""


def _ned(a: Told) -> tuple[float, float, float, float]:
    v = a.vehicle
    east, north = (p + q for p, q in zip(v.velocity, a.bias_now(), strict=True))
    x, y = v.x + a.offset[0], v.y + a.offset[1]
    if a.home_relative:
        x, y = x - a.home[0], y - a.home[1]
    shake = a.random.gauss
    return (
        y + shake(0.0, POSITION_NOISE),
        x + shake(0.0, POSITION_NOISE),
        north + shake(0.0, SPEED_NOISE),
        east + shake(0.0, SPEED_NOISE),
    )


def _yaw(a: Told) -> float:
    return math.remainder(0.5 * math.pi - a.vehicle.yaw, 2.0 * math.pi)


def _local(a: Told) -> Any:
    x, y, vx, vy = _ned(a)
    return a.end.codec.local_position_ned_encode(_ms(a), x, y, 0.0, vx, vy, 0.0)


def _odometry(a: Told) -> Any:
    x, y, vx, vy = _ned(a)
    half = 0.5 * _yaw(a)
    c, s = math.cos(2.0 * half), math.sin(2.0 * half)
    body = (c * vx + s * vy, c * vy - s * vx)
    q = (math.cos(half), 0.0, 0.0, math.sin(half))
    none = [math.nan] * 21
    return a.end.codec.odometry_encode(
        round(a.uptime * 1e6),
        1,
        12,
        x,
        y,
        0.0,
        q,
        *body,
        0.0,
        0.0,
        0.0,
        -a.vehicle.w,
        none,
        none,
        a.resets % 256,
        2,
        100,
    )


def _attitude(a: Told) -> Any:
    return a.end.codec.attitude_encode(_ms(a), 0.0, 0.0, _yaw(a), 0.0, 0.0, -a.vehicle.w)


def _ekf(a: Told) -> Any:
    flags, variance = (128 | 1, 1.4) if a.estimator_bad else (1 | 2 | 4 | 8 | 16 | 32 | 512, 0.02)
    if not a.positioned:
        flags = 1024 if a.uptime < a.cold else 128 | 1 | 2
    return a.end.codec.ekf_status_report_encode(flags, variance, variance, variance, 0.1, 0.0)


def _estimator(a: Told) -> Any:
    bad = a.estimator_bad or not a.positioned
    flags, ratio = (128 | 1, 2.0) if bad else (1 | 2 | 4 | 8 | 16 | 32, 0.1)
    stamp = round(a.uptime * 1e6)
    return a.end.codec.estimator_status_encode(stamp, flags, ratio, ratio, 0.1, 0.1, 0.0, 0.0, 0.3, 0.3)


def _gps(a: Told) -> Any:
    fix = 1 if a.gps_lost_at is not None or a.uptime < a.cold else 6
    lat, lon = _place(a.vehicle.x, a.vehicle.y)
    return a.end.codec.gps_raw_int_encode(
        round(a.uptime * 1e6),
        fix,
        lat,
        lon,
        584000,
        80 if fix > 3 else 9999,
        65535,
        65535,
        65535,
        14 if fix > 3 else 2,
    )


def _global(a: Told) -> Any:
    _, _, north, east = _ned(a)
    lat, lon = _place(a.vehicle.x + a.offset[0], a.vehicle.y + a.offset[1])
    return a.end.codec.global_position_int_encode(
        _ms(a), lat, lon, 584000, 0, round(100.0 * north), round(100.0 * east), 0, 65535
    )


def _home(a: Told) -> Any:
    lat, lon = _place(*a.home)
    return a.end.codec.home_position_encode(lat, lon, 584000, 0, 0, 0, (1, 0, 0, 0), 0, 0, 0)


def _version(a: Told) -> Any:
    firmware = OLD_FIRMWARE if a.home_relative else FIRMWARE[a.kind]
    return a.end.codec.autopilot_version_encode(0, firmware, 0, 0, 0, b"rtctl-dbl", b"rtctl-dbl", b"rtctl-dbl", 0, 0, 1)


def _place(x: float, y: float) -> tuple[int, int]:
    """Return latitude and longitude [1e-7 deg] of a place [m] east, north of the origin."""
    lat = ORIGIN[0] + y / 111318.84502145034
    lon = ORIGIN[1] + x / (111318.84502145034 * math.cos(math.radians(0.5 * (lat + ORIGIN[0]))))
    return round(lat * 1e7), round(lon * 1e7)


def _origin(a: Told) -> Any:
    return a.end.codec.gps_global_origin_encode(round(ORIGIN[0] * 1e7), round(ORIGIN[1] * 1e7), 584000)


def _ms(a: Told) -> int:
    return round(a.uptime * 1e3)


STREAMS: dict[int, Callable[[Told], Any]] = {  # by message id
    32: _local,
    30: _attitude,
    331: _odometry,
    193: _ekf,
    230: _estimator,
    49: _origin,
    24: _gps,
    33: _global,
    242: _home,
    148: _version,
}

"""The robot file of a mobile base: its structs, and the contradictions that such a file carries by itself."""

import math
import os
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Literal
from urllib.parse import urlsplit

from msgspec import Meta

from rtctl.control.firas import eta_of, rho_num_of
from rtctl.errors import ConfigError
from rtctl.protocol.mavlink_budget import MOST, SCANS, Streams, baud_of, fitted
from rtctl.protocol.signing import KEY
from rtctl.rover.occupancy import CELL, STENCIL
from rtctl.spec.obstacles import Name, Obstacle, refuse_obstacles, refuse_rooms
from rtctl.spec.read import name_place, parse, read
from rtctl.spec.robot import ConsoleTable, LogTable, Table, Text
from rtctl.spec.rules import Found
from rtctl.world import rooms

Metre = Annotated[float, Meta(ge=-10.0, le=10.0)]
Id = Annotated[int, Meta(ge=1, le=255)]
Seconds = Annotated[float, Meta(ge=0.05, le=30.0)]
SCHEMES = {
    "udpin": "HOST:PORT to listen at",
    "udpout": "HOST:PORT of the vehicle",
    "tcp": "HOST:PORT of the vehicle",
    "serial": "a device, /dev/ttyACM0:BAUD",
}


QUICK_STREAMS = {"ardupilot": ("LOCAL_POSITION_NED", "ATTITUDE"), "px4": ("ODOMETRY", "ATTITUDE")}
SLOW_STREAMS = {  # [Hz]
    "ardupilot": {"EKF_STATUS_REPORT": 10.0, "GPS_RAW_INT": 5.0, "GLOBAL_POSITION_INT": 2.0, "HOME_POSITION": 1.0},
    "px4": {"ESTIMATOR_STATUS": 10.0, "GPS_RAW_INT": 5.0},
}


class BaseRobot(Table, frozen=True, kw_only=True):
    """The robot."""

    name: Name
    kind: Literal["base"]


class BaseTable(Table, frozen=True, kw_only=True):
    """The vehicle: its outline, its wheels and how late they answer."""

    wheels: Literal["holonomic", "skid", "ackermann"]
    footprint_m: (
        Annotated[
            tuple[tuple[Metre, Metre], ...], Meta(min_length=3, max_length=64, description="corners, front +x, left +y")
        ]
        | None
    ) = None
    radius_m: Annotated[float, Meta(ge=0.02, le=10.0, description="of a round footprint")] | None = None
    control_point_m: Annotated[float, Meta(ge=0.05, le=5.0, description="ahead of the axle; steers gently when far")]
    turn_radius_m: Annotated[float, Meta(ge=0.0, le=50.0, description="smallest of a turn; 0 on the spot")] = 0.0
    reverse: Annotated[bool, Meta(description="may it drive backwards?")]
    lag_s: Annotated[float, Meta(ge=0.02, le=3.0, description="from a set-point to the speed it asks for")]
    turn_lag_s: Annotated[float, Meta(ge=0.02, le=3.0, description="the same of the yaw rate")]
    brake_m_s2: Annotated[float, Meta(ge=0.05, le=20.0, description="deceleration that the wheels surely give")]
    height_m: Annotated[float, Meta(ge=0.0, le=10.0, description="at which obstacles that are told are cut")] = 0.3
    reach_m: Annotated[float, Meta(ge=1.0, le=9000.0, description="goals further from the origin are refused")]


class BaseLoop(Table, frozen=True, kw_only=True):
    """Rates and scheduling."""

    servo_hz: Annotated[float, Meta(ge=10.0, le=100.0, description="ticks and set-points")]
    plan_hz: Annotated[float, Meta(ge=1.0, le=50.0, description="looks for a way, beside those that a scan causes")]
    realtime: Literal["required", "best-effort"] = "required"
    cpu: Annotated[int, Meta(ge=0, le=1023)] | None = None
    priority: Annotated[int, Meta(ge=1, le=98, description="SCHED_FIFO priority")] = 80


class BaseLink(Table, frozen=True, kw_only=True):
    """The autopilot."""

    type: Literal["mavlink"]
    url: Annotated[Text, Meta(description="; ".join(f"{k}:{v}" for k, v in SCHEMES.items()))]
    autopilot: Literal["ardupilot", "px4"]
    signing: Annotated[Literal["required", "off"], Meta(description="MAVLink 2 signing, both ways")]
    key_file: Annotated[Text, Meta(description="32 bytes, or 64 hexadecimal digits; mode 0600")] | None = None
    state_file: (
        Annotated[Text, Meta(description="where timestamps of signed streams are kept over restarts")] | None
    ) = None
    signing_link_id: Annotated[int, Meta(ge=0, le=255)] = 0
    system_id: Annotated[Id, Meta(description="ours")] = 245
    component_id: Annotated[Id, Meta(description="ours; 191 is an onboard computer")] = 191
    vehicle_id: Annotated[Id, Meta(description="the vehicle's system id")] | None = (
        None  # None: the first autopilot heard
    )
    handshake_s: (
        Annotated[float, Meta(ge=1.0, le=3600.0, description="the vehicle must be there within; waits without")] | None
    ) = None


class BaseMotion(Table, frozen=True, kw_only=True):
    """The motion task."""

    v_max_m_s: Annotated[float, Meta(ge=0.05, le=10.0)]
    a_max_m_s2: Annotated[float, Meta(ge=0.05, le=20.0)]
    w_max_rad_s: Annotated[float, Meta(ge=0.05, le=10.0)]
    alpha_max_rad_s2: Annotated[float, Meta(ge=0.1, le=100.0)]
    stiffness: Annotated[float, Meta(ge=0.1, le=100.0, description="k_p of a unit mass [1/s2]")]
    damping_ratio: Annotated[float, Meta(ge=0.3, le=5.0, description="k_v = 2 zeta sqrt(k_p)")]
    tolerance_m: Annotated[float, Meta(ge=0.01, le=10.0, description="arrived, unless a goal says otherwise")]
    tolerance_rad: Annotated[float, Meta(ge=0.02, le=0.5, description="the same of a goal's heading")] = 0.1


class BaseAvoid(Table, frozen=True, kw_only=True):
    """Repulsion, the room a way keeps, and what is believed of the range sensor."""

    influence_m: Annotated[float, Meta(ge=0.1, le=20.0, description="rho0, from the footprint")]
    clearance_m: Annotated[float, Meta(ge=0.05, le=10.0, description="rho_min: v_max is spent here; ways keep it")]
    stop_m: Annotated[float, Meta(ge=0.02, le=10.0, description="the governor brings the base to rest at this")]
    damping_ratio: Annotated[float, Meta(ge=0.05, le=5.0)]
    lookahead_s: Annotated[float, Meta(ge=0.0, le=5.0, description="closing speed widens the influence by this")] = 0.5
    scan: Annotated[Literal["required", "off"], Meta(description="required: no motion without a fresh scan")]
    range_m: Annotated[float, Meta(ge=0.5, le=30.0, description="returns further away are not believed")]
    seen_s: Annotated[float, Meta(ge=0.2, le=30.0, description="what was seen free counts as free for this long")] = 2.0


class Sensor(Table, frozen=True, kw_only=True):
    """A range sensor: a component of its own on the vehicle's link, most often not the autopilot."""

    name: Name
    message: Literal["OBSTACLE_DISTANCE", "DISTANCE_SENSOR"] = "OBSTACLE_DISTANCE"
    system: Annotated[Id, Meta(description="its system id; the vehicle's unless given")] | None = None
    component: Annotated[Id, Meta(description="any, while only one speaks, unless given")] | None = None
    yaw_rad: Annotated[
        float, Meta(ge=-3.2, le=3.2, description="of its front, counter-clockwise from the vehicle's")
    ] = 0.0
    offset_m: Annotated[tuple[Metre, Metre], Meta(description="ahead and to the left of the origin")] = (0.0, 0.0)
    frame: Annotated[
        Literal["as sent", "body", "north"], Meta(description="of its angles; senders leave `frame` wrong often")
    ] = "as sent"
    min_m: Annotated[float, Meta(ge=0.0, le=5.0, description="nearer it measures nothing")] = 0.0
    max_m: Annotated[float, Meta(ge=0.5, le=100.0, description="further it measures nothing")] = 100.0


class BaseEstimator(Table, frozen=True, kw_only=True):
    """Standard deviations."""

    acceleration_m_s2: Annotated[float, Meta(ge=0.01, le=50.0)] = 1.5
    position_m: Annotated[float, Meta(ge=0.001, le=5.0)] = 0.05
    velocity_m_s: Annotated[float, Meta(ge=0.001, le=5.0)] = 0.05


class BaseSafety(Table, frozen=True, kw_only=True):
    """Time-outs, bounds and what they lead to."""

    heartbeat_hold_s: Annotated[Seconds, Meta(description="the vehicle's heartbeat older than this: zero twist")] = 1.5
    heartbeat_stop_s: Annotated[Seconds, Meta(description="latched stop")] = 3.0
    stale_hold_ms: Annotated[float, Meta(ge=20.0, le=5000.0, description="position older than this: zero twist")]
    stale_stop_ms: Annotated[float, Meta(ge=50.0, le=10000.0, description="latched stop")]
    scan_stale_s: Annotated[float, Meta(ge=0.05, le=5.0, description="a scan older than this: zero twist")] = 0.5
    obstacle_stale_s: Annotated[float, Meta(ge=0.05, le=10.0)] = 0.5
    jump_m: Annotated[float, Meta(ge=0.05, le=20.0, description="beyond what speed explains: the estimate jumped")]
    engage_s: Annotated[float, Meta(ge=1.0, le=120.0, description="for mode and arming")] = 15.0
    stall_s: Annotated[float, Meta(ge=0.5, le=120.0, description="without progress: diagnosed after this")] = 5.0


class BaseConfig(Table, frozen=True, kw_only=True):
    """One mobile base, one file."""

    robot: BaseRobot
    base: BaseTable
    loop: BaseLoop
    link: BaseLink
    motion: BaseMotion
    avoid: BaseAvoid
    safety: BaseSafety
    log: LogTable
    estimator: BaseEstimator = BaseEstimator()
    console: ConsoleTable = ConsoleTable()
    obstacle: Annotated[tuple[Obstacle, ...], Meta(max_length=64)] = ()
    sensor: Annotated[tuple[Sensor, ...], Meta(max_length=4, description="any one scan and any beams if none")] = ()


def is_base(path: str | Path) -> bool:
    """Return whether a file says that it describes a base. Raises ConfigError for one that is no TOML."""
    robot = parse(Path(path)).get("robot")
    return isinstance(robot, dict) and robot.get("kind") == "base"


def load(path: str | Path) -> BaseConfig:
    """Return the checked config of a base's TOML file. Raises ConfigError as the arm's `load`."""
    config: BaseConfig = read(Path(path), BaseConfig)
    for group in (_shape, _link, _rates, _distances):
        for found in group(config):
            raise ConfigError(name_place(str(path), found.path), found.got, found.wanted)
    refuse_obstacles(config.obstacle, str(path))
    refuse_rooms(config.obstacle, rooms.NONE, str(path))
    for i, o in enumerate(config.obstacle):
        if o.waypoints or any((*o.velocity_m_s, *o.omega_rad_s)) or o.appears_s > 0.0 or o.vanishes_s < 1e6:
            place = name_place(str(path), f"obstacle[{i}].name")
            raise ConfigError(place, f"{o.name}, which moves", "one at rest; moving obstacles belong in a scenario")
    return config


def hull(c: BaseConfig) -> float:
    """Return the radius [m] of the circle about the origin that holds the footprint: what a turn on the spot sweeps."""
    if c.base.radius_m is not None:
        return c.base.radius_m
    return max(math.hypot(*corner) for corner in c.base.footprint_m or ())


def braking_distance(c: BaseConfig) -> float:
    """Return the way [m] from v_max to rest: lag first, then the brakes."""
    return c.motion.v_max_m_s * c.base.lag_s + c.motion.v_max_m_s**2 / (2.0 * c.base.brake_m_s2)


def _shape(c: BaseConfig) -> Iterator[Found]:
    b = c.base
    if (b.footprint_m is None) == (b.radius_m is None):
        yield Found("base.footprint_m", "both or neither of footprint_m and radius_m", "one of them")
    if b.footprint_m is not None and not _around_origin(b.footprint_m):
        yield Found("base.footprint_m", list(map(list, b.footprint_m)), "corners in one turn around the origin")
    if b.wheels == "ackermann" and b.turn_radius_m < 0.05:
        yield Found("base.turn_radius_m", b.turn_radius_m, "at least 0.05: a car does not turn on the spot")
    if b.wheels != "ackermann" and b.turn_radius_m > 0.0:
        yield Found("base.turn_radius_m", b.turn_radius_m, f"0: {b.wheels} wheels turn on the spot")
    if b.wheels == "holonomic" and c.link.autopilot == "ardupilot":
        # GUIDED takes hypot(vx, vy) as forward speed: a sideways command would drive ahead
        yield Found("base.wheels", b.wheels, "skid or ackermann: ArduPilot's GUIDED takes no sideways speed")


def streams(c: BaseConfig) -> Streams | None:
    """Return what a serial line bears of the conversation, None where there is none."""
    baud = baud_of(c.link.url)
    if baud is None:
        return None
    quick, slow = QUICK_STREAMS[c.link.autopilot], dict(SLOW_STREAMS[c.link.autopilot])
    if c.avoid.scan == "required":
        kinds = [sensor.message for sensor in c.sensor] or ["OBSTACLE_DISTANCE"]
        slow |= {kind: SCANS * kinds.count(kind) for kind in kinds}
    return fitted(baud, c.loop.servo_hz, slow, quick, c.link.signing == "required")


def _around_origin(corners: tuple[tuple[float, float], ...]) -> bool:
    """Return whether a polygon goes once around the origin, seen from where its angle rises all along."""
    angles = [math.atan2(y, x) for x, y in corners]
    turns = [
        (b - a + math.pi) % (2.0 * math.pi) - math.pi for a, b in zip(angles, angles[1:] + angles[:1], strict=True)
    ]
    if all(t < 0.0 for t in turns):
        turns = [-t for t in turns]
    return all(t > 0.0 for t in turns) and abs(sum(turns) - 2.0 * math.pi) < 1e-6


def _link(c: BaseConfig) -> Iterator[Found]:
    link = c.link
    scheme, _, rest = link.url.partition(":")
    if scheme not in SCHEMES or not rest:
        wanted = " or ".join(f"{k}:{v}" for k, v in SCHEMES.items())
        yield Found("link.url", link.url, wanted)
    elif scheme != "serial" and not _host_port(rest):
        yield Found("link.url", link.url, f"{scheme}:{SCHEMES[scheme]}, port 1 to 65535")
    elif scheme == "serial" and baud_of(link.url) is None:
        yield Found("link.url", link.url, f"serial:{SCHEMES[scheme]}")
    elif (line := streams(c)) is not None and not line.fits:
        why = f"a faster line: {line.received:.0%} of this one is received and {line.sent:.0%} sent, {MOST:.0%} at most"
        yield Found("link.url", link.url, why)
    if link.signing == "required" and link.key_file is None:
        yield Found("link.key_file", "nothing", 'the file of the key, or signing = "off"')
    if link.signing == "off" and link.key_file is not None:
        yield Found("link.signing", "off", "required: a key_file is given")
    if link.signing == "required" and link.state_file is None:
        yield Found("link.state_file", "nothing", "a file that keeps timestamps: without it a restart takes replays")
    if link.vehicle_id is not None and (link.vehicle_id, 1) == (link.system_id, link.component_id):
        yield Found("link.component_id", link.component_id, "one that the vehicle's autopilot does not have")


def _host_port(text: str) -> bool:
    try:
        parts = urlsplit(f"//{text}")
        return bool(parts.hostname) and parts.port is not None and parts.port > 0
    except ValueError:
        return False


def _rates(c: BaseConfig) -> Iterator[Found]:
    s, period = c.safety, 1000.0 / c.loop.servo_hz
    if c.loop.plan_hz > c.loop.servo_hz:
        yield Found("loop.plan_hz", c.loop.plan_hz, f"at most servo_hz = {c.loop.servo_hz:g}")
    if s.heartbeat_hold_s >= s.heartbeat_stop_s:
        yield Found(
            "safety.heartbeat_hold_s", s.heartbeat_hold_s, f"less than heartbeat_stop_s = {s.heartbeat_stop_s:g}"
        )
    if s.heartbeat_hold_s < 1.0:
        yield Found("safety.heartbeat_hold_s", s.heartbeat_hold_s, "at least 1: heartbeats come once a second")
    if s.stale_hold_ms < 2.0 * period:
        yield Found("safety.stale_hold_ms", s.stale_hold_ms, f"at least 2 servo periods = {2.0 * period:g} ms")
    if s.stale_hold_ms >= s.stale_stop_ms:
        yield Found("safety.stale_hold_ms", s.stale_hold_ms, f"less than stale_stop_ms = {s.stale_stop_ms:g}")


def _distances(c: BaseConfig) -> Iterator[Found]:
    a, dt = c.avoid, 1.0 / c.loop.servo_hz
    if a.clearance_m >= a.influence_m:
        yield Found("avoid.clearance_m", a.clearance_m, f"less than influence_m = {a.influence_m:g}")
        return
    room = hull(c) + a.clearance_m + math.sqrt(0.5) * CELL
    if room > (STENCIL - 1) * CELL:
        why = f"with the footprint's {hull(c):.3g} at most {(STENCIL - 1) * CELL - math.sqrt(0.5) * CELL:.3g}"
        yield Found("avoid.clearance_m", a.clearance_m, why)
    if a.stop_m >= a.clearance_m:
        # a way runs at clearance_m: a governor that stops there would never let it pass
        yield Found("avoid.stop_m", a.stop_m, f"less than clearance_m = {a.clearance_m:g}")
    rho_num = rho_num_of(eta_of(c.motion.v_max_m_s, a.influence_m, a.clearance_m), dt)
    if rho_num >= a.clearance_m:
        why = f"more than rho_num = {rho_num:.3g} of this speed and servo_hz = {c.loop.servo_hz:g}"
        yield Found("avoid.clearance_m", a.clearance_m, why)
    need = hull(c) + a.stop_m + braking_distance(c) + c.motion.v_max_m_s * c.safety.scan_stale_s
    if a.scan == "required" and need > a.range_m:
        why = f"at least {need:.3g}: hull, stop_m, the way to rest from v_max, and a scan as old as scan_stale_s"
        yield Found("avoid.range_m", a.range_m, why)


def read_key(path: str | Path, place: str) -> bytes:
    """Return the signing key of a file that nobody else may read. Raises ConfigError."""
    try:
        mode = os.stat(path).st_mode
        data = Path(path).read_bytes()
    except OSError as error:
        raise ConfigError(place, f"{path}: {error.strerror}", "a readable key file") from None
    if stat.S_IMODE(mode) & 0o177:
        raise ConfigError(place, f"{path}: mode {stat.S_IMODE(mode):04o}", "mode 0600: a key is for its owner alone")
    if len(data) != KEY:
        text = data.strip()
        try:
            data = bytes.fromhex(text.decode("ascii"))
        except ValueError:
            data = b""
    if len(data) != KEY:
        raise ConfigError(place, f"{path}: no key", f"{KEY} bytes, or {2 * KEY} hexadecimal digits")
    return data

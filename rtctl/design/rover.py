"""A checked base config into the derived `Base`, and what `rtctl check` tells of it."""

import math
from pathlib import Path

import numpy as np

from rtctl.arm.robot import SLOTS
from rtctl.control.firas import field_params
from rtctl.design.assets import load_assets, placed
from rtctl.design.report import Report, Row
from rtctl.errors import ConfigError
from rtctl.protocol.mavlink_budget import MOST
from rtctl.rover.occupancy import CELL
from rtctl.rover.robot import Base, Limits, Margins, Noise, SafetyParams, Wheels
from rtctl.spec.base import BaseConfig, braking_distance, hull, read_key, streams
from rtctl.spec.obstacles import shape_of
from rtctl.spec.read import name_place
from rtctl.types import F64
from rtctl.world.primitives import distance

WHEELS = {"holonomic": Wheels.HOLONOMIC, "skid": Wheels.SKID, "ackermann": Wheels.ACKERMANN}
EDGE = 0.1  # [m] between PSPs along the outline
SKIN = 0.02  # [m] radius of a PSP on a polygon


def build(c: BaseConfig, path: str | Path) -> Base:
    """Return the base of a checked config; `path` is its file. Raises ConfigError."""
    dt = 1.0 / c.loop.servo_hz
    points, radius = _points(c)
    assets = load_assets((), c.obstacle, Path(path))
    shapes = [shape_of(o) for o in c.obstacle]
    obstacles = tuple(placed(s, assets.clouds[s.name]) if s.name in assets.clouds else s for s in shapes)
    b, m, a, s = c.base, c.motion, c.avoid, c.safety
    base = Base(
        name=c.robot.name,
        wheels=WHEELS[b.wheels],
        world_velocity=c.link.autopilot == "px4",
        slots=SLOTS,
        dt=dt,
        plan_dt=1.0 / c.loop.plan_hz,
        k_p=m.stiffness,
        k_v=2.0 * m.damping_ratio * math.sqrt(m.stiffness),
        ahead=b.control_point_m,
        limits=Limits(m.v_max_m_s, m.a_max_m_s2, m.w_max_rad_s, m.alpha_max_rad_s2, b.turn_radius_m, b.reverse),
        # a cell's centre may lie half its diagonal from what it stands for
        margins=Margins(
            hull(c),
            hull(c) + a.clearance_m + math.sqrt(0.5) * CELL,
            a.clearance_m + math.sqrt(0.5) * CELL,
            a.stop_m,
            b.brake_m_s2,
            b.lag_s,
            b.turn_lag_s,
            b.height_m,
        ),
        points=points,
        point_radius=radius,
        cover=_cover(c),
        field=field_params(m.v_max_m_s, a.influence_m, a.clearance_m, dt, a.damping_ratio, a.lookahead_s, 1.0),
        noise=Noise(c.estimator.acceleration_m_s2, c.estimator.position_m, c.estimator.velocity_m_s),
        safety=SafetyParams(
            s.heartbeat_hold_s,
            s.heartbeat_stop_s,
            1e-3 * s.stale_hold_ms,
            1e-3 * s.stale_stop_ms,
            s.scan_stale_s,
            a.scan == "required",
            s.obstacle_stale_s,
            s.jump_m,
            a.seen_s,
        ),
        obstacles=obstacles,
        meshes=assets.meshes,
        reach=b.reach_m,
        tolerance=m.tolerance_m,
        tolerance_rot=m.tolerance_rad,
        stall=s.stall_s,
        engage=s.engage_s,
        sense=a.range_m,
        sensors=tuple(sensor.name for sensor in c.sensor) or ("scan", "beams"),
    )
    at = np.column_stack([points, np.full(len(points), b.height_m)])
    for i, shape in enumerate(base.obstacles):
        rho = distance(shape, at, assets.meshes)[0] - radius
        if rho.min() <= 0.0:
            place = name_place(str(path), f"obstacle[{i}].position_m")
            raise ConfigError(
                place, f"{shape.name} {-rho.min():.3g} m inside the footprint at the origin", "clear of it"
            )
    return base


def key_of(c: BaseConfig, path: str | Path) -> bytes | None:
    """Return the signing key, None when signing is off. Raises ConfigError for a file that others may read."""
    if c.link.key_file is None:
        return None
    where = Path(c.link.key_file)
    return read_key(where if where.is_absolute() else Path(path).parent / where, name_place(str(path), "link.key_file"))


def _points(c: BaseConfig) -> tuple[F64, F64]:
    """Return PSPs (m, 2) [m] and radii (m,) [m]: a disc as itself, a polygon as points along its edges."""
    if c.base.radius_m is not None:
        return np.zeros((1, 2)), np.array([c.base.radius_m])
    corners = np.array(c.base.footprint_m)
    found = []
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        n = max(1, math.ceil(float(np.hypot(*(b - a))) / EDGE))
        found += [a + (b - a) * k / n for k in range(n)]
    return np.array(found), np.full(len(found), SKIN)


def _straight_gap(base: Base) -> list[Row]:
    """Return what an outline steered as it is passes straight on, a row; none for others."""
    if not len(base.cover):
        return []
    wide = float(np.ptp(base.points[:, 1]))
    gap = wide + 2.0 * base.margins.aside + 3.0 * CELL  # returns and outline lie in cells, and headings are HEADINGS
    return [_row("gap straight on", gap, "m", "that the outline passes on a leg")]


def _cover(c: BaseConfig) -> F64:
    """Return points (n, 2) [m] no more than a cell apart along a polygon's edges and within it.

    None of what is steered as a circle: a disc, what cannot turn on the spot, what PX4 turns as it thinks best.
    """
    if c.base.footprint_m is None or c.base.wheels != "skid" or c.link.autopilot == "px4":
        return np.zeros((0, 2))
    corners = np.array(c.base.footprint_m)
    rings = max(1, math.ceil(hull(c) / CELL))
    found = [np.zeros(2)]
    for scale in np.arange(1, rings + 1) / rings:  # the polygon goes once around the origin, and so do these
        for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            n = max(1, math.ceil(scale * float(np.hypot(*(b - a))) / CELL))
            found += [scale * (a + (b - a) * k / n) for k in range(n)]
    return np.array(found)


def report(c: BaseConfig, base: Base) -> Report:
    """Return the figures of a base that `load` and `build` let through."""
    f, m = base.field, base.margins
    stop = braking_distance(c)
    rows = [
        _row(
            "servo period",
            1e3 * base.dt,
            "ms",
            f"{c.loop.servo_hz:g} Hz, set-points at the same rate",
            c.loop.realtime == "required",
        ),
        _row(
            "signing",
            int(c.link.signing == "required"),
            "",
            "MAVLink 2, both ways"
            if c.link.signing == "required"
            else "off: whoever reaches the link can drive the vehicle",
            c.link.signing == "required",
        ),
        _row("hull", m.hull, "m", "circle that the footprint turns in"),
        _row("points (PSPs)", len(base.point_radius), "", "on the footprint"),
        _row("k_p", base.k_p, "1/s2", "stiffness of the unit mass"),
        _row("k_v", base.k_v, "1/s", "damping of the unit mass"),
        _row("eta", f.eta, "m4/s2", f"spends {base.limits.v_max:g} m/s between {f.rho0:g} and {f.rho_min:g} m"),
        _row("rho_num", f.rho_num, "m", f"(3 eta dt^2)^(1/4); at most the clearance {f.rho_min:g}"),
        _row("way to rest", stop, "m", f"{m.lag:g} s of lag and {m.brake:g} m/s2 from {base.limits.v_max:g} m/s"),
        _row("room of a way", m.room, "m", "free distance of its cells' centres: hull, clearance, half a cell"),
        _row("gap that is passed", 2.0 * m.room + CELL, "m", "narrower ones may count as walls"),
        *_straight_gap(base),
        _row("range", base.sense, "m", "of the scan that is believed"),
        _row("reverse", int(base.limits.reverse), "", _ways(base), base.limits.reverse or base.limits.radius == 0.0),
        _row(
            "scan",
            int(base.safety.scan),
            "",
            "required" if base.safety.scan else "off: only what is told is avoided",
            base.safety.scan,
        ),
        _row("reach", base.reach, "m", "no goal further from the origin is taken"),
    ]
    if (line := streams(c)) is not None:
        note = f"received, position and attitude at {line.quick:g} Hz; {MOST:.0%} at most"
        rows.append(_row("line", line.received, "", note))
        rows.append(_row("line", line.sent, "", f"sent, set-points at {c.loop.servo_hz / line.every:g} Hz"))
    return Report(base.name, tuple(rows))


def _ways(base: Base) -> str:
    if base.limits.reverse:
        return "it may drive backwards"
    if base.limits.radius > 0.0:
        return "off: a car that cannot turn on the spot stays before an obstacle it faces closely"
    return "off: it turns on the spot"


def _row(name: str, value: float, unit: str, note: str, fine: bool = True) -> Row:
    return Row(name, float(value), unit, "ok" if fine else "warn", note)

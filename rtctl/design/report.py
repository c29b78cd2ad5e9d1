"""What `rtctl check` tells of a robot: figures derived from its config, each with a verdict."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from rtctl.arm.robot import Robot
from rtctl.control.firas import FieldParams
from rtctl.design.description import dynamics, notes
from rtctl.design.extremes import Extremes, extremes
from rtctl.plain import Json
from rtctl.spec import rules
from rtctl.spec.bus import LOAD_MAX
from rtctl.spec.robot import Config
from rtctl.types import F64

OK, WARN = "ok", "warn"
SLOW = 0.3  # [rad/s] at which a joint without brake may sink
SAG = 0.2  # [rad] of a joint that only its drive's kp holds, beyond which that is worth a warning
WAY_ROOM = 1.2  # of the clearance, that a planned way keeps at least


class Row(NamedTuple):
    """One figure."""

    name: str
    value: float
    unit: str
    verdict: str  # ok | warn
    note: str


class Report(NamedTuple):
    """All figures of one robot."""

    robot: str
    rows: tuple[Row, ...]

    @property
    def warnings(self) -> int:
        """Number of rows with a warning."""
        return sum(row.verdict == WARN for row in self.rows)

    def as_dict(self) -> Json:
        """Return the report for --json."""
        return {"robot": self.robot, "warnings": self.warnings, "rows": [row._asdict() for row in self.rows]}

    def render(self) -> str:
        """Return the report as a plain table."""
        cells = [(r.name, f"{r.value:.4g}", r.unit, r.verdict, r.note) for r in self.rows]
        widths = [max(len(row[k]) for row in cells) for k in range(4)]
        lines = [
            f"{name:<{widths[0]}}  {value:>{widths[1]}} {unit:<{widths[2]}}  {verdict:<{widths[3]}}  {note}".rstrip()
            for name, value, unit, verdict, note in cells
        ]
        tail = f"{self.warnings} warning{'s' if self.warnings != 1 else ''}" if self.warnings else "no warnings"
        return "\n".join([f"robot {self.robot}", "", *lines, "", tail])


def report(config: Config, robot: Robot) -> Report:
    """Return the figures of a config that `load` and `build` let through; what they refuse never gets here."""
    found = extremes(config, robot.body)
    rows = [*_bus(config), *_loop(config, robot), *_motion(config, robot)]
    rows += _field("obstacle", robot.avoid, robot) + _field("self", robot.self_avoid, robot)
    rows += [*_limits(robot, found), *_torque(robot, found), *_unbraked(config, robot, found), *_points(config, robot)]
    rows += [*_resolution(robot), *_description(robot)]
    return Report(robot.name, tuple(rows))


def _row(name: str, value: float, unit: str, note: str, fine: bool = True) -> Row:
    return Row(name, float(value), unit, OK if fine else WARN, note)


def _gap(r: Robot) -> float:
    """Return by how much [m] a gap must be wider than a link: on either side the overhang, and what a way keeps."""
    return 2.0 * (r.coverage.overhang + WAY_ROOM * r.avoid.rho_min)


def _bus(c: Config) -> list[Row]:
    load = rules.bus_load(c)
    n, kind = len(c.robot.joints), "CAN FD with bit-rate switch" if c.link.fd else "classic CAN"
    safe = c.link.protocol == "mit+e2e"
    return [
        _row("frame time", 1e6 * load.command, "us", f"{kind}, {c.link.protocol}, worst-case stuffing"),
        _row("bus time per cycle", 1e6 * load.cycle, "us", f"{n} commands and {n} replies"),
        _row(
            "bus load",
            100 * load.ratio,
            "%",
            f"at most {100 * LOAD_MAX:.0f}; servo up to {LOAD_MAX / load.cycle:.0f} Hz",
        ),
        _row("wire protection", int(safe), "", "counter and CRC on every frame" if safe else "the CAN CRC alone", safe),
    ]


def _loop(c: Config, r: Robot) -> list[Row]:
    ratio = r.model_dt / r.dt
    return [
        _row(
            "servo period",
            1e3 * r.dt,
            "ms",
            f"{c.loop.servo_hz:g} Hz, real time {c.loop.realtime}",
            c.loop.realtime == "required",
        ),
        _row("model period", 1e3 * r.model_dt, "ms", f"{c.loop.model_hz:g} Hz, every {ratio:g} servo periods"),
        _row("drive watchdog", c.safety.watchdog_ms, "ms", f"{c.safety.watchdog_ms / (1e3 * r.dt):.1f} servo periods"),
        _row("stale: hold", r.safety.stale_periods, "periods", f"{c.safety.stale_hold_ms:g} ms"),
        _row("stale: stop", r.safety.lost_periods, "periods", f"{c.safety.stale_stop_ms:g} ms"),
    ]


def _motion(c: Config, r: Robot) -> list[Row]:
    m = r.motion
    ramp, braking = m.v_max * m.k_v / m.k_p, rules.braking_distance(c)
    layer = r.avoid.rho0 - r.avoid.rho_min
    return [
        _row("k_p", m.k_p, "1/s2", "stiffness of the unit mass"),
        _row("k_v", m.k_v, "1/s", "damping of the unit mass"),
        _row(
            "deceleration ramp",
            ramp,
            "m",
            f"V_max k_v/k_p before the goal; influence {r.avoid.rho0:g}",
            ramp <= r.avoid.rho0,
        ),
        _row("braking distance", braking, "m", f"V_max^2/(2 a_max); at most influence - clearance = {layer:.3g}"),
        _row("reach", r.reach, "m", "no goal further from the base is taken"),
    ]


def _field(name: str, f: FieldParams, r: Robot) -> list[Row]:
    peak = f.eta * (1.0 / f.rho_min - 1.0 / f.rho0) / f.rho_min**2
    cap = f.eta * (1.0 / f.rho_num - 1.0 / f.rho0) / f.rho_num**2
    return [
        _row(f"{name} eta", f.eta, "m4/s2", f"spends {r.motion.v_max:g} m/s between {f.rho0:g} and {f.rho_min:g} m"),
        _row(f"{name} rho_num", f.rho_num, "m", f"(3 eta dt^2)^(1/4); at most the clearance {f.rho_min:g}"),
        _row(f"{name} push at clearance", peak, "m/s2", f"capped at {cap:.4g}"),
        _row(f"{name} damping k_d", f.k_d, "1/s", "one-sided, while closing"),
    ]


def _limits(r: Robot, found: Extremes) -> list[Row]:
    """Joint-limit zones: can the torque left by gravity spend the zone's speed within the zone?"""
    f = r.limit
    braking = found.inertia * _zone_speed(r) ** 2 / (2.0 * (f.rho0 - f.rho_min))
    spare = (r.tau_max - found.gravity) / np.maximum(braking, 1e-12)
    i, k = int(spare.argmin()), int((f.rho_num / f.rho_min).argmax())
    note = f"torque gravity leaves over torque to brake, worst: {r.joints[i]}"
    if spare[i] < 1.0:
        note += "; limits and obstacles may be passed there: a lower qd_max_rad_s, or a stronger drive"
    return [
        _row("joint rho_num", f.rho_num[k], "rad", f"worst: {r.joints[k]}; at most the clearance {f.rho_min[k]:g}"),
        _row(
            "joint-limit braking",
            spare[i],
            "x",
            note,
            bool(spare[i] >= 1.0),
        ),
    ]


def _zone_speed(r: Robot) -> F64:
    f = r.limit
    return np.sqrt(f.eta) * (1.0 / f.rho_min - 1.0 / f.rho0)


def _torque(r: Robot, found: Extremes) -> list[Row]:
    rows = []
    for i, joint in enumerate(r.joints):
        ratio = found.gravity[i] / r.tau_max[i]
        note = f"{found.gravity[i]:.3g} of {r.tau_max[i]:.4g} Nm, at home {found.gravity_home[i]:.3g}"
        rows.append(_row(f"gravity at {joint}", 100 * ratio, "%", note, bool(ratio < 0.9)))
    for i, joint in enumerate(r.joints if found.tool.any() else ()):
        note = f"at most {found.tool[i]:.3g} of the {found.gravity[i]:.3g} Nm above"
        rows.append(_row(f"of it the tool at {joint}", 100 * found.tool[i] / r.tau_max[i], "%", note))
    if r.payload_max > 0.0:
        ratio = found.payload / r.tau_max
        i = int(ratio.argmax())
        note = f"{found.payload[i]:.3g} of {r.tau_max[i]:.4g} Nm at {r.joints[i]}, {r.payload_max:g} kg at the tip"
        rows.append(_row("gravity with payload_max_kg", 100 * ratio[i], "%", note, bool(ratio[i] < 1.0)))
    return rows


def _unbraked(c: Config, r: Robot, found: Extremes) -> list[Row]:
    """What the drives' own loops can do for joints without a brake when the controller stops."""
    rows = []
    for i, (joint, brake) in enumerate(zip(r.joints, rules.brakes(c), strict=True)):
        if brake:
            continue
        g, kp, kd = found.gravity[i], r.stop.kp[i], r.stop.kd[i]
        rows.append(
            _row(f"held at {joint}", g / kp, "rad", f"no brake; kp {kp:.3g} Nm/rad, {g:.3g} Nm", bool(g / kp < SAG))
        )
        note = f"sinks by kd {kd:.2g} alone; that carries {SLOW * kd:.2g} Nm at {SLOW:g} rad/s"
        rows.append(_row(f"damped at {joint}", g / kd, "rad/s", note))
    if rows:
        parked = c.robot.park_rad is not None
        note = "robot.park_rad: disarm there" if parked else "no robot.park_rad: disarm with --drop alone"
        rows.append(_row("place to park", int(parked), "", note, parked))
    return rows


def _resolution(r: Robot) -> list[Row]:
    """Is one step of a drive's torque lost in what the estimator takes for noise of the acceleration?"""
    inertia = r.stop.damping / r.stop.decay  # A_ii at home
    step = r.tau_lsb / np.sqrt(12.0) / inertia / r.joint_filter.sigma_qdd
    i = int(step.argmax())
    note = f"{r.tau_lsb[i]:.2g} Nm over the estimator's noise, worst: {r.joints[i]}"
    return [_row("torque resolution", step[i], "x", note, bool(step[i] <= 1.0))]


def _description(r: Robot) -> list[Row]:
    """What the URDF says that no body has, or that is not used."""
    rows = [_row(f"inertia of {note.about}", 0, "", note.text, False) for note in notes(Path(r.urdf), r.joints)]
    if found := dynamics(Path(r.urdf), r.joints):
        damping, friction = (max(values[k] for values in found.values()) for k in (0, 1))
        note = f"damping, and {friction:g} Nm of friction: not used, the file's friction is"
        rows.append(_row("URDF dynamics", damping, "Nms/rad", note))
    return rows


def _points(c: Config, r: Robot) -> list[Row]:
    cover, auto = r.coverage, isinstance(c.avoid.points, str)
    fine = cover.fraction >= 0.999 or cover.protrusion < r.avoid.rho_min
    return [
        _row("points (PSPs)", len(r.points.radius), "", "placed from the collision geometry" if auto else "as given"),
        _row("points cover", 100 * cover.fraction, "%", "of the links' surface samples", fine),
        _row("protrusion", cover.protrusion, "m", f"of a link beyond its points; clearance {r.avoid.rho_min:g}", fine),
        _row("overhang", cover.overhang, "m", "of the points beyond the links"),
        _row("gap", _gap(r), "m", "wider than a link: a planned way surely passes (overhang_m)"),
        _self_collision(c, r),
    ]


def _self_collision(c: Config, r: Robot) -> Row:
    """How many pairs of links are watched, and whether some are so near at home that they push each other there."""
    apart = r.body.own_distances(r.home, r.own)
    k = int(apart.argmin()) if len(apart) else -1
    note, fine = "watched" if c.avoid.self_collision else "switched off", c.avoid.self_collision
    if k >= 0 and apart[k] < r.self_avoid.rho0:
        far, near = r.own.names[k]
        note += f"; {far} and {near} are {apart[k]:.3g} m apart at home: they push each other there"
        fine = False
    return _row("self-collision pairs", len(r.own.pairs), "", note, fine)

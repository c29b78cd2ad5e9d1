"""The files that `rtctl init` writes, as people are to read and change them."""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from rtctl.intake.body import Joint
from rtctl.intake.drives import Drive
from rtctl.spec.bus import LOAD_MAX, cycle_load
from rtctl.types import F64

RATES = (1000, 500, 250)  # [Hz]
PAYLOAD = 12  # bytes of a protected frame
BITRATE, DATA_BITRATE = 1_000_000, 5_000_000
LEG = 4.0  # [s] to reach a goal


class Settings(NamedTuple):
    """The numbers of a config."""

    name: str
    urdf: str
    tip: str
    joints: Sequence[Joint]
    drives: Sequence[Drive]
    home: F64
    v_max: float  # [m/s]
    a_max: float  # [m/s2]
    influence: float  # [m]
    clearance: float  # [m]
    zone: float  # [rad]
    floor: float  # [m]
    light: bool  # joints that gather speed quickly


def rate(joints: int) -> int:
    """Return the servo rate [Hz] that the bus has room for."""
    fits = [hz for hz in RATES if cycle_load(joints, PAYLOAD, BITRATE, DATA_BITRATE, 1.0 / hz).ratio <= LOAD_MAX]
    return fits[0] if fits else RATES[-1]


def config(s: Settings, origin: str, told: Sequence[str], locked: Mapping[str, float]) -> str:
    """Return the text of the robot's file."""
    hz = rate(len(s.joints))
    period = 1000.0 / hz  # [ms]
    lines = [
        f"# {s.name}, made by rtctl init of {origin}. rtctl check {s.name}.toml prints what follows from it;",
        f"# rtctl sim {s.name}_first.toml plays two goals. Go through the lines marked CHECK before real torque.",
        *(f"#   {line}" for line in told),
    ]
    if locked:
        stated = ", ".join(f"{name} = {value:g}" for name, value in list(locked.items())[:12])
        lines.append(f"# Locked into the links of {s.urdf}: {stated}{' …' if len(locked) > 12 else ''}")
    lines += [
        "",
        "[robot]",
        f'name = "{s.name}"',
        'kind = "arm"',
        f'urdf = "{s.urdf}"                     # relative to this file; its collision geometry is convex pieces',
        f'tip_frame = "{s.tip}"',
        f"home_rad = [{', '.join(f'{q:g}' for q in s.home)}]   # CHECK: clear of limits, of itself, of the table",
        "payload_max_kg = 0.0                # carried without being told",
        "# CHECK: ids as your drives have them; armature = J G^2 of rotor and gear; torque and speed of the joint",
        "joints = [",
        *(_joint(k, j, d) for k, (j, d) in enumerate(zip(s.joints, s.drives, strict=True), 1)),
        "]",
        "",
    ]
    for name, table in {d.name: d.table for d in s.drives if d.table is not None}.items():
        lines += [f"[drives.{name}]                     # a virtual drive: scales of its fields on the wire"]
        lines += [f"{key} = {v:g}" for key, v in zip(("p_max_rad", "v_max_rad_s", "t_max_Nm"), table, strict=True)]
        lines.append("")
    lines += [
        "[loop]",
        f"servo_hz = {hz}                    # what the bus below has room for",
        f"model_hz = {hz // 4}",
        'realtime = "best-effort"            # simulations run anywhere; a real arm wants "required"',
        "",
        "[link]",
        'type = "can"',
        'interface = "socketpair"            # virtual drives; a real arm: "socketcan"',
        f'channel = "{s.name}"                # a real arm: "can0"',
        f"bitrate = {BITRATE}",
        "fd = true",
        f"data_bitrate = {DATA_BITRATE}",
        'protocol = "mit+e2e"                # drives without end-to-end protection: "mit"',
        "",
        "[motion]                            # CHECK: begin slower on a real arm",
        f"v_max_m_s = {s.v_max:g}",
        f"a_max_m_s2 = {s.a_max:g}",
        "w_max_rad_s = 1.5",
        "stiffness = 200.0",
        "damping_ratio = 1.0",
        "",
        "[avoid]",
        f"influence_m = {s.influence:g}                   # repulsion begins at this distance",
        f"clearance_m = {s.clearance:g}                  # nothing comes nearer",
        "damping_ratio = 1.0",
        'points = "auto"                     # spheres that cover the collision geometry',
        "self_collision = true",
        *([f"joint_influence_rad = {s.zone:g}", f"joint_clearance_rad = {0.15 * s.zone:.3g}"] if s.zone < 0.2 else []),
        "",
    ]
    if s.light:
        lines += [
            "[estimator]                         # joints this light gather speed beyond what is taken for noise",
            "joint_acceleration_rad_s2 = 60.0",
            "acceleration_rad_s2 = 60.0",
            "",
        ]
    lines += [
        "[safety]",
        f"watchdog_ms = {20.0 * period:g}                  # a drive that hears nothing for this long stops by itself",
        f"stale_hold_ms = {3.0 * period:g}",
        f"stale_stop_ms = {10.0 * period:g}",
        "",
        "[log]",
        'directory = "logs"',
        "segment_MB = 256.0",
        "segment_s = 600.0",
        "disk_floor_MB = 200.0",
        "",
        "[[obstacle]]                        # CHECK: what the arm stands on",
        'name = "table"',
        'type = "plane"',
        f"position_m = [0.0, 0.0, {s.floor:g}]",
        "",
    ]
    return "\n".join(lines)


def _joint(k: int, j: Joint, d: Drive) -> str:
    low, high = _inside(j.low, 1), _inside(j.high, -1)
    torque, slew = _down(j.effort), max(1000.0, 10.0 * j.effort)
    return (
        f'    {{ name = "{j.name}", can_id = {k}, q_min_rad = {low:g}, q_max_rad = {high:g}, '
        f"qd_max_rad_s = {_down(j.speed):g}, tau_max_Nm = {torque:g}, tau_rate_Nm_s = {slew:g}, "
        f'armature_kg_m2 = {d.armature:g}, drive = "{d.name}" }},'
    )


def _inside(limit: float, towards: int) -> float:
    """Return a limit [rad] of four digits, rounded towards the inside."""
    rounded = round(limit, 4)
    return rounded if (rounded - limit) * towards >= 0.0 else round(limit + towards * 1e-4, 4)


def _down(limit: float) -> float:
    """Return a limit of a few digits, not above it."""
    step = 10.0 ** (math.floor(math.log10(limit)) - 3)
    return float(f"{math.floor(limit / step + 1e-9) * step:.4g}")


def scenario(s: Settings, goals: Sequence[F64], ball: F64 | None, radius: float) -> str:
    """Return the text of a first scenario."""
    lines = [
        f"# {s.name}: two goals" + (", a ball beside the way between them." if ball is not None else "."),
        "",
        f'robot = "{s.name}.toml"',
        f"duration_s = {0.5 + LEG * len(goals):g}",
    ]
    for k, goal in enumerate(goals):
        lines += ["", "[[goal]]", f"at_s = {0.5 + LEG * k:g}", f"position_m = [{', '.join(f'{c:g}' for c in goal)}]"]
    if ball is not None:
        lines += ["", "[[obstacle]]", 'name = "ball"', 'type = "sphere"', f"radius_m = {radius:g}"]
        lines.append(f"position_m = [{', '.join(f'{c:g}' for c in ball)}]")
    return "\n".join([*lines, ""])

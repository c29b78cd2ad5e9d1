"""What the simulator takes from the robot file, read with tomllib alone.

The file is checked by `rtctl check`; here a missing or wrong key is simply a SettingsError that names it.
"""

import math
import os
import site
import sys
import tomllib
from pathlib import Path
from typing import Any, NamedTuple

from firmware_sim import codec
from firmware_sim.drive import Rating
from firmware_sim.gripper import GripperSetting, gripper_settings

# published full scales; [drives.NAME] in the file adds to them or overrides
SCALES = {
    "DM4310": codec.Scale(12.5, 30.0, 10.0),
    "DM4310_48V": codec.Scale(12.5, 50.0, 10.0),
    "DM4340": codec.Scale(12.5, 8.0, 28.0),
    "DM4340_48V": codec.Scale(12.5, 10.0, 28.0),
    "DM6006": codec.Scale(12.5, 45.0, 20.0),
    "DM8006": codec.Scale(12.5, 45.0, 40.0),
    "DM8009": codec.Scale(12.5, 45.0, 54.0),
    "DM10010": codec.Scale(12.5, 20.0, 200.0),
    "DM10010L": codec.Scale(12.5, 25.0, 200.0),
}


class SettingsError(Exception):
    """The robot file, the scenario or the URDF does not describe something that can be simulated."""


class JointSetting(NamedTuple):
    """One joint as the plant needs it."""

    name: str
    q_min: float  # [rad] permitted range; the mechanical stops lie outside it
    q_max: float
    armature: float  # [kg m^2] motor inertia seen at the joint
    friction: float  # [Nms/rad] viscous, seen at the joint
    coulomb: float  # [Nm]
    direction: float  # 1 or -1: the drive reads direction * q + zero
    zero: float  # [rad]
    brake: bool  # a holding brake: kits' drives have none


class Tool(NamedTuple):
    """What is fixed to the tip, in its frame."""

    mass: float  # [kg]
    com: tuple[float, ...]  # (3,) [m]
    inertia: tuple[float, ...]  # (6,) [kg m^2] xx, xy, xz, yy, yz, zz about the centre


class Settings(NamedTuple):
    """The robot file, as far as drives, plant and bus need it."""

    name: str
    folder: Path  # of the file: its own paths are relative to it
    urdf: Path
    package_dirs: tuple[Path, ...]
    tip_frame: str
    tool: Tool
    base_position: tuple[float, float, float]
    base_wxyz: tuple[float, float, float, float]
    joints: tuple[JointSetting, ...]
    ratings: tuple[Rating, ...]
    grippers: tuple[GripperSetting, ...]
    home: tuple[float, ...]
    period_ns: int
    interface: str
    channel: str
    fd: bool
    e2e: bool
    obstacles: tuple[dict[str, Any], ...]
    meshes: tuple[dict[str, Any], ...]
    socket: str | None


def package_dirs() -> tuple[Path, ...]:
    """Return the folders that `package://` names are looked for in: shares of wheels, then ROS's own."""
    ros = [Path(p) for p in os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep) if p]
    roots = [*map(Path, site.getsitepackages()), *(Path(p) for p in sys.path if p.endswith("site-packages"))]
    shares = [*(r / "cmeel.prefix" / "share" for r in roots), *ros]
    return tuple(dict.fromkeys(share for share in shares if share.is_dir()))


def resolve(name: str, beside: Path, packages: tuple[Path, ...]) -> Path:
    """Return the file behind `package://...`, or a path relative to `beside`; SettingsError if there is none."""
    if name.startswith("package://"):
        tried = [p / name.removeprefix("package://") for p in packages]
    else:
        tried = [beside / name.removeprefix("file://")]
    for path in tried:
        if path.is_file():
            return path
    raise SettingsError(f"{name}: not found, looked at {', '.join(map(str, tried)) or 'no package folder'}")


def quaternion(table: dict[str, Any]) -> tuple[float, float, float, float]:
    """Return the unit quaternion wxyz of `rpy_rad` (Rz(yaw) Ry(pitch) Rx(roll)), `wxyz` or `normal`; else identity."""
    if table.get("wxyz") is not None:
        w, x, y, z = map(float, table["wxyz"])
    elif table.get("normal") is not None:
        a, b, c = map(float, table["normal"])
        size = math.sqrt(a * a + b * b + c * c)
        w, x, y, z = 1.0 + c / size, -b / size, a / size, 0.0
        if w < 1e-9:
            w, x = 0.0, 1.0
    else:
        r, p, h = (0.5 * float(v) for v in table.get("rpy_rad") or (0.0, 0.0, 0.0))
        w = math.cos(r) * math.cos(p) * math.cos(h) + math.sin(r) * math.sin(p) * math.sin(h)
        x = math.sin(r) * math.cos(p) * math.cos(h) - math.cos(r) * math.sin(p) * math.sin(h)
        y = math.cos(r) * math.sin(p) * math.cos(h) + math.sin(r) * math.cos(p) * math.sin(h)
        z = math.cos(r) * math.cos(p) * math.sin(h) - math.sin(r) * math.sin(p) * math.cos(h)
    size = math.sqrt(w * w + x * x + y * y + z * z)
    return (w / size, x / size, y / size, z / size)


def load(config_path: str | Path, control_hz: float | None = None) -> Settings:
    """Read the robot file; `control_hz` overrides loop.servo_hz. SettingsError names what is missing or wrong."""
    path = Path(config_path)
    try:
        with path.open("rb") as file:
            return _settings(tomllib.load(file), path, control_hz)
    except KeyError as error:
        raise SettingsError(f"{path}: {error.args[0]} is missing") from error
    except (OSError, TypeError, ValueError) as error:
        raise SettingsError(f"{path}: {error}") from error


def _settings(file: dict[str, Any], path: Path, control_hz: float | None) -> Settings:
    robot, link, safety = file["robot"], file["link"], file["safety"]
    base = robot.get("base_pose", {})
    period_ns = round(1e9 / float(control_hz or file["loop"]["servo_hz"]))
    packages = package_dirs()
    scales = SCALES | {
        name: codec.Scale(float(d["p_max_rad"]), float(d["v_max_rad_s"]), float(d["t_max_Nm"]))
        for name, d in file.get("drives", {}).items()
    }
    rate = int(link.get("data_bitrate") or link["bitrate"]) if link["fd"] else int(link["bitrate"])
    common = {
        "slew_window_ns": period_ns,
        "timeout": round(float(safety["watchdog_ms"]) * 1e6 / codec.TIMEOUT_NS),
        "baud": codec.BAUD_CODES.get(rate, 4),
        "e2e": link["protocol"] == "mit+e2e",
    }
    return Settings(
        name=robot["name"],
        folder=path.parent,
        urdf=resolve(robot["urdf"], path.parent, packages),
        package_dirs=packages,
        tip_frame=robot["tip_frame"],
        tool=_tool(file.get("tool") or {"mass_kg": 0.0}),
        base_position=tuple(map(float, base.get("position_m", (0.0, 0.0, 0.0)))),  # type: ignore[arg-type]
        base_wxyz=quaternion(base),
        joints=tuple(
            JointSetting(
                j["name"],
                float(j["q_min_rad"]),
                float(j["q_max_rad"]),
                float(j.get("armature_kg_m2", 0.0)),
                float(j.get("friction_Nms_rad", 0.0)) + float(j.get("friction", {}).get("viscous_Nms_rad", 0.0)),
                float(j.get("friction", {}).get("coulomb_Nm", 0.0)),
                float(j.get("direction", 1)),
                float(j.get("zero_rad", 0.0)),
                bool(
                    j.get(
                        "brake", j["drive"] in file.get("drives", {}) and file["drives"][j["drive"]].get("brake", True)
                    )
                ),
            )
            for j in robot["joints"]
        ),
        ratings=tuple(_rating(j, scales, common) for j in robot["joints"]),
        grippers=gripper_settings(file.get("gripper", []), lambda g: _gripper(g, scales, common)),
        home=tuple(map(float, robot["home_rad"])),
        period_ns=period_ns,
        interface=link["interface"],
        channel=link["channel"],
        fd=bool(link["fd"]),
        e2e=link["protocol"] == "mit+e2e",
        obstacles=tuple(file.get("obstacle", ())),
        meshes=tuple(file.get("mesh", ())),
        socket=file.get("console", {}).get("socket"),
    )


def _tool(table: dict[str, Any]) -> Tool:
    com, inertia = table.get("com_m", (0.0,) * 3), table.get("inertia_kg_m2") or (0.0,) * 6
    return Tool(float(table["mass_kg"]), tuple(map(float, com)), tuple(map(float, inertia)))


def _rating(joint: dict[str, Any], scales: dict[str, codec.Scale], common: dict[str, Any]) -> Rating:
    if joint["drive"] not in scales:
        raise ValueError(f"drive {joint['drive']} is not one of {', '.join(sorted(scales))}")
    return Rating(
        motor=int(joint["can_id"]),
        scale=scales[joint["drive"]],
        torque=float(joint["tau_max_Nm"]),
        torque_rate=float(joint["tau_rate_Nm_s"]),
        speed=float(joint["qd_max_rad_s"]),
        reply=int(joint.get("reply_id", -1)),
        **common,
    )


def _gripper(table: dict[str, Any], scales: dict[str, codec.Scale], common: dict[str, Any]) -> Rating:
    if table["drive"] not in scales:
        raise ValueError(f"drive {table['drive']} is not one of {', '.join(sorted(scales))}")
    scale = scales[table["drive"]]
    return Rating(
        motor=int(table["can_id"]),
        scale=scale,
        torque=scale.t,
        torque_rate=1e3 * scale.t,
        speed=scale.v,
        reply=int(table.get("reply_id", -1)),
        release_ns=0,
        **common,
    )

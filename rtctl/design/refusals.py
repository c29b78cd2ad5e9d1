"""What of a config is refused when it is held against the URDF: limits, torque, inertia, axes, a start in contact."""

from pathlib import Path

import numpy as np

from rtctl.arm.points import Points
from rtctl.arm.rigid_body import RigidBody
from rtctl.design.assets import Assets
from rtctl.design.description import notes
from rtctl.design.extremes import Extremes
from rtctl.design.mobility import mobility
from rtctl.errors import ConfigError
from rtctl.spec.read import name_place
from rtctl.spec.robot import Config
from rtctl.spec.urdf import urdf_file
from rtctl.types import F64, Shape
from rtctl.world.primitives import distance


def refuse_inertia(config: Config, path: Path) -> None:
    """Refuse an inertia tensor that no body has where neither we nor a simulator can make anything of it."""
    urdf = urdf_file(config.robot.urdf, path)
    for note in notes(urdf, [j.name for j in config.robot.joints]):
        if note.refused:
            wanted = f"inertia tensors that bodies have; {note.text} ({urdf.name})"
            raise ConfigError(name_place(str(path), "robot.urdf"), f"link {note.about}", wanted)


def refuse_limits(config: Config, body: RigidBody, source: str) -> None:
    """Refuse joints that are given more range, speed or torque than the URDF states."""
    limits = body.limits
    for i, j in enumerate(config.robot.joints):
        rows = [
            ("q_min_rad", j.q_min_rad, j.q_min_rad >= limits.q_min[i] - 1e-6, f"at least {limits.q_min[i]:g}"),
            ("q_max_rad", j.q_max_rad, j.q_max_rad <= limits.q_max[i] + 1e-6, f"at most {limits.q_max[i]:g}"),
            (
                "qd_max_rad_s",
                j.qd_max_rad_s,
                j.qd_max_rad_s <= limits.qd_max[i] * 1.000001,
                f"at most {limits.qd_max[i]:g}",
            ),
            (
                "tau_max_Nm",
                j.tau_max_Nm,
                j.tau_max_Nm <= limits.tau_max[i] * 1.000001,
                f"at most {limits.tau_max[i]:g}",
            ),
        ]
        for key, got, fine, wanted in rows:
            if not fine:
                place = name_place(source, f"robot.joints[{i}].{key}")
                raise ConfigError(place, got, f"{wanted}, the URDF's limit of {j.name}")


def refuse_torque(config: Config, found: Extremes, source: str) -> None:
    """Refuse a joint that cannot hold the arm at home with what may be sent, or anywhere with its rating.

    What is named is the tool where the arm without it could be held, and the largest payload where it cannot at home.
    """
    for i, j in enumerate(config.robot.joints):
        usable = config.safety.torque_ratio * j.tau_max_Nm
        if config.tool is not None and found.tool[i] > 0.0:
            for place, most, torque in (
                ("at home", usable, found.gravity_home[i]),
                ("", j.tau_max_Nm, found.gravity[i]),
            ):
                if torque >= most > torque - found.tool[i]:
                    wanted = f"less: {j.name} would carry {torque:.3g} of {most:.3g} Nm {place or 'within the limits'}"
                    raise ConfigError(name_place(source, "tool.mass_kg"), config.tool.mass_kg, wanted)
        if found.payload_home[i] >= usable > found.gravity_home[i]:
            wanted = f"less: {j.name} would carry {found.payload_home[i]:.3g} of {usable:.3g} Nm at home"
            raise ConfigError(name_place(source, "robot.payload_max_kg"), config.robot.payload_max_kg, wanted)
        place = name_place(source, f"robot.joints[{i}].tau_max_Nm")
        if found.gravity_home[i] >= usable:
            wanted = f"more than gravity's {found.gravity_home[i]:.3g} Nm at home / torque_ratio"
            raise ConfigError(place, j.tau_max_Nm, wanted)
        if found.gravity[i] >= j.tau_max_Nm:
            raise ConfigError(place, j.tau_max_Nm, f"more than gravity's {found.gravity[i]:.3g} Nm within the limits")


def refuse_contact(
    obstacles: tuple[Shape, ...], assets: Assets, body: RigidBody, points: Points, home: F64, source: str
) -> None:
    """Refuse an obstacle of the config that the arm touches at home."""
    P = body.evaluate(home, np.zeros(body.n), points).P
    for i, shape in enumerate(obstacles):
        rho = distance(shape, P, assets.meshes)[0] - points.radius
        if rho.min() <= 0.0:
            place = name_place(source, f"obstacle[{i}].position_m")
            got = f"{shape.name} {-rho.min():.3g} m inside the points of {points.names[int(rho.argmin())]} at home"
            raise ConfigError(place, got, "an obstacle clear of the arm at home")


def refuse_axes(c: Config, body: RigidBody, source: str) -> None:
    """Raise ConfigError for an axis of the task along or about which the tip never moves."""
    q_min, q_max = (np.array([getattr(j, key) for j in c.robot.joints]) for key in ("q_min_rad", "q_max_rad"))
    never = mobility(body, q_min, q_max)
    for i, axis in enumerate(c.motion.axes):
        lost = never.unturned if axis.startswith("r") else never.still
        if np.linalg.norm(lost[:, "xyz".index(axis[-1])]) > 1.0 - 1e-6:
            place = name_place(source, f"motion.axes[{i}]")
            raise ConfigError(place, axis, "an axis along (x) or about (rx) which this arm can move")

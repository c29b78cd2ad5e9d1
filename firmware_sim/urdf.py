"""The arm's URDF as the plant needs it.

Configured joints stay, all others are fixed at zero; visuals, URDF damping and friction are dropped; mechanical stops
lie STOP outside the permitted range; the base stands where the configuration puts it; masses are as wrong, and the
payload is, as `[plant]` says.
"""

import math
import xml.etree.ElementTree as ET

import numpy as np
from numpy.typing import NDArray

from firmware_sim.reality import Reality
from firmware_sim.settings import Settings, SettingsError, Tool, resolve

PACKAGES_ABOVE = 4  # folders above a URDF that may hold the packages that its meshes name
STOP = 0.1  # [rad or m] mechanical stop outside the permitted range
WORLD = "plant_world"
PAYLOAD, TOOL = "plant_payload", "plant_tool"
PAYLOAD_RADIUS = 0.03  # [m] of the ball that a payload is
MASSLESS = '<inertial><mass value="0"/><inertia ixx="0" ixy="0" ixz="0" iyy="0" iyz="0" izz="0"/></inertial>'


def rewrite(settings: Settings, reality: Reality) -> str:
    """Return the plant's URDF: absolute mesh paths, base pose and payload built in, only the configured joints free."""
    root = ET.parse(settings.urdf).getroot()
    wanted = {j.name: j for j in settings.joints}
    missing = wanted.keys() - {j.get("name") for j in root.iter("joint")}
    if missing:
        raise SettingsError(f"{settings.urdf}: has no joint {', '.join(sorted(missing))}")
    for link in root.iter("link"):
        for visual in link.findall("visual"):
            link.remove(visual)
    for mesh in root.iter("mesh"):
        packages = (*settings.package_dirs, *list(settings.urdf.parents)[:PACKAGES_ABOVE])
        mesh.set("filename", str(resolve(mesh.get("filename", ""), settings.urdf.parent, packages)))
    for joint in root.findall("joint"):
        for tag in ("dynamics", "mimic", "safety_controller"):
            for element in joint.findall(tag):
                joint.remove(element)
        setting = wanted.get(joint.get("name", ""))
        limit = joint.find("limit")
        if setting is None:
            joint.set("type", "fixed")
        elif joint.get("type") in ("revolute", "prismatic") and limit is not None:
            limit.set("lower", repr(min(float(limit.get("lower", "0")), setting.q_min) - STOP))
            limit.set("upper", repr(max(float(limit.get("upper", "0")), setting.q_max) + STOP))
    _make_wrong(root, reality)
    _load(root, reality, settings)
    children = {c.get("link") for c in root.iter("child")}
    base = next(link.get("name", "") for link in root.findall("link") if link.get("name") not in children)
    w, x, y, z = settings.base_wxyz
    rpy = (
        math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y)),
        math.asin(min(max(2.0 * (w * y - z * x), -1.0), 1.0)),
        math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)),
    )
    root.append(ET.fromstring(f'<link name="{WORLD}"/>'))
    for link in root.findall("link"):
        if link.find("inertial") is None:  # pybullet would give it 1 kg
            link.append(ET.fromstring(MASSLESS))
    root.append(
        ET.fromstring(
            f'<joint name="{WORLD}_joint" type="fixed"><parent link="{WORLD}"/><child link="{base}"/>'
            f'<origin xyz="{" ".join(map(repr, settings.base_position))}" rpy="{" ".join(map(repr, rpy))}"/></joint>'
        )
    )
    return ET.tostring(root, encoding="unicode")


def urdf_dynamics(settings: Settings, reality: Reality) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the viscous (n,) [Nms/rad] and Coulomb friction (n,) [Nm] that `[plant]` adds."""
    viscous, coulomb = np.array(reality.viscous), np.array(reality.coulomb)
    if reality.urdf_dynamics:
        found = {j.get("name"): j.find("dynamics") for j in ET.parse(settings.urdf).getroot().iter("joint")}
        for k, joint in enumerate(settings.joints):
            dynamics = found.get(joint.name)
            if dynamics is not None:
                viscous[k] += float(dynamics.get("damping", "0"))
                coulomb[k] += float(dynamics.get("friction", "0"))
    return viscous, coulomb


def _make_wrong(root: ET.Element, reality: Reality) -> None:
    """Scale masses and inertia tensors by their errors: a link's own, or the one for all."""
    names = {link.get("name", "") for link in root.iter("link")}
    for key, errors in (("mass", reality.mass_error), ("inertia", reality.inertia_error)):
        if unknown := sorted(set(errors) - names - {""}):
            raise SettingsError(f"plant.{key}_error: {unknown[0]} is no link of the URDF")
        for link in root.iter("link"):
            factor = 1.0 + errors.get(link.get("name", ""), errors.get("", 0.0))
            for element in link.iterfind(f"inertial/{key}") if factor != 1.0 else ():
                for name, value in element.items():
                    element.set(name, repr(float(value) * factor))


def _load(root: ET.Element, reality: Reality, settings: Settings) -> None:
    """Fix the tool to the tip and the payload, a ball of PAYLOAD_RADIUS, to its link; nothing can touch either."""
    if settings.tool.mass > 0.0:
        _fix(root, TOOL, settings.tip_frame, settings.tool)
    m = reality.payload_kg
    if m == 0.0:
        return
    link = reality.payload_link or settings.tip_frame
    if link not in {one.get("name") for one in root.iter("link")}:
        raise SettingsError(f"plant.payload_link: {link} is no link of {settings.urdf}")
    i = 0.4 * m * PAYLOAD_RADIUS**2
    _fix(root, PAYLOAD, link, Tool(m, reality.payload_com, (i, 0.0, 0.0, i, 0.0, i)))


def _fix(root: ET.Element, name: str, link: str, body: Tool) -> None:
    """Fix a body without a shape to a link."""
    keys = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    inertia = " ".join(f'{k}="{v!r}"' for k, v in zip(keys, body.inertia, strict=True))
    root.append(
        ET.fromstring(
            f'<link name="{name}"><inertial><mass value="{body.mass!r}"/><inertia {inertia}/></inertial></link>'
        )
    )
    at = " ".join(map(repr, body.com))
    root.append(
        ET.fromstring(
            f'<joint name="{name}_joint" type="fixed"><parent link="{link}"/><child link="{name}"/>'
            f'<origin xyz="{at}" rpy="0 0 0"/></joint>'
        )
    )

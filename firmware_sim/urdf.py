"""The arm's URDF as the plant needs it.

Configured joints stay, all others are fixed at zero; visuals, URDF damping and friction are dropped; mechanical stops
lie STOP outside the permitted range; the base stands where the configuration puts it.
"""

import math
import xml.etree.ElementTree as ET

from firmware_sim.settings import Settings, SettingsError, resolve

STOP = 0.1  # [rad or m] mechanical stop outside the permitted range
WORLD = "plant_world"
MASSLESS = '<inertial><mass value="0"/><inertia ixx="0" ixy="0" ixz="0" iyy="0" iyz="0" izz="0"/></inertial>'


def rewrite(settings: Settings) -> str:
    """Return the plant's URDF: absolute mesh paths, base pose built in, only the configured joints free."""
    root = ET.parse(settings.urdf).getroot()
    wanted = {j.name: j for j in settings.joints}
    missing = wanted.keys() - {j.get("name") for j in root.iter("joint")}
    if missing:
        raise SettingsError(f"{settings.urdf}: has no joint {', '.join(sorted(missing))}")
    for link in root.iter("link"):
        for visual in link.findall("visual"):
            link.remove(visual)
    for mesh in root.iter("mesh"):
        mesh.set("filename", str(resolve(mesh.get("filename", ""), settings.urdf.parent, settings.package_dirs)))
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

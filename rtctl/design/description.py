"""What a URDF says that no body has, or that this program does not use: told by `check`, before a simulator balks."""

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rtctl.types import F64

SLACK = 1e-3  # of the trace, by which rounded figures of a thin body may break the inequality


class Note(NamedTuple):
    """Something odd of a link."""

    about: str
    text: str
    refused: bool = False  # no simulator can play it


def notes(urdf: Path, joints: Sequence[str]) -> tuple[Note, ...]:
    """Return what is odd about the inertias of a URDF's links; joints: names of those that are driven."""
    root = ET.parse(urdf).getroot()
    moved = _moved(root, joints)
    found = []
    for link in root.iter("link"):
        tensor = _tensor(link)
        name = link.get("name", "")
        if tensor is None or possible(tensor):
            continue
        moments = ", ".join(f"{m:.3g}" for m in np.linalg.eigvalsh(tensor))
        text = f"no body has the principal moments {moments} kg m2: the largest is more than the others together"
        if name not in moved:
            found.append(Note(name, f"{text}; it does not move, so nothing comes of it"))
        else:
            diagonal = bool((tensor == np.diag(np.diag(tensor))).all())
            found.append(Note(name, text, not diagonal))
    return tuple(found)


def dynamics(urdf: Path, joints: Sequence[str]) -> dict[str, tuple[float, float]]:
    """Return damping [Nms/rad] and friction [Nm] that a URDF states of driven joints, where it states any."""
    found = {}
    for joint in ET.parse(urdf).getroot().iter("joint"):
        stated, name = joint.find("dynamics"), joint.get("name", "")
        if stated is not None and name in joints:
            values = float(stated.get("damping", "0")), float(stated.get("friction", "0"))
            if any(values):
                found[name] = values
    return found


def possible(tensor: F64) -> bool:
    """Return whether a body can have an inertia tensor (3, 3): no moment is more than the others together."""
    low, middle, high = np.linalg.eigvalsh(tensor)
    slack = SLACK * float(np.trace(tensor))
    return bool(low >= -slack and low + middle >= high - slack)


def _tensor(link: ET.Element) -> F64 | None:
    inertia = link.find("inertial/inertia")
    if inertia is None:
        return None
    xx, xy, xz, yy, yz, zz = (float(inertia.get(k, "0")) for k in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"))
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def _moved(root: ET.Element, joints: Sequence[str]) -> set[str]:
    """Return the links that some driven joint moves."""
    ends: dict[str, list[tuple[str, str]]] = {}
    for joint in root.iter("joint"):
        parent, child = joint.find("parent"), joint.find("child")
        if parent is not None and child is not None:
            ends.setdefault(parent.get("link", ""), []).append((joint.get("name", ""), child.get("link", "")))
    moved: set[str] = set()
    waiting = [(link, False) for link in set(ends) - {child for rows in ends.values() for _, child in rows}]
    while waiting:
        link, moves = waiting.pop()
        for name, end in ends.get(link, ()):
            goes = moves or name in joints
            if goes:
                moved.add(end)
            waiting.append((end, goes))
    return moved

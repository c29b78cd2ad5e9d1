"""What the arm and its surroundings look like, for 3D viewers: links, obstacles, goal, forces.

Everything is worked out in the recorder process from the record, the requests and the header: the servo pays nothing.
"""

import math
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

from rtctl.log.header import Header
from rtctl.log.record import draw
from rtctl.log.record.surroundings import Drawing
from rtctl.types import F64, RecordRow

NEWTON = 0.004  # [m] length of an arrow for 1 N
SEEN = 2.0  # [N] smaller forces are not drawn
BODY: draw.Colour = (0.95, 0.7, 0.3, 0.35)  # of the spheres that stand for the links


class Link(NamedTuple):
    """One joint of the URDF: where its child is in its parent."""

    parent: str
    child: str
    origin: F64  # (4, 4)
    axis: F64  # (3,)
    kind: str  # fixed | prismatic | anything that turns
    joint: int  # of q, -1 for one that is not configured: it stays at zero


class Scene(Drawing):
    """An arm among its obstacles; gives the two messages of a moment."""

    drawn = ("time", "q", "x", "wxyz", "goal", "force", "point")

    def __init__(self, header: Header) -> None:
        super().__init__(header)
        self.links = links_of(header.urdf, header.joints)
        roots = {link.parent for link in self.links} - {link.child for link in self.links}
        self.root = next(iter(sorted(roots)), "base")
        self.base = _pose(self.about.get("base"))
        points = [p for p in self.about.get("points", ()) if len(p) in (4, 5)]
        self.points = [(int(p[0]), np.array([*p[1:4], 1.0])) for p in points]
        self.radii = [float(p[4]) if len(p) == 5 else 0.0 for p in points]  # logs of before they were drawn have none
        self._carriers = _carriers(self.links, len(header.joints))

    def frames(self, record: RecordRow, ns: int) -> bytes:
        """Return foxglove.FrameTransforms of every link and of the estimated tip at log_time `ns`."""
        message = FrameTransforms()
        draw.frame(message, ns, draw.WORLD, self.root, self.base)
        for link in self.links:
            draw.frame(message, ns, link.parent, link.child, _moved(link, record["q"]))
        tip = np.eye(4)
        tip[:3, :3], tip[:3, 3] = draw.rotation(record["wxyz"]), record["x"]
        draw.frame(message, ns, draw.WORLD, "tip_estimate", tip)
        data: bytes = message.SerializeToString(deterministic=True)
        return data

    def own(self, message: SceneUpdate, record: RecordRow, ns: int) -> None:
        """Add the goal and the forces as arrows."""
        goal = draw.entity_of(message, "goal", ns)
        draw.ball(goal, record["goal"], 0.015, draw.GREEN)
        self._forces(draw.entity_of(message, "forces", ns), record)

    def body(self, message: SceneUpdate) -> None:
        """Add the points subjected to the potential: on each link those that it carries."""
        for carrier, chain in enumerate(self._carriers):
            mine = [(p, r) for (c, p), r in zip(self.points, self.radii, strict=True) if c == carrier and r > 0.0]
            if not chain or not mine:
                continue
            body = draw.entity_of(message, f"body {chain[-1].child}", 0, chain[-1].child)
            for local, radius in mine:
                draw.ball(body, local[:3], radius, BODY)

    def _forces(self, entity: SceneEntity, record: RecordRow) -> None:
        force = record["force"]
        size = np.linalg.norm(force, axis=1)
        for slot in np.flatnonzero(np.isfinite(size) & (size > SEEN)).tolist():
            start = self._point(record, int(record["point"][slot]))
            length = max(0.01, min(0.5, float(size[slot]) * NEWTON))
            draw.arrow(entity, start, force[slot] / size[slot], length, draw.RED)

    def _point(self, record: RecordRow, index: int) -> F64:
        """Return where (3,) [m] a point of the arm is; the tip when it is not known."""
        if not 0 <= index < len(self.points):
            return np.asarray(record["x"])
        carrier, local = self.points[index]
        X = self.base.copy()
        for link in self._carriers[carrier] if carrier < len(self._carriers) else ():
            X = X @ _moved(link, record["q"])
        return np.asarray((X @ local)[:3])


def links_of(urdf: str, joints: Sequence[str]) -> list[Link]:
    """Return the joints of a URDF's text, [] when it is none."""
    try:
        root = ET.fromstring(urdf)
    except ET.ParseError:
        return []
    found = []
    for joint in root.iterfind("joint"):
        parent, child, origin, axis = (joint.find(name) for name in ("parent", "child", "origin", "axis"))
        if parent is None or child is None:
            continue
        X = np.eye(4)
        if origin is not None:
            X[:3, :3], X[:3, 3] = _rpy(_numbers(origin.get("rpy"))), _numbers(origin.get("xyz"))
        name = joint.get("name", "")
        a = _numbers(axis.get("xyz")) if axis is not None else np.array([1.0, 0.0, 0.0])
        found.append(
            Link(
                parent.get("link", ""),
                child.get("link", ""),
                X,
                a / (np.linalg.norm(a) or 1.0),
                joint.get("type", "fixed"),
                joints.index(name) if name in joints else -1,
            )
        )
    return found


def _carriers(links: list[Link], n: int) -> list[list[Link]]:
    """Return the chain of joints from the root to the frame that each configured joint carries; 0 is the root."""
    by_child = {link.child: link for link in links}
    chains: list[list[Link]] = [[] for _ in range(n + 1)]
    for link in links:
        if link.joint < 0:
            continue
        chain, at, seen = [link], link.parent, {link.child}
        while at in by_child and at not in seen:
            seen.add(at)
            chain.append(by_child[at])
            at = by_child[at].parent
        chains[link.joint + 1] = chain[::-1]
    return chains


def _moved(link: Link, q: F64) -> F64:
    """Return the child in the parent (4, 4) at positions q."""
    if link.joint < 0 or link.kind == "fixed":
        return link.origin
    value, X = float(q[link.joint]), np.eye(4)
    if link.kind == "prismatic":
        X[:3, 3] = value * link.axis
    else:
        X[:3, :3] = _turn(link.axis, value)
    return np.asarray(link.origin @ X)


def _turn(axis: F64, angle: float) -> F64:
    """Return Rodrigues' rotation (3, 3) about a unit axis by an angle [rad]."""
    x, y, z = axis.tolist()
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + math.sin(angle) * K + (1.0 - math.cos(angle)) * (K @ K))


def _rpy(rpy: F64) -> F64:
    x, y, z = np.eye(3)
    return np.asarray(_turn(z, float(rpy[2])) @ _turn(y, float(rpy[1])) @ _turn(x, float(rpy[0])))


def _pose(about: object) -> F64:
    X = np.eye(4)
    if isinstance(about, dict):
        X[:3, :3], X[:3, 3] = draw.rotation(about.get("wxyz", (1, 0, 0, 0))), about.get("position", (0, 0, 0))
    return X


def _numbers(text: str | None) -> F64:
    try:
        values = np.array((text or "0 0 0").split(), np.float64)
    except ValueError:
        values = np.zeros(3)
    return values if values.shape == (3,) else np.zeros(3)

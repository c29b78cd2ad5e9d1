"""What the arm and its surroundings look like, for 3D viewers: frames of all links, obstacles, goal, forces.

Everything is worked out in the recorder process from the record, the requests and the header: the servo pays nothing.
Obstacles are followed by the same rule as the controller's own table: the first free slot, extrapolated by velocity.
"""

import json
import math
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

from rtctl.log.header import SCENE_FILE, Header
from rtctl.types import F64

HZ = 30.0
WORLD = "world"
DRAWN = ("time", "q", "x", "wxyz", "goal", "goal_wxyz", "force", "point")
LARGEST = 1e6  # [m, rad, N] of anything drawn; comparing is false for NaN
NEWTON = 0.004  # [m] length of an arrow for 1 N
SEEN = 2.0  # [N] smaller forces are not drawn
GREY, BLUE, GREEN, RED = (0.6, 0.6, 0.65, 0.55), (0.25, 0.45, 0.9, 0.7), (0.2, 0.75, 0.35, 0.9), (0.9, 0.2, 0.2, 1.0)


class Link(NamedTuple):
    """One joint of the URDF: where its child is in its parent."""

    parent: str
    child: str
    origin: F64  # (4, 4)
    axis: F64  # (3,)
    kind: str  # fixed | prismatic | anything that turns
    joint: int  # of q, -1 for one that is not configured: it stays at zero


class Thing(NamedTuple):
    """An obstacle as it was last told."""

    shape: dict[str, Any]
    time: float  # [s] robot time for which its position holds


class Scene:
    """Follows what moves; gives the two messages of a moment."""

    def __init__(self, header: Header) -> None:
        about = _json(header.files.get(SCENE_FILE, ""))
        self.links = links_of(header.urdf, header.joints)
        roots = {link.parent for link in self.links} - {link.child for link in self.links}
        self.root = next(iter(sorted(roots)), "base")
        self.base = _pose(about.get("base"))
        self.points = [(int(p[0]), np.array([*p[1:], 1.0])) for p in about.get("points", ()) if len(p) == 4]
        self.tip_frame = str(about.get("tip_frame", ""))
        self._carriers = _carriers(self.links, len(header.joints))
        self._slots: list[str] = [""] * header.slots
        self._things: dict[str, Thing] = {}
        self._gone: list[str] = []
        for shape in about.get("obstacles", ()):
            self._set(shape, 0.0)
        self._fixed = set(self._things)

    def request(self, payload: bytes, time: float) -> None:
        """Take a request's obstacles into account; time [s] of the robot."""
        edits = _json(payload.decode("utf-8", "replace")).get("obstacles", ())
        for edit in edits if isinstance(edits, list) else ():
            name, shape = str(edit.get("name", "")), edit.get("shape")
            if isinstance(shape, dict):
                if name not in self._fixed:
                    self._set({**shape, "name": name}, time - float(edit.get("age") or 0.0))
                continue
            for each in [n for n in self._things if name in (n, "*") and n not in self._fixed]:
                self._clear(each)

    def _set(self, shape: dict[str, Any], time: float) -> None:
        name = str(shape.get("name", ""))
        if name not in self._things:
            if "" not in self._slots:
                return
            self._slots[self._slots.index("")] = name
        self._things[name] = Thing(shape, time)

    def _clear(self, name: str) -> None:
        del self._things[name]
        self._slots[self._slots.index(name)] = ""
        self._gone.append(name)

    def name_of(self, slot: int) -> str:
        """Return the name of the obstacle in a slot, '' for none."""
        return self._slots[slot] if 0 <= slot < len(self._slots) else ""

    def shapes(self) -> list[dict[str, Any]]:
        """Return the obstacles as they were last told."""
        return [thing.shape for thing in self._things.values()]

    @staticmethod
    def can_show(record: Any) -> bool:
        """Return whether a record's numbers can be drawn: a log takes whatever bits a tick had."""
        names = [name for name in DRAWN if name in (record.dtype.names or ())]
        return len(names) == len(DRAWN) and all(bool((np.abs(record[name]) < LARGEST).all()) for name in names)

    # ---- messages

    def frames(self, record: Any, stamp: int) -> bytes:
        """Return foxglove.FrameTransforms of every link and of the estimated tip at log_time `stamp` [ns]."""
        message = FrameTransforms()
        self._frame(message, stamp, WORLD, self.root, self.base)
        for link in self.links:
            self._frame(message, stamp, link.parent, link.child, _moved(link, record["q"]))
        tip = np.eye(4)
        tip[:3, :3], tip[:3, 3] = _rotation(record["wxyz"]), record["x"]
        self._frame(message, stamp, WORLD, "tip_estimate", tip)
        data: bytes = message.SerializeToString(deterministic=True)
        return data

    @staticmethod
    def _frame(message: Any, stamp: int, parent: str, child: str, X: F64) -> None:
        one = message.transforms.add(parent_frame_id=parent, child_frame_id=child)
        _stamp(one.timestamp, stamp)
        one.translation.x, one.translation.y, one.translation.z = X[:3, 3].tolist()
        one.rotation.w, one.rotation.x, one.rotation.y, one.rotation.z = _quaternion(X[:3, :3])

    def update(self, record: Any, stamp: int) -> bytes:
        """Return foxglove.SceneUpdate: obstacles, goal, forces as arrows; what was cleared is deleted."""
        message = SceneUpdate()
        for name in self._gone:
            one = message.deletions.add(type=0, id=f"obstacle {name}")
            _stamp(one.timestamp, stamp)
        self._gone.clear()
        now = float(record["time"])
        for name, thing in self._things.items():
            _draw(_entity(message, f"obstacle {name}", stamp), thing, now, GREY if name in self._fixed else BLUE)
        goal = _entity(message, "goal", stamp)
        ball = goal.spheres.add()
        _put(ball.pose, record["goal"], record["goal_wxyz"])
        ball.size.x = ball.size.y = ball.size.z = 0.03
        ball.color.CopyFrom(Color(r=GREEN[0], g=GREEN[1], b=GREEN[2], a=GREEN[3]))
        self._forces(_entity(message, "forces", stamp), record)
        data: bytes = message.SerializeToString(deterministic=True)
        return data

    def _forces(self, entity: Any, record: Any) -> None:
        force = record["force"]
        size = np.linalg.norm(force, axis=1)
        for slot in np.flatnonzero(np.isfinite(size) & (size > SEEN)).tolist():
            start = self._point(record, int(record["point"][slot]))
            arrow = entity.arrows.add(shaft_diameter=0.012, head_diameter=0.03, head_length=0.03)
            _put(arrow.pose, start, _along(force[slot] / size[slot]))
            arrow.shaft_length = max(0.01, min(0.5, float(size[slot]) * NEWTON))
            arrow.color.CopyFrom(Color(r=RED[0], g=RED[1], b=RED[2], a=RED[3]))

    def _point(self, record: Any, index: int) -> F64:
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


def _rotation(wxyz: Any) -> F64:
    w, x, y, z = (float(v) for v in wxyz)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _quaternion(R: F64) -> tuple[float, float, float, float]:
    """Return wxyz of a rotation by the largest of its four squares: no cancellation anywhere."""
    m = R.tolist()
    squares = (
        1 + m[0][0] + m[1][1] + m[2][2],
        1 + m[0][0] - m[1][1] - m[2][2],
        1 - m[0][0] + m[1][1] - m[2][2],
        1 - m[0][0] - m[1][1] + m[2][2],
    )
    k = squares.index(max(squares))
    s = 2.0 * math.sqrt(max(squares[k], 1e-12))
    a, b, c = m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1]
    d, e, f = m[0][1] + m[1][0], m[0][2] + m[2][0], m[1][2] + m[2][1]
    rows = (
        (s / 4, a / s, b / s, c / s),
        (a / s, s / 4, d / s, e / s),
        (b / s, d / s, s / 4, f / s),
        (c / s, e / s, f / s, s / 4),
    )
    return rows[k]


def _along(direction: F64) -> tuple[float, float, float, float]:
    """Return wxyz that turns x to a unit vector."""
    x, y, z = direction.tolist()
    if x < -0.999999:
        return 0.0, 0.0, 0.0, 1.0
    w = 1.0 + x
    size = math.sqrt(w * w + y * y + z * z)
    return w / size, 0.0, -z / size, y / size


def _draw(entity: Any, thing: Thing, now: float, colour: tuple[float, ...]) -> None:
    """Add the primitives of one obstacle."""
    shape = thing.shape
    kind = str(shape.get("type", ""))
    a, b, c = (float(v) for v in [*shape.get("dims", ()), 0.0, 0.0, 0.0][:3])
    p = np.array(shape.get("position", (0, 0, 0)), np.float64) + max(0.0, now - thing.time) * np.array(
        shape.get("velocity", (0, 0, 0)), np.float64
    )
    wxyz = shape.get("wxyz", (1, 0, 0, 0))
    paint = Color(r=colour[0], g=colour[1], b=colour[2], a=colour[3])
    if kind in ("point", "sphere", "ellipsoid", "n_ellipsoid"):
        half = (a, a, a) if kind == "sphere" else (0.005,) * 3 if kind == "point" else (a, b, c)
        _solid(entity.spheres.add(color=paint), p, wxyz, [2 * v for v in half])
    elif kind in ("segment", "capsule"):
        radius = max(a, 0.003)
        R = _rotation(wxyz)
        _solid(
            entity.cylinders.add(color=paint, bottom_scale=1.0, top_scale=1.0), p, wxyz, [2 * radius, 2 * radius, 2 * b]
        )
        for end in (-b, b):
            _solid(entity.spheres.add(color=paint), p + R[:, 2] * end, wxyz, [2 * radius] * 3)
    elif kind in ("cylinder", "n_cylinder"):
        size = [2 * a, 2 * a, 2 * b] if kind == "cylinder" else [2 * a, 2 * b, 2 * c]
        _solid(entity.cylinders.add(color=paint, bottom_scale=1.0, top_scale=1.0), p, wxyz, size)
    elif kind == "cone":
        wide = max(a, b, 1e-6)
        solid = entity.cylinders.add(color=paint, bottom_scale=a / wide, top_scale=b / wide)
        _solid(solid, p, wxyz, [2 * wide, 2 * wide, 2 * c])
    elif kind == "box":
        _solid(entity.cubes.add(color=paint), p, wxyz, [2 * a, 2 * b, 2 * c])
    elif kind == "plane":
        _solid(entity.cubes.add(color=paint), p - _rotation(wxyz)[:, 2] * 0.001, wxyz, [3.0, 3.0, 0.002])
    text = entity.texts.add(text=str(shape.get("name", "")), billboard=True, font_size=0.03, scale_invariant=False)
    text.color.CopyFrom(Color(r=0.9, g=0.9, b=0.9, a=1.0))
    _put(text.pose, p, wxyz)


def _solid(primitive: Any, position: F64, wxyz: Any, size: Sequence[float]) -> None:
    _put(primitive.pose, position, wxyz)
    primitive.size.x, primitive.size.y, primitive.size.z = size


def _put(pose: Any, position: Any, wxyz: Any) -> None:
    pose.position.x, pose.position.y, pose.position.z = (float(v) for v in position)
    o = pose.orientation
    o.w, o.x, o.y, o.z = (float(v) for v in wxyz)


def _entity(message: Any, name: str, stamp: int) -> Any:
    entity = message.entities.add(id=name, frame_id=WORLD)
    _stamp(entity.timestamp, stamp)
    return entity


def _stamp(target: Any, stamp: int) -> None:
    target.seconds, target.nanos = stamp // 1_000_000_000, stamp % 1_000_000_000


def _pose(about: Any) -> F64:
    X = np.eye(4)
    if isinstance(about, dict):
        X[:3, :3], X[:3, 3] = _rotation(about.get("wxyz", (1, 0, 0, 0))), about.get("position", (0, 0, 0))
    return X


def _numbers(text: str | None) -> F64:
    try:
        values = np.array((text or "0 0 0").split(), np.float64)
    except ValueError:
        values = np.zeros(3)
    return values if values.shape == (3,) else np.zeros(3)


def _json(text: "str | bytes") -> dict[str, Any]:
    try:
        value = json.loads(text or "{}")
    except (ValueError, RecursionError):
        value = {}
    return value if isinstance(value, dict) else {}

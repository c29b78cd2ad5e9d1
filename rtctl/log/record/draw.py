"""Primitives of the foxglove schemas: what 3D viewers draw."""

import math
from collections.abc import Iterable, Sequence
from typing import TypeAlias

import numpy as np
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.CubePrimitive_pb2 import CubePrimitive
from foxglove_schemas_protobuf.CylinderPrimitive_pb2 import CylinderPrimitive
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from foxglove_schemas_protobuf.SpherePrimitive_pb2 import SpherePrimitive
from google.protobuf.timestamp_pb2 import Timestamp

from rtctl.plain import Json
from rtctl.types import F64

Solid: TypeAlias = SpherePrimitive | CubePrimitive | CylinderPrimitive
Colour = tuple[float, float, float, float]

WORLD = "world"
GREY: Colour = (0.6, 0.6, 0.65, 0.55)
BLUE: Colour = (0.25, 0.45, 0.9, 0.7)
GREEN: Colour = (0.2, 0.75, 0.35, 0.9)
RED: Colour = (0.9, 0.2, 0.2, 1.0)
WHITE: Colour = (0.9, 0.9, 0.9, 1.0)
SHEER = 0.3  # of a plane's colour: what is behind it is seen


def rotation(wxyz: Iterable[float]) -> F64:
    """Return the rotation (3, 3) of a unit quaternion."""
    w, x, y, z = (float(v) for v in wxyz)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion(R: F64) -> tuple[float, float, float, float]:
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


def along(direction: F64) -> tuple[float, float, float, float]:
    """Return wxyz that turns x to a unit vector."""
    x, y, z = direction.tolist()
    if x < -0.999999:
        return 0.0, 0.0, 0.0, 1.0
    w = 1.0 + x
    size = math.sqrt(w * w + y * y + z * z)
    return w / size, 0.0, -z / size, y / size


def obstacle(entity: SceneEntity, shape: Json, boxes: F64, elapsed: float, colour: Colour) -> None:
    """Add the primitives of one obstacle, `elapsed` [s] after it was where its shape says.

    boxes (k, 6) [m]: least and greatest x y z in its frame, for a mesh or a cloud.
    """
    kind = str(shape.get("type", ""))
    a, b, c = (float(v) for v in [*shape.get("dims", ()), 0.0, 0.0, 0.0][:3])
    p = np.array(shape.get("position", (0, 0, 0)), np.float64)
    p += max(0.0, elapsed) * np.array(shape.get("velocity", (0, 0, 0)), np.float64)
    wxyz = shape.get("wxyz", (1, 0, 0, 0))
    paint = paint_of(colour)
    if kind in ("point", "sphere", "ellipsoid", "n_ellipsoid"):
        half = (a, a, a) if kind == "sphere" else (0.005,) * 3 if kind == "point" else (a, b, c)
        solid(entity.spheres.add(color=paint), p, wxyz, [2 * v for v in half])
    elif kind in ("segment", "capsule"):
        radius = max(a, 0.003)
        R = rotation(wxyz)
        trunk = entity.cylinders.add(color=paint, bottom_scale=1.0, top_scale=1.0)
        solid(trunk, p, wxyz, [2 * radius, 2 * radius, 2 * b])
        for end in (-b, b):
            solid(entity.spheres.add(color=paint), p + R[:, 2] * end, wxyz, [2 * radius] * 3)
    elif kind in ("cylinder", "n_cylinder"):
        size = [2 * a, 2 * a, 2 * b] if kind == "cylinder" else [2 * a, 2 * b, 2 * c]
        solid(entity.cylinders.add(color=paint, bottom_scale=1.0, top_scale=1.0), p, wxyz, size)
    elif kind == "cone":
        wide = max(a, b, 1e-6)
        one = entity.cylinders.add(color=paint, bottom_scale=a / wide, top_scale=b / wide)
        solid(one, p, wxyz, [2 * wide, 2 * wide, 2 * c])
    elif kind == "box":
        solid(entity.cubes.add(color=paint), p, wxyz, [2 * a, 2 * b, 2 * c])
    elif kind == "plane":
        paint.a *= SHEER
        solid(entity.cubes.add(color=paint), p - rotation(wxyz)[:, 2] * 0.001, wxyz, [3.0, 3.0, 0.002])
    for low, high in zip(boxes[:, :3], boxes[:, 3:], strict=True):
        solid(entity.cubes.add(color=paint), p + rotation(wxyz) @ (0.5 * (low + high)), wxyz, (high - low).tolist())
    text = entity.texts.add(text=str(shape.get("name", "")), billboard=True, font_size=0.05, scale_invariant=False)
    text.color.CopyFrom(paint_of(WHITE))
    put(text.pose, p, wxyz)


def ball(entity: SceneEntity, centre: Iterable[float], radius: float, colour: Colour) -> None:
    """Add a sphere."""
    solid(entity.spheres.add(color=paint_of(colour)), centre, (1.0, 0.0, 0.0, 0.0), [2.0 * radius] * 3)


def disc(entity: SceneEntity, centre: Iterable[float], radius: float, height: float, colour: Colour) -> None:
    """Add an upright cylinder."""
    one = entity.cylinders.add(color=paint_of(colour), bottom_scale=1.0, top_scale=1.0)
    solid(one, centre, (1.0, 0.0, 0.0, 0.0), [2.0 * radius, 2.0 * radius, height])


def arrow(
    entity: SceneEntity, start: Iterable[float], direction: F64, length: float, colour: Colour, thick: float = 0.012
) -> None:
    """Add an arrow along a unit vector."""
    head = 2.5 * thick
    one = entity.arrows.add(shaft_diameter=thick, head_diameter=head, head_length=head, shaft_length=length)
    one.color.CopyFrom(paint_of(colour))
    put(one.pose, start, along(direction))


def strip(entity: SceneEntity, corners: F64, thick: float, colour: Colour) -> None:
    """Add a line through corners (k, 3)."""
    one = entity.lines.add(type=0, thickness=thick, color=paint_of(colour))
    one.pose.orientation.w = 1.0
    for x, y, z in corners.tolist():
        one.points.add(x=x, y=y, z=z)


def solid(primitive: Solid, position: Iterable[float], wxyz: Iterable[float], size: Sequence[float]) -> None:
    """Give a primitive its pose and its whole extents [m]."""
    put(primitive.pose, position, wxyz)
    primitive.size.x, primitive.size.y, primitive.size.z = size


def put(pose: Pose, position: Iterable[float], wxyz: Iterable[float]) -> None:
    pose.position.x, pose.position.y, pose.position.z = (float(v) for v in position)
    o = pose.orientation
    o.w, o.x, o.y, o.z = (float(v) for v in wxyz)


def paint_of(colour: Colour) -> Color:
    return Color(r=colour[0], g=colour[1], b=colour[2], a=colour[3])


def entity_of(message: SceneUpdate, name: str, ns: int, frame: str = WORLD) -> SceneEntity:
    """Add an entity to a SceneUpdate at log_time `ns`: it replaces the one of that name."""
    entity: SceneEntity = message.entities.add(id=name, frame_id=frame, frame_locked=frame != WORLD)
    stamped(entity.timestamp, ns)
    return entity


def frame(message: FrameTransforms, ns: int, parent: str, child: str, X: F64) -> None:
    """Add to FrameTransforms where (4, 4) a frame is in its parent."""
    one = message.transforms.add(parent_frame_id=parent, child_frame_id=child)
    stamped(one.timestamp, ns)
    one.translation.x, one.translation.y, one.translation.z = X[:3, 3].tolist()
    one.rotation.w, one.rotation.x, one.rotation.y, one.rotation.z = quaternion(X[:3, :3])


def stamped(target: Timestamp, ns: int) -> None:
    target.seconds, target.nanos = ns // 1_000_000_000, ns % 1_000_000_000

"""Obstacles as triangles in their own frame, for drawing; `dims` mean what `rtctl.world.primitives` says."""

from typing import NamedTuple

import numpy as np
import trimesh

from rtctl.plain import Json
from rtctl.types import F64, I64

PLANE = 1.5  # [m] half the side of the piece of a plane that is drawn
POINT = 0.008  # [m] radius of what has none
FINE = 3  # subdivisions of an icosphere


class Triangles(NamedTuple):
    """A surface."""

    vertices: F64  # (v, 3) [m]
    faces: I64  # (f, 3)


def triangles(shape: Json, boxes: F64, grown: float = 0.0) -> Triangles | None:
    """Return the surface of an obstacle, `grown` [m] outwards; None for a type that is not known.

    boxes (k, 6) [m]: least and greatest x y z, for a mesh or a cloud, whose own triangles a log does not tell here.
    """
    kind = str(shape.get("type", ""))
    a, b, c, n = (float(v) for v in [*shape.get("dims", ()), 0.0, 0.0, 0.0, 0.0][:4])
    if kind in ("point", "sphere"):
        return ball((a or POINT) + grown)
    if kind in ("segment", "capsule"):
        return _of(trimesh.creation.capsule(height=2 * b, radius=max(a, POINT) + grown))
    if kind == "cylinder":
        return _grown(_of(trimesh.creation.cylinder(radius=a, height=2 * b, sections=48)), grown)
    if kind == "cone":
        return _grown(_frustum(a, b, c), grown)
    if kind == "box":
        return _grown(_of(trimesh.creation.box(extents=(2 * a, 2 * b, 2 * c))), grown, rounded=False)
    if kind == "plane":
        return _of(trimesh.creation.box(extents=(2 * PLANE, 2 * PLANE, 0.002)), shift=grown - 0.001)
    if kind in ("ellipsoid", "n_ellipsoid", "n_cylinder"):
        return _grown(_superquadric(kind, np.array([a, b, c]), n or 1.0), grown)
    if len(boxes):
        return _joined([_box(low - grown, high + grown) for low, high in zip(boxes[:, :3], boxes[:, 3:], strict=True)])
    return None


def ball(radius: float, fine: int = FINE) -> Triangles:
    """Return a sphere [m] about the origin."""
    return _of(trimesh.creation.icosphere(subdivisions=fine, radius=radius))


def _of(mesh: trimesh.Trimesh, shift: float = 0.0) -> Triangles:
    vertices = np.array(mesh.vertices, np.float64)
    vertices[:, 2] += shift
    return Triangles(vertices, np.array(mesh.faces, np.int64))


def _superquadric(kind: str, half: F64, n: float) -> Triangles:
    """Return (x/a)^2p + (y/b)^2p + (z/c)^2r = 1: directions of a sphere, each as far out as the surface is."""
    unit = ball(1.0, FINE + 1)
    p, r = (n if kind == "n_ellipsoid" else 1.0), (1.0 if kind == "ellipsoid" else n)
    d = np.abs(unit.vertices)
    low, high = np.zeros(len(d)), np.full(len(d), 2.0)  # the factor lies between: |d| = 1, so one of d is over 1/2
    for _ in range(40):
        s = 0.5 * (low + high)
        inside = (s * d[:, 0]) ** (2 * p) + (s * d[:, 1]) ** (2 * p) + (s * d[:, 2]) ** (2 * r) < 1.0
        low, high = np.where(inside, s, low), np.where(inside, high, s)
    return Triangles(unit.vertices * low[:, None] * half, unit.faces)


def _frustum(bottom: float, top: float, half: float) -> Triangles:
    """Return a cone's frustum along z; either radius [m] may be 0."""
    angle = np.linspace(0.0, 2.0 * np.pi, 48, endpoint=False)
    ring = np.column_stack([np.cos(angle), np.sin(angle)])
    k = len(ring)
    vertices = np.zeros((2 * k + 2, 3))
    vertices[:k, :2], vertices[k : 2 * k, :2] = bottom * ring, top * ring
    vertices[:k, 2], vertices[k : 2 * k, 2], vertices[2 * k, 2], vertices[2 * k + 1, 2] = -half, half, -half, half
    i = np.arange(k)
    j = (i + 1) % k
    sides = [np.column_stack([i, j, k + i]), np.column_stack([j, k + j, k + i])]
    ends = [np.column_stack([j, i, np.full(k, 2 * k)]), np.column_stack([k + i, k + j, np.full(k, 2 * k + 1)])]
    return Triangles(vertices, np.vstack(sides + ends))


def _grown(body: Triangles, by: float, rounded: bool = True) -> Triangles:
    """Return a convex body whose surface lies `by` [m] further out; edges are not rounded where that shows little."""
    if by == 0.0:
        return body
    if not rounded:
        return Triangles(body.vertices + by * np.sign(body.vertices), body.faces)
    mesh = trimesh.Trimesh(body.vertices, body.faces, process=False)
    around = ball(by, 1).vertices
    hull = trimesh.convex.convex_hull((mesh.vertices[:, None] + around).reshape(-1, 3))
    return _of(hull)


def _box(low: F64, high: F64) -> Triangles:
    body = _of(trimesh.creation.box(extents=np.maximum(high - low, 1e-4)))
    return Triangles(body.vertices + 0.5 * (low + high), body.faces)


def _joined(parts: list[Triangles]) -> Triangles:
    at = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = [part.faces + start for part, start in zip(parts, at, strict=False)]
    return Triangles(np.vstack([part.vertices for part in parts]), np.vstack(faces))

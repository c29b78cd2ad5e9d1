"""Collision geometry of an arm as convex pieces that every program reads: boxes, balls, cylinders, hulls as STL."""

import struct
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import coal
import numpy as np
import pinocchio as pin
from scipy.spatial import ConvexHull, QhullError

from rtctl.design.solids import REACH, _corners
from rtctl.errors import ConfigError
from rtctl.intake.body import Arm
from rtctl.types import F64, I64

CORNERS_MAX = 120  # of a hull: what has more is put into one with fewer faces that contains it
DIRECTIONS = 96
THIN = 5e-4  # [m] half the thickness that a flat mesh is given


class Piece(NamedTuple):
    """A convex piece on a link."""

    joint: int  # Pinocchio's
    frame: str  # that it belongs to
    placement: pin.SE3  # in the joint's frame
    corners: F64  # (v, 3) [m] in the piece's frame
    faces: I64  # (f, 3)
    primitive: str  # URDF's element for a box, ball or cylinder, '' for a hull


def pieces(arm: Arm, told: list[str], scale: float = 1.0) -> list[Piece]:
    """Return the pieces of an arm's collision geometry; links that have none are given the hulls of what one sees.

    scale: of the shapes; where they are is scaled already.
    """
    made = _piece(arm.model, scale)
    found = [p for p in map(made, arm.collision.geometryObjects) if p is not None]
    bare = [j for j in range(arm.model.njoints) if j not in {p.joint for p in found}]
    seen = [g for g in arm.visual.geometryObjects if int(g.parentJoint) in bare]
    filled = [p for p in map(made, seen) if p is not None]
    if filled:
        names = sorted({arm.model.names[p.joint] if p.joint else "the base" for p in filled})
        told.append(f"no collision geometry at {', '.join(names[:4])}: hulls of the visual meshes are taken")
    return [*found, *filled]


def _piece(model: pin.Model, scale: float) -> Callable[[pin.GeometryObject], Piece | None]:
    def made(thing: pin.GeometryObject) -> Piece | None:
        shape = thing.geometry
        if isinstance(shape, coal.Plane | coal.Halfspace):
            return None
        try:
            corners = scale * _points(shape, str(thing.name))
        except ConfigError:
            return None
        if len(corners) < 4 or not (np.abs(corners) <= REACH).all():
            return None
        name = model.frames[thing.parentFrame].name
        corners, faces = hull(corners)
        return Piece(int(thing.parentJoint), name, thing.placement, corners, faces, _primitive(shape, scale))

    return made


def _points(shape: coal.CollisionGeometry, name: str) -> F64:
    if isinstance(shape, coal.Ellipsoid):
        ball: F64 = _corners(coal.Sphere(1.0), name)
        return np.asarray(ball * np.array(shape.radii))
    corners: F64 = _corners(shape, name)
    return corners


def _primitive(shape: coal.CollisionGeometry, scale: float) -> str:
    if isinstance(shape, coal.Box):
        size = " ".join(f"{2.0 * scale * float(h):.9g}" for h in shape.halfSide)
        return f'<box size="{size}"/>'
    if isinstance(shape, coal.Sphere):
        return f'<sphere radius="{scale * shape.radius:.9g}"/>'
    if isinstance(shape, coal.Cylinder):
        return f'<cylinder radius="{scale * shape.radius:.9g}" length="{2.0 * scale * shape.halfLength:.9g}"/>'
    return ""


def hull(points: F64) -> tuple[F64, I64]:
    """Return corners and faces of a convex hull of points, one with few faces that contains it where it has many."""
    points = np.unique(np.round(points, 6), axis=0)
    try:
        whole = ConvexHull(points)
    except QhullError:  # flat: given a thickness
        centre = points.mean(axis=0)
        normal = np.linalg.svd(points - centre)[2][2]
        points = np.concatenate([points + THIN * normal, points - THIN * normal])
        whole = ConvexHull(points, qhull_options="QJ")
    corners: F64 = points[whole.vertices]
    if len(corners) > CORNERS_MAX:
        corners = _simpler(corners)
    final = ConvexHull(corners, qhull_options="QJ" if len(corners) < 5 else "Qt")
    return _outward(corners, final)


def _simpler(corners: F64) -> F64:
    """Return the corners of a polyhedron with few faces that contains the hull of `corners`."""
    k = np.arange(DIRECTIONS) + 0.5
    polar, turn = np.arccos(1.0 - 2.0 * k / DIRECTIONS), np.pi * (1.0 + 5.0**0.5) * k
    d = np.stack([np.cos(turn) * np.sin(polar), np.sin(turn) * np.sin(polar), np.cos(polar)], axis=1)
    chosen = np.unique(np.argmax(d @ corners.T, axis=1))
    inner = ConvexHull(corners[chosen])
    beyond = (corners @ inner.equations[:, :3].T + inner.equations[:, 3]).max()
    centre = corners[chosen].mean(axis=0)
    depth = -(inner.equations[:, :3] @ centre + inner.equations[:, 3]).max()
    if depth < 1e-3:
        return corners
    out: F64 = centre + (corners[chosen] - centre) * (1.0 + (max(beyond, 0.0) + 1e-6) / depth)
    return out


def _outward(corners: F64, found: ConvexHull) -> tuple[F64, I64]:
    """Return corners and faces with the corners of each face counter-clockwise from outside."""
    faces = found.simplices.astype(np.int64).copy()
    a, b, c = (corners[faces[:, k]] for k in range(3))
    flipped = np.einsum("ij,ij->i", np.cross(b - a, c - a), found.equations[:, :3]) < 0.0
    faces[flipped] = faces[flipped][:, [0, 2, 1]]
    return corners, faces


def write_stl(path: Path, corners: F64, faces: I64) -> None:
    """Write a binary STL."""
    a, b, c = (corners[faces[:, k]] for k in range(3))
    n = np.cross(b - a, c - a)
    n /= np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1e-12)
    rows = np.zeros(len(faces), np.dtype([("v", "<f4", (4, 3)), ("rest", "<u2")]))
    rows["v"] = np.stack([n, a, b, c], axis=1)
    path.write_bytes(b"rtctl init".ljust(80) + struct.pack("<I", len(faces)) + rows.tobytes())


def volume(corners: F64, faces: I64) -> float:
    """Return the volume [m3] of a convex polyhedron."""
    a, b, c = (corners[faces[:, k]] for k in range(3))
    return float(abs(np.einsum("ij,ij->i", a, np.cross(b, c)).sum()) / 6.0)

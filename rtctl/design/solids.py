"""Collision geometry as convex pieces: their corners, faces, depth below the surface.

A mesh is taken by its hull, which is also what physics engines collide with. A round shape is replaced by a
polyhedron that contains it, a little larger: 1.7 % for a sphere.
"""

import math
from collections.abc import Sequence
from importlib.metadata import version
from typing import NamedTuple

import coal
import numpy as np

from rtctl.arm.rigid_body import RigidBody
from rtctl.design import kept
from rtctl.errors import ConfigError
from rtctl.types import F64, I64

EDGE = 0.012  # [m] longest edge of a surface triangle
REACH = 5.0  # [m] of a link's geometry from its joint: millimetres taken for metres lie beyond
STEP = 1e-5  # [m] lengths are rounded to it, so that rounding errors cannot change a choice
_SIDES = 24  # of the polygons that stand for circles


class Solid(NamedTuple):
    """One convex piece of collision geometry in the frame of the joint that carries it."""

    link: int
    name: str  # URDF link
    corners: F64  # (v, 3) [m]
    faces: I64  # (f, 3) corner indices
    planes: F64  # (p, 4) outward unit normal and offset: n.x + d <= 0 inside


def solids_of(body: RigidBody) -> list[Solid]:
    """Return the convex pieces of the collision geometry, in the order of the URDF."""
    things, corners = list(body.geometry.geometryObjects), list[F64]()
    for thing in things:
        X = thing.placement
        corners.append(_corners(thing.geometry, str(thing.name)) @ np.array(X.rotation).T + np.array(X.translation))
        if not (np.abs(corners[-1]) <= REACH).all():
            got = f"a corner {np.abs(corners[-1]).max():.4g} m from its joint"
            raise ConfigError(f"collision geometry {thing.name}", got, f"at most {REACH:g} m")
    hulls = _hulls([str(thing.name) for thing in things], corners)
    return [
        Solid(body.link_of[thing.parentJoint], body.model.frames[thing.parentFrame].name, each, *hull)
        for thing, each, hull in zip(things, corners, hulls, strict=True)
    ]


def _hulls(names: Sequence[str], corners: Sequence[F64]) -> list[tuple[I64, F64]]:
    """Return triangles (f, 3) and planes (f, 4) of the hull of each set of corners (v, 3) [m]."""
    path = kept.place_of("hulls", f"scipy {version('scipy')}", corners, __name__, __file__)
    said = kept.known(path)
    if said is not None and set(said) == {"faces", "planes"} and len(said["faces"]) == len(corners):
        return [(np.array(f, np.int64), np.array(p)) for f, p in zip(said["faces"], said["planes"], strict=True)]
    from scipy.spatial import ConvexHull, QhullError  # see rtctl.world.meshes

    found: list[tuple[I64, F64]] = []
    for name, each in zip(names, corners, strict=True):
        try:
            hull = ConvexHull(each)
        except QhullError:
            raise ConfigError(f"collision geometry {name}", "a flat or degenerate mesh", "a solid") from None
        found.append((hull.simplices.astype(np.int64), hull.equations.copy()))
    kept.note(path, {"faces": [f.tolist() for f, _ in found], "planes": [p.tolist() for _, p in found]})
    return found


def _corners(shape: coal.CollisionGeometry, name: str) -> F64:
    """Return the corners of a polyhedron that contains a collision shape (itself, for a flat-faced one)."""
    if isinstance(shape, coal.BVHModelBase):
        return np.array(shape.vertices(), dtype=np.float64)
    if isinstance(shape, coal.ConvexBase):
        return np.array(shape.points(), dtype=np.float64)
    if isinstance(shape, coal.Box):
        signs = np.array([(i, j, k) for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)], dtype=np.float64)
        return np.asarray(signs * np.array(shape.halfSide))
    if isinstance(shape, coal.Sphere):
        return _ball(shape.radius)
    if isinstance(shape, coal.Capsule):
        return _at_both_ends(_ball(shape.radius), shape.halfLength)
    if isinstance(shape, coal.Cylinder):
        return _at_both_ends(_ring(shape.radius), shape.halfLength)
    raise ConfigError(f"collision geometry {name}", type(shape).__name__, "a mesh, box, sphere, capsule or cylinder")


def _at_both_ends(corners: F64, half_length: float) -> F64:
    """Return corners shifted along z to both ends of an axis: their hull is the shape swept along it."""
    shift = np.array([0.0, 0.0, half_length])
    return np.concatenate([corners - shift, corners + shift])


def _ring(radius: float) -> F64:
    """Return a regular polygon circumscribed about a circle in the xy plane."""
    t = np.arange(_SIDES) * (2.0 * math.pi / _SIDES)
    return np.column_stack([np.cos(t), np.sin(t), np.zeros(_SIDES)]) * (radius / math.cos(math.pi / _SIDES))


def _ball(radius: float) -> F64:
    """Return the corners of a polyhedron around a sphere: rings on the circles of latitude, and the poles."""
    grow = 1.0 / math.cos(math.pi / _SIDES)
    rows = [np.array([[0.0, 0.0, z * radius * grow]]) for z in (-1.0, 1.0)]
    for k in range(1, _SIDES // 2):
        phi = 2.0 * math.pi * k / _SIDES
        rows.append(_ring(radius * grow * math.sin(phi)) + np.array([0.0, 0.0, radius * grow * math.cos(phi)]))
    return np.concatenate(rows)


def surface(solid: Solid, edge: float = EDGE) -> tuple[F64, I64]:
    """Return a solid's surface as small triangles: samples (s, 3) and their indices (t, 3)."""
    triangles = solid.corners[solid.faces]  # (t, 3 corners, 3)
    done = []
    while len(triangles):
        edges = np.linalg.norm(triangles[:, [1, 2, 0]] - triangles, axis=2)
        long = edges.max(axis=1) > edge
        done.append(triangles[~long])
        triangles, edges = triangles[long], edges[long]
        # turn each so that its longest edge is corner 0 to corner 1, then halve that edge
        first = np.argmax(edges, axis=1)
        rows = np.arange(len(triangles))
        p, q, r = (triangles[rows, (first + k) % 3] for k in range(3))
        middle = 0.5 * (p + q)
        triangles = np.concatenate([np.stack([p, middle, r], axis=1), np.stack([middle, q, r], axis=1)])
    split = np.concatenate(done).reshape(-1, 3)
    # numpy's unique of rows takes four times as long: it compares them as records
    order = np.lexsort((split[:, 2], split[:, 1], split[:, 0]))
    ordered = split[order]
    new = np.append(True, (ordered[1:] != ordered[:-1]).any(axis=1))
    index = np.empty(len(split), np.int64)
    index[order] = np.cumsum(new) - 1
    return ordered[new], index.reshape(-1, 3)


def areas(samples: F64, triangles: I64) -> F64:
    p, q, r = (samples[triangles[:, k]] for k in range(3))
    return np.asarray(0.5 * np.linalg.norm(np.cross(q - p, r - p), axis=1))


def depth(solid: Solid, p: F64) -> F64:
    """Return how deep points lie below a convex surface [m]: exact inside, negative outside."""
    below: F64 = np.full(len(p), np.inf)
    for nx, ny, nz, d in solid.planes:
        np.minimum(below, -(p[:, 0] * nx + p[:, 1] * ny + p[:, 2] * nz + d), out=below)
    return below

"""Obstacles as a structure of arrays, and the true distances of points to them (Khatib 1986, analytic primitives).

Meaning of `dims` by type, lengths in [m], frame at the centre of the primitive:

    point                                        a sphere of radius 0
    sphere       radius
    segment      0 or radius, half length        along local z
    capsule      radius, half length             along local z, hemispheres beyond the half length
    cylinder     radius, half length             along local z
    cone         r_bottom, r_top, half height    along local z, either radius may be 0
    box          half sizes x, y, z
    plane                                        local z = 0; the half-space below is solid
    ellipsoid    a, b, c                         semi-axes
    n_ellipsoid  a, b, c, n                      (x/a)^2n + (y/b)^2n + (z/c)^2n = 1, 1 <= n <= 50
    n_cylinder   a, b, c, n                      (x/a)^2 + (y/b)^2 + (z/c)^2n = 1
    mesh         none                            a closed surface of triangles, `shape.mesh` among the robot's meshes
    cloud        radius, step                    balls about points that lie at whole steps, `shape.cloud`

Everything is pure: editing returns new arrays. Kernels are compiled and valid as plain Python.
"""

import math
from typing import NamedTuple

import numpy as np

from rtctl.kernel import kernel, leaf_kernel
from rtctl.kernel.rotations import R_of, compose, exp3
from rtctl.types import B1, F64, I64, Shape
from rtctl.world import distance as exact
from rtctl.world import meshes, rooms, tree
from rtctl.world.meshes import Meshes
from rtctl.world.rooms import Rooms, fault_of_room, room_of
from rtctl.world.superquadric import n_surface

SPHERE, CAPSULE, PLANE, BOX, CONE, SUPERQUADRIC, MESH, CLOUD = range(8)

# type -> (kind, number of dims that count, how many of those may be zero, from the left)
_TYPES: dict[str, tuple[int, int, int]] = {
    "point": (SPHERE, 0, 0),
    "sphere": (SPHERE, 1, 0),
    "segment": (CAPSULE, 2, 1),
    "capsule": (CAPSULE, 2, 0),
    "cylinder": (CONE, 2, 0),
    "cone": (CONE, 3, 2),
    "box": (BOX, 3, 0),
    "plane": (PLANE, 0, 0),
    "ellipsoid": (SUPERQUADRIC, 3, 0),
    "n_ellipsoid": (SUPERQUADRIC, 4, 0),
    "n_cylinder": (SUPERQUADRIC, 4, 0),
    "mesh": (MESH, 0, 0),
    "cloud": (CLOUD, 1, 1),
}
TYPES = tuple(_TYPES)
NUMBERS = (("position", 3), ("wxyz", 4), ("velocity", 3), ("omega", 3), ("dims", 4))  # arrays of a Shape
SIZE_MIN, SIZE_MAX = 1e-4, 100.0  # [m] of a dimension that must not be zero
LARGEST = 1e4  # [m, m/s, rad/s] of any number: squares of larger ones could overflow
N_MAX = 50.0  # edges of a 2n = 100 surface are round to 2 % of its size; beyond that use the box
CLOUDS = 4  # there may be at once
CLOUD_POINTS = 10_000  # of one cloud: what fits one message of 64 KiB
STEP_MIN, STEP_MAX = 1e-6, 0.01  # [m] of a cloud's coordinates
_SLACK = 1e-9  # [m] and relative: far above the rounding and solver errors of any distance


class Obstacles(NamedTuple):
    """K slots of posed, moving primitives; an inactive slot is as if it were not there."""

    kind: I64  # (K,)
    active: B1  # (K,)
    R: F64  # (K, 3, 3) orientation in the world
    p: F64  # (K, 3) [m] position
    v: F64  # (K, 3) [m/s] of p
    w: F64  # (K, 3) [rad/s]
    dims: F64  # (K, 5) by kind: as in Shape; superquadrics (a, b, c, exponent of x and y, exponent of z);
    # meshes (0, 0, reach, start in `mesh`, 0), clouds (radius, 0, reach, index in `clouds`, 0)
    group: I64  # (K,) equal: parts of one union, the nearest counts; different: forces add
    margin: F64  # (K,) [m] by which the surface is taken to be nearer: what an old observation does not know
    room: F64  # (K, 4) [m] influence and clearance of its own, and of the config; see `rooms`
    mesh: F64  # bodies of `bvh`, those of the robot: never changes
    clouds: tuple[F64, F64, F64, F64]  # bodies of `bvh`; a new cloud is a new array in its place


def obstacles_empty(slots: int, known: Meshes = meshes.NONE) -> Obstacles:
    """Return K = `slots` inactive slots; `known` are the meshes that shapes may refer to."""
    return Obstacles(
        np.zeros(slots, np.int64),
        np.zeros(slots, np.bool_),
        np.tile(np.eye(3), (slots, 1, 1)),
        np.zeros((slots, 3)),
        np.zeros((slots, 3)),
        np.zeros((slots, 3)),
        np.ones((slots, 5)),
        np.arange(slots),
        np.zeros(slots),
        np.zeros((slots, 4)),
        known.data,
        (np.zeros(0), np.zeros(0), np.zeros(0), np.zeros(0)),
    )


def fault_of(shape: Shape, known: Meshes = meshes.NONE, of_all: Rooms = rooms.NONE) -> str:
    """Return what is wrong with a shape as one line that names the field, or "" when it can be used."""
    if shape.type not in _TYPES:
        return f"type: got {shape.type!r}, wanted one of {', '.join(TYPES)}"
    for name, count in NUMBERS:
        if fault := fault_of_numbers(name, getattr(shape, name), count):
            return fault
    if abs(math.hypot(*shape.wxyz) - 1.0) > 1e-3:
        return f"wxyz: got {shape.wxyz}, wanted a unit quaternion"
    if shape.type == "mesh" and shape.mesh not in known.names:
        return f"mesh: got {shape.mesh!r}, wanted one of the config's: {', '.join(known.names) or 'it has none'}"
    if shape.type == "cloud" and not (0 < len(shape.cloud) <= 6 * CLOUD_POINTS and len(shape.cloud) % 6 == 0):
        return f"cloud: got {len(shape.cloud)} bytes, wanted 6 for each of 1 to {CLOUD_POINTS} points"
    if shape.type == "cloud" and not STEP_MIN <= shape.dims[1] <= STEP_MAX:
        return f"dims[1]: got a step of {shape.dims[1]} m, wanted {STEP_MIN} to {STEP_MAX}"
    if found := fault_of_room(shape.influence, shape.clearance, of_all):
        return f"{found[0]}: got {found[1]:g}, wanted {found[2]}"
    return _fault_of_dims(shape)


def fault_of_numbers(name: str, value: F64, count: int) -> str:
    """Return what is wrong with an array of a shape as one line, or ""."""
    known = isinstance(value, np.ndarray) and value.shape == (count,)
    numbers = value.tolist() if known else [math.nan]  # a list of its own: ufuncs cost ten times as much
    if not all(map(math.isfinite, numbers)):
        return f"{name}: got {value}, wanted {count} finite numbers"
    if max(map(abs, numbers)) > LARGEST:
        return f"{name}: got {value}, wanted nothing beyond {LARGEST:g}"
    return ""


def _fault_of_dims(shape: Shape) -> str:
    """Return what is wrong with the dims of a known type, or ""."""
    _, count, zero = _TYPES[shape.type]
    for i, value in enumerate(shape.dims[: min(count, 3)].tolist()):
        least = 0.0 if i < zero else SIZE_MIN
        if not least <= value <= SIZE_MAX:
            return f"dims[{i}]: got {value} m, wanted {least} to {SIZE_MAX}"
    if shape.type == "cone" and max(shape.dims[:2]) < SIZE_MIN:
        return f"dims: got two radii of {max(shape.dims[:2])} m, wanted one of at least {SIZE_MIN}"
    if count == 4 and not 1.0 <= shape.dims[3] <= N_MAX:
        return f"dims[3]: got n = {shape.dims[3]}, wanted 1 to {N_MAX}"
    return ""


def _stored_dims(shape: Shape) -> tuple[float, float, float, float, float]:
    """Return the five numbers that the kernels use: cylinders are cones, points spheres, ellipsoids superquadrics."""
    a, b, c, n = (float(d) for d in shape.dims)
    match shape.type:
        case "point":
            return 0.0, 0.0, 0.0, 0.0, 0.0
        case "cylinder":
            return a, a, b, 0.0, 0.0
        case "ellipsoid":
            return a, b, c, 2.0, 2.0
        case "n_ellipsoid":
            return a, b, c, 2.0 * n, 2.0 * n
        case "n_cylinder":
            return a, b, c, 2.0, 2.0 * n
        case _:
            return a, b, c, 0.0, 0.0


def cloud_place(obstacles: Obstacles, slot: int) -> int:
    """Return which of the clouds one in `slot` would be: its own again, or the first that is free; -1 for none."""
    taken = obstacles.active & (obstacles.kind == CLOUD)
    if taken[slot]:
        return int(obstacles.dims[slot, 3])
    used = set(obstacles.dims[taken, 3].tolist())
    return next((i for i in range(CLOUDS) if i not in used), -1)


def with_shape(
    obstacles: Obstacles,
    slot: int,
    shape: Shape,
    group: int = -1,
    known: Meshes = meshes.NONE,
    of_all: Rooms = rooms.NONE,
) -> Obstacles:
    """Return the obstacles with `shape` in `slot`; `group` -1 = one of its own (the slot's index).

    known: the meshes that the obstacles were made with; of_all: influence and clearance without its own. Raises
    ValueError with `fault_of(shape)` on a shape that cannot be used, and on one cloud too many; ask first where that is
    a value.
    """
    fault = fault_of(shape, known, of_all)
    if fault or (shape.type == "cloud" and cloud_place(obstacles, slot) < 0):
        raise ValueError(fault or f"cloud: there are {CLOUDS} already")
    new = put_shape(copied(obstacles), slot, shape, known, of_all)
    new.group[slot] = slot if group < 0 else group
    new.margin[slot] = 0.0
    return new


def put_shape(new: Obstacles, slot: int, shape: Shape, known: Meshes, of_all: Rooms = rooms.NONE) -> Obstacles:
    """Write a shape without fault into a slot of arrays that are the caller's own; group and margin stay."""
    place = cloud_place(new, slot) if shape.type == "cloud" else 0
    new.kind[slot] = _TYPES[shape.type][0]
    new.active[slot] = True
    new.R[slot] = R_of(np.asarray(shape.wxyz, np.float64))
    new.p[slot] = shape.position
    new.v[slot] = shape.velocity
    new.w[slot] = shape.omega
    new.dims[slot] = _stored_dims(shape)
    new.room[slot] = room_of(shape.influence, shape.clearance, of_all)
    if shape.type == "mesh":
        start = known.start(shape.mesh)
        new.dims[slot] = 0.0, 0.0, known.data[start + 2], start, 0.0
    if shape.type == "cloud":
        body = tree.cloud_body(np.frombuffer(shape.cloud, "<i2"), float(shape.dims[1]))
        new.dims[slot] = shape.dims[0], 0.0, body[2], place, 0.0
        clouds = list(new.clouds)
        clouds[place] = body
        new = new._replace(clouds=(clouds[0], clouds[1], clouds[2], clouds[3]))
    return new


def copied(obstacles: Obstacles) -> Obstacles:
    """Return the same obstacles in arrays of their own."""
    o = obstacles
    return Obstacles(
        o.kind.copy(),
        o.active.copy(),
        o.R.copy(),
        o.p.copy(),
        o.v.copy(),
        o.w.copy(),
        o.dims.copy(),
        o.group.copy(),
        o.margin.copy(),
        o.room.copy(),
        o.mesh,
        o.clouds,
    )


def advance(obstacles: Obstacles, dt: float) -> Obstacles:
    """Return the obstacles moved on by their own velocities for dt [s]: p + v dt, exp(w dt) R."""
    p, R = advanced_pose(obstacles.active, obstacles.p, obstacles.R, obstacles.v, obstacles.w, dt)
    return obstacles._replace(p=p, R=R)


@kernel
def advanced_pose(active: B1, p: F64, R: F64, v: F64, w: F64, dt: float) -> tuple[F64, F64]:
    """Return new (p, R) of the active slots; the others are carried over."""
    p, R = p.copy(), R.copy()
    for k in range(active.shape[0]):
        if active[k]:
            for i in range(3):
                p[k, i] += v[k, i] * dt
            if w[k, 0] != 0.0 or w[k, 1] != 0.0 or w[k, 2] != 0.0:
                R[k] = compose(exp3(w[k] * dt), R[k])
    return p, R


@leaf_kernel
def speed_bound(obstacles: Obstacles) -> float:
    """Return a bound on the speed [m/s] of any surface point of any active obstacle; infinite for a turning plane."""
    bound, v, w = 0.0, obstacles.v, obstacles.w
    for k in range(obstacles.active.shape[0]):
        if obstacles.active[k]:
            speed = math.sqrt(v[k, 0] * v[k, 0] + v[k, 1] * v[k, 1] + v[k, 2] * v[k, 2])
            turn = math.sqrt(w[k, 0] * w[k, 0] + w[k, 1] * w[k, 1] + w[k, 2] * w[k, 2])
            if turn > 0.0:
                speed += math.inf if obstacles.kind[k] == PLANE else turn * _reach(obstacles.dims, k)
            bound = speed if not speed <= bound else bound
    return bound


@leaf_kernel
def _reach(dims: F64, k: int) -> float:
    """Return a radius about the frame that holds a primitive of any kind with these dims (the sum bounds them all)."""
    reach: float = dims[k, 0] + dims[k, 1] + dims[k, 2]
    return reach


@kernel
def _measure(P: F64, radius: F64, R: F64, p: F64, dims: F64, k: int, j: int, out: F64) -> None:
    """Write the true distance and normal of point j to the superquadric in slot k."""
    dx, dy, dz = P[0, j] - p[k, 0], P[1, j] - p[k, 1], P[2, j] - p[k, 2]
    x = dx * R[k, 0, 0] + dy * R[k, 1, 0] + dz * R[k, 2, 0]
    y = dx * R[k, 0, 1] + dy * R[k, 1, 1] + dz * R[k, 2, 1]
    z = dx * R[k, 0, 2] + dy * R[k, 1, 2] + dz * R[k, 2, 2]
    d, e, f, g = n_surface(x, y, z, dims[k, 0], dims[k, 1], dims[k, 2], dims[k, 3], dims[k, 4])
    out[k, 0, j] = d - radius[j]
    for i in range(3):
        out[k, 1 + i, j] = R[k, i, 0] * e + R[k, i, 1] * f + R[k, i, 2] * g


@kernel
def _superquadric(P: F64, radius: F64, R: F64, p: F64, dims: F64, k: int, cutoff: float, out: F64) -> None:
    """Distances to a superquadric behind a pre-filter: its bounding box, vectorised, is never farther than itself.

    The point nearest to the box is made exact first: its distance bounds the least one, so the least is exact always,
    and so is all that lies within the cut-off. An entry left as a lower bound is above both.
    """
    first, bound = -1, math.inf
    if np.isfinite(cutoff):
        exact.box(P, radius, R, p, dims, k, out)
        first = 0
        for j in range(radius.shape[0]):
            if out[k, 0, j] < out[k, 0, first]:
                first = j
        _measure(P, radius, R, p, dims, k, first, out)
        bound = max(cutoff, out[k, 0, first])
        bound += _SLACK * (1.0 + abs(bound))
    for j in range(radius.shape[0]):
        if j != first and (first < 0 or not out[k, 0, j] > bound):
            _measure(P, radius, R, p, dims, k, j, out)


@kernel
def _dear(P: F64, radius: F64, obstacles: Obstacles, k: int, cutoff: float, out: F64) -> None:
    """Distances to the kinds that ask their bounding box first."""
    R, p, dims = obstacles.R, obstacles.p, obstacles.dims
    if obstacles.kind[k] == MESH:
        tree.many(P, radius, R, p, k, tree.Body(obstacles.mesh, int(dims[k, 3]), 0.0), cutoff, out)
    elif obstacles.kind[k] == CLOUD:
        tree.many(P, radius, R, p, k, tree.Body(obstacles.clouds[int(dims[k, 3])], 0, dims[k, 0]), cutoff, out)
    else:
        _superquadric(P, radius, R, p, dims, k, cutoff, out)


@leaf_kernel
def distances_into(P: F64, radius: F64, obstacles: Obstacles, cutoff: float, out: F64) -> None:
    """Write the distances of points to every active obstacle, obstacle-outer, point-inner.

    The broad phase is in the kernels that are dear: superquadrics, meshes and clouds ask their bounding box first. For
    the others a test by ball would cost what a ball costs: 0.12 us for 50 points, a box 0.20, a cone 0.33.

    P: (>= 3, m) [m], a row per coordinate. radius: (m,) [m]. cutoff: [m]; a distance below it, and the least of each
    obstacle, is exact; above it a lower bound may stand (not for the simple kinds). Infinite: all are exact.
    out: (K, >= 4, m): row 0 rho [m], true distance to the surface minus radius and margin, negative inside, infinite
    for inactive slots; rows 1-3 the unit normal d rho/d p, outward also inside, untouched for inactive slots.
    """
    R, p, dims = obstacles.R, obstacles.p, obstacles.dims
    for k in range(obstacles.active.shape[0]):
        kind, margin = obstacles.kind[k], obstacles.margin[k]
        if not obstacles.active[k]:
            for j in range(radius.shape[0]):
                out[k, 0, j] = math.inf
            continue
        if kind == SPHERE:
            exact.sphere(P, radius, R, p, dims, k, out)
        elif kind == CAPSULE:
            exact.capsule(P, radius, R, p, dims, k, out)
        elif kind == PLANE:
            exact.plane(P, radius, R, p, k, out)
        elif kind == BOX:
            exact.box(P, radius, R, p, dims, k, out)
        elif kind == CONE:
            exact.cone(P, radius, R, p, dims, k, out)
        else:
            _dear(P, radius, obstacles, k, cutoff + margin, out)
        if margin > 0.0:
            for j in range(radius.shape[0]):
                out[k, 0, j] -= margin


def distances(P: F64, radius: F64, obstacles: Obstacles) -> tuple[F64, F64]:
    """Return exact (rho (K, m), normal (K, 3, m)) of points P (m, 3) [m] with radii (m,) [m]; see `distances_into`.

    For checks, plans and plots; the tick uses `distances_into`.
    """
    slots, m = obstacles.active.shape[0], P.shape[0]
    out = np.zeros((slots, 4, m))
    distances_into(np.ascontiguousarray(P.T), radius, obstacles, math.inf, out)
    return out[:, 0], out[:, 1:]


def distance(shape: Shape, P: F64, known: Meshes = meshes.NONE) -> tuple[F64, F64]:
    """Return exact (rho (m,), normal (m, 3)) of points P (m, 3) [m] to one shape; `known` are the robot's meshes."""
    there = with_shape(obstacles_empty(1, known), 0, shape._replace(influence=0.0, clearance=0.0), known=known)
    rho, normal = distances(P, np.zeros(P.shape[0]), there)
    return rho[0], np.ascontiguousarray(normal[0].T)

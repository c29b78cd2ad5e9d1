"""Obstacles of a scenario: where each is at a time, and a collision shape of it for pybullet.

Spheres, capsules, boxes and cylinders are pybullet's own shapes. The others become convex hulls of vertices that lie on
the surface, so a hull never reaches beyond the true shape: measured clearances are never too small, and too large by
at most `tolerance` (`HULL_TOLERANCE` of the largest semi-axis, held by a test). A mesh is pybullet's own reading of its
file: its triangles, hollow to the engine, or its hull. A cloud is a mesh of specks, see `scan`.
"""

import math
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from firmware_sim.bullet import pb, silent
from firmware_sim.scan import Scan, load_scan, specks
from firmware_sim.settings import Settings, SettingsError, quaternion, resolve

F64 = NDArray[np.float64]
GRID = 13  # vertices along an edge of the cube that is projected onto a surface
SIDES = 96  # of the polygon that stands for a circle: sagitta 0.05 % of the radius
THIN = 1e-4  # [m] radius of a point or a segment without thickness
SLAB = 20.0  # [m] half size of the box that stands for a half space
HULL_TOLERANCE = 0.012
REST = (0.0, 0.0, 0.0)  # [m/s]


class Shape(NamedTuple):
    """An obstacle as a camera reports it; fields as `rtctl.types.Shape`."""

    name: str
    type: str
    dims: F64  # (4,)
    position: F64  # (3,) [m]
    wxyz: F64  # (4,)
    velocity: F64  # (3,) [m/s]
    omega: F64  # (3,) [rad/s]
    group: str = ""
    mesh: str = ""
    cloud: bytes = b""
    influence: float = 0.0
    clearance: float = 0.0


class ObstacleEdit(NamedTuple):
    """Set or clear one obstacle by name; fields as `rtctl.types.ObstacleEdit`."""

    name: str
    shape: Shape | None
    age: float = 0.0
    feed: bool = False


class MeshFile(NamedTuple):
    """Where a mesh comes from."""

    path: str
    scale: float
    hull: bool
    size: F64  # (3,) [m] of the box about its own origin that holds it


class Leg(NamedTuple):
    """A stretch of an obstacle's way at constant velocity, in plain numbers."""

    begins: float  # [s]
    ends: float
    start: tuple[float, float, float]  # [m]
    velocity: tuple[float, float, float]  # [m/s]


class Solid(NamedTuple):
    """One obstacle of a scenario: its own keys, and what follows from them."""

    spec: dict[str, Any]
    name: str
    type: str  # as the controller knows it
    dims: F64  # (4,)
    wxyz: F64  # (4,) when it appears
    appears: float  # [s]
    vanishes: float  # [s]
    vertices: F64  # (k, 3) of the hull, (0, 3) for pybullet's own shapes
    still: bool  # never moves
    group: str  # the union it is a part of, "" for none
    legs: tuple[Leg, ...]  # where it is at a time, without gaps
    mesh: MeshFile | None = None
    key: str = ""  # of the mesh, as the controller knows it
    scan: Scan | None = None


def multiply(a: F64, b: F64) -> F64:
    """Return the quaternion product a b, wxyz."""
    w = a[0] * b[0] - a[1:] @ b[1:]
    return np.concatenate(([w], a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:])))


def solid(spec: dict[str, Any], settings: Settings) -> Solid:
    """Return the obstacle that a scenario's table describes; SettingsError for a type nobody knows."""
    kind = spec["type"]
    dims, vertices = _geometry(kind, spec)
    mesh = _mesh(spec, settings) if kind == "mesh" else None
    scan = None
    if kind == "cloud":
        path = resolve(spec["file"], settings.folder, settings.package_dirs)
        scan = load_scan(path, float(spec["point_radius_m"]), spec["name"])
        dims = scan.reported, scan.step
    return Solid(
        spec=spec,
        name=spec["name"],
        type=kind,
        dims=np.array((*dims, 0.0, 0.0, 0.0, 0.0)[:4], dtype=np.float64),
        wxyz=np.array(quaternion(spec)),
        appears=float(spec.get("appears_s", 0.0)),
        vanishes=float(spec.get("vanishes_s", 1e6)),
        vertices=vertices,
        still=not spec.get("waypoints") and not any((*spec.get("velocity_m_s", ()), *spec.get("omega_rad_s", ()))),
        group="" if spec.get("combine") == "sum" else spec.get("group", ""),
        legs=_legs(spec),
        mesh=mesh,
        key=(spec.get("mesh") or "@" + spec["name"]) if mesh else "",
        scan=scan,
    )


def _geometry(kind: str, spec: dict[str, Any]) -> tuple[tuple[float, ...], F64]:
    """Return the dimensions in the controller's order and the hull's vertices."""
    none = np.zeros((0, 3))
    radius = float(spec.get("radius_m", 0.0))
    if kind == "sphere":
        return (radius,), none
    if kind in ("point", "plane", "mesh", "cloud"):
        return (), none
    if kind in ("capsule", "segment", "cylinder"):
        return (radius, 0.5 * float(spec["length_m"])), none
    if kind == "box":
        return tuple(0.5 * float(s) for s in spec["size_m"]), none
    if kind == "cone":
        dims: tuple[float, ...] = (radius, float(spec.get("top_radius_m", 0.0)), 0.5 * float(spec["height_m"]))
        return dims, frustum(*dims)
    if kind in ("ellipsoid", "n_ellipsoid", "n_cylinder"):
        axes = tuple(map(float, spec["semi_axes_m"]))
        if kind == "ellipsoid":
            return axes, superquadric(axes, (2.0, 2.0, 2.0))
        n = float(spec["n"])
        return (*axes, n), superquadric(axes, (2.0 * n if kind == "n_ellipsoid" else 2.0,) * 2 + (2.0 * n,))
    raise SettingsError(f"obstacle {spec.get('name')}: type {kind} is none of the known ones")


def superquadric(axes: tuple[float, ...], powers: tuple[float, float, float]) -> F64:
    """Return vertices on |x/a|^p0 + |y/b|^p1 + |z/c|^p2 = 1, from a cube's grid projected onto it."""
    t = np.tan(np.linspace(-0.25, 0.25, GRID) * math.pi)  # equal angles seen from the centre
    u, v = (g.ravel() for g in np.meshgrid(t, t))
    one = np.ones_like(u)
    faces = [np.roll(np.array((s * one, u, v)), k, axis=0).T for k in range(3) for s in (-1.0, 1.0)]
    d = np.unique(np.round(np.concatenate(faces), 12), axis=0)  # (k, 3) directions in units of the axes
    low, high = np.zeros(len(d)), np.full(len(d), 2.0)
    for _ in range(60):  # radius along each direction by bisection: the powers may differ by axis
        middle = 0.5 * (low + high)
        inside = (np.abs(d * middle[:, None]) ** np.array(powers)).sum(axis=1) < 1.0
        low, high = np.where(inside, middle, low), np.where(inside, high, middle)
    return np.asarray(d * low[:, None] * np.array(axes), dtype=np.float64)


def frustum(bottom: float, top: float, half: float) -> F64:
    """Return vertices of a cone of radii `bottom` at -half and `top` at +half along z [m]."""
    angle = np.linspace(0.0, 2.0 * math.pi, SIDES, endpoint=False)
    ring = np.stack((np.cos(angle), np.sin(angle)), axis=1)
    low = np.concatenate((ring * bottom, np.full((SIDES, 1), -half)), axis=1)
    if top <= 0.0:
        return np.concatenate((low, [[0.0, 0.0, half]]))
    return np.concatenate((low, np.concatenate((ring * top, np.full((SIDES, 1), half)), axis=1)))


def _mesh(spec: dict[str, Any], settings: Settings) -> MeshFile:
    """Return the mesh file of an obstacle, its own or one that the robot file names; SettingsError without one."""
    table = spec
    if "mesh" in spec:
        table = next((t for t in settings.meshes if t["name"] == spec["mesh"]), {})
    if "file" not in table:
        raise SettingsError(f"obstacle {spec['name']}: mesh {spec.get('mesh')} is not in the robot file")
    path = str(resolve(table["file"], settings.folder, settings.package_dirs))
    scale, client = float(table.get("scale", 1.0)), pb.connect(pb.DIRECT)
    try:
        with silent():
            shape = pb.createCollisionShape(pb.GEOM_MESH, fileName=path, physicsClientId=client)
            body = pb.createMultiBody(0.0, shape, physicsClientId=client)
        vertices = np.array(pb.getMeshData(body, -1, physicsClientId=client)[1], dtype=np.float64)
    except pb.error as error:
        raise SettingsError(f"obstacle {spec['name']}: {path}: {error}") from error
    finally:
        pb.disconnect(client)
    return MeshFile(path, scale, bool(table.get("hull", False)), 2.0 * scale * np.abs(vertices).max(axis=0))


def _legs(spec: dict[str, Any]) -> tuple[Leg, ...]:
    """Return an obstacle's way: at constant velocity from `appears_s`, or along waypoints and at rest at their ends."""
    waypoints = spec.get("waypoints")
    if not waypoints:
        x, y, z = (float(v) + 0.0 for v in spec["position_m"])  # no negative zero
        vx, vy, vz = map(float, spec.get("velocity_m_s", (0.0, 0.0, 0.0)))
        at = float(spec.get("appears_s", 0.0))
        return (Leg(-math.inf, at, (x, y, z), REST), Leg(at, math.inf, (x, y, z), (vx, vy, vz)))
    points = [(float(t), (float(x), float(y), float(z))) for t, x, y, z in waypoints]
    legs = [Leg(-math.inf, points[0][0], points[0][1], REST)]
    for (t0, a), (t1, b) in pairwise(points):
        if t1 > t0:
            vx, vy, vz = ((v - u) / (t1 - t0) for u, v in zip(a, b, strict=True))
            legs.append(Leg(t0, t1, (a[0] + 0.0, a[1] + 0.0, a[2] + 0.0), (vx, vy, vz)))
    legs.append(Leg(points[-1][0], math.inf, points[-1][1], REST))
    return tuple(legs)


def leg_at(obstacle: Solid, t: float) -> Leg:
    """Return the leg that an obstacle is on at time t [s]."""
    for leg in obstacle.legs:
        if leg.begins <= t < leg.ends:
            return leg
    return obstacle.legs[-1]


def place_at(leg: Leg, t: float) -> tuple[float, float, float]:
    """Return the position [m] at time t [s] of its leg."""
    (x, y, z), (vx, vy, vz) = leg.start, leg.velocity
    if leg.velocity == REST:
        return leg.start
    past = t - leg.begins
    return (x + vx * past, y + vy * past, z + vz * past)


def shape_at(obstacle: Solid, t: float) -> Shape | None:
    """Return the obstacle as it is at time t [s], None while it is not there."""
    if not obstacle.appears <= t < obstacle.vanishes:
        return None
    leg = leg_at(obstacle, t)
    position, velocity = np.array(place_at(leg, t)), np.array(leg.velocity)
    omega = np.array(obstacle.spec.get("omega_rad_s", (0.0, 0.0, 0.0)), dtype=np.float64)
    angle = float(np.linalg.norm(omega)) * (t - obstacle.appears)
    o = obstacle
    wxyz = obstacle.wxyz
    if angle > 0.0:
        axis = omega / np.linalg.norm(omega)
        wxyz = multiply(np.concatenate(([math.cos(0.5 * angle)], math.sin(0.5 * angle) * axis)), wxyz)
    room = float(o.spec.get("influence_m") or 0.0), float(o.spec.get("clearance_m") or 0.0)
    return Shape(o.name, o.type, o.dims, position, wxyz, velocity, omega, o.group, o.key, b"", *room)


def reported(obstacle: Solid, shape: Shape) -> Shape:
    """Return the shape as a camera tells it: a cloud with its points, about their centre."""
    scan = obstacle.scan
    if scan is None:
        return shape
    w, v = shape.wxyz[0], shape.wxyz[1:]
    arm = scan.centre + 2.0 * np.cross(v, np.cross(v, scan.centre) + w * scan.centre)
    velocity = shape.velocity + np.cross(shape.omega, arm)
    return shape._replace(position=shape.position + arm, velocity=velocity, cloud=scan.steps)


def collision_shape(obstacle: Solid, client: int) -> int:
    """Create the obstacle's collision shape in pybullet and return its id."""
    kind, d, make = obstacle.type, obstacle.dims, pb.createCollisionShape
    if obstacle.mesh is not None:
        flags = 0 if obstacle.mesh.hull else pb.GEOM_FORCE_CONCAVE_TRIMESH
        with silent():
            scale = [obstacle.mesh.scale] * 3
            return int(
                make(pb.GEOM_MESH, fileName=obstacle.mesh.path, meshScale=scale, flags=flags, physicsClientId=client)
            )
    if obstacle.scan is not None:
        vertices, indices = specks(obstacle.scan.points)
        return int(make(pb.GEOM_MESH, vertices=vertices, indices=indices, physicsClientId=client))
    if len(obstacle.vertices):
        return int(make(pb.GEOM_MESH, vertices=obstacle.vertices.tolist(), physicsClientId=client))
    if kind in ("sphere", "point"):
        return int(make(pb.GEOM_SPHERE, radius=d[0] if kind == "sphere" else THIN, physicsClientId=client))
    if kind in ("capsule", "segment"):
        radius = max(float(d[0]), THIN)
        return int(make(pb.GEOM_CAPSULE, radius=radius, height=2.0 * d[1], physicsClientId=client))
    if kind == "cylinder":
        return int(make(pb.GEOM_CYLINDER, radius=d[0], height=2.0 * d[1], physicsClientId=client))
    if kind == "plane":
        return int(
            make(
                pb.GEOM_BOX,
                halfExtents=[SLAB] * 3,
                collisionFramePosition=[0.0, 0.0, -SLAB],
                physicsClientId=client,
            )
        )
    return int(make(pb.GEOM_BOX, halfExtents=d[:3].tolist(), physicsClientId=client))

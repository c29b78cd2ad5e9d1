"""Obstacles as people write them (config, scenario, control socket), and as the controller takes them.

Axis of capsule, segment, cylinder, cone, n_cylinder: local z. A plane is solid below its local z (or its `normal`).
"""

from itertools import pairwise
from typing import Annotated, Literal, NamedTuple

import numpy as np
from msgspec import Meta, Struct

from rtctl.errors import ConfigError
from rtctl.kernel.rotations import R_of, exp3, quat_of
from rtctl.spec.read import name_place
from rtctl.types import F64, Shape
from rtctl.world.rooms import CLEARANCE, INFLUENCE, Rooms, fault_of_room

Name = Annotated[str, Meta(min_length=1, max_length=32, pattern=r"^[A-Za-z0-9][A-Za-z0-9_.+-]*$")]
Coordinate = Annotated[float, Meta(ge=-9000.0, le=9000.0)]
Length = Annotated[float, Meta(ge=-10.0, le=10.0)]
Extent = Annotated[float, Meta(ge=1e-4, le=50.0)]
Turn = Annotated[float, Meta(ge=-6.3, le=6.3)]
Unit = Annotated[float, Meta(ge=-1.0, le=1.0)]
Speed = Annotated[float, Meta(ge=-20.0, le=20.0)]
Time = Annotated[float, Meta(ge=0.0, le=1e6)]
Exponent = Annotated[float, Meta(ge=1.0, le=50.0)]

File = Annotated[str, Meta(min_length=1, max_length=255)]

Place = tuple[Coordinate, Coordinate, Coordinate]
Extents = tuple[Extent, Extent, Extent]
RollPitchYaw = tuple[Turn, Turn, Turn]
Orientation = tuple[Unit, Unit, Unit, Unit]
Velocity = tuple[Speed, Speed, Speed]
Waypoint = tuple[Time, Coordinate, Coordinate, Coordinate]


class Posed(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="type"):
    """What all obstacles share: a name, where they are, and how they move.

    At rest or at constant velocity: `position_m` is where it is at `appears_s`. Along `waypoints` ([t, x, y, z], t from
    the start of the scenario): straight lines between them, at rest before the first and after the last.
    Obstacles of one `group` are one obstacle: of a union the part nearest to a point of the arm acts on that point; in
    a sum, as among obstacles without a group, all do.
    """

    name: Name
    position_m: Place | None = None
    rpy_rad: RollPitchYaw | None = None
    wxyz: Orientation | None = None
    velocity_m_s: Velocity = (0.0, 0.0, 0.0)
    omega_rad_s: Velocity = (0.0, 0.0, 0.0)
    waypoints: Annotated[tuple[Waypoint, ...], Meta(max_length=256)] = ()
    appears_s: Time = 0.0
    vanishes_s: Time = 1e6
    group: Name | None = None
    combine: Literal["union", "sum"] | None = None  # None: union, if there is a group
    # as of [avoid], which hold without them; of an arm's obstacles alone
    influence_m: Annotated[float, Meta(ge=INFLUENCE[0], le=INFLUENCE[1])] | None = None
    clearance_m: Annotated[float, Meta(ge=CLEARANCE[0], le=CLEARANCE[1])] | None = None


class Sphere(Posed, tag="sphere", frozen=True, kw_only=True):
    """A ball."""

    radius_m: Extent


class PointObstacle(Posed, tag="point", frozen=True, kw_only=True):
    """A single point."""


class Capsule(Posed, tag="capsule", frozen=True, kw_only=True):
    """All points within `radius_m` of a segment of `length_m` centred on the origin along local z."""

    radius_m: Extent
    length_m: Extent


class Segment(Posed, tag="segment", frozen=True, kw_only=True):
    """A straight line of `length_m` centred on the origin along local z, thickened by `radius_m`."""

    length_m: Extent
    radius_m: Annotated[float, Meta(ge=0.0, le=50.0)] = 0.0


class Cylinder(Posed, tag="cylinder", frozen=True, kw_only=True):
    """A solid cylinder of full height `length_m` centred on the origin along local z."""

    radius_m: Extent
    length_m: Extent


class Box(Posed, tag="box", frozen=True, kw_only=True):
    """A box of full sizes `size_m` centred on the origin."""

    size_m: Extents


class Plane(Posed, tag="plane", frozen=True, kw_only=True):
    """A half space whose surface passes through `position_m`; free on the side of `normal` (default: local z)."""

    normal: tuple[Unit, Unit, Unit] | None = None


class Ellipsoid(Posed, tag="ellipsoid", frozen=True, kw_only=True):
    """(x/a)^2 + (y/b)^2 + (z/c)^2 = 1."""

    semi_axes_m: Extents


class NEllipsoid(Posed, tag="n_ellipsoid", frozen=True, kw_only=True):
    """(x/a)^2n + (y/b)^2n + (z/c)^2n = 1."""

    semi_axes_m: Extents
    n: Exponent


class NCylinder(Posed, tag="n_cylinder", frozen=True, kw_only=True):
    """(x/a)^2 + (y/b)^2 + (z/c)^2n = 1."""

    semi_axes_m: Extents
    n: Exponent


class Cone(Posed, tag="cone", frozen=True, kw_only=True):
    """A cone of full height `height_m` about its middle, `radius_m` at the -z end, `top_radius_m` at the +z end."""

    radius_m: Extent
    height_m: Extent
    top_radius_m: Annotated[float, Meta(ge=0.0, le=50.0)] = 0.0


class Mesh(Posed, tag="mesh", frozen=True, kw_only=True):
    """A closed surface of triangles: `mesh` of the config by its name, or a `file` (STL, OBJ) beside the one it is in.

    scale: metres of a unit of the file. hull: the convex hull, for a surface that is open or crosses itself.
    """

    mesh: Name | None = None
    file: File | None = None
    scale: Annotated[float, Meta(ge=1e-6, le=1e4)] = 1.0
    hull: bool = False


class Cloud(Posed, tag="cloud", frozen=True, kw_only=True):
    """Balls of `point_radius_m` about the points of a `file` (NPY, XYZ, PLY) beside the one it is named in.

    voxel_m: one point stands for all in a cube of this size, and the radius grows by what that moves them.
    """

    point_radius_m: Annotated[float, Meta(ge=0.0, le=1.0)]
    file: File | None = None
    voxel_m: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.0


Obstacle = (
    Sphere
    | PointObstacle
    | Capsule
    | Segment
    | Cylinder
    | Box
    | Plane
    | Ellipsoid
    | NEllipsoid
    | NCylinder
    | Cone
    | Mesh
    | Cloud
)


class Pose(NamedTuple):
    """Where an obstacle is at one time, and whether it is there at all."""

    position: F64  # (3,) [m]
    velocity: F64  # (3,) [m/s]
    present: bool


def dims_of(obstacle: Obstacle) -> F64:
    """Return the (4,) dimensions [m] in the order of `world.primitives`; halves where it wants halves."""
    match obstacle:
        case Sphere():
            d: tuple[float, ...] = (obstacle.radius_m,)
        case Capsule() | Segment() | Cylinder():
            d = (obstacle.radius_m, 0.5 * obstacle.length_m)
        case Box():
            d = tuple(0.5 * s for s in obstacle.size_m)
        case Ellipsoid():
            d = obstacle.semi_axes_m
        case NEllipsoid() | NCylinder():
            d = (*obstacle.semi_axes_m, obstacle.n)
        case Cone():
            d = (obstacle.radius_m, obstacle.top_radius_m, 0.5 * obstacle.height_m)
        case Cloud():
            d = (obstacle.point_radius_m,)
        case _:  # point, plane and mesh have none
            d = ()
    out = np.zeros(4)
    out[: len(d)] = d
    return out


def quaternion(rpy: tuple[float, float, float] | None, wxyz: tuple[float, float, float, float] | None) -> F64:
    """Return the unit quaternion wxyz (4,) of R = Rz(yaw) Ry(pitch) Rx(roll) [rad], or `wxyz` itself."""
    if wxyz is not None:
        w = np.array(wxyz, dtype=np.float64)
        return w / np.linalg.norm(w)
    (sr, sp, sy), (cr, cp, cy) = np.sin(0.5 * np.array(rpy or np.zeros(3))), np.cos(0.5 * np.array(rpy or np.zeros(3)))
    return np.array(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ]
    )


def _facing(normal: tuple[float, float, float]) -> F64:
    """Return the shortest rotation wxyz (4,) that turns local z to `normal`; half a turn about x when they oppose."""
    x, y, z = np.array(normal) / np.linalg.norm(normal)
    w = np.array([1.0 + z, -y, x, 0.0])
    size = np.linalg.norm(w)
    return w / size if size > 1e-9 else np.array([0.0, 1.0, 0.0, 0.0])


def orientation_of(obstacle: Obstacle, t: float = 0.0) -> F64:
    """Return the obstacle's orientation wxyz (4,) at time t [s]; it turns by omega from when it appears."""
    if isinstance(obstacle, Plane) and obstacle.normal is not None:
        w = _facing(obstacle.normal)
    else:
        w = quaternion(obstacle.rpy_rad, obstacle.wxyz)
    turn = np.array(obstacle.omega_rad_s) * max(0.0, t - obstacle.appears_s)
    return quat_of(exp3(turn) @ R_of(w)) if turn.any() else w


def pose_at(obstacle: Obstacle, t: float) -> Pose:
    """Return position (3,) [m], velocity (3,) [m/s] and presence at time t [s] of the scenario."""
    present = obstacle.appears_s <= t < obstacle.vanishes_s
    if not obstacle.waypoints:
        v = np.array(obstacle.velocity_m_s)
        # before it appears it has not moved: it starts from where it was written to appear
        return Pose(np.array(obstacle.position_m) + v * max(0.0, t - obstacle.appears_s), v, present)
    w = np.array(obstacle.waypoints)  # (k, 4)
    k = int(np.searchsorted(w[:, 0], t, side="right"))
    if k == 0 or k == len(w):
        return Pose(w[0, 1:] if k == 0 else w[-1, 1:], np.zeros(3), present)
    velocity = (w[k, 1:] - w[k - 1, 1:]) / (w[k, 0] - w[k - 1, 0])
    return Pose(w[k - 1, 1:] + velocity * (t - w[k - 1, 0]), velocity, present)


def mesh_key(mesh: Mesh) -> str:
    """Return the name of an obstacle's mesh among the robot's; one of a file of its own is no name anybody can say."""
    return mesh.mesh or f"@{mesh.name}"


def shape_of(obstacle: Obstacle, t: float = 0.0) -> Shape:
    """Return the obstacle as the controller takes it, where it is at time t [s]; a cloud still without its points."""
    pose = pose_at(obstacle, t)
    return Shape(
        name=obstacle.name,
        type=type(obstacle).__struct_config__.tag,  # type: ignore[arg-type]
        dims=dims_of(obstacle),
        position=pose.position,
        wxyz=orientation_of(obstacle, t),
        velocity=pose.velocity,
        omega=np.array(obstacle.omega_rad_s),
        group="" if obstacle.group is None or obstacle.combine == "sum" else obstacle.group,
        mesh=mesh_key(obstacle) if isinstance(obstacle, Mesh) else "",
        influence=obstacle.influence_m or 0.0,
        clearance=obstacle.clearance_m or 0.0,
    )


def contradiction(o: Obstacle) -> tuple[str, object, str] | None:
    """Return (key, what came, what was wanted) of the first pair of keys that contradict each other, or None."""
    if o.position_m is None and not o.waypoints:
        return "position_m", "nothing", "position_m or waypoints"
    if o.waypoints:
        t = [w[0] for w in o.waypoints]
        if o.position_m is not None:
            return "position_m", list(o.position_m), "nothing beside waypoints"
        if any(o.velocity_m_s):
            return "velocity_m_s", list(o.velocity_m_s), "nothing beside waypoints"
        if any(b - a < 1e-3 for a, b in pairwise(t)):
            return "waypoints", t, "times that rise by at least 1 ms"
    if o.vanishes_s <= o.appears_s:
        return "vanishes_s", o.vanishes_s, f"more than appears_s = {o.appears_s:g}"
    if o.combine is not None and o.group is None:
        return "combine", o.combine, "a group beside it"
    if o.influence_m is not None and o.clearance_m is not None and o.clearance_m >= o.influence_m:
        return "clearance_m", o.clearance_m, f"less than influence_m = {o.influence_m:g}"
    if isinstance(o, Mesh) and (o.mesh is None) == (o.file is None):
        return "mesh", "neither it nor file" if o.mesh is None else f"{o.mesh} and a file", "one of the two"
    if isinstance(o, Mesh) and o.mesh is not None and (o.hull or o.scale != 1.0):
        return "mesh", o.mesh, "no scale or hull beside it: its [[mesh]] has them"
    if isinstance(o, Plane) and o.normal is not None:
        if o.rpy_rad is not None or o.wxyz is not None:
            return "normal", list(o.normal), "nothing beside rpy_rad or wxyz"
        if np.linalg.norm(o.normal) < 0.1:
            return "normal", list(o.normal), "a direction"
    return orientation_contradiction(o.rpy_rad, o.wxyz)


def orientation_contradiction(rpy: object, wxyz: tuple[float, ...] | None) -> tuple[str, object, str] | None:
    """Return the contradiction of two orientations given at once, or of a quaternion that is none."""
    if wxyz is None:
        return None
    if rpy is not None:
        return "wxyz", list(wxyz), "nothing beside rpy_rad"
    if abs(np.linalg.norm(wxyz) - 1.0) > 1e-2:
        return "wxyz", list(wxyz), "a quaternion of length 1"
    return None


def refuse_obstacles(obstacles: tuple[Obstacle, ...], source: str, one: bool = False) -> None:
    """Raise ConfigError for the first obstacle whose keys contradict each other or whose name is taken."""
    names: set[str] = set()
    combined: dict[str, str] = {}
    for i, obstacle in enumerate(obstacles):
        inside = "" if one else f"obstacle[{i}]."
        found = contradiction(obstacle)
        if found is not None:
            raise ConfigError(name_place(source, inside + found[0]), found[1], found[2])
        if obstacle.name in names:
            raise ConfigError(name_place(source, f"{inside}name"), obstacle.name, "a name not used before")
        names.add(obstacle.name)
        if isinstance(obstacle, Cloud) and obstacle.file is None:
            raise ConfigError(name_place(source, f"{inside}file"), "nothing", "an NPY, XYZ or PLY file")
        if obstacle.group is not None:
            how = combined.setdefault(obstacle.group, obstacle.combine or "union")
            if how != (obstacle.combine or "union"):
                place = name_place(source, f"{inside}combine")
                raise ConfigError(place, obstacle.combine or "union", f"{how}, as the rest of group {obstacle.group}")


def refuse_rooms(obstacles: tuple[Obstacle, ...], rooms: Rooms, source: str) -> None:
    """Raise ConfigError for the first obstacle whose own influence or clearance the robot cannot give it."""
    for i, o in enumerate(obstacles):
        if found := fault_of_room(o.influence_m or 0.0, o.clearance_m or 0.0, rooms):
            raise ConfigError(name_place(source, f"obstacle[{i}].{found[0]}"), found[1], found[2])

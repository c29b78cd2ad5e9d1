"""What the plant needs of pybullet where another engine moves the arm: for Pythons that pybullet has no wheel for.

The names, arguments and answers are pybullet's, as far as `plant`, `obstacles`, `oracle` and `shapes` call them; the
kinematics are Pinocchio's, the distances Coal's. A link's mesh is its convex hull, as there. Nothing moves by itself:
`second.SecondPlant` says where the joints are. A question that only an engine can answer raises `error`.

Links are numbered from the base outwards, each as the joint that moves it; the frame of a link's inertia is the link's
own frame here. Of the points where two shapes are nearest, one is told.
"""

import math
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Sequence
from functools import cached_property
from itertools import count
from typing import NamedTuple

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

F64 = NDArray[np.float64]
Three = Sequence[float] | F64
Point = tuple[int, int, int, int, int, F64, F64, F64, float]  # as pybullet's: flag, bodies, links, places, normal, gap

DIRECT = 2
URDF_USE_INERTIA_FROM_FILE, URDF_USE_IMPLICIT_CYLINDER = 2, 128
JOINT_REVOLUTE, JOINT_PRISMATIC, JOINT_FIXED = 0, 1, 4
GEOM_SPHERE, GEOM_BOX, GEOM_CYLINDER, GEOM_MESH, GEOM_CAPSULE = 2, 3, 4, 5, 7
GEOM_FORCE_CONCAVE_TRIMESH = 1
VELOCITY_CONTROL, TORQUE_CONTROL, ACTIVATION_STATE_DISABLE_SLEEPING = 0, 1, 1
_KINDS = {"revolute": JOINT_REVOLUTE, "continuous": JOINT_REVOLUTE, "prismatic": JOINT_PRISMATIC}
BASE = -1


class error(Exception):
    """What cannot be done."""


class Piece(NamedTuple):
    """A shape in the frame of what carries it."""

    shape: coal.CollisionGeometry
    R: F64  # (3, 3)
    t: F64  # (3,) [m]
    low: F64  # (3,) [m] corners of the box about it, in its own frame
    high: F64


class Joint(NamedTuple):
    """A joint, and the link that it carries."""

    name: str
    kind: int
    low: float
    high: float
    axis: tuple[float, ...]
    parent: int  # link, BASE for the base
    link: str


def _piece(shape: coal.CollisionGeometry, R: F64, t: F64) -> Piece:
    shape.computeLocalAABB()
    return Piece(shape, R, t, np.array(shape.aabb_local.min_), np.array(shape.aabb_local.max_))


class _Body:
    """Pieces that stand somewhere: an obstacle, or a link of the arm."""

    def __init__(self, pieces: Sequence[Piece]) -> None:
        self.pieces = list(pieces)
        self.R: F64 = np.eye(3)
        self.t: F64 = np.zeros(3)
        self._ball: tuple[float, float, float, float] | None = None
        self._box: tuple[F64, F64] | None = None

    def put(self, R: F64, t: F64) -> None:
        self.R, self.t, self._ball, self._box = R, t, None, None

    def ball(self) -> tuple[float, float, float, float]:
        """Return the middle [m], in the world, and the radius [m] of a ball that holds it."""
        if self._ball is None:
            middle, radius = self._own_ball
            self._ball = (*(self.R @ middle + self.t).tolist(), radius)
        return self._ball

    @cached_property
    def _own_ball(self) -> tuple[F64, float]:
        middles = [p.R @ (0.5 * (p.low + p.high)) + p.t for p in self.pieces]
        middle = np.mean(middles, axis=0)
        radii = [float(np.linalg.norm(0.5 * (p.high - p.low))) for p in self.pieces]
        return middle, max(float(np.linalg.norm(m - middle)) + r for m, r in zip(middles, radii, strict=True))

    def placed(self) -> Iterator[tuple[Piece, coal.Transform3s]]:
        for p in self.pieces:
            yield p, coal.Transform3s(self.R @ p.R, self.R @ p.t + self.t)

    def box(self) -> tuple[F64, F64]:
        """Return the corners [m] of a box in the world that holds it: of a piece's own box, turned."""
        if self._box is not None:
            return self._box
        low, high = np.full(3, np.inf), np.full(3, -np.inf)
        for p in self.pieces:
            R = self.R @ p.R
            centre = R @ (0.5 * (p.low + p.high)) + self.R @ p.t + self.t
            half = np.abs(R) @ (0.5 * (p.high - p.low))
            low, high = np.minimum(low, centre - half), np.maximum(high, centre + half)
        self._box = low, high
        return self._box


class _World:
    """The arm and the obstacles of a client."""

    def __init__(self) -> None:
        self.arm: _Arm | None = None
        self.shapes: dict[int, Piece] = {}
        self.bodies: dict[int, _Body] = {}
        self.numbers = count(1)  # 0 is the arm


class _Arm:
    """A URDF at a posture."""

    def __init__(self, urdf: str) -> None:
        try:
            self.model = pin.buildModelFromXML(urdf)
            found = pin.buildGeomFromUrdfString(self.model, urdf, pin.GeometryType.COLLISION)
        except (ValueError, RuntimeError) as reason:
            raise error(str(reason)) from None
        self.data = self.model.createData()
        self.joints = _joints(ET.fromstring(urdf))
        self.q = {k: 0.0 for k, j in enumerate(self.joints) if j.kind != JOINT_FIXED}
        self.qd = dict.fromkeys(self.q, 0.0)
        self.frames = [self.model.getFrameId(j.link, pin.FrameType.BODY) for j in self.joints]
        self.at = {k: self.model.joints[self.model.getJointId(self.joints[k].name)] for k in self.q}
        by_link = {j.link: k for k, j in enumerate(self.joints)}
        self.links: dict[int, _Body] = {}
        for thing in found.geometryObjects:
            frame = self.model.frames[thing.parentFrame]
            X = frame.placement.inverse() * thing.placement
            piece = _piece(_convex(thing.geometry), np.array(X.rotation), np.array(X.translation))
            self.links.setdefault(by_link.get(frame.name, BASE), _Body(())).pieces.append(piece)
        self._stale = True

    def set(self, joint: int, q: float, qd: float) -> None:
        if joint in self.q:
            self.q[joint], self.qd[joint], self._stale = q, qd, True

    def _posture(self, q: dict[int, float]) -> F64:
        full = pin.neutral(self.model)
        for k, value in q.items():
            j = self.at[k]
            full[j.idx_q : j.idx_q + j.nq] = value if j.nq == 1 else (math.cos(value), math.sin(value))
        return np.asarray(full)

    def place(self) -> None:
        """Put links where the joints have them."""
        if self._stale:
            pin.framesForwardKinematics(self.model, self.data, self._posture(self.q))
            for link, body in self.links.items():
                body.put(*self.pose(link))
            self._stale = False

    def pose(self, link: int) -> tuple[F64, F64]:
        """Return orientation and place [m] of a link's frame; `place` comes first."""
        if link == BASE:
            return np.eye(3), np.zeros(3)
        X = self.data.oMf[self.frames[link]]
        return np.array(X.rotation), np.array(X.translation)

    def jacobian(self, link: int, local: Three, q: dict[int, float]) -> tuple[F64, F64]:
        """Return d(place)/dq (3, n) and d(angle)/dq (3, n) of a place in a link's frame, in the world."""
        J = pin.computeFrameJacobian(
            self.model, self.data, self._posture(q), self.frames[link], pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        )
        self._stale = True
        R = np.array(self.data.oMf[self.frames[link]].rotation)
        columns = [self.at[k].idx_v for k in sorted(q)]
        turns, arm = J[3:, columns], R @ np.asarray(local, dtype=np.float64)
        return J[:3, columns] + np.cross(turns.T, arm).T, turns


def _joints(root: ET.Element) -> list[Joint]:
    """Return the joints of a URDF, the base's first, each after the one that carries it."""
    by_parent: dict[str, list[ET.Element]] = {}
    children = set()
    for joint in root.findall("joint"):
        by_parent.setdefault(_of(joint, "parent"), []).append(joint)
        children.add(_of(joint, "child"))
    base = next(link.get("name", "") for link in root.findall("link") if link.get("name") not in children)
    found: list[Joint] = []
    waiting = [(joint, BASE) for joint in reversed(by_parent.get(base, []))]
    while waiting:
        joint, parent = waiting.pop()
        limit, axis = joint.find("limit"), joint.find("axis")
        low, high = (0.0, -1.0) if limit is None else (float(limit.get(k, "0")) for k in ("lower", "upper"))
        kind = _KINDS.get(joint.get("type", ""), JOINT_FIXED)
        along = tuple(map(float, ("1 0 0" if axis is None else axis.get("xyz", "1 0 0")).split()))
        found.append(Joint(joint.get("name", ""), kind, low, high, along, parent, _of(joint, "child")))
        waiting += [(one, len(found) - 1) for one in reversed(by_parent.get(found[-1].link, []))]
    return found


def _of(joint: ET.Element, end: str) -> str:
    element = joint.find(end)
    return "" if element is None else element.get("link", "")


def _convex(shape: coal.CollisionGeometry) -> coal.CollisionGeometry:
    """Return the hull of a mesh, any other shape as it is."""
    if not isinstance(shape, coal.BVHModelBase):
        return shape
    try:
        shape.buildConvexHull(True, "Qt")
    except RuntimeError as reason:  # of what is flat
        raise error(str(reason)) from None
    return shape.convex


def _mesh(vertices: F64, triangles: NDArray[np.int64]) -> coal.BVHModelOBBRSS:
    corners, indices = coal.StdVec_Vec3s(), coal.StdVec_Triangle()
    corners.extend(list(vertices))
    indices.extend([coal.Triangle(*map(int, t)) for t in triangles])
    mesh = coal.BVHModelOBBRSS()
    mesh.beginModel(len(triangles), len(vertices))
    mesh.addSubModel(corners, indices)
    mesh.endModel()
    return mesh


# ---- pybullet's functions

_worlds: dict[int, _World] = {}
_clients = count()


def _arm(client: int) -> _Arm:
    arm = _worlds[client].arm
    if arm is None:
        raise error("no arm")
    return arm


def connect(mode: int) -> int:
    client = next(_clients)
    _worlds[client] = _World()
    return client


def disconnect(client: int) -> None:
    del _worlds[client]


def setGravity(x: float, y: float, z: float, physicsClientId: int) -> None:
    """Say nothing to nobody: another engine moves the arm."""


def setPhysicsEngineParameter(**_: object) -> None:
    pass


def changeDynamics(*_: object, **__: object) -> None:
    pass


def setJointMotorControl2(*_: object, **__: object) -> None:
    pass


def performCollisionDetection(physicsClientId: int) -> None:
    pass


def loadURDF(path: str, useFixedBase: bool, flags: int, physicsClientId: int) -> int:
    with open(path, encoding="utf-8") as file:
        _worlds[physicsClientId].arm = _Arm(file.read())
    return 0


def getNumJoints(body: int, physicsClientId: int) -> int:
    return len(_arm(physicsClientId).joints)


def getJointInfo(body: int, joint: int, physicsClientId: int) -> tuple[object, ...]:
    j = _arm(physicsClientId).joints[joint]
    ends = (joint, j.name.encode(), j.kind, -1, -1, 0, 0.0, 0.0, j.low, j.high, 0.0, 0.0, j.link.encode())
    return (*ends, j.axis, (0.0,) * 3, (0.0, 0.0, 0.0, 1.0), j.parent)


def getDynamicsInfo(body: int, link: int, physicsClientId: int) -> tuple[object, ...]:
    return 1.0, 0.0, (1.0, 1.0, 1.0)  # masses are the other engine's


def resetJointState(body: int, joint: int, q: float, qd: float, physicsClientId: int) -> None:
    _arm(physicsClientId).set(joint, q, qd)


def getJointStates(body: int, joints: Sequence[int], physicsClientId: int) -> list[tuple[float, float]]:
    arm = _arm(physicsClientId)
    return [(arm.q[k], arm.qd[k]) for k in joints]


def getLinkState(
    body: int, link: int, computeLinkVelocity: int = 0, computeForwardKinematics: int = 0, physicsClientId: int = 0
) -> tuple[object, ...]:
    arm = _arm(physicsClientId)
    arm.place()
    R, t = arm.pose(link)
    place, turned = tuple(t.tolist()), tuple(pin.Quaternion(R).coeffs().tolist())
    return place, turned, (0.0,) * 3, (0.0, 0.0, 0.0, 1.0), place, turned


def getCollisionShapeData(body: int, link: int, physicsClientId: int) -> list[object]:
    links = _arm(physicsClientId).links
    return list(links[link].pieces) if link in links else []


def getAABB(body: int, link: int = BASE, physicsClientId: int = 0) -> tuple[F64, F64]:
    return _body(physicsClientId, body, link).box()


def _body(client: int, body: int, link: int = BASE) -> _Body:
    world = _worlds[client]
    if body:
        return world.bodies[body]
    arm = _arm(client)
    arm.place()
    return arm.links[link]


def createCollisionShape(
    kind: int,
    radius: float = 0.5,
    height: float = 1.0,
    halfExtents: Three = (1.0, 1.0, 1.0),
    fileName: str = "",
    meshScale: Three = (1.0, 1.0, 1.0),
    vertices: Sequence[Three] = (),
    indices: Sequence[int] = (),
    flags: int = 0,
    collisionFramePosition: Three = (0.0, 0.0, 0.0),
    physicsClientId: int = 0,
) -> int:
    if kind == GEOM_MESH:
        if fileName:
            mesh = _loaded(fileName, meshScale)
            shape = mesh if flags & GEOM_FORCE_CONCAVE_TRIMESH else _convex(mesh)
        else:
            corners = np.asarray(vertices, dtype=np.float64)
            hollow = np.asarray(indices, dtype=np.int64).reshape(-1, 3)
            some = np.array([[0, 1, 2]])  # a hull is of corners alone
            shape = _mesh(corners, hollow) if len(hollow) else _convex(_mesh(corners, some))
    elif kind == GEOM_SPHERE:
        shape = coal.Sphere(radius)
    elif kind == GEOM_CAPSULE:
        shape = coal.Capsule(radius, height)
    elif kind == GEOM_CYLINDER:
        shape = coal.Cylinder(radius, height)
    else:
        shape = coal.Box(*(2.0 * float(h) for h in halfExtents))
    world = _worlds[physicsClientId]
    number = next(world.numbers)
    world.shapes[number] = _piece(shape, np.eye(3), np.asarray(collisionFramePosition, dtype=np.float64))
    return number


def _loaded(name: str, scale: Three) -> coal.BVHModelBase:
    try:
        return coal.MeshLoader(coal.NODE_TYPE.BV_OBBRSS).load(name, np.asarray(scale, dtype=np.float64))
    except (RuntimeError, ValueError) as reason:
        raise error(str(reason)) from None


def createMultiBody(
    mass: float,
    shape: int,
    visual: int = -1,
    position: Three = (0.0, 0.0, 0.0),
    xyzw: Three = (0.0, 0.0, 0.0, 1.0),
    physicsClientId: int = 0,
) -> int:
    world = _worlds[physicsClientId]
    number = next(world.numbers)
    world.bodies[number] = _Body([world.shapes[shape]])
    resetBasePositionAndOrientation(number, position, xyzw, physicsClientId)
    return number


def removeBody(body: int, physicsClientId: int) -> None:
    del _worlds[physicsClientId].bodies[body]


def resetBasePositionAndOrientation(body: int, position: Three, xyzw: Three, physicsClientId: int) -> None:
    x, y, z, w = map(float, xyzw)
    R = np.array(pin.Quaternion(w, x, y, z).normalized().toRotationMatrix())
    _worlds[physicsClientId].bodies[body].put(R, np.asarray(position, dtype=np.float64))


def getMeshData(body: int, link: int, physicsClientId: int) -> tuple[int, F64]:
    shape = _worlds[physicsClientId].bodies[body].pieces[0].shape
    mesh = isinstance(shape, coal.BVHModelBase)
    corners = np.array(shape.vertices() if mesh else [shape.point(k) for k in range(shape.num_points)])
    return len(corners), corners


def getClosestPoints(
    a: int, b: int, sight: float, linkA: int | None = None, linkB: int | None = None, physicsClientId: int = 0
) -> list[Point]:
    """Return where links of the arm a are nearest to body b, or a link of it: at most sight [m] apart."""
    arm, other = _arm(physicsClientId), BASE if linkB is None else linkB
    arm.place()
    that = _body(physicsClientId, b, other)
    x, y, z, radius = that.ball()
    found = []
    for link in (linkA,) if linkA is not None else arm.links:
        this = arm.links[link]
        u, v, w, r = this.ball()
        if math.hypot(x - u, y - v, z - w) - radius - r <= sight:
            point = _nearest(this, that, sight, (a, b, link, other))
            if point is not None:
                found.append(point)
    return found


def getContactPoints(a: int, b: int | None = None, physicsClientId: int = 0) -> list[Point]:
    """Return where links of body a touch body b, or any other."""
    bodies = sorted(_worlds[physicsClientId].bodies) if b is None else [b]
    return [point for one in bodies for point in getClosestPoints(a, one, 0.0, physicsClientId=physicsClientId)]


def _nearest(one: _Body, other: _Body, sight: float, names: tuple[int, int, int, int]) -> Point | None:
    """Return where two bodies are nearest to each other; None where they are farther apart than sight [m]."""
    (low, high), (other_low, other_high) = one.box(), other.box()
    gaps = np.maximum(low - other_high, other_low - high)
    if math.sqrt(float((np.maximum(gaps, 0.0) ** 2).sum())) > sight:
        return None
    best: coal.DistanceResult | None = None
    for p, at in one.placed():
        for r, there in other.placed():
            result = coal.DistanceResult()
            coal.distance(p.shape, at, r.shape, there, coal.DistanceRequest(True, True), result)
            if best is None or result.min_distance < best.min_distance:
                best = result
    if best is None or best.min_distance > sight:
        return None
    normal = -np.array(best.normal)  # Coal's points from the first to the second
    return (0, *names, np.array(best.getNearestPoint1()), np.array(best.getNearestPoint2()), normal, best.min_distance)


def calculateJacobian(
    body: int,
    link: int,
    local: Three,
    q: Sequence[float],
    qd: Sequence[float],
    qdd: Sequence[float],
    physicsClientId: int = 0,
) -> tuple[F64, F64]:
    arm = _arm(physicsClientId)
    return arm.jacobian(link, local, dict(zip(sorted(arm.q), q, strict=True)))


def invertTransform(position: Three, xyzw: Three) -> tuple[F64, tuple[float, ...]]:
    x, y, z, w = map(float, xyzw)
    inverse = pin.Quaternion(w, -x, -y, -z)
    return -(np.array(inverse.toRotationMatrix()) @ np.asarray(position)), (-x, -y, -z, w)


def multiplyTransforms(p: Three, a: Three, r: Three, b: Three) -> tuple[F64, tuple[float, ...]]:
    one, other = (pin.Quaternion(float(v[3]), *map(float, v[:3])) for v in (a, b))
    return np.asarray(p) + np.array(one.toRotationMatrix()) @ np.asarray(r), tuple((one * other).coeffs().tolist())

"""What the plant needs of pybullet where another engine moves the arm: for Pythons that pybullet has no wheel for.

The names, arguments and answers are pybullet's, as far as `plant`, `obstacles`, `oracle` and `shapes` call them; the
kinematics are Pinocchio's, the distances Coal's. A link's mesh is its convex hull, as there. Nothing moves by itself:
`second.SecondPlant` says where the joints are. What only an engine can answer is not there.

Links are numbered from the base outwards, each as the joint that moves it; the frame of a link's inertia is the link's
own frame here. Of the points where two shapes are nearest, one is told.
"""

import math
from collections.abc import Sequence
from itertools import count
from typing import TypedDict, Unpack

import coal
import numpy as np
import pinocchio as pin

from firmware_sim.rigid import (
    BASE,
    F64,
    FIXED,
    PRISMATIC,
    REVOLUTE,
    Arm,
    Body,
    Piece,
    ShapeError,
    Three,
    hull_of,
    loaded,
    mesh_of,
    nearest,
    piece_of,
)

Point = tuple[int, int, int, int, int, F64, F64, F64, float]  # as pybullet's: flag, bodies, links, places, normal, gap

DIRECT = 2
URDF_USE_INERTIA_FROM_FILE, URDF_USE_IMPLICIT_CYLINDER = 2, 128
JOINT_REVOLUTE, JOINT_PRISMATIC, JOINT_FIXED = REVOLUTE, PRISMATIC, FIXED
GEOM_SPHERE, GEOM_BOX, GEOM_CYLINDER, GEOM_MESH, GEOM_CAPSULE = 2, 3, 4, 5, 7
GEOM_FORCE_CONCAVE_TRIMESH = 1
VELOCITY_CONTROL, TORQUE_CONTROL, ACTIVATION_STATE_DISABLE_SLEEPING = 0, 1, 1
error = ShapeError


class _World:
    """The arm and the obstacles of a client."""

    def __init__(self) -> None:
        self.arm: Arm | None = None
        self.shapes: dict[int, Piece] = {}
        self.bodies: dict[int, Body] = {}
        self.numbers = count(1)  # 0 is the arm


# ---- pybullet's functions

_worlds: dict[int, _World] = {}
_clients = count()


def _arm(client: int) -> Arm:
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
        _worlds[physicsClientId].arm = Arm(file.read())
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


def _body(client: int, body: int, link: int = BASE) -> Body:
    world = _worlds[client]
    if body:
        return world.bodies[body]
    arm = _arm(client)
    arm.place()
    return arm.links[link]


class Form(TypedDict, total=False):
    """What `createCollisionShape` is told of a shape, each kind what it has."""

    radius: float  # [m]
    height: float  # [m] of what lies between a capsule's balls, or of a cylinder
    halfExtents: Three  # [m]
    fileName: str
    meshScale: Three
    vertices: Sequence[Three]  # [m]
    indices: Sequence[int]  # three a triangle; none: the hull of the vertices
    flags: int
    collisionFramePosition: Three  # [m]


def createCollisionShape(kind: int, physicsClientId: int = 0, **form: Unpack[Form]) -> int:
    if kind == GEOM_MESH:
        if "fileName" in form:
            mesh = loaded(form["fileName"], form.get("meshScale", (1.0, 1.0, 1.0)))
            shape = mesh if form.get("flags", 0) & GEOM_FORCE_CONCAVE_TRIMESH else hull_of(mesh)
        else:
            corners = np.asarray(form["vertices"], dtype=np.float64)
            hollow = np.asarray(form.get("indices", ()), dtype=np.int64).reshape(-1, 3)
            some = np.array([[0, 1, 2]])  # a hull is of corners alone
            shape = mesh_of(corners, hollow) if len(hollow) else hull_of(mesh_of(corners, some))
    elif kind == GEOM_SPHERE:
        shape = coal.Sphere(form["radius"])
    elif kind == GEOM_CAPSULE:
        shape = coal.Capsule(form["radius"], form["height"])
    elif kind == GEOM_CYLINDER:
        shape = coal.Cylinder(form["radius"], form["height"])
    else:
        shape = coal.Box(*(2.0 * float(h) for h in form["halfExtents"]))
    world = _worlds[physicsClientId]
    number = next(world.numbers)
    at = np.asarray(form.get("collisionFramePosition", (0.0, 0.0, 0.0)), dtype=np.float64)
    world.shapes[number] = piece_of(shape, np.eye(3), at)
    return number


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
    world.bodies[number] = Body([world.shapes[shape]])
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
            near = nearest(this, that, sight)
            if near is not None:
                found.append((0, a, b, link, other, *near))
    return found


def getContactPoints(a: int, b: int | None = None, physicsClientId: int = 0) -> list[Point]:
    """Return where links of body a touch body b, or any other."""
    bodies = sorted(_worlds[physicsClientId].bodies) if b is None else [b]
    return [point for one in bodies for point in getClosestPoints(a, one, 0.0, physicsClientId=physicsClientId)]


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

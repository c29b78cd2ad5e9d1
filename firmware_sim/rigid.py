"""Rigid bodies that stand where they are put: the links of a URDF at a posture, solids, and the distances of both.

Kinematics are Pinocchio's, distances Coal's. A link's mesh is its convex hull.
"""

import math
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

F64 = NDArray[np.float64]
Three = Sequence[float] | F64
REVOLUTE, PRISMATIC, FIXED = 0, 1, 4  # pybullet's numbers
_KINDS = {"revolute": REVOLUTE, "continuous": REVOLUTE, "prismatic": PRISMATIC}
BASE = -1


class ShapeError(Exception):
    """What a URDF or a mesh cannot be."""


class Near(NamedTuple):
    """Where two bodies are nearest to each other, in the world."""

    on_one: F64  # (3,) [m]
    on_other: F64  # (3,) [m]
    normal: F64  # (3,) from the other to the one
    distance: float  # [m]; negative: how deep


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


def piece_of(shape: coal.CollisionGeometry, R: F64, t: F64) -> Piece:
    shape.computeLocalAABB()
    return Piece(shape, R, t, np.array(shape.aabb_local.min_), np.array(shape.aabb_local.max_))


class Body:
    """Pieces that stand somewhere: an obstacle, or a link of the arm."""

    def __init__(self, pieces: Sequence[Piece]) -> None:
        self.pieces = list(pieces)
        self.R: F64 = np.eye(3)
        self.t: F64 = np.zeros(3)
        self._ball: tuple[float, float, float, float] | None = None
        self._box: tuple[F64, F64] | None = None
        self._placed: list[tuple[Piece, coal.Transform3s]] | None = None

    def put(self, R: F64, t: F64) -> None:
        self.R, self.t, self._ball, self._box, self._placed = R, t, None, None, None

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

    def placed(self) -> list[tuple[Piece, coal.Transform3s]]:
        """Return the pieces and where they are: many bodies are measured to one that stands."""
        if self._placed is None:
            self._placed = [(p, coal.Transform3s(self.R @ p.R, self.R @ p.t + self.t)) for p in self.pieces]
        return self._placed

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


class Arm:
    """A URDF at a posture."""

    def __init__(self, urdf: str) -> None:
        try:
            self.model = pin.buildModelFromXML(urdf)
            found = pin.buildGeomFromUrdfString(self.model, urdf, pin.GeometryType.COLLISION)
        except (ValueError, RuntimeError) as reason:
            raise ShapeError(str(reason)) from None
        self.data = self.model.createData()
        self.joints = _joints(ET.fromstring(urdf))
        self.q = {k: 0.0 for k, j in enumerate(self.joints) if j.kind != FIXED}
        self.qd = dict.fromkeys(self.q, 0.0)
        self.frames = [self.model.getFrameId(j.link, pin.FrameType.BODY) for j in self.joints]
        self.at = {k: self.model.joints[self.model.getJointId(self.joints[k].name)] for k in self.q}
        by_link = {j.link: k for k, j in enumerate(self.joints)}
        self.links: dict[int, Body] = {}
        for thing in found.geometryObjects:
            frame = self.model.frames[thing.parentFrame]
            X = frame.placement.inverse() * thing.placement
            piece = piece_of(hull_of(thing.geometry), np.array(X.rotation), np.array(X.translation))
            self.links.setdefault(by_link.get(frame.name, BASE), Body(())).pieces.append(piece)
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
        kind = _KINDS.get(joint.get("type", ""), FIXED)
        along = tuple(map(float, ("1 0 0" if axis is None else axis.get("xyz", "1 0 0")).split()))
        found.append(Joint(joint.get("name", ""), kind, low, high, along, parent, _of(joint, "child")))
        waiting += [(one, len(found) - 1) for one in reversed(by_parent.get(found[-1].link, []))]
    return found


def _of(joint: ET.Element, end: str) -> str:
    element = joint.find(end)
    return "" if element is None else element.get("link", "")


def hull_of(shape: coal.CollisionGeometry) -> coal.CollisionGeometry:
    """Return the hull of a mesh, any other shape as it is."""
    if not isinstance(shape, coal.BVHModelBase):
        return shape
    try:
        shape.buildConvexHull(True, "Qt")
    except RuntimeError as reason:  # of what is flat
        raise ShapeError(str(reason)) from None
    return shape.convex


def mesh_of(vertices: F64, triangles: NDArray[np.int64]) -> coal.BVHModelOBBRSS:
    corners, indices = coal.StdVec_Vec3s(), coal.StdVec_Triangle()
    corners.extend(list(vertices))
    indices.extend([coal.Triangle(*map(int, t)) for t in triangles])
    mesh = coal.BVHModelOBBRSS()
    mesh.beginModel(len(triangles), len(vertices))
    mesh.addSubModel(corners, indices)
    mesh.endModel()
    return mesh


def loaded(name: str, scale: Three) -> coal.BVHModelBase:
    try:
        return coal.MeshLoader(coal.NODE_TYPE.BV_OBBRSS).load(name, np.asarray(scale, dtype=np.float64))
    except (RuntimeError, ValueError) as reason:
        raise ShapeError(str(reason)) from None


def nearest(one: Body, other: Body, sight: float) -> Near | None:
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
    return Near(np.array(best.getNearestPoint1()), np.array(best.getNearestPoint2()), normal, best.min_distance)

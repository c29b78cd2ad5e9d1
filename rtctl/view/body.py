"""The robot as triangles that hang on joints: its visual meshes where they are, else its collision bodies."""

import math
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import coal
import numpy as np
import pinocchio as pin
import trimesh

from rtctl.errors import LogError
from rtctl.log.header import Header
from rtctl.log.record.draw import quaternion, rotation
from rtctl.log.record.meshes import unpacked
from rtctl.plain import Json
from rtctl.spec.urdf import package_folders, share_folders
from rtctl.types import F64, I64

GREY = (205, 208, 214)
Pose = tuple[list[float], list[float]]  # position (3,) [m] and wxyz


class Piece(NamedTuple):
    """A part of a link."""

    name: str
    joint: int  # of the model, that it moves with
    X: F64  # (4, 4) in the joint's frame
    vertices: F64  # (v, 3) [m]
    faces: I64  # (f, 3)
    colour: tuple[int, int, int]


class Body:
    """An arm: where its parts and protected points are at positions q."""

    def __init__(
        self, header: Header, base: Json, points: Sequence[Sequence[float]], folder: Path | None = None
    ) -> None:
        """base: pose of the arm as SCENE_FILE has it; points: [joint, x, y, z, radius] likewise.

        folder: of the config's URDF, for meshes beside it; None when the header comes from a log: it opens no file
        that a log names, only those of installed packages and its own attachments.
        """
        self.base = np.eye(4)
        self.base[:3, :3] = rotation(base.get("wxyz", (1, 0, 0, 0)))
        self.base[:3, 3] = base.get("position", (0, 0, 0))
        self.model = pin.buildModelFromXML(header.urdf)
        self.data = self.model.createData()
        self._q = pin.neutral(self.model)
        self._at = [self._index(name) for name in header.joints]
        self._carriers = [0, *(self.model.getJointId(name) for name in header.joints)]
        sound = [p for p in points if len(p) == 5 and 0 <= int(p[0]) < len(self._carriers)]
        self.points = [(self._carriers[int(p[0])], np.array(p[1:4], np.float64), float(p[4])) for p in sound]
        self.pieces = pieces_of(self.model, header, folder)
        pin.forwardKinematics(self.model, self.data, self._q)

    def _index(self, name: str) -> tuple[int, bool]:
        """Return where a joint's position stands in the model's, and whether it is there as cosine and sine."""
        if not self.model.existJointName(name):
            raise LogError(f"the URDF has no joint {name}")
        joint = self.model.joints[self.model.getJointId(name)]
        return joint.idx_q, joint.nq == 2

    def move(self, q: F64) -> None:
        """Take the arm to positions q (n,) [rad or m]."""
        for (at, is_circle), value in zip(self._at, q.tolist(), strict=True):
            if is_circle:
                self._q[at], self._q[at + 1] = math.cos(value), math.sin(value)
            else:
                self._q[at] = value
        pin.forwardKinematics(self.model, self.data, self._q)

    def carried(self) -> list[tuple[int, int]]:
        """Return the joints, each after the one that carries it, and that one: 0 is the base, which is in the world."""
        return [(joint, int(self.model.parents[joint])) for joint in range(1, self.model.njoints)]

    def pose(self, joint: int) -> Pose:
        """Return where a joint's frame is now in that of the joint that carries it; of the base (0) in the world."""
        if joint == 0:
            return split(self.base)
        x, y, z, *turn, w = pin.SE3ToXYZQUAT(self.data.liMi[joint]).tolist()
        return [x, y, z], [w, *turn]

    def reach(self) -> float:
        """Return how far [m] from its base the arm has a part, where it stands now; 1 m for one without parts."""
        far = [
            np.linalg.norm(
                piece.vertices @ (X := self.data.oMi[piece.joint].homogeneous @ piece.X)[:3, :3].T + X[:3, 3], axis=1
            ).max()
            for piece in self.pieces
            if len(piece.vertices)
        ]
        return float(max(far, default=1.0))

    def point(self, index: int) -> F64 | None:
        """Return where (3,) [m] a protected point is now; None when there is none of that index."""
        if not 0 <= index < len(self.points):
            return None
        joint, local, _ = self.points[index]
        at = self.base @ self.data.oMi[joint].homogeneous
        return np.asarray(at[:3, :3] @ local + at[:3, 3])


def split(X: F64) -> Pose:
    """Return a homogeneous transform (4, 4) as a position and a quaternion."""
    return X[:3, 3].tolist(), list(quaternion(X[:3, :3]))


def pieces_of(model: pin.Model, header: Header, folder: Path | None) -> list[Piece]:
    """Return the parts of all links that can be found: visual ones, for a link without any its collision bodies."""
    with tempfile.TemporaryDirectory(prefix="rtctl-view-") as name:
        try:
            urdf, _ = unpacked(header.urdf, header.config, header.files, Path(name))
        except LogError:
            urdf = header.urdf
        found: dict[str, list[Piece]] = {}
        for kind, tag in ((pin.GeometryType.VISUAL, "visual"), (pin.GeometryType.COLLISION, "collision")):
            text = _resolved(urdf if tag == "collision" else header.urdf, tag, folder, Path(name))
            for link, piece in _loaded(model, text, kind):
                found.setdefault(f"{tag} {link}", []).append(piece)
    links = {key.partition(" ")[2] for key in found}
    return [piece for link in sorted(links) for piece in found.get(f"visual {link}") or found[f"collision {link}"]]


def _resolved(urdf: str, tag: str, folder: Path | None, unpacked_to: Path) -> str:
    """Return the URDF with whole paths for its meshes; what names a mesh that is not there is left out."""
    root = ET.fromstring(urdf)
    places = package_folders(folder / "any.urdf") if folder is not None else share_folders()
    for link in root.iterfind("link"):
        for each in [e for e in link if e.tag in ("visual", "collision")]:
            mesh = each.find("geometry/mesh")
            if each.tag != tag:
                link.remove(each)
            elif mesh is not None:
                path = _file(mesh.get("filename", ""), places, folder, unpacked_to)
                if path is None:
                    link.remove(each)
                else:
                    mesh.set("filename", str(path))
    return ET.tostring(root, encoding="unicode")


def _file(name: str, places: Sequence[Path], folder: Path | None, unpacked_to: Path) -> Path | None:
    if name.startswith("package://"):
        inside = name.removeprefix("package://")
        return next((p / inside for p in places if (p / inside).is_file()), None)
    path = Path(name.removeprefix("file://"))
    if path.parent == unpacked_to:
        return path if path.is_file() else None
    if folder is None:
        return None
    return folder / path if (folder / path).is_file() else None


def _loaded(model: pin.Model, urdf: str, kind: pin.GeometryType) -> list[tuple[str, Piece]]:
    """Return the parts of a URDF's text with the links that have them."""
    try:
        geometry = pin.buildGeomFromUrdfString(model, urdf, kind)
    except (ValueError, RuntimeError):  # a file that is no mesh: the arm is drawn without
        return []
    found = []
    for each in geometry.geometryObjects:
        surface = surface_of(each.geometry)
        if surface is not None:
            r, g, b, _ = (round(255 * float(v)) for v in each.meshColor)
            colour = GREY if (r, g, b) == (230, 230, 230) else (r, g, b)  # the loader's default
            piece = Piece(each.name, int(each.parentJoint), each.placement.homogeneous, *surface, colour)
            found.append((model.frames[each.parentFrame].name, piece))
    return found


def surface_of(geometry: object) -> tuple[F64, I64] | None:
    """Return vertices (v, 3) [m] and faces (f, 3) of one of coal's bodies; None for one that is not known."""
    if isinstance(geometry, coal.BVHModelBase):
        faces = [[t[0], t[1], t[2]] for t in (geometry.tri_indices(k) for k in range(geometry.num_tris))]
        return np.array(geometry.vertices(), np.float64), np.array(faces, np.int64)
    mesh = None
    if isinstance(geometry, coal.Cylinder):
        mesh = trimesh.creation.cylinder(radius=geometry.radius, height=2 * geometry.halfLength)
    elif isinstance(geometry, coal.Sphere):
        mesh = trimesh.creation.icosphere(radius=geometry.radius)
    elif isinstance(geometry, coal.Box):
        mesh = trimesh.creation.box(extents=2 * geometry.halfSide)
    elif isinstance(geometry, coal.Capsule):
        mesh = trimesh.creation.capsule(height=2 * geometry.halfLength, radius=geometry.radius)
    return None if mesh is None else (np.array(mesh.vertices, np.float64), np.array(mesh.faces, np.int64))

"""What obstacles take from files: meshes, checked and made into solids; clouds of points, thinned and packed.

All of it happens when a file is loaded or before a message is sent, never in the servo.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rtctl.errors import ConfigError
from rtctl.kernel.rotations import R_of
from rtctl.spec.base import BaseConfig
from rtctl.spec.files import read_cloud, read_mesh
from rtctl.spec.obstacles import Cloud, Mesh, Obstacle, mesh_key
from rtctl.spec.read import name_place
from rtctl.spec.robot import Config, MeshTable
from rtctl.types import F64, I64, Shape
from rtctl.world import meshes as solids
from rtctl.world.meshes import Meshes, added, mesh_body
from rtctl.world.primitives import CLOUD_POINTS, STEP_MAX, STEP_MIN
from rtctl.world.tree import POINTS_PER_LEAF, ordered

WHOLE = 32767  # steps from the centre, of int16
PLACE_MAX, SPAN_MAX, SPAN_MIN = 9000.0, 100.0, 1e-4  # [m] as of places and of the largest and smallest obstacles
COARSER = 1.25  # factor on the voxels of a cloud that has still too many points


def files_named(config: Config | BaseConfig) -> tuple[str, ...]:
    """Return the files that a config's meshes and obstacles name, an arm's or a base's."""
    named = [getattr(each, "file", None) for each in (*getattr(config, "mesh", ()), *config.obstacle)]
    return tuple(sorted({str(name) for name in named if name}))


def refuse_extreme(points: F64, scale: float = 1.0, span: bool = True) -> None:
    """Raise ValueError for points (n, 3) that no obstacle of a robot can have once they are times `scale` [m].

    They lie where places may lie; span: and are as large as solids may be.
    """
    far = float(np.abs(points).max(initial=0.0))  # before it is scaled: that may pass what a number can be
    if far > PLACE_MAX / scale:
        raise ValueError(f"a point {far:.4g} units of {scale:g} m from the origin, wanted at most {PLACE_MAX:g} m")
    size = scale * float(np.ptp(points, axis=0).max()) if span and len(points) else SPAN_MIN
    if not SPAN_MIN <= size <= SPAN_MAX:
        raise ValueError(f"a solid of {size:.4g} m, wanted {SPAN_MIN:g} to {SPAN_MAX:g} m")


class Packed(NamedTuple):
    """A cloud as the controller takes it; every ball of the points it was made from lies within its balls."""

    steps: bytes  # x, y, z of each point in whole steps from the centre, int16, in the order of a balanced tree
    step: float  # [m]
    centre: F64  # (3,) [m]
    radius: float  # [m] of the points, and what thinning and rounding may have moved them

    @property
    def points(self) -> int:
        """Return how many there are."""
        return len(self.steps) // 6


class Assets(NamedTuple):
    """The files behind a list of obstacles."""

    meshes: Meshes
    clouds: Mapping[str, Packed]  # by the obstacle's name


def packed(points: F64, radius: float, voxel: float = 0.0) -> Packed:
    """Return points (n, 3) [m] of balls of `radius` [m] as whole steps, at most CLOUD_POINTS of them.

    One point, the mean, stands for all in a cube of `voxel` [m]; 0 keeps every point. Too many: the cubes grow. The
    radius grows by the largest distance of a point to the one that stands for it, at most sqrt(3) voxel and half a
    step each way. Raises ValueError for points that are none.
    """
    if points.ndim != 2 or points.shape[1] != 3 or not len(points) or not np.all(np.isfinite(points)):
        raise ValueError("wanted one or more rows of three finite numbers")
    refuse_extreme(points, span=False)
    size = np.ptp(points, axis=0)
    few, index = _thinned(points, voxel)
    voxel = voxel or float(size.max()) / 250.0
    while len(few) > CLOUD_POINTS:
        few, index = _thinned(points, voxel)
        voxel *= COARSER
    centre = points.min(axis=0) + 0.5 * size
    step = max(STEP_MIN, 0.5 * float(size.max()) / WHOLE)
    if step > STEP_MAX:
        raise ValueError(f"points that span {size.max():.4g} m, wanted at most {2.0 * WHOLE * STEP_MAX:.4g}")
    steps = np.rint((few - centre) / step)
    moved = float(np.linalg.norm(points - (centre + step * steps)[index], axis=1).max())
    order = ordered(steps, POINTS_PER_LEAF)
    return Packed(steps[order].astype("<i2").tobytes(), step, centre, radius + moved)


def _thinned(points: F64, voxel: float) -> tuple[F64, I64]:
    """Return the points that stand for all, one for each cube, and for each point the index of its own."""
    if voxel == 0.0:
        return points, np.arange(len(points))
    cells = np.floor((points - points.min(axis=0)) / voxel).astype(np.int64)
    _, index, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    index = index.reshape(-1)
    few = np.stack([np.bincount(index, points[:, k]) for k in range(3)], axis=1) / count[:, None]
    return few, index


def placed(shape: Shape, cloud: Packed) -> Shape:
    """Return the shape of a cloud obstacle with its points: the frame goes to their centre, and moves as it did."""
    arm = R_of(shape.wxyz) @ cloud.centre
    return shape._replace(
        position=shape.position + arm,
        velocity=shape.velocity + np.cross(shape.omega, arm),
        dims=np.array([cloud.radius, cloud.step, 0.0, 0.0]),
        cloud=cloud.steps,
    )


def load_mesh(path: Path, scale: float, hull: bool, place: str) -> F64:
    """Return the body of a mesh file. Raises ConfigError, one line that names `place` and the file."""
    try:
        vertices, triangles = read_mesh(path)
        refuse_extreme(vertices, scale)
        return mesh_body(vertices * scale, triangles, hull)
    except OSError as error:
        raise ConfigError(place, f"{path}: {(error.strerror or 'unreadable').lower()}", "an STL or OBJ file") from None
    except ValueError as error:
        raise ConfigError(place, f"{path}: {error}", "a closed triangle mesh (STL, OBJ)") from None


def load_cloud(path: Path, radius: float, voxel: float, place: str) -> Packed:
    """Return a cloud file packed. Raises ConfigError, one line that names `place` and the file."""
    try:
        return packed(read_cloud(path), radius, voxel)
    except OSError as error:
        wanted = "an NPY, XYZ or PLY file"
        raise ConfigError(place, f"{path}: {(error.strerror or 'unreadable').lower()}", wanted) from None
    except ValueError as error:
        raise ConfigError(place, f"{path}: {error}", "points x y z (NPY, XYZ, PLY)") from None


def load_assets(
    tables: Iterable[MeshTable], obstacles: Iterable[Obstacle], source: Path, known: Meshes = solids.NONE
) -> Assets:
    """Return the files of [[mesh]] tables and of obstacles, found beside `source`; `known` meshes come first.

    Raises ConfigError for a file that is missing or no solid, and for an obstacle of a mesh that nobody named.
    """
    meshes, clouds, folder = known, {}, source.resolve().parent
    for i, table in enumerate(tables):
        place = name_place(str(source), f"mesh[{i}]")
        if table.name in meshes.names:
            raise ConfigError(f"{place}.name", table.name, "a name not used before")
        body = load_mesh(folder / table.file, table.scale, table.hull, f"{place}.file")
        meshes = added(meshes, table.name, body)
    for i, obstacle in enumerate(obstacles):
        place = name_place(str(source), f"obstacle[{i}]")
        if isinstance(obstacle, Mesh) and obstacle.file is not None:
            body = load_mesh(folder / obstacle.file, obstacle.scale, obstacle.hull, f"{place}.file")
            meshes = added(meshes, mesh_key(obstacle), body)
        elif isinstance(obstacle, Mesh) and obstacle.mesh not in meshes.names:
            wanted = f"one of the config's [[mesh]] names: {', '.join(meshes.names) or 'it has none'}"
            raise ConfigError(f"{place}.mesh", obstacle.mesh, wanted)
        elif isinstance(obstacle, Cloud) and obstacle.file is not None:
            file, radius = folder / obstacle.file, obstacle.point_radius_m
            clouds[obstacle.name] = load_cloud(file, radius, obstacle.voxel_m, f"{place}.file")
    return Assets(meshes, clouds)

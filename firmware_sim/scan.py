"""Clouds of points: read from a file, packed as a camera's driver sends them, and made into a shape for pybullet.

pybullet takes no ten thousand balls, but a mesh of as many triangles: each point becomes a tiny one, and the radius of
the balls is taken off the distance that pybullet measures.
"""

import io
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from firmware_sim.settings import SettingsError

F64 = NDArray[np.float64]
POINTS_MAX = 10_000
SPECK = 1e-5  # [m] of the triangle that stands for a point
_TYPES = {"float": "f4", "float32": "f4", "double": "f8", "float64": "f8", "uchar": "u1", "uint8": "u1", "int": "i4"}


class Scan(NamedTuple):
    """A cloud in the frame of its obstacle, whose origin is moved to `centre` in what a camera reports."""

    points: F64  # (n, 3) [m]
    radius: float  # [m]
    centre: F64  # (3,) [m]
    step: float  # [m]
    steps: bytes  # x, y, z of each point in steps from the centre, little-endian int16
    reported: float  # [m] the radius, and what rounding to steps can move a point


def load_scan(path: Path, radius: float, name: str) -> Scan:
    """Return the cloud of an NPY, XYZ or PLY file. Raises SettingsError."""
    try:
        points = _points(path)
    except (OSError, ValueError, KeyError, IndexError) as error:
        raise SettingsError(f"obstacle {name}: {path}: {error}") from error
    if not 1 <= len(points) <= POINTS_MAX or not np.all(np.isfinite(points)):
        raise SettingsError(f"obstacle {name}: {path}: {len(points)} points, wanted 1 to {POINTS_MAX}, all finite")
    low, size = points.min(axis=0), np.ptp(points, axis=0)
    centre, step = low + 0.5 * size, max(1e-6, float(size.max()) / 65534.0)
    steps = np.rint((points - centre) / step).astype(np.int64)
    order = np.argsort(_morton((points - low) / max(float(size.max()), 1e-9)), kind="stable")
    packed = steps[order].astype("<i2").tobytes()
    return Scan(points, radius, centre, step, packed, radius + 0.5 * 3.0**0.5 * step)


def specks(points: F64) -> tuple[list[list[float]], list[int]]:
    """Return vertices and indices of a mesh with a tiny triangle at each point."""
    corners = SPECK * np.array([[1.0, 0.0, 0.0], [-0.5, 0.8, 0.0], [-0.5, -0.4, 0.7]])
    vertices = (points[:, None, :] + corners).reshape(-1, 3)
    return vertices.tolist(), list(range(len(vertices)))


def _morton(unit: F64) -> NDArray[np.int64]:
    """Return the place of points in the unit cube along a curve that keeps neighbours together."""
    cells = (unit * 1023.0).astype(np.int64)
    code = np.zeros(len(cells), dtype=np.int64)
    for bit in range(10):
        for axis in range(3):
            code |= (cells[:, axis] >> bit & 1) << (3 * bit + axis)
    return code


def _points(path: Path) -> F64:
    kind = path.suffix.lower()
    if kind == ".npy":
        points = np.load(path, allow_pickle=False)
    elif kind == ".ply":
        points = _ply(path.read_bytes())
    elif kind == ".xyz":
        points = np.loadtxt(io.StringIO(path.read_text().replace(",", " ")), ndmin=2)
    else:
        raise ValueError(f"a file that ends in {kind or 'nothing'}, wanted .npy, .xyz or .ply")
    if points.ndim != 2 or points.shape[1] < 3:
        raise ValueError(f"an array of shape {points.shape}, wanted rows of x y z")
    return np.ascontiguousarray(points[:, :3], dtype=np.float64)


def _ply(raw: bytes) -> F64:
    head, _, body = raw.partition(b"end_header\n")
    lines = [line.split() for line in head.decode("latin-1").splitlines()]
    count = next(int(line[2]) for line in lines if line[:2] == ["element", "vertex"])
    fields = [(line[2], _TYPES[line[1]]) for line in lines if line[:1] == ["property"] and len(line) == 3]
    if ["format", "ascii", "1.0"] in lines:
        rows = np.loadtxt(io.StringIO(body.decode("latin-1")), ndmin=2, max_rows=count)
        return rows[:, [[name for name, _ in fields].index(c) for c in "xyz"]]
    table = np.frombuffer(body, np.dtype([(name, "<" + kind) for name, kind in fields]), count)
    return np.stack([table[c] for c in "xyz"], axis=1)

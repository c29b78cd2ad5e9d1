"""Mesh and point-cloud files: STL and OBJ, NPY, XYZ and PLY, read as plain numbers and nothing else.

Every reader raises ValueError, one line; OSError where the file cannot be read.
"""

import io
import struct
from itertools import pairwise
from pathlib import Path

import numpy as np

from rtctl.types import F64, I64

BYTES_MAX = 64 << 20
MESHES, CLOUDS = (".stl", ".obj"), (".npy", ".xyz", ".ply")
_PLY = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip


def read_mesh(path: Path) -> tuple[F64, I64]:
    """Return the vertices (v, 3) and triangles (t, 3) of an STL or OBJ file, as the file has them."""
    kind, raw = path.suffix.lower(), _bytes(path, MESHES)
    vertices, triangles = _stl(raw) if kind == ".stl" else _obj(raw)
    if not len(triangles):
        raise ValueError("no triangles")
    if not np.all(np.isfinite(vertices)):
        raise ValueError("a vertex that is not a number")
    return vertices, triangles


def read_cloud(path: Path) -> F64:
    """Return the points (n, 3) of an NPY, XYZ or PLY file; columns beyond the third are passed over."""
    kind, raw = path.suffix.lower(), _bytes(path, CLOUDS)
    points = _npy(raw) if kind == ".npy" else (_ply(raw) if kind == ".ply" else _xyz(raw))
    if points.ndim != 2 or points.shape[1] < 3 or not len(points):
        raise ValueError(f"an array of shape {points.shape}, wanted rows of x y z")
    points = np.ascontiguousarray(points[:, :3], dtype=np.float64)
    if not np.all(np.isfinite(points)):
        raise ValueError("a point that is not a number")
    return points


def _bytes(path: Path, kinds: tuple[str, ...]) -> bytes:
    if path.suffix.lower() not in kinds:
        raise ValueError(f"a file called {path.name}, wanted one that ends in {', '.join(kinds)}")
    if path.stat().st_size > BYTES_MAX:
        raise ValueError(f"a file of {path.stat().st_size} bytes, wanted at most {BYTES_MAX}")
    return path.read_bytes()


def _stl(raw: bytes) -> tuple[F64, I64]:
    count = struct.unpack_from("<I", raw, 80)[0] if len(raw) >= 84 else -1
    if len(raw) == 84 + 50 * count:
        facets = np.frombuffer(raw, np.dtype([("n", "<f4", 3), ("v", "<f4", (3, 3)), ("rest", "<u2")]), offset=84)
        corners = facets["v"].reshape(-1, 3).astype(np.float64)
    elif raw[:5].lower() == b"solid":
        rows = [line.split()[1:] for line in raw.decode("latin-1").splitlines() if line.split()[:1] == ["vertex"]]
        if any(len(row) != 3 for row in rows) or len(rows) % 3:
            raise ValueError("an ASCII STL with a facet that has not three vertices of three numbers")
        corners = np.array(rows, dtype=np.float64).reshape(-1, 3)
    else:
        raise ValueError("a file that is neither binary nor ASCII STL, or is cut short")
    return corners, np.arange(len(corners), dtype=np.int64).reshape(-1, 3)


def _obj(raw: bytes) -> tuple[F64, I64]:
    vertices: list[list[float]] = []
    triangles: list[tuple[int, int, int]] = []
    for at, line in enumerate(raw.decode("latin-1").splitlines(), 1):
        words = line.split()
        if words[:1] == ["v"]:
            vertices.append([float(word) for word in words[1:4]])
            if len(vertices[-1]) != 3:
                raise ValueError(f"line {at}: a vertex without three numbers")
        elif words[:1] == ["f"]:
            numbers = [int(word.split("/")[0]) for word in words[1:]]
            face = [n - 1 if n > 0 else len(vertices) + n for n in numbers]
            if len(face) < 3 or 0 in numbers or min(face) < 0:
                raise ValueError(f"line {at}: not a face")
            triangles += [(face[0], b, c) for b, c in pairwise(face[1:])]
    T = np.array(triangles, dtype=np.int64).reshape(-1, 3)
    if len(T) and T.max() >= len(vertices):
        raise ValueError(f"a face with vertex {T.max() + 1} of {len(vertices)}")
    return np.array(vertices, dtype=np.float64).reshape(-1, 3), T


def _npy(raw: bytes) -> F64:
    points: F64 = np.load(io.BytesIO(raw), allow_pickle=False)
    if not isinstance(points, np.ndarray) or points.dtype.kind not in "fiu":
        raise ValueError("an NPY file without an array of numbers")
    return points


def _xyz(raw: bytes) -> F64:
    rows = [line.replace(",", " ").split()[:3] for line in raw.decode("latin-1").splitlines()]
    rows = [row for row in rows if row and not row[0].startswith("#")]
    if any(len(row) != 3 for row in rows):
        raise ValueError("a line without three numbers")
    return np.array(rows, dtype=np.float64).reshape(-1, 3)


def _ply(raw: bytes) -> F64:
    """Read the first element of a PLY file, which must be its vertices with scalar properties x, y, z."""
    head, end, body = raw.partition(b"end_header")
    lines = [line.split() for line in head.decode("latin-1").splitlines() if line.split()]
    if not end or lines[0] != ["ply"]:
        raise ValueError("a file without the header of PLY")
    body = body[body.index(b"\n") + 1 :] if b"\n" in body else b""
    form = next((line[1] for line in lines if line[0] == "format" and len(line) > 1), "")
    starts = [k for k, line in enumerate(lines) if line[0] == "element"]
    if not starts or len(lines[starts[0]]) != 3 or lines[starts[0]][1] != "vertex":
        raise ValueError("a PLY file that does not begin with its vertices")
    count = int(lines[starts[0]][2])
    stop = starts[1] if len(starts) > 1 else len(lines)
    fields = [line[1:] for line in lines[starts[0] : stop] if line[0] == "property"]
    if any(len(field) != 2 or field[0] not in _PLY for field in fields):
        raise ValueError("a PLY file whose vertices carry lists or unknown types")
    names = [name for _, name in fields]
    if not {"x", "y", "z"} <= set(names):
        raise ValueError("a PLY file whose vertices have no x, y, z")
    if form == "ascii":
        rows = [line.split() for line in body.decode("latin-1").splitlines()[:count]]
        if len(rows) != count or any(len(row) != len(names) for row in rows):
            raise ValueError(f"fewer than {count} vertices of {len(names)} numbers")
        table = np.array(rows, dtype=np.float64).reshape(count, len(names))
        return np.stack([table[:, names.index(c)] for c in "xyz"], axis=1)
    if form not in ("binary_little_endian", "binary_big_endian"):
        raise ValueError(f"a PLY format {form!r}")
    order = "<" if form == "binary_little_endian" else ">"
    data = np.frombuffer(body, np.dtype([(name, order + _PLY[kind]) for kind, name in fields]), count)
    return np.stack([data[c].astype(np.float64) for c in "xyz"], axis=1)

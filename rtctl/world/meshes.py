"""Triangle meshes as solids: checked, ordered and given the normals by which the servo tells inside from outside.

A mesh is measured by its own triangles, not by convex pieces: the distance is exact, inside as well, and no
approximation comes between the file and the arm. For that it must enclose a volume. Done once, when a file is loaded.
"""

import math
from typing import NamedTuple

import numpy as np

from rtctl.kernel import kernel
from rtctl.types import F64, I64
from rtctl.world.tree import HEAD, TRIANGLES_PER_LEAF, fill_boxes, leaves_for, ordered

TRIANGLES_MAX = 50_000  # of one mesh
PROBES = 200  # triangles on either side of which the winding number is asked for


class Meshes(NamedTuple):
    """The solids that obstacles may refer to by name."""

    names: tuple[str, ...]
    starts: tuple[int, ...]  # of each body in `data`
    data: F64  # bodies of `bvh`, one behind the other

    def start(self, name: str) -> int:
        """Return where the body of a name begins, -1 where there is none."""
        return self.starts[self.names.index(name)] if name in self.names else -1

    def body(self, name: str) -> F64:
        """Return the body of a name. Raises ValueError where there is none."""
        at = self.names.index(name)
        return self.data[self.starts[at] : self.starts[at + 1] if at + 1 < len(self.starts) else None]


NONE = Meshes((), (), np.zeros(0))


def added(meshes: Meshes, name: str, body: F64) -> Meshes:
    """Return the meshes with one more."""
    start = meshes.data.shape[0]
    return Meshes((*meshes.names, name), (*meshes.starts, start), np.concatenate([meshes.data, body]))


def mesh_body(vertices: F64, triangles: I64, hull: bool = False) -> F64:
    """Return the body of `bvh` of a closed surface: vertices (v, 3) [m], triangles (t, 3) of indices.

    hull: take the convex hull of the vertices instead, whatever the triangles are. A surface that is inside out is
    turned. Raises ValueError, one line, for a surface that encloses no volume: open, crossing itself, flat, too large.
    """
    V, T = _hull(vertices) if hull else _merged(vertices, triangles)
    if not 4 <= len(T) <= TRIANGLES_MAX:
        raise ValueError(f"{len(T)} triangles, wanted 4 to {TRIANGLES_MAX}")
    _refuse_open(V, T)
    volume = float(np.einsum("ij,ij->", V[T[:, 0]], np.cross(V[T[:, 1]], V[T[:, 2]]))) / 6.0
    if abs(volume) < 1e-12 * float(np.ptp(V, axis=0).max()) ** 3:
        raise ValueError("a surface that encloses no volume")
    T = T if volume > 0.0 else np.ascontiguousarray(T[:, ::-1])
    T = T[ordered(np.ascontiguousarray(V[T].mean(axis=1)), TRIANGLES_PER_LEAF)]
    faces, edges, corners = _normals(V, T)
    if not hull:
        _refuse_crossing(V, T, faces)
    n = len(T)
    leaves = leaves_for(n, TRIANGLES_PER_LEAF)
    body = np.zeros(HEAD + 12 * leaves + 30 * n)
    body[:2], body[3] = (n, leaves), 9.0
    items = HEAD + 12 * leaves
    body[items : items + 9 * n] = V[T].ravel()
    body[items + 9 * n :] = np.concatenate([faces[:, None], edges, corners], axis=1).ravel()
    fill_boxes(body)
    return body


def _hull(vertices: F64) -> tuple[F64, I64]:
    """Return vertices and outward triangles of the convex hull."""
    from scipy.spatial import ConvexHull, QhullError  # half of the time that all else takes to be imported

    try:
        found = ConvexHull(vertices)
    except (QhullError, ValueError):
        raise ValueError("vertices that span no volume") from None
    T = found.simplices.astype(np.int64)
    n = np.cross(vertices[T[:, 1]] - vertices[T[:, 0]], vertices[T[:, 2]] - vertices[T[:, 0]])
    inward = np.einsum("ij,ij->i", n, found.equations[:, :3]) < 0.0
    T[inward] = T[inward][:, ::-1]
    return vertices, T


def _merged(vertices: F64, triangles: I64) -> tuple[F64, I64]:
    """Return the mesh with equal vertices made one (an STL repeats them), without triangles that are none."""
    V, index = np.unique(vertices + 0.0, axis=0, return_inverse=True)
    T = index.reshape(-1)[triangles]
    whole = (T[:, 0] != T[:, 1]) & (T[:, 1] != T[:, 2]) & (T[:, 2] != T[:, 0])
    return V, np.ascontiguousarray(T[whole].astype(np.int64))


def _edges(T: I64) -> tuple[I64, I64]:
    """Return the edges as they run in their triangles: from (3 t,), to (3 t,), in the order ab, bc, ca of each."""
    return T.ravel(), np.roll(T, -1, axis=1).ravel()


def _refuse_open(V: F64, T: I64) -> None:
    """Refuse a surface on which some edge does not run once each way."""
    a, b = _edges(T)
    count = len(V)
    there, back = np.sort(a * count + b), np.sort(b * count + a)
    if np.any(there[1:] == there[:-1]):
        twice = there[1:][there[1:] == there[:-1]][0]
        place = np.array2string(V[twice // count], precision=4)
        raise ValueError(f"a surface that folds: an edge at {place} runs twice the same way; hull = true wraps it")
    if not np.array_equal(there, back):
        lone = np.setdiff1d(there, back)
        place = np.array2string(V[lone[0] // count], precision=4)
        raise ValueError(f"a surface with {len(lone)} open edges, one at {place}; hull = true wraps it")


def _unit(v: F64) -> F64:
    size = np.linalg.norm(v, axis=-1, keepdims=True)
    return np.asarray(np.divide(v, size, out=np.zeros_like(v), where=size > 0.0))


def _normals(V: F64, T: I64) -> tuple[F64, F64, F64]:
    """Return unit normals of faces (t, 3), of their edges (t, 3, 3) and corners (t, 3, 3).

    Of an edge: the mean of its two faces; of a corner: its faces weighted by their angles there.
    """
    p = V[T]  # (t, corner, 3)
    faces = _unit(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]))
    a, b = _edges(T)
    there, back = a * len(V) + b, b * len(V) + a
    by_edge = np.argsort(there)
    other = by_edge[np.searchsorted(there[by_edge], back)] // 3  # the triangle on the other side
    edges = _unit(faces[np.arange(3 * len(T)) // 3] + faces[other]).reshape(-1, 3, 3)
    to_next, to_last = _unit(np.roll(p, -1, axis=1) - p), _unit(np.roll(p, 1, axis=1) - p)
    angle = np.arccos(np.clip(np.einsum("tci,tci->tc", to_next, to_last), -1.0, 1.0))
    total = np.zeros_like(V)
    np.add.at(total, T.ravel(), (angle[:, :, None] * faces[:, None]).reshape(-1, 3))
    return faces, edges, _unit(total)[T]


@kernel
def winding(V: F64, T: I64, X: F64) -> F64:
    """Return how often the surface winds about points X (m, 3), 1 inside, 0 outside (van Oosterom, Strackee 1983)."""
    turns = np.zeros(X.shape[0])
    for i in range(X.shape[0]):
        x, y, z = X[i, 0], X[i, 1], X[i, 2]
        for t in range(T.shape[0]):
            j, k, l = T[t, 0], T[t, 1], T[t, 2]
            ax, ay, az = V[j, 0] - x, V[j, 1] - y, V[j, 2] - z
            bx, by, bz = V[k, 0] - x, V[k, 1] - y, V[k, 2] - z
            cx, cy, cz = V[l, 0] - x, V[l, 1] - y, V[l, 2] - z
            a = math.sqrt(ax * ax + ay * ay + az * az)
            b = math.sqrt(bx * bx + by * by + bz * bz)
            c = math.sqrt(cx * cx + cy * cy + cz * cz)
            det = ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx)
            ab, bc, ca = ax * bx + ay * by + az * bz, bx * cx + by * cy + bz * cz, cx * ax + cy * ay + cz * az
            turns[i] += math.atan2(det, a * b * c + ab * c + bc * a + ca * b) / (2.0 * math.pi)
    return turns


def _refuse_crossing(V: F64, T: I64, faces: F64) -> None:
    """Refuse a surface that, somewhere just above or below itself, is not between outside and inside."""
    area = np.linalg.norm(np.cross(V[T[:, 1]] - V[T[:, 0]], V[T[:, 2]] - V[T[:, 0]]), axis=1)
    large = np.flatnonzero(area > 1e-9 * area.max())
    probe = large[np.linspace(0, len(large) - 1, min(PROBES, len(large))).astype(np.int64)]
    centre, step = V[T[probe]].mean(axis=1), 1e-7 * float(np.ptp(V, axis=0).max())
    above, below = winding(V, T, centre + step * faces[probe]), winding(V, T, centre - step * faces[probe])
    wrong = np.flatnonzero((np.abs(above) > 0.1) | (np.abs(below - 1.0) > 0.1))
    if len(wrong):
        place = np.array2string(centre[wrong[0]], precision=4)
        raise ValueError(f"a surface that crosses itself or is inside out near {place}; hull = true wraps it")

"""Closed surfaces and clouds for tests, with what is known of them without any distance code."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rtctl.types import F64, I64, Shape
from rtctl.world.meshes import NONE, Meshes, added, mesh_body

UNIT = np.array([1.0, 0.0, 0.0, 0.0])


class Surface(NamedTuple):
    """A closed mesh, and whether points are inside it, by a rule that knows no triangles."""

    V: F64
    T: I64
    inside: Callable[[F64], np.ndarray]


def box(a: float, b: float, c: float, at: tuple[float, float, float] = (0, 0, 0)) -> Surface:
    """Return a box of half sizes a, b, c about `at`."""
    size, centre = np.array([a, b, c]), np.array(at, float)
    V = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float) * size + centre
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    T = np.array([t for i, j, k, l in quads for t in ((i, j, k), (i, k, l))])
    return Surface(V, T, lambda x: np.all(np.abs(x - centre) < size, axis=1))


def ell() -> Surface:
    """Return an L of 0.2 m, thick 0.06 m: two boxes' worth, with an edge that is not convex."""
    outline = np.array([[0, 0], [0.2, 0], [0.2, 0.06], [0.06, 0.06], [0.06, 0.2], [0, 0.2]], float) - 0.06
    V = np.concatenate([np.column_stack([outline, np.full(6, z)]) for z in (-0.03, 0.03)])
    low = [(0, 2, 1), (0, 3, 2), (0, 4, 3), (0, 5, 4)]
    sides = [t for i in range(6) for t in ((i, (i + 1) % 6, 6 + (i + 1) % 6), (i, 6 + (i + 1) % 6, 6 + i))]
    T = np.array([*low, *[(6 + a, 6 + c, 6 + b) for a, b, c in low], *sides])

    def inside(x: F64) -> np.ndarray:
        u, v, w = x[:, 0] + 0.06, x[:, 1] + 0.06, np.abs(x[:, 2])
        arms = ((u < 0.2) & (v < 0.06)) | ((u < 0.06) & (v < 0.2))
        return np.asarray(arms & (u > 0.0) & (v > 0.0) & (w < 0.03))

    return Surface(V, T, inside)


def hollow() -> Surface:
    """Return a box with a box-shaped cavity: the inner surface is inside out."""
    outer, inner = box(0.2, 0.15, 0.1), box(0.1, 0.1, 0.05, (0.03, 0.0, 0.0))
    V, T = np.concatenate([outer.V, inner.V]), np.concatenate([outer.T, inner.T[:, ::-1] + 8])
    return Surface(V, T, lambda x: outer.inside(x) & ~inner.inside(x))


def torus(R: float = 0.15, r: float = 0.05, n: int = 48, m: int = 24) -> Surface:
    """Return a torus of n by m quadrangles; points within a facet's sagitta of the surface are not told apart."""
    u, v = np.meshgrid(np.arange(n) * 2 * np.pi / n, np.arange(m) * 2 * np.pi / m, indexing="ij")
    ring = R + r * np.cos(v)
    V = np.stack([ring * np.cos(u), ring * np.sin(u), r * np.sin(v)], -1).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(n), np.arange(m), indexing="ij")
    a, b, c, d = (((i + p) % n * m + (j + q) % m).ravel() for p, q in ((0, 0), (1, 0), (1, 1), (0, 1)))
    T = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    return Surface(V, T, lambda x: np.hypot(np.hypot(x[:, 0], x[:, 1]) - R, x[:, 2]) < r)


SURFACES = {
    "box": box(0.1, 0.2, 0.3),
    "thin plate": box(0.2, 0.15, 0.001),
    "ell": ell(),
    "hollow": hollow(),
    "torus": torus(),
}


def sampled(surface: Surface, count: int, rng: np.random.Generator) -> F64:
    """Return points spread over the triangles by area."""
    p = surface.V[surface.T]
    area = np.linalg.norm(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), axis=1)
    p = p[rng.choice(len(p), count, p=area / area.sum())]
    s, t = rng.uniform(size=(2, count, 1))
    s, t = np.where(s + t > 1.0, 1.0 - s, s), np.where(s + t > 1.0, 1.0 - t, t)
    return np.asarray(p[:, 0] + s * (p[:, 1] - p[:, 0]) + t * (p[:, 2] - p[:, 0]))


def known(**surfaces: Surface) -> Meshes:
    """Return the surfaces as a robot's meshes, by their names."""
    meshes = NONE
    for name, s in surfaces.items():
        meshes = added(meshes, name, mesh_body(s.V, s.T))
    return meshes


def mesh_shape(name: str, position: F64 | None = None, wxyz: F64 = UNIT, label: str = "it") -> Shape:
    """Return the obstacle `label` of the mesh `name`."""
    zero = np.zeros(3)
    return Shape(label, "mesh", np.zeros(4), zero if position is None else position, wxyz, zero, zero, mesh=name)


def cloud_shape(steps: I64, step: float, radius: float, position: F64 | None = None, wxyz: F64 = UNIT) -> Shape:
    """Return a cloud of points at `steps` (n, 3) times `step` [m]."""
    zero = np.zeros(3)
    dims = np.array([radius, step, 0.0, 0.0])
    at = zero if position is None else position
    return Shape("cloud", "cloud", dims, at, wxyz, zero, zero, cloud=steps.astype("<i2").tobytes())


def write_obj(path: Path, surface: Surface, scale: float = 1.0) -> Path:
    """Write a surface as an OBJ file, in units of 1/scale metres."""
    lines = [f"v {x:.17g} {y:.17g} {z:.17g}" for x, y, z in surface.V / scale]
    path.write_text("\n".join([*lines, *(f"f {a + 1}//1 {b + 1}//1 {c + 1}//1" for a, b, c in surface.T)]) + "\n")
    return path


def write_stl(path: Path, surface: Surface, ascii_: bool = False) -> Path:
    """Write a surface as an STL file, which knows no vertices in common."""
    p = surface.V[surface.T].astype("<f4")
    if ascii_:
        facets = [
            "\n".join(
                [
                    "facet normal 0 0 0",
                    "outer loop",
                    *(f"vertex {x:.9g} {y:.9g} {z:.9g}" for x, y, z in t),
                    "endloop",
                    "endfacet",
                ]
            )
            for t in p
        ]
        path.write_text("solid it\n" + "\n".join(facets) + "\nendsolid it\n")
        return path
    rows = np.zeros(len(p), np.dtype([("n", "<f4", 3), ("v", "<f4", (3, 3)), ("rest", "<u2")]))
    rows["v"] = p
    path.write_bytes(bytes(80) + np.uint32(len(p)).tobytes() + rows.tobytes())
    return path

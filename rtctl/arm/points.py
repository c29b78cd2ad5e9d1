"""Points subjected to the potential (PSPs): spheres that stand for the links."""

from typing import NamedTuple

import numpy as np

from rtctl.types import F64, I64


class Points(NamedTuple):
    """Spheres fixed in links; link 0 is the base, which never carries one."""

    link: I64  # (m,)
    local: F64  # (m, 3) [m] centre in the frame of the joint that carries it
    radius: F64  # (m,) [m]
    names: tuple[str, ...]  # (m,) URDF link


class Coverage(NamedTuple):
    """How well spheres stand for the moving links' collision geometry."""

    fraction: float  # of the surface area, in triangles that lie wholly inside one sphere
    protrusion: float  # [m] farthest that the surface sticks out of the spheres; 0 when covered
    overhang: float  # [m] farthest that a sphere reaches beyond the geometry, an upper bound
    bare: tuple[str, ...]  # URDF links that have geometry but no full cover


def no_points() -> Points:
    """Return none."""
    return Points(np.zeros(0, dtype=np.int64), np.zeros((0, 3)), np.zeros(0), ())

"""What solids look like from a direction: their outlines as polygons of a page."""

from typing import NamedTuple

import numpy as np

from rtctl.kernel.rotations import R_of
from rtctl.types import F64, Shape

AROUND = np.linspace(0.0, 2.0 * np.pi, 145)


class Projection(NamedTuple):
    """A parallel projection: the directions (3,) of the world that go to the right and up on the page."""

    right: F64
    up: F64

    def of(self, points: F64) -> F64:
        """Return where points (k, 3) [m] fall on the page (k, 2) [m]."""
        return np.stack([points @ self.right, points @ self.up], axis=-1)

    @property
    def toward(self) -> F64:
        """Return the direction (3,) to the beholder."""
        return np.cross(self.right, self.up)


def view(azimuth: float, elevation: float) -> Projection:
    """Return the view from a direction: azimuth [rad] from x about z, elevation [rad] above the horizon."""
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    toward = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    return Projection(right, np.cross(toward, right))


def axis_view(right: int, up: int) -> Projection:
    """Return the view in which two world axes go to the right and up."""
    return Projection(np.eye(3)[right], np.eye(3)[up])


def outline(shape: Shape, seen: Projection) -> F64:
    """Return the outline (k, 2) [m] of a convex solid: in each direction of the page the point that reaches furthest.

    h(u) = argmax x.u over the solid; a plane has no outline.
    """
    R = R_of(shape.wxyz)
    u = np.outer(np.cos(AROUND), seen.right) + np.outer(np.sin(AROUND), seen.up)
    return seen.of(shape.position + _furthest(shape, u @ R) @ R.T)


def _furthest(shape: Shape, u: F64) -> F64:
    """Return the points (k, 3) of a solid in its own frame that reach furthest in the directions u (k, 3)."""
    d = shape.dims
    flat = np.hypot(u[:, 0], u[:, 1])[:, None].clip(min=1e-12)
    side = np.sign(u[:, 2:])
    x: F64
    match shape.type:
        case "box":
            x = np.sign(u) * d[:3]
        case "capsule" | "segment":
            x = u * d[0] + side * np.array([0.0, 0.0, d[1]])
        case "cylinder":
            x = np.hstack([d[0] * u[:, :2] / flat, side * d[1]])
        case "cone":
            top = d[1] * flat + d[2] * u[:, 2:] > d[0] * flat - d[2] * u[:, 2:]
            x = np.hstack([np.where(top, d[1], d[0]) * u[:, :2] / flat, np.where(top, d[2], -d[2])])
        case "ellipsoid" | "n_ellipsoid":
            n = d[3] if shape.type == "n_ellipsoid" else 1.0
            p = 2.0 * n / (2.0 * n - 1.0)  # the dual norm's exponent: x_i ~ |a_i u_i|^(p - 1)
            w = np.abs(u * d[:3])
            size = (w**p).sum(1, keepdims=True) ** (1.0 / p)
            x = np.sign(u) * d[:3] * (w / size) ** (p - 1.0)
        case "n_cylinder":  # drawn with its edges
            w = u[:, :2] * d[:2]
            x = np.hstack([d[:2] * w / np.linalg.norm(w, axis=1, keepdims=True).clip(min=1e-12), side * d[2]])
        case "cloud":
            points = d[1] * np.frombuffer(shape.cloud, "<i2").reshape(-1, 3)
            x = points[(u @ points.T).argmax(axis=1)] + d[0] * u
        case _:  # sphere, point; a mesh, whose corners are not here, as the point that it is about
            x = u * d[0]
    return x

"""Solids cut by the plane: distances, what a range sensor sees, and what a vehicle's outline touches.

A disc for what is round about the vertical, a rectangle for boxes; both posed, both moving. This is the oracle of the
base: nothing of it is the controller's.
"""

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from firmware_sim.settings import SettingsError, quaternion

F64 = NDArray[np.float64]


class Solid(NamedTuple):
    """One obstacle at one time; a disc has half sizes of zero and its radius."""

    name: str
    x: float  # [m]
    y: float
    yaw: float  # [rad]
    half: tuple[float, float]  # [m] of a rectangle
    radius: float  # [m] of a disc, 0 for a rectangle


def solids_at(tables: Sequence[dict[str, Any]], time: float) -> list[Solid]:
    """Return the obstacles of a scenario's tables that are there at `time` [s]."""
    there = [t for t in tables if float(t.get("appears_s", 0.0)) <= time < float(t.get("vanishes_s", 1e6))]
    return [solid_of(table, time) for table in there]


def velocity_of(table: dict[str, Any], time: float) -> tuple[float, float]:
    """Return an obstacle's velocity [m/s] at `time` [s]."""
    for a, b in pairwise(table.get("waypoints", ())):
        if a[0] <= time < b[0]:
            return (b[1] - a[1]) / (b[0] - a[0]), (b[2] - a[2]) / (b[0] - a[0])
    vx, vy, _ = table.get("velocity_m_s", (0.0, 0.0, 0.0)) if not table.get("waypoints") else (0.0, 0.0, 0.0)
    return float(vx), float(vy)


def solid_of(table: dict[str, Any], time: float) -> Solid:
    """Return an obstacle's cut at `time` [s]. SettingsError for a type that is no prism or sphere."""
    name, kind = str(table["name"]), table["type"]
    w, i, j, k = quaternion(table)
    if abs(i) > 1e-6 or abs(j) > 1e-6:
        raise SettingsError(f"obstacle {name}: tilted; the rover's world is flat")
    yaw = 2.0 * math.atan2(k, w)
    if table.get("waypoints"):
        row = list(zip(*table["waypoints"], strict=True))
        x, y = float(np.interp(time, row[0], row[1])), float(np.interp(time, row[0], row[2]))
    else:
        since = max(0.0, time - float(table.get("appears_s", 0.0)))
        vx, vy = velocity_of(table, time)
        x, y = float(table["position_m"][0]) + vx * since, float(table["position_m"][1]) + vy * since
    if kind in ("sphere", "cylinder", "capsule", "point"):
        return Solid(name, x, y, 0.0, (0.0, 0.0), max(float(table.get("radius_m", 0.0)), 1e-3))
    if kind == "box":
        return Solid(name, x, y, yaw, (0.5 * float(table["size_m"][0]), 0.5 * float(table["size_m"][1])), 0.0)
    raise SettingsError(f"obstacle {name}: {kind} is not one of box, cylinder, sphere, capsule, point")


def distance(solid: Solid, points: F64) -> F64:
    """Return the distance (m,) [m] of points (m, 2) to a solid; 0 inside."""
    dx, dy = points[:, 0] - solid.x, points[:, 1] - solid.y
    if solid.radius > 0.0:
        return np.maximum(np.hypot(dx, dy) - solid.radius, 0.0)
    c, s = math.cos(solid.yaw), math.sin(solid.yaw)
    u, v = np.abs(c * dx + s * dy) - solid.half[0], np.abs(c * dy - s * dx) - solid.half[1]
    return np.hypot(np.maximum(u, 0.0), np.maximum(v, 0.0))


def rays(solid: Solid, x: float, y: float, angle: F64) -> F64:
    """Return the distance (k,) [m] along rays from (x, y) at world angles (k,) [rad] to a solid; infinite: missed."""
    ox, oy = x - solid.x, y - solid.y
    ex, ey = np.cos(angle), np.sin(angle)
    if solid.radius > 0.0:
        along = ox * ex + oy * ey
        root = along * along - (ox * ox + oy * oy - solid.radius**2)
        t = -along - np.sqrt(np.maximum(root, 0.0))
        return np.where((root >= 0.0) & (t >= 0.0), t, np.inf)
    c, s = math.cos(solid.yaw), math.sin(solid.yaw)
    near, far = np.full(len(angle), -np.inf), np.full(len(angle), np.inf)
    for o, e, half in (
        (c * ox + s * oy, c * ex + s * ey, solid.half[0]),
        (c * oy - s * ox, c * ey - s * ex, solid.half[1]),
    ):
        safe = np.where(np.abs(e) < 1e-12, 1e-12, e)
        a, b = (-half - o) / safe, (half - o) / safe
        near, far = np.maximum(near, np.minimum(a, b)), np.minimum(far, np.maximum(a, b))
    return np.where((near <= far) & (near >= 0.0), near, np.inf)


def scan(solids: list[Solid], x: float, y: float, heading: float, sectors: int, rays_each: int, reach: float) -> F64:
    """Return the nearest range (sectors,) [m] in each sector, sector 0 centred on the front, clockwise.

    heading [rad] counter-clockwise from east; infinite where nothing is within `reach` [m].
    """
    width = 2.0 * math.pi / sectors
    spread = ((np.arange(rays_each) + 0.5) / rays_each - 0.5) * width
    angle = (heading - np.arange(sectors)[:, None] * width + spread).ravel()
    best = np.full(angle.shape, np.inf)
    for solid in solids:
        best = np.minimum(best, rays(solid, x, y, angle))
    nearest: F64 = best.reshape(sectors, rays_each).min(axis=1)
    return np.where(nearest <= reach, nearest, np.inf)


def clearance(solid: Solid, outline: F64, radius: float) -> float:
    """Return the distance [m] from the vehicle's outline to a solid; outline (m, 2) points with circles of `radius`."""
    return float(distance(solid, outline).min()) - radius

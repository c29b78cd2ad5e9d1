"""An outline that is not round: how far it can go straight ahead, and how far it can turn, before it is too near.

What is already nearer than it should be may leave, and not come nearer.
"""

import math

import numpy as np

from rtctl.kernel import kernel
from rtctl.rover.occupancy import CELL, SIZE, Chart
from rtctl.rover.robot import Base
from rtctl.types import F64
from rtctl.world.primitives import Obstacles, distances_into

FINE = 0.05  # [rad] between the headings that a turn is looked at in
SPARE = 1e-3  # [m] by which a distance must fall to count as nearer


def placed(points: F64, x: F64, yaw: float) -> F64:
    """Return points (m, 2) [m] of the body's frame in the world, at x (2,) [m] and yaw [rad]."""
    c, s = math.cos(yaw), math.sin(yaw)
    there: F64 = x + points @ np.array([[c, s], [-s, c]])
    return there


def turn_free(base: Base, pose: F64, side: float, most: float, seen: F64, obstacles: Obstacles) -> float:
    """Return the angle [rad], at most `most`, by which the outline can turn from pose (x, y, yaw) (3,).

    side: 1 to the left, -1 to the right. No point of the outline comes nearer than `stop` [m] to a return of seen
    (m, 2) [m] or to a known obstacle.
    """
    m = base.margins
    near = seen[np.hypot(*(seen - pose[:2]).T) < m.hull + m.stop] if len(seen) else seen
    angle = _turn_past(base.points, base.point_radius + m.stop, pose, side, most, near)
    if obstacles.active.any():
        angle = min(angle, _turn_by(base.points, base.point_radius + m.stop, pose, side, angle, obstacles, m.height))
    return angle


@kernel
def _nearest(points: F64, r: F64, pose: F64, turn: float, seen: F64) -> float:
    """Return the least distance of returns to circles of radii r (m,) about the outline's points, turned on."""
    c, s, least = math.cos(pose[2] + turn), math.sin(pose[2] + turn), math.inf
    for j in range(points.shape[0]):
        px, py = pose[0] + c * points[j, 0] - s * points[j, 1], pose[1] + s * points[j, 0] + c * points[j, 1]
        for i in range(seen.shape[0]):
            least = min(least, math.sqrt((seen[i, 0] - px) ** 2 + (seen[i, 1] - py) ** 2) - r[j])
    return least


@kernel
def _turn_past(points: F64, r: F64, pose: F64, side: float, most: float, seen: F64) -> float:
    before = _nearest(points, r, pose, 0.0, seen)
    n = math.ceil(most / FINE)
    for k in range(1, n + 1):
        d = _nearest(points, r, pose, side * most * k / n, seen)
        if d < 0.0 and d < before - SPARE:
            return most * (k - 1) / n
        before = max(d, before) if d < 0.0 else 0.0
    return most


@kernel
def _turn_by(points: F64, r: F64, pose: F64, side: float, most: float, obstacles: Obstacles, height: float) -> float:
    m, slots = points.shape[0], obstacles.active.shape[0]
    P, out = np.empty((3, m)), np.zeros((slots, 4, m))
    n = math.ceil(most / FINE)
    before = 0.0
    for k in range(n + 1):
        yaw = pose[2] + (side * most * k / n if n > 0 else 0.0)
        c, s = math.cos(yaw), math.sin(yaw)
        for j in range(m):
            P[0, j], P[1, j] = (
                pose[0] + c * points[j, 0] - s * points[j, 1],
                pose[1] + s * points[j, 0] + c * points[j, 1],
            )
            P[2, j] = height
        distances_into(P, r, obstacles, math.inf, out)
        d = math.inf
        for slot in range(slots):
            if obstacles.active[slot]:
                d = min(d, out[slot, 0].min())
        if k > 0 and d < 0.0 and d < before - SPARE:
            return most * (k - 1) / n
        before = min(d, 0.0) if k == 0 else (max(d, before) if d < 0.0 else 0.0)
    return most


@kernel
def gap_past(outline: F64, r: F64, x: F64, e: F64, wide: float, seen: F64) -> float:
    """Return how far [m] an outline about x can move along e (2,) until a return is nearer than it should be.

    outline (m, 2) [m] in the world, r (m,) [m] what each point keeps. A return beyond `wide` [m] of x counts by the
    circle of that radius, as a round base would take it; 0: each by the outline itself.
    """
    gap = math.inf
    for i in range(seen.shape[0]):
        dx, dy = seen[i, 0] - x[0], seen[i, 1] - x[1]
        if dx * dx + dy * dy >= wide * wide and wide > 0.0:
            along, aside = dx * e[0] + dy * e[1], dy * e[0] - dx * e[1]
            if along > 0.0 and abs(aside) < wide:
                gap = min(gap, along - math.sqrt(wide * wide - aside * aside))
            continue
        for j in range(outline.shape[0]):
            dx, dy = seen[i, 0] - outline[j, 0], seen[i, 1] - outline[j, 1]
            along, aside = dx * e[0] + dy * e[1], dy * e[0] - dx * e[1]
            if along > 0.0 and abs(aside) < r[j]:
                gap = min(gap, max(along - math.sqrt(r[j] * r[j] - aside * aside), 0.0))
    return gap


def strip_seen(base: Base, chart: Chart, pose: F64, e: F64, reach: float, oldest: int) -> tuple[float, int]:
    """Return how far [m] the outline at pose (3,) can move along e (2,) before it comes to what is not seen.

    The same as `occupancy.seen_ahead` of the strip that the outline sweeps.
    """
    body = placed(base.points, np.zeros(2), pose[2])
    along, aside = body @ e, body @ np.array([-e[1], e[0]])
    box = np.array([float(along.max()), float(aside.min()), float(aside.max())])
    gap, tick = _strip(chart, pose[:2], e, box, reach, oldest)
    return gap, tick


@kernel
def _strip(chart: Chart, x: F64, e: F64, box: F64, reach: float, oldest: int) -> tuple[float, int]:
    cells, origin, seen = chart
    gap, first = math.inf, 1 << 30
    half = int((reach + box[0] + box[2] - box[1]) / CELL) + 1
    ci, cj = math.floor(x[0] / CELL) - origin[0], math.floor(x[1] / CELL) - origin[1]
    for i in range(ci - half, ci + half + 1):
        for j in range(cj - half, cj + half + 1):
            dx, dy = (origin[0] + i + 0.5) * CELL - x[0], (origin[1] + j + 0.5) * CELL - x[1]
            s, aside = dx * e[0] + dy * e[1] - box[0], dy * e[0] - dx * e[1]
            if not (box[1] < aside < box[2]) or s <= 0.0 or s > reach:
                continue
            if not (0 <= i < SIZE and 0 <= j < SIZE):
                gap = min(gap, s)
            elif cells[i, j] == 0:
                if seen[i, j] <= oldest:
                    gap = min(gap, s)
                else:
                    first = min(first, int(seen[i, j]))
    return gap, first


def turn_seen(base: Base, chart: Chart, pose: F64, side: float, most: float, oldest: int) -> float:
    """Return the angle [rad], at most `most`, through which the outline turns over what is known.

    Known is a cell with a return in it, and one that a beam passed, or the outline stood on, after tick `oldest`.
    """
    return _turn_seen(chart, base.cover, pose, side, most, oldest)


@kernel
def _turn_seen(chart: Chart, cover: F64, pose: F64, side: float, most: float, oldest: int) -> float:
    cells, origin, seen = chart
    n = math.ceil(most / FINE)
    for k in range(1, n + 1):
        yaw = pose[2] + side * most * k / n
        c, s = math.cos(yaw), math.sin(yaw)
        for j in range(cover.shape[0]):
            a = math.floor((pose[0] + c * cover[j, 0] - s * cover[j, 1]) / CELL) - origin[0]
            b = math.floor((pose[1] + s * cover[j, 0] + c * cover[j, 1]) / CELL) - origin[1]
            if not (0 <= a < SIZE and 0 <= b < SIZE) or (cells[a, b] == 0 and seen[a, b] <= oldest):
                return most * (k - 1) / n
    return most


def stood(chart: Chart, cover: F64, x: F64, yaw: float, tick: int) -> Chart:
    """Return the chart with the cells under the outline seen: the base is there. cover (n, 2) [m] in its frame."""
    seen = chart.seen.copy()
    cell = np.floor(placed(cover, x, yaw) / CELL).astype(np.int64) - chart.origin
    inside = ((cell >= 0) & (cell < SIZE)).all(axis=1)
    seen[cell[inside, 0], cell[inside, 1]] = tick
    return chart._replace(seen=seen)

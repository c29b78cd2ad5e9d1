"""What the range sensor has seen, kept: a window of cells that moves with the base, and the free distance in it.

A single scan forgets the wall behind the corner; the way out of a dead end needs it. Cells hold evidence: a return
sets it, a beam that passes takes it away again, so that what moved on is forgotten after a few looks. Beside that a
cell keeps when it was last seen free: seen, free and unknown are three things, and what nobody has looked at is not
free. Everything is pure: editing returns new arrays.
"""

import math
from typing import NamedTuple

import numpy as np

from rtctl.kernel import kernel
from rtctl.types import F64, I64
from rtctl.world.primitives import Obstacles, distances_into

SIZE = 192  # cells a side
CELL = 0.35  # [m]
SURE = 3  # looks through a cell that forget a return in it
STENCIL = 12  # cells: free distances are told up to this many, and as this many beyond
MARGIN = 24  # cells between the base and the window's edge before the window is moved
NEVER = -(1 << 30)  # tick of a cell that was never seen free
U8Grid = np.ndarray[tuple[int, int], np.dtype[np.uint8]]
I32Grid = np.ndarray[tuple[int, int], np.dtype[np.int32]]


class Chart(NamedTuple):
    """Evidence of returns by cell; cell (i, j) covers world x from (origin[0] + i) CELL on."""

    cells: U8Grid  # (SIZE, SIZE) looks left before the return is forgotten
    origin: I64  # (2,) index of the lower corner in the world's own cells
    seen: I32Grid  # (SIZE, SIZE) tick at which a beam passed last


def empty(x: F64) -> Chart:
    """Return a chart without returns, centred on x (2,) [m]."""
    return Chart(np.zeros((SIZE, SIZE), np.uint8), _corner(x), np.full((SIZE, SIZE), NEVER, np.int32))


def _corner(x: F64) -> I64:
    return np.floor(x / CELL).astype(np.int64) - SIZE // 2


def moved(chart: Chart, x: F64) -> Chart:
    """Return the chart with x (2,) [m] well inside its window; what leaves the window is forgotten."""
    at = np.floor(x / CELL).astype(np.int64) - chart.origin
    if bool((at >= MARGIN).all() and (at < SIZE - MARGIN).all()):
        return chart
    origin = _corner(x)
    cells, seen = np.zeros_like(chart.cells), np.full_like(chart.seen, NEVER)
    shift = origin - chart.origin
    if bool((np.abs(shift) < SIZE).all()):
        (a, b), (c, d) = (_overlap(int(s)) for s in shift)
        cells[a[0] : a[1], c[0] : c[1]] = chart.cells[b[0] : b[1], d[0] : d[1]]
        seen[a[0] : a[1], c[0] : c[1]] = chart.seen[b[0] : b[1], d[0] : d[1]]
    return Chart(cells, origin, seen)


def _overlap(shift: int) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return the ranges of the new and of the old window that are the same cells."""
    kept = SIZE - abs(shift)
    return ((0, kept), (shift, shift + kept)) if shift >= 0 else ((-shift, -shift + kept), (0, kept))


def shifted(chart: Chart, by: F64) -> Chart:
    """Return the chart after the frame of the position jumped by (2,) [m]: what was seen jumps along, to the cell."""
    return chart._replace(origin=chart.origin + np.round(by / CELL).astype(np.int64))


class PlacedScan(NamedTuple):
    """One turn of a range sensor."""

    x: F64  # (2,) [m] of the sensor
    angle: float  # [rad] of sector 0 in the world, counter-clockwise from east
    step: float  # [rad] to the next sector
    ranges: F64  # (k,) [m] infinite: nothing up to the reach; negative: unknown
    reach: float  # [m]


def integrate_scan(chart: Chart, scan: PlacedScan, tick: int) -> Chart:
    """Return the chart after one scan, taken in this tick."""
    cells, seen = chart.cells.copy(), chart.seen.copy()
    _integrate(cells, seen, chart.origin, scan, tick)
    return chart._replace(cells=cells, seen=seen)


@kernel
def _integrate(cells: U8Grid, seen: I32Grid, origin: I64, scan: PlacedScan, tick: int) -> None:
    x, step, ranges, reach = scan.x, scan.step, scan.ranges, scan.reach
    count, turn = ranges.shape[0], 2.0 * math.pi
    around = round(turn / abs(step))
    half = int(reach / CELL) + 1
    ci, cj = math.floor(x[0] / CELL) - origin[0], math.floor(x[1] / CELL) - origin[1]
    for i in range(max(0, ci - half), min(SIZE, ci + half + 1)):
        for j in range(max(0, cj - half), min(SIZE, cj + half + 1)):
            dx, dy = (origin[0] + i + 0.5) * CELL - x[0], (origin[1] + j + 0.5) * CELL - x[1]
            d = math.sqrt(dx * dx + dy * dy)
            if d > reach - CELL or d < CELL:
                continue
            angle = math.atan2(dy, dx) - scan.angle
            wide = 0.7 * CELL / d  # every beam that touches the cell must have passed it
            first = math.floor((angle - wide) / step + 0.5)
            last = math.floor((angle + wide) / step + 0.5)
            if step < 0.0:
                first, last = math.floor((angle + wide) / step + 0.5), math.floor((angle - wide) / step + 0.5)
            passed = True
            for k in range(first, last + 1):
                at = k % around
                if at >= count or ranges[at] < d + 0.7 * CELL:
                    passed = False
            if passed:
                seen[i, j] = tick
                if cells[i, j] > 0:
                    cells[i, j] -= 1
    for k in range(count):
        d = ranges[k]
        if d < 0.0 or d > reach:
            continue
        angle = scan.angle + k * step
        i = math.floor((x[0] + d * math.cos(angle)) / CELL) - origin[0]
        j = math.floor((x[1] + d * math.sin(angle)) / CELL) - origin[1]
        if 0 <= i < SIZE and 0 <= j < SIZE:
            cells[i, j] = SURE


def stood(chart: Chart, x: F64, radius: float, tick: int) -> Chart:
    """Return the chart with the cells under a circle of `radius` [m] about x (2,) [m] seen: the base is there."""
    seen = chart.seen.copy()
    _stand(seen, chart.origin, x, radius, tick)
    return chart._replace(seen=seen)


@kernel
def _stand(seen: I32Grid, origin: I64, x: F64, radius: float, tick: int) -> None:
    half = int(radius / CELL) + 1
    ci, cj = math.floor(x[0] / CELL) - origin[0], math.floor(x[1] / CELL) - origin[1]
    for i in range(max(0, ci - half), min(SIZE, ci + half + 1)):
        for j in range(max(0, cj - half), min(SIZE, cj + half + 1)):
            dx, dy = (origin[0] + i + 0.5) * CELL - x[0], (origin[1] + j + 0.5) * CELL - x[1]
            if dx * dx + dy * dy <= radius * radius:
                seen[i, j] = tick


def seen_ahead(chart: Chart, x: F64, e: F64, radius: float, reach: float, oldest: int) -> tuple[float, int]:
    """Return how far [m] a circle of `radius` [m] about x (2,) can move along e before it comes to what is not seen.

    A cell counts that a beam has passed in a tick after `oldest`, and one with a return in it: the governor keeps off
    that by itself. With it the tick of the cell seen longest ago within `reach` [m]; infinite: all of it is seen.
    """
    gap, tick = _ahead(chart.cells, chart.seen, chart.origin, x, e, radius, reach, oldest)
    return gap, tick


@kernel
def _ahead(
    cells: U8Grid, seen: I32Grid, origin: I64, x: F64, e: F64, radius: float, reach: float, oldest: int
) -> tuple[float, int]:
    gap, first = math.inf, 1 << 30
    half = int((reach + radius) / CELL) + 1
    ci, cj = math.floor(x[0] / CELL) - origin[0], math.floor(x[1] / CELL) - origin[1]
    for i in range(ci - half, ci + half + 1):
        for j in range(cj - half, cj + half + 1):
            dx, dy = (origin[0] + i + 0.5) * CELL - x[0], (origin[1] + j + 0.5) * CELL - x[1]
            along, aside = dx * e[0] + dy * e[1], dy * e[0] - dx * e[1]
            if along <= 0.0 or abs(aside) >= radius:
                continue
            s = along - math.sqrt(radius * radius - aside * aside)
            if s > reach or s <= 0.0:
                continue
            if not (0 <= i < SIZE and 0 <= j < SIZE):
                gap = min(gap, s)
            elif cells[i, j] == 0:
                if seen[i, j] <= oldest:
                    gap = min(gap, s)
                else:
                    first = min(first, int(seen[i, j]))
    return gap, first


def unseen_ahead(chart: Chart, x: F64, e: F64, radius: float, reach: float, oldest: int) -> F64 | None:
    """Return the place (2,) [m] where that circle first comes to what is not seen within `reach` [m], None: nowhere."""
    gap, px, py = _unseen(chart.cells, chart.seen, chart.origin, x, e, radius, reach, oldest)
    return None if math.isinf(gap) else np.array([px, py])


def known(chart: Chart, at: F64, oldest: int) -> bool:
    """Return whether the cell at a place (2,) [m] has a return in it, or a beam has passed it after tick `oldest`."""
    i, j = (int(k) for k in np.floor(at / CELL).astype(np.int64) - chart.origin)
    if not (0 <= i < SIZE and 0 <= j < SIZE):
        return False
    return bool(chart.cells[i, j] > 0 or chart.seen[i, j] > oldest)


@kernel
def _unseen(
    cells: U8Grid, seen: I32Grid, origin: I64, x: F64, e: F64, radius: float, reach: float, oldest: int
) -> tuple[float, float, float]:
    gap, px, py = math.inf, 0.0, 0.0
    half = int((reach + radius) / CELL) + 1
    ci, cj = math.floor(x[0] / CELL) - origin[0], math.floor(x[1] / CELL) - origin[1]
    for i in range(max(0, ci - half), min(SIZE, ci + half + 1)):
        for j in range(max(0, cj - half), min(SIZE, cj + half + 1)):
            dx, dy = (origin[0] + i + 0.5) * CELL - x[0], (origin[1] + j + 0.5) * CELL - x[1]
            along, aside = dx * e[0] + dy * e[1], dy * e[0] - dx * e[1]
            if along <= 0.0 or abs(aside) >= radius or cells[i, j] > 0 or seen[i, j] > oldest:
                continue
            s = along - math.sqrt(radius * radius - aside * aside)
            if 0.0 < s <= min(reach, gap):
                gap, px, py = s, x[0] + dx, x[1] + dy
    return gap, px, py


def free_distance(chart: Chart, obstacles: Obstacles, height: float) -> F64:
    """Return the distance (SIZE, SIZE) [m] of each cell's centre to the nearest return or known obstacle.

    Beyond STENCIL cells it is that many: nobody asks how much further. height [m] is where the known obstacles, which
    are solids, are cut.
    """
    field = np.empty((SIZE, SIZE))
    _free(chart.cells, chart.origin, obstacles, height, field)
    return field


def at(free: F64, origin: I64, x: F64) -> float:
    """Return the free distance [m] of the cell that x (2,) [m] lies in, infinite beyond the window."""
    i, j = (int(k) for k in np.floor(x / CELL).astype(np.int64) - origin)
    return float(free[i, j]) if 0 <= i < SIZE and 0 <= j < SIZE else math.inf


@kernel
def _free(cells: U8Grid, origin: I64, obstacles: Obstacles, height: float, field: F64) -> None:
    far = STENCIL * CELL
    field[:] = far
    for i in range(SIZE):
        for j in range(SIZE):
            if cells[i, j] == 0:
                continue
            for a in range(max(0, i - STENCIL), min(SIZE, i + STENCIL + 1)):
                for b in range(max(0, j - STENCIL), min(SIZE, j + STENCIL + 1)):
                    d = CELL * math.sqrt(float((a - i) * (a - i) + (b - j) * (b - j)))
                    if d < field[a, b]:
                        field[a, b] = d
    slots = obstacles.active.shape[0]
    told = np.flatnonzero(obstacles.active)
    if told.shape[0] == 0:
        return
    P, none, out = np.empty((3, SIZE)), np.zeros(SIZE), np.empty((slots, 4, SIZE))
    for i in range(SIZE):
        for j in range(SIZE):
            P[0, j], P[1, j], P[2, j] = (origin[0] + i + 0.5) * CELL, (origin[1] + j + 0.5) * CELL, height
        distances_into(P, none, obstacles, math.inf, out)
        for k in told:
            for j in range(SIZE):
                if out[k, 0, j] < field[i, j]:
                    field[i, j] = max(out[k, 0, j], 0.0)


def returns_near(chart: Chart, x: F64, reach: float) -> F64:
    """Return the centres (m, 2) [m] of cells with a return within `reach` [m] of x (2,)."""
    return _near(chart.cells, chart.origin, x, reach)


@kernel
def _near(cells: U8Grid, origin: I64, x: F64, reach: float) -> F64:
    half = int(reach / CELL) + 1
    ci, cj = math.floor(x[0] / CELL) - origin[0], math.floor(x[1] / CELL) - origin[1]
    found, m = np.empty(((2 * half + 1) ** 2, 2)), 0
    for i in range(max(0, ci - half), min(SIZE, ci + half + 1)):
        for j in range(max(0, cj - half), min(SIZE, cj + half + 1)):
            if cells[i, j] > 0:
                px, py = (origin[0] + i + 0.5) * CELL, (origin[1] + j + 0.5) * CELL
                if (px - x[0]) ** 2 + (py - x[1]) ** 2 <= reach * reach:
                    found[m, 0], found[m, 1] = px, py
                    m += 1
    return found[:m].copy()

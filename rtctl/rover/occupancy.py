"""What the range sensor has seen, kept: a window of cells that moves with the base, and the free distance in it.

A single scan forgets the wall behind the corner; the way out of a dead end needs it. Cells hold evidence: a return
sets it, a beam that passes takes it away again, so that what moved on is forgotten after a few looks. Everything is
pure: editing returns new arrays.
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
U8Grid = np.ndarray[tuple[int, int], np.dtype[np.uint8]]


class Chart(NamedTuple):
    """Evidence of returns by cell; cell (i, j) covers world x from (origin[0] + i) CELL on."""

    cells: U8Grid  # (SIZE, SIZE) looks left before the return is forgotten
    origin: I64  # (2,) index of the lower corner in the world's own cells


def empty(x: F64) -> Chart:
    """Return a chart without returns, centred on x (2,) [m]."""
    return Chart(np.zeros((SIZE, SIZE), np.uint8), _corner(x))


def _corner(x: F64) -> I64:
    return np.floor(x / CELL).astype(np.int64) - SIZE // 2


def moved(chart: Chart, x: F64) -> Chart:
    """Return the chart with x (2,) [m] well inside its window; what leaves the window is forgotten."""
    at = np.floor(x / CELL).astype(np.int64) - chart.origin
    if bool((at >= MARGIN).all() and (at < SIZE - MARGIN).all()):
        return chart
    origin = _corner(x)
    cells = np.zeros_like(chart.cells)
    shift = origin - chart.origin
    if bool((np.abs(shift) < SIZE).all()):
        (a, b), (c, d) = (_overlap(int(s)) for s in shift)
        cells[a[0] : a[1], c[0] : c[1]] = chart.cells[b[0] : b[1], d[0] : d[1]]
    return Chart(cells, origin)


def _overlap(shift: int) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return the ranges of the new and of the old window that are the same cells."""
    kept = SIZE - abs(shift)
    return ((0, kept), (shift, shift + kept)) if shift >= 0 else ((-shift, -shift + kept), (0, kept))


def shifted(chart: Chart, by: F64) -> Chart:
    """Return the chart after the frame of the position jumped by (2,) [m]: what was seen jumps along, to the cell."""
    return chart._replace(origin=chart.origin + np.round(by / CELL).astype(np.int64))


def looked(chart: Chart, x: F64, yaw: float, scan: F64, start: float, step: float, reach: float) -> Chart:
    """Return the chart after one scan taken at x (2,) [m], yaw [rad].

    scan (k,) [m] of sectors at body angles start + i step [rad], counter-clockwise; infinite: nothing up to `reach`
    [m]; negative: unknown.
    """
    cells = chart.cells.copy()
    _look(cells, chart.origin, x, yaw, scan, start, step, reach)
    return chart._replace(cells=cells)


@kernel
def _look(cells: U8Grid, origin: I64, x: F64, yaw: float, scan: F64, start: float, step: float, reach: float) -> None:
    count, turn = scan.shape[0], 2.0 * math.pi
    half = int(reach / CELL) + 1
    ci, cj = math.floor(x[0] / CELL) - origin[0], math.floor(x[1] / CELL) - origin[1]
    for i in range(max(0, ci - half), min(SIZE, ci + half + 1)):
        for j in range(max(0, cj - half), min(SIZE, cj + half + 1)):
            if cells[i, j] == 0:
                continue
            dx, dy = (origin[0] + i + 0.5) * CELL - x[0], (origin[1] + j + 0.5) * CELL - x[1]
            d = math.sqrt(dx * dx + dy * dy)
            if d > reach - CELL or d < CELL:
                continue
            angle = math.atan2(dy, dx) - yaw - start
            wide = 0.7 * CELL / d  # every beam that touches the cell must have passed it
            first = math.floor((angle - wide) / step + 0.5)
            last = math.floor((angle + wide) / step + 0.5)
            if step < 0.0:
                first, last = last, first
            passed = True
            for k in range(first, last + 1):
                at = k % round(turn / abs(step))
                if at >= count or scan[at] < d + 0.7 * CELL:
                    passed = False
            if passed:
                cells[i, j] -= 1
    for k in range(count):
        d = scan[k]
        if d < 0.0 or d > reach:
            continue
        angle = yaw + start + k * step
        i = math.floor((x[0] + d * math.cos(angle)) / CELL) - origin[0]
        j = math.floor((x[1] + d * math.sin(angle)) / CELL) - origin[1]
        if 0 <= i < SIZE and 0 <= j < SIZE:
            cells[i, j] = SURE


def free_distance(chart: Chart, obstacles: Obstacles, height: float) -> F64:
    """Return the distance (SIZE, SIZE) [m] of each cell's centre to the nearest return or told obstacle.

    Beyond STENCIL cells it is that many: nobody asks how much further. height [m] is where the told obstacles, which
    are solids, are cut.
    """
    field = np.empty((SIZE, SIZE))
    _free(chart.cells, chart.origin, obstacles, height, field)
    return field


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

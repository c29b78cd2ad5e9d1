"""The escape from local minima: the shortest way round what has been seen, as a stream of via-points for the law.

The potential field alone stops where forces cancel. The way round is the taut string to the goal through cells whose
free distance is large enough; the law then heads for the string's first corner, the tangent point of what blocks it.
A way once chosen is kept while it stays open and another is not clearly shorter: without that a base before the
middle of a wall turns left and right for ever.
"""

import heapq
import math
from typing import NamedTuple

import numpy as np

from rtctl.kernel import kernel
from rtctl.rover.occupancy import CELL, SIZE
from rtctl.types import F64, I64

CORNERS = 32  # of a way at most
KEEP = 1.10  # a new way must be shorter than the old by this factor
KEEP_LENGTH = 0.7  # [m] and by this
NEAR_VIA = 1.5  # [m] from a corner of a closed way within which the same side is still open


class Way(NamedTuple):
    """A taut string from the base to the goal, or to the free cell nearest to it."""

    corners: F64  # (k, 2) [m], the last is the end; empty: no way is known
    length: float  # [m] from the base
    short: float  # [m] from its end to the goal; 0: it reaches it
    start: F64 | None = None  # (2,) [m] where its first leg begins; None: a string for the circle about the outline


NO_WAY = Way(np.zeros((0, 2)), math.inf, math.inf)


def way_to(free: F64, origin: I64, x: F64, goal: F64, room: float, old: Way) -> Way:
    """Return the way from x (2,) to goal (2,) [m] through cells with a free distance of at least `room` [m].

    free (SIZE, SIZE) [m]; a base that stands where there is less may only gain. `old`: the way kept so far.
    """
    corners, k, short = _search(free, origin, x, goal, room)
    new = Way(corners[:k], _length(x, corners[:k]), short)
    kept = remaining(free, origin, x, old, room)
    if len(kept.corners) and kept.short <= short + CELL and kept.length <= KEEP * new.length + KEEP_LENGTH:
        return kept
    if len(old.corners) and not len(kept.corners):
        same = _by_way_of(free, origin, x, old.corners[0], goal, room)
        if same.short <= short + CELL and same.length <= KEEP * new.length + KEEP_LENGTH:
            return same
    return new


def _by_way_of(free: F64, origin: I64, x: F64, via: F64, goal: F64, room: float) -> Way:
    """Return the way to the goal past the free place nearest to via (2,) [m], NO_WAY when none is near.

    A range sensor's noise moves a wall by a cell, which closes a way that grazes it: the next best on the same side is
    as good. Without this a base before the middle of a wall changes sides with each scan.
    """
    first, k, _ = _search(free, origin, x, via, room)
    if not k or math.dist(first[k - 1], via) > NEAR_VIA:
        return NO_WAY
    rest, n, short = _search(free, origin, first[k - 1], goal, room)
    corners = np.concatenate([first[:k], rest[:n]])[:CORNERS]
    whole = Way(corners, _length(x, corners), short)
    left = remaining(free, origin, x, whole, room)
    return left if len(left.corners) else whole


def remaining(free: F64, origin: I64, x: F64, way: Way, room: float) -> Way:
    """Return what is left of a way from x (2,) on, NO_WAY when something closed it."""
    if not len(way.corners):
        return NO_WAY
    passed = _passed(free, origin, x, way.corners, room)
    if passed < 0:
        return NO_WAY
    rest = way.corners[passed:]
    return Way(rest, _length(x, rest), way.short)


@kernel
def _length(x: F64, corners: F64) -> float:
    total, px, py = 0.0, x[0], x[1]
    for k in range(corners.shape[0]):
        total += math.sqrt((corners[k, 0] - px) ** 2 + (corners[k, 1] - py) ** 2)
        px, py = corners[k, 0], corners[k, 1]
    return total


@kernel
def _passed(free: F64, origin: I64, x: F64, corners: F64, room: float) -> int:
    """Return how many corners lie behind: the last one in sight is the next; -1 when none is or the rest is closed."""
    n, first = corners.shape[0], -1
    for k in range(n):
        if _clear(free, origin, x[0], x[1], corners[k, 0], corners[k, 1], room):
            first = k
    for k in range(max(first, 0), n - 1):
        if not _clear(free, origin, corners[k, 0], corners[k, 1], corners[k + 1, 0], corners[k + 1, 1], room):
            return -1
    return first


@kernel
def _clear(free: F64, origin: I64, ax: float, ay: float, bx: float, by: float, room: float) -> bool:
    """Return whether the straight line keeps `room` [m]; where it begins with less it may only gain until it has it."""
    length = math.sqrt((bx - ax) ** 2 + (by - ay) ** 2)
    s, before = 0.0, -1.0
    inside = True
    while True:
        t = s / length if length > 0.0 else 0.0
        i = math.floor((ax + t * (bx - ax)) / CELL) - origin[0]
        j = math.floor((ay + t * (by - ay)) / CELL) - origin[1]
        if not (0 <= i < SIZE and 0 <= j < SIZE):
            return True  # beyond the window nothing is known
        d = free[i, j]
        if d >= room:
            inside = False
        elif not inside or d < before - 1e-9:
            return False
        before = d
        if s >= length:
            return True
        s = min(s + max(0.5 * CELL, 0.9 * (d - room)), length)


@kernel
def _search(free: F64, origin: I64, x: F64, goal: F64, room: float) -> tuple[F64, int, float]:
    """A* over cells, then the string pulled taut: (corners (CORNERS, 2), their number, distance short of the goal)."""
    n = SIZE * SIZE
    cost, parent, closed = np.full(n, math.inf), np.full(n, -1, np.int64), np.zeros(n, np.bool_)
    si = min(max(math.floor(x[0] / CELL) - origin[0], 0), SIZE - 1)
    sj = min(max(math.floor(x[1] / CELL) - origin[1], 0), SIZE - 1)
    gi, gj = goal[0] / CELL - origin[0] - 0.5, goal[1] / CELL - origin[1] - 0.5
    outside = not (0.0 <= gi <= SIZE - 1.0 and 0.0 <= gj <= SIZE - 1.0)
    begin = si * SIZE + sj
    cost[begin] = 0.0
    h = math.sqrt((si - gi) ** 2 + (sj - gj) ** 2)
    heap = [(h, begin)]
    best, best_h, end = begin, h, -1
    while len(heap) > 0:
        _, cell = heapq.heappop(heap)
        if closed[cell]:
            continue
        closed[cell] = True
        i, j = cell // SIZE, cell % SIZE
        h = math.sqrt((i - gi) ** 2 + (j - gj) ** 2)
        if h < best_h:
            best, best_h = cell, h
        if h < 0.75 or (outside and (i == 0 or j == 0 or i == SIZE - 1 or j == SIZE - 1)):
            end = cell
            break
        for di in range(-1, 2):
            for dj in range(-1, 2):
                a, b = i + di, j + dj
                if (di == 0 and dj == 0) or not (0 <= a < SIZE and 0 <= b < SIZE):
                    continue
                d, to = free[a, b], a * SIZE + b
                if closed[to] or (d < room and (free[i, j] >= room or d < free[i, j])):
                    continue
                step = math.sqrt(float(di * di + dj * dj))
                if cost[cell] + step < cost[to]:
                    cost[to], parent[to] = cost[cell] + step, cell
                    heapq.heappush(heap, (cost[to] + math.sqrt((a - gi) ** 2 + (b - gj) ** 2), to))
    reached = end >= 0
    short = 0.0 if reached else best_h * CELL
    return _taut(free, origin, x, goal, room, parent, end if reached else best, reached, short)


@kernel
def _taut(
    free: F64, origin: I64, x: F64, goal: F64, room: float, parent: I64, end: int, reached: bool, short: float
) -> tuple[F64, int, float]:
    count, cell = 0, end
    while cell >= 0:
        count, cell = count + 1, parent[cell]
    points = np.empty((count, 2))
    cell = end
    for k in range(count - 1, -1, -1):
        points[k, 0] = (origin[0] + cell // SIZE + 0.5) * CELL
        points[k, 1] = (origin[1] + cell % SIZE + 0.5) * CELL
        cell = parent[cell]
    if reached:
        points[count - 1, 0], points[count - 1, 1] = goal[0], goal[1]
    points[0, 0], points[0, 1] = x[0], x[1]
    corners, k, at = np.empty((CORNERS, 2)), 0, 0
    while at < count - 1 and k < CORNERS:
        to = count - 1
        while to > at + 1 and not _clear(
            free, origin, points[at, 0], points[at, 1], points[to, 0], points[to, 1], room
        ):
            to -= 1
        corners[k, 0], corners[k, 1] = points[to, 0], points[to, 1]
        k, at = k + 1, to
    if k == 0 and count == 1:
        corners[0, 0], corners[0, 1] = points[0, 0], points[0, 1]
        k = 1
    return corners, k, short

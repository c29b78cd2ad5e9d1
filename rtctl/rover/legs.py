"""The way of an outline that is not round: legs driven straight ahead, and turns on the spot between them.

A round base needs to know where its centre may be; a long one also which way it faces there. Where the circle about
the outline finds no way, poses are searched instead: cells times HEADINGS, with the outline laid over the chart at
each. Costs are bounded from below by the length of way that a point would have (hybrid A*: Dolgov et al., Path
Planning for Autonomous Vehicles in Unknown Semi-structured Environments, 2010).
"""

import heapq
import math

import numpy as np

from rtctl.kernel import kernel
from rtctl.rover.occupancy import CELL, SIZE
from rtctl.rover.path import CORNERS, NO_WAY, Way
from rtctl.types import F64, I64

HEADINGS = 16
STEPS = np.array(
    [[1, 0], [2, 1], [1, 1], [1, 2], [0, 1], [-1, 2], [-1, 1], [-2, 1],
     [-1, 0], [-2, -1], [-1, -1], [-1, -2], [0, -1], [1, -2], [1, -1], [2, -1]],
    np.int64,
)  # fmt: skip
BEARINGS = np.arctan2(STEPS[:, 1], STEPS[:, 0])  # [rad]
TURN = 1.5  # [cells] that a turn from one heading to the next costs
MOST = 20_000  # poses that are looked at before the search gives up
LOOSE = 1.0  # [cells] by which a leg that is being driven may come nearer than one that is chosen
REACHED = 0.15  # [m] before a leg's end where it is done
FINE = 0.1  # [rad] between the headings that a turn is looked at in
AHEAD = 1.5  # [m] along a leg that is steered for


def legs_to(free: F64, origin: I64, cover: F64, pose: F64, goal: F64, room: float) -> Way:
    """Return the way of legs from pose (x, y, yaw) (3,) [m, m, rad] to goal (2,) [m], NO_WAY where none is found.

    free (SIZE, SIZE) [m], cover (n, 2) [m]: points of the outline in the body's frame, each of which keeps a free
    distance of at least `room` [m].
    """
    corners, k = _legs(free, origin, cover, pose, goal, room)
    if k == 0:
        return NO_WAY
    way = np.concatenate([pose[None, :2], corners[:k]])
    length = float(np.hypot(*np.diff(way, axis=0).T).sum())
    return Way(corners[:k], length, 0.0, pose[:2])


def legs_left(free: F64, origin: I64, cover: F64, pose: F64, way: Way, room: float) -> Way:
    """Return what is left of a way of legs at a pose (3,), NO_WAY when something closed it."""
    if way.start is None:
        return NO_WAY
    start, corners = way.start, way.corners
    leg = corners[0] - start
    length = float(np.hypot(*leg))
    along = float((pose[:2] - start) @ leg) / max(length, 1e-9)
    if along >= length - REACHED and len(corners) > 1:
        start, corners = corners[0], corners[1:]
    if not _open(free, origin, cover, pose, start, corners, room - LOOSE * CELL):
        return NO_WAY
    rest = np.concatenate([pose[None, :2], corners])
    return Way(corners, float(np.hypot(*np.diff(rest, axis=0).T).sum()), way.short, start)


def aimed_at(way: Way, x: F64) -> tuple[F64, float]:
    """Return (place (2,) [m], length [m]): what the base at x (2,) steers for on its leg, and what is left of that."""
    assert way.start is not None
    leg = way.corners[0] - way.start
    length = float(np.hypot(*leg))
    e = leg / max(length, 1e-9)
    along = float((x - way.start) @ e)
    return way.start + (along + AHEAD) * e, max(length - along, 0.0)


def heading(way: Way) -> float:
    """Return the heading [rad] of the leg that is being driven, NaN of a way without legs."""
    if way.start is None or not len(way.corners):
        return math.nan
    leg = way.corners[0] - way.start
    return math.atan2(leg[1], leg[0])


@kernel
def _fits(free: F64, origin: I64, cover: F64, x: float, y: float, yaw: float, room: float) -> bool:
    """Return whether every point of the outline keeps `room` [m] at a pose; beyond the window nothing is known."""
    c, s = math.cos(yaw), math.sin(yaw)
    for k in range(cover.shape[0]):
        i = math.floor((x + c * cover[k, 0] - s * cover[k, 1]) / CELL) - origin[0]
        j = math.floor((y + s * cover[k, 0] + c * cover[k, 1]) / CELL) - origin[1]
        if 0 <= i < SIZE and 0 <= j < SIZE and free[i, j] < room:
            return False
    return True


@kernel
def _turns(free: F64, origin: I64, cover: F64, x: float, y: float, yaw: float, to: float, room: float) -> bool:
    """Return whether the outline may turn on the spot from `yaw` to `to` [rad], the shorter way round."""
    angle = (to - yaw + math.pi) % (2.0 * math.pi) - math.pi
    n = math.ceil(abs(angle) / FINE)
    for k in range(1, n + 1):
        if not _fits(free, origin, cover, x, y, yaw + angle * k / n, room):
            return False
    return True


@kernel
def _drives(free: F64, origin: I64, cover: F64, a: F64, b: F64, yaw: float, room: float) -> bool:
    """Return whether the outline may go straight from a to b (2,) [m] at a heading [rad]."""
    length = math.sqrt((b[0] - a[0]) ** 2 + (b[1] - a[1]) ** 2)
    n = max(math.ceil(length / (0.5 * CELL)), 1)
    for k in range(1, n + 1):
        t = k / n
        if not _fits(free, origin, cover, a[0] + t * (b[0] - a[0]), a[1] + t * (b[1] - a[1]), yaw, room):
            return False
    return True


@kernel
def _open(free: F64, origin: I64, cover: F64, pose: F64, start: F64, corners: F64, room: float) -> bool:
    """Return whether the legs can still be driven from a pose on the first of them."""
    at, yaw = pose[:2].copy(), pose[2]
    for k in range(corners.shape[0]):
        origin_of = start if k == 0 else corners[k - 1]
        to = math.atan2(corners[k, 1] - origin_of[1], corners[k, 0] - origin_of[0])
        if k > 0 and not _turns(free, origin, cover, at[0], at[1], yaw, to, room):
            return False
        if not _drives(free, origin, cover, at, corners[k], to, room):
            return False
        at, yaw = corners[k].copy(), to
    return True


@kernel
def _lengths(free: F64, origin: I64, goal: F64, room: float) -> F64:
    """Return the length [cells] of a point's way from each cell to the goal, infinite where none is (Dijkstra)."""
    n = SIZE * SIZE
    cost, closed = np.full(n, math.inf), np.zeros(n, np.bool_)
    i = min(max(math.floor(goal[0] / CELL) - origin[0], 0), SIZE - 1)
    j = min(max(math.floor(goal[1] / CELL) - origin[1], 0), SIZE - 1)
    cost[i * SIZE + j] = 0.0
    heap = [(0.0, i * SIZE + j)]
    while len(heap) > 0:
        _, cell = heapq.heappop(heap)
        if closed[cell]:
            continue
        closed[cell] = True
        i, j = cell // SIZE, cell % SIZE
        for di in range(-1, 2):
            for dj in range(-1, 2):
                a, b = i + di, j + dj
                if (di == 0 and dj == 0) or not (0 <= a < SIZE and 0 <= b < SIZE) or free[a, b] < room:
                    continue
                to = a * SIZE + b
                c = cost[cell] + math.sqrt(float(di * di + dj * dj))
                if not closed[to] and c < cost[to]:
                    cost[to] = c
                    heapq.heappush(heap, (c, to))
    return cost


@kernel
def _legs(free: F64, origin: I64, cover: F64, pose: F64, goal: F64, room: float) -> tuple[F64, int]:
    """A* over poses, then neighbouring legs made one where that fits: (corners (CORNERS, 2), their number or 0)."""
    left = _lengths(free, origin, goal, room)
    si, sj = math.floor(pose[0] / CELL) - origin[0], math.floor(pose[1] / CELL) - origin[1]
    none = np.empty((CORNERS, 2))
    if not (0 <= si < SIZE and 0 <= sj < SIZE) or math.isinf(left[si * SIZE + sj]):
        return none, 0
    n = SIZE * SIZE * HEADINGS
    cost, parent, closed = np.full(n, math.inf), np.full(n, -1, np.int64), np.zeros(n, np.bool_)
    begin = (si * SIZE + sj) * HEADINGS + int(np.argmax(np.cos(BEARINGS - pose[2])))
    cost[begin] = 0.0
    heap = [(left[begin // HEADINGS], begin)]
    end, looked = -1, 0
    while len(heap) > 0 and looked < MOST:
        _, state = heapq.heappop(heap)
        if closed[state]:
            continue
        closed[state], looked = True, looked + 1
        cell, k = state // HEADINGS, state % HEADINGS
        if left[cell] < 0.5:
            end = state
            break
        i, j = cell // SIZE, cell % SIZE
        x, y = (origin[0] + i + 0.5) * CELL, (origin[1] + j + 0.5) * CELL
        yaw = BEARINGS[k]
        for move in range(3):
            if move < 2:
                side = 1 if move == 0 else -1
                next_k = (k + side) % HEADINGS
                to, step = cell * HEADINGS + next_k, TURN
                if closed[to] or not _turns(free, origin, cover, x, y, yaw, BEARINGS[next_k], room):
                    continue
            else:
                a, b = i + STEPS[k, 0], j + STEPS[k, 1]
                if not (0 <= a < SIZE and 0 <= b < SIZE):
                    continue
                to, step = (a * SIZE + b) * HEADINGS + k, math.sqrt(float(STEPS[k, 0] ** 2 + STEPS[k, 1] ** 2))
                there = np.array([x + STEPS[k, 0] * CELL, y + STEPS[k, 1] * CELL])
                if closed[to] or not _drives(free, origin, cover, np.array([x, y]), there, yaw, room):
                    continue
            c = cost[state] + step
            if c < cost[to] and not math.isinf(left[to // HEADINGS]):
                cost[to], parent[to] = c, state
                heapq.heappush(heap, (c + left[to // HEADINGS], to))
    if end < 0:
        return none, 0
    return _joined(free, origin, cover, pose, goal, room, parent, end)


@kernel
def _joined(
    free: F64, origin: I64, cover: F64, pose: F64, goal: F64, room: float, parent: I64, end: int
) -> tuple[F64, int]:
    """Return the corners of a chain of poses, each leg as long as turn and drive fit; 0 where they do not."""
    count, state = 0, end
    while state >= 0:
        count, state = count + 1, parent[state]
    points, m = np.empty((count + 1, 2)), count
    state = end
    for k in range(count - 1, -1, -1):
        cell = state // HEADINGS
        points[k, 0], points[k, 1] = (origin[0] + cell // SIZE + 0.5) * CELL, (origin[1] + cell % SIZE + 0.5) * CELL
        state = parent[state]
    points[0], points[m] = pose[:2], goal
    corners, k, at, yaw = np.empty((CORNERS, 2)), 0, 0, pose[2]
    while at < m and k < CORNERS:
        found = -1
        for to in range(m, at, -1):
            dx, dy = points[to, 0] - points[at, 0], points[to, 1] - points[at, 1]
            if dx * dx + dy * dy < 1e-6:
                continue
            heading = math.atan2(dy, dx)
            if _turns(free, origin, cover, points[at, 0], points[at, 1], yaw, heading, room) and _drives(
                free, origin, cover, points[at], points[to], heading, room
            ):
                found, yaw = to, heading
                break
        if found < 0:
            return corners, 0
        corners[k], at, k = points[found], found, k + 1
    return corners, k if at == m else 0

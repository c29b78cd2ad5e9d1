"""Whether a scene can be done at all: a way found by a sampling planner of its own, checked by pybullet, and timed.

It shares nothing with the controller's planner: RRT-Connect (Kuffner and LaValle, ICRA 2000) over the joints, free
where pybullet's distances between the links' collision shapes and everything else are enough, then shortened by
random shortcuts (Geraerts and Overmars, IJRR 26(8), 2007).
"""

from collections.abc import Callable
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from firmware_sim.plant import Plant
from rtctl.arm.robot import Robot
from rtctl.kernel.rotations import log3
from rtctl.types import F64

STEP = 0.35  # [rad] of a tree's growth, the largest joint's
FINE = 0.04  # [rad] between two checked postures
MARGIN = 0.02  # [rad] to joint limits
NODES = 1500  # of both trees
SHORTCUTS = 60
BINS = 200  # of a way that is timed

Free = Callable[[F64], bool]


class Room(NamedTuple):
    """What a posture must keep free."""

    rho: float  # [m] to every obstacle
    own: float  # [m] between links


def free_of(plant: Plant, robot: Robot, room: Room) -> Free:
    """Return the test of a posture (n,) by the plant's collision shapes, with the obstacles where they are now."""
    low, high = robot.q_min + MARGIN, robot.q_max - MARGIN

    def free(q: F64) -> bool:
        if bool((q < low).any() or (q > high).any()):
            return False
        plant.place(q)
        if min(plant.clearances().values(), default=np.inf) < room.rho:
            return False
        return plant.self_clearance() >= room.own

    return free


def way(start: F64, end: F64, robot: Robot, free: Free, rng: np.random.Generator) -> F64 | None:
    """Return postures (k, n) [rad] of a free way between two, None when none was found in NODES nodes."""
    if not (free(start) and free(end)):
        return None
    if _joined(start, end, free):
        return np.array([start, end])
    here, there = _Tree(start), _Tree(end)
    while len(here.q) + len(there.q) < NODES:
        reached = here.grown(rng.uniform(robot.q_min, robot.q_max), free)
        if reached is not None:
            other = there.connected(here.q[reached], free)
            if other is not None:
                path = [*reversed(here.path(reached)), *there.path(other)]
                if not np.array_equal(path[0], start):
                    path.reverse()
                return _shortened(np.array(path), free, rng)
        here, there = there, here
    return None


class _Tree:
    def __init__(self, root: F64) -> None:
        self.q, self.parent = [root], [-1]

    def grown(self, toward: F64, free: Free) -> int | None:
        """Return the node of one step from the nearest one, None where it is not free."""
        near = int(np.abs(np.array(self.q) - toward).max(axis=1).argmin())
        away = toward - self.q[near]
        size = float(np.abs(away).max())
        q = toward if size <= STEP else self.q[near] + away * (STEP / size)
        if size < 1e-9 or not _joined(self.q[near], q, free):
            return None
        self.q.append(q)
        self.parent.append(near)
        return len(self.q) - 1

    def connected(self, goal: F64, free: Free) -> int | None:
        """Return the node at `goal`, grown step by step, None when something is in the way."""
        while True:
            k = self.grown(goal, free)
            if k is None:
                return None
            if np.array_equal(self.q[k], goal):
                return k

    def path(self, k: int) -> list[F64]:
        """Return the postures from node k to the root."""
        out = []
        while k >= 0:
            out.append(self.q[k])
            k = self.parent[k]
        return out


def _joined(a: F64, b: F64, free: Free) -> bool:
    """Return whether the straight line between two postures is free, its ends left out but the last."""
    count = max(1, int(np.ceil(np.abs(b - a).max() / FINE)))
    return all(free(a + (b - a) * (k / count)) for k in range(1, count + 1))


def _shortened(path: F64, free: Free, rng: np.random.Generator) -> F64:
    for _ in range(SHORTCUTS):
        if len(path) < 3:
            break
        i, j = sorted(rng.choice(len(path), 2, replace=False))
        if j - i > 1 and _joined(path[i], path[j], free):
            path = np.concatenate([path[: i + 1], path[j:]])
    return path


def duration(robot: Robot, path: F64) -> float:
    """Return the time [s] of a way (k, n) [rad] under the robot's limits, from rest to rest.

    A trapezoid along the way: everywhere the share of the fastest that joint speeds, v_max and w_max allow; it rises
    from 0 to 1, and falls again, in the tip's stopping time v_max / a_max. T = sum of the pieces at full speed + that.
    Corners are taken without a stop, so that it is rather too short than too long.
    """
    m = robot.motion
    fine = _fine(path)
    poses = [robot.body.evaluate(q, np.zeros(robot.n), robot.points, robot.own) for q in fine]
    least = 0.0  # [s] at full speed all along
    for (a, b), (p, r) in zip(pairwise(fine), pairwise(poses), strict=True):
        turned = float(np.linalg.norm(log3(p.R.T @ r.R)))
        joints = float((np.abs(b - a) / robot.qd_max).max())
        least += max(joints, float(np.linalg.norm(r.x - p.x)) / m.v_max, turned / m.w_max)
    stop = m.v_max / m.a_max  # [s]
    return least + stop if least >= stop else 2.0 * float(np.sqrt(least * stop))


def _fine(path: F64) -> F64:
    sizes = np.abs(np.diff(path, axis=0)).max(axis=1)
    at = np.concatenate([[0.0], np.cumsum(sizes)])
    s = np.linspace(0.0, at[-1], BINS + 1)
    return np.stack([np.interp(s, at, path[:, k]) for k in range(path.shape[1])], axis=1)

"""The obstacles of a scenario as bodies of a pybullet world: kinematic, where their scenario says, when it says."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from firmware_sim.bullet import pb
from firmware_sim.shapes import REST, Solid, collision_shape, leg_at, place_at, shape_at

Pose = tuple[float, ...]  # x, y, z [m], w, x, y, z


class Obstacles:
    """Owns the bodies of the obstacles that are present."""

    def __init__(self, client: int, solids: Sequence[Solid], margin: float) -> None:
        """`margin` [m] is pybullet's own around a collision shape."""
        self.client, self.solids, self.margin = client, list(solids), margin
        self.bodies: dict[str, int] = {}  # of those that are present
        self.moved: NDArray[np.float64] = np.zeros(len(self.solids))  # [m] at most that any point of it has gone so far
        self._poses: dict[str, Pose] = {}
        self._times: dict[str, float] = {}
        self._radius: dict[str, float] = {}  # [m] of the ball about its origin that holds it
        self._turned: list[tuple[float, ...]] = [tuple(s.wxyz.tolist()) for s in self.solids]  # of what does not spin
        self._rests = [(0.0, 0.0)] * len(self.solids)  # [s] when nothing about it changes
        self._spin = [float(np.linalg.norm(s.spec.get("omega_rad_s", (0.0, 0.0, 0.0)))) for s in self.solids]  # [rad/s]

    def move(self, t: float) -> list[int]:
        """Put every obstacle where it is at time t [s]; return the places in `solids` of those that came or went."""
        changed = []
        for k, obstacle in enumerate(self.solids):
            begins, ends = self._rests[k]
            if begins <= t < ends:
                continue
            there = obstacle.name in self.bodies
            if obstacle.appears <= t < obstacle.vanishes:
                if not there:
                    self._create(k, obstacle, t)
                    changed.append(k)
                else:
                    self._put(k, obstacle, t)
            elif there:
                pb.removeBody(self.bodies.pop(obstacle.name), physicsClientId=self.client)
                changed.append(k)
            self._rests[k] = self._rest(k, obstacle, t)
        return changed

    def _rest(self, k: int, obstacle: Solid, t: float) -> tuple[float, float]:
        """Return from when to when [s] nothing changes about an obstacle, t within; nothing where it moves."""
        if t < obstacle.appears:
            return -math.inf, obstacle.appears
        if t >= obstacle.vanishes:
            return obstacle.vanishes, math.inf
        leg = leg_at(obstacle, t)
        if self._spin[k] != 0.0 or leg.velocity != REST:
            return 0.0, 0.0
        return max(leg.begins, obstacle.appears), min(leg.ends, obstacle.vanishes)

    def _pose(self, k: int, obstacle: Solid, t: float) -> Pose:
        if self._spin[k] == 0.0:
            return (*place_at(leg_at(obstacle, t), t), *self._turned[k])
        shape = shape_at(obstacle, t)
        assert shape is not None
        return (*shape.position.tolist(), *shape.wxyz.tolist())

    def _create(self, k: int, obstacle: Solid, t: float) -> None:
        x, y, z, *wxyz = pose = self._pose(k, obstacle, t)
        form = collision_shape(obstacle, self.client)
        body = pb.createMultiBody(0.0, form, -1, (x, y, z), (*wxyz[1:], wxyz[0]), physicsClientId=self.client)
        pb.changeDynamics(body, -1, collisionMargin=self.margin, physicsClientId=self.client)
        name = obstacle.name
        self.bodies[name], self._poses[name], self._times[name] = body, pose, t
        corners = np.array(pb.getAABB(body, physicsClientId=self.client)) - (x, y, z)
        self._radius[name] = float(np.linalg.norm(np.abs(corners).max(axis=0)))

    def _put(self, k: int, obstacle: Solid, t: float) -> None:
        name = obstacle.name
        pose, old = self._pose(k, obstacle, t), self._poses[name]
        if pose == old:
            return
        turned = self._spin[k] * abs(t - self._times[name]) * self._radius[name]
        self.moved[k] += math.dist(pose[:3], old[:3]) + turned
        self._poses[name], self._times[name] = pose, t
        pb.resetBasePositionAndOrientation(
            self.bodies[name], pose[:3], (*pose[4:], pose[3]), physicsClientId=self.client
        )

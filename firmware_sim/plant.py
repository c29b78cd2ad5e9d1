"""The arm and its world as rigid bodies in pybullet: what the drives' torques do, and how near everything is.

The URDF is rewritten for the plant, see `firmware_sim.urdf`. Obstacles are massless and kinematic: they
push the arm, the arm does not push them. Links of the arm do not push each other; their distance is measured.

Collision meshes of links are their convex hulls with pybullet's margin of 1 mm: clearances to them are 1 mm too small
and contact begins 1 mm early. The same margin rounds the corners of a link's boxes, by 0.7 mm at most.
"""

import os
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from firmware_sim.bullet import pb, silent
from firmware_sim.drive import NS
from firmware_sim.settings import Settings, SettingsError
from firmware_sim.shapes import collision_shape, shape_at, solid
from firmware_sim.urdf import rewrite

F64 = NDArray[np.float64]
GRAVITY = 9.81  # [m/s^2]
STEP_NS = 500_000  # longest physics step
SIGHT = 0.5  # [m] clearances are measured up to here; farther counts as this
SELF_SIGHT = 0.1  # [m] the same between links of the arm
BEYOND = SIGHT + 0.1  # [m] clouds are looked for up to here, so that far ones need not be measured every time
LEVER = 2.0  # [m] no point of the arm is further from the axis of any of its joints
FASTEST = 10.0  # [m/s] no two links of an arm close faster
NEAR, TOUCH = 0.1, 1e-3  # [m] see Plant._pairs
MARGIN = 0.0


class Contact(NamedTuple):
    """One contact event: when, what touched what, and who ran into whom."""

    time: float  # [s]
    link: str
    other: str
    cause: str  # "arm" | "obstacle" | "self"
    arm_m_s: float = 0.0  # speed with which the arm's own point came towards the obstacle, just before they met
    other_m_s: float = 0.0  # and the obstacle's towards the arm
    row: tuple[float, ...] = ()  # d gap/d q (n,) of the arm's point [m/rad]


class Plant:
    """Owns a pybullet world: the arm, the obstacles, and time. Deterministic: no threads, no randomness."""

    def __init__(self, settings: Settings, start_q: Sequence[float] | F64, obstacles: Sequence[dict[str, Any]]) -> None:
        self.settings = settings
        self.client = pb.connect(pb.DIRECT)
        n_steps = -(-settings.period_ns // STEP_NS)
        self.step_ns = settings.period_ns // n_steps
        self.substeps = n_steps
        self._engine()
        urdf = rewrite(settings)
        self.body = self._load(urdf)
        self._identify()
        self._inertias(urdf)
        self.time_ns = 0
        self.scene_ns = 0  # time on the scenario's clock: where the obstacles are
        self.solids = [solid(dict(o), settings) for o in obstacles]
        self.bodies: dict[str, int] = {}
        self.poses: dict[str, tuple[float, ...]] = {}
        self.scans = {s.name: s.scan.radius for s in self.solids if s.scan is not None}
        self.cloud_seen: dict[str, tuple[float, float, list[float], int]] = {}  # distance, least so far, q, time [ns]
        self.touching: set[tuple[str, str]] = set()
        self.contacts: list[Contact] = []
        self.drag = [-1.0] * len(self.index)
        self.q = [0.0] * len(self.index)
        self.qd = [0.0] * len(self.index)
        self.self_due: dict[tuple[int, int], int] = {}  # [ns] when a pair must be looked at again
        self.far_pairs = self._pairs(settings.home)
        self.place(start_q)
        self._before = self.q, self.qd
        self._move_obstacles()

    def _engine(self) -> None:
        pb.setGravity(0.0, 0.0, -GRAVITY, physicsClientId=self.client)
        pb.setPhysicsEngineParameter(
            fixedTimeStep=self.step_ns / NS,
            numSubSteps=0,
            numSolverIterations=50,
            solverResidualThreshold=0.0,  # the default lets a braked arm creep by 0.2 mrad/s
            deterministicOverlappingPairs=1,
            enableFileCaching=0,
            physicsClientId=self.client,
        )

    def _load(self, urdf: str) -> int:
        with tempfile.TemporaryDirectory() as folder:
            path = os.path.join(folder, "plant.urdf")
            with open(path, "w", encoding="utf-8") as file:
                file.write(urdf)
            try:
                with silent():
                    flags = pb.URDF_USE_INERTIA_FROM_FILE | pb.URDF_USE_IMPLICIT_CYLINDER
                    return int(pb.loadURDF(path, useFixedBase=True, flags=flags, physicsClientId=self.client))
            except pb.error as error:
                raise SettingsError(f"{self.settings.urdf}: {error}") from error

    def _identify(self) -> None:
        """Find joints and links by name; take every damping and motor that pybullet adds away."""
        info = [pb.getJointInfo(self.body, i, physicsClientId=self.client) for i in range(self._joints())]
        by_joint = {i[1].decode(): i[0] for i in info}
        self.index = [by_joint[j.name] for j in self.settings.joints]
        self.links = {i[0]: i[12].decode() for i in info}
        self.parent = {i[0]: i[16] for i in info}
        frames = {name: i for i, name in self.links.items()}
        if self.settings.tip_frame not in frames:
            raise SettingsError(f"{self.settings.urdf}: has no link {self.settings.tip_frame}")
        self.tip = frames[self.settings.tip_frame]
        for i in range(-1, self._joints()):
            pb.changeDynamics(
                self.body,
                i,
                linearDamping=0.0,
                angularDamping=0.0,
                jointDamping=0.0,
                maxJointVelocity=1000.0,
                collisionMargin=MARGIN,
                activationState=pb.ACTIVATION_STATE_DISABLE_SLEEPING,
                physicsClientId=self.client,
            )
        movable = [i[0] for i in info if i[2] != pb.JOINT_FIXED]
        for i in movable:
            pb.setJointMotorControl2(self.body, i, pb.VELOCITY_CONTROL, force=0.0, physicsClientId=self.client)
        self.moving = frozenset(i for i in self.links if self._chain(i))
        self.armature = np.array([j.armature for j in self.settings.joints])
        self.friction = np.array([j.friction for j in self.settings.joints])
        self.motors = bool(self.armature.any() or self.friction.any())

    def _inertias(self, urdf: str) -> None:
        """Give links the tensor of the URDF where pybullet replaced it by zero.

        It does so, with no more than a warning, where the largest moment is more than the sum of the others: published
        identifications have such links.
        """
        frames = {name: i for i, name in self.links.items()}
        for link in ET.fromstring(urdf).findall("link"):
            tensor = link.find("inertial/inertia")
            i = frames.get(link.get("name", ""), -1)
            if tensor is None or i < 0:
                continue
            wanted = [float(tensor.get(k, "0")) for k in ("ixx", "iyy", "izz")]
            if not any(wanted) or any(pb.getDynamicsInfo(self.body, i, physicsClientId=self.client)[2]):
                continue
            if any(float(tensor.get(k, "0")) for k in ("ixy", "ixz", "iyz")):
                raise SettingsError(
                    f"{self.settings.urdf}: link {link.get('name')}: no body has such an inertia tensor"
                )
            pb.changeDynamics(self.body, i, localInertiaDiagonal=wanted, physicsClientId=self.client)

    def _joints(self) -> int:
        return int(pb.getNumJoints(self.body, physicsClientId=self.client))

    # ---- motion

    def place(self, q: Sequence[float] | F64) -> None:
        """Put the arm at rest at q [rad]."""
        for i, value in zip(self.index, q, strict=True):
            pb.resetJointState(self.body, i, float(value), 0.0, physicsClientId=self.client)
        self.self_due.clear()
        self._read()

    def _read(self) -> None:
        states = pb.getJointStates(self.body, self.index, physicsClientId=self.client)
        self.q = [s[0] for s in states]
        self.qd = [s[1] for s in states]

    def step(self, torque: Sequence[float], drag: Sequence[float]) -> None:
        """Advance one physics step under driven torques [Nm] and bounds on opposing torque [Nm], per joint.

        Drag is a velocity motor towards zero speed with a bounded force: it brakes and holds, and never drives.
        """
        if self.motors:
            torque = self._with_motors(torque)
        pb.setJointMotorControlArray(
            self.body, self.index, pb.TORQUE_CONTROL, forces=torque, physicsClientId=self.client
        )
        for k, bound in enumerate(drag):
            if bound != self.drag[k]:
                pb.setJointMotorControl2(
                    self.body,
                    self.index[k],
                    pb.VELOCITY_CONTROL,
                    targetVelocity=0.0,
                    force=bound,
                    physicsClientId=self.client,
                )
                self.drag[k] = bound
        pb.stepSimulation(physicsClientId=self.client)
        self.time_ns += self.step_ns
        self._read()

    def _with_motors(self, torque: Sequence[float]) -> list[float]:
        """Return the torques that move the arm as if each joint also carried its motor's inertia and friction.

        (A + diag(J G^2)) qdd = tau - B G^2 qd - h - g; pybullet, which knows A alone, gets tau - B G^2 qd - J G^2 qdd.
        """
        A = np.array(pb.calculateMassMatrix(self.body, self.q, physicsClientId=self.client))
        bias = pb.calculateInverseDynamics(self.body, self.q, self.qd, [0.0] * len(self.q), physicsClientId=self.client)
        tau = np.asarray(torque, dtype=np.float64) - self.friction * np.array(self.qd)
        qdd = np.linalg.solve(A + np.diag(self.armature), tau - np.array(bias))
        result: list[float] = (tau - self.armature * qdd).tolist()
        return result

    def advance_world(self) -> None:
        """Close a servo period: contacts counted, obstacles to where they are now."""
        self._count_contacts()
        self._before = self.q, self.qd
        self._move_obstacles()

    def _move_obstacles(self) -> None:
        t = self.scene_ns / NS
        for obstacle in self.solids:
            body = self.bodies.get(obstacle.name, -1)
            present = obstacle.appears <= t < obstacle.vanishes
            if present == (body >= 0) and (obstacle.still or not present):
                continue
            shape = shape_at(obstacle, t)
            if shape is None:
                self.cloud_seen.pop(obstacle.name, None)
                pb.removeBody(self.bodies.pop(obstacle.name), physicsClientId=self.client)
                continue
            w, x, y, z = shape.wxyz
            if body < 0:
                form = collision_shape(obstacle, self.client)
                body = pb.createMultiBody(
                    0.0, form, -1, shape.position.tolist(), (x, y, z, w), physicsClientId=self.client
                )
                pb.changeDynamics(body, -1, collisionMargin=MARGIN, physicsClientId=self.client)
                self.bodies[obstacle.name], self.poses[obstacle.name] = body, (*shape.position, *shape.wxyz)
            elif self.poses[obstacle.name] != (pose := (*shape.position, *shape.wxyz)):
                self.poses[obstacle.name] = pose
                pb.resetBasePositionAndOrientation(
                    body, shape.position.tolist(), (x, y, z, w), physicsClientId=self.client
                )

    # ---- what an oracle sees

    def _count_contacts(self) -> None:
        """Count rising edges of contact, per link and obstacle."""
        now: set[tuple[str, str]] = set()
        for name, body in self.bodies.items():
            if name in self.scans:
                continue  # the engine knows their centres alone; see _cloud_clearance
            for point in pb.getContactPoints(self.body, body, physicsClientId=self.client):
                if point[3] not in self.moving or point[8] > 0.0:
                    continue
                pair = (self.links[point[3]], name)
                if pair not in now and pair not in self.touching:
                    self.contacts.append(self._met(point, name))
                now.add(pair)
        self.touching = now | {pair for pair in self.touching if pair[1].startswith("self:")}

    def _met(self, point: tuple[Any, ...], name: str) -> Contact:
        """Return the contact: whose surface moved faster along the normal before they met closed the gap."""
        q, qd = self._before  # the impact has changed the arm's speed already
        com, turned = pb.getLinkState(self.body, point[3], physicsClientId=self.client)[:2]
        local, _ = pb.multiplyTransforms(*pb.invertTransform(com, turned), point[5], (0.0, 0.0, 0.0, 1.0))
        rows = pb.calculateJacobian(self.body, point[3], local, q, qd, [0.0] * len(q), physicsClientId=self.client)
        normal = np.array(point[7])  # from the obstacle to the arm
        row = normal @ np.array(rows[0])
        own = -float(row @ np.array(qd))
        shape = shape_at(next(s for s in self.solids if s.name == name), self.scene_ns / NS)
        other = 0.0
        if shape is not None:
            other = float(normal @ (shape.velocity + np.cross(shape.omega, np.array(point[6]) - shape.position)))
        cause = "obstacle" if other > own else "arm"
        return Contact(self.time_ns / NS, self.links[point[3]], name, cause, own, other, tuple(row.tolist()))

    def clearances(self) -> dict[str, float]:
        """Return the smallest distance of any moving link to each obstacle present [m], at most SIGHT."""
        found: dict[str, float] = {}
        for name, body in self.bodies.items():
            if name in self.scans:
                found[name] = self._cloud_clearance(name, body)
                continue
            points = pb.getClosestPoints(self.body, body, SIGHT, physicsClientId=self.client)
            found[name] = min((p[8] for p in points if p[3] in self.moving), default=SIGHT)
        return found

    def _cloud_clearance(self, name: str, body: int) -> float:
        """Return the smallest distance of any moving link to the balls of a cloud [m], at most SIGHT.

        Measured when what has moved since could have brought a link nearer than ever before; until then as it was:
        thousands of specks take pybullet milliseconds, and the smallest clearance is missed by nothing.
        """
        radius = self.scans[name]
        last, least, turned, then = self.cloud_seen.get(name, (0.0, np.inf, self.q, self.time_ns))
        shape = shape_at(next(s for s in self.solids if s.name == name), self.scene_ns / NS)
        fast = (
            0.0 if shape is None else float(np.linalg.norm(shape.velocity) + 2.0 * LEVER * np.linalg.norm(shape.omega))
        )
        moved = LEVER * float(np.abs(np.subtract(self.q, turned)).sum()) + fast * (self.time_ns - then) / NS
        if name in self.cloud_seen and last - moved > min(least, SIGHT):
            return min(last, SIGHT)
        points: Sequence[tuple[Any, ...]] = ()
        sight = max(last + 2.0 * moved, 0.02) + radius
        while not points and sight < 2.0 * (BEYOND + radius):  # near first: few specks are within a small sight
            points = pb.getClosestPoints(self.body, body, min(sight, BEYOND + radius), physicsClientId=self.client)
            points = [p for p in points if p[3] in self.moving]
            sight *= 2.0
        nearest = min(points, key=lambda p: p[8], default=None)
        distance = BEYOND if nearest is None else float(nearest[8]) - radius
        pair = (self.links[nearest[3]] if nearest is not None else "", name)
        if distance <= 0.0 and nearest is not None and least > 0.0 and pair not in self.touching:
            self.contacts.append(self._met(nearest, name))
        self.cloud_seen[name] = distance, min(least, distance), list(self.q), self.time_ns
        return min(distance, SIGHT)

    def self_clearance(self) -> float:
        """Return the smallest distance between links that are not neighbours [m], at most SELF_SIGHT."""
        smallest = SELF_SIGHT
        now: set[tuple[str, str]] = set()
        for a, b in self.far_pairs:
            if self.time_ns < self.self_due.get((a, b), 0):
                continue  # too far apart at the last look to be within SELF_SIGHT yet
            points = pb.getClosestPoints(self.body, self.body, SIGHT, a, b, physicsClientId=self.client)
            distance = min((p[8] for p in points), default=SIGHT)
            self.self_due[a, b] = self.time_ns + int(max(distance - SELF_SIGHT, 0.0) / FASTEST * NS)
            smallest = min(smallest, distance)
            if distance <= 0.0:
                now.add((self.links[a], "self:" + self.links[b]))
        for pair in sorted(now - self.touching):
            self.contacts.append(Contact(self.time_ns / NS, pair[0], pair[1], "self"))
        self.touching = {p for p in self.touching if not p[1].startswith("self:")} | now
        return smallest

    def _pairs(self, home: Sequence[float]) -> list[tuple[int, int]]:
        """Return pairs of links that could meet.

        Left out: links of one body, neighbours, what touches at home, and links two joints apart that are near at home:
        they stay near whatever the joint between them does, and their hulls overlap where the links do not.
        """
        self.place(home)
        shaped = [i for i in sorted(self.links) if pb.getCollisionShapeData(self.body, i, physicsClientId=self.client)]
        chain = {i: self._chain(i) for i in shaped}
        pairs = []
        for k, a in enumerate(shaped):
            for b in shaped[k + 1 :]:
                apart = len(set(chain[a]) ^ set(chain[b]))  # joints between the two links
                if apart < 2:
                    continue
                sight = NEAR if apart == 2 else TOUCH
                if not pb.getClosestPoints(self.body, self.body, sight, a, b, physicsClientId=self.client):
                    pairs.append((a, b))
        return pairs

    def _chain(self, link: int) -> list[int]:
        """Return the moving joints between the base and a link."""
        found = []
        while link >= 0:
            if link in self.index:
                found.append(link)
            link = self.parent[link]
        return found

    def tip_pose(self) -> tuple[F64, F64]:
        """Return position [m] and orientation wxyz of the tip frame."""
        state = pb.getLinkState(self.body, self.tip, computeForwardKinematics=1, physicsClientId=self.client)
        x, y, z, w = state[5]
        return np.array(state[4]), np.array([w, x, y, z])

    def close(self) -> None:
        """Leave pybullet."""
        if self.client >= 0:
            pb.disconnect(self.client)
            self.client = -1

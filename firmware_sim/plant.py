"""The arm and its world as rigid bodies in pybullet: what the drives' torques do, and how near everything is.

The URDF is rewritten for the plant, see `firmware_sim.urdf`. Obstacles are massless and kinematic: they
push the arm, the arm does not push them. Links of the arm do not push each other; their distance is measured.

Collision meshes of links are their convex hulls with pybullet's margin of 1 mm: clearances to them are 1 mm too small
and contact begins 1 mm early. The same margin rounds the corners of a link's boxes, by 0.7 mm at most.
"""

import os
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from firmware_sim.bullet import pb, silent
from firmware_sim.drive import NS
from firmware_sim.friction import Joints
from firmware_sim.obstacles import Obstacles
from firmware_sim.oracle import Arm, Contact, Oracle, State
from firmware_sim.reality import Reality, reality_of
from firmware_sim.settings import Settings, SettingsError
from firmware_sim.shapes import solid
from firmware_sim.urdf import rewrite, urdf_dynamics

F64 = NDArray[np.float64]
GRAVITY = 9.81  # [m/s^2]
STEP_NS = 500_000  # longest physics step
MARGIN = 0.0
__all__ = ["Contact", "Plant"]


class Plant:
    """Owns a pybullet world: the arm, the obstacles, and time. Deterministic: no threads, no randomness."""

    def __init__(
        self,
        settings: Settings,
        start_q: Sequence[float] | F64,
        obstacles: Sequence[dict[str, Any]],
        reality: Reality | None = None,
    ) -> None:
        """`reality`: how it differs from its description, None: in nothing."""
        self.settings = settings
        self.reality = reality_of({}, settings) if reality is None else reality
        self.client = pb.connect(pb.DIRECT)
        n_steps = -(-settings.period_ns // STEP_NS)
        self.step_ns = settings.period_ns // n_steps
        self.substeps = n_steps
        self._engine()
        urdf = rewrite(settings, self.reality)
        self.body = self._load(urdf)
        self._identify()
        self._inertias(urdf)
        self.time_ns = 0
        self.scene_ns = 0  # time on the scenario's clock: where the obstacles are
        self.pushed: dict[int, F64] = {}
        self.drag = [-1.0] * len(self.index)
        self.q = [0.0] * len(self.index)
        self.qd = [0.0] * len(self.index)
        self.place(settings.home)
        self.solids = [solid(dict(o), settings) for o in obstacles]
        self.obstacles = Obstacles(self.client, self.solids, MARGIN)
        self.oracle = Oracle(Arm(self.client, self.body, tuple(self.index), self.links, self.parent), self.obstacles)
        self.place(start_q)
        self._before = self._state()
        self._move_obstacles()

    @property
    def contacts(self) -> list[Contact]:
        """Contact events so far."""
        return self.oracle.contacts

    @property
    def bodies(self) -> dict[str, int]:
        """pybullet's numbers of the obstacles that are present, by name."""
        return self.obstacles.bodies

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
        self.armature = np.array([j.armature for j in self.settings.joints])
        self._rotors = np.diag(self.armature)
        viscous, coulomb = urdf_dynamics(self.settings, self.reality)
        self.friction = np.array([j.friction for j in self.settings.joints]) + viscous
        self.joints = Joints(
            self.reality._replace(coulomb=tuple(coulomb), static=tuple(np.maximum(coulomb, self.reality.static))),
            [r.torque for r in self.settings.ratings],
        )
        self.motors = bool(self.armature.any() or self.friction.any() or self.joints.rubs)

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
                if not self._moves(i):
                    continue
                raise SettingsError(
                    f"{self.settings.urdf}: link {link.get('name')}: no body has such an inertia tensor"
                )
            pb.changeDynamics(self.body, i, localInertiaDiagonal=wanted, physicsClientId=self.client)

    def _moves(self, link: int) -> bool:
        """Return whether some joint of the arm moves a link."""
        while link >= 0:
            if link in self.index:
                return True
            link = self.parent[link]
        return False

    def _joints(self) -> int:
        return int(pb.getNumJoints(self.body, physicsClientId=self.client))

    # ---- motion

    def place(self, q: Sequence[float] | F64) -> None:
        """Put the arm at rest at q [rad]."""
        for i, value in zip(self.index, q, strict=True):
            pb.resetJointState(self.body, i, float(value), 0.0, physicsClientId=self.client)
        self._read()

    def _read(self) -> None:
        states = pb.getJointStates(self.body, self.index, physicsClientId=self.client)
        self.q = [s[0] for s in states]
        self.qd = [s[1] for s in states]

    def push(self, forces: Mapping[str, Sequence[float]]) -> None:
        """Let forces [N] in the world act at the centres of mass of links, until told otherwise. Raises SettingsError.

        The torque J^T f at the joints stands for each.
        """
        frames = {name: i for i, name in self.links.items()}
        for name in forces:
            if name not in frames:
                raise SettingsError(f"push: {name} is no link of {self.settings.urdf}")
        self.pushed = {frames[name]: np.array(f, dtype=np.float64) for name, f in forces.items() if any(f)}

    def _pushed(self) -> F64:
        """Return the torque (n,) [Nm] of the pushes."""
        torque = np.zeros(len(self.q))
        for link, force in self.pushed.items():
            at = np.array(pb.getLinkState(self.body, link, computeForwardKinematics=1, physicsClientId=self.client)[0])
            for k, joint in enumerate(self.index):
                if joint in self._above(link):
                    axis, origin = self._axis(joint)
                    torque[k] += np.cross(axis, at - origin) @ force
        return torque

    def _above(self, link: int) -> set[int]:
        """Return the joints between a link and the base; pybullet numbers a joint as the link it moves."""
        found = set()
        while link >= 0:
            found.add(link)
            link = self.parent[link]
        return found

    def _axis(self, joint: int) -> tuple[F64, F64]:
        """Return the axis of a revolute joint and a place on it [m], in the world."""
        state = pb.getLinkState(self.body, joint, physicsClientId=self.client)
        R = np.array(pb.getMatrixFromQuaternion(state[1])).reshape(3, 3)  # of the frame of inertia
        axis = np.array(pb.getJointInfo(self.body, joint, physicsClientId=self.client)[13])
        return R @ axis, np.array(state[4])

    def step(self, torque: Sequence[float], drag: Sequence[float]) -> None:
        """Advance one physics step under driven torques [Nm] and bounds on opposing torque [Nm], per joint.

        Drag is a velocity motor towards zero speed with a bounded force: it brakes and holds, and never drives.
        """
        if not self.joints.ideal:
            torque, drag = self.joints.given(torque, drag)
        if self.pushed:
            torque = (np.asarray(torque) + self._pushed()).tolist()
        if self.motors:
            torque = self._with_motors(torque, drag)
        pb.setJointMotorControlArray(
            self.body, self.index, pb.TORQUE_CONTROL, forces=torque, physicsClientId=self.client
        )
        if drag != self.drag:
            self._brake(drag)
        pb.stepSimulation(physicsClientId=self.client)
        self.time_ns += self.step_ns
        self._read()

    def _with_motors(self, torque: Sequence[float], drag: Sequence[float]) -> list[float]:
        """Return the torques that move the arm as if each joint also carried its motor's inertia and friction.

        (A + diag(J G^2)) qdd = tau - B G^2 qd - f - b - h - g; pybullet, which knows A alone and finds the brakes' b by
        itself, gets tau - B G^2 qd - f - J G^2 qdd. The friction f is that of `friction`, and b <= drag [Nm] another:
        a joint that its brake holds does not carry its motor's inertia along.
        """
        A = np.array(pb.calculateMassMatrix(self.body, self.q, physicsClientId=self.client))
        bias = pb.calculateInverseDynamics(self.body, self.q, self.qd, [0.0] * len(self.q), physicsClientId=self.client)
        tau = np.asarray(torque, dtype=np.float64) - self.friction * np.array(self.qd)
        braked = np.zeros(len(tau))
        if self.joints.rubs or any(drag):
            rubbing, braked = self.joints.rub(
                A + self._rotors, tau - np.array(bias), np.array(self.qd), self.step_ns / NS, np.array(drag)
            )
            tau -= rubbing
        qdd = np.linalg.solve(A + self._rotors, tau - braked - np.array(bias))
        result: list[float] = (tau - self.armature * qdd).tolist()
        return result

    def _brake(self, drag: Sequence[float]) -> None:
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

    def advance_world(self) -> None:
        """Close a servo period: contacts counted, obstacles to where they are now."""
        now = self._state()
        self.oracle.count_contacts(now, self._before)
        self._before = now
        self._move_obstacles()

    def _state(self) -> State:
        return State(self.q, self.qd, self.time_ns, self.scene_ns)

    def _move_obstacles(self) -> None:
        for k in self.obstacles.move(self.scene_ns / NS):
            self.oracle.forget(k)

    # ---- what an oracle sees

    def clearances(self, exact: bool = True) -> dict[str, float]:
        """Return the smallest distance of any moving link to each obstacle present [m], see `Oracle.clearances`."""
        return self.oracle.clearances(self._state(), self._before, exact)

    def self_clearance(self, exact: bool = True) -> float:
        """Return the smallest distance between links that are not neighbours [m], see `Oracle.self_clearance`."""
        return self.oracle.self_clearance(self._state(), exact)

    def tip_pose(self) -> tuple[F64, F64]:
        """Return position [m] and orientation wxyz of the tip frame."""
        state = pb.getLinkState(self.body, self.tip, computeForwardKinematics=1, physicsClientId=self.client)
        x, y, z, w = state[5]
        pose = np.array((*state[4], w, x, y, z))
        return pose[:3], pose[3:]

    def close(self) -> None:
        """Leave pybullet."""
        if self.client >= 0:
            pb.disconnect(self.client)
            self.client = -1

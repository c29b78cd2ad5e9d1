"""Arms that tests share: the Panda of example-robot-data, and a crooked little one that has every kind of joint."""

import xml.etree.ElementTree as ET
from functools import cache
from pathlib import Path

import numpy as np
import pybullet
from scipy.spatial.transform import Rotation

from rtctl.arm.points import Points
from rtctl.arm.rigid_body import RigidBody
from rtctl.spec.urdf import package_folders, urdf_file
from rtctl.types import F64

PANDA = urdf_file("package://example-robot-data/robots/panda_description/urdf/panda.urdf", Path("panda.toml"))
PANDA_JOINTS = tuple(f"panda_joint{i}" for i in range(1, 8))
PANDA_HOME = np.array([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785])
TILTED = np.array([[0.8, 0.0, 0.6, 0.3], [0.36, 0.8, -0.48, -0.2], [-0.48, 0.6, 0.64, 0.5], [0.0, 0.0, 0.0, 1.0]])

CROOKED_JOINTS = ("wheel", "slide", "hinge", "wrist")
CROOKED = """<robot name="crooked">
  <link name="base"><collision><geometry><box size="0.2 0.2 0.1"/></geometry></collision></link>
  <link name="a">{inertial}<collision><origin xyz="0 0 0.1"/>
    <geometry><cylinder radius="0.04" length="0.2"/></geometry></collision></link>
  <link name="b">{inertial}<collision><geometry><sphere radius="0.06"/></geometry></collision></link>
  <link name="c">{inertial}<collision><geometry><box size="0.05 0.06 0.3"/></geometry></collision></link>
  <link name="d">{inertial}</link>
  <link name="e">{inertial}</link>
  <link name="tip"/>
  <joint name="wheel" type="continuous"><parent link="base"/><child link="a"/>
    <origin xyz="0 0 0.1" rpy="0.1 0.2 0.3"/><axis xyz="0 0.6 0.8"/><limit effort="20" velocity="3"/></joint>
  <joint name="slide" type="prismatic"><parent link="a"/><child link="b"/>
    <origin xyz="0.1 0.05 0.2" rpy="0 0.7 0"/><axis xyz="0.6 0 0.8"/>
    <limit effort="50" velocity="1" lower="-0.2" upper="0.3"/></joint>
  <joint name="hinge" type="revolute"><parent link="b"/><child link="c"/>
    <origin xyz="0 0.1 0.1" rpy="1.2 0 0.4"/><axis xyz="1 0 0"/>
    <limit effort="10" velocity="2" lower="-2" upper="1"/></joint>
  <joint name="wrist" type="revolute"><parent link="c"/><child link="e"/>
    <origin xyz="0 0.02 0.15" rpy="0 1 0"/><axis xyz="0 0 1"/>
    <limit effort="5" velocity="4" lower="-1.5" upper="1.5"/></joint>
  <joint name="aside" type="revolute"><parent link="a"/><child link="d"/>
    <origin xyz="0 0 0.1"/><axis xyz="0 0 1"/><limit effort="1" velocity="1" lower="-1" upper="1"/></joint>
  <joint name="mount" type="fixed"><parent link="e"/><child link="tip"/><origin xyz="0.02 0 0.1" rpy="0.3 0 0"/></joint>
</robot>""".replace(
    "{inertial}",
    """<inertial><origin xyz="0.02 -0.01 0.05" rpy="0.2 0.1 0"/><mass value="1.3"/>
    <inertia ixx="0.02" ixy="0.001" ixz="-0.002" iyy="0.03" iyz="0.0015" izz="0.025"/></inertial>""",
)

NO_POINTS = Points(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros(0), ())


@cache
def panda() -> RigidBody:
    """Return the Panda on a level base, fingers closed."""
    return RigidBody.from_urdf(PANDA, PANDA_JOINTS, "panda_hand_tcp", np.eye(4), None, package_folders(PANDA))


def crooked(folder: Path, joints: tuple[str, ...] = CROOKED_JOINTS, base: F64 = TILTED) -> RigidBody:
    """Return the crooked arm on a tilted base; its side branch is locked."""
    path = folder / "crooked.urdf"
    path.write_text(CROOKED)
    return RigidBody.from_urdf(path, joints, "tip", base)


def states(body: RigidBody, count: int, seed: int = 0) -> list[tuple[F64, F64, F64]]:
    """Return random (q, qd, qdd) within the position limits."""
    rng = np.random.default_rng(seed)
    low, high = np.maximum(body.limits.q_min, -3.0), np.minimum(body.limits.q_max, 3.0)
    return [
        (rng.uniform(low, high), rng.uniform(-2.0, 2.0, body.n), rng.uniform(-10.0, 10.0, body.n)) for _ in range(count)
    ]


class Bullet:
    """The same URDF in pybullet, an independent implementation; joints that are not named are welded.

    Fixed links are not merged (URDF_MERGE_FIXED_LINKS computes wrong inertias) and shapes are left out.
    """

    def __init__(self, urdf: Path, joints: tuple[str, ...], base: F64, scratch: Path) -> None:
        tree = ET.parse(urdf)
        for link in tree.getroot().iter("link"):
            for kind in ("visual", "collision"):
                for element in link.findall(kind):
                    link.remove(element)
            if link.find("inertial") is None:  # Bullet would take one kilogram
                inertial = ET.SubElement(link, "inertial")
                ET.SubElement(inertial, "mass", value="0")
                ET.SubElement(inertial, "inertia", dict.fromkeys(("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), "0"))
        for joint in tree.getroot().iter("joint"):
            if joint.get("name") not in joints:
                joint.set("type", "fixed")
        file = scratch / "bare.urdf"
        tree.write(file)
        self.client = pybullet.connect(pybullet.DIRECT)
        # Its inverse dynamics takes gravity in the base's frame.
        pybullet.setGravity(*(base[:3, :3].T @ (0.0, 0.0, -9.81)), physicsClientId=self.client)
        self.body = pybullet.loadURDF(
            str(file), useFixedBase=True, flags=pybullet.URDF_USE_INERTIA_FROM_FILE, physicsClientId=self.client
        )
        # Bullet places a body by its centre of mass, not by the URDF's root
        mass_frame = pybullet.getDynamicsInfo(self.body, -1, physicsClientId=self.client)[3:5]
        local, turn = np.array(mass_frame[0]), Rotation.from_quat(mass_frame[1])
        rotation = Rotation.from_matrix(base[:3, :3])
        pybullet.resetBasePositionAndOrientation(
            self.body,
            base[:3, 3] + rotation.apply(local),
            (rotation * turn).as_quat(),
            physicsClientId=self.client,
        )
        infos = [
            pybullet.getJointInfo(self.body, i, physicsClientId=self.client)
            for i in range(pybullet.getNumJoints(self.body, physicsClientId=self.client))
        ]
        moving = [info[1].decode() for info in infos if info[2] != pybullet.JOINT_FIXED]
        self.order = [moving.index(name) for name in joints]  # of ours in Bullet's
        self.links = {info[12].decode(): info[0] for info in infos}
        self.index = {info[1].decode(): info[0] for info in infos}
        self.joints = joints

    def torques(self, q: F64, qd: F64, qdd: F64) -> F64:
        """Return the inverse dynamics."""
        scattered = [self._scatter(v) for v in (q, qd, qdd)]
        tau = pybullet.calculateInverseDynamics(self.body, *scattered, physicsClientId=self.client)
        return np.array(tau)[self.order]

    def mass_matrix(self, q: F64) -> F64:
        """Return A(q)."""
        A = np.array(pybullet.calculateMassMatrix(self.body, self._scatter(q), physicsClientId=self.client))
        return A[np.ix_(self.order, self.order)]

    def link_pose(self, link: str, q: F64) -> tuple[F64, F64]:
        """Return position and rotation matrix of a link's frame in the world."""
        for name, value in zip(self.joints, q, strict=True):
            pybullet.resetJointState(self.body, self.index[name], value, physicsClientId=self.client)
        state = pybullet.getLinkState(
            self.body, self.links[link], computeForwardKinematics=True, physicsClientId=self.client
        )
        return np.array(state[4]), np.array(pybullet.getMatrixFromQuaternion(state[5])).reshape(3, 3)

    def close(self) -> None:
        """Leave the physics server."""
        pybullet.disconnect(self.client)

    def _scatter(self, v: F64) -> list[float]:
        out = np.zeros(len(self.order))
        out[self.order] = v
        return [float(x) for x in out]

"""The parameter-evaluation level: rigid-body dynamics and kinematics of one arm from its URDF (Pinocchio).

`RigidBody.evaluate` runs at the model rate. It takes Pinocchio's results through views of its memory held from the
start.
"""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from rtctl.arm.model import Model, Skeleton, Terms, assemble, place_points, placements_in
from rtctl.arm.points import Points
from rtctl.arm.self_collision import Own
from rtctl.errors import ConfigError
from rtctl.types import B1, F64, I64


class Load(NamedTuple):
    """What is fixed to the tip's link beside what the URDF says, in the tip's frame."""

    mass: float  # [kg]
    com: F64  # (3,) [m]
    inertia: F64  # (3, 3) [kg m2] about the centre


UNLOADED = (0.0, 0.0, 0.0, 0.0)  # a payload: mass [kg] and centre [m] in the tip's frame
NOTHING = Load(0.0, np.zeros(3), np.zeros((3, 3)))


class JointLimits(NamedTuple):
    """Limits that the URDF states, in the order of the joint names."""

    q_min: F64  # (n,) [rad or m]; -inf for a continuous joint
    q_max: F64  # (n,)
    qd_max: F64  # (n,) [rad/s or m/s]
    tau_max: F64  # (n,) [Nm or N]


class RigidBody:
    """One arm: Pinocchio's model reduced to the configured joints, its scratch data and views into it.

    Links are numbered 0 = base and everything fixed to it, i = whatever joint i-1 of `names` carries.
    """

    def __init__(self, model: pin.Model, geometry: pin.GeometryModel, names: Sequence[str], tip_frame: str) -> None:
        self.model, self.geometry, self.names = model, geometry, tuple(names)
        self.data: pin.Data = model.createData()
        joints = [model.getJointId(name) for name in self.names]
        n = len(joints)
        self._iq: I64 = np.array([model.idx_qs[j] for j in joints], dtype=np.int64)
        self._iv: I64 = np.array([model.idx_vs[j] for j in joints], dtype=np.int64)
        self._circular: I64 = np.array([k for k in range(n) if model.nqs[joints[k]] == 2], dtype=np.int64)
        self._direct = bool(model.nq == n and (self._iq == np.arange(n)).all())
        # parent[link], link numbering; every other joint was locked, so a parent is the base or a configured joint
        link_of = {0: 0} | {joint: k + 1 for k, joint in enumerate(joints)}
        self.parent: I64 = np.array([0] + [link_of[model.parents[j]] for j in joints], dtype=np.int64)
        self.link_of = link_of  # Pinocchio's joint id -> link
        chain: B1 = np.zeros((n + 1, n), dtype=np.bool_)
        for k in range(1, n + 1):
            ancestor = k
            while ancestor:
                chain[k, ancestor - 1] = True
                ancestor = int(self.parent[ancestor])
        frame = model.frames[model.getFrameId(tip_frame)]
        self.skeleton = Skeleton(
            iv=self._iv,
            joint=np.array([0, *joints], dtype=np.int64),
            chain=chain,
            tip=link_of[frame.parentJoint],
            tip_R=np.ascontiguousarray(frame.placement.rotation),
            tip_t=np.ascontiguousarray(frame.placement.translation),
        )
        self._tip_joint, self._tip_pose = int(frame.parentJoint), pin.SE3(frame.placement)
        self._bare = pin.Inertia(model.inertias[self._tip_joint])  # of the tip's link
        self._payload = (0.0, 0.0, 0.0, 0.0)
        data = self.data
        self._terms = Terms(data.M, data.nle, data.g, data.J, data.dJ, *_held(data.oMi))

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.names)

    @property
    def links(self) -> tuple[str, ...]:
        """Names of the links: what each joint carries, by the first body that the URDF fixes to it."""
        bodies: dict[int, str] = {}
        for frame in self.model.frames:
            if frame.type == pin.FrameType.BODY:
                bodies.setdefault(int(frame.parentJoint), frame.name)
        return tuple(bodies.get(int(j), "base") for j in self.skeleton.joint)

    @property
    def limits(self) -> JointLimits:
        """Joint limits from the URDF; a continuous joint has none."""
        model = self.model
        q_min, q_max = np.array(model.lowerPositionLimit)[self._iq], np.array(model.upperPositionLimit)[self._iq]
        q_min[self._circular], q_max[self._circular] = -np.inf, np.inf
        return JointLimits(q_min, q_max, np.array(model.velocityLimit)[self._iv], np.array(model.effortLimit)[self._iv])

    @classmethod
    def from_urdf(
        cls,
        urdf: str | Path,
        joint_names: Sequence[str],
        tip_frame: str,
        base_pose: F64,
        armature: F64 | None = None,
        package_dirs: Sequence[str | Path] = (),
        tool: Load = NOTHING,
    ) -> "RigidBody":
        """Read an arm from a URDF; joints that are not named are locked at zero.

        joint_names: order of every (n,) array. base_pose: (4, 4) X_WB, pose of the URDF's root in the world.
        armature: (n,) [kg m2] reflected rotor inertia added to A's diagonal, None is zero. package_dirs: what
        package:// in mesh names resolves against. tool: on the tip's link beside the URDF. Raises ConfigError.
        """
        place = str(urdf)
        if not Path(urdf).is_file():
            raise ConfigError(place, "no such file", "a URDF")
        try:
            full = pin.buildModelFromUrdf(place)
            geometry = pin.buildGeomFromUrdf(
                full, place, pin.GeometryType.COLLISION, package_dirs=[str(d) for d in package_dirs]
            )
        except (ValueError, RuntimeError) as fault:
            raise ConfigError(place, str(fault).splitlines()[0], "a URDF whose collision meshes can be found") from None
        _check_names(place, full, joint_names, tip_frame)
        locked = [j for j in range(1, full.njoints) if full.names[j] not in joint_names]
        model, geometry = pin.buildReducedModel(full, geometry, locked, pin.neutral(full))
        _move_base(model, geometry, base_pose)
        if tool.mass > 0.0:
            frame = model.frames[model.getFrameId(tip_frame)]
            model.inertias[frame.parentJoint] += frame.placement.act(pin.Inertia(tool.mass, tool.com, tool.inertia))
        body = cls(model, geometry, joint_names, tip_frame)
        if armature is not None:
            inertia = np.zeros(model.nv)
            inertia[body._iv] = armature
            model.armature = inertia
        _check_inertia(place, body)
        return body

    def configuration(self, q: F64) -> F64:
        """Return Pinocchio's configuration vector; a continuous joint is a point on the unit circle there."""
        if self._direct:
            return q
        full: F64 = np.zeros(self.model.nq)
        full[self._iq] = q
        for k in self._circular:
            full[self._iq[k]], full[self._iq[k] + 1] = np.cos(q[k]), np.sin(q[k])
        return full

    def _velocity(self, qd: F64) -> F64:
        full: F64 = np.zeros(self.model.nv)
        full[self._iv] = qd
        return full

    def carry(self, payload: Sequence[float]) -> None:
        """Let the tip's link carry a payload: mass [kg] and its centre x, y, z [m] in the tip's frame, a point."""
        wanted = (float(payload[0]), float(payload[1]), float(payload[2]), float(payload[3]))
        if wanted == self._payload:
            return
        self._payload = wanted
        point = pin.Inertia(wanted[0], np.array(wanted[1:]), np.zeros((3, 3)))
        self.model.inertias[self._tip_joint] = (
            self._bare + self._tip_pose.act(point) if wanted[0] > 0.0 else pin.Inertia(self._bare)
        )

    def evaluate(
        self, q: F64, qd: F64, points: Points, own: Own | None = None, payload: Sequence[float] = UNLOADED
    ) -> Model:
        """Return every term of the law at one state: A(q) qdd + h(q, qd) + g(q) = tau, and J, Jdqd, PSPs.

        q, qd: (n,) [rad, rad/s]; payload: as of `carry`. The result shares no memory with this object.
        """
        self.carry(payload)
        pin.computeAllTerms(self.model, self.data, self.configuration(q), self._velocity(qd))
        found = assemble(self._terms, self.skeleton, qd, points.link, points.local)
        terms, (Rj, tj) = found[:12], found[12:]
        rho, rows = np.zeros(0), np.zeros((0, self.n))
        if own:
            rho, rows = own.measure(Rj, tj, self._terms.J, self.skeleton.iv, self.skeleton.chain)
        return Model(q.copy(), qd.copy(), *terms, rho, rows)

    def placements(self, q: F64) -> tuple[F64, F64]:
        """Return the links' placements (n + 1, 3, 3), (n + 1, 3) [m] at q (n,)."""
        pin.forwardKinematics(self.model, self.data, self.configuration(q))
        return placements_in(self._terms.R, self._terms.t, self.skeleton.joint)

    def placed(self, q: F64, points: Points) -> F64:
        """Return the PSPs (m, 3) [m] at q (n,), and nothing else: a planner asks thousands of times."""
        P = np.empty((len(points.link), 3))
        place_points(*self.placements(q), points.link, points.local, P)
        return P

    def own_distances(self, q: F64, own: Own) -> F64:
        """Return the distances (L,) [m] of the watched pairs at q (n,), inf beyond `own.reach`."""
        return own.distances(*self.placements(q))


def _held(placements: Iterable[pin.SE3]) -> tuple[F64, F64]:
    """Return views of all rotations (joints, 3, 3) and translations (joints, 3) [m] of a vector of Pinocchio's SE3.

    They follow each other in memory at equal steps, so that one view each serves instead of two a joint.
    """
    views = [(X.rotation, X.translation) for X in placements]
    at = np.array([[view.__array_interface__["data"][0] for view in pair] for pair in views], dtype=np.int64)
    step = int(at[1, 0] - at[0, 0])
    if (np.diff(at, axis=0) != step).any():
        raise RuntimeError("Pinocchio's placements are not one array")
    R, t = views[0]
    return (
        np.lib.stride_tricks.as_strided(R, (len(views), 3, 3), (step, *R.strides)),
        np.lib.stride_tricks.as_strided(t, (len(views), 3), (step, *t.strides)),
    )


def _check_names(place: str, model: pin.Model, joint_names: Sequence[str], tip_frame: str) -> None:
    """Refuse joints and frames the URDF does not have, and joints of more than one degree of freedom."""
    movable = [name for name, nv in zip(model.names, model.nvs, strict=True) if nv == 1]
    for k, name in enumerate(joint_names):
        if name not in movable:
            raise ConfigError(f"{place}: joint", name, f"one of {', '.join(movable)}")
        if name in joint_names[:k]:
            raise ConfigError(f"{place}: joint", f"{name} twice", "each joint once")
    if not joint_names:
        raise ConfigError(f"{place}: joints", "none", f"some of {', '.join(movable)}")
    frames = [frame.name for frame in model.frames]
    if tip_frame not in frames:
        raise ConfigError(f"{place}: tip_frame", tip_frame, f"one of {', '.join(frames)}")


def _move_base(model: pin.Model, geometry: pin.GeometryModel, base_pose: F64) -> None:
    """Put the root at X_WB: whatever hangs on the universe moves, gravity stays along the world's -z."""
    X = pin.SE3(np.asarray(base_pose, dtype=np.float64))
    for j in range(1, model.njoints):
        if model.parents[j] == 0:
            model.jointPlacements[j] = X * model.jointPlacements[j]
    for frame in model.frames:
        if frame.parentJoint == 0 and frame.name != "universe":
            frame.placement = X * frame.placement
    for thing in geometry.geometryObjects:
        if thing.parentJoint == 0:
            thing.placement = X * thing.placement


def _check_inertia(place: str, body: RigidBody) -> None:
    """Refuse a URDF whose mass matrix is singular: a massless last link makes every torque infinite."""
    A = np.array(pin.crba(body.model, body.data, pin.neutral(body.model)))
    eigenvalues = np.linalg.eigvalsh(np.triu(A) + np.triu(A, 1).T)
    if not np.isfinite(A).all() or eigenvalues[0] <= 1e-9 * eigenvalues[-1]:
        raise ConfigError(f"{place}: inertia", f"mass matrix eigenvalues from {eigenvalues[0]:.2g}", "positive")

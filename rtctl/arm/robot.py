"""The robot as the tick sees it: constants alone, SI, derived from one config file by `config.build`."""

from typing import NamedTuple

import numpy as np

from rtctl.arm.estimator import Design, EstimatorParams, JointParams
from rtctl.arm.faults import SafetyParams
from rtctl.arm.field import Field, FieldParams, LimitParams
from rtctl.arm.gripper import Gripper
from rtctl.arm.osc import MotionParams
from rtctl.arm.points import Coverage, Points
from rtctl.arm.rigid_body import RigidBody
from rtctl.arm.self_collision import Own
from rtctl.types import F64, I64, Record, Shape, Task
from rtctl.world.meshes import NONE, Meshes

JOINTS_MAX = 15  # of any arm: motor ids have four bits
SLOTS = 64  # obstacle slots: the size of every array over obstacles


class StopParams(NamedTuple):
    """How the arm is brought to rest when it must stop."""

    damping: F64  # (n,) [Nms/rad] D of the damped stop -(D + decay A) qd + g: A_ii(home) times the rate of decay
    decay: float  # [1/s] with which a stopping joint loses its speed
    kp: F64  # (n,) [Nm/rad] of the drives' own loops, where they hold the arm
    kd: F64  # (n,) [Nms/rad]
    time: float  # [s] a damped stop cuts torque after this at the latest
    frames: int  # disable frames sent at start and at the end
    stall: float  # [s] at rest short of the goal before it is diagnosed


class Arm(NamedTuple):
    """The robot as the servo level takes it, in few flat arrays; see `law.prepared`."""

    constants: Record
    radius: F64  # (m,) [m] of the PSPs
    link: I64  # (m,)
    reals: F64  # the memory of `Robot.scratch`; see `flat.field_in`
    wholes: I64


class Robot(NamedTuple):
    """Everything `tick` may know of the arm that does not change."""

    name: str
    n: int
    joints: tuple[str, ...]
    links: tuple[str, ...]  # (n + 1) 0 the base, i what joint i-1 carries
    slots: int  # obstacle slots K
    dt: float  # [s] servo period
    model_dt: float  # [s] period of the parameter evaluation, >= dt
    q_min: F64  # (n,) [rad]
    q_max: F64  # (n,) [rad]
    qd_max: F64  # (n,) [rad/s]
    tau_max: F64  # (n,) [Nm] that may be sent: torque_ratio of the rating
    tau_rated: F64  # (n,) [Nm] rating of the joint
    tau_rate: F64  # (n,) [Nm/s]
    tau_lsb: F64  # (n,) [Nm] rounding of the torque a drive echoes
    grippers: tuple[Gripper, ...]  # on its bus
    payload_max: float  # [kg] at the tip, that is carried untold
    friction_max: F64  # (n,) [Nm] the same of friction, and of what the drives are wrong by
    noticeable: F64  # (n,) [Nm] more than this of an external torque is more than rounding
    viscous: F64  # (n,) [Nms/rad] friction of the joints, all of it: what predictions count with
    viscous_told: F64  # (n,) [Nms/rad] of it what is given beforehand; the rest damps
    coulomb: F64  # (n,) [Nm] friction that is given beforehand
    collision: F64  # (n,) [Nm] a fast external torque beyond it, and what may explain it, is a contact
    collision_hard: F64  # (n,) [Nm] the same of one after which the arm is not driven any more
    braking: F64  # (n,) [rad/s2] with which a joint is brought to rest before its limit
    home: F64  # (n,) [rad]
    q_rest: F64  # (n,) [rad] of the posture task
    base: F64  # (3,) [m] base in the world
    reach: float  # [m] no point of the tip can be further from the base
    body: RigidBody  # evaluates the model; keeps scratch memory, no state
    points: Points
    coverage: Coverage
    own: Own  # hulls and pairs of links that can meet; no pairs when self-collision is off
    obstacles: tuple[Shape, ...]  # of the config, always there
    motion: MotionParams
    avoid: FieldParams
    postures: bool  # a posture of the goal's own is looked for
    plans: bool  # a planner may lead the arm where the law does not get on
    escape: bool  # circulate around what holds the arm short of its goal
    self_avoid: FieldParams
    limit: LimitParams
    estimator: EstimatorParams  # noise of the tip filter
    tip_design: Design  # its steady state
    joint_filter: JointParams  # noise of the joint filters
    joint_P: F64  # (n, 2, 2) their steady covariance
    safety: SafetyParams
    stop: StopParams
    scratch: Field  # work arrays of the field, overwritten every tick
    tolerance: float  # [m] of a goal that gives none
    tolerance_rot: float  # [rad]
    park: F64 | None = None  # (n,) [rad] where it rests without torque
    park_on_exit: bool = False  # SIGTERM parks it
    urdf: str = ""  # its file
    brakeless: bool = False  # some joint has no brake: without torque the arm falls
    axes: Task = Task.POSE  # of the tip that the arm can move
    meshes: Meshes = NONE  # that obstacles may refer to
    carry: bool = True  # tip and points are estimated between evaluations; else held still
    arm: Arm = Arm(np.zeros(0), np.zeros(0), np.zeros(0, np.int64), np.zeros(0), np.zeros(0, np.int64))
    constants: Record = np.zeros(0)  # what the law needs of the above in one record; see `law.prepared`

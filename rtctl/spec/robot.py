"""The robot file: frozen structs that say what every key may hold.

Every number has both bounds here, every text and list a largest length; keys carry units. Conversion to SI without
suffix happens in `build` alone. A default never switches a protection off.
"""

from typing import Annotated, Literal

from msgspec import Meta, Struct

from rtctl.spec.obstacles import Length, Name, Obstacle, Orientation, Place, RollPitchYaw

Text = Annotated[str, Meta(min_length=1, max_length=255)]
Key = Annotated[str, Meta(min_length=1, max_length=64)]  # a name inside the URDF
Angle = Annotated[float, Meta(ge=-100.0, le=100.0)]
Angles = Annotated[tuple[Angle, ...], Meta(min_length=1, max_length=15)]
Moment = Annotated[float, Meta(ge=-100.0, le=100.0)]
Rate = Annotated[float, Meta(ge=10.0, le=4000.0)]
Axis = Literal["x", "y", "z", "rx", "ry", "rz"]
Milliseconds = Annotated[float, Meta(ge=0.1, le=1000.0)]


class Table(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A TOML table: unknown keys are refused."""


class FrictionTable(Table, frozen=True, kw_only=True):
    """Friction of a joint that the law gives beforehand."""

    coulomb_Nm: Annotated[float, Meta(ge=0.0, le=1000.0, description="of a joint that slides, whatever its speed")] = (
        0.0
    )
    viscous_Nms_rad: Annotated[float, Meta(ge=0.0, le=1000.0, description="beside friction_Nms_rad, which damps")] = 0.0


class Joint(Table, frozen=True, kw_only=True):
    """One joint, in the order of the chain from the base to the tip."""

    name: Annotated[Key, Meta(description="joint of the URDF")]
    can_id: Annotated[int, Meta(ge=1, le=0x7F, description="motor id")]
    q_min_rad: Angle
    q_max_rad: Angle
    qd_max_rad_s: Annotated[float, Meta(ge=0.01, le=100.0)]
    tau_max_Nm: Annotated[float, Meta(ge=0.01, le=2000.0)]
    tau_rate_Nm_s: Annotated[float, Meta(ge=1.0, le=1e6, description="largest change of torque")]
    drive: Annotated[Name, Meta(description="a drive of the catalogue or of [drives]: its scales on the wire")]
    armature_kg_m2: Annotated[float, Meta(ge=0.0, le=100.0, description="motor inertia seen at the joint, J G^2")] = 0.0
    friction_Nms_rad: Annotated[float, Meta(ge=0.0, le=1000.0, description="viscous, seen at the joint, B G^2")] = 0.0
    friction: Annotated[FrictionTable, Meta(description="given beforehand")] = FrictionTable()
    reply_id: Annotated[int, Meta(ge=1, le=0x7FE, description="of its replies; default: can_id + 0x10")] | None = None
    brake: Annotated[bool, Meta(description="has a holding brake; default: as its drive's type")] | None = None
    direction: Annotated[Literal[1, -1], Meta(description="-1: the drive counts the other way round")] = 1
    zero_rad: Annotated[Angle, Meta(description="the drive reads direction q + zero_rad")] = 0.0
    wrap: Annotated[
        bool, Meta(description="the encoder may come back whole turns off: the one within the limits is taken")
    ] = False


class GripperTable(Table, frozen=True, kw_only=True):
    """A gripper whose drive is on the arm's bus; `rtctl grip 0..1 [--force N]` moves it."""

    name: Name = "gripper"
    can_id: Annotated[int, Meta(ge=1, le=0x7F, description="motor id")]
    reply_id: Annotated[int, Meta(ge=1, le=0x7FE, description="of its replies; default: can_id + 0x10")] | None = None
    drive: Annotated[Name, Meta(description="a drive of the catalogue or of [drives]: its scales on the wire")]
    open_rad: Annotated[Angle, Meta(description="what the drive reads where it is open")]
    closed_rad: Annotated[Angle, Meta(description="and where it is closed")]
    travel_m: Annotated[float, Meta(ge=1e-3, le=1.0, description="opening of the jaws, from closed to open")]
    force_max_N: Annotated[float, Meta(ge=0.1, le=2000.0, description="between the jaws")]
    speed_m_s: Annotated[float, Meta(ge=1e-3, le=2.0, description="of the opening")] = 0.1
    kp_Nm_rad: Annotated[float, Meta(ge=0.1, le=500.0, description="of its drive's loop")] = 10.0
    kd_Nms_rad: Annotated[float, Meta(ge=0.01, le=5.0)] = 1.0


class BasePose(Table, frozen=True, kw_only=True):
    """Where the arm's base stands in the world."""

    position_m: Place = (0.0, 0.0, 0.0)
    rpy_rad: RollPitchYaw | None = None
    wxyz: Orientation | None = None


class ToolTable(Table, frozen=True, kw_only=True):
    """What is fixed to the tip's link and is not in the URDF, in the frame `robot.tip_frame`."""

    mass_kg: Annotated[float, Meta(ge=0.0, le=200.0)]
    com_m: Annotated[tuple[Length, Length, Length], Meta(description="centre of mass, in the tip's frame")] = (
        0.0,
        0.0,
        0.0,
    )
    inertia_kg_m2: (
        Annotated[
            tuple[Moment, Moment, Moment, Moment, Moment, Moment],
            Meta(description="xx, xy, xz, yy, yz, zz about the centre, along the tip's axes; nothing: a point"),
        ]
        | None
    ) = None


class RobotTable(Table, frozen=True, kw_only=True):
    """The arm."""

    name: Name
    kind: Literal["arm", "base"]
    urdf: Annotated[Text, Meta(description="path relative to this file, or package://example-robot-data/robots/…")]
    tip_frame: Annotated[Key, Meta(description="frame of the URDF that the goals are for")]
    home_rad: Annotated[Angles, Meta(description="rest posture: default start and null-space attractor")]
    joints: Annotated[tuple[Joint, ...], Meta(min_length=1, max_length=15)]
    park_rad: Annotated[Angles, Meta(description="where the arm rests without torque, for park")] | None = None
    park_on_exit: Annotated[bool, Meta(description="SIGTERM parks an arm; else one without brakes is lowered")] = False
    base_pose: BasePose = BasePose()
    payload_max_kg: Annotated[
        float, Meta(ge=0.0, le=200.0, description="largest payload at the tip, carried without being told")
    ] = 0.0


class Loop(Table, frozen=True, kw_only=True):
    """Rates and scheduling of the servo process."""

    servo_hz: Rate
    model_hz: Annotated[Rate, Meta(description="rate of the parameter evaluation, at most servo_hz")]
    realtime: Annotated[
        Literal["required", "best-effort"], Meta(description="required: refuse to start without real-time rights")
    ] = "required"
    cpu: Annotated[int, Meta(ge=0, le=1023)] | None = None  # None: the scheduler chooses
    priority: Annotated[int, Meta(ge=1, le=98, description="SCHED_FIFO priority")] = 80


class LinkTable(Table, frozen=True, kw_only=True):
    """The bus."""

    type: Literal["can", "mavlink"]
    interface: Annotated[Name, Meta(description="socketcan, socketpair, or an interface of python-can")]
    channel: Text
    bitrate: Annotated[int, Meta(ge=10_000, le=1_000_000)]
    fd: bool
    protocol: Literal["mit", "mit+e2e", "cia402"]
    data_bitrate: (
        Annotated[int, Meta(ge=100_000, le=8_000_000, description="of the data phase; needed for fd")] | None
    ) = None
    listen_ms: Annotated[
        float, Meta(ge=50.0, le=10_000.0, description="listen for a second master before the start")
    ] = 500.0
    handshake_s: Annotated[float, Meta(ge=0.1, le=60.0, description="drives must have answered within")] = 5.0


class Posture(Table, frozen=True, kw_only=True):
    """The null-space task of a redundant arm: k_q (q_rest - q) - d_q qd."""

    q_rest_rad: Angles | None = None  # None: robot.home_rad
    stiffness: Annotated[float, Meta(ge=0.0, le=1000.0, description="k_q [1/s2]")] = 10.0
    damping: Annotated[float, Meta(ge=0.1, le=200.0, description="d_q [1/s]; never 0")] = 6.0
    speed_ratio: Annotated[float, Meta(ge=0.01, le=0.9, description="of qd_max, at which it may drift home")] = 0.25


class Motion(Table, frozen=True, kw_only=True):
    """The motion task at the tip."""

    v_max_m_s: Annotated[float, Meta(ge=0.001, le=5.0)]
    a_max_m_s2: Annotated[float, Meta(ge=0.01, le=100.0)]
    w_max_rad_s: Annotated[float, Meta(ge=0.01, le=20.0)]
    stiffness: Annotated[float, Meta(ge=1.0, le=5000.0, description="k_p of a unit mass [1/s2]")]
    damping_ratio: Annotated[float, Meta(ge=0.3, le=5.0, description="k_v = 2 zeta sqrt(k_p)")]
    alpha_max_rad_s2: Annotated[float, Meta(ge=0.1, le=500.0)] = 15.0
    tolerance_m: Annotated[float, Meta(ge=1e-4, le=0.1, description="arrived, unless a goal says otherwise")] = 0.003
    tolerance_rad: Annotated[float, Meta(ge=1e-3, le=0.5)] = 0.015
    joint_speed_ratio: Annotated[float, Meta(ge=0.1, le=0.95, description="of qd_max that the motion may ask for")] = (
        0.8
    )
    singular_1_kg: Annotated[float, Meta(ge=1e-4, le=10.0, description="eigenvalue of J A^-1 J^T damped below")] = 0.02
    length_m: Annotated[float, Meta(ge=0.01, le=2.0, description="makes angular rows comparable to linear ones")] = 0.2
    axes: Annotated[
        tuple[Axis, ...],
        Meta(min_length=1, max_length=6, description="world axes along (x) and about (rx) which the tip can move"),
    ] = ("x", "y", "z", "rx", "ry", "rz")
    posture: Posture = Posture()


class Point(Table, frozen=True, kw_only=True):
    """A point subjected to the potential, fixed in a link's frame."""

    link: Key
    position_m: Annotated[tuple[Length, Length, Length], Meta(description="in the frame of the link's joint")]
    radius_m: Annotated[float, Meta(ge=0.0, le=0.5)]


class Avoid(Table, frozen=True, kw_only=True):
    """Repulsion from obstacles, from the arm itself and from joint limits."""

    influence_m: Annotated[float, Meta(ge=0.005, le=1.0, description="rho0: the field begins here")]
    clearance_m: Annotated[float, Meta(ge=0.001, le=0.5, description="rho_min: v_max is spent here")]
    damping_ratio: Annotated[float, Meta(ge=0.05, le=5.0, description="of the one-sided damping while closing")]
    points: Literal["auto"] | Annotated[tuple[Point, ...], Meta(min_length=1, max_length=256)] = "auto"
    overhang_m: Annotated[
        float, Meta(ge=0.01, le=0.05, description="that auto points may stand out of links; less gives more of them")
    ] = 0.025
    lookahead_s: Annotated[float, Meta(ge=0.0, le=1.0, description="closing speed widens the influence by this")] = 0.1
    escape: Annotated[bool, Meta(description="circulate around an obstacle that holds the arm short of its goal")] = (
        True
    )
    posture: Annotated[
        Literal["auto", "never"],
        Meta(description="auto: a goal is pursued in a posture of its own; never: in that of rest"),
    ] = "auto"
    plan: Annotated[
        Literal["auto", "never"], Meta(description="auto: a planner leads the arm where the law alone does not get on")
    ] = "auto"
    superposition: Annotated[
        Literal["blend", "sum"],
        Meta(description="of a link's points: weighted by their part in its repulsion, or added as in the paper"),
    ] = "blend"
    inertia: Annotated[
        Literal["normal", "task"],
        Meta(description="of a point: its mass along the normal, or its whole kinetic energy matrix as in the paper"),
    ] = "normal"
    self_collision: bool = True
    self_influence_m: Annotated[float, Meta(ge=0.005, le=0.5)] = 0.02
    self_clearance_m: Annotated[float, Meta(ge=0.001, le=0.2)] = 0.008
    joint_influence_rad: Annotated[float, Meta(ge=0.01, le=1.0, description="zone of the joint-limit potential")] = 0.2
    joint_clearance_rad: Annotated[float, Meta(ge=0.002, le=0.5)] = 0.03
    joint_braking_s: Annotated[float, Meta(ge=0.02, le=2.0, description="from qd_max to rest, before a limit")] = 0.2
    obstacle_speed_m_s: Annotated[
        float, Meta(ge=0.0, le=5.0, description="speed of obstacles beside the one told; times age it widens them")
    ] = 0.1
    joint_speed_rad_s: Annotated[float, Meta(ge=0.05, le=50.0, description="spent at the joint clearance")] = 1.5
    obstacles_max: Annotated[
        int, Meta(ge=1, le=256, description="known at once; each costs time in a tick and room in the log")
    ] = 64


class Estimator(Table, frozen=True, kw_only=True):
    """Standard deviations of noise, and the bound beyond which an innovation is a fault.

    Measurement noise is that of the drives' quantisation, LSB/sqrt(12), and what is added here.
    """

    acceleration_m_s2: Annotated[float, Meta(ge=1e-3, le=1000.0, description="of the tip, not commanded")] = 5.0
    acceleration_rad_s2: Annotated[float, Meta(ge=1e-3, le=5000.0, description="of the tip, not commanded")] = 20.0
    joint_acceleration_rad_s2: Annotated[float, Meta(ge=1e-2, le=1e4, description="not commanded")] = 20.0
    position_noise_rad: Annotated[float, Meta(ge=0.0, le=0.1, description="of an encoder, beside its step")] = 0.0
    velocity_noise_rad_s: Annotated[float, Meta(ge=0.0, le=5.0, description="of a drive, beside its step")] = 0.0
    joint_velocity: Annotated[bool, Meta(description="the drives report a velocity worth using")] = True
    innovation_sigma: Annotated[float, Meta(ge=3.0, le=50.0)] = 8.0
    carry: Annotated[
        bool, Meta(description="tip and points between evaluations; false holds them still, to compare")
    ] = True


class Safety(Table, frozen=True, kw_only=True):
    """Time-outs, bounds and what they lead to."""

    watchdog_ms: Annotated[float, Meta(ge=1.0, le=100.0, description="the drive's own: torque off without a command")]
    stale_hold_ms: Annotated[Milliseconds, Meta(description="feedback older than this: brake and hold")]
    stale_stop_ms: Annotated[Milliseconds, Meta(description="feedback older than this: latched stop")]
    torque_ratio: Annotated[float, Meta(ge=0.1, le=1.0, description="of tau_max that may be sent")] = 0.95
    torque_error_ratio: Annotated[float, Meta(ge=0.002, le=0.5, description="of tau_max, sent against echoed")] = 0.05
    friction_ratio: Annotated[
        float, Meta(ge=0.0, le=0.5, description="of tau_max: friction that is compensated without being told")
    ] = 0.05
    collision_ratio: Annotated[
        float, Meta(ge=0.002, le=1.0, description="of tau_max: an external torque that comes faster is a contact")
    ] = 0.1
    collision_hard_ratio: Annotated[
        float, Meta(ge=0.01, le=2.0, description="the same, after which the arm is driven no more")
    ] = 0.4
    speed_ratio: Annotated[float, Meta(ge=1.0, le=1.5, description="of qd_max, beyond it a fault")] = 1.2
    limit_excess_rad: Annotated[float, Meta(ge=0.0, le=0.2, description="beyond a joint limit, then a fault")] = 0.02
    obstacle_stale_s: Annotated[
        float, Meta(ge=0.05, le=10.0, description="a moving obstacle unseen for this: hold")
    ] = 0.5
    stop_frames: Annotated[int, Meta(ge=3, le=1000, description="disable frames at start and end")] = 10
    stop_damping: Annotated[float, Meta(ge=0.5, le=100.0, description="rate of decay of a damped stop [1/s]")] = 10.0
    stop_s: Annotated[float, Meta(ge=0.1, le=5.0, description="a damped stop cuts torque after this at the latest")] = (
        1.0
    )
    stall_s: Annotated[float, Meta(ge=0.1, le=60.0, description="at rest short of the goal: diagnosed after this")] = (
        2.0
    )


class LogTable(Table, frozen=True, kw_only=True):
    """The MCAP recorder."""

    directory: Annotated[Text, Meta(description="relative to the working directory, created when absent")]
    segment_MB: Annotated[float, Meta(ge=1.0, le=65536.0)]
    segment_s: Annotated[float, Meta(ge=1.0, le=86400.0)]
    disk_floor_MB: Annotated[float, Meta(ge=1.0, le=1e7, description="free space below which arming is refused")]
    ring_MB: Annotated[float, Meta(ge=1.0, le=1024.0, description="shared memory between servo and recorder")] = 16.0


class ConsoleTable(Table, frozen=True, kw_only=True):
    """The control socket."""

    socket: Annotated[str, Meta(min_length=1, max_length=100)] | None = None  # None: derived from the robot's name


class DriveTable(Table, frozen=True, kw_only=True):
    """The scales of a drive's fields on the wire; checked against its registers 21-23 before it is enabled."""

    # 16 bits of 32 rad are steps of 1 mrad, the coarsest encoder that the bound on jumps expects; 12 bits of 120 rad/s
    # are steps of 0.06 rad/s, beyond which no reading is small enough for a joint at rest
    p_max_rad: Annotated[float, Meta(ge=0.1, le=32.0)]
    v_max_rad_s: Annotated[float, Meta(ge=0.1, le=120.0)]
    t_max_Nm: Annotated[float, Meta(ge=0.01, le=5000.0)]
    # as every drive of a file was taken to be before there was this key: their logs replay as they were
    brake: Annotated[bool, Meta(description="such drives come with a holding brake")] = True


class MeshTable(Table, frozen=True, kw_only=True):
    """A solid that obstacles may refer to by name, those told to the running daemon included."""

    name: Name
    file: Annotated[Text, Meta(description="STL or OBJ, relative to this file")]
    scale: Annotated[float, Meta(ge=1e-6, le=1e4, description="metres of a unit of the file")] = 1.0
    hull: Annotated[bool, Meta(description="take the convex hull: for a surface that is open or crosses itself")] = (
        False
    )


class Config(Table, frozen=True, kw_only=True):
    """One robot, one file."""

    robot: RobotTable
    loop: Loop
    link: LinkTable
    motion: Motion
    avoid: Avoid
    safety: Safety
    log: LogTable
    tool: ToolTable | None = None
    gripper: Annotated[tuple[GripperTable, ...], Meta(max_length=4)] = ()
    estimator: Estimator = Estimator()
    console: ConsoleTable = ConsoleTable()
    drives: Annotated[dict[Name, DriveTable], Meta(max_length=64)] = {}
    obstacle: Annotated[tuple[Obstacle, ...], Meta(max_length=256)] = ()
    mesh: Annotated[tuple[MeshTable, ...], Meta(max_length=32)] = ()

"""The nouns: plain values that every floor of the program shares. SI units, float64 arrays.

Shapes: n joints, m points subjected to the potential (PSPs), K obstacle slots.
"""

from collections.abc import Iterator, Sequence
from enum import STRICT, IntEnum, IntFlag
from typing import Any, NamedTuple, Protocol, TypeAlias, overload

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
I32 = NDArray[np.int32]
U64 = NDArray[np.uint64]
U32 = NDArray[np.uint32]
U8 = NDArray[np.uint8]
B1 = NDArray[np.bool_]


class State(IntEnum):
    """Supervisor states; the order is that of a session, not of severity."""

    BOOT = 0
    PREFLIGHT = 1
    IDLE = 2  # drives disabled, feedback watched
    ARMED = 3  # drives being enabled, torque = hold
    RUN = 4  # the law drives the arm
    STOPPING = 5  # braking to rest, then held, then disabled
    SAFE_STOP = 6  # SS1/SS2 latched: damped, an operator's reset leaves it
    FAULT = 7  # STO latched: torque off


class Verb(IntEnum):
    """What an operator can ask for; TERM is SIGTERM."""

    NONE = 0
    ARM = 1
    DISARM = 2
    STOP = 3
    RESET = 4
    RECOVER = 5
    TERM = 6
    DROP = 7  # disarm an arm that falls then
    PARK = 8  # move to where an arm rests without torque, then disarm
    FLOAT = 10  # let a hand move the arm
    HOLD = 11  # stay here, without a goal


class Status(IntEnum):
    """Level of competence: what the controller is doing about the goal, and what holds it."""

    NO_GOAL = 0
    MOVING = 1
    ARRIVED = 2
    SHADOWED = 3  # goal within some obstacle's influence
    LOCAL_MINIMUM = 4  # forces cancel, goal clear
    SATURATED = 5  # torque limits hold the arm
    SINGULAR = 6  # the direction to the goal is lost
    LIMITED = 7  # joint limits hold the arm
    UNREACHABLE = 8  # stretched out: the goal is farther than the links are long
    ESCAPING = 9  # circulating around what blocks the way
    BLIND = 10  # a base stands: where it would go has not been seen
    FLOATING = 11  # a hand moves the arm


class Severity(IntEnum):
    """Reactions, totally ordered: the worst wins."""

    NONE = 0
    LOG = 1
    REJECT = 2
    SS2 = 3  # brake along the path, hold under control
    SS1 = 4  # damp, torque off at rest
    STO = 5  # torque off now


class LimitFlag(IntFlag):
    """Which protection altered the wanted torque this tick."""

    NONE = 0
    NON_FINITE = 1
    MAGNITUDE = 2
    SLEW = 4
    MOTION_SCALED = 8  # motion gave way to obstacles and limits
    SINGULAR = 16  # spectral damping of Lambda active
    FIELD_CAP = 32  # repulsion capped below rho_num
    SPEED = 64  # joint speed limiter active


class Link(IntFlag):
    """What the link saw during the cycle."""

    NONE = 0
    OVERFLOW = 1  # receive queue overflowed
    SEND_FAILED = 2  # a command frame was dropped (ENOBUFS)
    BUS_OFF = 4
    ERROR_PASSIVE = 8
    DOWN = 16  # interface down or gone
    FOREIGN_COMMAND = 32  # somebody else sends our command ids
    CORRUPT = 64  # a frame failed its CRC, length or id check
    DUPLICATE = 128  # more than one reply of a joint in one cycle
    SEQUENCE = 256  # a reply's counter jumped: frames were lost or overtook each other
    DISORDER = 512  # counters keep jumping
    LOG_DEGRADED = 1024  # set by the daemon: the log cannot be written
    DERATED = 2048  # a drive says that it gives less torque than asked: hot, or at its own limit


class Drive(IntEnum):
    """What a command asks of every joint drive this cycle."""

    DISABLE = 0  # the stop frame: replies, never torque
    ENABLE = 1
    TORQUE = 2
    CLEAR = 3  # clear a latched drive fault
    HOLD = 4  # the drives' own loops, see `Hold`


class Task(IntFlag, boundary=STRICT):
    """What of the tip's motion a goal constrains, in world axes; the rest is the posture's."""

    X = 1
    Y = 2
    Z = 4
    RX = 8
    RY = 16
    RZ = 32
    DIRECTION = 64  # where an axis of the tool points; the roll about it is free
    POSITION = X | Y | Z
    ORIENTATION = RX | RY | RZ
    POSE = POSITION | ORIENTATION


GOAL_TIMEOUT = 0.25  # [s] of a goal that moves and says nothing else: of ten a second one may be lost
TOOL_Z = np.array([0.0, 0.0, 1.0])  # writable as every array: a read-only one is another type to compiled kernels


class Goal(NamedTuple):
    """A goal pose of the tip in the world frame."""

    position: F64  # (3,) [m]; what the task leaves out means nothing
    wxyz: F64  # (4,) unit quaternion; for Task.DIRECTION any that turns `axis` there
    task: Task
    tolerance: float  # [m] arrived within this and within tolerance_rot
    tolerance_rot: float  # [rad]
    axis: F64 = TOOL_Z  # (3,) unit vector in the tip's frame, for Task.DIRECTION
    posture: F64 | None = None  # (n,) [rad] that the null space takes on the way, None: the robot's own
    velocity: F64 | None = None  # (3,) [m/s] of a goal that moves
    omega: F64 | None = None  # (3,) [rad/s]
    timeout: float | None = None  # [s] for which it holds unless another comes; None: one that moves GOAL_TIMEOUT

    @property
    def streams(self) -> bool:
        """Return whether it is one of a stream."""
        return self.velocity is not None or self.omega is not None or self.timeout is not None


class Shape(NamedTuple):
    """An obstacle as it is described: a named, posed, possibly moving primitive, mesh or cloud of points."""

    name: str
    type: str  # sphere | capsule | segment | point | box | plane | ellipsoid | n_ellipsoid | mesh | cloud | ...
    dims: F64  # (4,) meaning by type, see control.primitives
    position: F64  # (3,) [m] of the primitive's frame in the world
    wxyz: F64  # (4,) orientation
    velocity: F64  # (3,) [m/s]
    omega: F64  # (3,) [rad/s]
    group: str = ""  # parts of one union: of them the nearest to a point acts on it; "" = adds to the others
    mesh: str = ""  # of a mesh: the name of its solid among the robot's
    cloud: bytes = b""  # of a cloud: x, y, z of each point in whole steps, little-endian int16
    influence: float = 0.0  # [m] of its own, 0: the config's
    clearance: float = 0.0  # [m] likewise


class ObstacleEdit(NamedTuple):
    """Set (shape given) or clear (shape None) one obstacle by name; `age` [s] of the observation."""

    name: str
    shape: Shape | None
    age: float = 0.0
    feed: bool = False  # somebody keeps observing it: the observation grows stale even of what rests


class Advice(NamedTuple):
    """What is found beside the servo about the goal that is pursued: a posture, and how it is meant."""

    posture: F64  # (n,) [rad]
    leads: bool = False  # the joints head for it, for a while; else the null space does, on the tip's way to the goal
    clear: bool = False  # the links in it are known to keep the clearance, even where their points do not


class Payload(NamedTuple):
    """What the tip carries, a point in its frame."""

    mass: float  # [kg], 0 nothing
    x: float = 0.0  # [m] of its centre
    y: float = 0.0
    z: float = 0.0


class Grip(NamedTuple):
    """What a gripper shall do."""

    closed: float  # 0 open, 1 closed
    force: float = 0.0  # [N] at most, 0: the gripper's own bound
    name: str = ""  # of the gripper, '' every one


class Request(NamedTuple):
    """Everything that reaches the tick from operators and sensors in one slot."""

    verb: Verb = Verb.NONE
    goal: Goal | None = None
    obstacles: tuple[ObstacleEdit, ...] = ()
    payload: Payload | None = None
    advice: Advice | None = None
    grip: Grip | None = None
    drive: tuple[float, ...] | None = None  # (n,) [Nm] of another law, in place of what drives the arm in this tick


NO_GRIPPERS = np.zeros((5, 0))


class Feedback(NamedTuple):
    """What the link knows of the robot at one slot; the last good value where nothing came."""

    slot: int  # index on the absolute grid
    missed: int  # slots skipped since the previous tick
    q: F64  # (n,) [rad]
    qd: F64  # (n,) [rad/s]
    tau: F64  # (n,) [Nm] torque the drive echoes
    age: F64  # (n,) [s] of the newest reply at this slot
    replies: I64  # (n,) replies of this cycle; exactly 1 is healthy
    drive: I64  # (n,) drive status code (protocol.mit), -1 = never heard
    link: int  # Link flags of the cycle
    lateness: float  # [s] of the previous wake-up; logged, never used by the law
    compute: float  # [s] of the previous tick; logged, never used by the law
    grippers: F64 = NO_GRIPPERS  # (5, g) q [rad], qd [rad/s], tau [Nm], age [s], drive status code of each


class Hold(NamedTuple):
    """What the drives do by themselves, on their own encoders: tau_i = kp (p - q) + kd (v - qd) + the command's."""

    p: F64  # (n,) [rad]
    v: F64  # (n,) [rad/s]
    kp: F64  # (n,) [Nm/rad]
    kd: F64  # (n,) [Nms/rad]
    off: B1  # (n,) joints that cannot be held: their drives are disabled


class Command(NamedTuple):
    """What goes to the drives."""

    drive: Drive
    tau: F64  # (n,) [Nm]
    hold: Hold | None = None  # of Drive.HOLD
    grippers: F64 = NO_GRIPPERS  # (5, g) p [rad], v [rad/s], kp [Nm/rad], kd [Nms/rad], t [Nm] of their drives' loops


class Frames(Sequence[bytes]):
    """Raw CAN frames of one size in one piece of memory: a cycle's, taken apart only where something is odd."""

    __slots__ = ("data", "size")

    def __init__(self, data: bytes, size: int) -> None:
        """`data`: one frame behind the other, each of `size` bytes."""
        self.data, self.size = data, size

    @classmethod
    def of(cls, frames: Sequence[bytes]) -> "Frames | None":
        """Return frames in one piece; None unless there are some and all have one size."""
        if isinstance(frames, Frames):
            return frames
        sizes = set(map(len, frames))
        return cls(b"".join(frames), sizes.pop()) if len(sizes) == 1 and 0 not in sizes else None

    def __len__(self) -> int:
        return len(self.data) // self.size

    @overload
    def __getitem__(self, index: int) -> bytes: ...

    @overload
    def __getitem__(self, index: slice) -> list[bytes]: ...

    def __getitem__(self, index: int | slice) -> bytes | list[bytes]:
        at = range(0, len(self.data), self.size)[index]
        if isinstance(at, int):
            return self.data[at : at + self.size]
        return [self.data[each : each + self.size] for each in at]

    def __iter__(self) -> Iterator[bytes]:
        return iter(self[:])

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Sequence) and list(self) == list(other)

    __hash__ = None  # type: ignore[assignment] # equal to a list, which has none


class Transport(Protocol):
    """Moves raw `struct can_frame` (16 bytes) and `struct canfd_frame` (72 bytes); blocks only in wait and collect."""

    def send(self, raw: bytes) -> bool: ...  # False: dropped, never queued

    def send_all(self, frames: Sequence[bytes]) -> Sequence[bytes]: ...  # a cycle's at once; those that went out

    def receive(self) -> Sequence[bytes]: ...  # everything that waits

    def collect(self, count: int, timeout: float) -> Sequence[bytes]: ...  # waits for that many, or for silence [s]

    def wait(self, timeout: float) -> bool: ...  # readable within timeout [s]

    def flags(self) -> int: ...  # Link flags since the last call

    def reopen(self) -> bool: ...  # one attempt after the bus went away

    def close(self) -> None: ...


class Truth(NamedTuple):
    """The simulator's own account after a cycle: an oracle that the controller never sees."""

    time: float  # [s] simulated
    q: F64  # (n,)
    qd: F64  # (n,)
    tau: F64  # (n,) torque the joints really got
    tip: F64  # (3,) tip position
    tip_wxyz: F64  # (4,)
    clearance: dict[str, float]  # obstacle name -> smallest distance to any link's collision shape [m]
    self_clearance: float  # [m]
    contacts: int  # contact events so far (arm against obstacles or itself)


class Simulator(Protocol):
    """Drives and plant in lockstep; found through the entry-point group `rtctl.simulator`."""

    def exchange(self, frames: list[bytes]) -> list[bytes]: ...  # one servo period

    def obstacles(self) -> list[ObstacleEdit]: ...  # what a perfect camera would report now

    def truth(self) -> Truth: ...

    def close(self) -> None: ...


Record = NDArray[Any]  # one element of arm.record.record_dtype(n, K)
RecordRow: TypeAlias = Any  # an element of a structured array: numpy has no static type of its fields
Array: TypeAlias = NDArray[Any]  # of any kind of number

"""What may be said to the control socket: checked structs, and the requests of the tick that they become.

JSON, strict: no unknown keys, no NaN or infinity, every number bounded on both sides, every list of a largest length.
A cloud of points is one binary message: CLOUD_MARK, the length of a JSON header (u32, little-endian), that header, and
six bytes for each point, x, y, z in whole steps as int16. 10,000 points are 60 kB, so a message holds the largest.
"""

import math
import struct
from collections.abc import Callable, Iterator, Sequence
from typing import Annotated, Literal, NamedTuple

import msgspec
import numpy as np
from msgspec import Meta, Struct

from rtctl.arm.task import point_of, within
from rtctl.control.goals import RESTS
from rtctl.errors import ConfigError, RequestError
from rtctl.plain import Json
from rtctl.spec.goal import (
    Axes,
    Direction,
    GoalTurning,
    GoalVelocity,
    Heading,
    TimeOut,
    ToolAxis,
    goal_contradiction,
    goal_from,
    streamed,
)
from rtctl.spec.obstacles import (
    Cloud,
    Length,
    Mesh,
    Name,
    Obstacle,
    Orientation,
    Place,
    RollPitchYaw,
    contradiction,
    shape_of,
)
from rtctl.spec.read import convert, type_info
from rtctl.spec.robot import Angles
from rtctl.types import Goal, Grip, ObstacleEdit, Payload, Request, Task, Verb

OBSTACLES_MAX = 64  # in one camera frame
CLOUD_MARK = b"RTCLOUD1"
_LENGTH = struct.Struct("<I")
HEADING = "a heading is a base's"
ARM_TOLERANCE = 0.1  # [m] of an arm's goal at most

Latitude = Annotated[float, Meta(ge=-85.0, le=85.0)]
Longitude = Annotated[float, Meta(ge=-180.0, le=180.0)]
AGE_MAX = 10.0  # [s]
Age = Annotated[float, Meta(ge=0.0, le=AGE_MAX)]
Stamp = Annotated[
    float, Meta(ge=0.0, le=1e12, description="of the observation, CLOCK_MONOTONIC [s], in place of age_s")
]
NameOrAll = Annotated[str, Meta(max_length=32, pattern=r"^(\*|[A-Za-z0-9][A-Za-z0-9_.+-]*)$")]


Deadline = Annotated[
    float, Meta(ge=0.0, le=1e12, description="CLOCK_MONOTONIC [s] until which the caller waits; refused when later")
]


class _Message(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="verb"):
    """A JSON object told apart by its `verb`."""

    by_s: Deadline | None = None


class Arm(_Message, tag="arm", frozen=True):
    """Enable the drives, holding."""


class Disarm(_Message, tag="disarm", frozen=True):
    """Come to rest, then disable the drives."""

    drop: bool = False  # also an arm that falls then


class Park(_Message, tag="park", frozen=True):
    """Move to where the arm rests without torque, then disable the drives."""


class Stop(_Message, tag="stop", frozen=True):
    """Brake now and stay stopped."""


class Reset(_Message, tag="reset", frozen=True):
    """Leave a latched stop, once its cause is gone."""


class Recover(_Message, tag="recover", frozen=True):
    """Allow a slow move inward from beyond a joint limit."""


class Float(_Message, tag="float", frozen=True):
    """Let a hand move the arm: what it weighs is carried, nothing is driven; `hold` or a goal ends it."""


class Hold(_Message, tag="hold", frozen=True):
    """Stay here, without a goal."""


class PayloadMessage(_Message, tag="payload", frozen=True, kw_only=True):
    """Tell what the tip carries now; 0 kg: nothing."""

    mass_kg: Annotated[float, Meta(ge=0.0, le=200.0)]
    com_m: Annotated[tuple[Length, Length, Length], Meta(description="its centre, in the tip's frame")] = (
        0.0,
        0.0,
        0.0,
    )


class GripMessage(_Message, tag="grip", frozen=True, kw_only=True):
    """Move a gripper, or every one, to a share of its way with a force at most; 0 N: its own bound."""

    closed: Annotated[float, Meta(ge=0.0, le=1.0, description="0 open, 1 closed")]
    force_N: Annotated[float, Meta(ge=0.0, le=2000.0)] = 0.0
    name: Annotated[str, Meta(max_length=32)] = ""


class Status(_Message, tag="status", frozen=True):
    """Ask how things stand."""


class GoalMessage(_Message, tag="goal", frozen=True, kw_only=True):
    """Move the tip: position (or `axes` of it), orientation, direction of a tool axis; the rest stays free."""

    position_m: Place | None = None
    latlon_deg: tuple[Latitude, Longitude] | None = None  # of a base that knows where on Earth it is
    axes: Axes | None = None
    wxyz: Orientation | None = None
    rpy_rad: RollPitchYaw | None = None
    hold: Literal["orientation"] | None = None
    direction: Direction | None = None
    tool_axis: ToolAxis | None = None
    heading_rad: Heading | None = None  # of a base
    tolerance_m: Annotated[float, Meta(ge=1e-4, le=10.0)] | None = None  # of an arm at most 0.1
    tolerance_rad: Annotated[float, Meta(ge=1e-3, le=0.5)] | None = None
    posture_rad: Angles | None = None
    velocity_m_s: GoalVelocity | None = None
    velocity_rad_s: GoalTurning | None = None
    timeout_ms: TimeOut | None = None


class World(_Message, tag="world", frozen=True):
    """Ask which obstacles the controller knows of."""


class ObstacleMessage(_Message, tag="obstacle", frozen=True, kw_only=True):
    """Set or clear one obstacle; `clear = "*"` clears all."""

    set: Obstacle | None = None
    clear: NameOrAll | None = None
    age_s: Age = 0.0
    stamp_s: Stamp | None = None


class ObstaclesMessage(_Message, tag="obstacles", frozen=True, kw_only=True):
    """One frame of a camera; obstacles that it does not name stay as they were.

    Whatever a camera has shown must be shown again within `safety.obstacle_stale_s`, also what rests, or be cleared.
    """

    set: Annotated[tuple[Obstacle, ...], Meta(max_length=OBSTACLES_MAX)]
    clear: Annotated[tuple[Name, ...], Meta(max_length=OBSTACLES_MAX)] = ()
    age_s: Age = 0.0
    stamp_s: Stamp | None = None


class CloudMessage(_Message, tag="cloud", frozen=True, kw_only=True):
    """The header of a cloud; `feed`: a camera's, which sends the next one soon, told without waiting for the tick."""

    set: Cloud
    step_m: Annotated[float, Meta(ge=1e-6, le=0.01)]
    feed: bool = False
    age_s: Age = 0.0
    stamp_s: Stamp | None = None


class CloudFrame(NamedTuple):
    """A cloud as it came: header and points."""

    header: CloudMessage
    steps: bytes


Message = (
    Arm
    | Disarm
    | Park
    | Stop
    | Reset
    | Recover
    | Float
    | Hold
    | PayloadMessage
    | GripMessage
    | Status
    | World
    | GoalMessage
    | ObstacleMessage
    | ObstaclesMessage
)
VERBS = {
    Arm: Verb.ARM,
    Disarm: Verb.DISARM,
    Park: Verb.PARK,
    Stop: Verb.STOP,
    Reset: Verb.RESET,
    Recover: Verb.RECOVER,
    Float: Verb.FLOAT,
    Hold: Verb.HOLD,
}

KNOWN = frozenset(str(t.tag) for t in type_info(Message).types) | {"cloud"}
_decoder = msgspec.json.Decoder(Message, strict=True)
_cloud_decoder = msgspec.json.Decoder(CloudMessage, strict=True)


class Bounds(NamedTuple):
    """What goals are held to: a ball the arm's tip can reach at most, and the default tolerances."""

    centre: tuple[float, float, float]  # [m] of the arm's base in the world
    radius: float  # [m]
    tolerance: float  # [m]
    tolerance_rot: float  # [rad]
    axes: Task = Task.POSE  # of the tip that the arm can move
    local: Callable[[float, float], tuple[float, float] | None] | None = None  # a place [deg] in [m]; None: an arm


def cloud_message(header: Json, steps: bytes) -> bytes:
    """Return the binary message of a cloud; what a camera's driver sends."""
    text = msgspec.json.encode({"verb": "cloud", **header})
    return CLOUD_MARK + _LENGTH.pack(len(text)) + text + steps


def decode(raw: bytes | memoryview) -> Message | CloudFrame:
    """Return the message in `raw`. Raises RequestError on anything but a complete, well-formed one."""
    if bytes(raw[: len(CLOUD_MARK)]) == CLOUD_MARK:
        return _cloud_of(bytes(raw))
    try:
        message: Message = _decoder.decode(raw)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise RequestError(_explained(bytes(raw), Message, error)) from None
    for path, obstacle in _obstacles(message):
        if isinstance(obstacle, Cloud):
            raise RequestError(f"{path}: a cloud comes as a binary message; rtctl obstacle set sends one from a file")
        _refuse(path, obstacle)
    return message


def checked(message: Json) -> None:
    """Refuse a message that no daemon would take, whatever its robot and state. Raises RequestError."""
    found = decode(msgspec.json.encode(message))
    if isinstance(found, GoalMessage):
        on_earth = found.latlon_deg is not None and found.position_m is None  # where that is the daemon knows alone
        _refuse_goal(msgspec.structs.replace(found, position_m=(0.0, 0.0, 0.0)) if on_earth else found)


def _explained(raw: bytes, kind: object, error: Exception) -> str:
    """Return why a message is refused: the place in it, what came, what was wanted."""
    try:
        data = msgspec.json.decode(raw)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
        words = str(error).removeprefix("JSON is malformed: ").removeprefix("Input data was truncated")
        return f"request: got no JSON ({words or 'it is cut short'}), wanted one JSON object"
    if not isinstance(data, dict):
        return "request: got no object, wanted one JSON object with a verb"
    verb = data.get("verb")
    try:
        convert(data, kind, verb if isinstance(verb, str) and verb in KNOWN else "request")
    except ConfigError as refusal:
        return f"{refusal.place.replace(': ', '.', 1)}: got {refusal.got}, wanted {refusal.wanted}"
    except RecursionError:
        return "request: got lists or tables nested too deep, wanted a few levels"
    return f"request: got what JSON has no value for ({error}), wanted finite numbers and known names"


def _cloud_of(raw: bytes) -> CloudFrame:
    """Return the cloud of a binary message. Raises RequestError; the points themselves are judged by the tick."""
    start = len(CLOUD_MARK) + _LENGTH.size
    length = _LENGTH.unpack_from(raw, len(CLOUD_MARK))[0] if len(raw) >= start else len(raw)
    try:
        header = _cloud_decoder.decode(raw[start : start + length])
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise RequestError(_explained(raw[start : start + length], CloudMessage, error)) from None
    _refuse("cloud.set", header.set)
    return CloudFrame(header, raw[start + length :])


def _refuse(path: str, obstacle: Obstacle) -> None:
    """Raise RequestError for an obstacle that contradicts itself, has a timetable, or wants a file to be opened."""
    if found := contradiction(obstacle):
        key, got, wanted = found
        raise RequestError(f"{path}.{key}: got {got}, wanted {wanted}")
    if obstacle.waypoints or obstacle.appears_s != 0.0 or obstacle.vanishes_s != 1e6:
        raise RequestError(f"{path}: got a timetable, wanted where it is now: a timetable belongs in a scenario")
    if isinstance(obstacle, Mesh | Cloud) and obstacle.file is not None:
        # the daemon opens no file that a peer names: it may run as another user, and must not wait for a disk
        raise RequestError(f"{path}.file: got {obstacle.file!r}, wanted mesh = the name of a [[mesh]] of the config")


def request_of(
    message: Message | CloudFrame, bounds: Bounds, orientation: Callable[[], Sequence[float]], now: float = math.nan
) -> Request:
    """Return what the tick gets; `orientation` says the tip's wxyz, for a goal that holds it. Raises RequestError.

    now: as in `notices_of`; a request whose caller waits no more is refused.
    """
    if not isinstance(message, CloudFrame) and message.by_s is not None and now > message.by_s:
        raise RequestError(f"too late: the caller waited until {now - message.by_s:.1f} s ago")
    match message:
        case GoalMessage():
            return Request(goal=_goal_of(message, bounds, orientation))
        case ObstacleMessage() | ObstaclesMessage() | CloudFrame():
            return Request(obstacles=tuple(notice.edit(0.0) for notice in notices_of(message, now)))
        case PayloadMessage():
            if bounds.local is not None:
                raise RequestError("payload: a base carries what it carries, wanted an arm")
            return Request(payload=Payload(message.mass_kg, *message.com_m))
        case GripMessage():
            if bounds.local is not None:
                raise RequestError("grip: a base has no gripper, wanted an arm")
            return Request(grip=Grip(message.closed, message.force_N, message.name))
        case Status() | World():
            return Request()
        case Disarm(drop=True):
            return Request(verb=Verb.DROP)
        case _:
            return Request(verb=VERBS[type(message)])


class Notice(NamedTuple):
    """News of one obstacle, checked; made into arrays only when its tick comes."""

    name: str
    obstacle: Obstacle | None  # None: it is gone
    age: float  # [s] when it came
    feed: bool = False  # from a camera, which will show it again
    steps: bytes = b""  # of a cloud: its points
    step: float = 0.0  # [m]

    def edit(self, waited: float) -> ObstacleEdit:
        """Return the edit for a tick that comes `waited` [s] later."""
        shape = None if self.obstacle is None else shape_of(self.obstacle)
        if shape is not None and self.steps:
            shape = shape._replace(dims=np.array([shape.dims[0], self.step, 0.0, 0.0]), cloud=self.steps)
        return ObstacleEdit(self.name, shape, self.age + waited, self.feed)


def notices_of(message: ObstacleMessage | ObstaclesMessage | CloudFrame, now: float = math.nan) -> list[Notice]:
    """Return one notice per obstacle that is set or cleared; the name "*" clears all. Raises RequestError.

    now: CLOCK_MONOTONIC [s], for observations that carry a stamp in place of an age.
    """
    if isinstance(message, CloudFrame):
        header = message.header
        return [Notice(header.set.name, header.set, _age(header, now), header.feed, message.steps, header.step_m)]
    age = _age(message, now)
    if isinstance(message, ObstaclesMessage):
        gone = [Notice(name, None, age) for name in message.clear]
        return gone + [Notice(obstacle.name, obstacle, age, True) for obstacle in message.set]
    if message.set is not None and message.clear is None:
        return [Notice(message.set.name, message.set, age)]
    if message.clear is not None and message.set is None:
        return [Notice(message.clear, None, age)]
    raise RequestError("obstacle: got both or neither of set and clear, wanted one")


def _age(message: ObstacleMessage | ObstaclesMessage | CloudMessage, now: float) -> float:
    """Return how old an observation is [s], the time that its message took included where it carries a stamp."""
    if message.stamp_s is None:
        return message.age_s
    age = now - message.stamp_s
    if message.age_s != 0.0 or not 0.0 <= age <= AGE_MAX:
        got = "an age beside it" if message.age_s != 0.0 else f"a time {age:.3f} s ago"
        raise RequestError(f"stamp_s: got {got}, wanted CLOCK_MONOTONIC of the last {AGE_MAX:g} s alone")
    return age


def _refuse_goal(message: GoalMessage) -> None:
    if found := goal_contradiction(message):
        key, got, wanted = found
        raise RequestError(f"goal.{key}: got {got}, wanted {wanted}")


def _goal_of(message: GoalMessage, bounds: Bounds, orientation: Callable[[], Sequence[float]]) -> Goal:
    if message.latlon_deg is not None:
        message = msgspec.structs.replace(message, position_m=_position_of(message, bounds), latlon_deg=None)
    if bounds.local is None and (message.tolerance_m or 0.0) > ARM_TOLERANCE:
        raise RequestError(f"goal.tolerance_m: got {message.tolerance_m}, wanted at most {ARM_TOLERANCE}")
    if bounds.local is None and message.heading_rad is not None:
        raise RequestError(f"goal.heading_rad: got {message.heading_rad}, wanted rpy_rad or wxyz: {HEADING}")
    if bounds.local is not None and (found := streamed(message)):
        raise RequestError(f"goal.{found[0]}: got {found[1]}, wanted {RESTS}")
    _refuse_goal(message)
    goal = goal_from(message, lambda: np.array(orientation()), bounds.tolerance, bounds.tolerance_rot)
    if message.posture_rad is not None:
        goal = goal._replace(posture=np.array(message.posture_rad, dtype=np.float64))
    task, why = within(goal.task, bounds.axes)
    if why:
        raise RequestError(why)
    centre = np.array(bounds.centre)
    away = math.dist(point_of(goal._replace(task=task), centre), centre)  # what is free is no further than it need be
    if away > bounds.radius:
        raise RequestError(f"goal.position_m: got {away:.3f} m from the base, wanted at most {bounds.radius:.3f} m")
    return goal


def _position_of(message: GoalMessage, bounds: Bounds) -> tuple[float, float, float]:
    """Return the place [m] of a goal in degrees. Raises RequestError."""
    assert message.latlon_deg is not None
    if message.position_m is not None:
        raise RequestError("goal.latlon_deg: got position_m beside it, wanted one of them")
    if bounds.local is None:
        raise RequestError("goal.latlon_deg: an arm has no place on Earth, wanted position_m")
    at = bounds.local(*message.latlon_deg)
    if at is None:
        raise RequestError("goal.latlon_deg: the vehicle has not said where its origin is")
    return (*at, 0.0)


def _obstacles(message: Message) -> Iterator[tuple[str, Obstacle]]:
    if isinstance(message, ObstacleMessage) and message.set is not None:
        yield "obstacle.set", message.set
    elif isinstance(message, ObstaclesMessage):
        for i, obstacle in enumerate(message.set):
            yield f"obstacles.set[{i}]", obstacle

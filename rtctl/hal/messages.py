"""What may be said to the control socket: checked structs, and the requests of the tick that they become.

JSON, strict: no unknown keys, no NaN or infinity, every number bounded on both sides, every list of a largest length.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Annotated, Literal, NamedTuple

import msgspec
import numpy as np
from msgspec import Meta, Struct

from rtctl.config.goal import Axes, Direction, ToolAxis, goal_contradiction, goal_from
from rtctl.config.obstacles import (
    Name,
    Obstacle,
    Orientation,
    Place,
    RollPitchYaw,
    contradiction,
    shape_of,
)
from rtctl.control.task import point_of, within
from rtctl.errors import RequestError
from rtctl.types import Goal, ObstacleEdit, Request, Task, Verb

OBSTACLES_MAX = 64  # in one camera frame

Age = Annotated[float, Meta(ge=0.0, le=10.0)]
NameOrAll = Annotated[str, Meta(max_length=32, pattern=r"^(\*|[A-Za-z0-9][A-Za-z0-9_.+-]*)$")]


class _Message(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="verb"):
    """A JSON object told apart by its `verb`."""


class Arm(_Message, tag="arm", frozen=True):
    """Enable the drives, holding."""


class Disarm(_Message, tag="disarm", frozen=True):
    """Come to rest, then disable the drives."""


class Stop(_Message, tag="stop", frozen=True):
    """Brake now and stay stopped."""


class Reset(_Message, tag="reset", frozen=True):
    """Leave a latched stop, once its cause is gone."""


class Recover(_Message, tag="recover", frozen=True):
    """Allow a slow move inward from beyond a joint limit."""


class Status(_Message, tag="status", frozen=True):
    """Ask how things stand."""


class GoalMessage(_Message, tag="goal", frozen=True, kw_only=True):
    """Move the tip: position (or `axes` of it), orientation, direction of a tool axis; the rest stays free."""

    position_m: Place | None = None
    axes: Axes | None = None
    wxyz: Orientation | None = None
    rpy_rad: RollPitchYaw | None = None
    hold: Literal["orientation"] | None = None
    direction: Direction | None = None
    tool_axis: ToolAxis | None = None
    tolerance_m: Annotated[float, Meta(ge=1e-4, le=0.1)] | None = None
    tolerance_rad: Annotated[float, Meta(ge=1e-3, le=0.5)] | None = None


class ObstacleMessage(_Message, tag="obstacle", frozen=True, kw_only=True):
    """Set or clear one obstacle; `clear = "*"` clears all."""

    set: Obstacle | None = None
    clear: NameOrAll | None = None
    age_s: Age = 0.0


class ObstaclesMessage(_Message, tag="obstacles", frozen=True, kw_only=True):
    """One frame of a camera; obstacles that it does not name stay as they were."""

    set: Annotated[tuple[Obstacle, ...], Meta(max_length=OBSTACLES_MAX)]
    clear: Annotated[tuple[Name, ...], Meta(max_length=OBSTACLES_MAX)] = ()
    age_s: Age = 0.0


Message = Arm | Disarm | Stop | Reset | Recover | Status | GoalMessage | ObstacleMessage | ObstaclesMessage
VERBS = {Arm: Verb.ARM, Disarm: Verb.DISARM, Stop: Verb.STOP, Reset: Verb.RESET, Recover: Verb.RECOVER}

_decoder = msgspec.json.Decoder(Message, strict=True)


class Bounds(NamedTuple):
    """What goals are held to: a ball the arm's tip can reach at most, and the default tolerances."""

    centre: tuple[float, float, float]  # [m] of the arm's base in the world
    radius: float  # [m]
    tolerance: float  # [m]
    tolerance_rot: float  # [rad]
    axes: Task = Task.POSE  # of the tip that the arm can move


def decode(raw: bytes | memoryview) -> Message:
    """Return the message in `raw`. Raises RequestError on anything but a complete, well-formed one."""
    try:
        message: Message = _decoder.decode(raw)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise RequestError(f"not understood: {error}") from None
    for path, obstacle in _obstacles(message):
        if found := contradiction(obstacle):
            key, got, wanted = found
            raise RequestError(f"{path}.{key}: got {got}, wanted {wanted}")
        if obstacle.waypoints or obstacle.appears_s != 0.0 or obstacle.vanishes_s != 1e6:
            raise RequestError(f"{path}: a timetable belongs in a scenario; say where the obstacle is now")
    return message


def request_of(message: Message, bounds: Bounds, orientation: Callable[[], Sequence[float]]) -> Request:
    """Return what the tick gets; `orientation` says the tip's wxyz, for a goal that holds it. Raises RequestError."""
    match message:
        case GoalMessage():
            return Request(goal=_goal_of(message, bounds, orientation))
        case ObstacleMessage() | ObstaclesMessage():
            return Request(obstacles=tuple(notice.edit(0.0) for notice in notices_of(message)))
        case Status():
            return Request()
        case _:
            return Request(verb=VERBS[type(message)])


class Notice(NamedTuple):
    """News of one obstacle, checked; made into arrays only when its tick comes."""

    name: str
    obstacle: Obstacle | None  # None: it is gone
    age: float  # [s] when it came

    def edit(self, waited: float) -> ObstacleEdit:
        """Return the edit for a tick that comes `waited` [s] later."""
        shape = None if self.obstacle is None else shape_of(self.obstacle)
        return ObstacleEdit(self.name, shape, self.age + waited)


def notices_of(message: ObstacleMessage | ObstaclesMessage) -> list[Notice]:
    """Return one notice per obstacle that is set or cleared; the name "*" clears all. Raises RequestError."""
    if isinstance(message, ObstaclesMessage):
        gone = [Notice(name, None, message.age_s) for name in message.clear]
        return gone + [Notice(obstacle.name, obstacle, message.age_s) for obstacle in message.set]
    if message.set is not None and message.clear is None:
        return [Notice(message.set.name, message.set, message.age_s)]
    if message.clear is not None and message.set is None:
        return [Notice(message.clear, None, message.age_s)]
    raise RequestError("obstacle: got both or neither of set and clear, wanted one")


def _goal_of(message: GoalMessage, bounds: Bounds, orientation: Callable[[], Sequence[float]]) -> Goal:
    if found := goal_contradiction(message):
        key, got, wanted = found
        raise RequestError(f"goal.{key}: got {got}, wanted {wanted}")
    goal = goal_from(message, lambda: np.array(orientation()), bounds.tolerance, bounds.tolerance_rot)
    task, why = within(goal.task, bounds.axes)
    if why:
        raise RequestError(why)
    centre = np.array(bounds.centre)
    away = math.dist(point_of(goal._replace(task=task), centre), centre)  # what is free is no further than it need be
    if away > bounds.radius:
        raise RequestError(f"goal.position_m: got {away:.3f} m from the base, wanted at most {bounds.radius:.3f} m")
    return goal


def _obstacles(message: Message) -> Iterator[tuple[str, Obstacle]]:
    if isinstance(message, ObstacleMessage) and message.set is not None:
        yield "obstacle.set", message.set
    elif isinstance(message, ObstaclesMessage):
        for i, obstacle in enumerate(message.set):
            yield f"obstacles.set[{i}]", obstacle

"""What a goal asks for, as scenario files and the control socket say it, and the goal that the tick takes."""

import math
from collections.abc import Callable, Sequence
from typing import Annotated, Literal, Protocol

import numpy as np
from msgspec import Meta

from rtctl.arm.task import between
from rtctl.kernel.rotations import exp3, quat_of
from rtctl.spec.obstacles import Orientation, Place, RollPitchYaw, Unit, orientation_contradiction, quaternion
from rtctl.types import F64, GOAL_TIMEOUT, Goal, Task

LinearAxis = Literal["x", "y", "z"]
Axes = Annotated[tuple[LinearAxis, ...], Meta(min_length=1, max_length=3, description="position along these alone")]
Heading = Annotated[float, Meta(ge=-6.3, le=6.3, description="of a base, counter-clockwise from east")]
Direction = Annotated[tuple[Unit, Unit, Unit], Meta(description="of the tool's axis in the world; roll is free")]
ToolAxis = Annotated[Literal["x", "y", "z", "-x", "-y", "-z"], Meta(description="of the tip's frame, for a direction")]
Beside = Annotated[float, Meta(ge=-10.0, le=10.0)]
Turning = Annotated[float, Meta(ge=-50.0, le=50.0)]
GoalVelocity = Annotated[
    tuple[Beside, Beside, Beside], Meta(description="of a goal that moves: it goes on so until the next one comes")
]
GoalTurning = Annotated[
    tuple[Turning, Turning, Turning], Meta(description="of a goal whose orientation turns, in world axes")
]
TimeOut = Annotated[
    float,
    Meta(
        ge=10.0,
        le=10_000.0,
        description=f"of a stream: when it has passed without another goal the arm stops; {1e3 * GOAL_TIMEOUT:g} of a "
        "goal that moves, none of others",
    ),
]
STREAMED = ("velocity_m_s", "velocity_rad_s", "timeout_ms")  # keys of an arm's goals
_BITS = {"x": Task.X, "y": Task.Y, "z": Task.Z, "rx": Task.RX, "ry": Task.RY, "rz": Task.RZ}


class Asked(Protocol):
    """The fields that say where the tip is to go."""

    @property
    def position_m(self) -> Place | None: ...
    @property
    def axes(self) -> tuple[LinearAxis, ...] | None: ...
    @property
    def wxyz(self) -> Orientation | None: ...
    @property
    def rpy_rad(self) -> RollPitchYaw | None: ...
    @property
    def hold(self) -> Literal["orientation"] | None: ...
    @property
    def direction(self) -> tuple[float, float, float] | None: ...
    @property
    def tool_axis(self) -> str | None: ...
    @property
    def heading_rad(self) -> float | None: ...
    @property
    def velocity_m_s(self) -> tuple[float, float, float] | None: ...
    @property
    def velocity_rad_s(self) -> tuple[float, float, float] | None: ...
    @property
    def timeout_ms(self) -> float | None: ...
    @property
    def tolerance_m(self) -> float | None: ...
    @property
    def tolerance_rad(self) -> float | None: ...


def task_of(axes: Sequence[str]) -> Task:
    """Return the task of axes by name."""
    bits = 0
    for axis in axes:
        bits |= int(_BITS[axis])
    return Task(bits)


def goal_contradiction(goal: Asked) -> tuple[str, object, str] | None:
    """Return the first contradiction within a goal as (key, got, wanted), None when there is none."""
    if found := orientation_contradiction(goal.rpy_rad, goal.wxyz):
        return found
    oriented = goal.rpy_rad is not None or goal.wxyz is not None
    if goal.heading_rad is not None and (oriented or goal.hold or goal.direction):
        return "heading_rad", goal.heading_rad, "no other orientation beside it"
    if goal.hold and oriented:
        return "hold", goal.hold, "nothing beside wxyz or rpy_rad"
    if goal.direction is not None:
        if oriented or goal.hold:
            return "direction", list(goal.direction), "no orientation beside it"
        if np.linalg.norm(goal.direction) < 1e-3:
            return "direction", list(goal.direction), "a vector that points somewhere"
    elif goal.tool_axis is not None:
        return "tool_axis", goal.tool_axis, "a direction beside it"
    if goal.position_m is None:
        if goal.axes is not None:
            return "axes", ", ".join(goal.axes), "a position_m beside it"
        if not (oriented or goal.hold or goal.direction):
            return "position_m", "nothing", "a position, an orientation or a direction"
        if goal.velocity_m_s is not None:
            return "velocity_m_s", list(goal.velocity_m_s), "a position_m beside it"
    if goal.velocity_rad_s is not None and not (oriented or goal.direction):
        return "velocity_rad_s", list(goal.velocity_rad_s), "wxyz, rpy_rad or direction beside it"
    if goal.axes is not None and len(set(goal.axes)) != len(goal.axes):
        return "axes", ", ".join(goal.axes), "each axis once"
    return None


def streamed(goal: Asked) -> tuple[str, object] | None:
    """Return the first key of a goal that is a stream's, and what it says, None where there is none."""
    given = {key: getattr(goal, key) for key in STREAMED}
    return next(((key, value) for key, value in given.items() if value is not None), None)


def _velocity(told: tuple[float, float, float] | None) -> F64 | None:
    """Return a velocity (3,), None for a goal that rests."""
    return None if told is None or not any(told) else np.array(told, dtype=np.float64)


def goal_from(goal: Asked, wxyz: Callable[[], F64], tolerance: float, tolerance_rot: float) -> Goal:
    """Return the goal as the tick takes it.

    wxyz: the tip's orientation now (4,), for a goal that holds it. tolerance [m], tolerance_rot [rad]: the robot's, for
    a goal that gives none.
    """
    bits = 0 if goal.position_m is None else int(task_of(goal.axes or ("x", "y", "z")))
    axis = np.zeros(3)
    axis["xyz".index((goal.tool_axis or "z")[-1])] = -1.0 if (goal.tool_axis or "z")[0] == "-" else 1.0
    if goal.direction is not None:
        bits |= int(Task.DIRECTION)
        towards = np.array(goal.direction, dtype=np.float64)
        turn = quat_of(exp3(between(axis, towards / np.linalg.norm(towards))))
    elif goal.rpy_rad is not None or goal.wxyz is not None:
        bits |= int(Task.ORIENTATION)
        turn = quaternion(goal.rpy_rad, goal.wxyz)
    elif goal.heading_rad is not None:
        bits |= int(Task.RZ)
        turn = np.array([math.cos(0.5 * goal.heading_rad), 0.0, 0.0, math.sin(0.5 * goal.heading_rad)])
    else:
        bits |= int(Task.ORIENTATION) if goal.hold else 0
        turn = np.array(wxyz(), dtype=np.float64) if goal.hold else np.array([1.0, 0.0, 0.0, 0.0])
    velocity, omega = _velocity(goal.velocity_m_s), _velocity(goal.velocity_rad_s)
    timeout = GOAL_TIMEOUT if velocity is not None or omega is not None else None
    return Goal(
        position=np.zeros(3) if goal.position_m is None else np.array(goal.position_m, dtype=np.float64),
        wxyz=turn,
        task=Task(bits),
        tolerance=tolerance if goal.tolerance_m is None else goal.tolerance_m,
        tolerance_rot=tolerance_rot if goal.tolerance_rad is None else goal.tolerance_rad,
        axis=axis,
        velocity=velocity,
        omega=omega,
        timeout=timeout if goal.timeout_ms is None else 1e-3 * goal.timeout_ms,
    )

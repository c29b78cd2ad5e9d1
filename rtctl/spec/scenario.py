"""Scenario files: goals, obstacles and faults over time, for one robot."""

from itertools import pairwise
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from rtctl.errors import ConfigError
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
)
from rtctl.spec.obstacles import (
    Coordinate,
    Name,
    Obstacle,
    Orientation,
    Place,
    RollPitchYaw,
    refuse_obstacles,
    shape_of,
)
from rtctl.spec.plant import PlantTable
from rtctl.spec.read import convert, name_place, read
from rtctl.spec.robot import Angle, Angles, Key, Table, Text
from rtctl.spec.shipped import shipped
from rtctl.types import F64, Goal, ObstacleEdit

Moment = Annotated[float, Meta(ge=0.0, le=3600.0)]


class GoalTable(Table, frozen=True, kw_only=True):
    """A goal of the tip: position (or `axes` of it), orientation, direction of a tool axis; the rest stays free."""

    position_m: Place | None = None
    axes: Axes | None = None  # None: all three
    wxyz: Orientation | None = None
    rpy_rad: RollPitchYaw | None = None
    hold: Literal["orientation"] | None = None
    direction: Direction | None = None
    tool_axis: ToolAxis | None = None  # None: z
    heading_rad: Heading | None = None  # of a base
    tolerance_m: Annotated[float, Meta(ge=1e-4, le=1.0)] | None = None
    tolerance_rad: Annotated[float, Meta(ge=1e-3, le=3.2)] | None = None
    velocity_m_s: GoalVelocity | None = None
    velocity_rad_s: GoalTurning | None = None
    timeout_ms: TimeOut | None = None


class TimedGoal(GoalTable, frozen=True, kw_only=True):
    """A goal given at a moment of the scenario."""

    at_s: Moment


class FaultTable(Table, frozen=True, kw_only=True):
    """A fault to inject; `kind` is the injector's name of it."""

    at_s: Moment
    kind: Name
    duration_s: Annotated[float, Meta(ge=0.0, le=3600.0, description="0 lasts")] = 0.0
    joint: Annotated[int, Meta(ge=-1, le=14, description="index, -1 is all")] | Key = -1
    from_deg: Annotated[
        float, Meta(ge=-360.0, le=360.0, description="of a range sensor, clockwise from the front")
    ] = -180.0
    to_deg: Annotated[float, Meta(ge=-360.0, le=360.0)] = 180.0
    link: Annotated[Key, Meta(description="of a push: the link that is pushed at its centre of mass")] | None = None
    newton: Annotated[float, Meta(ge=0.0, le=1e4, description="of a push")] | None = None
    direction: (
        Annotated[tuple[Coordinate, Coordinate, Coordinate], Meta(description="of a push, in the world; default: down")]
        | None
    ) = None
    value: Annotated[float, Meta(ge=-1e4, le=1e4, description="how much, where the kind has a size")] | None = None


class GripTable(Table, frozen=True, kw_only=True):
    """What a gripper is asked at a time."""

    at_s: Moment
    closed: Annotated[float, Meta(ge=0.0, le=1.0, description="0 open, 1 closed")]
    force_N: Annotated[float, Meta(ge=0.0, le=2000.0, description="at most; 0: its own bound")] = 0.0


class Scenario(Table, frozen=True, kw_only=True):
    """What happens to a robot over a stretch of time."""

    robot: Text
    duration_s: Annotated[float, Meta(ge=0.01, le=3600.0)]
    start_q_rad: Angles | None = None  # None: the robot's home
    start_pose: Annotated[tuple[Coordinate, Coordinate, Angle], Meta(description="of a base: m, m, rad")] | None = None
    seed: Annotated[int, Meta(ge=0, le=2**53)] = 0
    planner: Annotated[bool, Meta(description="lead the tip to each goal by the sub-goals of the global planner")] = (
        False
    )
    goal: Annotated[tuple[TimedGoal, ...], Meta(max_length=10_000)] = ()
    obstacle: Annotated[tuple[Obstacle, ...], Meta(max_length=256)] = ()
    fault: Annotated[tuple[FaultTable, ...], Meta(max_length=1000)] = ()
    grip: Annotated[tuple[GripTable, ...], Meta(max_length=10_000)] = ()
    plant: PlantTable | None = None  # None: the simulated arm is as described


def load_scenario(path: str | Path) -> Scenario:
    """Return the scenario of a TOML file.

    Raises ConfigError for a key that is missing, unknown, out of bounds or in contradiction with another.
    """
    scenario: Scenario = read(Path(path), Scenario)
    refuse_obstacles(scenario.obstacle, str(path))
    for i, goal in enumerate(scenario.goal):
        _refuse_goal(goal, str(path), f"goal[{i}].")
    times = [g.at_s for g in scenario.goal]
    for i, (a, b) in enumerate(pairwise(times)):
        if b <= a:
            raise ConfigError(f"{path}: goal[{i + 1}].at_s", b, f"more than the goal before it, {a:g}")
    return scenario


def robot_file(scenario: Scenario, path: str | Path) -> Path:
    """Return the config file of the scenario's robot: a path relative to it, or the name of a file in configs/."""
    here, robot = Path(path).resolve().parent, scenario.robot
    if robot.endswith(".toml"):
        tried = [here / robot, Path(robot)]
    else:
        roots = [
            here,
            here / "configs",
            here.parent / "configs",
            Path("configs"),
            shipped(),
        ]
        tried = [root / f"{robot}.toml" for root in roots]
    found = next((p for p in tried if p.is_file()), None)
    if found is None:
        raise ConfigError(f"{path}: robot", robot, f"a config file; looked for {tried[0]} and configs/{robot}.toml")
    return found


def scenario_dict(scenario: Scenario, path: str | Path = "scenario.toml") -> Json:
    """Return the scenario as the plain values of its TOML, defaults filled in and absent keys left out.

    Files of meshes and clouds, relative to `path`, become absolute.
    """
    plain = _without_none(msgspec.to_builtins(scenario))
    for table in plain["obstacle"]:
        if "file" in table:
            table["file"] = str(Path(path).resolve().parent / table["file"])
    return plain


def _without_none(table: Json) -> Json:
    return {key: _set(value) for key, value in table.items() if value is not None}


def _set(value: object) -> object:
    if isinstance(value, dict):
        return _without_none(value)
    return [_set(v) for v in value] if isinstance(value, list | tuple) else value


def parse_obstacle(data: object, source: str) -> Obstacle:
    """Return the obstacle of one JSON or TOML table, for the control socket and the command line."""
    obstacle: Obstacle = convert(data, Obstacle, source)
    refuse_obstacles((obstacle,), source, one=True)
    return obstacle


def parse_goal(data: object, source: str) -> GoalTable:
    """Return the goal of one JSON table, for the control socket and the command line."""
    goal: GoalTable = convert(data, GoalTable, source)
    _refuse_goal(goal, source, "")
    return goal


def goal_of(goal: GoalTable, wxyz: F64, tolerance: float, tolerance_rot: float) -> Goal:
    """Return the goal as the tick takes it.

    wxyz (4,): the tip's orientation now, kept by hold = "orientation". tolerance [m], tolerance_rot [rad]: the robot's,
    for a goal that gives none.
    """
    return goal_from(goal, lambda: wxyz, tolerance, tolerance_rot)


def edit_of(obstacle: Obstacle, age: float = 0.0) -> ObstacleEdit:
    """Return the edit that sets an obstacle seen `age` [s] ago."""
    return ObstacleEdit(obstacle.name, shape_of(obstacle), age)


def _refuse_goal(goal: GoalTable, source: str, inside: str) -> None:
    if found := goal_contradiction(goal):
        raise ConfigError(name_place(source, inside + found[0]), found[1], found[2])

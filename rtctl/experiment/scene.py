"""A scenario played through the whole pipe, CAN bytes included, and kept period by period for a figure."""

import json
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np

from rtctl.app.arm import ArmServo
from rtctl.app.arm_scene import ArmTurn
from rtctl.app.sim import simulate
from rtctl.arm.robot import Robot
from rtctl.errors import ConfigError
from rtctl.plain import Json
from rtctl.spec.obstacles import shape_of
from rtctl.spec.read import convert
from rtctl.spec.scenario import Scenario
from rtctl.spec.shipped import shipped
from rtctl.spec.urdf import urdf_file
from rtctl.types import F64, I64, Shape, Truth

Say = Callable[[float], None]  # takes the part (0 to 1) that is done
CONFIGS = shipped()


def unsaid(part: float) -> None:
    """Say nothing of how far the work is."""


def config_file(name: str) -> Path:
    """Return the config of a robot that the source tree carries. Raises ConfigError."""
    path = CONFIGS / f"{name}.toml"
    if not path.is_file():
        raise ConfigError(str(path), "no such file", "the source tree's configs: experiments run from it")
    return path


class Trace(NamedTuple):
    """What happened, a row a period (T) of the simulated time; n joints."""

    robot: Robot
    scenario: Scenario
    time: F64  # (T,) [s]
    q: F64  # (T, n) [rad] true
    tip: F64  # (T, 3) [m] true
    xd: F64  # (T, 3) [m/s] of the tip, true by differences
    x_seen: F64  # (T, 3) [m] of the tip, the controller's estimate
    clearance: dict[str, F64]  # (T,) [m] of pybullet, by obstacle
    rho: F64  # (T,) [m] least distance, as the controller sees it
    force: F64  # (T,) [N] of all obstacles on the arm
    status: I64  # (T,) types.Status
    tau_limits: F64  # (T, n) [Nm]
    tau: F64  # (T, n) [Nm] sent
    figures: Json  # of `rtctl.app.sim.simulate`

    def least(self) -> F64:
        """Return the clearance (T,) [m] to the nearest obstacle, by pybullet."""
        least: F64 = np.min(list(self.clearance.values()), axis=0)
        return least

    def speed(self) -> F64:
        """Return the speed (T,) [m/s] of the tip."""
        speed: F64 = np.linalg.norm(self.xd, axis=1)
        return speed

    def shapes(self, t: float) -> list[Shape]:
        """Return the obstacles that are there at time t [s], in their places."""
        return [shape_of(o, t) for o in self.scenario.obstacle if o.appears_s <= t < o.vanishes_s]

    def row(self, t: float) -> int:
        """Return the row of time t [s]."""
        return int(np.searchsorted(self.time, t).clip(max=len(self.time) - 1))

    def rows(self, start: float, end: float) -> slice:
        """Return the rows from one time [s] to another."""
        return slice(self.row(start), self.row(end) + 1)


def variant(source: Path, folder: Path, changes: dict[str, dict[str, object]]) -> Path:
    """Write a copy of a config with keys of its tables replaced; return its file.

    Paths stay valid: a relative URDF becomes an absolute one.
    """
    import tomllib

    table = tomllib.loads(source.read_text(encoding="utf-8"))
    if not table["robot"]["urdf"].startswith("package://"):
        table["robot"]["urdf"] = str(urdf_file(table["robot"]["urdf"], source).resolve())
    for name, values in changes.items():
        table.setdefault(name, {}).update(values)
    path = folder / source.name
    path.write_text("".join(f"{json.dumps(k)} = {toml(v)}\n" for k, v in table.items()), encoding="utf-8")
    return path


def toml(value: object) -> str:
    """Return a value in TOML, tables inline."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(k)} = {toml(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(toml(v) for v in value) + "]"
    return json.dumps(value)


def played(
    scenario: Json,
    config: Path,
    say: Say = unsaid,
    changes: dict[str, dict[str, object]] | None = None,
) -> Trace:
    """Return the trace of a scenario, given as the tables of its TOML, on the robot of a config file.

    changes: keys of the config's tables to be replaced.
    """
    told: Scenario = convert({**scenario, "robot": str(config)}, Scenario, "experiment")
    rows: list[tuple[object, ...]] = []
    clearance: dict[str, list[float]] = {}
    robots: list[Robot] = []

    def watch(servo: ArmServo, truth: Truth, turn: ArmTurn) -> None:
        robots[:] = [servo.robot]
        record = turn.record.reshape(1)[0]
        push = np.linalg.norm(record["force"], axis=1).sum()
        rows.append(
            (
                truth.time,
                truth.q.copy(),
                truth.tip.copy(),
                record["x"].copy(),
                record["rho"].min(),
                push,
                record["status"],
                record["tau_limits"].copy(),
                record["tau_sent"].copy(),
            )
        )
        for name, d in truth.clearance.items():
            clearance.setdefault(name, [np.nan] * (len(rows) - 1)).append(d)
        for column in clearance.values():
            if len(column) < len(rows):
                column.append(np.nan)
        if len(rows) % 100 == 0:
            say(min(truth.time / told.duration_s, 1.0))

    with TemporaryDirectory() as name:
        folder = Path(name)
        where = variant(config, folder, changes or {})
        path = folder / "scenario.toml"
        told_here = {**scenario, "robot": where.name}
        path.write_text("".join(f"{json.dumps(k)} = {toml(v)}\n" for k, v in told_here.items()), encoding="utf-8")
        figures = simulate(path, watch=watch)
    time, q, tip, x, rho, force, status, limits, tau = (np.array(column) for column in zip(*rows, strict=True))
    xd = np.gradient(tip, time, axis=0)
    columns = {k: np.array(v) for k, v in clearance.items()}
    return Trace(robots[0], told, time, q, tip, xd, x, columns, rho, force, status, limits, tau, figures)

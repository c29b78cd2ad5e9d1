"""A run as its log tells it: time series of the tick, goals as the controller took them, obstacles as it was told."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rtctl.arm import faults
from rtctl.arm.task import error_of
from rtctl.design import Config
from rtctl.errors import LogError
from rtctl.kernel.rotations import R_of
from rtctl.log import read, segments
from rtctl.log.header import meshes_of
from rtctl.log.read.inputs import requests_of
from rtctl.spec.obstacles import shape_of
from rtctl.types import B1, F64, I64, Drive, Goal, Request, Shape, State
from rtctl.world import obstacle_table
from rtctl.world.meshes import Meshes

FIELDS = (
    "tick",
    "slot",
    "missed",
    "q",
    "x",
    "xd",
    "wxyz",
    "rho",
    "tau_sent",
    "command",
    "state",
    "lateness",
    "compute",
    "faults",
    "age",
)


class Track(NamedTuple):
    """An obstacle over the run."""

    name: str
    rho: F64  # (N,) [m] the controller's distance to the arm's points, nan while it is not there
    at: list[float]  # (k,) [s] when it was reported
    shapes: list[Shape]  # (k,) as it was reported

    @property
    def moves(self) -> bool:
        """Whether it was ever reported elsewhere."""
        return any((s.position != self.shapes[0].position).any() for s in self.shapes)


class Trace(NamedTuple):
    """Columns of the log's ticks, from the first slot to the last; N ticks, n joints."""

    slot: I64  # (N,)
    time: F64  # (N,) [s] since the arm was told to wake
    missed: I64  # (N,) slots skipped before this tick
    q: F64  # (N, n) [rad] encoders
    x: F64  # (N, 3) [m] tip
    xd: F64  # (N, 3) [m/s]
    wxyz: F64  # (N, 4)
    goals: dict[int, Goal]  # by the slot that the controller was given them in
    ratio: F64  # (N, n) torque sent, of the joint's rating
    driven: B1  # (N,) torque was sent
    running: B1  # (N,) state RUN
    lateness: F64  # (N,) [s] of the wake-up
    compute: F64  # (N,) [s] of the tick before
    age: F64  # (N,) [s] oldest reply
    faults: tuple[str, ...]  # seen in any tick
    period: float  # [s]
    joints: tuple[str, ...]
    tracks: dict[str, Track]  # obstacles by name
    v_max: float  # [m/s]
    influence: float  # [m]
    clearance: float  # [m]

    def at(self, slot: int) -> int:
        """Return the first tick at or after a slot of the grid."""
        return int(np.searchsorted(self.slot, slot))

    def errors(self, part: slice, goal: Goal) -> tuple[F64, F64]:
        """Return distance [m] and angle [rad] of the tip to a goal in a stretch of ticks, 0 where the goal is free."""
        both = np.array([error_of(goal, x, R_of(w)) for x, w in zip(self.x[part], self.wxyz[part], strict=True)])
        return both[:, 0], both[:, 1]


def trace(path: Path | str, config: Config, began: int) -> Trace:
    """Return the run of a log (all its segments) under `config`; time counts from the slot `began`.

    Raises LogError when a file cannot be read or holds no tick.
    """
    logs = [read(part) for part in segments(path)]
    ticks = [log["/tick"] for log in logs if "/tick" in log and len(log["/tick"])]
    if not ticks:
        raise LogError(f"{path}: holds no tick")
    c = {name: np.concatenate([getattr(t, name) for t in ticks]) for name in FIELDS}
    header = logs[0].header
    time: F64 = (c["slot"].astype(np.int64) - began) * np.float64(header.period)
    requests = [pair for log in logs for pair in sorted(requests_of(log).items())]
    slot_of = dict(zip(c["tick"].tolist(), c["slot"].tolist(), strict=True))
    return Trace(
        slot=c["slot"].astype(np.int64),
        time=time,
        missed=c["missed"].astype(np.int64),
        q=c["q"],
        x=c["x"],
        xd=c["xd"],
        wxyz=c["wxyz"],
        goals={slot_of[tick]: r.goal for tick, r in requests if r.goal is not None},
        ratio=np.abs(c["tau_sent"]) / np.array([j.tau_max_Nm for j in config.robot.joints]),
        driven=c["command"] == int(Drive.TORQUE),
        running=c["state"] == int(State.RUN),
        lateness=c["lateness"],
        compute=c["compute"],
        age=c["age"].max(1),
        faults=faults.names(int(np.bitwise_or.reduce(c["faults"].astype(np.int64)))),
        period=header.period,
        joints=header.joints,
        tracks=_tracks(time, c["rho"], _spans(config, meshes_of(header), requests, c["tick"].astype(np.int64))),
        v_max=config.motion.v_max_m_s,
        influence=config.avoid.influence_m,
        clearance=config.avoid.clearance_m,
    )


Span = tuple[int, int, tuple[str, ...], list[Shape]]


def _spans(config: Config, known: Meshes, requests: Iterable[tuple[int, Request]], ticks: I64) -> Iterator[Span]:
    """Yield stretches of ticks [start, stop) between two edits, the names of the slots, and the shapes just set."""
    edits = [shape_of(o) for o in config.obstacle]
    # the points of a config's own cloud are not in the log; here its name and place are enough
    edits = [s._replace(type="point") if s.type == "cloud" else s for s in edits]
    table = obstacle_table.with_static(obstacle_table.empty(known=known), tuple(edits))
    start, count = 0, len(ticks)
    for tick, request in requests:
        if request.obstacles:
            stop = int(np.searchsorted(ticks, tick))
            yield start, stop, table.names, edits
            table, _ = obstacle_table.edited(table, request.obstacles)
            start, edits = stop, [e.shape for e in request.obstacles if e.shape is not None]
    yield start, count, table.names, edits


def _tracks(time: F64, rho: F64, spans: Iterable[Span]) -> dict[str, Track]:
    """Return the obstacles by name: the slots of the log's columns, named by replaying what the controller was told."""
    found: dict[str, Track] = {}
    for start, stop, names, shapes in spans:
        for shape in shapes:
            track = found.setdefault(shape.name, Track(shape.name, np.full(len(time), np.nan), [], []))
            track.at.append(float(time[min(start, len(time) - 1)]))
            track.shapes.append(shape)
        for slot, name in enumerate(names):
            if name:
                found[name].rho[start:stop] = rho[start:stop, slot]
    for track in found.values():
        track.rho[~np.isfinite(track.rho)] = np.nan
    return found

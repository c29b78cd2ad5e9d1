"""Everything a report shows, gathered in one pass over the log, a piece at a time: any length fits into memory."""

import tomllib
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np

from rtctl.errors import LogError
from rtctl.log import limits, schema
from rtctl.log.header import Header
from rtctl.log.read.faults import fault_table
from rtctl.log.read.fields import called
from rtctl.log.read.run import Run
from rtctl.log.read.topic import Part, Structured
from rtctl.log.view.report.bins import Bins, Histogram, Spectrum
from rtctl.log.view.report.slots import Slots, Way
from rtctl.plain import Json
from rtctl.spec.bus import frame_time
from rtctl.types import F64, Array, LimitFlag, State, Status

XYZ = ("x", "y", "z")
PARTS = ("motion", "obstacles", "limits", "posture", "gravity")


class Span(NamedTuple):
    """A value that held from one time to another."""

    start: float  # [s]
    stop: float
    name: str


class Gathered(NamedTuple):
    """What the pages are made of."""

    header: Header
    bins: Bins
    lateness: Histogram
    compute: Histogram
    spectrum: Spectrum
    states: list[Span]
    statuses: list[Span]
    faults: list[Span]
    cuts: list[Span]
    obstacles: list[Way]
    goals: list[list[float]]  # [m] as they were asked for
    asked: list[float]  # [s] when
    limits: dict[str, F64]  # q_min, q_max, tau_max, qd_max (n,), v_max (1,)
    figures: Json
    bus: dict[str, tuple[F64, F64]]  # topic -> times [s] and load [0..1]
    events: list[tuple[float, str, str]]


class _Turns:
    """Spans of equal values over pieces."""

    def __init__(self, name: Callable[[int], str]) -> None:
        self.spans: list[Span] = []
        self._name = name
        self._value: int | None = None
        self._since = self._last = 0.0

    def add(self, time: F64, values: Array) -> None:
        if not len(values):
            return
        previous = -1 if self._value is None else self._value
        edges = np.flatnonzero(np.diff(values.astype(np.int64), prepend=previous))
        for k in edges.tolist():
            self._close(float(time[k]))
            self._value, self._since = int(values[k]), float(time[k])
        self._last = float(time[-1])

    def _close(self, now: float) -> None:
        if self._value is not None and now > self._since and (name := self._name(self._value)):
            self.spans.append(Span(self._since, now, name))

    def done(self, period: float) -> list[Span]:
        self._close(self._last + period)
        return self.spans


def _when_set(name: str, value: int) -> str:
    return name if value else ""


class _Bits:
    """Spans in which a bit was set."""

    def __init__(self, names: dict[int, str]) -> None:
        self._turns = {bit: _Turns(partial(_when_set, name)) for bit, name in names.items()}

    def add(self, time: F64, values: Array) -> None:
        for bit, turns in self._turns.items():
            turns.add(time, (values & np.array(bit, values.dtype)) != 0)

    def done(self, period: float) -> list[Span]:
        return sorted(span for turns in self._turns.values() for span in turns.done(period))


def gather(run: Run, progress: Callable[[int], None] = lambda n: None) -> Gathered:
    """Return what a log's report shows. Raises LogError when it has no ticks of rtctl."""
    header = run.header
    total = run.count(schema.TICK)
    if not total:
        raise LogError(f"{run.path}: no tick in it: nothing to report")
    bins, slots = Bins(total), Slots(run, header)
    spectrum = Spectrum(len(header.joints), 1.0 / header.period)
    lateness, compute = Histogram(), Histogram()
    limits = limits_of(header)
    states = _Turns(lambda v: called(State, v))
    statuses = _Turns(lambda v: called(Status, v).lower())
    faults = _Bits({1 << i: name for i, name in enumerate(fault_table(header))})
    cuts = _Bits({int(cut): cut.name.lower() for cut in LimitFlag if cut and cut.name})
    figures = _Figures()
    done, marks = 0, list[tuple[int, float]]()
    for piece in run.pieces(schema.TICK):
        records = piece.array
        if not len(records):
            continue
        bins.begin(done, records["time"])
        _fill(bins, records, header, limits)
        _obstacles(bins, records, slots)
        for turns, field in ((states, "state"), (statuses, "status"), (faults, "faults"), (cuts, "cut")):
            if field not in (records.dtype.names or ()):
                continue
            turns.add(records["time"], records[field])
        lateness.add(np.abs(records["lateness"]))
        compute.add(records["compute"])
        if "tau_sent" in (records.dtype.names or ()):
            spectrum.add(records["tau_sent"])
        figures.add(records)
        marks += [(int(records["tick"][k]), float(records["time"][k])) for k in (0, -1)]
        done += len(records)
        progress(90 * done // total)
    period = header.period
    events = [_event(e) for e in run.events]
    bus = {name: _bus_load(run, name, header) for name in run.topics if name.startswith(schema.can_topic(""))}
    return Gathered(
        header,
        bins,
        lateness,
        compute,
        spectrum,
        states.done(period),
        statuses.done(period),
        faults.done(period),
        cuts.done(period),
        list(slots.ways.values()),
        slots.goals,
        np.interp(slots.asked, *np.array(marks, np.float64).T).tolist() if slots.asked else [],
        limits,
        figures.as_dict(),
        bus,
        events,
    )


def _fill(bins: Bins, r: Structured, header: Header, limits: dict[str, F64]) -> None:
    """Add the series of a piece that are not per obstacle."""
    joints, have = header.joints, set(r.dtype.names or ())
    for name in have & {"x", "xd", "goal"}:
        bins.columns(name, r[name], XYZ)
    for name in have & {"error", "error_rot", "sigma_min", "innovation", "lateness", "compute", "v", "w", "heading"}:
        bins.add(name, r[name])
    for name in have & {"q", "qd", "tau_sent", "tau_measured"}:
        bins.columns(name, r[name], joints)
    bins.add("speed", np.linalg.norm(r["xd"], axis=1))
    for part in PARTS if "tau_motion" in have else ():
        bins.add(f"part.{part}", np.linalg.norm(r[f"tau_{part}"], axis=1))
    if "age" in have and joints:
        bins.add("age", r["age"].max(axis=1))
    bins.add("missed", r["missed"].astype(np.float64))
    if "q_min" in limits:
        bins.columns("margin", np.minimum(r["q"] - limits["q_min"], limits["q_max"] - r["q"]), joints)


def _obstacles(bins: Bins, r: Structured, slots: Slots) -> None:
    rho = r["rho"]
    active = np.flatnonzero(np.isfinite(rho).any(axis=0))
    for slot in active.tolist():
        size = np.linalg.norm(r["force"][:, slot], axis=1) if "force" in (r.dtype.names or ()) else np.zeros(len(r))
        for name, rows in slots.mine(slot, r["tick"].astype(np.int64)):
            bins.add(f"rho.{name}", np.where(rows, rho[:, slot], np.nan))
            bins.add(f"force.{name}", np.where(rows, size, np.nan))


class _Figures:
    """Numbers of the whole run."""

    def __init__(self) -> None:
        self.ticks = self.missed = 0
        self.path = self.speed = self.torque = 0.0
        self.rho = self.age = np.inf
        self.first = self.last = 0.0
        self.error = 0.0
        self._tip: F64 | None = None

    def add(self, r: Structured) -> None:
        self.first = float(r["time"][0]) if not self.ticks else self.first
        self.last, self.error = float(r["time"][-1]), float(r["error"][-1])
        self.ticks += len(r)
        self.missed += int(r["missed"].sum())
        tip = np.concatenate([r["x"][:1] if self._tip is None else self._tip[None], r["x"]])
        self.path += float(np.linalg.norm(np.diff(tip, axis=0), axis=1).sum())
        self._tip = r["x"][-1].copy()
        self.speed = max(self.speed, float(np.linalg.norm(r["xd"], axis=1).max()))
        if "tau_sent" in (r.dtype.names or ()):
            self.torque = max(self.torque, float(np.abs(r["tau_sent"]).max()))
        self.rho = min(self.rho, float(r["rho"].min()))

    def as_dict(self) -> Json:
        return {
            "ticks": self.ticks,
            "missed": self.missed,
            "duration_s": self.last - self.first,
            "path_m": self.path,
            "top_speed_m_s": self.speed,
            "largest_torque_Nm": self.torque,
            "smallest_clearance_m": self.rho if np.isfinite(self.rho) else None,
            "final_error_m": self.error,
        }


def limits_of(header: Header) -> dict[str, F64]:
    """Return the limits that a log's config states, {} for one that has none like that."""
    try:
        config = tomllib.loads(header.config)
        joints = config["robot"]["joints"]
        ratio = float(config.get("safety", {}).get("torque_ratio", 1.0))
        found = {
            "q_min": np.array([float(j["q_min_rad"]) for j in joints]),
            "q_max": np.array([float(j["q_max_rad"]) for j in joints]),
            "qd_max": np.array([float(j["qd_max_rad_s"]) for j in joints]),
            "tau_max": np.array([ratio * float(j["tau_max_Nm"]) for j in joints]),
            "v_max": np.array([float(config["motion"]["v_max_m_s"])]),
        }
    except (tomllib.TOMLDecodeError, KeyError, TypeError, ValueError, AttributeError):
        return {}
    return found if all(len(v) in (1, len(header.joints)) for v in found.values()) else {}


def _bus_load(run: Run, topic: str, header: Header, width: float = 0.1) -> tuple[F64, F64]:
    """Return times [s] since the log's begin and the share of each `width` [s] that frames took on the wire."""
    try:
        link = tomllib.loads(header.config)["link"]
        fd = bool(link.get("fd", False))
        rates = float(link["bitrate"]), float(link["data_bitrate"]) if fd else None
        cost = np.array([frame_time(n, *rates) for n in range(65 if fd else 9)])
    except (tomllib.TOMLDecodeError, KeyError, TypeError, ValueError):
        return np.zeros(0), np.zeros(0)
    start, stop = run.span
    count = min(max(1, int((stop - start) / 1e9 / width) + 1), limits.SPAN_BINS)

    def work(part: Part) -> F64:
        size = np.clip(part.size - schema.CAN_DATA_AT, 0, len(cost) - 1)
        place = np.clip((part.time - start) // round(width * 1e9), 0, count - 1)
        return np.asarray(np.bincount(place, cost[size], count), np.float64)

    load = np.zeros(count)
    for each in run[topic].source(work):
        load += each
    return np.asarray(np.arange(count) * width), load / width


def _event(event: Json) -> tuple[float, str, str]:
    at = event.get("time", 0.0)
    return (
        float(at) if isinstance(at, int | float) else 0.0,
        str(event.get("name", "")),
        str(event.get("detail", event.get("message", ""))),
    )

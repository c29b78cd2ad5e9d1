"""Replay: the pure tick once more on the inputs of a log, from the log alone: the same bits, or where they differ.

The command frames are made anew by the daemon's own encoder, so that what is compared is what went over the bus.
"""

import gc
import hashlib
import json
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple, cast

import msgspec
import numpy as np

from rtctl import config as cfg
from rtctl.assembly import link_spec
from rtctl.config import Config
from rtctl.config.urdf import urdf_file
from rtctl.control.pipe import initial, tick
from rtctl.control.robot import Robot
from rtctl.errors import ConfigError, LogError
from rtctl.hal.can import CanLink
from rtctl.log import schema
from rtctl.log.fields import size_of, unit_of
from rtctl.log.header import meshes_of
from rtctl.log.mesh import unpacked
from rtctl.log.replay import Logged, feedbacks_of, inputs
from rtctl.log.run import Run
from rtctl.log.topic import CAN_ROW, Structured, stacked
from rtctl.protocol import frame
from rtctl.servo import first_feedback
from rtctl.types import F64, I64, Command, Drive, Request, Transport

BLOCK = 1000  # ticks that are compared at once
GIVEN = frozenset(("lateness", "compute"))  # copied through, never computed
COUNTER_AT = 8  # of the counter in a protected frame's data


class Divergence(NamedTuple):
    """Where a replay first differs from the log."""

    tick: int
    time: float  # [s] robot time
    joint: str  # or obstacle slot, or axis; '' for a field without parts
    field: str  # of the record, or `frame`
    logged: str
    replayed: str
    size: str  # of the difference, with unit


class Difference(NamedTuple):
    """How far one field differs over a whole replay."""

    field: str
    unit: str
    ticks: int  # in which it differs
    first: int  # tick
    largest: float  # absolute difference; NaN where a number stands against none
    at: int  # tick of the largest


class Replay(NamedTuple):
    """What a replay found."""

    robot: str
    ticks: int
    frames: int  # compared
    digest: str  # sha256 of the replayed command frames, as `rtctl sim` prints it
    divergence: Divergence | None
    differences: tuple[Difference, ...]
    ignored: tuple[str, ...]  # fields that only one of log and program knows
    seconds: float  # taken
    duration: float  # [s] of robot time
    time: F64  # (T,) [s]
    logged: F64  # (T, n) [Nm] tau_sent; of a base (T, 2) [m/s] v_world
    replayed: F64  # (T, n)

    @property
    def identical(self) -> bool:
        """Return whether every bit is the same."""
        return self.divergence is None

    @property
    def speed(self) -> float:
        """Return robot time over the time taken."""
        return self.duration / self.seconds if self.seconds > 0.0 else 0.0


def rebuilt(run: Run) -> tuple[Config, Robot]:
    """Return config and robot as the log's attachments describe them.

    Raises LogError when they are not there, ConfigError when this version refuses them.
    """
    header = run.header
    if not header.config or not header.urdf:
        raise LogError(f"{run.path}: no config.toml or robot.urdf attached: it cannot be replayed alone")
    with tempfile.TemporaryDirectory(prefix="rtctl-replay-") as name:
        folder = Path(name)
        urdf, text = unpacked(header.urdf, header.config, header.files, folder)
        (folder / "config.toml").write_text(text, encoding="utf-8")
        (folder / "robot.urdf").write_text(urdf, encoding="utf-8")
        try:
            config = cfg.load(folder / "config.toml")
            own = msgspec.structs.replace(config.robot, urdf="robot.urdf")
            here = msgspec.structs.replace(config, robot=own)
            robot = cfg.build(here, folder / "config.toml")
            return config, robot._replace(meshes=meshes_of(header))
        except ValueError as error:
            raise LogError(f"{run.path}: a mesh that is attached: {error}") from None
        except ConfigError as error:
            place = error.place.replace(f"{folder}/", f"{run.path}: ")
            raise ConfigError(place, error.got, error.wanted) from None


def other(path: Path, run: Run) -> tuple[Config, Robot]:
    """Return another config and its robot, for what-if. Raises ConfigError when it is not for this log's robot."""
    config = cfg.load(path)
    urdf_file(config.robot.urdf, path)
    header = run.header
    names = tuple(j.name for j in config.robot.joints)
    if names != header.joints:
        raise ConfigError(f"{path}: robot.joints", ", ".join(names), f"the log's {', '.join(header.joints)}")
    if abs(1.0 / config.loop.servo_hz - header.period) > 1e-12:
        raise ConfigError(f"{path}: loop.servo_hz", config.loop.servo_hz, f"the log's {1.0 / header.period:g}")
    return config, cfg.build(config, path)._replace(meshes=meshes_of(run.header))


class _Null:
    """A bus that takes everything."""

    def send_all(self, frames: list[bytes]) -> list[bytes]:
        return frames


class _Subject(NamedTuple):
    """What is replayed: an arm or a base."""

    name: str
    dt: float  # [s]
    memory: Any
    tick: Callable[[Any, Any, Request], tuple[Any, Any, Any]]  # (memory, feedback, request)
    feedbacks: Callable[[Structured], Iterable[Any]]
    link: CanLink | None  # encodes commands again; None: the records alone are compared
    shown: str  # the field of a command that is drawn


def _arm(run: Run, config: Path | None) -> _Subject:
    what, robot = rebuilt(run) if config is None else other(config, run)
    link = CanLink(link_spec(what), cast(Transport, _Null()))
    memory = initial(robot, first_feedback(_first_q(run)))
    step = lambda m, feedback, request: tick(robot, m, feedback, request)  # noqa: E731
    return _Subject(robot.name, robot.dt, memory, step, feedbacks_of, link, "tau_sent")


def _base(run: Run, config: Path | None) -> _Subject:
    from rtctl.config.base import load
    from rtctl.config.base_derive import build
    from rtctl.control.base import pipe
    from rtctl.control.base.record import feedback_from

    header = run.header
    with tempfile.TemporaryDirectory(prefix="rtctl-replay-") as name:
        path = Path(name) / "config.toml"
        path.write_text(header.config, encoding="utf-8")
        path = path if config is None else config
        base = build(load(path), path)
    try:
        start = feedback_from(np.frombuffer(bytes.fromhex(header.extra.get("start", "")), header.dtype)[0])
    except (ValueError, IndexError):
        raise LogError(f"{run.path}: its header has no feedback of the handshake") from None
    if abs(base.dt - header.period) > 1e-12:
        raise ConfigError(f"{path}: loop.servo_hz", f"{1.0 / base.dt:g}", f"the log's {1.0 / header.period:g}")
    step = lambda m, feedback, request: pipe.tick(base, m, feedback, request)  # noqa: E731
    rows = lambda records: map(feedback_from, records)  # noqa: E731
    return _Subject(base.name, base.dt, pipe.initial(base, start), step, rows, None, "v_world")


def replay(run: Run, config: Path | None = None, progress: Callable[[int], None] = lambda n: None) -> Replay:
    """Return how the tick's replay differs from the log; with `config`, how that config's commands would.

    progress: called with the number of ticks done. Raises LogError, ConfigError.
    """
    subject = (_base if run.header.extra.get("kind") == "base" else _arm)(run, config)
    link, memory = subject.link, subject.memory
    dry = run.header.extra.get("dry") == "1"
    wire = None if link is None else _Wire(run, link, config is None)
    check = _Check(run, subject.shown)
    digest = hashlib.sha256()
    begun, done = time.perf_counter(), 0
    for block in _blocks(inputs(run.logs, subject.feedbacks)):
        if not done:
            gc.freeze()  # robot and kernels will not be garbage: looking through them again costs a twentieth
            if int(block[0].record["tick"]) != 0:
                raise LogError(f"{run.path}: begins with tick {block[0].record['tick']}; what was before it is missing")
        if wire is not None:
            wire.prime(block[0].log_time)
        records, sent = [], []
        for logged in block:
            memory, command, record = subject.tick(memory, logged.feedback, logged.request)
            records.append(record)
            if link is not None:
                sent.append(link.write(Command(Drive.DISABLE, command.tau) if dry else command))
                digest.update(b"".join(sent[-1]))
        check.compare([logged.record for logged in block], records)
        if wire is not None:
            ticks = [int(logged.record["tick"]) for logged in block]
            wire.compare([logged.log_time for logged in block], ticks, subject.dt, sent)
        done += len(block)
        progress(done)
    gc.unfreeze()
    seconds = time.perf_counter() - begun
    if not done:
        raise LogError(f"{run.path}: no tick in it")
    found = (check.divergence, None if wire is None else wire.divergence)
    first = min((d for d in found if d is not None), key=lambda d: d.tick, default=None)
    return Replay(
        subject.name, done, 0 if wire is None else wire.frames, "" if link is None else digest.hexdigest(), first,
        check.differences(), check.ignored, seconds, done * subject.dt,
        np.concatenate(check.time), np.concatenate(check.tau_logged), np.concatenate(check.tau),
    )  # fmt: skip


def _blocks(ticks: Iterator[Logged]) -> Iterator[list[Logged]]:
    while block := list(islice(ticks, BLOCK)):
        yield block


def _first_q(run: Run) -> F64:
    text = run.header.extra.get("q_handshake", "")
    try:
        q = np.frombuffer(bytes.fromhex(text), np.float64)
    except ValueError:
        q = np.zeros(0)
    if q.shape != (len(run.header.joints),):
        raise LogError(f"{run.path}: its header has no positions of the handshake")
    return q


class _Check:
    """Compares records, block by block."""

    def __init__(self, run: Run, shown: str) -> None:
        self.run, self.shown = run, shown
        self.divergence: Divergence | None = None
        self.ignored: tuple[str, ...] = ()
        self.time: list[F64] = []
        self.tau: list[F64] = []
        self.tau_logged: list[F64] = []
        self._found: dict[str, Difference] = {}

    def compare(self, logged: list[Any], replayed: list[Any]) -> None:
        """Take a block of ticks into account."""
        ours = np.frombuffer(b"".join(record.tobytes() for record in replayed), replayed[0].dtype)
        theirs = np.frombuffer(b"".join(record.tobytes() for record in logged), logged[0].dtype)
        self.time.append(np.array(theirs["time"]))
        self.tau.append(np.array(ours[self.shown]))
        self.tau_logged.append(np.array(theirs[self.shown]))
        if ours.dtype == theirs.dtype and ours.tobytes() == theirs.tobytes():
            return
        mine, its = (set(a.dtype.names or ()) for a in (ours, theirs))
        self.ignored = tuple(sorted(mine ^ its))
        names = [name for name in theirs.dtype.names or () if name in mine and name not in GIVEN]
        first: tuple[int, str] | None = None
        for name in names:
            a, b = theirs[name], ours[name]
            if a.shape != b.shape:
                self.ignored = tuple(sorted({*self.ignored, name}))
                continue
            rows = np.flatnonzero(_differ(a, b))
            if not len(rows):
                continue
            self._note(name, a, b, rows, theirs["tick"])
            if first is None or rows[0] < first[0]:
                first = (int(rows[0]), name)
        if first is not None and self.divergence is None:
            self.divergence = self._divergence(theirs[first[0]], ours[first[0]], first[1])

    def _note(self, name: str, a: Any, b: Any, rows: Any, ticks: Any) -> None:
        with np.errstate(invalid="ignore"):
            gap = np.abs(a[rows].astype(np.float64) - b[rows].astype(np.float64)).reshape(len(rows), -1)
        gap[(a[rows] == b[rows]).reshape(gap.shape)] = 0.0  # inf and inf
        worst = np.where(np.isnan(gap), np.inf, gap).max(axis=1)
        k = int(worst.argmax())
        old = self._found.get(name)
        here = Difference(name, unit_of(name), len(rows), int(ticks[rows[0]]), float(worst[k]), int(ticks[rows[k]]))
        if old is not None:
            larger = here if here.largest > old.largest else old
            here = old._replace(ticks=old.ticks + here.ticks, largest=larger.largest, at=larger.at)
        self._found[name] = here

    def _divergence(self, a: Any, b: Any, name: str) -> Divergence:
        one, two = np.atleast_1d(a[name]), np.atleast_1d(b[name])
        index = np.unravel_index(int(np.flatnonzero(_differ(one.reshape(-1, 1), two.reshape(-1, 1)))[0]), one.shape)
        x, y = one[index], two[index]
        part = part_of(name, index, self.run.header.joints) if a[name].shape else ""
        return Divergence(
            int(a["tick"]), float(a["time"]), part, name, repr(x.item()), repr(y.item()), size_of(name, x, y)
        )

    def differences(self) -> tuple[Difference, ...]:
        """Return the fields that differ, in the order of the record."""
        return tuple(self._found[name] for name in self.run.header.dtype.names or () if name in self._found)


def part_of(name: str, index: tuple[Any, ...], joints: tuple[str, ...]) -> str:
    """Return what an index of a field means: a joint's name, an axis, an obstacle's slot."""
    first = int(index[0])
    if name in ("rho", "force", "point"):
        return f"obstacle slot {first}" + (f", {'xyz'[int(index[1])]}" if len(index) > 1 else "")
    if name in ("x", "xd", "omega", "goal"):
        return "xyz"[first]
    if name in ("wxyz", "goal_wxyz"):
        return "wxyz"[first]
    if name == "F":
        return ("x", "y", "z", "rx", "ry", "rz")[first]
    return joints[first] if first < len(joints) else str(first)


def _differ(a: Any, b: Any) -> Any:
    """Return the rows that differ in a bit."""
    kind = {8: np.uint64, 4: np.uint32}[a.dtype.itemsize]
    bits = (np.ascontiguousarray(a).view(kind) != np.ascontiguousarray(b).view(kind)).reshape(len(a), -1)
    return bits.any(axis=1)


class _Wire:
    """Compares command frames with those that the log holds for the same ticks."""

    def __init__(self, run: Run, link: CanLink, compares: bool) -> None:
        self.link = link
        self.frames = 0
        self.divergence: Divergence | None = None
        compares = compares and any(run.count(schema.can_topic(bus)) for bus in run.header.buses[:1])
        self._sent = _sent_frames(run) if compares else iter(())
        self._waiting: Structured = np.zeros(0, CAN_ROW)
        self._time: I64 = np.zeros(0, np.int64)
        self._ended = not compares
        self._primed = False
        self._counted = _counters(run, len(link.spec.joints))
        self._joint = {joint.can_id: joint.name for joint in link.spec.joints}
        self._size = frame.CANFD_MTU if link.spec.fd else frame.CAN_MTU

    def _fill(self, until: int) -> None:
        """Read on until every frame up to a log_time [ns] is there."""
        while not self._ended and (not len(self._time) or self._time[-1] <= until):
            more = next(self._sent, None)
            if more is None:
                self._ended = True
                return
            self._time = np.concatenate([self._time, more[0]])
            self._waiting = stacked([self._waiting, more[1]], CAN_ROW)

    def prime(self, time: int) -> None:
        """Continue the counters of the log, which the handshake has moved: those of its first commands, less one."""
        if self._primed:
            return
        self._primed = True
        if self._counted:
            for j, counter in enumerate(self._counted):
                self.link.set_counter(j, counter)
            return
        self._fill(time)
        if not self.link.protected:
            return
        ids = [joint.can_id for joint in self.link.spec.joints]
        for j, can_id in enumerate(ids):
            rows = np.flatnonzero((self._waiting["id"] == can_id) & (self._time >= time))
            if len(rows):
                self.link.set_counter(j, int(self._waiting["data"][rows[0], COUNTER_AT]) - 1)

    def compare(self, times: list[int], ticks: list[int], period: float, frames: list[list[bytes]]) -> None:
        """Take a block of ticks into account: the frames of a tick carry its log_time."""
        if self._ended and not len(self._time):
            return
        self._fill(times[-1])
        cut = int(np.searchsorted(self._time, times[-1], side="right"))
        logged, stamps = self._waiting[:cut], self._time[:cut]
        self._waiting, self._time = self._waiting[cut:], self._time[cut:]
        keep = np.isin(stamps, times)  # frames of no tick are the daemon's own stop frames
        logged, stamps = logged[keep], stamps[keep]
        raw = np.frombuffer(b"".join(f for each in frames for f in each), np.uint8).reshape(-1, self._size)
        owner = np.repeat(np.arange(len(times)), [len(each) for each in frames])
        self.frames += len(logged)
        if len(raw) == len(logged):
            ids = raw[:, :4].copy().view("<u4").reshape(-1)
            same = (ids == logged["id"]) & (raw[:, 4] == logged["dlc"])
            same &= (raw[:, 8:] == logged["data"][:, : self._size - 8]).all(axis=1)
            same &= stamps == np.array(times)[owner]
            if same.all():
                return
            row = int(np.flatnonzero(~same)[0])
        else:
            row = _first_gap(stamps, np.array(times)[owner])
        if self.divergence is None:
            at = int(owner[min(row, len(owner) - 1)]) if len(owner) else 0
            self.divergence = self._divergence(ticks[at], period, row, raw, logged)

    def _divergence(self, tick: int, period: float, row: int, raw: Any, logged: Any) -> Divergence:
        ours = bytes(raw[row, 8 : 8 + int(raw[row, 4])]) if row < len(raw) else b""
        its = bytes(logged["data"][row, : int(logged["dlc"][row])]) if row < len(logged) else b""
        can_id = int(logged["id"][row]) if row < len(logged) else int.from_bytes(raw[row, :4].tobytes(), "little")
        places = [i for i, (a, b) in enumerate(zip(its, ours, strict=False)) if a != b]
        size = f"bytes {', '.join(map(str, places))}" if places and ours and its else "a frame that the other lacks"
        joint = self._joint.get(can_id, f"{can_id:03X}")
        return Divergence(tick, tick * period, joint, "frame", its.hex() or "none", ours.hex() or "none", size)


def _counters(run: Run, n: int) -> list[int]:
    """Return the counters of the handshake that the header tells, [] when it does not."""
    try:
        found = [int(c) for c in json.loads(run.header.extra.get("counters", "[]"))]
    except (ValueError, TypeError):
        found = []
    return found if len(found) == n else []


def _first_gap(one: I64, two: I64) -> int:
    n = min(len(one), len(two))
    rows = np.flatnonzero(one[:n] != two[:n])
    return int(rows[0]) if len(rows) else n


def _sent_frames(run: Run) -> Iterator[tuple[I64, Structured]]:
    """Yield log_time and the command frames of the first bus, piece by piece."""
    topic = schema.can_topic(run.header.buses[0]) if run.header.buses else ""
    for piece in run.pieces(topic):
        array = piece.array
        mine = array["direction"] == schema.TX
        yield piece.time[mine], array[mine]

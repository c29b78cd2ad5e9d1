"""What a replay is compared with: the records and the command frames of the log, bit by bit."""

import json
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple, SupportsInt

import numpy as np
from numpy.typing import NDArray

from rtctl.hal.can.link import CanLink
from rtctl.log import schema
from rtctl.log.read.fields import size_of, unit_of
from rtctl.log.read.inputs import EVERYTHING
from rtctl.log.read.run import Run
from rtctl.log.read.topic import CAN_ROW, Structured, Topic, stacked
from rtctl.protocol import frame
from rtctl.types import B1, F64, I64, Record

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


class Check:
    """Compares records, block by block."""

    def __init__(self, run: Run, shown: str) -> None:
        self.run, self.shown = run, shown
        self.divergence: Divergence | None = None
        self.ignored: tuple[str, ...] = ()
        self.time: list[F64] = []
        self.tau: list[F64] = []
        self.tau_logged: list[F64] = []
        self._found: dict[str, Difference] = {}

    def drawn(self) -> tuple[F64, F64, F64]:
        """Return time (T,) [s] and what is drawn of the log and of the replay, (T, n) each."""
        if not self.time:
            return np.zeros(0), np.zeros((0, 0)), np.zeros((0, 0))
        return np.concatenate(self.time), np.concatenate(self.tau_logged), np.concatenate(self.tau)

    def compare(self, logged: Sequence[Record], replayed: Sequence[Record]) -> list[int]:
        """Take a block of ticks into account; return their numbers."""
        ours = np.frombuffer(b"".join(record.tobytes() for record in replayed), replayed[0].dtype)
        theirs = np.frombuffer(b"".join(record.tobytes() for record in logged), logged[0].dtype)
        self.time.append(np.array(theirs["time"]))
        self.tau.append(np.array(ours[self.shown]))
        self.tau_logged.append(np.array(theirs[self.shown]))
        ticks: list[int] = theirs["tick"].tolist()
        if ours.dtype == theirs.dtype and ours.tobytes() == theirs.tobytes():
            return ticks
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
        return ticks

    def _note(self, name: str, a: F64, b: F64, rows: I64, ticks: I64) -> None:
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

    def _divergence(self, a: Record, b: Record, name: str) -> Divergence:
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


def part_of(name: str, index: Sequence[SupportsInt], joints: tuple[str, ...]) -> str:
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


def _differ(a: F64, b: F64) -> B1:
    """Return the rows that differ in a bit."""
    kind = {8: np.uint64, 4: np.uint32}[a.dtype.itemsize]
    bits = (np.ascontiguousarray(a).view(kind) != np.ascontiguousarray(b).view(kind)).reshape(len(a), -1)
    rows: B1 = bits.any(axis=1)
    return rows


class Wire:
    """Compares command frames with those that the log holds for the same ticks."""

    def __init__(self, run: Run, link: CanLink, compares: bool, span: tuple[int, int] = EVERYTHING) -> None:
        """`compares` with the frames of a span of log_time [ns], or only encodes."""
        self.link = link
        self.frames = 0
        self.divergence: Divergence | None = None
        compares = compares and any(run.count(schema.can_topic(bus)) for bus in run.header.buses[:1])
        self._sent = _sent_frames(run, span) if compares else iter(())
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

    def go_on(self, counters: tuple[int, ...]) -> None:
        """Continue the counters of a checkpoint."""
        self._primed = True
        for j, counter in enumerate(counters):
            self.link.set_counter(j, counter)

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

    def compare(self, times: list[int], ticks: list[int], period: float, frames: list[bytes]) -> None:
        """Take a block of ticks into account, each with all its frames: in the log they carry its log_time."""
        if self._ended and not len(self._time):
            return
        self._fill(times[-1])
        cut = int(np.searchsorted(self._time, times[-1], side="right"))
        logged, stamps = self._waiting[:cut], self._time[:cut]
        self._waiting, self._time = self._waiting[cut:], self._time[cut:]
        keep = np.isin(stamps, times)  # frames of no tick are the daemon's own stop frames
        logged, stamps = logged[keep], stamps[keep]
        raw = np.frombuffer(b"".join(frames), np.uint8).reshape(-1, self._size)
        owner = np.repeat(np.arange(len(times)), [len(each) // self._size for each in frames])
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

    def _divergence(self, tick: int, period: float, row: int, raw: NDArray[np.uint8], logged: Structured) -> Divergence:
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


def _sent_frames(run: Run, span: tuple[int, int]) -> Iterator[tuple[I64, Structured]]:
    """Yield log_time and the command frames of the first bus, piece by piece."""
    topic = schema.can_topic(run.header.buses[0]) if run.header.buses else ""
    pieces: Iterable[Topic] = run.pieces(topic) if span == EVERYTHING else (run.window(topic, *span),)
    for piece in pieces:
        array = piece.array
        mine = array["direction"] == schema.TX
        yield piece.time[mine], array[mine]

"""What went over a CAN bus: identifiers, rates, changes, losses, and what the frames say by a DBC."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from rtctl.errors import LogError
from rtctl.log import schema
from rtctl.log.read.run import Run
from rtctl.log.read.topic import Structured
from rtctl.log.view.export import frames
from rtctl.protocol.dbc import DBC
from rtctl.types import F64, I64, U8

COUNTER_AT = 8  # of the counter in a protected frame of 12 bytes

if TYPE_CHECKING:
    from cantools.database.can import Message
    from cantools.database.can import Signal as DbcSignal


class Signal(NamedTuple):
    """A signal over a whole log."""

    name: str
    unit: str
    smallest: float
    largest: float
    last: float
    choice: str  # the last value's name, '' for numbers


class Traffic(NamedTuple):
    """The frames of one identifier in one direction."""

    bus: str
    way: str  # rx | tx
    id: int
    name: str  # by the DBC, '' if it does not know the identifier
    frames: int
    length: int  # [bytes] of the last
    hz: float
    gap_max: float  # [s] longest time between two
    changes: int  # frames whose data differ from the one before
    lost: int  # by the holes in their counters; -1 where frames carry none
    errors: int  # error frames of the bus
    signals: tuple[Signal, ...]
    data: str  # of the last frame, hexadecimal


class _Sum:
    """What is known of one identifier so far."""

    def __init__(self) -> None:
        self.frames = self.changes = self.lost = self.errors = 0
        self.first = self.last = -1
        self.gap = 0
        self.tail = np.zeros(64, np.uint8)
        self.length = 0
        self.counter = -1
        self.low: F64 = np.zeros(0)
        self.high: F64 = np.zeros(0)
        self.values: F64 = np.zeros(0)


def traffic(run: Run, dbc: str = "", progress: Callable[[int], None] = lambda n: None) -> list[Traffic]:
    """Return the traffic of all buses, by bus, identifier and direction.

    dbc: text; the log's own attachment is used when it is empty. Raises LogError without a bus, or for a bad DBC.
    """
    messages = _messages(dbc or str(run.header.files.get(DBC, "")) if _has_header(run) else dbc)
    counted = _has_header(run) and "mit+e2e" in run.header.config
    sums: dict[tuple[str, int, int], _Sum] = {}
    done = 0
    for bus, time, array in frames(run):
        code = array["id"].astype(np.int64) << 1 | array["direction"]
        for value in np.unique(code).tolist():
            rows = code == value
            _add(sums.setdefault((bus, value >> 1, value & 1), _Sum()), time[rows], array[rows], counted, messages)
        done += len(array)
        progress(done)
    return [_row(key, s, counted, messages) for key, s in sorted(sums.items())]


def _has_header(run: Run) -> bool:
    try:
        return bool(run.header)
    except LogError:
        return False


def _messages(text: str) -> "dict[int, Message]":
    """Return a DBC's messages by identifier. Raises LogError when it is none."""
    if not text:
        return {}
    import cantools

    try:
        found = cantools.database.load_string(text, "dbc")
    except Exception as error:  # another program's parser: whatever it raises, it is the file's fault
        raise LogError(f"DBC: {str(error).splitlines()[0] if str(error) else type(error).__name__}") from None
    return {message.frame_id: message for message in getattr(found, "messages", ())}


def load_dbc(path: Path) -> str:
    """Return a DBC's text. Raises LogError."""
    try:
        return path.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise LogError(f"{path}: {error.strerror}") from None


def _add(s: _Sum, time: I64, array: Structured, counted: bool, messages: "Mapping[int, Message]") -> None:
    data = array["data"]
    before = s.tail[None, :] if s.frames else data[:1]
    s.changes += int((data != np.concatenate([before, data[:-1]])).any(axis=1).sum())
    start = time[:1] if s.last < 0 else np.array([s.last])
    s.gap = max(s.gap, int(np.diff(time, prepend=start).max()))
    s.first, s.last = (int(time[0]) if s.first < 0 else s.first), int(time[-1])
    s.frames, s.errors = s.frames + len(array), s.errors + int(array["is_error"].sum())
    s.tail, s.length = data[-1].copy(), int(array["dlc"][-1])
    if counted and s.length == 12:
        counter = data[:, COUNTER_AT].astype(np.int64)
        steps = np.diff(counter, prepend=(counter[0] - 1 if s.counter < 0 else s.counter)) % 256
        s.lost += int((steps - 1)[steps > 0].sum())
        s.counter = int(counter[-1])
    message = messages.get(int(array["id"][0]))
    if message is not None and message.length == s.length:
        _decode(s, data[:, : s.length], message)


def _decode(s: _Sum, data: U8, message: "Message") -> None:
    special = (data[:, :7] == 0xFF).all(axis=1)  # enable, disable and the like are no numbers
    if special.all():
        return
    bits = np.unpackbits(np.ascontiguousarray(data[~special]), axis=1)
    values = np.stack([_values(bits, signal) for signal in message.signals], axis=1)
    low, high = values.min(axis=0), values.max(axis=0)
    s.low = low if not len(s.low) else np.minimum(s.low, low)
    s.high = high if not len(s.high) else np.maximum(s.high, high)
    s.values = values[-1]


def _values(bits: U8, signal: "DbcSignal") -> F64:
    """Return a signal of every frame. bits: (N, 8 length), the most significant bit of each byte first."""
    if signal.byte_order == "big_endian":
        start = 8 * (signal.start // 8) + 7 - signal.start % 8
        places = list(range(start, start + signal.length))
    else:  # the least significant bit first, upwards through the bytes
        places = [8 * (b // 8) + 7 - b % 8 for b in range(signal.start, signal.start + signal.length)][::-1]
    weights = 2.0 ** np.arange(signal.length - 1, -1, -1)
    raw = bits[:, places] @ weights
    if signal.is_signed:
        raw = np.where(raw >= 2.0 ** (signal.length - 1), raw - 2.0**signal.length, raw)
    return np.asarray(raw * float(signal.scale) + float(signal.offset))


def _row(key: tuple[str, int, int], s: _Sum, counted: bool, messages: "Mapping[int, Message]") -> Traffic:
    bus, number, way = key
    message = messages.get(number)
    signals: tuple[Signal, ...] = ()
    if message is not None and len(s.values):
        signals = tuple(
            Signal(
                sig.name,
                sig.unit or "",
                float(s.low[i]),
                float(s.high[i]),
                float(s.values[i]),
                _choice(sig, s.values[i]),
            )
            for i, sig in enumerate(message.signals)
            if sig.name not in ("counter", "crc")
        )
    span = (s.last - s.first) / 1e9
    return Traffic(
        bus=bus,
        way="tx" if way == schema.TX else "rx",
        id=number,
        name=message.name if message is not None else "",
        frames=s.frames,
        length=s.length,
        hz=(s.frames - 1) / span if span > 0.0 else 0.0,
        gap_max=s.gap / 1e9,
        changes=s.changes,
        lost=s.lost if counted and s.length == 12 else -1,
        errors=s.errors,
        signals=signals,
        data=s.tail[: s.length].tobytes().hex(),
    )


def _choice(signal: "DbcSignal", value: float) -> str:
    found = signal.choices.get(round(value)) if signal.choices else None
    return str(found) if found is not None else ""

"""The messages of one topic, and their fields as arrays."""

import json
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import Any, NamedTuple, Self

import numpy as np
from mcap import records
from numpy.typing import NDArray

from rtctl.errors import LogError
from rtctl.log import limits, schema
from rtctl.log.mcap.walk import Source, rows_of
from rtctl.log.schema import Layout, can_layout, tick_layout
from rtctl.plain import Json
from rtctl.spell import nearest
from rtctl.types import I64, U8, Array

OBJECT = 64  # [bytes] that a message costs beside its own, once it is an object
STAMPS = 16  # [bytes] of a message's time and sequence number
Structured = NDArray[np.void]
CAN_ROW = np.dtype(  # of Topic.array for a bus
    [
        ("stamp_ns", "<u8"),
        ("id", "<u4"),
        ("dlc", "<u4"),
        ("direction", "u1"),  # schema.RX or TX
        ("is_extended", "?"),
        ("is_rtr", "?"),
        ("is_error", "?"),
        ("fd", "?"),
        ("brs", "?"),
        ("esi", "?"),
        ("data", "u1", (64,)),
    ]
)


class Part(NamedTuple):
    """A channel's messages in one chunk; equal-length columns."""

    data: Source
    at: I64  # where each message begins
    size: I64  # [bytes]
    time: I64  # [ns] log_time
    sequence: I64


Mapped = Callable[[Callable[[Part], Any]], list[Any]]  # applies a function to each part, gives the results in order


class Held:
    """Counts what is kept of a topic while it is read, so that no file makes a reader keep more than it may."""

    def __init__(self, name: str, most: int) -> None:
        self.name, self.most, self.size = name, most, 0

    def add(self, size: int) -> None:
        """Count `size` [bytes] more. Raises LogError when they are too many."""
        self.size += size
        if self.size > self.most:
            bound = f"more than {self.most >> 20} MiB at once; take a window of time, some fields, or pieces"
            raise LogError(f"{self.name}: {bound}")


class Topic:
    """The messages of one topic, in the order of the file; read when they are asked for.

    For /tick and /can/<bus> every field is an attribute, an array of one row a message: `log["/tick"].q` is (N, n)
    [rad]. `rtctl.log.read.fields.FIELDS` says what each is and in which unit; a bus has the fields of CAN_ROW.
    """

    def __init__(
        self,
        name: str,
        channel: records.Channel,
        schema_name: str,
        dtype: np.dtype[np.void] | None,
        source: Mapped,
        most: int = limits.HELD,
    ) -> None:
        self.name = name
        self.most = most  # [bytes] that are held at once
        self.encoding: str = channel.message_encoding
        self.schema = schema_name
        self.metadata: Mapping[str, str] = channel.metadata
        self.dtype = dtype  # of a tick
        self.source = source
        self.channel = channel
        self._stamps: tuple[I64, I64] | None = None  # log_time and sequence, when the messages have been read

    def __len__(self) -> int:
        return len(self.time)

    def __getattr__(self, field: str) -> Array:
        if field.startswith("_"):
            raise AttributeError(field)
        try:
            return self.field(field)
        except LogError as error:
            raise AttributeError(str(error)) from None

    def field(self, name: str) -> Array:
        """Return one field (N, ...); `time` here is the record's robot time [s], the attribute is log_time.

        Raises LogError when the topic has no such field.
        """
        known = self.fields
        if name not in known:
            raise LogError(f"{self.name}: got field {name}, wanted {nearest(name, known)}")
        if self.dtype is None:
            return np.ascontiguousarray(self.array[name])
        return self._ticks.field(name)

    @property
    def fields(self) -> tuple[str, ...]:
        """Return the names of the fields. Raises LogError for a topic that is not an array."""
        dtype = self.dtype if self.dtype is not None else CAN_ROW if self._is_can else None
        if dtype is None:
            raise LogError(f"{self.name}: {self.schema or self.encoding} is not an array; use .json or .payloads")
        return tuple(dtype.names or ())

    def load(self, *names: str) -> Self:
        """Read several fields in one pass, which each attribute would else take by itself; return the topic."""
        if self.dtype is not None:
            odd = [name for name in names if name not in self.fields]
            if odd:
                raise LogError(f"{self.name}: got field {odd[0]}, wanted {nearest(odd[0], self.fields)}")
            self._ticks.load(names)
        return self

    @property
    def _is_can(self) -> bool:
        return self.schema == "rtctl.CanFrame"

    @property
    def time(self) -> I64:
        """Return log_time (N,) [ns]."""
        if self._stamps is not None:
            return self._stamps[0]
        return self._ticks.times[0] if self.dtype is not None else self._heads[0]

    @property
    def sequence(self) -> I64:
        """Return the sequence numbers (N,)."""
        if self._stamps is not None:
            return self._stamps[1]
        return self._ticks.times[1] if self.dtype is not None else self._heads[1]

    @cached_property
    def _heads(self) -> tuple[I64, I64]:
        return _stamps(self.source(lambda part: (part.time, part.sequence)))

    @cached_property
    def payloads(self) -> list[bytes]:
        """Return the messages as they were written."""
        held = Held(self.name, self.most)

        def take(part: Part) -> list[bytes]:
            held.add(int(part.size.sum()) + OBJECT * len(part.size))
            return [part.data[a:b] for a, b in zip(part.at.tolist(), (part.at + part.size).tolist(), strict=True)]

        return [payload for payloads in self.source(take) for payload in payloads]

    @cached_property
    def array(self) -> Structured:
        """Return the messages as one structured array: of `Header.dtype` for /tick, CAN_ROW for a bus.

        Raises LogError for other topics, and when a message is not of the layout that the header describes.
        """
        _ = self.fields
        dtype, held = CAN_ROW if self.dtype is None else self.dtype, Held(self.name, self.most)
        layout = None if self.dtype is None else tick_layout(dtype)

        def take(part: Part) -> tuple[Structured, I64, I64]:
            held.add(dtype.itemsize * len(part.at))
            rows = _frames(self.name, part) if layout is None else _records(self.name, part, layout, dtype)
            return rows, part.time, part.sequence

        found = self.source(take)
        self._stamps = _stamps([(times, sequences) for _, times, sequences in found])
        return stacked([rows for rows, _, _ in found], dtype)

    @property
    def json(self) -> list[Json]:
        """Return the messages of a JSON topic; one that is not a JSON object becomes {"raw": text}."""
        return [_json(payload) for payload in self.payloads]

    @cached_property
    def _ticks(self) -> "_Ticks":
        return _Ticks(self.name, self.dtype if self.dtype is not None else np.dtype([]), self.source, self.most)


def _stamps(found: Sequence[tuple[I64, I64]]) -> tuple[I64, I64]:
    none = [np.zeros(0, np.int64)]
    return np.concatenate([f[0] for f in found] or none), np.concatenate([f[1] for f in found] or none)


class _Ticks:
    """The fields of constant-size messages: each read, by itself or with others, when it is first asked for."""

    def __init__(self, name: str, dtype: np.dtype[np.void], source: Mapped, most: int) -> None:
        self.name, self.source = name, source
        self._held = Held(name, most)
        self.layout = tick_layout(dtype)
        self._times: tuple[I64, I64] | None = None
        self._found: dict[str, Array] = {}

    def load(self, names: Sequence[str]) -> None:
        """Read fields that are not there yet in one pass over the file."""
        assert self.layout.wire.fields is not None
        kinds = {name: self.layout.wire.fields[name][:2] for name in names if name not in self._found}
        if not kinds and self._times is not None:
            return
        leads = [_lead(self.layout, at) for _, at in kinds.values()]
        template = self.layout.template
        width = sum(kind.itemsize for kind, _ in kinds.values()) + STAMPS

        def take(part: Part) -> tuple[I64, I64, list[U8]]:
            self._held.add(width * len(part.at))
            raw = _sized(self.name, part, self.layout)
            blocks = []
            for (kind, at), lead in zip(kinds.values(), leads, strict=True):
                block = rows_of(raw, part.at + (at - lead), lead + kind.itemsize)
                _check(self.name, block[:, :lead], template[at - lead : at])
                blocks.append(block[:, lead:])
            return part.time, part.sequence, blocks

        found = self.source(take)
        none = np.zeros(0, np.int64)
        if self._times is None:
            self._times = (
                np.concatenate([f[0] for f in found] or [none]),
                np.concatenate([f[1] for f in found] or [none]),
            )
        for i, (name, (kind, _)) in enumerate(kinds.items()):
            block = np.concatenate([f[2][i] for f in found] or [np.zeros((0, kind.itemsize), np.uint8)])
            self._found[name] = block.reshape(-1).view(kind.base).reshape(len(block), *kind.shape)

    @property
    def times(self) -> tuple[I64, I64]:
        """Return log_time [ns] and sequence numbers."""
        if self._times is None:
            self.load(())
        assert self._times is not None
        return self._times

    def field(self, name: str) -> Array:
        """Return one field (N, ...)."""
        self.load((name,))
        return self._found[name]


def _lead(layout: Layout, at: int) -> int:
    """Return how many bytes of tag and length stand right before the value at `at`."""
    tags = set(layout.tags.tolist())
    count = 0
    while at - count - 1 in tags:
        count += 1
    return count


def stacked(arrays: Sequence[Structured], dtype: np.dtype[np.void]) -> Structured:
    """Return contiguous arrays of one dtype as one; numpy would compare the dtypes field by field for each."""
    if len(arrays) == 1:
        return arrays[0]
    return np.concatenate([a.view(np.uint8) for a in arrays] or [np.zeros(0, np.uint8)]).view(dtype)


def _sized(name: str, part: Part, layout: Layout) -> U8:
    """Return the bytes that hold the part's messages, after comparing every message's size with the layout's."""
    if (part.size != len(layout.template)).any():
        raise LogError(f"{name}: messages are not of the {len(layout.template)} bytes that the log's header says")
    return np.frombuffer(part.data, np.uint8)


def _check(name: str, found: U8, wanted: U8) -> None:
    if (found != wanted).any():
        raise LogError(f"{name}: messages are not of the layout that the log's header says")


def _view(name: str, raw: U8, at: I64, layout: Layout) -> Structured:
    """Return constant-size messages as an array, after comparing every tag and length with the layout."""
    block = rows_of(raw, at, len(layout.template))
    _check(name, block[:, layout.tags], layout.template[layout.tags])
    return block.reshape(-1).view(layout.wire)


def _records(name: str, part: Part, layout: Layout, dtype: np.dtype[np.void]) -> Structured:
    wire = _view(name, _sized(name, part, layout), part.at, layout)
    array = np.empty(len(wire), dtype)
    for field in dtype.names or ():
        array[field] = wire[field]
    return array


def _frames(name: str, part: Part) -> Structured:
    array = np.zeros(len(part.at), CAN_ROW)
    raw = np.frombuffer(part.data, np.uint8)
    for size in np.unique(part.size).tolist():
        rows = np.flatnonzero(part.size == size)
        length = size - schema.CAN_DATA_AT
        if not 0 <= length <= 64:
            raise LogError(f"{name}: a message of {size} bytes is not a frame as this version writes it")
        wire = _view(name, raw, part.at[rows], can_layout(length))
        for field in CAN_ROW.names[:-1] if CAN_ROW.names else ():
            array[field][rows] = wire[field]
        array["data"][rows, :length] = wire["data"]
    return array


def _json(payload: bytes) -> Json:
    try:
        value = json.loads(payload)
    except (ValueError, RecursionError):
        value = None
    return value if isinstance(value, dict) else {"raw": payload.decode("utf-8", "replace")}

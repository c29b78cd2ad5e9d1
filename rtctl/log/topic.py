"""The messages of one topic, and their fields as arrays."""

import json
from collections.abc import Mapping
from functools import cached_property
from typing import Any

import numpy as np
from mcap import records

from rtctl.errors import LogError
from rtctl.log import schema
from rtctl.log.schema import Layout, can_layout, tick_layout
from rtctl.types import I64

Structured = np.ndarray[Any, np.dtype[np.void]]
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


class Topic:
    """The messages of one topic, in the order of the file.

    For /tick and /can/<bus> every field is an attribute: `log["/tick"].q` is (N, n) [rad] and so on, as
    control.record names them; a bus has the fields of CAN_ROW.
    """

    def __init__(self, name: str, channel: records.Channel, schema_name: str, dtype: np.dtype[np.void] | None) -> None:
        self.name = name
        self.encoding: str = channel.message_encoding
        self.schema = schema_name
        self.metadata: Mapping[str, str] = channel.metadata
        self.time: I64 = np.zeros(0, dtype=np.int64)  # (N,) log_time [ns]
        self.sequence: I64 = np.zeros(0, dtype=np.int64)  # (N,)
        self.payloads: list[bytes] = []  # (N,) as written
        self._dtype = dtype
        self._array: Structured | None = None

    def __len__(self) -> int:
        return len(self.payloads)

    def __getattr__(self, field: str) -> np.ndarray[Any, Any]:
        if field.startswith("_"):
            raise AttributeError(field)
        array = self.array if self._dtype is None else self._wire  # one field of a tick needs no copy of the others
        if field not in (array.dtype.names or ()):
            raise AttributeError(f"{self.name} has no field {field}; it has {', '.join(array.dtype.names or ())}")
        return np.ascontiguousarray(array[field])

    @property
    def array(self) -> Structured:
        """Return the messages as one structured array: of `Header.dtype` for /tick, CAN_ROW for a bus.

        Raises LogError for other topics, and when a message is not of the layout that the header describes.
        """
        if self._array is None:
            if self._dtype is not None:
                self._array = self._ticks(self._dtype)
            elif self.schema == "rtctl.CanFrame":
                self._array = self._frames()
            else:
                raise LogError(f"{self.name}: {self.schema or self.encoding} is not an array; use .json or .payloads")
        return self._array

    @property
    def json(self) -> list[dict[str, Any]]:
        """Return the messages of a JSON topic; one that is not a JSON object becomes {"raw": text}."""
        return [_json(payload) for payload in self.payloads]

    @cached_property
    def _wire(self) -> Structured:
        """Return the ticks where they are, between tags and lengths."""
        return _view(self.name, self.payloads, tick_layout(self._dtype or np.dtype([])))

    def _ticks(self, dtype: np.dtype[np.void]) -> Structured:
        wire = self._wire
        array = np.empty(len(wire), dtype)
        for field in dtype.names or ():
            array[field] = wire[field]
        return array

    def _frames(self) -> Structured:
        array = np.zeros(len(self.payloads), CAN_ROW)
        sizes = np.fromiter(map(len, self.payloads), np.int64, len(self.payloads))
        for size in np.unique(sizes).tolist():
            rows = np.flatnonzero(sizes == size)
            length = size - schema.CAN_DATA_AT
            if not 0 <= length <= 64:
                raise LogError(f"{self.name}: a message of {size} bytes is not a frame as this version writes it")
            wire = _view(self.name, [self.payloads[i] for i in rows], can_layout(length))
            for field in CAN_ROW.names[:-1] if CAN_ROW.names else ():
                array[field][rows] = wire[field]
            array["data"][rows, :length] = wire["data"]
        return array


def _json(payload: bytes) -> dict[str, Any]:
    try:
        value = json.loads(payload)
    except (ValueError, RecursionError):
        value = None
    return value if isinstance(value, dict) else {"raw": payload.decode("utf-8", "replace")}


def _view(name: str, payloads: list[bytes], layout: Layout) -> Structured:
    """Return constant-size messages as an array, after comparing every tag and length with the layout."""
    size = len(layout.template)
    if any(len(payload) != size for payload in payloads):
        raise LogError(f"{name}: messages are not of the {size} bytes that the log's header says")
    raw = np.frombuffer(b"".join(payloads), np.uint8).reshape(-1, size)
    if (raw[:, layout.tags] != layout.template[layout.tags]).any():
        raise LogError(f"{name}: messages are not of the layout that the log's header says")
    return raw.reshape(-1).view(layout.wire)

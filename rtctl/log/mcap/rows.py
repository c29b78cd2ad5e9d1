"""Message records as bytes, many of one kind at a time: a template of each, its fields written as columns."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rtctl.log.entry import Payload
from rtctl.log.schema import MESSAGE, Layout
from rtctl.types import I64, U8, U64

OP_MESSAGE = 5


class Encoded(NamedTuple):
    """Whole message records and where they are; columns of equal length, in the order of `data`."""

    data: bytes
    channel: I64
    sequence: I64
    time: U64  # log_time [ns]: all that a file may say; with signed ones beside it numpy would make floats of both
    offset: I64  # in data


def single(data: bytes, channel: int, sequence: int, time: int) -> Encoded:
    """Return one whole message record; time: log_time [ns]."""
    one = np.array([channel], np.int64), np.array([sequence], np.int64), np.array([time], np.uint64)
    return Encoded(data, *one, np.zeros(1, np.int64))


def nothing() -> Encoded:
    """Return no message."""
    none = np.zeros(0, np.int64)
    return Encoded(b"", none, none, none.astype(np.uint64), none)


class Rows(NamedTuple):
    """Template of a constant-size piece of one or two message records, and its parts."""

    template: U8
    dtype: np.dtype[np.void]


def rows_for(parts: Sequence[tuple[int, Layout]]) -> Rows:
    """Return the rows that hold one message of each (channel, layout), one behind the other."""
    fields: list[tuple[str, np.dtype[np.void]]] = []
    for number, (_, layout) in enumerate(parts):
        fields += [(f"head{number}", MESSAGE), (f"body{number}", layout.wire)]
    dtype = np.dtype(fields)
    assert dtype.fields is not None
    template = np.zeros(dtype.itemsize, np.uint8)
    row = template.view(dtype)
    for number, (channel, layout) in enumerate(parts):
        head = row[f"head{number}"]
        head["op"], head["channel"] = OP_MESSAGE, channel
        head["length"] = MESSAGE.itemsize - 9 + layout.wire.itemsize
        start = dtype.fields[f"body{number}"][1]
        template[start : start + layout.wire.itemsize] = layout.template
    return Rows(template, dtype)


def message(channel: int, sequence: int, time: int, data: bytes) -> bytes:
    """Return one message record."""
    head = np.zeros(1, MESSAGE)
    head["op"], head["length"], head["channel"] = OP_MESSAGE, MESSAGE.itemsize - 9 + len(data), channel
    head["sequence"], head["log"], head["publish"] = sequence & 0xFFFFFFFF, time, time
    return head.tobytes() + data


def copies(template: U8, n: int) -> U8:
    """Return n rows of the template, (n, len(template))."""
    block = np.empty((n, len(template)), np.uint8)
    block[:] = template
    return block


def stamped(head: NDArray[np.void], stamp: I64, sequence: I64) -> None:
    """Write log_time [ns] and sequence numbers into the heads of rows."""
    head["sequence"], head["log"], head["publish"] = sequence, stamp, stamp


def assembled(
    first: list[Encoded], pieces: list[Payload], columns: list[tuple[I64, int, I64, I64, int]], last: list[Encoded]
) -> Encoded:
    """Return everything as one block, its columns in the order of the bytes."""
    lead = b"".join(e.data for e in first)
    sizes = np.fromiter(map(len, pieces), np.int64, len(pieces))
    starts = np.cumsum(sizes) - sizes + len(lead)
    channel: list[I64] = []
    time: list[U64] = []
    sequence: list[I64] = []
    offset: list[I64] = []
    at = 0
    behind = len(lead) + int(sizes.sum())
    for k, e in enumerate([*first, *last]):
        if k == len(first):
            at = behind
        channel.append(e.channel)
        time.append(e.time)
        sequence.append(e.sequence)
        offset.append(e.offset + at)
        at += len(e.data)
    for rows, number, stamp, counted, within in columns:
        channel.append(np.full(len(rows), number, dtype=np.int64))
        time.append(stamp.astype(np.uint64))
        sequence.append(counted)
        offset.append(starts[rows] + within)
    if not channel:
        return nothing()
    offsets = np.concatenate(offset)
    order = np.argsort(offsets, kind="stable")
    return Encoded(
        lead + b"".join(pieces) + b"".join(e.data for e in last),
        np.concatenate(channel)[order],
        np.concatenate(sequence)[order],
        np.concatenate(time)[order],
        offsets[order],
    )

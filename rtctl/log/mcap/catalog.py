"""What is where in a log file: from its summary when it is whole, by walking it when it is not."""

import json
import struct
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from mcap import records
from mcap.opcode import Opcode

from rtctl.log.mcap.summary import END
from rtctl.log.mcap.walk import (
    I64_MAX,
    RECORD,
    Damaged,
    Source,
    chunk_head,
    has_magic,
    message_index,
    parsed,
    rows_of,
    walk,
)
from rtctl.types import I64, U64

FOOTER_SIZE = RECORD.size + 20 + 8
U64_MAX = (1 << 64) - 1
LOOKED_AT = 8  # chunks of a summary whose own records are compared with it
_CHUNK_INDEX = int(Opcode.CHUNK_INDEX)  # an Opcode takes ten times as long to compare
_INDEX_HEAD = np.dtype([("start", "<u8"), ("end", "<u8"), ("at", "<u8"), ("length", "<u8"), ("table", "<u4")])
_INDEX_ENTRY = np.dtype([("channel", "<u2"), ("offset", "<u8")])


class Chunks(NamedTuple):
    """The chunks of a file as columns: a long file has thousands, of which a window needs a few."""

    body: I64  # (N,) of the chunk's record
    end: I64
    start_time: U64  # (N,) [ns] log_time
    end_time: U64
    owner: I64  # (M,) of each message index record: its chunk, ascending
    channel: I64
    at: I64  # where the record begins

    def indices(self, channel: int) -> I64:
        """Return of each chunk where the channel's message index record begins; -1: no messages of it, 0: not known."""
        counts = np.bincount(self.owner, minlength=len(self.body))
        found: I64 = np.where(counts > 0, -1, 0)
        mine = self.channel == channel
        found[self.owner[mine]] = self.at[mine]
        return found

    def channels(self) -> list[I64]:
        """Return of each chunk the channels it has message index records of."""
        parts = np.split(self.channel, np.searchsorted(self.owner, np.arange(1, len(self.body))))
        return parts[: len(self.body)]


class Catalog(NamedTuple):
    """The contents of a file without its messages."""

    schemas: dict[int, records.Schema]
    channels: dict[int, records.Channel]
    metadata: list[tuple[str, dict[str, str]]]
    attachments: dict[str, tuple[int, int]]  # name -> body of the record
    chunks: Chunks
    loose: list[tuple[int, int]]  # bodies of messages outside any chunk
    counts: dict[str, tuple[int, int, int]]  # topic -> messages, first and last sequence number; {} when not known
    span: tuple[int, int]  # [ns] log_time of first and last message; (0, 0) when not known
    complete: bool  # closed by its writer
    good: int  # the offset behind the last whole record of the data section


def _empty(complete: bool, good: int) -> Catalog:
    return Catalog({}, {}, [], {}, _chunks([], [], []), [], {}, (0, 0), complete, good)


def _chunks(
    places: Sequence[tuple[int, int]], times: Sequence[tuple[int, int]], indices: Sequence[tuple[int, int, int]]
) -> Chunks:
    """Return chunks of (body, end), (first, last log_time) and message index records of (chunk, channel, place)."""
    place, time = np.array(places, np.int64).reshape(-1, 2), np.array(times, np.uint64).reshape(-1, 2)
    index = np.array(indices, np.int64).reshape(-1, 3)
    return Chunks(*place.T, *time.T, *index.T)


def catalog(data: Source) -> Catalog:
    """Return the catalog of a file's bytes.

    Raises Damaged when they do not start as an MCAP file does.
    """
    start, end = has_magic(data, len(data))
    if not start:
        raise Damaged("a file that is no MCAP log: it does not start with the magic bytes")
    if end:
        found = _from_summary(data)
        if found is not None:
            return found
    return _from_walk(data)


def _from_summary(data: Source) -> Catalog | None:
    """Return the catalog that the summary gives, or None when there is none, or it cannot be believed."""
    at = len(data) - FOOTER_SIZE
    if at < 8:
        return None
    opcode, length = RECORD.unpack_from(data, at)
    if opcode != Opcode.FOOTER or length != 20:
        return None
    (start,) = struct.unpack_from("<Q", data, at + RECORD.size)
    if not 8 <= start < at:
        return None
    found = _empty(True, start)
    span = found.span
    seen_statistics, indices = False, list[int]()  # of chunks: start and end of the body in turn
    try:
        for opcode, body, end in walk(data, start, at):
            if opcode == _CHUNK_INDEX:  # nearly all of them
                indices += (body, end)
            elif opcode == Opcode.STATISTICS:
                statistics = parsed(records.Statistics.read, data, body, end)
                span, seen_statistics = (statistics.message_start_time, statistics.message_end_time), True
            elif opcode == Opcode.ATTACHMENT_INDEX:
                index = parsed(records.AttachmentIndex.read, data, body, end)
                found.attachments[index.name] = (index.offset + RECORD.size, index.offset + index.length)
            elif opcode == Opcode.METADATA_INDEX:
                place = parsed(records.MetadataIndex.read, data, body, end)
                _metadata(found, data, place.offset + RECORD.size, place.offset + place.length)
            else:
                _describe(found, data, opcode, body, end)
        chunks = _chunk_indices(data, indices)
    except (Damaged, struct.error):
        return None
    if not seen_statistics or not found.channels or (not indices and span != (0, 0)):
        return None  # another writer's file without indices, or loose messages: walk it
    return found._replace(span=span, chunks=chunks)


def _chunk_indices(data: Source, places: list[int]) -> Chunks:
    """Return the chunks that the index records named by `places`, (start, end) of each body in turn, point at.

    Some of the chunks' own records are looked at: a summary of another file is not believed. Looking at each would
    touch a page of the file for every chunk. Raises Damaged.
    """
    if not places:
        return _chunks([], [], [])
    raw = np.frombuffer(data, np.uint8)
    place = np.array(places, np.int64).reshape(-1, 2)
    space = place[:, 1] - place[:, 0] - _INDEX_HEAD.itemsize
    if (space < 0).any():
        raise Damaged("chunk index: too short")
    head = rows_of(raw, place[:, 0], _INDEX_HEAD.itemsize).view(_INDEX_HEAD).reshape(-1)
    count = head["table"].astype(np.int64) // _INDEX_ENTRY.itemsize
    if (_INDEX_ENTRY.itemsize * count > space).any():
        raise Damaged("chunk index: wrong length")
    at, length = head["at"], head["length"]
    if (at > len(data)).any() or (length > len(data) - at).any():
        raise Damaged("chunk index: points behind the file")
    chunks = np.arange(len(place))
    owner = np.repeat(chunks, count)
    within = np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count)
    rows = place[owner, 0] + _INDEX_HEAD.itemsize + _INDEX_ENTRY.itemsize * within
    table = rows_of(raw, rows, _INDEX_ENTRY.itemsize).view(_INDEX_ENTRY).reshape(-1)
    body, end = at.astype(np.int64) + RECORD.size, (at + length).astype(np.int64)
    for k in np.unique(np.linspace(0, len(chunks) - 1, LOOKED_AT + 1).astype(int)).tolist():
        opcode, inner = RECORD.unpack_from(data, int(at[k])) if at[k] <= len(data) - RECORD.size else (0, 0)
        if opcode != Opcode.CHUNK or int(body[k]) + inner != int(end[k]):
            raise Damaged("chunk index: no chunk where it points")
    indices = np.minimum(table["offset"], np.uint64(I64_MAX)).astype(np.int64)
    return Chunks(body, end, head["start"], head["end"], owner, table["channel"].astype(np.int64), indices)


def _from_walk(data: Source) -> Catalog:
    found = _empty(False, 8)
    good, complete = 8, False
    places, times = list[tuple[int, int]](), list[tuple[int, int]]()
    indices = list[tuple[int, int, int]]()
    for opcode, body, end in walk(data, 8, len(data)):
        try:
            if opcode in (Opcode.DATA_END, Opcode.FOOTER):
                complete = True
                break
            if opcode == Opcode.CHUNK:
                head = chunk_head(data, body, end)
                places.append((body, end))
                times.append((head.start, head.end))
            elif opcode == Opcode.MESSAGE_INDEX:
                channel, _ = message_index(data, body, end)
                if places:
                    indices.append((len(places) - 1, channel, body - RECORD.size))
            elif opcode == Opcode.MESSAGE:
                found.loose.append((body, end))
            elif opcode == Opcode.ATTACHMENT:
                found.attachments[parsed(records.Attachment.read, data, body, end).name] = (body, end)
            elif opcode == Opcode.METADATA:
                _metadata(found, data, body, end)
            else:
                _describe(found, data, opcode, body, end)
        except Damaged:  # it is known where the next one begins
            if opcode == Opcode.CHUNK:  # counted as one that cannot be read, wherever somebody looks
                places.append((body, end))
                times.append((0, U64_MAX))
        good = end
    if not complete:  # the cut may have gone through the last chunk's indices: that one is walked
        indices = [index for index in indices if index[0] != len(places) - 1]
    return found._replace(complete=complete, good=good, chunks=_chunks(places, times, indices))


def _describe(found: Catalog, data: Source, opcode: int, body: int, end: int) -> None:
    if opcode == Opcode.SCHEMA:
        schema = parsed(records.Schema.read, data, body, end)
        found.schemas[schema.id] = schema
    elif opcode == Opcode.CHANNEL:
        channel = parsed(records.Channel.read, data, body, end)
        found.channels[channel.id] = channel


def _metadata(found: Catalog, data: Source, body: int, end: int) -> None:
    entry = parsed(records.Metadata.read, data, body, end)
    found.metadata.append((entry.name, entry.metadata))
    if entry.name == END:
        try:
            rows = {topic: json.loads(row) for topic, row in entry.metadata.items()}
            found.counts.update({topic: (int(r[0]), int(r[1]), int(r[2])) for topic, r in rows.items()})
        except (ValueError, TypeError, IndexError, KeyError) as error:
            raise Damaged(f"metadata {END}: {error}") from None


def describe_chunk(found: Catalog, records_of_chunk: bytes) -> None:
    """Add the schemas and channels that another writer put inside a chunk."""
    for opcode, body, end in walk(records_of_chunk, 0, len(records_of_chunk)):
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            _describe(found, records_of_chunk, opcode, body, end)


def attachment(data: Source, place: tuple[int, int]) -> records.Attachment:
    """Return the attachment record at a place.

    Raises Damaged.
    """
    found: records.Attachment = parsed(records.Attachment.read, data, *place)
    return found

"""What is where in a log file: from its summary when it is whole, by walking it when it is not."""

import io
import json
import struct
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, TypeVar

import numpy as np
from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode

from rtctl.log.summary import END
from rtctl.log.walk import RECORD, Damaged, Source, chunk_head, has_magic, message_index, rows_of, walk

T = TypeVar("T")
FOOTER_SIZE = RECORD.size + 20 + 8
LOOKED_AT = 8  # chunks of a summary whose own records are compared with it
_INDEX_HEAD = np.dtype([("start", "<u8"), ("end", "<u8"), ("at", "<u8"), ("length", "<u8"), ("table", "<u4")])
_INDEX_ENTRY = np.dtype([("channel", "<u2"), ("offset", "<u8")])


class ChunkRef(NamedTuple):
    """A chunk's place: the body of its record, and those of its message indices by channel."""

    body: int
    end: int
    start_time: int  # [ns] log_time
    end_time: int
    indices: Mapping[int, int]  # channel -> offset of its message index record; empty: walk the chunk


class Catalog(NamedTuple):
    """The contents of a file without its messages."""

    schemas: dict[int, records.Schema]
    channels: dict[int, records.Channel]
    metadata: list[tuple[str, dict[str, str]]]
    attachments: dict[str, tuple[int, int]]  # name -> body of the record
    chunks: list[ChunkRef]
    loose: list[tuple[int, int]]  # bodies of messages outside any chunk
    counts: dict[str, tuple[int, int, int]]  # topic -> messages, first and last sequence number; {} when not known
    span: tuple[int, int]  # [ns] log_time of first and last message; (0, 0) when not known
    complete: bool  # closed by its writer
    good: int  # the offset behind the last whole record of the data section


def _empty(complete: bool, good: int) -> Catalog:
    return Catalog({}, {}, [], {}, [], [], {}, (0, 0), complete, good)


def parsed(read: Callable[[ReadDataStream], T], data: Source, body: int, end: int) -> T:
    """Return the record whose body is [body, end).

    Raises Damaged.
    """
    try:
        return read(ReadDataStream(io.BytesIO(data[body:end])))
    except (McapError, struct.error, ValueError, OverflowError, MemoryError) as error:
        raise Damaged(f"record at {body}: {error}") from None


def catalog(data: Source) -> Catalog:
    """Return the catalog of a file's bytes.

    Raises Damaged when they do not start as an MCAP file does.
    """
    start, end = has_magic(data, len(data))
    if not start:
        raise Damaged("not an MCAP file: it does not start with the magic bytes")
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
    seen_statistics, indices = False, list[tuple[int, int]]()
    try:
        for opcode, body, end in walk(data, start, at):
            if opcode == Opcode.STATISTICS:
                statistics = parsed(records.Statistics.read, data, body, end)
                span, seen_statistics = (statistics.message_start_time, statistics.message_end_time), True
            elif opcode == Opcode.CHUNK_INDEX:
                indices.append((body, end))
            elif opcode == Opcode.ATTACHMENT_INDEX:
                index = parsed(records.AttachmentIndex.read, data, body, end)
                found.attachments[index.name] = (index.offset + RECORD.size, index.offset + index.length)
            elif opcode == Opcode.METADATA_INDEX:
                place = parsed(records.MetadataIndex.read, data, body, end)
                _metadata(found, data, place.offset + RECORD.size, place.offset + place.length)
            else:
                _describe(found, data, opcode, body, end)
        found.chunks.extend(_chunk_indices(data, indices))
    except (Damaged, struct.error):
        return None
    if not seen_statistics or not found.channels or (not found.chunks and span != (0, 0)):
        return None  # another writer's file without indices, or loose messages: walk it
    return found._replace(span=span)


def _chunk_indices(data: Source, places: list[tuple[int, int]]) -> list[ChunkRef]:
    """Return the chunks that the index records at `places` name; of a long file there are thousands, so in bulk.

    Some of the chunks' own records are looked at: a summary of another file is not believed. Looking at each would
    touch a page of the file for every chunk.
    """
    sizes = np.array([end - body for body, end in places], np.int64)
    bodies = np.array([body for body, _ in places], np.int64)
    refs: dict[int, ChunkRef] = {}
    raw = np.frombuffer(data, np.uint8)
    for size in np.unique(sizes).tolist():
        mine = bodies[sizes == size]
        if size < _INDEX_HEAD.itemsize:
            raise Damaged("chunk index: too short")
        head = rows_of(raw, mine, _INDEX_HEAD.itemsize).view(_INDEX_HEAD).reshape(-1)
        for count in np.unique(head["table"] // 10).tolist():
            chosen = mine[head["table"] // 10 == count]
            rows = head[head["table"] // 10 == count]
            if _INDEX_HEAD.itemsize + 10 * count > size:
                raise Damaged("chunk index: wrong length")
            table = (
                rows_of(raw, chosen + _INDEX_HEAD.itemsize, 10 * count).view(_INDEX_ENTRY).reshape(len(chosen), count)
            )
            for body, row, ids, offsets in zip(
                chosen.tolist(), rows.tolist(), table["channel"].tolist(), table["offset"].tolist(), strict=True
            ):
                start, end, at, length, _ = row
                refs[body] = ChunkRef(at + RECORD.size, at + length, start, end, dict(zip(ids, offsets, strict=True)))
    found = [refs[body] for body in bodies.tolist()]
    for k in range(LOOKED_AT + 1) if found else ():
        ref = found[k * (len(found) - 1) // LOOKED_AT]
        at = ref.body - RECORD.size
        opcode, inner = RECORD.unpack_from(data, at) if 0 <= at <= len(data) - RECORD.size else (0, 0)
        if opcode != Opcode.CHUNK or ref.body + inner != ref.end or ref.end > len(data):
            raise Damaged("chunk index: no chunk where it points")
    return found


def _from_walk(data: Source) -> Catalog:
    found = _empty(False, 8)
    good, complete = 8, False
    indices: dict[int, int] = {}
    for opcode, body, end in walk(data, 8, len(data)):
        try:
            if opcode in (Opcode.DATA_END, Opcode.FOOTER):
                complete = True
                break
            if opcode == Opcode.CHUNK:
                head = chunk_head(data, body, end)
                indices = {}
                found.chunks.append(ChunkRef(body, end, head.start, head.end, indices))
            elif opcode == Opcode.MESSAGE_INDEX:
                channel, _ = message_index(data, body, end)
                indices[channel] = body - RECORD.size
            elif opcode == Opcode.MESSAGE:
                found.loose.append((body, end))
            elif opcode == Opcode.ATTACHMENT:
                found.attachments[parsed(records.Attachment.read, data, body, end).name] = (body, end)
            elif opcode == Opcode.METADATA:
                _metadata(found, data, body, end)
            else:
                _describe(found, data, opcode, body, end)
        except Damaged:
            break
        good = end
    if found.chunks and not complete:
        # the cut may have gone through the last chunk's indices: that one is walked
        found.chunks[-1] = found.chunks[-1]._replace(indices={})
    return found._replace(complete=complete, good=good)


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


def attachment(data: Source, place: tuple[int, int]) -> Any:
    """Return the attachment record at a place.

    Raises Damaged.
    """
    return parsed(records.Attachment.read, data, *place)

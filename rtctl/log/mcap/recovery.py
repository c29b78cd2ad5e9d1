"""Making a file whole that was cut off: keep every whole chunk, write the end that its writer could not."""

import json
import os
from pathlib import Path
from typing import NamedTuple

import numpy as np
from mcap import records
from mcap.opcode import Opcode

from rtctl.errors import LogError
from rtctl.log import schema
from rtctl.log.mcap.catalog import attachment, catalog
from rtctl.log.mcap.names import OPEN, logs_in
from rtctl.log.mcap.rows import Encoded, message, nothing, single
from rtctl.log.mcap.segment import Segment, locked, settle
from rtctl.log.mcap.summary import END, Summary, message_indices
from rtctl.log.mcap.walk import (
    MESSAGE,
    RECORD,
    Damaged,
    chunk_data,
    chunk_head,
    chunk_messages,
    has_magic,
    message_index,
    parsed,
    walk,
)
from rtctl.plain import Json

BAD = ".bad"  # suffix of a file of which nothing can be used


class Recovery(NamedTuple):
    """What became of a file."""

    path: Path  # its name now
    messages: int  # that were in it
    lost_bytes: int  # cut off behind the last whole chunk
    damaged: int  # chunks in the middle that cannot be read
    entries: int  # number of the last ring entry in it; 0 when it does not say


class _Scan(NamedTuple):
    summary: Summary
    good: int  # bytes to keep
    indices: bytes  # message indices that the last chunk lacks
    damaged: int
    entries: int
    whole: bool  # there is nothing to do but rename


def recover(path: Path, content: Json | None = None) -> Recovery:
    """Close a `.open` file in place and give it its name.

    content: of the /log/sentinel that says why it ends.
    Raises LogError when the file is being written by somebody, OSError when the disk does not take its end.
    """
    if path.suffix != OPEN:
        raise LogError(f"{path}: wanted a file ending in {OPEN}")
    target = path.with_name(path.name.removesuffix(OPEN))
    file = os.open(path, os.O_RDWR | os.O_CLOEXEC)
    if not locked(file):
        os.close(file)
        raise LogError(f"{path}: is being written")
    data = path.read_bytes()
    if not has_magic(data, len(data))[0]:
        target = path.with_name(target.name + BAD)
        settle(path, target)
        os.close(file)
        return Recovery(target, 0, len(data), 0, 0)
    scan = _scan(data)
    if scan.whole:
        settle(path, target)
        os.close(file)
        return Recovery(target, scan.summary.messages, 0, scan.damaged, scan.entries)
    lost, kept = len(data) - scan.good, scan.summary.messages
    segment = Segment(target, file, scan.summary, scan.good)
    try:
        os.ftruncate(file, scan.good)
        os.lseek(file, scan.good, os.SEEK_SET)
        segment.write(scan.indices)
        segment.add(sentinel(scan.summary, {**(content or {"reason": "cut off"}), "lost_bytes": lost}))
        segment.end()
        _verified(path)
    except (OSError, LogError):
        segment.close()
        raise
    settle(path, target)
    segment.close()
    return Recovery(target, kept, lost, scan.damaged, scan.entries)


def _verified(path: Path) -> None:
    """Raise LogError unless a file is read as one that its writer has closed."""
    data = path.read_bytes()
    try:
        complete = catalog(data).complete
    except Damaged as error:
        raise LogError(f"{path}: {error}") from None
    if not complete:
        raise LogError(f"{path}: is not whole after recovery")


def entries_of(path: Path) -> int:
    """Return the number of the last ring entry in a closed file; 0 when it does not say, or cannot be read."""
    try:
        data = path.read_bytes()
        return _scan(data).entries if has_magic(data, len(data))[0] else 0
    except OSError:
        return 0


def drop_last_chunk(path: Path) -> bool:
    """Cut the last chunk off a `.open` file, to make room for its end; False when there is none left."""
    try:
        data = path.read_bytes()
        chunks = [body - RECORD.size for opcode, body, _ in walk(data, 8, len(data)) if opcode == Opcode.CHUNK]
        if chunks:
            os.truncate(path, chunks[-1])
    except OSError:
        return False
    return bool(chunks)


def sentinel(summary: Summary, content: Json) -> Encoded:
    """Return the sentinel for the file's last moment; nothing when the file has no channel for it."""
    for channel in summary.channels:
        if channel.topic == schema.SENTINEL:
            sequence = summary.last.get(channel.id, 0) + 1
            data = message(channel.id, sequence, summary.end, json.dumps(content).encode())
            return single(data, channel.id, sequence, summary.end)
    return nothing()


def _scan(data: bytes) -> _Scan:
    """Walk a file's data section and describe what of it is whole."""
    summary = Summary()
    good, damaged, entries, ended = 8, 0, 0, False
    last: tuple[int, bytes, dict[int, int]] | None = None  # of the last chunk: its end, and what its index should be
    for opcode, body, end in walk(data, 8, len(data)):
        try:
            if opcode in (Opcode.DATA_END, Opcode.FOOTER):
                ended = True
                break
            if opcode == Opcode.CHUNK:
                found = _chunk(summary, data, body, end)
                last = (end, *found[:2]) if found else None
                damaged += found is None
                entries = max(entries, found[2] if found else 0)
            elif opcode == Opcode.MESSAGE_INDEX:
                channel, _ = message_index(data, body, end)
                if last and summary.chunks:
                    summary.chunks[-1].message_index_offsets[channel] = body - RECORD.size
                    summary.chunks[-1].message_index_length += end - body + RECORD.size
            elif not _other(summary, data, opcode, body, end):
                break
        except Damaged:
            break
        good = end
    whole = ended and has_magic(data, len(data))[1]
    indices = b""
    if not whole and last and len(summary.chunks[-1].message_index_offsets) != len(last[2]):
        good, indices, starts = last  # cut off among the last chunk's indices: write them again
        summary.chunks[-1].message_index_offsets = {channel: good + at for channel, at in starts.items()}
        summary.chunks[-1].message_index_length = len(indices)
    return _Scan(summary, good, indices, damaged, entries, whole)


def _chunk(summary: Summary, data: bytes, body: int, end: int) -> tuple[bytes, dict[int, int], int] | None:
    """Count a chunk; return its message indices, their places and the ring position in it; None: it is damaged."""
    try:
        head = chunk_head(data, body, end)
        content = chunk_data(data, head)
    except Damaged:
        return None
    messages = chunk_messages(content)
    if len(messages.channel):
        summary.add_messages(messages.channel, messages.sequence, messages.time)
    summary.chunks.append(
        records.ChunkIndex(
            chunk_length=end - body + RECORD.size,
            chunk_start_offset=body - RECORD.size,
            compression=head.compression,
            compressed_size=head.data_end - head.data_at,
            message_end_time=head.end,
            message_index_length=0,
            message_index_offsets={},
            message_start_time=head.start,
            uncompressed_size=head.size,
        )
    )
    position = [c.id for c in summary.channels if c.topic == schema.POSITION]
    entries = 0
    for index in np.flatnonzero(np.isin(messages.channel, position)).tolist():
        start = int(messages.offset[index]) + RECORD.size + MESSAGE.size
        entries = max(entries, _entries(content[start : start + int(messages.size[index])]))
    return *message_indices(messages.channel, messages.time, messages.offset), entries


def _entries(payload: bytes) -> int:
    try:
        return int(json.loads(payload)["entries"])
    except (ValueError, TypeError, KeyError):
        return 0


def _other(summary: Summary, data: bytes, opcode: int, body: int, end: int) -> bool:
    """Take note of a record that is not about messages; False when the file's end begins with it."""
    if opcode == Opcode.SCHEMA:
        summary.schemas.append(parsed(records.Schema.read, data, body, end))
    elif opcode == Opcode.CHANNEL:
        summary.channels.append(parsed(records.Channel.read, data, body, end))
    elif opcode == Opcode.METADATA:
        name = parsed(records.Metadata.read, data, body, end).name
        if name == END:
            return False
        at, length = body - RECORD.size, end - body + RECORD.size
        summary.metadata.append(records.MetadataIndex(offset=at, length=length, name=name))
    elif opcode == Opcode.ATTACHMENT:
        found = attachment(data, (body, end))
        at, length = body - RECORD.size, end - body + RECORD.size
        summary.attachments.append(
            records.AttachmentIndex(
                offset=at,
                length=length,
                log_time=found.log_time,
                create_time=found.create_time,
                data_size=len(found.data),
                name=found.name,
                media_type=found.media_type,
            )
        )
    return True


def recover_folder(folder: Path) -> list[Recovery]:
    """Recover every `.open` file of a folder that nobody is writing."""
    done = []
    for path in [path for path in logs_in(folder) if path.suffix == OPEN]:
        try:
            done.append(recover(path))
        except (LogError, OSError):  # in use, gone meanwhile, or no room: the next start tries again
            continue
    return done

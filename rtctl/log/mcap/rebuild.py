"""A damaged file copied into a whole one: whatever can be read of it, with indices and an end made anew."""

import struct
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import zstandard
from isal import isal_zlib
from mcap import records
from mcap.opcode import Opcode

from rtctl.log.mcap.recovery import sentinel
from rtctl.log.mcap.rows import Encoded, single
from rtctl.log.mcap.segment import CHUNK_BYTES, Chunk, Segment
from rtctl.log.mcap.summary import END, MAGIC, packed
from rtctl.log.mcap.walk import (
    CHUNK,
    MESSAGE,
    RECORD,
    Damaged,
    Messages,
    Source,
    chunk_data,
    chunk_head,
    chunk_messages,
    parsed,
    walk,
)
from rtctl.plain import Json
from rtctl.types import I64

MARKS = (b"\x04\0\0\0zstd", b"\x03\0\0\0lz4")  # in a chunk's head: where one may begin again behind damage
_ENDS = (Opcode.DATA_END, Opcode.FOOTER)


class Rebuilt(NamedTuple):
    """What came over."""

    messages: int
    lost_bytes: int  # that are no records
    damaged: int  # records that say what cannot be
    written: int  # messages of the copy: those, and the sentinel


def rebuild(data: Source, segment: Segment, content: Json) -> Rebuilt:
    """Copy what can be read of a file's bytes into an empty segment, and end it; content: of its sentinel if cut off.

    Raises Damaged when there is nothing to copy, OSError when the disk does not take it.
    """
    copy = _Copy(data, segment)
    segment.write(MAGIC + _header(data))
    for opcode, body, end in copy.records():
        try:
            copy.record(opcode, body, end)
        except Damaged:
            copy.damaged += 1
    segment.flush()
    messages = segment.summary.messages
    if not messages and not copy.others:
        raise Damaged("nothing in it can be used")
    if not copy.ended or copy.lost or copy.damaged:
        segment.add(sentinel(segment.summary, {**content, "lost_bytes": copy.lost}))
    segment.end()
    return Rebuilt(messages, copy.lost, copy.damaged, segment.summary.messages)


def _header(data: Source) -> bytes:
    for opcode, body, end in walk(data, 8, len(data)):
        if opcode == Opcode.HEADER:
            try:
                parsed(records.Header.read, data, body, end)
                return bytes(data[body - RECORD.size : end])
            except Damaged:
                break
        break
    return packed(records.Header(profile="", library=""))


class _Copy:
    """The way of the records from one file to the other."""

    def __init__(self, data: Source, segment: Segment) -> None:
        self.data, self.segment, self.summary = data, segment, segment.summary
        self.lost = self.damaged = 0
        self.others = False  # anything but messages came over, or the file is whole and holds nothing
        self.ended = False
        self._schemas: dict[int, records.Schema] = {}
        self._channels: dict[int, records.Channel] = {}

    def records(self) -> Iterator[tuple[int, int, int]]:
        """Yield (opcode, body, end) of the data section's records; behind damage, from the next whole chunk on."""
        at = 8
        while at < len(self.data):
            for opcode, body, end in walk(self.data, at, len(self.data)):
                if opcode in _ENDS:
                    self.ended = self.others = True
                    return
                yield opcode, body, end
                at = end
            behind = self._next_chunk(at + 1)
            self.lost += behind - at
            at = behind

    def _next_chunk(self, at: int) -> int:
        """Return where the next chunk begins that can be read, at or behind `at`; the file's end when none does."""
        size = len(self.data)
        lead = RECORD.size + CHUNK.size - 4  # bytes before the length of the compression's name
        place = at + lead
        while True:
            places = [found for found in (self.data.find(mark, place) for mark in MARKS) if found >= 0]
            if not places:
                return size
            start = min(places) - lead
            opcode, length = RECORD.unpack_from(self.data, start)
            body = start + RECORD.size
            if opcode == Opcode.CHUNK and body + length <= size:
                try:
                    chunk_data(self.data, chunk_head(self.data, body, body + length))
                    return start
                except Damaged:
                    pass
            place = min(places) + 1

    def record(self, opcode: int, body: int, end: int) -> None:
        """Copy one record. Raises Damaged when it cannot be."""
        if opcode == Opcode.SCHEMA:
            self._schema(self.data, body, end)
        elif opcode == Opcode.CHANNEL:
            self._channel(self.data, body, end)
        elif opcode == Opcode.MESSAGE:
            self._message(body, end)
        elif opcode == Opcode.CHUNK:
            self._chunk(body, end)
        elif opcode == Opcode.ATTACHMENT:
            self._attachment(body, end)
        elif opcode == Opcode.METADATA:
            found = parsed(records.Metadata.read, self.data, body, end)
            if found.name != END:  # that one is made anew
                self.segment.write(self.summary.add_metadata(self.segment.size, found.name, found.metadata))
                self.others = True

    def _schema(self, data: Source, body: int, end: int) -> None:
        found = parsed(records.Schema.read, data, body, end)
        if found.id == 0 or self._schemas.get(found.id, found) != found:
            raise Damaged("schema: an identifier that is not its own")
        if found.id not in self._schemas:
            self._schemas[found.id] = found
            self.summary.schemas.append(found)
            self.segment.write(packed(found))
            self.others = True

    def _channel(self, data: Source, body: int, end: int) -> None:
        found = parsed(records.Channel.read, data, body, end)
        known = self._channels.get(found.id)
        lacks = found.schema_id != 0 and found.schema_id not in self._schemas
        kept = replace(found, schema_id=0) if lacks else found
        if known is not None and known != kept:
            raise Damaged("channel: an identifier that is not its own")
        if known is None:
            self._channels[found.id] = kept
            self.summary.channels.append(kept)
            self.segment.write(packed(kept))
            self.others = True
        if lacks:
            raise Damaged("channel: its schema is not there")

    def _message(self, body: int, end: int) -> None:
        if end - body < MESSAGE.size:
            raise Damaged("message: too short")
        channel, sequence, time, _ = MESSAGE.unpack_from(self.data, body)
        if channel not in self._channels:
            raise Damaged("message: of no channel")
        self._add(single(bytes(self.data[body - RECORD.size : end]), channel, sequence, time))

    def _add(self, encoded: Encoded) -> None:
        self.segment.add(encoded)
        if self.segment.pending >= CHUNK_BYTES:
            self.segment.flush()

    def _chunk(self, body: int, end: int) -> None:
        head = chunk_head(self.data, body, end)
        content = chunk_data(self.data, head)
        whole = self._describe(content)
        found = chunk_messages(content)
        known = np.isin(found.channel, list(self._channels))
        raw = bytes(self.data[head.data_at : head.data_end])
        single = head.compression == "" or (
            head.compression == "zstd" and zstandard.frame_content_size(raw) == head.size
        )
        if whole and known.all() and single and len(found.channel):
            self.segment.flush()
            chunk = Chunk(head.compression, head.size, head.crc, raw)
            self.segment.add_chunk(chunk, found.channel, found.sequence, found.stamp, found.offset)
            return
        self._again(content, found, np.flatnonzero(known))
        if not (whole and known.all()):
            raise Damaged("chunk: some of its records")

    def _describe(self, content: bytes) -> bool:
        """Take note of the schemas and channels in a chunk; return whether all of it is records that can be."""
        good, last = True, 0
        for opcode, body, end in walk(content, 0, len(content)):
            last = end
            try:
                if opcode == Opcode.SCHEMA:
                    self._schema(content, body, end)
                elif opcode == Opcode.CHANNEL:
                    self._channel(content, body, end)
                elif opcode == Opcode.MESSAGE and end - body < MESSAGE.size:
                    good = False
            except Damaged:
                good = False
        return good and last == len(content)

    def _again(self, content: bytes, found: Messages, rows: I64) -> None:
        """Put messages of a chunk into chunks of our own."""
        for k in rows.tolist():
            at = int(found.offset[k])
            raw = content[at : at + RECORD.size + MESSAGE.size + int(found.size[k])]
            self._add(single(raw, int(found.channel[k]), int(found.sequence[k]), int(found.stamp[k])))

    def _attachment(self, body: int, end: int) -> None:
        found = parsed(records.Attachment.read, self.data, body, end)
        length = 16 + 4 + len(found.name.encode()) + 4 + len(found.media_type.encode()) + 8 + len(found.data)
        if body + length + 4 > end:
            raise Damaged("attachment: too short")
        (crc,) = struct.unpack_from("<I", self.data, body + length)
        if crc and isal_zlib.crc32(self.data[body : body + length]) != crc:
            raise Damaged("attachment: its checksum differs")
        self.segment.write(self.summary.add_attachment_record(self.segment.size, found))
        self.others = True

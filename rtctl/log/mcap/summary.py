"""What the end of an MCAP file says about the rest of it; grown chunk by chunk while writing or recovering."""

import json
import struct
import zlib
from collections.abc import Mapping

import numpy as np
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode

from rtctl.log.schema import Channel
from rtctl.types import I64, U64

MAGIC = b"\x89MCAP0\r\n"
END = "rtctl.end"  # the metadata record with the sequence numbers of every topic
INDEX_ENTRY = np.dtype([("time", "<u8"), ("offset", "<u8")])
WRAP = 1 << 32  # of MCAP's sequence numbers


def packed(*items: records.McapRecord) -> bytes:
    """Return records as they stand in the file."""
    builder = RecordBuilder()
    for item in items:
        item.write(builder)
    data: bytes = builder.end()  # type: ignore[no-untyped-call]
    return data


def message_indices(channel: I64, time: I64 | U64, offset: I64) -> tuple[bytes, dict[int, int]]:
    """Return the message index records of a chunk, and where each channel's starts among them."""
    data = bytearray()
    starts: dict[int, int] = {}
    for number in np.unique(channel).tolist():
        mine = channel == number
        entries = np.empty(int(mine.sum()), INDEX_ENTRY)
        entries["time"], entries["offset"] = time[mine], offset[mine]
        starts[number] = len(data)
        raw = entries.tobytes()
        data += struct.pack("<BQHI", Opcode.MESSAGE_INDEX, 6 + len(raw), number, len(raw)) + raw
    return bytes(data), starts


class Summary:
    """Counts and indices of what has been written so far."""

    def __init__(self) -> None:
        self.schemas: list[records.Schema] = []
        self.channels: list[records.Channel] = []
        self.chunks: list[records.ChunkIndex] = []
        self.attachments: list[records.AttachmentIndex] = []
        self.metadata: list[records.MetadataIndex] = []
        self.count: dict[int, int] = {}  # messages by channel
        self.first: dict[int, int] = {}  # sequence numbers
        self.last: dict[int, int] = {}
        self.start = 0  # [ns] log_time
        self.end = 0

    @property
    def messages(self) -> int:
        """Return the number of messages of all channels."""
        return sum(self.count.values())

    def add_channels(self, channels: tuple[Channel, ...]) -> bytes:
        """Return the schema and channel records of a new file."""
        for c in channels:
            self.schemas.append(records.Schema(id=c.id, data=c.schema_data, encoding=c.schema_encoding, name=c.schema))
            self.channels.append(
                records.Channel(id=c.id, topic=c.topic, message_encoding=c.encoding, metadata={}, schema_id=c.id)
            )
        return packed(*self.schemas, *self.channels)

    def add_metadata(self, at: int, name: str, content: Mapping[str, str]) -> bytes:
        """Return a metadata record for offset `at` of the file."""
        data = packed(records.Metadata(name=name, metadata=dict(content)))
        self.metadata.append(records.MetadataIndex(offset=at, length=len(data), name=name))
        return data

    def add_attachment(self, at: int, name: str, media_type: str, content: bytes, time: int) -> bytes:
        """Return an attachment record for offset `at` of the file."""
        return self.add_attachment_record(at, records.Attachment(time, time, name, media_type, content))

    def add_attachment_record(self, at: int, found: records.Attachment) -> bytes:
        """Return an attachment's record for offset `at` of the file."""
        data = packed(found)
        self.attachments.append(
            records.AttachmentIndex(
                offset=at,
                length=len(data),
                log_time=found.log_time,
                create_time=found.create_time,
                data_size=len(found.data),
                name=found.name,
                media_type=found.media_type,
            )
        )
        return data

    def add_messages(self, channel: I64, sequence: I64, time: I64 | U64) -> None:
        """Count the messages of a chunk, given in order."""
        none_yet = not self.count
        for number in np.unique(channel).tolist():
            mine = sequence[channel == number]
            self.count[number] = self.count.get(number, 0) + len(mine)
            self.first.setdefault(number, int(mine[0]) % WRAP)
            self.last[number] = int(mine[-1]) % WRAP
        low, high = int(time.min()), int(time.max())
        self.start = low if none_yet else min(self.start, low)
        self.end = max(self.end, high)

    def sequences(self) -> dict[str, str]:
        """Return by topic the JSON of [messages, first sequence number, last sequence number]."""
        topics = {c.id: c.topic for c in self.channels}
        found: dict[str, list[int]] = {}
        for number, count in sorted(self.count.items()):
            if number in topics:  # several channels may be of one topic
                row = found.setdefault(topics[number], [0, self.first[number], 0])
                row[0], row[2] = row[0] + count, self.last[number]
        return {topic: json.dumps(row) for topic, row in found.items()}

    def tail(self, at: int) -> bytes:
        """Return everything that follows the last chunk, for offset `at`: metadata, data end, summary, footer."""
        data = self.add_metadata(at, END, self.sequences()) + packed(records.DataEnd(0))
        start = at + len(data)
        groups: list[tuple[Opcode, list[records.McapRecord]]] = [
            (Opcode.SCHEMA, list(self.schemas)),
            (Opcode.CHANNEL, list(self.channels)),
            (Opcode.STATISTICS, [self._statistics()]),
            (Opcode.CHUNK_INDEX, list(self.chunks)),
            (Opcode.ATTACHMENT_INDEX, list(self.attachments)),
            (Opcode.METADATA_INDEX, list(self.metadata)),
        ]
        summary = bytearray()
        offsets = []
        for opcode, items in groups:
            raw = packed(*items)
            if raw:
                offsets.append(
                    records.SummaryOffset(group_opcode=opcode, group_start=start + len(summary), group_length=len(raw))
                )
            summary += raw
        offset_start = start + len(summary)
        summary += packed(*offsets)
        footer = struct.pack("<BQQQ", Opcode.FOOTER, 20, start, offset_start)
        crc = zlib.crc32(footer, zlib.crc32(summary))
        return data + bytes(summary) + footer + struct.pack("<I", crc) + MAGIC

    def _statistics(self) -> records.Statistics:
        return records.Statistics(
            attachment_count=len(self.attachments),
            channel_count=len(self.channels),
            channel_message_counts=dict(sorted(self.count.items())),
            chunk_count=len(self.chunks),
            message_count=self.messages,
            message_end_time=self.end,
            message_start_time=self.start,
            metadata_count=len(self.metadata),
            schema_count=len(self.schemas),
        )

"""The conformance suite of the MCAP project, made anew from its published definitions: 416 files that are all valid.

Six contents, and every sensible combination of ten features; the names say which: `OneMessage-ch-chx-mx-pad.mcap`.
"""

import itertools
import struct
import zlib
from collections.abc import Iterator
from typing import NamedTuple

MAGIC = b"\x89MCAP0\r\n"
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = range(1, 9)
ATTACHMENT, ATTACHMENT_INDEX, STATISTICS, METADATA, METADATA_INDEX, SUMMARY_OFFSET, DATA_END = range(9, 16)
FEATURES = ("ch", "mx", "st", "rsh", "rch", "ax", "mdx", "chx", "sum", "pad")
PADDING = b"\x01\x02\x03"  # behind the fields of a record: later versions may add some, and readers skip them
TEN_TIMES = (0, 2, 1, 3, 3, 5, 4, 7, 8, 9)  # [ns] of the ten messages, not in order


class Content(NamedTuple):
    """What a file holds: a schema (1, Example), a channel, times and numbers of messages, an attachment, metadata."""

    name: str
    schema: bool = False
    channel: bool = False
    messages: tuple[tuple[int, int, int], ...] = ()  # sequence, log_time, publish_time
    attachment: bool = False
    metadata: bool = False


CONTENTS = (
    Content("NoData"),
    Content("OneSchemalessMessage", channel=True, messages=((10, 2, 1),)),
    Content("OneMessage", schema=True, channel=True, messages=((10, 2, 1),)),
    Content("OneAttachment", attachment=True),
    Content("OneMetadata", metadata=True),
    Content("TenMessages", True, True, tuple((k, t, t) for k, t in enumerate(TEN_TIMES))),
)


def suite() -> Iterator[tuple[str, Content, bytes]]:
    """Yield name, content and bytes of every file."""
    for content in CONTENTS:
        for chosen in itertools.product((False, True), repeat=len(FEATURES)):
            features = {name for name, on in zip(FEATURES, chosen, strict=True) if on}
            if sensible(content, features):
                yield "-".join([content.name, *sorted(features)]) + ".mcap", content, file_of(content, features)


def sensible(content: Content, features: set[str]) -> bool:
    """Return whether the features have something to be about."""
    needs = {
        "ax": content.attachment,
        "mdx": content.metadata,
        "rsh": content.schema,
        "rch": content.channel,
        "ch": content.channel,
        "chx": "ch" in features,
        "mx": "ch" in features,
        "sum": bool(features & {"chx", "rsh", "rch", "mdx", "ax", "st"}),
    }
    return all(there for name, there in needs.items() if name in features)


def text(value: str) -> bytes:
    data = value.encode()
    return struct.pack("<I", len(data)) + data


def mapping(pairs: dict[str, str]) -> bytes:
    data = b"".join(text(key) + text(value) for key, value in pairs.items())
    return struct.pack("<I", len(data)) + data


class _File:
    """Grows a file and knows where its records are."""

    def __init__(self, padded: bool) -> None:
        self.data = bytearray()
        self.padding = PADDING if padded else b""

    def add(self, opcode: int, body: bytes, padded: bool = True) -> tuple[int, int]:
        """Append a record; return its offset and length."""
        at = len(self.data)
        body += self.padding if padded else b""
        self.data += struct.pack("<BQ", opcode, len(body)) + body
        return at, len(self.data) - at


def file_of(content: Content, features: set[str]) -> bytes:
    """Return the bytes of a file."""
    file = _File("pad" in features)
    file.data += MAGIC
    file.add(HEADER, text("") + text(""))
    inside = _File(False) if "ch" in features else file  # the records of a chunk have no padding
    schema = struct.pack("<H", 1) + text("Example") + text("c") + struct.pack("<I", 3) + b"\x04\x05\x06"
    schema_id, encoding, about = (1, "a", {"foo": "bar"}) if content.schema else (0, "text", {})
    channel = struct.pack("<HH", 1, schema_id) + text("example") + text(encoding) + mapping(about)
    if content.schema:
        inside.add(SCHEMA, schema)
    if content.channel:
        inside.add(CHANNEL, channel)
    index = b""
    for sequence, log_time, publish_time in content.messages:
        at, _ = inside.add(MESSAGE, struct.pack("<HIQQ", 1, sequence, log_time, publish_time) + b"\1\2\3", False)
        index += struct.pack("<QQ", log_time, at)
    times = [log_time for _, log_time, _ in content.messages] or [0]
    summary: dict[int, list[bytes]] = {}
    if content.attachment:
        body = struct.pack("<QQ", 2, 1) + text("myFile") + text("application/octet-stream")
        body += struct.pack("<Q", 3) + b"\1\2\3"
        at, length = file.add(ATTACHMENT, body + struct.pack("<I", zlib.crc32(body)))
        if "ax" in features:
            entry = struct.pack("<QQQQQ", at, length, 2, 1, 3) + text("myFile") + text("application/octet-stream")
            summary[ATTACHMENT_INDEX] = [entry]
    if content.metadata:
        at, length = file.add(METADATA, text("myMetadata") + mapping({"foo": "bar"}))
        if "mdx" in features:
            summary[METADATA_INDEX] = [struct.pack("<QQ", at, length) + text("myMetadata")]
    if "ch" in features:
        size = len(inside.data)
        head = struct.pack("<QQQI", min(times), max(times), size, zlib.crc32(inside.data)) + text("")
        at, length = file.add(CHUNK, head + struct.pack("<Q", size) + inside.data)
        offsets, indices = b"", 0
        if "mx" in features:
            place, indices = file.add(MESSAGE_INDEX, struct.pack("<HI", 1, len(index)) + index)
            offsets = struct.pack("<HQ", 1, place)
        if "chx" in features:
            entry = struct.pack("<QQQQI", min(times), max(times), at, length, len(offsets)) + offsets
            summary[CHUNK_INDEX] = [entry + struct.pack("<Q", indices) + text("") + struct.pack("<QQ", size, size)]
    file.add(DATA_END, struct.pack("<I", zlib.crc32(file.data)))
    if "rsh" in features:
        summary[SCHEMA] = [schema]
    if "rch" in features:
        summary[CHANNEL] = [channel]
    if "st" in features:
        count = len(content.messages)
        counts = struct.pack("<HQ", 1, count) if count else b""
        numbers = (content.schema, content.channel, content.attachment, content.metadata, "ch" in features)
        body = struct.pack("<QHIIIIQQ", count, *map(int, numbers), min(times), max(times))
        summary[STATISTICS] = [body + struct.pack("<I", len(counts)) + counts]
    start = len(file.data)
    groups = []
    for opcode in (SCHEMA, CHANNEL, STATISTICS, METADATA_INDEX, ATTACHMENT_INDEX, CHUNK_INDEX):
        at = len(file.data)
        for body in summary.get(opcode, []):
            file.add(opcode, body)
        if len(file.data) > at:
            groups.append(struct.pack("<BQQ", opcode, at, len(file.data) - at))
    start, offset_start = (start if groups else 0), (len(file.data) if "sum" in features else 0)
    for group in groups if "sum" in features else []:
        file.add(SUMMARY_OFFSET, group)
    footer = struct.pack("<BQQQ", FOOTER, 20, start, offset_start)
    crc = zlib.crc32(footer, zlib.crc32(file.data[start:] if start else b""))
    return bytes(file.data) + footer + struct.pack("<I", crc) + MAGIC

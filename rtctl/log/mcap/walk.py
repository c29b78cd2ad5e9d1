"""Walking the records of an MCAP file or chunk, whole or cut off anywhere, without ever believing a length."""

import mmap
import struct
import threading
from collections.abc import Iterator
from typing import NamedTuple, TypeAlias

import lz4.frame  # type: ignore[import-untyped]
import numpy as np
import zstandard
from isal import isal_zlib
from mcap.opcode import Opcode

from rtctl.log.mcap.summary import INDEX_ENTRY, MAGIC
from rtctl.types import I64, U8

RECORD = struct.Struct("<BQ")
CHUNK = struct.Struct("<QQQII")  # start, end, uncompressed size, crc, length of the compression's name
MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log_time, publish_time
Source: TypeAlias = bytes | mmap.mmap
I64_MAX = (1 << 63) - 1
LARGEST = 1 << 30  # [bytes] of an uncompressed chunk that we are willing to hold


class _Zstd(threading.local):
    """A decompressor for each thread: making one takes a tenth of the time of a chunk."""

    def __init__(self) -> None:
        self.decompressor = zstandard.ZstdDecompressor()


_ZSTD = _Zstd()


class Messages(NamedTuple):
    """The messages of a chunk; columns of equal length."""

    channel: I64
    sequence: I64
    time: I64  # log_time [ns]
    offset: I64  # of the message record in the chunk
    size: I64  # of its data


class Damaged(ValueError):
    """A record does not mean what its place in the file says."""


def rows_of(raw: U8, at: I64, size: int) -> U8:
    """Return `size` bytes from each of the places `at`, (len(at), size)."""
    if not len(at) or not size:
        return np.zeros((len(at), size), np.uint8)
    every: U8 = np.ndarray((len(raw) - size + 1, size), np.uint8, raw, 0, (1, 1))  # as_strided takes ten times as long
    return every[at]


def walk(data: Source, at: int, stop: int) -> Iterator[tuple[int, int, int]]:
    """Yield (opcode, start of the body, end of the body) of the whole records between `at` and `stop`."""
    unpack, size, footer = RECORD.unpack_from, RECORD.size, int(Opcode.FOOTER)  # looked up once: there are thousands
    body = at + size
    while body <= stop:
        opcode, length = unpack(data, body - size)
        end = body + length
        if opcode == 0 or end > stop:
            return
        yield opcode, body, end
        if opcode == footer:
            return
        body = end + size


class ChunkHead(NamedTuple):
    """A chunk record up to its data."""

    start: int  # [ns] log_time
    end: int
    size: int  # uncompressed
    crc: int  # 0: none
    compression: str
    data_at: int
    data_end: int


def chunk_head(data: Source, body: int, end: int) -> ChunkHead:
    """Return the head of the chunk record whose body is [body, end).

    Raises Damaged.
    """
    try:
        start, stop, size, crc, named = CHUNK.unpack_from(data, body)
        at = body + CHUNK.size
        if at + named + 8 > end:
            raise Damaged("chunk: the name of its compression is too long")
        name = bytes(memoryview(data)[at : at + named]).decode("ascii")
        (length,) = struct.unpack_from("<Q", data, at + named)
    except (struct.error, UnicodeDecodeError) as error:
        raise Damaged(f"chunk: {error}") from None
    at += named + 8
    if at + length > end or size > LARGEST:
        raise Damaged("chunk: wrong length")
    return ChunkHead(start, stop, size, crc, name, at, at + length)


def chunk_data(data: Source, head: ChunkHead) -> bytes:
    """Return the uncompressed records of a chunk.

    Raises Damaged when they cannot be had or differ from their checksum.
    """
    raw = memoryview(data)[head.data_at : head.data_end]
    try:
        if head.compression == "zstd":
            if zstandard.frame_content_size(raw) not in (head.size, -1):
                raise Damaged("chunk: its size differs from what it says")
            records = _ZSTD.decompressor.decompress(raw, max_output_size=head.size or 1)
        elif head.compression == "lz4":
            records = lz4.frame.LZ4FrameDecompressor().decompress(raw, max_length=head.size or 1)
        elif head.compression == "":
            records = bytes(raw)
        else:
            raise Damaged(f"chunk: compression {head.compression!r}; known: zstd, lz4, none")
    except (zstandard.ZstdError, RuntimeError, MemoryError) as error:
        raise Damaged(f"chunk: {error}") from None
    finally:
        raw.release()
    if len(records) != head.size or (head.crc and isal_zlib.crc32(records) != head.crc):
        raise Damaged("chunk: checksum or size differs")
    return records


def chunk_messages(records: bytes) -> Messages:
    """Return the messages of a chunk by walking it."""
    rows = []
    for opcode, body, end in walk(records, 0, len(records)):
        if opcode == Opcode.MESSAGE and end - body >= MESSAGE.size:
            channel, sequence, time, _ = MESSAGE.unpack_from(records, body)
            rows.append((channel, sequence, min(time, I64_MAX), body - RECORD.size, end - body - MESSAGE.size))
    table = np.array(rows, dtype=np.int64).reshape(len(rows), 5)
    return Messages(*(np.ascontiguousarray(table[:, i]) for i in range(5)))


def message_index(data: Source, body: int, end: int) -> tuple[int, np.ndarray[tuple[int], np.dtype[np.void]]]:
    """Return the channel and the (time, offset) entries of a message index record.

    Raises Damaged.
    """
    if end - body < 6:
        raise Damaged("message index: too short")
    channel, length = struct.unpack_from("<HI", data, body)
    if body + 6 + length > end or length % INDEX_ENTRY.itemsize:
        raise Damaged("message index: wrong length")
    return channel, np.frombuffer(data, INDEX_ENTRY, length // INDEX_ENTRY.itemsize, body + 6)


def has_magic(data: Source, size: int) -> tuple[bool, bool]:
    """Return whether the file starts and ends as an MCAP file does."""
    view = memoryview(data)
    start = bytes(view[:8]) == MAGIC
    end = size >= 2 * len(MAGIC) and bytes(view[size - 8 : size]) == MAGIC
    view.release()
    return start, end

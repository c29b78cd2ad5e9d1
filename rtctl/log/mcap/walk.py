"""Walking the records of an MCAP file or chunk, whole or cut off anywhere, without ever believing a length."""

import io
import mmap
import struct
import threading
from array import array
from collections.abc import Callable, Iterator
from typing import NamedTuple, TypeAlias, TypeVar

import lz4.frame  # type: ignore[import-untyped]
import numpy as np
import zstandard
from isal import isal_zlib
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode

from rtctl.log import limits
from rtctl.log.mcap.summary import INDEX_ENTRY, MAGIC
from rtctl.types import I64, U8, U64

RECORD = struct.Struct("<BQ")
CHUNK = struct.Struct("<QQQII")  # start, end, uncompressed size, crc, length of the compression's name
MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log_time, publish_time
T = TypeVar("T")
Source: TypeAlias = bytes | mmap.mmap
I64_MAX = (1 << 63) - 1


class _Zstd(threading.local):
    """A decompressor for each thread: making one takes a tenth of the time of a chunk."""

    def __init__(self) -> None:
        self.decompressor = zstandard.ZstdDecompressor(max_window_size=limits.CHUNK)


_ZSTD = _Zstd()


class Messages(NamedTuple):
    """The messages of a chunk; columns of equal length."""

    channel: I64
    sequence: I64
    time: I64  # log_time [ns]; one beyond 2^63 reads as I64_MAX
    offset: I64  # of the message record in the chunk
    size: I64  # of its data
    stamp: U64  # log_time [ns] as it stands there


class Damaged(ValueError):
    """A record does not mean what its place in the file says."""


def parsed(read: Callable[[ReadDataStream], T], data: Source, body: int, end: int) -> T:
    """Return the record whose body is [body, end).

    Raises Damaged.
    """
    try:
        return read(ReadDataStream(io.BytesIO(data[body:end])))
    except (McapError, struct.error, ValueError, OverflowError, MemoryError) as error:
        raise Damaged(f"record at {body}: {error or type(error).__name__}") from None


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
    if at + length > end:
        raise Damaged("chunk: wrong length")
    if size > limits.CHUNK:
        raise Damaged(f"chunk: says {size} bytes, at most {limits.CHUNK} are unpacked")
    return ChunkHead(start, stop, size, crc, name, at, at + length)


def chunk_data(data: Source, head: ChunkHead) -> bytes:
    """Return the uncompressed records of a chunk; never more bytes than its head says are unpacked.

    Raises Damaged when they cannot be had or differ from their checksum.
    """
    raw = memoryview(data)[head.data_at : head.data_end]
    try:
        if head.compression == "zstd":
            records = _from_zstd(raw, head.size)
        elif head.compression == "lz4":
            records = _from_lz4(raw, head.size)
        elif head.compression == "":
            records = bytes(raw)
        else:
            raise Damaged(f"chunk: compression {head.compression!r}; known: zstd, lz4, none")
    except (zstandard.ZstdError, RuntimeError, EOFError, MemoryError) as error:
        raise Damaged(f"chunk: {head.compression}: {error or type(error).__name__}") from None
    finally:
        raw.release()
    if len(records) != head.size:
        raise Damaged(f"chunk: holds {len(records)} bytes or more, its head says {head.size}")
    if head.crc and isal_zlib.crc32(records) != head.crc:
        raise Damaged("chunk: its checksum differs")
    return records


def _from_zstd(raw: memoryview, size: int) -> bytes:
    """Return at most `size` + 1 bytes; frames one behind another are one stream."""
    if not raw:
        return b""
    if zstandard.frame_content_size(raw) == size:
        try:
            whole: bytes = _ZSTD.decompressor.decompress(raw, max_output_size=size, allow_extra_data=False)
            return whole
        except zstandard.ZstdError:
            if size:
                raise
    with _ZSTD.decompressor.stream_reader(raw, read_across_frames=True, closefd=False) as reader:
        parts, left = [], size + 1
        while left and (part := reader.read(left)):
            parts.append(part)
            left -= len(part)
    return b"".join(parts)


def _from_lz4(raw: memoryview, size: int) -> bytes:
    """Return at most `size` + 1 bytes; frames one behind another are one stream."""
    parts, left, rest = [], size + 1, bytes(raw)
    while left and rest:
        frame = lz4.frame.LZ4FrameDecompressor()
        while left and not frame.eof:
            part = frame.decompress(rest, max_length=left)
            parts.append(part)
            left -= len(part)
            rest = b""
            if not part:
                break
        rest = frame.unused_data or b""
    return b"".join(parts)


def chunk_messages(records: bytes) -> Messages:
    """Return the messages of a chunk by walking it."""
    rows = array("Q")  # a list of tuples would take ten times the memory
    for opcode, body, end in walk(records, 0, len(records)):
        if opcode == Opcode.MESSAGE and end - body >= MESSAGE.size:
            channel, sequence, time, _ = MESSAGE.unpack_from(records, body)
            rows.extend((channel, sequence, body - RECORD.size, end - body - MESSAGE.size, time))
    table = np.frombuffer(rows, np.uint64).reshape(-1, 5) if rows else np.zeros((0, 5), np.uint64)
    channels, sequences, offsets, sizes = (np.ascontiguousarray(table[:, i]).view(np.int64) for i in range(4))
    stamps = np.ascontiguousarray(table[:, 4])
    return Messages(channels, sequences, clamped(stamps), offsets, sizes, stamps)


def clamped(stamps: U64) -> I64:
    """Return times [ns] as signed numbers; those beyond 2^63 as I64_MAX."""
    return np.minimum(stamps, np.uint64(I64_MAX)).astype(np.int64)


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

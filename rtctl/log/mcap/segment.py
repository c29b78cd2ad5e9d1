"""One MCAP file being written: whole chunks only, each on its way to the disk before it counts as written."""

import fcntl
import os
import struct
import time
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import zstandard
from isal import isal_zlib
from mcap import records
from mcap.opcode import Opcode

from rtctl.log.header import Header, header_to_json
from rtctl.log.mcap.names import INFO, OPEN
from rtctl.log.mcap.rows import Encoded
from rtctl.log.mcap.summary import MAGIC, Summary, message_indices, packed
from rtctl.log.schema import Channel
from rtctl.types import I64, U64

CHUNK_BYTES = 256 << 10
MODE = 0o640  # of log files: they tell what a robot does, and where
LETTING_GO = 0.5  # [s] for which a lock may outlive the process it was of
LEVEL = 1  # on such rows smaller and faster than 3
MEDIA = {".urdf": "application/xml", ".zip": "application/zip", ".json": "application/json"}  # of attachments


class Chunk(NamedTuple):
    """A chunk's records, compressed."""

    compression: str
    size: int  # [bytes] uncompressed
    crc: int  # of the uncompressed records; 0: none
    data: bytes


class Segment:
    """Writes `path`.open and renames it to `path` when it is whole; see `begin` and `recover`.

    Every method that writes raises OSError when the disk does not take it; the file then ends with its last good
    chunk and `finish` may be called to close it.
    """

    def __init__(self, path: Path, file: int, summary: Summary, size: int) -> None:
        """Go on behind the first `size` bytes of an open, locked file that `summary` describes."""
        self.path = path
        self.file = file
        self.summary = summary
        self.size = size  # bytes that are whole; a torn write behind them is cut off
        self.pending = 0  # bytes of the chunk that is being filled
        self._chunk: list[Encoded] = []
        self.compressor = zstandard.ZstdCompressor(level=LEVEL)

    def add(self, encoded: Encoded) -> None:
        """Put messages into the current chunk; they reach the disk with `flush`."""
        if encoded.data:
            self._chunk.append(encoded)
            self.pending += len(encoded.data)

    def flush(self) -> None:
        """Write the current chunk, if it holds anything.

        Raises OSError when the disk does not take it: its messages are gone, the file is as before.
        """
        chunk, self._chunk, self.pending = self._chunk, [], 0
        if not chunk:
            return
        channel, sequence, time = (np.concatenate([e[i] for e in chunk]) for i in (1, 2, 3))
        bases = np.cumsum([0] + [len(e.data) for e in chunk[:-1]])
        offset = np.concatenate([e.offset + base for e, base in zip(chunk, bases, strict=True)])
        data = b"".join(e.data for e in chunk)
        self.add_chunk(
            Chunk("zstd", len(data), isal_zlib.crc32(data), self.compressor.compress(data)),
            channel,
            sequence,
            time,
            offset,
        )

    def add_chunk(self, chunk: "Chunk", channel: I64, sequence: I64, time: I64 | U64, offset: I64) -> None:
        """Write a chunk as it is, and the indices of its messages, given in order.

        Raises OSError when the disk does not take it.
        """
        start, end = (int(time.min()), int(time.max())) if len(time) else (0, 0)
        name = chunk.compression.encode()
        head = struct.pack("<QQQII", start, end, chunk.size, chunk.crc, len(name)) + name
        head += struct.pack("<Q", len(chunk.data))
        record = struct.pack("<BQ", Opcode.CHUNK, len(head) + len(chunk.data)) + head + chunk.data
        indices, starts = message_indices(channel, time, offset)
        at = self.size
        self.write(record + indices)
        if len(time):
            self.summary.add_messages(channel, sequence, time)
        self.summary.chunks.append(
            records.ChunkIndex(
                chunk_length=len(record),
                chunk_start_offset=at,
                compression=chunk.compression,
                compressed_size=len(chunk.data),
                message_end_time=end,
                message_index_length=len(indices),
                message_index_offsets={number: at + len(record) + s for number, s in starts.items()},
                message_start_time=start,
                uncompressed_size=chunk.size,
            )
        )

    def sync(self) -> None:
        """Wait until what has been written is on the disk."""
        os.fdatasync(self.file)

    def end(self) -> None:
        """Flush, and write what follows the last chunk; on the disk when this returns. May be tried again."""
        self.flush()
        metadata = list(self.summary.metadata)
        try:
            self.write(self.summary.tail(self.size))
        except OSError:
            self.summary.metadata = metadata
            raise
        os.fsync(self.file)

    def finish(self) -> Path:
        """End the file and give it its name; return that name."""
        self.end()
        settle(open_name(self.path), self.path)
        self.close()
        return self.path

    def close(self) -> None:
        """Let go of the file as it is."""
        os.close(self.file)

    def write(self, data: bytes) -> None:
        """Append bytes, or nothing at all.

        Raises OSError when the disk does not take them.
        """
        view = memoryview(data)
        try:
            while view:
                view = view[os.write(self.file, view) :]
        except OSError:
            os.ftruncate(self.file, self.size)
            os.lseek(self.file, self.size, os.SEEK_SET)
            raise
        self.size += len(data)


def open_name(path: Path) -> Path:
    """Return the name that a file has while it is being written."""
    return path.with_name(path.name + OPEN)


def locked(file: int) -> bool:
    """Take the lock of an open file; False when another still has it after LETTING_GO.

    A process that was killed a moment ago has it until its threads have ended: who comes to its rescue waits that long.
    """
    until = time.monotonic() + LETTING_GO
    while True:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return True
        except OSError:
            if time.monotonic() > until:
                return False
            time.sleep(0.01)


def begin(path: Path, header: Header, channels: tuple[Channel, ...], stamp: int, more: Mapping[str, str]) -> Segment:
    """Open a new file and write what comes before the first message.

    stamp: log_time [ns] of the attachments; more: further metadata (clock offset, segment number).
    Raises OSError.
    """
    file = os.open(open_name(path), os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, MODE)
    summary = Summary()
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        segment = Segment(path, file, summary, 0)
        segment.write(_start(summary, header, channels, stamp, more))
    except OSError:
        os.close(file)
        open_name(path).unlink(missing_ok=True)
        raise
    return segment


def _start(
    summary: Summary, header: Header, channels: tuple[Channel, ...], time: int, more: Mapping[str, str]
) -> bytes:
    library = f"rtctl {header.versions.get('rtctl', '')}".rstrip()
    data = MAGIC + packed(records.Header(profile="", library=library))
    data += summary.add_channels(channels)
    texts = header._replace(config="", urdf="", files={})  # they are the attachments
    info = {"header": header_to_json(texts), "robot": header.robot, "config_sha256": header.config_sha256}
    info |= {f"version.{name}": version for name, version in header.versions.items()}
    data += summary.add_metadata(len(data), INFO, {**info, "revision": header.revision, **more})
    files = {"config.toml": header.config, "robot.urdf": header.urdf, **header.files}
    for name, content in files.items():
        raw = content.encode() if isinstance(content, str) else content
        data += summary.add_attachment(len(data), name, MEDIA.get(Path(name).suffix, "text/plain"), raw, time)
    return data


def settle(source: Path, target: Path) -> None:
    """Rename a file that is on the disk already, so that after a power cut it has one name or the other."""
    os.replace(source, target)
    folder = os.open(target.parent, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)

"""Writing a log: a session of segments that outlives a full disk, and a sink for simulations."""

import contextlib
import os
import shutil
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from rtctl.errors import LogError
from rtctl.log import schema
from rtctl.log.entry import Batch, Payload, empty, stream
from rtctl.log.header import Header
from rtctl.log.mcap.names import Origin, metadata, segment_name
from rtctl.log.mcap.recovery import drop_last_chunk, recover
from rtctl.log.mcap.segment import CHUNK_BYTES, MODE, Segment, begin, open_name
from rtctl.log.record.encoding import Encoder
from rtctl.log.record.retention import Retention, session_order
from rtctl.plain import Json

CHUNK_TIME = 0.25  # [s] after which a chunk is written however small
JITTER_NS = 1_000_000  # of the clocks' offset, as it is read: less is no change
SYNC_TIME = 1.0  # [s]
RESERVE = 512 << 10  # [bytes] kept aside so that a full disk still takes the end of the file
REOPEN = 64 << 20  # [bytes] above the floor before a session that met a full disk writes again


class Options(NamedTuple):
    """How a session writes."""

    directory: Path
    stem: str  # files are stem.000.mcap, stem.001.mcap, ...
    segment_s: float = 60.0
    segment_bytes: int = 1 << 30
    floor_bytes: int = 256 << 20  # of free disk; 0: write until it is full


def segment_path(options: Options, number: int) -> Path:
    """Return the name of a session's segment."""
    return options.directory / segment_name(options.stem, number)


def clock_offset() -> int:
    """Return wall clock - monotonic clock [ns], from the closest of a few readings.

    A wall clock that says it was set before the machine started, as one without a battery at 1970 may, is not one: the
    log's times, which are never below zero, then are the monotonic clock's.
    """
    readings = []
    for _ in range(5):
        before, wall, after = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
        readings.append((after - before, wall - (before + after) // 2))
    return max(min(readings)[1], 0)


def free_bytes(folder: Path) -> int:
    """Return what an ordinary user may still write to the disk of a folder; 0 when it cannot be said."""
    try:
        return shutil.disk_usage(folder).free
    except OSError:
        return 0


class Session:
    """Segments one after the other. Never raises for the disk's sake: it becomes `degraded`, and comes back.

    number: of the last entry that an earlier recorder of the same ring has written.
    """

    def __init__(
        self,
        header: Header,
        options: Options,
        number: int = 0,
        first: int = 0,
        free: Callable[[Path], int] = free_bytes,
    ) -> None:
        self.header = header
        self.options = options
        self.encoder = Encoder(header, number)
        self.index = first  # of the current segment
        self.degraded = False
        self.lost = 0  # entries that came while nothing could be written
        self.clean = True  # nothing waits to be written
        self._free = free
        self._segment: Segment | None = None
        self._written = number  # of the last entry on disk
        self._opened = self._flushed = self._synced = 0.0
        self._reserve = options.directory / f".{options.stem}.reserve"
        self._next = first
        self._order = session_order(options.directory, options.stem)
        self._retention = Retention(options.directory)
        self.open()

    @property
    def path(self) -> Path:
        """Return the name that the current segment will have."""
        return segment_path(self.options, self.index)

    def open(self) -> None:
        """Begin the next segment, or become degraded."""
        now = time.monotonic()
        self._opened = self._flushed = self._synced = now
        offset = clock_offset()
        if abs(offset - self.encoder.offset) > JITTER_NS:  # else a turn that two files share would have two times
            self.encoder.offset = offset
        stamp = time.monotonic_ns() + self.encoder.offset
        try:
            self.options.directory.mkdir(parents=True, exist_ok=True)
            self._set_aside()
            path = segment_path(self.options, self._next)
            while path.exists() or open_name(path).exists():  # never over another log
                self._next += 1
                path = segment_path(self.options, self._next)
            origin = Origin(self._order, self.options.stem, self._next)
            more = {**metadata(origin), "clock_offset_ns": str(self.encoder.offset)}
            self._segment = begin(path, self.header, self.encoder.channels, stamp, more)
        except OSError:
            self._segment, self.degraded = None, True
            return
        self.index, self._next, self.degraded = self._next, self._next + 1, False
        self.encoder.time = self.encoder.time or stamp - self.encoder.offset

    def _set_aside(self) -> None:
        """Take the reserve; on a disk too small for it the file's last chunks pay for its end."""
        if self._reserve.exists():
            return
        with contextlib.suppress(OSError):
            file = os.open(self._reserve, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, MODE)
            try:
                os.posix_fallocate(file, 0, RESERVE)
            except OSError:
                self._reserve.unlink()
            finally:
                os.close(file)

    def _give_up_reserve(self) -> None:
        with contextlib.suppress(OSError):
            self._reserve.unlink(missing_ok=True)

    def write(self, batch: Batch) -> None:
        """Take a batch; it is on its way to the disk when `clean`."""
        if not batch.number:
            return
        if self._segment is None:
            self.lost += len(batch.number)
            return
        self._segment.add(self.encoder.encode(batch))
        self.clean = False
        if self._segment.pending >= CHUNK_BYTES:
            self.flush()

    def poll(self) -> None:
        """Do what time asks for: write the chunk, sync, change segment, look at the disk."""
        now = time.monotonic()
        if self._segment is not None and now - self._flushed >= CHUNK_TIME:
            self.flush()
        if now - self._synced < SYNC_TIME:
            return
        self._synced = now
        if self._segment is None:
            if self._free(self.options.directory) > self.options.floor_bytes + REOPEN:
                self.open()
            return
        try:
            self._segment.sync()
        except OSError:
            self._fail("disk error")
            return
        if not self._has_room() and not self._retention.make_room(self._has_room):
            self.flush()
            if self._segment is not None:
                self._fail("disk floor")
        elif now - self._opened >= self.options.segment_s or self._segment.size >= self.options.segment_bytes:
            self.finish({"reason": "segment full", "next": segment_path(self.options, self._next).name})
            self.open()

    def _has_room(self) -> bool:
        return self._free(self.options.directory) >= self.options.floor_bytes

    def flush(self) -> None:
        """Write the chunk that is being filled."""
        self._flushed = time.monotonic()
        if self._segment is None or self.clean:
            return
        try:
            entries = {"entries": self.encoder.number}
            self._segment.add(self.encoder.own(schema.POSITION, self.encoder.time, entries))
            self._segment.flush()
        except OSError as error:
            self._fail(f"disk: {error.strerror}")
            return
        self._written = self.encoder.number
        self.clean = True

    def finish(self, content: Json) -> None:
        """Close the current segment, saying why."""
        self.flush()
        if self._segment is None:
            return
        segment, self._segment = self._segment, None
        more = {"dropped": self.encoder.dropped, "malformed": self.encoder.malformed, "lost": self.lost}
        end = max(self.encoder.time, segment.summary.end - self.encoder.offset)
        sentinel = {**content, **more, "entries": self._written}
        try:
            segment.add(self.encoder.own(schema.SENTINEL, end, sentinel))
            segment.finish()
        except OSError as error:
            self.degraded = True
            self._finish_short(segment, {**sentinel, "reason": f"disk: {error.strerror}"})

    def _finish_short(self, segment: Segment, content: Json) -> None:
        """Close a segment on a full disk: give up the reserve, then chunk after chunk, until its end fits."""
        segment.close()
        self._give_up_reserve()
        path = open_name(segment.path)
        while True:
            try:
                recover(path, content)
            except (OSError, LogError):
                if not drop_last_chunk(path):
                    return
                continue
            return

    def _fail(self, reason: str) -> None:
        """Close what is good, and go on without a file. Entries not yet written show as a dropout later."""
        self.lost += self.encoder.number - self._written
        self.encoder.number = self._written
        self.clean = True
        self.degraded = True
        self._give_up_reserve()
        self.finish({"reason": reason})
        self.degraded = True

    def close(self, content: Json, number: int = 0) -> None:
        """Close the log. number: of the last entry that the producer offered, dropped or not."""
        if self._segment is not None:
            for encoded in self.encoder.missing(number, self.encoder.time):
                self._segment.add(encoded)
                self.clean = False
        self.finish(content)
        self._give_up_reserve()


class McapSink:
    """The recorder's `put` without ring and process: a simulation's log in one file.

    log_time is the time given to `put`, so equal runs write equal bytes.
    Raises LogError when the file cannot be written.
    """

    def __init__(self, path: Path | str, header: Header) -> None:
        self.path = Path(path)
        self._encoder = Encoder(header)
        self._batch = empty()
        self._number = 0
        self._sequence: dict[int, int] = {}
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            more = {"segment": "0", "session": self.path.stem, "clock_offset_ns": "0"}
            self._segment = begin(self.path, header, self._encoder.channels, 0, more)
        except OSError as error:
            raise LogError(f"{path}: {error.strerror}") from None

    def put(self, kind: int, payload: Payload, time_ns: int) -> bool:
        """Put one entry; always True."""
        return self.put_many(kind, (payload,), time_ns)

    def put_many(self, kind: int, payloads: Sequence[Payload], time_ns: int) -> bool:
        """Put several entries of one kind and time; always True."""
        key = stream(kind)
        for payload in payloads:
            self._number += 1
            sequence = self._sequence[key] = self._sequence.get(key, 0) + 1
            self._batch.kind.append(kind)
            self._batch.number.append(self._number)
            self._batch.time.append(time_ns)
            self._batch.sequence.append(sequence)
            self._batch.payload.append(payload)
        if len(self._batch.kind) >= 256:
            self._drain()
        return True

    def _drain(self) -> None:
        batch, self._batch = self._batch, empty()
        try:
            self._segment.add(self._encoder.encode(batch))
            if self._segment.pending >= CHUNK_BYTES:
                self._segment.flush()
        except OSError as error:
            raise LogError(f"{self.path}: {error.strerror}") from None

    def close(self, reason: str = "closed", detail: str = "") -> Path:
        """Close the file whole and return its name."""
        self._drain()
        content = {"reason": reason, "detail": detail, "entries": self._number}
        content["malformed"] = self._encoder.malformed
        try:
            self._segment.add(self._encoder.own(schema.SENTINEL, self._encoder.time, content))
            return self._segment.finish()
        except OSError as error:
            raise LogError(f"{self.path}: {error.strerror}") from None

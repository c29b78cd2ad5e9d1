"""Reading logs: `read(path)["/tick"].q` is an array, whether the file is whole, cut off or still being written."""

import contextlib
import mmap
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from mcap import records

from rtctl.errors import LogError
from rtctl.log import limits, schema
from rtctl.log.header import Header, header_from_json, of_attachment
from rtctl.log.mcap.catalog import Catalog, attachment, catalog, describe_chunk
from rtctl.log.mcap.names import INFO, OPEN, beside
from rtctl.log.mcap.summary import INDEX_ENTRY
from rtctl.log.mcap.walk import (
    I64_MAX,
    MESSAGE,
    RECORD,
    Damaged,
    Source,
    chunk_data,
    chunk_head,
    chunk_messages,
    clamped,
    rows_of,
)
from rtctl.log.mcap.walk import message_index as index_entries
from rtctl.log.read.topic import Part, Topic
from rtctl.log.schema import MESSAGE as MESSAGE_HEAD
from rtctl.types import I64

T = TypeVar("T")
THREADS = min(4, os.cpu_count() or 1)  # zstd, checksums and numpy's copies let go of the interpreter's lock
RUN = 16  # chunks that a thread takes at a time: handing over each would cost as much as unpacking it
PIECE = 64  # chunks at a time of `pieces`


class Log:
    """One log file. Topics are read when they are asked for, and kept."""

    def __init__(self, path: Path, data: Source, damaged: set[int] | None = None) -> None:
        """damaged: of chunks that another reading of the file has met; those met now are added."""
        self.path = path
        self._data = data
        try:
            self._catalog: Catalog = catalog(data)
        except Damaged as error:
            raise LogError(f"{path}: {error}") from None
        self._damaged = set[int]() if damaged is None else damaged  # where their records begin
        self._topics: dict[str, Topic] = {}
        if not self._catalog.channels or not self._catalog.complete:
            self._describe_from_chunks()
        self._header: Header | None = None

    def _describe_from_chunks(self) -> None:
        known = set(self._catalog.channels)
        for k, channels in enumerate(self._catalog.chunks.channels()):
            if not known.issuperset(channels.tolist()) or not known or not len(channels):
                with contextlib.suppress(Damaged):  # what stands before it in the chunk is known
                    describe_chunk(self._catalog, self._chunk(k) or b"")
                known = set(self._catalog.channels)

    @property
    def damaged(self) -> int:
        """Return the chunks met so far that could not be read."""
        return len(self._damaged)

    @property
    def complete(self) -> bool:
        """Return whether the file was closed by its writer (or recovered)."""
        return self._catalog.complete

    @property
    def good(self) -> int:
        """Return the offset [bytes] up to which the file's data is whole."""
        return self._catalog.good

    @property
    def size(self) -> int:
        """Return the size of the file [bytes] when it was opened."""
        return len(self._data)

    def channel(self, topic: str) -> tuple[records.Channel, records.Schema | None]:
        """Return the channel and schema records of a topic. Raises LogError when the file has no such topic."""
        for channel in self._catalog.channels.values():
            if channel.topic == topic:
                return channel, self._catalog.schemas.get(channel.schema_id)
        raise LogError(f"{self.path}: no topic {topic}; it has {', '.join(self.topics)}")

    def schema_of(self, topic: str) -> str:
        """Return the name of a topic's schema, or its encoding when it has none."""
        for channel in self._catalog.channels.values():
            if channel.topic == topic:
                kind = self._catalog.schemas.get(channel.schema_id)
                return str(kind.name if kind else channel.message_encoding)
        return ""

    @property
    def topics(self) -> list[str]:
        """Return the names of all topics, with or without messages."""
        return sorted({channel.topic for channel in self._catalog.channels.values()})

    @property
    def counts(self) -> dict[str, tuple[int, int, int]]:
        """Return by topic: messages, first and last sequence number. From the file's end, else by reading it all."""
        if self._catalog.counts:
            return dict(self._catalog.counts)
        return dict(self._walked[0])

    @property
    def span(self) -> tuple[int, int]:
        """Return log_time [ns] of the first and of the last message; (0, 0) when there is none."""
        if self._catalog.span != (0, 0):
            return self._catalog.span
        return self._walked[1]

    @property
    def bounds(self) -> tuple[int, int]:
        """Return two log_times [ns] between which all messages lie, without reading them."""
        chunks = self._catalog.chunks
        if self._catalog.loose:
            return 0, I64_MAX
        if not len(chunks.body):
            return 0, 0
        return int(chunks.start_time.min()), int(chunks.end_time.max())

    @property
    def metadata(self) -> dict[str, dict[str, str]]:
        """Return the metadata records by name."""
        return dict(self._catalog.metadata)

    @property
    def attachments(self) -> dict[str, bytes]:
        """Return the attachments by name; one that is damaged is left out."""
        found = {}
        for name, place in self._catalog.attachments.items():
            try:
                found[name] = bytes(attachment(self._data, place).data)
            except Damaged:
                continue
        return found

    @property
    def header(self) -> Header:
        """Return the header, with the texts of its attachments.

        Raises LogError when the log was not written by this program or its start is lost.
        """
        if self._header is None:
            text = self.metadata.get(INFO, {}).get("header", "")
            try:
                if len(text) > limits.HEADER:
                    raise ValueError(f"{len(text)} characters, at most {limits.HEADER} are read")
                header = header_from_json(text)
            except (
                ValueError,
                TypeError,
                KeyError,
                IndexError,
                AttributeError,
                RecursionError,
                OverflowError,
            ) as error:
                why = f": {error}" if text else ""
                raise LogError(f"{self.path}: has no header of rtctl{why}") from None
            files = {name: of_attachment(name, data) for name, data in self.attachments.items()}
            config, urdf = str(files.pop("config.toml", "")), str(files.pop("robot.urdf", ""))
            self._header = header._replace(config=config, urdf=urdf, files=files)
        return self._header

    @property
    def offset(self) -> int:
        """Return log_time - monotonic clock [ns] of this file; 0 when it does not say."""
        text = self.metadata.get(INFO, {}).get("clock_offset_ns", "0")
        digits = text.removeprefix("-")
        return int(text) if digits.isascii() and digits.isdigit() and len(digits) < 20 else 0

    @property
    def beyond(self) -> bool:
        """Return whether a message is of a later time than 2^63 ns, of the year 2262: such a time reads as 2^63 - 1."""
        return self.span[1] >= I64_MAX

    def __iter__(self) -> Iterator[str]:
        return iter(self.topics)

    def __contains__(self, topic: str) -> bool:
        return topic in self.topics

    def __getitem__(self, topic: str) -> Topic:
        """Return one topic's messages.

        Raises LogError when the file has no such topic.
        """
        if topic not in self._topics:
            self._topics[topic] = self._topic(topic, slice(None), True)
        return self._topics[topic]

    @property
    def events(self) -> list[dict[str, Any]]:
        """Return the events as they were put, each with its `log_time` [ns]."""
        if schema.EVENT not in self:
            return []
        topic = self[schema.EVENT]
        return [{**m.get("data", m), "log_time": t} for m, t in zip(topic.json, topic.time.tolist(), strict=True)]

    @property
    def sentinel(self) -> dict[str, Any]:
        """Return why the file ends; {} when nothing says so: it is still being written, or was cut off."""
        found = self[schema.SENTINEL].json if schema.SENTINEL in self else []
        return found[-1] if found else {}

    @property
    def dropouts(self) -> list[dict[str, Any]]:
        """Return the spans in which entries are missing, each with its `count`."""
        return self[schema.DROPOUT].json if schema.DROPOUT in self.counts else []

    @property
    def data(self) -> Source:
        """Return the file's bytes as they were when it was opened."""
        return self._data

    def sequences(self, topic: str) -> list[I64]:
        """Return the sequence numbers of a topic, of each of its channels."""
        ids = [i for i, channel in self._catalog.channels.items() if channel.topic == topic]
        none = [np.zeros(0, np.int64)]
        return [
            np.concatenate(list(self._map(lambda part: part.sequence, i, slice(None), True, 0, I64_MAX)) or none)
            for i in ids
        ]

    def window(self, topic: str, start: int, stop: int) -> Topic:
        """Return the messages of a topic with start <= log_time < stop [ns], reading only the chunks they are in.

        Raises LogError when the file has no such topic.
        """
        return self._topic(topic, slice(None), True, start, stop)

    def pieces(self, topic: str) -> Iterator[Topic]:
        """Yield a topic some chunks at a time, so that any length fits into memory. Raises LogError without it."""
        for part in self._runs_of_chunks():
            yield self._topic(topic, part, False)
        if self._catalog.loose:
            yield self._topic(topic, slice(0), True)

    def _runs_of_chunks(self) -> Iterator[slice]:
        """Yield the chunks in runs of at most PIECE, and of at most limits.UNPACKED bytes if of more than one."""
        first = size = 0
        count = len(self._catalog.chunks.body)
        for k in range(count):
            try:
                more = chunk_head(self._data, int(self._catalog.chunks.body[k]), int(self._catalog.chunks.end[k])).size
            except Damaged:
                more = 0
            if k > first and (k - first >= PIECE or size + more > limits.UNPACKED):
                yield slice(first, k)
                first, size = k, 0
            size += more
        if count:
            yield slice(first, count)

    def _topic(self, name: str, among: slice, loose: bool, start: int = 0, stop: int = I64_MAX) -> Topic:
        ids = [i for i, channel in self._catalog.channels.items() if channel.topic == name]
        if not ids:
            raise LogError(f"{self.path}: no topic {name}; it has {', '.join(self.topics)}")
        channel = self._catalog.channels[ids[0]]
        kind = self._catalog.schemas.get(channel.schema_id)
        schema_name = kind.name if kind else ""
        dtype = None
        if schema_name == "rtctl.Tick":
            with contextlib.suppress(LogError):  # a start without header: the messages stay as they are
                dtype = self.header.dtype

        def source(work: Callable[[Part], T]) -> list[T]:
            return [done for i in ids for done in self._map(work, i, among, loose, start, stop)]

        return Topic(name, channel, schema_name, dtype, source, limits.held(len(self._data)))

    def _map(
        self, work: Callable[[Part], T], channel: int, among: slice, loose: bool, start: int, stop: int
    ) -> Iterator[T]:
        """Yield what `work` makes of a channel's messages, chunk by chunk; chunks are unpacked by several threads."""
        chunks = self._catalog.chunks
        indices = chunks.indices(channel)
        chosen = (chunks.end_time >= start) & (chunks.start_time < stop) & (indices >= 0)
        numbers = np.arange(len(chosen))[among]
        wanted = numbers[chosen[among]].tolist()

        def some(run: list[int]) -> list[T]:
            contents = ((self._chunk(k), int(indices[k])) for k in run)
            parts = (
                _part(content, self._offsets(at, channel, content), channel, start, stop)
                for content, at in contents
                if content is not None
            )
            return [work(part) for part in parts]

        runs = [wanted[at : at + RUN] for at in range(0, len(wanted), RUN)]
        if len(runs) > 1:
            with ThreadPoolExecutor(THREADS) as pool:
                found = list(pool.map(some, runs))
        else:
            found = [some(run) for run in runs]
        for results in found:
            yield from results
        if loose and self._catalog.loose:
            rows = np.array([body - RECORD.size for body, _ in self._catalog.loose], dtype=np.int64)
            yield work(_part(self._data, rows, channel, start, stop))

    def _chunk(self, number: int) -> bytes | None:
        body, end = int(self._catalog.chunks.body[number]), int(self._catalog.chunks.end[number])
        try:
            return chunk_data(self._data, chunk_head(self._data, body, end))
        except Damaged:
            self._damaged.add(body)
            return None

    def _offsets(self, at: int, channel: int, records_of_chunk: bytes) -> I64:
        """Return where the channel's messages are in a chunk, ascending: by its index at `at`, else by walking."""
        if at and at + RECORD.size <= len(self._data):
            try:
                _, length = RECORD.unpack_from(self._data, at)
                body = at + RECORD.size
                found, entries = index_entries(self._data, body, min(body + length, len(self._data)))
            except Damaged:
                found, entries = -1, np.zeros(0, INDEX_ENTRY)
            if found == channel:
                offsets: I64 = np.array(entries["offset"], dtype=np.int64)
                offsets.sort()
                return offsets
        messages = chunk_messages(records_of_chunk)
        walked: I64 = messages.offset[messages.channel == channel]
        return walked

    @cached_property
    def _walked(self) -> tuple[dict[str, tuple[int, int, int]], tuple[int, int]]:
        """Return `counts` and `span` from the messages themselves, unpacking each chunk once."""
        counts: dict[str, tuple[int, int, int]] = {}
        low, high = I64_MAX, 0

        def add(part: Part, topic: str) -> None:
            nonlocal low, high
            if len(part.time):
                n, first, _ = counts.get(topic, (0, int(part.sequence[0]), 0))
                counts[topic] = (n + len(part.time), first, int(part.sequence[-1]))
                low, high = min(low, int(part.time.min())), max(high, int(part.time.max()))

        loose = np.array([body - RECORD.size for body, _ in self._catalog.loose], dtype=np.int64)
        indices = {i: self._catalog.chunks.indices(i).tolist() for i in self._catalog.channels}
        for k in range(len(self._catalog.chunks.body)):
            content = self._chunk(k)
            for i, channel in self._catalog.channels.items() if content is not None else ():
                if indices[i][k] >= 0:
                    at = self._offsets(indices[i][k], i, content or b"")
                    add(_part(content or b"", at, i, 0, I64_MAX), channel.topic)
        for i, channel in self._catalog.channels.items() if len(loose) else ():
            add(_part(self._data, loose, i, 0, I64_MAX), channel.topic)
        return dict(sorted(counts.items())), (low, high) if counts else (0, 0)


def _part(data: Source, offsets: I64, channel: int, start: int, stop: int) -> Part:
    """Return the messages at `offsets`, which ascend, that are what is wanted."""
    raw = np.frombuffer(data, np.uint8)
    size = len(raw)
    if len(offsets) and (offsets[0] < 0 or offsets[-1] > size - MESSAGE_HEAD.itemsize):
        offsets = offsets[(offsets >= 0) & (offsets <= size - MESSAGE_HEAD.itemsize)]
    head = rows_of(raw, offsets, MESSAGE_HEAD.itemsize).view(MESSAGE_HEAD).reshape(-1)
    time, at = head["log"], offsets + MESSAGE_HEAD.itemsize
    good = (head["op"] == 5) & (head["channel"] == channel) & (time >= start)
    if stop < I64_MAX:
        good &= time < stop
    body = head["length"] - np.uint64(MESSAGE.size)  # wraps for a length that is too small: then it is too large
    good &= body <= (size - at).view(np.uint64)
    if not good.all():
        head, at, body = head[good], at[good], body[good]
    return Part(data, at, body.view(np.int64), clamped(head["log"]), head["sequence"].astype(np.int64))


def read(path: Path | str, damaged: set[int] | None = None) -> Log:
    """Open a log for reading; damaged: as of `Log`.

    Raises LogError when the file cannot be read or is not an MCAP file.
    """
    path = Path(path)
    try:
        if path.exists() and not path.is_file() and not path.is_dir():  # a pipe would not even let itself be opened
            raise ValueError("not a file")
        with path.open("rb") as file:
            # a file that is being written may be cut short by its writer, which a map would not survive
            mapped = path.suffix != OPEN and path.stat().st_size > 0
            data: Source = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) if mapped else file.read()
    except (OSError, ValueError) as error:
        raise LogError(f"{path}: {error}") from None
    return Log(path, data, damaged)


def segments(path: Path | str) -> list[Path]:
    """Return all files of the run that a file is one of, in the order of their numbers."""
    return [file for _, file in beside(Path(path))]

"""Reading logs: `read(path)["/tick"].q` is an array, whether the file is whole, cut off or still being written."""

import contextlib
import glob
import mmap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from rtctl.errors import LogError
from rtctl.log import schema
from rtctl.log.catalog import Catalog, ChunkRef, attachment, catalog, describe_chunk
from rtctl.log.header import Header, header_from_json
from rtctl.log.segment import INFO, OPEN
from rtctl.log.summary import INDEX_ENTRY
from rtctl.log.topic import Topic
from rtctl.log.walk import I64_MAX, MESSAGE, RECORD, Damaged, Source, chunk_data, chunk_head, chunk_messages
from rtctl.log.walk import message_index as index_entries
from rtctl.types import I64


class Log:
    """One log file. Topics are read when they are asked for, and kept."""

    def __init__(self, path: Path, data: Source) -> None:
        self.path = path
        self._data = data
        try:
            self._catalog: Catalog = catalog(data)
        except Damaged as error:
            raise LogError(f"{path}: {error}") from None
        self.damaged = 0  # chunks that could not be read
        self._topics: dict[str, Topic] = {}
        if not self._catalog.channels or not self._catalog.complete:
            self._describe_from_chunks()
        self._header: Header | None = None

    def _describe_from_chunks(self) -> None:
        known = set(self._catalog.channels)
        for chunk in self._catalog.chunks:
            if not set(chunk.indices) <= known or not known:
                records_of_chunk = self._chunk(chunk)
                describe_chunk(self._catalog, records_of_chunk or b"")
                known = set(self._catalog.channels)

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
        found = {}
        for name in self.topics:
            topic = self[name]
            if len(topic):
                found[name] = (len(topic), int(topic.sequence[0]), int(topic.sequence[-1]))
        return found

    @property
    def span(self) -> tuple[int, int]:
        """Return log_time [ns] of the first and of the last message; (0, 0) when there is none."""
        if self._catalog.span != (0, 0):
            return self._catalog.span
        times = [self[name].time for name in self.topics if len(self[name])]
        return (min(int(t.min()) for t in times), max(int(t.max()) for t in times)) if times else (0, 0)

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
                header = header_from_json(text)
            except (ValueError, TypeError, KeyError, IndexError, AttributeError, RecursionError):
                raise LogError(f"{self.path}: has no header of rtctl") from None
            texts = {name: data.decode("utf-8", "replace") for name, data in self.attachments.items()}
            config, urdf = texts.pop("config.toml", ""), texts.pop("robot.urdf", "")
            self._header = header._replace(config=config, urdf=urdf, files=texts)
        return self._header

    @property
    def offset(self) -> int:
        """Return log_time - monotonic clock [ns] of this file; 0 when it does not say."""
        text = self.metadata.get(INFO, {}).get("clock_offset_ns", "0")
        return int(text) if text.lstrip("-").isdigit() else 0

    def __contains__(self, topic: str) -> bool:
        return topic in self.topics

    def __getitem__(self, topic: str) -> Topic:
        """Return one topic's messages.

        Raises LogError when the file has no such topic.
        """
        if topic not in self._topics:
            self._topics[topic] = self._read(topic)
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

    def window(self, topic: str, start: int, stop: int) -> Topic:
        """Return the messages of a topic with start <= log_time < stop [ns], reading only the chunks they are in.

        Raises LogError when the file has no such topic.
        """
        return self._read(topic, start, stop)

    def _read(self, name: str, start: int = 0, stop: int = I64_MAX) -> Topic:
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
        topic = Topic(name, channel, schema_name, dtype)
        columns = [part for i in ids for part in self._parts(i, start, stop)]
        if columns:
            topic.time = np.concatenate([c[0] for c in columns])
            topic.sequence = np.concatenate([c[1] for c in columns])
            topic.payloads = [payload for c in columns for payload in c[2]]
        return topic

    def _parts(self, channel: int, start: int, stop: int) -> Iterator[tuple[I64, I64, list[bytes]]]:
        """Yield times, sequence numbers and payloads of a channel, chunk by chunk."""
        for chunk in self._catalog.chunks:
            if chunk.end_time < start or chunk.start_time >= stop or (chunk.indices and channel not in chunk.indices):
                continue
            records_of_chunk = self._chunk(chunk)
            if records_of_chunk is not None:
                yield _select(records_of_chunk, self._offsets(chunk, channel, records_of_chunk), channel, start, stop)
        loose = self._catalog.loose
        if loose:
            rows = np.array([body - RECORD.size for body, _ in loose], dtype=np.int64)
            yield _select(self._data, rows, channel, start, stop)

    def _chunk(self, chunk: ChunkRef) -> bytes | None:
        try:
            return chunk_data(self._data, chunk_head(self._data, chunk.body, chunk.end))
        except Damaged:
            self.damaged += 1
            return None

    def _offsets(self, chunk: ChunkRef, channel: int, records_of_chunk: bytes) -> I64:
        """Return where the channel's messages are in a chunk: by its index, else by walking."""
        at = chunk.indices.get(channel, 0)
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


def _select(data: Source, offsets: I64, channel: int, start: int, stop: int) -> tuple[I64, I64, list[bytes]]:
    """Return times, sequence numbers and payloads of the messages at `offsets` that are what is wanted."""
    times, sequences, payloads = [], [], []
    size = len(data)
    for at in offsets.tolist():
        if not 0 <= at <= size - RECORD.size - MESSAGE.size:
            continue
        opcode, length = RECORD.unpack_from(data, at)
        found, sequence, time, _ = MESSAGE.unpack_from(data, at + RECORD.size)
        end = at + RECORD.size + length
        if opcode != 5 or found != channel or end > size or not start <= time < stop:
            continue
        times.append(time)
        sequences.append(sequence)
        payloads.append(data[at + RECORD.size + MESSAGE.size : end])
    return np.array(times, dtype=np.int64), np.array(sequences, dtype=np.int64), payloads


def read(path: Path | str) -> Log:
    """Open a log for reading.

    Raises LogError when the file cannot be read or is not an MCAP file.
    """
    path = Path(path)
    try:
        with path.open("rb") as file:
            # a file that is being written may be cut short by its writer, which a map would not survive
            mapped = path.suffix != OPEN and path.stat().st_size > 0
            data: Source = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) if mapped else file.read()
    except (OSError, ValueError) as error:
        raise LogError(f"{path}: {error}") from None
    return Log(path, data)


def segments(path: Path | str) -> list[Path]:
    """Return all files of the log that `path` is one of, in order (`name.000.mcap`, `name.001.mcap`, ...)."""
    path = Path(path)
    stem, dot, number = path.name.removesuffix(OPEN).removesuffix(".mcap").rpartition(".")
    if not dot or not number.isdigit():
        return [path]
    pattern = f"{glob.escape(stem)}.[0-9]*.mcap"
    return sorted([*path.parent.glob(pattern), *path.parent.glob(pattern + OPEN)]) or [path]

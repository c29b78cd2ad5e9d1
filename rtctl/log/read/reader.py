"""Reading logs: `read(path)["/tick"].q` is an array, whether the file is whole, cut off or still being written."""

import contextlib
import mmap
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeVar

import numpy as np
from mcap import records

from rtctl.errors import LogError
from rtctl.log import limits, schema
from rtctl.log.header import Header, header_from_json, of_attachment
from rtctl.log.mcap.catalog import Catalog, attachment, catalog, describe_chunk
from rtctl.log.mcap.names import INFO, OPEN, beside
from rtctl.log.mcap.walk import (
    I64_MAX,
    Damaged,
    Source,
)
from rtctl.log.read.chunks import ChunkReader
from rtctl.log.read.topic import Part, Topic
from rtctl.plain import Json
from rtctl.spell import nearest
from rtctl.types import I64

T = TypeVar("T")


class Log:
    """One log file. Topics are read when they are asked for, and kept."""

    def __init__(self, path: Path, data: Source, damaged: set[int] | None = None) -> None:
        """damaged: of chunks that another reading of the file has met; those met now are added."""
        self.path = path
        self._data = data
        try:
            self._catalog: Catalog = catalog(data)
        except Damaged as error:
            raise LogError(f"{path}: got {error}, wanted a log (.mcap)") from None
        self._damaged = set[int]() if damaged is None else damaged  # where their records begin
        self._chunks = ChunkReader(data, self._catalog, self._damaged)
        self._topics: dict[str, Topic] = {}
        if not self._catalog.channels or not self._catalog.complete:
            self._describe_from_chunks()
        self._header: Header | None = None

    def _describe_from_chunks(self) -> None:
        known = set(self._catalog.channels)
        for k, channels in enumerate(self._catalog.chunks.channels()):
            if not known.issuperset(channels.tolist()) or not known or not len(channels):
                with contextlib.suppress(Damaged):  # what stands before it in the chunk is known
                    describe_chunk(self._catalog, self._chunks.content(k) or b"")
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
        raise LogError(f"{self.path}: got topic {topic}, wanted {nearest(topic, self.topics)}")

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
        return dict(self._chunks.walked[0])

    @property
    def span(self) -> tuple[int, int]:
        """Return log_time [ns] of the first and of the last message; (0, 0) when there is none."""
        if self._catalog.span != (0, 0):
            return self._catalog.span
        return self._chunks.walked[1]

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
    def events(self) -> list[Json]:
        """Return the events as they were put, each with its `log_time` [ns]."""
        if schema.EVENT not in self:
            return []
        topic = self[schema.EVENT]
        return [{**m.get("data", m), "log_time": t} for m, t in zip(topic.json, topic.time.tolist(), strict=True)]

    @property
    def sentinel(self) -> Json:
        """Return why the file ends; {} when nothing says so: it is still being written, or was cut off."""
        found = self[schema.SENTINEL].json if schema.SENTINEL in self else []
        return found[-1] if found else {}

    @property
    def dropouts(self) -> list[Json]:
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
            np.concatenate(list(self._chunks.map(lambda part: part.sequence, i, slice(None), True, 0, I64_MAX)) or none)
            for i in ids
        ]

    def window(self, topic: str, start: int, stop: int) -> Topic:
        """Return the messages of a topic with start <= log_time < stop [ns], reading only the chunks they are in.

        Raises LogError when the file has no such topic.
        """
        return self._topic(topic, slice(None), True, start, stop)

    def pieces(self, topic: str) -> Iterator[Topic]:
        """Yield a topic some chunks at a time, so that any length fits into memory. Raises LogError without it."""
        for part in self._chunks.runs():
            yield self._topic(topic, part, False)
        if self._catalog.loose:
            yield self._topic(topic, slice(0), True)

    def _topic(self, name: str, among: slice, loose: bool, start: int = 0, stop: int = I64_MAX) -> Topic:
        ids = [i for i, channel in self._catalog.channels.items() if channel.topic == name]
        if not ids:
            raise LogError(f"{self.path}: got topic {name}, wanted {nearest(name, self.topics)}")
        channel = self._catalog.channels[ids[0]]
        kind = self._catalog.schemas.get(channel.schema_id)
        schema_name = kind.name if kind else ""
        dtype = None
        if schema_name == "rtctl.Tick":
            with contextlib.suppress(LogError):  # a start without header: the messages stay as they are
                dtype = self.header.dtype

        def source(work: Callable[[Part], T]) -> list[T]:
            return [done for i in ids for done in self._chunks.map(work, i, among, loose, start, stop)]

        return Topic(name, channel, schema_name, dtype, source, limits.held(len(self._data)))


def read(path: Path | str, damaged: set[int] | None = None) -> Log:
    """Open a log for reading; damaged: as of `Log`.

    Raises LogError when the file cannot be read or is not an MCAP file.
    """
    path = Path(path)
    try:
        if path.exists() and not path.is_file() and not path.is_dir():  # a pipe would not even let itself be opened
            raise ValueError("no file")
        with path.open("rb") as file:
            # a file that is being written may be cut short by its writer, which a map would not survive
            mapped = path.suffix != OPEN and path.stat().st_size > 0
            data: Source = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) if mapped else file.read()
    except (OSError, ValueError) as error:
        why = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise LogError(f"{path}: got {why.lower()}, wanted a log (.mcap)") from None
    return Log(path, data, damaged)


def segments(path: Path | str) -> list[Path]:
    """Return all files of the run that a file is one of, in the order of their numbers."""
    return [file for _, file in beside(Path(path))]

"""The messages of a channel, chunk by chunk: by their indices where there are any, unpacked by several threads."""

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from typing import TypeVar

import numpy as np

from rtctl.log import limits
from rtctl.log.mcap.catalog import Catalog
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
from rtctl.log.read.topic import Part
from rtctl.log.schema import MESSAGE as MESSAGE_HEAD
from rtctl.types import I64

T = TypeVar("T")
THREADS = min(4, os.cpu_count() or 1)  # zstd, checksums and numpy's copies let go of the interpreter's lock
RUN = 16  # chunks that a thread takes at a time: handing over each would cost as much as unpacking it
PIECE = 64  # chunks at a time of `runs`


class ChunkReader:
    """Gives the messages of a file that its catalog knows, and remembers the chunks that cannot be read."""

    def __init__(self, data: Source, catalog: Catalog, damaged: set[int]) -> None:
        self.data, self.catalog, self.damaged = data, catalog, damaged

    def runs(self) -> Iterator[slice]:
        """Yield the chunks in runs of at most PIECE, and of at most limits.UNPACKED bytes if of more than one."""
        first = size = 0
        count = len(self.catalog.chunks.body)
        for k in range(count):
            try:
                more = chunk_head(self.data, int(self.catalog.chunks.body[k]), int(self.catalog.chunks.end[k])).size
            except Damaged:
                more = 0
            if k > first and (k - first >= PIECE or size + more > limits.UNPACKED):
                yield slice(first, k)
                first, size = k, 0
            size += more
        if count:
            yield slice(first, count)

    def map(
        self, work: Callable[[Part], T], channel: int, among: slice, loose: bool, start: int, stop: int
    ) -> Iterator[T]:
        """Yield what `work` makes of a channel's messages, chunk by chunk; chunks are unpacked by several threads."""
        chunks = self.catalog.chunks
        indices = chunks.indices(channel)
        chosen = (chunks.end_time >= start) & (indices >= 0)
        if stop < I64_MAX:  # otherwise to the end, whatever times there are
            chosen &= chunks.start_time < stop
        numbers = np.arange(len(chosen))[among]
        wanted = numbers[chosen[among]].tolist()

        def some(run: list[int]) -> list[T]:
            contents = ((self.content(k), int(indices[k])) for k in run)
            parts = (
                part_of(content, self._offsets(at, channel, content), channel, start, stop)
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
        if loose and self.catalog.loose:
            rows = np.array([body - RECORD.size for body, _ in self.catalog.loose], dtype=np.int64)
            yield work(part_of(self.data, rows, channel, start, stop))

    def content(self, number: int) -> bytes | None:
        body, end = int(self.catalog.chunks.body[number]), int(self.catalog.chunks.end[number])
        try:
            return chunk_data(self.data, chunk_head(self.data, body, end))
        except Damaged:
            self.damaged.add(body)
            return None

    def _offsets(self, at: int, channel: int, records_of_chunk: bytes) -> I64:
        """Return where the channel's messages are in a chunk, ascending: by its index at `at`, else by walking."""
        if at and at + RECORD.size <= len(self.data):
            try:
                _, length = RECORD.unpack_from(self.data, at)
                body = at + RECORD.size
                found, entries = index_entries(self.data, body, min(body + length, len(self.data)))
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
    def walked(self) -> tuple[dict[str, tuple[int, int, int]], tuple[int, int]]:
        """Return `counts` and `span` from the messages themselves, unpacking each chunk once."""
        counts: dict[str, tuple[int, int, int]] = {}
        low, high = I64_MAX, 0

        def add(part: Part, topic: str) -> None:
            nonlocal low, high
            if len(part.time):
                n, first, _ = counts.get(topic, (0, int(part.sequence[0]), 0))
                counts[topic] = (n + len(part.time), first, int(part.sequence[-1]))
                low, high = min(low, int(part.time.min())), max(high, int(part.time.max()))

        loose = np.array([body - RECORD.size for body, _ in self.catalog.loose], dtype=np.int64)
        indices = {i: self.catalog.chunks.indices(i).tolist() for i in self.catalog.channels}
        for k in range(len(self.catalog.chunks.body)):
            content = self.content(k)
            for i, channel in self.catalog.channels.items() if content is not None else ():
                if indices[i][k] >= 0:
                    at = self._offsets(indices[i][k], i, content or b"")
                    add(part_of(content or b"", at, i, 0, I64_MAX), channel.topic)
        for i, channel in self.catalog.channels.items() if len(loose) else ():
            add(part_of(self.data, loose, i, 0, I64_MAX), channel.topic)
        return dict(sorted(counts.items())), (low, high) if counts else (0, 0)


def part_of(data: Source, offsets: I64, channel: int, start: int, stop: int) -> Part:
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

"""Following a log while it is written: what each new chunk of the growing file holds."""

import contextlib
from pathlib import Path
from typing import NamedTuple

import numpy as np
from mcap import records
from mcap.opcode import Opcode
from numpy.typing import NDArray

from rtctl.errors import LogError
from rtctl.log import limits, schema
from rtctl.log.mcap.names import OPEN
from rtctl.log.mcap.summary import MAGIC
from rtctl.log.mcap.walk import MESSAGE, RECORD, Damaged, chunk_data, chunk_head, chunk_messages, parsed, walk
from rtctl.log.read.reader import read
from rtctl.log.read.topic import Part, Topic
from rtctl.plain import Json

MOST = 2 * limits.CHUNK  # [bytes] read at a look


class NewRecords(NamedTuple):
    """What a look at the file brought."""

    ticks: NDArray[np.void]  # the records that are new; empty for another program's log
    events: list[Json]
    ended: Json  # the sentinel; {} while it is being written


class Tail:
    """Reads on where it stopped; goes over to the file's final name when its writer has closed it."""

    def __init__(self, path: Path) -> None:
        """Raises LogError when the file is not there or no log."""
        self.path = path
        log = read(path)
        self.header = log.header
        self._at = len(MAGIC)
        self._channels: dict[int, records.Channel] = {}

    @property
    def _file(self) -> Path:
        done = self.path.with_name(self.path.name.removesuffix(OPEN))
        return self.path if self.path.exists() else done

    def read_on(self) -> NewRecords:
        """Return what has been written since the last call. Raises LogError when the file has gone."""
        try:
            with self._file.open("rb") as file:
                file.seek(self._at)
                data = file.read(MOST)
        except OSError as error:
            raise LogError(f"{self.path}: {error.strerror}") from None
        found: list[NDArray[np.void]] = []
        events: list[Json] = []
        ended: Json = {}
        used = 0
        for opcode, body, end in walk(data, 0, len(data)):
            used = end
            if opcode == Opcode.CHANNEL:
                with contextlib.suppress(Damaged):
                    channel = parsed(records.Channel.read, data, body, end)
                    self._channels[channel.id] = channel
            elif opcode == Opcode.CHUNK:
                try:
                    content = chunk_data(data, chunk_head(data, body, end))
                except Damaged:
                    continue
                for channel_id, topic in self._topics(content):
                    if topic.name == schema.TICK and topic.dtype is not None:
                        found.append(topic.array)
                    elif topic.name == schema.EVENT:
                        events += [m.get("data", m) for m in topic.json]
                    elif topic.name == schema.SENTINEL:
                        ended = topic.json[-1]
                    del channel_id
        if not used and len(data) == MOST:
            raise LogError(f"{self.path}: a record of more than {MOST >> 20} MiB at {self._at}")
        self._at += used
        ticks = np.concatenate(found) if found else np.zeros(0, self.header.dtype)
        return NewRecords(ticks, [e for e in events if isinstance(e, dict)], ended)

    def _topics(self, content: bytes) -> list[tuple[int, Topic]]:
        rows = chunk_messages(content)
        topics = []
        for number, channel in self._channels.items():
            mine = rows.channel == number
            if not mine.any() or channel.topic not in (schema.TICK, schema.EVENT, schema.SENTINEL):
                continue
            at = rows.offset[mine] + RECORD.size + MESSAGE.size
            part = Part(content, at, rows.size[mine], rows.time[mine], rows.sequence[mine])
            dtype = self.header.dtype if channel.topic == schema.TICK else None
            topics.append((number, Topic(channel.topic, channel, "", dtype, lambda work, part=part: [work(part)])))  # type: ignore[misc]
        return topics


def newest(folder: Path) -> Path:
    """Return the log of a folder that is being written, else the newest. Raises LogError when there is none."""
    files = [*folder.glob("*.mcap" + OPEN)] or [*folder.glob("*.mcap")]
    if not files:
        raise LogError(f"{folder}: no log in it")
    return max(files, key=lambda p: p.stat().st_mtime)

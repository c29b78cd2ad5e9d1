"""Following a log while it is written: what each new chunk of the growing file holds."""

import contextlib
from collections.abc import Callable, Collection
from functools import partial
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np
from mcap import records
from mcap.opcode import Opcode
from numpy.typing import NDArray

from rtctl.errors import LogError
from rtctl.log import limits, schema
from rtctl.log.mcap.names import OPEN
from rtctl.log.mcap.summary import MAGIC
from rtctl.log.mcap.walk import MESSAGE, RECORD, Damaged, Messages, chunk_data, chunk_head, chunk_messages, parsed, walk
from rtctl.log.read.reader import read
from rtctl.log.read.topic import Part, Topic
from rtctl.plain import Json

T = TypeVar("T")
MOST = 2 * limits.CHUNK  # [bytes] read at a look


class Message(NamedTuple):
    """A message as it stands in the file."""

    topic: str
    time: int  # [ns] log_time
    data: bytes


class NewRecords(NamedTuple):
    """What a look at the file brought."""

    ticks: NDArray[np.void]  # the records that are new; empty for another program's log
    events: list[Json]
    ended: Json  # the sentinel of the run's last file; {} while it is being written
    messages: list[Message]  # of the topics that were asked for as they are, by time


class Tail:
    """Reads on where it stopped; goes over to the file's final name when its writer has closed it, and to the next."""

    def __init__(self, path: Path, raw: Collection[str] = ()) -> None:
        """`raw`: topics whose messages are wanted as they are. Raises LogError when the file is not there or no log."""
        self.path = path
        log = read(path)
        self.header = log.header
        self.schemas: dict[str, tuple[records.Channel, records.Schema]] = {}  # of the topics in `raw`, as far as known
        self._raw = frozenset(raw)
        self._begin(path)

    def _begin(self, path: Path) -> None:
        self.path, self._at, self._waits = path, len(MAGIC), False
        self._channels: dict[int, records.Channel] = {}
        self._schemas: dict[int, records.Schema] = {}

    @property
    def _file(self) -> Path:
        done = self.path.with_name(self.path.name.removesuffix(OPEN))
        return self.path if self.path.exists() else done

    def read_on(self) -> NewRecords:
        """Return what has been written since the last call. Raises LogError when the file has gone."""
        found: list[NDArray[np.void]] = []
        events: list[Json] = []
        messages: list[Message] = []
        ended: Json = {}
        used = 0
        try:
            with self._file.open("rb") as file:
                file.seek(self._at)
                data = file.read(MOST)
            self._waits = False
        except OSError as error:
            if not self._waits:
                raise LogError(f"{self.path}: {error.strerror}") from None
            data = b""
        for opcode, body, end in walk(data, 0, len(data)):
            used = end
            if opcode == Opcode.CHANNEL:
                with contextlib.suppress(Damaged):
                    channel = parsed(records.Channel.read, data, body, end)
                    self._channels[channel.id] = channel
                    if channel.topic in self._raw and channel.schema_id in self._schemas:
                        self.schemas[channel.topic] = channel, self._schemas[channel.schema_id]
            elif opcode == Opcode.SCHEMA:
                with contextlib.suppress(Damaged):
                    known = parsed(records.Schema.read, data, body, end)
                    self._schemas[known.id] = known
            elif opcode == Opcode.CHUNK:
                try:
                    content = chunk_data(data, chunk_head(data, body, end))
                except Damaged:
                    continue
                rows = chunk_messages(content)
                messages += self._as_they_are(content, rows)
                for topic in self._topics(content, rows):
                    if topic.name == schema.TICK and topic.dtype is not None:
                        found.append(topic.array)
                    elif topic.name == schema.EVENT:
                        events += [m.get("data", m) for m in topic.json]
                    elif topic.name == schema.SENTINEL:
                        ended = topic.json[-1]
        if not used and len(data) == MOST:
            raise LogError(f"{self.path}: a record of more than {MOST >> 20} MiB at {self._at}")
        self._at += used
        ticks = np.concatenate(found) if found else np.zeros(0, self.header.dtype)
        events = [e for e in events if isinstance(e, dict)]
        after = ended.get("next") if isinstance(ended, dict) else None
        if isinstance(after, str) and after == Path(after).name and after.endswith(".mcap"):  # of this folder
            self._begin(self.path.with_name(after + OPEN))
            self._waits, ended = True, {}
        return NewRecords(ticks, events, ended, messages)

    def _as_they_are(self, content: bytes, rows: Messages) -> list[Message]:
        """Return the messages of a chunk whose topics were asked for."""
        wanted = {n: channel.topic for n, channel in self._channels.items() if channel.topic in self.schemas}
        mine = np.flatnonzero(np.isin(rows.channel, list(wanted)))
        starts = rows.offset[mine] + RECORD.size + MESSAGE.size
        columns = (rows.channel[mine], rows.time[mine], starts, starts + rows.size[mine])
        found = zip(*(column.tolist() for column in columns), strict=True)
        return sorted((Message(wanted[n], at, content[a:b]) for n, at, a, b in found), key=lambda m: m.time)

    def _topics(self, content: bytes, rows: Messages) -> list[Topic]:
        topics = []
        for number, channel in self._channels.items():
            mine = rows.channel == number
            if not mine.any() or channel.topic not in (schema.TICK, schema.EVENT, schema.SENTINEL):
                continue
            at = rows.offset[mine] + RECORD.size + MESSAGE.size
            part = Part(content, at, rows.size[mine], rows.time[mine], rows.sequence[mine])
            dtype = self.header.dtype if channel.topic == schema.TICK else None
            topics.append(Topic(channel.topic, channel, "", dtype, partial(_worked, part)))
        return topics


def _worked(part: Part, work: Callable[[Part], T]) -> list[T]:
    return [work(part)]


def newest(folder: Path) -> Path:
    """Return the log of a folder that is being written, else the newest. Raises LogError when there is none."""
    files = [*folder.glob("*.mcap" + OPEN)] or [*folder.glob("*.mcap")]
    if not files:
        raise LogError(f"{folder}: no log in it")
    return max(files, key=lambda p: p.stat().st_mtime)

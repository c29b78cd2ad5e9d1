"""All segments of one run as one log, however many there are: few files are open at a time."""

from collections import Counter, OrderedDict
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple, TypeVar, overload

from rtctl.errors import LogError
from rtctl.log import limits
from rtctl.log.header import Header
from rtctl.log.mcap.names import beside
from rtctl.log.mcap.walk import I64_MAX
from rtctl.log.read.reader import Log, read
from rtctl.log.read.topic import Part, Topic
from rtctl.plain import Json
from rtctl.spell import nearest

T = TypeVar("T")
OPEN_AT_ONCE = 16  # files of a run
TOLD = 5  # gaps in the numbers of segments that are told


class Contents(NamedTuple):
    """What is kept of each file when it is closed again."""

    size: int  # [bytes]
    bounds: tuple[int, int]  # [ns] between which its log_times lie
    topics: frozenset[str]  # with or without messages


class Logs(Sequence[Log]):
    """The files of a run as logs; the one that was not used for longest is closed for the next."""

    def __init__(self, paths: Sequence[Path]) -> None:
        self.paths = list(paths)
        self.damaged: list[set[int]] = [set() for _ in self.paths]
        self._open: OrderedDict[int, Log] = OrderedDict()

    def __len__(self) -> int:
        return len(self.paths)

    @overload
    def __getitem__(self, index: int) -> Log: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[Log]: ...
    def __getitem__(self, index: int | slice) -> Log | Sequence[Log]:
        """Return one log, opened. Raises LogError when it has gone or is none."""
        if isinstance(index, slice):
            return [self[k] for k in range(*index.indices(len(self)))]
        number = range(len(self))[index]
        if number not in self._open:
            self._open[number] = read(self.paths[number], self.damaged[number])
        self._open.move_to_end(number)
        while len(self._open) > OPEN_AT_ONCE:
            self._open.popitem(last=False)
        return self._open[number]


class Run:
    """The files of one session, or a single file; read as one."""

    def __init__(self, paths: Sequence[Path]) -> None:
        self.logs = Logs(paths)

    @property
    def path(self) -> Path:
        """Return the first file."""
        return self.logs.paths[0]

    @property
    def header(self) -> Header:
        """Return the header of the first segment. Raises LogError when it has none."""
        return self.logs[0].header

    @cached_property
    def contents(self) -> list[Contents]:
        """Return what is in each file, in their order."""
        return [Contents(log.size, log.bounds, frozenset(log.topics)) for log in self.logs]

    @cached_property
    def topics(self) -> list[str]:
        """Return the names of all topics, with or without messages."""
        return sorted({name for each in self.contents for name in each.topics})

    @property
    def size(self) -> int:
        """Return the bytes of all files."""
        return sum(each.size for each in self.contents)

    @cached_property
    def span(self) -> tuple[int, int]:
        """Return log_time [ns] of the first and of the last message; (0, 0) when there is none."""
        spans = [span for span in (log.span for log in self.logs) if span != (0, 0)]
        return (min(s[0] for s in spans), max(s[1] for s in spans)) if spans else (0, 0)

    @property
    def events(self) -> list[Json]:
        """Return the events of all segments, each with its `log_time` [ns]."""
        return [event for log in self.logs for event in log.events]

    @property
    def sentinel(self) -> Json:
        """Return why the last file ends; {} when nothing says so."""
        return self.logs[-1].sentinel

    @property
    def dropouts(self) -> list[Json]:
        """Return the dropouts of all segments."""
        return [d for log in self.logs for d in log.dropouts]

    @property
    def damaged(self) -> int:
        """Return the chunks met so far that could not be read."""
        return sum(map(len, self.logs.damaged))

    def __iter__(self) -> Iterator[str]:
        return iter(self.topics)

    def __contains__(self, topic: str) -> bool:
        return topic in self.topics

    def __getitem__(self, topic: str) -> Topic:
        """Return one topic's messages over all segments. Raises LogError when no file has it."""
        return self.window(topic, 0, I64_MAX)

    def window(self, topic: str, start: int, stop: int) -> Topic:
        """Return the messages of a topic with start <= log_time < stop [ns], of the files that have any then.

        Raises LogError when no file has the topic.
        """
        having = [k for k, each in enumerate(self.contents) if topic in each.topics]
        if not having:
            raise LogError(f"{self.path}: got topic {topic}, wanted {nearest(topic, self.topics)}")
        first = self.logs[having[0]].window(topic, start, stop)
        if len(having) == 1:
            return first
        chosen = [k for k in having if self.contents[k].bounds[0] < stop and self.contents[k].bounds[1] >= start]

        def source(work: Callable[[Part], T]) -> list[T]:
            return [done for k in chosen for done in self._part(k, first, start, stop).source(work)]

        most = limits.held(sum(self.contents[k].size for k in chosen))
        return Topic(first.name, first.channel, first.schema, first.dtype, source, most)

    def _part(self, k: int, first: Topic, start: int, stop: int) -> Topic:
        found = self.logs[k].window(first.name, start, stop)
        if found.dtype != first.dtype:
            raise LogError(f"{first.name}: the segments are of different layouts")
        return found

    def pieces(self, topic: str) -> Iterator[Topic]:
        """Yield a topic some chunks at a time, so that any length fits into memory."""
        for k, each in enumerate(self.contents):
            if topic in each.topics:
                yield from self.logs[k].pieces(topic)

    @cached_property
    def _counts(self) -> Counter[str]:
        found = Counter[str]()
        for log in self.logs:
            found.update({topic: n for topic, (n, _, _) in log.counts.items()})
        return found

    def count(self, topic: str) -> int:
        """Return the number of messages of a topic."""
        return self._counts[topic]


def read_run(path: Path | str) -> Run:
    """Open all segments of the run that a file is one of: those of its folder that say they are of its session.

    Raises LogError when a file cannot be read, is not an MCAP file, or a segment between the first and last is missing.
    """
    path = Path(path)
    read(path)  # says why not
    rows = beside(path)
    numbers = [number for number, _ in rows]
    twice = sorted({a for a, b in pairwise(numbers) if a == b})
    if twice:
        raise LogError(f"{path}: several files beside it say they are segment {twice[0]} of its session")
    gaps = [_gap(a, b) for a, b in pairwise(numbers) if b != a + 1]
    if gaps:
        more = f" and {len(gaps) - TOLD} more gaps" if len(gaps) > TOLD else ""
        raise LogError(f"{path}: segments {', '.join(gaps[:TOLD])}{more} are missing beside it")
    return Run([file for _, file in rows])


def _gap(before: int, behind: int) -> str:
    first, last = before + 1, behind - 1
    return f"{first:03d}" if first == last else f"{first:03d} to {last:03d}"

"""All segments of one run as one log."""

from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import Any

from rtctl.errors import LogError
from rtctl.log.header import Header
from rtctl.log.mcap.walk import I64_MAX
from rtctl.log.read.reader import Log, read, segments
from rtctl.log.read.topic import Topic, joined


class Run:
    """The files `name.000.mcap`, `name.001.mcap`, ... of one run, or a single file; read as one."""

    def __init__(self, logs: list[Log]) -> None:
        self.logs = logs

    @property
    def path(self) -> Path:
        """Return the first file."""
        return self.logs[0].path

    @property
    def header(self) -> Header:
        """Return the header of the first segment. Raises LogError when it has none."""
        return self.logs[0].header

    @cached_property
    def topics(self) -> list[str]:
        """Return the names of all topics, with or without messages."""
        return sorted({name for log in self.logs for name in log.topics})

    @property
    def size(self) -> int:
        """Return the bytes of all files."""
        return sum(log.size for log in self.logs)

    @property
    def span(self) -> tuple[int, int]:
        """Return log_time [ns] of the first and of the last message; (0, 0) when there is none."""
        spans = [log.span for log in self.logs if log.span != (0, 0)]
        return (min(s[0] for s in spans), max(s[1] for s in spans)) if spans else (0, 0)

    @property
    def events(self) -> list[dict[str, Any]]:
        """Return the events of all segments, each with its `log_time` [ns]."""
        return [event for log in self.logs for event in log.events]

    @property
    def sentinel(self) -> dict[str, Any]:
        """Return why the last file ends; {} when nothing says so."""
        return self.logs[-1].sentinel

    @property
    def dropouts(self) -> list[dict[str, Any]]:
        """Return the dropouts of all segments."""
        return [d for log in self.logs for d in log.dropouts]

    @property
    def damaged(self) -> int:
        """Return the chunks met so far that could not be read."""
        return sum(log.damaged for log in self.logs)

    def __iter__(self) -> Iterator[str]:
        return iter(self.topics)

    def __contains__(self, topic: str) -> bool:
        return topic in self.topics

    def __getitem__(self, topic: str) -> Topic:
        """Return one topic's messages over all segments. Raises LogError when no file has it."""
        return self.window(topic, 0, I64_MAX)

    def window(self, topic: str, start: int, stop: int) -> Topic:
        """Return the messages of a topic with start <= log_time < stop [ns].

        Raises LogError when no file has the topic.
        """
        parts = [log.window(topic, start, stop) for log in self.logs if topic in log]
        if not parts:
            raise LogError(f"{self.path}: no topic {topic}; it has {', '.join(self.topics)}")
        return joined(parts)

    def pieces(self, topic: str) -> Iterator[Topic]:
        """Yield a topic chunk by chunk, so that any length fits into memory."""
        for log in self.logs:
            if topic in log:
                yield from log.pieces(topic)

    def count(self, topic: str) -> int:
        """Return the number of messages of a topic."""
        return sum(log.counts.get(topic, (0, 0, 0))[0] for log in self.logs)


def read_run(path: Path | str) -> Run:
    """Open all segments of the run that a file is one of.

    Raises LogError when a file cannot be read, is not an MCAP file, or a segment between the first and last is missing.
    """
    if not Path(path).is_file():
        read(path)  # says why not
    files = segments(path)
    numbers = [_number(file) for file in files] if len(files) > 1 else []
    if numbers and numbers != list(range(numbers[0], numbers[0] + len(files))):
        missing = sorted(set(range(numbers[0], numbers[-1])) - set(numbers))
        raise LogError(f"{path}: segments {', '.join(f'{n:03d}' for n in missing)} are missing beside it")
    return Run([read(file) for file in files])


def _number(path: Path) -> int:
    return int(path.name.removesuffix(".open").removesuffix(".mcap").rpartition(".")[2])

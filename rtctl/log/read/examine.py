"""A log's health: structure, checksums, indices, numbers, time, decoding."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from mcap.opcode import Opcode

from rtctl.errors import LogError
from rtctl.log import schema
from rtctl.log.mcap.names import INFO
from rtctl.log.mcap.summary import WRAP
from rtctl.log.mcap.walk import I64_MAX, MESSAGE, Damaged, chunk_data, chunk_head, chunk_messages, has_magic, walk
from rtctl.log.read.reader import Log, read
from rtctl.types import I64


class Finding(NamedTuple):
    """One thing that was looked at."""

    name: str
    good: bool
    text: str


def examine(path: Path, progress: Callable[[int], None] = lambda n: None) -> list[Finding]:
    """Return what is right and wrong with a file. Raises LogError when it cannot be read or is no MCAP file."""
    log = read(path)
    ours = INFO in log.metadata
    findings = [_ending(log), *_structure(log, progress, ours), *_channels(log, ours), *_decoding(log)]
    lost = sum(_int(d.get("count")) for d in log.dropouts)
    findings.append(Finding("dropouts", not lost, f"{lost} entries did not fit the ring" if lost else "none"))
    return findings


def _int(value: object) -> int:
    return value if isinstance(value, int) else 0


def _ending(log: Log) -> Finding:
    if not log.complete:
        torn = log.size - log.good
        return Finding("end", False, f"cut off, {torn} bytes torn; `rtctl log recover {log.path}` makes it whole")
    reason = str(log.sentinel.get("reason", "")) or "no sentinel says why"
    return Finding("end", True, f"whole: {reason}")


class _Times:
    """Whether log_time goes back within a channel, or beyond what can be shown."""

    def __init__(self) -> None:
        self.back = self.beyond = 0
        self._last: dict[int, int] = {}

    def add(self, channel: I64, time: I64) -> None:
        self.beyond += int((time == I64_MAX).sum())
        for number in np.unique(channel).tolist():
            times = time[channel == number]
            self.back += int((np.diff(times, prepend=self._last.get(number, times[0])) < 0).sum())
            self._last[number] = int(times[-1])

    def finding(self, ours: bool) -> Finding:
        texts = []
        if self.back:  # MCAP asks for no order; our own writer keeps it
            texts.append(f"{self.back} messages are earlier than the one before them in their channel")
        if self.beyond:
            texts.append(f"{self.beyond} messages are later than 2^63 ns, of the year 2262: they read as 2^63 - 1")
        return Finding("time", not (ours and texts), "; ".join(texts) or "does not go back in any channel")


def _structure(log: Log, progress: Callable[[int], None], ours: bool) -> list[Finding]:
    data = log.data
    chunks = messages = 0
    broken: list[str] = []
    times = _Times()
    good = 8
    for opcode, body, end in walk(data, 8, len(data)):
        good = end
        if opcode == Opcode.CHUNK:
            chunks += 1
            progress(end)
            try:
                rows = chunk_messages(chunk_data(data, chunk_head(data, body, end)))
            except Damaged as error:
                broken.append(str(error))
                continue
            messages += len(rows.time)
            times.add(rows.channel, rows.time)
        elif opcode == Opcode.MESSAGE and end - body >= MESSAGE.size:
            messages += 1
            channel, _, time, _ = MESSAGE.unpack_from(data, body)
            times.add(np.array([channel]), np.array([min(time, I64_MAX)]))
    start, magic = has_magic(data, len(data))
    rest = len(data) - good - (8 if magic else 0)
    text = f"{chunks - len(broken)} of {chunks} chunks unpack and match, {messages} messages"
    return [
        Finding(
            "records",
            start and rest == 0,
            f"{good} bytes of whole records" + (f", then {rest} that are none" if rest else ""),
        ),
        Finding("checksums", not broken, f"{text}; {broken[0]}" if broken else text),
        times.finding(ours),
    ]


def _channels(log: Log, ours: bool) -> list[Finding]:
    holes: dict[str, int] = {}
    unnumbered = set[str]()
    found = 0
    for name in log.topics:
        for numbers in log.sequences(name):  # each publisher counts for itself
            found += len(numbers)
            missing = missing_numbers(numbers)
            if missing is None:
                unnumbered.add(name)
            elif missing:
                holes[name] = holes.get(name, 0) + missing
    said = sum(n for n, _, _ in log.counts.values())
    texts = [f"holes: {', '.join(f'{name} {n}' for name, n in holes.items())}"] if holes else []
    texts += [f"not numbered one by one: {', '.join(sorted(unnumbered))}"] if unnumbered else []
    wrong = bool(holes or unnumbered) if ours else bool(holes)
    same = found == said
    return [
        Finding("sequence", not wrong, "; ".join(texts) or "no hole in any topic"),
        Finding("summary", same, f"{said} messages" if same else f"says {said} messages, {found} are there"),
    ]


def missing_numbers(sequence: I64) -> int | None:
    """Return how many numbers are missing among a channel's; None when they do not count its messages.

    MCAP leaves it to the publisher what a sequence number is: 0 throughout where it has none.
    """
    steps = np.diff(sequence) % WRAP
    if ((steps == 0) | (steps > WRAP // 2)).any():
        return None
    return int((steps - 1).sum())


def _decoding(log: Log) -> list[Finding]:
    try:
        header = log.header
    except LogError:
        return [Finding("header", True, "not written by rtctl: messages are left undecoded")]
    findings = [
        Finding("header", True, f"{header.robot}, {len(header.joints)} joints, config {header.config_sha256[:12]}")
    ]
    odd = []
    for name in log.topics:
        topic = log[name]
        try:
            if topic.dtype is not None or topic.schema == "rtctl.CanFrame":
                for piece in log.pieces(name):
                    _ = piece.array
            elif topic.encoding == "json" and any("raw" in content for content in topic.json):
                odd.append(f"{name}: not JSON")
        except LogError as error:
            odd.append(str(error))
    ticks = log[schema.TICK].field("tick").astype(np.int64) if schema.TICK in log and not odd else np.zeros(0, np.int64)
    gaps = int((np.diff(ticks) != 1).sum())
    findings.append(Finding("decoding", not odd, "; ".join(odd) or "every message is what its schema says"))
    findings.append(
        Finding("ticks", not gaps, f"{len(ticks)} without a gap" if not gaps else f"{gaps} gaps in {len(ticks)}")
    )
    return findings

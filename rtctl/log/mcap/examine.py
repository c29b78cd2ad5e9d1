"""A log's health: structure, checksums, indices, numbers, time, decoding; and making a damaged one whole."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import make_reader

from rtctl.errors import LogError
from rtctl.log import schema
from rtctl.log.mcap.recovery import recover
from rtctl.log.mcap.segment import OPEN
from rtctl.log.mcap.summary import WRAP
from rtctl.log.mcap.walk import Damaged, chunk_data, chunk_head, chunk_messages, has_magic, walk
from rtctl.log.read.reader import Log, read

RECOVERED = ".recovered"
LOSSLESS, LOSSY = 0, 3  # exit codes of `recover`; 1 is failed


class Finding(NamedTuple):
    """One thing that was looked at."""

    name: str
    good: bool
    text: str


class Mended(NamedTuple):
    """What became of a file that was recovered."""

    source: Path
    path: Path
    messages: int
    lost_bytes: int
    damaged: int
    independent: int  # messages that the mcap package's own reader finds in the result

    @property
    def code(self) -> int:
        """Return the exit code."""
        return LOSSY if self.lost_bytes or self.damaged else LOSSLESS


def examine(path: Path, progress: Callable[[int], None] = lambda n: None) -> list[Finding]:
    """Return what is right and wrong with a file. Raises LogError when it cannot be read or is no MCAP file."""
    log = read(path)
    findings = [_ending(log), *_structure(path, progress), *_channels(log), *_decoding(log)]
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


def _structure(path: Path, progress: Callable[[int], None]) -> list[Finding]:
    data = path.read_bytes()
    chunks = broken = messages = 0
    order = True
    last: dict[int, int] = {}
    good = 8
    for opcode, body, end in walk(data, 8, len(data)):
        good = end
        if opcode == Opcode.CHUNK:
            chunks += 1
            progress(end)
            try:
                rows = chunk_messages(chunk_data(data, chunk_head(data, body, end)))
            except Damaged:
                broken += 1
                continue
            messages += len(rows.time)
            for number in np.unique(rows.channel).tolist():
                times = rows.time[rows.channel == number]
                order &= bool((np.diff(times, prepend=last.get(number, times[0])) >= 0).all())
                last[number] = int(times[-1])
        elif opcode == Opcode.MESSAGE:
            messages += 1
    start, magic = has_magic(data, len(data))
    rest = len(data) - good - (8 if magic else 0)
    return [
        Finding(
            "records",
            start and rest == 0,
            f"{good} bytes of whole records" + (f", then {rest} that are none" if rest else ""),
        ),
        Finding("checksums", not broken, f"{chunks - broken} of {chunks} chunks unpack and match, {messages} messages"),
        Finding("time", order, "does not go back in any topic" if order else "goes back within a topic"),
    ]


def _channels(log: Log) -> list[Finding]:
    holes = {}
    found = 0
    for name in log.topics:
        topic = log[name]
        found += len(topic)
        if len(topic):
            gaps = (np.diff(topic.sequence) - 1) % WRAP
            if missing := int(gaps.sum()):
                holes[name] = missing
    said = sum(n for n, _, _ in log.counts.values())
    numbers = ", ".join(f"{name} {n}" for name, n in holes.items())
    same = found == said
    return [
        Finding("sequence", not holes, f"holes: {numbers}" if holes else "no hole in any topic"),
        Finding("summary", same, f"{said} messages" if same else f"says {said} messages, {found} are there"),
    ]


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


def mend(path: Path, out: Path | None = None) -> Mended:
    """Make a file whole: a `.open` one in place, any other as a copy beside it (or at `out`); verify the result.

    Raises LogError when nothing can be used or the result does not hold what was found, OSError when the disk refuses.
    """
    if path.suffix == OPEN and out is None:
        done = recover(path)
    else:
        stem = path.name.removesuffix(OPEN).removesuffix(".mcap")
        target = out if out is not None else path.with_name(f"{stem}{RECOVERED}.mcap")
        if target.exists():
            raise LogError(f"{target}: is there already")
        copy = target.with_name(target.name + OPEN)
        read(path)  # says why not, before anything is copied
        shutil.copyfile(path, copy)
        done = recover(copy)
    if not done.path.name.endswith(".mcap"):
        raise LogError(f"{done.path}: nothing in it can be used")
    count = independent_count(done.path)
    ours = sum(n for n, _, _ in read(done.path).counts.values())
    if count != ours or not read(done.path).complete:
        raise LogError(f"{done.path}: after recovery {ours} messages, another reader finds {count}")
    return Mended(path, done.path, done.messages, done.lost_bytes, done.damaged, count)


def independent_count(path: Path) -> int:
    """Return how many messages the mcap package reads. Raises LogError when it cannot."""
    try:
        with path.open("rb") as file:
            return sum(1 for _ in make_reader(file, validate_crcs=True).iter_messages(log_time_order=False))
    except (McapError, ValueError, OSError) as error:
        raise LogError(f"{path}: {error}") from None


def open_files(folder: Path) -> list[Path]:
    """Return the files of a folder that were never closed."""
    return sorted(p for p in folder.glob("*.mcap" + OPEN) if os.access(p, os.R_OK))

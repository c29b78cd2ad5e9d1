"""Making damaged logs whole: copied under a temporary name, read again by two readers, only then given their name."""

import os
from pathlib import Path
from typing import NamedTuple

from mcap.reader import make_reader

from rtctl.errors import LogError
from rtctl.log.mcap.names import OPEN, logs_in
from rtctl.log.mcap.rebuild import Rebuilt, rebuild
from rtctl.log.mcap.segment import MODE, Segment, locked, settle
from rtctl.log.mcap.summary import Summary
from rtctl.log.mcap.walk import Damaged, Source
from rtctl.log.read.reader import read

RECOVERED = ".recovered"
LOSSLESS, LOSSY = 0, 3  # exit codes of `recover`; 1 is failed
CUT_OFF = {"reason": "cut off"}  # of the sentinel


class Mended(NamedTuple):
    """What became of a file that was recovered."""

    source: Path
    path: Path
    messages: int
    lost_bytes: int
    damaged: int  # chunks and other records that could not be used, or not whole
    independent: int  # messages that the mcap package's own reader finds in the result

    @property
    def code(self) -> int:
        """Return the exit code."""
        return LOSSY if self.lost_bytes or self.damaged else LOSSLESS


def mend(path: Path, out: Path | None = None) -> Mended:
    """Make a file whole: a `.open` one takes its final name, any other is copied beside it (or to `out`).

    Raises LogError when somebody is writing it, nothing in it can be used or the result does not hold what was found,
    OSError when the disk refuses; the file itself is then as it was.
    """
    closes = path.suffix == OPEN and out is None
    target = out if out is not None else path.with_name(_target(path, closes))
    if target.exists():
        raise LogError(f"{target}: is there already")
    data = read(path).data  # says why not
    lock = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        if not locked(lock):
            raise LogError(f"{path}: is being written")
        done, count = _copied(path, data, target)
        if closes:
            path.unlink()
    finally:
        os.close(lock)
    return Mended(path, target, done.messages, done.lost_bytes, done.damaged, count)


def _target(path: Path, closes: bool) -> str:
    name = path.name.removesuffix(OPEN).removesuffix(".mcap")
    return f"{name}.mcap" if closes else f"{name}{RECOVERED}.mcap"


def _copied(path: Path, data: Source, target: Path) -> tuple[Rebuilt, int]:
    """Write the whole file under a name that no reader looks for, verify it, rename it."""
    part = target.with_name(f".{target.name}.{os.getpid()}.part")
    file = os.open(part, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, MODE)
    segment = Segment(part, file, Summary(), 0)
    try:
        done = rebuild(data, segment, CUT_OFF)
        count = _verified(part, done)
        settle(part, target)
    except Damaged as error:
        raise LogError(f"{path}: {error}") from None
    finally:
        segment.close()
        part.unlink(missing_ok=True)
    return done, count


def _verified(path: Path, done: Rebuilt) -> int:
    """Return how many messages another reader finds. Raises LogError unless all that were found can be read again."""
    count = independent_count(path)
    log = read(path)
    ours = sum(n for n, _, _ in log.counts.values())
    again = sum(len(log[name]) for name in log.topics)
    if not log.complete or not count == ours == again == done.written:
        raise LogError(f"{path.name}: {done.written} messages were written, {again} and {count} are read again")
    return count


def independent_count(path: Path) -> int:
    """Return how many messages the mcap package reads. Raises LogError when it cannot."""
    try:
        with path.open("rb") as file:
            return sum(1 for _ in make_reader(file, validate_crcs=True).iter_messages(log_time_order=False))
    except Exception as error:  # another program's reader: whatever it raises, it is the file's fault
        raise LogError(f"{path}: {str(error) or type(error).__name__}") from None


def open_files(folder: Path) -> list[Path]:
    """Return the files of a folder that were never closed."""
    return [path for path in logs_in(folder) if path.suffix == OPEN and os.access(path, os.R_OK)]

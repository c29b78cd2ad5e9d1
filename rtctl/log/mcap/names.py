"""Which files are one run: by what each says of its session in its first records, in the order of its own number."""

import mmap
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

from mcap import records
from mcap.opcode import Opcode

from rtctl.log.limits import HEAD
from rtctl.log.mcap.walk import Damaged, has_magic, parsed, walk

OPEN = ".open"  # suffix while a file is being written
INFO = "rtctl"  # the metadata record with the header and the session
PIN = ".pin"  # a file of this suffix beside a log keeps it from being deleted


class Origin(NamedTuple):
    """What a segment says of itself."""

    order: int  # of its session among those of the folder; 0 where an older program did not say
    session: str
    segment: int


def metadata(origin: Origin) -> dict[str, str]:
    """Return an origin as a file's metadata has it."""
    return {"session_order": str(origin.order), "session": origin.session, "segment": str(origin.segment)}


def origin_of(path: Path) -> Origin | None:
    """Return what a file says of itself; None when it cannot be read or says nothing."""
    try:
        if not path.is_file():  # a pipe would not even let itself be opened
            return None
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            return _origin(data)
    except (OSError, ValueError):
        return None


def _origin(data: mmap.mmap) -> Origin | None:
    if not has_magic(data, len(data))[0]:
        return None
    try:
        for opcode, body, end in walk(data, 8, min(len(data), HEAD)):
            if opcode == Opcode.CHUNK:
                return None
            if opcode == Opcode.METADATA:
                found = parsed(records.Metadata.read, data, body, end)
                if found.name == INFO:
                    return _said(found.metadata)
    except Damaged:
        pass
    return None


def _said(entry: dict[str, str]) -> Origin | None:
    session, segment, order = (entry.get(key, "") for key in ("session", "segment", "session_order"))
    numbers = [number(text) for text in (segment, order or "0")]
    return Origin(numbers[1], session, numbers[0]) if session and min(numbers) >= 0 else None


def number(text: str) -> int:
    """Return a number as a file name or metadata has it; -1 when it is none."""
    return int(text) if text.isascii() and text.isdigit() and len(text) < 16 else -1


def plain(path: Path) -> str:
    """Return a log's name without its endings."""
    return path.name.removesuffix(OPEN).removesuffix(".mcap")


def logs_in(folder: Path) -> Iterator[Path]:
    """Yield the log files of a folder, closed or not."""
    try:
        found = sorted(folder.iterdir())
    except OSError:
        return
    yield from (path for path in found if path.name.removesuffix(OPEN).endswith(".mcap"))


def session_files(paths: Iterable[Path], session: str) -> list[tuple[int, Path]]:
    """Return (number, path) of the files of a session, in the order of their numbers."""
    found = ((origin_of(path), path) for path in paths)
    return sorted((origin.segment, path) for origin, path in found if origin is not None and origin.session == session)


def beside(path: Path) -> list[tuple[int, Path]]:
    """Return (number, path) of all files of a folder that are of the same session as a file, in their order.

    A file that says nothing of a session is by itself; so is one whose place another file takes too, such as a copy.
    """
    mine = origin_of(path)
    if mine is None:
        return [(0, path)]
    others = session_files(logs_in(path.parent), mine.session)
    return sorted([(mine.segment, path), *(row for row in others if row[0] != mine.segment)])


def segment_name(session: str, segment: int) -> str:
    """Return the file name of a session's segment."""
    return f"{session}.{segment:03d}.mcap"

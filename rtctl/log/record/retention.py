"""Which logs of a folder are the oldest, and go first when the disk is to keep free room."""

import contextlib
from collections import deque
from collections.abc import Callable
from pathlib import Path

from rtctl.log.mcap.names import OPEN, PIN, logs_in, origin_of, plain, segment_name


def old_segments(folder: Path) -> list[Path]:
    """Return the closed segments of a folder that recorders wrote, the oldest session's first, each by its numbers.

    Another program's files, and those that bear another name than their segment's, are nobody's to delete.
    """
    found = []
    for path in logs_in(folder):
        origin = origin_of(path) if path.suffix != OPEN else None
        if origin is not None and path.name == segment_name(origin.session, origin.segment):
            found.append((origin, path))
    return [path for _, path in sorted(found)]


def session_order(folder: Path, session: str) -> int:
    """Return a session's place among those of a folder: its own where it has segments there, else behind all others."""
    firsts = {plain(path).rpartition(".")[0]: path for path in logs_in(folder)}  # one file of each is enough
    origins = [origin for origin in map(origin_of, firsts.values()) if origin is not None]
    own = [origin.order for origin in origins if origin.session == session and origin.order]
    return own[0] if own else max((origin.order for origin in origins), default=0) + 1


class Retention:
    """Deletes the oldest segments of a folder; those with a `.pin` beside them stay.

    Which is older, sessions and their numbers tell, never a clock: after a start at 1970 yesterday's are older yet.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._oldest: deque[Path] = deque()  # as last looked: looking at each of thousands takes a second

    def make_room(self, enough: Callable[[], bool]) -> bool:
        """Delete until there is enough room; return whether there is."""
        for looked in (False, True):
            if looked:
                self._oldest = deque(old_segments(self._folder))
            while self._oldest:
                path = self._oldest.popleft()
                if path.with_name(path.name + PIN).exists():
                    continue
                with contextlib.suppress(OSError):
                    path.unlink()
                if enough():
                    return True
        return False

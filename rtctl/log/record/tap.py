"""Looking into a ring that a servo fills and a recorder drains, without either knowing: mapped read-only.

Nothing protects what a looker reads, for the producer waits for the recorder alone. So entries are copied first, and
then believed only if the producer cannot have come round to them meanwhile: `head` at the end of the copy is less than
a lap, less MARGIN, ahead of where the copy began.
"""

import mmap
import os
import tempfile
from pathlib import Path
from typing import NamedTuple, TypeAlias

from rtctl.errors import LinkError
from rtctl.log.entry import Kind
from rtctl.log.record import ring as rings
from rtctl.log.record.ring import HEAD, HEAD_AT, HEAD_SIZE, PARTS, TAIL, WRAP, Ring
from rtctl.trust import TrustError, open_file, plain_name

MARGIN = 256 << 10  # [bytes] that the producer may be writing beyond `head`: more than any one piece of a real ring
WANTED = frozenset((int(Kind.REQUEST), int(Kind.EVENT)))  # kept all; of ticks the newest is enough
TICK = int(Kind.TICK)
Message: TypeAlias = tuple[int, bytes]  # kind and payload


class Look(NamedTuple):
    """What a look brought."""

    tick: bytes  # the newest record, b"" when there is none since the last look
    messages: list[Message]  # requests and events, in their order
    lost: bool  # some were missed: the looker was away for a lap


class Tap(Ring):
    """The looker's end of a ring."""

    def __init__(self, path: Path) -> None:
        """Map the ring read-only. Raises LinkError when it is none, TrustError when another user's, OSError."""
        file = open_file(path, os.O_RDONLY, (os.geteuid(),), private=True)
        try:
            super().__init__(path, file, mmap.ACCESS_READ)
        except LinkError:
            os.close(file)
            raise
        self._room = self.capacity - min(MARGIN, self.capacity // 4)
        self._at = self.words[TAIL]

    def look(self) -> Look:
        """Return what came since the last look."""
        head = self.words[HEAD_AT]
        if self._fence is not None:
            self._fence()
        lost = head - self._at > self._room
        if lost:
            self._at = self.words[TAIL]
        begun, found = self._at, self._copied(head)
        if self._fence is not None:
            self._fence()
        if found is None or (begun != head and self.words[HEAD_AT] - begun > self._room):
            self._at = self.words[TAIL]
            return Look(b"", [], True)
        return Look(found[0], found[1], lost)

    def _copied(self, head: int) -> tuple[bytes, list[Message]] | None:
        """Return the newest record and the messages up to `head`; None when an entry makes no sense."""
        tick, messages, position = (0, 0), list[Message](), self._at
        while position < head:
            at = position & self.mask
            start = self.data_at + at
            length, kind, _, _, _, parts = HEAD.unpack_from(self.map, start)
            if length == WRAP:
                position += self.capacity - at
                continue
            if at + HEAD_SIZE + length > self.capacity or not 0 < parts <= PARTS:
                return None
            start += HEAD_SIZE
            if kind == TICK:
                tick = (start, start + length)
            elif kind in WANTED:
                messages.append((kind, bytes(self.map[start : start + length])))
            position += (length + HEAD_SIZE + 7) & ~7
        self._at = position
        return bytes(self.map[tick[0] : tick[1]]), messages

    @property
    def closed(self) -> bool:
        """Return whether the producer said that nothing more will come."""
        return bool(self.words[rings.CLOSED])

    @property
    def ended(self) -> bool:
        """Return whether nothing more will come: the producer said so, or is gone."""
        return self.closed or not self.producer_alive()


def living(robot: str = "") -> list[Path]:
    """Return the rings of this user's servo processes that live, of one robot or of all; the newest last."""
    found = []
    for folder in (rings.SHM, Path(tempfile.gettempdir())):
        for path in folder.glob(f"rtctl-{plain_name(robot) + '-' if robot else ''}*.ring"):
            try:
                tap = Tap(path)
            except (LinkError, TrustError, OSError):
                continue
            if not tap.ended:
                found.append((path.stat().st_mtime, path))
            tap.unmap()
    return [path for _, path in sorted(found)]

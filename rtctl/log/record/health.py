"""When a log loses too much to be relied on, and when an event says too often what it has said."""

import math
from typing import NamedTuple

DROP_RATE = 0.01  # share of the entries of a window; above it the log is degraded: no run can be replayed from it
WINDOW = 1.0  # [s] over which drops are counted
HOLD = 5.0  # [s] without such a window before the log is relied on again
BURST = 10  # events of one kind that are told within PERIOD; further ones are counted
PERIOD = 10.0  # [s]


class _Window(NamedTuple):
    start: float  # [s]
    entries: int  # offered and dropped when it began
    dropped: int


class DropWatch:
    """Tells from the counts of a ring whether it drops more than DROP_RATE of what is put."""

    def __init__(self) -> None:
        self._window = _Window(0.0, 0, 0)
        self._until = -1.0  # [s] up to which the log is degraded

    def update(self, now: float, entries: int, dropped: int) -> bool:
        """Return whether too much is being lost.

        now: [s] of a monotonic clock; entries, dropped: how many were offered to the ring since its start, and refused.
        """
        window = self._window
        if now - window.start >= WINDOW:
            if dropped - window.dropped > DROP_RATE * (entries - window.entries):
                self._until = now + HOLD
            self._window = _Window(now, entries, dropped)
        return now < self._until


class Repeats:
    """Lets the first BURST events of a kind through in each PERIOD, and says how many it kept back."""

    def __init__(self) -> None:
        self._kinds: dict[str, tuple[float, int]] = {}  # when the kind's period began, events in it
        self._until = math.inf  # [s] the first of these periods ends

    def passed(self, now: float, events: list[tuple[str, str]]) -> list[tuple[str, str]]:
        """Return those of (name, detail) that are told at robot time `now` [s], and what was kept back before."""
        if not events and now < self._until:  # nearly always
            return events
        told = self._ended(now)
        for name, detail in events:
            kind = kind_of(name, detail)
            start, count = self._kinds.get(kind, (now, 0))
            self._kinds[kind] = start, count + 1
            if count < BURST:
                told.append((name, detail))
        self._until = min((start + PERIOD for start, _ in self._kinds.values()), default=math.inf)
        return told

    def _ended(self, now: float) -> list[tuple[str, str]]:
        """Forget the kinds whose period is over; return an event for each that was kept back."""
        over = [kind for kind, (start, _) in self._kinds.items() if now - start >= PERIOD]
        counts = {kind: self._kinds.pop(kind)[1] for kind in over}
        return [
            ("repeated", f"{kind}: {count - BURST} more in {PERIOD:g} s")
            for kind, count in counts.items()
            if count > BURST
        ]


def kind_of(name: str, detail: str) -> str:
    """Return what counts as the same event: its name, and the first word of what it is about."""
    first = detail.split(maxsplit=1)[0].rstrip(":,;") if detail.strip() else ""
    return f"{name} {first}".rstrip()

"""An arm that is led along a way: how far it has come, since when, and whether it waits for what moves."""

import numpy as np

from rtctl.app.postures import Site
from rtctl.app.way import comes, heading, progress, travelled, way_of, yielding
from rtctl.types import F64, Advice

NEAR, NEARLY = 0.06, 0.015  # [rad], [m] of points, from the end of a way, where the goal itself is headed for
STUCK = 0.8  # [s] without progress along a way
PATIENCE = 0.5  # [s] for which it waits for what moves, then another way is planned


class Course:
    """A way of postures, and an arm on it."""

    def __init__(self, site: Site, path: F64) -> None:
        """Begin at the first posture of a path (k, n) [rad]."""
        self.way, self.at = way_of(site, path), 0
        self.moved_at = -1  # tick of the last progress; -1: none yet
        self.waits_since = -1  # tick; -1: it does not wait
        self.blocked = False  # something comes across the way

    def come(self, tick: int, q: F64) -> None:
        """Take note of where the joints q (n,) [rad] are."""
        at = progress(self.way, self.at, q)
        if at > self.at or self.moved_at < 0:
            self.at, self.moved_at = at, tick

    def ended(self, site: Site) -> bool:
        """Return whether the arm is at the end of the way."""
        end = self.way.Q[-1:]
        return bool(np.abs(site.start - end[0]).max() < NEAR and travelled(site, end)[0] < NEARLY)

    def look(self, site: Site) -> None:
        """See whether something comes across the way ahead."""
        self.blocked = comes(site, self.way, self.at)

    def waits(self, tick: int) -> bool:
        """Return whether it waits already; from now on it does: what moves is no lack of progress."""
        waited, self.moved_at = self.waits_since >= 0, tick
        self.waits_since = self.waits_since if waited else tick
        return waited

    def goes(self) -> None:
        """Go on."""
        self.waits_since = -1

    def patient(self, tick: int, dt: float) -> bool:
        """Return whether it goes on waiting; dt [s] of a tick."""
        return (tick - self.waits_since) * dt <= PATIENCE

    def stuck(self, tick: int, dt: float) -> bool:
        """Return whether it has not come on for too long; dt [s] of a tick."""
        return (tick - self.moved_at) * dt > STUCK

    def first(self, site: Site) -> Advice:
        """Return what to head for at the start, before anything was looked at."""
        return heading(site, self.way, self.at, False)

    def on(self, site: Site) -> Advice:
        """Return what to head for."""
        return heading(site, self.way, self.at, True)

    def aside(self, site: Site) -> Advice:
        """Return what to head for while something comes."""
        return yielding(site, self.way, self.at)

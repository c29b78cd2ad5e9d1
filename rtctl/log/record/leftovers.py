"""Rings that processes left when they were killed: where they lie, and those that nobody needs."""

import contextlib
import json
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

from rtctl.errors import LinkError
from rtctl.log.record import ring as rings
from rtctl.log.record.ring import attach
from rtctl.trust import TrustError

PREFIX = "rtctl-"
SUFFIX = ".ring"


def sweep(folders: Sequence[Path] = ()) -> None:
    """Remove the rings that simulations of this user left when they were killed: no log is of them."""
    for path in rings_in(folders):
        with contextlib.suppress(LinkError, TrustError, OSError):
            ring = attach(path)
            try:
                left = not ring.producer_alive() and _logless(ring.blob)
            finally:
                ring.unmap()
            if left:
                path.unlink()


def _logless(blob: bytes) -> bool:
    """Return whether a ring says that no log is made of it; one that says nothing sensible does not."""
    try:
        said = json.loads(blob)
    except (ValueError, RecursionError):
        return False
    return isinstance(said, dict) and said.get("options") == []


def rings_in(folders: Sequence[Path] = ()) -> Iterator[Path]:
    """Yield the ring files of folders, by default those where rings are made."""
    for folder in folders or (rings.SHM, Path(tempfile.gettempdir())):
        yield from sorted(folder.glob(f"{PREFIX}*{SUFFIX}"))

"""The signing key of a link and what must survive a restart: the newest timestamp of every stream.

The file holds a lease: stamps a little ahead of the newest, so that it is written seldom and still nothing recorded
before a kill -9 is taken as new after it. A peer that signs by its clock is silent to us for at most that lease.
"""

import os
import time
from collections.abc import Callable
from pathlib import Path

from rtctl.errors import ConfigError
from rtctl.protocol import signing
from rtctl.protocol.signing import Frame, State, Verdict

LEASE = 2 * 100_000  # [10 us] two seconds


class Keys:
    """Signs and judges frames; without a key it lets everything through, unsigned."""

    def __init__(
        self,
        key: bytes | None,
        path: Path | None,
        link: int = 0,
        unix_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        """`path` keeps timestamps over restarts. Raises ConfigError for a file that is none."""
        self._key, self._path, self._link, self._unix_ns = key, path, link, unix_ns
        self._state, self._leased = signing.NOTHING, signing.NOTHING
        if key is not None and path is not None:
            self._state = self._leased = _read(path)

    def judge(self, frame: Frame) -> Verdict:
        """Return what a frame is worth."""
        if self._key is None:
            return Verdict.GOOD if frame.version == 1 or not frame.flags & ~signing.SIGNED else Verdict.MALFORMED
        verdict, self._state = signing.verify(frame, self._key, self._state, signing.timestamp(self._unix_ns()))
        return verdict

    def signed(self, raw: bytes, checksum_extra: int) -> bytes:
        """Return a packed frame as it goes out."""
        if self._key is None:
            return raw
        now = signing.timestamp(self._unix_ns())
        out, self._state = signing.sign(raw, self._key, self._link, self._state, now, checksum_extra)
        return out

    def keep(self, last: bool = False) -> None:
        """Renew the lease where it has run out; at the end write the stamps themselves."""
        if self._path is None or self._key is None:
            return
        s, leased = self._state, self._leased
        out = s.sent > leased.sent or any(stamp > leased.streams.get(k, -1) for k, stamp in s.streams.items())
        if last:
            _write(self._path, s)
        elif out:
            self._leased = State({k: stamp + LEASE for k, stamp in s.streams.items()}, s.sent + LEASE)
            _write(self._path, self._leased)


def _read(path: Path) -> State:
    try:
        return signing.from_text(path.read_text(encoding="ascii"))
    except FileNotFoundError:
        return signing.NOTHING
    except (OSError, ValueError) as error:
        raise ConfigError(f"link.state_file {path}", str(error), "timestamps of signed streams, or no file") from None


def _write(path: Path, state: State) -> None:
    """Replace the file as a whole; a disk that is full costs replay protection after a restart, never a tick."""
    new = path.with_name(path.name + ".new")
    try:
        descriptor = os.open(new, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o600)
        with os.fdopen(descriptor, "w", encoding="ascii") as file:
            file.write(signing.to_text(state))
        os.replace(new, path)
    except OSError:
        return

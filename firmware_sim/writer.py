"""Writes a file again and again in a process of its own: a disk can be busy for longer than a drive may sleep.

The process is this file, run by itself; hence the standard library alone.
"""

import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

TEXT_MAX = 1 << 18  # bytes


class Writer:
    """Owns the process."""

    def __init__(self, path: str) -> None:
        self.path = Path(path).absolute()
        self._socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 2 * TEXT_MAX)
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-I", "-S", __file__, str(self.path)], stdin=theirs.fileno()
            )
        self._socket.setblocking(False)

    def put(self, text: bytes) -> None:
        """Hand a text over, or drop it: the next one says more."""
        try:
            self._socket.send(text)
        except OSError:  # busy with those before, or too long a text
            return

    def close(self, text: bytes) -> None:
        """Write the last text, after all that was handed over."""
        self._socket.close()
        self._process.wait()
        write(self.path, text)


def write(path: Path, text: bytes) -> None:
    """Write to a neighbour first and rename it, so that a reader never sees half of it."""
    beside = path.with_name(f".{path.name}.{os.getpid()}")
    beside.write_bytes(text)
    os.replace(beside, path)


def main(path: Path) -> None:
    """Write what comes on standard input, until it ends."""
    for number in (signal.SIGTERM, signal.SIGINT):  # they are for the drives, whose end ends this
        signal.signal(number, signal.SIG_IGN)
    while text := os.read(0, TEXT_MAX):
        write(path, text)


if __name__ == "__main__":
    main(Path(sys.argv[1]))

"""pybullet without its chatter on stdout and stderr, which belong to machine-readable output."""

import ctypes
import os
from collections.abc import Iterator
from contextlib import contextmanager

_libc = ctypes.CDLL(None)


@contextmanager
def silent() -> Iterator[None]:
    """Send file descriptors 1 and 2 to nowhere meanwhile; what Python has buffered is not touched."""
    saved = os.dup(1), os.dup(2)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    _libc.fflush(None)
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)
    try:
        yield
    finally:
        _libc.fflush(None)
        os.dup2(saved[0], 1)
        os.dup2(saved[1], 2)
        for fd in (*saved, nowhere):
            os.close(fd)


with silent():
    import pybullet as pb

__all__ = ["pb", "silent"]

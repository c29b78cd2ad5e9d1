"""pybullet without its chatter on stdout and stderr, which belong to machine-readable output.

Where it is not installed, as on Pythons that it has no wheel for, `stand_in` answers for it: then MuJoCo moves the arm.
"""

import ctypes
import os
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from importlib.util import find_spec
from types import ModuleType

IS_THERE = find_spec("pybullet") is not None or find_spec("mujoco") is None  # without both, pybullet is what lacks
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
    pb: ModuleType = import_module("pybullet" if IS_THERE else "firmware_sim.stand_in")

__all__ = ["IS_THERE", "pb", "silent"]

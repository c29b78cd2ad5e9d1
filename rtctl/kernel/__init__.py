"""The servo level's compiled code: one decorator for all kernels, and the mathematics that they share."""

from collections.abc import Callable
from typing import ParamSpec, TypeVar

from numba import njit

_P = ParamSpec("_P")
_R = TypeVar("_R")


def kernel(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Compile a function that is also valid plain Python: NUMBA_DISABLE_JIT=1 gives the same bits, slowly.

    fastmath is off: sums keep their order, so that equal inputs give equal bits.
    """
    compiled: Callable[_P, _R] = njit(cache=True, fastmath=False)(function)
    return compiled


def ieee_kernel(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Compile as `kernel` does, without Python's test for division by zero: the loop then vectorises."""
    compiled: Callable[_P, _R] = njit(cache=True, fastmath=False, error_model="numpy")(function)
    return compiled

"""The servo level's compiled code: one decorator for all kernels, and the mathematics that they share."""

from collections.abc import Callable
from contextlib import suppress
from typing import Literal, ParamSpec, TypeVar

from numba import njit

from rtctl.kernel.cache import install

_P = ParamSpec("_P")
_R = TypeVar("_R")


def kernel(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Compile a function that is also valid plain Python: NUMBA_DISABLE_JIT=1 gives the same bits, slowly.

    fastmath is off: sums keep their order, so that equal inputs give equal bits.
    """
    return _compiled(function, "python")


def ieee_kernel(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Compile as `kernel` does, without Python's test for division by zero: the loop then vectorises."""
    return _compiled(function, "numpy")


def _compiled(function: Callable[_P, _R], errors: Literal["python", "numpy"]) -> Callable[_P, _R]:
    compiled: Callable[_P, _R] = njit(fastmath=False, error_model=errors)(function)
    if compiled is not function:  # it is, where NUMBA_DISABLE_JIT=1
        with suppress(LookupError):  # a script's or a shell's own kernels are compiled each time
            install(compiled, function)
    return compiled

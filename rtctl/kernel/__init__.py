"""The servo level's compiled code: one decorator for all kernels, and the mathematics that they share."""

import sys
from collections.abc import Callable
from contextlib import suppress
from importlib import import_module
from typing import Literal, ParamSpec, Protocol, TypeVar, cast

from numba import njit, typeof

from rtctl.kernel.cache import install

_P = ParamSpec("_P")
_R = TypeVar("_R")


def _without_lapack() -> None:
    """Have numba loaded as if SciPy's LAPACK were not there.

    It looks for that when it compiles or loads its first function, for convolutions alone, which no kernel has; to
    load SciPy takes as long as numba itself. A function that multiplies matrices by BLAS finds it later all the same.
    """
    name, modules = "scipy.linalg.cython_blas", cast(dict[str, object], sys.modules)
    if name not in modules:
        modules[name] = None  # an import of it fails
        try:
            import_module("numba.np.arraymath")
        finally:
            del modules[name]


_without_lapack()


def kernel(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Compile a function that is also valid plain Python: NUMBA_DISABLE_JIT=1 gives the same bits, slowly.

    fastmath is off: sums keep their order, so that equal inputs give equal bits.
    """
    return _compiled(function, "python", counting=True)


def ieee_kernel(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Compile as `kernel` does, without Python's test for division by zero: the loop then vectorises."""
    return _compiled(function, "numpy", counting=True)


def leaf_kernel(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Compile as `ieee_kernel` does a function that makes no arrays: no references are counted in it.

    What it is given belongs to the caller. Each count would be an atomic addition; a dozen of them, two for each array
    of a named tuple that is unpacked, cost as much as the distances of sixteen points. So would the call: an array is
    seven numbers to pass, a model a hundred; it is compiled into its caller. An array made in it is an error when it is
    compiled. It may return numbers; arrays only to another leaf: to a kernel or to Python they would not be its own.
    """
    return _compiled(function, "numpy", counting=False)


def _compiled(function: Callable[_P, _R], errors: Literal["python", "numpy"], counting: bool) -> Callable[_P, _R]:
    # _nrt is always said: unsaid, a kernel takes it from the one that is compiled first to call it
    compiled: Callable[_P, _R] = njit(  # type: ignore[call-overload]
        fastmath=False, error_model=errors, _nrt=counting, forceinline=not counting, no_cfunc_wrapper=True
    )(function)
    if compiled is not function:  # it is, where NUMBA_DISABLE_JIT=1
        with suppress(LookupError):  # a script's or a shell's own kernels are compiled each time
            install(compiled, function)
    return compiled


class _Compiled(Protocol):
    def compile(self, signature: tuple[object, ...]) -> object: ...


def compile_for(function: Callable[..., object], *values: object) -> None:
    """Compile a kernel for arguments of the types that these values have, without a call of it."""
    types = tuple(typeof(value) for value in values)  # type: ignore[no-untyped-call]
    cast(_Compiled, function).compile(types)

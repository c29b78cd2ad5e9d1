"""One decorator for the compiled code of the virtual drives, cached by the sources that it is made of.

numba looks only at the file that defines a function: a kernel cached before a bound in another file changed would go on
with the old one. Hence a folder that is named after all of them.
"""

import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import numba

_P = ParamSpec("_P")
_R = TypeVar("_R")
_settings: Any = numba.config  # whose attributes come from the environment
_SOURCES = ("bank_kernels", "cells", "codec", "drive", "kernel", "nearness")


def _folder() -> Path:
    """Return the folder of these sources: beside those of the controller, or where NUMBA_CACHE_DIR says."""
    cache = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    own = Path(cache) / "rtctl"
    given = os.environ.get("NUMBA_CACHE_DIR", "")
    base = own if not given or Path(given).parent == own else Path(given)  # a folder in `own` is the controller's
    digest = hashlib.sha256()
    for name in _SOURCES:
        digest.update(Path(__file__).with_name(f"{name}.py").read_bytes())
    return base / f"drives-{digest.hexdigest()[:16]}"


_FOLDER = str(_folder())


def cold() -> bool:
    """Tell whether nothing is compiled yet: the first start of these sources takes some seconds more."""
    return not os.path.isdir(_FOLDER)


def kernel(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Compile a function that is also valid plain Python; sums keep their order, so equal inputs give equal bits."""
    base, _settings.CACHE_DIR = _settings.CACHE_DIR, _FOLDER
    try:
        compiled: Callable[_P, _R] = numba.njit(cache=True, fastmath=False, error_model="numpy")(function)
    finally:
        _settings.CACHE_DIR = base
    return compiled

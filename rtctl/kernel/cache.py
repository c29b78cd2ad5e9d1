"""Where compiled kernels are kept: by what each module is made of, its own source and all that it imports.

numba looks only at the file that defines a function: a kernel cached before a change of a function that it calls from
another file would go on running the old one. Here a module's kernels lie in a folder that is named by a hash of its
source and of every module of the same package that it imports, directly or not. So a change in one room recompiles
what depends on it and nothing else, and two versions of the sources keep their kernels side by side.

numba's own key adds its version, the processor and the types of the arguments, the whole layout of a record included.
"""

import fcntl
import hashlib
import os
import re
import shutil
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, TypeAlias

from numba.core.caching import CompileResultCacheImpl, FunctionCache

from rtctl.trust import TrustError, own_folder

PATIENCE = 300.0  # [s] for another process that compiles the same function; then it is compiled here too
ATTEMPTS = 3  # to make a folder that others let go of
VERSIONS = 8  # of a module's kernels that are kept, the latest used

_FROM = re.compile(rb"^[ \t]*from[ \t]+([\w.]+)[ \t]+import[ \t]*(\([^)]*\)|[^\n]*)", re.MULTILINE)
_IMPORT = re.compile(rb"^[ \t]*import[ \t]+([\w., \t]+)", re.MULTILINE)
_WORD = re.compile(r"\w+")
_Tops: TypeAlias = tuple[tuple[str, Path], ...]  # package -> the folder that it lies in
_PACKAGE = __name__.partition(".")[0]
_TOP = Path(__file__).parents[2]


@cache
def folder() -> Path:
    """Return the folder of all kernels: NUMBA_CACHE_DIR, or rtctl in the user's cache, or a temporary one of ours.

    Kernels are code: a folder that another user may write is not taken.
    """
    base = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    named = os.environ.get("NUMBA_CACHE_DIR") or os.path.join(base, "rtctl")
    for place in (Path(named), Path(tempfile.gettempdir()) / f"rtctl-kernels-{os.geteuid()}"):
        with suppress(OSError, TrustError):
            place.parent.mkdir(parents=True, exist_ok=True)
            own_folder(place, 0o700)
            with tempfile.TemporaryFile(dir=place):  # a folder on a read-only disk says nothing before
                return place
    return Path(tempfile.mkdtemp(prefix="rtctl-kernels-"))


@cache
def stamp(module: str, file: str) -> str:
    """Return a hash of the sources of a module and of all that it imports, of its own package and of this one.

    module: dotted name, such as `rtctl.arm.law`. file: where its source lies. Raises LookupError where the name does
    not lead to the file, as in a script or a shell.
    """
    own = module.partition(".")[0]
    depth = module.count(".") + (Path(file).name == "__init__.py")
    tops = ((_PACKAGE, _TOP), (own, Path(file).parents[depth]))  # of one name, the latter
    if _path(tops, module) != Path(file):
        raise LookupError(module)
    found: dict[str, str] = {}
    waiting = [module]
    while waiting:
        name = waiting.pop()
        if name not in found:
            found[name], imports = _source(tops, name)
            waiting += imports
    text = "\n".join(f"{name} {found[name]}" for name in sorted(found))
    return hashlib.sha256(text.encode()).hexdigest()


@cache
def _source(tops: _Tops, module: str) -> tuple[str, tuple[str, ...]]:
    """Return the hash of a module's source, and which modules it names in its imports."""
    path = _path(tops, module)
    text = path.read_bytes() if path else b""
    named: set[str] = set()
    for origin, names in _FROM.findall(text):
        start = origin.decode()
        named |= {start, *(f"{start}.{word}" for word in _WORD.findall(names.decode(errors="replace")))}
    for names in _IMPORT.findall(text):
        named |= {part.split()[0] for part in names.decode().split(",") if part.split()}
    ours = (name for name in named if name != module and _path(tops, name))
    return hashlib.sha256(text).hexdigest(), tuple(sorted(ours))


@cache
def _path(tops: _Tops, module: str) -> Path | None:
    """Return the file of a module; None of one of another package, or where there is none."""
    parts = module.split(".")
    top = dict(tops).get(parts[0])
    if top is not None:
        stem = top.joinpath(*parts)
        for path in (stem.parent / f"{stem.name}.py", stem / "__init__.py"):
            if path.is_file():
                return path
    return None


class _Locator:
    """Tells numba where the kernels of a function lie."""

    def __init__(self, function: Callable[..., object], file: str) -> None:
        self.stamp = stamp(function.__module__, file)
        self.line = str(function.__code__.co_firstlineno)
        self.home = folder() / function.__module__
        self.path = self.home / self.stamp[:16]

    @classmethod
    def from_function(cls, function: Callable[..., object], file: str) -> "_Locator":
        return cls(function, file)

    def get_cache_path(self) -> str:
        return str(self.path)

    def get_source_stamp(self) -> str:
        return self.stamp

    def get_disambiguator(self) -> str:
        return self.line

    def ensure_cache_path(self) -> None:
        """Make the folder, and let go of the versions that were not used for longest."""
        if not self.path.is_dir():
            self.path.mkdir(parents=True, exist_ok=True)
            for old in sorted(self.home.iterdir(), key=_last_use, reverse=True)[VERSIONS:]:
                if old != self.path:
                    shutil.rmtree(old, ignore_errors=True)
        os.utime(self.path)


def _last_use(path: Path) -> float:
    with suppress(OSError):
        return path.stat().st_mtime
    return 0.0


class _Content(CompileResultCacheImpl):
    _locator_classes = [_Locator]  # noqa: RUF012  numba declares it so


class KernelCache(FunctionCache):
    """numba's cache of one function, in a folder named by content, that several processes fill without double work.

    Who finds nothing there locks the function and compiles it; others wait for that and load what it made. What a
    function calls is locked after it, and no kernel calls itself, so nobody waits in a circle.
    """

    _impl_class = _Content
    _lock = -1  # descriptor, while this process compiles the function

    def load_overload(self, sig: object, target_context: object) -> object:
        """Return what was compiled for a signature; None, with the function locked, where nobody did."""
        load: Callable[[object, object], object] = super().load_overload
        found = load(sig, target_context)
        if found is None and self._enabled:
            self._take()
            found = load(sig, target_context)
        if found is not None:
            self._release()
        return found

    def save_overload(self, sig: object, data: object) -> None:
        """Save what was compiled, and let the others have it.

        A process of another version may have let go of the folder meanwhile; what cannot be kept is compiled again.
        """
        save: Callable[[object, object], None] = super().save_overload
        try:
            with suppress(OSError):
                try:
                    save(sig, data)
                except FileNotFoundError:
                    self._impl.locator.ensure_cache_path()
                    save(sig, data)
        finally:
            self._release()

    def _take(self) -> None:
        if self._lock < 0:
            locator: _Locator = self._impl.locator
            path = locator.path / f"{self._impl.filename_base}.lock"
            for _ in range(ATTEMPTS):
                with suppress(FileNotFoundError):
                    locator.ensure_cache_path()
                    self._lock = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
                    break
            else:
                return  # compiled here, whatever others do
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end:
            with suppress(BlockingIOError):
                fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                return
            time.sleep(0.02)

    def _release(self) -> None:
        if self._lock >= 0:
            os.close(self._lock)
            self._lock = -1


def install(dispatcher: Any, function: Callable[..., object]) -> None:
    """Give a compiled function this cache, as njit(cache=True) gives it numba's. Raises LookupError, see `stamp`."""
    cache_of: Callable[[Callable[..., object]], KernelCache] = KernelCache
    dispatcher._cache = cache_of(function)

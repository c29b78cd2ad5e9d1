"""One mutant in a child of a pytest session that has collected the tests: its code takes the place of the right one."""

import importlib.abc
import importlib.util
import os
import resource
import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import NamedTuple

import pytest

KILLED, SURVIVED, IMPOSSIBLE = 1, 0, 2
HERE = Path(__file__).parent
SPARE = 20.0  # [s] of processor time beyond what the tests take unchanged


class Change(NamedTuple):
    """A changed module."""

    file: Path
    text: str  # all that is in it
    scope: str  # the function that is changed
    on_import: bool  # whether the change acts when the module is imported


def in_child(change: Change, items: Sequence[pytest.Item], seconds: float) -> int:
    """Fork; return the child's process id. The child ends with KILLED or SURVIVED.

    seconds: processor time of the tests where nothing is changed; a mutant that takes many times that is killed.
    """
    pid = os.fork()
    if pid:
        return pid
    status = KILLED  # what breaks the trial itself is noticed by a test, too
    try:
        null = os.open(os.devnull, os.O_RDWR)
        for descriptor in range(3):
            os.dup2(null, descriptor)
        limit = int(SPARE + 10.0 * seconds) + 1
        resource.setrlimit(resource.RLIMIT_CPU, (limit, limit))
        if not change.on_import:
            status = _in_place(change, items)
        if change.on_import or status == IMPOSSIBLE:
            status = _anew(change, items)
    finally:
        os._exit(status)


def _in_place(change: Change, items: Sequence[pytest.Item]) -> int:
    """Give the functions of the loaded module the changed code and run the tests."""
    file = change.file
    module = next((m for m in list(sys.modules.values()) if getattr(m, "__file__", None) == str(file)), None)
    changed = {code.co_qualname: code for code in _codes(compile(change.text, str(file), "exec"))}
    functions = _functions(module, change.scope) if module else []
    for function in functions:
        code = changed.get(function.__code__.co_qualname)
        if code is None or code.co_freevars != function.__code__.co_freevars:
            return IMPOSSIBLE
        function.__code__ = code
    session = items[0].session
    before = session.testsfailed
    if not functions:
        return IMPOSSIBLE
    for item in items:
        item.config.hook.pytest_runtest_protocol(item=item, nextitem=None)
        if session.testsfailed > before:
            return KILLED
    return SURVIVED


def _codes(code: CodeType) -> list[CodeType]:
    """Return the code of every function of a module and its classes."""
    inner = [one for one in code.co_consts if isinstance(one, CodeType)]
    return [*inner, *(found for one in inner for found in _codes(one))]


def _functions(module: ModuleType, scope: str) -> list[FunctionType]:
    """Return the function that a scope names, or the methods of the class."""
    owner: object = module
    for name in scope.split("."):
        held = vars(owner).get(name) if isinstance(owner, type | ModuleType) else None
        if isinstance(held, property):
            held = held.fget
        if isinstance(held, staticmethod | classmethod):
            held = held.__func__
        if isinstance(held, FunctionType):
            return [held]
        owner = held
    return []


class _Changed(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Gives one module its changed source."""

    def __init__(self, name: str, file: Path, text: str) -> None:
        self.name, self.file, self.text = name, file, text

    def find_spec(self, name: str, path: object, target: object = None) -> ModuleSpec | None:
        """Return where the module comes from, None for all others."""
        if name != self.name:
            return None
        return importlib.util.spec_from_file_location(name, self.file, loader=self)

    def create_module(self, spec: ModuleSpec) -> None:
        """Let the module be an ordinary one."""

    def exec_module(self, module: ModuleType) -> None:
        """Run the changed source."""
        exec(compile(self.text, str(self.file), "exec"), vars(module))


def _anew(change: Change, items: Sequence[pytest.Item]) -> int:
    """Import the program and its tests anew, the module changed, and run the tests."""
    root = items[0].config.rootpath
    name = ".".join(change.file.relative_to(root).with_suffix("").parts)
    for loaded in [name for name, module in sys.modules.items() if _is_ours(module, root)]:
        del sys.modules[loaded]
    sys.meta_path.insert(0, _Changed(name, change.file, change.text))
    _keep_no_kernels()
    flags = ["-x", "-q", "-s", "-p", "no:cacheprovider", "-W", "ignore", "-p", "tools.mutants.profile"]
    return KILLED if pytest.main([*flags, *(item.nodeid for item in items)]) != 0 else SURVIVED


def _is_ours(module: ModuleType, root: Path) -> bool:
    """Return whether a module lies in the project, these here and the installed ones apart."""
    file = getattr(module, "__file__", None) or ""
    return file.startswith(f"{root}{os.sep}") and "site-packages" not in file and Path(file).parent != HERE


def _keep_no_kernels() -> None:
    """Let nothing that is compiled of a changed module be found by another process."""
    from numba.core.caching import Cache

    Cache.save_overload = lambda self, sig, data: None  # type: ignore[method-assign]

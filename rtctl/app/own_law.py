"""A law of somebody's own: found by the name of its file, and what is said of it when it raises."""

import importlib.util
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeAlias

from rtctl.errors import RtctlError, UsageError
from rtctl.spell import nearest
from rtctl.types import F64

AnyLaw: TypeAlias = Callable[..., Sequence[float] | F64 | None]  # `rtctl.app.servo.Law` of any vehicle


class OwnLawError(RtctlError):
    """A law that is not this program's raised."""


def load_law(text: str) -> AnyLaw:
    """Return the function that `FILE.py:NAME` names, by running the file. Raises UsageError."""
    file, colon, name = text.rpartition(":")
    if not (colon and file and name):
        raise UsageError(f"--law: got {text!r}, wanted FILE.py:NAME, a function of (robot, memory, feedback)")
    path = Path(file)
    if not path.is_file():
        raise UsageError(f"--law: {file}: no such file, wanted FILE.py:NAME")
    spec = importlib.util.spec_from_file_location(f"law_{path.stem}", path)
    if spec is None or spec.loader is None:
        raise UsageError(f"--law: {file}: got a file of another kind, wanted one that ends in .py")
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        raise UsageError(f"--law: {file} cannot be run: {raised(error)}") from error
    law = getattr(module, name, None)
    if not callable(law):
        known = [n for n, value in vars(module).items() if callable(value) and not n.startswith("_")]
        raise UsageError(f"--law: {file}: got {name!r}, wanted {nearest(name, known)}")
    found: AnyLaw = law
    return found


def raised(error: Exception) -> str:
    """Return what an exception says, and the line that raised it."""
    text = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
    if isinstance(error, SyntaxError):
        return f"{text} ({error.filename}, line {error.lineno})"
    frames = traceback.extract_tb(error.__traceback__)
    return f"{text} ({Path(frames[-1].filename).name}, line {frames[-1].lineno})" if frames else text

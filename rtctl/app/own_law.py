"""A law of somebody's own: found by the name of its file, and what is said of it when it raises."""

import importlib.util
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeAlias, TypeVar, cast

import msgspec
import numpy as np

from rtctl.errors import RtctlError, UsageError
from rtctl.spell import nearest
from rtctl.types import F64, Array

AnyLaw: TypeAlias = Callable[..., Sequence[float] | F64 | None]  # `rtctl.app.servo.Law` of any vehicle


SMALL = 1 << 16  # [bytes] an array of more is shown as it is, read-only: meshes, clouds
T = TypeVar("T")


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
    except (Exception, SystemExit) as error:
        raise UsageError(f"--law: {file} cannot be run: {raised(error)}") from error
    law = getattr(module, name, None)
    if not callable(law):
        known = [n for n, value in vars(module).items() if callable(value) and not n.startswith("_")]
        raise UsageError(f"--law: {file}: got {name!r}, wanted {nearest(name, known)}")
    found: AnyLaw = law
    return found


def private(value: T) -> T:
    """Return a value with arrays of its own wherever it has any: whoever writes into them changes nothing else.

    `q = memory.joints.q; q -= goal` is soon written, and would be what the controller believes from then on.
    """
    shown: object = value
    if isinstance(value, np.ndarray):
        shown = value.copy() if value.nbytes <= SMALL else _sealed(value)
    elif isinstance(value, tuple):
        parts = map(private, value)
        shown = type(value)(*parts) if hasattr(value, "_fields") else type(value)(parts)
    elif isinstance(value, msgspec.Struct):
        shown = type(value)(*(private(getattr(value, name)) for name in value.__struct_fields__))
    return cast(T, shown)


def _sealed(array: Array) -> Array:
    seen = array.view()
    seen.flags.writeable = False
    return seen


def raised(error: BaseException) -> str:
    """Return what an exception says, and the line that raised it."""
    text = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
    if isinstance(error, SyntaxError):
        return f"{text} ({error.filename}, line {error.lineno})"
    frames = traceback.extract_tb(error.__traceback__)
    return f"{text} ({Path(frames[-1].filename).name}, line {frames[-1].lineno})" if frames else text

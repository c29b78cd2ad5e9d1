"""The paper's experiments: each is played, drawn (PNG and SVG), and its numbers written (JSON).

A module an experiment: `TITLE`, `CAPTION`, `run(say) -> data`, `figures(data) -> dict`, `draw(data) -> Figure`; one
whose numbers are read side by side has `table(data)` too, written as NAME.md.
"""

import json
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from types import ModuleType

from rtctl.errors import UsageError
from rtctl.plain import Json

NAMES = ("potential", "line", "enclosure", "puma", "limits", "moving", "minimum", "rates", "bounce", "forms")
DIGITS = 9  # of a number in a JSON file


def module_of(name: str) -> ModuleType:
    """Return the module of an experiment. Raises UsageError for a name that is none."""
    if name not in NAMES:
        raise UsageError(f"experiment: got {name!r}, wanted one of {', '.join(NAMES)}")
    return import_module(f"rtctl.experiment.{name}")


def perform(name: str, folder: Path, say: Callable[[float], None]) -> Json:
    """Play an experiment, write NAME.png, NAME.svg and NAME.json into a folder, and return its figures.

    `say` is told the part (0 to 1) that is done. The same sources give the same numbers.
    """
    from rtctl.experiment.style import saved, styled

    module = module_of(name)
    data = module.run(say)
    figures = rounded(module.figures(data))
    with styled():
        saved(module.draw(data), folder, name)
    text = json.dumps({"experiment": name, "title": module.TITLE, **figures}, indent=2, allow_nan=False)
    (folder / f"{name}.json").write_text(text + "\n", encoding="utf-8")
    if hasattr(module, "table"):
        (folder / f"{name}.md").write_text(
            f"{module.TITLE}: `rtctl experiment {name} --out DIR`\n\n{module.table(data)}\n", encoding="utf-8"
        )
    return figures


def rounded(figures: Json) -> Json:
    """Return numbers to nine digits, those that are not finite as None; lists and dicts likewise."""
    return {name: _rounded(value) for name, value in figures.items()}


def _rounded(value: object) -> object:
    if isinstance(value, dict):
        return rounded(value)
    if isinstance(value, list | tuple):
        return [_rounded(v) for v in value]
    if isinstance(value, float):
        return float(f"{value:.{DIGITS}g}") if abs(value) < float("inf") else None
    return value

"""One HTML page about a log: everything inside, nothing from the network."""

from collections.abc import Callable
from pathlib import Path

from rtctl.errors import LogError
from rtctl.log.read.run import Run
from rtctl.log.view.report.gather import Gathered, gather
from rtctl.log.view.report.page import page

__all__ = ["Gathered", "gather", "page", "write_report"]


def write_report(run: Run, path: Path, progress: Callable[[int], None] = lambda n: None) -> Gathered:
    """Write the report of a log; progress is told percents. Raises LogError."""
    found = gather(run, progress)
    text = page(run, found)
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise LogError(f"{path}: {error.strerror}") from None
    progress(100)
    return found

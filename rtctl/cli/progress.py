"""Progress bars for long work: on a terminal, on stderr, gone when the work is done."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

REDRAW = 0.1  # [s]


@contextmanager
def bar(label: str, total: int) -> Iterator[Callable[[int], None]]:
    """Show how far some work is; yields a function that is told how much of `total` is done.

    Drawn when told and not by a thread of its own: work may fork.
    """
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    with Progress(
        *columns, console=console, transient=True, disable=not console.is_terminal, auto_refresh=False
    ) as progress:
        task = progress.add_task(label, total=max(total, 1))
        drawn = -1.0

        def told(done: int) -> None:
            nonlocal drawn
            now = time.monotonic()
            progress.update(task, completed=done, refresh=now - drawn > REDRAW)
            drawn = now if now - drawn > REDRAW else drawn

        yield told

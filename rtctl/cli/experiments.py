"""`rtctl experiment`: the paper's experiments, played and drawn."""

import argparse
import json
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from rtctl.cli.parser import Commands, command
from rtctl.errors import EXIT_OK, UsageError

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID


def add(commands: Commands) -> None:
    """Add the command."""
    parser = command(
        commands,
        "experiment",
        "play the paper's experiments: a figure and its numbers each",
        "rtctl experiment --all --out figures\n  rtctl experiment line bounce --out figures --json",
        _experiment,
    )
    parser.add_argument("name", metavar="NAME", nargs="*", help="which; --list prints them")
    parser.add_argument("--all", action="store_true", help="every one")
    parser.add_argument("--list", action="store_true", help="print their names and exit")
    parser.add_argument("--out", metavar="DIR", help="folder for NAME.png, NAME.svg and NAME.json, made when absent")
    parser.add_argument("--json", action="store_true", help="print the figures as one JSON object")


def _experiment(arguments: argparse.Namespace) -> int:
    from rtctl import experiment

    if arguments.list:
        return _list(arguments.json)
    if arguments.all == bool(arguments.name):
        raise UsageError("experiment: wanted names or --all (rtctl experiment --list)")
    if not arguments.out:
        raise UsageError("experiment: --out is missing, wanted a folder for the figures")
    names = list(experiment.NAMES) if arguments.all else list(dict.fromkeys(arguments.name))
    for name in names:
        experiment.module_of(name)
    folder = Path(arguments.out)
    folder.mkdir(parents=True, exist_ok=True)
    figures = _performed(names, folder, quiet=arguments.json)
    if arguments.json:
        print(json.dumps(figures))
    return EXIT_OK


def _list(as_json: bool) -> int:
    from rtctl import experiment

    rows = {name: experiment.module_of(name).CAPTION for name in experiment.NAMES}
    print(json.dumps(rows) if as_json else "\n".join(f"{name:<12}{caption}" for name, caption in rows.items()))
    return EXIT_OK


def _moved(progress: "Progress", task: "TaskID", part: float) -> None:
    progress.update(task, completed=part)


def _performed(names: list[str], folder: Path, quiet: bool) -> dict[str, object]:
    """Perform experiments one by one; progress goes to stderr, so that stdout is the answer alone."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    from rtctl import experiment

    console = Console(stderr=True, highlight=False)
    figures: dict[str, object] = {}
    columns = TextColumn("{task.description:<12}"), BarColumn(), TextColumn("{task.percentage:>3.0f} %")
    with Progress(*columns, TimeElapsedColumn(), console=console, transient=True) as progress:
        for name in names:
            task = progress.add_task(name, total=1.0)
            begun = time.perf_counter()
            figures[name] = experiment.perform(name, folder, partial(_moved, progress, task))
            progress.remove_task(task)
            if not quiet:
                took = time.perf_counter() - begun
                console.print(f"{name:<12}{folder / name}.png  .svg  .json   {took:5.1f} s", soft_wrap=True)
    return figures

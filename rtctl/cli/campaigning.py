"""The work of `rtctl campaign`: from what was asked to rows, a table, a page, and an exit code."""

import argparse
import json
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from rtctl.campaign.case import Asked, Case, code
from rtctl.campaign.engine import perform
from rtctl.campaign.expand import Plan, named
from rtctl.campaign.minimise import minimised
from rtctl.campaign.play import played, save, written
from rtctl.campaign.rates import GROUPED, groups, severity, wilson
from rtctl.campaign.report import page, text_table, worst
from rtctl.campaign.robots import grid, ready
from rtctl.campaign.store import Store
from rtctl.cli.offline import prepare
from rtctl.cli.progress import bar
from rtctl.errors import EXIT_FAILED, EXIT_OK, RtctlError, UsageError
from rtctl.plain import Json

SILENT = 10.0  # [s] between two lines of progress where there is no terminal
REDRAW = 0.2  # [s]
SHRUNK = 5  # failing scenes that are minimised at the end of a campaign


def run(arguments: argparse.Namespace) -> int:
    """Play what has no row yet; print the figures; return the exit code."""
    workers = os.cpu_count() or 1 if arguments.workers is None else arguments.workers
    if workers < 0 or not 0.0 <= arguments.min_arrived <= 1.0:
        raise UsageError("campaign: --workers: at least 0; --min-arrived: 0 to 1")
    asked = _asked(arguments)
    plan = _plan(asked)
    keys = _looked_at(plan, compile_them=not arguments.scheduler)
    store, begun = Store(Path(arguments.out), asked, code(), arguments.other_code), time.monotonic()
    had = len(store.rows)
    try:
        _performed(plan, store, len(keys), workers, arguments.scheduler)
    except KeyboardInterrupt:
        print(f"rtctl: {len(store.rows)} of {len(keys)} rows kept; the same command goes on", file=sys.stderr)
        return EXIT_FAILED
    finally:
        store.close()
    rows = [store.rows[key] for key in keys]
    print(
        f"{len(rows)} runs, {len(store.rows) - had} of them new in {time.monotonic() - begun:.1f} s: {store.parts}",
        file=sys.stderr,
    )
    if arguments.minimise:
        _shrink(plan, rows, Path(arguments.out))
    return _judged(arguments, rows)


def report(arguments: argparse.Namespace) -> int:
    """Write the page of a campaign, or print its figures."""
    folder = Path(arguments.folder)
    store = Store(folder)
    rows = list(store.rows.values())
    if not rows:
        raise RtctlError(f"{folder}: no row yet, wanted a campaign that has played something")
    if arguments.json:
        print(json.dumps(_figures(rows)))
        return EXIT_OK
    wanted = {row["key"] for row in worst(rows)}
    cases = {case.key: case for case in _plan(store.about["asked"]).cases() if case.key in wanted}
    for case in cases.values():
        prepare(str(ready(case.robot, case.config).path))
    with bar("drawing", len(wanted)) as told:
        text = page(folder, store.about, rows, cases, told)
    out = Path(arguments.out or folder / "report.html")
    out.write_text(text, encoding="utf-8")
    print(out)
    return EXIT_OK


def play(arguments: argparse.Namespace) -> int:
    """Play one run alone, as the campaign did; print its row and the files that play it elsewhere."""
    folder = Path(arguments.folder)
    store = Store(folder)
    case = next((c for c in _plan(store.about["asked"]).cases() if c.key == arguments.key), None)
    if case is None:
        raise UsageError(f"{folder}: has no run {arguments.key}, wanted a key of its rows")
    prepare(str(ready(case.robot, case.config).path))
    row = played(case)
    path, _ = written(case, folder / "alone")
    print(json.dumps(row))
    print(f"rtctl sim {path}", file=sys.stderr)
    old = store.rows.get(case.key)
    if old is not None and old["digest"] != row.get("digest"):
        print("rtctl: it went another way than in the campaign: other code, or another machine", file=sys.stderr)
    if arguments.minimise:
        _shrunk(case, row, folder)
    return EXIT_FAILED if row["failures"] else EXIT_OK


def _asked(arguments: argparse.Namespace) -> Json:
    """Return all that the cases depend on, as it is kept beside the rows."""
    files = [str(Path(what).resolve()) for what in arguments.what if Path(what).exists()]
    sources = [what for what in arguments.what if not Path(what).exists()]
    if files and sources:
        raise UsageError(f"campaign: got {sources[0]} beside files, wanted files or generators, or a file that exists")
    options = {}
    for word in arguments.option:
        key, equals, value = word.partition("=")
        if not (key and equals):
            raise UsageError(f"--option: got {word!r}, wanted KEY=VALUE")
        options[key] = value
    return {
        "sources": sources or ["folder"],
        "files": files,
        "robots": [name for name in arguments.robots.split(",") if name],
        "count": arguments.count,
        "seeds": [arguments.seeds.start, arguments.seeds.stop],
        "options": options,
        "grid": arguments.grid,
        "plants": arguments.plants and str(Path(arguments.plants).resolve()),
        "faults": arguments.faults and str(Path(arguments.faults).resolve()),
    }


def _plan(asked: Json) -> Plan:
    """Return the plan of what was asked. Raises UsageError, ConfigError."""
    options = dict(asked["options"]) | ({"files": "\n".join(asked["files"])} if asked["files"] else {})
    return Plan(
        tuple(asked["sources"]),
        Asked(tuple(asked["robots"]), range(*asked["seeds"]), asked["count"], options),
        tuple(grid(asked["grid"])),
        named(asked["plants"], "plant"),
        named(asked["faults"], "fault"),
    )


def _looked_at(plan: Plan, compile_them: bool) -> list[str]:
    """Return the keys of all cases; their robots are checked, and compiled where the runs are here."""
    keys: dict[str, None] = {}
    robots: dict[tuple[str, str], None] = {}
    for case in plan.cases():
        keys[case.key] = None
        robots[case.robot, case.plain_config] = None
    if not keys:
        raise UsageError("campaign: no case, wanted a set that has some")
    for each in robots if compile_them else ():
        prepare(str(ready(*each).path))
    return list(keys)


def _performed(plan: Plan, store: Store, total: int, workers: int, scheduler: str) -> None:
    with _watched(store, total) as told:

        def took(row: Json, crew: int) -> None:
            store.add(row)
            told(row, crew)

        perform(_without_row(plan, store), took, workers, scheduler)


def _without_row(plan: Plan, store: Store) -> Iterator[Case]:
    given: set[str] = set()
    for case in plan.cases():
        if case.key not in store.rows and case.key not in given:
            given.add(case.key)
            yield case


@contextmanager
def _watched(store: Store, total: int) -> Iterator[Callable[[Json, int], None]]:
    """Show rows, rate, time left and failures so far: a bar on a terminal, else a line now and then."""
    console = Console(stderr=True, highlight=False)
    columns = (BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(), TextColumn("{task.description}"))
    begun, had, failed = time.monotonic(), len(store.rows), 0
    shown = begun
    with Progress(
        *columns, console=console, transient=True, disable=not console.is_terminal, auto_refresh=False
    ) as bar_:
        task = bar_.add_task("", total=total, completed=had)

        def told(row: Json, crew: int) -> None:
            nonlocal failed, shown
            failed += bool(row.get("failures"))
            now, done = time.monotonic(), len(store.rows)
            if now - shown < (REDRAW if console.is_terminal else SILENT):
                return
            shown, rate = now, (done - had) / (now - begun)
            text = f"{rate:.2f} runs/s, {crew} workers, {failed} failed"
            bar_.update(task, completed=done, description=text, refresh=True)
            if not console.is_terminal:
                left = (total - done) / rate
                print(f"rtctl: {done} of {total}, {text}, {left:.0f} s left", file=sys.stderr, flush=True)

        yield told


def _judged(arguments: argparse.Namespace, rows: Sequence[Json]) -> int:
    """Print the figures; return 1 when a run broke what none may break, or too few arrived."""
    arrived = wilson(sum(row["outcome"] == "arrived" for row in rows), len(rows))
    failed = [row for row in rows if row["failures"]]
    if arguments.json:
        print(json.dumps(_figures(rows)))
    else:
        print(text_table(rows))
        for row in sorted(failed, key=severity)[:20]:
            print(f"{row['key']}  {row['robot']} {row['set']} {row['seed']}:{row['number']}  {row['failures']}")
            print(f"    rtctl campaign play {arguments.out} {row['key']}")
    if arrived.share < arguments.min_arrived:
        print(f"rtctl: arrived {arrived}, wanted at least {100 * arguments.min_arrived:g} %", file=sys.stderr)
        return EXIT_FAILED
    return EXIT_FAILED if failed else EXIT_OK


def _figures(rows: Sequence[Json]) -> Json:
    """Return the figures of each group as JSON."""
    found = [g._asdict() | {"name": dict(zip(GROUPED, g.name, strict=True))} for g in groups(rows)]
    plain = json.dumps({"runs": len(rows), "groups": found}).replace("NaN", "null")
    return dict(json.loads(plain))


def _shrink(plan: Plan, rows: Sequence[Json], folder: Path) -> None:
    """Minimise the worst scenes that failed; where none did, those that did not arrive."""
    bad = [row for row in rows if row["failures"]] or [row for row in rows if row["outcome"] != "arrived"]
    chosen = {row["key"]: row for row in sorted(bad, key=severity)[:SHRUNK]}
    for case in plan.cases():
        if case.key in chosen:
            _shrunk(case, chosen.pop(case.key), folder)


def _shrunk(case: Case, row: Json, folder: Path) -> None:
    def told(text: str) -> None:
        print(f"rtctl: {case.key}: {text}", file=sys.stderr, flush=True)

    scene = minimised(case, row, told)
    path, _ = save(case, scene, folder / "minimal", case.key)
    print(f"rtctl sim {path}", file=sys.stderr)

"""`rtctl campaign`: its parser; the work is in `campaigning`, whose imports take seconds."""

import argparse

from rtctl.cli.parser import Commands, command, number

EXAMPLE = """rtctl campaign run random --robots panda,ur5 --count 500 --out out/random
  rtctl campaign run scenarios/ --grid avoid.clearance_m=0.01,0.02 --plants plants.toml --out out/grid
  rtctl campaign run random --count 100000 --scheduler tcp://head:8786 --out out/large
  rtctl campaign report out/grid
  rtctl campaign play out/grid 1f0c5a77d2b3e490 --minimise"""


def add(commands: Commands) -> None:
    """Add the command and what it can do."""
    parser = command(commands, "campaign", "play many scenarios, keep and judge what comes of them", EXAMPLE)
    inner = parser.add_subparsers(metavar="WHAT", dest="campaign", required=True)
    _add_run(inner)
    report = command(inner, "report", "a campaign as one page of HTML", "rtctl campaign report out/grid", _report)
    report.add_argument("folder", metavar="DIR", help="the --out of a campaign")
    report.add_argument("--out", metavar="FILE", help="default: DIR/report.html")
    report.add_argument("--json", action="store_true", help="print the figures of each group as JSON, draw nothing")
    play = command(inner, "play", "play one run of a campaign alone", "rtctl campaign play out/grid KEY", _play)
    play.add_argument("folder", metavar="DIR")
    play.add_argument("key", metavar="KEY", help="of the run, as the report prints it")
    play.add_argument("--minimise", action="store_true", help="shrink its scene while it ends the same, and write it")


def _add_run(inner: Commands) -> None:
    run = command(inner, "run", "play every case that has no row yet", EXAMPLE.partition("\n")[0], _run)
    run.add_argument("what", metavar="WHAT", nargs="+", help="scenario files, folders of them, random, or MODULE:NAME")
    run.add_argument("--out", metavar="DIR", required=True, help="rows, and what is needed to go on; made when absent")
    of = run.add_argument_group("which cases")
    of.add_argument("--robots", metavar="NAMES", default="", help="comma-separated; default: those of the source")
    of.add_argument("--count", metavar="N", type=_at_least_one, default=100, help="random scenes a seed (%(default)s)")
    of.add_argument("--seeds", metavar="A[:B]", type=_seeds, default=range(1), help="A, or A to before B; default 0")
    of.add_argument("--option", metavar="KEY=VALUE", action="append", default=[], help="what a MODULE:NAME takes")
    of.add_argument("--grid", metavar="KEY=A,B", action="append", default=[], help="configs: a table's key varied")
    of.add_argument("--plants", metavar="FILE", default="", help="TOML of named [plant] tables, each played")
    of.add_argument("--faults", metavar="FILE", default="", help="TOML of named [[fault]] lists, each played")
    by = run.add_argument_group("on what")
    by.add_argument("--workers", metavar="N", type=int, help="local processes; default: a processor each; 0: this one")
    by.add_argument("--scheduler", metavar="ADDRESS", default="", help="of a Dask cluster that is there already")
    by.add_argument("--other-code", action="store_true", help="go on although the rows there are of other code")
    end = run.add_argument_group("at the end")
    end.add_argument("--min-arrived", metavar="SHARE", type=number, default=0.0, help="fewer fail the campaign")
    end.add_argument("--minimise", action="store_true", help="shrink the worst scenes that failed and write them")
    end.add_argument("--json", action="store_true", help="print one JSON object")


def _at_least_one(text: str) -> int:
    if not text.isdigit() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"got {text!r}, wanted a whole number from 1")
    return int(text)


def _seeds(text: str) -> range:
    first, _, last = text.partition(":")
    if not first.isdigit() or (last and not last.isdigit()) or (last and int(last) <= int(first)):
        raise argparse.ArgumentTypeError(f"got {text!r}, wanted a seed, or FIRST:BEFORE")
    return range(int(first), int(last) if last else int(first) + 1)


def _run(arguments: argparse.Namespace) -> int:
    from rtctl.cli.campaigning import run

    return run(arguments)


def _report(arguments: argparse.Namespace) -> int:
    from rtctl.cli.campaigning import report

    return report(arguments)


def _play(arguments: argparse.Namespace) -> int:
    from rtctl.cli.campaigning import play

    return play(arguments)

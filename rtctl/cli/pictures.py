"""`rtctl log export`, `plot` and `report`: logs in other programs' formats, and in pictures."""

import argparse
from pathlib import Path

from rtctl.cli.parser import Commands, command, log_file, number
from rtctl.cli.progress import bar
from rtctl.errors import EXIT_OK, UsageError
from rtctl.spell import nearest

FORMATS = ("csv", "parquet", "candump", "blf", "tlog")
ENDINGS = {".csv": "csv", ".parquet": "parquet", ".log": "candump", ".blf": "blf", ".tlog": "tlog"}
EXPORT_EXAMPLE = """rtctl log export run.mcap --fields time,x,rho > run.csv
  rtctl log export run.mcap --out run.parquet
  rtctl log export run.mcap --out run.log
  rtctl log export run.mcap --out run.blf
  rtctl log export rover.mcap --out flight.tlog"""


EXPORT_TEXT = """Write a log in another program's format: a topic as CSV or Parquet (units are metadata of its columns);
CAN frames as candump's .log (canplayer, python-can, Wireshark) or Vector's .blf; MAVLink packets as .tlog."""


def add(actions: Commands) -> None:
    """Add the three commands."""
    export = command(actions, "export", "write a log in another program's format", EXPORT_EXAMPLE, _export)
    export.description = EXPORT_TEXT
    export.add_argument("file", metavar="FILE", type=log_file)
    export.add_argument("--out", metavar="FILE", default="-", help="default: standard output, for csv and candump")
    export.add_argument("--format", choices=FORMATS, default="", help="default: by the ending of --out, else csv")
    export.add_argument("--topic", metavar="TOPIC", default="/tick", help="for csv and parquet; default: %(default)s")
    export.add_argument("--fields", metavar="A,B,…", default="", help="fields of the topic; default: all")
    plot = command(
        actions,
        "plot",
        "draw chosen fields over time",
        "rtctl log plot run.mcap --fields x,error,tau_sent --from 2 --to 4 --out run.png\n"
        "  rtctl log plot run.mcap --list",
        _plot,
    )
    plot.add_argument("file", metavar="FILE", type=log_file)
    plot.add_argument("--fields", metavar="A,B,…", default="x,error,rho,tau_sent", help="default: %(default)s")
    plot.add_argument("--from", dest="start", metavar="S", type=number, default=0.0, help="after the log's begin")
    plot.add_argument("--to", dest="stop", metavar="S", type=number, default=1e12, help="after the log's begin")
    plot.add_argument("--out", metavar="PICTURE", default="", help="png, svg or pdf; default: beside the log")
    plot.add_argument("--list", action="store_true", help="print the fields, their units and meanings")
    report = command(
        actions,
        "report",
        "write one HTML page about a log that needs no network",
        "rtctl log report run.mcap\n  rtctl log report run.mcap --out run.html --png run.png",
        _report,
    )
    report.add_argument("file", metavar="FILE", type=log_file)
    report.add_argument("--out", metavar="FILE", default="", help="default: beside the log, .html")
    report.add_argument("--png", metavar="PICTURE", default="", help="also draw its main plots into one picture")


def _export(arguments: argparse.Namespace) -> int:
    from rtctl.log.read.run import read_run
    from rtctl.log.view import export

    out = str(arguments.out)
    kind = arguments.format or ("csv" if out == "-" else ENDINGS.get(Path(out).suffix, ""))
    if not kind:
        raise UsageError(f"--out: got {out}, wanted an ending of {', '.join(ENDINGS)}, or --format")
    if out == "-" and kind not in ("csv", "candump"):
        raise UsageError(f"--out: {kind} needs a file")
    run = read_run(arguments.file)
    names = tuple(arguments.fields.split(",")) if arguments.fields else ()
    if kind in ("csv", "parquet"):
        total = run.count(arguments.topic)
        topic = run.window(arguments.topic, 0, 0)
        for name in names:
            if topic.dtype is not None and name not in topic.fields:
                raise UsageError(f"--fields: got {name!r}, wanted {nearest(name, topic.fields, len(topic.fields))}")
    else:
        total = sum(run.count(name) for name in (export.buses(run) if kind != "tlog" else ()))
    with bar(f"writing {kind}", total) as progress:
        if kind == "parquet":
            export.to_parquet(run, arguments.topic, names, Path(out), progress)
        elif kind == "blf":
            export.to_blf(run, Path(out), progress)
        elif kind == "tlog":
            export.to_tlog(run, Path(out), progress)
        else:
            with export.text_file(out) as file:
                if kind == "csv":
                    export.to_csv(run, arguments.topic, names, file, progress)
                else:
                    export.to_candump(run, file, progress)
    return EXIT_OK


def _plot(arguments: argparse.Namespace) -> int:
    from rtctl.log.read.run import read_run

    run = read_run(arguments.file)
    if arguments.list:
        from rtctl.cli.values import table
        from rtctl.log.read.fields import FIELDS, Field

        none = Field("", "")
        dtype = run.header.dtype
        rows = [
            [n, str(dtype[n].shape or ""), FIELDS.get(n, none).unit, FIELDS.get(n, none).text]
            for n in dtype.names or ()
        ]
        print(table(rows, ["field", "shape", "unit", "what it is"]))
        return EXIT_OK
    from rtctl.log.view.plot import plot

    if arguments.stop <= arguments.start:
        raise UsageError(f"--to: got {arguments.stop:g}, wanted more than --from {arguments.start:g}")
    out = Path(arguments.out) if arguments.out else Path(arguments.file).with_suffix(".png")
    plot(run, arguments.fields.split(","), out, arguments.start, arguments.stop)
    print(out)
    return EXIT_OK


def _report(arguments: argparse.Namespace) -> int:
    from rtctl.log.read.run import read_run
    from rtctl.log.view.report import write_report

    run = read_run(arguments.file)
    out = Path(arguments.out) if arguments.out else Path(arguments.file).with_suffix(".html")
    with bar("reporting", 100) as progress:
        found = write_report(run, out, progress)
        if arguments.png:
            from rtctl.log.view.sheet import draw

            draw(found, Path(arguments.png))
    print(out)
    return EXIT_OK

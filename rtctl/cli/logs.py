"""`rtctl log`: looking into logs, and writing their topics as CSV."""

import argparse
import csv
import json
import sys
from typing import Any

from rtctl.cli.parser import Commands, command
from rtctl.errors import EXIT_OK, UsageError


def add(commands: Commands) -> None:
    """Add the log commands."""
    log = command(commands, "log", "read a log", "rtctl log info logs/panda.000.mcap")
    actions = log.add_subparsers(metavar="ACTION", dest="action", required=True)
    info = command(actions, "info", "what a log holds, and how it ended", "rtctl log info run.mcap --json", _info)
    info.add_argument("file", metavar="FILE")
    info.add_argument("--json", action="store_true", help="print one JSON object")
    export = command(
        actions, "export", "write one topic as CSV", "rtctl log export run.mcap --fields time,x,rho > run.csv", _export
    )
    export.add_argument("file", metavar="FILE")
    export.add_argument("--topic", metavar="TOPIC", default="/tick", help="default: %(default)s")
    export.add_argument("--fields", metavar="A,B,…", default="", help="fields of the topic; default: all")


def _info(arguments: argparse.Namespace) -> int:
    from rtctl.log.info import info

    found = info(arguments.file)
    print(json.dumps(found) if arguments.json else _text(found))
    return EXIT_OK


def _text(found: dict[str, Any]) -> str:
    state = "complete" if found["complete"] else f"cut off, {found['torn_bytes']} bytes torn"
    head = [
        ("file", f"{found['path']}, {found['bytes'] / 1e6:.2f} MB, {state}"),
        ("robot", f"{found.get('robot', 'unknown')}, config {str(found.get('config_sha256', 'unknown'))[:12]}"),
        ("duration", f"{found['duration_s']:.3f} s"),
        ("ended", str(found["sentinel"].get("reason", json.dumps(found["sentinel"]))) if found["sentinel"] else "-"),
        ("dropouts", f"{found['dropouts']['entries']} entries, {found['damaged_chunks']} damaged chunks"),
        ("versions", ", ".join(f"{name} {version}" for name, version in found.get("versions", {}).items()) or "-"),
    ]
    lines = [f"{name:9} {text}" for name, text in head]
    width = max((len(name) for name in found["topics"]), default=5)
    lines += ["", f"{'topic':{width}}  {'messages':>9} {'Hz':>9} {'holes':>6}  schema"]
    for name, t in found["topics"].items():
        lines.append(f"{name:{width}}  {t['messages']:>9} {t['hz']:>9.1f} {t['holes']:>6}  {t['schema']}")
    return "\n".join(lines)


def _export(arguments: argparse.Namespace) -> int:
    from rtctl.log import read

    topic = read(arguments.file)[arguments.topic]
    rows = topic.array
    names = arguments.fields.split(",") if arguments.fields else list(rows.dtype.names or ())
    for name in names:
        if name not in (rows.dtype.names or ()):
            raise UsageError(f"--fields: got {name!r}, wanted some of {', '.join(rows.dtype.names or ())}")
    out = csv.writer(sys.stdout, lineterminator="\n")
    out.writerow(["log_time_ns", *(title for name in names for title in _titles(name, rows[name].shape[1:]))])
    columns = [rows[name].reshape(len(rows), -1) for name in names]
    for i, at in enumerate(topic.time.tolist()):
        out.writerow([at, *(value for column in columns for value in column[i].tolist())])
    return EXIT_OK


def _titles(name: str, shape: tuple[int, ...]) -> list[str]:
    """Return one title per number of a field: q.0, q.1, …; force.3.x would be force.3.0."""
    titles = [name]
    for size in shape:
        titles = [f"{title}.{i}" for title in titles for i in range(size)]
    return titles

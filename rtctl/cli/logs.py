"""`rtctl log`: what a log holds, whether it is whole, what went over the buses, and what is being written now."""

import argparse
import json
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from rtctl.cli import identify, pictures, replays
from rtctl.cli.parser import Commands, Parser, command, log_file, port, positive
from rtctl.cli.progress import bar
from rtctl.cli.values import table
from rtctl.errors import EXIT_FAILED, EXIT_OK, UsageError, needs
from rtctl.plain import Json

if TYPE_CHECKING:
    from rtctl.cli.relay import Relay
    from rtctl.log.read.follow import Tail
    from rtctl.types import RecordRow


def add(commands: Commands) -> None:
    """Add the log commands."""
    log = command(
        commands, "log", "read a log", "rtctl log info logs/panda.000.mcap\n  rtctl log report logs/panda.000.mcap"
    )
    actions = log.add_subparsers(metavar="ACTION", dest="action", required=True)
    info = command(actions, "info", "what a log holds, and how it ended", "rtctl log info run.mcap --json", _info)
    _file(info)
    doctor = command(
        actions,
        "doctor",
        "is a log whole: structure, checksums, numbers, time, decoding",
        "rtctl log doctor run.mcap",
        _doctor,
    )
    _file(doctor)
    recover = command(
        actions,
        "recover",
        "make logs whole that a crash cut off, and empty the rings it left",
        RECOVER_EXAMPLE,
        _recover,
    )
    recover.description = RECOVER_TEXT
    recover.add_argument("path", metavar="FILE|FOLDER", type=log_file)
    recover.add_argument(
        "--out", metavar="FILE", default="", help="write the whole log there; default: in place for .open"
    )
    recover.add_argument("--json", action="store_true", help="print one JSON object")
    can = command(
        actions,
        "can",
        "what went over the CAN buses: identifiers, rates, changes, losses, values",
        "rtctl log can run.mcap\n  rtctl log can run.mcap --dbc configs/drive.dbc --values",
        _can,
    )
    _file(can)
    can.add_argument("--dbc", metavar="FILE", default="", help="decode by this DBC; default: the one in the log")
    can.add_argument("--values", action="store_true", help="smallest, largest and last value of every signal")
    mavlink = command(
        actions,
        "mavlink",
        "what went over the MAVLink links: senders, messages, rates, losses",
        "rtctl log mavlink rover.mcap",
        _mavlink,
    )
    _file(mavlink)
    tail = command(actions, "tail", "follow a log while it is written", TAIL_EXAMPLE, _tail)
    tail.add_argument(
        "path", metavar="FILE|FOLDER", type=log_file, nargs="?", default="logs", help="default: the newest in logs/"
    )
    tail.add_argument("--json", action="store_true", help="print a JSON object a line")
    tail.add_argument("--every", metavar="S", type=positive, default=1.0, help="between two states (%(default)s s)")
    tail.add_argument("--for", dest="seconds", metavar="S", type=positive, default=float("inf"), help="then stop")
    tail.add_argument("--foxglove", action="store_true", help="let Foxglove draw it: links, obstacles, goal, events")
    tail.add_argument("--host", metavar="H", help="of --foxglove (127.0.0.1)")
    tail.add_argument("--port", metavar="P", type=port, help="of --foxglove; 0: any free (8765)")
    pictures.add(actions)
    replays.add(actions)
    identify.add(actions)


LOOK = 0.1  # [s] between two looks at a growing file
TAIL_EXAMPLE = "rtctl log tail\n  rtctl log tail logs/ --json\n  rtctl log tail --foxglove"
RECOVER_EXAMPLE = "rtctl log recover logs/\n  rtctl log recover cut.mcap --out whole.mcap"
RECOVER_TEXT = """Make logs whole that a crash cut off, and empty the rings it left in /dev/shm.

A file is copied under a temporary name, opened again and counted by another reader before it is believed. Only then
does the copy replace a .open file, or stand beside any other.
Exit code 0: nothing was lost; 3: whole, but something was lost; 1: failed."""


def _file(parser: Parser) -> None:
    parser.add_argument("file", metavar="FILE", type=log_file)
    parser.add_argument("--json", action="store_true", help="print one JSON object")


def _info(arguments: argparse.Namespace) -> int:
    from rtctl.log.read.info import info

    found = info(arguments.file)
    print(json.dumps(found) if arguments.json else _text(found))
    return EXIT_OK


def _text(found: Json) -> str:
    state = "complete" if found["complete"] else f"cut off, {found['torn_bytes']} bytes torn"
    head = [
        ("file", f"{found['path']}, {found['bytes'] / 1e6:.2f} MB, {state}"),
        ("robot", f"{found.get('robot', 'unknown')}, config {str(found.get('config_sha256', 'unknown'))[:12]}"),
        ("duration", f"{found['duration_s']:.3f} s"),
        ("ended", str(found["sentinel"].get("reason", json.dumps(found["sentinel"]))) if found["sentinel"] else "-"),
        ("dropouts", f"{found['dropouts']['entries']} entries, {found['damaged_chunks']} damaged chunks"),
        ("versions", ", ".join(f"{name} {version}" for name, version in found.get("versions", {}).items()) or "-"),
    ]
    if found["beyond_2_63_ns"]:
        head.append(("times", "reach beyond 2^63 ns, the year 2262: those read as 2^63 - 1"))
    lines = [f"{name:9} {text}" for name, text in head]
    rows = [[n, str(t["messages"]), f"{t['hz']:.1f}", str(t["holes"]), t["schema"]] for n, t in found["topics"].items()]
    return "\n".join([*lines, "", table(rows, ["topic", "messages", "Hz", "holes", "schema"], frozenset((1, 2, 3)))])


def _doctor(arguments: argparse.Namespace) -> int:
    from rtctl.log.read.examine import examine

    path = Path(arguments.file)
    with bar("examining", path.stat().st_size if path.is_file() else 1) as progress:
        findings = examine(path, progress)
    good = all(f.good for f in findings)
    if arguments.json:
        print(json.dumps({"good": good, "findings": [f._asdict() for f in findings]}))
    else:
        print(table([["ok" if f.good else "BAD", f.name, f.text] for f in findings], ["", "what", "found"]))
    return EXIT_OK if good else EXIT_FAILED


def _recover(arguments: argparse.Namespace) -> int:
    from rtctl.log.read.mend import mend, open_files
    from rtctl.log.record.recorder import rescue

    path = Path(arguments.path)
    if path.is_dir():
        if arguments.out:
            raise UsageError("--out: got a folder to recover, wanted one file")
        cut = open_files(path)
        done = [mend(file) for file in cut if _free(file)]
        rescued = [p for p in rescue(path) if p not in {m.path for m in done}]
    else:
        done, rescued = [mend(path, Path(arguments.out) if arguments.out else None)], []
    if arguments.json:
        rows = [{k: str(v) if isinstance(v, Path) else v for k, v in m._asdict().items()} for m in done]
        print(json.dumps({"files": rows, "rescued": [str(p) for p in rescued]}))
    else:
        for m in done:
            lost = f"{m.lost_bytes} bytes and {m.damaged} chunks lost" if m.code else "nothing lost"
            more = ", with the sentinel" if m.independent > m.messages else ""
            print(f"{m.path}: {m.messages} messages, {lost}; another reader finds {m.independent}{more}")
        for p in rescued:
            print(f"{p}: out of the ring that a crash left")
        if not done and not rescued:
            print(f"{path}: nothing to recover")
    return max((m.code for m in done), default=EXIT_OK)


def _free(path: Path) -> bool:
    """Return whether nobody is writing a file."""
    import fcntl

    with path.open("rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            return False
    return True


def _can(arguments: argparse.Namespace) -> int:
    from rtctl.log.read.run import read_run
    from rtctl.log.view.export import buses
    from rtctl.log.view.traffic import load_dbc, traffic

    run = read_run(arguments.file)
    text = load_dbc(Path(arguments.dbc)) if arguments.dbc else ""
    with bar("reading frames", sum(run.count(bus) for bus in buses(run))) as progress:
        found = traffic(run, text, progress)
    if arguments.json:
        print(json.dumps([{**t._asdict(), "signals": [s._asdict() for s in t.signals]} for t in found]))
        return EXIT_OK
    head = ["bus", "id", "", "name", "frames", "Hz", "longest gap", "changed", "lost", "bytes", "last data"]
    rows = [
        [
            t.bus,
            f"{t.id:03X}",
            t.way,
            t.name,
            str(t.frames),
            f"{t.hz:.1f}",
            f"{t.gap_max * 1e3:.2f} ms",
            f"{100.0 * t.changes / t.frames:.1f} %",
            "-" if t.lost < 0 else str(t.lost),
            str(t.length),
            t.data,
        ]
        for t in found
    ]
    print(table(rows, head, frozenset((4, 5, 6, 7, 8, 9))))
    if arguments.values:
        signals = [
            [t.name, s.name, f"{s.smallest:.6g}", f"{s.largest:.6g}", s.choice or f"{s.last:.6g}", s.unit]
            for t in found
            for s in t.signals
        ]
        print()
        print(table(signals, ["message", "signal", "smallest", "largest", "last", "unit"], frozenset((2, 3, 4))))
    return EXIT_OK


def _mavlink(arguments: argparse.Namespace) -> int:
    from rtctl.log.read.run import read_run
    from rtctl.log.view.mavlink import listing

    found = listing(read_run(arguments.file))
    if arguments.json:
        print(json.dumps([row._asdict() for row in found]))
        return EXIT_OK
    rows = [
        [
            r.link,
            r.way,
            f"{r.system}/{r.component}",
            str(r.message),
            r.name,
            str(r.packets),
            f"{r.hz:.1f}",
            "-" if r.lost < 0 else str(r.lost),
        ]
        for r in found
    ]
    head = ["link", "", "sender", "message", "name", "packets", "Hz", "lost by sender"]
    print(table(rows, head, frozenset((3, 5, 6, 7))))
    return EXIT_OK


def _tail(arguments: argparse.Namespace) -> int:
    from rtctl.log.read.follow import Tail, newest

    if not arguments.foxglove and (arguments.host is not None or arguments.port is not None):
        raise UsageError("log tail: got --host or --port, wanted --foxglove beside it: nothing else listens")
    path = Path(arguments.path)
    path = newest(path) if path.is_dir() else path
    if not arguments.foxglove:
        return _follow(arguments, Tail(path), None)
    needs("view", "foxglove")
    from rtctl.cli.relay import TOPICS, Relay

    followed = Tail(path, TOPICS)
    relay = Relay(followed, arguments.host or "127.0.0.1", 8765 if arguments.port is None else arguments.port)
    try:
        print(f"rtctl: {relay.url}: in Foxglove, Open connection, Foxglove WebSocket  (Ctrl-C ends)", file=sys.stderr)
        return _follow(arguments, followed, relay)
    finally:
        relay.close()


def _follow(arguments: argparse.Namespace, followed: "Tail", relay: "Relay | None") -> int:
    from rtctl.cli.relay import pause

    until = time.monotonic() + arguments.seconds
    shown = -1e9
    while True:
        new = followed.read_on()
        if relay is not None:
            relay.add(new.messages, time.monotonic())
        for event in new.events:
            _say(event, arguments.json)
        if len(new.ticks) and float(new.ticks["time"][-1]) - shown >= arguments.every:
            shown = float(new.ticks["time"][-1])
            print(json.dumps(_state(new.ticks[-1])) if arguments.json else _line(new.ticks[-1]), flush=True)
        if new.ended:
            while relay is not None and relay.waits:
                pause(relay, LOOK)
            print(json.dumps({"ended": new.ended}) if arguments.json else f"ended: {new.ended.get('reason', '?')}")
            return EXIT_OK
        if time.monotonic() > until:
            return EXIT_OK
        pause(relay, LOOK)


def _say(event: Json, as_json: bool) -> None:
    if as_json:
        print(json.dumps({k: v for k, v in event.items() if k != "evidence"}), flush=True)
        return
    at, detail = event.get("time", 0.0), event.get("detail", "")
    text = f"{event.get('name', event.get('message', '?'))}{': ' if detail else ''}{detail}"
    print(f"{at if isinstance(at, int | float) else 0.0:10.3f} s  {text}", flush=True)


def _state(record: "RecordRow") -> Json:
    import numpy as np

    from rtctl.log.read.fields import called
    from rtctl.types import State, Status

    rho = record["rho"][np.isfinite(record["rho"])]
    return {
        "time_s": float(record["time"]),
        "tick": int(record["tick"]),
        "state": called(State, int(record["state"])),
        "status": called(Status, int(record["status"])).lower(),
        "x_m": record["x"].tolist(),
        "error_m": float(record["error"]),
        "clearance_m": float(rho.min()) if len(rho) else None,
    }


def _line(record: "RecordRow") -> str:
    s = _state(record)
    near = "" if s["clearance_m"] is None else f"clearance {s['clearance_m'] * 1e3:.1f} mm"
    x = " ".join(f"{v:+.3f}" for v in s["x_m"])
    words = [f"{s['time_s']:10.3f} s", f"{s['state']:9}", f"{s['status']:13}", f"tip {x}"]
    return "  ".join([*words, f"error {s['error_m'] * 1e3:.1f} mm", near]).rstrip()

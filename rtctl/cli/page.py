"""`rtctl view`: a robot in the browser, live or from a log; and the same page beside `rtctl sim --view`."""

import argparse
import os
import signal
import subprocess
import sys
import webbrowser
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from rtctl.cli.parser import Commands, Parser, command, log_file, port
from rtctl.errors import EXIT_OK, RtctlError, UsageError, needs

if TYPE_CHECKING:
    from rtctl.view.follow import Source
    from rtctl.view.operator import Operator

EXAMPLE = """rtctl view
  rtctl view run.mcap
  rtctl view --robot panda --host 0.0.0.0"""
OPENED = "rtctl: the page is open"  # told to who started us, once somebody looks
TEXT = """Show a robot in the browser: the one that a daemon of this user drives, or FILE, a log.

The page maps the daemon's shared memory read-only and never holds it up. It is read-only until it is unlocked there;
then it arms, stops, takes goals and obstacles by hand, each judged by the daemon as from `rtctl goal`. It listens on
this machine alone. With another --host the address carries a token: who has it may command the robot.
Its stop is no emergency stop."""


def add(commands: Commands) -> None:
    """Add the command."""
    view = command(commands, "view", "see a robot in the browser, live or from a log", EXAMPLE, _view)
    view.description = TEXT
    view.add_argument(
        "file", metavar="FILE", type=log_file, nargs="?", default="", help="a log; default: what runs now"
    )
    which = view.add_mutually_exclusive_group()
    which.add_argument("--socket", metavar="PATH", default="", help="the daemon's control socket")
    which.add_argument("--robot", metavar="NAME", default="", help="the daemon of this robot; default: the only one")
    which.add_argument("--ring", metavar="FILE", default="", help="in /dev/shm, of one of several that run")
    add_address(view)


def add_address(parser: Parser) -> None:
    """Add where the page listens."""
    parser.add_argument("--host", metavar="H", default="127.0.0.1", help="of the page (%(default)s)")
    parser.add_argument("--port", metavar="P", type=port, default=8080, help="of the page; 0: any free (%(default)s)")
    parser.add_argument("--no-browser", action="store_true", help="print the address alone")


def _view(arguments: argparse.Namespace) -> int:
    needs("view", "viser")
    from rtctl.view.page import Page

    signal.signal(signal.SIGTERM, signal.default_int_handler)
    parent = os.getppid()
    source, operator = _source(arguments)
    page = Page(source, operator, arguments.host, arguments.port)
    try:
        print(f"rtctl: {page.gate.url}  (Ctrl-C ends)", flush=True)
        if arguments.host != "127.0.0.1":
            print("rtctl: who has this address may command the robot", flush=True)
        if not arguments.no_browser:
            webbrowser.open(page.gate.url)
        if arguments.ring:
            page.when_seen(lambda: print(OPENED, flush=True))
        page.run(lambda: bool(arguments.ring) and os.getppid() != parent)  # a simulation's page ends with it
    except KeyboardInterrupt:  # the way one leaves it
        pass
    finally:
        page.close()
    return EXIT_OK


def _source(arguments: argparse.Namespace) -> "tuple[Source, Operator]":
    from rtctl.hal.client import find
    from rtctl.view.follow import Live, Recorded
    from rtctl.view.operator import Operator

    if not arguments.file:
        live = Live(arguments.robot, arguments.socket, Path(arguments.ring) if arguments.ring else None)
        return live, Operator(lambda: arguments.socket or find(live.robot))
    if arguments.socket or arguments.robot:
        raise UsageError("view: got a log and a daemon, wanted one of them")
    from rtctl.cli.progress import bar
    from rtctl.log import schema
    from rtctl.log.read.run import read_run

    run = read_run(arguments.file)
    with bar("reading", max(1, run.count(schema.TICK))) as progress:
        return Recorded(run, progress), Operator(None)


@contextmanager
def viewer(arguments: argparse.Namespace) -> Iterator[Callable[[Path], None] | None]:
    """Yield what shows a simulation in a page of its own process, None where none is asked for."""
    if not arguments.view:
        yield None
        return
    needs("view", "viser")
    pages: list[subprocess.Popen[str]] = []

    def shown(ring: Path) -> None:
        where = [
            "--host",
            arguments.host,
            "--port",
            str(arguments.port),
            *(["--no-browser"] if arguments.no_browser else []),
        ]
        call = [sys.executable, "-m", "rtctl", "view", "--ring", str(ring), *where]
        page = subprocess.Popen(call, stdout=subprocess.PIPE, text=True, start_new_session=True)
        pages.append(page)
        assert page.stdout is not None
        print("rtctl: the scenario begins when the page is opened", file=sys.stderr, flush=True)
        for line in page.stdout:
            if line.strip() == OPENED:
                return
            print(line, end="", file=sys.stderr, flush=True)
        raise RtctlError("the page could not be shown")

    try:
        yield shown
    finally:
        for page in pages:
            page.terminate()
            page.wait(20)
            if page.stdout is not None:
                page.stdout.close()

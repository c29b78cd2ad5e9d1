"""What all commands share: one-line errors, examples in the help, checked numbers, options that find the daemon."""

import argparse
import math
import os
import re
from collections.abc import Callable
from typing import Any, NoReturn

from rtctl.errors import UsageError

Work = Callable[[argparse.Namespace], int]
Commands = Any  # argparse's own type of add_subparsers is private


class Parser(argparse.ArgumentParser):
    """An argument parser whose complaints are one line."""

    def __init__(self, **kwargs: Any) -> None:
        """Take argparse's arguments; abbreviations are off, so that a new option never changes an old call."""
        kwargs.setdefault("formatter_class", argparse.RawDescriptionHelpFormatter)
        super().__init__(allow_abbrev=False, **kwargs)
        # argparse takes -1e-3 for an option; coordinates are written like that
        self._negative_number_matcher = re.compile(r"^-(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?$")

    def error(self, message: str) -> NoReturn:
        """Raise the complaint instead of printing the usage around it."""
        raise UsageError(f"{message} (see {self.prog} --help)")


def command(commands: Commands, name: str, help_: str, example: str, work: Work | None = None) -> Parser:
    """Add a command with a line of help and at least one example; `work` runs it."""
    parser: Parser = commands.add_parser(name, help=help_, description=help_, epilog=f"example:\n  {example}")
    if work is not None:
        parser.set_defaults(work=work)
    return parser


def add_daemon(parser: Parser) -> None:
    """Add the options that choose the daemon and bound its answer."""
    which = parser.add_mutually_exclusive_group()
    which.add_argument("--socket", metavar="PATH", default="", help="the daemon's control socket")
    which.add_argument("--robot", metavar="NAME", default="", help="the daemon of this robot; default: the only one")
    parser.add_argument(
        "--reply", metavar="S", type=positive, default=2.0, help="to wait for an answer (%(default)s s)"
    )


def daemon_of(arguments: argparse.Namespace) -> str:
    """Return the control socket that the options mean. Raises LinkError, UsageError."""
    if arguments.socket:
        return str(arguments.socket)
    from rtctl.hal.client import find

    return find(arguments.robot)


def number(text: str) -> float:
    """Return a finite number."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"got {text!r}, wanted a finite number")
    return value


def log_file(text: str) -> str:
    """Return the name of a log file or folder. Raises UsageError for one that cannot be said in a message or a page."""
    try:
        text.encode()
    except UnicodeEncodeError:
        name = os.fsencode(text).decode("utf-8", "backslashreplace")
        raise UsageError(f"{name}: its name is not UTF-8; rename it first") from None
    return text


def positive(text: str) -> float:
    """Return a finite number above zero."""
    value = number(text)
    if value <= 0.0:
        raise argparse.ArgumentTypeError(f"got {text!r}, wanted a number above 0")
    return value

"""What all commands share: one-line errors, examples in the help, checked numbers, options that find the daemon."""

import argparse
import math
import os
import re
from collections.abc import Callable
from typing import Any, NoReturn

from rtctl.errors import UsageError
from rtctl.spell import nearest

Work = Callable[[argparse.Namespace], int]
Commands = Any  # argparse's own type of add_subparsers is private


class Parser(argparse.ArgumentParser):
    """An argument parser whose complaints are one line: the argument, what came, what was wanted, the nearest name."""

    def __init__(self, **kwargs: Any) -> None:
        """Take argparse's arguments; abbreviations are off, so that a new option never changes an old call."""
        kwargs.setdefault("formatter_class", argparse.RawDescriptionHelpFormatter)
        super().__init__(allow_abbrev=False, **kwargs)
        # argparse takes -1e-3 for an option; coordinates are written like that
        self._negative_number_matcher = re.compile(r"^-(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?$")

    def error(self, message: str) -> NoReturn:
        """Raise the complaint instead of printing the usage around it."""
        raise UsageError(f"{in_house(message)} (see {self.prog} --help)")

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Refuse here what no option or place takes: the parser of the command knows the names it has."""
        found, rest = super().parse_known_args(args, namespace)
        if rest:
            options = [name for name in self._option_string_actions if name.startswith("--")]
            unknown = next((word for word in rest if word.startswith("-")), "")
            if unknown:
                self.error(f"got {unknown}, an unknown option, wanted {nearest(unknown.split('=')[0], options)}")
            self.error(f"got {' '.join(rest)} beyond what the command takes, wanted nothing more")
        return found, rest

    def _check_value(self, action: argparse.Action, value: object) -> None:
        if action.choices is not None and value not in action.choices:
            names = [str(choice) for choice in action.choices]
            raise argparse.ArgumentError(action, f"got {value!r}, wanted {nearest(str(value), names)}")


COMPLAINTS = (  # of argparse, in the words that all mistakes have here
    (r"the following arguments are required: (.*)", r"\1: got nothing, wanted a value"),
    (r"one of the arguments (.*) is required", r"got none of \1, wanted one of them"),
    (r"expected (\d+) arguments?", r"got fewer values, wanted \1"),
    (r"expected one argument", r"got nothing, wanted a value"),
    (r"expected at least one argument", r"got nothing, wanted a value or more"),
    (r"invalid int value: (.*)", r"got \1, wanted a whole number"),
    (r"not allowed with argument (.*)", r"got \1 beside it, wanted one of them"),
)


def in_house(message: str) -> str:
    """Return a complaint of argparse in the words that all mistakes have here."""
    message = message.removeprefix("argument ")
    for pattern, words in COMPLAINTS:
        message = re.sub(pattern, words, message)
    return message


def command(commands: Commands, name: str, help_: str, example: str, work: Work | None = None) -> Parser:
    """Add a command with a line of help, at least one example and its exit codes; `work` runs it."""
    parser: Parser = commands.add_parser(name, help=help_, description=help_, epilog=f"example:\n  {example}")
    assert parser.epilog is not None
    parser.epilog += exit_codes(parser.prog)
    if work is not None:
        parser.set_defaults(work=work)
    return parser


CONFIG_REFUSED = "the file, or what was found on the bus, is refused"
VERB_FAILED = "no daemon, refused, or it did not come to that in time"
CODES: dict[str, dict[int, str]] = {  # what 1 and 78 mean to a command; 0 and 2 mean the same to all
    "check": {78: CONFIG_REFUSED},
    "run": {1: "the loop failed, or the vehicle did not come in time", 78: CONFIG_REFUSED},
    "warm": {1: "compilation failed", 78: CONFIG_REFUSED},
    "commission": {1: "no answers, or torque contradicts reading", 78: CONFIG_REFUSED},
    "goal": {1: "no daemon, refused, or not reached"},
    "goals": {1: "no daemon, or a goal was refused or not reached"},
    "obstacle": {1: "no daemon, or refused"},
    "payload": {1: "no daemon, or refused"},
    "grip": {1: "no daemon, refused, or it neither came there nor holds anything"},
    "status": {1: "no daemon, or it ended"},
    "sim": {1: "a goal was missed, or something was touched (--allow-miss: never)", 78: CONFIG_REFUSED},
    "doctor": {1: "something that torque needs is missing"},
    "plan": {1: "no way was found, or it was not followed to its end", 78: CONFIG_REFUSED},
    "log": {1: "the log cannot be read, or lacks what was asked of it"},
    "bench": {1: "a figure misses its target"},
    "experiment": {1: "an experiment could not be played"},
    "init": {1: "the robot cannot be controlled, or its packages are missing", 78: "the written file is refused"},
    **{verb: {1: VERB_FAILED} for verb in ("arm", "disarm", "park", "stop", "reset", "float", "hold", "recover")},
}


def exit_codes(prog: str) -> str:
    """Return the table of a command's exit codes, for the end of its help."""
    rows = {0: "done", **CODES.get(prog.split()[1], {}), 2: "a wrong call: see above"}
    return "\n\nexit codes:\n" + "\n".join(f"  {code:<4}{words}" for code, words in sorted(rows.items()))


def add_daemon(parser: Parser) -> None:
    """Add the options that choose the daemon and bound its answer."""
    which = parser.add_mutually_exclusive_group()
    which.add_argument("--socket", metavar="PATH", default="", help="the daemon's control socket")
    robot = which.add_argument(
        "--robot", metavar="NAME", default="", help="the daemon of this robot; default: the only one"
    )
    robot.completer = _robots  # type: ignore[attr-defined] # as argcomplete looks for it
    parser.add_argument(
        "--reply", metavar="S", type=positive, default=2.0, help="to wait for an answer (%(default)s s)"
    )


def _robots(**_: object) -> list[str]:
    """Return the names that a shell may complete --robot to."""
    from pathlib import Path

    from rtctl.hal.client import running

    return [Path(path).stem.removeprefix("rtctl-") for path in running()]


def daemon_of(arguments: argparse.Namespace, patience: float = 0.0) -> str:
    """Return the control socket that the options mean, waited for `patience` [s]. Raises LinkError, UsageError."""
    if arguments.socket:
        return str(arguments.socket)
    from rtctl.hal.client import find

    return find(arguments.robot, patience)


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


def port(text: str) -> int:
    """Return a TCP port; 0 is any free one."""
    if not text.isdecimal() or int(text) > 65535:
        raise argparse.ArgumentTypeError(f"got {text!r}, wanted a port of 0 to 65535")
    return int(text)

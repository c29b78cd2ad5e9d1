"""The command `rtctl`: parsers here, work in the modules beside; nothing heavy is imported before it is needed."""

import io
import os
import sys
from collections.abc import Sequence

from rtctl.cli import campaign, commission, experiments, init, logs, offline, operate, page, plan
from rtctl.cli.parser import Parser
from rtctl.errors import EXIT_FAILED, EXIT_OK, EXIT_USAGE, RtctlError, UsageError, lacking, until_interrupted

EXAMPLES = """example:
  rtctl check configs/panda.toml
  rtctl run configs/panda.toml &
  rtctl arm && rtctl goal 0.45 0.20 0.40 && rtctl status
"""
CODES = """
exit codes of all commands (each command's own: rtctl COMMAND --help):
  0   done; a verb: what it causes has happened
  1   it failed: refused, not reached, touched, no daemon, a log that cannot be read
  2   a wrong call: an unknown command or option, a value of the wrong kind
  78  a file, or what was found on the bus, is refused

Not safety-rated: a hardware emergency stop is required.
"""


def build_parser() -> Parser:
    """Return the parser of the whole command line; each command carries its function as `work`."""
    parser = Parser(
        prog="rtctl",
        description="Torque control of arms in operational space, with obstacle avoidance, over CAN.",
        epilog=EXAMPLES + CODES,
    )
    parser.add_argument("--version", action="store_true", help="print the version and exit")
    commands = parser.add_subparsers(metavar="COMMAND", dest="command")
    init.add(commands)
    offline.add_before(commands)
    commission.add(commands)
    operate.add(commands)
    page.add(commands)
    plan.add(commands)
    offline.add_after(commands)
    experiments.add(commands)
    campaign.add(commands)
    logs.add(commands)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return the exit code: 0, 1 failed, 2 wrong call, 78 refused config."""
    if isinstance(sys.stdout, io.TextIOWrapper):  # a terminal without our letters shows others, no traceback
        sys.stdout.reconfigure(errors="replace")
    try:
        with until_interrupted():
            code = _run(sys.argv[1:] if argv is None else list(argv))
            sys.stdout.flush()
            return code
        return EXIT_FAILED
    except BrokenPipeError:  # whoever read our output has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # the interpreter's own flush at exit must not fail again
        return EXIT_FAILED
    except RtctlError as error:
        return _report(str(error), error.exit_code)
    except ModuleNotFoundError as error:
        text = lacking(error)
        if not text:
            raise
        return _report(text, EXIT_USAGE)
    except OSError as error:
        got = (error.strerror or str(error)).lower()
        words = f"{error.filename}: got {got}, wanted a file that can be opened" if error.filename else got
        return _report(words, EXIT_FAILED)


def _run(argv: list[str]) -> int:
    parser = build_parser()
    if "_ARGCOMPLETE" in os.environ:  # a shell asks what could come next (rtctl completion)
        import argcomplete

        argcomplete.autocomplete(parser)
    arguments = parser.parse_args(argv)
    if arguments.version:
        from rtctl import __version__

        print(f"rtctl {__version__}")
        return EXIT_OK
    if arguments.command is None:
        raise UsageError("COMMAND: got nothing, wanted one, such as check, sim, run, arm (see rtctl --help)")
    return int(arguments.work(arguments))


def _report(text: str, code: int) -> int:
    print(f"rtctl: {' '.join(text.split())}", file=sys.stderr)
    return code

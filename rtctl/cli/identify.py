"""`rtctl log identify`: payload and friction of the arm of a log, as keys for its file."""

import argparse
import json

from rtctl.cli.parser import Commands, command, log_file
from rtctl.cli.values import table
from rtctl.errors import EXIT_OK

EXAMPLE = "rtctl log identify logs/panda.000.mcap"
TEXT = """Find what the arm of a log carried at its tip and how its joints rubbed, by least squares; print it as keys.
The arm must have moved for some seconds, each joint to and fro; what a joint did at rest is left out. Every number
comes with its standard error; what is not three of them away from nothing is not printed as a key."""


def add(actions: Commands) -> None:
    """Add the command."""
    parser = command(actions, "identify", "payload and friction of the arm, with their errors", EXAMPLE, _identify)
    parser.description = TEXT
    parser.add_argument("file", metavar="FILE", type=log_file)
    parser.add_argument("--json", action="store_true", help="print one JSON object")


def _identify(arguments: argparse.Namespace) -> int:
    from rtctl.app.identify import Number, from_file

    found = from_file(arguments.file)
    if arguments.json:
        print(json.dumps(found.as_dict()))
        return EXIT_OK

    def shown(x: Number) -> str:
        return f"{x.value:.4g} +- {x.sigma:.2g}"

    print(f"{found.robot}: {found.seconds:.1f} s of motion")
    print(f"payload {shown(found.mass)} kg at {', '.join(map(shown, found.com))} m of the tip\n")
    rows = [
        [name, shown(c), shown(b), f"{left:.3g}"]
        for name, c, b, left in zip(found.joints, found.coulomb, found.viscous, found.left.tolist(), strict=True)
    ]
    print(table(rows, ["joint", "Coulomb [Nm]", "viscous [Nms/rad]", "unexplained [Nm]"], frozenset((1, 2, 3))))
    print(f"\n{found.toml()}")
    return EXIT_OK

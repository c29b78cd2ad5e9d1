"""`rtctl init`: a config for an arm that nobody has described to rtctl yet."""

import argparse
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from rtctl.cli.parser import Commands, command, positive
from rtctl.errors import EXIT_OK, UsageError

if TYPE_CHECKING:
    from rtctl.intake.body import Asked
    from rtctl.intake.make import Made
    from rtctl.intake.sources import Source

EXAMPLE = """rtctl init arm.urdf --tip tool0
  rtctl init so101 --out mine && rtctl check mine/so101.toml && rtctl sim mine/so101_first.toml
  rtctl init robosuite:baxter --side left --name baxter_left --repair
  rtctl init yam.urdf --drives damiao:4340,4340,4340,4310,4310,4310"""
TEXT = """Make a config of an arm from its description: a URDF, xacro or MJCF file, or the name of a robot of an
installed package (example-robot-data, rtb-data, pybullet_data, robosuite; robot_descriptions:NAME fetches one).
Written are NAME.toml, NAME.urdf (the arm alone, with convex collision geometry), NAME_meshes/ and NAME_first.toml, a
scenario of two goals. What was missing, assumed or changed is told, and stands in the file."""
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.+-]{0,31}")


def add(commands: Commands) -> None:
    """Add the command."""
    parser = command(commands, "init", "make a config of an arm from its description", EXAMPLE, _init)
    parser.description = TEXT
    parser.add_argument("robot", metavar="ROBOT", nargs="?", default="", help="a file, or a name; --list prints names")
    parser.add_argument("--list", action="store_true", help="print the robots of the installed packages and exit")
    parser.add_argument("--out", metavar="DIR", default=".", help="where to write (%(default)s)")
    parser.add_argument("--name", metavar="NAME", default="", help="of the robot and its files; default: ROBOT's")
    parser.add_argument("--tip", metavar="FRAME", default="", help="frame that goals are for; asked for where unclear")
    parser.add_argument("--side", choices=("left", "right"), default="", metavar="SIDE", help="left or right arm")
    parser.add_argument("--joints", metavar="PATTERN", default="", help="joints of the arm, as arm_left_*; others lock")
    parser.add_argument("--lock", metavar="JOINT=RAD", action="append", default=[], help="where a joint is locked (0)")
    parser.add_argument(
        "--exclude", metavar="LINK", action="append", default=[], help="leave a link out, and what it carries"
    )
    parser.add_argument(
        "--scale", metavar="S", type=positive, default=1.0, help="of all lengths: 0.001 for millimetres"
    )
    parser.add_argument("--drives", metavar="MAKER:TYPES", default="virtual", help="damiao:8009,4340,… or %(default)s")
    parser.add_argument("--repair", action="store_true", help="replace impossible inertias and torques, and say so")
    parser.add_argument("--force", action="store_true", help="write over files that are there")


def _init(arguments: argparse.Namespace) -> int:
    from rtctl.intake import sources

    if arguments.list:
        for name, places in sorted(sources.index().items()):
            print(f"{name:<40}{', '.join(places)}")
        return EXIT_OK
    if not arguments.robot:
        raise UsageError("ROBOT: got nothing, wanted a URDF, xacro or MJCF file, or a name (rtctl init --list)")
    from rtctl.intake.body import Asked

    found = sources.find(arguments.robot)
    name = arguments.name or found.name
    if not NAME.fullmatch(name):
        raise UsageError(f"--name: got {name!r}, wanted 1 to 32 letters, digits, _.+-")
    config = Path(arguments.out) / f"{name}.toml"
    if config.exists() and not arguments.force:
        raise UsageError(f"{config}: got a file that is there already, wanted --force or another --name or --out")
    locks = _locks(arguments.lock)
    asked = Asked(arguments.tip, arguments.side, arguments.joints, locks, arguments.exclude, arguments.scale)
    made = _made(found, Path(arguments.out), name, asked, arguments)
    for line in made.told:
        print(f"  {line}")
    from rtctl import design

    loaded = design.load(made.config)
    design.build(loaded, made.config)
    print(f"{made.config}: {made.joints} joints, from {found.origin}; rtctl check accepts it")
    if made.scenario is not None:
        print(f"next: rtctl sim {made.scenario}")
    return EXIT_OK


def _made(found: "Source", folder: Path, name: str, asked: "Asked", arguments: argparse.Namespace) -> "Made":
    """Make the files; ask at a terminal where the arm ends if that is unclear."""
    from rtctl.intake.make import make

    try:
        return make(found, folder, name, asked, arguments.drives, arguments.repair)
    except UsageError as error:
        if not (str(error).startswith("--tip: got nothing") and sys.stdin.isatty()):
            raise
        print(f"rtctl: {error}", file=sys.stderr)
    tip = input("tip frame? ").strip()
    return make(found, folder, name, asked._replace(tip=tip), arguments.drives, arguments.repair)


def _locks(words: list[str]) -> dict[str, float]:
    found = {}
    for word in words:
        name, _, value = word.partition("=")
        try:
            found[name] = float(value)
        except ValueError:
            raise UsageError(f"--lock: got {word!r}, wanted JOINT=RAD") from None
    return found

"""`rtctl plan`: its parser; the work is in `planning`, whose imports take seconds."""

import argparse

from rtctl.cli.parser import Commands, add_daemon, command, number, positive


def add(commands: Commands) -> None:
    """Add the planner's command."""
    parser = command(
        commands,
        "plan",
        "plan a way to a far goal: sub-goals for the same goal interface",
        "rtctl plan configs/panda.toml --to 0.53 0 0.22 --scenario configs/scenarios/trap.toml\n"
        "  rtctl plan configs/panda.toml --to 0.53 0 0.22 --run",
        _plan,
    )
    parser.description = (
        "Without --from and --scenario: from where the running robot is, around the obstacles that it knows of.\n"
        "The sub-goals are printed, one JSON line each, as `rtctl goals FILE --pass 0.07` takes them; with --run they\n"
        "are followed, and planned anew when the controller reports that something holds the arm."
    )
    parser.add_argument("config", metavar="CONFIG")
    parser.add_argument("--to", metavar=("X", "Y", "Z"), nargs=3, type=number, required=True, help="[m]")
    turn = parser.add_mutually_exclusive_group()
    turn.add_argument("--rpy", metavar=("R", "P", "Y"), nargs=3, type=number, help="roll, pitch, yaw [rad]")
    turn.add_argument("--wxyz", metavar=("W", "X", "Y", "Z"), nargs=4, type=number, help="unit quaternion")
    parser.add_argument("--from", metavar="Q", dest="start", nargs="+", type=number, help="start posture [rad]")
    parser.add_argument("--scenario", metavar="FILE", help="its start and obstacles, as they are at its beginning")
    parser.add_argument("--seed", metavar="N", type=int, default=0, help="the same seed gives the same path")
    parser.add_argument("--within", metavar="S", type=positive, default=20.0, help="to find a path (%(default)s s)")
    parser.add_argument("--run", action="store_true", help="follow the sub-goals on the running robot")
    parser.add_argument("--timeout", metavar="S", type=positive, default=60.0, help="with --run, to arrive")
    parser.add_argument("--json", action="store_true", help="with --run, print one JSON object")
    add_daemon(parser)


def _plan(arguments: argparse.Namespace) -> int:
    from rtctl.cli.planning import run

    return run(arguments)

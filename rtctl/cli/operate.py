"""Commands to a running daemon, over its control socket."""

import argparse
import json
import os
import sys
import time
from contextlib import closing, suppress
from typing import TYPE_CHECKING

from rtctl.cli.parser import Commands, Parser, add_daemon, command, daemon_of, number, positive
from rtctl.errors import EXIT_FAILED, EXIT_OK, LinkError, RequestError, UsageError
from rtctl.plain import Json

if TYPE_CHECKING:
    from rtctl.hal.client import Session

VERBS = {
    "arm": "enable the drives; the arm holds where it is",
    "disarm": "come to rest, then disable the drives",
    "park": "move to robot.park_rad, where the arm rests without torque, then disable the drives",
    "stop": "brake now; only an operator's reset leaves the stop",
    "reset": "leave a latched stop or fault, once its cause is gone",
    "float": "let a hand move the arm: its weight is carried, limits and obstacles are kept; ends with hold or a goal",
    "hold": "stay here, without a goal",
    "recover": "where a joint is beyond its limit: enable the drives, move slowly inward",
}
KEYS_OF = {
    "sphere": "radius_m",
    "point": "",
    "capsule": "radius_m length_m",
    "segment": "length_m [radius_m]",
    "cylinder": "radius_m length_m",
    "cone": "radius_m height_m [top_radius_m]",
    "box": "size_m=x,y,z",
    "plane": "[normal=x,y,z]",
    "ellipsoid": "semi_axes_m=a,b,c",
    "n_ellipsoid": "semi_axes_m=a,b,c n",
    "n_cylinder": "semi_axes_m=a,b,c n",
    "mesh": "mesh=NAME",
    "cloud": "file=FILE.npy|.xyz|.ply point_radius_m [voxel_m]",
}
WATCH_PERIOD = 0.1  # [s]
NOTE_EVERY = 5.0  # [s] between two notes of a daemon that gives no answer
PATIENT, PATIENCE = ("arm", "recover"), 3.0  # [s] verbs that a daemon started beside is waited for, to open its socket
EVERYTHING = "*"
MISSION_MAX = 4_000_000  # characters of a mission's file at most


def add(commands: Commands) -> None:
    """Add the operator's commands."""
    for verb, text in VERBS.items():
        parser = command(commands, verb, text, f"rtctl {verb} --robot panda", _verb)
        _add_no_wait(parser)
        if verb == "disarm":
            parser.add_argument("--drop", action="store_true", help="also an arm without brakes, which falls then")
        parser.add_argument(
            "--timeout", metavar="S", type=positive, default=60.0, help="to come to that (%(default)s s)"
        )
        add_daemon(parser)
    example = "rtctl goal 0.45 -0.2 0.4 --rpy 3.14 0 0"
    goal = command(commands, "goal", "send the tip to a position [m], a pose, or a part of one", example, _goal)
    for axis in "xyz":
        goal.add_argument(
            axis, metavar=axis.upper(), type=number, nargs="?", help="in the world frame [m]; of a base Z means nothing"
        )
    goal.add_argument("--latlon", metavar=("LAT", "LON"), nargs=2, type=number, help="of a base instead of X Y [deg]")
    turn = goal.add_mutually_exclusive_group()
    turn.add_argument("--rpy", metavar=("R", "P", "Y"), nargs=3, type=number, help="roll, pitch, yaw [rad]")
    turn.add_argument("--wxyz", metavar=("W", "X", "Y", "Z"), nargs=4, type=number, help="unit quaternion")
    turn.add_argument("--hold-orientation", action="store_true", help="keep the present orientation")
    turn.add_argument("--direction", metavar=("X", "Y", "Z"), nargs=3, type=number, help="where the tool's axis points")
    turn.add_argument("--heading", metavar="RAD", type=number, help="of a base, counter-clockwise from east [rad]")
    goal.add_argument("--tool-axis", metavar="AXIS", help="that axis of the tip: x y z -x -y -z (z)")
    goal.add_argument("--axes", metavar="AXES", help="of X Y Z those that count: xy, z, …; none: orientation alone")
    goal.add_argument("--tolerance", metavar="M", type=positive, help="arrived within this distance [m]")
    goal.add_argument(
        "--velocity",
        metavar=("X", "Y", "Z"),
        nargs=3,
        type=number,
        help="of a goal that moves [m/s]: it is not waited for",
    )
    goal.add_argument(
        "--turning", metavar=("X", "Y", "Z"), nargs=3, type=number, help="of its orientation, in world axes [rad/s]"
    )
    goal.add_argument("--timeout-ms", metavar="MS", type=positive, help="stop the arm unless another comes within it")
    _add_waiting(goal)
    _add_no_wait(goal)
    goal.add_argument("--wait", action="store_true", help=argparse.SUPPRESS)  # what it does anyway, for older calls
    goals = command(commands, "goals", "send a stream of goals", "rtctl goals tour.csv --keep-going", _goals)
    goals.description = (
        "Send goals one after another, each when the one before has arrived. A line is x,y,z; x,y,z,roll,pitch,yaw;\n"
        "x,y,z,w,x,y,z; under a header of such names (and dx,dy,dz, lat,lon, heading_rad, tool_axis, axes,\n"
        "tolerance_m, vx,vy,vz, wx,wy,wz, timeout_ms); or JSON:\n"
        '{"position_m": [0.4, 0, 0.5], "hold": "orientation"}.\n'
        "A goal that moves (vx,vy,vz [m/s], wx,wy,wz [rad/s]) is not waited for: the next line follows as it comes,\n"
        "or at --rate; the last one of a stream rests, or the arm stops.\n"
        "Of a base also a mission of QGroundControl, .plan or .waypoints, of way-points alone."
    )
    goals.add_argument("file", metavar="FILE", help="CSV or JSON lines; - reads standard input as it comes")
    _add_waiting(goals)
    goals.add_argument("--rate", metavar="HZ", type=positive, help="send at this rate without waiting for arrival")
    goals.add_argument(
        "--pass", metavar="M", dest="near", type=positive, help="give the next goal when the tip is this near [m]"
    )
    goals.add_argument("--keep-going", action="store_true", help="go on after a goal that was refused or not reached")
    _add_obstacle(commands)
    payload = command(commands, "payload", "tell what the tip carries", "rtctl payload 0.8 0 0 0.05", _payload)
    payload.add_argument("mass", metavar="KG", type=number, help="0: nothing")
    payload.add_argument(
        "com", metavar="X Y Z", type=number, nargs="*", default=(), help="its centre in the tip's frame [m] (0 0 0)"
    )
    add_daemon(payload)
    grip = command(commands, "grip", "move the gripper", "rtctl grip 1 --force 20", _grip)
    grip.add_argument("closed", metavar="SHARE", type=number, help="0 open … 1 closed")
    grip.add_argument("--force", metavar="N", type=positive, help="between the jaws at most (what the file allows)")
    grip.add_argument("--name", metavar="NAME", default="", help="of the gripper (every one)")
    grip.add_argument("--timeout", metavar="S", type=positive, default=10.0, help="to be there (%(default)s s)")
    _add_no_wait(grip)
    add_daemon(grip)
    status = command(commands, "status", "show how things stand", "rtctl status --watch", _status)
    status.add_argument("--watch", action="store_true", help="keep showing, ten times a second")
    status.add_argument("--json", action="store_true", help="print the daemon's reply; with --watch one a line")
    add_daemon(status)


def _add_no_wait(parser: Parser) -> None:
    parser.add_argument("--no-wait", action="store_true", help="return when it was taken, not when it is done")


def _add_waiting(parser: Parser) -> None:
    parser.add_argument("--timeout", metavar="S", type=positive, default=30.0, help="to arrive, a goal (%(default)s s)")
    parser.add_argument("--json", action="store_true", help="print one JSON object per goal")
    add_daemon(parser)


def _add_obstacle(commands: Commands) -> None:
    parser = command(
        commands,
        "obstacle",
        "set or clear an obstacle",
        "rtctl obstacle set ball sphere radius_m=0.05 position_m=0.4,0,0.5 velocity_m_s=0,0.1,0\n"
        "  rtctl obstacle set lamp sphere radius_m=0.1 position_m=0.6,0,0.5 influence_m=0.2 clearance_m=0.06\n"
        "  rtctl obstacle clear ball",
    )
    actions = parser.add_subparsers(metavar="ACTION", dest="action", required=True)
    example = "rtctl obstacle set crate box size_m=0.2,0.2,0.1 position_m=0.5,0,0.05"
    setter = command(actions, "set", "put an obstacle, or move it", example, _set)
    setter.add_argument("name", metavar="NAME")
    kind = setter.add_argument("type", metavar="TYPE", help="one of those above")
    kind.completer = lambda **_: list(KEYS_OF)  # type: ignore[attr-defined] # as argcomplete looks for it
    setter.add_argument("keys", metavar="KEY=VALUE", nargs="*", help="as in a scenario's [[obstacle]]; lists by commas")
    setter.description = "Put an obstacle, or move it. Its type's own keys:\n\n" + "\n".join(
        f"  {kind:12} {keys}" for kind, keys in KEYS_OF.items()
    )
    setter.description += (
        "\n\nand of all: position_m, rpy_rad or wxyz, velocity_m_s, omega_rad_s, group, combine=union|sum,\n"
        "influence_m, clearance_m: where its field begins, and what the arm keeps of it; without them as in [avoid].\n"
        "A mesh is one that the daemon's config names in a [[mesh]]; a cloud's file is read here, thinned and sent."
    )
    add_daemon(setter)
    clear = command(actions, "clear", "forget an obstacle", "rtctl obstacle clear --all", _clear)
    which = clear.add_mutually_exclusive_group(required=True)
    which.add_argument("name", metavar="NAME", nargs="?", default="")
    which.add_argument("--all", action="store_true", help="forget all, the config's own included")
    add_daemon(clear)


def _demand(arguments: argparse.Namespace, message: Json) -> Json:
    from rtctl.hal.client import demand

    return demand(daemon_of(arguments), message, arguments.reply)


def _said(reply: Json, default: str) -> int:
    print(reply.get("text") or default)
    return EXIT_OK


def _verb(arguments: argparse.Namespace) -> int:
    from rtctl.cli.waiting import perform, ready_session, told

    verb = arguments.command
    message: Json = {"verb": verb, "drop": True} if verb == "disarm" and arguments.drop else {"verb": verb}
    if arguments.no_wait:
        return _said(_demand(arguments, message), f"{verb}: accepted")
    with ready_session(arguments, verb, PATIENCE if verb in PATIENT else 0.0) as session:
        return told(verb, perform(session, message, arguments.timeout))


def _payload(arguments: argparse.Namespace) -> int:
    if len(arguments.com) not in (0, 3):
        raise UsageError(f"payload: got {len(arguments.com)} numbers after KG, wanted X Y Z or none")
    message: Json = {"verb": "payload", "mass_kg": arguments.mass}
    message |= {"com_m": arguments.com} if arguments.com else {}
    _checked(message)
    return _said(_demand(arguments, message), f"payload: {arguments.mass:g} kg")


def _grip(arguments: argparse.Namespace) -> int:
    from rtctl.cli.waiting import gripped, ready_session, told

    message: Json = {"verb": "grip", "closed": arguments.closed, "force_N": arguments.force or 0.0}
    message |= {"name": arguments.name} if arguments.name else {}
    _checked(message)
    if arguments.no_wait:
        return _said(_demand(arguments, message), "grip: accepted")
    with ready_session(arguments, "grip", 0.0) as session:
        return told("grip", gripped(session, message, arguments.timeout))


def _set(arguments: argparse.Namespace) -> int:
    from rtctl.cli.values import assignments

    described = {"name": arguments.name, "type": arguments.type, **assignments(arguments.keys)}
    if arguments.type == "cloud":
        return _set_cloud(arguments, described)
    message = {"verb": "obstacle", "set": described}
    _checked(message)
    return _said(_demand(arguments, message), f"obstacle {arguments.name}: set")


def _set_cloud(arguments: argparse.Namespace, described: Json) -> int:
    """Read the points here, where the file is, and send them as one binary message."""
    from pathlib import Path

    from rtctl.design.assets import load_cloud, placed
    from rtctl.hal.client import Session, accepted
    from rtctl.hal.messages import cloud_message
    from rtctl.spec.obstacles import Cloud, shape_of
    from rtctl.spec.scenario import parse_obstacle

    cloud = parse_obstacle(described, "obstacle")
    assert isinstance(cloud, Cloud)
    assert cloud.file is not None
    points = load_cloud(Path(cloud.file), cloud.point_radius_m, cloud.voxel_m, "obstacle: file")
    shape = placed(shape_of(cloud), points)
    table = {k: v for k, v in described.items() if k not in ("file", "voxel_m")} | {
        "position_m": shape.position.tolist(),
        "velocity_m_s": shape.velocity.tolist(),
        "point_radius_m": points.radius,
    }
    with Session(daemon_of(arguments), arguments.reply) as session:
        reply = accepted(session.ask_raw(cloud_message({"set": table, "step_m": points.step}, points.steps)))
    return _said(reply, f"obstacle {arguments.name}: set, {points.points} points of radius {points.radius:.4g} m")


def _clear(arguments: argparse.Namespace) -> int:
    name = EVERYTHING if arguments.all else arguments.name
    what = "all obstacles" if arguments.all else f"obstacle {name}"
    return _said(_demand(arguments, {"verb": "obstacle", "clear": name}), f"{what}: cleared")


def _goal(arguments: argparse.Namespace) -> int:
    from rtctl.cli.goals import Outcome, send_and_wait
    from rtctl.cli.values import goes_on, letters
    from rtctl.cli.waiting import ready_session

    message: Json = {"verb": "goal", **_place(arguments)}
    if arguments.axes == "none":
        message.pop("position_m", None)
    elif arguments.axes is not None:
        message["axes"] = letters(arguments.axes)
    asked = {
        "rpy_rad": arguments.rpy,
        "wxyz": arguments.wxyz,
        "direction": arguments.direction,
        "heading_rad": arguments.heading,
        "tool_axis": arguments.tool_axis,
        "tolerance_m": arguments.tolerance,
        "velocity_m_s": arguments.velocity,
        "velocity_rad_s": arguments.turning,
        "timeout_ms": arguments.timeout_ms,
    }
    message |= {key: value for key, value in asked.items() if value is not None}
    if arguments.hold_orientation:
        message["hold"] = "orientation"
    _checked(message)
    if arguments.no_wait or goes_on(message):
        return _said(_demand(arguments, message), "goal: accepted")
    with ready_session(arguments, "goal") as session:
        outcome: Outcome = send_and_wait(session, message, arguments.timeout)
    outcome.show(arguments.json)
    return EXIT_OK if outcome.arrived else EXIT_FAILED


def _checked(message: Json, place: str = "") -> None:
    """Refuse, before anybody is asked, what no daemon would take. Raises UsageError."""
    from rtctl.hal.messages import checked  # loads what takes half a second

    try:
        checked(message)
    except RequestError as error:
        raise UsageError(f"{place}{error}") from None


def _place(arguments: argparse.Namespace) -> Json:
    """Return where a goal is. Raises UsageError."""
    if arguments.latlon is not None:
        if arguments.x is not None:
            raise UsageError("goal: got X Y and --latlon, wanted one of them")
        return {"latlon_deg": arguments.latlon}
    if arguments.z is None:  # also of a base: a Z forgotten must not send an arm to the floor
        count = sum(value is not None for value in (arguments.x, arguments.y))
        raise UsageError(f"goal: got {count} numbers, wanted X Y Z [m], or --latlon LAT LON [deg]")
    return {"position_m": [arguments.x, arguments.y, arguments.z]}


def _goals(arguments: argparse.Namespace) -> int:
    from rtctl.cli import missions
    from rtctl.cli.goals import run_stream
    from rtctl.cli.values import goal_messages, goes_on
    from rtctl.cli.waiting import ready_session

    if arguments.file != "-" and not os.path.isfile(arguments.file):
        raise UsageError(f"{arguments.file}: got no such file, wanted one of goals, or - for standard input")
    if arguments.file == "-":
        with ready_session(arguments, "goals") as session:
            return run_stream(session, sys.stdin, "stdin", arguments)
    with open(arguments.file, encoding="utf-8", errors="replace") as file:
        text = file.read(MISSION_MAX)
        lines = missions.goals_of(text, arguments.file) if missions.is_mission(text) else text.splitlines()
    for at, message in goal_messages(lines, arguments.file):
        _checked(message, f"{arguments.file}:{at}: ")
        if goes_on(message) and not arguments.rate:
            raise UsageError(f"{arguments.file}:{at}: got a goal that moves, wanted --rate HZ with it, or - as FILE")
    with ready_session(arguments, "goals") as session:
        return run_stream(session, lines, arguments.file, arguments)


def _status(arguments: argparse.Namespace) -> int:
    with closing(_Asker(daemon_of(arguments), arguments.reply)) as asker:
        if arguments.json:
            while True:
                print(json.dumps(asker.ask()), flush=True)
                if not arguments.watch:
                    return EXIT_OK
                time.sleep(WATCH_PERIOD)
        from rtctl.cli import view

        if not arguments.watch:
            view.show(asker.ask())
            return EXIT_OK
        with suppress(KeyboardInterrupt):  # the way one leaves it
            view.watch(asker.ask, WATCH_PERIOD)
    return EXIT_OK


class _Asker:
    """Asks for the status again and again: of a daemon that is busy or has hung up on us too."""

    def __init__(self, path: str, timeout: float) -> None:
        self.path, self.timeout = path, timeout
        self._session: Session | None = None

    def close(self) -> None:
        """Hang up."""
        if self._session is not None:
            self._session.close()
            self._session = None

    def ask(self) -> Json:
        """Return the status. Raises LinkError only when no daemon is there any more."""
        from rtctl.hal.client import Session, accepted, answers

        met, told = self._session is not None, 0.0
        while True:
            try:
                if self._session is None:
                    self._session = Session(self.path, self.timeout)
                return accepted(self._session.ask({"verb": "status"}))
            except LinkError as error:
                self.close()
                if not answers(self.path):
                    raise LinkError(f"{self.path}: the daemon has ended" if met else str(error)) from None
                if "no answer" in str(error) and time.monotonic() - told > NOTE_EVERY:
                    told = time.monotonic()
                    print(f"rtctl: status: {error}: it is there and busy; asking again", file=sys.stderr, flush=True)
                time.sleep(WATCH_PERIOD)

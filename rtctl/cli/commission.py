"""`rtctl commission`: the operator's side of `rtctl.app.commission`, and the file that it changes."""

import argparse
import difflib
import os
import time
import tomllib
from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

from rtctl.cli.parser import Commands, command
from rtctl.errors import EXIT_FAILED, EXIT_OK, RtctlError, UsageError

if TYPE_CHECKING:
    from rtctl.app.commission import Operator
    from rtctl.app.push import Bench

PERIOD = 2e-3  # [s] of the cycles at least: nothing here needs more


def add(commands: Commands) -> None:
    """Add the command."""
    parser = command(
        commands,
        "commission",
        "find how each drive is mounted on its joint: direction, zero, whole turns",
        "rtctl commission configs/openarm.toml --joint joint_3",
        _commission,
    )
    parser.description = (
        "One joint at a time: first by hand, all drives off, then by a small torque after your yes for each. The keys\n"
        "direction, zero_rad and wrap of the joints are then written into the file, its comments kept; the change is\n"
        "shown first. No daemon may run on the bus."
    )
    parser.add_argument("config", metavar="CONFIG")
    parser.add_argument("--joint", metavar="NAME", action="append", default=[], help="only this joint; repeatable")
    parser.add_argument("--no-torque", action="store_true", help="by hand alone: no drive is enabled")


class Terminal:
    """An operator at the terminal."""

    def say(self, text: str) -> None:
        """Print a line."""
        print(text, flush=True)

    def ask(self, text: str) -> str:
        """Return a line that was typed. Raises RtctlError at the end of the input."""
        try:
            return input(text)
        except EOFError:
            raise RtctlError("commission: no more answers; nothing was written") from None


def _commission(arguments: argparse.Namespace) -> int:
    from rtctl import design
    from rtctl.app import commission
    from rtctl.app.arm_link import link_spec, open_bus
    from rtctl.app.push import Bench
    from rtctl.hal.can.handshake import handshake
    from rtctl.hal.can.link import CanLink
    from rtctl.hal.service import InstanceLock, bus_resource

    path = Path(arguments.config)
    if design.is_base(path):
        raise UsageError(f"commission: {path}: a base has no joints")
    config = design.load(path)
    chosen = _chosen(arguments.joint, [joint.name for joint in config.robot.joints])
    with InstanceLock(bus_resource(config.link.interface, config.link.channel), "link.channel"):
        spec = commission.straight(link_spec(config))
        with closing(CanLink(spec, open_bus(config, spec))) as link:
            handshake(link, listen=1e-3 * config.link.listen_ms)
            period = max(spec.period, PERIOD)
            bench = Bench(link, period, metronome(period))
            return run(path, bench, Terminal(), chosen, not arguments.no_torque)


def run(path: Path, bench: "Bench", operator: "Operator", chosen: Sequence[int], torque: bool) -> int:
    """Commission the chosen joints of a robot file on drives that have been greeted; return the exit code."""
    from rtctl import design
    from rtctl.app import commission

    config = design.load(path)
    known = commission.geometry(config, path)
    try:
        found = commission.by_hand(config, known, bench, operator, chosen)
        wrong = commission.by_torque(config, known, bench, operator, chosen, found) if torque else []
    finally:
        bench.off()
    if wrong:
        operator.say(f"nothing was written: torque contradicts reading at {', '.join(wrong)}; its motor's phases?")
        return EXIT_FAILED
    write(path, commission.changes(config, found), operator)
    return EXIT_OK


def _chosen(names: Sequence[str], known: Sequence[str]) -> list[int]:
    for name in names:
        if name not in known:
            raise UsageError(f"--joint: got {name}, wanted one of {', '.join(known)}")
    return [i for i, name in enumerate(known) if not names or name in names]


def metronome(period: float) -> Callable[[], None]:
    """Return a function that waits for the end of its period [s]; what is late is not made up for."""
    due = time.monotonic()

    def pause() -> None:
        nonlocal due
        due = max(due + period, time.monotonic() - period)
        time.sleep(max(due - time.monotonic(), 0.0))

    return pause


def write(path: Path, changes: dict[str, dict[str, int | float | bool]], operator: "Operator") -> None:
    """Show what changes in a robot file and, after the operator's yes, write it.

    Raises ConfigError, and leaves the file, where its text cannot be edited or the new keys contradict others.
    """
    from rtctl.spec.edit import with_joint_keys
    from rtctl.spec.read import convert
    from rtctl.spec.robot import Config
    from rtctl.spec.rules import refuse

    if not changes:
        operator.say(f"{path} is right as it is")
        return
    old = path.read_text(encoding="utf-8")
    new = with_joint_keys(old, changes, str(path))
    refuse(convert(tomllib.loads(new), Config, str(path)), str(path))
    lines = difflib.unified_diff(old.splitlines(), new.splitlines(), str(path), str(path), "", "", 1, "")
    operator.say("\n" + "\n".join(lines))
    if operator.ask(f"Write this to {path}? yes? ").strip().lower() not in ("y", "yes"):
        operator.say("nothing was written")
        return
    whole = path.resolve()
    beside = whole.with_name(f".{whole.name}.new")
    beside.write_text(new, encoding="utf-8")
    os.chmod(beside, whole.stat().st_mode)
    os.replace(beside, whole)
    operator.say(f"{path}: written")

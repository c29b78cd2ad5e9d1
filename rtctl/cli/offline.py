"""Commands that need no running daemon: check, run, sim, schema, doctor, bench."""

import argparse
import json
import re
import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from rtctl.cli import page
from rtctl.cli.parser import Commands, Parser, command, positive
from rtctl.errors import EXIT_FAILED, EXIT_OK, RtctlError, UsageError
from rtctl.hal.say import ERR, say
from rtctl.plain import Json
from rtctl.spec.shipped import shipped

if TYPE_CHECKING:
    from rtctl.hal.lobby import Lobby


def add_before(commands: Commands) -> None:
    """Add what comes before operating: check and run."""
    check = command(
        commands, "check", "validate a config and print the derived robot", "rtctl check configs/panda.toml", _check
    )
    check.add_argument("config", metavar="CONFIG")
    check.add_argument("--json", action="store_true", help="print one JSON object")
    run = command(commands, "run", "run the daemon in the foreground", "rtctl run configs/panda.toml --dry", _run)
    run.add_argument("config", metavar="CONFIG")
    run.add_argument("--dry", action="store_true", help="compute and log, but send stop frames alone")
    run.add_argument("--lockstep", action="store_true", help="wait for the drives' replies instead of the clock")
    run.add_argument("--timeout", metavar="S", type=positive, help="wait no longer for a vehicle that is not there yet")
    _add_law(run)
    run.add_argument(
        "--pass-lock-of",
        metavar="USER",
        action="append",
        default=[],
        help="start although a process of USER holds this bus's lock: somebody who keeps the name without a controller "
        "and cannot be made to give it up",
    )

    warm = command(commands, "warm", "compile ahead what a robot needs", "rtctl warm configs/panda.toml", _warm)
    warm.add_argument("config", metavar="CONFIG", nargs="?", default="", help="default: the source tree's panda.toml")


def add_after(commands: Commands) -> None:
    """Add what is done beside operating: simulation, schema, the machine."""
    sim = command(
        commands,
        "sim",
        "play a scenario: controller and virtual robot in one process",
        "rtctl sim scenarios/demo.toml --json --log demo.mcap",
        _sim,
    )
    sim.add_argument(
        "scenario", metavar="SCENARIO", help="a file, or the name of one that comes with the program: demo"
    )
    sim.add_argument("--json", action="store_true", help="print one JSON object")
    sim.add_argument("--log", metavar="FILE", default="", help="write an MCAP log")
    sim.add_argument("--realtime", action="store_true", help="no faster than the clock")
    sim.add_argument(
        "--view",
        action="store_true",
        help="in the browser and in real time; it takes commands, and goes on after its end",
    )
    page.add_address(sim)
    _add_law(sim)
    sim.add_argument(
        "--allow-miss", action="store_true", help="exit 0 also when a goal was missed or something touched"
    )
    schema = command(
        commands, "schema", "print a JSON Schema, for editors", "rtctl schema config > configs/schema.json", _schema
    )
    schema.add_argument(
        "what", choices=("config", "base", "scenario", "request"), nargs="?", default="config", metavar="WHAT"
    )
    schema.description = (
        "Print the JSON Schema of WHAT: config (default: an arm's), base, scenario, or request to the control socket."
    )
    doctor = command(commands, "doctor", "can this machine do it", "rtctl doctor --json", _doctor)
    doctor.add_argument("--json", action="store_true", help="print one JSON object")
    doctor.add_argument(
        "--wakes", metavar="N", type=int, default=1000, help="wake-ups to measure (%(default)s, 1 ms each)"
    )
    bench = command(commands, "bench", "measure the speed figures on this machine", "rtctl bench", _bench)
    bench.add_argument("arguments", metavar="ARG", nargs="*", help="passed on to tools/bench.py, after --")

    completion = command(
        commands,
        "completion",
        "print what makes a shell complete rtctl's words",
        "rtctl completion bash > ~/.local/share/bash-completion/completions/rtctl",
        _completion,
    )
    completion.add_argument("shell", choices=("bash", "zsh", "fish"), metavar="SHELL", help="bash, zsh or fish")


def _add_law(parser: Parser) -> None:
    parser.add_argument(
        "--law", metavar="FILE.py:NAME", default="", help="a law of your own drives the arm, within every guard"
    )


def _completion(arguments: argparse.Namespace) -> int:
    from argcomplete.shell_integration import shellcode

    print(shellcode(["rtctl"], shell=arguments.shell))
    return EXIT_OK


def _check(arguments: argparse.Namespace) -> int:
    from rtctl import design

    if design.is_base(arguments.config):
        report = design.check_base(arguments.config)
    else:
        loaded = design.load(arguments.config)
        report = design.check(loaded, design.build(loaded, arguments.config))
    print(json.dumps(report.as_dict()) if arguments.json else report.render())
    return EXIT_OK


def _run(arguments: argparse.Namespace) -> int:
    passing = frozenset(_stranger(name) for name in arguments.pass_lock_of)
    with ExitStack() as stack:
        _refuse_scenario(arguments.config)
        lobby = _lobby(arguments.config)
        if lobby is not None:
            stack.enter_context(lobby)
            say(f"rtctl: starting {lobby.robot}; {lobby.path} answers already", ERR)
        _refuse_config(arguments.config)
        prepare(arguments.config, lobby=lobby)
        from rtctl.app.daemon import run

        return run(
            arguments.config,
            lockstep=arguments.lockstep,
            dry=arguments.dry,
            timeout=arguments.timeout,
            passing=passing,
            lobby=lobby,
            law=arguments.law,
        )


def _refuse_scenario(config: str) -> None:
    """Refuse at once what is no robot's file, before anything is compiled for it. Raises ConfigError."""
    from rtctl.spec.read import refuse_scenario

    refuse_scenario(Path(config))


def _refuse_config(config: str) -> None:
    """Refuse a file that contradicts itself before minutes are spent on compiling for it. Raises ConfigError."""
    from rtctl import design

    if design.is_base(config):
        design.load_base(config)
    else:
        design.load(config)


def _lobby(config: str) -> "Lobby | None":
    """Return who answers at the control socket from now on: what follows takes seconds to load, minutes to compile.

    None where the file does not say plainly whose daemon it is, or the place is taken: the daemon itself tells then.
    """
    import tomllib

    from rtctl.hal.client import default_path
    from rtctl.hal.lobby import Lobby

    try:
        tables = tomllib.loads(Path(config).read_text(encoding="utf-8"))
        name, socket = tables["robot"]["name"], tables.get("console", {}).get("socket", "")
        if re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.+-]{0,31}", name) and isinstance(socket, str):
            return Lobby(socket or default_path(name), name)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError, RtctlError):
        pass
    return None


def _stranger(name: str) -> int:
    """Return the id of a user whose lock may be passed over. Raises UsageError.

    What this user or root runs may be a controller, and can be ended: two on one bus is what the lock is there against.
    """
    from rtctl.trust import trusted_users, user_id

    user = user_id(name)
    if user in trusted_users():
        raise UsageError(f"--pass-lock-of: got {name}, wanted a user other than this one and root: end that process")
    return user


def _sim(arguments: argparse.Namespace) -> int:
    from rtctl.app.own_law import load_law
    from rtctl.app.sim import simulate
    from rtctl.spec.scenario import load_scenario, robot_file
    from rtctl.spec.shipped import scenario_file

    arguments.scenario = scenario_file(arguments.scenario)
    law = load_law(arguments.law) if arguments.law else None
    prepare(str(robot_file(load_scenario(arguments.scenario), arguments.scenario)))
    with page.viewer(arguments) as shown:
        result = simulate(arguments.scenario, arguments.log or None, arguments.realtime, shown=shown, law=law)
    if arguments.json:
        print(json.dumps(result))
    else:
        from rtctl.cli.summary import show

        show(result, arguments.scenario, arguments.log)
    missed = _missed(result)
    if missed and not arguments.allow_miss:
        print(f"rtctl: sim: {missed} (--allow-miss exits 0 all the same)", file=sys.stderr)
        return EXIT_FAILED
    return EXIT_OK


def _missed(result: Json) -> str:
    """Return what a run failed in, in words, '' for nothing."""
    goals = result.get("goals") or ()
    missed, touched = sum(goal["arrived"] is False for goal in goals), int(result.get("contacts") or 0)
    why = [f"{missed} of {len(goals)} goals missed"] if missed else []
    return ", ".join([*why, f"{touched} contacts"] if touched else why)


def _warm(arguments: argparse.Namespace) -> int:
    from rtctl.app.choose import vehicle_of

    config = arguments.config or str(shipped() / "panda.toml")
    if not Path(config).is_file():
        raise UsageError(f"warm: {config}: no such file, wanted a config")
    vehicle_of(Path(config)).load(Path(config), None)
    prepare(config, strict=True)
    return EXIT_OK


def prepare(config: str, strict: bool = False, lobby: "Lobby | None" = None) -> None:
    """Compile what a config's robot needs where that was not done yet, and say so: it takes a while.

    What goes wrong then is left to the command itself to find and to tell, unless strict.
    """
    from rtctl.app import warm

    if not Path(config).is_file() or not warm.needed(config):
        return
    say("rtctl: compiling what is not compiled yet; it is kept for the next time", ERR)
    from rtctl.cli.progress import bar

    total, begun = warm.kernels(), time.monotonic()
    printed, compiled = begun, 0

    def told(done: int) -> None:
        nonlocal printed, compiled
        compiled = done
        draw(min(done, total))
        if lobby is not None:
            lobby.tell("compiling what is not compiled yet", done, total)
        if not sys.stderr.isatty() and time.monotonic() - printed > 5.0:
            printed = time.monotonic()
            say(f"rtctl: compiled {done} of at most {total} kernels in {printed - begun:.0f} s", ERR)

    try:
        with bar("compiling", total) as draw:
            warm.warm(config, told)
        say(f"rtctl: compiled {compiled} kernels in {time.monotonic() - begun:.0f} s; that was all", ERR)
    except RtctlError:
        if strict:
            raise


def _schema(arguments: argparse.Namespace) -> int:
    print(json.dumps(_schema_of(arguments.what), indent=2))
    return EXIT_OK


def _schema_of(what: str) -> Json:
    from rtctl import design

    if what in ("config", "base"):
        return design.json_schema(design.Config if what == "config" else design.BaseConfig)
    import msgspec

    from rtctl.hal.messages import Message
    from rtctl.spec.scenario import Scenario

    schema = msgspec.json.schema(Scenario if what == "scenario" else Message)
    head = {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": f"rtctl {what}"}
    return dict(msgspec.json.decode(msgspec.json.encode({**head, **schema})))  # tuples become the lists of JSON


def _doctor(arguments: argparse.Namespace) -> int:
    from rtctl.hal import doctor

    if not 10 <= arguments.wakes <= 1_000_000:
        raise UsageError(f"--wakes: got {arguments.wakes}, wanted 10 to 1000000")
    rows = doctor.examine(wakes=arguments.wakes)
    print(json.dumps(doctor.as_dict(rows)) if arguments.json else doctor.render(rows))
    return doctor.exit_code(rows)


def _bench(arguments: argparse.Namespace) -> int:
    root = Path(__file__).parents[2]
    if not (root / "tools" / "bench.py").is_file():
        raise UsageError("bench: tools/bench.py is part of the source tree, which this installation lacks")
    return subprocess.run([sys.executable, "-m", "tools.bench", *arguments.arguments], cwd=root, check=False).returncode

"""An arm goes round obstacles: controller and drives as two processes over CAN, played from a scenario.

    python -m tools.demo
    python -m tools.demo --lockstep --scenario configs/demo.toml --out /tmp/demo
    python -m tools.demo --interface socketcan --channel vcan0

Exit status 0 when every goal was reached within 5 mm and 0.02 rad, nothing was touched and both processes ended well.
Without --lockstep or --realtime the run is in real time where the machine can keep it, by two short measurements: of
wake-ups alone, and of controller and drives with the arm at rest. Where it cannot, the first line and the last one say
LOCKSTEP: time goes on when the drives have been answered, and there are no deadlines to keep.
"""

import argparse
import os
import re
import signal
import sys
import tempfile
import time
import tomllib
from collections.abc import Sequence
from contextlib import suppress
from itertools import islice
from pathlib import Path

from msgspec.structs import replace
from rich.console import Console
from rich.text import Text

from rtctl import design as cfg
from rtctl.errors import EXIT_FAILED, EXIT_OK, RtctlError
from rtctl.hal import clock
from rtctl.hal.client import Session, accepted
from rtctl.log import read_run
from rtctl.log.view.report import gather
from rtctl.log.view.sheet import draw
from rtctl.spec.scenario import Scenario, load_scenario, robot_file
from tools.outcome import WIDTH, Outcome, judge, notes_of, show
from tools.pair import DemoError, Pair, placed, working_copy
from tools.player import play
from tools.trace import trace

__all__ = ["main", "play"]

PRIORITY = 80  # of the probe, as the controller has by default
PROBE_S = 0.5  # [s] of wake-ups alone, before anything is started
PROBE_LATE = 0.5  # of the period that 99 % of them may be late
TRIAL_S = 3.0  # [s] in which controller and drives show whether they keep real time with the arm at rest
TRIAL_MISSED = 1  # slots in it that may be missed
TRIAL_TURN = 0.6  # of the period that lateness and turn together may take in 95 % of the looks at them
TRIAL_POLL = 0.025  # [s] between two looks
LOCKSTEP = "LOCKSTEP: time goes on when the drives have been answered; this run shows no deadlines"
REAL_TIME = "REAL TIME: controller and drives each on a grid of their own"
STYLE = {"goal": "bold cyan", "arrived": "green", "aside": "yellow", "state": "dim", "fault": "bold red"}


class Voice:
    """Prints lines as they come; colours and styles on a terminal alone."""

    def __init__(self) -> None:
        console = Console(highlight=False)
        self.console = console if console.is_terminal else Console(highlight=False, width=WIDTH)

    def __call__(self, style: str, text: str) -> None:
        self.console.print(Text(text, style=STYLE.get(style, style)), soft_wrap=True)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return its exit code."""
    args = _arguments(argv)
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # nor does this leave drives or controller behind
    voice = Voice()
    try:
        return _demo(args, voice)
    except RtctlError as error:
        print(f"demo: {error}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        print("demo: interrupted; both processes were ended", file=sys.stderr)
        return 130


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m tools.demo", description="An arm goes round obstacles: controller and drives over CAN."
    )
    parser.add_argument("--config", help="robot file (default: the one that the scenario names)")
    parser.add_argument("--scenario", default="configs/demo.toml", help="what happens (%(default)s)")
    parser.add_argument("--out", default="out/demo", metavar="DIR", help="for log, plot and outputs (%(default)s)")
    parser.add_argument("--interface", default="socketpair", help="of the bus: socketpair, socketcan (%(default)s)")
    parser.add_argument("--channel", help="of the bus (default: a socket of the run's own)")
    parser.add_argument("--seconds", type=float, metavar="S", help="play no more of the scenario than its first S [s]")
    pace = parser.add_mutually_exclusive_group()
    pace.add_argument("--lockstep", action="store_true", help="time goes on when the drives have been answered")
    pace.add_argument("--realtime", action="store_true", help="real time, however late this machine is")
    return parser.parse_args(argv)


def _demo(args: argparse.Namespace, voice: Voice) -> int:
    scenario = load_scenario(args.scenario)
    if args.seconds is not None and args.seconds < scenario.duration_s:
        goals = tuple(goal for goal in scenario.goal if goal.at_s < args.seconds)
        scenario = replace(scenario, duration_s=args.seconds, goal=goals)
    source = Path(args.config) if args.config else robot_file(scenario, args.scenario)
    loaded = cfg.load(source)  # refuses what is wrong with it under its own name
    out = Path(args.out)
    out.mkdir(parents=True, exist_ok=True)
    modes, why = _modes(args, 1.0 / loaded.loop.servo_hz)
    with tempfile.TemporaryDirectory(prefix="rtctl-demo-") as sockets:  # short paths that only this user can enter
        config = out / source.name
        urdf = tomllib.loads(source.read_text(encoding="utf-8"))["robot"]["urdf"]
        changes: dict[str, dict[str, str | int | None]] = {
            "link": {"interface": args.interface, "channel": args.channel or f"{sockets}/bus"},
            "log": {"directory": str(out.resolve() / "logs")},
            "console": {"socket": f"{sockets}/console"},
        }
        if "://" not in urdf:
            changes["robot"] = {"urdf": str((source.parent / urdf).resolve())}
        cores = placed()
        if cores is not None and loaded.loop.cpu is None:
            changes["loop"] = {"cpu": cores.controller}
        working_copy(source, config, changes)
        head = (
            f"{scenario.robot}: {len(scenario.goal)} goals, {len(scenario.obstacle)} obstacles, "
            f"{scenario.duration_s:g} s, over {args.interface}\n"
            f"in {out}: the robot file of this run, outputs, log and plot\n"
            "nearest: by the controller's spheres, which stand out of the links; at the end: by the simulator"
        )
        for lockstep in modes:
            last = lockstep or args.realtime
            outcome = _attempt(config, Path(args.scenario), scenario, out, lockstep, not last, Told(voice, head, why))
            if isinstance(outcome, str):
                why = outcome
                continue
            if last or not outcome.failures or not outcome.late_at_all:
                if lockstep:
                    voice("bold", LOCKSTEP)
                return EXIT_FAILED if outcome.failures else EXIT_OK
            why = _excuse(outcome)
        raise AssertionError("the last attempt is final")


def _modes(args: argparse.Namespace, period: float) -> tuple[tuple[bool, ...], str]:
    """Return whether each attempt is in lockstep, and why the first one is where that was not asked for."""
    if args.lockstep or args.realtime:
        return (bool(args.lockstep),), ""
    why = probed(period)
    return ((True,), why) if why else ((False, True), "")


class Told:
    """A voice whose first line says in which mode the run is played."""

    def __init__(self, voice: Voice, head: str, why: str) -> None:
        """`why` it is lockstep, where that was not asked for."""
        self.voice, self.head, self.why = voice, head, why

    def begin(self, lockstep: bool) -> None:
        """Say the mode, then what is played."""
        self.voice("bold", LOCKSTEP if lockstep else REAL_TIME)
        if lockstep and self.why:
            self.voice("yellow", f"{self.why} (--realtime insists)")
        first, *rest = self.head.split("\n")
        self.voice("bold", first)
        for line in rest:
            self.voice("dim", line)

    def __call__(self, style: str, text: str) -> None:
        self.voice(style, text)


def probed(period: float) -> str:
    """Measure wake-ups on a grid of `period` [s] like the controller's; return why that is no real time, or ""."""
    if len(os.sched_getaffinity(0)) < 2:
        return "this machine has one core for controller and drives"
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    with suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    try:
        with clock.light_sleep():
            slots = list(islice(clock.grid(period), round(PROBE_S / period)))
    finally:
        os.sched_setscheduler(0, *before)
    late = sorted(each.lateness for each in slots)[len(slots) * 99 // 100]
    if late <= PROBE_LATE * period:
        return ""
    return f"this machine wakes up {late * 1e3:.2f} ms late now, in a period of {period * 1e3:g} ms"


def _attempt(
    config: Path, scenario_file: Path, scenario: Scenario, out: Path, lockstep: bool, trial: bool, told: Told
) -> Outcome | str:
    """Play once; return the outcome, or why this machine does not keep real time when the trial showed that."""
    mode, voice = "lockstep" if lockstep else "real time", told.voice
    if trial:
        print("demo: does this machine keep real time? (the first time compiles: a minute or two)", file=sys.stderr)
    else:
        told.begin(lockstep)
        voice("dim", f"starting drives and controller in {mode} (the first time compiles: a minute or two)")
    with Pair(config, scenario_file, out, lockstep) as pair:
        if trial:
            why = _unfit(pair)
            if why:
                return why
            told.begin(lockstep)
        for line in pair.lines():
            voice("dim", line)
        played = play(pair.console, scenario, voice, pair.lines, deadlines=not lockstep)
    for line in pair.lines():
        voice("dim", re.sub(r" \d+ slots missed,", "", line) if lockstep else line)
    if not pair.report():
        raise DemoError(f"the drives left no report: {pair.exits}")
    log = played.log.removesuffix(".open")
    run = trace(log, cfg.load(config), played.began)
    outcome = judge(run, pair.report(), played.given, len(scenario.goal), played.end, played.ended, pair.exits)
    plot = out / "demo.png"
    draw(gather(read_run(log)), plot, notes_of(outcome, run.period, lockstep))
    show(outcome, mode, {"log": log, "report": str(pair.report_file), "plot": str(plot)}, voice.console)
    return outcome


def _unfit(pair: Pair) -> str:
    """Watch both processes for a while with the arm at rest; return why they do not keep real time, or ""."""
    share: list[float] = []  # of the period that lateness and turn took
    with Session(pair.console) as session:
        given_up = _given_up(pair)
        before = accepted(session.ask({"verb": "status"}))
        until = time.monotonic() + TRIAL_S
        while time.monotonic() < until:
            time.sleep(TRIAL_POLL)
            after = accepted(session.ask({"verb": "status"}))
            share.append((after["lateness_s"] + after["compute_s"]) * pair.rate)
    missed: int = after["missed"] - before["missed"]
    slots = missed + after["tick"] - before["tick"]
    slipped = _given_up(pair) - given_up
    busy = sorted(share)[len(share) * 95 // 100]
    if missed <= TRIAL_MISSED and slipped == 0.0 and busy <= TRIAL_TURN:
        return ""
    return (
        f"this machine does not keep real time now: in a trial of {TRIAL_S:g} s {missed} of {slots} slots missed, "
        f"turns of up to {busy:.0%} of the period, drives gave up {slipped * 1e3:.0f} ms"
    )


def _given_up(pair: Pair) -> float:
    """Return the time [s] that the drives' clock has given up so far."""
    return float(pair.report().get("slipped_s", 0.0))


def _excuse(outcome: Outcome) -> str:
    """Return why there will be another attempt."""
    return (
        f"the run in real time failed on a machine that was late: {outcome.missed} slots missed, the drives up to "
        f"{outcome.drives_late * 1e3:.0f} ms late; once more"
    )


if __name__ == "__main__":
    sys.exit(main())

"""An arm goes round obstacles: controller and drives as two processes over CAN, played from a scenario.

    python -m tools.demo
    python -m tools.demo --lockstep --scenario configs/demo.toml --out /tmp/demo
    python -m tools.demo --interface socketcan --channel vcan0

Exit status 0 when every goal was reached within 5 mm and 0.02 rad, nothing was touched and both processes ended well.
Without --lockstep or --realtime the run is in real time where the machine can keep it; where it cannot, it says so and
plays in lockstep, in which time goes on when the drives have been answered.
"""

import argparse
import sys
import tempfile
import time
import tomllib
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.text import Text

from rtctl import design as cfg
from rtctl.errors import EXIT_FAILED, EXIT_OK, RtctlError
from rtctl.hal.client import Session, accepted
from rtctl.spec.scenario import Scenario, load_scenario, robot_file
from tools.outcome import WIDTH, Outcome, judge, show
from tools.pair import DemoError, Pair, working_copy
from tools.player import play
from tools.plot import draw
from tools.trace import trace

__all__ = ["main", "play"]

TRIAL_S = 2.0  # [s] in which the machine shows whether it keeps real time
TRIAL_MISSED = 0.02  # of the slots in it
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
    pace = parser.add_mutually_exclusive_group()
    pace.add_argument("--lockstep", action="store_true", help="time goes on when the drives have been answered")
    pace.add_argument("--realtime", action="store_true", help="real time, however late this machine is")
    return parser.parse_args(argv)


def _demo(args: argparse.Namespace, voice: Voice) -> int:
    scenario = load_scenario(args.scenario)
    source = Path(args.config) if args.config else robot_file(scenario, args.scenario)
    cfg.load(source)  # refuses what is wrong with it under its own name
    out = Path(args.out)
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="rtctl-demo-") as sockets:  # short paths that only this user can enter
        config = out / source.name
        urdf = tomllib.loads(source.read_text(encoding="utf-8"))["robot"]["urdf"]
        changes: dict[str, dict[str, str | None]] = {
            "link": {"interface": args.interface, "channel": args.channel or f"{sockets}/bus"},
            "log": {"directory": str(out.resolve() / "logs")},
            "console": {"socket": f"{sockets}/console"},
        }
        if "://" not in urdf:
            changes["robot"] = {"urdf": str((source.parent / urdf).resolve())}
        working_copy(source, config, changes)
        voice(
            "bold",
            f"{scenario.robot}: {len(scenario.goal)} goals, {len(scenario.obstacle)} obstacles, "
            f"{scenario.duration_s:g} s, over {args.interface}",
        )
        voice("dim", f"in {out}: the robot file of this run, outputs, log and plot")
        for lockstep in (True,) if args.lockstep else (False,) if args.realtime else (False, True):
            last = lockstep or args.realtime
            outcome = _attempt(config, Path(args.scenario), scenario, out, lockstep, not last, voice)
            if outcome is not None and (last or not outcome.failures or not outcome.late_at_all):
                return EXIT_FAILED if outcome.failures else EXIT_OK
            if outcome is not None:
                _excuse(outcome, voice)
        raise AssertionError("the last attempt is final")


def _attempt(
    config: Path, scenario_file: Path, scenario: Scenario, out: Path, lockstep: bool, trial: bool, voice: Voice
) -> Outcome | None:
    """Play once; return the outcome, or None when the trial showed that this machine does not keep real time."""
    mode = "lockstep" if lockstep else "real time"
    voice("dim", f"starting drives and controller in {mode} (the first time compiles: a minute or two)")
    with Pair(config, scenario_file, out, lockstep) as pair:
        for line in pair.lines():
            voice("dim", line)
        if trial and not _keeps_time(pair, voice):
            return None
        played = play(pair.console, scenario, voice, pair.lines)
    for line in pair.lines():
        voice("dim", line)
    if not pair.report():
        raise DemoError(f"the drives left no report: {pair.exits}")
    log = played.log.removesuffix(".open")
    run = trace(log, cfg.load(config), played.began)
    outcome = judge(run, pair.report(), played.given, len(scenario.goal), played.end, played.ended, pair.exits)
    plot = out / "demo.png"
    draw(run, outcome, mode, plot)
    show(outcome, mode, {"log": log, "report": str(pair.report_file), "plot": str(plot)}, voice.console)
    return outcome


def _keeps_time(pair: Pair, voice: Voice) -> bool:
    """Watch both processes for a while with the arm at rest; say how late they are."""
    with Session(pair.console) as session:
        given_up = _given_up(pair)
        before = accepted(session.ask({"verb": "status"}))
        time.sleep(TRIAL_S)
        after = accepted(session.ask({"verb": "status"}))
    missed: int = after["missed"] - before["missed"]
    slots = missed + after["tick"] - before["tick"]
    slipped = _given_up(pair) - given_up
    share = missed / max(slots, 1)
    good = bool(share <= TRIAL_MISSED and slipped == 0.0)
    voice(
        "dim" if good else "yellow",
        f"trial of {TRIAL_S:g} s: {missed} of {slots} slots missed, drives gave up {slipped * 1e3:.0f} ms",
    )
    if not good:
        voice("yellow", "this machine does not keep real time now: playing in lockstep instead (--realtime insists)")
    return good


def _given_up(pair: Pair) -> float:
    """Return the time [s] that the drives' clock has given up so far."""
    return float(pair.report().get("slipped_s", 0.0))


def _excuse(outcome: Outcome, voice: Voice) -> None:
    """Say why there will be another attempt."""
    voice(
        "yellow",
        f"\nthe run in real time failed on a machine that was late: {outcome.missed} slots missed, the drives up to "
        f"{outcome.drives_late * 1e3:.0f} ms late. Playing once more, in lockstep (--realtime insists on this result)",
    )


if __name__ == "__main__":
    sys.exit(main())

"""What became of a played scenario: each goal by the log, contacts and clearances by the drives' own account."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from rtctl.arm.task import turns
from rtctl.log.view.style import Goal, Notes
from rtctl.types import F64
from tools.trace import Trace

REACHED, REACHED_ROT = 5e-3, 0.02  # [m], [rad] within which a goal counts as reached
PLENTY = 0.5  # [m] the drives' account does not measure beyond this
WIDTH = 110  # columns of a summary that goes into a file or pipe


class Given(NamedTuple):
    """A goal of the scenario, as it was put to the controller."""

    number: int  # from 1
    position: tuple[float, float, float]  # [m]
    slot: int  # of the grid, in which the controller took it
    refusal: str = ""  # why it did not


class GoalOutcome(NamedTuple):
    """What became of one goal."""

    given: Given
    at: float  # [s] when it was given, since the arm woke
    reached: bool  # at the end of its time
    first: float | None  # [s] after `at` when the tip first was within the bounds
    last: float | None  # [s] after `at` since when it has stayed there
    error: float  # [m] at the end of its time
    error_rot: float | None  # [rad], None for a goal without orientation
    deviation: float  # [m] greatest distance from the straight line


class Outcome(NamedTuple):
    """What became of the run."""

    goals: list[GoalOutcome]
    never: list[int]  # numbers of goals that were not given
    clearance: dict[str, float]  # [m] smallest by obstacle, measured by the drives
    own_clearance: float | None  # [m] of the arm to itself, the same
    contacts: list[str]
    trips: list[str]  # drive faults, as the drives tell them
    ticks: int
    missed: int  # while the arm was driven
    slots: int  # of the grid in that time
    late: float  # [s] 99th percentile of the wake-up's lateness in that time
    drives_late: float  # [s] greatest lateness of the drives' own clock
    drives_slipped: float  # [s] that the drives' clock gave up
    faults: tuple[str, ...]
    speed: float  # [m/s] greatest of the tip
    torque: float  # greatest part of a joint's rating
    ended: str  # why it ended early, '' when it did not
    exits: dict[str, int]  # exit codes

    @property
    def failures(self) -> list[str]:
        """Return why the run does not count, one line each; empty when it does."""
        found = [f"goal {n}: was never given" for n in self.never]
        for g in self.goals:
            if g.given.refusal:
                found.append(f"goal {g.given.number}: refused: {g.given.refusal}")
            elif not g.reached:
                turn = "" if g.error_rot is None else f", {g.error_rot:.4f} rad"
                found.append(f"goal {g.given.number}: not reached, {g.error * 1e3:.1f} mm{turn} away at the end")
        found += [f"contact: {c}" for c in self.contacts]
        found += [f"ended early: {self.ended}"] if self.ended else []
        return found + [f"{name} ended with exit code {code}" for name, code in self.exits.items() if code != 0]

    @property
    def late_at_all(self) -> bool:
        """Return whether either process missed its time: then a failure may be this machine's."""
        return self.missed > 0 or self.drives_slipped > 0.0 or self.drives_late > 2e-3


def judge(
    trace: Trace,
    report: Mapping[str, Any],
    given: Sequence[Given],
    count: int,
    end: int,
    ended: str,
    exits: Mapping[str, int],
) -> Outcome:
    """Return the outcome of a run: `count` goals in its scenario, those `given`, over at the slot `end`."""
    accepted = [g for g in given if not g.refusal]
    stops = dict(zip(accepted, [g.slot for g in accepted[1:]] + [end], strict=True))
    driven = np.flatnonzero(trace.driven)
    span = slice(driven[0], driven[-1] + 1) if len(driven) else slice(0, 0)
    clearance = {k: v for k, v in report["min_clearance_m"].items() if k != "all"}
    return Outcome(
        goals=[_goal(trace, g, stops[g]) if g in stops else _refused(trace, g) for g in given],
        never=[n for n in range(1, count + 1) if n not in {g.number for g in given}],
        clearance=clearance,
        own_clearance=report["min_self_clearance_m"],
        contacts=[f"{c['link']} and {c['other']} at {c['time']:.2f} s" for c in report["contact_events"]],
        trips=[f"{t['joint']}: drive fault {t['code']:#x} at {t['time_s']:.3f} s" for t in report["trips"]],
        ticks=len(trace.slot),
        missed=int(trace.missed[span].sum()),
        slots=int(trace.slot[span][-1] - trace.slot[span][0] + 1) if len(driven) else 0,
        late=float(np.percentile(trace.lateness[span], 99)) if len(driven) else 0.0,
        drives_late=float(report.get("max_late_s", 0.0)),
        drives_slipped=float(report.get("slipped_s", 0.0)),
        faults=trace.faults,
        speed=float(np.sqrt((trace.xd[span] ** 2).sum(1)).max(initial=0.0)),
        torque=float(trace.ratio[span].max(initial=0.0)),
        ended=ended,
        exits=dict(exits),
    )


def notes_of(outcome: Outcome, period: float, lockstep: bool) -> Notes:
    """Return what the picture of a run tells beside its log; period: [s] of the servo."""
    reached = sum(g.reached for g in outcome.goals)
    deadlines = () if lockstep else (f"{outcome.missed} of {outcome.slots} deadlines missed",)
    words = (
        f"{reached} of {len(outcome.goals) + len(outcome.never)} goals reached",
        f"{len(outcome.contacts)} contacts",
        *deadlines,
        f"{1.0 / period:.0f} Hz in {'lockstep' if lockstep else 'real time'}",
        f"faults: {', '.join(outcome.faults) or 'none'}",
    )
    goals = tuple(
        Goal(g.given.number, g.given.position, g.given.slot * period, g.reached)
        for g in outcome.goals
        if not g.given.refusal
    )
    verdict = "FAIL" if outcome.failures else "PASS"
    return Notes("An arm goes round obstacles", verdict, words, goals, tuple(outcome.clearance.items()), lockstep)


def _refused(trace: Trace, given: Given) -> GoalOutcome:
    return GoalOutcome(given, _seconds(trace, given.slot), False, None, None, float("nan"), None, 0.0)


def _seconds(trace: Trace, slot: int) -> float:
    return float(trace.time[min(trace.at(slot), len(trace.time) - 1)])


def _goal(trace: Trace, given: Given, end: int) -> GoalOutcome:
    """Return what became of a goal that the controller pursued until the slot `end`.

    The goal is the one that the controller logged when it took it; where the tip is, the log's estimate.
    """
    start, stop = trace.at(given.slot), max(trace.at(end), trace.at(given.slot) + 1)
    part, goal = slice(start, stop), trace.goals[given.slot]
    e, e_rot = trace.errors(part, goal)
    pose = turns(goal.task)
    there = (e <= REACHED) & (e_rot <= REACHED_ROT)
    elapsed = trace.time[part] - trace.time[start]
    outside = np.flatnonzero(~there)
    settled = elapsed[outside[-1] + 1 if len(outside) else 0] if there[-1] else None
    return GoalOutcome(
        given=given,
        at=float(trace.time[start]),
        reached=bool(there[-1]),
        first=float(elapsed[there.argmax()]) if there.any() else None,
        last=None if settled is None else float(settled),
        error=float(e[-1]),
        error_rot=float(e_rot[-1]) if pose else None,
        deviation=_deviation(trace.x[part], trace.x[start], goal.position),
    )


def _deviation(x: F64, start: F64, goal: F64) -> float:
    """Return the greatest distance [m] of points x (N, 3) from the segment start to goal."""
    along = goal - start
    length2 = float(along @ along)
    s = np.clip((x - start) @ along / length2, 0.0, 1.0) if length2 > 1e-12 else np.zeros(len(x))
    return float(np.sqrt(((x - start - s[:, None] * along) ** 2).sum(1)).max())


# ---- for people


def show(outcome: Outcome, mode: str, files: Mapping[str, str], console: Console) -> None:
    """Print the summary."""
    good = not outcome.failures
    console.print()
    console.print(_goals(outcome))
    console.print()
    console.print(_obstacles(outcome))
    console.print()
    table = Table.grid(padding=(0, 3))
    for label, value in _figures(outcome, mode):
        table.add_row(Text(label, style="dim"), value)
    for label, path in files.items():
        table.add_row(Text(label, style="dim"), Text(path, overflow="fold"))
    console.print(table)
    console.print()
    reached = sum(g.reached for g in outcome.goals)
    total = len(outcome.goals) + len(outcome.never)
    head = f"{reached} of {total} goals reached, {len(outcome.contacts)} contacts"
    console.print(Text.assemble(("PASS" if good else "FAIL", f"bold {'green' if good else 'red'}"), f"  {head}"))
    for line in outcome.failures:
        console.print(Text(f"      {line}", style="red"), soft_wrap=True)


def _table(*columns: str) -> Table:
    table = Table(box=None, padding=(0, 2), pad_edge=False, header_style="dim")
    for i, name in enumerate(columns):
        table.add_column(name, justify="left" if i == 0 else "right")
    return table


def _goals(outcome: Outcome) -> Table:
    table = _table("goal", "position [m]", "given at", "reached in", "settled in", "error", "rotation", "off line")
    for g in outcome.goals:
        where = " ".join(f"{c:+.3f}" for c in g.given.position)
        if g.given.refusal:
            table.add_row(str(g.given.number), where, _s(g.at), Text("refused", style="bold red"))
            continue
        style = "green" if g.reached else "bold red"
        table.add_row(
            str(g.given.number),
            where,
            _s(g.at),
            Text(_s(g.first) if g.first is not None else "never", style="" if g.first is not None else "bold red"),
            Text(_s(g.last) if g.last is not None else "not there", style=style),
            Text(f"{g.error * 1e3:.2f} mm", style=style),
            "-" if g.error_rot is None else Text(f"{g.error_rot:.4f} rad", style=style),
            f"{g.deviation * 1e3:.1f} mm",
        )
    for n in outcome.never:
        table.add_row(str(n), "-", "never", Text("not given", style="bold red"))
    return table


def _obstacles(outcome: Outcome) -> Table:
    table = _table("obstacle", "smallest clearance, by the simulator")
    for name, d in outcome.clearance.items():
        text = f"over {PLENTY * 1e3:.0f} mm" if d >= PLENTY else f"{d * 1e3:.1f} mm"
        table.add_row(name, Text(text, style="bold red" if d <= 0.0 else ""))
    return table


def _figures(outcome: Outcome, mode: str) -> list[tuple[str, Text]]:
    share = outcome.missed / outcome.slots if outcome.slots else 0.0
    rows = [
        ("contacts", Text(str(len(outcome.contacts)), style="bold red" if outcome.contacts else "green")),
        ("mode", Text(mode)),
        ("ticks", Text(f"{outcome.ticks}, of them {outcome.slots - outcome.missed} with the arm driven")),
    ]
    if mode == "real time":
        rows.append(("deadline misses", Text(f"{outcome.missed} of {outcome.slots} slots ({share:.2%})")))
        rows.append(("wake-up late", Text(f"{outcome.late * 1e3:.2f} ms (99 % of slots)")))
        drives = f"{outcome.drives_late * 1e3:.1f} ms at most, {outcome.drives_slipped * 1e3:.0f} ms given up"
        rows.append(("drives late", Text(drives)))
    bad = "bold red"
    return [
        *rows,
        ("faults", Text(", ".join(outcome.faults), style=bad) if outcome.faults else Text("none", style="green")),
        ("drive faults", Text("; ".join(outcome.trips), style=bad) if outcome.trips else Text("none", style="green")),
        ("top speed", Text(f"{outcome.speed:.3f} m/s")),
        ("top torque", Text(f"{outcome.torque:.0%} of the rating")),
        ("exit codes", Text(", ".join(f"{name} {code}" for name, code in outcome.exits.items()))),
    ]


def _s(value: float) -> str:
    return f"{value:.2f} s"

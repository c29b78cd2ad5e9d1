"""What the two levels buy: tracking and clearance over servo and model rates, with and without the estimator (§4)."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from rtctl.experiment.scene import Say, Trace, config_file, played, unsaid
from rtctl.experiment.style import BLUE, FAINT, INK, ORANGE, RED, note, page
from rtctl.plain import Json

TITLE = "What the two levels buy"
CAPTION = "tracking error and clearance over servo and model rates, the paper's 225/100 Hz included"
PAIRS = ((1000, 1000), (1000, 250), (1000, 50), (500, 125), (225, 100), (100, 100))  # [Hz]
LINE, PAST = (0.50, 0.35, 0.40), (0.50, -0.30, 0.40)  # [m] goals: one in free space, one past the ball
BALL = {"name": "ball", "type": "sphere", "radius_m": 0.07, "position_m": [0.58, 0.02, 0.36]}
GIVEN, THEN, END = 0.4, 1.9, 4.1  # [s]
MARGIN_MS = 8.0  # beyond a servo period, for the time-outs of the slowest pair


class Run(NamedTuple):
    """One pair of rates, with or without the estimator."""

    servo: int  # [Hz]
    model: int  # [Hz]
    carry: bool  # the estimator carries tip and points between evaluations
    error: float  # [m] root mean square of the tip the servo believes in, against the true one, while it moves
    off: float  # [m] off the straight line in free space
    clearance: float  # [m] least, by pybullet
    top_speed: float  # [m/s]
    rough: float  # [Nm] root mean square of the change of torque from period to period, summed over joints, by 1/kHz
    arrived: bool
    contacts: int
    faults: tuple[str, ...]


class Data(NamedTuple):
    """What the figure shows."""

    runs: list[Run]


def run(say: Say = unsaid, pairs: tuple[tuple[int, int], ...] = PAIRS) -> Data:
    """Play the same two goals at each pair of rates, with the estimator and without it."""
    cases = [(servo, model, carry) for servo, model in pairs for carry in (True, False)]
    config = config_file("panda")

    def saying(k: int) -> Say:
        return lambda part: say((k + part) / len(cases))

    return Data([_played(config, *case, saying(k)) for k, case in enumerate(cases)])


def changes_of(servo: int, model: int, carry: bool = True) -> dict[str, dict[str, object]]:
    """Return the keys of a config that are changed for a pair of rates [Hz]."""
    period = 1e3 / servo
    return {
        "loop": {"servo_hz": servo, "model_hz": model},
        "safety": {
            "watchdog_ms": 5.0 * period + MARGIN_MS,
            "stale_hold_ms": 2.2 * period + 1.0,
            "stale_stop_ms": 4.5 * period + MARGIN_MS,
        },
        # wide enough for the slowest servo: below rho_num the sampled field would pump (config refuses it)
        "avoid": {"self_clearance_m": 0.018, "self_influence_m": 0.04, "joint_clearance_rad": 0.05},
        "estimator": {"carry": carry},
    }


def _played(config: Path, servo: int, model: int, carry: bool, say: Say) -> Run:
    scenario = {
        "duration_s": END,
        "goal": [{"at_s": GIVEN, "position_m": list(LINE)}, {"at_s": THEN, "position_m": list(PAST)}],
        "obstacle": [BALL],
    }
    trace = played(scenario, config, say, changes_of(servo, model, carry))
    f = trace.figures
    return Run(
        servo,
        model,
        carry,
        _believed(trace),
        _off(trace),
        f["min_clearance_m"]["ball"],
        f["max_speed_m_s"],
        _rough(trace),
        f["arrived"],
        f["contacts"],
        tuple(f["faults"]),
    )


def _believed(trace: Trace) -> float:
    """Return how far the tip the law acted on was from where it was when the torque began to act.

    A record is of the slot before its row of truth: that row shows where the arm was at the slot's end.
    """
    moving = trace.speed()[:-1] > 0.05
    e = np.linalg.norm(trace.x_seen[1:] - trace.tip[:-1], axis=1)[moving]
    return float(np.sqrt((e**2).mean())) if len(e) else 0.0


def _off(trace: Trace) -> float:
    rows = trace.rows(GIVEN, THEN)
    tip = trace.tip[rows]
    way = np.array(LINE) - tip[0]
    way /= np.linalg.norm(way)
    offset = tip - tip[0]
    return float(np.linalg.norm(offset - np.outer(offset @ way, way), axis=1).max())


def _rough(trace: Trace) -> float:
    rows = trace.rows(GIVEN + 0.1, END)
    step = np.diff(trace.tau[rows], axis=0)
    return float(np.sqrt((step**2).sum(axis=1).mean()))


def figures(data: Data) -> Json:
    """Return the numbers of the figure: a row a run."""
    return {
        "runs": [
            {
                "servo_Hz": r.servo,
                "model_Hz": r.model,
                "estimator": r.carry,
                "tip_error_rms_m": r.error,
                "line_deviation_m": r.off,
                "min_clearance_m": r.clearance,
                "max_speed_m_s": r.top_speed,
                "torque_step_rms_Nm": r.rough,
                "arrived": r.arrived,
                "contacts": r.contacts,
                "faults": list(r.faults),
            }
            for r in data.runs
        ]
    }


def draw(data: Data) -> Figure:
    """Return the figure: three measures over the pairs, dots with the estimator, rings without it."""
    figure = page(
        "What the two levels buy",
        "Panda, the same two goals at each pair of rates: free space, then past a ball",
        size=(11.0, 6.4),
    )
    grid = figure.add_gridspec(1, 4, left=0.145, right=0.985, top=0.78, bottom=0.12, wspace=0.13)
    columns = (
        ("Tip believed\nagainst true, rms", "mm", lambda r: 1e3 * r.error, "log"),
        ("Off the straight line\nin free space", "mm", lambda r: 1e3 * r.off, "log"),
        ("Torque step from\nperiod to period, rms", "Nm", lambda r: r.rough, "linear"),
        ("Least clearance\nto the ball", "mm", lambda r: 1e3 * r.clearance, "clearance"),
    )
    axes0 = None
    for k, (title, unit, value, scale) in enumerate(columns):
        axes = figure.add_subplot(grid[k])
        _column(axes, data, value, scale)
        axes.set_title(title, fontsize=12.5)
        axes.set_xlabel(f"[{unit}]")
        if k == 0:
            axes0 = axes
        else:
            axes.tick_params(labelleft=False)
    assert axes0 is not None
    axes0.set_ylabel("servo / model rate [Hz]")
    handles = axes0.get_legend_handles_labels()
    figure.legend(*handles, loc="upper right", bbox_to_anchor=(0.99, 1.0), ncols=1, fontsize=12)
    return figure


def _column(axes: Axes, data: Data, value: Callable[[Run], float], scale: str) -> None:
    pairs = list(dict.fromkeys((r.servo, r.model) for r in data.runs))
    for carry in (True, False):
        runs = [r for r in data.runs if r.carry == carry]
        y = [pairs.index((r.servo, r.model)) for r in runs]
        x = [value(r) for r in runs]
        fill, edge = (BLUE, BLUE) if carry else ("none", ORANGE)
        axes.plot(
            x,
            y,
            "o" if carry else "s",
            ms=9,
            mew=2.0,
            clip_on=False,
            zorder=5 if carry else 6,
            label="with the estimator" if carry else "held still in between",
            mfc=fill,
            mec=edge,
        )
        for r, a, b in zip(runs, x, y, strict=True):
            if not r.arrived or r.faults:
                axes.plot(a, b, "x", ms=13, mec=RED, mew=2.0, zorder=7, clip_on=False)
    for k in range(len(pairs)):
        axes.axhline(k, color=FAINT, lw=0.6, zorder=0)
    if scale == "log":
        axes.set_xscale("log")
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 3.0)))
        axes.xaxis.set_minor_locator(NullLocator())
        axes.xaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
    elif scale == "linear":
        axes.set_xlim(left=0.0)
    else:
        axes.axvline(20.0, color=RED, lw=1.5, ls=(0, (5, 3)))
        note(axes, 20.5, len(pairs) - 0.45, "clearance", RED, ha="left", va="center", fontsize=11)
        axes.set_xlim(left=15.0)
    axes.set_ylim(len(pairs) - 0.3, -0.6)
    axes.set_yticks(range(len(pairs)), [f"{s} / {m}" for s, m in pairs])
    axes.tick_params(axis="y", length=0, labelcolor=INK)
    axes.grid(True, axis="x")


def table(data: Data) -> str:
    """Return the runs as a table in Markdown."""
    head = "| servo / model [Hz] | estimator | tip, rms [mm] | off the line [mm] | clearance [mm] | top speed [m/s] |"
    rows = [
        f"| {r.servo} / {r.model} | {'yes' if r.carry else 'no'} | {1e3 * r.error:.2f} | {1e3 * r.off:.2f} "
        f"| {1e3 * r.clearance:.1f} | {r.top_speed:.3f} |"
        for r in data.runs
    ]
    return "\n".join([head, "|---|---|---|---|---|---|", *rows])

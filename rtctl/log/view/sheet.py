"""A run on one page: where the tip went and past what, and how error, clearance, torque, speed and timing developed."""

import tomllib
from collections.abc import Callable
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from rtctl.log.view.maps import draw_map, window_of
from rtctl.log.view.report.gather import XYZ, Gathered
from rtctl.log.view.style import (
    BLUE,
    FAINT,
    GREEN,
    INK,
    JOINT_COLOURS,
    OBSTACLE_COLOURS,
    ORANGE,
    PAPER,
    RED,
    Goal,
    Notes,
    head,
    legend,
    level,
)

SIZE, DPI = (16.0, 12.0), 100
COLOURS = 96  # of the file: a third of the bytes of one with all
REACHED = 5.0  # [mm] drawn as the level below which a goal counts as reached
Panel = Callable[[Axes, Gathered, Notes], None]


def draw(g: Gathered, path: Path, notes: Notes | None = None) -> None:
    """Write the page; notes: what others than the log say of the run."""
    notes = _completed(g, Notes() if notes is None else notes)
    figure = Figure(figsize=SIZE, dpi=DPI, facecolor=PAPER)
    FigureCanvasAgg(figure)
    names = _obstacles(g)
    colours: dict[str, str] = dict(zip(names, cycle(OBSTACLE_COLOURS), strict=False))
    grid = figure.add_gridspec(
        1, 2, width_ratios=(1.0, 1.28), left=0.05, right=0.985, top=0.9, bottom=0.05, wspace=0.13
    )
    if {f"x.{axis}" for axis in XYZ} <= set(g.bins.names):
        window = window_of(g, notes.goals)
        size = window[1] - window[0]
        places = grid[0].subgridspec(2, 1, hspace=0.17, height_ratios=(size[0], max(size[2], 0.3 * size[0])))
        views = (((1, 0), "From above: way of the tip, from light to dark"), ((1, 2), "From behind"))
        for k, (plane, title) in enumerate(views):
            draw_map(figure.add_subplot(places[k]), g, notes.goals, colours, plane, window, title)
    panels = [panel for panel, needs in PANELS if any(name.startswith(needs) for name in g.bins.names)]
    rows = grid[1].subgridspec(len(panels), 1, hspace=0.32)
    last: Axes | None = None
    for k, panel in enumerate(panels):
        axes = last = figure.add_subplot(rows[k])
        panel(axes, g, notes)
        _instants(axes, g, notes, numbered=k == 0)
        axes.tick_params(labelbottom=k == len(panels) - 1)
    if last is not None:
        last.set_xlabel("robot time [s]")
    _title(figure, g, notes)
    figure.savefig(path)
    if path.suffix == ".png":
        _shrink(path)


def _completed(g: Gathered, notes: Notes) -> Notes:
    """Return notes with the log's own figures and goals where nobody gave others."""
    f = g.figures
    near = f["smallest_clearance_m"]
    faults = sorted({span.name for span in g.faults})
    words = (
        f"{f['duration_s']:.1f} s at {1.0 / g.header.period:.0f} Hz",
        f"smallest clearance {'-' if near is None else f'{near * 1e3:.1f} mm'} by the controller's spheres",
        f"top speed {f['top_speed_m_s']:.3f} m/s",
        f"faults: {', '.join(faults) or 'none'}",
    )
    goals = tuple(Goal(k, tuple(p), at) for k, (p, at) in enumerate(zip(g.goals, g.asked, strict=True), start=1))
    return notes._replace(
        title=notes.title or g.header.robot,
        words=notes.words or words,
        goals=notes.goals or goals[:30],
        lockstep=notes.lockstep or g.lateness.largest == 0.0,
    )


def _shrink(path: Path) -> None:
    """Write a picture again with few colours."""
    from PIL import Image

    with Image.open(path) as image:
        small = image.convert("RGB").quantize(COLOURS)
    small.save(path, optimize=True)


def _title(figure: Figure, g: Gathered, notes: Notes) -> None:
    figure.text(0.05, 0.962, notes.title, fontsize=19, fontweight="bold", color=INK)
    figure.text(0.05, 0.938, "   ·   ".join(notes.words), fontsize=11.5, color=RED if g.faults else INK)
    colour = GREEN if notes.verdict == "PASS" else RED
    figure.text(0.985, 0.962, notes.verdict, fontsize=19, fontweight="bold", color=colour, ha="right")


def _obstacles(g: Gathered) -> list[str]:
    """Return the names of the obstacles that anything was measured to, and of the others that are drawn."""
    measured = [name.removeprefix("rho.") for name in g.bins.names if name.startswith("rho.")]
    return [*measured, *(way.name for way in g.obstacles if way.name not in measured)]


def _line(axes: Axes, g: Gathered, name: str, scale: float = 1.0, most: float = np.inf, **how: Any) -> None:
    """Draw a series as a line through the smallest and largest value of each bin; what is beyond `most` is left out."""
    low, high = g.bins.series(name)
    time, values = np.repeat(g.bins.time, 2), scale * np.stack([low, high], axis=1).reshape(-1)
    values = np.where(values > most, np.nan, values)
    axes.plot(time, values, **{"lw": 1.4, **how})


def _instants(axes: Axes, g: Gathered, notes: Notes, numbered: bool) -> None:
    """Mark when goals were given, and when faults were in force."""
    axes.set_xlim(float(g.bins.time[0]), max(float(g.bins.time[-1]), float(g.bins.time[0]) + g.header.period))
    for span in g.faults:
        axes.axvspan(span.start, span.stop, color=RED, alpha=0.25, lw=0)
    for goal in notes.goals:
        axes.axvline(goal.at, color="#CFCFCF", lw=1.0, zorder=0)
        if numbered:
            axes.annotate(
                str(goal.number),
                (goal.at, 1.0),
                xycoords=("data", "axes fraction"),
                xytext=(4, -12),
                textcoords="offset points",
                fontsize=10,
                fontweight="bold",
                color=RED if goal.reached is False else INK,
            )


def _error(axes: Axes, g: Gathered, notes: Notes) -> None:
    """Draw the distance to the goal in force."""
    low, high = (np.maximum(series * 1e3, 1e-3) for series in g.bins.series("error"))
    axes.plot(np.repeat(g.bins.time, 2), np.stack([low, high], axis=1).reshape(-1), color=BLUE, lw=1.4)
    axes.set_yscale("log")
    axes.set_ylim(0.02, max(2000.0, 1.2 * float(np.nanmax(high))))
    axes.set_yticks([0.1, 1.0, 10.0, 100.0, 1000.0], ["0.1", "1", "10", "100", "1000"])
    level(axes, REACHED, f"reached: {REACHED:g} mm", RED)
    head(axes, "Distance to the goal", "mm")


def _clearance(axes: Axes, g: Gathered, notes: Notes) -> None:
    """Draw the controller's distance to each obstacle; the oracle's smallest is told beside it."""
    oracle = dict(notes.oracle)
    names = [name.removeprefix("rho.") for name in g.bins.names if name.startswith("rho.")]
    influence, clearance = _avoid(g)
    edge = 3.0 * influence if influence > 0.0 else 0.6  # [m] what is farther would run through the names
    for name, colour in zip(names, cycle(OBSTACLE_COLOURS), strict=False):
        least = float(np.nanmin(g.bins.series(f"rho.{name}")[0])) * 1e3
        truth = f", oracle {oracle[name] * 1e3:.0f} mm" if name in oracle else ""
        _line(axes, g, f"rho.{name}", most=edge, color=colour, label=f"{name}: least {least:.0f} mm{truth}")
    if influence > 0.0:
        axes.axhspan(0.0, clearance, color=RED, alpha=0.12, lw=0)
        level(axes, influence, "influence", FAINT)
        level(axes, clearance, "clearance", RED)
    named = 0 < len(names) <= 12
    axes.set_ylim(0.0, edge * (1.0 + 0.28 * ((len(names) + 1) // 2) * named))
    axes.set_yticks(np.linspace(0.0, edge, 4))
    head(axes, "Clearance by the controller's spheres", "m")
    if named:
        axes.legend(loc="upper right", ncols=2, fontsize=9, framealpha=0.85, edgecolor="none", handlelength=1.4)


def _avoid(g: Gathered) -> tuple[float, float]:
    """Return the influence and the clearance [m] that the config states, zeros where it states none."""
    try:
        avoid = tomllib.loads(g.header.config)["avoid"]
        return float(avoid["influence_m"]), float(avoid["clearance_m"])
    except (tomllib.TOMLDecodeError, KeyError, TypeError, ValueError):
        return 0.0, 0.0


def _torque(axes: Axes, g: Gathered, notes: Notes) -> None:
    """Draw the torque sent to each joint, of its limit where the config states one."""
    largest = g.limits.get("tau_max", np.zeros(0))
    relative = len(largest) == len(g.header.joints) and bool((largest > 0.0).all())
    for k, (joint, colour) in enumerate(zip(g.header.joints, cycle(JOINT_COLOURS), strict=False)):
        scale = 100.0 / float(largest[k]) if relative else 1.0
        _line(axes, g, f"tau_sent.{joint}", scale, color=colour, lw=1.1, label=joint.rpartition("_")[2])
    if relative:
        axes.set_ylim(-105.0, 105.0)
        for edge in (-100.0, 100.0):
            axes.axhline(edge, color=RED, lw=1.2, ls="--")
    head(axes, "Torque sent, of the limit" if relative else "Torque sent", "%" if relative else "Nm")
    legend(axes, min(len(g.header.joints), 8))


def _speed(axes: Axes, g: Gathered, notes: Notes) -> None:
    """Draw the speed of the tip."""
    _line(axes, g, "speed", color=BLUE)
    axes.set_ylim(bottom=0.0)
    v_max = g.limits.get("v_max")
    if v_max is not None and float(v_max[0]) > 0.0:
        axes.set_ylim(0.0, 1.25 * float(v_max[0]))
        level(axes, float(v_max[0]), "v max", RED)
    head(axes, "Speed of the tip", "m/s")


def _timing(axes: Axes, g: Gathered, notes: Notes) -> None:
    """Draw the time of each turn; lateness and missed slots where there are deadlines."""
    _line(axes, g, "compute", 1e3, color=ORANGE, lw=1.1, label=f"turn, p99 {g.compute.quantile(0.99) * 1e3:.2f} ms")
    axes.set_yscale("log")
    axes.set_ylim(0.005, 200.0)
    axes.set_yticks([0.01, 0.1, 1.0, 10.0, 100.0], ["0.01", "0.1", "1", "10", "100"])
    if notes.lockstep:
        head(axes, "Time of a turn (lockstep: no deadlines)", "ms")
    else:
        late = f"late, p99 {g.lateness.quantile(0.99) * 1e3:.2f} ms"
        _line(axes, g, "lateness", 1e3, color=BLUE, lw=1.1, label=late)
        missed = g.bins.series("missed")[1]
        gone = missed > 0
        if gone.any():
            axes.plot(g.bins.time[gone], missed[gone] * g.header.period * 1e3, "|", ms=7, color=RED, label="missed")
        level(axes, g.header.period * 1e3, "period", FAINT)
        head(axes, "Timing of the servo loop", "ms")
    legend(axes, 3)


PANELS: tuple[tuple[Panel, str], ...] = (  # and how the series begin without which a panel has nothing to show
    (_error, "error"),
    (_clearance, "rho."),
    (_torque, "tau_sent."),
    (_speed, "speed"),
    (_timing, "compute"),
)

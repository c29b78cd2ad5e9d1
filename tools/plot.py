"""A run on one page: where the tip went and past what, and how error, clearance, torque, speed and timing developed.

Colours are those of Okabe and Ito, which colour-blind people tell apart.
"""

from collections.abc import Callable
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from rtctl.experiment.outline import axis_view, outline
from rtctl.kernel.rotations import R_of
from rtctl.types import F64, Shape
from tools.outcome import REACHED, GoalOutcome, Outcome
from tools.trace import Trace, Track

SIZE, DPI = (16.0, 12.0), 100
ORANGE, SKY, GREEN, YELLOW, BLUE, RED, PURPLE = (
    "#E69F00", "#56B4E9", "#009E73", "#F0E442", "#0072B2", "#D55E00", "#CC79A7",
)  # fmt: skip
INK, FAINT, PAPER = "#222222", "#9A9A9A", "#FFFFFF"
OBSTACLE_COLOURS = (ORANGE, SKY, GREEN, PURPLE, RED, BLUE, "#8C8C8C", YELLOW)
JOINT_COLOURS = (BLUE, ORANGE, GREEN, RED, PURPLE, SKY, INK)
MARGIN = 0.12  # [m] round path and goals
NEARBY = 1.0  # [m] an obstacle further from the origin need not be on the maps
POINTS = 4000  # of a curve: more than a page shows
GHOSTS = 11  # of a moving obstacle
TRAIL = 0.15  # [m] beyond the window to which its trail goes
Axes = Any
Window = tuple[F64, F64]  # corners (3,) [m]


def draw(trace: Trace, outcome: Outcome, mode: str, path: Path) -> None:
    """Write the page as a PNG file."""
    figure = Figure(figsize=SIZE, dpi=DPI, facecolor=PAPER)
    FigureCanvasAgg(figure)
    colours = dict(zip(trace.tracks, cycle(OBSTACLE_COLOURS), strict=False))
    grid = figure.add_gridspec(
        1, 2, width_ratios=(1.0, 1.28), left=0.05, right=0.985, top=0.9, bottom=0.05, wspace=0.13
    )
    window = _window(trace, outcome)
    size = window[1] - window[0]
    places = grid[0].subgridspec(2, 1, hspace=0.17, height_ratios=(size[0], size[2]))
    maps = [figure.add_subplot(places[0]), figure.add_subplot(places[1])]
    _map(maps[0], trace, outcome, colours, (1, 0), window, "From above: way of the tip, from light to dark")
    _map(maps[1], trace, outcome, colours, (1, 2), window, "From behind the arm")
    rows = grid[1].subgridspec(5, 1, hspace=0.32, height_ratios=(1.15, 1.15, 1.15, 0.85, 0.85))
    panels = [figure.add_subplot(rows[i]) for i in range(5)]
    for axes, panel in zip(panels, (_error, _clearance, _torque, _speed, _timing), strict=True):
        panel(axes, trace, outcome, colours)
        _instants(axes, trace, outcome, numbered=axes is panels[0])
    panels[-1].set_xlabel("time since arming [s]")
    for axes in panels[:-1]:
        axes.tick_params(labelbottom=False)
    _title(figure, trace, outcome, mode)
    figure.savefig(path)


def _title(figure: Figure, trace: Trace, outcome: Outcome, mode: str) -> None:
    reached = sum(g.reached for g in outcome.goals)
    verdict = "PASS" if not outcome.failures else "FAIL"
    figure.text(0.05, 0.962, "An arm goes round obstacles", fontsize=19, fontweight="bold", color=INK)
    words = [
        f"{reached} of {len(outcome.goals) + len(outcome.never)} goals reached",
        f"{len(outcome.contacts)} contacts",
        *([] if mode == "lockstep" else [f"{outcome.missed} of {outcome.slots} deadlines missed"]),
        f"{1.0 / trace.period:.0f} Hz in {mode}",
        f"faults: {', '.join(outcome.faults) or 'none'}",
    ]
    figure.text(0.05, 0.938, "   ·   ".join(words), fontsize=11.5, color=INK)
    colour = GREEN if verdict == "PASS" else RED
    figure.text(0.985, 0.962, verdict, fontsize=19, fontweight="bold", color=colour, ha="right")


# ---- maps


def _window(trace: Trace, outcome: Outcome) -> Window:
    """Return the corners (3,) [m] of what the maps show: path, goals, base, and some room."""
    goals = [np.array(g.given.position) for g in outcome.goals if not g.given.refusal]
    solids = [t.shapes[-1].position for t in trace.tracks.values() if not t.moves and t.shapes[-1].type != "plane"]
    near = [p for p in solids if np.abs(p).max() < NEARBY]
    points = np.vstack([trace.x[trace.driven], np.zeros((1, 3)), *goals, *near])
    return points.min(0) - MARGIN, points.max(0) + MARGIN


def _map(
    axes: Axes, trace: Trace, outcome: Outcome, colours: dict[str, str], plane: tuple[int, int],
    window: Window, title: str,
) -> None:  # fmt: skip
    """Draw one view: `plane` are the world axes that go to the right and up."""
    across, up = plane
    low, high = window = _fitted(axes, window, plane)
    for track in trace.tracks.values():
        _obstacle(axes, trace, track, colours[track.name], plane, window)
    path = _thinned(trace.x[trace.driven])
    axes.plot(path[:, across], path[:, up], color=PAPER, lw=4.0, zorder=4, solid_capstyle="round")
    _path(axes, trace, plane)
    start = trace.x[trace.driven][:1]
    axes.plot(start[:, across], start[:, up], "s", ms=9, mfc=PAPER, mec=INK, mew=1.6, zorder=7)
    if len(start):
        axes.annotate(
            "start",
            start[0, [across, up]],
            xytext=(0, -16),
            textcoords="offset points",
            ha="center",
            fontsize=9,
            zorder=8,
            bbox={"fc": PAPER, "ec": "none", "alpha": 0.75, "pad": 0.8},
        )
    axes.plot(0.0, 0.0, marker="^", ms=12, color=FAINT, zorder=3)
    axes.annotate("base", (0.0, 0.0), xytext=(0, 9), textcoords="offset points", ha="center", fontsize=9, color=FAINT)
    for g in outcome.goals:
        _goal_mark(axes, g, plane)
    axes.set_aspect("equal", adjustable="box")
    axes.set_xlim(high[across], low[across])  # seen along x, y grows to the left
    axes.set_ylim(low[up], high[up])
    names = "xyz"
    axes.set_xlabel(f"{names[across]} [m]")
    axes.set_ylabel(f"{names[up]} [m]")
    axes.set_title(title, loc="left", fontsize=12, fontweight="bold", color=INK)
    axes.grid(color="#ECECEC", lw=0.8, zorder=0)
    axes.set_axisbelow(True)
    _frame(axes)


def _fitted(axes: Axes, window: Window, plane: tuple[int, int]) -> Window:
    """Return the window widened, the same on both sides, to the shape of the axes: scales are equal."""
    low, high = window[0].copy(), window[1].copy()
    size = axes.get_position().size * SIZE
    scale = float(((high - low)[list(plane)] / size).max())
    for axis, length in zip(plane, size, strict=True):
        more = 0.5 * (scale * length - (high[axis] - low[axis]))
        low[axis], high[axis] = low[axis] - more, high[axis] + more
    return low, high


def _path(axes: Axes, trace: Trace, plane: tuple[int, int]) -> None:
    """Draw the path of the tip, thin where it is slow, dark as time goes on."""
    x = _thinned(trace.x[trace.driven][:, plane])
    shade = np.linspace(0.0, 1.0, max(len(x) - 1, 1))
    first, last = np.array([0.55, 0.70, 0.83]), np.array([0.0, 0.25, 0.45])
    colours = first + shade[:, None] * (last - first)
    segments = np.stack([x[:-1], x[1:]], axis=1)
    axes.add_collection(LineCollection(list(segments), colors=colours, linewidths=2.0, zorder=5, capstyle="round"))


def _goal_mark(axes: Axes, g: GoalOutcome, plane: tuple[int, int]) -> None:
    colour = INK if g.reached else RED
    here = np.array(g.given.position)[list(plane)]
    axes.plot(*here, "o", ms=17, mfc=PAPER, mec=colour, mew=1.8, zorder=8)
    axes.text(
        *here,
        str(g.given.number),
        ha="center",
        va="center_baseline",
        fontsize=10,
        fontweight="bold",
        color=colour,
        zorder=9,
    )


def _obstacle(axes: Axes, trace: Trace, track: Track, colour: str, plane: tuple[int, int], window: Window) -> None:
    """Draw an obstacle; one that moves where it was nearest to the arm, and its way as a faded trail."""
    if track.shapes[0].type == "plane":
        _plane(axes, track, colour, plane, window)
        return
    nearest = trace.time[int(np.nanargmin(track.rho))] if np.isfinite(track.rho).any() else track.at[-1]
    shape = track.shapes[max(int(np.searchsorted(track.at, nearest)) - 1, 0)]
    if track.moves:
        for ghost in _ghosts(track, window):
            axes.add_patch(Polygon(silhouette(ghost, plane), closed=True, fc=colour, ec=colour, alpha=0.13, zorder=1))
        trail = np.array([s.position for s in track.shapes])[:, plane]
        axes.plot(trail[:, 0], trail[:, 1], color=colour, lw=1.2, ls=(0, (4, 3)), zorder=2)
    outline = silhouette(shape, plane)
    axes.add_patch(Polygon(outline, closed=True, fc=colour, ec="none", alpha=0.4, zorder=2))
    axes.add_patch(Polygon(outline, closed=True, fc="none", ec=colour, lw=1.6, zorder=3))
    name = f"{track.name} at {nearest:.1f} s" if track.moves else track.name
    low, high = window[0][list(plane)] + 0.02, window[1][list(plane)] - 0.02
    place = shape.position[list(plane)]
    if track.moves:  # below, where it hides no goal
        place = np.array([place[0], outline[:, 1].min()])
    _name(axes, np.clip(place, low, high), name, colour)


def _name(axes: Axes, place: F64, text: str, colour: str) -> None:
    box = {"fc": PAPER, "ec": colour, "alpha": 0.85, "pad": 1.6, "lw": 0.8}
    axes.text(*place, text, ha="center", va="center", fontsize=9.5, color=INK, zorder=6, style="italic", bbox=box)


def _plane(axes: Axes, track: Track, colour: str, plane: tuple[int, int], window: Window) -> None:
    """Draw a half space where the view shows it edge on."""
    shape = track.shapes[-1]
    normal = R_of(shape.wxyz)[:, 2][list(plane)]
    if np.linalg.norm(normal) < 0.9:
        return
    point, along = shape.position[list(plane)], np.array([-normal[1], normal[0]])
    corners = [point - 5.0 * along, point + 5.0 * along, point + 5.0 * (along - normal), point - 5.0 * (along + normal)]
    axes.add_patch(Polygon(corners, closed=True, fc=colour, ec=colour, alpha=0.35, lw=1.2, zorder=1))
    low, high = window[0][list(plane)] + 0.03, window[1][list(plane)] - 0.03
    axes.text(high[0], np.clip(point - 0.03 * normal, low, high)[1], track.name, ha="left", va="center", fontsize=9.5,
              color=INK, zorder=6, style="italic")  # fmt: skip


def _ghosts(track: Track, window: Window) -> list[Shape]:
    """Return the shapes of the trail: its way through the window's neighbourhood, at equal distances."""
    places = np.array([s.position for s in track.shapes])
    near = np.flatnonzero(((places > window[0] - TRAIL) & (places < window[1] + TRAIL)).all(1))
    if not len(near):
        return []
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(places[near], axis=0), axis=1))])
    wanted = np.linspace(0.0, way[-1], GHOSTS)
    return [track.shapes[near[i]] for i in np.unique(np.searchsorted(way, wanted).clip(max=len(way) - 1))]


def silhouette(shape: Shape, plane: tuple[int, int]) -> F64:
    """Return the outline (k, 2) [m] of a convex solid seen along the third axis."""
    return outline(shape, axis_view(*plane))


# ---- panels over time


def _error(axes: Axes, trace: Trace, outcome: Outcome, colours: dict[str, str]) -> None:
    """Distance to the goal in force."""
    taken = [g for g in outcome.goals if not g.given.refusal]
    ends = [trace.at(g.given.slot) for g in taken[1:]] + [len(trace.time)]
    for g, end in zip(taken, ends, strict=True):
        start = trace.at(g.given.slot)
        part = slice(start, max(start + 1, min(end, int(np.flatnonzero(trace.running)[-1]) + 1)))
        e, _ = trace.errors(part, trace.goals[g.given.slot])
        axes.plot(*_curve(trace.time[part], np.maximum(e * 1e3, 1e-3), np.max), color=BLUE, lw=1.6)
    axes.set_yscale("log")
    axes.set_ylim(0.02, 2000.0)
    axes.set_yticks([0.1, 1.0, 10.0, 100.0, 1000.0], ["0.1", "1", "10", "100", "1000"])
    axes.axhline(REACHED * 1e3, color=RED, lw=1.2, ls="--")
    _note(axes, REACHED * 1e3, "reached: 5 mm", RED)
    _head(axes, "Distance to the goal", "mm")


def _clearance(axes: Axes, trace: Trace, outcome: Outcome, colours: dict[str, str]) -> None:
    """Controller's distance of each obstacle to the arm."""
    top = 5.0 * trace.influence
    for name, track in trace.tracks.items():
        rho = np.where(trace.running, track.rho, np.nan)
        axes.plot(*_curve(trace.time, rho, np.min), color=colours[name], lw=1.8, label=name)
    axes.set_ylim(0.0, top)
    axes.axhspan(0.0, trace.clearance, color=RED, alpha=0.12, lw=0)
    axes.axhline(trace.influence, color=FAINT, lw=1.2, ls="--")
    axes.axhline(trace.clearance, color=RED, lw=1.2, ls="--")
    _note(axes, trace.influence, "influence", FAINT)
    _note(axes, trace.clearance, "clearance", RED)
    _head(axes, "Obstacles to arm, as the controller sees it", "m")
    _legend(axes, len(trace.tracks))


def _torque(axes: Axes, trace: Trace, outcome: Outcome, colours: dict[str, str]) -> None:
    """Torque sent of each joint."""
    for k, (joint, colour) in enumerate(zip(trace.joints, cycle(JOINT_COLOURS), strict=False)):
        ratio = np.where(trace.driven, trace.ratio[:, k] * 100.0, np.nan)
        axes.plot(*_curve(trace.time, ratio, np.max), color=colour, lw=1.1, label=joint.removeprefix("panda_"))
    axes.set_ylim(0.0, 105.0)
    axes.axhline(100.0, color=RED, lw=1.2, ls="--")
    _head(axes, "Torque, of the rating", "%")
    _legend(axes, len(trace.joints))


def _speed(axes: Axes, trace: Trace, outcome: Outcome, colours: dict[str, str]) -> None:
    """Speed of the tip."""
    speed = np.where(trace.driven, np.sqrt((trace.xd**2).sum(1)), np.nan)
    axes.plot(*_curve(trace.time, speed, np.max), color=BLUE, lw=1.6)
    axes.set_ylim(0.0, 1.25 * trace.v_max)
    axes.axhline(trace.v_max, color=RED, lw=1.2, ls="--")
    _note(axes, trace.v_max, "v max", RED)
    _head(axes, "Speed of the tip", "m/s")


def _timing(axes: Axes, trace: Trace, outcome: Outcome, colours: dict[str, str]) -> None:
    """Time of each tick and lateness of its wake-up; missed slots as marks."""
    period = trace.period * 1e3
    axes.plot(*_curve(trace.time, trace.compute * 1e3, np.max), color=ORANGE, lw=1.1, label="tick, longest")
    axes.plot(*_curve(trace.time, trace.compute * 1e3, np.median), color=GREEN, lw=1.1, label="tick, median")
    if trace.lateness.any():
        late = _curve(trace.time, trace.lateness * 1e3, np.max)
        axes.plot(*late, color=BLUE, lw=1.1, label="late, longest")
    gone = trace.missed > 0
    axes.set_yscale("log")
    axes.set_ylim(0.005, 200.0)
    axes.set_yticks([0.01, 0.1, 1.0, 10.0, 100.0], ["0.01", "0.1", "1", "10", "100"])
    if gone.any():
        lost = trace.missed[gone] * period
        axes.plot(trace.time[gone], lost, "|", ms=7, color=RED, label="missed")
    axes.axhline(period, color=FAINT, lw=1.2, ls="--")
    _note(axes, period, "period", FAINT)
    _head(axes, "Timing of the servo loop", "ms")
    _legend(axes, 4)


def _instants(axes: Axes, trace: Trace, outcome: Outcome, numbered: bool) -> None:
    """Mark when goals were given."""
    axes.set_xlim(0.0, float(trace.time[-1]))
    for g in outcome.goals:
        axes.axvline(g.at, color="#CFCFCF", lw=1.0, zorder=0)
        if numbered:
            axes.annotate(
                str(g.given.number),
                (g.at, 1.0),
                xycoords=("data", "axes fraction"),
                xytext=(4, -12),
                textcoords="offset points",
                fontsize=10,
                fontweight="bold",
                color=INK if g.reached else RED,
            )


def _head(axes: Axes, title: str, unit: str) -> None:
    axes.set_title(f"{title} [{unit}]", loc="left", fontsize=11.5, fontweight="bold", color=INK, pad=5)
    axes.grid(axis="y", color="#ECECEC", lw=0.8)
    axes.set_axisbelow(True)
    _frame(axes)


def _frame(axes: Axes) -> None:
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axes.spines[side].set_color(FAINT)
    axes.tick_params(colors=INK, labelsize=9.5, color=FAINT)
    axes.minorticks_off()


def _note(axes: Axes, value: float, text: str, colour: str) -> None:
    """Name a level at the right end of the axes."""
    axes.annotate(
        text,
        (1.0, value),
        xycoords=("axes fraction", "data"),
        xytext=(-3, 3.5),
        textcoords="offset points",
        ha="right",
        va="bottom",
        fontsize=9,
        color=colour,
        bbox={"fc": PAPER, "ec": "none", "alpha": 0.8, "pad": 0.6},
        zorder=9,
    )


def _legend(axes: Axes, count: int) -> None:
    axes.legend(
        loc="lower right",
        bbox_to_anchor=(1.005, 0.985),
        ncols=count,
        fontsize=9,
        frameon=False,
        handlelength=1.4,
        columnspacing=1.1,
        handletextpad=0.5,
        borderaxespad=0.1,
    )


def _thinned(x: F64) -> F64:
    """Return every k-th row and the last."""
    step = max(1, len(x) // POINTS)
    return np.vstack([x[::step], x[-1:]])


def _curve(time: F64, values: F64, of: Callable[..., Any]) -> tuple[F64, F64]:
    """Return a curve of at most POINTS points, each `of` (smallest, greatest, ...) the ticks it stands for."""
    step = max(1, len(values) // (POINTS // 4))
    n = len(values) // step * step
    blocks = values[:n].reshape(-1, step)
    empty = np.isnan(blocks).all(1)
    filled = np.where(np.isnan(blocks), np.nanmax(values) if not np.isnan(values).all() else 0.0, blocks)
    reduced = of(filled if of is np.min else np.where(np.isnan(blocks), filled.min(), blocks), axis=1)
    return time[:n].reshape(-1, step)[:, 0], np.where(empty, np.nan, reduced)

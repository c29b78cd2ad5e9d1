"""Where the tip went and past what, seen along an axis of the world."""

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.patches import Polygon

from rtctl.kernel.rotations import R_of
from rtctl.log.view.report.gather import XYZ, Gathered
from rtctl.log.view.report.slots import Way
from rtctl.log.view.style import FAINT, INK, PAPER, RED, Goal, frame
from rtctl.types import F64, Shape
from rtctl.world.outline import axis_view, outline

Window = tuple[F64, F64]  # corners (3,) [m]
MARGIN = 0.12  # [m] round path and goals
NEARBY = 1.0  # [m] an obstacle further from the path need not be on the maps
POINTS = 4000  # of a path: more than a page shows
GHOSTS = 11  # of a moving obstacle
TRAIL = 0.15  # [m] beyond the window to which its trail goes


def path_of(g: Gathered) -> F64:
    """Return the path of the tip (k, 3) [m]."""
    every: F64 = np.stack([np.mean(g.bins.series(f"x.{axis}"), axis=0) for axis in XYZ], axis=1)
    known: F64 = every[np.isfinite(every).all(1)]
    thinned: F64 = known[:: max(1, len(known) // POINTS)]
    return np.concatenate([thinned, known[-1:]])


def window_of(g: Gathered, goals: tuple[Goal, ...]) -> Window:
    """Return the corners (3,) [m] of what the maps show: path, goals, what was near, and some room."""
    path = path_of(g)
    points = np.vstack([path, np.zeros((1, 3)), *(np.array(goal.position) for goal in goals)])
    low, high = points.min(0) - NEARBY, points.max(0) + NEARBY
    places = [np.array(_nearest(g, way)[1]) for way in g.obstacles if way.type != "plane"]
    near = [p for p in places if ((p > low) & (p < high)).all() and np.abs(p).max() < NEARBY]
    points = np.vstack([points, *near])
    return points.min(0) - MARGIN, points.max(0) + MARGIN


def draw_map(
    axes: Axes,
    g: Gathered,
    goals: tuple[Goal, ...],
    colours: Mapping[str, str],
    plane: tuple[int, int],
    window: Window,
    title: str,
) -> None:
    """Draw one view: `plane` are the world axes that go to the right and up."""
    across, up = plane
    low, high = window = _fitted(axes, window, plane)
    for way in g.obstacles:
        _obstacle(axes, g, way, colours.get(way.name, FAINT), plane, window)
    path = path_of(g)[:, plane]
    axes.plot(path[:, 0], path[:, 1], color=PAPER, lw=4.0, zorder=4, solid_capstyle="round")
    shade = np.linspace(0.0, 1.0, max(len(path) - 1, 1))
    first, last = np.array([0.55, 0.70, 0.83]), np.array([0.0, 0.25, 0.45])
    segments = list(np.stack([path[:-1], path[1:]], axis=1))
    lines = LineCollection(
        segments, colors=first + shade[:, None] * (last - first), linewidths=2.0, zorder=5, capstyle="round"
    )
    axes.add_collection(lines)
    if len(path):
        axes.plot(*path[0], "s", ms=9, mfc=PAPER, mec=INK, mew=1.6, zorder=7)
        _label(axes, path[0], "start", (0, -16), INK)
    axes.plot(0.0, 0.0, marker="^", ms=12, color=FAINT, zorder=3)
    _label(axes, np.zeros(2), "base", (0, 9), FAINT)
    for goal in goals:
        here, colour = np.array(goal.position)[list(plane)], RED if goal.reached is False else INK
        axes.plot(*here, "o", ms=17, mfc=PAPER, mec=colour, mew=1.8, zorder=8)
        axes.text(
            here[0],
            here[1],
            str(goal.number),
            ha="center",
            va="center_baseline",
            fontsize=10,
            fontweight="bold",
            color=colour,
            zorder=9,
        )
    axes.set_aspect("equal", adjustable="box")
    axes.set_xlim(high[across], low[across])  # seen along x, y grows to the left
    axes.set_ylim(low[up], high[up])
    axes.set_xlabel(f"{XYZ[across]} [m]")
    axes.set_ylabel(f"{XYZ[up]} [m]")
    axes.set_title(title, loc="left", fontsize=12, fontweight="bold", color=INK)
    axes.grid(color="#ECECEC", lw=0.8, zorder=0)
    frame(axes)


def _label(axes: Axes, place: F64, text: str, offset: tuple[int, int], colour: str) -> None:
    box = {"fc": PAPER, "ec": "none", "alpha": 0.75, "pad": 0.8}
    axes.annotate(
        text,
        (place[0], place[1]),
        xytext=offset,
        textcoords="offset points",
        ha="center",
        fontsize=9,
        color=colour,
        zorder=8,
        bbox=box,
    )


def _fitted(axes: Axes, window: Window, plane: tuple[int, int]) -> Window:
    """Return the window widened, the same on both sides, to the shape of the axes: scales are equal."""
    low, high = window[0].copy(), window[1].copy()
    figure = axes.get_figure(root=True)
    assert figure is not None
    size = axes.get_position().size * figure.get_size_inches()
    scale = float(((high - low)[list(plane)] / size).max())
    for axis, length in zip(plane, size, strict=True):
        more = 0.5 * (scale * length - (high[axis] - low[axis]))
        low[axis], high[axis] = low[axis] - more, high[axis] + more
    return low, high


def _shape(way: Way, place: list[float]) -> Shape:
    dims = np.array([*way.dims, 0.0, 0.0, 0.0, 0.0][:4])
    return Shape(way.name, way.type, dims, np.array(place), np.array(way.wxyz), np.zeros(3), np.zeros(3))


def _nearest(g: Gathered, way: Way) -> tuple[float, list[float]]:
    """Return when [s] an obstacle was nearest to the arm, and where it was then [m]."""
    if f"rho.{way.name}" not in g.bins.names:
        return float(g.bins.time[-1]), way.path[-1]
    low, _ = g.bins.series(f"rho.{way.name}")
    time = float(g.bins.time[int(np.nanargmin(low))])
    tick = time / g.header.period
    return time, way.path[max(int(np.searchsorted(way.ticks, tick, "right")) - 1, 0)]


def _obstacle(axes: Axes, g: Gathered, way: Way, colour: str, plane: tuple[int, int], window: Window) -> None:
    """Draw an obstacle; one that moves where it was nearest to the arm, and its way as a faded trail."""
    if way.type == "plane":
        _plane(axes, way, colour, plane, window)
        return
    if way.type in ("mesh", "cloud"):  # their corners are not here
        return
    seen, moves = axis_view(*plane), len(way.path) > 1
    time, place = _nearest(g, way)
    shape = _shape(way, place)
    if moves:
        for ghost in _ghosts(way, window):
            polygon = outline(_shape(way, ghost), seen)
            axes.add_patch(Polygon(polygon, closed=True, fc=colour, ec=colour, alpha=0.13, zorder=1))
        trail = np.array(way.path)[:, plane]
        axes.plot(trail[:, 0], trail[:, 1], color=colour, lw=1.2, ls=(0, (4, 3)), zorder=2)
    edge = outline(shape, seen)
    axes.add_patch(Polygon(edge, closed=True, fc=colour, ec="none", alpha=0.4, zorder=2))
    axes.add_patch(Polygon(edge, closed=True, fc="none", ec=colour, lw=1.6, zorder=3))
    low, high = window[0][list(plane)] + 0.02, window[1][list(plane)] - 0.02
    at = shape.position[list(plane)]
    if moves:  # below, where it hides no goal
        at = np.array([at[0], edge[:, 1].min()])
    box = {"fc": PAPER, "ec": colour, "alpha": 0.85, "pad": 1.6, "lw": 0.8}
    x, y = np.clip(at, low, high)
    axes.text(
        x,
        y,
        f"{way.name} at {time:.1f} s" if moves else way.name,
        ha="center",
        va="center",
        fontsize=9.5,
        color=INK,
        zorder=6,
        style="italic",
        bbox=box,
    )


def _plane(axes: Axes, way: Way, colour: str, plane: tuple[int, int], window: Window) -> None:
    """Draw a half space where the view shows it edge on."""
    shape = _shape(way, way.path[-1])
    normal = R_of(shape.wxyz)[:, 2][list(plane)]
    if np.linalg.norm(normal) < 0.9:
        return
    point, along = shape.position[list(plane)], np.array([-normal[1], normal[0]])
    corners = [point - 5.0 * along, point + 5.0 * along, point + 5.0 * (along - normal), point - 5.0 * (along + normal)]
    axes.add_patch(Polygon(corners, closed=True, fc=colour, ec=colour, alpha=0.35, lw=1.2, zorder=1))
    low, high = window[0][list(plane)] + 0.03, window[1][list(plane)] - 0.03
    axes.text(
        high[0],
        np.clip(point - 0.03 * normal, low, high)[1],
        way.name,
        ha="left",
        va="center",
        fontsize=9.5,
        color=INK,
        zorder=6,
        style="italic",
    )


def _ghosts(way: Way, window: Window) -> list[list[float]]:
    """Return the places of the trail: its way through the window's neighbourhood, at equal distances."""
    places = np.array(way.path)
    near = np.flatnonzero(((places > window[0] - TRAIL) & (places < window[1] + TRAIL)).all(1))
    if not len(near):
        return []
    gone = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(places[near], axis=0), axis=1))])
    wanted = np.linspace(0.0, gone[-1], GHOSTS)
    return [way.path[near[i]] for i in np.unique(np.searchsorted(gone, wanted).clip(max=len(gone) - 1))]

"""The redundant planar arm of four joints in an enclosure: every link avoids walls and obstacles (Khatib 1986)."""

from typing import NamedTuple

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rtctl.experiment.drawing import draw_arm, draw_shapes, draw_strobes, draw_way, framed, strobes
from rtctl.experiment.outline import Figurine, axis_view
from rtctl.experiment.scene import Say, Trace, unsaid
from rtctl.experiment.style import BLUE, FRONT, INK, ORANGE, PAPER, RED, level, note, page, thinned
from rtctl.experiment.tour import arrivals, leg, numbers, tour
from rtctl.plain import Json

TITLE = "A planar arm of four joints in an enclosure"
CAPTION = "whole-arm avoidance among walls and pillars, as stroboscopic frames, and the clearance of every moment"
SEEN = axis_view(0, 1)
LEFT, RIGHT, BELOW, ABOVE = -0.62, 1.62, -0.72, 1.16  # [m] the walls
GOALS = ((0.22, 0.84), (0.13, 0.67), (1.1, 0.86))  # [m] in the plane
EVERY = 3.4  # [s] a goal
FRAMES = 7


def _pillar(name: str, x: float, y: float, radius: float) -> Json:
    return {"name": name, "type": "cylinder", "radius_m": radius, "length_m": 0.4, "position_m": [x, y, 0.0]}


def _wall(name: str, x: float, y: float, normal: tuple[float, float]) -> Json:
    return {"name": name, "type": "plane", "position_m": [x, y, 0.0], "normal": [*normal, 0.0]}


OBSTACLES = (
    _wall("left", LEFT, 0.0, (1.0, 0.0)),
    _wall("right", RIGHT, 0.0, (-1.0, 0.0)),
    _wall("below", 0.0, BELOW, (0.0, 1.0)),
    _wall("above", 0.0, ABOVE, (0.0, -1.0)),
    _pillar("pillar", 0.55, 0.42, 0.05),
    _pillar("post", 1.33, 0.3, 0.07),
    {"name": "crate", "type": "box", "size_m": [0.34, 0.2, 0.4], "position_m": [0.5, -0.5, 0.0]},
)


class Data(NamedTuple):
    """What the figure shows."""

    trace: Trace
    goals: tuple[tuple[float, float], ...]


def run(say: Say = unsaid, goals: tuple[tuple[float, float], ...] = GOALS) -> Data:
    """Play the goals one after the other."""
    return Data(tour("planar4", [(*g, 0.0) for g in goals], EVERY, OBSTACLES, say), goals)


def figures(data: Data) -> Json:
    """Return the numbers of the figure."""
    return numbers(data.trace)


def draw(data: Data) -> Figure:
    """Return the figure: a drawing a goal, and the clearance below."""
    trace, f = data.trace, data.trace.figures
    least = 1e3 * f["min_clearance_m"]["all"]
    figure = page(
        "Four joints in an enclosure",
        f"Every link keeps off walls, pillars and crate: {least:.0f} mm at the least, {f['contacts']} contacts",
        size=(11.0, 6.6),
    )
    count = len(data.goals)
    grid = figure.add_gridspec(
        2, count, left=0.075, right=0.985, top=0.855, bottom=0.105, wspace=0.05, hspace=0.22, height_ratios=(1.9, 1.0)
    )
    figurine = Figurine(trace.robot.body)
    for k in range(count):
        _drawing(figure.add_subplot(grid[0, k]), data, figurine, k)
    _clearance(figure.add_subplot(grid[1, :]), data)
    return figure


def _drawing(axes: Axes, data: Data, figurine: Figurine, k: int) -> None:
    trace = data.trace
    rows = leg(trace, k, k)
    draw_shapes(axes, trace.shapes(0.0), SEEN)
    picked = rows.start + strobes(trace.q[rows], FRAMES)
    draw_strobes(axes, figurine, trace, picked, SEEN)
    draw_arm(axes, figurine, trace.q[picked[-1]], SEEN, FRONT, 6.5, edge=PAPER, lw=0.8)
    draw_way(axes, trace.tip[rows], SEEN, ORANGE)
    for place in figurine.joints(trace.q[picked[-1]]):
        axes.plot(place[0], place[1], "o", ms=4.5, mfc=PAPER, mec=INK, mew=0.9, zorder=9)
    axes.plot(*data.goals[k], "*", ms=16, mfc=ORANGE, mec=INK, mew=0.9, zorder=12)
    framed(axes, (LEFT - 0.09, RIGHT + 0.09), (BELOW - 0.09, ABOVE + 0.09), None)
    axes.set_title(f"Goal {k + 1}", pad=4)


def _clearance(axes: Axes, data: Data) -> None:
    trace = data.trace
    t, d = thinned(trace.time, 1e3 * trace.least())
    axes.plot(t, d, color=FRONT, lw=2.0)
    avoid = trace.robot.avoid
    level(axes, 1e3 * avoid.rho_min, "clearance", RED)
    level(axes, 1e3 * avoid.rho0, "influence", BLUE)
    arrivals(axes, trace, 6.0)
    for k, goal in enumerate(trace.scenario.goal):
        note(axes, goal.at_s + 0.06, 134, f"goal {k + 1}", va="top")
    axes.set_ylim(0.0, 140.0)
    axes.set_xlim(0.0, trace.time[-1])
    axes.set_xlabel("time [s]")
    axes.set_ylabel("clearance [mm]")

"""The paper's robot, a PUMA 560, reaches around obstacles: two views, stroboscopic (Khatib 1986)."""

from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rtctl.experiment.drawing import draw_arm, draw_shapes, draw_strobes, draw_way, framed, strobes
from rtctl.experiment.outline import Figurine, Projection, axis_view, view
from rtctl.experiment.scene import Say, Trace, unsaid
from rtctl.experiment.style import BLUE, FAINT, FRONT, GREEN, INK, ORANGE, PAPER, RED, level, page, thinned
from rtctl.experiment.tour import arrivals, leg, numbers, tour
from rtctl.plain import Json

TITLE = "A PUMA 560 reaches around obstacles"
CAPTION = "the paper's robot among a post, a ball and a crate: from the side, from above, and its clearances"
START = (0.9, 0.6, -2.6, 0.0, 0.8, 0.0)  # [rad]
GOALS = ((0.60, -0.50, 0.72), (0.24, -0.75, 0.95))  # [m]
EVERY = 4.0  # [s] a goal
FRAMES = 6
OBLIQUE = view(np.radians(-14.0), np.radians(26.0))
ABOVE = axis_view(0, 1)

OBSTACLES: tuple[Json, ...] = (
    {"name": "floor", "type": "plane", "position_m": [0.0, 0.0, 0.0]},
    {"name": "ball", "type": "sphere", "radius_m": 0.13, "position_m": [0.62, 0.02, 0.66]},
    {"name": "post", "type": "capsule", "radius_m": 0.05, "length_m": 0.95, "position_m": [0.42, -0.74, 0.475]},
    {"name": "crate", "type": "box", "size_m": [0.3, 0.3, 0.45], "position_m": [0.62, 0.5, 0.225]},
)


class Data(NamedTuple):
    """What the figure shows."""

    trace: Trace
    goals: tuple[tuple[float, float, float], ...]


def run(say: Say = unsaid, goals: tuple[tuple[float, float, float], ...] = GOALS) -> Data:
    """Play the goals one after the other."""
    return Data(tour("puma560", goals, EVERY, OBSTACLES, say, START), goals)


def figures(data: Data) -> Json:
    """Return the numbers of the figure."""
    return numbers(data.trace)


def draw(data: Data) -> Figure:
    """Return the figure: the arm from the side and from above, and its clearances."""
    trace, f = data.trace, data.trace.figures
    figure = page(
        "A PUMA 560 reaches over a ball and around a post",
        f"{1e3 * f['min_clearance_m']['all']:.0f} mm clear at the least, {f['contacts']} contacts, "
        f"top speed {f['max_speed_m_s']:.2f} m/s",
        size=(11.0, 6.4),
    )
    figurine = Figurine(trace.robot.body)
    for k, title in enumerate(("1: over the ball", "2: around the post")):
        if k < len(data.goals):
            axes = figure.add_axes((0.005 + 0.33 * k, 0.36, 0.33, 0.49))
            _drawing(axes, data, figurine, OBLIQUE, k, k)
            framed(axes, (-0.80, 0.97), (-0.39, 1.14), None)
            axes.text(0.03, 0.94, title, transform=axes.transAxes, fontsize=13.5, fontweight="bold")
    above = figure.add_axes((0.67, 0.36, 0.325, 0.49))
    _drawing(above, data, figurine, ABOVE, 0, len(data.goals) - 1)
    framed(above, (-0.62, 1.08), (-0.87, 0.71), None)
    above.text(0.03, 0.94, "both from above", transform=above.transAxes, fontsize=13.5, fontweight="bold")
    _clearance(figure.add_axes((0.075, 0.1, 0.91, 0.235)), data)
    return figure


def _drawing(axes: Axes, data: Data, figurine: Figurine, seen: Projection, first: int, last: int) -> None:
    """Draw legs in one view: obstacles behind the arm, frames from light to dark, the way of the tip."""
    trace = data.trace
    rows = leg(trace, first, last)
    solids = [s for s in trace.shapes(0.0) if s.type != "plane"]
    draw_shapes(axes, sorted(solids, key=lambda s: float(s.position @ seen.toward)), seen)
    picked = rows.start + strobes(trace.q[rows], FRAMES)
    draw_strobes(axes, figurine, trace, picked[:-1], seen)
    draw_arm(axes, figurine, trace.q[picked[-1]], seen, FRONT, 6.5, edge=PAPER, lw=0.8)
    draw_way(axes, trace.tip[rows], seen, ORANGE)
    for goal in data.goals[first : last + 1]:
        axes.plot(*seen.of(np.array(goal)), "*", ms=16, mfc=ORANGE, mec=INK, mew=0.9, zorder=12)


def _clearance(axes: Axes, data: Data) -> None:
    trace = data.trace
    for (name, d), colour in zip(trace.clearance.items(), (FAINT, BLUE, RED, GREEN), strict=False):
        if name != "floor":
            axes.plot(*thinned(trace.time, 1e3 * d), color=colour, lw=1.9, label=name)
    level(axes, 1e3 * trace.robot.avoid.rho_min, "clearance", RED)
    arrivals(axes, trace, 8.0)
    axes.set_ylim(0.0, 300.0)
    axes.set_xlim(0.0, trace.time[-1])
    axes.set_xlabel("time [s]")
    axes.set_ylabel("clearance [mm]")
    axes.legend(loc="upper right", fontsize=11, handlelength=1.2, borderaxespad=0.0, ncols=3, columnspacing=1.4)

"""A ball passes through the place where the arm holds its tip: it yields, keeps clear, and comes back."""

from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rtctl.experiment.drawing import draw_arm, draw_shapes, draw_way, framed
from rtctl.experiment.outline import Figurine, view
from rtctl.experiment.scene import Say, Trace, config_file, played, unsaid
from rtctl.experiment.style import BLUE, FAINT, FRONT, INK, ORANGE, RED, SKY, level, page, thinned
from rtctl.plain import Json
from rtctl.types import F64

TITLE = "A moving obstacle passes"
CAPTION = "a ball drifts through the held tip of a Panda: still frames, and clearance and error over time"
HOLD = np.array([0.50, 0.0, 0.45])  # [m]
SPEED, RADIUS = 0.25, 0.08  # [m/s] half of v_max; [m]
FROM, TO = 0.95, -0.60  # [m] y of the ball's way
AT_X, AT_Z, LEAVES = 0.55, 0.53, 1.0  # [m], [m], [s]
AFTER = 0.8  # [s] shown after the ball has gone
SEEN = view(np.radians(20.0), np.radians(16.0))


class Data(NamedTuple):
    """What the figure shows."""

    trace: Trace
    times: F64  # (4,) [s] of the still frames, the third when the tip has yielded most
    gone: float  # [s] when the ball is at the end of its way


def run(say: Say = unsaid, speed: float = SPEED) -> Data:
    """Let the ball pass at `speed` [m/s]."""
    gone = LEAVES + (FROM - TO) / speed
    scenario = {
        "duration_s": gone + AFTER,
        "goal": [{"at_s": 0.3, "position_m": HOLD.tolist()}],
        "obstacle": [
            {
                "name": "ball",
                "type": "sphere",
                "radius_m": RADIUS,
                "waypoints": [[0.0, AT_X, FROM, AT_Z], [LEAVES, AT_X, FROM, AT_Z], [gone, AT_X, TO, AT_Z]],
            }
        ],
    }
    trace = played(scenario, config_file("panda"), say)
    away = np.linalg.norm(trace.tip - HOLD, axis=1) * (trace.time > LEAVES + 1.0)
    yielded = float(trace.time[int(np.argmax(away))])
    return Data(trace, yielded + np.array([-2.0, -0.6, 0.0, 0.9]), gone)


def figures(data: Data) -> Json:
    """Return the numbers of the figure."""
    trace, f = data.trace, data.trace.figures
    error = np.linalg.norm(trace.tip - HOLD, axis=1)
    return {
        "ball_speed_m_s": SPEED,
        "min_clearance_m": f["min_clearance_m"]["ball"],
        "contacts": f["contacts"],
        "yielded_m": float(error[trace.time > LEAVES + 1.0].max()),
        "error_after_m": float(error[-1]),
        "arrived": f["arrived"],
        "max_speed_m_s": f["max_speed_m_s"],
        "max_torque_ratio": f["max_torque_ratio"],
        "faults": f["faults"],
    }


def draw(data: Data) -> Figure:
    """Return the figure: four moments above, clearance and error below."""
    numbers = figures(data)
    figure = page(
        "A ball drifts through the place the arm holds",
        f"{SPEED} m/s, half the arm's own limit: {1e3 * numbers['min_clearance_m']:.0f} mm clear at the least, "
        f"{1e3 * numbers['error_after_m']:.1f} mm off when it has gone",
        size=(11.0, 6.4),
    )
    figurine = Figurine(data.trace.robot.body)
    for k, t in enumerate(data.times):
        axes = figure.add_axes((0.005 + 0.2475 * k, 0.37, 0.2475, 0.49))
        _moment(axes, data, figurine, float(t))
    _course(figure.add_axes((0.075, 0.105, 0.91, 0.235)), data)
    return figure


def _moment(axes: Axes, data: Data, figurine: Figurine, t: float) -> None:
    trace = data.trace
    row = trace.row(t)
    ghosts = [s for k in range(1, 4) for s in trace.shapes(t - 0.45 * k)]
    draw_shapes(axes, reversed(ghosts), SEEN, colour=ORANGE, alpha=0.22, zorder=2.0)
    ball = trace.shapes(t)[0]
    front = float(ball.position @ SEEN.toward) > float(trace.tip[row] @ SEEN.toward)
    draw_arm(axes, figurine, trace.q[row], SEEN, "#8FB3D3", 5.0, edge=FRONT, lw=0.9)
    draw_shapes(axes, [ball], SEEN, colour=ORANGE, zorder=7.0 if front else 3.0)
    draw_way(axes, trace.tip[trace.rows(max(t - 1.2, 0.0), t)], SEEN, RED, lw=1.8)
    axes.plot(*SEEN.of(HOLD), "+", ms=13, mec=INK, mew=2.0, zorder=12)
    framed(axes, (-0.50, 0.34), (-0.12, 0.84), None)
    axes.text(-0.48, 0.80, f"{t:.1f} s", fontsize=14, fontweight="bold", va="top")


def _course(axes: Axes, data: Data) -> None:
    trace, avoid = data.trace, data.trace.robot.avoid
    error = np.linalg.norm(trace.tip - HOLD, axis=1)
    axes.plot(*thinned(trace.time, 1e3 * trace.clearance["ball"]), color=ORANGE, label="arm to ball, by pybullet")
    axes.plot(*thinned(trace.time, 1e3 * error), color=BLUE, label="tip to where it holds")
    level(axes, 1e3 * avoid.rho_min, "clearance", RED)
    level(axes, 1e3 * avoid.rho0, "influence", SKY)
    for t in data.times:
        axes.axvline(float(t), color=FAINT, lw=1.0, zorder=1)
    axes.set_ylim(0.0, 260.0)
    axes.set_xlim(1.5, trace.time[-1])
    axes.set_xlabel("time [s]")
    axes.set_ylabel("[mm]")
    axes.legend(loc="upper center", bbox_to_anchor=(0.525, 1.06), ncols=1, borderaxespad=0.0)

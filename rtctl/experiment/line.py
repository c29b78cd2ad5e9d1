"""Straight lines under a speed limit: a Panda through the whole pipe, from goal to goal in free space (eq. 8)."""

from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rtctl.experiment.scene import Say, Trace, config_file, played, unsaid
from rtctl.experiment.style import INK, RED, SERIES, level, note, page, thinned
from rtctl.plain import Json
from rtctl.types import F64

TITLE = "Straight lines under a speed limit"
CAPTION = "a Panda's tip from goal to goal: off the line, speed, exponential approach"
GOALS = ((0.50, 0.35, 0.40), (0.55, -0.30, 0.30), (0.35, -0.40, 0.65), (0.45, 0.20, 0.55))  # [m]
FIRST, EVERY = 0.5, 2.6  # [s] when goals are given
CLOSE = 5e-4  # [m] below it the drives' quantisation is what one sees


class Leg(NamedTuple):
    """The way to one goal, a row a period since it was given."""

    t: F64  # (T,) [s] since then
    along: F64  # (T,) [m] along the straight line
    off: F64  # (T,) [m] from it
    speed: F64  # (T,) [m/s]
    error: F64  # (T,) [m] to the goal
    length: float  # [m]


class Data(NamedTuple):
    """What the figure shows."""

    legs: list[Leg]
    v_max: float  # [m/s]
    omega: float  # [1/s] sqrt(k_p): pole of the critically damped unit mass
    top_speed: float  # [m/s] of the whole run
    contacts: int


def run(say: Say = unsaid, goals: tuple[tuple[float, float, float], ...] = GOALS) -> Data:
    """Play the goals one after the other."""
    trace = played(
        {
            "duration_s": FIRST + EVERY * len(goals),
            "goal": [{"at_s": FIRST + EVERY * k, "position_m": list(g)} for k, g in enumerate(goals)],
        },
        config_file("panda"),
        say,
    )
    legs = [_leg(trace, FIRST + EVERY * k, np.array(goal)) for k, goal in enumerate(goals)]
    motion = trace.robot.motion
    return Data(
        legs, motion.v_max, float(np.sqrt(motion.k_p)), trace.figures["max_speed_m_s"], trace.figures["contacts"]
    )


def _leg(trace: Trace, at: float, goal: F64) -> Leg:
    rows = trace.rows(at, at + EVERY - 2e-3)
    tip = trace.tip[rows]
    way = goal - tip[0]
    length = float(np.linalg.norm(way))
    offset = tip - tip[0]
    along = offset @ way / length
    off = np.linalg.norm(offset - np.outer(along, way / length), axis=1)
    error = np.linalg.norm(goal - tip, axis=1)
    return Leg(trace.time[rows] - trace.time[rows][0], along, off, trace.speed()[rows], error, length)


def decay(leg: Leg, omega: float) -> tuple[float, float]:
    """Return the rate [1/s] at which the error falls between 20 and 1 mm, and the analytic one over the same span.

    A critically damped unit mass with x'' = -2 w x' - w^2 x that enters at the speed of its slow mode, e' = -k e with
    k = k_p/k_v = w/2, follows e = (e0 + (e0' + w e0) t) exp(-w t).
    """
    inside = (leg.error < 0.020) & (leg.error > 0.001)
    t, e = leg.t[inside], leg.error[inside]
    return float(np.log(e[0] / e[-1]) / (t[-1] - t[0])), _analytic_rate(leg, omega)


def _analytic_rate(leg: Leg, omega: float) -> float:
    t, e = analytic(leg, omega)
    inside = (e < 0.020) & (e > 0.001)
    return float(np.log(e[inside][0] / e[inside][-1]) / (t[inside][-1] - t[inside][0]))


def analytic(leg: Leg, omega: float) -> tuple[F64, F64]:
    """Return (t, e) of the critically damped unit mass from an error of 20 mm on, with its speed there."""
    k = int(np.argmax(leg.error < 0.020))
    t = leg.t[k:]
    e0, slope = leg.error[k], float(np.gradient(leg.error, leg.t)[k])
    s = t - t[0]
    return t, (e0 + (slope + omega * e0) * s) * np.exp(-omega * s)


def figures(data: Data) -> Json:
    """Return the numbers of the figure."""
    rates = [decay(leg, data.omega) for leg in data.legs]
    return {
        "v_max_m_s": data.v_max,
        "top_speed_m_s": data.top_speed,
        "line_deviation_m": [float(leg.off.max()) for leg in data.legs],
        "final_error_m": [float(leg.error[-1]) for leg in data.legs],
        "length_m": [leg.length for leg in data.legs],
        "decay_1_s": [measured for measured, _ in rates],
        "decay_analytic_1_s": [wanted for _, wanted in rates],
        "contacts": data.contacts,
    }


def draw(data: Data) -> Figure:
    """Return the figure."""
    off = max(float(leg.off.max()) for leg in data.legs)
    figure = page(
        "Straight to the goal, never faster than allowed",
        f"Panda through the whole pipe, CAN bytes included: {1e3 * off:.1f} mm off the line at most, "
        f"top speed {data.top_speed:.3f} of {data.v_max} m/s",
    )
    grid = figure.add_gridspec(
        2, 2, left=0.075, right=0.985, top=0.81, bottom=0.1, wspace=0.2, hspace=0.5, width_ratios=(1.15, 1.0)
    )
    _off(figure.add_subplot(grid[0, 0]), data)
    _speed(figure.add_subplot(grid[1, 0]), data)
    _approach(figure.add_subplot(grid[:, 1]), data)
    return figure


def _off(axes: Axes, data: Data) -> None:
    for k, (leg, colour) in enumerate(zip(data.legs, SERIES, strict=False)):
        axes.plot(*thinned(leg.along, 1e3 * leg.off), color=colour, lw=1.8, label=f"{k + 1}")
    axes.set_ylim(0.0, 1.5 * max(1e3 * float(leg.off.max()) for leg in data.legs))
    axes.set_xlim(left=0.0)
    axes.grid(True)
    axes.set_xlabel("way along the line [m]")
    axes.set_ylabel("off the line [mm]")
    axes.set_title("Path against the line")
    axes.legend(
        loc="upper right",
        ncols=4,
        title="goal",
        alignment="right",
        handlelength=1.2,
        columnspacing=1.0,
        borderaxespad=0.0,
    )


def _speed(axes: Axes, data: Data) -> None:
    for leg, colour in zip(data.legs, SERIES, strict=False):
        axes.plot(*thinned(leg.t, leg.speed), color=colour, lw=1.8)
    level(axes, data.v_max, "v max")
    axes.set_ylim(0.0, 1.3 * data.v_max)
    axes.set_xlim(0.0, 2.0)
    axes.grid(True)
    axes.set_xlabel("since the goal was given [s]")
    axes.set_ylabel("tip speed [m/s]")
    note(axes, 0.62, 0.17, "slower where a joint would be too fast", fontsize=11, ha="center", va="center")
    axes.set_title("Speed against the limit")


def _approach(axes: Axes, data: Data) -> None:
    for k, (leg, colour) in enumerate(zip(data.legs, SERIES, strict=False)):
        axes.plot(*thinned(leg.t, 1e3 * leg.error), color=colour, lw=2.0)
        t, e = analytic(leg, data.omega)
        shown = e > 2e-5
        axes.plot(
            t[shown],
            1e3 * e[shown],
            color=INK,
            lw=1.3,
            ls=(0, (2, 2)),
            zorder=9,
            label="critically damped unit mass" if k == 0 else None,
        )
    axes.set_yscale("log")
    axes.set_ylim(0.02, 2000.0)
    axes.set_yticks([0.1, 1.0, 10.0, 100.0, 1000.0], ["0.1", "1", "10", "100", "1000"])
    axes.minorticks_off()
    axes.set_xlim(0.0, 2.4)
    axes.grid(True)
    level(axes, 1e3 * CLOSE, "0.5 mm", RED, at=0.01, above=False)
    axes.set_xlabel("since the goal was given [s]")
    axes.set_ylabel("distance to the goal [mm]")
    axes.set_title("Exponential approach")
    axes.legend(loc="upper right")

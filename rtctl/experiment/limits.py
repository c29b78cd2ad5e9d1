"""Joint limits: the hand is asked to turn in place further than joint 7 can; it slows, stops short, and says why."""

from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rtctl.experiment.drawing import draw_arm, draw_strobes, framed, strobes
from rtctl.experiment.outline import Figurine, axis_view
from rtctl.experiment.scene import Say, Trace, config_file, played, unsaid
from rtctl.experiment.style import FAINT, FRONT, INK, ORANGE, PAPER, RED, SERIES, page, thinned
from rtctl.plain import Json

TITLE = "Joint-limit avoidance"
CAPTION = "the hand turns in place: to the edge of joint 7's zone, then beyond its limit, which it never reaches"
PLACE = (0.50, 0.0, 0.40)  # [m]
TURNS = (-1.9, -2.6, 0.0)  # [rad] of the hand about the vertical; joint 7 starts at 0.785 and turns the other way
FIRST, EVERY = 0.5, 5.0  # [s]: two to turn, and two at rest until the controller names what holds it
FRAMES = 6
SEEN = axis_view(0, 1)


class Data(NamedTuple):
    """What the figure shows."""

    trace: Trace
    turns: tuple[float, ...]  # [rad]
    zone: float  # [rad] of the potential before each limit


def run(say: Say = unsaid, turns: tuple[float, ...] = TURNS) -> Data:
    """Ask for one turn of the hand after the other, the tip staying where it is."""
    scenario = {
        "duration_s": FIRST + EVERY * len(turns),
        "goal": [
            {
                "at_s": FIRST + EVERY * k,
                "position_m": list(PLACE),
                "wxyz": [0.0, float(np.cos(0.5 * turn)), float(np.sin(0.5 * turn)), 0.0],
            }
            for k, turn in enumerate(turns)
        ],
    }
    trace = played(scenario, config_file("panda"), say, {"avoid": {"posture": "never", "plan": "never"}})
    return Data(trace, turns, float(trace.robot.limit.rho0.max()))


def diagnoses(data: Data) -> list[tuple[str, str]]:
    """Return the last status of each goal and what it names, as the controller told them."""
    told = data.trace.figures["statuses"]
    ends = [FIRST + EVERY * (k + 1) for k in range(len(data.turns))]
    return [next(((n, d) for t, n, d in reversed(told) if end - EVERY <= t < end), ("moving", "")) for end in ends]


def figures(data: Data) -> Json:
    """Return the numbers of the figure."""
    trace, f = data.trace, data.trace.figures
    robot = trace.robot
    margin = np.minimum(trace.q - robot.q_min, robot.q_max - trace.q)
    return {
        "turn_rad": list(data.turns),
        "joint_7_would_need_rad": [float(robot.home[6] - turn) for turn in data.turns],
        "joint_7_limit_rad": float(robot.q_max[6]),
        "arrived": [g["arrived"] for g in f["goals"]],
        "error_m": [g["error_m"] for g in f["goals"]],
        "error_rad": [g["error_rad"] for g in f["goals"]],
        "diagnosis": [" ".join(d).strip() for d in diagnoses(data)],
        "margin_rad": margin.min(axis=0).tolist(),
        "min_joint_margin_rad": f["min_joint_margin_rad"],
        "zone_rad": data.zone,
        "max_joint_speed_ratio": f["max_joint_speed_ratio"],
        "max_torque_ratio": f["max_torque_ratio"],
        "max_limit_torque_Nm": float(np.abs(trace.tau_limits).max()),
        "faults": f["faults"],
    }


def draw(data: Data) -> Figure:
    """Return the figure: the arm as each goal leaves it, and all joints in their ranges."""
    least = figures(data)["min_joint_margin_rad"]
    figure = page(
        "A turn beyond the stop of joint 7",
        f"The hand turns in place, asked along the orange line; least margin of any joint to its limit {least:.2f} rad",
        size=(11.0, 5.2),
    )
    figurine = Figurine(data.trace.robot.body)
    for k in range(len(data.turns)):
        _hand(figure.add_axes((0.01 + 0.182 * k, 0.19, 0.176, 0.53)), data, figurine, k)
    _joints(figure.add_axes((0.64, 0.14, 0.345, 0.60)), data)
    return figure


def _hand(axes: Axes, data: Data, figurine: Figurine, k: int) -> None:
    """Draw the arm from above where a goal left it, the asked direction of the hand as a line."""
    trace = data.trace
    rows = trace.rows(FIRST + EVERY * k, FIRST + EVERY * (k + 1) - 2e-3)
    picked = rows.start + strobes(trace.q[rows], FRAMES)
    draw_strobes(axes, figurine, trace, picked[:-1], SEEN)
    draw_arm(axes, figurine, trace.q[picked[-1]], SEEN, FRONT, 6.5, edge=PAPER, lw=0.8)
    place, turn = np.array(PLACE[:2]), data.turns[k]
    way = np.array([-np.sin(turn), np.cos(turn)]) * 0.19  # the fingers open along the hand's y
    ends = np.stack([place - way, place + way])
    axes.plot(ends[:, 0], ends[:, 1], color=PAPER, lw=4.5, zorder=10)
    axes.plot(ends[:, 0], ends[:, 1], color=ORANGE, lw=2.4, zorder=11, label="asked")
    word, joint = diagnoses(data)[k]
    axes.text(
        0.0,
        1.04,
        f"{k + 1}: {turn:+.1f} rad" if turn else f"{k + 1}: and back",
        transform=axes.transAxes,
        fontsize=13,
        fontweight="bold",
    )
    words = word if not joint else f"{word}:\n{joint.removeprefix('panda_').partition(' at ')[0]}"
    axes.text(
        0.0, -0.05, words, va="top", transform=axes.transAxes, fontsize=13, color=INK if word == "arrived" else RED
    )
    framed(axes, (0.33, 0.67), (-0.24, 0.24), None)


def _joints(axes: Axes, data: Data) -> None:
    """Draw every joint's place in its range, -1 at the lower limit and 1 at the upper."""
    trace, robot = data.trace, data.trace.robot
    middle, half = 0.5 * (robot.q_min + robot.q_max), 0.5 * (robot.q_max - robot.q_min)
    for k in range(robot.n):
        t, u = thinned(trace.time, (trace.q[:, k] - middle[k]) / half[k])
        bold = k == robot.n - 1
        axes.plot(t, u, color=SERIES[k], lw=3.2 if bold else 1.5, label=f"{k + 1}", zorder=8 if bold else 5)
    band = data.zone / half[-1]
    for low in (-1.0, 1.0 - band):
        axes.axhspan(low, low + band, color=ORANGE, alpha=0.22, lw=0)
    axes.axhspan(1.0, 1.2, color=RED, alpha=0.18, lw=0)
    axes.axhspan(-1.2, -1.0, color=RED, alpha=0.18, lw=0)
    for k in range(len(data.turns)):
        axes.axvline(FIRST + EVERY * k, color=FAINT, lw=1.0, zorder=1)
        axes.text(FIRST + EVERY * k + 0.1, -1.09, f"goal {k + 1}", fontsize=12, va="center")
    axes.text(0.98 * trace.time[-1], 1.09, "beyond the limit", color=RED, fontsize=12, va="center", ha="right")
    axes.text(0.15, 1.0 - 0.5 * band, "zone", color="#9A6A00", fontsize=12, va="center")
    axes.set_ylim(-1.18, 1.18)
    axes.set_yticks([-1.0, 0.0, 1.0], ["lower\nlimit", "middle", "upper\nlimit"])
    axes.set_xlim(0.0, trace.time[-1])
    axes.set_xlabel("time [s]")
    axes.text(0.0, 1.1, "joints in their ranges", transform=axes.transAxes, fontsize=13.5, fontweight="bold")
    axes.legend(
        loc="lower left",
        ncols=7,
        fontsize=11,
        bbox_to_anchor=(-0.02, 0.99),
        handlelength=1.0,
        columnspacing=0.9,
        handletextpad=0.4,
        borderpad=0.1,
    )

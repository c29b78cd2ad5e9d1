"""Goals given one after the other among obstacles: the run, its numbers, and its arrivals in a figure."""

from collections.abc import Sequence
from itertools import pairwise

from matplotlib.axes import Axes

from rtctl.experiment.scene import Say, Trace, config_file, played
from rtctl.experiment.style import FAINT, INK, ORANGE
from rtctl.plain import Json
from rtctl.types import Status

FIRST = 0.5  # [s] the first goal is given
OF_GOAL = ("arrived", "error_m", "time_to_goal_s", "line_deviation_m")
OF_RUN = (
    "min_clearance_m",
    "min_self_clearance_m",
    "contacts",
    "max_speed_m_s",
    "max_torque_ratio",
    "max_joint_speed_ratio",
    "min_joint_margin_rad",
    "faults",
)


def tour(
    config: str,
    goals: Sequence[Sequence[float]],
    every: float,
    obstacles: Sequence[Json],
    say: Say,
    start: Sequence[float] | None = None,
) -> Trace:
    """Return the trace of the robot of a config given a goal [m] `every` seconds, from start [rad] or its home."""
    scenario = {
        "duration_s": FIRST + every * len(goals),
        "goal": [{"at_s": FIRST + every * k, "position_m": list(g)} for k, g in enumerate(goals)],
        "obstacle": list(obstacles),
        **({} if start is None else {"start_q_rad": list(start)}),
    }
    return played(scenario, config_file(config), say)


def numbers(trace: Trace) -> Json:
    """Return the numbers of the tour's figure: lists with a value a goal, and what holds for the whole run."""
    f = trace.figures
    return {**{k: [g[k] for g in f["goals"]] for k in OF_GOAL}, **{k: f[k] for k in OF_RUN}}


def _starts(trace: Trace) -> list[float]:
    """Return when each goal is given, and the end [s]."""
    return [*(g.at_s for g in trace.scenario.goal), trace.scenario.duration_s]


def leg(trace: Trace, first: int, last: int) -> slice:
    """Return the rows between goal `first` being given and the one after `last`."""
    starts = _starts(trace)
    return trace.rows(starts[first], starts[last + 1] - 2e-3)


def arrivals(axes: Axes, trace: Trace, height: float) -> None:
    """Draw over time a line where each goal is given, and a star at `height` where it is reached."""
    for at, until in pairwise(_starts(trace)):
        axes.axvline(at, color=FAINT, lw=1.0, zorder=1)
        reached = trace.time[(trace.status == int(Status.ARRIVED)) & (trace.time > at) & (trace.time < until)]
        if len(reached):
            axes.plot(reached[0], height, "*", ms=13, mfc=ORANGE, mec=INK, mew=0.9, zorder=12, clip_on=False)

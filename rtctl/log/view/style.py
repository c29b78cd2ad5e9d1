"""Colours, axes and marks of the picture of a run; the colours of Okabe and Ito, which all people tell apart."""

from typing import NamedTuple

from matplotlib.axes import Axes

ORANGE, SKY, GREEN, YELLOW = "#E69F00", "#56B4E9", "#009E73", "#F0E442"
BLUE, RED, PURPLE = "#0072B2", "#D55E00", "#CC79A7"
INK, FAINT, PAPER = "#222222", "#9A9A9A", "#FFFFFF"
OBSTACLE_COLOURS = (ORANGE, SKY, GREEN, PURPLE, RED, BLUE, "#8C8C8C", YELLOW)
JOINT_COLOURS = (BLUE, ORANGE, GREEN, RED, PURPLE, SKY, INK)


class Goal(NamedTuple):
    """A goal as it is marked."""

    number: int  # from 1
    position: tuple[float, ...]  # (3,) [m]
    at: float  # [s] robot time when it was asked for
    reached: bool | None = None  # None: nobody judged it


class Notes(NamedTuple):
    """What others than the log say of a run."""

    title: str = ""  # the robot's name where it is empty
    verdict: str = ""  # PASS or FAIL
    words: tuple[str, ...] = ()  # a line below the title; figures of the log where there are none
    goals: tuple[Goal, ...] = ()  # those of the log where there are none
    oracle: tuple[tuple[str, float], ...] = ()  # smallest clearance [m] by obstacle, measured on the true bodies
    lockstep: bool = False  # time waited for the drives: there are no deadlines


def frame(axes: Axes) -> None:
    """Leave two sides of a frame."""
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axes.spines[side].set_color(FAINT)
    axes.tick_params(colors=INK, labelsize=9.5, color=FAINT)
    axes.minorticks_off()
    axes.set_axisbelow(True)


def head(axes: Axes, title: str, unit: str) -> None:
    """Name a panel and its unit."""
    axes.set_title(f"{title} [{unit}]", loc="left", fontsize=11.5, fontweight="bold", color=INK, pad=5)
    axes.grid(axis="y", color="#ECECEC", lw=0.8)
    frame(axes)


def level(axes: Axes, value: float, text: str, colour: str) -> None:
    """Draw a level and name it at the right end of the axes."""
    axes.axhline(value, color=colour, lw=1.2, ls="--")
    box = {"fc": PAPER, "ec": "none", "alpha": 0.8, "pad": 0.6}
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
        bbox=box,
        zorder=9,
    )


def legend(axes: Axes, columns: int) -> None:
    """Put the names of the lines above the axes, at the right."""
    axes.legend(
        loc="lower right",
        bbox_to_anchor=(1.005, 0.985),
        ncols=columns,
        fontsize=9,
        frameon=False,
        handlelength=1.4,
        columnspacing=1.1,
        handletextpad=0.5,
        borderaxespad=0.1,
    )

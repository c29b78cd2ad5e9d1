"""How every figure looks: colours that colour-blind people tell apart (Okabe and Ito), type, axes, and the files."""

from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from rtctl.types import F64

ORANGE, SKY, GREEN, YELLOW = "#E69F00", "#56B4E9", "#009E73", "#F0E442"
BLUE, RED, PURPLE = "#0072B2", "#D55E00", "#CC79A7"
INK, FAINT, PAPER = "#222222", "#8C8C8C", "#FFFFFF"
STONE, PLINTH, FRONT = "#B9B2A6", "#E4E1DC", "#004475"
SERIES = (BLUE, ORANGE, GREEN, RED, PURPLE, SKY, INK)
WIDTH, HEIGHT, DPI = 11.0, 6.6, 100  # [in], [in], [1/in]
LIGHT, DARK = np.array([0.80, 0.88, 0.95]), np.array([0.0, 0.27, 0.46])
COLOURS = 200  # of a PNG
CURVE = 1200  # points of a curve: more than a page shows

RC: Any = {
    "font.family": "DejaVu Sans",
    "font.size": 13.0,
    "axes.titlesize": 13.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.labelsize": 13.0,
    "axes.labelcolor": INK,
    "axes.edgecolor": FAINT,
    "axes.linewidth": 1.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "grid.color": "#E8E8E8",
    "xtick.color": FAINT,
    "ytick.color": FAINT,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "legend.frameon": False,
    "legend.fontsize": 12.0,
    "lines.linewidth": 2.2,
    "lines.solid_capstyle": "round",
    "svg.hashsalt": "rtctl",  # the same figure, the same file
    "svg.fonttype": "none",  # text stays text
    "path.simplify_threshold": 0.3,
}


@contextmanager
def styled() -> Iterator[None]:
    """Draw in the style of these figures."""
    with matplotlib.rc_context(RC):
        yield


def page(title: str, below: str = "", size: tuple[float, float] = (WIDTH, HEIGHT)) -> Figure:
    """Return an empty figure with its headline and a line of words below it."""
    figure = Figure(figsize=size, dpi=DPI, facecolor=PAPER)
    FigureCanvasAgg(figure)
    inch = 1.0 / size[1]
    figure.text(0.025, 1.0 - 0.20 * inch, title, fontsize=18, fontweight="bold", color=INK, va="top")
    if below:
        figure.text(0.025, 1.0 - 0.56 * inch, below, fontsize=13, color=INK, va="top")
    return figure


def saved(figure: Figure, folder: Path, name: str) -> None:
    """Write NAME.png and NAME.svg; equal figures give equal files."""
    full = BytesIO()
    figure.savefig(full, format="png", metadata={"Software": None})
    picture = Image.open(full).convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE)  # a third of the size
    picture.save(folder / f"{name}.png", optimize=True)
    figure.savefig(folder / f"{name}.svg", metadata={"Date": None, "Creator": None})


def shade(part: float) -> tuple[float, float, float]:
    """Return the colour of a moment: light at the start (0), dark at the end (1)."""
    r, g, b = LIGHT + part * (DARK - LIGHT)
    return float(r), float(g), float(b)


def thinned(*columns: F64) -> list[F64]:
    """Return the same rows of each column, few enough for a curve."""
    rows = len(columns[0])
    keep = np.unique(np.linspace(0, rows - 1, min(rows, CURVE)).astype(int))
    return [c[keep] for c in columns]


def note(axes: Axes, x: float, y: float, text: str, colour: str = INK, **more: Any) -> None:
    """Write a word into a drawing, on paper so that it can be read over lines."""
    box = {"fc": PAPER, "ec": "none", "alpha": 0.8, "pad": 1.2}
    axes.text(x, y, text, color=colour, bbox=box, **{"fontsize": 12, "zorder": 20, **more})


def level(axes: Axes, y: float, text: str, colour: str = RED, at: float = 0.99, above: bool = True) -> None:
    """Draw a horizontal bound with its name at a place (0 to 1) along it."""
    axes.axhline(y, color=colour, lw=1.5, ls=(0, (5, 3)), zorder=3)
    axes.annotate(
        text,
        (at, y),
        xycoords=("axes fraction", "data"),
        xytext=(0, 4 if above else -4),
        textcoords="offset points",
        ha="right" if at > 0.5 else "left",
        va="bottom" if above else "top",
        fontsize=12,
        color=colour,
        zorder=20,
    )

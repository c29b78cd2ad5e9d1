"""Pictures of logs: chosen fields over time, and what differs between two runs."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rtctl.errors import LogError
from rtctl.log import schema
from rtctl.log.read.fields import FIELDS, unit_of
from rtctl.log.read.run import Run
from rtctl.log.view.report.slots import slot_names
from rtctl.types import F64

BINS = 1500  # across a picture; more samples are drawn as the band between their smallest and largest
if TYPE_CHECKING:
    from matplotlib.figure import Figure

DPI = 110


def envelope(time: F64, values: F64, bins: int = BINS) -> tuple[F64, F64]:
    """Return (t, v) that draws the same line: of each bin its smallest and largest value, in the order of time.

    values: (N,). NaN and infinities are left out of a bin's extremes, a bin without any number is NaN.
    """
    n = len(time)
    if n <= 2 * bins:
        return time, values
    edges = np.linspace(0, n, bins + 1).astype(np.int64)[:-1]
    finite = np.isfinite(values)
    low = np.minimum.reduceat(np.where(finite, values, np.inf), edges)
    high = np.maximum.reduceat(np.where(finite, values, -np.inf), edges)
    gone = ~np.isfinite(low)
    low[gone] = high[gone] = np.nan
    return np.repeat(time[edges], 2), np.stack([low, high], axis=1).reshape(-1)


def figure(rows: int, width: float = 11.0, height: float = 2.2) -> "tuple[Figure, NDArray[np.object_]]":
    """Return a matplotlib figure and its axes, one below the other."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    return pyplot.subplots(
        rows, 1, sharex=True, squeeze=False, figsize=(width, height * rows + 0.6), layout="constrained"
    )


def save(fig: "Figure", path: Path) -> None:
    """Write a figure as PNG, SVG or PDF by the name's ending. Raises LogError for another."""
    from matplotlib import pyplot

    try:
        fig.savefig(path, dpi=DPI)
    except ValueError:
        raise LogError(f"{path}: got {path.suffix or 'no ending'}, wanted .png, .svg or .pdf") from None
    finally:
        pyplot.close(fig)


def plot(run: Run, names: Sequence[str], path: Path, start: float = 0.0, stop: float = np.inf) -> None:
    """Draw fields of /tick over robot time from `start` to `stop` [s after the log's begin].

    Raises LogError for a field that the log does not have.
    """
    topic = run[schema.TICK].load("time", *names)
    time = topic.field("time") - (topic.field("time")[0] if len(topic) else 0.0)
    rows = (time >= start) & (time <= stop)
    if not rows.any():
        raise LogError(
            f"{run.path}: no tick between {start:g} and {stop:g} s; it lasts {time[-1] if len(time) else 0:.3f} s"
        )
    fig, axes = figure(len(names))
    for ax, name in zip(axes[:, 0], names, strict=True):
        values = topic.field(name)[rows].astype(np.float64).reshape(int(rows.sum()), -1)
        labels = parts_of(run, name, values.shape[1])
        shown = [
            i
            for i in range(values.shape[1])
            if np.isfinite(values[:, i]).any() and (name != "force" or values[:, i].any())
        ]
        for i in shown:
            ax.plot(*envelope(time[rows], values[:, i]), linewidth=0.8, label=labels[i] if labels else None)
        unit = unit_of(name)
        ax.set_ylabel(f"{name}{f' [{unit}]' if unit else ''}")
        ax.set_title(FIELDS[name].text if name in FIELDS else name, fontsize=9, loc="left")
        ax.grid(alpha=0.3)
        if 1 < len(shown) <= 12:
            ax.legend(fontsize=7, loc="upper right", ncols=4)
    axes[-1, 0].set_xlabel("time [s]")
    save(fig, path)


VECTORS = {  # names of the parts of fields that are not one a joint or a slot
    **dict.fromkeys(("x", "xd", "goal", "omega", "goal_axis"), ("x", "y", "z")),
    **dict.fromkeys(("wxyz", "goal_wxyz"), ("w", "x", "y", "z")),
    "F": ("x", "y", "z", "about x", "about y", "about z"),
}


def parts_of(run: Run, name: str, count: int) -> tuple[str, ...]:
    """Return the names of a field's `count` numbers: axes, joints, or the obstacles that had the slots; () for one."""
    header = run.header
    if count == 1:
        return ()
    if len(VECTORS.get(name, ())) == count:
        return VECTORS[name]
    if name in ("rho", "force", "point") and count % max(header.slots, 1) == 0:
        names = slot_names(run)
        each = count // header.slots
        return tuple(text if each == 1 else f"{text} {'xyz'[k]}" for text in names for k in range(each))
    return header.joints if count == len(header.joints) else tuple(f"{name} {i}" for i in range(count))


def plot_pair(
    time: F64,
    groups: Sequence[tuple[str, str, F64, F64]],
    labels: tuple[str, str],
    path: Path,
    parts: Sequence[str] = (),
) -> None:
    """Draw pairs of (name, unit, a, b) and below each pair its difference; a, b: (T,) or (T, k)."""
    fig, axes = figure(2 * len(groups))
    for row, (name, unit, a, b) in enumerate(groups):
        top, bottom = axes[2 * row, 0], axes[2 * row + 1, 0]
        a, b = a.reshape(len(time), -1), b.reshape(len(time), -1)
        for i in range(a.shape[1]):
            colour = f"C{i % 10}"
            first = i == 0
            top.plot(*envelope(time, a[:, i]), color=colour, linewidth=0.8, label=labels[0] if first else None)
            top.plot(
                *envelope(time, b[:, i]), color=colour, linewidth=0.8, linestyle=":", label=labels[1] if first else None
            )
            part = parts[i] if i < len(parts) and a.shape[1] == len(parts) else str(i)
            bottom.plot(*envelope(time, b[:, i] - a[:, i]), color=colour, linewidth=0.8, label=part)
        top.set_ylabel(f"{name} [{unit}]")
        bottom.set_ylabel(f"difference [{unit}]")
        top.legend(fontsize=7, loc="upper right")
        if a.shape[1] > 1:
            bottom.legend(fontsize=7, loc="upper right", ncols=4)
        for ax in (top, bottom):
            ax.grid(alpha=0.3)
    axes[-1, 0].set_xlabel("robot time [s]")
    save(fig, path)

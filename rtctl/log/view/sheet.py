"""The report as one picture, for a page that cannot run a script."""

from pathlib import Path
from typing import Any

import numpy as np

from rtctl.log.view.plot import save
from rtctl.log.view.report.gather import XYZ, Gathered

COLOURS = 96
STATUS = {
    "moving": "#2f6fde", "arrived": "#2a9d5c", "shadowed": "#e0a12b", "local_minimum": "#c9354a",
    "saturated": "#8457c9", "singular": "#d254a3", "limited": "#a9772c",
}  # fmt: skip


def draw(g: Gathered, path: Path) -> None:
    """Draw what was gathered: clearance, error, speed, torque, path, timing."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    fig = pyplot.figure(figsize=(11.0, 8.6), layout="constrained")
    grid = fig.add_gridspec(4, 3)
    f = g.figures
    near = f["smallest_clearance_m"]
    clear = "-" if near is None else f"{near * 1e3:.1f} mm"
    title = f"{g.header.robot}   {f['duration_s']:.1f} s   clearance {clear}   top speed {f['top_speed_m_s']:.3f} m/s"
    faults = sorted({s.name for s in g.faults})
    fig.suptitle(f"{title}   faults {', '.join(faults) or 'none'}", fontsize=11, color="#c62828" if faults else "black")
    have = set(g.bins.names)
    names = [n.removeprefix("rho.") for n in g.bins.names if n.startswith("rho.")]
    _lines(fig.add_subplot(grid[0, :2]), g, [(f"x.{a}", a) for a in XYZ], "tip [m]")
    _lines(fig.add_subplot(grid[1, :2]), g, [("error", "error")], "to the goal [m]", log=True)
    if names:
        ax = fig.add_subplot(grid[2, :2])
        _lines(ax, g, [(f"rho.{n}", n) for n in names], "clearance [m]")
        ax.set_ylim(0.0, 0.6)
    ax = fig.add_subplot(grid[3, :2])
    _lines(ax, g, [(f"tau_sent.{j}", j.rpartition("_")[2]) for j in g.header.joints], "torque sent [Nm]")
    ax.set_xlabel("time [s]")
    if {f"x.{a}" for a in XYZ} <= have:
        _path(fig.add_subplot(grid[:2, 2], projection="3d"), g)
    _timing(fig.add_subplot(grid[2, 2]), g)
    _spectrum(fig.add_subplot(grid[3, 2]), g)
    save(fig, path)
    if path.suffix == ".png":
        _shrink(path)


def _shrink(path: Path) -> None:
    """Write a picture again with few colours: a third of the bytes."""
    from PIL import Image

    with Image.open(path) as image:
        small = image.convert("RGB").quantize(COLOURS)
    small.save(path, optimize=True)


def _lines(ax: Any, g: Gathered, series: list[tuple[str, str]], label: str, log: bool = False) -> None:
    for span in g.statuses:
        ax.axvspan(span.start, span.stop, color=STATUS.get(span.name, "#9aa7b6"), alpha=0.09, linewidth=0)
    for i, (name, text) in enumerate(s for s in series if s[0] in g.bins.names):
        low, high = g.bins.series(name)
        time = np.repeat(g.bins.time, 2)
        ax.plot(time, np.stack([low, high], axis=1).reshape(-1), linewidth=0.8, color=f"C{i}", label=text)
    for span in g.faults:
        ax.axvspan(span.start, span.stop, color="#c62828", alpha=0.3)
    if log:
        ax.set_yscale("log")
        ax.set_ylim(bottom=1e-5)
    ax.set_ylabel(label, fontsize=8)
    ax.tick_params(labelsize=7)
    ax.margins(x=0.0)
    ax.grid(alpha=0.25)
    if len(series) > 1:
        ax.legend(fontsize=6, loc="upper right", ncols=4)


def _path(ax: Any, g: Gathered) -> None:
    tip = [np.mean(g.bins.series(f"x.{a}"), axis=0) for a in XYZ]
    ax.plot(*tip, linewidth=0.9, color="#2f6fde")
    for i, goal in enumerate(g.goals[:30]):
        ax.scatter(*goal, s=16, facecolors="none", edgecolors="black", linewidths=0.8)
        ax.text(*goal, f" {i + 1}", fontsize=7)
    ax.set_aspect("equal", adjustable="datalim")
    ax.tick_params(labelsize=6)
    ax.set_title("path of the tip [m]", fontsize=8)


def _timing(ax: Any, g: Gathered) -> None:
    for name, h in (("turn", g.compute), ("lateness", g.lateness)):
        ax.stairs(
            h.counts[1:-1], h.edges * 1e6, fill=True, alpha=0.5, label=f"{name}, p99 {h.quantile(0.99) * 1e6:.0f} µs"
        )
    ax.set_xscale("log")
    ax.set_xlabel("µs", fontsize=7)
    ax.set_ylabel("ticks", fontsize=8)
    ax.tick_params(labelsize=7)
    ax.legend(fontsize=6)


def _spectrum(ax: Any, g: Gathered) -> None:
    if g.spectrum.blocks:
        for row in g.spectrum.amplitude:
            ax.loglog(g.spectrum.frequency[1:], np.maximum(row[1:], 1e-9), linewidth=0.8)
    ax.set_xlabel("Hz", fontsize=7)
    ax.set_ylabel("torque [Nm/√Hz]", fontsize=8)
    ax.tick_params(labelsize=7)
    ax.grid(alpha=0.25)

"""Arms and obstacles on a page: stroboscopic frames as the paper draws them."""

from collections.abc import Iterable, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Polygon

from rtctl.experiment.outline import Figurine, Projection, outline
from rtctl.experiment.scene import Trace
from rtctl.experiment.style import FAINT, INK, PAPER, PLINTH, STONE, shade, thinned
from rtctl.types import F64, I64, Shape

REACH = 4.0  # [m] to which a half space is drawn


def strobes(q: F64, count: int) -> I64:
    """Return `count` rows of q (T, n), first and last included, between which the joints move equally far."""
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(q, axis=0), axis=1))])
    return np.searchsorted(way, np.linspace(0.0, way[-1] * (1.0 - 1e-9), count)).clip(max=len(q) - 1)


def draw_shapes(
    axes: Axes, shapes: Iterable[Shape], seen: Projection, colour: str = STONE, alpha: float = 1.0, zorder: float = 3.0
) -> None:
    """Draw obstacles as solids with an outline."""
    for shape in shapes:
        ring = half_space(shape, seen) if shape.type == "plane" else outline(shape, seen)
        if len(ring):
            axes.add_patch(Polygon(ring, fc=colour, ec="none", alpha=alpha, zorder=zorder))
            axes.add_patch(Polygon(ring, fc="none", ec=INK, lw=1.2, alpha=alpha, zorder=zorder + 0.1))


def half_space(shape: Shape, seen: Projection) -> F64:
    """Return a plane's solid side (4, 2) [m] where it is seen edge on; nothing where it is not."""
    from rtctl.kernel.rotations import R_of

    normal, point = seen.of(R_of(shape.wxyz)[:, 2]), seen.of(shape.position)
    if np.linalg.norm(normal) < 0.9:
        return np.zeros((0, 2))
    along = np.array([-normal[1], normal[0]]) * REACH
    return np.array([point - along, point + along, point + along - normal * REACH, point - along - normal * REACH])


def draw_arm(
    axes: Axes,
    figurine: Figurine,
    q: F64,
    seen: Projection,
    colour: tuple[float, float, float] | str,
    zorder: float,
    edge: str | tuple[float, float, float] = PAPER,
    lw: float = 0.7,
) -> None:
    """Draw the solids of an arm at q (n,), the nearest to the beholder last."""
    for piece in figurine.pieces(q, seen):
        still = piece.link == 0  # the base is the same in every frame
        fc, ec = (PLINTH, FAINT) if still else (colour, edge)
        axes.add_patch(Polygon(piece.polygon, fc=fc, ec=ec, lw=lw, joinstyle="round", zorder=4.0 if still else zorder))


def draw_strobes(
    axes: Axes, figurine: Figurine, trace: Trace, rows: Sequence[int] | I64, seen: Projection, zorder: float = 5.0
) -> None:
    """Draw an arm at several rows of a trace, from light to dark."""
    for k, row in enumerate(rows):
        part = k / max(len(rows) - 1, 1)
        draw_arm(axes, figurine, trace.q[row], seen, shade(part), zorder + part, edge=shade(min(part + 0.35, 1.0)))


def draw_way(axes: Axes, tip: F64, seen: Projection, colour: str, zorder: float = 8.0, lw: float = 2.0) -> None:
    """Draw the path (T, 3) of a tip, on paper so that it can be read over the arm."""
    (points,) = thinned(seen.of(tip))
    axes.plot(points[:, 0], points[:, 1], color=PAPER, lw=lw + 2.0, zorder=zorder)
    axes.plot(points[:, 0], points[:, 1], color=colour, lw=lw, zorder=zorder + 0.1)


def framed(axes: Axes, across: tuple[float, float], up: tuple[float, float], names: tuple[str, str] | None) -> None:
    """Give a drawing its window [m], equal scales, and axes with names; without names it stands by itself."""
    axes.set_aspect("equal")
    axes.set_xlim(*across)
    axes.set_ylim(*up)
    if names is None:
        axes.set_axis_off()
        return
    axes.set_xlabel(f"{names[0]} [m]")
    axes.set_ylabel(f"{names[1]} [m]")

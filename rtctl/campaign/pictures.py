"""A run drawn: played again, seen from the side and from above."""

import base64
from io import BytesIO
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rtctl.campaign.case import Case, source_of
from rtctl.campaign.play import changed, scenario_of, simulated
from rtctl.experiment.outline import Figurine, axis_view
from rtctl.kernel.rotations import R_of
from rtctl.plain import Json
from rtctl.spec.obstacles import shape_of
from rtctl.spec.scenario import Scenario
from rtctl.types import F64, Shape
from rtctl.world.outline import Projection, outline

VIEWS = (("from the side", 0, 2), ("from above", 0, 1))
MARGIN = 0.15  # [m] about what the arm covers
ARM, BLOCK, WAY, GOAL = "#56B4E9", "#999999", "#0072B2", "#D55E00"  # Okabe and Ito
EVERY = 10  # periods between two points of the way that are kept


class Film(NamedTuple):
    """What is drawn of a run."""

    row: Json
    scenario: Scenario
    body: Any  # the arm's rigid body, None of a rover
    tip: F64  # (k, 3) [m]
    q: F64  # (2, n) at the start and at the end
    end: float  # [s]


def film(case: Case) -> Film:
    """Play a run again and keep what a picture of it needs."""
    scene = changed(case, source_of(case.source).scene(case))
    tips: list[F64] = []
    ends: list[F64] = []
    bodies: list[Any] = []
    count = [0, 0.0]

    def watch(servo: Any, truth: Any, turn: Any) -> None:
        arm = hasattr(truth, "tip")
        if count[0] % EVERY == 0:
            tips.append(truth.tip.copy() if arm else np.array([truth.x, truth.y, 0.0]))
        bodies[:] = [servo.robot.body if arm else None]
        ends[1:] = [truth.q.copy()] if arm else []
        if arm and count[0] == 0:
            ends[:] = [truth.q.copy()] * 2
        count[0] += 1
        count[1] = truth.time

    row = simulated(case, scene, watch)
    return Film(row, scenario_of(case, scene), bodies[0], np.array(tips), np.array(ends), float(count[1]))


def drawn(case: Case) -> tuple[str, str]:
    """Return a picture of a run as the source of an <img>, and the digest of what was drawn."""
    shown = film(case)
    figure = Figure(figsize=(7.2, 3.4), layout="constrained")
    for axes, (title, right, up) in zip(figure.subplots(1, 2), VIEWS, strict=True):
        _view(axes, shown, axis_view(right, up), title)
    out = BytesIO()
    figure.savefig(out, format="png", dpi=80)
    return "data:image/png;base64," + base64.b64encode(out.getvalue()).decode(), str(shown.row["digest"])


def _view(axes: Axes, shown: Film, seen: Projection, title: str) -> None:
    covered = [seen.of(shown.tip)]
    if shown.body is not None and len(shown.q):
        figurine = Figurine(shown.body)
        for q, alpha in zip(shown.q, (0.12, 0.45), strict=True):
            for piece in figurine.pieces(q, seen):
                axes.fill(*piece.polygon.T, color=ARM, alpha=alpha, lw=0.4, ec="white")
                covered.append(piece.polygon)
    for obstacle in shown.scenario.obstacle:
        shape = shape_of(obstacle, shown.end)
        if shape.type == "plane":
            _plane(axes, shape, seen)
        else:
            axes.fill(*outline(shape, seen).T, color=BLOCK, alpha=0.35, lw=0.6, ec="black")
    axes.plot(*seen.of(shown.tip).T, color=WAY, lw=1.2)
    for goal in shown.scenario.goal:
        if goal.position_m is not None:
            axes.plot(*seen.of(np.array([goal.position_m]))[0], "+", color=GOAL, ms=10, mew=1.8)
            covered.append(seen.of(np.array([goal.position_m])))
    low, high = (np.concatenate(covered).min(axis=0), np.concatenate(covered).max(axis=0))
    axes.set_xlim(low[0] - MARGIN, high[0] + MARGIN)
    axes.set_ylim(low[1] - MARGIN, high[1] + MARGIN)
    axes.set_aspect("equal")
    axes.set_title(title, fontsize=8)
    axes.tick_params(labelsize=6)


def _plane(axes: Axes, shape: Shape, seen: Projection) -> None:
    """Draw the surface of a plane where it is seen edge on."""
    normal = R_of(shape.wxyz)[:, 2]
    if abs(normal @ seen.toward) > 0.05:
        return
    flat = np.array([normal @ seen.right, normal @ seen.up])
    at = seen.of(shape.position[None])[0]
    along = np.array([-flat[1], flat[0]])
    axes.axline(at, at + along, color="black", lw=0.8)

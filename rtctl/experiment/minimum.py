"""Where the field alone stays: a wall that is escaped over its edge, a bucket that only a planner leads out of."""

import tomllib
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rtctl.experiment.drawing import draw_arm, draw_shapes, draw_strobes, draw_way, framed, strobes
from rtctl.experiment.outline import Figurine, Projection, axis_view
from rtctl.experiment.scene import CONFIGS, Say, Trace, config_file, played, unsaid
from rtctl.experiment.style import BLUE, FRONT, INK, RED, note, page, thinned
from rtctl.plain import Json
from rtctl.types import F64

TITLE = "Local minimum, escape and plan"
CAPTION = "left alone it says what holds it; a wall is escaped over its edge, a bucket left by a planned way"
GOAL = [0.45, -0.25, 0.3]  # [m] beyond the wall
AT = 0.5  # [s] when goals are given
BESIDE = [0.0639, -0.0741, 0.4370, -2.2232, 0.0376, 2.1557, 1.2645]  # [rad] the tip on the other side of it
WALL = {"name": "wall", "type": "box", "size_m": [0.5, 0.02, 0.4], "position_m": [0.45, 0.0, 0.2]}
ESCAPES: dict[str, dict[str, object]] = {"avoid": {"posture": "never", "plan": "never"}}
ALONE: dict[str, dict[str, object]] = {"avoid": {**ESCAPES["avoid"], "escape": False}}
FACING, ASIDE = axis_view(1, 2), axis_view(0, 2)


class Case(NamedTuple):
    """One obstacle, met twice: left alone, and with help."""

    alone: Trace
    helped: Trace
    goal: F64  # (3,) [m]


class Data(NamedTuple):
    """What the figure shows."""

    wall: Case
    trap: Case


def run(say: Say = unsaid, seconds: tuple[float, float, float, float] = (8.0, 8.0, 6.0, 6.0)) -> Data:
    """Play the wall without and with escape, then the trap without and with a planner, so long [s] each."""
    panda = config_file("panda")
    wall = {"start_q_rad": BESIDE, "goal": [{"at_s": AT, "position_m": GOAL}], "obstacle": [WALL]}
    trap = tomllib.loads((CONFIGS / "scenarios" / "trap.toml").read_text(encoding="utf-8"))
    told: list[Json] = [wall, wall, {**trap, "planner": False}, {**trap, "planner": True}]

    def part(k: int) -> Trace:
        scenario = {**told[k], "duration_s": seconds[k]}
        return played(scenario, panda, lambda done: say((k + done) / 4.0), (ALONE, ESCAPES, ALONE, {})[k])

    under = np.array(trap["goal"][0]["position_m"])
    return Data(Case(part(0), part(1), np.array(GOAL)), Case(part(2), part(3), under))


def figures(data: Data) -> Json:
    """Return the numbers of the figure."""
    cases = {"wall": data.wall.alone, "escape": data.wall.helped, "trap": data.trap.alone, "plan": data.trap.helped}
    goals = {"wall": data.wall.goal, "escape": data.wall.goal, "trap": data.trap.goal, "plan": data.trap.goal}
    return {name: _numbers(trace, goals[name]) for name, trace in cases.items()}


def _numbers(trace: Trace, goal: F64) -> Json:
    f = trace.figures
    _, status, detail = f["statuses"][-1]
    return {
        "arrived": f["arrived"],
        "status": status,
        "held_by": detail,
        "error_m": float(np.linalg.norm(trace.tip[-1] - goal)),
        "min_clearance_m": f["min_clearance_m"]["all"],
        "contacts": f["contacts"],
        "max_speed_m_s": f["max_speed_m_s"],
        "faults": f["faults"],
    }


def draw(data: Data) -> Figure:
    """Return the figure: the ways above, the distance to the goal below."""
    numbers = figures(data)
    clear = 1e3 * min(one["min_clearance_m"] for one in numbers.values())
    figure = page(
        "What a field cannot do, and what helps",
        f"left alone the arm rests and names what holds it (red); {clear:.0f} mm clear at the least, no contact",
        size=(11.0, 7.2),
    )
    wall, trap = (figure.add_axes((0.02 + 0.5 * k, 0.34, 0.46, 0.5)) for k in range(2))
    _ways(wall, data.wall, FACING, "Escape: over the wall")
    framed(wall, (-0.62, 0.62), (-0.02, 0.98), None)
    _ways(trap, data.trap, ASIDE, "Plan: out of the bucket, under it")
    framed(trap, (-0.22, 1.00), (-0.04, 1.03), None)
    for k, (case, name) in enumerate(((data.wall, "escape"), (data.trap, "plan"))):
        _course(figure.add_axes((0.075 + 0.5 * k, 0.1, 0.4, 0.19)), case, name)
    return figure


def _ways(axes: Axes, case: Case, seen: Projection, title: str) -> None:
    """Both ways of the tip; the arm where it stayed, and as it went."""
    figurine = Figurine(case.helped.robot.body)
    under = case.helped.time > AT
    draw_shapes(axes, case.helped.shapes(0.0), seen, alpha=0.6, zorder=7.2)
    draw_strobes(axes, figurine, case.helped, strobes(case.helped.q * under[:, None], 6), seen)
    draw_arm(axes, figurine, case.helped.q[-1], seen, FRONT, 7.0, edge="#8FB3D3", lw=0.9)
    draw_way(axes, case.alone.tip, seen, RED, lw=2.4)
    draw_way(axes, case.helped.tip, seen, FRONT, lw=2.0)
    axes.plot(*seen.of(case.alone.tip[-1]), "X", ms=12, color=RED, mec="white", zorder=12)
    axes.plot(*seen.of(case.goal), "*", ms=17, color="#E69F00", mec=INK, zorder=12)
    axes.set_title(title, loc="left", fontsize=14, fontweight="bold")


def _course(axes: Axes, case: Case, name: str) -> None:
    for trace, colour, text in ((case.alone, RED, "left alone"), (case.helped, BLUE, name)):
        gap = 1e3 * np.linalg.norm(trace.tip - case.goal, axis=1)
        axes.plot(*thinned(trace.time, gap), color=colour, label=text)
    _, status, detail = case.alone.figures["statuses"][-1]
    level_at = 1e3 * float(np.linalg.norm(case.alone.tip[-1] - case.goal))
    words = f"{status}: {detail}".replace("; ", ",\n")
    note(axes, case.helped.time[-1], level_at + 55.0, words, RED, ha="right", va="bottom", fontsize=10)
    axes.set_ylim(0.0, 700.0)
    axes.set_xlim(0.0, case.helped.time[-1])
    axes.set_xlabel("time [s]")
    axes.set_ylabel("to the goal [mm]")
    axes.legend(loc="upper right", ncols=2)

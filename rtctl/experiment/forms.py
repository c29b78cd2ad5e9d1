"""The forms of the repulsion side by side: shares of a link or the paper's sum, a mass along n or the whole Lambda."""

from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rtctl import design
from rtctl.arm.field import SUM, TASK, Field, MovingPoints, field, field_buffers
from rtctl.arm.robot import Robot
from rtctl.experiment.scene import Say, Trace, config_file, played, unsaid
from rtctl.experiment.style import BLUE, FAINT, GREEN, INK, ORANGE, RED, level, note, page, thinned
from rtctl.plain import Json
from rtctl.types import F64, Shape
from rtctl.world.primitives import obstacles_empty, with_shape

TITLE = "The forms of the repulsion"
CAPTION = "torques of the default beside the paper's own forms at random postures, and a run with each"
SAMPLES, SEED = 2000, 0
GAP = 0.07  # [m] between a ball and the point it is put beside, at most
LIGHT = 0.1  # [Nm] a torque below it has no direction worth telling
START = (0.7, -0.4, 0.0, -2.2, 0.0, 1.8, 0.8)  # [rad]
GOAL = (0.45, -0.35, 0.45)  # [m]
BALL: Json = {"name": "ball", "type": "sphere", "radius_m": 0.08, "position_m": [0.45, -0.035, 0.445]}
FIRST, LASTS = 0.3, 3.2  # [s]
FORMS = (("blend", "normal"), ("blend", "task"), ("sum", "normal"), ("sum", "task"))
COLOURS = (INK, BLUE, ORANGE, RED)


class Data(NamedTuple):
    """What the figure shows."""

    ratio: F64  # (S,) |torque| of the sum over that of the blend, both along normals
    angle: F64  # (S,) [deg] between the torques of Lambda and of the mass along n, both blended
    size: F64  # (S,) |torque| of Lambda over that of the mass along n
    traces: dict[str, Trace]


def run(
    say: Say = unsaid, samples: int = SAMPLES, forms: tuple[tuple[str, str], ...] = FORMS, lasts: float = LASTS
) -> Data:
    """Compare torques at random postures of the Panda, then play a run with each form."""
    path = config_file("panda")
    config = design.load(path)
    arm = design.build(config, path)
    torques = _sampled(arm, samples)
    size = np.linalg.norm(torques, axis=2)
    kept = size[:, 0] > LIGHT
    torques, size = torques[kept], size[kept]
    cosine = np.einsum("sd,sd->s", torques[:, 0], torques[:, 1]) / (size[:, 0] * size[:, 1])
    angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    traces = {}
    goal = {"at_s": FIRST, "position_m": list(GOAL)}
    scenario = {"duration_s": lasts, "start_q_rad": list(START), "goal": [goal], "obstacle": [BALL]}
    for k, (superposition, inertia) in enumerate(forms):
        say((k + 0.5) / (len(forms) + 0.5))
        keys: dict[str, object] = {"superposition": superposition, "inertia": inertia}
        keys |= {"posture": "never", "plan": "never"}  # the field's own way, not one round what it will meet
        traces[f"{superposition}, {inertia}"] = played(scenario, path, unsaid, {"avoid": keys})
    return Data(size[:, 2] / size[:, 0], angle, size[:, 1] / size[:, 0], traces)


def _sampled(arm: Robot, samples: int) -> F64:
    """Return torques (S, 3, n) of an arm at rest with a ball beside it: as by default, with Lambda, with the sum."""
    rng, still, m = np.random.default_rng(SEED), np.zeros(arm.n), len(arm.points.radius)
    out, torques = field_buffers(1, m, arm.n), np.empty((samples, 3, arm.n))
    for s in range(samples):
        model = arm.body.evaluate(rng.uniform(arm.q_min, arm.q_max), still, arm.points)
        points = MovingPoints(model.P, model.Jp, model.B, arm.points.radius, arm.points.link)
        j, radius, away = int(rng.integers(m)), float(rng.uniform(0.03, 0.15)), rng.normal(size=3)
        off = radius + arm.points.radius[j] + float(rng.uniform(0.0, GAP))
        table = with_shape(obstacles_empty(1), 0, _ball(model.P[j] + off * away / np.linalg.norm(away), radius))
        for k, forms in enumerate((0, TASK, SUM)):
            field(points, still, still, table, arm.avoid._replace(forms=float(forms)), out, True)
            torques[s, k] = _tau(out)
    return torques


def _tau(out: Field) -> F64:
    return out.tau


def _ball(centre: F64, radius: float) -> Shape:
    zero = np.zeros(3)
    return Shape(
        "ball", "sphere", np.array([radius, 0.0, 0.0, 0.0]), centre, np.array([1.0, 0.0, 0.0, 0.0]), zero, zero
    )


def figures(data: Data) -> Json:
    """Return the numbers of the figure."""

    def spread(values: F64) -> Json:
        low, median, high = np.percentile(values, (5.0, 50.0, 95.0))
        return {"p5": low, "median": median, "p95": high, "worst": values.max()}

    return {
        "samples": len(data.ratio),
        "sum_over_blend": spread(data.ratio),
        "task_over_normal": spread(data.size),
        "task_to_normal_deg": spread(data.angle),
        "runs": [{"form": name, **_of_run(trace)} for name, trace in data.traces.items()],
    }


def _of_run(trace: Trace) -> Json:
    f = trace.figures
    keys = ("arrived", "time_to_goal_s", "contacts", "max_torque_ratio", "max_speed_m_s", "faults")
    least = {"min_clearance_m": f["min_clearance_m"]["all"], "max_force_N": float(trace.force.max())}
    return {**{k: f[k] for k in keys}, **least}


def draw(data: Data) -> Figure:
    """Return the figure: how torques differ, and the runs."""
    figure = page(
        "The repulsion's forms: the default beside the paper's own",
        f"Panda, {len(data.ratio)} random postures, each with a ball up to {1e3 * GAP:.0f} mm off a point of the arm; "
        "then one run with each form",
        size=(11.0, 8.6),
    )
    grid = figure.add_gridspec(2, 2, left=0.075, right=0.985, top=0.865, bottom=0.075, wspace=0.2, hspace=0.36)
    _ratios(figure.add_subplot(grid[0, 0]), data.ratio)
    _angles(figure.add_subplot(grid[0, 1]), data.angle)
    _clearances(figure.add_subplot(grid[1, 0]), data.traces)
    _pushes(figure.add_subplot(grid[1, 1]), data.traces)
    return figure


def _ratios(axes: Axes, ratio: F64) -> None:
    axes.hist(ratio, bins=np.geomspace(0.5, 20.0, 46).tolist(), color=ORANGE)
    axes.set_xscale("log")
    axes.set_xticks([0.5, 1, 2, 5, 10, 20], ["0.5", "1", "2", "5", "10", "20"])
    axes.minorticks_off()
    _median(axes, float(np.median(ratio)), f"median {np.median(ratio):.1f}")
    axes.set_xlabel("torque of the sum over that of the blend")
    axes.set_ylabel("postures")
    axes.set_title("The plain sum: how much harder")


def _angles(axes: Axes, angle: F64) -> None:
    axes.hist(angle, bins=np.linspace(0.0, 90.0, 46).tolist(), color=BLUE)
    _median(
        axes, float(np.median(angle)), f"median {np.median(angle):.0f} deg; 95 % {np.percentile(angle, 95):.0f} deg"
    )
    axes.set_xlim(0.0, 90.0)
    axes.set_xlabel("angle between the two torques [deg]")
    axes.set_title(r"The whole $\Lambda$: how turned")


def _median(axes: Axes, at: float, text: str) -> None:
    axes.axvline(at, color=INK, lw=1.6, ls=(0, (5, 3)))
    top = axes.get_ylim()[1]
    note(axes, at * 1.05 + 0.01, 0.96 * top, text, INK, ha="left", va="top")


def _clearances(axes: Axes, traces: dict[str, Trace]) -> None:
    for (name, trace), colour in zip(traces.items(), COLOURS, strict=False):
        axes.plot(*thinned(trace.time, 1e3 * trace.least()), color=colour, lw=1.9, label=name)
    first = next(iter(traces.values()))
    level(axes, 1e3 * first.robot.avoid.rho_min, "clearance", GREEN)
    axes.set_ylim(0.0, 200.0)
    axes.set_xlim(0.0, first.time[-1])
    axes.set_xlabel("time [s]")
    axes.set_ylabel("clearance, by pybullet [mm]")
    axes.set_title("Around a ball: clearance")
    axes.legend(loc="upper right", fontsize=11, handlelength=1.2, borderaxespad=0.0)


def _pushes(axes: Axes, traces: dict[str, Trace]) -> None:
    for (name, trace), colour in zip(traces.items(), COLOURS, strict=False):
        axes.plot(*thinned(trace.time, trace.force), color=colour, lw=1.9, label=name)
    first = next(iter(traces.values()))
    axes.axhline(0.0, color=FAINT, lw=1.0)
    axes.set_xlim(0.0, first.time[-1])
    axes.set_xlabel("time [s]")
    axes.set_ylabel("force of the ball [N]", labelpad=2)
    axes.set_title("Around a ball: what it pushes with")

"""A point mass in the FIRAS field of an ellipsoid, a cylinder and a cone: equipotentials and paths (Khatib 1986)."""

from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon

from rtctl.control.firas import FieldParams, field_params
from rtctl.experiment.mass import Flight, Mass, motion_params, obstacles_of, potential, turning_distance
from rtctl.experiment.outline import axis_view, outline
from rtctl.experiment.scene import Say, unsaid
from rtctl.experiment.style import BLUE, GREEN, INK, ORANGE, PAPER, RED, STONE, note, page
from rtctl.kernel.rotations import R_of
from rtctl.plain import Json
from rtctl.types import F64, Shape
from rtctl.world.primitives import distance

TITLE = "A point mass in the field of an ellipsoid, a cylinder and a cone"
CAPTION = "equipotentials, paths to a goal, and where energy lets a mass turn"
DT = 1e-3  # [s]
V_MAX, A_MAX, K_P = 0.5, 5.0, 200.0
INFLUENCE, CLEARANCE = 0.20, 0.02  # [m]
GOAL = np.array([0.62, 0.0, -0.05])
STARTS = (-0.42, -0.22, -0.10, 0.12, 0.24, 0.42)  # [m] heights from which masses set out
SPEEDS = (0.1, 0.2, 0.35, 0.5, 0.7, 1.0)  # [m/s] at which one is thrown at the surface
THROW = -0.45  # [m] where a thrown mass starts
HALF = 0.75, 0.56  # [m] of the window
SEEN = axis_view(0, 2)
TILT = -0.45  # [rad] of the cylinder: a face square to the way to the goal would hold a mass for ever


def _shape(kind: str, dims: tuple[float, ...], tilt: float = 0.0) -> Shape:
    zero, turned = np.zeros(3), np.array([np.cos(0.5 * tilt), 0.0, np.sin(0.5 * tilt), 0.0])
    return Shape(kind, kind, np.array([*dims, 0.0, 0.0, 0.0, 0.0])[:4], zero, turned, zero, zero)


# each with the way (3,) from which a mass meets it square, in its own frame
SHAPES = (
    (_shape("ellipsoid", (0.26, 0.2, 0.16)), np.array([1.0, 0.0, 0.0])),
    (_shape("cylinder", (0.16, 0.2), TILT), np.array([1.0, 0.0, 0.0])),
    (_shape("cone", (0.22, 0.0, 0.22)), np.array([0.0, 0.0, 1.0])),
)


class Case(NamedTuple):
    """One obstacle and the masses that met it."""

    shape: Shape
    paths: list[Flight]  # to the goal
    throw: Flight  # without goal and damping, at V_MAX, slanting
    heights: F64  # (k,) where straight throws turned [m], by SPEEDS
    energy: float  # largest change of v^2/2 + U on the slanting throw, of its start's


class Data(NamedTuple):
    """What the figure shows."""

    params: FieldParams
    cases: list[Case]
    speeds: F64  # (k,) [m/s]


def run(say: Say = unsaid, starts: tuple[float, ...] = STARTS, speeds: tuple[float, ...] = SPEEDS) -> Data:
    """Let masses fly: to the goal from each of `starts` [m], and straight at the surface at each of `speeds` [m/s]."""
    params = field_params(V_MAX, INFLUENCE, CLEARANCE, DT, 1.0, 0.0, 1e3)
    free = params._replace(k_d=0.0)  # damping takes energy out: without it energy is kept
    motion = motion_params(V_MAX, A_MAX, K_P)
    cases = []
    for number, (shape, way) in enumerate(SHAPES):
        table = obstacles_of(shape)
        mass, undamped = Mass(table, params, DT), Mass(table, free, DT)
        paths = []
        for k, z in enumerate(starts):
            start = np.array([-0.62, 0.0, z])
            paths.append(mass.fly(start, np.zeros(3), 6.0, GOAL, motion))
            say((number + (k + 1) / len(starts) * 0.8) / len(SHAPES))
        throw = undamped.fly(np.array([THROW, 0.0, 0.30]), np.array([0.42, 0.0, -0.27]), 2.6)
        least = np.array([_straight(undamped, R_of(shape.wxyz) @ way, v).least for v in speeds])
        cases.append(Case(shape, paths, throw, least, _drift(throw, free)))
    return Data(params, cases, np.array(speeds))


def _straight(mass: Mass, way: F64, speed: float) -> Flight:
    """Return the flight straight at the middle of the solid: in, and on the way out again."""
    return mass.fly(-0.6 * way, speed * way, 0.8 / speed)


def _drift(flight: Flight, params: FieldParams) -> float:
    E = 0.5 * (flight.v**2).sum(axis=1) + potential(flight.rho, params)
    return float(np.abs(E - E[0]).max() / E[0])


def figures(data: Data) -> Json:
    """Return the numbers of the figure."""
    turning = np.array([turning_distance(float(v), data.params) for v in data.speeds])
    return {
        "v_max_m_s": V_MAX,
        "influence_m": INFLUENCE,
        "clearance_m": CLEARANCE,
        "eta_m4_s2": data.params.eta,
        "speeds_m_s": data.speeds.tolist(),
        "turning_distance_m": turning.tolist(),
        "shapes": {
            c.shape.type: {
                "clearance_m": [p.least for p in c.paths],
                "goal_error_m": [float(np.linalg.norm(p.x[-1] - GOAL)) for p in c.paths],
                "top_speed_m_s": [float(np.linalg.norm(p.v, axis=1).max()) for p in c.paths],
                "turned_at_m": c.heights.tolist(),
                "turning_error_m": float(np.abs(c.heights - turning).max()),
                "energy_drift": c.energy,
            }
            for c in data.cases
        },
    }


def draw(data: Data) -> Figure:
    """Return the figure."""
    figure = page(
        "A point mass in the artificial potential field",
        f"FIRAS round three solids: speed limit {V_MAX} m/s, influence {100 * INFLUENCE:.0f} cm, "
        f"clearance {100 * CLEARANCE:.0f} cm; kernels of the servo at 1 kHz",
        size=(11.0, 9.6),
    )
    grid = figure.add_gridspec(2, 2, left=0.075, right=0.985, top=0.885, bottom=0.07, wspace=0.17, hspace=0.24)
    for k, case in enumerate(data.cases):
        _map(figure.add_subplot(grid[k // 2, k % 2]), data.params, case)
    _turning(figure.add_subplot(grid[1, 1]), data)
    return figure


def _map(axes: Axes, params: FieldParams, case: Case) -> None:
    """Draw one solid in its plane of symmetry, the potential round it, and the paths."""
    across, up = np.linspace(-HALF[0], HALF[0], 301), np.linspace(-HALF[1], HALF[1], 225)
    X, Z = np.meshgrid(across, up)
    P = np.stack([X.ravel(), np.zeros(X.size), Z.ravel()], axis=1)
    U = potential(distance(case.shape, P)[0], params).reshape(X.shape)
    full = 0.5 * V_MAX**2
    levels = [0.0, *(full * np.array([0.002, 0.01, 0.03, 0.1, 0.3, 1.0])), 1e9]
    tints = ListedColormap([PAPER, "#F3F7FB", "#E3EDF6", "#CFE0F0", "#B5CEE6", "#94B8DA", "#6F9FCB"])
    axes.contourf(across, up, np.minimum(U, 1e8), levels=levels, colors=tints.colors, zorder=0)
    axes.contour(across, up, np.minimum(U, 1e8), levels=levels[1:-1], colors="#7FA6CC", linewidths=0.7, zorder=1)
    axes.add_patch(Polygon(outline(case.shape, SEEN), fc=STONE, ec=INK, lw=1.4, zorder=4))
    for path in case.paths:
        axes.plot(path.x[:, 0], path.x[:, 2], color=BLUE, lw=2.0, zorder=6)
        axes.plot(path.x[0, 0], path.x[0, 2], "o", ms=5, mfc=PAPER, mec=BLUE, mew=1.6, zorder=7)
    axes.plot(case.throw.x[:, 0], case.throw.x[:, 2], color=RED, lw=1.8, ls=(0, (4, 2)), zorder=6)
    axes.plot(GOAL[0], GOAL[2], marker="*", ms=17, mfc=ORANGE, mec=INK, mew=0.9, zorder=9)
    axes.set_aspect("equal")
    axes.set_xlim(-HALF[0], HALF[0])
    axes.set_ylim(-HALF[1], HALF[1])
    axes.set_xlabel("x [m]")
    axes.set_ylabel("z [m]")
    axes.set_title(case.shape.type.capitalize())
    if case.shape.type == "ellipsoid":
        handles = [Line2D([], [], color=BLUE, lw=2.0), Line2D([], [], color=RED, lw=1.8, ls=(0, (4, 2)))]
        axes.legend(handles, ["to the goal", "thrown, undamped"], loc="lower right", borderaxespad=0.1)


def _turning(axes: Axes, data: Data) -> None:
    """Draw where masses thrown straight at the surface turn, over their speed, beside what energy says."""
    v = np.linspace(0.05, 1.1, 200)
    axes.plot(v, [1e3 * turning_distance(float(s), data.params) for s in v], color=INK, lw=1.6, zorder=2)
    for case, marker, colour in zip(data.cases, "os^", (BLUE, ORANGE, GREEN), strict=True):
        axes.plot(data.speeds, 1e3 * case.heights, marker, ms=9, mfc="none", mec=colour, mew=2.0, label=case.shape.type)
    axes.axvline(V_MAX, color=RED, lw=1.5, ls=(0, (5, 3)))
    axes.axhline(1e3 * CLEARANCE, color=RED, lw=1.5, ls=(0, (5, 3)))
    note(axes, 0.52, 9, "speed limit", RED, ha="left")
    note(axes, 1.08, 23, "clearance", RED, ha="right", va="bottom")
    note(axes, 0.2, 115, r"line: $\frac{1}{2}v^2=\frac{\eta}{2}(1/\rho-1/\rho_0)^2$", ha="left", fontsize=13)
    axes.set_yscale("log")
    axes.set_yticks([10, 20, 50, 100, 200], ["10", "20", "50", "100", "200"])
    axes.minorticks_off()
    axes.set_ylim(8, 200)
    axes.set_xlim(0.0, 1.1)
    axes.grid(True)
    axes.set_xlabel("speed at which it comes [m/s]")
    axes.set_ylabel("turns at [mm]", labelpad=2)
    axes.set_title("Closest approach without damping")
    axes.legend(loc="lower left", handletextpad=0.1)

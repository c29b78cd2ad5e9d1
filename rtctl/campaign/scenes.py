"""Random scenarios: seeded, so that robot, seed and index name one for ever.

The rule of what is asked of an arm ("feasible"), `rho` being the distance of the spheres that cover its links, which
stand out of them by up to 25 mm:

- the start lies inside the joint limits by `START_MARGIN`, clear of itself by the self-influence;
- the goal is the tip's pose at a second configuration outside the joint-limit zones, clear of itself likewise;
- a still obstacle keeps rho >= influence from both;
- a moving one, at up to half of v_max, keeps rho >= influence + the look-ahead's widening from the start as long as it
  takes to arm the robot and 0.5 s more, from the goal when it is given, from the goal's configuration at the end, and
  always from the column, those spheres that no posture takes anywhere. It may cross anything else.
"""

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np

from rtctl.arm.robot import Robot
from rtctl.design import Config
from rtctl.experiment.scene import toml
from rtctl.kernel.rotations import quat_of
from rtctl.spec.obstacles import pose_at, shape_of
from rtctl.spec.read import convert
from rtctl.spec.scenario import Scenario
from rtctl.types import F64
from rtctl.world.primitives import distance

SHORTEST, LONGEST = 5.0, 10.0  # [s] of a scenario
SETTLING = 3.0  # [s] beside 1.5 times what the straight line takes at v_max: to settle, or to tell why not
GOAL_AT = 0.5  # [s]: the arm is running by then
GRACE = 1.0  # [s] from the start in which a moving obstacle keeps its distance
START_MARGIN = 0.05  # [rad]
MOST = 12  # obstacles
MOVING = 0.4  # share of the obstacles that move
TRIES = 60  # per obstacle; one that finds no place is left out
NAMES = "abcdefghijkl"
COLUMN = 0.2  # of the reach: spheres that stay within this whatever the posture cannot flee

Table = dict[str, Any]


def scenario_of(robot: Robot, config: Config, seed: int, index: int) -> Table:
    """Return the tables of scenario `index` of a robot."""
    # by the name that a robot had when its scenes were first drawn: the rebuilt OpenArm was `openarm`
    rng = np.random.default_rng([seed, index, *robot.name.removesuffix("_e2e").encode()])
    start = posture(robot, config, rng, START_MARGIN)
    end = posture(robot, config, rng, config.avoid.joint_influence_rad)
    tip = robot.body.evaluate(end, np.zeros(robot.n), robot.points, robot.own)
    goal: Table = {"at_s": GOAL_AT, "position_m": _round(tip.x)}
    if rng.random() < 0.5:
        goal["wxyz"] = _unit(quat_of(tip.R))
    away = np.linalg.norm(tip.x - robot.body.evaluate(start, np.zeros(robot.n), robot.points, robot.own).x)
    lasts = round(float(np.clip(SETTLING + 1.5 * away / robot.motion.v_max, SHORTEST, LONGEST)), 1)
    obstacles: list[Table] = []
    wanted = int(rng.integers(1, MOST + 1))
    while len(obstacles) < wanted:
        found = obstacle(robot, NAMES[len(obstacles)], start, end, lasts, rng)
        if found is None and obstacles:
            wanted -= 1
        elif found is not None:
            obstacles.append(found)
    return {
        "robot": robot.name,
        "duration_s": lasts,
        "start_q_rad": _round(start),
        "seed": index,
        "goal": [goal],
        "obstacle": obstacles,
    }


def _round(values: F64) -> list[float]:
    return [round(float(v), 6) for v in values]


def _unit(wxyz: F64) -> list[float]:
    return [float(f"{v:.9f}") for v in wxyz]


def posture(robot: Robot, config: Config, rng: np.random.Generator, margin: float) -> F64:
    """Return joint angles (n,) [rad] inside the limits by `margin` at which the arm is clear of itself."""
    for _ in range(10_000):
        q: F64 = rng.uniform(robot.q_min + margin, robot.q_max - margin)
        if not len(robot.own.pairs) or robot.body.own_distances(q, robot.own).min() > robot.self_avoid.rho0:
            return q
    raise RuntimeError(f"{robot.name}: no posture clear of itself")


def _points(robot: Robot, q: F64) -> F64:
    return robot.body.evaluate(q, np.zeros(robot.n), robot.points, robot.own).P


@cache
def _column(name: str) -> tuple[F64, F64]:
    """Return where the spheres of the column are, over many postures: centres (k, 3) and radii (k,) [m]."""
    robot = _ROBOTS[name]
    rng = np.random.default_rng(0)
    P = np.array([_points(robot, rng.uniform(robot.q_min, robot.q_max)) for _ in range(64)])
    fixed = np.linalg.norm(P - P.mean(axis=0), axis=2).max(axis=0) < COLUMN * robot.reach
    centres = P[:, fixed]
    return centres.reshape(-1, 3), np.tile(robot.points.radius[fixed], len(P))


_ROBOTS: dict[str, Robot] = {}  # by name: arrays are no keys of a cache


def obstacle(
    robot: Robot, name: str, start: F64, end: F64, lasts: float, rng: np.random.Generator, share: float = MOVING
) -> Table | None:
    """Return an obstacle that leaves the arm a chance, None when none was found; share: of them that move."""
    scale = robot.reach / 0.9
    at_start, at_end = _points(robot, start), _points(robot, end)
    goal = robot.body.evaluate(end, np.zeros(robot.n), robot.points, robot.own).x[None]
    _ROBOTS[robot.name] = robot
    for _ in range(TRIES):
        kind = str(rng.choice(KINDS))
        table: Table = {"name": name, "type": kind, **_SIZES[kind](rng, scale)}
        # somewhere the arm can be: about a point of it in a third configuration
        P = _points(robot, rng.uniform(robot.q_min, robot.q_max))
        where = P[int(rng.integers(len(P)))] + rng.normal(0.0, 0.08 * scale, 3)
        wxyz = rng.normal(size=4)
        table["wxyz"] = _unit(wxyz / np.linalg.norm(wxyz))
        moving = rng.random() < share
        if moving:
            v = rng.normal(size=3)
            v *= rng.uniform(0.1, 0.5) * robot.motion.v_max / np.linalg.norm(v)
            where = where - v * rng.uniform(GRACE, lasts)
            table["velocity_m_s"] = _round(v)
            if kind not in ("plane", "sphere", "point") and rng.random() < 0.3:
                table["omega_rad_s"] = _round(rng.uniform(-0.5, 0.5, 3))
        table["position_m"] = _round(where)
        if _leaves_a_chance(robot, table, at_start, at_end, goal, lasts if moving else 0.0):
            return table
    return None


def _leaves_a_chance(robot: Robot, table: Table, at_start: F64, at_end: F64, goal: F64, lasts: float) -> bool:
    """Return whether an obstacle keeps the rule above; lasts [s] is how long it moves, 0 for a still one."""
    if np.abs(table["position_m"]).max() > 50.0:
        return False
    scenario: Scenario = convert({"robot": robot.name, "duration_s": 1.0, "obstacle": [table]}, Scenario, "scene")
    told = scenario.obstacle[0]
    rho0 = robot.avoid.rho0

    def clear(P: F64, t: float, wide: float, radius: F64 = robot.points.radius) -> bool:
        gap: F64 = distance(shape_of(told, t), P)[0] - radius
        return bool(gap.min() >= wide) if len(gap) else True

    if not lasts:
        return clear(at_start, 0.0, rho0) and clear(at_end, 0.0, rho0)
    speed = float(np.linalg.norm(pose_at(told, 0.0).velocity))
    wide = rho0 + robot.avoid.look_ahead * speed
    if not clear(at_end, lasts, wide):
        return False
    if not all(clear(at_start, float(t), wide) for t in np.linspace(0.0, GRACE, 6)):
        return False
    if not clear(goal, GOAL_AT, rho0, np.zeros(1)):
        return False
    centres, radius = _column(robot.name)
    return all(clear(centres, float(t), wide, radius) for t in np.linspace(0.0, lasts, 25))


def _sizes(*keys: tuple[str, float, float]) -> Callable[[np.random.Generator, float], Table]:
    return lambda rng, scale: {key: round(float(rng.uniform(low, high)) * scale, 4) for key, low, high in keys}


def _triple(key: str, low: float, high: float, n: bool) -> Callable[[np.random.Generator, float], Table]:
    def table(rng: np.random.Generator, scale: float) -> Table:
        out: Table = {key: _round(rng.uniform(low, high, 3) * scale)}
        return {**out, "n": round(float(rng.uniform(1.5, 8.0)), 2)} if n else out

    return table


_SIZES: dict[str, Callable[[np.random.Generator, float], Table]] = {
    "point": _sizes(),
    "plane": _sizes(),
    "sphere": _sizes(("radius_m", 0.02, 0.12)),
    "segment": _sizes(("length_m", 0.1, 0.6)),
    "capsule": _sizes(("radius_m", 0.02, 0.08), ("length_m", 0.1, 0.5)),
    "cylinder": _sizes(("radius_m", 0.02, 0.1), ("length_m", 0.05, 0.4)),
    "cone": _sizes(("radius_m", 0.03, 0.12), ("height_m", 0.08, 0.3), ("top_radius_m", 0.0, 0.05)),
    "box": _triple("size_m", 0.04, 0.3, False),
    "ellipsoid": _triple("semi_axes_m", 0.02, 0.15, False),
    "n_ellipsoid": _triple("semi_axes_m", 0.02, 0.12, True),
    "n_cylinder": _triple("semi_axes_m", 0.02, 0.12, True),
}


KINDS = tuple(_SIZES)


def toml_of(table: Table, comment: str) -> str:
    """Return a scenario as TOML that `rtctl sim` reads, to the same bits."""
    lines = [f"# {comment}", ""] if comment else []
    lines += [f"{k} = {toml(v)}" for k, v in table.items() if not _is_tables(v)]
    for key, rows in table.items():
        for row in rows if _is_tables(rows) else ():
            lines += ["", f"[[{key}]]", *(f"{k} = {toml(v)}" for k, v in row.items())]
    return "\n".join(lines) + "\n"


def _is_tables(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and isinstance(value[0], dict)

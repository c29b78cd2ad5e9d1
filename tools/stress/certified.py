"""Random scenes that can be done, each with a way to its goal found by `certificate`, as a source of campaigns.

rtctl campaign run tools.stress.certified --robots panda --count 60 --out out/certified

In turn: `still` and `moving` obstacles anywhere; `turn`, a tool turned by nearly half a turn, the short way of which
may be blocked by a joint's limit; `table`, work close above a table; `gap`, between two columns; `stretched`, from a
stretched arm. A scene of which no way is found is drawn anew. Among moving obstacles the way is one at the moment the
goal is given, with all obstacles where they are then, and the posture at its end is clear from start to end.
"""

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from firmware_sim.plant import Plant
from rtctl.app.simulator import open_simulator
from rtctl.arm.robot import Robot
from rtctl.campaign import scenes
from rtctl.campaign.case import Asked, Case, Scene, options_within
from rtctl.campaign.robots import ready
from rtctl.campaign.scenes import GOAL_AT, Table
from rtctl.campaign.sources import derived, numbered
from rtctl.design import Config
from rtctl.errors import RtctlError
from rtctl.kernel.rotations import quat_of
from rtctl.spec.obstacles import orientation_of, pose_at
from rtctl.spec.read import convert
from rtctl.spec.scenario import Scenario
from rtctl.types import F64
from tools.stress.certificate import Room, duration, free_of, way
from tools.stress.source import Stress

KINDS = ("still", "moving", "turn", "table", "gap", "stretched")
DRAWS = 40  # of a scene, until one has a way
BESIDE = 0.005  # [m] that a way keeps beside the clearance: as far as points may stand out of links
NEAR = (0.03, 0.06)  # [m] from the arm to a table or a column at the goal
HALF_TURN = (2.6, 3.5)  # [rad] of the tool
INSTANTS = 9  # at which a moving scene is looked at
SETTLING = 6.0  # [s] beside three times what the certified way takes


class Certified(Stress):
    """Scenes with a certificate, judged as the stress set is."""

    def cases(self, asked: Asked) -> Iterator[Case]:
        """Yield the cases: for each seed, `--count` scenes over all robots, the kinds in turn."""
        options_within(asked, (), "tools.stress.certified")
        for case in numbered("tools.stress.certified", asked):
            yield case._replace(set=KINDS[case.number % len(KINDS)])

    def scene(self, case: Case) -> Scene:
        """Return the scene of a case, its way and what that takes."""
        path = ready(case.robot, case.plain_config).path
        robot, config = derived(case.robot, path)
        table, found, _ = certified(robot, config, path, case.seed, case.number)
        return Scene(table, path, reference_s=duration(robot, found), certificate=found.tolist())


def certified(robot: Robot, config: Config, path: Path, seed: int, number: int) -> tuple[Table, F64, int]:
    """Return the tables of a scene, a way (k, n) [rad] to its goal, and how often it was drawn. Raises RtctlError."""
    kind = KINDS[number % len(KINDS)]
    for draw in range(DRAWS):
        rng = np.random.default_rng([seed, number, draw, *robot.name.encode()])
        start, end, obstacles = _DRAWN[kind](robot, config, path, rng)
        if obstacles is None:
            continue
        found = _way(robot, path, start, end, obstacles, rng)
        if found is None:
            continue
        table = _table(robot, number, start, end, obstacles, duration(robot, found), rng)
        if _stays_clear(robot, path, end, obstacles, table["duration_s"]):
            return table, found, draw + 1
    raise RtctlError(f"{robot.name}: no {kind} scene of seed {seed} and number {number} has a way")


def _table(
    robot: Robot, number: int, start: F64, end: F64, obstacles: list[Table], takes: float, rng: np.random.Generator
) -> Table:
    tip = robot.body.evaluate(end, np.zeros(robot.n), robot.points, robot.own)
    goal: Table = {"at_s": GOAL_AT, "position_m": [float(v) for v in tip.x]}
    turned = KINDS[number % len(KINDS)] == "turn" or rng.random() < 0.5
    if turned:
        goal["wxyz"] = [float(v) for v in quat_of(tip.R)]
    return {
        "robot": robot.name,
        "duration_s": round(GOAL_AT + SETTLING + 3.0 * takes, 1),
        "start_q_rad": [float(v) for v in start],
        "seed": number,
        "goal": [goal],
        "obstacle": obstacles,
    }


def _way(
    robot: Robot, path: Path, start: F64, end: F64, obstacles: list[Table], rng: np.random.Generator
) -> F64 | None:
    """Return a way among the obstacles as they stand when the goal is given, None when none was found."""
    now = _frozen(robot, obstacles, GOAL_AT)
    found: F64 | None = _seen(
        robot, path, now, lambda plant: way(start, end, robot, free_of(plant, robot, _room(robot)), rng)
    )
    return found


def _room(robot: Robot) -> Room:
    return Room(robot.avoid.rho_min + BESIDE, robot.self_avoid.rho_min)


def _stays_clear(robot: Robot, path: Path, end: F64, obstacles: list[Table], lasts: float) -> bool:
    """Return whether the posture at the end of the way is clear as long as the scene lasts [s]."""
    if not any("velocity_m_s" in o for o in obstacles):
        return True

    def clear(plant: Plant) -> bool:
        return free_of(plant, robot, _room(robot))(end)

    return all(
        _seen(robot, path, _frozen(robot, obstacles, float(t)), clear) for t in np.linspace(0.0, lasts, INSTANTS)
    )


def _seen(robot: Robot, path: Path, obstacles: list[Table], look: Callable[[Plant], Any]) -> Any:
    """Return what is looked at in a plant with still obstacles."""
    scenario = _scenario(robot, obstacles)
    simulator: Any = open_simulator(path, scenario, path)
    try:
        return look(simulator.plant)
    finally:
        simulator.close()


def _scenario(robot: Robot, obstacles: list[Table]) -> Scenario:
    table = {"robot": robot.name, "duration_s": 1.0, "obstacle": obstacles}
    scenario: Scenario = convert(table, Scenario, "scene")
    return scenario


def _frozen(robot: Robot, obstacles: list[Table], t: float) -> list[Table]:
    """Return the obstacles at rest where they are at time t [s]."""
    out = []
    for table, o in zip(obstacles, _scenario(robot, obstacles).obstacle, strict=True):
        still = {k: v for k, v in table.items() if k not in ("velocity_m_s", "omega_rad_s", "rpy_rad", "normal")}
        at, turned = pose_at(o, t).position, orientation_of(o, t)
        out.append({**still, "position_m": [float(v) for v in at], "wxyz": [float(v) for v in turned]})
    return out


# -- the kinds: start, end, obstacles (None: draw again) ---------------------------------------------------------------

Drawn = tuple[F64, F64, list[Table] | None]


def _ends(robot: Robot, config: Config, rng: np.random.Generator) -> tuple[F64, F64]:
    start = scenes.posture(robot, config, rng, scenes.START_MARGIN)
    return start, scenes.posture(robot, config, rng, config.avoid.joint_influence_rad)


def _anywhere(share: float) -> Callable[[Robot, Config, Path, np.random.Generator], Drawn]:
    def drawn(robot: Robot, config: Config, path: Path, rng: np.random.Generator) -> Drawn:
        start, end = _ends(robot, config, rng)
        return start, end, _random(robot, start, end, int(rng.integers(1, scenes.MOST + 1)), share, rng)

    return drawn


def _random(robot: Robot, start: F64, end: F64, count: int, share: float, rng: np.random.Generator) -> list[Table]:
    lasts = GOAL_AT + SETTLING
    found = [scenes.obstacle(robot, name, start, end, lasts, rng, share) for name in scenes.NAMES[:count]]
    return [o for o in found if o is not None]


def _turn(robot: Robot, config: Config, path: Path, rng: np.random.Generator) -> Drawn:
    """The last joint turns the tool by nearly half a turn, to either side as its limits allow; others move little."""
    start = scenes.posture(robot, config, rng, scenes.START_MARGIN)
    end = np.clip(
        start + rng.uniform(-0.3, 0.3, robot.n),
        robot.q_min + config.avoid.joint_influence_rad,
        robot.q_max - config.avoid.joint_influence_rad,
    )
    low, high = robot.q_min[-1] + config.avoid.joint_influence_rad, robot.q_max[-1] - config.avoid.joint_influence_rad
    turn = min(float(rng.uniform(*HALF_TURN)), 0.95 * float(high - low))
    side = 1.0 if rng.random() < 0.5 else -1.0
    start[-1] = rng.uniform(low, high - turn) if side > 0 else rng.uniform(low + turn, high)
    end[-1] = start[-1] + side * turn
    return start, end, _random(robot, start, end, int(rng.integers(0, 4)), 0.0, rng)


def _beside(robot: Robot, path: Path, end: F64, made: Callable[[float], list[Table]], far: float) -> list[Table] | None:
    """Return what is made at the least distance, of those up to `far` [m], at which it keeps NEAR to the arm's end."""
    for away in np.arange(0.0, far, 0.01):
        obstacles = made(float(away))
        gap = _seen(robot, path, obstacles, lambda plant: _gap(plant, end))
        if gap > NEAR[1]:
            return None
        if gap >= NEAR[0]:
            return obstacles
    return None


def _gap(plant: Plant, q: F64) -> float:
    plant.place(q)
    return min(plant.clearances().values(), default=math.inf)


def _work_table(robot: Robot, config: Config, path: Path, rng: np.random.Generator) -> Drawn:
    start, end = _ends(robot, config, rng)
    tip = robot.body.evaluate(end, np.zeros(robot.n), robot.points, robot.own).x
    half = 0.2 * robot.reach

    def made(away: float) -> list[Table]:
        at = [float(tip[0]), float(tip[1]), float(tip[2]) - 0.02 - away]
        return [{"name": "table", "type": "box", "size_m": [2 * half, 2 * half, 0.04], "position_m": at}]

    return start, end, _beside(robot, path, end, made, 0.3)


def _gap_scene(robot: Robot, config: Config, path: Path, rng: np.random.Generator) -> Drawn:
    start, end = _ends(robot, config, rng)
    tip = robot.body.evaluate(end, np.zeros(robot.n), robot.points, robot.own).x
    out = tip - robot.base
    flat = float(np.hypot(out[0], out[1]))
    if flat < 0.3 * robot.reach:
        return start, end, None
    side = np.array([-out[1], out[0], 0.0]) / flat
    at = tip - 0.12 * np.array([out[0], out[1], 0.0]) / flat

    def made(away: float) -> list[Table]:
        return [
            {
                "name": name,
                "type": "capsule",
                "radius_m": 0.05,
                "length_m": 0.4,
                "position_m": [float(v) for v in at + sign * (0.1 + away) * side],
            }
            for name, sign in (("left", 1.0), ("right", -1.0))
        ]

    return start, end, _beside(robot, path, end, made, 0.3)


def _stretched(robot: Robot, config: Config, path: Path, rng: np.random.Generator) -> Drawn:
    """Start from that of many postures whose tip is farthest away."""
    found = [scenes.posture(robot, config, rng, scenes.START_MARGIN) for _ in range(60)]
    tips = [robot.body.evaluate(q, np.zeros(robot.n), robot.points, robot.own).x for q in found]
    start = found[int(np.argmax([np.linalg.norm(x - robot.base) for x in tips]))]
    end = scenes.posture(robot, config, rng, config.avoid.joint_influence_rad)
    return start, end, _random(robot, start, end, int(rng.integers(0, 5)), 0.0, rng)


_DRAWN: dict[str, Callable[[Robot, Config, Path, np.random.Generator], Drawn]] = {
    "still": _anywhere(0.0),
    "moving": _anywhere(scenes.MOVING),
    "turn": _turn,
    "table": _work_table,
    "gap": _gap_scene,
    "stretched": _stretched,
}

source = Certified()

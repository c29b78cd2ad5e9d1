"""MotionBenchMaker's problems as a source of `rtctl campaign`; docs/benchmark.md says where the data come from.

A goal is the pose that the tip has at the problem's goal joints. What the arm is to grasp there stands among the
obstacles: what is nearer than GRASPED to it at the goal is left out. Arrived within NEAR and
TURNED, without a contact, counts.
"""

import gzip
import json
from collections import Counter
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from rtctl.app.simulator import open_simulator
from rtctl.arm.robot import Robot
from rtctl.campaign.case import Asked, Case, Scene, loads, options_within
from rtctl.campaign.play import simulated
from rtctl.campaign.robots import Variant, found, ready, text_of
from rtctl.campaign.sources import derived
from rtctl.errors import ConfigError, UsageError
from rtctl.kernel.rotations import R_of, quat_of
from rtctl.plain import Json
from rtctl.spec.read import convert
from rtctl.spec.robot import Avoid
from rtctl.spec.scenario import Scenario
from rtctl.types import F64

GRASPED = 0.003  # [m]
NEAR, TURNED = 0.005, 0.02  # [m], [rad]
GOAL_AT = 0.3  # [s]
LASTS = 20.0  # [s] within which it must arrive
# Shelves and boxes leave the hand less than the shipped files' 20 mm, and their points stand out of links too far;
# slower, for the shorter influence.
CLEARANCE, INFLUENCE, SPEED, OVERHANG = 0.005, 0.05, 0.3, 0.010  # [m], [m], [m/s], [m]
CONFIG: dict[tuple[str, ...], object] = {
    ("avoid", "clearance_m"): CLEARANCE,
    ("avoid", "influence_m"): INFLUENCE,
    ("avoid", "overhang_m"): OVERHANG,
    ("motion", "v_max_m_s"): SPEED,
}
FRAMES = {"panda": "panda_link0", "ur5": "base_link"}  # that the obstacles are given in


class Benchmark:
    """`data`: files, comma-separated; `per-set` of each, default all, after `skip` others; `plan`: auto or never."""

    def cases(self, asked: Asked) -> Iterator[Case]:
        """Yield a case for each problem."""
        options = options_within(asked, ("data", "per-set", "skip", "plan"), "tools.benchmark.source")
        per_set = int(options.get("per-set", 0)) or 1_000_000
        skip = int(options.get("skip", 0))
        plan = options.get("plan", "auto")
        if plan not in ("auto", "never"):
            raise UsageError(f"benchmark: plan: got {plan}, wanted auto or never")
        for file in options.get("data", "").split(","):
            data = problems(Path(file))
            name = data["robot"]
            if name not in FRAMES:
                raise ConfigError(f"{file}: robot", name, f"one of {', '.join(FRAMES)}")
            if asked.robots and name not in asked.robots:
                continue
            path = found(name, Path("scenario.toml"))
            text = text_of(path, Variant("", CONFIG | ({("avoid", "plan"): plan} if plans() else {})))
            taken: Counter[str] = Counter()
            for number, problem in enumerate(data["problems"]):
                taken[problem["set"]] += 1
                if skip < taken[problem["set"]] <= skip + per_set:
                    body = json.dumps({"problem": problem, "plan": plan})
                    yield Case("tools.benchmark.source", name, text, 0, number, problem["set"], body=body)

    def scene(self, case: Case) -> Scene:
        """Return the scene of a problem."""
        path = ready(case.robot, case.plain_config).path
        robot, _ = derived(case.robot, path)
        body = loads(case.body)
        return Scene(scene_of(robot, path, body["problem"], body["plan"]), path, tolerance=(NEAR, TURNED))

    def play(self, case: Case, scene: Scene, config: Path) -> Json:
        """Return the columns of a run."""
        return simulated(case, scene)


@cache
def problems(path: Path) -> Json:
    """Return the data of a file. Raises ConfigError."""
    try:
        return dict(json.loads(gzip.decompress(path.read_bytes())))
    except (OSError, ValueError) as error:
        raise ConfigError(str(path), error, "problems of MotionBenchMaker, see docs/benchmark.md") from None


def plans() -> bool:
    """Return whether the config says itself when it plans."""
    return "plan" in Avoid.__struct_fields__


def scene_of(robot: Robot, config: Path, problem: Json, plan: str) -> Json:
    """Return the tables of the scenario of a problem."""
    order = [problem["joints"].index(name) for name in robot.joints]
    start, goal = (np.array(problem[key])[order] for key in ("start_rad", "goal_rad"))
    obstacles = [placed(robot, o, FRAMES[robot.name]) for o in problem["obstacles"]]
    touched = touching(config, robot.name, goal, obstacles)
    tip = robot.body.evaluate(goal, np.zeros(robot.n), robot.points, robot.own)
    table: Json = {
        "robot": robot.name,
        "duration_s": GOAL_AT + LASTS,
        "start_q_rad": [float(v) for v in start],
        "goal": [
            {
                "at_s": GOAL_AT,
                "position_m": [float(v) for v in tip.x],
                "wxyz": [float(v) for v in quat_of(tip.R)],
                "tolerance_m": NEAR,
                "tolerance_rad": TURNED,
            }
        ],
        "obstacle": [o for o in obstacles if o["name"] not in touched],
    }
    return table | ({"planner": True} if plan == "auto" and not plans() else {})


def placed(robot: Robot, obstacle: Json, frame: str) -> Json:
    """Return an obstacle given in a frame of the arm's foot as it stands in the world."""
    R, t = foot(robot, frame)
    wxyz = np.array(obstacle["wxyz"])
    at = R @ np.array(obstacle["position_m"]) + t
    turned = quat_of(R @ R_of(wxyz / np.linalg.norm(wxyz)))
    return {**obstacle, "position_m": [float(v) for v in at], "wxyz": [float(v) for v in turned]}


def foot(robot: Robot, frame: str) -> tuple[F64, F64]:
    """Return orientation (3, 3) and position (3,) [m] of a frame that no joint moves."""
    import pinocchio as pin

    body = robot.body
    pin.framesForwardKinematics(body.model, body.data, body.configuration(robot.home))
    pose = body.data.oMf[body.model.getFrameId(frame)]
    return np.array(pose.rotation), np.array(pose.translation)


def touching(config: Path, name: str, q: F64, obstacles: list[Json]) -> set[str]:
    """Return which obstacles are nearer than GRASPED to the arm at q (n,), by the simulator's collision shapes."""
    table: dict[str, Any] = {"robot": name, "duration_s": 1.0, "start_q_rad": q.tolist(), "obstacle": obstacles}
    scenario: Scenario = convert(table, Scenario, "benchmark")
    simulator = open_simulator(config, scenario, config)
    try:
        return {n for n, distance in simulator.truth().clearance.items() if distance < GRASPED}
    finally:
        simulator.close()


source = Benchmark()

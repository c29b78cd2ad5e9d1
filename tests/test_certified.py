"""Certified scenes: the way leads from the start to the goal, and another geometry than its planner's finds it free."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from rtctl.arm.robot import Robot
from rtctl.kernel.rotations import R_of
from rtctl.spec.obstacles import shape_of
from rtctl.spec.read import convert
from rtctl.spec.scenario import Scenario
from rtctl.types import F64
from rtctl.world.primitives import distance
from tools.stress.certificate import duration, way
from tools.stress.certified import BESIDE, KINDS, certified
from tools.stress.judge import OVERHANG
from tools.stress.play import CONFIGS, robot_of


def least(robot: Robot, table: dict[str, object], q: F64, t: float) -> float:
    """Return the least distance [m] of the spheres that cover the links, by rtctl's own primitives."""
    scenario: Scenario = convert(table, Scenario, "scene")
    P = robot.body.evaluate(q, np.zeros(robot.n), robot.points, robot.own).P
    gaps = [(distance(shape_of(o, t), P)[0] - robot.points.radius).min() for o in scenario.obstacle]
    return float(min(gaps, default=np.inf))


@pytest.mark.parametrize("kind", ["moving", "turn", "table"])
def test_a_way_leads_to_the_goal_and_is_free(kind: str):
    robot, config = robot_of("panda")
    table, found, _ = certified(robot, config, Path(CONFIGS / "panda.toml"), 0, KINDS.index(kind))
    assert found[0] == pytest.approx(table["start_q_rad"])
    tip = robot.body.evaluate(found[-1], np.zeros(robot.n), robot.points, robot.own)
    goal = table["goal"][0]
    assert tip.x == pytest.approx(goal["position_m"], abs=1e-9)
    if "wxyz" in goal:
        assert np.allclose(tip.R, R_of(np.array(goal["wxyz"])), atol=1e-9)
    room = robot.avoid.rho_min + BESIDE - OVERHANG
    for a, b in pairwise(found):
        for q in np.linspace(a, b, 10):
            assert (q > robot.q_min).all()
            assert (q < robot.q_max).all()
            assert least(robot, table, q, goal["at_s"]) > room
    if kind == "table":
        assert least(robot, table, found[-1], 0.0) < 0.07


def test_a_wall_with_no_way_has_no_certificate_and_a_hole_in_it_has():
    robot, _ = robot_of("panda")
    start, end = robot.home.copy(), robot.home.copy()
    start[0], end[0] = -1.0, 1.0

    def free(hole: bool):
        return lambda q: (
            bool((q > robot.q_min).all() and (q < robot.q_max).all()) and (abs(q[0]) > 0.1 or (hole and q[1] < -1.0))
        )

    rng = np.random.default_rng(0)
    assert way(start, end, robot, free(False), rng) is None
    found = way(start, end, robot, free(True), rng)
    assert found is not None
    assert np.array_equal(found[[0, -1]], [start, end])
    assert min(q[1] for q in found) < -1.0


def test_the_time_of_a_way_is_that_of_a_trapezoid():
    """A quarter turn of the base at v_max: the tip's arc length / v_max, and one stopping time."""
    robot, _ = robot_of("panda")
    a, b = robot.home.copy(), robot.home.copy()
    b[0] += 0.5
    tip = robot.body.evaluate(a, np.zeros(robot.n), robot.points, robot.own).x - robot.base
    arc = 0.5 * float(np.hypot(tip[0], tip[1]))
    wanted = max(arc / robot.motion.v_max, 0.5 / robot.motion.w_max, 0.5 / robot.qd_max[0])
    assert duration(robot, np.array([a, b])) == pytest.approx(
        wanted + robot.motion.v_max / robot.motion.a_max, rel=1e-3
    )

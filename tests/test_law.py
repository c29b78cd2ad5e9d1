"""The law's torques against another rigid-body engine."""

from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtctl.arm.bounds import SPEED_HORIZON
from rtctl.arm.field import MovingPoints, move_points
from rtctl.arm.law import evaluate_law
from rtctl.arm.model import Model
from rtctl.arm.osc import Twist, operational_space
from rtctl.arm.terms import Law, Motion, nothing_ahead
from rtctl.types import F64, Shape
from rtctl.world.primitives import Obstacles, obstacles_empty, with_shape
from tests.arms import PANDA, PANDA_HOME, PANDA_JOINTS, Bullet, states
from tests.lab import robot, sphere

ZERO = np.zeros(3)
ROUGH = np.array([0.3, 0.4, -0.2, -1.7, 0.3, 1.9, 0.4])


@pytest.fixture(scope="module")
def bullet(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bullet]:
    """The arm in another engine."""
    other = Bullet(PANDA, PANDA_JOINTS, np.eye(4), Path(tmp_path_factory.mktemp("bullet")))
    yield other
    other.close()


@cache
def space_of(shapes: tuple[tuple[float, ...], ...]) -> Obstacles:
    """Return obstacles that are balls, each (x, y, z, radius)."""
    table = obstacles_empty(robot().slots)
    for k, (x, y, z, radius) in enumerate(shapes):
        table = with_shape(table, k, sphere(str(k), [x, y, z], radius))
    return table


def model_at(q: F64, qd: F64) -> Model:
    return robot().body.evaluate(q, qd, robot().points, robot().own)


def law_at(q: F64, qd: F64 | None = None, balls: tuple[tuple[float, ...], ...] = (), **changes: Any) -> Law:
    """Return the law for a state that the model was evaluated at; by default it wants nothing."""
    arm = robot()
    qd = np.zeros(7) if qd is None else qd
    model = model_at(q, qd)
    space = operational_space(model.J, model.A_inv, model.Lambda_inv, np.eye(6)[: changes.pop("rows", 6)], arm.motion)
    twist = model.J @ qd
    model, space = changes.pop("model", model), changes.pop("space", space)
    obstacles = changes.pop("obstacles", space_of(balls))
    still = Twist(ZERO, ZERO)
    error, previous = Twist(changes.pop("e", ZERO), ZERO), Twist(changes.pop("v_ref", ZERO), ZERO)
    plain = (still, still, q, 1.0, np.zeros(7), False, np.zeros(7), nothing_ahead(arm), np.zeros(0))
    motion = Motion(q, qd, Twist(twist[:3], twist[3:]), *plain)
    return evaluate_law(arm, model, space, obstacles, motion._replace(error=error, previous=previous, **changes))


def test_an_arm_at_its_goal_is_carried_by_gravity_torque_alone(bullet: Bullet):
    for q, _, _ in states(robot().body, 50):
        inside = np.clip(q, robot().q_min + 0.25, robot().q_max - 0.25)
        law = law_at(inside)
        if not law.tau_obstacles.any():  # the arm is not near itself
            np.testing.assert_allclose(law.drive + law.keep, bullet.torques(inside, 0 * q, 0 * q), atol=0.02)


@pytest.mark.parametrize(("rows", "least"), [(3, 1.0), (6, 0.05)])
def test_the_tip_accelerates_as_the_law_says_whatever_the_posture_wants(bullet: Bullet, rows: int, least: float):
    qd = np.array([0.1, -0.2, 0.15, 0.1, -0.3, 0.2, 0.1])
    e, rest = np.array([0.1, 0.2, -0.1]), PANDA_HOME + 0.3
    law = law_at(ROUGH, qd, rows=rows, e=e, v_ref=np.array([0.2, 0.1, 0.0]), q_rest=rest)
    tau = law.drive + law.keep
    qdd = np.linalg.solve(bullet.mass_matrix(ROUGH), tau - bullet.torques(ROUGH, qd, np.zeros(7)))
    model = model_at(ROUGH, qd)
    np.testing.assert_allclose((model.J @ qdd + model.Jdqd)[:rows], law.F[:rows], atol=2e-3)
    assert np.abs(law.tau_posture).max() > least


def test_the_parts_add_up_to_what_is_sent_on():
    law = law_at(ROUGH, np.full(7, 0.2), ((0.45, 0.2, 0.5, 0.05),), e=np.array([0.2, 0.1, 0.0]), q_rest=PANDA_HOME)
    model = model_at(ROUGH, np.full(7, 0.2))
    parts = law.tau_motion + law.tau_posture + law.tau_obstacles + law.tau_limits + model.g + model.h
    np.testing.assert_allclose(law.drive + law.keep, parts, atol=1e-9)


def test_what_is_kept_never_drives_an_arm_that_nothing_is_near():
    for q, qd, _ in states(robot().body, 50, seed=3):
        inside = np.clip(q, robot().q_min + 0.25, robot().q_max - 0.25)
        slow = 0.3 * qd
        law = law_at(inside, slow, e=np.array([0.1, 0.0, 0.1]))
        if law.tau_obstacles.any():
            continue
        model = model_at(inside, slow)
        # J^T Lambda Jd qd belongs to the brake and is no dissipation; it goes with the square of the speed
        frozen = model.J.T @ operational_space(model.J, model.A_inv, model.Lambda_inv, np.eye(6), robot().motion).Lambda
        power = slow @ (law.keep - model.g - model.h + frozen @ model.Jdqd)
        assert power <= 1e-9


def test_braking_keeps_the_direction_and_loses_speed_at_a_max():
    v = np.array([0.3, 0.0, 0.4])
    law = law_at(ROUGH, v_ref=v)
    np.testing.assert_allclose(law.v_ref, v * (1.0 - robot().motion.a_max * robot().dt / 0.5), rtol=1e-9)


def top_speed(strength: float, way: F64, axis: F64, told: bool) -> float:
    """Return the top speed of a tip, of v_max, that a hand pushes across its way, as the limiter slews the torque."""
    arm = robot()
    qd = np.linalg.pinv(model_at(ROUGH, np.zeros(7)).J) @ np.array([*(0.96 * arm.motion.v_max * way), 0.0, 0.0, 0.0])
    sent, qdd, top = model_at(ROUGH, qd).g + model_at(ROUGH, qd).h, np.zeros(7), 0.0
    for _ in range(250):
        model = model_at(ROUGH, qd)
        J, v = model.J[:3], model.J[:3] @ qd
        push = J.T @ (strength * np.cross(axis, v) / np.linalg.norm(v))
        law = law_at(ROUGH, qd, floats=True, hand=push, qdd=qdd, sent=sent if told else np.zeros(0), model=model)
        change = law.drive + law.keep - sent
        sent = sent + change * min(1.0, float((arm.tau_rate * arm.dt / np.maximum(np.abs(change), 1e-12)).min()))
        qdd = model.A_inv @ (sent - model.g - model.h)
        qd = qd + arm.dt * qdd
        top = max(top, float(np.linalg.norm(J @ qd)))
    return top / arm.motion.v_max


@pytest.mark.parametrize(("strength", "way", "axis"), [(100.0, 0, 2), (300.0, 0, 2), (30.0, 2, 1)])
def test_the_guards_judge_what_the_limiter_leaves_of_a_torque(strength: float, way: int, axis: int):
    """It slows all joints down as one: braking the tip waits for a joint that has a long way to go."""
    x = np.eye(3)
    assert top_speed(strength, x[way], x[axis], True) <= 1.02
    assert top_speed(strength, x[way], x[axis], False) > 1.02


def test_far_obstacles_change_no_bit():
    near, far = law_at(ROUGH), law_at(ROUGH, balls=((0.0, 5.0, 0.0, 0.3), (0.0, -5.0, 0.0, 0.3)))
    assert near.drive.tobytes() == far.drive.tobytes()
    assert near.keep.tobytes() == far.keep.tobytes()


def test_a_ball_pushes_the_nearest_point_away_from_its_centre():
    model = model_at(PANDA_HOME, np.zeros(7))
    centre = model.x + np.array([0.10, 0.0, 0.0])
    law = law_at(PANDA_HOME, balls=((*centre, 0.03),))
    j = int(law.nearest[0])
    away = model.P[j] - centre
    assert 0.0 < law.rho[0] == pytest.approx(np.linalg.norm(away) - 0.03 - robot().points.radius[j], abs=1e-9)
    assert law.force[0] @ away > 0.0
    assert away @ model.Jp[j] @ model.A_inv @ law.tau_obstacles > 0.0


def test_points_moved_between_evaluations_are_off_by_the_square_of_the_step():
    model = model_at(ROUGH, np.zeros(7))
    direction = np.array([1.0, -0.5, 0.8, 0.7, -1.0, 0.6, 1.0])
    errors = []
    for step in (0.008, 0.004, 0.002):  # 2 rad/s over 4, 2, 1 ms
        moved = np.empty((6, len(robot().points.radius)))
        points = MovingPoints(model.P, model.Jp, model.B, robot().points.radius, robot().points.link)
        move_points(points, step * direction, np.zeros(7), moved)
        errors.append(np.abs(moved[:3].T - model_at(ROUGH + step * direction, np.zeros(7)).P[: moved.shape[1]]).max())
    assert errors[0] < 1e-4
    np.testing.assert_allclose([errors[0] / errors[1], errors[1] / errors[2]], 4.0, rtol=0.05)


def test_a_slow_start_bounds_what_joints_are_asked_for():
    balls = ((0.307, 0.0, 0.44, 0.03),)
    full, slow = law_at(PANDA_HOME, balls=balls), law_at(PANDA_HOME, balls=balls, speed_scale=0.1)
    model = model_at(PANDA_HOME, np.zeros(7))
    for law, pace in ((full, 1.0), (slow, 0.1)):
        qdd = model.A_inv @ (law.drive + law.keep - model.g)
        assert (np.abs(qdd) <= pace * robot().qd_max / SPEED_HORIZON * (1 + 1e-9)).all()
    assert np.abs(slow.keep - model.g).max() < np.abs(full.keep - model.g).max()


def test_an_obstacle_of_any_kind_reaches_the_torque():
    x = model_at(PANDA_HOME, np.zeros(7)).x
    dims = {
        "point": (0, 0, 0, 0),
        "segment": (0.0, 0.1, 0, 0),
        "sphere": (0.02, 0, 0, 0),
        "capsule": (0.02, 0.1, 0, 0),
        "cylinder": (0.02, 0.02, 0, 0),
        "cone": (0.02, 0.01, 0.02, 0),
        "box": (0.02, 0.02, 0.02, 0),
        "plane": (0, 0, 0, 0),
        "ellipsoid": (0.02, 0.03, 0.02, 0),
        "n_ellipsoid": (0.02, 0.03, 0.02, 4.0),
        "n_cylinder": (0.02, 0.02, 0.03, 4.0),
    }
    for kind, size in dims.items():
        at = x + np.array([0.0, 0.0, -0.08])
        unit = np.array([1.0, 0.0, 0.0, 0.0])
        shape = Shape(kind, kind, np.array(size, np.float64), at, unit, ZERO, ZERO)
        law = law_at(PANDA_HOME, obstacles=with_shape(obstacles_empty(robot().slots), 0, shape))
        assert np.abs(law.tau_obstacles).max() > 0.01, kind
        assert law.force[0, 2] > 0.0, kind

"""The law's torques against another rigid-body engine, and the guards against their promises."""

from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import nnls

from rtctl.arm.guards import SPEED_BAND, SPEED_HORIZON, approach_rows, fitting, guard, joint_bounds, tip_row
from rtctl.arm.joint_field import own_field
from rtctl.arm.law import Law, evaluate_law, moved_points
from rtctl.arm.model import Model
from rtctl.arm.osc import operational_space
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
    inputs: dict[str, Any] = {
        "model": model, "space": space, "obstacles": space_of(balls), "q": q, "qd": qd, "xd": twist[:3],
        "omega": twist[3:], "e": ZERO, "e_rot": ZERO, "v_ref": ZERO, "w_ref": ZERO, "q_rest": q, "pace": 1.0,
    }  # fmt: skip
    return evaluate_law(arm, **(inputs | changes))


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
        moved = moved_points(model.P, model.Jp, step * direction)
        errors.append(np.abs(moved - model_at(ROUGH + step * direction, np.zeros(7)).P).max())
    assert errors[0] < 1e-4
    np.testing.assert_allclose([errors[0] / errors[1], errors[1] / errors[2]], 4.0, rtol=0.05)


def test_a_slow_start_bounds_what_joints_are_asked_for():
    balls = ((0.307, 0.0, 0.44, 0.03),)
    full, slow = law_at(PANDA_HOME, balls=balls), law_at(PANDA_HOME, balls=balls, pace=0.1)
    model = model_at(PANDA_HOME, np.zeros(7))
    for law, pace in ((full, 1.0), (slow, 0.1)):
        qdd = model.A_inv @ (law.drive + law.keep - model.g)
        assert (np.abs(qdd) <= pace * robot().qd_max / SPEED_HORIZON * (1 + 1e-9)).all()
    assert np.abs(slow.keep - model.g).max() < np.abs(full.keep - model.g).max()


# ---- the guards

MIN, MAX, FASTEST, BRAKING = np.full(7, -2.0), np.full(7, 2.0), np.full(7, 2.0), np.full(7, 10.0)
RATE = np.full(7, 1000.0)
NO_ROWS, NO_BOUNDS = np.zeros((0, 7)), np.zeros(0)
angle = st.floats(-2.2, 2.2)
speed = st.floats(-3.0, 3.0)
vector = st.lists(st.floats(-100.0, 100.0), min_size=7, max_size=7).map(np.array)


def guarded(tau: F64, q: F64, qd: F64) -> tuple[F64, F64, bool]:
    """Return the accelerations without and with the guard on the joints, and whether it acted."""
    model = model_at(PANDA_HOME, np.zeros(7))
    low, high = joint_bounds(model.A, q, qd, MIN, MAX, FASTEST, BRAKING, RATE)
    added, acts = guard(model.A, model.A_inv, tau, low, high, NO_ROWS, NO_BOUNDS)
    return model.A_inv @ tau, model.A_inv @ (tau + added), acts


@given(tau=vector, q=st.lists(angle, min_size=7, max_size=7), qd=st.lists(speed, min_size=7, max_size=7))
def test_no_joint_is_accelerated_to_where_it_could_not_stop(tau: F64, q: list[float], qd: list[float]):
    at, moving = np.array(q), np.array(qd)
    _, qdd, acts = guarded(tau, at, moving)
    bound_up = np.minimum(SPEED_BAND * FASTEST, np.sqrt(2 * BRAKING * np.maximum(0.0, MAX - at)))
    bound_down = np.minimum(SPEED_BAND * FASTEST, np.sqrt(2 * BRAKING * np.maximum(0.0, at - MIN)))
    soon = moving + qdd * SPEED_HORIZON
    assert (soon <= bound_up + 1e-9).all()
    assert (soon >= -bound_down - 1e-9).all()
    assert acts or (soon == moving + guarded(tau, at, moving)[0] * SPEED_HORIZON).all()


def nearest(A: F64, wanted: F64, C: F64, b: F64) -> F64:
    """Return argmin (x - wanted)^T A (x - wanted) with C x <= b, as a least-distance problem (Lawson and Hanson)."""
    L = np.linalg.cholesky(A)
    G, h = -np.linalg.solve(L, C.T).T, C @ wanted - b  # G y >= h for y = L^T (x - wanted)
    E, f = np.vstack((G.T, h)), np.append(np.zeros(len(wanted)), 1.0)
    u, _ = nnls(E, f, maxiter=1000)
    r = E @ u - f
    return wanted + np.linalg.solve(L.T, -r[:-1] / r[-1])


def test_what_the_guards_change_is_the_least_that_keeps_every_bound():
    rng = np.random.default_rng(2)
    model = model_at(ROUGH, np.zeros(7))
    acted = 0
    for _ in range(100):
        tau, rows, bounds = rng.normal(0.0, 20.0, 7), rng.normal(size=(2, 7)), rng.uniform(0.0, 5.0, 2)
        low, high = -rng.uniform(1.0, 20.0, 7), rng.uniform(1.0, 20.0, 7)
        added, acts = guard(model.A, model.A_inv, tau, low, high, rows, bounds)
        wanted = model.A_inv @ tau
        C, b = np.vstack((np.eye(7), -np.eye(7), rows)), np.concatenate((high, -low, bounds))
        best, found = nearest(model.A, wanted, C, b), model.A_inv @ (tau + added)
        size = np.sqrt(np.einsum("ci,ij,cj->c", C, model.A_inv, C))
        cost, least = ((x - wanted) @ model.A @ (x - wanted) for x in (found, best))
        assert ((C @ found - b) / size).max() <= 1e-3 * np.sqrt(least) + 1e-6
        assert cost == pytest.approx(least, rel=5e-3, abs=1e-6)
        acted += acts
    assert acted > 90


def test_a_push_away_stays_one_when_a_joint_is_at_its_stop():
    """Cutting the joint's own acceleration alone would turn it round in some postures."""
    cut_alone, guarded_too = [], []
    for q, _, _ in states(robot().body, 60, seed=5):
        model, zero = model_at(q, np.zeros(7)), np.zeros(7)
        for j in range(0, len(model.P), 3):
            row = model.Jp[j, 0]
            tau = 30.0 * row
            qdd = model.A_inv @ tau
            for i in range(7):
                stopped = np.where(np.arange(7) == i, 0.0, qdd)
                high = np.where(np.arange(7) == i, 0.0, 1e3)
                added, _ = guard(model.A, model.A_inv, tau, -high, high, NO_ROWS, NO_BOUNDS)
                cut_alone.append(row @ stopped)
                guarded_too.append(row @ (model.A_inv @ (tau + added)))
        assert not zero.any()
    assert min(cut_alone) < -1.0
    assert min(guarded_too) > -1e-6


def test_the_guard_is_quiet_where_there_is_nothing_to_guard():
    _, _, acts = guarded(np.full(7, 0.01), np.zeros(7), np.zeros(7))
    assert not acts


@given(q=angle, qd=speed, push=st.floats(-50.0, 50.0))
def test_the_guard_treats_up_and_down_alike(q: float, qd: float, push: float):
    one = guarded(np.full(7, push), np.full(7, q), np.full(7, qd))[1]
    other = guarded(np.full(7, -push), np.full(7, -q), np.full(7, -qd))[1]
    np.testing.assert_allclose(one, -other, atol=1e-9)


@given(tau=vector, direction=st.lists(st.floats(-1.0, 1.0), min_size=3, max_size=3), v=st.floats(0.01, 1.5))
def test_the_tip_is_not_pushed_past_its_speed(tau: F64, direction: list[float], v: float):
    size = float(np.linalg.norm(direction))
    if size < 0.1:
        return
    u = np.array(direction) / size
    model = model_at(PANDA_HOME, np.zeros(7))
    row, bound = tip_row(model.J, np.zeros(6), model.A_inv, v * u, 0.5, RATE)
    low = np.full(7, -1e6)
    added, acts = guard(model.A, model.A_inv, tau, low, -low, row[None], np.array([bound]))
    before, after = (u @ model.J[:3] @ model.A_inv @ t for t in (tau, tau + added))
    if acts:
        assert v + after * SPEED_HORIZON <= max(0.5, v) + 2e-3
        assert after == pytest.approx(bound, abs=0.1)
    else:
        assert after == before
        assert v < 0.05 or v + before * SPEED_HORIZON <= 0.5 + 1e-9


@pytest.mark.parametrize("pull", [1.0, 30.0, 1000.0])
def test_nothing_is_pulled_into_what_is_near(pull: float):
    """A point of a kilogram, one period of delay, a force towards a wall however large: it stops short of it."""
    eye, rate = np.eye(3), np.full(3, 2000.0)
    x, v, sent, least = 0.049, -0.5, 0.0, np.inf
    for _ in range(1500):
        distances = np.zeros((1, 6, 1))
        distances[0, :4, 0] = x, 1.0, 0.0, 0.0
        qd = np.array([v, 0.0, 0.0])
        rows, bounds = approach_rows(
            np.zeros(1, np.int64), np.ones(1, np.int64), distances, eye[None], NO_BOUNDS, np.zeros((0, 3)), ZERO, eye,
            qd, 0.1, 0.02, 0.5, 5.0, rate,
        )  # fmt: skip
        tau, low = np.array([-pull, 0.0, 0.0]), np.full(3, -1e6)
        added, _ = guard(eye, eye, tau, low, -low, rows, bounds)
        asked = (tau + added)[0]
        v, x = v + 1e-3 * sent, x + 1e-3 * v
        sent = np.clip(asked, sent - 2.0, sent + 2.0)
        least = min(least, x)
    assert 0.0 < least < 0.01
    assert abs(v) < 0.01


@given(tau=vector, load=vector)
def test_a_field_beyond_the_motors_loses_strength_not_direction(tau: F64, load: F64):
    tau_max = np.array([80.0, 80.0, 80.0, 80.0, 11.0, 11.0, 11.0])
    share = fitting(tau, load, tau_max)
    assert 0.0 < share <= 1.0
    spare = np.minimum(tau_max, tau_max - np.sign(tau) * load)
    assert (np.abs(share * tau) <= np.maximum(spare, 0.2 * tau_max) * (1 + 1e-9)).all()
    assert share == 1.0 or (np.abs(share * tau) >= np.maximum(spare, 0.2 * tau_max) * (1 - 1e-9)).any()


def test_an_obstacle_of_any_kind_reaches_the_torque():
    x = model_at(PANDA_HOME, np.zeros(7)).x
    dims = {
        "point": (0, 0, 0, 0), "segment": (0.0, 0.1, 0, 0), "sphere": (0.02, 0, 0, 0), "capsule": (0.02, 0.1, 0, 0),
        "cylinder": (0.02, 0.02, 0, 0), "cone": (0.02, 0.01, 0.02, 0), "box": (0.02, 0.02, 0.02, 0),
        "plane": (0, 0, 0, 0), "ellipsoid": (0.02, 0.03, 0.02, 0), "n_ellipsoid": (0.02, 0.03, 0.02, 4.0),
        "n_cylinder": (0.02, 0.02, 0.03, 4.0),
    }  # fmt: skip
    for kind, size in dims.items():
        at = x + np.array([0.0, 0.0, -0.08])
        unit = np.array([1.0, 0.0, 0.0, 0.0])
        shape = Shape(kind, kind, np.array(size, np.float64), at, unit, ZERO, ZERO)
        law = law_at(PANDA_HOME, obstacles=with_shape(obstacles_empty(robot().slots), 0, shape))
        assert np.abs(law.tau_obstacles).max() > 0.01, kind
        assert law.force[0, 2] > 0.0, kind


def test_two_links_that_close_fast_are_neither_thrown_back_nor_brought_to_touch():
    """A kilogram between them, torque that takes 20 ms to brake: their field alone throws them back at 1.9 m/s."""
    arm, eye, least, back = robot(), np.eye(3), np.inf, 0.0
    field, row = arm.self_avoid, np.array([[1.0, 0.0, 0.0]])
    x, v, sent, step = arm.own.reach, -0.5, 0.0, 0.25  # [m], [m/s], [N], [N] in a period
    for _ in range(400):
        qd, rho = np.array([v, 0.0, 0.0]), np.array([x if x < arm.own.reach else np.inf])
        push, _, _ = own_field(rho, row, ZERO, qd, eye, field)
        rows, bounds = approach_rows(
            np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 4, 0)), np.zeros((0, 3, 3)), rho, row, ZERO,
            eye, qd, arm.avoid.rho0, field.rho_min, arm.motion.v_max, arm.motion.a_max, np.full(3, 1e3 * step),
        )  # fmt: skip
        low = np.full(3, -1e6)
        added, _ = guard(eye, eye, push, low, -low, rows, bounds)
        sent += np.clip((push + added)[0] - sent, -step, step)
        v, x = v + 1e-3 * sent, x + 1e-3 * v
        least, back = min(least, x), max(back, v)
    assert least > 0.5 * field.rho_min
    assert back < 0.25  # half of what it came with

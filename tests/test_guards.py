"""The guards against their promises, by what moves under them."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtctl.arm.bounds import (
    SPEED_BAND,
    SPEED_HORIZON,
    ApproachParams,
    Bounds,
    MotionLimits,
    SelfPairs,
    TipMotion,
    approach_bound,
    joint_bounds,
    self_bounds,
    tip_bounds,
)
from rtctl.arm.field import Field, MovingPoints, field, field_buffers, field_params
from rtctl.arm.guards import Inertia, Motors
from rtctl.arm.joint_field import own_field
from rtctl.arm.model import Model
from rtctl.arm.scaling import scale_to_limits
from rtctl.types import F64, Shape
from rtctl.world.primitives import obstacles_empty, with_shape
from tests.arms import PANDA_HOME, states
from tests.guarding import bounds_of, guard, nearby_of, nearest, sent_of
from tests.lab import robot, sphere
from tests.test_law import ZERO, model_at

FREE = np.full(7, np.inf)
EYE = np.eye(3)
NO_ENDS = np.zeros(0)  # no posture of a goal


MIN, MAX, FASTEST, BRAKING = np.full(7, -2.0), np.full(7, 2.0), np.full(7, 2.0), np.full(7, 10.0)
RATE = np.full(7, 1000.0)
NO_ROWS, NO_BOUNDS = np.zeros((0, 7)), np.zeros(0)
angle = st.floats(-2.2, 2.2)
speed = st.floats(-3.0, 3.0)
vector = st.lists(st.floats(-100.0, 100.0), min_size=7, max_size=7).map(np.array)


def joints_guarded(tau: F64, q: F64, qd: F64) -> tuple[F64, F64, bool]:
    """Return the accelerations without and with the guard on the joints, and whether it acted."""
    model = model_at(PANDA_HOME, np.zeros(7))
    low, high = np.empty(7), np.empty(7)
    joint_bounds(model.A, q, qd, MotionLimits(MIN, MAX, FASTEST, BRAKING, FREE, RATE), low, high)
    added, acts = guard(model.A, model.A_inv, tau, low, high, NO_ROWS, NO_BOUNDS)
    return model.A_inv @ tau, model.A_inv @ (tau + added), acts


@given(tau=vector, q=st.lists(angle, min_size=7, max_size=7), qd=st.lists(speed, min_size=7, max_size=7))
def test_no_joint_is_accelerated_to_where_it_could_not_stop(tau: F64, q: list[float], qd: list[float]):
    at, moving = np.array(q), np.array(qd)
    _, qdd, acts = joints_guarded(tau, at, moving)
    bound_up = np.minimum(SPEED_BAND * FASTEST, np.sqrt(2 * BRAKING * np.maximum(0.0, MAX - at)))
    bound_down = np.minimum(SPEED_BAND * FASTEST, np.sqrt(2 * BRAKING * np.maximum(0.0, at - MIN)))
    soon = moving + qdd * SPEED_HORIZON
    assert (soon <= bound_up + 1e-9).all()
    assert (soon >= -bound_down - 1e-9).all()
    assert acts or (soon == moving + joints_guarded(tau, at, moving)[0] * SPEED_HORIZON).all()


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
    _, _, acts = joints_guarded(np.full(7, 0.01), np.zeros(7), np.zeros(7))
    assert not acts


@given(q=angle, qd=speed, push=st.floats(-50.0, 50.0))
def test_the_guard_treats_up_and_down_alike(q: float, qd: float, push: float):
    one = joints_guarded(np.full(7, push), np.full(7, q), np.full(7, qd))[1]
    other = joints_guarded(np.full(7, -push), np.full(7, -q), np.full(7, -qd))[1]
    np.testing.assert_allclose(one, -other, atol=1e-9)


@given(tau=vector, direction=st.lists(st.floats(-1.0, 1.0), min_size=3, max_size=3), v=st.floats(0.01, 1.5))
def test_the_tip_is_not_pushed_past_its_speed(tau: F64, direction: list[float], v: float):
    size = float(np.linalg.norm(direction))
    if size < 0.1:
        return
    u = np.array(direction) / size
    model = model_at(PANDA_HOME, np.zeros(7))
    rows, most = np.zeros((2, 7)), np.zeros(2)
    tip_bounds(TipMotion(model.J, np.zeros(6), v * u, np.zeros(7)), model.A, model.A_inv, 0.5, RATE, rows, most)
    low = np.full(7, -1e6)
    added, acts = guard(model.A, model.A_inv, tau, low, -low, rows, most)
    before, after = (u @ model.J[:3] @ model.A_inv @ t for t in (tau, tau + added))
    if acts:
        assert v + after * SPEED_HORIZON <= max(0.5, v) + 2e-3
        assert after == pytest.approx(most[0], abs=0.1)
    else:
        assert after == before
        assert v < 0.05 or v + before * SPEED_HORIZON <= 0.5 + 1e-9


def steady(force: F64) -> Callable[[F64], F64]:
    return lambda _: force


def pushed_about(push: Callable[[F64], F64], v: F64, step: float, A: F64 = EYE) -> float:
    """Return the top speed [m/s] of a tip of inertia A pushed about, its force [N] slewed by `step` in each 1 ms."""
    A_inv: F64 = np.asarray(np.linalg.inv(A), np.float64)
    low, sent, top = np.full(3, -1e6), np.zeros(3), 0.0
    for _ in range(2000):
        rows, most = np.zeros((2, 3)), np.zeros(2)
        tip = TipMotion(np.eye(6)[:, :3], np.zeros(6), v, A_inv @ sent)
        tip_bounds(tip, A, A_inv, 0.5, np.full(3, 1e3 * step), rows, most)
        wanted = push(v)
        for _ in range(2):  # what the guards let pass, then what the limiter leaves of it
            wanted = wanted + guard(A, A_inv, wanted, low, -low, rows, most)[0]
            change = wanted - sent
            wanted = sent + change * min(1.0, step / max(float(np.abs(change).max()), 1e-12))  # all as one
        sent = wanted
        v = v + 1e-3 * A_inv @ sent
        top = max(top, float(np.linalg.norm(v)))
    return top


@pytest.mark.parametrize("step", [0.1, 0.2, 1.0])
@pytest.mark.parametrize("strength", [10.0, 60.0, 1000.0])
def test_a_tip_that_is_pushed_aside_keeps_its_speed(step: float, strength: float):
    """A force across its way makes a tip no faster at first; it is too large to be taken back when it does."""
    aside = np.array([0.0, strength, 0.0])
    assert pushed_about(lambda _: aside, np.array([0.5, 0.0, 0.0]), step) <= 1.02 * 0.5


@pytest.mark.parametrize("step", [0.1, 0.2, 1.0])
def test_a_tip_that_is_pushed_aside_all_along_keeps_its_speed(step: float):
    assert pushed_about(lambda v: 120.0 * np.array([-v[1], v[0], 0.0]), np.array([0.5, 0.0, 0.0]), step) <= 1.02 * 0.5


@pytest.mark.parametrize("step", [0.1, 0.2, 1.0])
def test_a_tip_that_is_turned_round_keeps_its_speed(step: float):
    """What brakes it hard would throw it back."""
    assert pushed_about(lambda _: np.array([-1000.0, 0.0, 0.0]), np.array([0.5, 0.0, 0.0]), step) <= 1.02 * 0.5


@pytest.mark.parametrize("heavy", [3.0, 10.0, 30.0, 100.0])
@pytest.mark.parametrize("strength", [100.0, 300.0, 1000.0])
def test_a_tip_whose_joints_are_coupled_keeps_its_speed(heavy: float, strength: float):
    """One joint has the most torque to give back; slewed as one with it, the others follow at its pace."""
    rng = np.random.default_rng(3)
    for _ in range(4):
        Q = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        force = rng.normal(size=3)
        force *= strength / np.linalg.norm(force)
        A = Q @ np.diag([1.0, 1.0, heavy]) @ Q.T
        assert pushed_about(steady(force), np.array([0.45, 0.0, 0.0]), 1.0, A) <= 1.02 * 0.5


def test_a_tip_at_rest_is_not_given_a_push_that_cannot_be_taken_back():
    """As one that brakes hold: no speed yet, but the torque to have it."""
    rows, most = np.zeros((2, 3)), np.zeros(2)
    for push, kept in ((10.0, True), (60.0, False)):  # at 1000 N/s: 0.05 m/s until it is taken back, 1.8 m/s
        tip = TipMotion(np.eye(6)[:, :3], np.zeros(6), np.zeros(3), np.array([push, 0.0, 0.0]))
        tip_bounds(tip, np.eye(3), np.eye(3), 0.5, np.full(3, 1000.0), rows, most)
        assert bool((rows @ tip.qdd <= most).all()) == kept


def test_a_tip_that_brakes_gently_is_not_touched():
    rows, most = np.zeros((2, 3)), np.zeros(2)
    for v in (0.49, 0.3, 0.1, 0.01):
        tip = TipMotion(np.eye(6)[:, :3], np.zeros(6), np.array([v, 0.0, 0.0]), np.array([-5.0, 0.0, 0.0]))
        tip_bounds(tip, np.eye(3), np.eye(3), 0.5, np.full(3, 200.0), rows, most)
        assert (rows @ tip.qdd < most).all()


def beside_wall(x: F64, v: F64, mobility: F64 = EYE) -> tuple[MovingPoints, Field]:
    """Return a point at x (3,) [m] that moves at v (3,) [m/s] before the wall x = 0, and what the field measures."""
    upright = np.array([np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0])
    wall = with_shape(obstacles_empty(2), 0, Shape("wall", "plane", np.zeros(4), ZERO, upright, ZERO, ZERO))
    point = MovingPoints(x[None].copy(), np.eye(3)[None], mobility[None].copy(), np.zeros(1), np.ones(1, np.int64))
    seen = field_buffers(2, 1, 3)
    field(point, ZERO, v, wall, field_params(0.5, 0.1, 0.02, 1e-3, 0.7, 0.0, 50.0), seen, True)
    return point, seen


@pytest.mark.parametrize("pull", [1.0, 30.0, 1000.0])
def test_nothing_is_pulled_into_what_is_near(pull: float):
    """A point of a kilogram, one period of delay, a force towards a wall however large: it stops short of it."""
    eye, rate = np.eye(3), np.full(3, 2000.0)
    x, v, sent, least = 0.049, -0.5, 0.0, np.inf
    for _ in range(1500):
        qd = np.array([v, 0.0, 0.0])
        near = nearby_of(*beside_wall(np.array([x, 0.0, 0.0]), qd), qd, 0.5, 5.0, rate)
        tau, low = np.array([-pull, 0.0, 0.0]), np.full(3, -1e6)
        asked = sent_of(Inertia(eye, eye), Motors(ZERO, FREE[:3]), tau, bounds_of(low, -low), near)[0][0]
        v, x = v + 1e-3 * sent, x + 1e-3 * v
        sent = np.clip(asked, sent - 2.0, sent + 2.0)
        least = min(least, x)
    assert 0.0 < least < 0.01
    assert abs(v) < 0.01


@pytest.mark.parametrize("heavy", [1.0, 10.0])
@pytest.mark.parametrize("pull", [100.0, 1000.0])
def test_nothing_is_pulled_into_what_is_near_by_joints_slewed_as_one(heavy: float, pull: float):
    """What pulls it along the wall takes nearly all of the slew; what stops it comes first all the same."""
    rng, rate, low = np.random.default_rng(5), np.full(3, 2000.0), np.full(3, -1e6)
    for _ in range(3):
        Q = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        A = Q @ np.diag([1.0, 1.0, heavy]) @ Q.T
        A_inv, force = np.ascontiguousarray(np.linalg.inv(A)), rng.normal(size=3)
        force *= pull / np.linalg.norm(force)
        force[0] = -abs(force[0])
        x, v, sent = np.array([0.049, 0.0, 0.0]), np.array([-0.3, 0.0, 0.0]), np.zeros(3)
        for _ in range(1000):
            if v[0] > 0.0:  # turned away
                break
            point, seen = beside_wall(x, v, A_inv)
            tau = force + seen.tau
            for _ in range(2):  # what the guards let pass, then what the limiter leaves of it
                near = nearby_of(point, seen, v, 0.5, 5.0, rate)
                inertia, motors = Inertia(A, A_inv), Motors(ZERO, FREE[:3])
                change = sent_of(inertia, motors, tau, bounds_of(low, -low), near, A_inv @ sent)[0] - sent
                tau = sent + change * min(1.0, 2.0 / max(float(np.abs(change).max()), 1e-12))
            v = v + 1e-3 * A_inv @ sent
            x, sent = x + 1e-3 * v, tau
            assert x[0] > 0.002


def crowd(seed: int, slots: int = 24) -> tuple[Model, MovingPoints, Field, F64, F64]:
    """Return the arm among balls near its links: model, points, what the field measures, qd, torque rates."""
    rng, arm = np.random.default_rng(seed), robot()
    qd = 0.1 * rng.normal(size=7)
    model, table = model_at(PANDA_HOME + 0.2 * rng.normal(size=7), qd), obstacles_empty(slots)
    for k in range(slots):
        j, away = int(rng.integers(len(arm.points.radius))), rng.normal(size=3)
        away *= (arm.points.radius[j] + 0.02 + rng.uniform(0.005, 0.06)) / np.linalg.norm(away)
        table = with_shape(table, k, sphere(str(k), (model.P[j] + away).tolist(), 0.02))
    points = MovingPoints(model.P, model.Jp, model.B, arm.points.radius, arm.points.link)
    seen = field_buffers(slots, len(arm.points.radius), 7)
    field(points, np.zeros(7), qd, table, arm.avoid, seen, True)
    return model, points, seen, qd, arm.tau_rate


def explicit(model: Model, points: MovingPoints, seen: Field, qd: F64, rate: F64) -> tuple[F64, F64]:
    """Return every row that approaches an obstacle in the zone, and its bound, by the words of the docstrings alone."""
    rows, most, p = [], [], robot()
    for k in range(len(seen.rho_min)):
        rho = seen.pairs[k, 0]
        for link in range(8):
            mine = (points.link == link) & (rho < 0.5 * p.avoid.rho0)
            if not mine.any():
                continue
            for j in np.flatnonzero(mine & (rho < rho[mine].min() + 0.02)):
                row = -seen.pairs[k, 1:4, j] @ points.Jp[j]
                jerk = 0.5 * (row @ model.A_inv @ row) / max(1e-9, float((np.abs(row) / rate).max()))
                rows.append(row)
                most.append(approach_bound(rho[j], float(row @ qd), np.inf, p.motion.a_max, jerk))
    return np.array(rows).reshape(-1, 7), np.array(most)


@settings(deadline=None, max_examples=60)
@given(seed=st.integers(0, 1 << 32), force=st.floats(0.0, 100.0))
def test_rows_that_are_made_only_when_passed_give_the_answer_of_all_of_them(seed: int, force: float):
    model, points, seen, qd, rate = crowd(seed)
    tau = force * np.random.default_rng(seed + 1).normal(size=7)
    C, b = explicit(model, points, seen, qd, rate)
    low = np.full(7, -1e3)
    near = nearby_of(points, seen, qd, 0.5, robot().motion.a_max, rate)
    assert near.size == len(b)
    got, _ = sent_of(Inertia(model.A, model.A_inv), Motors(np.zeros(7), FREE), tau, bounds_of(low, -low), near)
    wanted = model.A_inv @ tau
    best = nearest(model.A, wanted, np.vstack((np.eye(7), -np.eye(7), C)), np.concatenate((-low, -low, b)))
    np.testing.assert_allclose(model.A_inv @ got, np.clip(best, low, -low), atol=1e-5 * (1.0 + np.abs(best).max()))


@settings(deadline=None, max_examples=60)
@given(seed=st.integers(0, 1 << 32))
def test_cheap_bounds_are_never_above_the_true_ones(seed: int):
    model, points, seen, qd, rate = crowd(seed)
    _, b = explicit(model, points, seen, qd, rate)
    near = nearby_of(points, seen, qd, 0.5, robot().motion.a_max, rate)
    assert (np.diff(points.link) >= 0).all()  # so both lists have the same order
    assert (near.found.most[: near.size] <= b).all()
    assert not near.size or (near.found.most[: near.size] < b).any()


@given(tau=vector, load=vector)
def test_a_field_beyond_the_motors_loses_strength_not_direction(tau: F64, load: F64):
    tau_max = np.array([80.0, 80.0, 80.0, 80.0, 11.0, 11.0, 11.0])
    share = scale_to_limits(tau, load, tau_max)
    assert 0.0 < share <= 1.0
    spare = np.minimum(tau_max, tau_max - np.sign(tau) * load)
    assert (np.abs(share * tau) <= np.maximum(spare, 0.2 * tau_max) * (1 + 1e-9)).all()
    assert share == 1.0 or (np.abs(share * tau) >= np.maximum(spare, 0.2 * tau_max) * (1 - 1e-9)).any()


def test_two_links_that_close_fast_are_neither_thrown_back_nor_brought_to_touch():
    """A kilogram between them, torque that takes 20 ms to brake: their field alone throws them back at 1.9 m/s."""
    arm, eye, least, back = robot(), np.eye(3), np.inf, 0.0
    params, row = arm.self_avoid, np.array([[1.0, 0.0, 0.0]])
    x, v, sent, step = arm.own.reach, -0.5, 0.0, 0.25  # [m], [m/s], [N], [N] in a period
    for _ in range(400):
        qd, rho = np.array([v, 0.0, 0.0]), np.array([x if x < arm.own.reach else np.inf])
        push, _, _ = own_field(rho, row, ZERO, qd, eye, params, NO_ENDS)
        low = np.full(3, -1e6)
        bounds = Bounds(low, -low, np.zeros((3, 3)), np.full(3, np.inf))
        approach = ApproachParams(arm.avoid.rho0, params.rho_min, arm.motion.v_max, arm.motion.a_max)
        self_bounds(SelfPairs(rho, row, ZERO), eye, qd, approach, np.full(3, 1e3 * step), bounds)
        added, _ = guard(eye, eye, push, low, -low, bounds.rows, bounds.most)
        sent += np.clip((push + added)[0] - sent, -step, step)
        v, x = v + 1e-3 * sent, x + 1e-3 * v
        least, back = min(least, x), max(back, v)
    assert least > 0.5 * params.rho_min
    assert back < 0.25  # half of what it came with

"""The guards' formulas, each against its own words, and their search against another solver.

What bounds are and which rows there are is written anew here, with numbers of its own: slow, with numpy alone.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize_scalar

from rtctl.arm import least_change
from rtctl.arm.bounds import (
    ApproachParams,
    MotionLimits,
    SelfPairs,
    TipMotion,
    acceleration_bound,
    approach_bound,
    joint_bounds,
    self_bounds,
    slew_time,
    tip_bounds,
)
from rtctl.arm.field import Field, MovingPoints, field_buffers
from rtctl.arm.guards import Inertia, Motors, hold_back, let_pass, passed
from rtctl.arm.least_change import Rows, rows_in, rows_sizes
from rtctl.arm.nearby import APPROACH_ZONE, Nearby, accelerate, look_near, nearby_in, towards
from rtctl.arm.scaling import scale_drive_to_limits, scale_to_limits
from rtctl.types import F64
from tests.guarding import SOFTNESS, bounds_of, guard, nearby_of, nearest, nothing_near, sent_of

HORIZON = 0.02  # [s] in which a speed may be brought back to its bound
SEEDS = 40


class Mass(NamedTuple):
    """An inertia with which every joint acts on every other."""

    A: F64
    A_inv: F64


def mass(rng: np.random.Generator, n: int) -> Mass:
    M = rng.normal(size=(n, n))
    A = M @ M.T + 0.1 * np.eye(n)
    return Mass(A, np.ascontiguousarray(np.linalg.inv(A)))


def may_accelerate(bound: float, speed: float, jerk: float) -> float:
    gap = bound - speed
    return gap / HORIZON if gap <= 0.0 else min(gap / HORIZON, float(np.sqrt(2 * jerk * gap)))


def may_approach(room: float, speed: float, top: float, braking: float, jerk: float) -> float:
    curve = np.sqrt(2 * braking * max(0.0, room - 2 * HORIZON**2 * braking))
    if curve >= top:
        return may_accelerate(top, speed, jerk)
    falls = braking * np.clip(speed / max(curve, HORIZON * braking), 0.0, 1.0)
    return float(may_accelerate(curve, speed, jerk) - falls)


def jerk_of(row: F64, A_inv: F64, rate: F64) -> float:
    return float(0.5 * (row @ A_inv @ row) / max(1e-9, (np.abs(row) / rate).max()))


@pytest.mark.parametrize("seed", range(SEEDS))
def test_a_speed_may_come_to_its_bound_and_no_farther(seed: int):
    rng = np.random.default_rng(seed)
    bound, speed, jerk = rng.uniform(0.0, 2.0), rng.uniform(-1.0, 3.0), 10.0 ** rng.uniform(-1.0, 4.0)
    assert acceleration_bound(bound, speed, jerk) == pytest.approx(may_accelerate(bound, speed, jerk), rel=1e-12)
    room, top, braking = rng.choice([-0.1, 0.0, 1e-4, 0.05, 1.0]), rng.choice([0.3, 2.0, np.inf]), rng.uniform(0.5, 20)
    for v in (speed, -speed, 0.0):
        got = approach_bound(room, v, top, braking, jerk)
        assert got == pytest.approx(may_approach(room, v, top, braking, jerk), rel=1e-12, abs=1e-12)
    edge = 2 * HORIZON**2 * braking + top**2 / (2 * braking) if np.isfinite(top) else 1.0
    for room in (0.99 * edge, edge, 1.01 * edge):
        got = approach_bound(room, 0.5 * bound, top, braking, jerk)
        assert got == pytest.approx(may_approach(room, 0.5 * bound, top, braking, jerk), rel=1e-9)


@pytest.mark.parametrize("seed", range(SEEDS))
def test_joints_keep_what_they_can_brake_with_the_torque_rate_of_all(seed: int):
    rng, n = np.random.default_rng(seed), 1 + seed % 5
    A = mass(rng, n).A
    if seed % 3 == 0:
        A = np.diag(np.diag(A))  # joints that do not act on each other
    q, qd = rng.uniform(-1.1, 1.1, n), rng.uniform(-2.5, 2.5, n)
    low, high = -rng.uniform(0.5, 1.0, n), rng.uniform(0.5, 1.0, n)
    qd_max, braking, tau_max = rng.uniform(1.0, 3.0, (3, n))
    limits = MotionLimits(low, high, qd_max, braking, tau_max, rng.uniform(10.0, 1e3, n))
    low, high = np.empty(n), np.empty(n)
    with np.errstate(invalid="ignore"):  # no share of a joint times a jerk without bound, where the interpreter runs it
        joint_bounds(A, q, qd, limits, low, high)
    for i in range(n):
        with np.errstate(divide="ignore"):
            jerk = float((0.5 * limits.tau_rate / np.abs(A[:, i])).min())
        top = 0.9 * limits.qd_max[i]
        up = may_approach(limits.q_max[i] - q[i], qd[i], top, limits.braking[i], jerk)
        down = -may_approach(q[i] - limits.q_min[i], -qd[i], top, limits.braking[i], jerk)
        if down > 0.0:
            up = max(up, down)
        elif up < 0.0:
            down = min(down, up)
        assert (low[i], high[i]) == pytest.approx((down, up), rel=1e-12)


@pytest.mark.parametrize("qd", [-0.3, -0.02, -0.005, -0.001, 0.0, 0.001, 0.005, 0.02, 0.3])
def test_a_joint_that_must_brake_is_not_asked_to_do_so_gently(qd: float):
    """Between limits that are nearly one: each side says how hard it must brake at least."""
    low, high = np.empty(1), np.empty(1)
    one = np.ones(1)
    joint_bounds(
        np.eye(1), 0.0 * one, qd * one, MotionLimits(-1e-4 * one, 1e-4 * one, one, 10 * one, one, one), low, high
    )
    must = abs(qd) / 0.02 + min(abs(qd) / 0.02, 10.0)
    if qd > 0.0:
        assert high[0] == pytest.approx(-must)
        assert low[0] == high[0]
    elif qd < 0.0:
        assert low[0] == pytest.approx(must)
        assert high[0] == low[0]
    else:
        assert low[0] == high[0] == 0.0


def tip_rows(tip: TipMotion, m: Mass, v_max: float, rate: F64) -> tuple[F64, F64]:
    """Return rows (2, n) and bounds (2,), inf for none, that keep a tip's speed."""
    J, v = tip.J[:3], tip.xd
    speed, a = float(np.linalg.norm(v)), J @ tip.qdd + tip.Jdqd[:3]
    slow, slews = speed < 0.1 * v_max, float((np.abs(m.A @ tip.qdd) / rate).max())
    rows, most = np.zeros((2, J.shape[1])), np.full(2, np.inf)

    def along(u: F64) -> tuple[F64, float, float]:
        row = u @ J
        return row, jerk_of(row, m.A_inv, rate), float(u @ tip.Jdqd[:3])

    if not slow:
        rows[0], jerk, drift = along(v / speed)
        most[0] = may_accelerate(v_max, speed, jerk) - drift
    if a.any():
        size = float(np.linalg.norm(a))
        T = max(size / along(a / size)[1], slews)
        p = v + 0.5 * T * a
        peak = float(np.linalg.norm(p))
        if peak >= 0.1 * v_max and (slow or v @ p < 0.999 * peak * speed):
            rows[1], jerk, drift = along(p / peak)
            now = float(v @ p) / peak
            bound = may_accelerate(v_max, now, jerk)
            if now < v_max and slews > 0.0:
                bound = min(bound, 2 * (v_max - now) / slews)
            most[1] = bound - drift
    return rows, most


@pytest.mark.parametrize("seed", range(4 * SEEDS))
def test_the_tip_is_bound_along_its_way_and_along_that_which_its_acceleration_leads_to(seed: int):
    rng, n, v_max = np.random.default_rng(seed), 3 + seed % 4, 0.5
    m, rate = mass(rng, n), rng.uniform(50.0, 2000.0, n)
    v = rng.normal(size=3)
    v *= rng.choice([0.0, 0.03, 0.0502, 0.06, 0.3, 0.499, 0.7]) / np.linalg.norm(v)
    J = rng.normal(size=(6, n))
    force = 10.0 ** rng.uniform(-1.0, 3.0) * rng.normal(size=n)
    if seed % 5 == 0:
        force = 20.0 * (J[:3].T @ v)  # along its way: one row is enough
    if seed % 7 == 0:
        force = np.zeros(n)
    Jdqd = np.append(rng.normal(size=3), rng.normal(size=3)) * (seed % 2)
    tip = TipMotion(J, Jdqd, v, m.A_inv @ force)
    rows, most = np.full((2, n), np.nan), np.full(2, np.nan)
    tip_bounds(tip, m.A, m.A_inv, v_max, rate, rows, most)
    wanted, bound = tip_rows(tip, m, v_max, rate)
    np.testing.assert_allclose(most, bound, rtol=1e-9)
    for r in np.flatnonzero(np.isfinite(bound)):
        np.testing.assert_allclose(rows[r], wanted[r], atol=1e-9)
    assert slew_time(m.A, tip.qdd, rate) == pytest.approx(float((np.abs(force) / rate).max()), rel=1e-9)


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("push", [0.1, 0.2, 20.0])
def test_a_tip_at_rest_is_bound_along_its_acceleration_however_small(axis: int, push: float):
    """Weak motors: half a newton takes a second to be taken back."""
    eye, rate, force = Mass(np.eye(3), np.eye(3)), np.full(3, 0.5), np.zeros(3)
    force[axis] = push
    tip = TipMotion(np.eye(6)[:, :3], np.zeros(6), np.zeros(3), force)
    rows, most = np.zeros((2, 3)), np.zeros(2)
    tip_bounds(tip, eye.A, eye.A_inv, 0.5, rate, rows, most)
    wanted, bound = tip_rows(tip, eye, 0.5, rate)
    np.testing.assert_allclose(most, bound)
    assert np.isinf(most[0])
    assert np.isinf(most[1]) == (push < 0.158)  # a T/2 at half the torque rate, T = a/0.25: a tenth of v_max
    if push > 0.158:
        np.testing.assert_allclose(rows[1], wanted[1])


@pytest.mark.parametrize("seed", range(SEEDS))
def test_links_of_the_arm_are_bound_by_what_is_left_between_them_by_now(seed: int):
    rng, n, L = np.random.default_rng(seed), 2 + seed % 4, 6
    m, rate, qd = mass(rng, n), rng.uniform(50.0, 2000.0, n), rng.normal(size=n)
    rho = rng.uniform(0.0, 0.3, L)
    rho[rng.integers(L)] = np.inf
    pairs = SelfPairs(rho, rng.normal(size=(L, n)), 0.01 * rng.normal(size=n))
    p = ApproachParams(0.2, 0.05, 0.6, rng.uniform(1.0, 8.0))
    out = bounds_of(np.zeros(n), np.zeros(n), np.zeros((2 + L, n)), np.full(2 + L, np.nan))
    self_bounds(pairs, m.A_inv, qd, p, rate, out)
    assert np.isnan(out.most[:2]).all()  # the tip's are not touched
    for s in range(L):
        if rho[s] == np.inf:
            assert out.most[2 + s] == np.inf
            continue
        row, room = -pairs.row[s], rho[s] + pairs.row[s] @ pairs.dq
        jerk, speed = jerk_of(row, m.A_inv, rate), float(row @ qd)
        fast = may_approach(room - 0.05, speed, np.inf, p.braking, jerk)
        free = may_approach(room, speed, 0.15 * 0.6, p.braking, jerk)
        np.testing.assert_allclose(out.rows[2 + s], row)
        assert out.most[2 + s] == pytest.approx(max(fast, free), rel=1e-9)


class Crowd(NamedTuple):
    """Points near obstacles: any distances and normals, with what the field writes of them."""

    m: Mass
    points: MovingPoints
    seen: Field
    qd: F64
    rate: F64


def crowd(seed: int) -> Crowd:
    rng, n, K, points = np.random.default_rng(seed), 4, 3, 12
    m, Jp, qd = mass(rng, n), rng.normal(size=(points, 3, n)), 0.2 * rng.normal(size=n)
    Jp[0] = 0.0  # a point that no joint moves
    B = np.einsum("jdi,ik,jek->jde", Jp, m.A_inv, Jp)
    moving = MovingPoints(np.zeros((points, 3)), Jp, B, np.zeros(points), np.sort(rng.integers(0, 3, points)))
    seen = field_buffers(K, points, n)
    seen.points[3:6] = np.einsum("jdi,i->dj", Jp, qd)
    for row, (a, b) in enumerate(((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))):
        seen.points[6 + row] = B[:, a, b]
    for k in range(K):
        normal = rng.normal(size=(3, points))
        seen.pairs[k, 0] = rng.uniform(0.0, 0.12, points)
        seen.pairs[k, 1:4] = normal / np.linalg.norm(normal, axis=0)
        near = np.flatnonzero(rng.uniform(size=points) < 0.7)
        seen.near[k, : len(near)], seen.near_count[k] = near, len(near)
        seen.rooms[k, 0], seen.rooms[k, 5] = rng.uniform(0.1, 0.2), rng.choice([0.0, 0.01])
        seen.rho_min[k] = seen.pairs[k, 0, near].min(initial=np.inf)
        seen.leader[k] = k if seed % 3 or k else -1
    if seed % 4 == 0:
        seen.rho_min[1] = 0.5 * seen.rooms[1, 0] + seen.rooms[1, 5]  # beyond the zone, by what stands there
    return Crowd(m, moving, seen, qd, rng.uniform(50.0, 2000.0, n))


def rows_of(c: Crowd, share: float, braking: float) -> tuple[list[tuple[int, int]], F64, F64]:
    """Return slot and point of all that counts, in order, with their rows and bounds."""
    places, rows, most = [], [], []
    for k in range(len(c.seen.leader)):
        zone = share * c.seen.rooms[k, 0] + c.seen.rooms[k, 5]
        if c.seen.leader[k] < 0 or c.seen.rho_min[k] >= zone:
            continue
        rho = c.seen.pairs[k, 0]
        near = [j for j in c.seen.near[k, : c.seen.near_count[k]] if rho[j] < zone]
        for j in near:
            first = min(rho[i] for i in near if c.points.link[i] == c.points.link[j])
            if rho[j] < min(zone, first + 0.02):
                row = -c.seen.pairs[k, 1:4, j] @ c.points.Jp[j]
                jerk = jerk_of(row, c.m.A_inv, c.rate)
                places.append((k, int(j)))
                rows.append(row)
                most.append(may_approach(rho[j] - c.seen.rooms[k, 5], float(row @ c.qd), np.inf, braking, jerk))
    return places, np.array(rows).reshape(-1, 4), np.array(most)


@pytest.mark.parametrize("seed", range(SEEDS))
def test_what_counts_near_an_obstacle_and_bounds_that_cost_little(seed: int):
    c = crowd(seed)
    near = nearby_of(c.points, c.seen, c.qd, APPROACH_ZONE, 5.0, c.rate)
    places, rows, most = rows_of(c, 0.5, 5.0)
    found = near.found
    assert [(int(k), int(j)) for k, j in found.place[:2, : near.size].T] == places
    assert (found.place[2, : near.size] == 0).all()
    assert (found.most[: near.size] <= most).all()
    for i, (k, j) in enumerate(places):
        b = rows[i] @ c.m.A_inv @ rows[i]
        steepest = max(1e-9, float((np.linalg.norm(c.points.Jp[j], axis=0) / c.rate).max()))
        room = c.seen.pairs[k, 0, j] - c.seen.rooms[k, 5]
        cheap = may_approach(room, float(rows[i] @ c.qd), np.inf, 5.0, 0.5 * b / steepest)
        assert found.most[i] == pytest.approx(cheap, rel=1e-6, abs=1e-6)
    x = np.random.default_rng(seed).normal(size=4)
    accelerate(x, near)
    for i in range(near.size):
        assert towards(i, near) == pytest.approx(rows[i] @ x, rel=1e-9)


def test_room_for_candidates_is_used_once_and_wholly():
    c, room = crowd(1), 5
    m, n, views = 12, 4, getattr(nearby_in, "py_func", nearby_in)
    whole, real = np.zeros(3 * room + 1, np.int64), np.zeros(room + 4 * m + n + 1)
    whole[-1] = 3
    near: Nearby = views(whole, real, c.points, c.seen, c.qd, 5.0, c.rate)
    assert near.size == 3
    for i, part in enumerate(near.found, 1):
        part[...] = i
    assert all((part == i).all() for i, part in enumerate(near.found, 1))
    assert [part.shape for part in near.found] == [(3, room), (room,), (4, m), (n + 1,)]


def test_more_candidates_than_there_is_room_for_are_left_out():
    c = crowd(1)
    every = len(rows_of(c, 0.5, 5.0)[0])
    views = getattr(nearby_in, "py_func", nearby_in)
    for room in (1, every // 2):
        whole, real = np.zeros(3 * room + 1, np.int64), np.zeros(room + 4 * 12 + 5)
        near: Nearby = views(whole, real, c.points, c.seen, c.qd, 5.0, c.rate)
        assert look_near(near, 0.5) <= room


@pytest.mark.parametrize("seed", range(SEEDS))
def test_an_acceleration_passes_when_it_passes_one_bound(seed: int):
    """Each bound alone, from both sides."""
    rng, c = np.random.default_rng(seed), crowd(seed)
    x, rows = rng.normal(size=4), rows_of(c, 0.5, 5.0)[1]
    near, wide = nearby_of(c.points, c.seen, c.qd, APPROACH_ZONE, 5.0, c.rate), np.full(4, 50.0)
    near.found.most[: near.size] = rows @ x + 1.0
    C = rng.normal(size=(3, 4))
    free = np.array([*(C[:2] @ x + 1.0), np.inf])
    assert not passed(x, bounds_of(-wide, wide, C, free), near)
    for i in range(4):
        for shift, over in ((1e-6, False), (-1e-6, True)):
            edge = np.where(np.arange(4) == i, x + shift, 50.0)
            assert passed(x, bounds_of(-wide, edge, C, free), near) == over
            assert passed(x, bounds_of(np.where(np.arange(4) == i, x - shift, -50.0), wide, C, free), near) == over
    for r in range(2):
        for shift, over in ((1e-6, False), (-1e-6, True)):
            tight = np.where(np.arange(3) == r, C @ x + shift, np.inf)
            assert passed(x, bounds_of(-wide, wide, C, tight), near) == over
    for i in range(near.size):
        kept = near.found.most[i]
        near.found.most[i] = rows[i] @ x - 1e-6
        assert passed(x, bounds_of(-wide, wide, C, free), near)
        near.found.most[i] = kept


def test_what_is_at_its_bound_passes_none():
    c, x, wide = crowd(2), np.array([1.0, -2.0, 3.0, 0.5]), np.full(4, 50.0)
    near = nearby_of(c.points, c.seen, c.qd, APPROACH_ZONE, 5.0, c.rate)
    accelerate(x, near)
    near.found.most[: near.size] = [towards(i, near) for i in range(near.size)]
    row = np.array([[0.0, 1.0, 0.0, 0.0]])
    assert near.size > 1
    assert not passed(x, bounds_of(x, x, row, np.array([-2.0])), near)
    one = near._replace(size=1)
    assert not passed(x, bounds_of(-wide, wide), one)
    one.found.most[0] -= 1e-9
    assert passed(x, bounds_of(-wide, wide), one)


@given(seed=st.integers(0, 1 << 32), rows=st.integers(0, 40), contradicting=st.booleans(), start=st.booleans())
def test_what_the_guards_change_is_the_least_that_keeps_every_bound(
    seed: int, rows: int, contradicting: bool, start: bool
):
    """Against quadprog, on bounds that can all be kept and on those that cannot."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 9))
    A, A_inv = mass(rng, n)
    wanted = rng.normal(0.0, 20.0, n)
    C, feasible = rng.normal(size=(rows, n)), rng.normal(0.0, 10.0, n)
    b = C @ feasible + rng.uniform(-3.0 if contradicting else 0.0, 3.0, rows)
    low, high = feasible - rng.uniform(0.1, 20.0, n), feasible + rng.uniform(0.1, 20.0, n)
    added, acts = guard(A, A_inv, A @ wanted, low, high, C, b, rng.normal(size=n) if start else None)
    found = wanted + A_inv @ added
    best = nearest(A, wanted, np.vstack((np.eye(n), -np.eye(n), C)), np.concatenate((high, -low, b)))
    np.testing.assert_allclose(found, np.clip(best, low, high), atol=1e-5 * (1.0 + np.abs(best).max()))
    assert acts == bool((wanted > high).any() or (wanted < low).any() or (C @ wanted > b).any())


def room_for(tau: F64, load: F64, tau_max: F64) -> float:
    """Return the share of tau that motors have beside the load, a fifth of what they give in any case."""
    spare = np.where(tau > 0.0, tau_max - load, tau_max + load)
    spare = np.maximum(np.minimum(spare, tau_max), 0.2 * tau_max)
    return min(1.0, float((spare / np.maximum(np.abs(tau), 1e-300)).min()))


@settings(max_examples=60)
@given(seed=st.integers(0, 1 << 32), force=st.floats(1.0, 100.0), weak=st.booleans(), start=st.booleans())
def test_motors_that_lack_strength_give_less_of_what_was_wanted_and_brake_all_the_same(
    seed: int, force: float, weak: bool, start: bool
):
    rng, c = np.random.default_rng(seed), crowd(seed % 1000)
    tau, load, tau_max = force * rng.normal(size=4), rng.normal(size=4), np.full(4, 5.0 if weak else 1e6)
    _, C, b = rows_of(c, 0.5, 5.0)
    near, wide = nearby_of(c.points, c.seen, c.qd, APPROACH_ZONE, 5.0, c.rate), np.full(4, 200.0)
    moves = C.any(axis=1)  # a point that no joint moves cannot be stopped either
    G, most = np.vstack((np.eye(4), -np.eye(4), C[moves])), np.concatenate((wide, wide, b[moves]))

    def kept(t: F64) -> F64:
        wanted = c.m.A_inv @ t
        best = wanted if (G @ wanted <= most).all() else np.clip(nearest(c.m.A, wanted, G, most), -wide, wide)
        out: F64 = c.m.A @ best
        return out

    sent = kept(tau)
    share = room_for(sent, load, tau_max)
    if share < 1.0:
        sent = kept(share * tau)
        share = room_for(sent, load, tau_max)
    motors, inertia = Motors(load, tau_max), Inertia(c.m.A, c.m.A_inv)
    got, acts = sent_of(inertia, motors, tau, bounds_of(-wide, wide), near, rng.normal(size=4) if start else None)
    assert weak or acts == bool((G @ c.m.A_inv @ tau > most).any())
    np.testing.assert_allclose(got, share * sent, atol=2e-5 * (1.0 + np.abs(sent).max()))


@pytest.mark.parametrize("seed", range(4 * SEEDS))
def test_less_is_sent_in_the_same_direction_and_no_less_than_must_be(seed: int):
    rng, n = np.random.default_rng(seed), 1 + seed % 4
    tau_max = rng.uniform(0.5, 40.0, n)
    tau, load = rng.choice([0.5, 30.0]) * rng.normal(size=n), 0.7 * tau_max * rng.normal(size=n)
    tau[rng.uniform(size=n) < 0.2] = 0.0
    assert scale_to_limits(tau, load, tau_max) == pytest.approx(room_for(tau, load, tau_max), rel=1e-12)
    shares = np.linspace(0.0, 1.0, 100001)
    within = (np.abs(load + shares[:, None] * tau) <= tau_max).all(axis=1)
    got = scale_drive_to_limits(tau, load, tau_max)
    if within[0]:
        assert got == pytest.approx(float(shares[within].max()), abs=2e-5)
    beyond = np.abs(load) > tau_max
    if (beyond & (tau * load > 0.0)).any():  # what would go farther beyond gives nothing
        assert got == 0.0
    elif not beyond[tau != 0.0].any():  # a joint that is not driven has no say
        assert (np.abs(load + got * tau) <= tau_max * (1.0 + 1e-12))[tau != 0.0].all()
        assert got == 1.0 or (np.abs(load + got * tau) >= tau_max * (1.0 - 1e-12))[tau != 0.0].any()


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_little_torque_beside_a_load_has_the_room_of_its_own_side(sign: float):
    """Half a newton metre where a motor of 1 Nm carries 0.8: a fifth of it; with the load there is more room."""
    one = np.ones(1)
    assert scale_to_limits(0.5 * sign * one, 0.8 * sign * one, one) == pytest.approx(0.4)
    assert scale_to_limits(0.5 * sign * one, -0.8 * sign * one, one) == 1.0
    assert scale_drive_to_limits(0.5 * sign * one, 0.75 * sign * one, one) == pytest.approx(0.5)
    assert scale_drive_to_limits(0.5 * sign * one, -0.75 * sign * one, one) == 1.0


@pytest.mark.parametrize("heavy", [0.5, 1.0, 2.0])
def test_what_passes_no_bound_may_pass_one_when_there_is_less_of_it(heavy: float):
    """A joint that must brake harder than the motors let it: less of the same torque is no answer."""
    near, work, inertia = nothing_near(2), np.zeros((2, 2)), Inertia(heavy * np.eye(2), np.eye(2) / heavy)
    low, high, tau = np.full(2, -1e3), np.array([1e3, -5.0 / heavy]), np.array([40.0, -8.0])
    strong, weak = Motors(np.zeros(2), np.full(2, 50.0)), Motors(np.zeros(2), np.full(2, 20.0))
    assert let_pass(inertia, strong, tau, bounds_of(low, high), near, work)
    np.testing.assert_array_equal(work[0], tau)
    assert not let_pass(inertia, weak, tau, bounds_of(low, high), near, work)
    assert let_pass(inertia, weak, tau, bounds_of(low, -low), near, work)
    np.testing.assert_allclose(work[0], 0.5 * tau)


def test_a_joint_that_passes_its_bound_a_little_takes_the_others_with_it():
    """Its own acceleration is cut; the others' change as if a stop held it."""
    A = np.array([[2.0, 1.0], [1.0, 1.0]])
    A_inv, wanted, wide = np.linalg.inv(A), np.array([5.5, 1.0]), np.full(2, 50.0)
    for sign in (1.0, -1.0):
        edge = np.array([5.0, 50.0])
        low, high = (-wide, edge) if sign > 0.0 else (-edge, wide)
        added, acts = guard(A, A_inv, A @ (sign * wanted), low, high, np.zeros((0, 2)), np.zeros(0))
        assert acts
        # its force, along the joint alone, moves the other by A_inv[1, 0] / A_inv[0, 0] of what it takes from the first
        got = sign * (sign * wanted + A_inv @ added)
        np.testing.assert_allclose(got, [5.0, 1.0 - 0.5 * A_inv[1, 0] / A_inv[0, 0]], atol=1e-3)


def test_a_bound_that_only_looked_passed_changes_nothing():
    """Beyond the bound that costs little, within the true one."""
    found = 0
    for seed in range(SEEDS):
        c = crowd(seed)
        near = nearby_of(c.points, c.seen, c.qd, APPROACH_ZONE, 5.0, c.rate)
        _, rows, most = rows_of(c, 0.5, 5.0)
        cheap, wide = near.found.most[: near.size].copy(), np.full(4, 1e3)
        for i in range(near.size):
            if not rows[i].any() or most[i] - cheap[i] < 1e-3:
                continue
            x = rows[i] * (0.5 * (cheap[i] + most[i]) / (rows[i] @ rows[i]))
            if (rows @ x >= most).any() or (np.abs(x) > wide).any():
                continue
            tau, motors = c.m.A @ x, Motors(np.zeros(4), np.full(4, np.inf))
            near = nearby_of(c.points, c.seen, c.qd, APPROACH_ZONE, 5.0, c.rate)
            got, acts = sent_of(Inertia(c.m.A, c.m.A_inv), motors, tau, bounds_of(-wide, wide), near)
            np.testing.assert_allclose(got, tau)
            assert not acts
            found += 1
    assert found > 10


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_start_that_is_not_a_number_changes_nothing(value: float):
    rng = np.random.default_rng(3)
    A, A_inv = mass(rng, 7)
    tau, rows, low = rng.normal(0.0, 20.0, 7), rng.normal(size=(3, 7)), np.full(7, -5.0)
    from_rest = guard(A, A_inv, tau, low, -low, rows, np.ones(3))
    from_there = guard(A, A_inv, tau, low, -low, rows, np.ones(3), np.full(7, value))
    assert from_there[0].tobytes() == from_rest[0].tobytes()
    assert from_rest[1]


def test_more_rows_than_there_is_room_for_end_in_bounds_of_the_joints():
    rng, n = np.random.default_rng(1), 3
    A, A_inv = mass(rng, n)
    tau, low = np.array([500.0, -300.0, 200.0]), np.full(n, -2.0)
    added, acts = guard(A, A_inv, tau, low, -low, rng.normal(size=(700, n)), np.zeros(700))
    assert acts
    assert (np.abs(A_inv @ (tau + added)) <= 2.0 + 1e-9).all()


def test_of_more_rows_than_there_is_room_for_those_made_first_are_kept():
    """Rows push the joints past their bounds, for which there is no room any more, nor for what is near."""
    c, wide = crowd(2), np.full(4, 2.0)
    near = nearby_of(c.points, c.seen, c.qd, APPROACH_ZONE, 5.0, c.rate)
    rows = np.tile(np.array([-1.0, 0.0, 0.0, 0.0]), (700, 1))
    bounds, motors = bounds_of(-wide, wide, rows, np.full(700, -10.0)), Motors(np.zeros(4), np.full(4, np.inf))
    got, acts = sent_of(Inertia(c.m.A, c.m.A_inv), motors, np.zeros(4), bounds, near)
    assert acts
    assert (np.abs(c.m.A_inv @ got) <= 2.0 + 1e-9).all()
    assert c.m.A_inv[0] @ got == pytest.approx(2.0)


def test_a_search_counts_its_steps():
    """One row that yields a little is passed before the step and after it: one step."""
    n, s, work = 2, room_of_rows(2), np.zeros((2, 2))
    s.x[0], s.numbers[1] = 0.0, 29
    near = nothing_near(n)
    inertia, motors, low = Inertia(np.eye(n), np.eye(n)), Motors(np.zeros(n), np.full(n, np.inf)), np.full(n, -9.0)
    bounds = bounds_of(low, -low, np.array([[-1.0, 0.0]]), np.array([-5.0]))
    assert hold_back(s, inertia, motors, np.zeros(n), bounds, near, np.zeros(5, np.int64), work)
    assert s.numbers[1] == 1
    assert work[0] == pytest.approx([5.0, 0.0], rel=1e-3)


def room_of_rows(n: int) -> Rows:
    real, whole = rows_sizes(n)
    made: Rows = getattr(rows_in, "py_func", rows_in)(np.zeros(real), np.zeros(whole, np.int64), n)
    return made


def test_room_for_rows_is_used_once_and_wholly():
    n = 3
    real, whole = rows_sizes(n)
    more = np.zeros(real + 50), np.zeros(whole + 5, np.int64)
    s: Rows = getattr(rows_in, "py_func", rows_in)(*more, n)
    for i, part in enumerate(s, 1):
        part[...] = i
    assert all((part == i).all() for i, part in enumerate(s, 1))
    assert sum(part.size for part in s[:-1]) == real
    assert s.numbers.size == whole
    assert s.C.shape == (512, n)


def filled(seed: int) -> tuple[Rows, Mass, F64]:
    """Return some rows, some of which x[0] passes, the inertia and what is wanted."""
    rng, n = np.random.default_rng(seed), 1 + seed % 5
    s, m, count = room_of_rows(n), mass(rng, n), seed % 7
    s.x[:] = rng.normal(size=(2, n))
    for r in range(count):
        s.C[r] = rng.normal(size=n)
        least_change.add_row(s, float(rng.normal()), least_change.mobility(m.A_inv, s.C, r))
    return s, m, rng.normal(size=n)


def cost(s: Rows, m: Mass, wanted: F64) -> Callable[[F64], float]:
    """Return what is to be least, of x."""
    count = s.numbers[0]
    k = 1.0 / (SOFTNESS * np.einsum("ci,ij,cj->c", s.C[:count], m.A_inv, s.C[:count]))

    def of(x: F64) -> float:
        over = np.maximum(0.0, s.C[:count] @ x - s.bound[:count])
        return float(0.5 * (x - wanted) @ m.A @ (x - wanted) + 0.5 * k @ over**2)

    return of


@pytest.mark.parametrize("seed", range(SEEDS))
def test_a_step_solves_the_rows_that_are_passed_and_goes_to_the_lowest_point_of_its_line(seed: int):
    s, m, wanted = filled(seed)
    count, f = int(s.numbers[0]), cost(s, m, wanted)
    for side in range(2):
        np.testing.assert_allclose(s.over[side, :count], s.C[:count] @ s.x[side] - s.bound[:count], atol=1e-12)
    least_change.newton_step(s, m.A, wanted)
    on = s.over[0, :count] > 0.0
    C, k = s.C[:count][on], s.stiffness[:count][on]
    best = wanted + np.linalg.solve(m.A + C.T @ (k[:, None] * C), C.T @ (k * (s.bound[:count][on] - C @ wanted)))
    np.testing.assert_allclose(s.x[1], best, rtol=1e-7, atol=1e-9)
    least_change.measure(s, 1)
    after = s.C[:count] @ s.x[1] - s.bound[:count]
    np.testing.assert_allclose(s.over[1, :count], after, atol=1e-9)
    assert least_change.settled(s) == bool(((after > 0.0) == on).all())
    a, b = s.x[0].copy(), s.x[1].copy()
    least_change.take_step(s, m.A, wanted)
    line = minimize_scalar(lambda t: f(a + t * (b - a)), bounds=(0.0, 1.0), method="bounded", options={"xatol": 1e-12})
    assert f(s.x[0]) <= f(a + line.x * (b - a)) * (1.0 + 1e-9) + 1e-12
    t = (s.x[0] - a) @ (b - a) / ((b - a) @ (b - a))
    assert 0.0 <= t <= 1.0 + 1e-12
    np.testing.assert_allclose(s.x[0], a + t * (b - a), atol=1e-9)
    np.testing.assert_allclose(s.over[0, :count], s.C[:count] @ s.x[0] - s.bound[:count], atol=1e-9)


@pytest.mark.parametrize("seed", range(SEEDS))
def test_the_lowest_point_of_a_line_with_many_corners(seed: int):
    """The slope there is none, beside that at its beginning."""
    rng, n, count = np.random.default_rng(seed), 4, 60
    s, m, wanted = room_of_rows(n), mass(rng, n), rng.normal(size=n)
    s.x[0], s.x[1] = 30.0 * rng.normal(size=n), 30.0 * rng.normal(size=n)
    for r in range(count):
        s.C[r] = rng.normal(size=n)
        least_change.add_row(s, 3.0 * float(rng.normal()), least_change.mobility(m.A_inv, s.C, r))
    C, bound, k = s.C[:count], s.bound[:count], s.stiffness[:count]

    def slope(a: F64, b: F64, t: float) -> float:
        x = a + t * (b - a)
        return float(((x - wanted) @ m.A + (k * np.maximum(0.0, C @ x - bound)) @ C) @ (b - a))

    a, b = s.x.copy()
    if slope(a, b, 0.0) > 0.0:  # a step of the search goes down at first
        a, b = b, a
    s.x[0], s.x[1] = a, b
    for side in range(2):
        least_change.measure(s, side)
    least_change.take_step(s, m.A, wanted)
    t = float((s.x[0] - a) @ (b - a) / ((b - a) @ (b - a)))
    if slope(a, b, 1.0) <= 0.0:
        assert t == pytest.approx(1.0)
    else:
        assert abs(slope(a, b, t)) <= 1e-9 * abs(slope(a, b, 0.0))


@pytest.mark.parametrize("stop", [0.13, 0.5, 0.77])
def test_the_lowest_point_of_a_line_before_a_stop(stop: float):
    """Beyond it the slope alone leads far back past where the step began."""
    s = room_of_rows(1)
    s.x[0], s.x[1] = 0.0, 1.0
    s.C[0] = -1.0
    least_change.add_row(s, -stop, 1.0)
    least_change.take_step(s, np.eye(1), np.full(1, -1.0))
    assert s.x[0, 0] == pytest.approx((stop - SOFTNESS) / (1.0 + SOFTNESS), rel=1e-9)


def test_a_row_along_which_nothing_moves_is_made_stiff_and_finite():
    s = room_of_rows(2)
    least_change.add_row(s, -1.0, 0.0)
    assert s.stiffness[0] == pytest.approx(1.0 / (SOFTNESS * 1e-12))

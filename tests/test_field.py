"""The field does what its energy says: turning points, bounds, no jumps, virtual work; compiled as interpreted."""

import hashlib
import math
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from rtctl.arm.field import (
    CAPPED,
    CONTACT,
    SUM,
    Field,
    FieldParams,
    LimitParams,
    eta_of,
    field,
    field_buffers,
    field_params,
    joint_limit_field,
    limit_params,
    own_field,
    rho_num_of,
)
from rtctl.types import F64, I64, Shape
from rtctl.world.primitives import Obstacles, advance, distances, obstacles_empty, with_shape

V, RHO0, RHO_MIN, DT = 0.5, 0.1, 0.02, 1e-3
UNDAMPED = field_params(V, RHO0, RHO_MIN, DT, 0.0, 0.0, 50.0)
DAMPED = field_params(V, RHO0, RHO_MIN, DT, 0.7, 0.3, 50.0)
IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])
NO_ENDS = np.zeros(0)  # no posture of a goal


def shape(kind: str, *dims: float, at: tuple[float, ...] = (0, 0, 0), v: tuple[float, ...] = (0, 0, 0)) -> Shape:
    full = np.zeros(4)
    full[: len(dims)] = dims
    return Shape("it", kind, full, np.array(at, float), IDENTITY, np.array(v, float), np.zeros(3))


def world(*shapes: Shape, groups: tuple[int, ...] | None = None) -> Obstacles:
    o = obstacles_empty(len(shapes) + 1)
    for k, s in enumerate(shapes):
        o = with_shape(o, k, s, -1 if groups is None else groups[k])
    return o


class Points(NamedTuple):
    """Free unit masses unless told otherwise: coordinates are the first point's position."""

    P: F64
    Jp: F64
    B: F64
    radius: F64
    link: I64


def masses(P: F64, mass: float = 1.0) -> Points:
    m = P.shape[0]
    return Points(
        P, np.tile(np.eye(3), (m, 1, 1)), np.tile(np.eye(3) / mass, (m, 1, 1)), np.zeros(m), np.ones(m, np.int64)
    )


def arm(rng: np.random.Generator, m: int = 20, n: int = 7, rows: int = 0) -> tuple[Points, F64]:
    """Return random points with a consistent mobility B = J A^-1 J^T, and A^-1."""
    Jp = rng.normal(size=(m + rows, 3, n)) * 0.4
    M = rng.normal(size=(n, n))
    A_inv = np.asarray(np.linalg.inv(M @ M.T + np.eye(n)), np.float64)
    B = np.einsum("jid,de,jke->jik", Jp[:m], A_inv, Jp[:m]).copy()
    link = np.sort(rng.integers(1, n + 1, m))
    return Points(rng.uniform(-0.4, 0.4, (m + rows, 3)), Jp, B, rng.uniform(0.01, 0.05, m), link), A_inv


def run(
    p: Points, qd: F64, o: Obstacles, params: FieldParams, blend: bool = False, prefilter: bool = True
) -> tuple[Field, int]:
    buffers = field_buffers(o.active.shape[0], p.radius.shape[0], p.Jp.shape[2])
    for a in buffers:
        a.fill(7)  # whatever an earlier call left must not matter
    used = params._replace(forms=float(params.forms if blend else int(params.forms) | SUM))
    flags = field(p, np.zeros_like(qd), qd, o, used, buffers, prefilter)
    return buffers, int(flags)


def push(rho: float, params: FieldParams = UNDAMPED, rho_dot: float = 0.0) -> float:
    """Return the acceleration of a unit mass at height rho over a plane, upward speed rho_dot."""
    out, _ = run(masses(np.array([[0.0, 0.0, rho]])), np.array([0.0, 0.0, rho_dot]), world(shape("plane")), params)
    return float(out.tau[2])


def largest_step(f: Callable[[float], float], start: float, end: float, count: int) -> float:
    """Return the largest change of f between neighbours; that of a function without jumps shrinks with the spacing."""
    return float(np.abs(np.diff([f(x) for x in np.linspace(start, end, count)])).max())


def test_repulsion_is_minus_the_gradient_of_the_potential() -> None:
    def U(rho: float) -> float:
        return 0.5 * UNDAMPED.eta * (1 / rho - 1 / RHO0) ** 2

    for rho in np.linspace(UNDAMPED.rho_num + 1e-4, RHO0 - 1e-4, 50):
        h = 1e-7
        assert push(rho) == pytest.approx(-(U(rho + h) - U(rho - h)) / (2 * h), rel=1e-6, abs=1e-6)
    assert push(RHO0) == 0.0
    assert push(0.5) == 0.0


def test_eta_is_that_of_the_worked_example() -> None:
    """V 0.5 m/s, rho0 0.1 m, rho_min 0.02 m: eta 1.56e-4, peak 15.6 m/s2 (hand calculation)."""
    assert eta_of(0.5, 0.1, 0.02) == pytest.approx(1.5625e-4, rel=1e-12)
    assert push(0.02) == pytest.approx(15.625, rel=1e-12)
    assert rho_num_of(1.5625e-4, 1e-3) == pytest.approx(4.653e-3, rel=1e-3)


@pytest.mark.parametrize("broken", [(0.5, 0.1, 0.1), (0.5, 0.1, 0.2), (0.5, 0.1, 0.0), (0.5, 0.1, -0.1)])
def test_a_clearance_that_does_not_lie_in_the_influence_is_refused(broken: tuple[float, float, float]) -> None:
    with pytest.raises(ValueError, match="clearance"):
        field_params(*broken, DT, 0.7, 0.3, 50.0)


def test_a_clearance_below_what_the_rate_can_hold_is_refused() -> None:
    with pytest.raises(ValueError, match="rho_num"):
        field_params(1.0, 0.1, 0.012, 1e-2, 0.7, 0.3, 50.0)
    with pytest.raises(ValueError, match="joint 1"):
        limit_params(np.array([1.0, 9.0]), np.full(2, 0.2), np.full(2, 0.03), 1e-2, 0.7)


def bounce(params: FieldParams, dt: float, delay: int, speed: float = V, wall: float = 0.0) -> tuple[float, float]:
    """Return (least distance, leaving speed) of a unit mass sent against a plane, semi-implicit Euler, force held."""
    z, v, least, late = RHO0 + 1e-3, -speed, math.inf, [0.0] * delay
    o = world(shape("plane", v=(0, 0, wall)))
    p, buffers, qd = masses(np.zeros((1, 3))), field_buffers(2, 1, 3), np.zeros(3)
    for _ in range(int(4 / dt)):
        p.P[0, 2], qd[2] = z, v
        field(p, np.zeros_like(qd), qd, o, params, buffers, True)
        late.append(float(buffers.tau[2]))
        v += late.pop(0) * dt
        z += v * dt
        least = min(least, z)
        if z > RHO0 + 2e-3:
            return least, v
    return least, v


def test_a_unit_mass_at_full_speed_turns_at_the_clearance() -> None:
    """Energy balance: V^2/2 = U(rho_min); at a high rate it leaves as fast as it came."""
    least, leaving = bounce(UNDAMPED, 2e-5, 0)
    assert least == pytest.approx(RHO_MIN, rel=2e-3)
    assert leaving == pytest.approx(V, rel=2e-3)
    half, _ = bounce(UNDAMPED, 2e-5, 0, speed=0.5 * V)
    assert half == pytest.approx(1 / (0.5 * (1 / RHO_MIN - 1 / RHO0) + 1 / RHO0), rel=2e-3)


@pytest.mark.parametrize(("rate", "gain"), [(1000, 1.07), (225, 1.40)])
def test_sampling_with_one_period_of_delay_gains_no_more_than_stated(rate: int, gain: float) -> None:
    """The undamped field at the rates of control-law.md: 1.06 at 1 kHz, 1.36 at 225 Hz."""
    params = field_params(V, RHO0, RHO_MIN, 1 / rate, 0.0, 0.0, 50.0)
    least, leaving = bounce(params, 1 / rate, 1)
    assert leaving <= gain * V
    assert least > 0.5 * RHO_MIN


@pytest.mark.parametrize("rate", [1000, 500, 225])
def test_damping_takes_the_energy_that_sampling_pumps(rate: int) -> None:
    params = field_params(V, RHO0, RHO_MIN, 1 / rate, 0.7, 0.0, 50.0)
    least, leaving = bounce(params, 1 / rate, 1)
    assert 0.0 < leaving < V
    assert least > RHO_MIN


def test_damping_is_one_sided_and_never_pulls() -> None:
    for rho in (0.001, 0.01, 0.03, 0.09):
        still, leaving, closing = push(rho, DAMPED), push(rho, DAMPED, 0.4), push(rho, DAMPED, -0.4)
        assert leaving == still
        assert closing > still > 0.0
    assert push(0.11, DAMPED, -5.0) == 0.0


@pytest.mark.parametrize("rho_dot", [0.0, -0.5, -20.0, 0.5])
def test_force_has_no_jump_in_the_distance(rho_dot: float) -> None:
    """From outside through rho0, rho_num and the surface to deep inside: steps shrink with the step in rho."""
    for centre in (RHO0, RHO_MIN, DAMPED.rho_num, 0.0, 0.05):
        steps = [abs(push(centre + h, DAMPED, rho_dot) - push(centre - h, DAMPED, rho_dot)) for h in (1e-5, 1e-7, 1e-9)]
        assert steps[1] <= 0.011 * steps[0] + 1e-9
        assert steps[2] <= 0.011 * steps[1] + 1e-9
    coarse, fine = (largest_step(lambda r: push(r, DAMPED, rho_dot), -0.02, 0.12, count) for count in (600, 6000))
    assert fine < 0.12 * coarse


def test_force_has_no_jump_in_the_closing_speed() -> None:
    a = [push(0.03, DAMPED, s) for s in (-1e-9, 0.0, 1e-9)]
    assert np.ptp(a) < 1e-6


def test_contact_and_inside_push_outward_at_the_cap() -> None:
    """No flip of the normal on penetration, no growth either; the flags tell."""
    cap = push(UNDAMPED.rho_num)
    for rho in (0.001, 0.0, -0.01, -1.0):
        assert push(rho) == cap
    for rho, expected in ((0.05, 0), (0.003, CAPPED), (0.0, CAPPED | CONTACT), (-0.02, CAPPED | CONTACT)):
        _, flags = run(masses(np.array([[0.0, 0.0, rho]])), np.zeros(3), world(shape("plane")), UNDAMPED)
        assert flags == expected
    o = world(shape("box", 0.1, 0.1, 0.1), shape("n_ellipsoid", 0.1, 0.1, 0.1, 4, at=(1, 0, 0)))
    for x in (0.101, 0.1, 0.09, 0.01):
        for centre in (0.0, 1.0):
            out, flags = run(masses(np.array([[centre + x, 0.0, 0.0]])), np.zeros(3), o, UNDAMPED)
            assert out.tau[0] == pytest.approx(cap)
            assert flags & CAPPED


def test_force_of_a_pair_is_bounded_whatever_the_speed_and_the_inertia() -> None:
    """2 m_max a(rho_num), also where its speed is absurd; what cannot move at all (B = 0) is not pushed."""
    bound = 2.0 * DAMPED.m_max * push(DAMPED.rho_num, DAMPED)
    for B in (0.0, 1e-9, 0.02, 1.0, 1e6):
        for speed in (0.0, -1.0, -1e6):
            p = masses(np.array([[0.0, 0.0, -0.01]]))._replace(B=np.full((1, 3, 3), B) * np.eye(3))
            out, _ = run(p, np.array([0.0, 0.0, speed]), world(shape("plane")), DAMPED)
            force = float(np.linalg.norm(out.force[0]))
            assert force <= bound * (1 + 1e-12)
            assert (force > 0.0) == (B > 0.0)


def test_the_point_gets_the_acceleration_of_a_unit_mass() -> None:
    """n . J A^-1 tau = a for one point of an arm of any inertia: the decoupling that lambda promises."""
    rng = np.random.default_rng(0)
    for _ in range(50):
        p, A_inv = arm(rng, m=1)
        p = p._replace(P=np.array([[0.3, 0.0, 0.0]]), radius=np.array([0.02]))
        rho = rng.uniform(0.01, 0.09)
        out, _ = run(p, np.zeros(7), world(shape("sphere", 0.28 - rho)), UNDAMPED)
        assert out.rho_min[0] == pytest.approx(rho)
        accelerated = np.array([1.0, 0.0, 0.0]) @ p.Jp[0] @ A_inv @ out.tau
        assert accelerated == pytest.approx(push(rho), rel=1e-9)


def test_torque_is_the_virtual_work_of_the_forces() -> None:
    """One point: tau . dq = f . dp for any dq; and the force reported is the force applied."""
    rng = np.random.default_rng(1)
    p, _ = arm(rng, m=1)
    p = p._replace(P=np.array([[0.2, 0.1, 0.0]]))
    out, _ = run(p, rng.normal(size=7), world(shape("box", 0.15, 0.1, 0.1)), DAMPED)
    for dq in rng.normal(size=(5, 7)):
        assert out.tau @ dq == pytest.approx(out.force[0] @ (p.Jp[0] @ dq), rel=1e-12)


def test_one_point_feels_the_same_blended_or_summed() -> None:
    rng = np.random.default_rng(2)
    o = world(
        shape("sphere", 0.1), shape("box", 0.1, 0.2, 0.1, at=(0.3, 0, 0)), shape("cone", 0.1, 0.0, 0.1, at=(0, 0.2, 0))
    )
    for _ in range(20):
        p, _ = arm(rng, m=1)
        qd = rng.normal(size=7)
        assert run(p, qd, o, DAMPED, True)[0].tau.tobytes() == run(p, qd, o, DAMPED, False)[0].tau.tobytes()


def test_many_spheres_on_a_link_push_like_one_only_when_blended() -> None:
    P = np.tile([[0.0, 0.0, 0.03]], (10, 1))
    one, _ = run(masses(P[:1]), np.zeros(3), world(shape("plane")), DAMPED)
    blended, _ = run(masses(P), np.zeros(3), world(shape("plane")), DAMPED, True)
    summed, _ = run(masses(P), np.zeros(3), world(shape("plane")), DAMPED, False)
    assert blended.tau[2] == pytest.approx(one.tau[2])
    assert summed.tau[2] == pytest.approx(10 * one.tau[2])
    # Points of different links do not share.
    apart, _ = run(masses(P)._replace(link=np.arange(10) % 2 + 1), np.zeros(3), world(shape("plane")), DAMPED, True)
    assert apart.tau[2] == pytest.approx(2 * one.tau[2])


def test_blended_force_has_no_jump_when_a_second_sphere_enters() -> None:
    def total(height: float) -> float:
        p = masses(np.array([[0.0, 0.0, 0.04], [0.0, 0.1, height]]))
        return float(run(p, np.array([0.0, 0.0, -0.3]), world(shape("plane")), DAMPED, True)[0].tau[2])

    assert total(RHO0 - 1e-7) == pytest.approx(total(RHO0 + 1e-7), rel=1e-6)
    assert largest_step(total, 0.11, -0.01, 5000) < 0.12 * largest_step(total, 0.11, -0.01, 500)


def test_union_takes_the_nearest_part_and_a_sum_takes_all() -> None:
    parts = (shape("sphere", 0.1), shape("sphere", 0.1, at=(0.0, 0.05, 0.0)))
    p = masses(np.array([[0.12, 0.02, 0.0], [0.0, 0.21, 0.0]]))._replace(link=np.array([1, 2]))
    single = [run(p, np.zeros(3), world(s), DAMPED)[0] for s in parts]
    union, _ = run(p, np.zeros(3), world(*parts, groups=(5, 5)), DAMPED)
    added, _ = run(p, np.zeros(3), world(*parts), DAMPED)
    assert np.allclose(added.tau, single[0].tau + single[1].tau, rtol=1e-12)
    nearest = [run(masses(p.P[j : j + 1]), np.zeros(3), world(parts[k]), DAMPED)[0].tau for j, k in ((0, 0), (1, 1))]
    assert np.allclose(union.tau, nearest[0] + nearest[1], rtol=1e-12)
    assert np.array_equal(union.rho_min[:2], [s.rho_min[0] for s in single])


def test_a_wall_in_two_parts_pushes_like_the_wall_in_one() -> None:
    """Two boxes side by side, one group: a link over both feels one repulsion."""
    whole = world(shape("box", 0.4, 0.2, 0.1))
    halves = world(
        shape("box", 0.2, 0.2, 0.1, at=(-0.2, 0, 0)), shape("box", 0.2, 0.2, 0.1, at=(0.2, 0, 0)), groups=(3, 3)
    )
    P = np.stack([np.linspace(-0.3, 0.33, 12), np.zeros(12), np.linspace(0.13, 0.16, 12)], axis=1)
    a, b = (run(masses(P), np.array([0.0, 0.0, -0.2]), o, DAMPED, True)[0].tau for o in (whole, halves))
    assert np.allclose(a, b, rtol=1e-12)


def test_an_obstacle_that_comes_is_felt_earlier_and_one_that_leaves_is_not() -> None:
    p = masses(np.array([[0.0, 0.0, 0.15]]))
    forces = {
        v: float(run(p, np.zeros(3), world(shape("plane", v=(0, 0, v))), DAMPED)[0].tau[2]) for v in (-0.25, 0.0, 0.25)
    }
    assert forces[0.25] > 0.0
    assert forces[0.0] == forces[-0.25] == 0.0
    near = masses(np.array([[0.0, 0.0, 0.05]]))
    a = [
        float(run(near, np.zeros(3), world(shape("plane", v=(0, 0, v))), DAMPED)[0].tau[2])
        for v in np.linspace(-0.1, 0.3, 4001)
    ]
    assert np.all(np.diff(a) >= 0.0)
    assert np.max(np.diff(a)) < 0.01 * max(a)


def test_a_turning_obstacle_counts_with_the_speed_of_its_surface() -> None:
    """A box that turns about z: rho_dot by differences of the distance, seen through the damping."""
    rng = np.random.default_rng(3)
    params = DAMPED._replace(look_ahead=0.0, k_d=1.0)
    for _ in range(20):
        s = shape("box", 0.3, 0.05, 0.1)._replace(omega=rng.normal(size=3), velocity=rng.normal(size=3))
        p, h = masses(np.array([[0.25, 0.08, 0.0]])), 1e-6
        o = world(s)
        ahead, back = (distances(p.P, p.radius, advance(o, t))[0][0, 0] for t in (h, -h))
        rho_dot = (ahead - back) / (2 * h)
        moving, still = (
            float(np.linalg.norm(run(p, np.zeros(3), w, params)[0].force[0]))
            for w in (o, world(s._replace(omega=np.zeros(3), velocity=np.zeros(3))))
        )
        rise = (1 / 0.03 - 1 / RHO0) / (1 / RHO_MIN - 1 / RHO0)
        assert moving - still == pytest.approx(max(0.0, -rho_dot) * rise**2, abs=1e-6)


def test_a_mass_at_rest_flees_from_an_approaching_wall() -> None:
    """A wall at 0.25 m/s against a mass at rest, 1 kHz with delay: never nearer than the clearance."""
    z, v, least, late = 0.3, 0.0, math.inf, 0.0
    o, p, buffers, qd = (
        world(shape("plane", v=(0, 0, 0.25))),
        masses(np.zeros((1, 3))),
        field_buffers(2, 1, 3),
        np.zeros(3),
    )
    for _ in range(3000):
        p.P[0, 2], qd[2] = z, v
        field(p, np.zeros_like(qd), qd, o, DAMPED, buffers, True)
        v += late * DT
        late = float(buffers.tau[2])
        z += v * DT
        o = advance(o, DT)
        least = min(least, z - o.p[0, 2])
    assert least > RHO_MIN
    assert v >= 0.25 * 0.99


def scene(seed: int) -> tuple[Points, F64, Obstacles, F64, F64]:
    rng = np.random.default_rng(seed)
    kinds = [("sphere", 0.1), ("capsule", 0.05, 0.1), ("box", 0.1, 0.05, 0.2), ("plane",), ("cone", 0.1, 0.05, 0.1)]
    kinds += [("ellipsoid", 0.1, 0.2, 0.05), ("n_ellipsoid", 0.1, 0.2, 0.05, 4.0), ("n_cylinder", 0.1, 0.1, 0.1, 2.5)]
    o = obstacles_empty(20)
    for k in range(18):
        wxyz = rng.normal(size=4)
        wxyz /= np.linalg.norm(wxyz)
        name, *dims = kinds[k % len(kinds)]
        at = rng.uniform(-0.7, 0.7, 3) - (np.array([0, 0, 1.2]) if name == "plane" else 0.0)
        turning = np.zeros(3) if name == "plane" else 0.3 * rng.normal(size=3)
        s = shape(str(name), *map(float, dims))._replace(
            position=at, wxyz=wxyz, velocity=0.2 * rng.normal(size=3), omega=turning
        )
        o = with_shape(o, k, s, group=int(rng.integers(0, 12)))
    p, A_inv = arm(rng, m=20, rows=8)
    rows = np.column_stack([rng.uniform(-0.02, 0.2, 10), rng.normal(size=(10, 7))])
    return p, rng.normal(size=7) * 0.3, o, A_inv, rows


def outputs(seed: int, prefilter: bool = True) -> list[F64]:
    """Return everything that the kernels compute for one random scene."""
    p, qd, o, A_inv, rows = scene(seed)
    out, flags = run(p, qd, o, DAMPED, seed % 2 == 0, prefilter)
    own, least, flags2 = own_field(rows[:, 0].copy(), rows[:, 1:].copy(), 0.01 * qd, qd, A_inv, DAMPED, NO_ENDS)
    limit = limit_params(np.full(7, 2.0), np.full(7, 0.3), np.full(7, 0.05), DT, 0.7)
    tau = np.empty(7)
    flags3 = joint_limit_field(qd, qd, np.full(7, -0.4), np.full(7, 0.4), np.ones(7), limit, tau)
    numbers = np.array([flags, flags2, flags3, least], float)
    return [out.tau, out.rho_min, out.nearest.astype(float), out.force, own, tau, numbers]


def test_pre_filter_changes_no_bit() -> None:
    active = 0
    for seed in range(60):
        a, b = outputs(seed, True), outputs(seed, False)
        assert [x.tobytes() for x in a] == [x.tobytes() for x in b]
        active += int(np.count_nonzero(a[3]))
    assert active > 300


def digest() -> str:
    return hashlib.sha256(b"".join(x.tobytes() for seed in range(6) for x in outputs(seed))).hexdigest()


def test_plain_python_computes_the_same_bits() -> None:
    """NUMBA_DISABLE_JIT=1 in another process: the interpreter is the oracle of the compiler."""
    script = (
        "import importlib.util as u, sys;"
        f"s = u.spec_from_file_location('scene', {__file__!r}); m = u.module_from_spec(s);"
        "sys.modules['scene'] = m; s.loader.exec_module(m); print(m.digest())"
    )
    plain = subprocess.run(
        [sys.executable, "-W", "error", "-c", script],
        env={**os.environ, "NUMBA_DISABLE_JIT": "1"},
        cwd=Path(__file__).parent.parent,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert plain.returncode == 0, plain.stderr
    assert plain.stdout.strip() == digest()


@pytest.mark.parametrize("place", ["P", "qd", "B"])
def test_a_number_that_is_none_reaches_the_torque_where_the_limits_stage_sees_it(place: str) -> None:
    """It is not mistaken for 'far away' or clamped to something plausible."""
    p, qd = masses(np.array([[0.0, 0.0, 0.03], [0.0, 0.5, 0.5]])), np.array([0.0, 0.0, -0.1])
    target = {"P": p.P, "qd": qd, "B": p.B}[place]
    target[(0,) * (target.ndim - 1) + (2,)] = np.nan if place != "B" else 0.0
    if place == "B":
        target[0, 2, 2] = np.nan
    if place == "qd":
        target[:] = np.nan
    out, _ = run(p, qd, world(shape("plane")), DAMPED, True)
    assert np.isnan(out.tau).any()


def test_nothing_near_means_no_torque_and_true_clearances() -> None:
    p = masses(np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 0.9]]))
    out, flags = run(p, np.zeros(3), world(shape("plane"), shape("n_ellipsoid", 0.1, 0.1, 0.1, 3)), DAMPED)
    assert flags == 0
    assert np.all(out.tau == 0.0)
    assert np.all(out.force == 0.0)
    assert out.rho_min[:2] == pytest.approx([0.9, 0.8])
    assert out.nearest.tolist() == [1, 1, -1]
    assert np.isposinf(out.rho_min[2])


LIMIT = limit_params(np.array([2.0]), np.array([0.3]), np.array([0.05]), DT, 0.7)


def limit_torque(q: float, qd: float = 0.0, A: float = 1.0, lo: float = -1.0, hi: float = 1.0) -> tuple[float, int]:
    tau = np.empty(1)
    flags = joint_limit_field(np.array([q]), np.array([qd]), np.array([lo]), np.array([hi]), np.array([A]), LIMIT, tau)
    return float(tau[0]), int(flags)


def test_both_joint_limits_are_treated_alike() -> None:
    for q in np.linspace(-1.2, 1.2, 101):
        for qd in (-1.0, 0.0, 1.0):
            assert limit_torque(q, qd)[0] == -limit_torque(-q, -qd)[0]
    assert limit_torque(0.0, 1.9)[0] == 0.0
    assert limit_torque(-0.9)[0] > 0.0 > limit_torque(0.9)[0]
    assert limit_torque(0.9, 0.0, 3.0)[0] == pytest.approx(3 * limit_torque(0.9)[0])


def test_a_joint_past_its_limit_is_pushed_inward_at_the_cap() -> None:
    cap = -limit_torque(1.0 - LIMIT.rho_num[0])[0]
    for past in (0.0, 0.1, 3.0):
        torque, flags = limit_torque(1.0 + past)
        assert torque == pytest.approx(-cap)
        assert flags == CAPPED | CONTACT
        assert limit_torque(-1.0 - past)[0] == pytest.approx(cap)
    assert limit_torque(5.0, 1e9)[0] == pytest.approx(-2 * cap)
    assert limit_torque(0.9)[1] == 0


def test_a_joint_at_full_speed_turns_at_its_clearance() -> None:
    """Energy of a unit inertia without damping, at a high rate: qd_max^2/2 = U(clearance)."""
    undamped = LIMIT._replace(k_d=np.zeros(1))
    q, v, most, tau, dt = 0.69, 2.0, 0.0, np.empty(1), 1e-5
    while v > -1.9 and most < 2.0:
        joint_limit_field(np.array([q]), np.array([v]), np.array([-1.0]), np.array([1.0]), np.ones(1), undamped, tau)
        v += tau[0] * dt
        q += v * dt
        most = max(most, q)
    assert most == pytest.approx(0.95, abs=2e-4)


def test_a_zone_thinner_than_the_clearance_pushes_there_alone_and_is_no_steeper() -> None:
    """That of a goal on a limit: nothing at the goal, and nowhere a stiffness beyond what a sampled field bears."""
    thin = LIMIT._replace(rho0=np.array([0.02]))
    tau = np.empty(1)

    def torque(left: float, params: LimitParams) -> float:
        joint_limit_field(np.array([1.0 - left]), np.zeros(1), -np.ones(1), np.ones(1), np.ones(1), params, tau)
        return float(tau[0])

    def stiffness(params: LimitParams) -> float:
        at = np.linspace(-0.01, 0.3, 20_001)
        return float(np.abs(np.diff([torque(left, params) for left in at])).max() / (at[1] - at[0]))

    assert torque(0.02, thin) == torque(0.1, thin) == 0.0
    assert torque(0.0, thin) < torque(0.015, thin) < 0.0
    assert stiffness(thin) <= 1.01 * stiffness(LIMIT)


def test_joint_limit_torque_has_no_jump_and_an_endless_joint_no_limit() -> None:
    coarse, fine = (largest_step(lambda q: limit_torque(q, 0.5)[0], -1.3, 1.3, count) for count in (10_000, 100_000))
    assert fine < 0.12 * coarse
    assert limit_torque(50.0, 1.0, 1.0, -math.inf, math.inf) == (0.0, 0)
    assert math.isnan(limit_torque(math.nan)[0])

"""Distances are true, normals are their unit gradients, everywhere: against dense sampling, coal and differences."""

import math
from collections.abc import Callable
from typing import Any

import coal
import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from rtctl.types import F64, Shape
from rtctl.world.primitives import (
    N_MAX,
    TYPES,
    Obstacles,
    advance,
    distance,
    distances,
    distances_into,
    fault_of,
    obstacles_empty,
    with_shape,
)
from tests.lab import without


def shape(kind: str, *dims: float, position: F64 | None = None, wxyz: F64 | None = None, **motion: F64) -> Shape:
    full = np.zeros(4)
    full[: len(dims)] = dims
    return Shape(
        "it",
        kind,
        full,
        np.zeros(3) if position is None else position,
        np.array([1.0, 0.0, 0.0, 0.0]) if wxyz is None else wxyz,
        motion.get("velocity", np.zeros(3)),
        motion.get("omega", np.zeros(3)),
    )


def random_pose(rng: np.random.Generator) -> tuple[F64, F64, F64]:
    """Return position, wxyz and the rotation matrix by scipy."""
    wxyz = rng.normal(size=4)
    wxyz /= np.linalg.norm(wxyz)
    return rng.uniform(-1, 1, 3), wxyz, Rotation.from_quat(np.roll(wxyz, -1)).as_matrix()


# Surfaces sampled without any distance code: a description (implicit function f, < 0 inside, f = 0 on the surface,
# with slopes near 1 per size) and points pushed radially or placed on faces.


def radial(f: Callable[[F64], F64], size: F64, count: int, rng: np.random.Generator) -> F64:
    """Return surface points of a star-shaped body: bisection on the ray through points of its bounding box's faces."""
    u = rng.uniform(-1, 1, (count, 3))
    face = rng.integers(0, 3, count)
    u[np.arange(count), face] = rng.choice([-1.0, 1.0], count)
    u *= size
    lo, hi = np.zeros(count), np.full(count, 1.001)
    for _ in range(60):
        mid = 0.5 * (lo + hi)
        inside = f(u * mid[:, None]) < 0
        lo, hi = np.where(inside, mid, lo), np.where(inside, hi, mid)
    points: F64 = u * lo[:, None]
    return points


def superquadric(a: float, b: float, c: float, p: float, pz: float) -> Callable[[F64], F64]:
    def f(x: F64) -> F64:
        value: F64 = np.abs(x[:, 0] / a) ** p + np.abs(x[:, 1] / b) ** p + np.abs(x[:, 2] / c) ** pz - 1.0
        return value

    return f


def frustum(ra: float, rb: float, h: float) -> Callable[[F64], F64]:
    def f(x: F64) -> F64:
        s = np.hypot(x[:, 0], x[:, 1])
        side = s - (ra + (rb - ra) * (x[:, 2] + h) / (2 * h))
        value: F64 = np.maximum(side, np.abs(x[:, 2]) - h)
        return value

    return f


def rounded(radius: float, half: float) -> Callable[[F64], F64]:
    def f(x: F64) -> F64:
        value: F64 = np.hypot(np.hypot(x[:, 0], x[:, 1]), np.maximum(np.abs(x[:, 2]) - half, 0)) - radius
        return value

    return f


def cuboid(a: float, b: float, c: float) -> Callable[[F64], F64]:
    def f(x: F64) -> F64:
        value: F64 = np.max(np.abs(x) - np.array([a, b, c]), axis=1)
        return value

    return f


BODIES: dict[str, tuple[Shape, Callable[[F64], F64], tuple[float, float, float]]] = {
    "sphere": (shape("sphere", 0.3), rounded(0.3, 0.0), (0.3, 0.3, 0.3)),
    "capsule": (shape("capsule", 0.1, 0.3), rounded(0.1, 0.3), (0.1, 0.1, 0.4)),
    "box": (shape("box", 0.1, 0.2, 0.3), cuboid(0.1, 0.2, 0.3), (0.1, 0.2, 0.3)),
    "thin box": (shape("box", 0.4, 0.3, 0.002), cuboid(0.4, 0.3, 0.002), (0.4, 0.3, 0.002)),
    "cylinder": (shape("cylinder", 0.2, 0.1), frustum(0.2, 0.2, 0.1), (0.2, 0.2, 0.1)),
    "disc": (shape("cylinder", 0.3, 0.002), frustum(0.3, 0.3, 0.002), (0.3, 0.3, 0.002)),
    "cone": (shape("cone", 0.2, 0.0, 0.2), frustum(0.2, 0.0, 0.2), (0.2, 0.2, 0.2)),
    "cone upside down": (shape("cone", 0.0, 0.2, 0.1), frustum(0.0, 0.2, 0.1), (0.2, 0.2, 0.1)),
    "truncated cone": (shape("cone", 0.2, 0.05, 0.1), frustum(0.2, 0.05, 0.1), (0.2, 0.2, 0.1)),
    "ellipsoid": (shape("ellipsoid", 0.1, 0.2, 0.3), superquadric(0.1, 0.2, 0.3, 2, 2), (0.1, 0.2, 0.3)),
    "oblate": (shape("ellipsoid", 0.3, 0.3, 0.1), superquadric(0.3, 0.3, 0.1, 2, 2), (0.3, 0.3, 0.1)),
    "needle": (shape("ellipsoid", 0.01, 0.01, 0.5), superquadric(0.01, 0.01, 0.5, 2, 2), (0.01, 0.01, 0.5)),
    "n-ellipsoid": (shape("n_ellipsoid", 0.1, 0.2, 0.3, 4), superquadric(0.1, 0.2, 0.3, 8, 8), (0.1, 0.2, 0.3)),
    "n = 10": (shape("n_ellipsoid", 0.2, 0.2, 0.2, 10), superquadric(0.2, 0.2, 0.2, 20, 20), (0.2, 0.2, 0.2)),
    "n = 1.5": (shape("n_ellipsoid", 0.1, 0.3, 0.2, 1.5), superquadric(0.1, 0.3, 0.2, 3, 3), (0.1, 0.3, 0.2)),
    "thin plate": (shape("n_ellipsoid", 0.3, 0.3, 0.01, 4), superquadric(0.3, 0.3, 0.01, 8, 8), (0.3, 0.3, 0.01)),
    "n-cylinder": (shape("n_cylinder", 0.1, 0.2, 0.3, 4), superquadric(0.1, 0.2, 0.3, 2, 8), (0.1, 0.2, 0.3)),
    "round n-cylinder": (shape("n_cylinder", 0.2, 0.2, 0.1, 10), superquadric(0.2, 0.2, 0.1, 2, 20), (0.2, 0.2, 0.1)),
}
bodies = pytest.mark.parametrize("name", BODIES)


def queries(size: F64, count: int, rng: np.random.Generator) -> F64:
    """Return points inside, near and far, some of them exactly on planes of symmetry and axes."""
    y: F64 = rng.uniform(-1, 1, (count, 3)) * (
        size * rng.choice([1.0, 1.5], (count, 1)) + rng.choice([0.0, 0.1], (count, 1))
    )
    y[: count // 10, 0] = 0.0
    y[count // 20 : count // 7, 1] = 0.0
    y[count // 12 : count // 5, 2] = 0.0
    return y


@bodies
def test_foot_lies_on_the_surface_and_the_sign_is_that_of_the_body(name: str) -> None:
    """100,000 points each: |rho| is the length of a way to the surface, so it is never too short."""
    body, f, dims = BODIES[name]
    size, rng = np.array(dims), np.random.default_rng(1)
    y = queries(size, 100_000, rng)
    rho, n = distance(body, y)
    assert np.all(np.isfinite(rho))
    assert np.abs(np.linalg.norm(n, axis=1) - 1.0).max() < 1e-12
    wrong = (rho > 0) != (f(y) > 0)
    assert np.all(np.abs(rho[wrong]) < 1e-12)
    foot, h = y - rho[:, None] * n, 1e-9 + 1e-9 * size.max()
    assert np.all(f(foot * (1 + h / size.min())) > -1e-12)
    assert np.all(f(foot * (1 - h / size.min())) < 1e-12)


@bodies
def test_no_sample_of_the_surface_is_nearer(name: str) -> None:
    """100,000 samples: |rho| is never too long, and the gap to them is small enough to notice another minimum."""
    body, f, dims = BODIES[name]
    size, rng = np.array(dims), np.random.default_rng(2)
    y = queries(size, 1_000, rng)
    samples, _ = cKDTree(radial(f, size, 100_000, rng)).query(y)
    gap = samples - np.abs(distance(body, y)[0])
    assert gap.min() > -1e-9
    assert gap.max() < 0.05 * size.max()


@bodies
def test_normal_is_the_gradient_of_the_distance(name: str) -> None:
    """Central differences, outside and inside; where the two one-sided slopes differ the point is on a medial set."""
    body, _, dims = BODIES[name]
    rng, h = np.random.default_rng(3), 1e-6
    y = rng.uniform(-1.5, 1.5, (2_000, 3)) * np.array(dims)
    rho, n = distance(body, y)
    plus = np.stack([distance(body, y + h * e)[0] for e in np.eye(3)], axis=1)
    minus = np.stack([distance(body, y - h * e)[0] for e in np.eye(3)], axis=1)
    smooth = np.all(np.abs(plus + minus - 2.0 * rho[:, None]) < 1e-10, axis=1)
    assert smooth.mean() > 0.8  # a needle of 1 cm bends the field within the step
    assert np.abs((plus - minus) / (2 * h) - n)[smooth].max() < 2e-6


@bodies
def test_posed_body_measures_as_the_body_in_its_own_frame(name: str) -> None:
    body, _, dims = BODIES[name]
    rng = np.random.default_rng(4)
    y = queries(np.array(dims), 300, rng)
    rho, n = distance(body, y)
    for _ in range(10):
        position, wxyz, R = random_pose(rng)
        posed_rho, posed_n = distance(body._replace(position=position, wxyz=wxyz), position + y @ R.T)
        assert np.abs(posed_rho - rho).max() < 1e-9
        general = np.abs(y).min(axis=1) > 1e-3  # on planes of symmetry rounding may choose the other side
        assert np.abs(posed_n - n @ R.T)[general].max() < 1e-6


@bodies
def test_normal_does_not_flip_at_the_surface(name: str) -> None:
    """Just outside, on and just inside a smooth surface point the normal is one and the same, outward."""
    body, f, dims = BODIES[name]
    x = radial(f, np.array(dims), 500, np.random.default_rng(5))
    rho, n = distance(body, x)
    x -= rho[:, None] * n
    _, n = distance(body, x)
    curved = 2e-3 if name in {"needle", "thin plate", "thin box", "disc"} else 2e-5
    for step in (1e-9, 1e-12, -1e-12, -1e-9):
        rho, m = distance(body, x + step * n)
        same = np.abs(m - n).max(axis=1) < curved
        assert same.mean() > 0.98  # the rest lies on an edge
        assert np.abs(rho - step)[same].max() < 1e-12
    inner, outer = distance(body, x - 1e-7 * n)[1], distance(body, x + 1e-7 * n)[1]
    assert np.mean(np.einsum("ij,ij->i", inner, outer) > 0.99) > 0.97


@pytest.mark.parametrize("name", [*BODIES, "point", "segment", "plane"])
def test_medial_sets_have_a_unit_normal_and_the_same_one_each_time(name: str) -> None:
    """At the centre, on axes, on edges and corners: finite, unit, repeatable, and never pointing inward."""
    extra = {"point": shape("point"), "segment": shape("segment", 0.0, 0.3), "plane": shape("plane")}
    body = extra[name] if name in extra else BODIES[name][0]
    size = np.array(BODIES[name][2]) if name in BODIES else np.array([0.1, 0.2, 0.3])
    grid = np.array([-1.0, -0.5, -1e-200, 0.0, 1e-160, 1e-12, 0.5, 1.0])
    y = np.stack(np.meshgrid(grid, grid, grid), -1).reshape(-1, 3) * size
    rho, n = distance(body, y)
    assert np.all(np.isfinite(rho))
    assert np.abs(np.linalg.norm(n, axis=1) - 1.0).max() < 1e-12
    again_rho, again_n = distance(body, y.copy())
    assert rho.tobytes() == again_rho.tobytes()
    assert n.tobytes() == again_n.tobytes()
    assert np.all(distance(body, y + 2.0 * size.max() * n)[0] > rho)


def test_point_segment_and_plane() -> None:
    rng = np.random.default_rng(6)
    y = rng.uniform(-1, 1, (1000, 3))
    position, wxyz, R = random_pose(rng)
    rho, n = distance(shape("point", position=position), y)
    assert np.allclose(rho, np.linalg.norm(y - position, axis=1), rtol=0, atol=1e-15)
    assert np.allclose(n * rho[:, None], y - position, rtol=0, atol=1e-14)

    rho, _ = distance(shape("segment", 0.0, 0.3, position=position, wxyz=wxyz), y)
    along = position + np.linspace(-0.3, 0.3, 20_001)[:, None] * R[:, 2]
    brute, _ = cKDTree(along).query(y)
    assert np.all(rho <= brute + 1e-12)
    assert np.abs(rho - brute).max() < 1e-4

    rho, n = distance(shape("plane", position=position, wxyz=wxyz), y)
    assert np.allclose(rho, (y - position) @ R[:, 2], rtol=0, atol=1e-14)
    assert np.allclose(n, R[:, 2], rtol=0, atol=1e-15)


COAL: dict[str, tuple[Shape, Callable[[], Any]]] = {
    "sphere": (shape("sphere", 0.2), lambda: coal.Sphere(0.2)),
    "capsule": (shape("capsule", 0.1, 0.3), lambda: coal.Capsule(0.1, 0.6)),
    "box": (shape("box", 0.1, 0.2, 0.3), lambda: coal.Box(0.2, 0.4, 0.6)),
    "cylinder": (shape("cylinder", 0.1, 0.3), lambda: coal.Cylinder(0.1, 0.6)),
    "cone": (shape("cone", 0.1, 0.0, 0.3), lambda: coal.Cone(0.1, 0.6)),
    "ellipsoid": (shape("ellipsoid", 0.1, 0.2, 0.3), lambda: coal.Ellipsoid(0.1, 0.2, 0.3)),
    "plane": (shape("plane"), lambda: coal.Halfspace(np.array([0.0, 0.0, 1.0]), 0.0)),
}


@pytest.mark.parametrize("name", COAL)
def test_agrees_with_coal_over_random_poses(name: str) -> None:
    """Distance of a ball of 5 cm, and its nearest direction, outside and in shallow contact."""
    body, make = COAL[name]
    other, ball, radius = make(), coal.Sphere(0.05), 0.05
    rng, request = np.random.default_rng(7), coal.DistanceRequest()
    request.gjk_tolerance = 1e-10
    request.gjk_max_iterations = 1000
    for _ in range(1500):
        position, wxyz, R = random_pose(rng)
        y = position + rng.uniform(-0.6, 0.6, 3)
        o = with_shape(obstacles_empty(1), 0, body._replace(position=position, wxyz=wxyz))
        rho, n = (v[0, ..., 0] for v in distances(y[None], np.array([radius]), o))
        if rho < -0.9 * radius:  # the ball's centre inside: coal then answers with its own choice of depth
            continue
        result = coal.DistanceResult()
        coal.distance(other, coal.Transform3s(R, position), ball, coal.Transform3s(np.eye(3), y), request, result)
        assert rho == pytest.approx(result.min_distance, abs=2e-5)
        if rho > 1e-3:
            towards = result.getNearestPoint2() - result.getNearestPoint1()
            assert n @ towards / np.linalg.norm(towards) > 1.0 - 1e-3


def test_nearly_a_box_is_measured_like_the_box() -> None:
    """n = 50 lies within 2 % of its box, and the distance with it: no overflow at 10,000 sizes, no underflow."""
    y = np.random.default_rng(8).uniform(-1, 1, (300, 3)) * np.array([[0.3], [30.0], [1000.0]]).repeat(100, 0)
    rounded_box, n = distance(shape("n_ellipsoid", 0.1, 0.2, 0.3, N_MAX), y)
    box, _ = distance(shape("box", 0.1, 0.2, 0.3), y)
    assert np.all(np.isfinite(n))
    assert np.all(rounded_box >= box - 1e-9)
    assert np.max(rounded_box - box) < 0.02


@pytest.mark.parametrize("kind", [t for t in TYPES if t not in ("mesh", "cloud")])  # those are in test_bodies
def test_a_coordinate_that_is_not_a_number_never_becomes_a_distance(kind: str) -> None:
    body = shape(kind, 0.1, 0.2, 0.3, 2.0)
    rho, _ = distance(body, np.array([[np.nan, 0.1, 0.1], [0.1, np.nan, 0.1], [0.1, 0.1, np.nan], [0.1, 0.1, 0.1]]))
    finite = np.isfinite(rho)
    assert finite[3]
    assert not finite[:3].any()


def scene(rng: np.random.Generator, slots: int = 24) -> tuple[Obstacles, F64, F64]:
    o = obstacles_empty(slots)
    for k in range(slots - 2):
        body = [b for b, _, _ in BODIES.values()][k % len(BODIES)]
        position, wxyz, _ = random_pose(rng)
        o = with_shape(o, k, body._replace(position=0.6 * position, wxyz=wxyz))
    return o, rng.uniform(-1, 1, (33, 3)), rng.uniform(0, 0.06, 33)


def test_pre_filter_keeps_every_bit_of_what_it_promises() -> None:
    """Distances below the cut-off and the least of each obstacle are exact; the rest is never too long."""
    rng, left = np.random.default_rng(9), 0
    for cutoff in (-0.01, 0.0, 0.1, 0.4):
        for _ in range(8):
            o, P, radius = scene(rng)
            rho, normal = distances(P, radius, o)
            out = np.zeros((rho.shape[0], 4, rho.shape[1]))
            distances_into(np.ascontiguousarray(P.T), radius, o, cutoff, out)
            exact = (rho <= cutoff) | (rho == rho.min(axis=1, keepdims=True))
            assert np.array_equal(out[:, 0][exact], rho[exact])
            assert np.array_equal(out[:, 1:].transpose(0, 2, 1)[exact], normal.transpose(0, 2, 1)[exact])
            assert np.all(out[:, 0][~exact] <= rho[~exact] + 1e-12)
            assert np.all(out[:, 0][~exact] > cutoff)
            assert np.array_equal(out[:, 0].argmin(axis=1), rho.argmin(axis=1))
            left += int(np.sum(out[:, 0] != rho))
    assert left > 1000  # it does filter


def test_point_radius_is_subtracted_and_inactive_slots_are_infinitely_far() -> None:
    o = with_shape(obstacles_empty(3), 1, shape("sphere", 0.1))
    P = np.array([[0.0, 0.0, 0.5], [0.0, 0.2, 0.0]])
    rho, normal = distances(P, np.array([0.05, 0.02]), o)
    assert np.allclose(rho[1], [0.35, 0.08])
    assert np.all(np.isposinf(rho[[0, 2]]))
    assert np.all(normal[[0, 2]] == 0.0)
    assert np.all(np.isposinf(distances(P, np.zeros(2), without(o, 1))[0]))


def test_a_moving_body_is_where_its_velocities_take_it() -> None:
    rng = np.random.default_rng(10)
    position, wxyz, R = random_pose(rng)
    v, w = np.array([0.1, -0.2, 0.3]), np.array([1.0, 2.0, -0.5])
    o = with_shape(
        obstacles_empty(2), 1, shape("box", 0.1, 0.2, 0.3, position=position, wxyz=wxyz, velocity=v, omega=w)
    )
    before = o.p.copy(), o.R.copy()
    later = o
    for _ in range(250):
        later = advance(later, 0.004)
    assert np.array_equal(o.p, before[0])
    assert np.array_equal(o.R, before[1])
    assert np.allclose(later.p[1], position + v, atol=1e-12)
    assert np.allclose(later.R[1], Rotation.from_rotvec(w).as_matrix() @ R, atol=1e-12)
    assert np.array_equal(later.R[0], np.eye(3))
    assert np.array_equal(later.p[0], np.zeros(3))


def test_editing_leaves_the_old_obstacles_alone() -> None:
    o = obstacles_empty(4)
    new = with_shape(o, 2, shape("sphere", 0.1), group=7)
    assert not o.active.any()
    assert new.active.tolist() == [False, False, True, False]
    assert new.group.tolist() == [0, 1, 7, 3]
    assert not without(new, 2).active.any()
    assert new.active[2]


@pytest.mark.parametrize(
    ("broken", "field"),
    [
        (shape("blob"), "type"),
        (shape("sphere", -0.1), "dims[0]"),
        (shape("sphere", 0.0), "dims[0]"),
        (shape("sphere", math.nan), "dims"),
        (shape("sphere", 1e9), "dims"),
        (shape("capsule", 0.1, 0.0), "dims[1]"),
        (shape("segment", -1.0, 0.1), "dims[0]"),
        (shape("cone", 0.0, 0.0, 0.1), "dims"),
        (shape("cone", 0.1, -0.1, 0.1), "dims[1]"),
        (shape("box", 0.1, 0.1, 0.0), "dims[2]"),
        (shape("n_ellipsoid", 0.1, 0.1, 0.1, 0.5), "dims[3]"),
        (shape("n_cylinder", 0.1, 0.1, 0.1, 51.0), "dims[3]"),
        (shape("sphere", 0.1, position=np.array([0.0, math.inf, 0.0])), "position"),
        (shape("sphere", 0.1, position=np.zeros(2)), "position"),
        (shape("sphere", 0.1, wxyz=np.zeros(4)), "wxyz"),
        (shape("sphere", 0.1, velocity=np.array([0.0, math.nan, 0.0])), "velocity"),
        (shape("sphere", 0.1, omega=np.zeros(4)), "omega"),
    ],
)
def test_a_shape_that_cannot_be_used_is_refused_by_the_name_of_its_field(broken: Shape, field: str) -> None:
    assert fault_of(broken).startswith(field + ":")
    with pytest.raises(ValueError, match=field.split("[")[0]):
        with_shape(obstacles_empty(1), 0, broken)


@bodies
def test_usable_shapes_have_no_fault(name: str) -> None:
    assert fault_of(BODIES[name][0]) == ""

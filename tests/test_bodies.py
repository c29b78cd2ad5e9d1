"""Meshes and clouds: true distances and normals, a pre-filter that changes no bit, files that are refused by a line."""

import math
import re
from pathlib import Path

import coal
import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from rtctl.arm.field import CONTACT, MovingPoints, field, field_buffers, field_params
from rtctl.design.assets import load_cloud, load_mesh, packed
from rtctl.errors import ConfigError
from rtctl.spec.files import read_cloud
from rtctl.types import F64, Shape
from rtctl.world.meshes import mesh_body
from rtctl.world.primitives import (
    CLOUD_POINTS,
    CLOUDS,
    Obstacles,
    distance,
    distances,
    distances_into,
    fault_of,
    obstacles_empty,
    with_shape,
)
from tests.bodies import (
    SURFACES,
    Surface,
    box,
    cloud_shape,
    known,
    mesh_shape,
    sampled,
    torus,
    write_obj,
    write_stl,
)
from tests.lab import without

MESHES = known(**{name.replace(" ", "_"): s for name, s in SURFACES.items()})
surfaces = pytest.mark.parametrize("name", SURFACES)


def measured(name: str, X: F64) -> tuple[F64, F64]:
    return distance(mesh_shape(name.replace(" ", "_")), X, MESHES)


def about(s: Surface, count: int, rng: np.random.Generator, grow: float = 1.6) -> F64:
    """Return points in and about a surface's box, a tenth of them on its planes of symmetry."""
    low, size = s.V.min(axis=0), np.ptp(s.V, axis=0)
    X = low + 0.5 * size + 0.5 * rng.uniform(-1, 1, (count, 3)) * (grow * size + 0.05)
    X[: count // 30, 0] = X[count // 30 : count // 15, 1] = X[count // 15 : count // 10, 2] = 0.0
    return np.asarray(X)


@surfaces
def test_a_mesh_is_measured_to_its_nearest_sample_and_signed_by_what_is_inside(name: str) -> None:
    """20,000 points a surface, outside, on and inside: never longer than to a sample, nor shorter by its spacing."""
    s, rng = SURFACES[name], np.random.default_rng(1)
    X = about(s, 20_000, rng)
    rho, n = measured(name, X)
    assert np.all(np.isfinite(rho))
    assert np.abs(np.linalg.norm(n, axis=1) - 1.0).max() < 1e-12
    nearest, _ = cKDTree(sampled(s, 400_000, rng)).query(X)
    assert (nearest - np.abs(rho)).min() > -1e-12
    assert (nearest - np.abs(rho)).max() < 6e-3
    assert np.mean(nearest - np.abs(rho)) < 1e-3
    clear = np.abs(rho) > (2e-3 if name == "torus" else 1e-12)  # a facet's sagitta
    assert np.array_equal(rho[clear] < 0.0, s.inside(X[clear]))
    assert np.mean(rho < 0.0) > 0.001
    foot_rho, foot_n = measured(name, X - rho[:, None] * n)
    assert np.abs(foot_rho).max() < 1e-12
    assert np.abs(np.linalg.norm(foot_n, axis=1) - 1.0).max() < 1e-12


@surfaces
def test_a_mesh_agrees_with_coal(name: str) -> None:
    """Unsigned, to the bounding-volume hierarchy of another library, at random poses."""
    s, rng = SURFACES[name], np.random.default_rng(2)
    vertices, triangles, model = coal.StdVec_Vec3s(), coal.StdVec_Triangle(), coal.BVHModelOBBRSS()
    vertices.extend(list(s.V))
    triangles.extend([coal.Triangle(*map(int, t)) for t in s.T])
    model.beginModel(len(s.T), len(s.V))
    model.addSubModel(vertices, triangles)
    model.endModel()
    speck = coal.Sphere(1e-9)
    for x in about(s, 300, rng):
        wxyz = rng.normal(size=4)
        wxyz /= np.linalg.norm(wxyz)
        R, p = Rotation.from_quat(np.roll(wxyz, -1)).as_matrix(), rng.uniform(-1, 1, 3)
        y = R @ x + p
        result = coal.DistanceResult()
        coal.distance(
            model, coal.Transform3s(R, p), speck, coal.Transform3s(np.eye(3), y), coal.DistanceRequest(), result
        )
        rho, _ = distance(mesh_shape(name.replace(" ", "_"), p, wxyz), y[None], MESHES)
        assert abs(rho[0]) == pytest.approx(result.min_distance, abs=1e-7)


@surfaces
def test_the_normal_of_a_mesh_is_the_gradient_of_its_distance(name: str) -> None:
    X, h = about(SURFACES[name], 2_000, np.random.default_rng(3)), 1e-6
    rho, n = measured(name, X)
    plus = np.stack([measured(name, X + h * e)[0] for e in np.eye(3)], axis=1)
    minus = np.stack([measured(name, X - h * e)[0] for e in np.eye(3)], axis=1)
    smooth = np.all(np.abs(plus + minus - 2.0 * rho[:, None]) < 1e-10, axis=1)
    assert smooth.mean() > 0.8
    assert np.abs((plus - minus) / (2 * h) - n)[smooth].max() < 1e-10 / (2 * h)


@surfaces
def test_on_the_surface_of_a_mesh_the_normal_neither_flips_nor_fades(name: str) -> None:
    """Faces, edges and corners: just outside, on and just inside it points out."""
    s, rng = SURFACES[name], np.random.default_rng(4)
    p = s.V[s.T]
    spots = np.concatenate([sampled(s, 500, rng), s.V, 0.5 * (p[:, 0] + p[:, 1])])
    _, n = measured(name, spots)
    assert np.abs(np.linalg.norm(n, axis=1) - 1.0).max() < 1e-12
    for step in (1e-5, 1e-8, -1e-8, -1e-5):
        rho, m = measured(name, spots + step * n)
        assert np.all(np.sign(rho) == np.sign(step))
        assert np.einsum("ij,ij->i", m, n).min() > 0.0


def test_a_surface_turned_inside_out_is_the_same_solid_and_a_hull_fills_it() -> None:
    s, X = SURFACES["ell"], about(SURFACES["ell"], 500, np.random.default_rng(5))
    rho, _ = measured("ell", X)
    from rtctl.world.meshes import NONE, added

    turned = added(NONE, "it", mesh_body(s.V, s.T[:, ::-1]))
    assert np.array_equal(distance(mesh_shape("it"), X, turned)[0], rho)
    hull = added(NONE, "it", mesh_body(s.V, s.T[:3], hull=True))
    wrapped, _ = distance(mesh_shape("it"), X, hull)
    assert np.all(wrapped <= rho + 1e-12)
    assert np.min(wrapped - rho) < -0.01


def cloud(count: int, rng: np.random.Generator, radius: float = 0.01) -> tuple[Shape, F64]:
    """Return a cloud and its points; every tenth twice."""
    steps = rng.integers(-3000, 3000, (count, 3))
    steps[: count // 10] = steps[count - count // 10 :]
    wxyz = rng.normal(size=4)
    wxyz /= np.linalg.norm(wxyz)
    at = rng.uniform(-0.3, 0.3, 3)
    R = Rotation.from_quat(np.roll(wxyz, -1)).as_matrix()
    return cloud_shape(steps, 1e-4, radius, at, wxyz), at + 1e-4 * steps @ R.T


@pytest.mark.parametrize("count", [1, 2, 16, 17, 1000, CLOUD_POINTS])
def test_a_cloud_is_measured_to_its_nearest_ball(count: int) -> None:
    """20,000 points for each size, against scipy's tree; on a point of the cloud the normal is some unit vector."""
    rng = np.random.default_rng(count)
    shape, points = cloud(count, rng)
    X = rng.uniform(-0.6, 0.6, (20_000, 3))
    X[: min(count, 500)] = points[:500]
    d, index = cKDTree(points).query(X)
    rho, n = distance(shape, X)
    assert np.abs(rho - (d - 0.01)).max() < 1e-12
    assert np.abs(np.linalg.norm(n, axis=1) - 1.0).max() < 1e-12
    away, clear = (X - points[index]) / np.maximum(d, 1e-300)[:, None], d > 1e-6
    second = (
        cKDTree(np.unique(points, axis=0)).query(X, k=min(2, len(np.unique(points, axis=0))))[0].reshape(20_000, -1)
    )
    clear &= (second[:, -1] - d > 1e-9) | (second.shape[1] == 1)
    assert np.abs(n - away)[clear].max() < 1e-6


def test_the_order_of_a_clouds_points_changes_no_distance() -> None:
    rng = np.random.default_rng(7)
    steps, X = rng.integers(-3000, 3000, (3000, 3)), rng.uniform(-0.4, 0.4, (2000, 3))
    a, b = (distance(cloud_shape(s, 1e-4, 0.01), X)[0] for s in (steps, rng.permutation(steps)))
    assert a.tobytes() == b.tobytes()


@pytest.mark.parametrize(("count", "voxel"), [(500, 0.0), (5000, 0.02), (60_000, 0.0), (60_000, 0.01)])
def test_a_thinned_cloud_holds_every_ball_of_the_whole_and_little_more(count: int, voxel: float) -> None:
    rng = np.random.default_rng(8)
    points = rng.normal(size=(count, 3)) * np.array([0.3, 0.2, 0.05]) + np.array([1.0, 2.0, 3.0])
    p = packed(points, 0.01, voxel)
    assert p.points <= CLOUD_POINTS
    assert p.radius - 0.01 <= (2e-4 if voxel == 0.0 and count <= CLOUD_POINTS else math.sqrt(3.0) * max(voxel, 0.1))
    steps = np.frombuffer(p.steps, "<i2").reshape(-1, 3).astype(np.int64)
    X = p.centre + rng.uniform(-1, 1, (5000, 3))
    thin, _ = distance(cloud_shape(steps, p.step, p.radius, p.centre), X)
    whole = cKDTree(points).query(X)[0] - 0.01
    assert np.all(thin <= whole + 1e-12)
    assert np.all(thin >= whole - 2.0 * (p.radius - 0.01) - 1e-12)


def scene(rng: np.random.Generator) -> tuple[Obstacles, F64, F64]:
    """Return meshes, clouds and round things, some of them with a margin, and points about them."""
    names = [name.replace(" ", "_") for name in SURFACES]
    o = obstacles_empty(14, MESHES)
    for k in range(12):
        wxyz = rng.normal(size=4)
        at, wxyz = rng.uniform(-0.5, 0.5, 3), wxyz / np.linalg.norm(wxyz)
        if k % 3 == 0:
            s = mesh_shape(names[rng.integers(len(names))], at, wxyz)
        elif k % 3 == 1 and k < 3 * CLOUDS:
            s = cloud(int(rng.integers(1, 900)), rng)[0]._replace(position=at)
        else:
            size = rng.uniform(0.02, 0.2, 4) + np.array([0, 0, 0, 2.0])
            s = Shape("it", "n_ellipsoid", size, at, wxyz, rng.normal(size=3) * 0.1, np.zeros(3))
        o = with_shape(o, k, s, group=int(rng.integers(0, 12)), known=MESHES)
    o.margin[:12] = rng.choice([0.0, 0.0, 0.03], 12)
    return o, rng.uniform(-0.8, 0.8, (33, 3)), rng.uniform(0, 0.06, 33)


def test_the_pre_filter_keeps_every_bit_of_what_it_promises() -> None:
    """Distances below the cut-off and the least of each obstacle are exact; the rest is never too long."""
    rng, left = np.random.default_rng(9), 0
    for cutoff in (-0.01, 0.0, 0.1, 0.4):
        for _ in range(15):
            o, P, radius = scene(rng)
            rho, normal = distances(P, radius, o)
            out = np.full((rho.shape[0], 4, rho.shape[1]), 7.0)
            distances_into(np.ascontiguousarray(P.T), radius, o, cutoff, out)
            out, rho, normal = out[o.active], rho[o.active], normal[o.active]
            exact = (rho <= cutoff) | (rho == rho.min(axis=1, keepdims=True))
            assert np.array_equal(out[:, 0][exact], rho[exact])
            assert np.array_equal(out[:, 1:].transpose(0, 2, 1)[exact], normal.transpose(0, 2, 1)[exact])
            assert np.all(out[:, 0][~exact] <= rho[~exact] + 1e-12)
            assert np.all(out[:, 0][~exact] > cutoff)
            assert np.array_equal(out[:, 0].argmin(axis=1), rho.argmin(axis=1))
            left += int(np.sum(out[:, 0] != rho))
    assert left > 1000  # it does filter


PARAMS = field_params(0.5, 0.1, 0.02, 1e-3, 0.7, 0.3, 50.0)


def repelled(o: Obstacles, P: F64, radius: F64, prefilter: bool = True, seed: int = 0) -> tuple[list[bytes], F64, int]:
    """Return the bits of what the field gives, its torque and its flags, on points of random mobility."""
    rng = np.random.default_rng(seed)
    m, n = len(P), 7
    Jp, M = rng.normal(size=(m, 3, n)) * 0.4, rng.normal(size=(n, n))
    A_inv = np.linalg.inv(M @ M.T + np.eye(n))
    B = np.einsum("jid,de,jke->jik", Jp, A_inv, Jp).copy()
    out, link = field_buffers(o.active.shape[0], m, n), np.sort(rng.integers(1, n + 1, m))
    flags = field(
        MovingPoints(P, Jp, B, radius, link), np.zeros(n), rng.normal(size=n) * 0.3, o, PARAMS, out, prefilter
    )
    return [a.tobytes() for a in (out.tau, out.rho_min, out.nearest, out.force)], out.tau.copy(), int(flags)


def test_the_pre_filter_changes_no_bit_of_the_torque() -> None:
    rng, acts = np.random.default_rng(10), 0
    for seed in range(40):
        o, P, radius = scene(rng)
        with_, tau, _ = repelled(o, P, radius, True, seed)
        assert with_ == repelled(o, P, radius, False, seed)[0]
        acts += bool(tau.any())
    assert acts > 20


@pytest.mark.parametrize("kind", ["mesh", "cloud"])
def test_one_that_appears_on_the_arm_pushes_out_with_a_bounded_force(kind: str) -> None:
    """A point inside goes the shortest way out; the push is that of the cap, however deep."""
    rng = np.random.default_rng(11)
    steps = (sampled(torus(), 3000, rng) / 1e-4).astype(np.int64)
    shape = mesh_shape("torus") if kind == "mesh" else cloud_shape(steps, 1e-4, 0.01)
    o = with_shape(obstacles_empty(2, MESHES), 0, shape, known=MESHES)
    P = sampled(torus(), 200, rng) * rng.uniform(0.95, 1.02, (200, 1))
    eye, pushes = np.tile(np.eye(3), (1, 1, 1)), []
    for x in P:
        out = field_buffers(2, 1, 3)
        flags = field(
            MovingPoints(x[None], eye, eye, np.full(1, 0.02), np.ones(1, np.int64)),
            np.zeros(3),
            np.zeros(3),
            o,
            PARAMS,
            out,
            True,
        )
        rho, n = distance(shape, x[None], MESHES)
        assert np.allclose(out.tau / np.linalg.norm(out.tau), n[0], atol=1e-9)
        assert bool(flags & CONTACT) == (rho[0] - 0.02 <= 0.0)
        if flags & CONTACT:
            pushes.append(float(np.linalg.norm(out.tau)))
    cap = PARAMS.eta * (1 / PARAMS.rho_num - 1 / PARAMS.rho0) / PARAMS.rho_num**2
    assert len(pushes) > 100
    assert np.allclose(pushes, cap, rtol=1e-12)


def test_a_coordinate_that_is_not_a_number_never_becomes_a_distance() -> None:
    for shape in (mesh_shape("ell"), cloud_shape(np.zeros((1, 3), np.int64), 1e-3, 0.01)):
        X = np.full((4, 3), 0.1)
        X[[0, 1, 2], [0, 1, 2]] = np.nan
        assert np.isfinite(distance(shape, X, MESHES)[0]).tolist() == [False, False, False, True]


@pytest.mark.parametrize(
    ("broken", "line"),
    [
        (mesh_shape("ghost"), "mesh: got 'ghost', wanted one of the config's: box"),
        (cloud_shape(np.zeros((0, 3)), 1e-3, 0.01), "cloud: got 0 bytes"),
        (cloud_shape(np.zeros((CLOUD_POINTS + 1, 3)), 1e-3, 0.01), "cloud: got 60006 bytes"),
        (cloud_shape(np.zeros((1, 3)), 1e-3, 0.01)._replace(cloud=b"1234567"), "cloud: got 7 bytes"),
        (cloud_shape(np.zeros((1, 3)), 0.0, 0.01), "dims[1]: got a step of 0.0 m"),
        (cloud_shape(np.zeros((1, 3)), math.nan, 0.01), "dims: got"),
        (cloud_shape(np.zeros((1, 3)), 1e-3, -1.0), "dims[0]: got -1.0 m"),
    ],
)
def test_what_cannot_be_used_is_refused_by_a_line(broken: Shape, line: str) -> None:
    assert fault_of(broken, MESHES).startswith(line)
    with pytest.raises(ValueError, match="got"):
        with_shape(obstacles_empty(1, MESHES), 0, broken, known=MESHES)


def test_there_is_room_for_some_clouds_and_a_new_one_takes_the_place_of_an_old() -> None:
    one = cloud_shape(np.zeros((1, 3)), 1e-3, 0.01)
    o = obstacles_empty(8)
    for k in range(CLOUDS):
        o = with_shape(o, k, one._replace(position=np.array([float(k), 0, 0])))
    with pytest.raises(ValueError, match="4 already"):
        with_shape(o, 6, one)
    o = with_shape(without(o, 1), 6, one._replace(position=np.array([9.0, 0, 0])))
    o = with_shape(o, 2, cloud_shape(np.array([[0, 0, 0], [100, 0, 0]]), 1e-3, 0.01, np.array([5.0, 0, 0])))
    rho, _ = distances(np.zeros((1, 3)), np.zeros(1), o)
    assert np.allclose(rho[[0, 2, 3, 6], 0], [-0.01, 4.99, 2.99, 8.99])
    assert np.isinf(rho[1, 0])


@pytest.mark.parametrize("form", ["stl", "ascii.stl", "obj"])
def test_mesh_files_are_read_as_what_was_written(form: str, tmp_path: Path) -> None:
    s, path = SURFACES["ell"], tmp_path / f"it.{form}"
    write_obj(path, s, 0.001) if form == "obj" else write_stl(path, s, form == "ascii.stl")
    from rtctl.world.meshes import NONE, added

    meshes = added(NONE, "it", load_mesh(path, 0.001 if form == "obj" else 1.0, False, "here"))
    X = about(s, 300, np.random.default_rng(12))
    assert np.abs(distance(mesh_shape("it"), X, meshes)[0] - measured("ell", X)[0]).max() < 1e-8  # STL is float32


def open_box() -> Surface:
    s = box(0.1, 0.1, 0.1)
    return s._replace(T=s.T[1:])


def two_boxes() -> Surface:
    a, b = box(0.1, 0.1, 0.1), box(0.1, 0.1, 0.1, (0.1, 0.05, 0.03))
    return a._replace(V=np.concatenate([a.V, b.V]), T=np.concatenate([a.T, b.T + 8]))


BAD_MESHES = {
    "open": (lambda p: write_obj(p, open_box()), "3 open edges"),
    "crossing itself": (lambda p: write_obj(p, two_boxes()), "crosses itself"),
    "folded": (lambda p: write_obj(p, box(1, 1, 1)._replace(T=np.array([[0, 1, 2]] * 4))), "twice the same way"),
    "flat": (lambda p: write_obj(p, box(1, 1, 0.0)), "triangles|no volume|twice"),
    "empty": (lambda p: p.write_text(""), "no triangles"),
    "words": (lambda p: p.write_text("v 1 2 three\n"), "could not convert"),
    "wild index": (lambda p: p.write_text("v 1 2 3\nf 1 2 3\n"), "vertex 3 of 1"),
    "not a number": (lambda p: p.write_text("v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"), "not a number"),
    "missing": (lambda p: None, "no such file"),
}


@pytest.mark.parametrize("fault", BAD_MESHES)
def test_a_bad_mesh_file_is_one_clear_line(fault: str, tmp_path: Path) -> None:
    write, reason = BAD_MESHES[fault]
    write(tmp_path / "it.obj")
    with pytest.raises(ConfigError, match=reason) as caught:
        load_mesh(tmp_path / "it.obj", 1.0, False, "panda.toml: mesh[0].file")
    line = str(caught.value)
    assert line.startswith("panda.toml: mesh[0].file: got ")
    assert "it.obj" in line
    assert "\n" not in line
    for raw in (b"", bytes(90), b"solid but not", write_stl(tmp_path / "a.stl", box(1, 1, 1)).read_bytes()[:-1]):
        (tmp_path / "b.stl").write_bytes(raw)
        with pytest.raises(ConfigError, match=r"STL|triangles"):
            load_mesh(tmp_path / "b.stl", 1.0, False, "x")


def test_cloud_files_are_read_as_what_was_written(tmp_path: Path) -> None:
    points = np.random.default_rng(13).normal(size=(50, 3))
    np.save(tmp_path / "a.npy", np.column_stack([points, points]))
    np.savetxt(tmp_path / "b.xyz", np.column_stack([points, points]), header="x y z", fmt="%.17g")
    head = "ply\nformat {}\ncomment no\nelement vertex 50\nproperty uchar red\n"
    head += "".join(f"property double {c}\n" for c in "xyz") + "element face 0\nproperty list uchar int i\nend_header\n"
    rows = "\n".join("7 {:.17g} {:.17g} {:.17g}".format(*p) for p in points)
    (tmp_path / "c.ply").write_text(head.format("ascii 1.0") + rows + "\n")
    for name, order in (("d", "<"), ("e", ">")):
        table = np.zeros(50, np.dtype([("r", "u1"), ("p", order + "f8", 3)]))
        table["p"] = points
        word = "binary_little_endian 1.0" if order == "<" else "binary_big_endian 1.0"
        (tmp_path / f"{name}.ply").write_bytes(head.format(word).encode() + table.tobytes())
    for name in ("a.npy", "b.xyz", "c.ply", "d.ply", "e.ply"):
        assert np.array_equal(read_cloud(tmp_path / name), points), name
    for name, raw in (
        ("f.npy", b"\x93NUMPY"),
        ("g.xyz", b"1 2\n"),
        ("h.xyz", b"nan 1 2\n"),
        ("i.xyz", b""),
        ("j.ply", b"ply\n"),
        ("k.ply", head.format("binary_little_endian 1.0").encode() + b"short"),
        ("l.pcd", b""),
        ("missing.xyz", None),
    ):
        if raw is not None:
            (tmp_path / name).write_bytes(raw)
        with pytest.raises(ConfigError, match=name) as caught:
            load_cloud(tmp_path / name, 0.01, 0.0, "s.toml: obstacle[0].file")
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("size", "scale", "reason"),
    [
        (1e30, 1.0, "1e+30 units"),
        (1e300, 1e4, "1e+300 units"),  # whose product is no number
        (50.5, 1.0, "a solid of 101 m"),
        (1e6, 1e-6, ""),  # in micrometres, it is a solid of two metres
        (1e-30, 1.0, "a solid of 2e-30 m"),
    ],
)
def test_a_mesh_is_as_large_as_solids_are(size: float, scale: float, reason: str, tmp_path: Path) -> None:
    path = write_obj(tmp_path / "it.obj", box(size, size, size))
    if not reason:
        assert len(load_mesh(path, scale, False, "x"))
        return
    with pytest.raises(ConfigError, match=re.escape(reason)):
        load_mesh(path, scale, False, "x")


@pytest.mark.parametrize("far", [1e300, -1e30, 9001.0])
def test_a_cloud_lies_where_places_are(far: float, tmp_path: Path) -> None:
    np.save(tmp_path / "it.npy", np.full((3, 3), far))
    with pytest.raises(ConfigError, match="from the origin, wanted at most 9000 m"):
        load_cloud(tmp_path / "it.npy", 0.01, 0.0, "x")

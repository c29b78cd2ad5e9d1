"""Spheres that stand for the links, against surface samples and Coal's own distances."""

import hashlib
import os
import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import Any

import coal
import numpy as np
import pinocchio
import pytest

from rtctl.arm.points import Coverage, Points
from rtctl.arm.rigid_body import RigidBody
from rtctl.design import kept
from rtctl.design.points import coverage, given, place
from rtctl.design.solids import solids_of
from rtctl.errors import ConfigError
from rtctl.types import F64
from tests.arms import CROOKED, CROOKED_JOINTS, crooked, panda, states

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(autouse=True)
def nothing_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spheres are placed anew in each test."""
    monkeypatch.setattr(kept, "folder", lambda: tmp_path)


@cache
def placed() -> tuple[Points, Coverage]:
    return place(panda())


def on_surface(shape: Any, count: int, rng: np.random.Generator) -> F64:
    """Return random points of a shape's surface in its own frame."""
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    if isinstance(shape, coal.BVHModelBase):
        corners = np.array(shape.vertices())
        triangles = [shape.tri_indices(i) for i in range(shape.num_tris)]
        index = np.array([[t[k] for k in range(3)] for t in triangles])[rng.integers(len(triangles), size=count)]
        weights = rng.dirichlet((1.0, 1.0, 1.0), size=count)
        return np.asarray((weights[:, :, None] * corners[index]).sum(axis=1))
    if isinstance(shape, coal.Box):
        cube = rng.uniform(-1.0, 1.0, (count, 3))
        axis = rng.integers(3, size=count)
        cube[np.arange(count), axis] = np.sign(cube[np.arange(count), axis])
        return np.asarray(cube * np.array(shape.halfSide))
    if isinstance(shape, coal.Sphere):
        return np.asarray(direction * shape.radius)
    assert isinstance(shape, coal.Cylinder)
    angle, z = rng.uniform(0.0, 2.0 * np.pi, count), rng.uniform(-1.0, 1.0, count) * shape.halfLength
    lid = rng.random(count) < 0.4
    r = np.where(lid, shape.radius * np.sqrt(rng.random(count)), shape.radius)
    z = np.where(lid, np.sign(z) * shape.halfLength, z)
    return np.column_stack([r * np.cos(angle), r * np.sin(angle), z])


def world_samples(body: RigidBody, q: F64, count: int) -> list[tuple[str, int, F64]]:
    """Return URDF link, number of the link and world samples of every collision shape, placed by Pinocchio."""
    rng = np.random.default_rng(5)
    data, geometry = body.model.createData(), body.geometry.createData()
    pinocchio.updateGeometryPlacements(body.model, data, body.geometry, geometry, body.configuration(q))
    found = []
    for k, thing in enumerate(body.geometry.geometryObjects):
        X = geometry.oMg[k]
        samples = on_surface(thing.geometry, count, rng) @ np.array(X.rotation).T + np.array(X.translation)
        joint = body.model.names[thing.parentJoint]
        found.append(
            (
                body.model.frames[thing.parentFrame].name,
                1 + body.names.index(joint) if joint in body.names else 0,
                samples,
            )
        )
    return found


def beyond(points: Points, centres: F64, link: int, samples: F64) -> float:
    """Return how far samples stick out of the spheres of one link at worst; negative when all are inside."""
    mine = points.link == link
    gap = np.linalg.norm(samples[:, None] - centres[mine], axis=2) - points.radius[mine]
    return float(gap.min(axis=1).max())


def test_spheres_hold_the_surface_of_every_moving_link_in_any_posture() -> None:
    points, report = placed()
    for q, qd, _ in states(panda(), 3):
        m = panda().evaluate(q, qd, points)
        for _, link, samples in world_samples(panda(), q, 4000):
            if link > 0:
                assert beyond(points, m.P[: len(points.radius)], link, samples) <= 1e-9
    assert report.fraction == 1.0
    assert report.protrusion <= 0.0
    assert report.bare == ()


def test_spheres_are_few_none_is_on_the_base_and_each_names_its_link() -> None:
    points, _ = placed()
    assert 30 <= len(points.radius) <= 60
    assert set(points.link) == set(range(1, 8))
    assert {name for name, link in zip(points.names, points.link, strict=True) if link == 5} == {"panda_link5"}
    assert {name for name, link in zip(points.names, points.link, strict=True) if link == 7} <= {
        "panda_link7",
        "panda_hand",
        "panda_leftfinger",
        "panda_rightfinger",
    }


def solid(shape: Any) -> Any:
    """Return Coal's convex hull of a mesh: to Coal the mesh itself is a skin, with room inside."""
    if not isinstance(shape, coal.BVHModelBase):
        return shape
    own = shape.clone()
    own.buildConvexHull(True, "Qt")
    return own.convex


def test_no_sphere_reaches_further_beyond_its_link_than_stated() -> None:
    points, report = placed()
    assert report.overhang <= 0.025
    rng = np.random.default_rng(2)
    speck, shapes = coal.Sphere(1e-6), panda().geometry.geometryObjects
    at = [coal.Transform3s(np.array(g.placement.rotation), np.array(g.placement.translation)) for g in shapes]
    hulls = [solid(g.geometry) for g in shapes]
    worst = 0.0
    for j in range(len(points.radius)):
        mine = [k for k, g in enumerate(shapes) if g.parentJoint == points.link[j]]
        direction = rng.normal(size=(60, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        for p in points.local[j] + direction * points.radius[j]:
            there, request = coal.Transform3s(np.eye(3), p), coal.DistanceRequest()
            gaps = [coal.distance(hulls[k], at[k], speck, there, request, coal.DistanceResult()) for k in mine]
            worst = max(worst, min(gaps))
    assert 0.9 * report.overhang < worst <= report.overhang + 1e-5


def test_a_finer_cover_has_more_spheres_and_less_overhang(tmp_path: Path) -> None:
    body = crooked(tmp_path)
    coarse, fine = place(body, 0.04), place(body, 0.02)
    assert len(coarse[0].radius) < len(fine[0].radius)
    for (points, report), overhang in ((coarse, 0.04), (fine, 0.02)):
        assert report.overhang <= overhang
        assert report.fraction == 1.0
        m = body.evaluate(np.zeros(4), np.zeros(4), points)
        for _, link, samples in world_samples(body, np.zeros(4), 4000):
            if link > 0:
                assert beyond(points, m.P[: len(points.radius)], link, samples) <= 1e-9


def _digest() -> str:
    points, _ = placed()
    fields = (points.link, points.local, points.radius)
    return hashlib.sha256(b"".join(field.tobytes() for field in fields)).hexdigest()


def test_another_process_places_the_same_spheres_to_the_bit() -> None:
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONHASHSEED": "7"}
    anew = "from rtctl.design import kept; kept.read = lambda path: None"
    script = f"{anew}; from tests.test_points import _digest; print(_digest())"
    run = subprocess.run([sys.executable, "-c", script], env=environment, cwd=ROOT, capture_output=True, text=True)
    assert run.stdout.strip().splitlines()[-1:] == [_digest()], run.stderr


def test_listed_spheres_are_taken_in_the_frame_of_their_urdf_link() -> None:
    tip = np.array([0.0, 0.0, 0.1034])
    points, report = given(panda(), [("panda_hand", tip, 0.03), ("panda_link4", np.zeros(3), 0.1)])
    q, qd, _ = states(panda(), 1)[0]
    m = panda().evaluate(q, qd, points)
    assert m.P[0] == pytest.approx(m.x, abs=1e-12)  # the tip frame is there on the hand
    assert m.Jp[0] == pytest.approx(m.J[:3], abs=1e-12)
    assert points.names == ("panda_hand", "panda_link4")
    assert points.link.tolist() == [7, 4]
    assert 0.0 < report.fraction < 0.5
    assert {"panda_link2", "panda_link5", "panda_hand"} <= set(report.bare)


def test_coverage_of_a_sphere_that_is_too_small_is_what_samples_show(tmp_path: Path) -> None:
    body = crooked(tmp_path)
    cover, _ = place(body)
    keep = cover.link != 2
    ball = Points(
        np.append(cover.link[keep], 2),
        np.vstack([cover.local[keep], [0.01, 0.0, 0.0]]),
        np.append(cover.radius[keep], 0.055),  # the link is a sphere of 0.06 about its origin
        (*np.array(cover.names)[keep], "b"),
    )
    report = coverage(ball, body)
    assert report.bare == ("b",)
    assert report.protrusion == pytest.approx(0.06 + 0.01 - 0.055, abs=2e-3)
    assert 0.5 < report.fraction < 1.0
    names = tuple(np.array(cover.names)[keep])
    without = coverage(Points(cover.link[keep], cover.local[keep], cover.radius[keep], names), body)
    assert without.bare == ("b",)
    assert without.protrusion >= 0.06


def test_a_listed_sphere_far_outside_its_link_is_all_overhang() -> None:
    _, report = given(panda(), [("panda_link1", np.array([1.0, 0.0, 0.0]), 0.05)])
    assert report.overhang == pytest.approx(0.05 + 1.0 - 0.055, abs=0.01)  # the link is a 0.055 m column


@pytest.mark.parametrize("link", ["panda_link0", "nonsense"])
def test_spheres_on_what_does_not_move_are_refused_by_name(link: str) -> None:
    with pytest.raises(ConfigError, match=rf"avoid\.points\[1\]\.link: got {link}, wanted one of .*panda_hand"):
        given(panda(), [("panda_hand", np.zeros(3), 0.03), (link, np.zeros(3), 0.03)])


def test_an_arm_without_shapes_or_with_flat_ones_is_refused(tmp_path: Path) -> None:
    bare, flat = tmp_path / "bare.urdf", tmp_path / "flat.urdf"
    bare.write_text(CROOKED.replace("<collision>", "<!--").replace("</collision>", "-->"))
    with pytest.raises(ConfigError, match="no collision geometry"):
        place(RigidBody.from_urdf(bare, CROOKED_JOINTS, "tip", np.eye(4)))
    corners = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]
    facets = "".join(
        "facet normal 0 0 1 outer loop\n"
        + "".join(f"vertex {x} {y} {z}\n" for x, y, z in (corners[i] for i in triangle))
        + "endloop endfacet\n"
        for triangle in ((0, 1, 2), (0, 2, 3))
    )
    (tmp_path / "flat.stl").write_text(f"solid flat\n{facets}endsolid flat\n")
    flat.write_text(CROOKED.replace('<sphere radius="0.06"/>', f'<mesh filename="{tmp_path}/flat.stl"/>'))
    with pytest.raises(ConfigError, match="degenerate"):
        place(RigidBody.from_urdf(flat, CROOKED_JOINTS, "tip", np.eye(4)))


@pytest.mark.parametrize("radius", ["1e30", "60.0"])
def test_a_link_in_other_units_than_metres_is_refused_before_it_is_cut_into_triangles(
    radius: str, tmp_path: Path
) -> None:
    huge = tmp_path / "huge.urdf"
    huge.write_text(CROOKED.replace('<sphere radius="0.06"/>', f'<sphere radius="{radius}"/>'))
    with pytest.raises(ConfigError, match="from its joint, wanted at most 5 m"):
        place(RigidBody.from_urdf(huge, CROOKED_JOINTS, "tip", np.eye(4)))


def same(a: tuple[Points, Coverage], b: tuple[Points, Coverage]) -> bool:
    alike = all(np.array_equal(x, y) for x, y in zip(a[0], b[0], strict=True))
    return alike and a[1] == b[1]


def test_what_was_placed_is_kept_to_the_bit_by_all_that_decides_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    body = crooked(tmp_path)
    made = place(body, 0.04)
    with monkeypatch.context() as patch:
        patch.setattr("rtctl.design.points._placed", None)
        assert same(place(body, 0.04), made)
        with pytest.raises(TypeError):
            place(body, 0.03)
        patch.setattr(kept, "stamp", lambda *_: "other sources")
        with pytest.raises(TypeError):
            place(body, 0.04)
    assert not same(place(body, 0.03), made)
    other = tmp_path / "other.urdf"
    other.write_text(CROOKED.replace('<sphere radius="0.06"/>', '<sphere radius="0.061"/>'))
    assert not same(place(RigidBody.from_urdf(other, CROOKED_JOINTS, "tip", np.eye(4)), 0.04), made)


@pytest.mark.parametrize("damage", ["", "{}", "[1]", '{"link": [1]}', "\x00"])
def test_a_file_that_is_damaged_is_made_anew(tmp_path: Path, damage: str) -> None:
    body = crooked(tmp_path)
    made = place(body, 0.04)
    (path,) = (tmp_path / "points").iterdir()
    path.write_text(damage)
    assert same(place(body, 0.04), made)
    assert kept.read(path) is not None


def test_a_file_of_which_one_digit_is_another_is_made_anew(tmp_path: Path) -> None:
    """A sphere that is a little smaller reads as well as the true one, and protects less."""
    body = crooked(tmp_path)
    made = place(body, 0.04)
    (path,) = (tmp_path / "points").iterdir()
    text = path.read_text()
    first = text.index('"radius": [0.') + len('"radius": [0.')
    path.write_text(text[:first] + "0" + text[first:])  # a tenth
    assert same(place(body, 0.04), made)


def test_hulls_are_kept_to_the_bit_and_made_anew_where_their_file_is_damaged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    body = crooked(tmp_path)
    made = solids_of(body)
    (path,) = (tmp_path / "hulls").iterdir()
    with monkeypatch.context() as patch:
        patch.setattr("scipy.spatial.ConvexHull", None)
        for before, now in zip(made, solids_of(body), strict=True):
            assert before[:2] == now[:2]
            assert all(
                a.dtype == b.dtype and a.tobytes() == b.tobytes() for a, b in zip(before[2:], now[2:], strict=True)
            )
        path.write_text(path.read_text()[:-9])
        with pytest.raises(TypeError):
            solids_of(body)
    assert len(solids_of(body)) == len(made)
    assert kept.known(path) is not None


def test_where_nothing_can_be_written_spheres_are_placed_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    body = crooked(tmp_path)
    (tmp_path / "file").touch()
    monkeypatch.setattr(kept, "folder", lambda: tmp_path / "file")
    assert len(place(body, 0.04)[0].radius)


def test_the_latest_placements_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kept, "KEPT", 2)
    body = crooked(tmp_path)
    for overhang in (0.04, 0.045, 0.05):
        place(body, overhang)
    assert len(list((tmp_path / "points").iterdir())) == 2

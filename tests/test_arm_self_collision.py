"""The arm against itself: distances against the meshes themselves, slopes by differences, forces by hand."""

from functools import cache
from pathlib import Path

import coal
import numpy as np
import pinocchio
import pytest

from rtctl.arm.apart import hulls_apart
from rtctl.arm.field import CAPPED, CONTACT, field_params, own_field
from rtctl.arm.rigid_body import RigidBody
from rtctl.arm.self_collision import Own, nothing
from rtctl.design import kept, pairs
from rtctl.design.pairs import hulls_of, watched
from rtctl.types import F64
from tests.arms import NO_POINTS, PANDA_HOME, panda

INFLUENCE, CLEARANCE, REACH = 0.02, 0.008, 0.04
PARAMS = field_params(0.5, INFLUENCE, CLEARANCE, 1e-3, 1.0, 0.0, 50.0)
UNDAMPED = PARAMS._replace(k_d=0.0)
NO_ENDS = np.zeros(0)  # no posture of a goal


@cache
def own() -> Own:
    limits = panda().limits
    return watched(panda(), limits.q_min, limits.q_max, PANDA_HOME, CLEARANCE, REACH)


def postures(count: int, seed: int = 2) -> F64:
    limits = panda().limits
    return np.random.default_rng(seed).uniform(limits.q_min, limits.q_max, (count, 7))


def meshes_of(body: RigidBody, q: F64) -> dict[str, tuple[coal.CollisionGeometry, coal.Transform3s]]:
    """Return each link's own collision mesh (not our hull of it), placed by Pinocchio."""
    data, placement = body.model.createData(), body.geometry.createData()
    pinocchio.updateGeometryPlacements(body.model, data, body.geometry, placement, q)
    return {
        thing.name.rpartition("_")[0]: (
            thing.geometry,
            coal.Transform3s(placement.oMg[k].rotation, placement.oMg[k].translation),
        )
        for k, thing in enumerate(body.geometry.geometryObjects)
        if thing.name.endswith("_0") and "finger" not in thing.name
    }


def test_distances_are_those_of_the_meshes() -> None:
    checked = 0
    for q in postures(150):
        m = panda().evaluate(q, np.zeros(7), NO_POINTS, own())
        meshes = meshes_of(panda(), q)
        for (far, near), rho in zip(own().names, m.own_rho, strict=True):
            if far in meshes and near in meshes and rho > 1e-4:
                true = coal.distance(*meshes[far], *meshes[near], coal.DistanceRequest(), coal.DistanceResult())
                assert true == pytest.approx(rho, abs=2e-4) if np.isfinite(rho) else true >= REACH - 2e-4
                checked += 1
    assert checked > 500


@pytest.mark.parametrize("reach", [0.01, REACH, 0.2])
def test_a_pair_is_left_out_only_where_gjk_finds_it_beyond_reach(reach: float) -> None:
    every = Own(own().hulls, own().pairs, reach)
    asked = within = 0
    for q in postures(400, seed=7):
        R, t = panda().placements(q)
        at = [coal.Transform3s(R[h.link], t[h.link]) for h in every.hulls]
        true = np.array(
            [
                coal.distance(
                    every.hulls[i].shape,
                    at[i],
                    every.hulls[j].shape,
                    at[j],
                    coal.DistanceRequest(),
                    coal.DistanceResult(),
                )
                for i, j in every.pairs
            ]
        )
        assert (every.distances(R, t) == np.where(true < reach, true, np.inf)).all()
        asked, within = asked + len(every.near(R, t)), within + int((true < reach).sum())
    assert 10 < within <= asked < 1.2 * within  # and few are measured for nothing


def test_whether_two_hulls_are_apart_is_what_coal_says_to_the_micrometre() -> None:
    every = Own(own().hulls, own().pairs, np.inf)
    touch = near = 0
    for q in postures(150, seed=5):
        R, t = panda().placements(q)
        for (i, j), rho in zip(every.pairs, every.distances(R, t), strict=True):
            for off in (-1e-2, -1e-3, -1e-6, 1e-6, 1e-3, 1e-2):
                if rho + off > 0.0:
                    assert hulls_apart(i, j, every.arrays, rho + off, R, t) == (off < 0.0)
                    near += rho < REACH
            if rho < -1e-6:
                assert not hulls_apart(i, j, every.arrays, 1e-3, R, t)
                touch += 1
    assert touch > 5
    assert near > 200


def test_slopes_are_those_of_finite_differences() -> None:
    h, checked, bad = 1e-6, 0, 0
    for q in postures(500, seed=1):
        m = panda().evaluate(q, np.zeros(7), NO_POINTS, own())
        for s in np.flatnonzero(np.isfinite(m.own_rho) & (m.own_rho > 2e-3)):
            ends = [[panda().own_distances(q + sign * h * e, own())[s] for sign in (-1.0, 1.0)] for e in np.eye(7)]
            slope = np.array([(b - a) / (2 * h) for a, b in ends])
            if np.isfinite(slope).all():  # none of the postures left the measured zone
                wrong = np.abs(slope - m.own_row[s]).max() > 1e-3
                checked += 1
                bad += wrong  # where two faces are parallel the nearest points jump and there is no slope
    assert checked > 30
    assert bad <= 0.05 * checked


def test_neighbours_and_links_that_never_meet_are_not_watched() -> None:
    names = set(own().names)
    # the hulls of forearm and hand fill the crook of the wrist: near at home, two joints apart
    assert not {("panda_hand", "panda_link5"), ("panda_link7", "panda_link5")} & names
    assert not {("panda_link2", "panda_link1"), ("panda_link5", "panda_link3"), ("panda_link4", "panda_link2")} & names
    assert {("panda_hand", "panda_link0"), ("panda_hand", "panda_link2"), ("panda_link5", "panda_link0")} <= names


def test_links_that_meet_in_few_postures_are_watched(monkeypatch: pytest.MonkeyPatch) -> None:
    every, limits, link = own(), panda().limits, {h.name: h.link for h in hulls_of(panda())}
    monkeypatch.setattr(pairs, "POSTURES", 40)  # as if what a pair meets in were fifty times as rare
    few = watched(panda(), limits.q_min, limits.q_max, PANDA_HOME, CLEARANCE, REACH)
    meet = {
        names
        for q in postures(600, seed=9)
        for names, rho in zip(every.names, panda().own_distances(q, every), strict=True)
        if rho < CLEARANCE and link[names[0]] - link[names[1]] > 2  # what two joints move is soon seen
    }
    assert len(meet) > 10
    assert meet <= set(few.names)


def test_links_that_are_near_at_home_are_watched() -> None:
    limits = panda().limits
    hand, arm = "panda_hand", "panda_link2"
    near = next(
        q
        for q in postures(20000, seed=4)
        for names, rho in zip(own().names, panda().own_distances(q, own()), strict=True)
        if names == (hand, arm) and CLEARANCE < rho < INFLUENCE
    )
    assert (hand, arm) in watched(panda(), limits.q_min, limits.q_max, near, CLEARANCE, REACH).names


def test_the_bounding_balls_hold_their_hulls() -> None:
    from rtctl.design.solids import solids_of

    hulls = {h.name: h for h in hulls_of(panda())}
    for solid in solids_of(panda()):
        h = hulls[solid.name]
        assert np.linalg.norm(solid.corners - h.centre, axis=1).max() <= h.radius + 1e-12


def test_without_pairs_nothing_is_measured_and_nothing_pushes() -> None:
    m = panda().evaluate(PANDA_HOME, np.zeros(7), NO_POINTS, nothing())
    assert m.own_rho.shape == (0,)
    tau, least, flags = own_field(m.own_rho, m.own_row, np.zeros(7), np.zeros(7), m.A_inv, PARAMS, NO_ENDS)
    assert not tau.any()
    assert (least, flags) == (np.inf, 0)


ROW = np.array([[0.3, -0.2, 0.5]])
M = np.random.default_rng(4).normal(size=(3, 3))
A_INV = np.asarray(np.linalg.inv(M @ M.T + np.eye(3)), np.float64)


def push(rho: float) -> float:
    """Return the slope of U = eta/2 (1/rho - 1/rho0)^2 by differences."""
    h = 1e-8

    def U(r: float) -> float:
        return 0.5 * PARAMS.eta * (1 / r - 1 / PARAMS.rho0) ** 2

    return (U(rho - h) - U(rho + h)) / (2 * h)


def test_a_pair_is_opened_with_the_acceleration_of_a_unit_mass() -> None:
    tau, least, flags = own_field(np.array([0.012]), ROW, np.zeros(3), np.zeros(3), A_INV, UNDAMPED, NO_ENDS)
    assert ROW[0] @ A_INV @ tau == pytest.approx(push(0.012), rel=1e-5)
    assert np.linalg.norm(np.cross(tau, ROW[0])) < 1e-9 * np.linalg.norm(tau)
    assert (least, flags) == (0.012, 0)


def test_distance_follows_the_joints_between_two_evaluations() -> None:
    dq = np.array([0.01, 0.0, -0.002])
    rho = 0.012 + float(ROW[0] @ dq)
    tau, least, _ = own_field(np.array([0.012]), ROW, dq, np.zeros(3), A_INV, UNDAMPED, NO_ENDS)
    assert least == pytest.approx(rho)
    assert ROW[0] @ A_INV @ tau == pytest.approx(push(rho), rel=1e-5)


def test_links_as_far_apart_as_at_the_goal_do_not_push_and_nearer_they_do() -> None:
    """The whole potential has its minimum at the goal, unless links are nearer there than their clearance."""

    def along(rho: float, there: float) -> float:
        tau, _, _ = own_field(np.array([rho]), ROW, np.zeros(3), np.zeros(3), A_INV, UNDAMPED, np.array([there]))
        return float(ROW[0] @ A_INV @ tau)

    assert along(0.012, 0.012) == 0.0 < along(0.011, 0.012) < push(0.011)
    assert along(0.012, np.inf) == pytest.approx(push(0.012), rel=1e-5)
    assert along(0.006, 0.006) > 0.0


def test_only_closing_is_damped() -> None:
    still = own_field(np.array([0.012]), ROW, np.zeros(3), np.zeros(3), A_INV, PARAMS, NO_ENDS)[0]
    closing = own_field(np.array([0.012]), ROW, np.zeros(3), -ROW[0], A_INV, PARAMS, NO_ENDS)[0]
    opening = own_field(np.array([0.012]), ROW, np.zeros(3), ROW[0], A_INV, PARAMS, NO_ENDS)[0]
    assert closing @ ROW[0] > still @ ROW[0] > 0.0
    assert np.allclose(opening, still)


@pytest.mark.parametrize("rho", [0.0, -0.03, PARAMS.rho_num])
def test_contact_is_flagged_bounded_and_still_pushed_apart(rho: float) -> None:
    tau, _, flags = own_field(np.array([rho]), ROW, np.zeros(3), np.zeros(3), A_INV, UNDAMPED, NO_ENDS)
    assert flags == (CAPPED if rho > 0.0 else CAPPED | CONTACT)
    assert ROW[0] @ A_INV @ tau == pytest.approx(push(PARAMS.rho_num), rel=1e-5)


def test_what_was_found_of_pairs_before_is_kept_and_found_anew_for_another_arm(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kept, "folder", lambda: tmp_path)
    limits = panda().limits
    first = watched(panda(), limits.q_min, limits.q_max, PANDA_HOME, CLEARANCE, REACH)
    monkeypatch.setattr(pairs, "_meet", None)  # it is not asked again
    assert watched(panda(), limits.q_min, limits.q_max, PANDA_HOME, CLEARANCE, REACH).names == first.names
    with pytest.raises(TypeError):
        watched(panda(), limits.q_min, 0.9 * limits.q_max, PANDA_HOME, CLEARANCE, REACH)

"""The rigid-body terms, against pybullet, finite differences and energy."""

import hashlib
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pinocchio
import pytest
from scipy.spatial.transform import Rotation

from rtctl.arm.model import Model, spd_inverse
from rtctl.arm.points import Points
from rtctl.arm.rigid_body import RigidBody
from rtctl.errors import ConfigError
from rtctl.spec.urdf import package_folders
from rtctl.types import F64
from tests.arms import (
    CROOKED,
    CROOKED_JOINTS,
    NO_POINTS,
    PANDA,
    PANDA_JOINTS,
    TILTED,
    Bullet,
    crooked,
    panda,
    states,
)

SHUFFLED = ("hinge", "wheel", "wrist", "slide")
ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("urdf")


@pytest.fixture(scope="module", params=["panda", "crooked", "shuffled"])
def pair(request: pytest.FixtureRequest, folder: Path) -> Iterator[tuple[RigidBody, Bullet]]:
    if request.param == "panda":
        body, bullet = panda(), Bullet(PANDA, PANDA_JOINTS, np.eye(4), folder)
    else:
        joints = CROOKED_JOINTS if request.param == "crooked" else SHUFFLED
        body = crooked(folder, joints)
        bullet = Bullet(folder / "crooked.urdf", joints, TILTED, folder)
    yield body, bullet
    bullet.close()


@pytest.fixture(params=["panda", "crooked", "shuffled"])
def body(request: pytest.FixtureRequest, folder: Path) -> RigidBody:
    if request.param == "panda":
        return panda()
    return crooked(folder, CROOKED_JOINTS if request.param == "crooked" else SHUFFLED)


def some_points(body: RigidBody, count: int = 20) -> Points:
    """Return points scattered over all moving links."""
    rng = np.random.default_rng(1)
    link = 1 + np.arange(count, dtype=np.int64) % body.n
    return Points(link, rng.normal(scale=0.1, size=(count, 3)), np.full(count, 0.05), ("",) * count)


def evaluate(body: RigidBody, q: F64, qd: F64) -> Model:
    return body.evaluate(q, qd, some_points(body))


def derivative(f: Callable[[F64], F64], q: F64, h: float = 1e-6) -> F64:
    """Return df/dq by central differences, the joint as last axis."""
    columns = [(f(q + h * e) - f(q - h * e)) / (2.0 * h) for e in np.eye(len(q))]
    return np.stack(columns, axis=-1)


def turn_rate(R: F64, dR: F64) -> F64:
    """Return omega of dR = [omega] R."""
    W = dR @ R.T
    return np.array([W[2, 1] - W[1, 2], W[0, 2] - W[2, 0], W[1, 0] - W[0, 1]]) / 2.0


def test_dynamics_agree_with_pybullet_at_a_thousand_states(pair: tuple[RigidBody, Bullet]) -> None:
    body, bullet = pair
    for q, qd, qdd in states(body, 1000):
        m = body.evaluate(q, qd, NO_POINTS)
        tau, A = bullet.torques(q, qd, qdd), bullet.mass_matrix(q)
        assert np.abs(m.A - A).max() <= 1e-5 * np.abs(A).max()
        assert np.abs(m.A @ qdd + m.h + m.g - tau).max() <= 1e-5 * np.abs(tau).max()
        still = bullet.torques(q, 0.0 * qd, 0.0 * qdd)
        assert m.g == pytest.approx(still, abs=1e-5 * np.abs(still).max())
        assert m.h == pytest.approx(bullet.torques(q, qd, 0.0 * qdd) - still, abs=1e-5 * np.abs(tau).max())


def test_the_tip_is_where_pybullet_puts_its_link(pair: tuple[RigidBody, Bullet]) -> None:
    body, bullet = pair
    link = "panda_hand_tcp" if body.n == 7 else "tip"
    for q, qd, _ in states(body, 30):
        m = body.evaluate(q, qd, NO_POINTS)
        position, rotation = bullet.link_pose(link, q)
        assert m.x == pytest.approx(position, abs=1e-6)
        assert np.abs(m.R - rotation).max() < 1e-6


def test_each_jacobian_is_the_derivative_of_its_position(body: RigidBody) -> None:
    for q, qd, _ in states(body, 10):
        m = evaluate(body, q, qd)
        assert m.J[:3] == pytest.approx(derivative(lambda q: evaluate(body, q, 0.0 * q).x, q), abs=1e-8)
        dR = derivative(lambda q: evaluate(body, q, 0.0 * q).R, q)
        rates = np.stack([turn_rate(m.R, dR[..., k]) for k in range(body.n)], axis=-1)
        assert m.J[3:] == pytest.approx(rates, abs=1e-8)
        assert m.Jp == pytest.approx(derivative(lambda q: evaluate(body, q, 0.0 * q).P, q), abs=1e-8)


def test_velocity_product_is_the_acceleration_of_the_tip_at_constant_joint_speed(body: RigidBody) -> None:
    h = 1e-5
    for q, qd, _ in states(body, 30):
        m = evaluate(body, q, qd)
        twist = [evaluate(body, q + s * h * qd, qd).J @ qd for s in (-1.0, 1.0)]
        assert m.Jdqd == pytest.approx((twist[1] - twist[0]) / (2.0 * h), abs=1e-6)
        x = [evaluate(body, q + s * 1e-4 * qd, qd).x for s in (-1.0, 0.0, 1.0)]
        assert m.Jdqd[:3] == pytest.approx((x[0] - 2.0 * x[1] + x[2]) / 1e-8, abs=1e-4)


def test_points_are_carried_by_their_link_alone(body: RigidBody) -> None:
    points = some_points(body)
    q, qd, _ = states(body, 1)[0]
    before = body.evaluate(q, qd, points)
    last = np.zeros(body.n)
    leaf = int(np.argmax(body.skeleton.chain.sum(axis=1))) - 1  # the joint at the end of the chain
    last[leaf] = 0.3
    after = body.evaluate(q + last, qd, points)
    moved = np.abs(after.P - before.P).max(axis=1) > 1e-9
    on_leaf = points.link == leaf + 1
    assert (moved == on_leaf).all()


def test_gravity_is_the_slope_of_potential_energy_on_a_tilted_base(body: RigidBody) -> None:
    for q, qd, _ in states(body, 5):
        data = body.model.createData()

        def potential(q: F64, data: object = data) -> F64:
            full = body.configuration(q)
            return np.array(pinocchio.computePotentialEnergy(body.model, data, full))

        assert evaluate(body, q, qd).g == pytest.approx(derivative(potential, q), abs=1e-6)


def test_coriolis_torque_does_the_work_that_a_changing_mass_matrix_takes(body: RigidBody) -> None:
    h = 1e-6
    for q, qd, _ in states(body, 20):
        m = evaluate(body, q, qd)
        dA = (evaluate(body, q + h * qd, qd).A - evaluate(body, q - h * qd, qd).A) / (2.0 * h)
        assert qd @ m.h == pytest.approx(0.5 * qd @ dA @ qd, abs=1e-7)
        assert m.h == pytest.approx(evaluate(body, q, -qd).h, abs=1e-11)  # quadratic in qd
        assert m.h * 4.0 == pytest.approx(evaluate(body, q, 2.0 * qd).h, abs=1e-10)


def test_inverse_inertias_are_numpys_and_a_unit_force_accelerates_by_them(body: RigidBody) -> None:
    m_points = 20
    for q, qd, _ in states(body, 20):
        m = evaluate(body, q, qd)
        inverse = np.linalg.inv(m.A)
        assert m.A_inv == pytest.approx(inverse, rel=1e-9, abs=1e-11 * np.abs(inverse).max())
        for k, force in enumerate(np.eye(6)):
            qdd = np.linalg.solve(m.A, m.J.T @ force)
            assert m.J @ qdd == pytest.approx(m.Lambda_inv[:, k], abs=1e-9 * np.abs(m.Lambda_inv).max())
        for j in range(m_points):
            for k, force in enumerate(np.eye(3)):
                qdd = np.linalg.solve(m.A, m.Jp[j].T @ force)
                assert m.Jp[j] @ qdd == pytest.approx(m.B[j][:, k], abs=1e-9 * np.abs(m.Lambda_inv).max())
        for symmetric in (m.A, m.A_inv, m.Lambda_inv, *m.B):
            assert (symmetric == symmetric.T).all()


def test_lambda_makes_the_dynamically_consistent_inverse() -> None:
    for q, qd, _ in states(panda(), 20):
        m = evaluate(panda(), q, qd)
        Lambda = np.linalg.inv(m.Lambda_inv)
        J_bar = m.A_inv @ m.J.T @ Lambda
        assert m.J @ J_bar == pytest.approx(np.eye(6), abs=1e-7)
        null = np.eye(7) - m.J.T @ J_bar.T
        assert m.J @ m.A_inv @ null == pytest.approx(np.zeros((6, 7)), abs=1e-7)  # no acceleration of the tip
        kinetic = 0.5 * (m.J @ qd) @ Lambda @ (m.J @ qd)
        assert kinetic <= 0.5 * qd @ m.A @ qd * (1.0 + 1e-9)  # the task can hold no more energy than the arm


def test_a_matrix_that_is_not_positive_definite_has_no_inverse_and_says_so() -> None:
    assert np.isnan(spd_inverse(np.diag([1.0, -1.0, 1.0]))).any()
    assert np.isnan(spd_inverse(np.zeros((2, 2)))).any()
    assert np.isnan(spd_inverse(np.full((3, 3), np.nan))).all()


def test_armature_adds_to_the_diagonal_alone(folder: Path) -> None:
    plain = crooked(folder)
    armature = np.array([0.1, 0.2, 0.3, 0.4])
    geared = RigidBody.from_urdf(folder / "crooked.urdf", CROOKED_JOINTS, "tip", TILTED, armature)
    q, qd, _ = states(plain, 1)[0]
    a, b = evaluate(plain, q, qd), evaluate(geared, q, qd)
    added = b.A - a.A
    assert added == pytest.approx(np.diag(armature), abs=1e-14)
    assert b.h == pytest.approx(a.h, abs=1e-14)
    assert b.g == pytest.approx(a.g, abs=1e-14)


def test_a_result_is_never_overwritten_by_the_next_and_repeats_to_the_bit(body: RigidBody) -> None:
    (q, qd, _), (other, other_d, _) = states(body, 2)
    first = evaluate(body, q, qd)
    kept = [field.copy() for field in first]
    evaluate(body, other, other_d)
    again = evaluate(body, q, qd)
    assert all((a == b).all() and (a == c).all() for a, b, c in zip(first, kept, again, strict=True))
    assert all(field.flags.c_contiguous and field.dtype == np.float64 for field in first)


def _digest(body: RigidBody) -> str:
    digest = hashlib.sha256()
    for q, qd, _ in states(body, 20):
        for field in evaluate(body, q, qd):
            digest.update(field.tobytes())
    return digest.hexdigest()


def test_another_process_without_the_compiler_gives_the_same_bits() -> None:
    script = "from tests.test_model import _digest; from tests.arms import panda; print(_digest(panda()))"
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1", "PYTHONPATH": str(ROOT)}
    run = subprocess.run([sys.executable, "-c", script], env=environment, cwd=ROOT, capture_output=True, text=True)
    assert run.stdout.strip().splitlines()[-1:] == [_digest(panda())], run.stderr


def test_a_state_that_is_not_finite_gives_terms_that_are_not(body: RigidBody) -> None:
    q, qd, _ = states(body, 1)[0]
    q[1] = np.nan
    m = evaluate(body, q, qd)
    assert not np.isfinite(m.x).all()
    assert not np.isfinite(m.A_inv).all()


def test_limits_are_the_urdfs_in_the_order_asked_for(folder: Path) -> None:
    limits = crooked(folder, SHUFFLED).limits
    assert limits.q_min.tolist() == [-2.0, -np.inf, -1.5, -0.2]
    assert limits.q_max.tolist() == [1.0, np.inf, 1.5, 0.3]
    assert limits.qd_max.tolist() == [2.0, 3.0, 4.0, 1.0]
    assert limits.tau_max.tolist() == [10.0, 20.0, 5.0, 50.0]


def test_a_turn_of_the_base_turns_the_whole_world_of_the_arm() -> None:
    X = np.eye(4)
    X[:3, :3], X[:3, 3] = Rotation.from_euler("z", 40, degrees=True).as_matrix(), (0.1, 0.2, 0.3)
    turned = RigidBody.from_urdf(PANDA, PANDA_JOINTS, "panda_hand_tcp", X, None, package_folders(PANDA))
    q, qd, _ = states(turned, 1)[0]
    a, b = evaluate(panda(), q, qd), evaluate(turned, q, qd)
    assert b.x == pytest.approx(X[:3, :3] @ a.x + X[:3, 3], abs=1e-12)
    assert b.P[:20] == pytest.approx(a.P[:20] @ X[:3, :3].T + X[:3, 3], abs=1e-12)
    assert b.g == pytest.approx(a.g, abs=1e-11)  # about the vertical: gravity is the same


REFUSED = [
    ({"joint_names": ("wheel", "nonsense")}, "nonsense", "wheel, slide, hinge, wrist, aside"),
    ({"joint_names": ("wheel", "wheel")}, "wheel twice", "once"),
    ({"joint_names": ("mount",)}, "mount", "wheel"),
    ({"joint_names": ()}, "none", "wheel"),
    ({"tip_frame": "nose"}, "nose", "tip"),
    ({"urdf": "absent.urdf"}, "no such file", "URDF"),
]


@pytest.mark.parametrize(("change", "got", "wanted"), REFUSED)
def test_what_the_urdf_does_not_have_is_refused_by_name(
    folder: Path, change: dict[str, object], got: str, wanted: str
) -> None:
    (folder / "crooked.urdf").write_text(CROOKED)
    arguments = {"urdf": folder / "crooked.urdf", "joint_names": CROOKED_JOINTS, "tip_frame": "tip", **change}
    with pytest.raises(ConfigError) as refusal:
        RigidBody.from_urdf(base_pose=np.eye(4), **arguments)  # type: ignore[arg-type]
    assert got in str(refusal.value.got)
    assert all(word in refusal.value.wanted for word in wanted.split(", "))


def test_meshes_that_cannot_be_found_and_links_without_mass_are_refused(folder: Path) -> None:
    with pytest.raises(ConfigError, match=r"link0\.stl"):
        RigidBody.from_urdf(PANDA, PANDA_JOINTS, "panda_hand_tcp", np.eye(4))
    massless = folder / "massless.urdf"
    massless.write_text(CROOKED.replace('<mass value="1.3"/>', '<mass value="0"/>').replace('="0.0', '="0.0000000'))
    with pytest.raises(ConfigError, match="inertia"):
        RigidBody.from_urdf(massless, CROOKED_JOINTS, "tip", np.eye(4))
    garbage = folder / "garbage.urdf"
    garbage.write_text("<robot><link/>")
    with pytest.raises(ConfigError, match=r"garbage\.urdf"):
        RigidBody.from_urdf(garbage, CROOKED_JOINTS, "tip", np.eye(4))

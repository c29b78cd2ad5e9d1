"""The four forms of the repulsion, against a few lines of numpy on Pinocchio's Jacobians, and in runs."""

import itertools
import math
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pinocchio as pin
import pytest

from rtctl import design as cfg
from rtctl.arm.diagnosis import balance
from rtctl.arm.field import SUM, TASK, FieldParams, MovingPoints, field, field_buffers
from rtctl.arm.law import evaluate_law
from rtctl.arm.osc import Twist, operational_space
from rtctl.arm.points import Points
from rtctl.arm.rigid_body import RigidBody
from rtctl.arm.robot import Robot
from rtctl.arm.terms import Motion, nothing_ahead
from rtctl.control.firas import eta_of, rho_num_of
from rtctl.errors import ConfigError
from rtctl.types import F64, State, Status
from rtctl.world.primitives import Obstacles, obstacles_empty, with_shape
from tests.lab import PANDA, play, robot, sphere

FORMS = tuple(itertools.product(("blend", "sum"), ("normal", "task")))
STRETCHED = np.zeros(7)
STRETCHED[3] = -1e-6


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return Path(tmp_path_factory.mktemp("forms"))


@cache
def path_of(folder: Path, superposition: str, inertia: str, extra: str = "") -> Path:
    """Write the Panda's config with a form; return its path."""
    path = folder / f"{superposition}_{inertia}.toml"
    keys = f'[avoid]\nsuperposition = "{superposition}"\ninertia = "{inertia}"\n{extra}'
    path.write_text(PANDA.read_text().replace("[avoid]\n", keys))
    return path


def arm_of(folder: Path, superposition: str, inertia: str) -> Robot:
    return robot(path_of(folder, superposition, inertia))


class Ball(NamedTuple):
    """An obstacle."""

    centre: F64  # (3,) [m]
    radius: float  # [m]


def table_of(balls: Sequence[Ball]) -> Obstacles:
    table = obstacles_empty(4)
    for k, ball in enumerate(balls):
        table = with_shape(table, k, sphere(str(k), ball.centre, ball.radius))
    return table


def scenes(count: int, seed: int = 0) -> list[tuple[F64, list[Ball]]]:
    """Return random postures of the Panda, each with two balls that some link is near to or in touch with."""
    arm, rng = robot(), np.random.default_rng(seed)
    found: list[tuple[F64, list[Ball]]] = []
    while len(found) < count:
        q = rng.uniform(arm.q_min, arm.q_max)
        P = arm.body.evaluate(q, np.zeros(7), arm.points).P
        balls = []
        for j in rng.integers(len(arm.points.radius), size=2):
            away = rng.normal(size=3)
            radius = rng.uniform(0.03, 0.15)
            gap = rng.uniform(0.0, 0.07)
            way = (radius + arm.points.radius[j] + gap) * away / np.linalg.norm(away)
            balls.append(Ball(P[j] + way, radius))
        found.append((q, balls))
    return found


class Seen(NamedTuple):
    """A point of the arm, by Pinocchio alone."""

    p: F64  # (3,) [m]
    J: F64  # (3, n)


def points_of(body: RigidBody, points: Points, q: F64) -> tuple[list[Seen], F64]:
    """Return the points of the arm and A^-1."""
    model, data = body.model, body.model.createData()
    pin.computeJointJacobians(model, data, q)
    pin.forwardKinematics(model, data, q)
    A = pin.crba(model, data, q)
    seen = []
    for link, local in zip(points.link, points.local, strict=True):
        joint = data.oMi[int(link)]
        lever = joint.rotation @ local
        J = pin.getJointJacobian(model, data, int(link), pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
        turned = np.cross(J[3:].T, lever).T  # w x lever
        seen.append(Seen(joint.translation + lever, J[:3] + turned))
    return seen, np.linalg.inv(np.triu(A) + np.triu(A, 1).T)


def expected(arm: Robot, q: F64, balls: Sequence[Ball], superposition: str, inertia: str) -> F64:
    """Return the torque (n,) of an arm at rest by the paper's equations, with the bounds that are stated."""
    f, b0 = arm.avoid, 1.0 / arm.avoid.m_max
    seen, A_inv = points_of(arm.body, arm.points, q)
    tau = np.zeros(arm.n)
    for ball in balls:
        terms, weights = [], []
        for at, radius, link in zip(seen, arm.points.radius, arm.points.link, strict=True):
            away = at.p - ball.centre
            rho = float(np.linalg.norm(away)) - ball.radius - radius
            if rho >= f.rho0:
                continue
            n, near = away / np.linalg.norm(away), max(rho, f.rho_num)
            a = f.eta * (1.0 / near - 1.0 / f.rho0) / near**2
            B = at.J @ A_inv @ at.J.T
            if inertia == "normal":
                b = n @ B @ n
                F = a * (1.0 / b if b > b0 else b / b0**2) * n
            else:
                s, V = np.linalg.eigh(B)
                F = a * (V @ np.diag(np.where(s > b0, 1.0 / np.maximum(s, 1e-300), s / b0**2)) @ V.T) @ n
            terms.append(at.J.T @ F)
            weights.append((int(link), a))
        for (link, a), term in zip(weights, terms, strict=True):
            whole = sum(other for of, other in weights if of == link)
            tau += term * (a / whole if superposition == "blend" else 1.0)
    return tau


def torque(arm: Robot, q: F64, obstacles: Obstacles, qd: F64 | None = None) -> F64:
    """Return the torque (n,) of the field."""
    still = np.zeros(arm.n)
    model = arm.body.evaluate(q, still, arm.points)
    points = MovingPoints(model.P, model.Jp, model.B, arm.points.radius, arm.points.link)
    out = field_buffers(4, len(arm.points.radius), arm.n)
    field(points, still, still if qd is None else qd, obstacles, arm.avoid, out, True)
    return out.tau.copy()


@pytest.mark.parametrize(("superposition", "inertia"), FORMS)
def test_the_field_is_that_of_its_equations(folder: Path, superposition: str, inertia: str):
    arm, acts = arm_of(folder, superposition, inertia), 0
    for q, balls in scenes(150):
        wanted = expected(arm, q, balls, superposition, inertia)
        got = torque(arm, q, table_of(balls))
        np.testing.assert_allclose(got, wanted, rtol=1e-6, atol=1e-6 * (1.0 + np.abs(wanted).max()))
        acts += bool(np.abs(wanted).max() > 1.0)
    assert acts > 100


def test_the_four_forms_are_four(folder: Path):
    q, balls = scenes(1, seed=3)[0]
    found = [torque(arm_of(folder, *form), q, table_of(balls)) for form in FORMS]
    for one, other in itertools.combinations(found, 2):
        assert np.abs(one - other).max() > 1e-3


@pytest.mark.parametrize(("superposition", "inertia"), FORMS)
def test_the_law_pushes_with_the_form_of_the_config(folder: Path, superposition: str, inertia: str):
    """The law scales what motors lack, by one factor for all joints."""
    arm = arm_of(folder, superposition, inertia)
    still, zero, alike = np.zeros(7), Twist(np.zeros(3), np.zeros(3)), 0
    for q, balls in scenes(20, seed=1):
        inside = np.clip(q, arm.q_min + 0.25, arm.q_max - 0.25)
        model = arm.body.evaluate(inside, still, arm.points, arm.own)
        space = operational_space(model.J, model.A_inv, model.Lambda_inv, np.eye(6)[:3], arm.motion)
        motion = Motion(
            inside, still, zero, zero, zero, inside, 1.0, still, False, still, nothing_ahead(arm), np.zeros(0)
        )
        table = obstacles_empty(arm.slots)
        for k, ball in enumerate(balls):
            table = with_shape(table, k, sphere(str(k), ball.centre, ball.radius))
        got = evaluate_law(arm, model, space, table, motion)
        wanted = expected(arm, inside, balls, superposition, inertia)
        if np.isfinite(model.own_rho).any() or not np.abs(wanted).max() > 1.0:
            continue  # links of the arm push each other there, too
        alike += 1
        scale = float(got.tau_obstacles @ wanted / (wanted @ wanted))
        assert 0.0 < scale <= 1.0 + 1e-6
        np.testing.assert_allclose(got.tau_obstacles, scale * wanted, atol=1e-5 * np.abs(wanted).max())
    assert alike >= 3


def test_files_without_the_keys_are_the_blend_along_normals(folder: Path):
    assert robot().avoid.forms == 0.0
    assert arm_of(folder, "blend", "normal").constants.tobytes() == robot().constants.tobytes()
    assert [int(arm_of(folder, *form).avoid.forms) for form in FORMS] == [0, TASK, SUM, SUM | TASK]


# ---- what differs


def angle(a: F64, b: F64) -> float:
    """Return the angle [deg] between two vectors."""
    cosine = float(a @ b / np.linalg.norm(a) / np.linalg.norm(b))
    return math.degrees(math.acos(min(max(cosine, -1.0), 1.0)))


def test_what_the_docs_say_of_the_forms_differences(folder: Path):
    """The sum pushes 3.6 times as hard in the median; Lambda turns the torque by 11 degrees, 45 in one of twenty."""
    ratio, turn = [], []
    for q, balls in scenes(300, seed=7):
        tau = [torque(arm_of(folder, *form), q, table_of(balls[:1])) for form in FORMS]
        blend, task, plain, _ = tau
        if np.linalg.norm(blend) < 0.1:
            continue
        ratio.append(float(np.linalg.norm(plain) / np.linalg.norm(blend)))
        turn.append(angle(blend, task))
    assert len(ratio) > 200
    assert 2.5 < np.median(ratio) < 5.0
    assert 7.0 < np.median(turn) < 15.0
    assert 30.0 < np.percentile(turn, 95) < 60.0


# ---- singular inertia


def singular() -> list[tuple[F64, int]]:
    """Return postures, each with a point of which some direction does not move: by the base, or of a stretched arm."""
    arm = robot()
    first = int(np.flatnonzero(arm.points.link == 1)[0])
    return [(arm.home, first), (STRETCHED, first), (STRETCHED, len(arm.points.radius) - 1), (np.zeros(7), 0)]


@pytest.mark.parametrize("inertia", ["normal", "task"])
@pytest.mark.parametrize("superposition", ["blend", "sum"])
def test_a_point_that_cannot_move_everywhere_gets_a_bounded_force_that_never_pulls(
    folder: Path, superposition: str, inertia: str
):
    """|F| <= 2 m_max a(rho_num), and the acceleration along n of the pushed point is not towards the ball."""
    arm = arm_of(folder, superposition, inertia)
    f, rng = arm.avoid, np.random.default_rng(5)
    cap = f.eta * (1.0 / f.rho_num - 1.0 / f.rho0) / f.rho_num**2
    for q, j in singular():
        model = arm.body.evaluate(q, np.zeros(7), arm.points)
        for rho in (0.03, 0.004, 0.0, -0.02):
            away = rng.normal(size=3)
            away /= np.linalg.norm(away)
            ball = Ball(model.P[j] + (0.05 + arm.points.radius[j] + rho) * away, 0.05)
            one = slice(j, j + 1)
            points = MovingPoints(
                model.P[one].copy(),
                model.Jp[one].copy(),
                model.B[one].copy(),
                arm.points.radius[one].copy(),
                arm.points.link[one].copy(),
            )
            for qd in (np.zeros(7), rng.normal(size=7), 1e6 * rng.normal(size=7)):
                out = field_buffers(4, 1, 7)
                field(points, np.zeros(7), qd, table_of([ball]), f, out, True)
                assert np.isfinite(out.tau).all()
                assert np.linalg.norm(out.force[0]) <= 2.0 * f.m_max * cap * (1.0 + 1e-9)
                n = -away if rho > -0.05 else away
                assert n @ model.Jp[j] @ model.A_inv @ out.tau >= -1e-9 * np.abs(out.tau).max()
            assert np.isfinite(torque(arm, q, table_of([ball]))).all()


def test_a_mobility_that_is_nothing_or_no_number_gives_no_force_or_is_seen(folder: Path):
    f = arm_of(folder, "blend", "task").avoid
    eye = np.eye(3)[None]
    for B, finite in ((0.0, True), (1e-300, True), (1e300, True), (math.nan, False)):
        out = field_buffers(4, 1, 3)
        points = MovingPoints(np.array([[0.0, 0.0, 0.06]]), eye, np.full((1, 3, 3), B), np.zeros(1), np.ones(1, int))
        field(points, np.zeros(3), np.zeros(3), table_of([Ball(np.zeros(3), 0.03)]), f, out, True)
        assert np.isfinite(out.tau).all() == finite


def lighter(f: FieldParams, forms: int) -> FieldParams:
    return f._replace(forms=float(forms))


def test_the_whole_inertia_of_a_point_accelerates_it_along_the_normal_and_the_mass_along_n_with_less_force():
    """Both give n . xdd = a; Lambda leaves nothing across, the mass along n is the least force that does."""
    arm, rng = robot(), np.random.default_rng(6)
    for q, balls in scenes(60, seed=2):
        model = arm.body.evaluate(q, np.zeros(7), arm.points)
        j = int(rng.choice(np.flatnonzero(arm.points.link >= 5)))
        away = model.P[j] - balls[0].centre
        away /= np.linalg.norm(away)
        ball = Ball(model.P[j] - (0.05 + arm.points.radius[j] + 0.03) * away, 0.05)
        one = slice(j, j + 1)
        points = MovingPoints(
            model.P[one], model.Jp[one], model.B[one], arm.points.radius[one], arm.points.link[one].copy()
        )
        if np.linalg.eigvalsh(model.B[j]).min() < 1.0 / arm.avoid.m_max:
            continue
        forces, f = [], arm.avoid
        a = f.eta * (1.0 / 0.03 - 1.0 / f.rho0) / 0.03**2
        for forms in (0, TASK):
            out = field_buffers(4, 1, 7)
            field(points, np.zeros(7), np.zeros(7), table_of([ball]), lighter(f, forms), out, True)
            xdd = model.Jp[j] @ model.A_inv @ out.tau
            assert away @ xdd == pytest.approx(a, rel=1e-6)
            if forms:
                np.testing.assert_allclose(xdd, a * away, atol=1e-6 * a)
            forces.append(float(np.linalg.norm(out.force[0])))
        assert forces[0] <= forces[1] * (1.0 + 1e-9)


# ---- what a rate can hold


def test_the_rate_must_hold_all_points_of_a_link_where_they_are_added(folder: Path):
    arm, plain = arm_of(folder, "sum", "normal"), robot()
    added = int(np.bincount(arm.points.link).max())
    assert added > 5
    assert arm.avoid.eta == plain.avoid.eta
    least = rho_num_of(added * arm.avoid.eta, arm.dt)
    assert arm.avoid.rho_num == max(least, 0.5 * arm.avoid.rho_min)
    assert added * arm.avoid.k_d * arm.dt <= 0.5 + 1e-12  # a damper that is sampled
    # what the rate holds of one point and not of all of a link
    eta = eta_of(arm.motion.v_max, arm.avoid.rho0, 0.002)
    assert rho_num_of(eta, arm.dt) < 0.002 < rho_num_of(added * eta, arm.dt)
    for form, refused in (("blend", False), ("sum", True)):
        lines = path_of(folder, form, "normal").read_text().splitlines()
        path = folder / "thin.toml"
        path.write_text("\n".join(["clearance_m = 0.002" if x.startswith("clearance_m") else x for x in lines]) + "\n")
        config = cfg.load(path)
        if refused:
            with pytest.raises(ConfigError, match=rf"avoid.clearance_m: .*{added} points of a link"):
                cfg.build(config, path)
        else:
            assert cfg.build(config, path).avoid.rho_min == 0.002


# ---- runs


@pytest.mark.parametrize(("superposition", "inertia"), FORMS)
def test_a_wall_that_holds_the_arm_is_named_whatever_the_form(folder: Path, superposition: str, inertia: str):
    """In balance the shares of what opposes the drive add up to one: a goal behind a wall, nothing else near."""
    path = folder / f"held_{superposition}_{inertia}.toml"
    alone = '[avoid]\nescape = false\nplan = "never"\nposture = "never"\n'
    path.write_text(path_of(folder, superposition, inertia).read_text().replace("[avoid]\n", alone))
    wall = {"name": "wall", "type": "box", "size_m": [0.05, 1.5, 1.5], "position_m": [0.75, 0.0, 0.5]}
    goal = [{"at_s": 0.3, "position_m": [0.85, 0.0, 0.5]}]
    run = play({"duration_s": 6.0, "goal": goal, "obstacle": [wall]}, path)
    assert run.figures["contacts"] == 0
    assert run.memory.status in (Status.LOCAL_MINIMUM, Status.SHADOWED)
    assert [text.partition(" at ")[0] for text in run.memory.blocked_by] == ["wall"]
    shares = balance(run.robot, run.memory, run.record["tau_limits"][-1], run.record["tau_wanted"][-1])
    assert shares.obstacles.sum() + shares.limits.sum() + shares.own == pytest.approx(1.0, abs=0.1)


AROUND = {
    "duration_s": 4.0,
    "goal": [{"at_s": 0.3, "position_m": [0.45, -0.35, 0.45]}],
    "start_q_rad": [0.7, -0.4, 0.0, -2.2, 0.0, 1.8, 0.8],
    "obstacle": [{"name": "ball", "type": "sphere", "radius_m": 0.08, "position_m": [0.45, -0.035, 0.445]}],
}


@pytest.mark.parametrize(("superposition", "inertia"), FORMS)
def test_it_goes_around_a_ball_and_keeps_every_bound(folder: Path, superposition: str, inertia: str):
    run = play(dict(AROUND), path_of(folder, superposition, inertia))
    f = run.figures
    assert f["arrived"]
    assert f["contacts"] == 0
    assert run.robot.avoid.rho_min < f["min_clearance_m"]["ball"] < 0.15
    assert max(f["max_torque_ratio"], f["max_torque_rate_ratio"], f["max_joint_speed_ratio"]) <= 1.0 + 1e-9
    assert f["max_speed_m_s"] <= 1.02 * run.robot.motion.v_max
    assert np.isfinite(run.record["tau_sent"]).all()
    assert run.memory.state == State.RUN


@pytest.mark.parametrize(("superposition", "inertia"), FORMS)
def test_a_stretched_arm_and_one_with_a_ball_at_its_base_have_finite_torques(
    folder: Path, superposition: str, inertia: str
):
    start = [0.0, 0.0, 0.0, -0.075, 0.0, 1.6, 0.8]
    balls = [
        {"name": "base", "type": "sphere", "radius_m": 0.05, "position_m": [0.19, 0.0, 0.2]},
        {"name": "hand", "type": "sphere", "radius_m": 0.06, "position_m": [0.12, 0.0, 1.25]},
    ]
    goal = [{"at_s": 0.3, "position_m": [0.35, 0.25, 0.7]}]
    run = play(
        {"duration_s": 2.0, "start_q_rad": start, "goal": goal, "obstacle": balls},
        path_of(folder, superposition, inertia),
    )
    f = run.figures
    assert f["contacts"] == 0
    assert np.isfinite(run.record["tau_sent"]).all()
    assert np.isfinite(run.record["tau_obstacles"]).all()
    assert max(f["max_torque_ratio"], f["max_joint_speed_ratio"]) <= 1.0 + 1e-9
    assert run.memory.state == State.RUN

"""The robots that come with the program: their descriptions against published numbers, their dynamics, their runs."""

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pinocchio as pin
import pytest

from firmware_sim.plant import Plant
from firmware_sim.settings import load as load_settings
from rtctl import design as cfg
from rtctl.arm.osc import operational_space
from rtctl.arm.pipe import tick
from rtctl.arm.robot import Robot
from rtctl.arm.task import selection
from rtctl.design.mobility import mobility
from rtctl.design.report import report
from rtctl.errors import ConfigError
from rtctl.types import F64, TOOL_Z, Request, State, Status, Task
from tests.arms import NO_POINTS
from tests.lab import ROOT, at_rest, healthy, play, robot
from tests.rig import Rig, until

NAMES = ("planar4", "puma560", "ur5", "openarm_e2e")
# a, d, alpha, mass, centre of mass and diagonal of the inertia in DH frame i (Corke and Armstrong-Helouvry 1994)
PUMA = (
    (0.0, 0.67183, np.pi / 2, 0.0, (0.0, 0.0, 0.0), (0.0, 0.35, 0.0)),
    (0.4318, 0.0, 0.0, 17.4, (-0.3638, 0.006, 0.2275), (0.13, 0.524, 0.539)),
    (0.0203, 0.15005, -np.pi / 2, 4.8, (-0.0203, -0.0141, 0.070), (0.066, 0.086, 0.0125)),
    (0.0, 0.4318, np.pi / 2, 0.82, (0.0, 0.019, 0.0), (1.8e-3, 1.3e-3, 1.8e-3)),
    (0.0, 0.0, -np.pi / 2, 0.34, (0.0, 0.0, 0.0), (0.3e-3, 0.4e-3, 0.3e-3)),
    (0.0, 0.0, 0.0, 0.09, (0.0, 0.0, 0.032), (0.15e-3, 0.15e-3, 0.04e-3)),
)
PUMA_MOTORS = np.array([200e-6] * 3 + [33e-6] * 3)  # [kg m2]
PUMA_FRICTION = np.array([1.48e-3, 0.817e-3, 1.38e-3, 71.2e-6, 82.6e-6, 36.7e-6])  # [Nms/rad]
PUMA_GEARS = np.array([-62.6111, 107.815, -53.7063, 76.0364, 71.923, 76.686])
PUMA_QN = np.array([0.0, np.pi / 4, np.pi, 0.0, np.pi / 4, 0.0])
# origin, axis, mass and centre of mass of each link (Enactic, openarm_description)
OPENARM = (
    ((0.0, 0.0, 0.0625), (0, 0, 1), 1.1417, (0.00115, 0.00003, 0.05395)),
    ((-0.0301, 0.0, 0.06), (-1, 0, 0), 0.2775, (0.0084, 0.0, 0.03257)),
    ((0.0301, 0.0, 0.06625), (0, 0, 1), 1.0739, (-0.0021, 0.00055, 0.08847)),
    ((0.0, 0.0315, 0.15375), (0, 1, 0), 0.5599, (-0.0029, -0.03031, 0.0634)),
    ((0.0, -0.0315, 0.0955), (0, 0, 1), 0.5507, (-0.00305, 0.00089, 0.04308)),
    ((0.0375, 0.0, 0.1205), (1, 0, 0), 0.3852, (-0.03714, 0.00033, -0.00009)),
    ((-0.0375, 0.0, 0.0), (0, 1, 0), 0.386, (0.00007, 0.01266, 0.06952)),
)


def config_of(name: str) -> Path:
    return ROOT / "configs" / f"{name}.toml"


def arm(name: str) -> Robot:
    return robot(config_of(name))


def postures(name: str, count: int = 5) -> F64:
    return np.random.default_rng(1).uniform(arm(name).q_min, arm(name).q_max, (count, arm(name).n))


def model_at(name: str, q: F64) -> Any:
    return arm(name).body.evaluate(q, np.zeros(len(q)), NO_POINTS)


def transform(R: F64, t: Any) -> F64:
    X = np.eye(4)
    X[:3, :3], X[:3, 3] = R, t
    return X


def about(axis: Any, angle: float) -> F64:
    """Rotation matrix about a unit axis (Rodrigues)."""
    x, y, z = axis
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * K + (1.0 - np.cos(angle)) * K @ K


def dh_frames(q: F64) -> list[F64]:
    """The PUMA's frames 1 to 6 by the standard convention: Rz(q) Tz(d) Tx(a) Rx(alpha), one after another."""
    X, frames = np.eye(4), []
    for angle, (a, d, alpha, *_) in zip(q, PUMA, strict=True):
        X = X @ transform(about((0, 0, 1), angle), (0, 0, d)) @ transform(about((1, 0, 0), alpha), (a, 0, 0))
        frames.append(X)
    return frames


def openarm_frames(q: F64) -> list[F64]:
    X, frames = np.eye(4), []
    for angle, (origin, axis, *_) in zip(q, OPENARM, strict=True):
        X = X @ transform(about(axis, angle), origin)
        frames.append(X)
    return frames


# ---- descriptions


def test_planar4_is_where_plane_trigonometry_says():
    for q in postures("planar4"):
        m, angle = model_at("planar4", q), np.cumsum(q)
        np.testing.assert_allclose(m.x, [0.5 * np.cos(angle).sum(), 0.5 * np.sin(angle).sum(), 0.0], atol=1e-12)
        np.testing.assert_allclose(m.R, about((0, 0, 1), angle[-1]), atol=1e-12)
        assert not m.g.any()  # it lies in the horizontal plane


def test_the_puma_is_where_its_denavit_hartenberg_table_says():
    for q in postures("puma560"):
        m, X = model_at("puma560", q), dh_frames(q)[-1] @ transform(np.eye(3), (0, 0, 0.05625))
        np.testing.assert_allclose(m.x, X[:3, 3], atol=1e-12)
        np.testing.assert_allclose(m.R, X[:3, :3], atol=1e-12)


def test_openarm_is_where_its_joint_table_says():
    for q in postures("openarm_e2e"):
        m, X = model_at("openarm_e2e", q), openarm_frames(q)[-1] @ transform(np.eye(3), (1e-6, 0.0205, 0.0))
        np.testing.assert_allclose(m.x, X[:3, 3], atol=1e-12)
        np.testing.assert_allclose(m.R, X[:3, :3], atol=1e-12)


@pytest.mark.parametrize(
    ("name", "kg"), [("planar4", 8.0), ("puma560", 23.45), ("ur5", 16.9939), ("openarm_e2e", 4.3749)]
)
def test_the_moving_links_weigh_what_is_published(name: str, kg: float):
    assert sum(i.mass for i in list(arm(name).body.model.inertias)[1:]) == pytest.approx(kg, abs=1e-9)


def test_the_puma_has_the_published_inertia_matrix_and_gravity():
    """At the nominal pose, as the Robotics Toolbox prints them (Corke, Robotics, Vision and Control): four decimals."""
    m = model_at("puma560", PUMA_QN)
    np.testing.assert_allclose(np.diag(m.A), [3.6594, 4.4137, 0.9378, 0.1925, 0.1713, 0.1941], atol=2e-4)
    np.testing.assert_allclose([m.A[0, 1], m.A[0, 2], m.A[1, 2]], [-0.4044, 0.1006, 0.3509], atol=2e-4)
    np.testing.assert_allclose(m.g, [0.0, 31.6399, 6.0351, 0.0, 0.0283, 0.0], atol=2e-3)


def test_the_puma_s_inertia_is_the_links_kinetic_energy_and_its_motors():
    eps = 1e-6
    for q in postures("puma560", 3):
        A = np.diag(PUMA_MOTORS * PUMA_GEARS**2)
        for i, (*_, mass, centre, inertia) in enumerate(PUMA):
            Jv, Jw, R = np.zeros((3, 6)), np.zeros((3, 6)), dh_frames(q)[i][:3, :3]
            for k in range(6):
                plus, minus = (dh_frames(q + s * eps * np.eye(6)[k])[i] for s in (1.0, -1.0))
                Jv[:, k] = ((plus - minus) @ (*centre, 1.0))[:3] / (2.0 * eps)
                W = (plus - minus)[:3, :3] @ R.T / (2.0 * eps)
                Jw[:, k] = W[2, 1], W[0, 2], W[1, 0]
            A += mass * Jv.T @ Jv + Jw.T @ R @ np.diag(inertia) @ R.T @ Jw
        np.testing.assert_allclose(model_at("puma560", q).A, A, atol=2e-5)  # the config rounds J G^2 to five digits


def test_openarm_s_gravity_is_the_slope_of_its_potential_energy():
    eps = 1e-6
    for q in postures("openarm_e2e", 3):

        def height(p: F64) -> float:
            frames = openarm_frames(p)
            return sum(9.81 * mass * (X @ (*c, 1.0))[2] for X, (_, _, mass, c) in zip(frames, OPENARM, strict=True))

        slope = [(height(q + eps * e) - height(q - eps * e)) / (2.0 * eps) for e in np.eye(7)]
        np.testing.assert_allclose(model_at("openarm_e2e", q).g, slope, atol=1e-6)


def test_planar4_s_inertia_is_that_of_slender_rods():
    q = np.array([0.3, 0.4, -0.9, 1.1])
    angle, A = np.cumsum(q), np.zeros((4, 4))
    for i in range(4):  # rod i: centre speed from the angles' rates, m l^2/12 about it
        J = np.zeros((2, 4))
        for j in range(i + 1):
            length = 0.25 if j == i else 0.5
            J[:, : j + 1] += (length * np.array([-np.sin(angle[j]), np.cos(angle[j])]))[:, None]
        A += 2.0 * J.T @ J
        A[: i + 1, : i + 1] += 2.0 * 0.5**2 / 12.0
    np.testing.assert_allclose(model_at("planar4", q).A, A, atol=1e-12)


# ---- configs


@pytest.mark.parametrize("name", NAMES)
def test_check_has_no_more_to_say_than_that_a_simulation_is_not_real_time(name: str):
    found = report(cfg.load(config_of(name)), arm(name))
    odd = ["inertia of link_3"] if name == "puma560" else []  # as published: no body has it
    assert [row.name for row in found.rows if row.verdict == "warn"] == ["servo period", *odd]
    assert arm(name).coverage.fraction == 1.0
    assert len(arm(name).points.radius) < 110


def test_the_damiao_drives_have_their_makers_scales_on_both_ends_of_the_wire():
    wanted = [(12.5, 45.0, 54.0)] * 2 + [(12.5, 8.0, 28.0)] * 2 + [(12.5, 30.0, 10.0)] * 3
    assert [tuple(s) for s in cfg.scales(cfg.load(config_of("openarm_e2e")))] == wanted
    assert [tuple(r.scale) for r in load_settings(config_of("openarm_e2e")).ratings] == wanted


def test_the_puma_s_motors_are_those_of_the_table():
    joints = cfg.load(config_of("puma560")).robot.joints
    np.testing.assert_allclose([j.armature_kg_m2 for j in joints], PUMA_MOTORS * PUMA_GEARS**2, rtol=1e-4)
    np.testing.assert_allclose([j.friction_Nms_rad for j in joints], PUMA_FRICTION * PUMA_GEARS**2, rtol=1e-3)


def test_the_puma_of_1986_is_the_other_but_for_its_motors():
    """Armstrong, Khatib and Burdick 1986, motor and drive inertia: their own table; all of it in A(q)."""
    motors = [1.14, 4.71, 0.827, 0.200, 0.179, 0.193]
    old, new = cfg.load(config_of("puma560_1986")), cfg.load(config_of("puma560"))
    assert [j.armature_kg_m2 for j in old.robot.joints] == motors
    plain = [msgspec.structs.replace(j, armature_kg_m2=0.0) for j in old.robot.joints]
    assert plain == [msgspec.structs.replace(j, armature_kg_m2=0.0) for j in new.robot.joints]
    assert old.robot.urdf == new.robot.urdf
    assert (old.motion, old.avoid, old.safety) == (new.motion, new.avoid, new.safety)
    more = np.diag(np.array(motors) - PUMA_MOTORS * PUMA_GEARS**2)
    for q in postures("puma560", 3):
        np.testing.assert_allclose(model_at("puma560_1986", q).A, model_at("puma560", q).A + more, atol=2e-5)
    assert report(old, arm("puma560_1986")).warnings == report(new, arm("puma560")).warnings


def test_compiled_code_sees_one_layout_of_constants_whatever_the_arm():
    """numba's cache would run the law of one arm for another: it numbers record types anew in each process."""
    assert len({arm(name).constants.dtype for name in NAMES}) == 1


# ---- plant


@pytest.mark.parametrize("name", [*NAMES, "puma560_1986"])
def test_the_plant_accelerates_as_pinocchio_does_with_motors_and_friction(name: str):
    body, settings = arm(name).body, load_settings(config_of(name))
    armature = np.array([j.armature for j in settings.joints])
    friction = np.array([j.friction for j in settings.joints])
    assert np.array_equal(np.array(body.model.armature), armature)
    plant, rng = Plant(settings, settings.home, []), np.random.default_rng(2)
    try:
        for q in 0.6 * postures(name, 3) + 0.4 * arm(name).home:
            qd, tau = rng.uniform(-0.5, 0.5, arm(name).n), rng.uniform(-0.2, 0.2, arm(name).n) * arm(name).tau_max
            plant.place(q)
            put_speed(plant, q, qd)
            plant.step(tau.tolist(), [0.0] * arm(name).n)
            got = (np.array(plant.qd) - qd) / (plant.step_ns * 1e-9)
            wanted = pin.aba(body.model, body.data, q, qd, tau - friction * qd)
            np.testing.assert_allclose(got, wanted, rtol=2e-3, atol=2e-2)
    finally:
        plant.close()


@pytest.mark.parametrize("name", ["puma560", "openarm_e2e"])
@pytest.mark.parametrize("held", [(1,), (0, 2)])
def test_joints_that_their_brakes_hold_leave_the_others_an_inertia_without_theirs(name: str, held: tuple[int, ...]):
    """(A + J)_ff qdd_f = (tau - B qd - h - g)_f of the free joints f: what is held does not turn its motor."""
    body, settings, n = arm(name).body, load_settings(config_of(name)), arm(name).n
    free = [j for j in range(n) if j not in held]
    friction = np.array([j.friction for j in settings.joints])
    plant, rng = Plant(settings, settings.home, []), np.random.default_rng(3)
    drag = [1e4 if j in held else 0.0 for j in range(n)]
    try:
        for q in 0.6 * postures(name, 3) + 0.4 * arm(name).home:
            qd, tau = rng.uniform(-0.5, 0.5, n), rng.uniform(-0.2, 0.2, n) * arm(name).tau_max
            qd[list(held)], tau[list(held)] = 0.0, 0.0
            plant.place(q)
            put_speed(plant, q, qd)
            plant.step(tau.tolist(), drag)
            got = (np.array(plant.qd) - qd) / (plant.step_ns * 1e-9)
            A = pin.crba(body.model, body.data, q)
            A = np.triu(A) + np.triu(A, 1).T
            bias = pin.nonLinearEffects(body.model, body.data, q, qd)
            wanted = np.linalg.solve(A[np.ix_(free, free)], (tau - friction * qd - bias)[free])
            np.testing.assert_allclose(got[free], wanted, rtol=5e-3, atol=5e-2)
            assert np.abs(np.array(plant.qd)[list(held)]).max() < 1e-3
    finally:
        plant.close()


def test_the_tick_expects_the_acceleration_that_friction_leaves_of_the_torque_it_sent():
    r = arm("puma560")
    qd = np.array([0.6, -0.5, 0.7, 1.5, -1.2, 1.0])
    first = at_rest(r, r.home)
    gravity = first.model.g
    running = first._replace(
        state=State.RUN,
        sent=np.tile(gravity, (4, 1)),
        speed_scale=1.0,
        joints=first.joints._replace(qd=qd),
        qd_measured=qd,
    )
    m, command, _ = tick(r, running, healthy(r.home, 0, qd=qd, tau=gravity), Request())
    assert m.state == State.RUN
    wanted = pin.aba(
        r.body.model, r.body.data, m.joints.q, m.joints.qd, command.tau - PUMA_FRICTION * PUMA_GEARS**2 * m.joints.qd
    )
    np.testing.assert_allclose(m.qdd, wanted, rtol=1e-3, atol=1e-3)


def put_speed(plant: Plant, q: F64, qd: F64) -> None:
    from firmware_sim.bullet import pb

    for i, position, speed in zip(plant.index, q, qd, strict=True):
        pb.resetJointState(plant.body, i, position, speed, physicsClientId=plant.client)
    plant._read()


# ---- what an arm can never do


def test_an_arm_in_a_plane_lacks_one_direction_and_two_turns_and_the_others_nothing():
    for name in NAMES:
        r = arm(name)
        never = mobility(r.body, r.q_min, r.q_max)
        plane = name == "planar4"
        np.testing.assert_allclose(never.still.T @ never.still, np.diag([0, 0, plane]), atol=1e-12)
        np.testing.assert_allclose(never.unturned.T @ never.unturned, np.diag([plane, plane, 0]), atol=1e-12)


def test_an_arm_in_a_plane_is_singular_where_it_is_stretched_and_not_where_it_is_bent():
    r = arm("planar4")
    for q, singular in ((r.home, False), (np.zeros(4), True)):
        m = model_at("planar4", q)
        S = selection(int(Task.POSITION & r.axes), TOOL_Z, m.R)
        space = operational_space(m.J, m.A_inv, m.Lambda_inv, S, r.motion)
        assert space.damped is singular
        in_plane = np.linalg.eigvalsh(m.J[:2] @ np.linalg.inv(m.A) @ m.J[:2].T)
        assert space.sigma_min == pytest.approx(in_plane[0], abs=1e-12)


def test_an_axis_along_which_the_arm_never_moves_is_refused(tmp_path: Path):
    text = config_of("planar4").read_text().replace('"planar4.urdf"', f'"{config_of("planar4").parent}/planar4.urdf"')
    for axes, i in ('["x", "y", "z"]', 2), ('["rx", "x", "y"]', 0):
        path = tmp_path / "planar4.toml"
        path.write_text(text.replace('["x", "y", "rz"]', axes))
        with pytest.raises(ConfigError, match=rf"motion.axes\[{i}\]"):
            cfg.build(cfg.load(path), path)


# ---- runs

# a goal, and an obstacle beside the way to it
RUNS: dict[str, tuple[list[float], dict[str, Any]]] = {
    "planar4": (
        [0.75, 1.15, 0],
        {"type": "cylinder", "radius_m": 0.05, "length_m": 0.4, "position_m": [0.98, 1.12, 0]},
    ),
    "puma560": ([0.58, 0.15, 1.05], {"type": "sphere", "radius_m": 0.06, "position_m": [0.72, 0.02, 1.12]}),
    "puma560_1986": ([0.58, 0.15, 1.05], {"type": "sphere", "radius_m": 0.06, "position_m": [0.72, 0.02, 1.12]}),
    "ur5": ([0.50, 0.35, 0.28], {"type": "box", "size_m": [0.08, 0.08, 0.3], "position_m": [0.66, 0.24, 0.2]}),
    "openarm_e2e": (
        [0.1, 0.32, 0.25],
        {"type": "capsule", "radius_m": 0.02, "length_m": 0.25, "position_m": [0.32, 0.26, 0.15]},
    ),
}


@pytest.mark.parametrize("name", [*NAMES, "puma560_1986"])
def test_it_reaches_a_goal_past_an_obstacle_within_every_limit(name: str):
    goal, obstacle = RUNS[name]
    scenario = {"duration_s": 2.6, "goal": [{"at_s": 0.3, "position_m": goal}], "obstacle": [{"name": "o", **obstacle}]}
    run = play(scenario, config_of(name))
    f = run.figures
    assert f["arrived"]
    assert f["final_error_m"] < 3e-3
    assert f["contacts"] == 0
    assert arm(name).avoid.rho_min * 0.8 < f["min_clearance_m"]["o"] < 0.2
    assert max(f["max_torque_ratio"], f["max_torque_rate_ratio"], f["max_joint_speed_ratio"]) <= 1.0 + 1e-9
    assert f["max_speed_m_s"] <= 1.02 * arm(name).motion.v_max
    assert f["min_joint_margin_rad"] > 0.0
    assert run.memory.state == State.RUN
    assert run.memory.in_force == 0


@pytest.mark.parametrize("name", NAMES)
def test_it_is_driven_by_the_daemon_over_a_bus(name: str, tmp_path: Path):
    with Rig(tmp_path, robot=name) as rig:
        rig.drives()
        rig.controller()
        rig.arm()
        assert rig.ask("goal", position_m=RUNS[name][0])["ok"]
        until(lambda: rig.status()["status"] == "arrived", lambda: f"does not arrive: {rig.status()}")
        assert rig.status()["faults"] == []


@pytest.mark.parametrize("name", ["puma560", "ur5"])
def test_a_pose_task_through_the_wrist_singularity_stays_bounded(name: str):
    """Joint 5 starts in line, so joints 4 and 6 turn about the same axis; the goal wants the lost rotation, too."""
    start = arm(name).home.copy()
    start[4] = 0.005
    x = model_at(name, start).x
    goal = {"at_s": 0.3, "position_m": (x + np.array([-0.08, 0.15, -0.05])).tolist(), "hold": "orientation"}
    run = play({"duration_s": 3.5, "start_q_rad": start.tolist(), "goal": [goal]}, config_of(name))
    f = run.figures
    assert run.record["sigma_min"].min() < arm(name).motion.epsilon
    assert max(f["max_torque_ratio"], f["max_torque_rate_ratio"], f["max_joint_speed_ratio"]) <= 1.0 + 1e-9
    assert f["max_speed_m_s"] <= 1.02 * arm(name).motion.v_max
    # the directions that are not lost make their way; what is lost stays short, and is called by its name
    assert f["final_error_m"] < 0.1 * 0.178
    assert f["arrived"] or run.memory.status == Status.SINGULAR
    assert run.memory.state == State.RUN
    assert run.memory.in_force == 0

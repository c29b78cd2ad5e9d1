"""The plant against analytic mechanics, Pinocchio's dynamics and distances computed in other ways."""

import math
from pathlib import Path
from typing import Any

import coal
import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import ellipk

from firmware_sim import shapes
from firmware_sim.bullet import pb
from firmware_sim.plant import Plant
from firmware_sim.settings import Settings, SettingsError, load
from firmware_sim.urdf import STOP

F64 = NDArray[np.float64]
PANDA = Path(__file__).resolve().parent.parent / "configs" / "panda.toml"
MASS, LENGTH, INERTIA, BALL = 2.0, 0.5, 0.01, 0.05

PENDULUM = f"""<robot name="pendulum">
<link name="base"><collision><geometry><box size="0.1 0.1 0.1"/></geometry></collision></link>
<joint name="hinge" type="revolute"><parent link="base"/><child link="rod"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" effort="50" velocity="20"/><dynamics damping="3" friction="1"/></joint>
<link name="rod"><inertial><origin xyz="0 0 -{LENGTH}"/><mass value="{MASS}"/>
<inertia ixx="{INERTIA}" ixy="0" ixz="0" iyy="{INERTIA}" iyz="0" izz="{INERTIA}"/></inertial>
<collision><origin xyz="0 0 -{LENGTH}"/><geometry><sphere radius="{BALL}"/></geometry></collision></link>
<joint name="tip_joint" type="fixed"><parent link="rod"/><child link="tip"/><origin xyz="0 0 -{LENGTH}"/></joint>
<link name="tip"/></robot>"""

CONFIG = """
[robot]
name = "pendulum"
urdf = "pendulum.urdf"
tip_frame = "tip"
home_rad = [0.0]
base_pose = {{ position_m = [0.1, 0.2, 0.3], rpy_rad = {rpy} }}
[[robot.joints]]
name = "hinge"
can_id = 1
q_min_rad = -2.0
q_max_rad = 2.0
qd_max_rad_s = 20.0
tau_max_Nm = 50.0
tau_rate_Nm_s = 1000.0
drive = "DM8009"
brake = true
armature_kg_m2 = {armature}
[loop]
servo_hz = {hz}
[link]
interface = "socketpair"
channel = "pendulum"
bitrate = 1_000_000
fd = false
protocol = "mit"
[safety]
watchdog_ms = 20.0
"""


def pendulum(folder: Path, armature: float = 0.0, rpy: str = "[0.0, 0.0, 0.0]", hz: float = 1000.0) -> Settings:
    """Return the settings of a ball on a rod that swings about y, its hinge at (0.1, 0.2, 0.3)."""
    (folder / "pendulum.urdf").write_text(PENDULUM)
    (folder / "pendulum.toml").write_text(CONFIG.format(armature=armature, rpy=rpy, hz=hz))
    return load(folder / "pendulum.toml")


def about_hinge() -> float:
    """Return the moment of inertia about the hinge."""
    return INERTIA + MASS * LENGTH**2


@pytest.fixture(scope="module")
def panda() -> Any:
    """A Panda at home."""
    settings = load(PANDA)
    plant = Plant(settings, settings.home, [])
    yield plant
    plant.close()


@pytest.fixture(scope="module")
def model() -> Any:
    """The same arm in Pinocchio, with fingers locked."""
    full = pin.buildModelFromUrdf(str(load(PANDA).urdf))
    return pin.buildReducedModel(full, [8, 9], pin.neutral(full))


def limits(plant: Plant) -> tuple[F64, F64]:
    """Return the permitted range of the joints."""
    joints = plant.settings.joints
    return np.array([j.q_min for j in joints]), np.array([j.q_max for j in joints])


# ---- dynamics


def test_accelerations_agree_with_pinocchio(panda: Plant, model: Any) -> None:
    data, rng = model.createData(), np.random.default_rng(1)
    pb.setPhysicsEngineParameter(fixedTimeStep=1e-6, physicsClientId=panda.client)
    try:
        for _ in range(100):
            q, qd, tau = rng.uniform(*limits(panda)), rng.uniform(-2, 2, 7), rng.uniform(-12, 12, 7)
            for i, a, b in zip(panda.index, q, qd, strict=True):
                pb.resetJointState(panda.body, i, a, b, physicsClientId=panda.client)
            panda.step(tau.tolist(), [0.0] * 7)
            measured, wanted = (np.array(panda.qd) - qd) / 1e-6, pin.aba(model, data, q, qd, tau)
            assert np.abs(measured - wanted).max() < 1e-6 * np.abs(wanted).max()
    finally:
        pb.setPhysicsEngineParameter(fixedTimeStep=panda.step_ns * 1e-9, physicsClientId=panda.client)


def test_gravity_torques_of_pinocchio_hold_the_arm(panda: Plant, model: Any) -> None:
    data = model.createData()
    q = np.array(panda.settings.home)
    panda.place(q)
    hold = pin.computeGeneralizedGravity(model, data, q).tolist()
    for _ in range(200):
        panda.step(hold, [0.0] * 7)
    assert np.abs(np.array(panda.q) - q).max() < 1e-6


def test_a_swing_without_torque_keeps_its_energy(panda: Plant, model: Any) -> None:
    data = model.createData()
    panda.place([0.3, 0.2, -0.2, -1.5, 0.1, 1.5, 0.0])

    def energy() -> float:
        q, qd = np.array(panda.q), np.array(panda.qd)
        return float(pin.computeKineticEnergy(model, data, q, qd) + pin.computePotentialEnergy(model, data, q))

    start, kinetic = energy(), 0.0
    for _ in range(400):
        panda.step([0.0] * 7, [0.0] * 7)
        kinetic = max(kinetic, pin.computeKineticEnergy(model, data, np.array(panda.q), np.array(panda.qd)))
        assert abs(energy() - start) < 0.01 * max(kinetic, 1.0)
    assert kinetic > 5.0
    panda.place(panda.settings.home)


def test_pendulum_has_the_period_of_the_elliptic_integral(tmp_path: Path) -> None:
    plant = Plant(pendulum(tmp_path), [1.5], [])
    crossings = []
    for _ in range(10_000):
        before = plant.q[0]
        plant.step([0.0], [0.0])
        if before > 0.0 >= plant.q[0]:
            crossings.append(plant.time_ns * 1e-9)
    plant.close()
    k = ellipk(math.sin(0.75) ** 2)
    period = 4.0 * k * math.sqrt(about_hinge() / (MASS * 9.81 * LENGTH))
    assert np.diff(crossings) == pytest.approx(period, abs=1.1e-3)
    assert crossings[0] == pytest.approx(period / 4, abs=1.1e-3)


@pytest.mark.parametrize("armature", [0.0, 0.3])
def test_motor_inertia_adds_to_the_link_s(tmp_path: Path, armature: float) -> None:
    plant = Plant(pendulum(tmp_path, armature), [0.0], [])
    plant.step([4.0], [0.0])
    qdd = plant.qd[0] / (plant.step_ns * 1e-9)
    plant.close()
    assert qdd == pytest.approx(4.0 / (about_hinge() + armature), rel=1e-6)


def test_drag_stops_and_holds_but_never_drives(tmp_path: Path) -> None:
    plant = Plant(pendulum(tmp_path), [0.5], [])
    load_torque = MASS * 9.81 * LENGTH * math.sin(0.5)
    for _ in range(1000):
        plant.step([0.0], [load_torque * 1.05])
        assert abs(plant.qd[0]) < 1e-6
    assert plant.q[0] == pytest.approx(0.5, abs=1e-5)
    for _ in range(100):
        plant.step([0.0], [load_torque * 0.9])
    slipping = -0.1 * load_torque / about_hinge() * 0.05
    assert plant.qd[0] == pytest.approx(slipping, rel=0.02)
    for _ in range(10):
        plant.step([0.0], [0.0])
    assert plant.qd[0] < slipping * 1.5  # released, it falls freely
    plant.close()


def test_a_joint_stops_at_its_mechanical_stop(tmp_path: Path) -> None:
    plant = Plant(pendulum(tmp_path), [1.8], [])
    for _ in range(2000):
        plant.step([30.0], [0.0])
    assert plant.q[0] == pytest.approx(2.0 + STOP, abs=0.01)
    plant.close()


@pytest.mark.parametrize(("hz", "steps"), [(1000.0, 2), (500.0, 4), (2000.0, 1), (225.0, 9), (4000.0, 1)])
def test_physics_steps_are_at_most_half_a_millisecond(tmp_path: Path, hz: float, steps: int) -> None:
    plant = Plant(pendulum(tmp_path, hz=hz), [0.0], [])
    assert plant.substeps == steps
    assert plant.step_ns <= 500_000
    assert abs(plant.substeps * plant.step_ns - 1e9 / hz) <= steps + 1
    plant.close()


# ---- geometry


def test_tip_agrees_with_pinocchio(panda: Plant, model: Any) -> None:
    data, rng = model.createData(), np.random.default_rng(2)
    frame = model.getFrameId("panda_hand_tcp")
    for _ in range(20):
        q = rng.uniform(*limits(panda))
        panda.place(q)
        pin.framesForwardKinematics(model, data, q)
        x, wxyz = panda.tip_pose()
        assert x == pytest.approx(data.oMf[frame].translation, abs=1e-6)
        turn = pin.Quaternion(*map(float, wxyz)).matrix().T @ data.oMf[frame].rotation
        assert turn == pytest.approx(np.eye(3), abs=1e-6)
    panda.place(panda.settings.home)


def test_base_pose_turns_and_shifts_the_arm(tmp_path: Path) -> None:
    plant = Plant(pendulum(tmp_path, rpy="[0.3, -0.5, 1.1]"), [0.4], [])
    R = pin.rpy.rpyToMatrix(0.3, -0.5, 1.1)
    wanted = np.array([0.1, 0.2, 0.3]) + R @ np.array([-math.sin(0.4), 0.0, -math.cos(0.4)]) * LENGTH
    assert plant.tip_pose()[0] == pytest.approx(wanted, abs=1e-6)
    plant.close()


CENTRE = np.array([0.1, 0.2, -0.2])  # of the ball when the pendulum hangs


def offset_by(x: float, y: float, z: float) -> list[float]:
    """Return a place beside the ball's centre."""
    return [float(v) for v in CENTRE + np.array((x, y, z))]


def measured(tmp_path: Path, **spec: Any) -> float:
    """Return the plant's clearance between the hanging ball and one obstacle."""
    plant = Plant(pendulum(tmp_path), [0.0], [{"name": "it", **spec}])
    try:
        return plant.clearances()["it"]
    finally:
        plant.close()


def test_clearance_of_a_sphere_is_centre_distance_less_radii(tmp_path: Path) -> None:
    for d in (0.2, 0.11, 0.08):
        at = offset_by(d, 0.0, 0.0)
        got = measured(tmp_path, type="sphere", radius_m=0.05, position_m=at)
        assert got == pytest.approx(d - 0.1, abs=1e-6)


def test_clearance_of_a_point_and_a_capsule(tmp_path: Path) -> None:
    p = offset_by(0.0, 0.3, 0.0)
    assert measured(tmp_path, type="point", position_m=p) == pytest.approx(0.25, abs=2 * shapes.THIN)
    c = offset_by(0.2, 0.0, 0.0)
    upright = measured(tmp_path, type="capsule", radius_m=0.03, length_m=0.2, position_m=c)
    assert upright == pytest.approx(0.2 - 0.05 - 0.03, abs=1e-5)
    lying = measured(tmp_path, type="capsule", radius_m=0.03, length_m=0.2, position_m=c, rpy_rad=[0, math.pi / 2, 0])
    assert lying == pytest.approx(0.1 - 0.05 - 0.03, abs=1e-5)
    line = measured(tmp_path, type="segment", length_m=0.2, position_m=c)
    assert line == pytest.approx(0.15, abs=2 * shapes.THIN)


@pytest.mark.parametrize("offset", [[0.3, 0.0, 0.0], [0.3, 0.25, 0.0], [0.3, 0.25, 0.35]])
def test_clearance_of_a_box_from_face_edge_and_corner(tmp_path: Path, offset: list[float]) -> None:
    at = CENTRE + offset
    got = measured(tmp_path, type="box", size_m=[0.2, 0.2, 0.2], position_m=at.tolist())
    assert got == pytest.approx(np.linalg.norm(np.maximum(np.abs(offset) - np.array(0.1), 0.0)) - 0.05, abs=1e-5)


def test_clearance_of_a_tilted_plane(tmp_path: Path) -> None:
    normal = np.array([0.3, -0.2, 0.9])
    normal /= np.linalg.norm(normal)
    at = CENTRE - 0.2 * normal + np.cross(normal, [1.0, 2.0, 3.0])
    got = measured(tmp_path, type="plane", position_m=at.tolist(), normal=normal.tolist())
    assert got == pytest.approx(0.15, abs=1e-5)
    roll = measured(tmp_path, type="plane", position_m=(CENTRE - [0.0, 0.0, 0.2]).tolist())
    assert roll == pytest.approx(0.15, abs=1e-5)


@pytest.mark.parametrize("offset", [[0.2, 0.0, 0.0], [0.05, 0.0, 0.3], [0.2, 0.1, 0.3]])
def test_clearance_of_a_cylinder_and_a_cone(tmp_path: Path, offset: list[float]) -> None:
    at, p = (CENTRE + offset).tolist(), -np.array(offset)
    radial, axial = float(np.hypot(p[0], p[1])), float(p[2])
    got = measured(tmp_path, type="cylinder", radius_m=0.08, length_m=0.3, position_m=at)
    assert got == pytest.approx(math.hypot(max(radial - 0.08, 0), max(abs(axial) - 0.15, 0)) - 0.05, abs=2e-4)

    def from_cone(u: F64) -> float:  # radius 0.1 at the bottom, 0.02 at the top, 0.3 high
        z, share = u
        return math.hypot(radial - share * (0.06 - 0.04 * z / 0.15), axial - z)

    start = [np.clip(axial, -0.15, 0.15), 0.5]
    best = minimize(from_cone, start, bounds=[(-0.15, 0.15), (0.0, 1.0)], options={"ftol": 1e-15, "gtol": 1e-10})
    cone = measured(tmp_path, type="cone", radius_m=0.1, top_radius_m=0.02, height_m=0.3, position_m=at)
    assert cone == pytest.approx(best.fun - 0.05, abs=3e-4)


@pytest.mark.parametrize(
    ("kind", "axes", "powers"),
    [
        ("ellipsoid", [0.1, 0.06, 0.15], (2, 2, 2)),
        ("n_ellipsoid", [0.1, 0.06, 0.15], (8, 8, 8)),
        ("n_ellipsoid", [0.15, 0.15, 0.02], (4, 4, 4)),
        ("n_cylinder", [0.1, 0.1, 0.15], (2, 2, 8)),
    ],
)
def test_hulls_keep_their_stated_tolerance(
    tmp_path: Path, kind: str, axes: list[float], powers: tuple[int, int, int]
) -> None:
    rng = np.random.default_rng(3)
    extra = {} if kind == "ellipsoid" else {"n": powers[2] / 2}
    for _ in range(6):
        direction = rng.normal(size=3)
        offset = 0.3 * direction / np.linalg.norm(direction)
        at = (CENTRE + offset).tolist()
        got = measured(tmp_path, type=kind, semi_axes_m=axes, position_m=at, **extra)
        # the true distance: nearest of many points of the surface in the direction of the ball, then refined
        d = rng.normal(size=(200_000, 3)) + rng.normal(size=(200_000, 1)) * 2.0 * -offset / 0.3
        scale = ((np.abs(d / np.array(axes)) ** np.array(powers)).sum(axis=1)) if len({*powers}) == 1 else None
        if scale is not None:
            surface = d / scale[:, None] ** (1.0 / powers[0])
        else:
            phi, theta = rng.uniform(-np.pi / 2, np.pi / 2, 200_000), rng.uniform(-np.pi, np.pi, 200_000)
            rise = np.sign(phi) * np.abs(np.sin(phi)) ** (2.0 / powers[2])
            surface = np.stack((np.cos(phi) * np.cos(theta), np.cos(phi) * np.sin(theta), rise), axis=1) * axes
        true = np.linalg.norm(surface + offset, axis=1).min() - BALL
        bound = shapes.HULL_TOLERANCE * max(axes)
        assert -3e-4 <= got - true <= bound


def test_link_meshes_are_their_convex_hulls(panda: Plant) -> None:
    settings = panda.settings
    model = pin.buildModelFromUrdf(str(settings.urdf))
    geometry = pin.buildGeomFromUrdf(
        model, str(settings.urdf), pin.GeometryType.COLLISION, package_dirs=[str(p) for p in settings.package_dirs]
    )
    data, gdata, rng = model.createData(), None, np.random.default_rng(4)
    moving = [g for g in geometry.geometryObjects if g.parentJoint > 0]
    for g in moving:
        if isinstance(g.geometry, coal.BVHModelBase):
            g.geometry.buildConvexHull(True, "Qt")
            g.geometry = g.geometry.convex
    gdata = pin.GeometryData(geometry)
    ball = coal.Sphere(0.05)
    for _ in range(15):
        q = rng.uniform(*limits(panda))
        at = rng.uniform(-0.6, 0.6, 3) + np.array((0.0, 0.0, 0.5))
        pin.updateGeometryPlacements(model, data, geometry, gdata, np.concatenate((q, [0.0, 0.0])))
        request, result = coal.DistanceRequest(), coal.DistanceResult()
        true = np.inf
        for g in moving:
            pose = gdata.oMg[geometry.getGeometryId(g.name)]
            where = coal.Transform3s(pose.rotation, pose.translation)
            result.clear()
            there = coal.Transform3s(np.eye(3), at)
            true = min(true, coal.distance(g.geometry, where, ball, there, request, result))
        if not 0.005 < true < 0.45:
            continue
        plant = Plant(settings, q, [{"name": "it", "type": "sphere", "radius_m": 0.05, "position_m": at.tolist()}])
        assert -1.1e-3 < plant.clearances()["it"] - true < 0.8e-3
        plant.close()


# ---- obstacles in motion, contact


def turn(plant: Plant, periods: int) -> None:
    """Advance a limp arm by servo periods."""
    for _ in range(periods):
        for _ in range(plant.substeps):
            plant.step([0.0] * len(plant.index), [0.0] * len(plant.index))
            plant.scene_ns += plant.step_ns
        plant.advance_world()


def test_obstacles_appear_move_and_vanish(tmp_path: Path) -> None:
    ball = {"type": "sphere", "radius_m": 0.05}
    specs: list[dict[str, Any]] = [
        {**ball, "name": "drifts", "position_m": [0.5, 0.2, -0.2], "velocity_m_s": [-0.5, 0, 0], "appears_s": 0.1},
        {**ball, "name": "walks", "waypoints": [[0.1, 0.1, 0.5, -0.2], [0.2, 0.1, 0.4, -0.2]], "vanishes_s": 0.3},
    ]
    plant = Plant(pendulum(tmp_path), [0.0], specs)
    seen = {}
    for ms in range(1, 351):
        turn(plant, 1)
        seen[ms] = plant.clearances()
    plant.close()
    assert "drifts" not in seen[99]
    assert seen[100]["drifts"] == pytest.approx(0.3, abs=1e-5)
    assert seen[300]["drifts"] == pytest.approx(0.2, abs=1e-5)
    assert seen[50]["walks"] == seen[99]["walks"] == pytest.approx(0.2, abs=1e-5)
    assert seen[150]["walks"] == pytest.approx(0.15, abs=1e-5)
    assert seen[299]["walks"] == pytest.approx(0.1, abs=1e-5)
    assert "walks" not in seen[300]


def test_a_ball_that_runs_into_the_arm_pushes_it_and_is_one_event(tmp_path: Path) -> None:
    spec = {"name": "ram", "type": "sphere", "radius_m": 0.05, "position_m": [0.3, 0.2, -0.2]}
    plant = Plant(pendulum(tmp_path), [0.0], [{**spec, "velocity_m_s": [-0.5, 0.0, 0.0]}])
    turn(plant, 195)
    assert not plant.contacts
    turn(plant, 15)
    assert [(c.link, c.other, c.cause) for c in plant.contacts] == [("rod", "ram", "obstacle")]
    assert plant.contacts[0].time == pytest.approx(0.2, abs=0.004)
    turn(plant, 100)
    assert plant.q[0] > 0.05  # pushed towards -x
    plant.close()


def test_an_arm_that_falls_on_an_obstacle_is_to_blame_and_stopped(tmp_path: Path) -> None:
    spec = {"name": "block", "type": "box", "size_m": [0.1, 0.1, 0.1], "position_m": [0.1, 0.2, -0.2]}
    plant = Plant(pendulum(tmp_path), [1.0], [spec])
    turn(plant, 600)
    assert plant.contacts[0].cause == "arm"
    assert plant.q[0] == pytest.approx(0.2, abs=0.03)  # half a box and a ball beside the middle
    plant.close()


def test_what_the_base_stands_on_is_no_contact(tmp_path: Path) -> None:
    spec = {"name": "table", "type": "plane", "position_m": [0.0, 0.0, 0.3], "normal": [0.0, 0.0, -1.0]}
    settings = pendulum(tmp_path)
    plant = Plant(settings, [0.0], [{**spec, "normal": [0.0, 0.0, 1.0], "position_m": [0.0, 0.0, -0.5]}])
    assert plant.clearances()["table"] == pytest.approx(0.25, abs=1e-5)
    turn(plant, 10)
    assert not plant.contacts
    plant.close()
    floor = {"name": "floor", "type": "plane", "position_m": [0.0, 0.0, 0.05]}
    arm = load(PANDA)
    plant = Plant(arm, arm.home, [floor])
    turn(plant, 3)
    assert not plant.contacts
    assert plant.clearances()["floor"] > 0.05
    plant.close()


def test_self_clearance_leaves_neighbours_out_and_sees_a_fold(panda: Plant) -> None:
    names = {frozenset((panda.links[a], panda.links[b])) for a, b in panda.oracle.far_pairs}
    for k in range(7):
        assert frozenset((f"panda_link{k}", f"panda_link{k + 1}")) not in names
    assert frozenset(("panda_hand", "panda_leftfinger")) not in names
    assert frozenset(("panda_link0", "panda_hand")) in names
    panda.place(panda.settings.home)
    assert panda.self_clearance() == 0.1
    before = len(panda.contacts)
    panda.place([0.0, 1.7, 0.0, -3.0, 0.0, 3.0, 0.0])  # the hand folded into the base
    assert panda.self_clearance() < 0.0
    assert panda.self_clearance() < 0.0
    events = panda.contacts[before:]
    assert {c.cause for c in events} == {"self"}
    assert len(events) == len({(c.link, c.other) for c in events})
    panda.place(panda.settings.home)


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ('tip_frame = "tip"', 'tip_frame = "nose"', "nose"),
        ('name = "hinge"', 'name = "knee"', "knee"),
        ('urdf = "pendulum.urdf"', 'urdf = "absent.urdf"', "absent.urdf"),
        ('drive = "DM8009"', 'drive = "DM1"', "DM1"),
        ("watchdog_ms = 20.0", "", "watchdog_ms"),
        ("[link]", "[lank]", "link"),
    ],
)
def test_a_robot_that_cannot_be_simulated_is_refused_by_name(tmp_path: Path, old: str, new: str, named: str) -> None:
    pendulum(tmp_path)
    path = tmp_path / "pendulum.toml"
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(SettingsError, match=named):
        Plant(load(path), [0.0], [])

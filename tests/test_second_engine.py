"""MuJoCo behind the same drives: closed forms, pybullet on the same runs, and a model by another hand than ours."""

import math
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.special import ellipk

from firmware_sim.reality import reality_of
from firmware_sim.second import SecondPlant
from firmware_sim.settings import SettingsError, load
from firmware_sim.simulator import plant_of
from rtctl.app.sim import simulate
from rtctl.cli import main
from tests.lab import PANDA, ROOT, lab
from tests.test_plant import LENGTH, MASS, about_hinge, pendulum
from tests.test_reality import FLAT

ENGINE = {"engine": "mujoco"}
XARM = "package://robosuite/models/assets/robots/xarm7/robot.xml"


def swinging(folder: Path, at: float, armature: float = 0.0, rpy: str = "[0.0, 0.0, 0.0]", **table: Any) -> SecondPlant:
    """Return a pendulum at rest at an angle [rad] from hanging."""
    settings = pendulum(folder, armature, rpy)
    plant = plant_of(settings, [at], [], reality_of(ENGINE | table, settings))
    assert isinstance(plant, SecondPlant)
    return plant


# ---- closed forms


def test_a_pendulum_has_the_period_of_the_elliptic_integral(tmp_path: Path):
    plant, crossings = swinging(tmp_path, 1.5), []
    for _ in range(10_000):
        before = plant.q[0]
        plant.step([0.0], [0.0])
        if before > 0.0 >= plant.q[0]:
            crossings.append(plant.time_ns * 1e-9)
    plant.close()
    period = 4.0 * ellipk(math.sin(0.75) ** 2) * math.sqrt(about_hinge() / (MASS * 9.81 * LENGTH))
    assert np.diff(crossings) == pytest.approx(period, abs=1.1e-3)


@pytest.mark.parametrize("armature", [0.0, 0.3])
def test_a_motor_s_inertia_adds_to_the_link_s(tmp_path: Path, armature: float):
    plant = swinging(tmp_path, 0.0, armature)
    plant.step([4.0], [0.0])
    assert plant.qd[0] / (plant.step_ns * 1e-9) == pytest.approx(4.0 / (about_hinge() + armature), rel=1e-6)
    plant.close()


def test_a_brake_holds_what_is_less_than_it_and_slips_under_more(tmp_path: Path):
    plant = swinging(tmp_path, 0.5, brake="ideal")
    weight = MASS * 9.81 * LENGTH * math.sin(0.5)
    for _ in range(1000):
        plant.step([0.0], [weight * 1.05])
    assert abs(plant.qd[0]) < 1e-4
    assert plant.q[0] == pytest.approx(0.5, abs=1e-4)
    for _ in range(100):
        plant.step([0.0], [weight * 0.9])
    assert plant.qd[0] == pytest.approx(-0.1 * weight / about_hinge() * 0.05, rel=0.05)
    plant.close()


def test_a_sliding_joint_is_stopped_in_the_time_of_its_momentum_and_one_that_sticks_stays(tmp_path: Path):
    plant = swinging(tmp_path, 0.0, 0.0, FLAT, coulomb_Nm=0.4, static_Nm=0.9)
    for _ in range(200):
        plant.step([0.85], [0.0])  # less than it sticks by
    assert abs(plant.q[0]) < 1e-4
    for _ in range(200):
        plant.step([3.0], [0.0])
    speed, steps, dt = plant.qd[0], 0, plant.step_ns * 1e-9
    while plant.qd[0] > 0.01:
        plant.step([0.0], [0.0])
        steps += 1
    plant.close()
    assert steps * dt == pytest.approx(about_hinge() * (speed - 0.01) / 0.4, rel=0.02)


def test_an_obstacle_pushes_the_arm_and_is_counted_once(tmp_path: Path):
    settings = pendulum(tmp_path)
    ball = {
        "name": "it",
        "type": "sphere",
        "radius_m": 0.05,
        "position_m": [0.6, 0.2, -0.2],
        "velocity_m_s": [-0.5, 0, 0],
    }
    plant = plant_of(settings, [0.0], [ball], reality_of(ENGINE, settings))
    for k in range(4000):
        plant.step([0.0], [0.0])
        plant.scene_ns += plant.step_ns
        if k % plant.substeps == plant.substeps - 1:
            plant.advance_world()
        if plant.contacts and plant.qd[0] > 0.1:
            break
    plant.close()
    assert [c.other for c in plant.contacts] == ["it"]
    assert plant.contacts[0].cause == "obstacle"
    assert plant.qd[0] > 0.1  # towards -x, where the ball goes


# ---- the whole arm


def test_a_goal_is_reached_as_in_pybullet():
    ends = []
    for table in ({}, ENGINE):
        with lab(path=PANDA, scenario={"plant": table}) as here:
            here.running()
            here.ask(here.simulator.truth().tip + np.array([0.1, 0.1, -0.05]))
            least = 1.0
            for _ in range(1200):
                here.step()
                least = min(least, here.simulator.truth().self_clearance)
            assert here.memory.status.name == "ARRIVED"
            ends.append((here.simulator.truth().tip, np.array(here.simulator.plant.q)))
    assert ends[0][0] == pytest.approx(ends[1][0], abs=3e-4)
    assert ends[0][1] == pytest.approx(ends[1][1], abs=5e-3)


def test_an_arm_arrives_whose_plant_is_another_s_model(tmp_path: Path):
    """The robot file is from the maker's URDF, the plant from robosuite's MJCF: other masses, friction of 1 Nm."""
    if find_spec("robosuite") is None:
        pytest.skip("needs the arms of robosuite: pip install rtctl[robots]")

    assert main(["init", "xarm7", "--out", str(tmp_path)]) == 0
    play = (tmp_path / "xarm7_first.toml").read_text()
    (tmp_path / "other.toml").write_text(play + f'\n[plant]\nengine = "mujoco"\nmodel = "{XARM}"\n')
    told = simulate(tmp_path / "other.toml")
    assert [g["arrived"] for g in told["goals"]] == [True, True]
    assert told["contacts"] == 0
    assert not told["faults"]


# ---- refusals


def chain(folder: Path, joints: list[str]) -> str:
    """Write an MJCF whose links hang one in another; return its name."""
    bodies = "".join(
        f'<body name="link_{name}" pos="0 0 0.1"><joint name="{name}"/><geom size="0.05" mass="1"/>' for name in joints
    )
    path = folder / "chain.xml"
    path.write_text(f"<mujoco><worldbody>{bodies}{'</body>' * len(joints)}</worldbody></mujoco>")
    return str(path)


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({"engine": "ode"}, "plant.engine: got 'ode', wanted one of bullet, mujoco"),
        ({"engine": "bullet", "model": "arm.xml"}, 'plant.model: an MJCF needs engine = "mujoco", which is "bullet"'),
        ({"model": "arm.xml"}, "plant.model: arm.xml: not found"),
        ({"model": "package://nobody/arm.xml"}, "plant.model: package://nobody/arm.xml: not found"),
        ({"joints": ["pan", "lift"]}, "plant.model: has the joints pan, lift"),
        ({"joints": list("abcdefg"), "payload_kg": 1.0, "payload_link": "none"}, "payload_link: none is no body of"),
        ({"joints": list("abcdefg"), "mass_error": {"none": 0.1}}, "plant.mass_error: none is no body of chain.xml"),
    ],
)
def test_what_makes_no_sense_is_refused_by_its_key(tmp_path: Path, table: dict[str, Any], words: str):
    settings, asked = load(ROOT / "configs/panda.toml"), ENGINE | table
    if "joints" in asked:
        asked["model"] = chain(tmp_path, asked.pop("joints"))
    with pytest.raises(SettingsError, match=words.replace("(", r"\(")):
        plant_of(settings, settings.home, [], reality_of(asked, settings))

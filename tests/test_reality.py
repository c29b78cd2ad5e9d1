"""A plant that is not its model, against mechanics worked out by hand and Pinocchio's."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from firmware_sim.drive import State
from firmware_sim.friction import CREEP, friction
from firmware_sim.plant import Plant
from firmware_sim.reality import KEYS, plant_table, reality_of
from firmware_sim.settings import SettingsError, load
from firmware_sim.simulator import open_simulator
from firmware_sim.traffic import Traffic
from rtctl.errors import ConfigError
from rtctl.protocol import frame
from rtctl.spec.plant import PlantTable
from rtctl.spec.scenario import load_scenario, scenario_dict
from tests.lab import PANDA, lab
from tests.test_plant import INERTIA, LENGTH, MASS, about_hinge, pendulum

FLAT = "[1.5707963267948966, 0.0, 0.0]"  # the hinge upright: gravity does nothing


def swinging(
    folder: Path, at: float, table: dict[str, Any], armature: float = 0.0, rpy: str = "[0.0, 0.0, 0.0]"
) -> Plant:
    """Return a pendulum at rest at an angle [rad] from hanging."""
    settings = pendulum(folder, armature, rpy)
    return Plant(settings, [at], [], reality_of(table, settings))


# ---- friction


@pytest.mark.parametrize("armature", [0.0, 0.3])
def test_a_sliding_joint_is_stopped_by_coulomb_friction_in_the_time_of_its_momentum(tmp_path: Path, armature: float):
    plant = swinging(tmp_path, 0.0, {"coulomb_Nm": 0.4}, armature, FLAT)
    steps = 0
    for _ in range(200):
        plant.step([3.0], [0.0])
    dt, speed = plant.step_ns * 1e-9, plant.qd[0]
    assert speed == pytest.approx(200 * dt * 2.6 / (about_hinge() + armature), rel=1e-6)
    while plant.qd[0] > 1e-9:
        plant.step([0.0], [0.0])
        steps += 1
    assert steps * dt == pytest.approx((about_hinge() + armature) * speed / 0.4, abs=2 * dt)
    rested = plant.q[0]
    for _ in range(400):
        plant.step([0.39], [0.0])  # less than friction: it stays for good
    assert plant.q[0] == pytest.approx(rested, abs=1e-9)
    plant.close()


def test_a_joint_breaks_away_at_its_static_friction_and_slides_on_under_less(tmp_path: Path):
    plant = swinging(tmp_path, 0.0, {"coulomb_Nm": 0.4, "static_Nm": 0.9}, 0.0, FLAT)
    for _ in range(100):
        plant.step([0.89], [0.0])
    assert abs(plant.qd[0]) < 1e-9
    while plant.qd[0] < 2.0 * CREEP:
        plant.step([0.91], [0.0])
    before = plant.qd[0]
    plant.step([0.5], [0.0])
    assert (plant.qd[0] - before) / (plant.step_ns * 1e-9) == pytest.approx(0.1 / about_hinge(), rel=1e-5)
    plant.close()


def test_friction_of_coupled_joints_obeys_its_law():
    """Complementarity: a joint that moves on has its whole bound against it, one with less stands still."""
    rng = np.random.default_rng(5)
    for _ in range(50):
        L = rng.normal(size=(6, 6))
        A, free, qd, bound = (
            L @ L.T + 0.1 * np.eye(6),
            rng.normal(size=6),
            0.02 * rng.normal(size=6),
            rng.uniform(0, 2, 6),
        )
        f = friction(A, free, qd, bound, 5e-4, np.zeros(6))
        after = qd + 5e-4 * np.linalg.solve(A, free - f)
        assert (np.abs(f) <= bound + 1e-12).all()
        for i in range(6):
            assert abs(after[i]) < 1e-5 or f[i] == pytest.approx(math.copysign(bound[i], after[i]), abs=1e-6)


def test_viscous_friction_and_that_of_the_urdf_hold_back_in_proportion(tmp_path: Path):
    for table, damping, coulomb in (
        ({"viscous_Nms_rad": 0.7}, 0.7, 0.0),
        ({"urdf_dynamics": True}, 3.0, 1.0),
    ):
        plant = swinging(tmp_path, 0.0, table, 0.0, FLAT)
        for _ in range(100):
            plant.step([2.0], [0.0])
        before = plant.qd[0]
        plant.step([2.0], [0.0])
        got = (plant.qd[0] - before) / (plant.step_ns * 1e-9)
        assert got == pytest.approx((2.0 - coulomb - damping * before) / about_hinge(), rel=1e-5)
        plant.close()


# ---- masses


def test_a_payload_accelerates_the_arm_as_the_same_body_does_in_pinocchio():
    settings = load(PANDA)
    mass, com = 1.3, np.array([0.02, -0.03, 0.05])
    table = {"payload_kg": mass, "payload_com_m": com.tolist(), "payload_link": "panda_hand"}
    full = pin.buildModelFromUrdf(str(settings.urdf))
    model = pin.buildReducedModel(full, [8, 9], pin.neutral(full))
    hand = model.frames[model.getFrameId("panda_hand")]
    ball = pin.Inertia(mass, com, 0.4 * mass * 0.03**2 * np.eye(3))
    model.appendBodyToJoint(hand.parentJoint, ball, hand.placement)
    plant = Plant(settings, settings.home, [], reality_of(table, settings))
    tau = np.array([3.0, -20.0, 2.0, 15.0, 1.0, 2.0, 0.3])
    plant.step(tau.tolist(), [0.0] * 7)
    wanted = pin.aba(model, model.createData(), np.array(settings.home), np.zeros(7), tau)
    np.testing.assert_allclose(np.array(plant.qd) / (plant.step_ns * 1e-9), wanted, rtol=2e-3, atol=2e-2)
    plant.close()


@pytest.mark.parametrize(
    ("table", "mass", "inertia"),
    [
        ({"mass_error": 0.2}, 1.2, 1.0),
        ({"mass_error": {"rod": -0.3}}, 0.7, 1.0),
        ({"mass_error": {"base": 0.5}}, 1.0, 1.0),
        ({"inertia_error": 0.5}, 1.0, 1.5),
    ],
)
def test_wrong_masses_fall_as_such_masses_do(tmp_path: Path, table: dict[str, Any], mass: float, inertia: float):
    plant = swinging(tmp_path, math.pi / 2, table)
    plant.step([0.0], [0.0])
    m = MASS * mass
    wanted = -m * 9.81 * LENGTH / (INERTIA * inertia + m * LENGTH**2)
    assert plant.qd[0] / (plant.step_ns * 1e-9) == pytest.approx(wanted, rel=1e-5)
    plant.close()


# ---- drives


def test_a_joint_that_is_mounted_the_other_way_round_is_read_and_driven_so(tmp_path: Path):
    pendulum(tmp_path, rpy=FLAT)
    table = {"encoder_direction": -1, "encoder_zero_rad": 0.4, "torque_gain": 0.5}
    here = open_simulator(tmp_path / "pendulum.toml", {"plant": table}, [0.3])
    drive = here.drives[0]
    assert drive.q == pytest.approx(0.4 - 0.3)
    here.plant.step([2.0], [0.0])
    here._sense()
    assert here.plant.qd[0] == pytest.approx(-0.5 * 2.0 / about_hinge() * here.plant.step_ns * 1e-9, rel=1e-6)
    assert drive.qd == pytest.approx(-here.plant.qd[0])
    here.close()


def sagged(brake: Any) -> float:
    """Return how far the plant's joints have come [rad] 0.15 s after every drive has let go."""
    with lab(scenario={"plant": {"brake": brake}}) as here:
        here.running()
        before = np.array(here.simulator.truth().q)
        for drive in here.simulator.drives:
            drive._off(State.DISABLED)
        for _ in range(150):
            here.simulator.advance()
        return float(np.abs(np.array(here.simulator.truth().q) - before).max())


def test_what_happens_to_an_arm_without_torque_is_up_to_its_brakes():
    """The heaviest load of this posture is 30 Nm: a brake of 20 Nm slips under it, slower than it falls."""
    held, slipping, free = sagged("ideal"), sagged(20.0), sagged("none")
    assert held < 1e-3 < 2e-3 < slipping < 0.6 * free


# ---- the bus


def test_replies_are_lost_and_late_as_often_as_was_said_and_in_order():
    traffic, seen = Traffic(0.2, 0.3, (0x123,), False, 4), []
    for cycle in range(4000):
        out = traffic.carried(0, [frame.pack(0x11, cycle.to_bytes(4, "big"))])
        assert frame.unpack(out[-1]).can_id == 0x123
        seen += [(cycle, int.from_bytes(frame.unpack(raw).data, "big")) for raw in out[:-1]]
    assert len(seen) / 4000 == pytest.approx(0.8, abs=0.02)
    assert sum(a > b for a, b in seen) / len(seen) == pytest.approx(0.3, abs=0.03)
    assert all(a - b in (0, 1) for a, b in seen)
    assert [b for _, b in seen] == sorted(b for _, b in seen)


def test_a_bus_of_frames_of_others_and_a_lost_reply_now_and_then_stops_no_arm():
    with lab(
        scenario={"plant": {"reply_loss": 0.002, "reply_late": 0.002, "talker_ids": [0x123, 0x7F, 0x18, 0x7FF]}}
    ) as here:
        here.running()
        here.run(0.5)
        assert here.memory.state.name == "RUN"


# ---- what people write


def test_the_simulator_reads_what_a_scenario_may_say(tmp_path: Path):
    assert set(KEYS) == set(PlantTable.__struct_fields__)
    (tmp_path / "s.toml").write_text(
        'robot = "panda"\nduration_s = 1.0\n[plant]\npayload_kg = 0.5\nbrake = ["none", "ideal", 3, 4, 5, 6, 7.5]\n'
        "mass_error = { panda_link3 = 0.1 }\nencoder_direction = [1, 1, -1, 1, 1, 1, 1]\n"
    )
    settings, table = load(PANDA), scenario_dict(load_scenario(tmp_path / "s.toml"))["plant"]
    found = reality_of(table, settings)
    assert found == reality_of(plant_table(tmp_path / "s.toml"), settings)
    assert found.brake == (0.0, -1.0, 3.0, 4.0, 5.0, 6.0, 7.5)
    assert found._replace(payload_kg=0.0, brake=(-1.0,) * 7, mass_error={"": 0.0}, encoder_direction=(1.0,) * 7) == (
        reality_of({}, settings)
    )


@pytest.mark.parametrize(
    ("line", "named"),
    [
        ("payload_kg = -1", "payload_kg"),
        ('brake = "some"', "brake"),
        ("brake = 0", "brake"),
        ("coulomb_Nm = [0.1, 0.2]", "coulomb_Nm"),
        ("torque_gain = 3.0", "torque_gain"),
        ("encoder_direction = 2", "encoder_direction"),
        ("mass_error = -1.0", "mass_error"),
        ("mass_error = { panda_link99 = 0.1 }", "panda_link99"),
        ('payload_link = "nose"\npayload_kg = 1', "nose"),
        ("payload_com_m = [0, 0]", "payload_com_m"),
        ("talker_ids = [4096]", "talker_ids"),
        ("viscous_Nms_rad = nan", "viscous_Nms_rad"),
        ("weight = 3", "weight"),
    ],
)
def test_a_plant_that_makes_no_sense_is_refused_by_name(tmp_path: Path, line: str, named: str):
    (tmp_path / "s.toml").write_text(f'robot = "panda"\nduration_s = 1.0\n[plant]\n{line}\n')
    with pytest.raises(SettingsError, match=named):
        open_simulator(PANDA, {"plant": plant_table(tmp_path / "s.toml")}).close()


@pytest.mark.parametrize("line", ["payload_kg = -1", 'brake = "some"', "encoder_direction = 2", "weight = 3"])
def test_a_scenario_says_the_same_before_anything_is_simulated(tmp_path: Path, line: str):
    (tmp_path / "s.toml").write_text(f'robot = "panda"\nduration_s = 1.0\n[plant]\n{line}\n')
    with pytest.raises(ConfigError, match=line.partition(" ")[0]):
        load_scenario(tmp_path / "s.toml")


def test_a_plant_file_that_is_none_is_refused_by_name(tmp_path: Path):
    (tmp_path / "s.toml").write_text("plant = 3\n")
    with pytest.raises(SettingsError, match="wanted a table"):
        plant_table(tmp_path / "s.toml")
    with pytest.raises(SettingsError, match=r"absent\.toml"):
        plant_table(tmp_path / "absent.toml")

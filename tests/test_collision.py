"""Contact that nobody told of: pushes in the plant, and what the controller makes of them and when."""

import math
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from firmware_sim.bullet import pb
from firmware_sim.plant import Plant
from firmware_sim.settings import SettingsError, load
from firmware_sim.simulator import open_simulator
from rtctl.arm.encoders import halted
from rtctl.types import Severity, State
from tests.lab import PANDA, Lab, lab

WAY = np.array([0.1, 0.3, -0.1])
AT = 0.9  # [s] of the push


@pytest.fixture(scope="module")
def touchy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a Panda's file whose joints take a fortieth of their torque for a contact."""
    path = tmp_path_factory.mktemp("touchy") / "panda.toml"
    path.write_text(PANDA.read_text().replace("[safety]\n", "[safety]\ncollision_ratio = 0.025\n"))
    return path


def moving(path: Path, push: dict[str, Any] | None, plant: dict[str, Any] | None = None) -> AbstractContextManager[Lab]:
    """Return a lab in which the Panda has been on its way for half a second when it is pushed."""
    faults = [] if push is None else [{"kind": "push", "at_s": AT, "duration_s": 0.3, **push}]
    return lab(path=path, scenario={"fault": faults, "plant": plant or {}})


def played(here: Lab, until: float) -> float:
    """Move, and play until a collision or a time [s] of the scenario; return the time then."""
    here.running()
    while here.simulator.plant.scene_ns < 0.4e9:
        here.step()
    x = here.simulator.plant.tip_pose()[0]
    here.ask(x + WAY)
    while here.simulator.plant.scene_ns < until * 1e9 and here.memory.state == State.RUN:
        here.step()
    return here.simulator.plant.scene_ns * 1e-9


@pytest.mark.parametrize("direction", [(0.0, 0.0, -1.0), (0.0, -1.0, 0.0)])
def test_15_newton_at_the_forearm_while_moving_are_a_collision_within_20_ms(touchy: Path, direction: tuple[float, ...]):
    with moving(touchy, {"link": "panda_link5", "newton": 15.0, "direction": direction}) as here:
        at = played(here, AT + 0.05)
        assert AT < at < AT + 0.0205
        assert here.memory.state == State.SAFE_STOP
        link = here.robot.links[here.memory.contact_link]
        assert link in ("panda_link3", "panda_link4", "panda_link5")  # none beyond it, and it is near
        told = [detail for _, name, detail in here.servo.events if name == "fault"]
        assert told == [f"SAFE_STOP: collision: something pushes the arm that nobody told of at {link}"]
        assert here.memory.off == 0  # held, not dropped


def test_a_blow_ends_in_a_damped_stop():
    with moving(PANDA, {"link": "panda_link5", "newton": 150.0}) as here:
        played(here, AT + 0.1)
        here.run(0.03)
        assert here.memory.reaction >= Severity.SS1  # `collision_hard`, or the innovation where that is sooner


@pytest.mark.parametrize("seed", [1, 2])
def test_loads_within_what_is_declared_are_no_collision(touchy: Path, seed: int):
    rng = np.random.default_rng(seed)
    tau_max = np.array([87.0] * 4 + [12.0] * 3)
    plant = {"payload_kg": float(rng.uniform(0, 3)), "coulomb_Nm": (0.05 * tau_max * rng.uniform(size=7)).tolist()}
    with moving(touchy, None, plant) as here:
        assert played(here, 2.4) >= 2.4 - 1e-6
        assert here.memory.state == State.RUN


@pytest.mark.parametrize(
    ("equal", "last", "qd", "wanted"),
    [
        (0.001, 0.11, 0.0, True),
        (0.001, -0.11, 0.0, True),
        (0.0, 0.11, 0.0, False),  # its position has changed in this tick
        (0.001, 0.09, 0.0, False),
        (0.001, 0.11, 0.014, True),  # a step of its speed is 0.01 rad/s
        (0.001, 0.11, -0.016, False),
    ],
)
def test_a_joint_halts_that_moved_until_its_position_stayed_the_same(
    equal: float, last: float, qd: float, wanted: bool
):
    assert halted(equal, last, qd, 0.01 / math.sqrt(12.0)) is wanted


def test_a_coarse_speed_tells_of_a_halt_only_from_five_of_its_steps():
    assert halted(0.001, 0.26, 0.07, 0.05 / math.sqrt(12.0))
    assert not halted(0.001, 0.24, 0.07, 0.05 / math.sqrt(12.0))
    assert not halted(0.001, 0.26, 0.08, 0.05 / math.sqrt(12.0))


# ---- the push itself


def test_a_push_in_the_plant_is_the_force_that_pybullet_applies_at_that_link():
    settings, force = load(PANDA), [8.0, 5.0, -12.0]
    ends = []
    for ours in (False, True):
        plant = Plant(settings, settings.home, [])
        link = next(i for i, name in plant.links.items() if name == "panda_link5")
        for _ in range(100):
            if ours:
                plant.push({"panda_link5": force})
            else:
                at = pb.getLinkState(plant.body, link, physicsClientId=plant.client)[0]
                pb.applyExternalForce(plant.body, link, force, at, pb.WORLD_FRAME, physicsClientId=plant.client)
            plant.step([0.0] * 7, [0.0] * 7)
        ends.append(np.array(plant.q))
        plant.close()
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-8)


@pytest.mark.parametrize(
    ("fault", "named"),
    [
        ({"newton": 3.0}, "link"),
        ({"link": "panda_link5"}, "newton"),
        ({"link": "nose", "newton": 3.0}, "nose"),
        ({"link": "panda_link5", "newton": 3.0, "direction": [0, 0, 0]}, "direction"),
    ],
)
def test_a_push_that_makes_no_sense_is_refused_by_name(fault: dict[str, Any], named: str):
    with pytest.raises(SettingsError, match=named):
        open_simulator(PANDA, {"fault": [{"kind": "push", "at_s": 0.1, **fault}]}).close()

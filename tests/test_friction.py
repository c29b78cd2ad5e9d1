"""Friction and payload that the file and an operator tell of: within 1 mm by the plant's truth, and no chatter."""

import re
from pathlib import Path

import numpy as np
import pytest

from rtctl.arm import faults
from rtctl.arm.friction import SLIDING, rubbing, sliding, speeds_of
from rtctl.kernel.rotations import quat_of
from rtctl.types import Payload, Request
from tests.lab import ROOT, lab
from tests.test_disturbance import CASES, until


def told(folder: Path, name: str) -> Path:
    """Write an arm's file with the friction of its case; return its path."""
    text = (ROOT / "configs" / f"{name}.toml").read_text()
    if "package://" not in text:
        text = text.replace('urdf = "', f'urdf = "{ROOT}/configs/')
    each = iter(np.broadcast_to(CASES[name].coulomb, text.count("can_id =")).tolist())
    text = re.sub(r'(drive = "\w+"[^}]*?) }', lambda m: f"{m[1]}, friction = {{ coulomb_Nm = {next(each)} }} }}", text)
    path = folder / f"{name}.toml"
    path.write_text(text)
    return path


@pytest.mark.parametrize("name", ["openarm_e2e", "panda"])
def test_what_was_told_of_is_carried_within_a_millimetre(name: str, tmp_path: Path):
    """`python -m tools.loads` prints the same of every arm that is shipped."""
    case = CASES[name]
    with lab(path=told(tmp_path, name), scenario={"plant": {"payload_kg": case.payload}}) as here:
        here.step(Request(payload=Payload(case.payload)))  # the plant of a file rubs as the file says
        here.running()
        x, wxyz = here.simulator.truth().tip.copy(), quat_of(here.memory.tip.R)
        here.ask(x + np.array(case.way), wxyz)
        until(here, lambda m: m.status.name == "ARRIVED", 4.0)
        here.run(1.0)
        tips, given = [], []
        for _ in range(500):
            here.step()
            tips.append(here.simulator.plant.tip_pose()[0])
            m = here.memory
            given.append(
                rubbing(here.robot.coulomb, here.robot.viscous_told, speeds_of(m.space.Jbar, m.v_ref, m.w_ref))
            )
        truth = here.simulator.truth()
        assert np.linalg.norm(truth.tip - x - np.array(case.way)) < 1e-3
        assert 2.0 * np.arccos(min(abs(truth.tip_wxyz @ wxyz), 1.0)) < 1e-2
        assert np.ptp(tips, axis=0).max() < 0.2e-3
        # chatter would be steps as large as the friction itself
        assert (np.abs(np.diff(given, axis=0)).max(axis=0) < 0.05 * np.array(case.coulomb)).all()
        assert faults.names(here.servo.faults_seen) == ()


def test_friction_is_smooth_odd_and_all_of_it_for_a_joint_that_slides():
    qd = np.linspace(-1.0, 1.0, 4001)
    found = np.array([sliding(float(v)) for v in qd])
    np.testing.assert_allclose(found, -found[::-1], atol=1e-15)
    assert (np.diff(found) > 0.0).all()
    assert np.abs(np.diff(found)).max() <= (qd[1] - qd[0]) / SLIDING
    assert sliding(10.0 * SLIDING) > 0.99
    np.testing.assert_allclose(rubbing(np.array([0.5]), np.array([2.0]), np.array([1.0])), [2.5], atol=1e-4)


def test_joint_speeds_of_a_tip_velocity():
    Jbar = np.arange(12.0).reshape(2, 6)
    v = np.array([1.0, -2.0, 0.5, 0.1, 0.0, -0.3])
    np.testing.assert_allclose(speeds_of(Jbar, v[:3], v[3:]), Jbar @ v)

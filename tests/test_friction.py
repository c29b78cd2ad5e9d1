"""Friction and payload that the file and an operator tell of: within 1 mm by the plant's truth, and no chatter."""

import re
from pathlib import Path

import numpy as np
import pytest

from rtctl.arm import faults
from rtctl.arm.friction import SLIDING, rubbing, sliding, smoothing, speeds_of
from rtctl.experiment import rates
from rtctl.experiment.scene import variant
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
            within = smoothing(here.robot.coulomb, m.model.A_inv, here.robot.dt)
            asked = speeds_of(m.space.Jbar, m.v_ref, m.w_ref)
            given.append(rubbing(here.robot.coulomb, here.robot.viscous_told, asked, within))
        truth = here.simulator.truth()
        assert np.linalg.norm(truth.tip - x - np.array(case.way)) < 1e-3
        assert 2.0 * np.arccos(min(abs(truth.tip_wxyz @ wxyz), 1.0)) < 1e-2
        assert np.ptp(tips, axis=0).max() < 0.2e-3
        # chatter would be steps as large as the friction itself
        assert (np.abs(np.diff(given, axis=0)).max(axis=0) < 0.05 * np.array(case.coulomb)).all()
        assert faults.names(here.servo.faults_seen) == ()


@pytest.mark.parametrize(
    ("name", "hz", "is_there"), [("panda", 100, False), ("panda", 225, False), ("planar4", 100, True)]
)
def test_at_slow_rates_it_neither_shakes_an_arm_without_it_nor_says_that_an_encoder_is_stuck(
    name: str, hz: int, is_there: bool, tmp_path: Path
):
    """By the plant's truth. A period takes more speed of a light joint than it ever has: it was thrown to and fro.

    The Panda was stopped by `innovation` on its way, planar4 before its goal by `encoder_stuck`.
    """
    case = CASES[name]
    path = variant(told(tmp_path, name), tmp_path, rates.changes_of(hz, 100))
    plant = {"payload_kg": case.payload} if is_there else {"coulomb_Nm": 0.0}
    with lab(path=path, scenario={"plant": plant}) as here:
        if is_there:
            here.step(Request(payload=Payload(case.payload)))
        here.running()
        x, wxyz = here.simulator.truth().tip.copy(), quat_of(here.memory.tip.R)
        here.ask(x + np.array(case.way), wxyz)
        here.run(2.0)
        tips, fastest = [], 0.0
        for _ in range(round(1.0 / here.robot.dt)):
            here.step()
            tips.append(here.simulator.plant.tip_pose()[0])
            fastest = max(fastest, float(np.abs(here.simulator.truth().qd).max()))
        assert faults.names(here.servo.faults_seen) == ()
        assert np.linalg.norm(tips[-1] - x - np.array(case.way)) < 3e-3
        assert fastest < 0.5  # the wrist went at 2.6 rad/s


def test_dry_friction_alone_never_turns_a_joint_round_within_a_period():
    """Of joints with nothing else on them: qd A_ii^-1 c s(qd) dt is what they lose, and no more than they have."""
    coulomb, A_inv = np.array([0.5, 0.5, 3.0]), np.diag([150.0, 1.0, 20.0])
    for dt in (1e-3, 0.01):
        within = smoothing(coulomb, A_inv, dt)
        for speed in (1e-4, 1e-2, 0.1, 1.0, 10.0):
            for qd in (np.full(3, speed), np.full(3, -speed)):
                after = qd - dt * A_inv.diagonal() * rubbing(coulomb, np.zeros(3), qd, within)
                assert (after * qd >= 0.0).all()
    np.testing.assert_allclose(smoothing(coulomb, A_inv, 1e-3), [0.075, SLIDING, 0.06])


def test_friction_is_smooth_odd_and_all_of_it_for_a_joint_that_slides():
    qd = np.linspace(-1.0, 1.0, 4001)
    found = np.array([sliding(float(v), SLIDING) for v in qd])
    np.testing.assert_allclose(found, -found[::-1], atol=1e-15)
    assert (np.diff(found) > 0.0).all()
    assert np.abs(np.diff(found)).max() <= (qd[1] - qd[0]) / SLIDING
    assert sliding(10.0 * SLIDING, SLIDING) > 0.99
    np.testing.assert_allclose(
        rubbing(np.array([0.5]), np.array([2.0]), np.array([1.0]), np.array([SLIDING])), [2.5], atol=1e-4
    )


def test_joint_speeds_of_a_tip_velocity():
    Jbar = np.arange(12.0).reshape(2, 6)
    v = np.array([1.0, -2.0, 0.5, 0.1, 0.0, -0.3])
    np.testing.assert_allclose(speeds_of(Jbar, v[:3], v[3:]), Jbar @ v)

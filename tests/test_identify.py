"""Payload and friction out of a log: the plant that made it is the oracle."""

from pathlib import Path

import numpy as np
import pytest

from rtctl.app.identify import Identified, from_file
from rtctl.cli import main
from rtctl.errors import LogError
from tests.lab import recorded

PLANT = """
[plant]
payload_kg = 1.2
payload_com_m = [0.0, 0.03, 0.06]
coulomb_Nm = [0.8, 0.7, 0.6, 0.5, 0.3, 0.25, 0.2]
viscous_Nms_rad = [0.5, 0.4, 0.3, 0.3, 0.1, 0.1, 0.1]
"""
WAYS = """
[[goal]]
at_s = 0.3
position_m = [0.50, 0.35, 0.40]
rpy_rad = [2.6, 0.3, 1.0]
[[goal]]
at_s = 2.4
position_m = [0.50, -0.35, 0.55]
rpy_rad = [3.14, -0.4, -0.8]
[[goal]]
at_s = 4.8
position_m = [0.35, 0.10, 0.65]
rpy_rad = [2.4, 0.5, 0.6]
[[goal]]
at_s = 6.6
position_m = [0.55, 0.10, 0.25]
rpy_rad = [3.6, 0.0, -0.6]
[[goal]]
at_s = 8.6
position_m = [0.40, -0.25, 0.50]
rpy_rad = [3.14, 0.4, 0.8]
"""
HEAD = 'robot = "panda"\n'


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> Identified:
    """What is found in the log of an arm that carries and rubs."""
    folder = tmp_path_factory.mktemp("identify")
    recorded(folder, f"{HEAD}duration_s = 11.0\n{WAYS}{PLANT}")
    return from_file(folder / "run.mcap")


def test_the_payload_is_found_and_how_sure_that_is(found: Identified):
    assert abs(found.mass.value - 1.2) < 4.0 * found.mass.sigma
    assert found.mass.sigma < 0.05
    for com, true in zip(found.com, (0.0, 0.03, 0.06), strict=True):
        assert abs(com.value - true) < max(4.0 * com.sigma, 2e-3)


def test_the_friction_of_each_joint_is_found(found: Identified):
    true, thick = np.array([0.8, 0.7, 0.6, 0.5, 0.3, 0.25, 0.2]), np.array([0.5, 0.4, 0.3, 0.3, 0.1, 0.1, 0.1])
    for k, (rub, viscous) in enumerate(zip(found.coulomb, found.viscous, strict=True)):
        assert abs(rub.value - true[k]) < 4.0 * rub.sigma + 0.02
        assert abs(viscous.value - thick[k]) < 4.0 * viscous.sigma + 0.02


def test_it_prints_keys_that_a_file_takes(found: Identified):
    text = found.toml()
    assert "[tool]\nmass_kg = 1.2" in text
    assert "friction = { coulomb_Nm = " in text


def test_a_log_without_motion_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    recorded(tmp_path, f"{HEAD}duration_s = 0.8\n")
    with pytest.raises(LogError, match="motion"):
        from_file(tmp_path / "run.mcap")
    assert main(["log", "identify", str(tmp_path / "run.mcap")]) == 1
    assert "wanted 1 s and more" in capsys.readouterr().err

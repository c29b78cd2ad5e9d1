"""How fast the tip of the plant is where what moves it is not its motion task: fields at full torque, friction."""

from pathlib import Path

import pytest

from tools.stress.certified import certified
from tools.stress.judge import TIP_TOLERANCE
from tools.stress.play import CONFIGS, play, robot_of


@pytest.mark.parametrize(
    ("name", "seed", "number"),
    [
        pytest.param("planar4", 61201, 51, id="pushed aside at full torque, which is slewed"),
        pytest.param("planar4", 71202, 69, id="let go by brakes beside what pushes it"),
        pytest.param("puma560", 61201, 53, id="friction that slows a joint makes the tip faster"),
        pytest.param("puma560", 61202, 71, id="the same, from a stretched arm"),
    ],
)
def test_the_tip_is_no_faster_than_v_max(name: str, seed: int, number: int):
    robot, config = robot_of(name)
    path = Path(CONFIGS / f"{name}.toml")
    table, _, _ = certified(robot, config, path, seed, number)
    seen = play(table, number, path)
    assert seen.contact is None
    assert seen.arrived
    assert 0.9 < seen.tip_speed < 1.0 + 0.5 * TIP_TOLERANCE

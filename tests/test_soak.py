"""The judge of the long runs (`python -m tools.soak`) is not blind."""

import tomllib
from pathlib import Path

import numpy as np
import pytest

from rtctl.spec.scenario import load_scenario
from tests.lab import PANDA
from tools.soak import arm
from tools.soak.growth import quarters

FINE = arm.Account([arm.Sample((360.0, 150.0, 200.0), 11, 1000, 20)] * 8, 0, 0, 0, 0, [], "")


def test_what_a_start_needs_is_no_growth_and_what_comes_later_is():
    assert quarters([300.0, 360.0, 360.0, 360.0]) == (360.0, 360.0)
    assert quarters([360.0, 360.0, 361.0, 361.0, 362.0, 362.0, 363.0, 363.0]) == (361.0, 363.0)
    assert quarters([5.0]) == (5.0, 5.0)


@pytest.mark.parametrize(
    "change",
    [
        {"missed": 1},
        {"dropped": 1},
        {"late": 1},
        {"contacts": 1},
        {"faults": ["push"]},
        {"failure": "SAFE_STOP: push"},
        {"samples": []},
        {"samples": [arm.Sample((360.0, 150.0 + k, 200.0), 11, 1000, 20) for k in range(8)]},
        {"samples": [arm.Sample((360.0, 150.0, 200.0), 11 + k, 1000, 20) for k in range(8)]},
    ],
)
def test_whatever_is_missed_touched_or_grows_is_told(change: dict[str, object]):
    assert arm.judged(FINE)
    assert not arm.judged(FINE._replace(**change))


@pytest.mark.parametrize("minutes", [1.0, 20.0, 1440.0])
def test_the_world_of_a_run_is_one_that_is_taken_and_its_ball_comes_by_to_the_end(tmp_path: Path, minutes: float):
    path = arm.scenario_in(tmp_path, PANDA, minutes)
    load_scenario(path)
    ball = np.array(tomllib.loads(path.read_text())["obstacle"][2]["waypoints"])
    passes = int((ball[:, 1:] == [0.5, -0.08, 0.42]).all(axis=1).sum())
    assert passes == min(60, 2 * minutes)
    assert ball[-1, 0] < 60.0 * minutes
    moved = np.linalg.norm(np.diff(ball[:, 1:], axis=0), axis=1)
    assert moved.max() / np.diff(ball[:, 0])[moved.argmax()] < 0.3  # [m/s], slower than the arm

"""The problems of MotionBenchMaker: goal, frame and what is left out, on a problem made by hand."""

import gzip
import json
from pathlib import Path

import numpy as np
import pytest

from rtctl.campaign.case import Asked
from rtctl.campaign.robots import ready
from rtctl.campaign.sources import derived
from rtctl.errors import ConfigError
from tools.benchmark.source import foot, problems, source

GOAL = [0.3, -0.5, 0.1, -2.2, 0.0, 1.7, 0.9]
HOME = [0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785]


def data(tmp_path: Path, obstacles: list[dict[str, object]]) -> Path:
    joints = [f"panda_joint{k}" for k in range(7, 0, -1)]  # an order of its own
    problem = {
        "set": "box",
        "index": 1,
        "joints": joints,
        "start_rad": HOME[::-1],
        "goal_rad": GOAL[::-1],
        "obstacles": obstacles,
    }
    file = tmp_path / "problems.json.gz"
    file.write_bytes(gzip.compress(json.dumps({"robot": "panda", "problems": [problem] * 3}).encode()))
    return file


def box(name: str, at: list[float], size: float) -> dict[str, object]:
    return {"name": name, "type": "box", "position_m": at, "wxyz": [1.0, 0.0, 0.0, 0.0], "size_m": [size] * 3}


def test_the_goal_is_the_tips_pose_and_what_is_grasped_is_left_out(tmp_path: Path):
    file = data(tmp_path, [box("grasped", [0.0, 0.0, 9.0], 0.04), box("shelf", [0.9, 0.9, 0.9], 0.1)])
    first = next(source.cases(Asked((), range(1), 1, {"data": str(file), "plan": "never"})))
    path = ready(first.robot, first.config).path
    robot, config = derived(first.robot, path)
    tip = robot.body.evaluate(np.array(GOAL), np.zeros(7), robot.points, robot.own)
    file = data(tmp_path, [box("grasped", tip.x.tolist(), 0.04), box("shelf", [0.9, 0.9, 0.9], 0.1)])
    problems.cache_clear()
    cases = list(source.cases(Asked((), range(1), 1, {"data": str(file), "per-set": "2", "plan": "never"})))
    assert [case.number for case in cases] == [0, 1]
    others = source.cases(Asked((), range(1), 1, {"data": str(file), "per-set": "1", "skip": "2", "plan": "never"}))
    assert [case.number for case in others] == [2]
    table = source.scene(cases[0]).table
    assert table["start_q_rad"] == HOME
    assert table["goal"][0]["position_m"] == pytest.approx(tip.x, abs=1e-9)
    assert [o["name"] for o in table["obstacle"]] == ["shelf"]
    assert config.avoid.clearance_m == 0.005
    R, t = foot(robot, "panda_link0")
    assert np.allclose(R, np.eye(3))
    assert np.allclose(t, 0.0)


def test_data_that_are_none_are_refused(tmp_path: Path):
    (tmp_path / "no.json.gz").write_bytes(b"text")
    with pytest.raises(ConfigError, match=r"docs/benchmark\.md"):
        list(source.cases(Asked((), range(1), 1, {"data": str(tmp_path / "no.json.gz")})))

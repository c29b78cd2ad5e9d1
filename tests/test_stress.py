"""The stress set: its generator keeps its rule, its judge sees what is wrong, and a few of its scenarios hold."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from firmware_sim.plant import Contact
from rtctl.campaign.case import Asked, Scene
from rtctl.campaign.scenes import scenario_of, toml_of
from rtctl.spec.scenario import load_scenario, scenario_dict
from tests.lab import robot
from tools.stress import judge
from tools.stress.play import CONFIGS, Seen, play, robot_of
from tools.stress.source import columns, source

BRIEF = 2.0  # [s] that is played here of each


def seen(**changes: Any) -> Seen:
    """Return what a run shows in which nothing is wrong."""
    good: dict[str, Any] = {
        "robot": "panda",
        "case": 0,
        "duration": 5.0,
        "arrived": True,
        "error": 0.0,
        "time_to_goal": 1.0,
        "contact": None,
        "retreat": 0.0,
        "can_retreat": 0.0,
        "finite": True,
        "torque": 1.0,
        "rate": 1.0,
        "joint_speed": 1.0,
        "tip_speed": 1.0,
        "margin": 0.0,
        "clearance": 0.1,
        "own": 0.1,
        "recent_torque": 0.1,
        "recent_speed": 0.1,
        "recent_tip": 0.1,
        "stopped": "",
        "faults": (),
        "status": "arrived",
        "detail": "",
        "statuses": (),
        "diagnosis": "",
        "digest": "",
    }
    return Seen(**(good | changes))


def met(cause: str, arm: float) -> Contact:
    return Contact(1.0, "link", "self:other" if cause == "self" else "ball", cause, arm, 0.2, (0.1,) * 7)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"torque": 1.001}, "torque at"),
        ({"rate": 1.001}, "torque rate at"),
        ({"joint_speed": 1.001}, "joint speed at"),
        ({"tip_speed": 1.03}, "tip speed at"),
        ({"margin": -0.001}, "beyond its limit"),
        ({"finite": False}, "not a number"),
        ({"torque": np.nan}, "torque at"),
        ({"faults": ("overspeed",)}, "fault overspeed"),
        ({"diagnosis": "limited by joint 3, which is free"}, "untrue"),
        ({"contact": met("arm", 0.1)}, "ran into"),
        ({"contact": met("obstacle", 0.1)}, "ran into"),  # slower than the obstacle, but closing
        ({"contact": met("self", 0.0)}, "touched itself"),
        ({"contact": met("obstacle", -0.05), "retreat": 0.05, "can_retreat": 0.5}, "down, which fled at"),
    ],
)
def test_the_judge_names_what_is_wrong(changes: dict[str, Any], said: str):
    broken = judge.failures(robot(), seen(**changes))
    assert len(broken) == 1
    assert said in broken[0]


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"contact": met("obstacle", -0.5), "retreat": 0.5, "can_retreat": 0.5},
        {"contact": met("obstacle", -0.1), "can_retreat": 0.5, "recent_speed": 0.9},
    ],
)
def test_the_judge_lets_pass_what_is_right(changes: dict[str, Any]):
    assert judge.failures(robot(), seen(**changes)) == []


def test_a_scenario_is_the_same_for_ever_and_from_its_file(tmp_path: Path):
    arm, config = robot_of("panda")
    for index in range(4):
        one, two = (scenario_of(arm, config, 0, index) for _ in range(2))
        assert one == two
        path = tmp_path / f"{index}.toml"
        path.write_text(toml_of(one, "a comment"))
        read = scenario_dict(load_scenario(path), path)
        for key, value in one.items():
            if key not in ("goal", "obstacle"):
                assert np.array_equal(read[key], value)
        for key in ("goal", "obstacle"):
            for row, wanted in zip(read[key], one[key], strict=True):
                assert all(np.array_equal(row[k], v) for k, v in wanted.items())
    assert scenario_of(arm, config, 1, 0) != scenario_of(arm, config, 0, 0)


@pytest.mark.parametrize("name", ["planar4", "puma560", "panda", "ur5", "openarm_e2e"])
def test_a_scenario_of_each_robot_breaks_nothing(name: str):
    arm, config = robot_of(name)
    table = scenario_of(arm, config, 0, 1) | {"duration_s": BRIEF}
    run = play(table, 1)
    assert judge.failures(arm, run) == []
    assert run.duration > BRIEF - 0.1
    assert run.joint_speed > 0.05  # it did move


@pytest.mark.parametrize(
    ("name", "index", "until"), [("ur5", 10, 1.0), ("openarm_e2e", 66, 0.9), ("ur5", 20, 2.2), ("panda", 80, 6.3)]
)
def test_what_went_wrong_once_holds(name: str, index: int, until: float):
    """A forearm that meets its own shoulder at v_max; a way past a singularity, with joints fit for 17 rad/s; a folded
    arm that swung between two of its own links, past a joint limit; a hand held at rest that was said to move.
    """
    arm, config = robot_of(name)
    run = play(scenario_of(arm, config, 0, index) | {"duration_s": until}, index)
    assert judge.failures(arm, run) == []


def test_an_arm_that_creeps_along_a_joint_limit_is_said_to_be_held_by_it():
    """Its tip slides on for seconds: at rest it is not yet, and it gets nowhere."""
    arm, config = robot_of("puma560")
    run = play(scenario_of(arm, config, 0, 72) | {"obstacle": [], "duration_s": 5.9}, 72, guided=False)
    assert (run.status, run.detail) == ("limited", "joint_1 at its upper limit")
    assert run.diagnosis == ""  # true of the plant's own joint
    assert run.margin < arm.limit.rho0[0]


def test_the_column_run_down_is_no_violation_of_any_bound():
    """A ball drives through the shoulder: the arm cannot flee, and does not whirl about for it."""
    ball = {
        "name": "ball",
        "type": "sphere",
        "radius_m": 0.1,
        "position_m": [-0.6, 0.1, 0.33],
        "velocity_m_s": [0.25, 0.0, 0.0],
    }
    run = play({"robot": "panda", "duration_s": 2.5, "obstacle": [ball]}, 0)
    assert run.contact is not None
    assert run.contact.arm_m_s < judge.CLOSING
    assert max(run.torque, run.joint_speed, run.tip_speed) <= 1.0
    assert run.rate <= 1.0 + 1e-9
    assert run.margin > 0.0


@pytest.mark.parametrize("at", [[0.307, 0.0, 0.44], [0.0, 0.125, 0.62], [0.385, 0.0, 0.55]])
def test_what_appears_within_the_clearance_of_a_running_arm_makes_nothing_too_fast(at: list[float]):
    ball = {"name": "ball", "type": "sphere", "radius_m": 0.03, "position_m": at, "appears_s": 0.8}
    run = play({"robot": "panda", "duration_s": 1.6, "obstacle": [ball]}, 0)
    assert run.clearance < robot().avoid.rho_min + 0.025  # spheres stand out of the links by that
    assert run.contact is None
    assert max(run.torque, run.joint_speed) <= 1.0
    assert run.tip_speed <= 1.0 + judge.TIP_TOLERANCE
    assert run.rate <= 1.0 + 1e-9


def test_a_run_of_the_campaign_is_the_run_itself():
    case = next(source.cases(Asked(("planar4",), range(1), 1, {})))
    path = CONFIGS / "planar4.toml"
    table = scenario_of(*robot_of("planar4"), 0, 0) | {"duration_s": 1.0}
    row = source.play(case, Scene(table, path), path)
    run = play(table, 0)
    assert (row["digest"], row["failures"], row["min_clearance_m"]) == (run.digest, "", run.clearance)
    late = columns(run, ["torque at 1.2"])
    assert late["failures"] == "torque at 1.2"

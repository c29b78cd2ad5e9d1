"""Scenarios and obstacles: what people write becomes what the controller takes."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rtctl import design
from rtctl.errors import ConfigError
from rtctl.spec.obstacles import orientation_of, pose_at, quaternion, shape_of
from rtctl.spec.scenario import GoalTable, goal_of, load_scenario, parse_goal, parse_obstacle, robot_file, scenario_dict
from rtctl.types import Task
from rtctl.world.primitives import TYPES, distance
from tests.config_leaves import write

AT = {"name": "o", "position_m": [1.0, 2.0, 3.0]}
SHAPES: list[tuple[dict[str, Any], list[float], float]] = [  # (keys, point in the obstacle's frame, its true distance)
    ({"type": "sphere", "radius_m": 0.1}, [0.3, 0.0, 0.0], 0.2),
    ({"type": "point"}, [0.3, 0.0, 0.4], 0.5),
    ({"type": "capsule", "radius_m": 0.1, "length_m": 0.6}, [0.0, 0.0, 0.5], 0.1),
    ({"type": "segment", "length_m": 0.6}, [0.0, 0.0, 0.5], 0.2),
    ({"type": "cylinder", "radius_m": 0.1, "length_m": 0.6}, [0.0, 0.0, 0.5], 0.2),
    ({"type": "box", "size_m": [0.2, 0.4, 0.6]}, [0.0, 0.0, 0.5], 0.2),
    ({"type": "box", "size_m": [0.2, 0.4, 0.6]}, [0.5, 0.0, 0.0], 0.4),
    ({"type": "plane"}, [7.0, 8.0, 0.5], 0.5),
    ({"type": "ellipsoid", "semi_axes_m": [0.1, 0.2, 0.3]}, [0.0, 0.0, 0.5], 0.2),
    ({"type": "n_ellipsoid", "semi_axes_m": [0.1, 0.2, 0.3], "n": 4.0}, [0.0, 0.5, 0.0], 0.3),
    ({"type": "n_cylinder", "semi_axes_m": [0.1, 0.2, 0.3], "n": 4.0}, [0.0, 0.0, 0.5], 0.2),
    ({"type": "cone", "radius_m": 0.1, "height_m": 0.6}, [0.0, 0.0, 0.5], 0.2),
    ({"type": "cone", "radius_m": 0.1, "top_radius_m": 0.2, "height_m": 0.6}, [0.2, 0.0, 0.4], 0.1),
]


@pytest.mark.parametrize(("keys", "point", "rho"), SHAPES, ids=lambda v: v["type"] if isinstance(v, dict) else "")
def test_each_kind_of_obstacle_has_the_size_it_was_written_with(
    keys: dict[str, Any], point: list[float], rho: float
) -> None:
    rpy = [0.3, -0.4, 1.1]
    shape = shape_of(parse_obstacle({**AT, **keys, "rpy_rad": rpy}, "test"))
    world = Rotation.from_euler("xyz", rpy).apply(point) + AT["position_m"]
    assert distance(shape, world[None, :])[0][0] == pytest.approx(rho, abs=1e-9)


def test_every_kind_the_controller_knows_can_be_written() -> None:
    """Those of files, mesh and cloud, are in test_bodies and test_obstacle_feed."""
    assert {keys["type"] for keys, _, _ in SHAPES} == set(TYPES) - {"mesh", "cloud"}


def test_roll_pitch_yaw_is_that_of_urdf() -> None:
    rng = np.random.default_rng(0)
    for rpy in rng.uniform(-3.1, 3.1, (50, 3)):
        expected = Rotation.from_euler("xyz", rpy).as_quat(scalar_first=True)
        got = quaternion((rpy[0], rpy[1], rpy[2]), None)
        assert min(np.abs(got - expected).max(), np.abs(got + expected).max()) < 1e-12


def test_a_normal_turns_local_z_to_itself() -> None:
    for normal in ([0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.6, -0.3, 0.2], [0.0, 1e-3, -1.0]):
        w = orientation_of(parse_obstacle({**AT, "type": "plane", "normal": normal}, "test"))
        z = Rotation.from_quat(w, scalar_first=True).apply([0.0, 0.0, 1.0])
        assert z == pytest.approx(np.array(normal) / np.linalg.norm(normal), abs=1e-9)


def test_an_obstacle_moves_from_where_it_appears() -> None:
    ball = parse_obstacle(
        {**AT, "type": "point", "velocity_m_s": [1.0, 0.0, -0.5], "appears_s": 2.0, "vanishes_s": 4.0}, "test"
    )
    assert [pose_at(ball, t).present for t in (1.99, 2.0, 3.99, 4.0)] == [False, True, True, False]
    assert pose_at(ball, 0.0).position == pytest.approx([1.0, 2.0, 3.0])
    assert pose_at(ball, 3.0).position == pytest.approx([2.0, 2.0, 2.5])
    assert pose_at(ball, 3.0).velocity == pytest.approx([1.0, 0.0, -0.5])


def test_waypoints_are_joined_by_straight_lines_and_rested_at() -> None:
    path = [[1.0, 0.0, 0.0, 0.0], [2.0, 1.0, 0.0, 0.0], [4.0, 1.0, 1.0, 0.0]]
    ball = parse_obstacle({"name": "o", "type": "point", "waypoints": path}, "test")
    expected = {0.5: [0, 0, 0], 1.5: [0.5, 0, 0], 3.0: [1.0, 0.5, 0], 9.0: [1, 1, 0]}
    for t, position in expected.items():
        assert pose_at(ball, t).position == pytest.approx(position)
    assert pose_at(ball, 3.0).velocity == pytest.approx([0.0, 0.5, 0.0])
    assert not pose_at(ball, 9.0).velocity.any()


def test_a_turning_obstacle_turns_about_the_world_axes() -> None:
    keys = {**AT, "type": "box", "size_m": [0.1] * 3, "rpy_rad": [0.5, 0.0, 0.0], "omega_rad_s": [0.0, 0.0, 0.7]}
    turned = Rotation.from_quat(shape_of(parse_obstacle(keys, "test"), 2.0).wxyz, scalar_first=True)
    expected = Rotation.from_rotvec([0.0, 0.0, 1.4]) * Rotation.from_euler("xyz", [0.5, 0.0, 0.0])
    assert (turned * expected.inv()).magnitude() < 1e-9


@pytest.mark.parametrize(
    ("data", "place"),
    [
        ({**AT, "type": "sphere"}, "radius_m"),
        ({**AT, "type": "mess"}, "type"),
        ({**AT, "type": "mesh"}, "mesh"),
        ({**AT, "type": "cloud", "point_radius_m": 0.01}, "file"),
        ({**AT}, "type"),
        ({**AT, "type": "point", "radius_m": 0.1}, "radius_m"),
        ({"name": "o", "type": "point"}, "position_m"),
        ({**AT, "type": "point", "waypoints": [[0, 0, 0, 0]]}, "position_m"),
        ({"name": "o", "type": "point", "waypoints": [[1, 0, 0, 0], [1, 1, 0, 0]]}, "waypoints"),
        ({"name": "o", "type": "point", "waypoints": [[1, 0, 0, 0]], "velocity_m_s": [1, 0, 0]}, "velocity_m_s"),
        ({**AT, "type": "point", "appears_s": 2.0, "vanishes_s": 2.0}, "vanishes_s"),
        ({**AT, "type": "point", "wxyz": [1, 0, 0, 0.5]}, "wxyz"),
        ({**AT, "type": "point", "wxyz": [1, 0, 0, 0], "rpy_rad": [0, 0, 0]}, "wxyz"),
        ({**AT, "type": "plane", "normal": [0, 0, 0]}, "normal"),
        ({**AT, "type": "plane", "normal": [0, 0, 1], "rpy_rad": [0, 0, 0]}, "normal"),
        ({**AT, "type": "point", "position_m": [float("nan"), 0, 0]}, "position_m[0]"),
        ([], ""),
        ("text", ""),
    ],
)
def test_an_obstacle_that_makes_no_sense_is_refused_by_name(data: object, place: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_obstacle(data, "obstacle")
    assert caught.value.place == (f"obstacle: {place}" if place else "obstacle")


SCENARIO: dict[str, Any] = {
    "robot": "panda",
    "duration_s": 8.0,
    "goal": [{"at_s": 0.0, "position_m": [0.5, 0.2, 0.4]}, {"at_s": 4.0, "position_m": [0.5, -0.2, 0.4]}],
    "obstacle": [{**AT, "type": "sphere", "radius_m": 0.1}],
    "fault": [{"at_s": 2.0, "kind": "drop", "duration_s": 0.1, "joint": "panda_joint2"}],
}


def test_a_scenario_survives_being_written_out_again(tmp_path: Path) -> None:
    scenario = load_scenario(write(tmp_path / "a.toml", SCENARIO))
    again = load_scenario(write(tmp_path / "b.toml", scenario_dict(scenario)))
    assert again == scenario
    assert robot_file(scenario, tmp_path / "a.toml").resolve() == (Path(__file__).parents[1] / "configs/panda.toml")


def test_a_robot_beside_the_scenario_goes_first_and_an_unknown_one_is_refused(tmp_path: Path) -> None:
    (tmp_path / "panda.toml").write_text("")
    scenario = load_scenario(write(tmp_path / "a.toml", SCENARIO))
    assert robot_file(scenario, tmp_path / "a.toml") == tmp_path / "panda.toml"
    for robot in ("absent", "absent.toml"):
        file = write(tmp_path / "b.toml", {**SCENARIO, "robot": robot})
        with pytest.raises(ConfigError, match="robot: got absent"):
            robot_file(load_scenario(file), file)


@pytest.mark.parametrize(
    ("changes", "place"),
    [
        ({"goal": [{"at_s": 1.0, "position_m": [0, 0, 0]}] * 2}, "goal[1].at_s"),
        (
            {"goal": [{"at_s": 0.0, "position_m": [0, 0, 0], "hold": "orientation", "rpy_rad": [0, 0, 0]}]},
            "goal[0].hold",
        ),
        ({"goal": [{"at_s": 0.0, "position_m": [0, 0, 0], "wxyz": [0, 0, 0, 0]}]}, "goal[0].wxyz"),
        ({"obstacle": SCENARIO["obstacle"] * 2}, "obstacle[1].name"),
        ({"obstacle": [{"name": "o", "type": "point"}]}, "obstacle[0].position_m"),
    ],
)
def test_a_scenario_that_contradicts_itself_is_refused_by_name(
    changes: dict[str, Any], place: str, tmp_path: Path
) -> None:
    file = write(tmp_path / "a.toml", {**SCENARIO, **changes})
    with pytest.raises(ConfigError) as caught:
        load_scenario(file)
    assert caught.value.place == f"{file}: {place}"


def test_a_goal_constrains_what_it_names() -> None:
    loaded = design.load(Path(__file__).parents[1] / "configs" / "panda.toml")
    now = np.array([0.0, 1.0, 0.0, 0.0])

    def goal(**keys: Any) -> tuple[Task, list[float], float]:
        table: GoalTable = parse_goal({"position_m": [0.5, 0.0, 0.4], **keys}, "goal")
        made = goal_of(table, now, loaded.motion.tolerance_m, loaded.motion.tolerance_rad)
        return made.task, [round(float(v), 6) for v in made.wxyz], made.tolerance

    assert goal()[0] is Task.POSITION
    assert goal(hold="orientation") == (Task.POSE, [0.0, 1.0, 0.0, 0.0], 0.003)
    assert goal(rpy_rad=[0.0, 0.0, np.pi]) == (Task.POSE, [0.0, 0.0, 0.0, 1.0], 0.003)
    assert goal(wxyz=[1.0, 0.0, 0.0, 0.0], tolerance_m=0.01) == (Task.POSE, [1.0, 0.0, 0.0, 0.0], 0.01)

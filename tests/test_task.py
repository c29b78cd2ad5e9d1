"""Partial tasks: the selected motions are controlled, the rest is free; against numpy, scipy and pybullet's truth."""

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rtctl.arm import osc, task
from rtctl.errors import ConfigError
from rtctl.kernel.rotations import R_of
from rtctl.spec.goal import goal_from
from rtctl.spec.scenario import GoalTable, parse_goal
from rtctl.types import F64, Goal, LimitFlag, Request, Status, Task
from tests.arms import PANDA_HOME
from tests.lab import Run, Standing, play
from tests.test_osc import P, arm

Z = np.array([0.0, 0.0, 1.0])
PARTS = {
    "plane": Task.X | Task.Y,
    "height and turn": Task.Z | Task.RZ,
    "orientation": Task.ORIENTATION,
    "direction": Task.DIRECTION,
    "position, direction": Task.POSITION | Task.DIRECTION,
    "line, orientation": Task.Y | Task.ORIENTATION,
}


def unit(v: F64) -> F64:
    """Return v with length 1."""
    return np.asarray(v / np.linalg.norm(v), np.float64)


numbers = st.floats(-1.0, 1.0, allow_subnormal=False)
units = st.tuples(numbers, numbers, numbers).map(np.array).filter(lambda v: np.linalg.norm(v) > 0.1).map(unit)


def turned(rotvec: F64) -> F64:
    R: F64 = Rotation.from_rotvec(rotvec).as_matrix()
    return R


# ---- the selection


@pytest.mark.parametrize("part", PARTS.values(), ids=list(PARTS))
def test_the_selected_motions_have_their_inertia_and_the_others_belong_to_the_posture(part: Task):
    J, A, A_inv = arm()
    R = turned(np.array([0.3, -1.2, 0.8]))
    S = task.selection(int(part), Z, R)
    np.testing.assert_allclose(S @ S.T, np.eye(len(S)), atol=1e-14)
    space = osc.operational_space(J, A_inv, J @ A_inv @ J.T, S, P._replace(epsilon=1e-9))
    np.testing.assert_allclose(space.Lambda, S.T @ np.linalg.inv(S @ J @ A_inv @ J.T @ S.T) @ S, atol=1e-9)
    F = np.random.default_rng(1).normal(size=6)
    np.testing.assert_allclose(S @ J @ A_inv @ J.T @ space.Lambda @ F, S @ F, atol=1e-9)  # accelerates as asked
    tau = space.NT @ A @ np.random.default_rng(2).normal(size=7)
    np.testing.assert_allclose(S @ J @ A_inv @ tau, 0.0, atol=1e-9)
    free = np.linalg.svd(S)[2][len(S) :]
    assert np.linalg.norm(free @ J @ A_inv @ tau) > 0.01  # the posture moves what the task leaves free
    twist = np.random.default_rng(3).normal(size=6)
    v, w = task.selected(int(part), Z, R, twist[:3], twist[3:])
    np.testing.assert_allclose(np.concatenate((v, w)), S.T @ S @ twist, atol=1e-14)


def test_a_direction_does_not_select_the_roll_about_the_tools_axis():
    R = turned(np.array([0.3, -1.2, 0.8]))
    S = task.selection(int(Task.DIRECTION), np.array([1.0, 0.0, 0.0]), R)
    np.testing.assert_allclose(S[:, 3:] @ R[:, 0], 0.0, atol=1e-15)


# ---- the error of a direction


@given(units, units)
def test_the_turn_between_two_directions_is_the_shortest(a: F64, b: F64):
    turn = task.between(a, b)
    np.testing.assert_allclose(turned(turn) @ a, b, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(turn), np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b), atol=1e-12)
    assert abs(turn @ a) < 1e-9


@given(units, st.floats(0.0, 1e-3))
def test_the_turn_is_smooth_at_zero(a: F64, angle: float):
    u = np.cross(a, [0.36, 0.48, 0.8])
    u = u / np.linalg.norm(u) if np.linalg.norm(u) > 1e-3 else np.cross(a, Z) / np.linalg.norm(np.cross(a, Z))
    np.testing.assert_allclose(task.between(a, turned(angle * u) @ a), angle * u, atol=1e-15)


@given(units)
def test_the_opposite_direction_is_half_a_turn_away_about_some_axis_across(a: F64):
    turn = task.between(a, -a)
    np.testing.assert_allclose(np.linalg.norm(turn), np.pi, rtol=1e-12)
    np.testing.assert_allclose(turned(turn) @ a, -a, atol=1e-9)


@given(units, st.sampled_from(["x", "y", "z", "-x", "-y", "-z"]))
def test_a_goal_that_points_has_an_orientation_that_points_there(direction: F64, tool_axis: Any):
    table = GoalTable(direction=tuple(direction.tolist()), tool_axis=tool_axis)
    goal = goal_from(table, lambda: PANDA_HOME[:4], 0.003, 0.015)
    assert goal.task == Task.DIRECTION
    np.testing.assert_allclose(R_of(goal.wxyz) @ goal.axis, direction, atol=1e-9)
    R = R_of(goal.wxyz) @ turned(1.7 * goal.axis)  # rolled about the axis it points there still
    assert task.error_of(goal, np.zeros(3), R)[1] < 1e-7


@pytest.mark.parametrize(
    ("keys", "key"),
    [
        ({}, "position_m"),
        ({"axes": ["x"]}, "axes"),
        ({"position_m": [0, 0, 0], "axes": ["x", "x"]}, "axes"),
        ({"direction": [0, 0, 0]}, "direction"),
        ({"direction": [0, 0, 1], "hold": "orientation"}, "direction"),
        ({"position_m": [0, 0, 0], "tool_axis": "x"}, "tool_axis"),
    ],
)
def test_a_goal_that_contradicts_itself_is_refused_by_its_key(keys: dict[str, Any], key: str):
    with pytest.raises(ConfigError) as caught:
        parse_goal(keys, "goal")
    assert caught.value.place == f"goal: {key}"


# ---- what an arm can do


def test_an_arm_that_moves_in_a_plane_ignores_the_height_and_refuses_an_orientation():
    plane = Task.X | Task.Y
    assert task.within(Task.POSITION, plane) == (plane, "")
    assert "orientation" in task.within(Task.POSE, plane)[1]
    assert "xy" in task.within(Task.Z, plane)[1]
    assert task.within(Task.POSITION | Task.DIRECTION, plane | Task.RZ) == (plane | Task.DIRECTION | Task.RZ, "")
    for each in (Task.POSE, Task.POSITION, Task.DIRECTION, Task.X):
        assert task.within(each, Task.POSE) == (each, "")


# ---- on the plant

GIVEN = 0.4
TOUR: dict[str, dict[str, Any]] = {
    "plane": {"position_m": [0.45, 0.25, 90.0], "axes": ["x", "y"]},
    "direction": {"direction": [0.6, 0.0, -0.8]},
    "position, direction": {"position_m": [0.45, -0.1, 0.5], "direction": [0.0, 0.0, -1.0]},
    "tool axis": {"position_m": [0.4, 0.1, 0.5], "direction": [0.8, 0.6, 0.0], "tool_axis": "x"},
    "orientation": {"rpy_rad": [2.8, 0.2, 0.3]},
}


@cache
def tour() -> Run:
    goals = [{"at_s": GIVEN + 2.0 * i, **goal} for i, goal in enumerate(TOUR.values())]
    return play({"duration_s": GIVEN + 2.0 * len(TOUR), "goal": goals})


def ends() -> list[int]:
    """Rows just before each next goal."""
    run = tour()
    return [int(np.searchsorted(run.t, GIVEN + 2.0 * (i + 1))) - 2 for i in range(len(TOUR))]


def test_each_part_of_a_pose_is_reached_and_told_so():
    run = tour()
    assert [leg["arrived"] for leg in run.figures["goals"]] == [True] * len(TOUR)
    assert run.figures["arrived"]
    for row in ends():
        assert run.record["status"][row] == Status.ARRIVED
        assert run.record["error"][row] < 1e-3
        assert run.record["error_rot"][row] < 5e-3
    assert not (run.record["cut"] & LimitFlag.SINGULAR).any()


def test_the_truth_agrees_with_what_was_asked_and_the_rest_was_left_alone():
    run, row = tour(), dict(zip(TOUR, ends(), strict=True))
    R = {name: R_of(run.record["wxyz"][k]) for name, k in row.items()}
    tip = {name: run.tip[k] for name, k in row.items()}
    np.testing.assert_allclose(tip["plane"][:2], [0.45, 0.25], atol=1e-3)
    assert 0.2 < tip["plane"][2] < 1.0  # 90 m up was not asked for
    np.testing.assert_allclose(R["direction"][:, 2], [0.6, 0.0, -0.8], atol=5e-3)
    np.testing.assert_allclose(tip["position, direction"], [0.45, -0.1, 0.5], atol=1e-3)
    np.testing.assert_allclose(R["position, direction"][:, 2], [0.0, 0.0, -1.0], atol=5e-3)
    np.testing.assert_allclose(R["tool axis"][:, 0], [0.8, 0.6, 0.0], atol=5e-3)
    wanted = Rotation.from_euler("xyz", [2.8, 0.2, 0.3]).as_matrix()
    np.testing.assert_allclose(R["orientation"], wanted, atol=5e-3)


def test_partial_motions_keep_the_limits_of_whole_ones():
    run = tour()
    for name in ("max_torque_ratio", "max_torque_rate_ratio", "max_joint_speed_ratio"):
        assert run.figures[name] <= 1.0 + 1e-9
    assert run.figures["contacts"] == 0
    assert run.figures["min_joint_margin_rad"] > 0.0


# ---- a planar arm

PLANAR = """<robot name="planar"><link name="base"/>{links}
  <link name="tip"/><joint name="end" type="fixed"><parent link="l3"/><child link="tip"/><origin xyz="0.3 0 0"/></joint>
</robot>""".format(
    links="".join(
        f"""<link name="l{i}"><inertial><origin xyz="0.15 0 0"/><mass value="1"/>
    <inertia ixx="0.001" iyy="0.008" izz="0.008" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><origin xyz="0.15 0 0" rpy="0 1.5708 0"/><geometry><cylinder radius="0.03" length="0.26"/></geometry>
    </collision></link>
    <joint name="j{i}" type="revolute"><parent link="{"base" if i == 1 else f"l{i - 1}"}"/><child link="l{i}"/>
    <origin xyz="{0.0 if i == 1 else 0.3} 0 0"/><axis xyz="0 0 1"/>
    <limit effort="30" velocity="3" lower="-2.8" upper="2.8"/></joint>"""
        for i in (1, 2, 3)
    )
)


def planar(folder: Path, axes: str) -> Path:
    """Write a planar arm of three joints; return its config."""
    (folder / "planar.urdf").write_text(PLANAR)
    joints = "".join(
        f'{{ name = "j{i}", can_id = {i}, q_min_rad = -2.8, q_max_rad = 2.8, qd_max_rad_s = 3.0, tau_max_Nm = 25.0, '
        'tau_rate_Nm_s = 1000.0, drive = "D" },\n'
        for i in (1, 2, 3)
    )
    text = (Path(__file__).parents[1] / "configs" / "panda.toml").read_text()
    rest = text[text.index("[loop]") :].replace("[motion]\n", f"[motion]\naxes = {axes}\n")
    head = f"""[robot]
name = "planar"
kind = "arm"
urdf = "planar.urdf"
tip_frame = "tip"
home_rad = [0.4, 0.7, 0.8]
joints = [
{joints}]
[drives.D]
p_max_rad = 12.5
v_max_rad_s = 10.0
t_max_Nm = 28.0

"""
    path = folder / "planar.toml"
    path.write_text(head + rest)
    return path


def test_a_planar_arm_moves_in_its_plane_and_is_not_called_singular_for_the_rest(tmp_path: Path):
    goals = [{"at_s": GIVEN, "position_m": [0.3, 0.45, 0.7]}, {"at_s": 2.4, "position_m": [0.55, 0.1, 0.0]}]
    run = play({"duration_s": 4.5, "goal": goals}, planar(tmp_path, '["x", "y"]'))
    assert run.figures["arrived"]
    assert run.figures["final_error_m"] < 1e-3
    assert not (run.record["cut"] & LimitFlag.SINGULAR).any()
    assert {name for _, name, _ in run.events} == {"state", "moving", "arrived"}


def test_a_goal_that_leaves_the_orientation_free_does_not_turn_the_hand_in_its_first_tick():
    standing = Standing()
    flipped = np.array([0.0, 0.0, 1.0, 0.0])
    goal = Goal(standing.memory.tip.x, flipped, Task.POSITION, 0.003, 0.015)
    standing.tick(Request(goal=goal))
    assert standing.memory.goal is not None
    np.testing.assert_allclose(standing.memory.w_ref, 0.0, atol=1e-6)

"""Catalogue row 38: keys that contradict each other, or the URDF, are refused by name with exit code 78."""

import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtctl import design
from rtctl.arm.robot import Robot
from rtctl.design import points
from rtctl.errors import ConfigError
from tests.config_leaves import replaced, write

PANDA = Path(__file__).parents[1] / "configs" / "panda.toml"
TABLE: dict[str, Any] = tomllib.loads(PANDA.read_text())
BOX = {"name": "table", "type": "box", "size_m": [0.4, 0.4, 0.1], "position_m": [0.6, 0.0, 0.0]}
TIP_AT_HOME = [0.307, 0.0, 0.487]  # tip of the Panda at its usual home, by the maker's DH parameters


def edited(*edits: tuple[str, Any]) -> dict[str, Any]:
    """Return the Panda's file with keys replaced; `a.2.b` goes into lists."""
    table = TABLE
    for path, value in edits:
        table = replaced(table, tuple(int(k) if k.isdigit() else k for k in path.split(".")), value)
    return table


# fmt: off
SLOW = [("loop.servo_hz", 100), ("loop.model_hz", 100), ("safety.watchdog_ms", 100.0),
        ("safety.stale_hold_ms", 30.0), ("safety.stale_stop_ms", 100.0)]
FILE = [  # (edits, place, word of the reason): refused from the file alone
    ([("robot.kind", "base")], "robot.kind", "tables of its own"),
    ([("link.type", "mavlink")], "link.type", "on a bus"),
    ([("link.protocol", "cia402")], "link.protocol", "CiA 402"),
    ([("robot.joints.3.name", "panda_joint1")], "robot.joints[3].name", "joint 0"),
    ([("robot.joints.6.can_id", 1)], "robot.joints[6].can_id", "joint 0"),
    ([("robot.joints.2.q_min_rad", 2.9)], "robot.joints[2].q_min_rad", "less than q_max_rad"),
    ([("robot.joints.2.q_min_rad", 2.8973)], "robot.joints[2].q_min_rad", "less than q_max_rad"),
    ([("robot.joints.1.drive", "DM9999")], "robot.joints[1].drive", "[drives.DM9999]"),
    ([("robot.joints.4.tau_max_Nm", 15.0)], "robot.joints[4].tau_max_Nm", "t_max = 14"),
    ([("robot.joints.0.qd_max_rad_s", 11.0)], "robot.joints[0].qd_max_rad_s", "v_max = 10"),
    ([("drives.PANDA87.p_max_rad", 2.5)], "robot.joints[0].q_min_rad", "p_max"),
    ([("robot.home_rad", [0.0] * 6)], "robot.home_rad", "7 joints"),
    ([("robot.home_rad.3", 0.0)], "robot.home_rad[3]", "within the limits"),
    ([("robot.home_rad.3", -0.1)], "robot.home_rad[3]", "limit zone"),
    ([("robot.home_rad.5", 3.6)], "robot.home_rad[5]", "limit zone"),
    ([("motion.posture", {"q_rest_rad": [0.0] * 8})], "motion.posture.q_rest_rad", "7 joints"),
    ([("motion.posture", {"q_rest_rad": [0.0, -0.785, 2.8, -2.356, 0.0, 1.571, 0.785]})],
     "motion.posture.q_rest_rad[2]", "limit zone"),
    ([("loop.model_hz", 2000)], "loop.model_hz", "servo_hz"),
    ([("safety.watchdog_ms", 3.0), ("safety.stale_stop_ms", 2.9)], "safety.watchdog_ms", "3 servo periods"),
    ([("loop.servo_hz", 25), ("loop.model_hz", 25)], "safety.watchdog_ms", "3 servo periods"),
    ([("safety.stale_hold_ms", 1.5)], "safety.stale_hold_ms", "2 servo periods"),
    ([("safety.stale_hold_ms", 10.0)], "safety.stale_hold_ms", "less than stale_stop_ms"),
    ([("safety.stale_stop_ms", 30.0)], "safety.stale_stop_ms", "watchdog_ms"),
    ([("obstacle", [BOX, {**BOX, "name": "b"}]), ("avoid.obstacles_max", 1)], "avoid.obstacles_max", "least the 2"),
    ([("avoid.clearance_m", 0.1)], "avoid.clearance_m", "influence_m"),
    ([("avoid.self_clearance_m", 0.05)], "avoid.self_clearance_m", "self_influence_m"),
    ([("avoid.joint_clearance_rad", 0.2)], "avoid.joint_clearance_rad", "joint_influence_rad"),
    ([*SLOW, ("avoid.clearance_m", 0.005)], "avoid.clearance_m", "rho_num"),
    ([*SLOW, ("avoid.self_clearance_m", 0.005)], "avoid.self_clearance_m", "rho_num"),
    ([*SLOW, ("avoid.self_clearance_m", 0.02), ("avoid.self_influence_m", 0.06), ("avoid.joint_clearance_rad", 0.01)],
     "avoid.joint_clearance_rad", "rho_num"),
    ([("avoid.joint_influence_rad", 1.0), ("robot.joints.0.q_max_rad", 0.5), ("robot.joints.0.q_min_rad", -0.5)],
     "avoid.joint_influence_rad", "half the range"),
    ([("motion.a_max_m_s2", 1.0)], "avoid.influence_m", "v_max^2/(2 a_max)"),
    ([("motion.v_max_m_s", 2.0)], "avoid.influence_m", "v_max^2/(2 a_max)"),
    ([("link.fd", False)], "link.fd", "12-byte"),
    ([("link.data_bitrate", ...)], "link.data_bitrate", "data phase"),
    ([("link.data_bitrate", 500_000)], "link.data_bitrate", "bitrate"),
    ([("link.fd", False), ("link.protocol", "mit")], "link.data_bitrate", "no data phase"),
    ([("link.fd", False), ("link.protocol", "mit"), ("link.data_bitrate", ...)], "loop.servo_hz", "189 %"),
    ([("link.data_bitrate", 5_000_000)], "loop.servo_hz", "90 %"),
    ([("robot.base_pose", {"rpy_rad": [0.0] * 3, "wxyz": [1.0, 0.0, 0.0, 0.0]})], "robot.base_pose.wxyz", "rpy_rad"),
    ([("robot.base_pose", {"wxyz": [1.0, 1.0, 0.0, 0.0]})], "robot.base_pose.wxyz", "length 1"),
    ([("obstacle", [BOX, BOX])], "obstacle[1].name", "not used before"),
    ([("obstacle", [{**BOX, "velocity_m_s": [0.1, 0.0, 0.0]}])], "obstacle[0].name", "scenario"),
    ([("obstacle", [{**BOX, "appears_s": 1.0}])], "obstacle[0].name", "scenario"),
    ([("obstacle", [{"name": "a", "type": "point"}])], "obstacle[0].position_m", "position_m or waypoints"),
]
URDF = [  # refused once the URDF is read
    ([("robot.urdf", "absent.urdf")], "robot.urdf", "a URDF file"),
    ([("robot.urdf", "package://absent/robot.urdf")], "robot.urdf", "package absent"),
    ([("robot.urdf", "package://example-robot-data/robots/absent.urdf")], "robot.urdf", "file of that package"),
    ([("robot.urdf", "panda.toml")], "robot.urdf", "a URDF"),
    ([("robot.joints.2.name", "panda_joint33")], "robot.joints[2].name", "panda_joint3"),
    ([("robot.tip_frame", "panda_tcp")], "robot.tip_frame", "panda_hand_tcp"),
    ([("robot.joints.1.q_max_rad", 2.0)], "robot.joints[1].q_max_rad", "URDF's limit"),
    ([("robot.joints.1.q_min_rad", -2.0)], "robot.joints[1].q_min_rad", "URDF's limit"),
    ([("robot.joints.1.tau_max_Nm", 89.0)], "robot.joints[1].tau_max_Nm", "URDF's limit"),
    ([("robot.joints.1.qd_max_rad_s", 3.0)], "robot.joints[1].qd_max_rad_s", "URDF's limit"),
    ([("robot.joints.3.tau_max_Nm", 20.0)], "robot.joints[3].tau_max_Nm", "at home"),
    ([("robot.joints.1.tau_max_Nm", 40.0)], "robot.joints[1].tau_max_Nm", "within the limits"),
    ([("avoid.points", [{"link": "panda_elbow", "position_m": [0.0, 0.0, 0.0], "radius_m": 0.1}])],
     "avoid.points[0].link", "panda_link4"),
    ([("avoid.points", [{"link": "panda_link0", "position_m": [0.0, 0.0, 0.0], "radius_m": 0.1}])],
     "avoid.points[0].link", "panda_link4"),
    ([("obstacle", [{"name": "ball", "type": "sphere", "radius_m": 0.05, "position_m": TIP_AT_HOME}])],
     "obstacle[0].position_m", "clear of the arm"),
]
# fmt: on


def names(cases: list[Any]) -> list[str]:
    """Return readable test names."""
    return [f"{case[1]}-{case[2].replace(' ', '_')}" for case in cases]


@pytest.fixture(scope="module")
def panda() -> Robot:
    return design.build(design.load(PANDA), PANDA)


@pytest.mark.parametrize(("edits", "place", "reason"), FILE, ids=names(FILE))
def test_a_contradiction_within_the_file_is_refused(
    edits: list[tuple[str, Any]], place: str, reason: str, tmp_path: Path
) -> None:
    file = write(tmp_path / "panda.toml", edited(*edits))
    with pytest.raises(ConfigError) as caught:
        design.load(file)
    assert (caught.value.place, caught.value.exit_code) == (f"{file}: {place}", 78)
    assert reason in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("edits", "place", "reason"), URDF, ids=names(URDF))
def test_a_contradiction_with_the_urdf_is_refused(
    edits: list[tuple[str, Any]], place: str, reason: str, tmp_path: Path
) -> None:
    file = write(tmp_path / "panda.toml", edited(*edits))
    loaded = design.load(file)
    with pytest.raises(ConfigError) as caught:
        design.build(loaded, file)
    assert (caught.value.place, caught.value.exit_code) == (f"{file}: {place}", 78)
    assert reason in str(caught.value)
    assert "\n" not in str(caught.value)


def test_the_shipped_panda_is_accepted_and_its_figures_are_the_published_ones(panda: Robot) -> None:
    assert panda.n == 7
    assert panda.avoid.eta == pytest.approx(1.56e-4, rel=2e-3)
    rows = {row.name: row for row in design.check(design.load(PANDA), panda).rows}
    assert rows["obstacle push at clearance"].value == pytest.approx(15.6, rel=2e-3)
    assert rows["bus load"].value == pytest.approx(74.4, abs=0.05)
    assert rows["deceleration ramp"].value == pytest.approx(0.0707, rel=1e-3)
    assert rows["gravity at panda_joint1"].value == pytest.approx(0.0, abs=1e-9)  # its axis is vertical
    assert [row.name for row in rows.values() if row.verdict == "warn"] == ["servo period"]


def test_eta_spends_the_speed_of_a_unit_mass_at_the_clearance(panda: Robot) -> None:
    for f in (panda.avoid, panda.self_avoid):
        rho = np.linspace(f.rho_min, f.rho0, 200_001)
        push = f.eta * (1.0 / rho - 1.0 / f.rho0) / rho**2
        work = float(((push[1:] + push[:-1]) / 2.0 * np.diff(rho)).sum())
        assert work == pytest.approx(0.5 * panda.motion.v_max**2, rel=1e-6)


def test_no_posture_reaches_beyond_the_reach(panda: Robot) -> None:
    rng = np.random.default_rng(1)
    for q in rng.uniform(panda.q_min, panda.q_max, (300, 7)):
        x = panda.body.evaluate(q, np.zeros(7), panda.points).x
        assert np.linalg.norm(x - panda.base) < panda.reach


def test_the_base_pose_moves_the_arm_and_what_it_reaches(panda: Robot, tmp_path: Path) -> None:
    moved = edited(("robot.base_pose", {"position_m": [1.0, 2.0, 3.0], "rpy_rad": [0.0, 0.0, np.pi / 2]}))
    moved["robot"]["urdf"] = TABLE["robot"]["urdf"]
    file = write(tmp_path / "panda.toml", moved)
    robot = design.build(design.load(file), file)
    here = panda.body.evaluate(panda.home, np.zeros(7), panda.points).x
    there = robot.body.evaluate(robot.home, np.zeros(7), robot.points).x
    assert there == pytest.approx([1.0 - here[1], 2.0 + here[0], 3.0 + here[2]], abs=1e-9)
    assert robot.reach == pytest.approx(panda.reach)


def test_the_paper_s_rates_are_accepted(tmp_path: Path) -> None:
    slow = edited(
        ("loop.servo_hz", 225),
        ("loop.model_hz", 100),
        ("safety.watchdog_ms", 60.0),
        ("safety.stale_hold_ms", 13.4),
        ("safety.stale_stop_ms", 45.0),
    )
    file = write(tmp_path / "panda.toml", slow)
    robot = design.build(design.load(file), file)
    assert (robot.safety.stale_periods, robot.safety.lost_periods) == (3, 10)
    assert robot.model_dt / robot.dt == pytest.approx(2.25)


def test_given_points_replace_the_automatic_ones_and_self_collision_can_be_switched_off(tmp_path: Path) -> None:
    given = [{"link": "panda_link4", "position_m": [0.0, 0.0, 0.0], "radius_m": 0.1}]
    file = write(tmp_path / "panda.toml", edited(("avoid.points", given), ("avoid.self_collision", False)))
    loaded = design.load(file)
    robot = design.build(loaded, file)
    assert robot.points.names == ("panda_link4",)
    assert len(robot.own.pairs) == 0
    warned = {row.name for row in design.check(loaded, robot).rows if row.verdict == "warn"}
    assert {"points cover", "self-collision pairs"} <= warned


def test_links_that_protrude_from_their_automatic_points_beyond_the_clearance_are_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    few = [("panda_link4", np.zeros(3), 0.05)]
    monkeypatch.setattr(points, "place", lambda body, *_: points.given(body, few))
    with pytest.raises(ConfigError, match=r"avoid\.clearance_m: got 0\.02, wanted more than the .* protrude"):
        design.build(design.load(PANDA), PANDA)


def test_the_report_is_a_table_and_json(panda: Robot) -> None:
    report = design.check(design.load(PANDA), panda)
    text = report.render()
    for row in report.as_dict()["rows"]:
        assert row["name"] in text
        assert np.isfinite(row["value"])
    assert max(map(len, text.splitlines())) <= 120

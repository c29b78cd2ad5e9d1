"""`rtctl init`: what it makes of a description moves, weighs and fills space as the description says, and works."""

import math
import tomllib
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from scipy.spatial import ConvexHull

from rtctl import design
from rtctl.cli import main
from rtctl.errors import EXIT_OK, EXIT_USAGE, UsageError
from rtctl.intake import drives
from rtctl.intake.body import Asked, Joint
from rtctl.intake.make import Made, make
from rtctl.intake.shapes import CORNERS_MAX, hull
from rtctl.intake.sources import IntakeError, Source, find, index, urdf_text

WHOLE = Asked()
INERTIAL = (
    '<inertial><origin xyz="0 0 0.1"/><mass value="{m}"/>'
    '<inertia ixx="0.004" iyy="0.004" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial>'
)
SHAPE = '<{kind}><origin xyz="0 0 0.1"/><geometry><box size="0.06 0.06 0.2"/></geometry></{kind}>'


def link(name: str, mass: float = 1.0, kind: str = "collision") -> str:
    return f'<link name="{name}">{INERTIAL.format(m=mass)}{SHAPE.format(kind=kind)}</link>'


def joint(
    name: str, parent: str, child: str, axis: str, more: str = "", kind: str = "revolute", at: str = "0 0 0.22"
) -> str:
    limit = "" if kind == "fixed" else '<limit lower="-2.2" upper="2.3" effort="60" velocity="3"/>'
    return (
        f'<joint name="{name}" type="{kind}"><origin xyz="{at}" rpy="0.1 0 0.2"/><parent link="{parent}"/>'
        f'<child link="{child}"/><axis xyz="{axis}"/>{limit}{more}</joint>'
    )


def two_armed() -> str:
    """Return a robot with a torso that lifts, a head, two arms of four joints with fingers, one of them coupled."""
    parts = [link("base", 20.0), link("torso", 10.0), joint("lift", "base", "torso", "0 0 1", kind="prismatic")]
    parts += [link("head"), joint("head_pan", "torso", "head", "0 0 1", at="0 0 0.6")]
    for side, y in (("left", 0.35), ("right", -0.35)):
        chain = ["torso", *(f"{side}_{k}" for k in range(4))]
        for k, axis in enumerate(("0 0 1", "0 1 0", "0 1 0", "1 0 0")):
            at = f"0.1 {y} 0.3" if k == 0 else "0 0 0.22"
            parts += [link(chain[k + 1]), joint(f"{side}_joint_{k}", chain[k], chain[k + 1], axis, at=at)]
        for k in range(2):
            coupled = f'<mimic joint="{side}_finger_0"/>' if k else ""
            parts.append(link(f"{side}_finger_link_{k}", 0.05))
            parts.append(joint(f"{side}_finger_{k}", chain[4], f"{side}_finger_link_{k}", "0 1 0", coupled))
        parts += [
            f'<link name="{side}_tool"/>',
            joint(f"{side}_tool_fixed", chain[4], f"{side}_tool", "1 0 0", kind="fixed"),
        ]
    return f'<robot name="two">{"".join(parts)}</robot>'


def made(
    folder: Path, text: str, asked: Asked = WHOLE, name: str = "arm", suffix: str = ".urdf", **how: object
) -> Made:
    path = folder / f"source{suffix}"
    path.write_text(text)
    source = Source(path, name, path.name, suffix == ".xml")
    return make(source, folder, name, asked, **how)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def left(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Made]:
    folder = tmp_path_factory.mktemp("left")
    return folder, made(folder, two_armed(), Asked(side="left", lock={"lift": 0.2}))


def tip_of(urdf: Path, tip: str, q: dict[str, float]) -> tuple[np.ndarray, np.ndarray]:
    """Return where a frame is and what gravity asks of the joints, by Pinocchio on a file."""
    model = pin.buildModelFromUrdf(str(urdf))
    data, full = model.createData(), pin.neutral(model)
    for name, value in q.items():
        full[model.idx_qs[model.getJointId(name)]] = value
    pin.framesForwardKinematics(model, data, full)
    g = pin.computeGeneralizedGravity(model, data, full)
    at = [g[model.idx_vs[model.getJointId(name)]] for name in q if name != "lift"]
    return data.oMf[model.getFrameId(tip)].homogeneous.copy(), np.array(at)


def test_one_arm_of_two_moves_and_weighs_as_in_the_whole_robot(left: tuple[Path, Made]) -> None:
    folder, arm = left
    joints = [j["name"] for j in tomllib.loads(arm.config.read_text())["robot"]["joints"]]
    assert joints == [f"left_joint_{k}" for k in range(4)]
    rng = np.random.default_rng(0)
    for q in rng.uniform(-2.0, 2.0, (8, 4)):
        mine = dict(zip(joints, q, strict=True))
        there, g_there = tip_of(folder / "source.urdf", "left_tool", {**mine, "lift": 0.2})
        here, g_here = tip_of(arm.urdf, "left_tool", mine)
        np.testing.assert_allclose(here, there, atol=1e-8)
        np.testing.assert_allclose(g_here, g_there, atol=1e-6)


def test_what_was_locked_and_assumed_is_told_and_stands_in_the_file(left: tuple[Path, Made]) -> None:
    _, arm = left
    told = "; ".join(arm.told)
    assert "lift at 0.2" in told
    assert "mimic joints are locked: left_finger_1, right_finger_1" in told
    assert "the tip is left_tool" in told
    text = arm.config.read_text()
    assert all(line in text for line in arm.told)
    assert "lift = 0.2" in text


def test_its_files_are_accepted(left: tuple[Path, Made]) -> None:
    _, arm = left
    config = design.load(arm.config)
    report = design.check(config, design.build(config, arm.config))
    assert "bus load" in report.render()
    assert arm.scenario is not None
    assert "ball" in arm.scenario.read_text()


def test_where_several_arms_are_one_must_be_chosen(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"--tip: got nothing, wanted .*left_joint_3.*right_joint_3.*--side"):
        made(tmp_path, two_armed())
    with pytest.raises(UsageError, match=r"--tip: got left_tol, wanted left_tool \(the nearest valid name\)"):
        made(tmp_path, two_armed(), Asked(tip="left_tol"))
    with pytest.raises(UsageError, match=r"--lock: got lifft, wanted lift"):
        made(tmp_path, two_armed(), Asked(side="left", lock={"lifft": 0.0}))


def test_links_that_are_left_out_weigh_nothing(tmp_path: Path) -> None:
    arm = made(tmp_path, two_armed(), Asked(side="left", exclude=("left_finger_link_0", "left_finger_link_1")))
    assert pin.buildModelFromUrdf(str(arm.urdf)).inertias[4].mass == pytest.approx(1.0)
    assert "finger" not in arm.urdf.read_text()


def chain_of(*parts: str, first: str = "0 0 1") -> str:
    body = [link("base"), link("a"), link("b"), *parts]
    body += [joint("j0", "base", "a", first), joint("j1", "a", "b", "0 1 0"), joint("j2", "b", "c", "0 1 0")]
    return f'<robot name="r">{"".join(body)}</robot>'


@pytest.mark.parametrize(
    ("text", "refusal", "told"),
    [
        (chain_of(link("c", 0.0)), "j2: its link has a mass of 0 kg", "repaired to a solid body"),
        (
            chain_of(link("c")).replace('izz="0.001"', 'izz="0.1"'),
            "j0: its link has moments 0.004, 0.004, 0.1 kg m2: one more than the others together",
            "repaired to a solid body of 1 kg",
        ),
        (
            chain_of(link("c")).replace('effort="60"', 'effort="2"'),
            "j1: its effort: got 2 Nm, wanted more than gravity's",
            "2 Nm do not carry the arm",
        ),
    ],
    ids=["no mass", "impossible moments", "too weak"],
)
def test_what_cannot_be_is_refused_or_repaired_where_that_is_asked_for(
    text: str, refusal: str, told: str, tmp_path: Path
) -> None:
    with pytest.raises(IntakeError) as caught:
        made(tmp_path, text)
    assert refusal in str(caught.value)
    assert "--repair" in str(caught.value)
    arm = made(tmp_path, text, repair=True)
    assert told in "; ".join(arm.told)
    design.load(arm.config)


def test_torques_that_nobody_states_brake_a_joint_that_carries_nothing(tmp_path: Path) -> None:
    arm = made(tmp_path, chain_of(link("c")).replace('effort="60"', 'effort="0"'))  # its first axis is upright
    joints = {j["name"]: j for j in tomllib.loads(arm.config.read_text())["robot"]["joints"]}
    model = pin.buildModelFromUrdf(str(arm.urdf))
    stretched = pin.crba(model, model.createData(), np.array([0.0, math.pi / 2.0, 0.0]))[0, 0]
    assert joints["j0"]["tau_max_Nm"] >= stretched * joints["j0"]["qd_max_rad_s"] / 0.2 > 1.5
    assert "assumed is what carries and brakes the arm: j0" in "; ".join(arm.told)


def test_a_link_that_is_only_seen_is_given_the_hull_of_what_one_sees(tmp_path: Path) -> None:
    arm = made(tmp_path, chain_of(link("c", kind="visual")))
    assert "no collision geometry at j2: hulls of the visual meshes are taken" in arm.told
    geometry = pin.buildGeomFromUrdf(pin.buildModelFromUrdf(str(arm.urdf)), str(arm.urdf), pin.GeometryType.COLLISION)
    assert {int(g.parentJoint) for g in geometry.geometryObjects} == {0, 1, 2, 3}


def test_a_joint_without_end_and_one_without_speed_are_given_bounds_that_are_told(tmp_path: Path) -> None:
    endless = chain_of(link("c")).replace('name="j0" type="revolute"', 'name="j0" type="continuous"')
    arm = made(tmp_path, endless.replace('velocity="3"', 'velocity="0"'))
    joints = tomllib.loads(arm.config.read_text())["robot"]["joints"]
    assert joints[0]["q_max_rad"] == pytest.approx(2 * math.pi, abs=0.01)
    assert "j0 turns without end: its range is ±6.28 rad here" in arm.told
    assert "no speeds are stated for j0, j1, j2: 2 rad/s is assumed" in arm.told


MJCF = """<mujoco><compiler angle="radian"/><worldbody><body name="base"><geom type="box" size=".05 .05 .05"/>
<body name="a" pos="0 0 .1"><joint name="m0" axis="0 0 1" range="-2 2"/>
<inertial pos="0 0 .1" mass="1" diaginertia=".01 .01 .005"/>
<geom type="capsule" fromto="0 0 0 0 0 .2" size=".03"/><body name="b" pos="0 0 .25">
<joint name="m1" axis="0 1 0" range="-2 2"/><inertial pos="0 0 .1" mass="1" diaginertia=".01 .01 .005"/>
<geom type="capsule" fromto="0 0 0 0 0 .2" size=".03"/><body name="c" pos="0 0 .25">
<joint name="m2" axis="0 1 0" range="-2 2"/><inertial pos="0 0 .1" mass=".5" diaginertia=".005 .005 .002"/>
<geom type="capsule" fromto="0 0 0 0 0 .2" size=".03"/></body></body></body></body></worldbody>
<actuator><motor joint="m0" ctrlrange="-9 9"/><motor joint="m1" ctrlrange="-30 30"/>
<motor joint="m2" ctrlrange="-9 9" gear="2"/></actuator>
</mujoco>"""


def test_an_mjcf_arm_keeps_its_lengths_masses_and_the_torques_of_its_motors(tmp_path: Path) -> None:
    arm = made(tmp_path, MJCF, suffix=".xml")
    model = pin.buildModelFromUrdf(str(arm.urdf))
    assert [model.inertias[k].mass for k in (1, 2, 3)] == pytest.approx([1.0, 1.0, 0.5])
    assert np.linalg.norm(model.jointPlacements[3].translation) == pytest.approx(0.25)
    assert model.effortLimit.tolist() == pytest.approx([9.0, 30.0, 18.0])
    design.load(arm.config)


def test_xacro_is_expanded(tmp_path: Path) -> None:
    text = chain_of(link("c")).replace("<robot ", '<robot xmlns:xacro="http://www.ros.org/wiki/xacro" ')
    text = text.replace('mass value="1.0"', 'mass value="${0.5 + 0.25}"')
    arm = made(tmp_path, text, suffix=".urdf.xacro")
    assert pin.buildModelFromUrdf(str(arm.urdf)).inertias[1].mass == pytest.approx(0.75)


def test_a_description_in_millimetres_is_scaled(tmp_path: Path) -> None:
    text = chain_of(link("c")).replace("0 0 0.22", "0 0 220").replace("0.06 0.06 0.2", "60 60 200")
    arm = made(tmp_path, text.replace('xyz="0 0 0.1"', 'xyz="0 0 100"'), Asked(scale=1e-3), repair=True)
    model = pin.buildModelFromUrdf(str(arm.urdf))
    assert np.linalg.norm(model.jointPlacements[2].translation) == pytest.approx(0.22)


def test_a_hull_with_fewer_corners_contains_the_one_it_stands_for() -> None:
    points = np.random.default_rng(0).normal(size=(4000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    points *= (0.1, 0.05, 0.2)
    corners, faces = hull(points)
    planes = ConvexHull(corners).equations
    assert len(corners) <= CORNERS_MAX
    assert (points @ planes[:, :3].T + planes[:, 3]).max() <= 1e-6
    normals = np.cross(corners[faces[:, 1]] - corners[faces[:, 0]], corners[faces[:, 2]] - corners[faces[:, 0]])
    assert (np.einsum("ij,ij->i", normals, corners[faces].mean(axis=1)) > 0.0).all()  # outward: the middle is inside


# -- drives and names ------------------------------------------------------------------------------------------------


def test_drives_of_the_shipped_table_bound_torque_and_speed() -> None:
    joints = [Joint(f"j{k}", -1.0, 1.0, 20.0, 54.0, 0.0) for k in range(2)]
    first, second = drives.chosen(drives.parse("damiao:8009,DM4310", 2), joints)
    assert (first.name, first.peak, first.table) == ("DM8009", 40.0, None)
    assert (second.name, second.peak, second.armature) == ("DM4310", 7.0, 0.0018)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("damiao:8008,4310", r"--drives: got DM8008, wanted DM800"),
        ("damiao:8009", "--drives: got 1 drives, wanted 2"),
        ("maxon:ec45", "--drives: got maxon:ec45, wanted virtual, or damiao:TYPE"),
    ],
)
def test_drives_that_nobody_knows_are_refused(text: str, why: str) -> None:
    with pytest.raises(UsageError, match=why):
        drives.parse(text, 2)


def test_a_robot_is_found_by_name_and_a_wrong_name_by_the_nearest() -> None:
    assert find("ur5").path.name == "ur5_robot.urdf"
    assert find("example-robot-data:panda").origin.startswith("example-robot-data: panda")
    assert len(index()) > 50
    with pytest.raises(UsageError, match=r"ROBOT: got 'so110', wanted a file, or so1\d\d \(the nearest valid name\)"):
        find("so110")


def test_a_xacro_whose_package_is_missing_is_refused_in_one_sentence(tmp_path: Path) -> None:
    arm = tmp_path / "arm.urdf.xacro"
    arm.write_text(
        '<robot name="arm" xmlns:xacro="http://www.ros.org/wiki/xacro">'
        '<xacro:include filename="$(find no_such_support)/urdf/macro.xacro"/></robot>'
    )
    with pytest.raises(IntakeError) as told:
        urdf_text(arm)
    assert str(told.value) == "arm.urdf.xacro: got $(find no_such_support), wanted a folder of that name above the file"


def test_the_command_writes_checks_and_says_what_comes_next(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "mine.urdf").write_text(chain_of(link("c")))
    words = ["init", str(tmp_path / "mine.urdf"), "--out", str(tmp_path)]
    assert main(words) == EXIT_OK
    out = capsys.readouterr().out
    assert "3 joints, from mine.urdf; rtctl check accepts it" in out
    assert ("next: rtctl sim" in out) == (tmp_path / "mine_first.toml").exists()
    assert main(words) == EXIT_USAGE
    assert "wanted --force" in capsys.readouterr().err

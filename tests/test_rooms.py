"""Influence and clearance of an obstacle's own: the field, the guards, ways and postures take them, and every door."""

import json
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from firmware_sim.settings import load as load_settings
from firmware_sim.shapes import shape_at, solid
from rtctl import design as cfg
from rtctl.app.arm import rooms
from rtctl.app.postures import endings, site_of
from rtctl.app.replay import replay
from rtctl.arm.field import MovingPoints, field, field_buffers, field_params
from rtctl.arm.kinematics import clearance_of
from rtctl.control.firas import put_room, rooms_of
from rtctl.errors import ConfigError
from rtctl.log import read_run
from rtctl.log.record.checkpoint import decode_checkpoint, encode_checkpoint
from rtctl.log.record.requests import decode_request, encode_request
from rtctl.spec.base import load as load_base
from rtctl.spec.obstacles import shape_of
from rtctl.spec.read import convert
from rtctl.spec.scenario import Scenario, parse_obstacle
from rtctl.types import F64, Goal, ObstacleEdit, Request, Shape, Task
from rtctl.world.obstacle_table import edited, empty
from rtctl.world.primitives import obstacles_empty, with_shape
from rtctl.world.rooms import NONE, Rooms, counted, farthest, fault_of_room, room_of
from tests.arms import PANDA_HOME
from tests.lab import PANDA, ROOT, Run, at_rest, lab, play, recorded, robot, same, sphere
from tests.test_forms import scenes

ALL = Rooms(0.1, 0.02, 1e-3)


def own(shape: Shape, influence: float = 0.0, clearance: float = 0.0) -> Shape:
    return shape._replace(influence=influence, clearance=clearance)


# ---- numbers


@pytest.mark.parametrize(
    ("influence", "clearance"), [(0.2, 0.06), (0.05, 0.008), (0.1, 0.02), (0.4, 0.3), (0.02, 0.01)]
)
def test_the_numbers_of_an_obstacle_are_those_of_a_config_with_them(influence: float, clearance: float):
    a = robot().avoid
    wanted = field_params(a.v_max, influence, clearance, a.dt, a.damping_ratio, a.look_ahead, a.m_max)
    row = np.zeros((1, 6))
    put_room(a, influence, clearance, row, 0)
    np.testing.assert_allclose(row[0, :5], wanted[:5], rtol=1e-12)
    assert row[0, 5] == pytest.approx(max(clearance - robot().coverage.overhang, 0.0))
    put_room(a, 0.0, 0.0, row, 0)
    assert tuple(row[0]) == (*a[:5], 0.0)


def test_what_counts_a_distance_keeps_touching_clearance_and_influence_in_their_places():
    room = room_of(0.2, 0.06, ALL)[None]
    assert [counted(x, room, 0) for x in (-0.01, 0.0, 0.06, 0.2)] == pytest.approx([-0.01, 0.0, 0.02, 0.1])
    rho = np.linspace(-0.1, 1.0, 400)
    counts = np.array([counted(float(x), room, 0) for x in rho])
    assert (np.diff(counts) > 0.0).all()
    active = np.ones(1, np.bool_)
    for reach in (0.005, 0.02, 0.05, 0.1, 0.7):
        far = farthest(room, active, reach)
        assert counted(far, room, 0) == pytest.approx(reach) or far == reach
        assert (counts[rho > far + 1e-9] >= reach).all()  # what is beyond it counts as no less
    assert farthest(np.zeros((1, 4)), active, 0.3) == 0.3
    assert farthest(room, ~active, 0.05) == 0.05


# ---- refusals


@pytest.mark.parametrize(
    ("influence", "clearance", "key", "wanted"),
    [
        (0.2, 0.2, "clearance_m", "less than influence_m = 0.2"),
        (0.0, 0.15, "clearance_m", "less than influence_m = 0.1"),
        (0.015, 0.0, "influence_m", "more than clearance_m = 0.02"),
        (0.2, 0.0009, "clearance_m", "0.001 to 0.5"),
        (2.0, 0.0, "influence_m", "0.005 to 1"),
        (0.1, 0.001, "clearance_m", "above it: rho_num = "),
        (0.0202, 0.0, "influence_m", "clearance_m = 0.02 is above: rho_num = "),
    ],
)
def test_numbers_that_cannot_be_are_refused(influence: float, clearance: float, key: str, wanted: str):
    found = fault_of_room(influence, clearance, ALL)
    assert found is not None
    assert found[0] == key
    assert found[1] == (influence if key == "influence_m" else clearance)
    assert wanted in found[2]
    table, refusal = edited(
        empty(2, of_all=ALL), (ObstacleEdit("b", own(sphere("b", [1, 0, 0], 0.1), influence, clearance)),)
    )
    assert refusal == f"obstacle b: {key}: got {found[1]:g}, wanted {found[2]}"
    assert not table.obstacles.active.any()


def test_rho_num_is_where_the_bound_lies():
    """The config's own rule, by `field_params`: what it refuses is refused, and nothing else."""
    a, of_all = robot().avoid, rooms_of(robot().avoid)
    rng, refused = np.random.default_rng(0), 0
    for _ in range(300):
        i = float(rng.uniform(0.01, 0.2))
        c = float(rng.uniform(0.001, i))
        try:
            field_params(a.v_max, i, c, a.dt, 1.0, 0.1, 50.0)
            fine = True
        except ValueError:
            fine = False
        assert (fault_of_room(i, c, of_all) is None) == fine
        refused += not fine
    assert 3 < refused < 150


def test_a_config_and_a_scenario_name_the_place(tmp_path: Path):
    ball = '[[obstacle]]\nname = "b"\ntype = "sphere"\nradius_m = 0.05\nposition_m = [0.7, 0.4, 0.6]\n'
    path = tmp_path / "panda.toml"
    for keys, place in (
        ("clearance_m = 0.15", "clearance_m: got 0.15, wanted less than influence_m = 0.1"),
        ("influence_m = 0.01", "influence_m: got 0.01, wanted more than clearance_m = 0.02"),
        ("influence_m = 0.05\nclearance_m = 0.06", "clearance_m: got 0.06, wanted less than influence_m = 0.05"),
        ("influence_m = 2.0", "influence_m: got 2.0, wanted"),
    ):
        path.write_text(f"{PANDA.read_text()}\n{ball}{keys}\n")
        with pytest.raises(ConfigError, match=rf"obstacle\[0\].{place}"):
            cfg.build(cfg.load(path), path)
    path.write_text(f"{PANDA.read_text()}\n{ball}influence_m = 0.2\nclearance_m = 0.06\n")
    arm = cfg.build(cfg.load(path), path)
    assert (arm.obstacles[0].influence, arm.obstacles[0].clearance) == (0.2, 0.06)
    assert rooms(at_rest(arm, PANDA_HOME)) == {"b": [0.2, 0.06]}


def test_a_base_has_one_influence_for_all(tmp_path: Path):
    path = tmp_path / "rover.toml"
    ball = (
        '[[obstacle]]\nname = "b"\ntype = "sphere"\nradius_m = 0.5\nposition_m = [9.0, 9.0, 0.3]\nclearance_m = 0.3\n'
    )
    path.write_text((ROOT / "configs" / "rover.toml").read_text() + "\n" + ball)
    with pytest.raises(ConfigError, match=r"obstacle\[0\].clearance_m.*an arm alone"):
        load_base(path)
    assert fault_of_room(0.0, 0.3, NONE) is not None


# ---- doors


def test_they_come_through_console_log_and_camera():
    told = {
        "name": "b",
        "type": "sphere",
        "radius_m": 0.1,
        "position_m": [0.5, 0, 0.5],
        "influence_m": 0.2,
        "clearance_m": 0.06,
    }
    shape = shape_of(parse_obstacle(told, "obstacle"))
    assert (shape.influence, shape.clearance) == (0.2, 0.06)
    asked = Request(obstacles=(ObstacleEdit("b", shape, 0.1),))
    assert same(decode_request(encode_request(7, asked))[1], asked)
    plain = encode_request(7, Request(obstacles=(ObstacleEdit("b", own(shape), 0.1),)))
    assert not {"influence", "clearance"} & set(json.loads(plain)["obstacles"][0]["shape"])  # as before there were such
    seen = shape_at(solid(told, load_settings(PANDA)), 0.0)
    assert seen is not None
    assert (seen.influence, seen.clearance) == (0.2, 0.06)


def test_a_checkpoint_keeps_them():
    m = at_rest(robot(), PANDA_HOME)
    world, refusal = edited(m.world, (ObstacleEdit("b", own(sphere("b", [0.6, 0, 0.6], 0.05), 0.2, 0.06)),))
    assert not refusal
    m = m._replace(world=world)
    back = decode_checkpoint(encode_checkpoint(m, (0,) * 7), robot(), at_rest(robot(), PANDA_HOME)).memory
    assert same(back, m)
    assert rooms(back) == {"b": [0.2, 0.06]}


# ---- the field


def torque(q: F64, qd: F64, shapes: tuple[Shape, ...], params: object = None) -> F64:
    """Return the torque (7,) of the field."""
    arm = robot()
    model, table = arm.body.evaluate(q, np.zeros(7), arm.points), obstacles_empty(3)
    for k, shape in enumerate(shapes):
        table = with_shape(table, k, shape, of_all=rooms_of(arm.avoid))
    points = MovingPoints(model.P, model.Jp, model.B, arm.points.radius, arm.points.link)
    out = field_buffers(3, len(arm.points.radius), 7)
    field(points, np.zeros(7), qd, table, params or arm.avoid, out, True)  # type: ignore[arg-type]
    return out.tau.copy()


def test_its_field_is_that_of_a_config_with_its_numbers_and_leaves_the_others_alone():
    a, rng, acts = robot().avoid, np.random.default_rng(4), 0
    for q, balls in scenes(80, seed=5):
        near, other = (sphere(str(k), ball.centre, ball.radius) for k, ball in enumerate(balls))
        i = float(rng.uniform(0.03, 0.3))
        c = float(rng.uniform(0.2, 0.8)) * i
        qd = 0.3 * rng.normal(size=7)
        alone = field_params(a.v_max, i, c, a.dt, a.damping_ratio, a.look_ahead, a.m_max)
        wanted = torque(q, qd, (near,), alone) + torque(q, qd, (other,))
        got = torque(q, qd, (own(near, i, c), other))
        np.testing.assert_allclose(got, wanted, rtol=1e-9, atol=1e-9 * (1.0 + np.abs(wanted).max()))
        acts += bool(np.abs(torque(q, qd, (near,), alone)).max() > 1.0)
    assert acts > 50


# ---- ways and postures


def points_from(q: F64, ball: Shape) -> float:
    """Return the least distance [m] of the arm's points from a ball, by hand."""
    arm = robot()
    P = arm.body.evaluate(q, np.zeros(7), arm.points).P
    return float((np.linalg.norm(P - ball.position, axis=1) - arm.points.radius - ball.dims[0]).min())


def test_postures_and_clearances_count_it():
    arm = robot()
    ball = sphere("b", [0.45, 0.1, 0.35], 0.06)
    for i, c in ((0.0, 0.0), (0.2, 0.06), (0.05, 0.008)):
        table = with_shape(obstacles_empty(1), 0, own(ball, i, c), of_all=rooms_of(arm.avoid))
        site = site_of(arm, table, PANDA_HOME)
        rho = points_from(PANDA_HOME, ball)
        far = clearance_of(site.chain, arm.points, PANDA_HOME[None], site.obstacles)[0]
        influence, clearance = (i, c) if i else (0.1, 0.02)
        assert far == pytest.approx(0.02 + (rho - clearance) * 0.08 / (influence - clearance), abs=1e-9)
        goal = Goal(np.array([0.5, 0.25, 0.4]), np.array([0, 1.0, 0, 0]), Task.POSITION, 0.003, 0.015)
        ends = endings(site, goal, 0)
        assert ends
        for end in ends:
            assert (points_from(end.q, ball) >= clearance - 1e-9) == (end.rho >= 0.02 - 1e-9)
            assert not end.rho >= 0.02 or end.clear


def test_a_planned_way_keeps_it():
    plan = pytest.importorskip("rtctl.app.plan")
    arm, least = robot(), {}
    ball = sphere("b", [0.45, 0.0, 0.45], 0.08)
    start = np.array([0.7, -0.4, 0.0, -2.2, 0.0, 1.8, 0.8])
    goal = Goal(np.array([0.4, -0.4, 0.4]), np.array([0, 1.0, 0, 0]), Task.POSITION, 0.003, 0.015)
    for i, c in ((0.0, 0.0), (0.16, 0.1)):
        table = with_shape(obstacles_empty(1), 0, own(ball, i, c), of_all=rooms_of(arm.avoid))
        site = site_of(arm, table, start)
        path = plan.plan_joints(site, goal, 0)
        fine = np.concatenate([np.linspace(a, b, 40) for a, b in pairwise(path)])
        least[c] = min(points_from(q, ball) for q in fine)
    assert least[0.0] > 0.02
    assert least[0.1] > 0.1


# ---- runs


def between(**keys: float) -> dict[str, Any]:
    """Return a scene in which the hand is asked between two balls, of which one has these keys."""
    ball = {"type": "sphere", "radius_m": 0.06}
    start = [0.0, -0.6, 0.0, -2.4, 0.0, 1.9, 0.8]
    balls = [
        {"name": "ball", **ball, "position_m": [0.62, 0.15, 0.5], **keys},
        {"name": "other", **ball, "position_m": [0.62, -0.15, 0.5]},
    ]
    goal = {"at_s": 0.3, "position_m": [0.62, 0.0, 0.48]}
    return {"duration_s": 3.0, "start_q_rad": start, "goal": [goal], "obstacle": balls}


def pressed(**keys: float) -> dict[str, Any]:
    """Return a scene in which the hand is asked to a goal 1 cm before a ball with these keys."""
    scene = between(**keys)
    ball = {**scene["obstacle"][0], "position_m": [0.62, 0.0, 0.5]}
    return {**scene, "obstacle": [ball], "goal": [{"at_s": 0.3, "position_m": [0.55, 0.0, 0.48]}]}


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The Panda by the law alone."""
    path = Path(tmp_path_factory.mktemp("rooms")) / "panda.toml"
    path.write_text(
        PANDA.read_text().replace("[avoid]\n", '[avoid]\nescape = false\nplan = "never"\nposture = "never"\n')
    )
    return path


WIDE: list[dict[str, float]] = [{"clearance_m": 0.06}, {"influence_m": 0.2, "clearance_m": 0.06}]


def bounded(run: Run) -> None:
    f = run.figures
    assert f["contacts"] == 0
    assert max(f["max_torque_ratio"], f["max_joint_speed_ratio"]) <= 1.0 + 1e-9
    assert f["max_speed_m_s"] <= 1.02 * run.robot.motion.v_max


@pytest.mark.parametrize("keys", WIDE)
def test_the_arm_keeps_the_clearance_of_a_ball_beside_one_with_the_config_s(alone: Path, keys: dict[str, float]):
    """By pybullet: at least the clearance less the overhang by which points stand out of links."""
    plain, wide = play(between(), alone), play(between(**keys), alone)
    least = 0.06 - robot().coverage.overhang
    for run in (plain, wide):
        bounded(run)
    assert wide.figures["min_clearance_m"]["ball"] >= 0.05 > least
    assert wide.record["rho"][:, 0].min() >= least  # of the points, as the guards see them
    assert plain.figures["min_clearance_m"]["ball"] < 0.04
    assert 0.02 < wide.figures["min_clearance_m"]["other"] < 0.04


@pytest.mark.parametrize("keys", WIDE)
def test_an_arm_that_is_pressed_against_it_keeps_it(alone: Path, keys: dict[str, float]):
    wide, plain = play(pressed(**keys), alone), play(pressed(), alone)
    near = play(pressed(influence_m=0.04, clearance_m=0.006), alone)
    for run in (plain, wide, near):
        bounded(run)
    assert wide.figures["min_clearance_m"]["ball"] >= 0.06
    assert 0.03 < plain.figures["min_clearance_m"]["ball"] < 0.05
    assert near.figures["min_clearance_m"]["ball"] < 0.03  # a small one lets it nearer
    assert near.record["rho"].min() > 0.006


def test_a_log_of_it_replays_to_the_bit(tmp_path: Path):
    ball = '[[obstacle]]\nname = "b"\ntype = "sphere"\nradius_m = 0.06\nposition_m = [0.62, 0.05, 0.5]\n'
    goal = "[[goal]]\nat_s = 0.3\nposition_m = [0.55, 0.0, 0.48]\n"
    scene = f'robot = "{PANDA}"\nduration_s = 1.2\n{goal}{ball}influence_m = 0.2\nclearance_m = 0.06\n'
    recorded(tmp_path, scene)
    run = read_run(tmp_path / "run.mcap")
    done = replay(run)
    assert done.ticks > 1000
    assert done.identical


def test_numbers_that_are_the_config_s_change_next_to_nothing(alone: Path):
    """The guards keep nothing more: the clearance is less than the overhang."""
    plain, same_ = play(pressed(), alone), play(pressed(influence_m=0.1, clearance_m=0.02), alone)
    assert np.abs(plain.q - same_.q).max() < 1e-3


def test_the_console_is_told_why(alone: Path):
    with lab(path=alone) as here:
        here.running()
        ball = own(sphere("b", [0.7, 0.3, 0.6], 0.05), 0.1, 0.1)
        here.step(Request(obstacles=(ObstacleEdit("b", ball),)))
        assert here.memory.refusal == "obstacle b: clearance_m: got 0.1, wanted less than influence_m = 0.1"
        here.step(Request(obstacles=(ObstacleEdit("b", ball._replace(influence=0.2)),)))
        assert not here.memory.refusal
        assert rooms(here.memory) == {"b": [0.2, 0.1]}


def test_a_scenario_may_name_them():
    told = {"robot": "panda", "duration_s": 1.0, **pressed(influence_m=0.2, clearance_m=0.06)}
    found = convert(told, Scenario, "scenario").obstacle[0]
    assert (found.influence_m, found.clearance_m) == (0.2, 0.06)

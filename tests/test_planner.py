"""The planner's paths by independent geometry, the stream of sub-goals, and the trap with and without it."""

import json
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import coal
import msgspec
import numpy as np
import pinocchio as pin
import pytest

from rtctl import design as cfg
from rtctl.app import daemon
from rtctl.app.plan import plan
from rtctl.app.stream import REPLANS, ArmStatus, GoalStream
from rtctl.arm.kinematics import chain_of
from rtctl.arm.robot import Robot
from rtctl.arm.search import Speeds, lasts
from rtctl.arm.task import between
from rtctl.cli import main
from rtctl.cli.planning import message_of, obstacles_told
from rtctl.cli.values import goal_messages
from rtctl.design.pairs import hulls_of
from rtctl.errors import PlanError, RequestError
from rtctl.hal.messages import GoalMessage, decode
from rtctl.kernel.rotations import exp3, quat_of
from rtctl.spec.obstacles import shape_of
from rtctl.spec.read import convert
from rtctl.spec.scenario import Scenario, load_scenario, scenario_dict
from rtctl.types import F64, Goal, ObstacleEdit, Shape, Task
from rtctl.world import obstacle_table
from rtctl.world.primitives import distances
from tests.bodies import cloud_shape, ell, known, mesh_shape, torus
from tests.lab import ROOT, changed, play, robot
from tools.stress.certificate import duration

TRAP = ROOT / "configs" / "scenarios" / "trap.toml"
UNIT = np.array([1.0, 0.0, 0.0, 0.0])
EYE = np.eye(3)


def trap(**keys: object) -> dict[str, Any]:
    return {**scenario_dict(load_scenario(TRAP)), **keys}


def to(x: float, y: float, z: float) -> Goal:
    return Goal(np.array([x, y, z]), UNIT, Task.POSITION, 0.003, 0.015)


def test_a_planned_way_is_clear_of_everything_by_coal_and_the_same_for_the_same_seed():
    arm, scenario = robot(), load_scenario(TRAP)
    shapes = tuple(shape_of(o) for o in scenario.obstacle)
    obstacles = obstacle_table.with_static(obstacle_table.empty(arm.slots), shapes).obstacles
    start = np.array(scenario.start_q_rad)
    goals = plan(arm, start, to(0.53, 0.0, 0.22), obstacles, seed=3)
    again = plan(arm, start, to(0.53, 0.0, 0.22), obstacles, seed=3)
    assert [g.position.tobytes() for g in goals] == [g.position.tobytes() for g in again]
    assert goals[-1].task == Task.POSITION
    assert goals[-1].position.tolist() == [0.53, 0.0, 0.22]
    path = np.array([start, *(g.posture for g in goals)])
    model, data = arm.body.model, arm.body.model.createData()
    joints = {link: j for j, link in arm.body.link_of.items()}
    boxes = [(coal.Box(*(2.0 * s.dims[:3])), coal.Transform3s(np.eye(3), s.position)) for s in shapes]
    hulls = [h for h in hulls_of(arm.body) if h.link > 0]
    for a, b in pairwise(path):
        for part in np.linspace(0.0, 1.0, 4):
            q = a + part * (b - a)
            assert ((arm.q_min < q) & (q < arm.q_max)).all()
            pin.forwardKinematics(model, data, q)
            for hull in hulls:
                X = data.oMi[joints[hull.link]]
                at = coal.Transform3s(X.rotation, X.translation)
                for box, pose in boxes:
                    d = coal.distance(hull.shape, at, box, pose, coal.DistanceRequest(), coal.DistanceResult())
                    assert d > arm.avoid.rho_min


def test_an_arm_in_a_plane_is_led_around_along_the_axes_that_it_has():
    file = ROOT / "configs" / "planar4.toml"
    arm = cfg.build(cfg.load(file), file)
    size, at = np.array([0.12, 0.12, 0.2]), np.array([1.28, 0.68, 0.0])
    crate = Shape("crate", "box", np.array([*size, 0.0]), at, UNIT, np.zeros(3), np.zeros(3))
    obstacles = obstacle_table.with_static(obstacle_table.empty(arm.slots), (crate,)).obstacles
    goals = plan(arm, arm.home, to(1.25, 0.35, 0.3), obstacles)  # it moves at the height it has
    assert [g.task for g in goals] == [arm.axes] * (len(goals) - 1) + [Task.X | Task.Y]
    for goal in goals:
        links = np.cumsum(goal.posture)  # four links of 0.5 m
        np.testing.assert_allclose(
            goal.position[:2], 0.5 * np.array([np.cos(links).sum(), np.sin(links).sum()]), atol=2e-4
        )
        P = arm.body.evaluate(goal.posture, np.zeros(4), arm.points).P
        away = np.linalg.norm(np.maximum(np.abs(P - at) - size, 0.0), axis=1) - arm.points.radius
        assert away.min() > arm.avoid.rho_min
        told = message_of(goal)
        assert told["axes"] == ["x", "y"]
        assert ("wxyz" in told) == bool(goal.task & Task.RZ)


@pytest.mark.parametrize("seed", range(3))
def test_a_way_through_a_gap_is_found_whatever_the_seed(seed: int):
    """Between two walls 0.4 m apart goes an arm whose links are 0.1 m thick; judged by coal."""
    file = ROOT / "configs" / "planar4.toml"
    arm = cfg.build(cfg.load(file), file)
    size = np.array([0.25, 1.0, 0.3])
    walls = [
        Shape(f"wall {y}", "box", np.array([*size, 0.0]), np.array([1.0, y, 0.0]), UNIT, np.zeros(3), np.zeros(3))
        for y in (-1.2, 1.2)
    ]
    start = np.array([2.2, 0.5, 0.5, 0.3])  # away from the walls, on their side of the arm's foot
    obstacles = obstacle_table.with_static(obstacle_table.empty(arm.slots), tuple(walls)).obstacles
    goals = plan(arm, start, to(1.7, 0.0, 0.0), obstacles, seed)
    links = np.cumsum(goals[-1].posture)  # four links of 0.5 m
    np.testing.assert_allclose(0.5 * np.array([np.cos(links).sum(), np.sin(links).sum()]), [1.7, 0.0], atol=2e-4)
    model, data = arm.body.model, arm.body.model.createData()
    joints = {link: j for j, link in arm.body.link_of.items()}
    hulls = [h for h in hulls_of(arm.body) if h.link > 0]
    boxes = [(coal.Box(*(2.0 * size)), coal.Transform3s(np.eye(3), w.position)) for w in walls]
    for a, b in pairwise(np.array([start, *(g.posture for g in goals)])):
        for part in np.linspace(0.0, 1.0, 6):
            pin.forwardKinematics(model, data, a + part * (b - a))
            for hull in hulls:
                X = data.oMi[joints[hull.link]]
                at = coal.Transform3s(X.rotation, X.translation)
                for box, pose in boxes:
                    d = coal.distance(hull.shape, at, box, pose, coal.DistanceRequest(), coal.DistanceResult())
                    assert d > 0.8 * arm.avoid.rho_min


def test_an_arm_folded_onto_itself_is_planned_for_from_where_it_is():
    """14 mm between its links, which a dozen planes between them do not show."""
    file = ROOT / "configs" / "planar4.toml"
    arm = cfg.build(cfg.load(file), file)
    folded = np.array([0.851, -1.047, 1.606, 2.551])
    least = float(arm.body.own_distances(folded, arm.own).min())
    assert 0.01 < least < 0.02
    goals = plan(arm, folded, to(1.946, -0.226, 0.0), obstacle_table.empty(arm.slots).obstacles)
    links = np.cumsum(goals[-1].posture)  # four links of 0.5 m
    end = 0.5 * np.array([np.cos(links).sum(), np.sin(links).sum()])
    np.testing.assert_allclose(end, [1.946, -0.226], atol=2e-4)
    for a, b in pairwise(np.array([folded, *(g.posture for g in goals)])):
        for part in np.linspace(0.0, 1.0, 10):
            assert arm.body.own_distances(a + part * (b - a), arm.own).min() >= arm.self_avoid.rho_min


def tip_way(arm: Robot, path: F64) -> float:
    """Return how long [m] the way of the tip is, by Pinocchio."""
    data, frame = arm.body.model.createData(), arm.body.model.getFrameId("panda_hand_tcp")
    tips = []
    for a, b in pairwise(path):
        for part in np.linspace(0.0, 1.0, 20):
            pin.framesForwardKinematics(arm.body.model, data, a + part * (b - a))
            tips.append(data.oMf[frame].translation.copy())
    return float(np.linalg.norm(np.diff(tips, axis=0), axis=1).sum())


SWUNG = np.array([-1.65, 1.32, 0.88, -0.52, -1.92, 3.6, 0.26])  # stretched out to one side


@pytest.mark.parametrize("seed", range(2))
def test_of_the_postures_of_a_goal_and_the_ways_there_a_quick_one_is_taken(seed: int):
    """The tip goes less far than on the straight way of the joints to the posture it ends in; judged by Pinocchio."""
    arm = robot()
    goal = to(-0.245, 0.473, 0.345)
    goals = plan(arm, SWUNG, goal, obstacle_table.empty(arm.slots).obstacles, seed)
    path = np.array([SWUNG, *(g.posture for g in goals)])
    straight = tip_way(arm, path[[0, -1]])
    assert np.linalg.norm(goals[-1].position - goal.position) == 0.0
    assert tip_way(arm, path) < 0.9 * straight


@pytest.mark.parametrize("turned", [False, True])
def test_a_way_is_timed_by_its_slowest_joint_or_the_tip(turned: bool):
    """The certificates of scenes time ways by other code; without corners they say the same, 1 / rate apart."""
    arm, m = robot(), robot().motion
    a = arm.home.copy()
    b = a + (np.array([0, 0, 0, 0, 0, 0, 1.4]) if turned else np.array([0.5, 0.3, 0, 0.4, 0, 0.2, 0]))
    speeds = Speeds(arm.qd_max, m.v_max, m.w_max, 4.0)
    wanted = duration(arm, np.array([a, b])) - m.v_max / m.a_max
    assert lasts(chain_of(arm.body), np.array([a, b]), speeds) == pytest.approx(wanted, rel=5e-3)
    back = lasts(chain_of(arm.body), np.array([a, b, a]), speeds) - 2.0 * wanted
    u = (b - a) / (wanted * arm.qd_max)
    assert back == pytest.approx(0.5 * 2.0 * np.linalg.norm(u) / 4.0, rel=0.1)


def test_an_arm_whose_points_reach_into_a_table_is_led_out_of_it():
    """The balls that stand for its links overlap the table where it starts, the links do not; by coal all along."""
    arm = robot()
    start = np.array([0.0, 0.9, 0.0, -1.9, 0.0, 2.8, 0.785])
    P = arm.body.placed(start, arm.points)
    model, data = arm.body.model, arm.body.model.createData()
    joints = {link: j for j, link in arm.body.link_of.items()}
    hulls = [h for h in hulls_of(arm.body) if h.link > 2]
    size = np.array([0.5, 0.5, 0.02])

    def gap(q: F64, top: float) -> float:
        pin.forwardKinematics(model, data, q)
        slab = coal.Box(*(2.0 * size)), coal.Transform3s(EYE, np.array([0.6, 0.0, top - size[2]]))
        return min(
            coal.distance(
                h.shape,
                coal.Transform3s(data.oMi[joints[h.link]].rotation, data.oMi[joints[h.link]].translation),
                *slab,
                coal.DistanceRequest(),
                coal.DistanceResult(),
            )
            for h in hulls
        )

    top = float((P[:, 2] - arm.points.radius)[arm.points.link > 2].min()) + 0.002
    table = Shape(
        "table", "box", np.array([*size, 0.0]), np.array([0.6, 0.0, top - size[2]]), UNIT, EYE[0] * 0, EYE[0] * 0
    )
    assert gap(start, top) > 0.002
    obstacles = obstacle_table.with_static(obstacle_table.empty(arm.slots), (table,)).obstacles
    goals = plan(arm, start, to(0.45, 0.2, top + 0.3), obstacles)
    path = np.array([start, *(g.posture for g in goals)])
    Q = [a + part * (b - a) for a, b in pairwise(path) for part in np.linspace(0.0, 1.0, 10)]
    gaps = np.array([gap(q, top) for q in Q])
    away = np.abs(np.array(Q) - start).max(axis=1)
    assert gaps.min() > min(0.002, 0.9 * gap(start, top))
    leaves = gap(start, top) - 0.005 + 0.1 * away  # the skin that is measured stands out by 5 mm at most
    assert (gaps >= np.minimum(leaves, arm.avoid.rho_min) - 1e-4).all()
    assert gaps[-1] > arm.avoid.rho_min


def test_a_plan_to_a_direction_ends_in_a_posture_that_points_there():
    arm, aim = robot(), np.array([0.8, 0.6, 0.0])
    turn = quat_of(exp3(between(EYE[0], aim)))
    asked = Goal(np.zeros(3), turn, Task.DIRECTION, 0.003, 0.015, EYE[0])
    q = plan(arm, arm.home, asked, obstacle_table.empty(arm.slots).obstacles)[-1].posture
    data = arm.body.model.createData()
    pin.framesForwardKinematics(arm.body.model, data, q)
    tip = data.oMf[arm.body.model.getFrameId("panda_hand_tcp")]
    np.testing.assert_allclose(tip.rotation[:, 0], aim, atol=2e-3)


def test_the_obstacles_of_a_running_robot_come_over_as_they_are():
    """Distances of the far side's obstacles and of those that were told, to the bit."""
    arm = robot()._replace(meshes=known(other=ell(), torus=torus()))
    ball = Shape("ball", "sphere", np.array([0.1, 0, 0, 0]), EYE[1], UNIT, 0.1 * EYE[0], np.zeros(3))
    edits = (ObstacleEdit("ball", ball, 0.2, True), ObstacleEdit("ring", mesh_shape("torus", 0.4 * EYE[0])))
    table, refusal = obstacle_table.edited(obstacle_table.empty(arm.slots, arm.meshes, creep=0.1), edits)
    assert not refusal
    servo: Any = SimpleNamespace(memory=SimpleNamespace(world=table))

    def told() -> dict[str, Any]:
        reply: dict[str, Any] = json.loads(msgspec.json.encode(daemon.world(servo), enc_hook=lambda a: a.tolist()))
        return reply

    P = np.random.default_rng(0).uniform(-1.0, 1.0, (50, 3))
    rho, _ = distances(P, np.zeros(50), table.obstacles)
    here = arm._replace(meshes=known(torus=torus()))  # at another place among the meshes of this side
    again, _ = distances(P, np.zeros(50), obstacles_told(told(), here))
    np.testing.assert_array_equal(rho[:2], again[:2])
    with pytest.raises(RequestError, match="ring is the mesh torus, which the config does not have"):
        obstacles_told(told(), robot())
    table, _ = obstacle_table.edited(table, (ObstacleEdit("dust", cloud_shape(P, 1e-4, 0.01, EYE[0])),))
    servo.memory.world = table
    with pytest.raises(RequestError, match="dust is a cloud"):
        obstacles_told(told(), here)


def test_the_trap_is_left_by_the_planned_way_without_contact():
    run = play(trap(duration_s=4.4))
    assert run.figures["arrived"]
    assert run.figures["contacts"] == 0
    assert run.figures["min_clearance_m"]["all"] > 0.02
    assert run.figures["max_speed_m_s"] <= 1.02 * run.robot.motion.v_max


def test_the_trap_is_reported_by_a_controller_that_is_left_alone(tmp_path):
    run = play(trap(duration_s=5.4, planner=False), changed(tmp_path, self_collision="true\nescape = false"))
    _, status, detail = run.events[-1]
    assert status == "local_minimum"
    assert {part.partition(" at ")[0] for part in detail.split("; ")} <= {"floor", "near", "far", "left", "right"}
    assert not run.figures["arrived"]
    assert run.figures["contacts"] == 0


def test_what_has_no_way_is_said_so():
    arm = robot()
    nothing = obstacle_table.empty(arm.slots).obstacles
    with pytest.raises(PlanError, match=r"no posture .* has the goal 0.000 0.000 2.000"):
        plan(arm, arm.home, to(0.0, 0.0, 2.0), nothing)
    table = [{"name": "slab", "type": "box", "size_m": (0.3, 0.3, 0.3), "position_m": (0.5, 0.0, 0.2)}]
    shapes = tuple(shape_of(o) for o in load_obstacles(table))
    with pytest.raises(PlanError, match="touches something"):
        plan(
            arm,
            arm.home,
            to(0.5, 0.0, 0.3),
            obstacle_table.with_static(obstacle_table.empty(arm.slots), shapes).obstacles,
        )


def load_obstacles(rows: list[dict[str, Any]]) -> tuple[Any, ...]:
    return convert({"robot": "panda", "duration_s": 1.0, "obstacle": rows}, Scenario, "test").obstacle


def test_the_command_prints_lines_that_the_stream_of_goals_takes(capsys):
    assert (
        main(["plan", "configs/panda.toml", "--to", "0.4", "0.2", "0.4", "--from", *["0"] * 3, "-1.5", "0", "1.5", "0"])
        == 0
    )
    out = capsys.readouterr()
    goals = [message for _, message in goal_messages(out.out.splitlines(), "plan")]
    assert f"{len(goals)} sub-goals" in out.err
    for goal in goals:
        taken = decode(json.dumps(goal).encode())
        assert isinstance(taken, GoalMessage)
        assert taken.posture_rad is not None
    assert goals[-1]["position_m"] == [0.4, 0.2, 0.4]
    assert "wxyz" not in goals[-1]


class Plans:
    """Counts the plans it is asked for."""

    def __init__(self, fail_from: int = 99) -> None:
        self.asked: list[tuple[F64, int]] = []
        self.fail_from = fail_from

    def __call__(self, q: F64, seed: int) -> list[Goal]:
        self.asked.append((q, seed))
        if len(self.asked) > self.fail_from:
            raise PlanError("plan: no path")
        return [to(0.1 * k, 0.0, 0.5)._replace(posture=np.full(3, 0.1 * k)) for k in range(1, 4)]


def seen(x: float, status: str = "moving", q: float | None = None) -> ArmStatus:
    return ArmStatus(status, "wall at hand", np.array([x, 0.0, 0.5]), np.full(3, x if q is None else q))


def given(stream: GoalStream, view: ArmStatus) -> float | None:
    goal = stream.next(view)
    return None if goal is None else float(goal.position[0])


def test_sub_goals_are_passed_near_and_the_last_one_is_arrived_at():
    stream = GoalStream(Plans(), np.zeros(3))
    assert given(stream, seen(0.0)) == 0.1
    assert given(stream, seen(0.02)) is None
    assert given(stream, seen(0.05, q=0.9)) is None  # the elbow is not there yet
    assert given(stream, seen(0.05)) == 0.2
    assert given(stream, seen(0.15)) == pytest.approx(0.3)
    assert given(stream, seen(0.29)) is None
    assert stream.over == ""
    assert given(stream, seen(0.3, "arrived")) is None
    assert stream.over == "arrived"


@pytest.mark.parametrize("status", ["local_minimum", "limited", "escaping"])
def test_what_holds_the_arm_is_planned_around_from_where_it_is_a_bounded_number_of_times(status: str):
    plans = Plans()
    stream = GoalStream(plans, np.zeros(3), seed=7)
    stream.next(seen(0.0))
    for k in range(REPLANS):
        assert given(stream, seen(0.3, status)) == 0.1
        assert plans.asked[-1][0].tolist() == [0.3] * 3
        assert plans.asked[-1][1] == 8 + k
        assert status in stream.events[-1]
    assert given(stream, seen(0.3, status)) is None
    assert stream.over == f"{status}: wall at hand"


def test_a_plan_that_fails_on_the_way_ends_it_with_both_reasons():
    stream = GoalStream(Plans(fail_from=1), np.zeros(3))
    stream.next(seen(0.0))
    assert given(stream, seen(-0.1, "limited")) is None
    assert stream.over == "limited: wall at hand; plan: no path"

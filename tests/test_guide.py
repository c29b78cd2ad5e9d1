"""Beside the servo: postures by Pinocchio, goals near obstacles by pybullet, advice in the log, the guide's process."""

import os
import signal
import time
from pathlib import Path
from typing import Any

import coal
import numpy as np
import pinocchio as pin
import pytest

from rtctl.app import plan
from rtctl.app.adviser import Adviser
from rtctl.app.arm_link import first_feedback
from rtctl.app.guide import Guide, Seen
from rtctl.app.postures import SLOTS, STEP, endings, inertia_of, links_keep, previewed, quartered, site_of, skin_of
from rtctl.app.replay import replay
from rtctl.app.sim import simulate_scenario
from rtctl.app.simulator import open_simulator
from rtctl.app.times import dulled
from rtctl.arm.field import APART, Ends, MovingPoints, field_buffers, field_to
from rtctl.arm.freedom import Room, body_of, first_blocked
from rtctl.arm.hot import MEASURED_POSTURE
from rtctl.arm.kinematics import chain_of, clearance_of, placements, points_at, tip_at
from rtctl.arm.memory import Memory
from rtctl.arm.pipe import initial
from rtctl.design.pairs import hulls_of
from rtctl.errors import PlanError
from rtctl.kernel.rotations import quat_of
from rtctl.log import schema
from rtctl.log.read.run import read_run
from rtctl.log.record.requests import decode_request, encode_request
from rtctl.plain import Json
from rtctl.spec.read import convert
from rtctl.spec.scenario import Scenario
from rtctl.types import Advice, Goal, ObstacleEdit, Request, Shape, State, Status, Task
from rtctl.world.primitives import Obstacles, distances, obstacles_empty, with_shape
from tests.lab import PANDA, ROOT, lab, play, robot

HOME = [0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785]
DOWN = (0.0, 1.0, 0.0, 0.0)
UNIT = np.array([1.0, 0.0, 0.0, 0.0])


def ball(at: np.ndarray, radius: float = 0.05) -> Shape:
    return Shape("ball", "sphere", np.array([radius, 0, 0, 0]), at, UNIT, np.zeros(3), np.zeros(3))


def around(*shapes: Shape) -> Obstacles:
    table = obstacles_empty(robot().slots)
    for k, shape in enumerate(shapes):
        table = with_shape(table, k, shape)
    return table


def test_compiled_kinematics_are_pinocchio_s():
    arm = robot()
    chain, n = chain_of(arm.body), arm.n
    model, data = arm.body.model, arm.body.model.createData()
    R, t = np.empty((n + 1, 3, 3)), np.empty((n + 1, 3))
    for q in np.random.default_rng(0).uniform(arm.q_min, arm.q_max, (10, n)):
        pin.computeJointJacobians(model, data, q)
        pin.updateFramePlacements(model, data)
        frame = model.getFrameId("panda_hand_tcp")
        placements(chain, q, R, t)
        x, turn, J = tip_at(chain, R, t)
        np.testing.assert_allclose(x, data.oMf[frame].translation, atol=1e-12)
        np.testing.assert_allclose(turn, data.oMf[frame].rotation, atol=1e-12)
        wanted = pin.getFrameJacobian(model, data, frame, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
        np.testing.assert_allclose(J, wanted, atol=1e-12)
        np.testing.assert_allclose(
            points_at(chain, arm.points.link, arm.points.local, q).T, arm.body.placed(q, arm.points), atol=1e-12
        )


def test_a_goal_that_only_a_folded_elbow_reaches_has_a_posture_though_it_lies_in_the_limit_s_zone():
    arm = robot()
    model, data = arm.body.model, arm.body.model.createData()
    folded = np.array([2.3, 0.485, -1.904, arm.q_min[3] + 0.006, -0.033, 1.868, 2.382])  # the wrist as near as it comes
    frame = model.getFrameId("panda_hand_tcp")
    pin.forwardKinematics(model, data, folded)
    there = pin.updateFramePlacement(model, data, frame)
    goal = Goal(there.translation.copy(), quat_of(there.rotation), Task.POSE, 0.003, 0.015)
    guide = Guide(arm, plans=False)
    site = site_of(arm, around(), np.array(HOME))
    assert endings(site, goal, 0) == []
    found = guide._endings(site, goal)
    assert found
    for end in found:
        assert ((end.q > arm.q_min) & (end.q < arm.q_max)).all()
        pin.forwardKinematics(model, data, end.q)
        reached = pin.updateFramePlacement(model, data, frame)
        assert np.linalg.norm(reached.translation - there.translation) < 0.003
        assert np.linalg.norm(pin.log3(reached.rotation.T @ there.rotation)) < 0.015


def test_postures_of_a_goal_have_it_within_limits_and_clear():
    arm = robot()
    goal = Goal(np.array([0.5, 0.1, 0.3]), np.array(DOWN), Task.POSE, 0.003, 0.015)
    data = arm.body.model.createData()
    obstacles = around(ball(np.array([0.5, 0.3, 0.4])))
    found = endings(site_of(arm, obstacles, np.array(HOME)), goal, 0)
    assert len(found) >= 2
    for end in found:
        pin.framesForwardKinematics(arm.body.model, data, end.q)
        tip = data.oMf[arm.body.model.getFrameId("panda_hand_tcp")]
        np.testing.assert_allclose(tip.translation, goal.position, atol=2e-4)
        assert abs(quat_of(np.array(tip.rotation)) @ goal.wxyz) > 1.0 - 1e-6
        assert ((arm.q_min < end.q) & (end.q < arm.q_max)).all()
        rho, _ = distances(arm.body.placed(end.q, arm.points), arm.points.radius, obstacles)
        assert rho.min() == pytest.approx(end.rho)
        assert end.rho > 0.0


def test_a_goal_that_touches_by_a_hair_has_a_posture_within_its_tolerance():
    """The points of the hand reach a millimetre into a block at the goal itself: a higher tip has the goal as well."""
    arm = robot()
    model, data = arm.body.model, arm.body.model.createData()
    frame = model.getFrameId("panda_hand_tcp")
    at = np.array([0.5, 0.1, 0.3])
    exact = endings(site_of(arm, around(), np.array(HOME)), Goal(at, np.array(DOWN), Task.POSE, 0.005, 0.02), 0)[0].q
    hand = arm.points.link == arm.n  # the same place in all postures
    deepest = float((arm.body.placed(exact, arm.points)[:, 2] - arm.points.radius)[hand].min())
    top, size = deepest + 0.001, np.array([0.2, 0.2, 0.1, 0.0])
    block = Shape("block", "box", size, np.array([at[0], at[1], top - 0.1]), UNIT, np.zeros(3), np.zeros(3))
    site = site_of(arm, around(block), np.array(HOME))
    for tolerance, are in ((0.001, False), (0.005, True)):
        goal = Goal(at, np.array(DOWN), Task.POSE, tolerance, 0.02)
        assert not endings(site, goal, 0)
        found = endings(site, goal, 0, 0.0)
        assert bool(found) == are
        for end in found:
            pin.forwardKinematics(model, data, end.q)
            tip = pin.updateFramePlacement(model, data, frame)
            assert np.linalg.norm(tip.translation - at) < 0.5 * tolerance
            assert 2.0 * np.arccos(min(1.0, abs(quat_of(np.array(tip.rotation)) @ np.array(DOWN)))) < 0.5 * 0.02
            lowest = (arm.body.placed(end.q, arm.points)[:, 2] - arm.points.radius)[hand].min()
            assert lowest > top


def test_the_whole_potential_has_its_minimum_at_the_goal():
    """At the goal no push, however near what rests is; beside it less than what draws the point there."""
    arm, q = robot(), np.array(HOME)
    model = arm.body.evaluate(q, np.zeros(7), arm.points)
    j = int(np.argmax(model.P[:, 2] * (arm.points.link == 7)))
    at = model.P[j] + np.array([0.0, 1.0, 0.0]) * (arm.points.radius[j] + 0.05 + 0.03)
    for _ in range(30):  # 30 mm from the nearest point
        obstacles = around(ball(at))
        rho, _ = distances(model.P, arm.points.radius, obstacles)
        at[1] += 0.03 - rho.min()
    points = MovingPoints(model.P, model.Jp, model.B, arm.points.radius, arm.points.link)
    out, still = field_buffers(arm.slots, len(model.P), 7), np.zeros(7)
    ends = Ends(model.P.copy(), rho.copy(), 1.05 * arm.avoid.rho_min, APART, 0.0, np.zeros(0))
    assert rho.min() == pytest.approx(0.03, abs=1e-3)

    def push(dq: np.ndarray, goal: Ends) -> np.ndarray:
        field_to(points, dq, still, obstacles, arm.avoid, out, True, goal)
        return out.tau.copy()

    nowhere = Ends(np.zeros((0, 3)), np.zeros((0, 0)), 0.0, APART, 0.0, np.zeros(0))
    assert np.abs(push(still, nowhere)).max() > 1.0
    assert np.abs(push(still, ends)).max() == 0.0
    for dq in 0.01 * np.random.default_rng(1).standard_normal((50, 7)):
        # acceleration of a spring k_p towards the goal, in the metric of A, against that of the field
        drawn, pushed = arm.motion.k_p * dq @ model.A @ dq, push(dq, ends) @ dq
        assert pushed < drawn
    at[1] -= 0.03 - rho.min()
    moving = ball(at)._replace(velocity=np.array([0.0, 0.01, 0.0]))  # away from it: no wider for that
    obstacles = around(moving)
    assert np.abs(push(still, ends)).max() > 1.0  # what moves keeps its whole influence


def played(log: Path | None = None, **tables: object) -> Json:
    scenario: Scenario = convert({"robot": "panda", "start_q_rad": HOME, **tables}, Scenario, "scenario")
    return simulate_scenario(scenario, PANDA, ROOT / "configs" / "none.toml", log)


def test_a_tool_turns_the_way_that_its_joints_can_and_the_log_replays_to_the_bit(tmp_path):
    log = tmp_path / "turn.mcap"
    goal = {"at_s": 0.3, "position_m": (0.4, 0.0, 0.45), "rpy_rad": (3.14159265, 0.0, -2.9)}
    found = played(log, duration_s=3.6, goal=(goal,))
    assert found["arrived"]
    run = read_run(log)
    asked = [decode_request(raw)[1].advice for raw in run[schema.REQUEST].payloads]
    assert any(each is not None for each in asked)
    again = replay(run)
    assert again.identical
    assert again.digest == found["digest"]


def test_advice_comes_back_from_the_log_to_the_bit():
    advice = Advice(np.random.default_rng(0).uniform(-1.0, 1.0, 7), True, True)
    _, asked = decode_request(encode_request(3, Request(advice=advice)))
    assert asked.advice is not None
    assert asked.advice.posture.tobytes() == advice.posture.tobytes()
    assert (asked.advice.leads, asked.advice.clear) == (True, True)


def test_where_points_stand_out_too_far_the_links_themselves_are_measured():
    """Free means that pybullet finds the clearance, and who has it, and twice the skin to spare, is free."""
    arm, rng = robot(), np.random.default_rng(3)
    keep, anchors = arm.avoid.rho_min, np.zeros((0, 7))
    coarse, fine = body_of(arm), body_of(arm, skin_of(arm.body))
    room = Room(1.2 * keep, 0.0, anchors, np.zeros((0, 2)))
    told: Json = {"robot": "panda", "duration_s": 1.0, "start_q_rad": HOME}
    gained = 0
    for k in range(12):
        P = arm.body.placed(np.array(HOME), arm.points)
        j = int(rng.integers(20, len(P)))
        way = rng.standard_normal(3)
        at = P[j] + way / np.linalg.norm(way) * (arm.points.radius[j] + 0.05 + rng.uniform(0.0, 0.03))
        stands = {"name": "ball", "type": "sphere", "radius_m": 0.05, "position_m": at.tolist()}
        scenario: Scenario = convert({**told, "obstacle": (stands,)}, Scenario, str(k))
        simulator = open_simulator(PANDA, scenario, ROOT / "configs" / "none.toml")
        true = simulator.truth().clearance["ball"]
        simulator.close()
        site = site_of(arm, around(ball(at)), np.array(HOME))
        is_free = [first_blocked(body, site.start[None], site.obstacles, room, 1.0) < 0 for body in (coarse, fine)]
        assert not is_free[1] or true >= keep - 1e-4
        assert is_free[1] or true < keep + 0.01
        gained += is_free[1] and not is_free[0]
    assert gained > 0


def test_links_keep_a_clearance_where_their_hulls_do_to_a_millimetre():
    """Balls and boxes beside some link, near enough for its skin not to tell whether the links keep 8 mm; by coal."""
    arm, rng, q = robot(), np.random.default_rng(4), np.array(HOME)
    arm = arm._replace(avoid=arm.avoid._replace(rho_min=0.008))
    R, t = arm.body.placements(q)
    hulls = [(hull.shape, coal.Transform3s(R[hull.link], t[hull.link])) for hull in hulls_of(arm.body) if hull.link]
    skin, tried, kept = skin_of(arm.body), 0, 0
    P = arm.body.placed(q, skin)
    while tried < 30:
        place = P[int(rng.integers(len(P)))] + rng.uniform(-0.07, 0.07, 3)
        is_ball, size = bool(rng.integers(2)), np.array([0.03, 0.04, 0.05, 0.0])
        thing = ball(place) if is_ball else Shape("ball", "box", size, place, UNIT, np.zeros(3), np.zeros(3))
        site = site_of(arm, around(thing), q)
        if not 0.003 < clearance_of(site.chain, skin, q[None], site.obstacles)[0] < 0.008:
            continue
        form, pose = coal.Sphere(0.05) if is_ball else coal.Box(0.06, 0.08, 0.1), coal.Transform3s(np.eye(3), place)
        asked = coal.DistanceRequest()
        true = min(coal.distance(hull, X, form, pose, asked, coal.DistanceResult()) for hull, X in hulls)
        keeps = links_keep(site, q)
        assert not keeps or true > 0.008 - 1e-5
        assert keeps or true < 0.008 + 1e-3
        tried, kept = tried + 1, kept + keeps
    assert 5 < kept < 30


def test_a_triangle_is_divided_without_a_hole_or_an_overlap():
    """Each of many points of triangles lies in one of the pieces, by its barycentric coordinates there."""
    rng = np.random.default_rng(6)
    whole = rng.normal(size=(20, 3, 3))
    pieces = quartered(whole)
    for share in rng.dirichlet(np.ones(3), 50):
        inside = []
        for k, corners in enumerate(whole):
            shares = [np.linalg.lstsq(piece.T, corners.T @ share)[0] for piece in pieces[4 * k : 4 * k + 4]]
            inside.append(sum(bool((each > 0.0).all()) for each in shares))
        assert inside == [1] * len(whole)


def test_what_is_far_is_left_out_of_a_look_and_nothing_else():
    """Free are the postures in which every point keeps the room, placed by Pinocchio and measured one by one."""
    arm, rng = robot(), np.random.default_rng(5)
    size, at = np.array([0.2, 0.3, 0.02, 0.0]), np.array([0.5, 0.1, 0.3])
    slab = Shape("slab", "box", size, at, UNIT, np.zeros(3), np.zeros(3))
    obstacles = around(ball(np.array([0.3, -0.4, 0.5])), ball(np.array([-0.4, 0.2, 0.7])), slab)
    body = body_of(arm)._replace(pairs=np.zeros((0, 2), np.int64))
    room = Room(0.04, 0.0, np.zeros((0, 7)), np.zeros((0, 3)))
    free = 0
    for q in rng.uniform(arm.q_min, arm.q_max, (150, 7)):
        rho, _ = distances(arm.body.placed(q, arm.points), arm.points.radius, obstacles)
        is_free = first_blocked(body, q[None], obstacles, room, 1.0) < 0
        assert is_free == (rho.min() >= 0.04)
        free += is_free
    assert 20 < free < 130


def seen(q: list[float], goal: Goal, *shapes: Shape, tick: int = 0, status: Status = Status.MOVING) -> Seen:
    used = len(shapes)
    o = around(*shapes)
    cut = o._replace(**{k: getattr(o, k)[:used] for k in SLOTS})
    return Seen(tick, State.RUN, status, goal, np.array(q), cut)


def test_a_goal_that_the_tip_reaches_by_itself_needs_no_advice():
    guide = Guide(robot(), plans=True)
    guide.begin()
    goal = Goal(np.array([0.45, 0.1, 0.45]), UNIT, Task.POSITION, 0.003, 0.015)
    assert all(guide.advise(seen(HOME, goal, tick=k)) is None for k in range(30))


@pytest.mark.parametrize("step", [(-0.033, 0.237, 0.199), (0.172, -0.054, -0.003)])
def test_the_preview_ends_where_the_arm_does_light_joints_first(step: tuple[float, ...]):
    with lab() as here:
        here.running()
        here.ask(here.simulator.truth().tip + np.array(step))
        given, site = here.memory.goal, site_of(here.robot, here.memory.world.obstacles, here.memory.joints.q)
        here.run(2.5)
        ended = here.simulator.truth().q
    assert given is not None
    errors = []
    for A in (inertia_of(site), np.eye(here.robot.n)):
        Q, there = previewed(site, given, here.robot.q_rest, A)
        assert there
        errors.append(np.abs(Q[-1] - ended).max())
    assert errors[0] < 0.25 < errors[1]  # [rad]


def test_a_goal_on_whose_way_light_joints_run_into_their_limits_gets_a_posture():
    to = np.array([0.194, -0.127, 0.216])
    with lab() as here:  # the law alone, by the plant's truth
        here.running()
        begin = here.memory.joints.q.copy()
        here.ask(to)
        given, arm = here.memory.goal, here.robot
        here.run(2.5)
        ended = here.simulator.truth().q
    assert given is not None

    def zones(q: np.ndarray) -> float:
        return float((np.minimum(q - arm.q_min, arm.q_max - q) / arm.limit.rho0).min())

    assert zones(ended) < 0.7
    guide = Guide(arm, False)
    guide.begin()
    advice = guide.advise(seen(list(begin), given))
    assert advice is not None
    assert advice.posture is not None
    assert zones(advice.posture) >= 1.0


ASIDE = (0.0639, -0.0741, 0.4370, -2.2232, 0.0376, 2.1557, 1.2645)  # the hand on one side of what stands there
ACROSS = (0.45, -0.25, 0.3)  # [m] on the other
STANDS = {  # what the law is held by, and what it gets past without a circle
    "wall": ({"name": "wall", "type": "box", "size_m": (0.5, 0.02, 0.4), "position_m": (0.45, 0.0, 0.2)}, True),
    "ball": ({"name": "ball", "type": "sphere", "radius_m": 0.05, "position_m": (0.45, 0.0, 0.3)}, False),
    "low ball": ({"name": "ball", "type": "sphere", "radius_m": 0.05, "position_m": (0.45, 0.0, 0.22)}, False),
}


def across(stands: Json, **keys: object) -> Json:
    goal = {"at_s": 0.3, "position_m": ACROSS}
    return {"duration_s": 3.3, "start_q_rad": ASIDE, "goal": (goal,), "obstacle": (stands,), **keys}


@pytest.mark.parametrize("name", STANDS)
def test_whether_the_law_gets_past_what_stands_there_is_known_before_it_goes(name: str):
    """The law without advice, by the plant's truth, against what is reckoned where it starts."""
    stands, holds = STANDS[name]
    run = play(across(stands))
    arrived = np.linalg.norm(run.tip - ACROSS, axis=1) < 0.003
    assert arrived[-1] != holds
    goal = Goal(np.array(ACROSS), UNIT, Task.POSITION, 0.003, 0.015)
    site = site_of(run.robot, run.memory.world.obstacles, np.array(ASIDE))
    Q, there = previewed(site, goal, run.robot.q_rest, dulled(site), run.robot.avoid.rho_min)
    assert there != holds
    P = run.robot.body.placed(Q[-1], run.robot.points)
    assert distances(P, run.robot.points.radius, site.obstacles)[0].min() > 0.9 * run.robot.avoid.rho_min
    if not holds:
        took = run.t[np.argmax(arrived)] - 0.3
        assert STEP * len(Q) < took + 0.1
        assert took < 1.25 * STEP * len(Q) + 0.75


def reactive(folder: Path) -> Path:
    path = folder / "never.toml"
    path.write_text(PANDA.read_text().replace("[avoid]\n", '[avoid]\nplan = "never"\n'))
    return path


ORDINARY: dict[str, Json] = {
    **{name: across(stands) for name, (stands, holds) in STANDS.items() if not holds},
    "a ball on its way": {
        "duration_s": 2.5,
        "start_q_rad": (0.7, -0.4, 0.0, -2.2, 0.0, 1.8, 0.8),
        "goal": ({"at_s": 0.3, "position_m": (0.45, -0.35, 0.45)},),
        "obstacle": ({"name": "ball", "type": "sphere", "radius_m": 0.05, "position_m": (0.5, 0.09, 0.42)},),
    },
    "nothing near": {"duration_s": 2.0, "goal": ({"at_s": 0.3, "position_m": (0.45, 0.2, 0.4)},)},
    "above a table": {
        "duration_s": 2.5,
        "goal": ({"at_s": 0.3, "position_m": (0.5, 0.1, 0.03), "hold": "orientation"},),
        "obstacle": ({"name": "table", "type": "plane", "position_m": (0.0, 0.0, -0.02), "normal": (0.0, 0.0, 1.0)},),
    },
}


@pytest.mark.parametrize("name", ORDINARY)
def test_what_the_law_does_by_itself_is_left_to_it(name: str, tmp_path: Path):
    scenario: Scenario = convert({"robot": "panda", "start_q_rad": HOME, **ORDINARY[name]}, Scenario, name)
    runs = [simulate_scenario(scenario, path, ROOT / "configs" / "none.toml") for path in (PANDA, reactive(tmp_path))]
    assert runs[0]["arrived"]
    assert runs[0]["digest"] == runs[1]["digest"]


def test_what_holds_the_law_is_planned_around_at_once_and_never_where_nothing_may_be_planned(tmp_path: Path):
    log = tmp_path / "wall.mcap"
    wall, _ = STANDS["wall"]
    found = played(log, **across(wall))
    assert [name for _, name, _ in found["statuses"]][:2] == ["moving", "planned"]
    assert found["time_to_goal_s"] < 2.3
    again = replay(read_run(log))
    assert again.identical
    assert again.digest == found["digest"]
    scenario: Scenario = convert({"robot": "panda", **across(wall)}, Scenario, "wall")
    alone = simulate_scenario(scenario, reactive(tmp_path), ROOT / "configs" / "none.toml")
    assert not alone["arrived"]
    assert "planned" not in [name for _, name, _ in alone["statuses"]]


def test_an_arm_does_not_wait_for_a_way_and_is_led_from_where_it_has_come_to(monkeypatch: pytest.MonkeyPatch):
    """The way is told 0.3 s late, as beside a servo; by pybullet nothing comes nearer than the clearance."""
    real, waits, tips = Guide.advise, list[tuple[int, Advice | None]](), list[np.ndarray]()

    def late(self: Guide, m: Seen) -> Advice | None:
        if waits:
            return waits.pop()[1] if m.tick >= waits[0][0] else None
        advice = real(self, m)
        if ("planned" in [name for name, _ in self.events]) and m.tick < 1000:
            waits.append((m.tick + 300, advice))
        return None if waits else advice

    monkeypatch.setattr(Guide, "advise", late)
    scenario: Scenario = convert({"robot": "panda", **across(STANDS["wall"][0])}, Scenario, "wall")
    told = ROOT / "configs" / "none.toml"
    found = simulate_scenario(scenario, PANDA, told, watch=lambda servo, truth, turn: tips.append(truth.tip.copy()))
    assert np.linalg.norm(tips[600] - tips[300]) > 0.04  # [m], the goal is given at 300
    assert found["arrived"]
    assert found["contacts"] == 0
    assert found["min_clearance_m"]["all"] >= robot().avoid.rho_min


def test_an_arm_that_moves_but_will_be_held_is_planned_for_though_the_first_look_missed_it(
    monkeypatch: pytest.MonkeyPatch,
):
    monkeypatch.setattr(Guide, "_first", lambda self, m, goal: self._expect(m, 1.05))  # as long as the tip would take
    found = played(**across(STANDS["wall"][0]))
    assert found["arrived"]
    assert found["contacts"] == 0
    assert found["min_clearance_m"]["all"] >= robot().avoid.rho_min
    planned = [t for t, name, _ in found["statuses"] if name == "planned"]
    assert 0.7 < planned[0] < 1.0  # half a second after the goal


def test_an_arm_for_whose_goal_no_posture_was_found_is_planned_for_again_before_anything_holds_it(
    monkeypatch: pytest.MonkeyPatch,
):
    planned, tries = plan.plan_joints, list[int]()

    def at_second(*args: Any, **how: Any) -> np.ndarray:
        tries.append(1)
        if len(tries) == 1:
            raise PlanError("plan: every posture found that has the goal touches something")
        return planned(*args, **how)

    monkeypatch.setattr(plan, "plan_joints", at_second)
    monkeypatch.setattr(Guide, "_endings", lambda self, site, goal: [])
    found = played(**across(STANDS["wall"][0]))
    assert found["arrived"]
    assert found["contacts"] == 0
    said = {name: t for t, name, _ in reversed(found["statuses"])}
    assert 0.3 < said["planned"] - said["no_plan"] < 1.1  # the law would be held a second later


def test_a_way_is_left_to_what_will_cross_it_and_taken_again():
    guide = Guide(robot(), plans=True, at_once=True)
    guide.begin()
    goal = Goal(np.array([0.5, 0.3, 0.4]), np.array(DOWN), Task.POSE, 0.003, 0.015)
    led = guide.advise(seen(HOME, goal))
    assert led is not None
    assert led.leads
    comes = ball(np.array([0.65, 0.1, 0.45]))._replace(velocity=np.array([-0.3, 0.0, 0.0]))
    advice = guide.advise(seen(HOME, goal, comes, tick=100))
    assert guide.events[-1][0] == "yields"
    assert advice is not None
    assert np.abs(advice.posture - HOME).max() < np.abs(led.posture - HOME).max()
    gone = guide.advise(seen(HOME, goal, tick=200))
    assert gone is not None
    assert np.abs(gone.posture - HOME).max() > 0.05


def held(m: Memory, tick: int) -> Memory:
    """Return a memory of an arm that is held in a limit, the tool still to be turned."""
    goal = Goal(np.array([0.4, 0.0, 0.45]), np.array([0.0, 0.9926, 0.1208, 0.0]), Task.POSE, 0.003, 0.015)
    return m._replace(tick=tick, state=State.RUN, status=Status.LIMITED, goal=goal)


def test_the_process_advises_is_never_waited_for_and_ends():
    arm = robot()
    adviser = Adviser(arm)
    try:
        assert adviser.pid != os.getpid()
        m = initial(arm, first_feedback(np.array(HOME)))
        adviser.begin()
        for tick in range(0, 100_000, 10):
            advice = adviser.advise(held(m, tick))
            if advice is not None:
                break
            time.sleep(0.01)
        assert advice is not None
        assert advice.posture.shape == (7,)

        os.kill(adviser.pid, signal.SIGSTOP)  # it hangs: what is shown piles up, and nobody waits
        for tick in range(0, 20_000, 10):
            adviser.advise(held(m, tick))
        adviser.begin()
        assert adviser.advise(held(m, 0)) is None  # what was said of the other goal is dropped

        os.kill(adviser.pid, signal.SIGKILL)
        os.waitpid(adviser.pid, 0)
        adviser.events.clear()
        while not adviser.events:
            assert adviser.advise(held(m, 0)) is None
        assert [name for name, _ in adviser.events] == ["no_guide"]
    finally:
        adviser.close()
    with pytest.raises(ProcessLookupError):
        os.kill(adviser.pid, 0)


def test_joints_that_are_led_and_held_are_said_to_be_so_within_two_seconds(monkeypatch):
    """Beyond a wall, by somebody who sees none: the wall is named, by pybullet within the influence."""
    beyond = np.array([1.2, *HOME[1:]])
    monkeypatch.setattr(Guide, "advise", lambda self, m: None if m.goal is None else Advice(beyond, leads=True))
    wall = {"name": "wall", "type": "box", "size_m": (1.2, 0.02, 1.6), "position_m": (0.5, 0.25, 0.4)}
    goal = {"at_s": 0.3, "position_m": (0.2, 0.5, 0.45)}
    found = played(duration_s=4.5, goal=(goal,), obstacle=(wall,))
    assert found["contacts"] == 0
    assert not found["arrived"]
    told = [(t, status, detail) for t, status, detail in found["statuses"] if status not in ("moving", "planned")]
    assert told
    assert told[0][0] < 4.3  # it stands within two seconds
    assert "wall at " in told[-1][2]
    assert found["statuses"][-1] == list(told[-1])
    assert found["min_clearance_m"]["wall"] < 0.1


def test_a_posture_measured_among_other_obstacles_is_not_trusted_beside_a_new_one():
    arm = robot()
    with lab() as here:
        here.running()
        here.ask([0.45, 0.1, 0.45])
        here.step(Request(advice=Advice(np.array(HOME), clear=True)))
        assert here.memory.has_posture == MEASURED_POSTURE
        comes = ball(np.array([0.6, 0.6, 0.6]))._replace(velocity=np.array([0.1, 0.0, 0.0]))
        here.step(Request(obstacles=(ObstacleEdit("ball", comes),)))
        assert here.memory.has_posture == MEASURED_POSTURE
        here.step(Request(obstacles=(ObstacleEdit("ball", ball(np.array([0.6, 0.6, 0.6]))),)))
        assert here.memory.has_posture == 1
        here.step(Request(advice=Advice(np.full(arm.n, 9.0))))  # beyond the limits: nobody asked for it, nobody is told
        assert not here.memory.refusal
        assert here.memory.goal is not None
        np.testing.assert_array_equal(here.memory.goal.posture, HOME)


@pytest.mark.parametrize(("late", "held"), [(10, True), (1000, False)])
def test_joints_at_the_goal_are_held_back_by_how_fast_they_drift_now(late: int, held: bool):
    """0.15 rad in a hundredth of a second would be in a limit at once; in a second it is nothing."""
    guide = Guide(robot(), plans=True)
    guide.begin()
    first, then = list(HOME), list(HOME)
    first[6] += 0.3
    then[6] += 0.45
    tip = robot().body.evaluate(np.array(first), np.zeros(7), robot().points)
    goal = Goal(tip.x, UNIT, Task.POSITION, 0.003, 0.015)
    assert guide.advise(seen(HOME, goal)) is None  # its first look
    assert guide.advise(seen(first, goal, tick=10, status=Status.ARRIVED)) is None
    kept = guide.advise(seen(then, goal, tick=10 + late, status=Status.ARRIVED))
    assert (kept is not None) == held
    if kept is not None:
        assert kept.posture.tolist() == first
        assert not kept.leads

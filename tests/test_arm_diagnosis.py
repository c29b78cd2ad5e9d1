"""What is said to hold the arm, checked against the geometry: coal's shapes, Pinocchio's and finite differences."""

from pathlib import Path
from typing import Any

import coal
import numpy as np
import pinocchio as pin
import pytest
from scipy.spatial.transform import Rotation

from rtctl.arm.diagnosis import Balance, at_edge, blockers
from rtctl.arm.escape import Phase
from rtctl.arm.self_collision import Hull
from rtctl.design.pairs import hulls_of
from rtctl.types import F64, Status
from tests.arms import panda, states
from tests.lab import PANDA, Run, changed, play, robot

FAR = np.full(4, np.inf)
NOTHING = Balance(np.zeros(4), np.zeros(7), 0.0, 1.0, np.full(7, 0.1), FAR, np.full(4, 0.1), False)
BESIDE = [0.0639, -0.0741, 0.4370, -2.2232, 0.0376, 2.1557, 1.2645]  # the hand points down at 0.45 0.25 0.3


def some(count: int, **values: float) -> F64:
    out = np.zeros(count)
    for key, value in values.items():
        out[int(key[1:])] = value
    return out


@pytest.mark.parametrize(
    ("change", "status", "mask", "main"),
    [
        ({"full": some(7, _3=1.0, _5=1.2)}, Status.SATURATED, 0b101000, 5),
        ({"obstacles": some(4, _1=0.7, _2=0.3)}, Status.LOCAL_MINIMUM, 0b110, 1),
        ({"obstacles": some(4, _1=0.95, _2=0.05)}, Status.LOCAL_MINIMUM, 0b10, 1),
        ({"obstacles": some(4, _1=1.0), "goal_rho": 0.05 * np.ones(4)}, Status.SHADOWED, 0b10, 1),
        ({"obstacles": some(4, _1=0.5, _2=0.5), "goal_rho": np.array([9, 0.05, 9, 9])}, Status.LOCAL_MINIMUM, 0b110, 1),
        ({"limits": some(7, _6=1.0)}, Status.LIMITED, 0b1000000, 6),
        ({"limits": some(7, _6=0.6, _3=0.4), "granted": 0.2}, Status.LIMITED, 0b1001000, 6),
        ({"granted": 0.1}, Status.SINGULAR, 0, -1),
        ({"granted": 0.1, "edge": True}, Status.UNREACHABLE, 0, -1),
        ({"obstacles": some(4, _1=0.4), "limits": some(7, _2=0.6)}, Status.LIMITED, 0b100, 2),
        ({"obstacles": some(4, _1=0.6), "limits": some(7, _2=0.4)}, Status.LOCAL_MINIMUM, 0b10, 1),
        ({}, Status.LOCAL_MINIMUM, 0, -1),
    ],
)
def test_the_cause_that_hides_the_others_comes_first_and_all_that_hold_are_named(change, status, mask, main):
    assert blockers(NOTHING._replace(**change)) == (status, mask, main)


def _second(f, q: F64, u: F64, a: F64, b: F64) -> float:
    """Return the mixed second difference of f(., u) over the steps a and b."""
    return (f(q + a + b, u) - f(q + a - b, u) - f(q - a + b, u) + f(q - a - b, u)) / 4e-8


def test_the_edge_of_reach_is_where_no_motion_of_second_order_leads_on():
    body, rng = panda(), np.random.default_rng(0)
    model, data, frame = body.model, body.model.createData(), body.model.getFrameId("panda_hand_tcp")

    def height(q: F64, u: F64) -> float:
        pin.framesForwardKinematics(model, data, q)
        return float(u @ data.oMf[frame].translation)

    seen = set()
    for q in [np.zeros(7), *(q for q, _, _ in states(body, 20))]:
        pin.computeJointJacobians(model, data, q)
        pin.framesForwardKinematics(model, data, q)
        J = pin.getFrameJacobian(model, data, frame, pin.LOCAL_WORLD_ALIGNED)
        u = rng.normal(size=3)
        u /= np.linalg.norm(u)
        step = 1e-4 * np.eye(7)
        H = np.array([[_second(height, q, u, a, b) for b in step] for a in step])
        edge = bool(np.linalg.eigvalsh(H).max() <= 0.05)
        assert at_edge(np.ascontiguousarray(J), u) == edge
        seen.add(edge)
    assert False in seen


def test_a_chain_stretched_out_is_at_its_edge_and_one_folded_back_is_not():
    def planar(lengths: list[float], angles: list[float]) -> F64:
        steps = [[l * np.cos(t), l * np.sin(t), 0.0] for l, t in zip(lengths, angles, strict=True)]
        at = np.cumsum(np.array(steps), axis=0)
        origins = np.vstack([np.zeros(3), at[:-1]])
        z = np.array([0.0, 0.0, 1.0])
        return np.vstack([np.array([np.cross(z, at[-1] - o) for o in origins]).T, np.tile(z[:, None], 3)])

    x = np.array([1.0, 0.0, 0.0])
    assert at_edge(planar([0.4, 0.3, 0.2], [0.0, 0.0, 0.0]), x)
    assert not at_edge(planar([0.4, 0.3, 0.2], [0.0, np.pi, 0.0]), x)
    assert not at_edge(planar([0.4, 0.3, 0.2], [0.0, 0.0, 0.0]), -x)


def wall() -> dict[str, Any]:
    return {"name": "wall", "type": "box", "size_m": [0.5, 0.02, 0.4], "position_m": [0.45, 0.0, 0.2]}


def across(path: Path, seconds: float) -> Run:
    """Return the run of an arm that has a wall between its tip and its goal."""
    goal = {"at_s": 0.5, "position_m": [0.45, -0.25, 0.3]}
    return play({"duration_s": seconds, "start_q_rad": BESIDE, "goal": [goal], "obstacle": [wall()]}, path)


@pytest.fixture(scope="module")
def off(tmp_path_factory):
    return changed(tmp_path_factory.mktemp("off"), self_collision="true\nescape = false")


def solid(run: Run, link: str) -> tuple[Hull, coal.Transform3s]:
    """Return coal's hull of a link and where it is at the end."""
    body = run.robot.body
    hull = next(h for h in hulls_of(body) if h.name == link)
    model, data = body.model, body.model.createData()
    pin.forwardKinematics(model, data, run.q[-1])
    joint = next(j for j, k in body.link_of.items() if k == hull.link)
    return hull, coal.Transform3s(data.oMi[joint].rotation, data.oMi[joint].translation)


def distance_to_box(run: Run, link: str, size: list[float], at: list[float]) -> float:
    hull, X = solid(run, link)
    pose = coal.Transform3s(np.eye(3), np.array(at))
    return coal.distance(hull.shape, X, coal.Box(*size), pose, coal.DistanceRequest(), coal.DistanceResult())


def test_a_wall_in_the_way_is_named_with_the_link_that_it_stops(off):
    run = across(off, 5.6)
    _, status, detail = run.events[-1]
    assert status == "local_minimum"
    name, _, link = detail.partition(" at ")
    assert name == "wall"
    assert distance_to_box(run, link, wall()["size_m"], wall()["position_m"]) < run.robot.avoid.rho0
    assert run.record["holders"][-1] == 1
    assert run.figures["contacts"] == 0


def test_a_wall_behind_a_hundred_obstacles_is_the_same_wall(off, tmp_path: Path):
    """What is far away takes slots and nothing else: the bits on the bus are those of the wall alone."""
    many = changed(tmp_path, "many", self_collision="true\nescape = false\nobstacles_max = 200")
    goal = {"at_s": 0.5, "position_m": [0.45, -0.25, 0.3]}
    far = [
        {"name": f"far{k}", "type": "sphere", "radius_m": 0.1, "position_m": [20.0 + k, 0.0, 0.0]} for k in range(100)
    ]
    scene = {"duration_s": 5.6, "start_q_rad": BESIDE, "goal": [goal]}
    alone, last = (play({**scene, "obstacle": o}, path) for o, path in (([wall()], off), ([*far, wall()], many)))
    assert last.digest == alone.digest
    assert last.events[-1] == alone.events[-1]
    assert (alone.record["blocker"][-1], last.record["blocker"][-1]) == (0, 100)
    assert last.record["rho"].shape[1] == 200


def test_a_wall_in_the_way_is_escaped_without_contact_or_haste():
    run = across(PANDA, 6.0)
    names = [name for _, name, _ in run.events if name != "state"]
    assert names[:4] == ["moving", "escaping", "moving", "arrived"]
    assert set(run.record["escape"]) == {Phase.NONE, Phase.CHOOSING, Phase.FIRST}
    assert run.figures["contacts"] == 0
    assert run.figures["min_clearance_m"]["all"] > 0.02
    assert run.figures["max_speed_m_s"] <= 1.02 * run.robot.motion.v_max
    assert run.figures["max_torque_ratio"] <= 1.0


def test_a_joint_limit_in_the_way_is_named_and_the_goal_does_lie_past_it():
    arm = robot()
    home = arm.body.evaluate(arm.home, np.zeros(7), arm.points)
    aim = Rotation.from_matrix(home.R) * Rotation.from_euler("z", 2.4)  # about the axis of the last joint
    x, y, z, w = aim.as_quat()
    wxyz = [float(c) for c in (w, x, y, z)]
    run = play({"duration_s": 5.0, "goal": [{"at_s": 0.5, "position_m": home.x.tolist(), "wxyz": wxyz}]})
    _, status, detail = run.events[-1]
    assert status == "limited"
    named = [part.split(" at its ") for part in detail.split("; ")]
    q, body = run.q[-1], arm.body
    data = body.model.createData()
    pin.computeJointJacobians(body.model, data, q)
    pin.framesForwardKinematics(body.model, data, q)
    frame = body.model.getFrameId("panda_hand_tcp")
    J = pin.getFrameJacobian(body.model, data, frame, pin.LOCAL_WORLD_ALIGNED)
    here = data.oMf[frame]
    turn = pin.log3(aim.as_matrix() @ here.rotation.T)
    A = pin.crba(body.model, body.model.createData(), q)
    A = np.triu(A) + np.triu(A, 1).T
    W = np.linalg.inv(A)
    e = np.concatenate([home.x - here.translation, turn])
    dq = W @ J.T @ np.linalg.solve(J @ W @ J.T, e)  # the dynamically consistent way to the goal
    for name, end in named:
        i = arm.joints.index(name)
        room = arm.q_max[i] - q[i] if end == "upper limit" else q[i] - arm.q_min[i]
        assert room < arm.limit.rho0[i]
        assert (dq[i] > room) if end == "upper limit" else (-dq[i] > room)

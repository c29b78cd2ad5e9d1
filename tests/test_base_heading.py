"""A goal with a heading: the rover turns to it on the spot, where it can, and says that it has arrived when it has.

The oracle is the double's own account of where the vehicle is and how it stands.
"""

import math

import msgspec
import numpy as np
import pytest

from rtctl.app.rover_log import header_of
from rtctl.app.sim import simulate_scenario
from rtctl.cli import values
from rtctl.errors import ConfigError, RequestError
from rtctl.hal.messages import Bounds, decode, request_of
from rtctl.log.read.run import read
from rtctl.log.record.requests import decode_request
from rtctl.log.record.writer import McapSink
from rtctl.rover import pipe
from rtctl.rover.record import feedback_from
from rtctl.spec.scenario import FaultTable, TimedGoal, load_scenario
from rtctl.types import Goal, Request, Status, Task
from tests.base_lab import CONFIGS, ROVER, ROVER_PX4, BaseLab, goal_at

BOUNDS = Bounds((0.0, 0.0, 0.0), 500.0, 0.3, 0.1, Task.X | Task.Y | Task.ORIENTATION, lambda a, b: (1.0, 2.0))
DISC = {"name": "d", "type": "cylinder", "radius_m": 1.0, "length_m": 2.0, "position_m": [8.0, 0.0, 0.0]}


def facing(x: float, y: float, heading: float, within: float = 0.1) -> Goal:
    """Return the goal of being at x, y [m] and facing `heading` [rad]."""
    turn = np.array([math.cos(heading / 2.0), 0.0, 0.0, math.sin(heading / 2.0)])
    return goal_at(x, y)._replace(wxyz=turn, task=Task.POSITION | Task.RZ, tolerance_rot=within)


def off(lab: BaseLab, goal: Goal, heading: float) -> tuple[float, float]:
    """Return how far [m, rad] the vehicle really is from a goal."""
    truth = lab.rover.truth()
    away = math.hypot(truth.x - goal.position[0], truth.y - goal.position[1])
    return away, abs(math.remainder(truth.yaw - heading, 2.0 * math.pi))


@pytest.mark.parametrize("heading", [0.0, 1.6, 3.14, -2.5])
@pytest.mark.parametrize("within", [0.05, 0.3])
def test_it_arrives_facing_as_asked_and_says_so_no_sooner(heading: float, within: float):
    lab, goal = BaseLab().armed(), facing(5.0, 1.0, heading, within)
    lab.tick(goal=goal)
    for _ in range(1000):
        lab.tick()
        away, angle = off(lab, goal, heading)
        if lab.m.status == Status.ARRIVED:
            break
    assert lab.m.status == Status.ARRIVED
    assert away < 0.3 + 0.05
    assert angle < within + 0.01
    lab.run(4.0)
    away, angle = off(lab, goal, heading)
    assert lab.m.status == Status.ARRIVED  # and stays
    assert away < 0.3 + 0.05
    assert angle < within + 0.01
    assert lab.rover.truth().w == pytest.approx(0.0, abs=0.01)
    assert lab.seen == ()


def test_it_turns_where_it_is_the_shorter_way_round_and_for_another_heading_alone():
    lab = BaseLab().armed()
    lab.tick(goal=facing(4.0, 0.0, 3.0))
    assert lab.run(20.0, lambda: lab.m.status == Status.ARRIVED)
    begin, turned = lab.rover.truth(), 0.0
    lab.tick(goal=facing(4.0, 0.0, -3.0))
    while lab.m.status != Status.ARRIVED:
        lab.tick()
        truth = lab.rover.truth()
        assert math.hypot(truth.x - begin.x, truth.y - begin.y) < 0.05
        turned += truth.w * lab.base.dt
        assert lab.slot < 2000
    assert turned == pytest.approx(2.0 * math.pi - 6.0, abs=0.2)  # through the seam at pi


def test_who_drifts_off_the_heading_turns_back_to_it():
    lab, goal = BaseLab().armed(), facing(3.0, 0.0, 1.0)
    lab.tick(goal=goal)
    assert lab.run(20.0, lambda: lab.m.status == Status.ARRIVED)
    lab.rover.vehicle.yaw += 0.6
    lab.run(0.5)
    assert lab.m.status == Status.MOVING
    assert lab.run(5.0, lambda: lab.m.status == Status.ARRIVED)
    assert off(lab, goal, 1.0)[1] < 0.11


def test_who_rests_beside_an_obstacle_is_not_pushed_off_its_goal():
    lab = BaseLab(obstacles=[DISC]).armed()
    assert lab.arrive(5.5, 0.0)
    lab.run(1.0)
    before = lab.rover.truth()
    lab.run(8.0)
    after = lab.rover.truth()
    assert lab.m.status == Status.ARRIVED
    assert math.hypot(after.x - before.x, after.y - before.y) < 0.05
    assert abs(after.yaw - before.yaw) < 0.05
    lab.tick(goal=facing(5.5, 0.0, 2.0))
    assert lab.run(10.0, lambda: lab.m.status == Status.ARRIVED)


def test_who_rests_at_its_goal_still_gives_way_to_what_comes():
    lab = BaseLab(obstacles=[{**DISC, "radius_m": 0.5, "velocity_m_s": [-0.25, 0.0, 0.0]}]).armed()
    assert lab.arrive(2.0, 0.0, 10.0)
    lab.run(18.0)
    assert lab.rover.truth().contacts == 0


@pytest.mark.parametrize(
    ("config", "edits", "why"),
    [
        (
            ROVER,
            [('"skid"', '"ackermann"\nturn_radius_m = 1.5')],
            "wanted none: this base turns in circles of 1.5 m, not on the spot",
        ),
        (ROVER_PX4, [], "wanted none: PX4 takes a velocity and turns as it thinks best"),
    ],
)
def test_a_base_that_cannot_turn_on_the_spot_refuses_a_heading(config, edits, why, tmp_path):
    text = config.read_text()
    for old, new in edits:
        text = text.replace(old, new)
    (tmp_path / "base.toml").write_text(text)
    lab = BaseLab(tmp_path / "base.toml").armed()
    lab.tick(goal=facing(5.0, 0.0, 1.0))
    assert lab.m.refusal == f"goal: got a heading, {why}"
    assert lab.m.goal is None
    lab.tick(goal=goal_at(5.0, 0.0))
    assert lab.m.refusal == ""


def test_any_other_orientation_is_refused():
    lab = BaseLab().armed()
    lab.tick(goal=facing(5.0, 0.0, 1.0)._replace(task=Task.POSE))
    assert lab.m.refusal == "goal: got an orientation, wanted heading_rad alone: a base turns in no other way"


def test_the_console_takes_a_heading_beside_metres_or_degrees():
    for place in ('"position_m": [3, 4, 0]', '"latlon_deg": [1, 2]'):
        text = f'{{"verb": "goal", {place}, "heading_rad": -1.2, "tolerance_rad": 0.2}}'.encode()
        goal = request_of(decode(text), BOUNDS, lambda: (1.0, 0.0, 0.0, 0.0)).goal
        assert goal is not None
        assert goal.task == Task.POSITION | Task.RZ
        assert goal.tolerance_rot == 0.2
        np.testing.assert_allclose(goal.wxyz, [math.cos(0.6), 0.0, 0.0, -math.sin(0.6)])
    for line in ('{"position_m": [3, 4, 0], "heading_rad": 0.5}', "x,y,z,heading_rad\n3,4,0,0.5"):
        ((_, message),) = values.goal_messages(line.splitlines(), "f")
        assert message == {"verb": "goal", "position_m": [3, 4, 0], "heading_rad": 0.5}


@pytest.mark.parametrize(
    ("message", "bounds", "why"),
    [
        ('"position_m": [3, 4, 0], "heading_rad": 1, "rpy_rad": [0, 0, 1]', BOUNDS, "no other orientation beside it"),
        ('"heading_rad": 1', BOUNDS, "wanted a position"),
        ('"position_m": [3, 4, 0], "heading_rad": 7', BOUNDS, "wanted a number from -6.3 to 6.3 rad"),
        ('"position_m": [3, 4, 0], "heading_rad": 1', BOUNDS._replace(local=None), "wanted rpy_rad or wxyz"),
    ],
)
def test_a_heading_that_makes_no_sense_is_refused(message, bounds, why):
    with pytest.raises(RequestError, match=why):
        request_of(decode(f'{{"verb": "goal", {message}}}'.encode()), bounds, lambda: (1.0, 0.0, 0.0, 0.0))


def test_a_scenario_of_an_arm_has_none():
    path = CONFIGS / "scenarios" / "planar4.toml"
    scenario = load_scenario(path)
    goal = TimedGoal(at_s=0.0, position_m=(0.3, 0.0, 0.0), heading_rad=1.0)
    with pytest.raises(ConfigError, match=r"goal\[0\]\.heading_rad: got 1, wanted rpy_rad or wxyz"):
        simulate_scenario(msgspec.structs.replace(scenario, goal=(goal,)), CONFIGS / "planar4.toml", path)


def test_a_scenario_reports_the_angle_by_the_truth_and_a_turn_that_does_not_come_does_not_arrive():
    path = CONFIGS / "worlds" / "disc.toml"
    goal = TimedGoal(at_s=0.2, position_m=(3.0, 0.0, 0.0), heading_rad=1.5, tolerance_rad=0.1)
    play = msgspec.structs.replace(load_scenario(path), goal=(goal,), duration_s=10.0)
    found = simulate_scenario(play, ROVER, path)
    assert found["arrived"]
    assert found["goals"][0]["error_rad"] == found["final_error_rad"] <= 0.1
    weak = FaultTable(at_s=0.0, kind="weak_yaw", value=0.0)
    found = simulate_scenario(msgspec.structs.replace(play, fault=(weak,)), ROVER, path)
    assert not found["arrived"]
    assert found["final_error_rad"] > 1.0
    assert "no_effect" in found["faults"]


def test_a_heading_is_in_the_log_and_replays_to_the_same_bytes(tmp_path):
    probe = BaseLab()
    sink = McapSink(tmp_path / "run.mcap", header_of(probe.config, ROVER, probe.base, probe.start))
    lab = BaseLab(sink=sink).armed()
    lab.tick(goal=facing(2.0, 0.0, 2.0))
    assert lab.run(15.0, lambda: lab.m.status == Status.ARRIVED)
    sink.close("end")
    log = read(tmp_path / "run.mcap")
    requests, rows = dict(decode_request(p) for p in log["/request"].payloads), log["/tick"].array
    m = pipe.initial(lab.base, lab.start)
    for k, row in enumerate(rows):
        m, _, record = pipe.tick(lab.base, m, feedback_from(row), requests.get(k, Request()))
        assert record.tobytes() == row.tobytes(), k
    assert rows["goal_heading"][-1] == pytest.approx(2.0)
    assert np.isnan(rows["goal_heading"][0])
    assert abs(rows["error_rot"][-1]) < 0.1
    assert np.abs(rows["w"]).max() > 0.5

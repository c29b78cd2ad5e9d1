"""What the rover does among obstacles it only sees: the four worlds, random ones, poor links, things that move.

The oracle is the double's own geometry: distances of the footprint to the solids, which the controller never sees.
"""

import numpy as np
import pytest

from rtctl.types import ObstacleEdit, Shape, State, Status, Verb
from tests.base_lab import ROVER, ROVER_PX4, UPRIGHT, BaseLab, Relay, some_world
from tools.rover_campaign import CLEARANCE, WORLDS, played, sight, worlds


@pytest.mark.parametrize("case", [c for c in worlds(2) if c.scenario.seed == 1], ids=lambda c: c.world)
def test_four_worlds_keep_clear_and_are_no_slower_than_the_autopilots_own_avoidance(case):
    run = played(case)
    assert run.arrived
    assert run.near_s is not None
    assert run.near_s <= WORLDS[run.world]
    assert run.clearance >= CLEARANCE
    assert run.contacts == 0
    assert run.why == "arrived"  # and no fault


@pytest.mark.parametrize("case", list(sight(8)), ids=lambda c: f"{c.kind}-{c.world}-{c.scenario.seed}")
def test_who_knows_too_little_or_is_told_wrongly_touches_nothing_and_says_why_it_stands(case):
    run = played(case)
    assert run.fine, run
    assert run.contacts == 0


@pytest.mark.parametrize("verb", [Verb.NONE, Verb.DISARM, Verb.TERM])
@pytest.mark.parametrize("goal", [(12.0, 0.5), (4.0, 6.0), (-5.0, 2.0)])
def test_who_has_arrived_does_not_turn_on_the_spot(goal: tuple[float, float], verb: Verb):
    lab = BaseLab().armed()
    assert lab.arrive(*goal)
    yaw, swing = lab.rover.truth().yaw, 0.0
    lab.tick(verb)
    for _ in range(200):
        lab.tick()
        swing = max(swing, abs(lab.rover.truth().yaw - yaw))
    assert lab.speed < 0.01
    assert swing < 0.05


def test_twenty_random_goals_among_ten_random_solids_without_contact():
    solids, places = some_world(2)
    lab = BaseLab(obstacles=solids).armed()
    assert [lab.arrive(*at) for at in places] == [True] * 20
    assert lab.rover.truth().contacts == 0
    assert lab.least > 0.4
    assert lab.seen == ()


def test_loss_delay_and_reordering_slow_or_stop_it_but_never_cause_contact():
    solids, places = some_world(2)
    relay = Relay(0.02, loss=0.10, delay=0.10, jitter=0.06, seed=2)
    lab = BaseLab(obstacles=solids, relay=relay).armed()
    arrived = []
    for at in places[:10]:
        arrived.append(lab.m.state == State.RUN and lab.arrive(*at))
    assert relay.lost > 0.08 * relay.count > 100
    assert lab.rover.truth().contacts == 0
    assert lab.least > 0.2
    assert arrived[0]
    assert set(lab.seen) <= {"heartbeat_late", "heartbeat_lost", "scan_stale", "position_stale"}


@pytest.mark.parametrize(
    ("start", "velocity"), [((12.0, 6.0), (0.0, -0.6)), ((12.0, 8.0), (0.0, -1.2)), ((25.0, 0.2), (-0.8, 0.0))]
)
def test_what_moves_across_or_towards_it_is_not_touched(start, velocity):
    moving = {
        "name": "m",
        "type": "cylinder",
        "radius_m": 0.5,
        "length_m": 2.0,
        "position_m": [*start, 0.0],
        "velocity_m_s": [*velocity, 0.0],
    }
    lab = BaseLab(obstacles=[moving]).armed()
    assert lab.arrive(25.0, 0.0)
    assert lab.rover.truth().contacts == 0
    assert lab.seen == ()


@pytest.mark.parametrize(
    ("config", "edits"),
    [
        (ROVER_PX4, []),
        (ROVER_PX4, [('"skid"', '"holonomic"')]),
        (ROVER, [('"skid"', '"ackermann"\nturn_radius_m = 1.5'), ("reverse = false", "reverse = true")]),
    ],
    ids=["px4", "holonomic", "car"],
)
def test_other_wheels_and_the_other_autopilot_get_through_as_well(config, edits, tmp_path):
    text = config.read_text()
    for old, new in edits:
        text = text.replace(old, new)
    (tmp_path / "base.toml").write_text(text)
    solids, places = some_world(4)
    lab = BaseLab(tmp_path / "base.toml", obstacles=solids).armed()
    assert [lab.arrive(*at) for at in places[:3]] == [True] * 3
    assert lab.rover.truth().contacts == 0
    assert lab.least > 0.4
    assert lab.seen == ()


def test_a_told_wall_that_no_sensor_sees_is_gone_round():
    wall = Shape("w", "box", np.array([0.25, 4.0, 1.0, 0.0]), np.array([12.0, 0.0, 0.0]), UPRIGHT, *np.zeros((2, 3)))
    lab = BaseLab().armed()
    lab.tick(obstacles=(ObstacleEdit("w", wall),))
    assert lab.arrive(25.0, 0.0)
    x, y = np.array([r["position"] for r in lab.records]).T
    hull = np.hypot(np.maximum(np.abs(x - 12.0) - 0.25, 0.0), np.maximum(np.abs(y) - 4.0, 0.0)) - 0.5
    assert hull.min() > 0.5


def test_a_goal_beside_an_obstacle_is_called_shadowed_and_one_shut_in_a_local_minimum():
    disc = {"name": "d", "type": "cylinder", "radius_m": 1.0, "length_m": 2.0, "position_m": [8.0, 0.0, 0.0]}
    lab = BaseLab(obstacles=[disc]).armed()
    assert not lab.arrive(6.5, 0.0, seconds=13.0)
    assert lab.m.status == Status.SHADOWED
    assert lab.least > 0.5
    walls = [
        ((0.3, 10.0), (6.0, 0.0)),
        ((0.3, 10.0), (-6.0, 0.0)),
        ((12.0, 0.3), (0.0, 5.0)),
        ((12.0, 0.3), (0.0, -5.0)),
    ]
    room = [
        {"name": f"w{i}", "type": "box", "size_m": [*size, 2.0], "position_m": [*at, 0.0]}
        for i, (size, at) in enumerate(walls)
    ]
    lab = BaseLab(obstacles=room).armed()
    assert not lab.arrive(20.0, 0.0, seconds=20.0)
    assert lab.m.status == Status.LOCAL_MINIMUM
    assert lab.least > 0.4
    assert lab.speed < 0.1

"""Turning to look: where the way ahead is unknown, the rover turns on the spot to see it before it stands for good.

The oracle is the double's geometry, and what its sensor was told to hide.
"""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtctl.rover import occupancy, turn
from rtctl.types import Status
from tests.base_lab import ROVER, ROVER_PX4, BaseLab, goal_at
from tests.test_base_sight import configured

REVERSE = ("reverse = false", "reverse = true")
LONG = ('scan = "required"', 'scan = "required"\nseen_s = 4.0')
DISC = {"name": "disc", "type": "cylinder", "radius_m": 1.0, "length_m": 2.0, "position_m": [5.0, 0.5, 0.0]}


def swing(lab: BaseLab, seconds: float) -> float:
    """Run and return the angle [rad] between the furthest headings of that time."""
    yaws = []
    for _ in range(round(seconds / lab.base.dt)):
        lab.tick()
        yaws.append(lab.rover.truth().yaw)
    return float(np.ptp(np.unwrap(yaws)))


@pytest.mark.parametrize("goal", [(-8.0, 0.0), (-8.0, 1.5)])
def test_who_may_reverse_but_does_not_see_behind_turns_round(goal, tmp_path):
    lab = BaseLab(configured(tmp_path, edits=[REVERSE]), inject=["scan_blind@0:0:100:260"]).armed()
    assert lab.arrive(goal[0], goal[1], 20.0)
    assert min(r["v"] for r in lab.records) > -0.1
    assert lab.seen == ()


def test_who_sees_behind_reverses(tmp_path):
    lab = BaseLab(configured(tmp_path, edits=[REVERSE])).armed()
    lab.tick(goal=goal_at(-8.0, 0.0))
    lab.run(3.0)
    assert lab.rover.truth().v < -1.0


@pytest.mark.parametrize("wedge", ["-10:10", "-5:20"])
def test_a_dark_wedge_ahead_is_looked_past_by_turning_aside(wedge, tmp_path):
    lab = BaseLab(configured(tmp_path, edits=[LONG]), obstacles=[DISC], inject=[f"scan_blind@0:0:{wedge}"]).armed()
    assert lab.arrive(9.0, 0.0, 60.0)
    assert lab.rover.truth().contacts == 0
    assert lab.least > 0.5
    said = [detail for _, name, detail in lab.servo.events if name == "blind"]
    assert said
    assert all("not seen: " in text for text in said)


@pytest.mark.parametrize("goal", [(8.0, 1.0), (-8.0, 1.0), (1.0, -8.0)])
def test_a_camera_that_sees_a_quarter_ahead_is_enough(goal, tmp_path):
    lab = BaseLab(configured(tmp_path, edits=[LONG]), inject=["scan_blind@0:0:45:315"]).armed()
    assert lab.arrive(goal[0], goal[1], 25.0)
    assert lab.rover.truth().contacts == 0


def test_looks_that_show_nothing_new_end_and_it_stands_for_good():
    lab = BaseLab(inject=["scan_blind@0:0:-45:45"]).armed()
    lab.tick(goal=goal_at(15.0, 0.0))
    assert swing(lab, 30.0) > 1.0
    assert lab.m.look.made == turn.LOOKS
    assert lab.m.status == Status.BLIND
    assert swing(lab, 5.0) < 0.1
    assert abs(lab.rover.truth().x) < 1.0


@pytest.mark.parametrize(
    ("config", "edits"),
    [(ROVER_PX4, ()), (ROVER, [('"skid"', '"ackermann"\nturn_radius_m = 1.5')])],
    ids=["px4", "car"],
)
def test_who_cannot_turn_on_the_spot_stands(config, edits, tmp_path):
    text = config.read_text()
    for old, new in edits:
        text = text.replace(old, new)
    (tmp_path / "base.toml").write_text(text)
    lab = BaseLab(tmp_path / "base.toml", inject=["scan_blind@0:0:-45:45"]).armed()
    lab.tick(goal=goal_at(15.0, 0.0))
    assert swing(lab, 6.0) < 0.1
    assert lab.m.status == Status.BLIND
    assert np.isnan(lab.m.look.heading)


@given(st.integers(0, 10_000), st.floats(-math.pi, math.pi))
def test_the_first_unseen_place_is_where_the_seen_way_ends(seed, angle):
    random = np.random.default_rng(seed)
    chart = occupancy.empty(np.zeros(2))
    shape = chart.seen.shape
    chart = chart._replace(
        seen=random.integers(0, 20, shape).astype(np.int32), cells=(random.random(shape) < 0.1).astype(np.uint8)
    )
    x, e = random.uniform(-1.0, 1.0, 2), np.array([math.cos(angle), math.sin(angle)])
    gap, _ = occupancy.seen_ahead(chart, x, e, 0.5, 3.0, 2)
    place = occupancy.unseen_ahead(chart, x, e, 0.5, 3.0, 2)
    if place is None:
        assert math.isinf(gap)
        return
    along, aside = (place - x) @ e, (place - x) @ np.array([-e[1], e[0]])
    assert along - math.sqrt(0.25 - aside**2) == pytest.approx(gap)
    assert not occupancy.known(chart, place, 2)
    assert occupancy.known(chart, place, -1)

"""A long vehicle is steered as what it is: through gaps that the circle about it does not pass, turning where it fits.

The oracle is the double's geometry: distances of the polygon to the solids, which the controller never sees.
"""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_sim.vehicle import Traits, Vehicle
from rtctl.rover import law, legs, occupancy, outline, path
from rtctl.types import ObstacleEdit, Shape, Status
from rtctl.world import obstacle_table
from tests.base_lab import BaseLab, goal_at
from tests.test_base_sight import configured

FRONT, BACK, HALF = 1.2, 0.8, 0.35  # [m] of the outline
ROUND = "radius_m = 0.5 "
LONG = (ROUND, f"footprint_m = [[{FRONT}, {HALF}], [-{BACK}, {HALF}], [-{BACK}, -{HALF}], [{FRONT}, -{HALF}]] #")
GAP = 3.45  # [m]; the circle about the outline wants 4.5


def box(name: str, x: float, y: float, dx: float, dy: float) -> dict[str, object]:
    """Return a box of dx by dy [m] about x, y."""
    return {"name": name, "type": "box", "size_m": [dx, dy, 2.0], "position_m": [x, y, 0.0]}


ROOM = [
    box("left", 10.0, 0.5 * GAP + 3.0, 3.0, 6.0),
    box("right", 10.0, -0.5 * GAP - 3.0, 3.0, 6.0),
    box("north", 3.0, 7.5, 17.0, 1.0),
    box("south", 3.0, -7.5, 17.0, 1.0),
    box("west", -5.0, 0.0, 1.0, 16.0),
]


def apart(pose: np.ndarray, cells: np.ndarray) -> float:
    """Return the least distance [m] of places (m, 2) [m] to the rectangle at a pose (3,); 0 within it."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    u, v = (cells - pose[:2]) @ np.array([c, s]), (cells - pose[:2]) @ np.array([-s, c])
    du = np.maximum(np.maximum(u - FRONT, -BACK - u), 0.0)
    dv = np.maximum(np.abs(v) - HALF, 0.0)
    return float(np.hypot(du, dv).min())


def test_it_goes_through_a_gap_that_the_circle_about_it_does_not_pass(tmp_path):
    lab = BaseLab(configured(tmp_path, edits=[LONG]), obstacles=ROOM, pose=(2.0, 1.5, 0.0)).armed()
    assert 2.0 * lab.base.margins.room > GAP
    assert lab.arrive(16.0, 3.0, 40.0)
    assert lab.least > 0.6  # clearance_m
    assert lab.seen == ()


@settings(max_examples=25)
@given(seed=st.integers(0, 10_000))
def test_legs_keep_the_outline_off_every_return_at_every_pose(seed, base):
    rng = np.random.default_rng(seed)
    chart = occupancy.empty(np.zeros(2))
    cells = chart.cells.copy()
    for _ in range(60):
        i, j = rng.integers(occupancy.SIZE // 2 - 30, occupancy.SIZE // 2 + 30, 2)
        if abs(i - occupancy.SIZE // 2) > 6 or abs(j - occupancy.SIZE // 2) > 6:
            cells[i, j] = occupancy.SURE
    chart = chart._replace(cells=cells)
    free = occupancy.free_distance(chart, obstacle_table.empty().obstacles, 0.3)
    pose, goal = np.array([0.05, 0.1, rng.uniform(-3.0, 3.0)]), rng.uniform(-9.0, 9.0, 2)
    way = legs.legs_to(free, chart.origin, base.cover, pose, goal, base.margins.aside)
    if not len(way.corners):
        return
    taken = (np.argwhere(cells > 0) + chart.origin + 0.5) * occupancy.CELL
    least = base.margins.aside - math.sqrt(0.5) * occupancy.CELL - 0.5 * occupancy.CELL
    at, yaw = pose[:2], pose[2]
    for corner in way.corners:
        to = math.atan2(*(corner - at)[::-1])
        for t in np.linspace(0.0, 1.0, 30):
            turned = yaw + t * math.remainder(to - yaw, 2.0 * math.pi)
            assert apart(np.array([*at, turned]), taken) > least
            assert apart(np.array([*(at + t * (corner - at)), to]), taken) > least
        at, yaw = corner, to
    assert math.dist(at, goal) < 1e-9


def test_what_stands_beside_its_front_ends_a_turn_before_it_is_touched(base):
    pole = np.array([[0.9, HALF + 0.75]])
    none = obstacle_table.empty().obstacles
    car, sent = Vehicle(Traits("skid", 2.0, 1.5, 2.0)), np.zeros((law.history(base), 2))
    for _ in range(400):
        x = np.array([car.x, car.y])
        coming = law.ahead_of(base, x, car.yaw, sent)[1] - car.yaw
        most = law.way_of_turn(base)
        free = outline.turn_free(base, np.array([*x, car.yaw]), 1.0, most, pole, none)
        w = 1.5 if free >= most else law.held_turn(base, 1.5, free, coming)
        sent = np.concatenate([[[0.0, w]], sent[:-1]])
        car.step(0.0, 0.0, w, base.dt)
    assert car.yaw > 0.1
    assert apart(np.array([car.x, car.y, car.yaw]), pole) > base.margins.stop - 0.1
    # away from it the turn is free
    assert outline.turn_free(base, np.array([car.x, car.y, car.yaw]), -1.0, 0.5, pole, none) == 0.5


def test_a_told_obstacle_ends_a_turn_as_a_seen_one_does(base, ball):
    pole = np.array([0.9, HALF + 0.75])
    none = np.zeros((0, 2))
    seen = outline.turn_free(base, np.zeros(3), 1.0, 1.0, pole[None], obstacle_table.empty().obstacles)
    told = outline.turn_free(base, np.zeros(3), 1.0, 1.0, none, ball(pole, 1e-3))
    assert told == pytest.approx(seen, abs=2.0 * outline.FINE)
    assert 0.0 < seen < 1.0


def test_it_does_not_turn_over_what_it_has_not_seen(tmp_path):
    lab = BaseLab(configured(tmp_path, edits=[LONG]), inject=["scan_blind@0:0:100:260"]).armed()
    lab.tick(goal=goal_at(-8.0, 0.5))
    lab.run(4.0)
    assert lab.m.status == Status.BLIND
    assert abs(lab.rover.truth().yaw) < 0.9


def test_a_way_of_legs_ends_where_a_wall_has_come(base):
    chart = occupancy.empty(np.zeros(2))
    none = obstacle_table.empty().obstacles
    free = occupancy.free_distance(chart, none, 0.3)
    way = legs.legs_to(free, chart.origin, base.cover, np.zeros(3), np.array([8.0, 0.0]), base.margins.aside)
    assert len(legs.legs_left(free, chart.origin, base.cover, np.zeros(3), way, base.margins.aside).corners)
    cells = chart.cells.copy()
    cells[occupancy.SIZE // 2 + 12, :] = occupancy.SURE
    free = occupancy.free_distance(chart._replace(cells=cells), none, 0.3)
    left = legs.legs_left(free, chart.origin, base.cover, np.zeros(3), way, base.margins.aside)
    assert left is path.NO_WAY


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    """Return a long base."""
    return BaseLab(configured(tmp_path_factory.mktemp("long"), edits=[LONG])).base


@pytest.fixture
def ball():
    """Return a function of place (2,) [m] and radius [m]: the obstacles with a ball there."""

    def told(at: np.ndarray, radius: float):
        upright = np.array([1.0, 0.0, 0.0, 0.0])
        place = np.array([*at, 0.3])
        shape = Shape("b", "sphere", np.array([radius, 0, 0, 0]), place, upright, *np.zeros((2, 3)))
        return obstacle_table.edited(obstacle_table.empty(), (ObstacleEdit("b", shape),))[0].obstacles

    return told

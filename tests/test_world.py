"""The table of obstacles: what edits do to it, how it moves, and how it grows old."""

import numpy as np
import pytest

from rtctl.types import ObstacleEdit, Shape
from rtctl.world import obstacle_table
from rtctl.world.obstacle_table import World, advanced, distance_from, edited, empty, oldest, with_static
from tests.lab import leaves, same, sphere

ORIGIN = np.zeros(3)


def put(table: World, *shapes: Shape, age: float = 0.0) -> World:
    table, refusal = edited(table, tuple(ObstacleEdit(s.name, s, age) for s in shapes))
    assert refusal == ""
    return table


def named(table: World) -> set[str]:
    return set(table.names) - {""}


def test_distances_are_measured_to_what_was_put_in():
    table = put(empty(8), sphere("ball", [3.0, 4.0, 0.0], 1.0), sphere("near", [0.0, 0.0, 0.5], 0.7))
    rho = dict(zip(table.names, distance_from(table, ORIGIN), strict=True))
    assert rho["ball"] == pytest.approx(4.0)
    assert rho["near"] == pytest.approx(-0.2)
    assert rho[""] == np.inf


def test_setting_a_name_again_replaces_it_and_takes_no_second_slot():
    table = put(empty(2), sphere("ball", [1.0, 0.0, 0.0], 0.1), sphere("other", [0.0, 5.0, 0.0], 0.1))
    table = put(table, sphere("ball", [2.0, 0.0, 0.0], 0.5))
    assert named(table) == {"ball", "other"}
    assert distance_from(table, ORIGIN).min() == pytest.approx(1.5)


def test_clearing_frees_the_slot_and_a_star_frees_all():
    table = put(empty(2), sphere("a", [1.0, 0.0, 0.0], 0.1), sphere("b", [2.0, 0.0, 0.0], 0.1, (1.0, 0.0, 0.0)))
    one, refusal = edited(table, (ObstacleEdit("a", None),))
    assert (named(one), refusal) == ({"b"}, "")
    assert named(put(one, sphere("c", [3.0, 0.0, 0.0], 0.1))) == {"b", "c"}
    none, refusal = edited(table, (ObstacleEdit("*", None),))
    assert (named(none), refusal) == (set(), "")
    assert not none.moving.any()
    assert distance_from(none, ORIGIN).min() == np.inf


@pytest.mark.parametrize(
    ("edit", "reason"),
    [
        (ObstacleEdit("ghost", None), "no obstacle is named ghost"),
        (ObstacleEdit("third", sphere("third", [1.0, 0.0, 0.0], 0.1)), "all 2 slots are taken"),
        (ObstacleEdit("a", sphere("a", [np.nan, 0.0, 0.0], 0.1)), "obstacle a: position"),
        (ObstacleEdit("a", sphere("a", [1e300, 0.0, 0.0], 0.1)), "obstacle a: position"),
        (ObstacleEdit("a", sphere("a", [0.0, 0.0, 0.0], 0.1, (1e200, 0.0, 0.0))), "obstacle a: velocity"),
        (ObstacleEdit("a", sphere("a", [9e3, 0.0, 0.0], 0.1, (9e3, 0.0, 0.0)), 0.4), "obstacle a: position by now"),
        (ObstacleEdit("a", sphere("a", [0.0, 0.0, 0.0], -1.0)), "obstacle a: dims"),
        (ObstacleEdit("a", sphere("a", [0.0, 0.0, 0.0], 0.1)._replace(type="blob")), "obstacle a: type"),
        (ObstacleEdit("a", sphere("a", [0.0, 0.0, 0.0], 0.1)._replace(wxyz=np.zeros(4))), "obstacle a: wxyz"),
        (ObstacleEdit("a", sphere("a", [0.0, 0.0, 0.0], 0.1), np.nan), "obstacle a: age"),
        (ObstacleEdit("a", sphere("a", [0.0, 0.0, 0.0], 0.1), -1.0), "obstacle a: age"),
        (ObstacleEdit("a", sphere("a", [0.0, 0.0, 0.0], 0.1), np.inf), "obstacle a: age"),
        (ObstacleEdit("*", sphere("*", [0.0, 0.0, 0.0], 0.1)), "wanted a name"),
        (ObstacleEdit("", sphere("", [0.0, 0.0, 0.0], 0.1)), "wanted a name"),
    ],
)
def test_an_edit_that_cannot_be_done_is_refused_by_name_and_changes_nothing(edit: ObstacleEdit, reason: str):
    table = put(empty(2), sphere("a", [1.0, 0.0, 0.0], 0.1), sphere("b", [2.0, 0.0, 0.0], 0.1))
    before = distance_from(table, ORIGIN)
    after, refusal = edited(table, (edit,))
    assert reason in refusal
    assert named(after) == {"a", "b"}
    np.testing.assert_array_equal(distance_from(after, ORIGIN), before)


def test_a_refused_edit_does_not_keep_the_others_out():
    bad = ObstacleEdit("bad", sphere("bad", [np.inf, 0.0, 0.0], 0.1))
    table, refusal = edited(empty(4), (bad, ObstacleEdit("good", sphere("good", [1.0, 0.0, 0.0], 0.1))))
    assert "bad" in refusal
    assert named(table) == {"good"}


def test_edits_of_one_request_are_what_the_same_edits_one_by_one_are():
    ball, box = sphere("ball", [1.0, 0.0, 0.0], 0.1, (0.2, 0.0, 0.0)), sphere("box", [0.0, 1.0, 0.0], 0.2)
    part = sphere("part", [0.0, 0.0, 1.0], 0.1)._replace(group="union")
    start = advanced(put(empty(4, creep=0.1), ball, box._replace(name="old"), age=0.2), 0.05)
    edits = (
        ObstacleEdit("ball", ball, 0.3),
        ObstacleEdit("box", box, 0.1, True),
        ObstacleEdit("old", None),
        ObstacleEdit("ball", ball._replace(position=np.array([2.0, 0.0, 0.0]))),
        ObstacleEdit("part", part),
        ObstacleEdit("box", None),
        ObstacleEdit("box", box._replace(group="union"), 0.2),
        ObstacleEdit("ghost", None),
    )
    at_once, refusal = edited(start, edits)
    one_by_one = start
    for each in edits:
        one_by_one, _ = edited(one_by_one, (each,))
    assert same(at_once, one_by_one)
    assert refusal == "no obstacle is named ghost"
    assert named(at_once) == {"ball", "box", "part"}


def test_a_moving_obstacle_is_where_its_velocity_takes_it_and_one_at_rest_stays():
    table = put(empty(4), sphere("ball", [2.0, 0.0, 0.0], 0.1, (-0.5, 0.0, 0.0)), sphere("rock", [0.0, 9.0, 0.0], 0.1))
    for _ in range(100):
        table = advanced(table, 0.01)
    rho = dict(zip(table.names, distance_from(table, ORIGIN), strict=True))
    assert rho["ball"] == pytest.approx(2.0 - 0.5 - 0.1, abs=1e-9)
    assert rho["rock"] == pytest.approx(8.9, abs=1e-12)


def test_an_old_observation_is_brought_up_to_now():
    late = put(empty(1), sphere("ball", [2.0, 0.0, 0.0], 0.1, (-0.5, 0.0, 0.0)), age=0.4)
    assert distance_from(late, ORIGIN)[0] == pytest.approx(2.0 - 0.2 - 0.1)
    assert oldest(late) == pytest.approx(0.4)


def test_only_what_moves_grows_stale_and_being_seen_makes_it_fresh():
    table = put(empty(4), sphere("ball", [2.0, 0.0, 0.0], 0.1, (0.1, 0.0, 0.0)), sphere("rock", [5.0, 0.0, 0.0], 0.1))
    for _ in range(30):
        table = advanced(table, 0.01)
    assert oldest(table) == pytest.approx(0.3)
    table = put(table, sphere("ball", [2.03, 0.0, 0.0], 0.1, (0.1, 0.0, 0.0)))
    assert oldest(table) == 0.0
    stopped = put(advanced(table, 0.2), sphere("ball", [2.03, 0.0, 0.0], 0.1))
    assert oldest(advanced(stopped, 10.0)) == 0.0


def test_an_obstacle_that_only_turns_moves():
    spinning = sphere("bar", [1.0, 0.0, 0.0], 0.1)._replace(type="capsule", omega=np.array([0.0, 0.0, 1.0]))
    table = advanced(put(empty(1), spinning._replace(dims=np.array([0.1, 0.5, 0.0, 0.0]))), 0.1)
    assert oldest(table) == pytest.approx(0.1)


def test_the_configs_own_obstacles_never_grow_stale():
    table = with_static(empty(4), (sphere("wall", [1.0, 0.0, 0.0], 0.1, (0.1, 0.0, 0.0)),))
    assert oldest(advanced(table, 100.0)) == 0.0
    assert "wall" in table.names


def test_the_configs_own_obstacles_are_always_there():
    table = put(with_static(empty(4), (sphere("wall", [1.0, 0.0, 0.0], 0.1),)), sphere("ball", [2.0, 0.0, 0.0], 0.1))
    cleared, refusal = edited(table, (ObstacleEdit("*", None),))
    assert (named(cleared), refusal) == ({"wall"}, "")
    for shape in (None, sphere("wall", [9.0, 0.0, 0.0], 0.1)):
        same, refusal = edited(table, (ObstacleEdit("wall", shape),))
        assert "wall: is the config's own" in refusal
        assert distance_from(same, ORIGIN).min() == pytest.approx(0.9)


def test_every_slot_can_be_used_and_the_last_is_seen():
    table = empty()
    shapes = tuple(sphere(f"s{i}", [10.0 + i, 0.0, 0.0], 0.1) for i in range(obstacle_table.SLOTS - 1))
    table = put(table, *shapes, sphere("last", [1.0, 0.0, 0.0], 0.1))
    assert len(named(table)) == obstacle_table.SLOTS
    assert distance_from(table, ORIGIN).min() == pytest.approx(0.9)


def test_no_edit_and_no_step_changes_the_table_it_was_given():
    table = put(empty(4), sphere("ball", [2.0, 0.0, 0.0], 0.1, (0.1, 0.0, 0.0)))
    arrays: list[np.ndarray] = []
    leaves(table, arrays.append)
    before = [a.tobytes() for a in arrays]
    advanced(table, 0.1)
    put(table, sphere("ball", [0.0, 0.0, 0.0], 0.2), sphere("more", [1.0, 0.0, 0.0], 0.2))
    edited(table, (ObstacleEdit("*", None),))
    assert [a.tobytes() for a in arrays] == before

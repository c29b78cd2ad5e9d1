"""The circulating field on a point mass: what it gets around, and that it gives up in time.

The oracle is the geometry: distances from the shapes' own definitions, not from the controller's memory.
"""

from typing import NamedTuple

import numpy as np
import pytest

from rtctl.arm import escape
from rtctl.arm.escape import Escape, Phase
from rtctl.arm.model import Model
from rtctl.arm.osc import MotionParams, approach_speed
from rtctl.control.firas import field_params, firas
from rtctl.types import F64, Goal, Shape, Task
from rtctl.world.primitives import Obstacles, distances, obstacles_empty, with_shape

DT = 1e-3
EYE = np.eye(3)
UNIT = np.array([1.0, 0.0, 0.0, 0.0])
MOTION = MotionParams(200.0, 2.0 * np.sqrt(200.0), 0.5, 5.0, 1.5, 15.0, 0.0, 6.0, np.ones(3), 0.02, 0.2, 0.8)
FIELD = field_params(0.5, 0.1, 0.02, DT, 1.0, 0.1, 50.0)
START, GOAL = np.array([-0.5, 0.0, 0.0]), np.array([0.5, 0.0, 0.0])
ASKED = Goal(GOAL, UNIT, Task.POSITION, 1e-3, 1e-2)


def box(*row: float) -> tuple[F64, F64]:
    """Return size and centre."""
    return np.array(row[:3]), np.array(row[3:])


WALL = [box(0.04, 0.5, 0.5, 0.0, 0.02, 0.03)]
# open towards the start: the way out leads back, past the place where the goal is nearest
POCKET = [
    box(0.04, 1.6, 1.6, 0.1, 0.0, 0.0),
    *(box(1.4, 0.04, 1.6, -0.6, side, 0.0) for side in (0.4, -0.4)),
    *(box(1.4, 1.6, 0.04, -0.6, 0.0, side) for side in (0.4, -0.4)),
]


def world(boxes: list[tuple[F64, F64]]) -> Obstacles:
    table = obstacles_empty(8)
    for k, (size, at) in enumerate(boxes):
        shape = Shape(f"b{k}", "box", np.array([*size, 0.0]), at, UNIT, np.zeros(3), np.zeros(3))
        table = with_shape(table, k, shape)
    return table


def clearance(boxes: list[tuple[F64, F64]], X: F64) -> float:
    """Return the least distance of positions (T, 3) to the boxes, by their definition."""
    outside = [np.linalg.norm(np.maximum(np.abs(X - at) - size / 2.0, 0.0), axis=1) for size, at in boxes]
    return float(np.min(outside))


def mass(x: F64) -> Model:
    """Return the model of a unit mass at x: three sliding joints."""
    J = np.vstack([EYE, np.zeros((3, 3))])
    none = np.zeros(0)
    Lambda_inv = np.zeros((6, 6))
    Lambda_inv[:3, :3] = EYE
    return Model(
        x,
        np.zeros(3),
        EYE,
        EYE,
        np.zeros(3),
        np.zeros(3),
        x,
        EYE,
        J,
        np.zeros(6),
        x[None],
        EYE[None],
        EYE[None],
        Lambda_inv,
        none,
        none,
    )


class Flight(NamedTuple):
    X: F64  # (T, 3)
    phases: list[Phase]
    speed: float  # [m/s] largest


def fly(obstacles: Obstacles, seconds: float, escaping: bool = True) -> Flight:
    """Return the path of a unit mass under the law's field, sent by the escape."""
    x, xd, v_ref, s = START.copy(), np.zeros(3), np.zeros(3), Escape()
    push, still, X, phases, speed = np.zeros(3), 0, [], [], 0.0
    for _ in range(round(seconds / DT)):
        e, model = GOAL - x, mass(x)
        still = still + 1 if np.linalg.norm(xd) < 0.01 else 0
        if escaping and s.phase == Phase.NONE and still == 300 and np.linalg.norm(e) > 0.1:
            s = escape.begun(s, float(np.linalg.norm(e)), push)
        elif s.phase == Phase.CHOOSING:
            s = escape.chosen(s, model, x, ASKED, obstacles, START, 3.0, 0.1, 0.02)
        elif s.phase != Phase.NONE:
            s = escape.advance(s._replace(phase=int(s.phase)), e, push, bool(np.linalg.norm(xd) < 0.01), DT)
        if s.active:
            e = escape.way(s.n, s.b, push, MOTION)
        d = float(np.linalg.norm(e))
        wanted = e / max(d, 1e-9) * approach_speed(d, MOTION.k_p / MOTION.k_v, MOTION.v_max, MOTION.a_max)
        step = wanted - v_ref
        v_ref = v_ref + step * min(1.0, MOTION.a_max * DT / max(float(np.linalg.norm(step)), 1e-12))
        rho, n = distances(x[None], np.zeros(1), obstacles)
        push, damp = np.zeros(3), np.zeros(3)
        for k in np.flatnonzero(obstacles.active):
            a, c = firas(
                rho[k, 0], float(n[k, :, 0] @ xd), FIELD.rho0, FIELD.rho_min, FIELD.rho_num, FIELD.eta, FIELD.k_d
            )
            push, damp = push + a * n[k, :, 0], damp + c * n[k, :, 0]
        xd = xd + DT * (-MOTION.k_v * (xd - v_ref) + push + damp)
        x = x + DT * xd
        X.append(x.copy())
        phases.append(s.phase)
        speed = max(speed, float(np.linalg.norm(xd)))
    return Flight(np.array(X), phases, speed)


def test_a_wall_that_stalls_the_plain_law_is_got_around():
    table = world(WALL)
    plain = fly(table, 4.0, escaping=False)
    assert np.linalg.norm(plain.X[-1] - plain.X[-1000]) < 1e-3  # it rests
    assert np.linalg.norm(plain.X[-1] - GOAL) > 0.4
    free = fly(table, 8.0)
    assert np.linalg.norm(free.X[-1] - GOAL) < 1e-3
    assert Phase.OTHER not in free.phases
    assert free.phases[-1] == Phase.NONE
    assert clearance(WALL, free.X) > 0.015
    assert free.speed <= 1.02 * MOTION.v_max


def test_the_shorter_way_around_is_taken():
    above = [box(0.04, 0.8, 0.5, 0.0, 0.0, -0.15)]  # 0.10 m to its upper edge, 0.4 m to the others
    X = fly(world(above), 5.0).X
    assert X[:, 2].max() > 0.1
    assert np.abs(X[:, 1]).max() < 0.1
    assert np.linalg.norm(X[-1] - GOAL) < 1e-3


def test_a_pocket_is_given_up_in_bounded_time_after_both_sides():
    flight = fly(world(POCKET), 20.0)
    assert [p for p, q in zip(flight.phases[1:], flight.phases, strict=False) if p != q] == [
        Phase.CHOOSING,
        Phase.FIRST,
        Phase.OTHER,
        Phase.GIVEN_UP,
    ]
    assert np.linalg.norm(flight.X[-1] - GOAL) > 0.3
    assert np.linalg.norm(flight.X[-1] - flight.X[-500]) < 1e-2  # back in the pocket, at rest
    assert clearance(POCKET, flight.X) > 0.015


def test_an_escape_stays_along_the_axes_that_the_goal_asks_for():
    plane, line = (ASKED._replace(task=task) for task in (Task.X | Task.Y, Task.X))
    push = escape.push_of(mass(START), np.array([-2.0, 1.0, 5.0]), plane)
    assert push.tolist() == [-2.0, 1.0, 0.0]

    def chosen(s: Escape, goal: Goal) -> Escape:
        while s.phase == Phase.CHOOSING:
            s = escape.chosen(s, mass(START), START, goal, world(WALL), START, 3.0, 0.1, 0.02)
        return s

    s = chosen(escape.begun(Escape(), 1.0, push), plane)
    way = escape.way(s.n, s.b, push, MOTION)
    assert s.phase == Phase.FIRST
    assert abs(way[2]) < 1e-12
    assert abs(way @ push) < 0.4 * np.linalg.norm(way) * np.linalg.norm(push)
    assert chosen(escape.begun(Escape(), 1.0, push[0] * EYE[0]), line).phase == Phase.GIVEN_UP  # nowhere to go


@pytest.mark.parametrize("d", [0.99, 1.0])
def test_no_second_escape_begins_where_the_first_one_did(d: float):
    old = Escape(hit=1.0)
    assert escape.begun(old, d, EYE[0]).phase == Phase.GIVEN_UP
    assert escape.begun(old, 0.9, EYE[0]).phase == Phase.CHOOSING


def test_the_circulation_is_across_the_push_and_at_its_speed():
    s = Escape(Phase.FIRST, 1.0, EYE[0], EYE[2])
    way = escape.way(s.n, s.b, 5.0 * EYE[0], MOTION)
    u = way / np.linalg.norm(way)
    assert u @ np.cross(EYE[2], EYE[0]) > 0.9
    assert -0.4 < u @ EYE[0] < 0.0
    speed = approach_speed(float(np.linalg.norm(way)), MOTION.k_p / MOTION.k_v, MOTION.v_max, MOTION.a_max)
    assert speed == pytest.approx(escape.SPEED * MOTION.v_max)

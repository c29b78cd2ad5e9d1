"""The border: one layout of each record whatever the robot, and plain Python as the oracle of the compiled call."""

from collections.abc import Iterator

import numpy as np
import pytest

from rtctl.arm import pipe, servo_level
from rtctl.arm.flat import model_in, parameters_of
from rtctl.arm.hot import HOT, record_of
from rtctl.arm.memory import Memory
from rtctl.arm.osc import operational_space
from rtctl.arm.pipe import tick
from rtctl.arm.task import selection
from rtctl.types import TOOL_Z, Link, Request, Task, Verb
from tests.lab import PANDA_HOME, ROOT, Standing, at_rest, goal, healthy, robot, same, seen, sphere

PLANAR4 = ROOT / "configs" / "planar4.toml"


def test_the_layout_of_each_record_is_one_whatever_the_robot() -> None:
    """numba numbers record types by process: a second layout in its cache could be run as the first."""
    planar = robot(PLANAR4)
    assert planar.n != robot().n
    assert planar.constants.dtype == robot().constants.dtype
    memories = at_rest(robot(), PANDA_HOME), at_rest(planar, planar.home)
    assert {m.hot.shape for m in memories} == {(HOT.itemsize // 8,)}
    assert all(HOT[name].base.itemsize == 8 for name in HOT.names or ())  # so that nothing is padded or unaligned


def test_every_robot_and_every_kind_of_tick_runs_the_same_compiled_call() -> None:
    arm, planar = Standing(), robot(PLANAR4)
    arm.tick(Request(goal=goal(arm.memory, [0.5, 0.3, 0.5])))
    arm.tick(seen(sphere("ball", [0.5, 0.2, 0.5], 0.06, (0.0, -0.05, 0.0)), age=0.02))
    arm.tick(Request(Verb.STOP))
    arm.tick(link=Link.CORRUPT)
    tick(planar, at_rest(planar, planar.home), healthy(planar.home, 0, tau=np.zeros(planar.n)), Request())
    assert len(servo_level.servo.signatures) == 1  # type: ignore[attr-defined]


def session() -> Iterator[Memory]:
    """Yield the memories of an arm that is asked for this and that."""
    arm = Standing()
    for k in range(24):
        requests = {
            2: Request(goal=goal(arm.memory, [0.5, 0.3, 0.5])),
            5: seen(sphere("ball", [0.5, 0.2, 0.5], 0.06, (0.0, -0.05, 0.0)), age=0.02),
            15: Request(Verb.STOP),
        }
        arm.tick(requests.get(k, Request()), qd=np.full(7, 0.02 * (k % 3)))
        yield arm.memory


def test_plain_python_computes_the_same_bits(monkeypatch: pytest.MonkeyPatch) -> None:
    compiled = list(session())
    for name in ("_sense", "act", "limited", "_move", "_uneventful", "_stop_torque", "_torque_asked", "observe"):
        monkeypatch.setattr(servo_level, name, getattr(servo_level, name).py_func)
    monkeypatch.setattr(pipe, "servo", servo_level.servo.py_func)  # type: ignore[attr-defined]
    assert same(list(session()), compiled)


def test_a_tick_leaves_what_it_was_given_as_it_was() -> None:
    arm = Standing()
    arm.tick(seen(sphere("ball", [0.5, 0.2, 0.5], 0.06, (0.0, -0.05, 0.0)), age=0.02))
    before = arm.memory
    kept = [each.copy() for each in (before.hot, before.table, before.shapes, before.parameters)]
    arm.ticks(8)
    assert same(kept, [before.hot, before.table, before.shapes, before.parameters])
    assert not same(kept[:2], [arm.memory.hot, arm.memory.table])


@pytest.mark.parametrize("task", [Task.POSE, Task.POSITION | Task.DIRECTION, Task.X | Task.RZ])
def test_the_parameters_hold_the_model_and_its_task_space(task: Task) -> None:
    arm = robot()
    model = arm.body.evaluate(PANDA_HOME, np.full(7, 0.1), arm.points, arm.own)
    found, space = model_in(parameters_of(model, int(task), TOOL_Z, arm.motion), arm.n, len(model.P))
    assert same(tuple(found), tuple(model))
    S = selection(int(task), TOOL_Z, model.R)
    wanted = operational_space(model.J, model.A_inv, model.Lambda_inv, S, arm.motion)
    assert same(tuple(map(np.asarray, space)), tuple(map(np.asarray, wanted)))


def test_a_field_of_the_memory_is_replaced_in_a_copy() -> None:
    memory = at_rest(robot(), PANDA_HOME)
    aim = goal(memory, [0.4, 0.1, 0.5])._replace(posture=PANDA_HOME)
    other = memory._replace(goal=aim, blockers=1 << 63, still=3)
    assert memory.goal is None
    assert other.goal is not None
    assert same(tuple(other.goal), tuple(aim))
    assert (other.blockers, other.still, memory.still) == (1 << 63, 3, 0)
    assert other._replace(goal=None).goal is None
    assert record_of(other.hot)["tick"].item() == memory.tick
    with pytest.raises(AttributeError):
        _ = memory.nothing

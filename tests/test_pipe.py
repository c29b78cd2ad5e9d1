"""The tick is a function: equal inputs give equal bits, nothing else goes in, nothing else comes out."""

import builtins
import json
import os
import random
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec.structs import astuple

from rtctl import design as cfg
from rtctl.app.arm_link import first_feedback
from rtctl.app.sim import simulate
from rtctl.arm.law import prepared
from rtctl.arm.memory import Memory
from rtctl.arm.pipe import compile_part, initial, tick, warm
from rtctl.hal.clock import lockstep
from rtctl.hal.messages import Bounds, decode, request_of
from rtctl.kernel.rotations import quat_of
from rtctl.log import read, segments
from rtctl.log.read.inputs import inputs
from rtctl.types import Command, Drive, Feedback, ObstacleEdit, Record, Request, State, Task, Verb
from tests.arms import PANDA_HOME
from tests.bodies import cloud_shape
from tests.lab import DOWN, PANDA, Lab, Standing, at_rest, goal, healthy, lab, leaves, robot, same, seen, sphere

ROOT = Path(__file__).parents[1]
MESSAGES: tuple[dict[str, Any], ...] = (
    {"verb": "goal", "position_m": [0.5, 0.2, 0.5]},
    {"verb": "goal", "position_m": [0.5, 0.1, 0.5], "rpy_rad": [3.1, 0.0, 0.1]},
    {"verb": "goal", "position_m": [0.5, 0.2, 0.5], "direction": [0.1, 0.0, -1.0], "tool_axis": "z"},
    {"verb": "goal", "direction": [0.1, 0.0, -1.0]},
    {"verb": "goal", "position_m": [0.5, 0.2, 0.5], "axes": ["x", "y"]},
    {"verb": "obstacle", "set": {"name": "o", "type": "box", "size_m": [0.1, 0.1, 0.1], "position_m": [0.5, 0.6, 0.5]}},
    {"verb": "obstacle", "clear": "o"},
)
BALL = sphere("ball", [0.5, 0.15, 0.5], 0.06, (0.0, -0.05, 0.0))


def busy_memory() -> tuple[Memory, Feedback, Request]:
    """Return inputs of a tick that uses every block: a goal under way, a moving obstacle near, an edit and a goal."""
    arm = Standing()
    arm.tick(Request(goal=goal(arm.memory, [0.5, 0.3, 0.5], DOWN), obstacles=(ObstacleEdit("ball", BALL),)))
    arm.ticks(30, qd=np.full(7, 0.05))
    near = sphere("near", [0.307, 0.0, 0.40], 0.02)
    request = Request(Verb.STOP, goal(arm.memory, [0.4, 0.2, 0.6]), (ObstacleEdit("near", near),))
    return arm.memory, healthy(arm.q, arm.slot, tau=arm.command.tau, qd=np.full(7, 0.02)), request


def everything(value: tuple[Memory, Command, Record]) -> bytes:
    """Return all bytes of what a tick gave."""
    found: list[bytes] = []
    leaves(value, lambda a: found.append(a.tobytes()))
    return b"".join(found) + repr([v for v in astuple(value[0]) if not isinstance(v, np.ndarray | tuple)]).encode()


def test_equal_inputs_give_equal_bits():
    memory, feedback, request = busy_memory()
    one, two = (tick(robot(), memory, feedback, request) for _ in range(2))
    assert same(one, two)
    assert everything(one) == everything(two)


def test_what_was_computed_in_between_leaves_no_trace():
    memory, feedback, request = busy_memory()
    one = tick(robot(), memory, feedback, request)
    other = at_rest(robot(), PANDA_HOME + 0.3, state=State.RUN)
    tick(robot(), other, healthy(PANDA_HOME + 0.3, 7), seen(sphere("x", [0.4, 0.1, 0.4], 0.1)))
    assert same(one, tick(robot(), memory, feedback, request))


def test_inputs_are_left_as_they_were():
    memory, feedback, request = busy_memory()
    arrays: list[np.ndarray[Any, Any]] = []
    leaves((memory, feedback, request), arrays.append)
    before = [a.tobytes() for a in arrays]
    for _ in range(3):
        tick(robot(), memory, feedback, request)
    assert [a.tobytes() for a in arrays] == before


def test_what_comes_out_is_not_overwritten_by_the_next_tick():
    memory, feedback, request = busy_memory()
    one = tick(robot(), memory, feedback, request)
    before = everything(one)
    arm_memory = one[0]
    for k in range(5):
        arm_memory = tick(robot(), arm_memory, feedback._replace(slot=feedback.slot + k), Request())[0]
    assert everything(one) == before


def test_the_tick_reads_no_clock_no_file_and_no_chance(monkeypatch: pytest.MonkeyPatch):
    memory, feedback, request = busy_memory()
    wanted = tick(robot(), memory, feedback, request)

    def forbidden(*args: Any, **kwargs: Any) -> Any:
        raise AssertionError("the tick looked outside")

    for name in ("time", "time_ns", "monotonic", "monotonic_ns", "perf_counter", "perf_counter_ns", "sleep"):
        monkeypatch.setattr(time, name, forbidden)
    for module, names in (
        (builtins, ("open", "print", "input")),
        (os, ("open", "stat", "read", "write", "urandom", "getenv")),
        (socket, ("socket",)),
        (random, ("random", "randrange", "gauss")),
        (np.random, ("default_rng", "random", "rand", "randn")),
    ):
        for name in names:
            monkeypatch.setattr(module, name, forbidden)
    got = tick(robot(), memory, feedback, request)
    monkeypatch.undo()
    assert same(got, wanted)


@pytest.mark.parametrize("part", [0, 1])
def test_what_two_processes_compile_ahead_has_the_arguments_of_now(part: int) -> None:
    compile_part(robot(), part)


def test_warming_compiles_all_that_a_run_needs():
    """In a process of its own: here other tests have compiled before."""
    script = "from tests.test_pipe import run_after_warming; run_after_warming()"
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def run_after_warming() -> None:
    """Play what a run may meet, and hold the kernels to the signatures that warming has left."""
    warm(robot())
    kernels = {
        f"{module}.{name}": thing
        for module in sorted(sys.modules)
        if module.startswith(("rtctl.kernel.", "rtctl.world.", "rtctl.control.", "rtctl.arm."))
        for name, thing in vars(sys.modules[module]).items()
        if hasattr(thing, "signatures")
    }
    assert len(kernels) > 30
    before = {name: len(kernel.signatures) for name, kernel in kernels.items()}
    with lab() as here:
        eventful(here)
        dust = np.random.default_rng(0).integers(-999, 999, (1000, 3))
        cloud = cloud_shape(dust, 1e-4, 0.01, np.array([0.6, 0.3, 0.5]))
        for feed in (True, False):
            here.step(Request(obstacles=(ObstacleEdit("dust", cloud, 0.01, feed), ObstacleEdit("again", cloud))))
            here.run(0.01)
    with lab() as here:
        here.running()
        arm = robot()
        bounds = Bounds(tuple(arm.base.tolist()), arm.reach, arm.tolerance, arm.tolerance_rot, arm.axes)
        for said in MESSAGES:
            message = decode(json.dumps(said).encode())
            here.step(request_of(message, bounds, lambda: quat_of(here.memory.tip.R).tolist()))
            assert not here.memory.refusal
            here.run(0.01)
    late = {name: kernel.signatures[before[name] :] for name, kernel in kernels.items()}
    assert not any(late.values()), {name: found for name, found in late.items() if found}


# ---- replay


def eventful(here: Lab) -> Lab:
    """Play a session with goals, obstacles, refusals, missed slots, a fault and a reset."""
    here.running()
    here.step(seen(BALL, age=0.02))
    here.ask([0.5, 0.3, 0.5], DOWN)
    here.run(0.3)
    here.step(Request(Verb.ARM))  # refused
    here.step(Request(obstacles=(ObstacleEdit("nobody", None),)))  # refused
    here.step(missed=2)
    here.ask([0.45, 0.0, 0.6])
    here.run(0.2)
    here.step(Request(goal=goal(here.memory, [0.45, 0.0, 0.6])._replace(task=Task.X | Task.DIRECTION, axis=DOWN[:3])))
    here.run(0.1)
    for _ in range(3):
        here.step(missed=1)
    here.run(0.3)
    here.step(Request(Verb.RESET, obstacles=(ObstacleEdit("*", None),)))
    here.until(State.IDLE)
    return here


def test_a_session_is_replayed_to_the_bit_from_what_went_in():
    with lab() as here:
        turns, requests = eventful(here).turns, here.requests
    memory = initial(robot(), here.first)
    states = set()
    for turn, request in zip(turns, requests, strict=True):
        memory, command, record = tick(robot(), memory, turn.feedback, request)
        assert record.tobytes() == turn.record.tobytes()
        assert same(command, turn.command)
        states.add(memory.state)
    assert same(memory, here.memory)
    assert states == {State.IDLE, State.ARMED, State.RUN, State.SAFE_STOP, State.STOPPING}


SCENARIO = f"""
robot = "{PANDA}"
duration_s = 1.2
[[goal]]
at_s = 0.4
position_m = [0.5, 0.2, 0.5]
hold = "orientation"
[[goal]]
at_s = 0.8
position_m = [0.5, -0.1, 0.45]
[[obstacle]]
name = "ball"
type = "sphere"
radius_m = 0.05
position_m = [0.55, 0.5, 0.5]
velocity_m_s = [0.0, -0.1, 0.0]
"""


def test_a_log_holds_all_that_went_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(cfg, "build", lambda config, path: robot())
    (tmp_path / "short.toml").write_text(SCENARIO)
    figures = simulate(tmp_path / "short.toml", log=tmp_path / "short.mcap")
    logs = [read(path) for path in segments(tmp_path / "short.mcap")]
    q = np.frombuffer(bytes.fromhex(logs[0].header.extra["q_handshake"]))
    memory = initial(robot(), first_feedback(q))
    goals, edits, ticks = 0, 0, 0
    for logged in inputs(logs):
        memory, _, record = tick(robot(), memory, logged.feedback, logged.request)
        assert record[0].tobytes() == logged.record.tobytes()
        goals, edits = goals + (logged.request.goal is not None), edits + len(logged.request.obstacles)
        ticks += 1
    assert ticks == figures["ticks"]
    assert goals == 2
    assert edits > 40


# ---- timing


@pytest.mark.parametrize(("servo", "model"), [(1000, 1000), (1000, 250), (225, 100), (500, 30)])
def test_the_model_is_evaluated_at_its_own_rate(servo: int, model: int):
    arm = prepared(robot()._replace(dt=1.0 / servo, model_dt=1.0 / model))
    memory = at_rest(arm, PANDA_HOME)
    evaluated = []
    for k in range(servo):
        memory, _, record = tick(arm, memory, healthy(PANDA_HOME, k, arm.dt), Request())
        evaluated.append(bool(record["model_evaluated"][0]))
    assert sum(evaluated) == pytest.approx(model, abs=1)
    gaps = np.diff(np.flatnonzero(evaluated))
    assert gaps.max() - gaps.min() <= 1  # evenly


def test_the_record_tells_what_came_in_and_went_out():
    memory, feedback, request = busy_memory()
    after, command, record = tick(robot(), memory, feedback._replace(lateness=1e-4, compute=2e-4), request)
    r = record[0]
    for name, value in (
        ("q", feedback.q),
        ("qd", feedback.qd),
        ("tau_measured", feedback.tau),
        ("age", feedback.age),
        ("slot", feedback.slot),
        ("lateness", 1e-4),
        ("compute", 2e-4),
        ("verb", Verb.STOP),
        ("tau_sent", command.tau),
        ("command", command.drive),
        ("state", after.state),
        ("faults", after.in_force),
        ("tick", memory.tick + 1),
    ):
        np.testing.assert_array_equal(r[name], value, err_msg=name)
    assert r["time"] == pytest.approx(feedback.slot * robot().dt)
    assert np.isfinite(r["rho"][:2]).all()
    assert np.isinf(r["rho"][2:]).all()


def test_no_torque_is_sent_but_as_a_torque_command():
    for state in (State.IDLE, State.FAULT):
        arm = Standing(state)
        arm.tick()
        assert arm.drive() == Drive.DISABLE
        assert not arm.command.tau.any()


def test_missed_slots_are_time_that_passed():
    with lab() as here:
        here.running()
        here.ask([0.5, 0.3, 0.5], DOWN)
        here.run(0.2)
        here.step(missed=2)
        tip, truth = here.memory.tip.x, here.simulator.plant.tip_pose()[0]
        assert np.linalg.norm(tip - truth) < 2e-3
        here.run(0.1)
        assert here.memory.state == State.RUN


def test_lockstep_counts_slots_without_a_clock():
    slots = lockstep()
    assert [next(slots) for _ in range(3)] == [(0, 0, 0.0), (1, 0, 0.0), (2, 0, 0.0)]

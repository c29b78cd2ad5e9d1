"""Everything at once: any order of operators, goals, obstacles, losses and faults, against the promises of the tick.

Drives, bus bytes and plant are the virtual robot's; time is what the machine makes of it. Every rule is something that
can happen to a controller, every check of `_holds` something that is promised whatever happens.
"""

import math
from typing import Any

import numpy as np
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, precondition, rule

from firmware_sim.drive import State as DriveState
from firmware_sim.inject import KINDS, Fault
from firmware_sim.simulator import open_simulator
from rtctl.arm.faults import FAULTS, TABLE, severity
from rtctl.protocol import frame
from rtctl.types import (
    TOOL_Z,
    Command,
    Drive,
    Goal,
    Link,
    ObstacleEdit,
    Request,
    Severity,
    Shape,
    State,
    Task,
    Verb,
)
from tests.lab import PANDA, Lab, robot

NS = 1_000_000_000
OPERATOR = (Verb.RESET, Verb.TERM)  # what may leave a latched state
LATCHED = sum(1 << i for i, f in enumerate(FAULTS) if f.clear != "A")
LATCHED_STATES = (State.SAFE_STOP, State.FAULT)

number = st.one_of(st.floats(-1.0, 1.0), st.sampled_from([math.nan, math.inf, -math.inf, 0.0, 1e300, -1e9, 5e-324]))
near = st.tuples(st.floats(0.2, 0.7), st.floats(-0.5, 0.5), st.floats(0.1, 0.8))
anywhere = st.one_of(near, st.tuples(number, number, number))
unit = st.sampled_from([(0.0, 1.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), (0.5, 0.5, 0.5, 0.5)])
turned = st.one_of(unit, st.tuples(number, number, number, number))
sizes = st.tuples(*[st.floats(0.01, 0.3)] * 3, st.floats(1.0, 8.0))
joints = st.integers(-1, 6)


class Session(RuleBasedStateMachine):
    """One session of an arm from power-on."""

    def __init__(self) -> None:
        super().__init__()
        self.lab: Lab | None = None

    @initialize(
        q=st.sampled_from([None, (0.0, -0.785, 0.0, -3.12, 0.0, 1.571, 0.785), (0.0, 1.2, 0.0, -0.09, 0, 1.6, 0)])
    )
    def power_on(self, q: tuple[float, ...] | None) -> None:
        self.lab = Lab(PANDA, open_simulator(PANDA, None, q, seed=1))
        self.sent = Command(Drive.DISABLE, np.zeros(7))

    def teardown(self) -> None:
        if self.lab is not None:
            self.lab.simulator.close()

    # ---- what is promised

    def _step(self, request: Request = Request(), missed: int = 0) -> None:  # noqa: B008 - a frozen value
        """Play a slot and hold the tick to its promises."""
        here = self.lab
        assert here is not None
        before = here.memory
        turn = here.step(request, missed)
        command, feedback, memory = turn.command, turn.feedback, here.memory
        here.turns.clear()
        here.requests.clear()
        self._torque_is_bounded(command, feedback)
        self._stops_are_kept(before, request)
        for name in turn.record.dtype.names or ():
            values = turn.record[name][0]
            # not finite may be only what the bus said, and the distance to what is not there
            if turn.record[name].dtype.kind == "f" and name != "rho":
                assert np.isfinite(values).all(), name
        assert not np.isnan(turn.record["rho"]).any()
        assert memory.state in (State.IDLE, State.ARMED, State.RUN, State.STOPPING, *LATCHED_STATES)
        assert (memory.goal is not None) <= (memory.state == State.RUN)
        for drive in here.simulator.drives:  # one that hears nothing for W drives nothing
            if 0 < drive.timeout_ns < drive.silence_ns:  # judged when the next physics step begins
                assert drive.state is not DriveState.ENABLED
        self.sent = command

    def _torque_is_bounded(self, command: Command, feedback: Any) -> None:
        arm, tau = robot(), command.tau
        assert np.isfinite(tau).all()
        assert (np.abs(tau) <= arm.tau_max).all()
        state = self.lab.memory.state  # type: ignore[union-attr]
        if state in (State.IDLE, State.FAULT):
            assert command.drive in (Drive.DISABLE, Drive.CLEAR)
        if command.drive != Drive.TORQUE:
            assert not tau.any()
        else:
            step = arm.tau_rate * arm.dt * (1 + 1e-9) + 1e-9
            follows = np.abs(tau - self.sent.tau) <= step
            # a drive that does something else is started from what it does; its word is as old as its reply
            lag = max(1, round(float(feedback.age.max()) / arm.dt))
            near_echo = np.abs(tau - np.clip(feedback.tau, -arm.tau_max, arm.tau_max)) <= (lag + 1) * step + arm.tau_lsb
            assert (follows | near_echo).all()

    def _stops_are_kept(self, before: Any, request: Request) -> None:
        memory = self.lab.memory  # type: ignore[union-attr]
        if request.verb not in OPERATOR:
            assert memory.in_force & LATCHED & before.in_force == before.in_force & LATCHED
            assert severity(memory.in_force & LATCHED) >= severity(before.in_force & LATCHED)
            if before.state in LATCHED_STATES:
                assert memory.state in LATCHED_STATES
                assert memory.reaction >= before.reaction
                if before.off:
                    assert memory.off or memory.state == State.FAULT
        worst = TABLE.stops(memory.in_force)
        if worst >= Severity.SS2 and memory.state in (State.ARMED, State.RUN):
            raise AssertionError(f"driven with {worst.name} in force")
        if before.state not in (State.ARMED, State.RUN) and memory.state == State.ARMED:
            assert request.verb in (Verb.ARM, Verb.RECOVER)
        if before.state != State.RUN and memory.state == State.RUN:
            assert before.state == State.ARMED

    def _play(self, ticks: int) -> None:
        for _ in range(ticks):
            self._step()

    # ---- what can happen

    @rule(ticks=st.integers(1, 60))
    def time_passes(self, ticks: int) -> None:
        self._play(ticks)

    @rule(verb=st.sampled_from([Verb.ARM, Verb.RECOVER, Verb.ARM, Verb.DISARM, Verb.STOP, Verb.RESET, Verb.TERM]))
    def an_operator_speaks(self, verb: Verb) -> None:
        self._step(Request(verb))

    @precondition(lambda self: self.lab is not None and self.lab.memory.state == State.IDLE)
    @rule(goal=near)
    def it_is_brought_to_run(self, goal: tuple[float, float, float]) -> None:
        """What an operator does who means it."""
        for verb in (Verb.RESET, Verb.RESET, Verb.RESET):
            self._step(Request(verb, obstacles=(ObstacleEdit("*", None),)))
            self._play(60)
        assert self.lab is not None
        self._step(Request(Verb.RECOVER if self.lab.memory.outside else Verb.ARM))
        self._play(400)
        self._step(Request(goal=Goal(np.array(goal), np.array([0.0, 1.0, 0.0, 0.0]), Task.POSITION, 0.003, 0.015)))
        self._play(30)

    @precondition(lambda self: self.lab is not None and self.lab.memory.state in LATCHED_STATES)
    @rule()
    def it_is_reset_until_it_works(self) -> None:
        for _ in range(3):
            self._step(Request(Verb.RESET))
            self._play(60)

    @rule(at=anywhere, wxyz=turned, task=st.sampled_from(Task), verb=st.sampled_from([Verb.NONE, Verb.NONE, Verb.STOP]))
    def a_goal_is_given(self, at: tuple[float, ...], wxyz: tuple[float, ...], task: Task, verb: Verb) -> None:
        self._step(Request(verb, Goal(np.array(at), np.array(wxyz), task, 0.003, 0.015)))
        self._play(20)

    @rule(
        at=st.one_of(near, anywhere),
        v=st.tuples(number, number, number),
        w=st.tuples(*[st.floats(-3.0, 3.0)] * 3),
        timeout=st.one_of(st.none(), number, st.floats(0.005, 0.1)),
        ticks=st.integers(1, 60),
    )
    def a_goal_that_moves_is_given(
        self, at: tuple[float, ...], v: tuple[float, ...], w: tuple[float, ...], timeout: float | None, ticks: int
    ) -> None:
        turn, task = np.array([0.0, 1.0, 0.0, 0.0]), Task.POSE
        self._step(
            Request(goal=Goal(np.array(at), turn, task, 0.003, 0.015, TOOL_Z, None, np.array(v), np.array(w), timeout))
        )
        self._play(ticks)

    @rule(
        kind=st.sampled_from(["sphere", "box", "capsule", "plane", "point", "n_ellipsoid", "cone", "cylinder", "blob"]),
        at=anywhere,
        wxyz=turned,
        dims=sizes,
        velocity=st.tuples(number, number, number),
        age=st.one_of(st.just(0.0), number),
        name=st.sampled_from(["a", "b", "c"]),
    )
    def an_obstacle_is_seen(
        self,
        kind: str,
        at: tuple[float, ...],
        wxyz: tuple[float, ...],
        dims: tuple[float, ...],
        velocity: tuple[float, ...],
        age: float,
        name: str,
    ) -> None:
        d, p, o, v = (np.array(x, np.float64) for x in (dims, at, wxyz, velocity))
        shape = Shape(name, kind, d, p, o, v, np.zeros(3))
        self._step(Request(obstacles=(ObstacleEdit(name, shape, age),)))
        self._play(15)

    @rule(offset=st.tuples(*[st.floats(-0.08, 0.08)] * 3), radius=st.floats(0.01, 0.1))
    def a_ball_appears_at_the_tip(self, offset: tuple[float, ...], radius: float) -> None:
        assert self.lab is not None
        at = self.lab.memory.tip.x + np.array(offset)
        unit_wxyz, size = np.array([1.0, 0.0, 0.0, 0.0]), np.array([radius, 0.0, 0.0, 0.0])
        shape = Shape("tip", "sphere", size, at, unit_wxyz, np.zeros(3), np.zeros(3))
        self._step(Request(obstacles=(ObstacleEdit("tip", shape),)))
        self._play(15)

    @rule(name=st.sampled_from(["a", "b", "tip", "*", "nobody"]))
    def an_obstacle_goes(self, name: str) -> None:
        self._step(Request(obstacles=(ObstacleEdit(name, None),)))

    @rule(kind=st.sampled_from(sorted(KINDS)), joint=joints, duration=st.sampled_from([0.001, 0.003, 0.01, 0.03]))
    def drive_sensor_or_bus_goes_wrong(self, kind: str, joint: int, duration: float) -> None:
        assert self.lab is not None
        simulator = self.lab.simulator
        now = simulator.plant.scene_ns
        simulator.injector.faults.append(Fault(kind, now, now + round(duration * NS), joint))
        self._play(10)

    @rule(slots=st.sampled_from([1, 1, 2, 5, 12, 40]), times=st.integers(1, 3))
    def deadlines_are_missed(self, slots: int, times: int) -> None:
        for _ in range(times):
            self._step(missed=slots)

    @rule(flag=st.sampled_from([f for f in Link if f]), ticks=st.integers(1, 3))
    def the_link_reports_trouble(self, flag: Link, ticks: int) -> None:
        assert self.lab is not None
        self.lab.servo.flags = int(flag)
        self._play(ticks)
        self.lab.servo.flags = 0

    @rule(
        can_id=st.one_of(st.integers(0x11, 0x20), st.integers(0x20, 0x7FE), st.sampled_from([1, 0x7FF])),
        data=st.binary(max_size=12),
        fd=st.booleans(),
    )
    def somebody_else_sends(self, can_id: int, data: bytes, fd: bool) -> None:
        assert self.lab is not None
        whole = (data + bytes(12))[:12] if fd else data[:8]
        self.lab.link.pending.append(frame.pack(can_id, whole, fd=fd, brs=fd))
        self._step()

    @rule(push=st.floats(-0.3, 0.3), joint=st.integers(0, 6))
    def somebody_moves_the_arm(self, push: float, joint: int) -> None:
        assert self.lab is not None
        plant = self.lab.simulator.plant
        q = np.array(plant.q)
        q[joint] = np.clip(q[joint] + push, robot().q_min[joint] - 0.05, robot().q_max[joint] + 0.05)
        plant.place(q)
        self._play(5)


TestSession = Session.TestCase
TestSession.settings = settings(
    max_examples=40,
    stateful_step_count=25,
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.filter_too_much, HealthCheck.data_too_large],
)

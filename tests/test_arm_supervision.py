"""The session: who may do what when, and what every way in and out of motion looks like."""

from typing import Any

import numpy as np
import pytest

from rtctl.arm import supervision
from rtctl.arm.law import prepared
from rtctl.arm.supervision import SETTLE
from rtctl.control import supervisor
from rtctl.control.supervisor import EVENT_OF
from rtctl.types import Drive, ObstacleEdit, Request, Severity, State, Task, Verb
from tests.arms import PANDA_HOME
from tests.lab import Standing, goal, robot, sphere

DT = 1e-3
VERBS = tuple(EVENT_OF)
STATES = (State.IDLE, State.ARMED, State.RUN, State.STOPPING, State.SAFE_STOP, State.FAULT)
MOVING: dict[str, Any] = {"qd": np.full(7, 0.3)}


def swing(arm: Standing, ticks: int) -> None:
    """Let every joint swing for some ticks, faster than rest: positions and speeds that agree."""
    for k in range(ticks):
        qd = MOVING["qd"] * (1.0 if k % 100 < 50 else -1.0)
        arm.q = arm.q + DT * qd
        arm.tick(qd=qd)


def idle(q: np.ndarray = PANDA_HOME) -> Standing:
    """Return an arm whose detectors are not surprised that it moves without getting anywhere."""
    panda, never = robot(), np.full(7, 1e9)
    calm = panda._replace(safety=panda.safety._replace(innovation_max=1e9), collision=never, collision_hard=never)
    arm = Standing(State.IDLE, q, prepared(calm))
    arm.tick()
    return arm


def running() -> Standing:
    arm = idle()
    arm.ask(Verb.ARM)
    arm.ticks(round(SETTLE / DT) + 2)
    assert arm.state() == State.RUN
    return arm


# ---- in


def test_an_idle_arm_is_sent_stop_frames_and_no_torque():
    arm = idle()
    for _ in range(20):
        arm.tick()
        assert arm.drive() == Drive.DISABLE
        assert not arm.command.tau.any()


def test_arming_enables_first_then_holds_then_runs():
    arm = idle()
    assert arm.ask(Verb.ARM) == ""
    assert (arm.state(), arm.drive()) == (State.ARMED, Drive.ENABLE)
    off = {"drive": np.array([1, 1, 1, 0, 1, 1, 1])}
    arm.ticks(50, **off)  # one drive takes its time
    assert arm.drive() == Drive.ENABLE
    states: list[State] = []
    for _ in range(round(SETTLE / DT) + 5):
        arm.tick()
        assert arm.drive() == Drive.TORQUE
        states.append(arm.state())
    assert states[0] == State.ARMED
    assert states[-1] == State.RUN
    assert set(states) == {State.ARMED, State.RUN}
    np.testing.assert_allclose(arm.command.tau, arm.memory.model.g, atol=0.3)


def test_torque_builds_up_within_its_rate_from_nothing():
    arm = idle()
    arm.ask(Verb.ARM)
    before = np.zeros(7)
    for _ in range(100):
        arm.tick()
        assert (np.abs(arm.command.tau - before) <= robot().tau_rate * DT * (1 + 1e-9)).all()
        before = arm.command.tau


def test_drives_that_do_not_enable_are_given_up_on():
    arm = idle()
    arm.ask(Verb.ARM)
    off = {"drive": np.zeros(7, np.int64)}
    arm.ticks(round(supervision.ENABLE_TIMEOUT / DT) - 5, **off)
    assert arm.state() == State.ARMED
    arm.ticks(10, **off)
    assert (arm.state(), arm.drive()) == (State.IDLE, Drive.DISABLE)


def test_a_new_run_holds_where_the_arm_is_now_and_knows_no_old_goal():
    arm = running()
    arm.tick(Request(goal=goal(arm.memory, [0.5, 0.3, 0.5])))
    arm.ticks(50)
    assert np.linalg.norm(arm.memory.v_ref) > 0.0
    arm.ask(Verb.DISARM)
    arm.ticks(400)
    assert arm.state() == State.IDLE
    moved = PANDA_HOME + 0.1  # somebody moves it by hand
    arm.q = moved
    arm.ticks(500)
    arm.ask(Verb.ARM)
    arm.ticks(300)
    memory = arm.memory
    assert memory.state == State.RUN
    assert memory.goal is None
    there = robot().body.evaluate(moved, np.zeros(7), robot().points, robot().own).x
    np.testing.assert_allclose(memory.hold.position, there, atol=1e-3)
    np.testing.assert_allclose(memory.q_rest, moved, atol=1e-3)
    assert not memory.v_ref.any() or np.abs(memory.v_ref).max() < 1e-2


def test_joints_are_given_their_speed_gradually():
    arm = idle()
    arm.ask(Verb.ARM)
    paces = []
    for _ in range(900):
        arm.tick()
        paces.append(arm.memory.speed_scale)
    assert paces[100] <= 0.11
    assert paces[-1] == 1.0
    assert np.diff(paces).min() >= 0.0
    assert np.diff(paces).max() < 0.01


# ---- verbs


@pytest.mark.parametrize("state", STATES)
@pytest.mark.parametrize("verb", VERBS)
def test_a_verb_in_the_wrong_state_is_refused_with_the_state_and_changes_nothing(state: State, verb: Verb):
    if (state, EVENT_OF[verb]) in supervisor.TABLE:
        return
    arm = Standing(state)
    arm.memory = arm.memory._replace(reaction=Severity.SS2 if state == State.SAFE_STOP else Severity.NONE)
    refusal = arm.ask(verb)
    assert refusal == f"{verb.name.lower()}: not possible in state {state.name}"
    assert arm.state() == state


def test_a_verdict_is_that_of_its_own_tick():
    arm = idle()
    assert arm.ask(Verb.RESET) == ""
    assert arm.ask(Verb.STOP) != ""
    assert arm.tick().refusal == ""


@pytest.mark.parametrize("state", [s for s in STATES if s != State.RUN])
def test_a_goal_is_for_a_running_arm(state: State):
    arm = Standing(state)
    arm.memory = arm.memory._replace(reaction=Severity.SS2 if state == State.SAFE_STOP else Severity.NONE)
    memory = arm.tick(Request(goal=goal(arm.memory, [0.5, 0.2, 0.5])))
    assert memory.refusal == f"goal: not possible in state {state.name}"
    assert memory.goal is None


def test_a_refused_goal_leaves_the_one_before_it():
    arm = running()
    arm.tick(Request(goal=goal(arm.memory, [0.5, 0.2, 0.5])))
    for bad in ([np.nan, 0.0, 0.5], [5.0, 0.0, 0.5]):
        memory = arm.tick(Request(goal=goal(arm.memory, bad)))
        assert memory.refusal.startswith("goal: ")
        assert memory.goal is not None
        np.testing.assert_array_equal(memory.goal.position, [0.5, 0.2, 0.5])


def test_a_goal_inside_an_obstacle_is_refused_by_name():
    arm = running()
    crate = sphere("crate", [0.5, 0.3, 0.5], 0.1)
    memory = arm.tick(Request(goal=goal(arm.memory, [0.5, 0.25, 0.5]), obstacles=(ObstacleEdit("crate", crate),)))
    assert memory.refusal == "goal: lies 0.050 m inside obstacle crate"


def test_stop_holds_the_arm_until_reset():
    arm = running()
    arm.ask(Verb.STOP)
    assert (arm.state(), arm.memory.reaction) == (State.SAFE_STOP, Severity.SS2)
    arm.ticks(300)
    assert (arm.state(), arm.drive()) == (State.SAFE_STOP, Drive.TORQUE)
    assert arm.ask(Verb.RESET) == ""
    assert arm.state() == State.STOPPING
    arm.ticks(300)
    assert (arm.state(), arm.memory.reaction) == (State.IDLE, Severity.NONE)


# ---- beyond a limit


def beyond() -> Standing:
    q = PANDA_HOME.copy()
    q[3] = robot().q_min[3] - 0.05
    return idle(q)


def test_beyond_a_limit_arming_is_refused_and_recovering_is_not():
    arm = beyond()
    assert "beyond its limits" in arm.ask(Verb.ARM)
    assert arm.state() == State.IDLE
    assert arm.ask(Verb.RECOVER) == ""
    arm.ticks(round(SETTLE / DT) + 2)
    assert (arm.state(), arm.memory.recovering) == (State.RUN, True)
    assert "outside_limits" not in arm.present
    assert "beyond its limits" in arm.tick(Request(goal=goal(arm.memory, [0.4, 0.2, 0.5]))).refusal
    model = arm.memory.model
    qdd = model.A_inv @ (arm.memory.sent[0] - model.g)
    assert qdd[3] > 0.0  # inward
    assert arm.memory.speed_scale == pytest.approx(0.1)


def test_where_nothing_is_beyond_a_limit_there_is_nothing_to_recover_from():
    for q in (PANDA_HOME, at_limit()):
        arm = idle(q)
        assert arm.ask(Verb.RECOVER) == f"recover: {supervision.INSIDE}"
        arm.ticks(round(SETTLE / DT) + 2)
        assert (arm.state(), arm.drive(), arm.memory.recovering) == (State.IDLE, Drive.DISABLE, False)
        assert arm.ask(Verb.ARM) == ""


def at_limit() -> np.ndarray:
    q = PANDA_HOME.copy()
    q[3] = robot().q_min[3]
    return q


# ---- out


def test_disarming_brings_a_moving_arm_to_rest_before_it_lets_go():
    arm = running()
    arm.ask(Verb.DISARM, **MOVING)
    swing(arm, 1000)
    assert (arm.state(), arm.drive()) == (State.STOPPING, Drive.TORQUE)
    arm.ticks(round(supervision.REST_HOLD / DT) - 2)
    assert arm.drive() == Drive.TORQUE
    arm.ticks(5)
    assert (arm.state(), arm.drive()) == (State.IDLE, Drive.DISABLE)


def test_an_arm_that_is_kept_moving_is_let_go_after_its_time():
    arm = running()
    arm.ask(Verb.DISARM)
    swing(arm, round(supervision.STOP_TIME / DT) - 5)
    assert arm.state() == State.STOPPING
    swing(arm, 10)
    assert arm.state() in (State.IDLE, State.SAFE_STOP)


def test_term_ends_every_session_and_says_when_it_is_done():
    for state in STATES:
        arm = Standing(state)
        arm.memory = arm.memory._replace(reaction=Severity.SS2 if state == State.SAFE_STOP else Severity.NONE)
        arm.tick(Request(Verb.TERM))
        assert arm.memory.leaving
        if state in (State.RUN, State.ARMED, State.SAFE_STOP):
            assert not arm.memory.done
            assert arm.drive() == Drive.TORQUE
        arm.ticks(300)
        assert arm.memory.done, state
        assert arm.drive() == Drive.DISABLE, state


@pytest.mark.parametrize("state", [State.RUN, State.STOPPING, State.SAFE_STOP, State.ARMED])
def test_a_second_term_does_not_wait_for_rest(state: State):
    arm = Standing(state)
    arm.memory = arm.memory._replace(reaction=Severity.SS2 if state == State.SAFE_STOP else Severity.NONE)
    arm.tick(Request(Verb.TERM), **MOVING)
    arm.tick(Request(Verb.TERM), **MOVING)
    assert (arm.state(), arm.drive()) == (State.FAULT, Drive.DISABLE)
    assert arm.memory.done


def test_term_during_a_damped_stop_does_not_give_torque_back():
    arm = running()
    arm.tick(link=4)  # bus-off
    arm.ticks(200)
    assert arm.drive() == Drive.DISABLE
    arm.tick(Request(Verb.TERM))
    arm.ticks(10)
    assert arm.drive() == Drive.DISABLE or not arm.enabled
    assert arm.memory.done


def test_leaving_run_drops_the_goal():
    for verb in (Verb.STOP, Verb.DISARM, Verb.TERM):
        arm = running()
        arm.tick(Request(goal=goal(arm.memory, [0.5, 0.2, 0.5])))
        arm.tick(Request(verb))
        assert arm.memory.goal is None
        assert arm.memory.hold.task == Task.POSE

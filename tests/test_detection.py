"""Faults of drives and encoders on the plant: seen within their time, and nothing else is taken for one."""

from typing import Any

import numpy as np
import pytest

from rtctl.app.arm_scene import ArmTurn
from rtctl.arm import faults
from rtctl.arm.faults import implausible_positions
from rtctl.arm.law import prepared
from rtctl.types import F64, Link, Request, State, Verb
from tests.lab import DOWN, Standing, goal, lab, robot

JOINT = 1  # carries the arm's weight
WARNED = Link.DERATED


def broken(inject: str, seconds: float, reach: list[float] | None = None) -> tuple[set[str], float, list[ArmTurn], F64]:
    """Return the faults, when [s] after 1 s the arm left RUN (-1: never), all turns and qd at the end."""
    with lab(inject=(inject,) if inject else ()) as here:
        here.running()
        here.ask([0.5, 0.3, 0.5] if reach is None else reach, DOWN)
        left = -1.0
        while here.simulator.time < 1.0 + seconds:
            here.step()
            if left < 0.0 and here.simulator.time > 1.0 and here.memory.state != State.RUN:
                left = here.simulator.time - 1.0
        return set(faults.names(here.servo.faults_seen)), left, here.turns, here.simulator.truth().qd.copy()


def test_a_motor_that_gives_half_its_torque_stops_the_arm_though_the_slew_follows_it():
    seen, after, _, _ = broken(f"weak@1.0:{JOINT}", 0.2)
    assert "torque_mismatch" in seen
    assert 0.0 < after < 0.02


def test_a_drive_that_reports_a_fault_is_not_said_to_lie_about_its_torque_too():
    seen, after, _, _ = broken("drive_fault@1.0:2", 0.5)
    assert "drive_fault" in seen
    assert "torque_mismatch" not in seen
    assert 0.0 <= after < 0.005


def test_an_echo_is_judged_against_the_last_four_commands_and_no_older_one():
    with lab() as here:
        here.running()
        here.ask([0.5, 0.3, 0.5], DOWN)
        for _ in range(50):
            here.step()
        commands = [turn.command.tau for turn in here.turns[-4:]]
        assert len({tau.tobytes() for tau in commands}) == 4  # on its way: each is another
        np.testing.assert_array_equal(here.memory.sent, commands[::-1])


def test_a_drive_that_says_it_gives_less_is_believed():
    arm = Standing()
    arm.ticks(5)
    half = {"tau": arm.command.tau * np.where(np.arange(7) == JOINT, 0.5, 1.0), "link": int(WARNED)}
    arm.ticks(4, **half)
    assert arm.memory.slew_follows_echo
    assert arm.memory.counters.slew_follows_echo == 0
    arm.ticks(4, **{**half, "link": 0})
    assert arm.memory.counters.slew_follows_echo >= 3


# ---- encoder


def test_one_jump_of_an_encoder_is_dropped_and_reaches_no_filter():
    arm = Standing()
    arm.ticks(20)
    before = arm.memory.joints
    wrong = arm.q + np.where(np.arange(7) == 1, 0.5, 0.0)
    arm.tick(q=wrong)
    np.testing.assert_allclose(arm.memory.joints.q, before.q, atol=1e-4)
    np.testing.assert_allclose(arm.memory.joints.qd, before.qd, atol=1e-2)
    np.testing.assert_array_equal(arm.record["q"][0], wrong)  # the log has what was said
    arm.ticks(100)
    assert arm.state() == State.RUN
    assert not arm.present


def test_an_encoder_that_stays_off_stops_the_arm_smoothly():
    seen, after, turns, qd = broken("encoder_jump@1.0:3", 0.5)
    assert "encoder_jump" in seen
    assert 0.0 < after < 0.01
    ratios = np.array([np.abs(turn.command.tau) / robot().tau_rated for turn in turns])
    assert ratios.max() < 0.7  # no kick from a filter that saw the jump
    assert np.abs(qd).max() < 0.3


# ---- deadlines


@pytest.mark.parametrize(("state", "held"), [(State.IDLE, False), (State.RUN, True)])
def test_a_missed_deadline_matters_where_torque_flows(state: State, held: bool):
    arm = Standing(state)
    late: dict[str, Any] = {"missed": 12}
    arm.tick(**late)
    assert ("deadline" in arm.present) == held
    if not held:
        arm.ticks(60)
        assert arm.ask(Verb.ARM) == ""


def test_recovering_from_beyond_a_limit_is_slow_whatever_pushes():
    """The limit's potential pushes with all the motor has; the guard keeps a tenth of qd_max all the same."""
    arm = robot()
    for joint, beyond in ((3, 0.06), (5, -0.1)):
        q = arm.home.copy()
        q[joint] = (arm.q_max if beyond > 0.0 else arm.q_min)[joint] + beyond
        fastest = 0.0
        with lab(q.tolist()) as here:
            here.step(Request(Verb.RECOVER))
            for _ in range(900):
                here.step()
                truth = here.simulator.truth()
                if not ((truth.q < arm.q_min) | (truth.q > arm.q_max)).any():
                    break
                fastest = max(fastest, float((np.abs(truth.qd) / arm.qd_max).max()))
            else:
                raise AssertionError("still beyond the limit")
            assert here.memory.state == State.RUN
        assert 0.02 < fastest < 0.12


@pytest.mark.parametrize("joint", [0, 1, 3, 5])
def test_an_encoder_that_sticks_while_its_joint_moves_stops_the_arm(joint: int):
    seen, after, _, _ = broken(f"stuck_encoder@1.0:{joint}", 0.15)
    assert seen & {"encoder_stuck", "innovation"}
    assert 0.0 < after < 0.1


@pytest.mark.parametrize("joint", [1, 3])
def test_an_encoder_that_sticks_at_rest_is_seen_by_the_torque_that_moves_its_joint(joint: int):
    with lab(inject=(f"stuck_encoder@0.5:{joint}",)) as here:
        here.running()
        while here.simulator.time < 0.6:
            here.step()
        here.ask([0.5, 0.3, 0.5], DOWN)
        while here.memory.state == State.RUN and here.simulator.time < 1.0:
            here.step()
        assert faults.names(here.servo.faults_seen) == ("encoder_stuck",)
        assert np.abs(here.simulator.truth().qd).max() < 1.2


def test_an_arm_that_is_held_while_a_goal_pushes_has_no_stuck_encoder():
    arm = Standing(arm=prepared(robot()._replace(safety=robot().safety._replace(innovation_max=1e9))))
    arm.tick(Request(goal=goal(arm.memory, [0.5, 0.3, 0.5])))
    arm.ticks(300)
    assert np.abs(arm.memory.sent[0] - arm.memory.model.g)[4] > arm.robot.safety.friction[4]
    assert arm.state() == State.RUN


def test_an_encoder_whose_speed_is_wrong_stops_the_arm():
    seen, after, _, _ = broken("false_velocity@1.0:3", 0.1)
    # what pushes the arm is computed from speeds: one that lies may be called a blow first
    assert seen & {"velocity_mismatch", "collision_hard"}
    assert 0.0 < after < 0.05


@pytest.mark.parametrize(("age_before", "age_now", "apart"), [(1, 1, 1), (3, 1, 3), (1, 3, 2), (2, 3, 2)])
def test_how_far_a_joint_can_have_moved_goes_by_when_the_two_positions_were_taken(
    age_before: int, age_now: int, apart: int
):
    """Two positions, each some periods old when it came; `apart` periods lie between the moments they tell of."""
    dt, fastest = 1e-3, 2.0
    elapsed = (apart - age_before + age_now) * dt
    reach = 1.5 * fastest * apart * dt + 2e-3
    for sign in (1.0, -1.0):
        for share, far in ((0.999, False), (1.001, True)):
            found = implausible_positions(
                np.array([sign * share * reach]),
                np.array([age_now * dt]),
                np.ones(1, np.int64),
                np.zeros(1),
                np.array([age_before * dt]),
                np.array([fastest]),
                elapsed,
                dt,
            )
            assert found.tolist() == [far]

"""An arm that a hand guides: a spring in the plant pulls its tip; the plant says where it goes and what it touches."""

import numpy as np
import pytest

from rtctl.types import F64, Payload, Request, State, Verb
from tests.lab import Lab, lab, seen, sphere

HAND = "panda_hand"
STIFF, DAMPING, STRONGEST = 400.0, 20.0, 30.0  # [N/m], [Ns/m], [N] of a hand


def pulled(here: Lab, to: F64, seconds: float) -> list[F64]:
    """Pull the hand of the plant's arm to a place [m] for a while; return where the tip was."""
    tips, dt = [here.simulator.plant.tip_pose()[0]], here.robot.dt
    for _ in range(round(seconds / dt)):
        speed = (tips[-1] - tips[max(len(tips) - 5, 0)]) / (4 * dt)
        force = STIFF * (to - tips[-1]) - DAMPING * speed
        force *= min(1.0, STRONGEST / max(float(np.linalg.norm(force)), 1e-9))
        here.simulator.plant.push({HAND: force.tolist()})
        here.step()
        tips.append(here.simulator.plant.tip_pose()[0])
    here.simulator.plant.push({HAND: (0.0, 0.0, 0.0)})
    return tips


def floating(here: Lab) -> Lab:
    """Arm, and let a hand move the arm."""
    here.running()
    here.run(0.3)
    here.step(Request(Verb.FLOAT))
    assert here.memory.status.name == "FLOATING"
    return here


def test_a_hand_moves_the_arm_and_it_stays_where_it_was_let_go():
    with lab(scenario={"plant": {"payload_kg": 0.8}}) as here:
        floating(here)
        start = here.simulator.plant.tip_pose()[0]
        here.run(0.5)
        assert np.linalg.norm(here.simulator.plant.tip_pose()[0] - start) < 2e-3  # nobody touches it
        tips = pulled(here, start + np.array([0.0, 0.15, 0.1]), 1.5)
        assert np.linalg.norm(tips[-1] - start) > 0.1
        assert here.memory.state == State.RUN
        here.step(Request(Verb.HOLD))
        assert not here.memory.floating
        here.run(0.4)
        before = here.simulator.plant.tip_pose()[0]
        tips = pulled(here, before + np.array([0.0, -0.02, 0.0]), 0.1)  # now it resists
        assert np.linalg.norm(tips[-1] - before) < 8e-3


def test_a_virtual_wall_stops_the_hand_and_speed_is_bounded():
    """The plant has no such ball: what keeps the arm off it is the controller alone."""
    with lab() as here:
        here.running()
        start = here.simulator.plant.tip_pose()[0]
        ball = start + np.array([0.0, 0.25, 0.0])
        here.step(seen(sphere("ball", ball, 0.08)))
        floating(here)
        tips = np.array(pulled(here, ball, 2.0))
        speed = np.linalg.norm(np.diff(tips, axis=0), axis=1) / here.robot.dt
        assert speed.max() < 1.1 * here.robot.motion.v_max
        assert np.linalg.norm(tips[-1] - start) > 0.05  # it came near
        assert np.linalg.norm(tips - ball, axis=1).min() > 0.08
        assert here.memory.rho.min() > 0.0
        assert "contact" not in here.servo.vehicle.names(here.servo.faults_seen)
        assert here.memory.state == State.RUN


def test_a_joint_limit_stops_the_hand():
    with lab() as here:
        floating(here)
        tips = pulled(here, here.simulator.plant.tip_pose()[0] + np.array([-0.6, 0.0, 0.3]), 2.0)
        truth = here.simulator.truth()
        assert len(tips) > 1
        assert (truth.q > here.robot.q_min).all()
        assert (truth.q < here.robot.q_max).all()
        assert here.memory.state == State.RUN


@pytest.mark.parametrize("verb", [Verb.FLOAT, Verb.HOLD])
def test_an_arm_that_does_not_run_is_neither_guided_nor_held(verb: Verb):
    with lab() as here:
        here.step(Request(verb))
        assert "IDLE" in here.memory.refusal


def test_a_goal_ends_it_and_a_stop_too():
    with lab() as here:
        floating(here)
        here.ask(here.memory.tip.x + np.array([0.0, 0.02, 0.0]))
        assert not here.memory.floating
        assert here.memory.goal is not None
        here.step(Request(Verb.FLOAT))
        assert here.memory.goal is None
        here.step(Request(Verb.STOP))
        assert here.memory.state == State.SAFE_STOP
        here.run(0.05)
        assert not here.memory.floating


def test_a_told_payload_is_carried_wherever_the_hand_takes_it():
    with lab(scenario={"plant": {"payload_kg": 1.5, "payload_com_m": (0.0, 0.0, 0.05)}}) as here:
        here.step(Request(payload=Payload(1.5, 0.0, 0.0, 0.05)))
        floating(here)
        start = here.simulator.plant.tip_pose()[0]
        pulled(here, start + np.array([0.1, 0.1, -0.1]), 1.0)
        here.run(1.5)  # what moves comes to rest
        there = here.simulator.plant.tip_pose()[0]
        here.run(0.5)
        assert np.linalg.norm(here.simulator.plant.tip_pose()[0] - there) < 3e-3

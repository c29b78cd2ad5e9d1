"""A payload that an operator tells of: no jump, the plant's tip at its place, bounds, and the same bits again."""

from typing import Any

import numpy as np
import pytest

from rtctl.arm.pipe import initial, tick
from rtctl.errors import RequestError
from rtctl.hal.messages import Bounds, decode, request_of
from rtctl.log.record.requests import decode_request, encode_request
from rtctl.types import Payload, Request
from tests.lab import Lab, Standing, lab, same

BOX = Payload(1.5, 0.0, 0.02, 0.05)
PLANT = {"plant": {"payload_kg": BOX.mass, "payload_com_m": BOX[1:]}}


def off(here: Lab, seconds: float) -> float:
    """Return how far [m] the plant's tip goes from where it is, for a while."""
    x, most = here.simulator.plant.tip_pose()[0], 0.0
    for _ in range(round(seconds / here.robot.dt)):
        here.step()
        most = max(most, float(np.linalg.norm(here.simulator.plant.tip_pose()[0] - x)))
    return most


def test_told_while_it_is_carried_it_moves_nothing_and_takes_the_place_of_what_was_learnt():
    with lab(scenario=PLANT) as here:
        here.running()
        here.run(1.5)
        learnt = np.abs(here.memory.lasting).max()
        here.step(Request(payload=BOX))
        assert not here.memory.refusal
        assert off(here, 0.5) < 5e-4
        assert np.abs(here.memory.lasting).max() < 0.2 * learnt
        assert here.servo.events[-1][1:] == ("payload", "1.5 kg at 0 0.02 0.05 m of the tip")


def test_told_before_the_arm_runs_its_tip_does_not_sink():
    with lab(scenario=PLANT) as here:
        here.step(Request(payload=BOX))
        x = here.simulator.plant.tip_pose()[0]
        here.running()
        here.run(0.5)
        assert np.linalg.norm(here.simulator.plant.tip_pose()[0] - x) < 1e-3


def test_told_of_what_is_not_there_the_tip_stays():
    with lab() as here:
        here.running()
        here.run(0.3)
        here.step(Request(payload=BOX))
        assert off(here, 0.7) < 2e-3
        assert here.memory.state.name == "RUN"


@pytest.mark.parametrize(("payload", "why"), [(Payload(3.5), "payload_max_kg = 3"), (Payload(2.9, 5.0), "would carry")])
def test_more_than_was_declared_or_a_joint_can_hold_is_refused(payload: Payload, why: str):
    arm = Standing()
    before = arm.memory.model.g
    assert why in arm.tick(Request(payload=payload)).refusal
    assert same(arm.tick().model.g, before)


def test_its_message_is_checked_and_reaches_the_tick():
    bounds = Bounds((0.0, 0.0, 0.0), 1.0, 0.003, 0.015)
    message = decode(b'{"verb": "payload", "mass_kg": 1.5, "com_m": [0.0, 0.02, 0.05]}')
    assert request_of(message, bounds, list) == Request(payload=BOX)
    for raw in (b'{"verb": "payload"}', b'{"verb": "payload", "mass_kg": -1}', b'{"verb": "payload", "mass_kg": NaN}'):
        with pytest.raises(RequestError):
            decode(raw)
    base = bounds._replace(local=lambda lat, lon: None)
    with pytest.raises(RequestError, match="base"):
        request_of(message, base, list)


def test_the_log_gives_it_back_and_the_ticks_are_the_same_bits():
    said: list[Any] = []
    with lab(scenario=PLANT) as here:
        here.running()
        here.step(Request(payload=BOX))
        here.run(0.1)
        robot, m = here.robot, initial(here.robot, here.first)
        for k, (turn, request) in enumerate(zip(here.turns, here.requests, strict=True)):
            number, again = decode_request(encode_request(k, request))
            assert number == k
            m, command, record = tick(robot, m, turn.feedback, again)
            said.append(record.tobytes() == turn.record.tobytes() and same(command.tau, turn.command.tau))
        assert all(said)
        assert same(m.hot, here.memory.hot)

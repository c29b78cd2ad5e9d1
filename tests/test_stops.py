"""Stops on the plant: from the detection on, by the plant's true speeds, ways and contacts, nothing runs away."""

from typing import NamedTuple

import numpy as np
import pytest

from rtctl.arm import faults
from rtctl.types import Drive, State
from tests.lab import DOWN, lab

REACH = [0.45, 0.35, 0.45]
LIES = ("stuck_encoder", "false_velocity", "encoder_jump", "weak", "silent")
BRAKED = 0.05  # [m] of the tip after the detection, with brakes that hold
FASTER = 0.3  # [rad/s] of any joint above its speed at the detection
KNOCK = (
    5e-3  # [s] after the brakes close, in which one that holds a heavy joint throws the lighter ones: theirs hold less
)


class Course(NamedTuple):
    """The true course of a stop."""

    seen: set[str]
    faster: float  # [rad/s] of any joint above its speed when the arm left RUN, but for the knock of the brakes
    way: float  # [m] of the tip from then on
    rest: float  # [rad/s] fastest joint at the end
    contacts: int


def course(inject: str, seconds: float = 1.2, at: float = 0.75) -> Course:
    """Play a fault while the arm moves to a goal, and the stop after it."""
    with lab(inject=(inject,)) as here:
        here.running()
        here.ask(REACH, DOWN)
        simulator, onset = here.simulator, None
        closed = np.inf
        faster = way = 0.0
        while simulator.time < at + seconds:
            here.step()
            truth = simulator.truth()
            if onset is None and simulator.time > at and here.memory.state != State.RUN:
                onset = truth
            if onset is not None:
                if closed == np.inf and here.turns[-1].command.drive == Drive.DISABLE:
                    closed = truth.time
                if not closed <= truth.time < closed + KNOCK:
                    faster = max(faster, float((np.abs(truth.qd) - np.abs(onset.qd)).max()))
                way = max(way, float(np.linalg.norm(truth.tip - onset.tip)))
        assert onset is not None, "it was not noticed"
        seen = set(faults.names(here.servo.faults_seen))
        return Course(seen, faster, way, float(np.abs(truth.qd).max()), truth.contacts)


@pytest.mark.parametrize("joint", ["", ":1", ":3", ":5"])
@pytest.mark.parametrize("kind", LIES)
def test_a_stop_on_false_measurements_lets_nothing_run_away(kind: str, joint: str) -> None:
    found = course(f"{kind}@0.75{joint}")
    assert found.seen & set(faults.names(faults.DISTRUST))
    assert found.faster < FASTER
    assert found.way < BRAKED
    assert found.rest < 0.01
    assert found.contacts == 0

"""The rival of `tools.barrier` is a fair one: it arrives, and its barriers hold where nothing else would."""

import pytest

from rtctl.spec.read import convert
from rtctl.spec.scenario import Scenario
from tools.barrier import DOWN, HOME, PANDA, Gains, play

CLEARANCE = 0.02  # [m] of configs/panda.toml
GOAL = {"at_s": 0.3, "position_m": (0.45, 0.35, 0.45), "wxyz": DOWN}
# in the hand's straight way from (0.31, 0, 0.49)
BALL = {"name": "ball", "type": "sphere", "radius_m": 0.06, "position_m": (0.42, 0.16, 0.47)}


def scene(seconds: float, *obstacles: dict[str, object]) -> Scenario:
    table = {"robot": "panda.toml", "duration_s": seconds, "start_q_rad": HOME, "goal": (GOAL,), "obstacle": obstacles}
    return convert(table, Scenario, "scene")


def test_the_rival_arrives_under_the_speed_limit() -> None:
    figures, unsolved = play(scene(2.0), PANDA, PANDA, Gains())
    assert figures["arrived"]
    assert unsolved == 0
    assert 0.4 < figures["max_speed_m_s"] < 0.55  # v_max is 0.5
    assert figures["line_deviation_m"] < 0.01


@pytest.mark.parametrize("pairs", [Gains().pairs, 0])
def test_its_barriers_keep_the_clearance_and_nothing_else_does(pairs: int) -> None:
    figures, _ = play(scene(1.2, BALL), PANDA, PANDA, Gains(pairs=pairs))
    if pairs:
        assert figures["contacts"] == 0
        assert figures["min_clearance_m"]["ball"] > CLEARANCE - 0.003  # its slack costs something
    else:
        assert figures["contacts"] > 0

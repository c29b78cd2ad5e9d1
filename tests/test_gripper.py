"""A gripper on the arm's bus, judged by its jaws in the simulator: where they stand and what they press with."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from firmware_sim.gripper import STIFF
from rtctl import design as cfg
from rtctl.app.replay import replay
from rtctl.app.sim import simulate
from rtctl.arm.gripper import ASKED, TARGET, Gripper, P, Q, gripped, state_of, unasked
from rtctl.arm.pipe import tick
from rtctl.errors import ConfigError, RequestError
from rtctl.hal import messages
from rtctl.log.read.run import read_run
from rtctl.protocol import frame
from rtctl.types import NO_GRIPPERS, Command, Drive, Grip, Request, State, Verb
from tests.lab import ROOT, Lab, lab

OPENARM = ROOT / "configs" / "openarm.toml"
LEVER = 0.09 / 1.05  # [m/rad] of its file
REPLY = frame.pack(0x18, bytes(8), fd=True, brs=True)[:4]


def grip(here: Lab, closed: float, force: float = 0.0, seconds: float = 2.5) -> None:
    """Ask the gripper for something and give it time."""
    here.step(Request(grip=Grip(closed, force)))
    here.run(seconds)


def word(here: Lab) -> str:
    """Return the gripper's state as the controller tells it."""
    return state_of(here.robot.grippers[0], here.memory.grippers[:, 0])


# ---- the jaws


def test_it_goes_where_it_is_asked_at_the_speed_of_its_file():
    with lab(path=OPENARM) as here:
        finger = here.simulator.fingers[0]
        here.running()
        assert finger.q == pytest.approx(-1.05, abs=0.02)  # enabled, it holds what it has
        fastest = 0.0
        here.step(Request(grip=Grip(0.5)))
        for _ in range(round(2.0 / here.robot.dt)):
            here.step()
            fastest = max(fastest, abs(finger.qd))
        assert finger.q == pytest.approx(-0.525, abs=0.02)
        assert fastest == pytest.approx(0.1 / LEVER, rel=0.1)  # speed_m_s
        assert word(here) == "there"
        assert not here.servo.faults_seen


@pytest.mark.parametrize("force", [10.0, 40.0])
def test_a_thing_between_the_jaws_is_pressed_with_the_force_and_no_more(force: float):
    with lab(path=OPENARM, scenario={"plant": {"gripper_thing": 0.6}}) as here:
        finger = here.simulator.fingers[0]
        here.running()
        grip(here, 1.0, force, seconds=0.1)
        most = 0.0
        for _ in range(round(2.5 / here.robot.dt)):
            here.step()
            most = max(most, finger.pressed / LEVER)
        assert word(here) == "gripping"
        friction = 0.1 / LEVER  # of the jaws
        assert finger.pressed / LEVER == pytest.approx(force, abs=friction + 1.0)
        assert most < force + 25.0  # it comes with its speed
        grip(here, 0.0)
        assert finger.q == pytest.approx(-1.05, abs=0.02)


def test_it_keeps_what_it_holds_in_a_stop_and_lets_go_with_the_drives():
    with lab(path=OPENARM, scenario={"plant": {"gripper_thing": 0.6}}) as here:
        finger = here.simulator.fingers[0]
        here.running()
        grip(here, 1.0, 30.0)
        here.step(Request(Verb.STOP))
        here.until(State.SAFE_STOP)
        held = STIFF * (finger.q - finger.high)
        assert held / LEVER == pytest.approx(30.0, abs=3.0)


def test_a_silent_gripper_is_told_and_the_arm_goes_on():
    with lab(path=OPENARM) as here:
        here.running()
        unreliable(here, lambda _: 0)
        here.run(0.3)
        assert here.memory.state == State.RUN
        assert not here.memory.in_force
        assert word(here) == "silent"
        assert ("gripper", "gripper: silent at 0.00 of closed") in [e[1:] for e in here.servo.events]


@pytest.fixture(scope="module")
def reversed_jaws(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the OpenArm's file with a gripper whose drive reads less the further it is closed."""
    text = OPENARM.read_text().replace('"openarm.urdf"', f'"{OPENARM.parent / "openarm.urdf"}"')
    assert text.count("open_rad = -1.05\nclosed_rad = 0.0") == 1
    path = tmp_path_factory.mktemp("reversed") / "arm.toml"
    path.write_text(text.replace("open_rad = -1.05\nclosed_rad = 0.0", "open_rad = 0.3\nclosed_rad = -0.75"))
    return path


def test_jaws_that_close_the_other_way_close_and_open_at_the_speed_of_their_file(reversed_jaws: Path):
    with lab(path=reversed_jaws) as here:
        finger = here.simulator.fingers[0]
        here.running()
        assert finger.q == pytest.approx(0.3, abs=0.02)
        here.step(Request(grip=Grip(0.5)))
        least = 0.0
        for _ in range(round(2.0 / here.robot.dt)):
            here.step()
            least = min(least, finger.qd)
        assert least == pytest.approx(-0.1 / LEVER, rel=0.1)
        assert finger.q == pytest.approx(0.3 - 0.525, abs=0.02)
        assert word(here) == "there"
        grip(here, 0.0)
        assert finger.q == pytest.approx(0.3, abs=0.02)
        assert not here.servo.faults_seen


def test_jaws_that_close_the_other_way_press_with_the_force_and_no_more(reversed_jaws: Path):
    with lab(path=reversed_jaws, scenario={"plant": {"gripper_thing": 0.6}}) as here:
        finger = here.simulator.fingers[0]
        here.running()
        grip(here, 1.0, 20.0)
        assert finger.pressed / LEVER == pytest.approx(-20.0, abs=0.1 / LEVER + 1.0)
        assert word(here) == "gripping"


def unreliable(here: Lab, passes: Callable[[int], int]) -> None:
    """Let replies of the gripper come late or never: passes(k) of those that wait after exchange k get through."""
    heard = here.link.transport._exchange
    waiting: list[bytes] = []
    count = iter(range(10**9))

    def exchange(frames: Any) -> list[bytes]:
        raws = heard(frames)
        waiting.extend(raw for raw in raws if raw[:4] == REPLY)
        through = passes(next(count))
        out, waiting[:] = waiting[:through], waiting[through:]
        del waiting[4:]
        return [*(raw for raw in raws if raw[:4] != REPLY), *out]

    here.link.transport._exchange = exchange


@pytest.mark.parametrize(
    "passes",
    [
        pytest.param(lambda k: (1, 0, 2, 0, 1)[k % 5], id="lost and late"),
        pytest.param(lambda k: 4 if k % 20 == 19 else 0, id="in bursts, sixteen periods old"),
    ],
)
def test_replies_that_are_lost_and_late_neither_stop_the_arm_nor_press_harder(passes: Callable[[int], int]):
    with lab(path=OPENARM, scenario={"plant": {"gripper_thing": 0.6}}) as here:
        finger = here.simulator.fingers[0]
        here.running()
        unreliable(here, passes)
        grip(here, 1.0, 20.0, seconds=0.1)
        most = 0.0
        for _ in range(round(2.5 / here.robot.dt)):
            here.step()
            most = max(most, finger.pressed / LEVER)
            assert word(here) != "silent"
        assert finger.pressed / LEVER == pytest.approx(20.0, abs=0.1 / LEVER + 1.0)
        assert most < 20.0 + 25.0  # it comes with its speed
        assert word(here) == "gripping"
        assert here.memory.state == State.RUN
        assert not here.servo.faults_seen


def test_a_gripper_that_is_silent_on_its_way_waits_and_goes_on_when_it_is_heard():
    with lab(path=OPENARM) as here:
        finger = here.simulator.fingers[0]
        here.running()
        grip(here, 1.0, 20.0, seconds=0.3)
        quiet = [True]
        unreliable(here, lambda _: 0 if quiet[0] else 9)
        before = finger.q
        here.run(0.5)
        assert word(here) == "silent"
        gripper = here.robot.grippers[0]
        assert finger.q < before + 20.0 * LEVER / gripper.kp + 0.02  # no further than the force allows
        quiet[0] = False
        here.run(2.0)
        assert finger.q == pytest.approx(0.0, abs=0.02)
        assert word(here) == "there"
        assert here.memory.state == State.RUN


def test_feedback_that_knows_of_no_gripper_is_one_of_a_silent_gripper():
    with lab(path=OPENARM) as here:
        feedback = here.running().turns[-1].feedback._replace(grippers=NO_GRIPPERS)
        m, command, record = tick(here.robot, here.memory, feedback, Request())
    assert state_of(here.robot.grippers[0], m.grippers[:, 0]) == "silent"
    assert command.grippers.shape == (5, 1)
    names = [name for name in record.dtype.names or () if name.startswith("gripper")]
    assert np.isfinite([record[name].item() for name in names]).all()


# ---- log and replay


def test_a_run_with_a_gripper_replays_to_the_bit(tmp_path: Path):
    scenario = f"""robot = "{OPENARM}"
duration_s = 1.5
[[goal]]
at_s = 0.4
position_m = [0.25, 0.20, 0.35]
[[grip]]
at_s = 0.5
closed = 0.7
force_N = 20.0
"""
    (tmp_path / "s.toml").write_text(scenario)
    told = simulate(tmp_path / "s.toml", log=tmp_path / "run.mcap")
    found = replay(read_run(tmp_path / "run.mcap"))
    assert found.identical
    assert found.digest == told["digest"]
    assert found.frames >= 8 * told["ticks"] - 16  # seven joints and the gripper
    run = read_run(tmp_path / "run.mcap")
    assert run.header.dtype["gripper_q"].shape == (1,)


# ---- the law of it


ONE = Gripper("one", open=0.0, closed=1.0, lever=0.1, torque=2.0, speed=0.5, kp=10.0, kd=1.0)


def test_the_reference_is_never_further_from_the_finger_than_the_force_allows():
    rng, memory, command = np.random.default_rng(3), unasked(1), Command(Drive.TORQUE, np.zeros(1))
    for k in range(500):
        seen = np.array([[rng.uniform(-0.2, 1.2)], [0.0], [0.0], [0.0], [1.0]])
        asked = Grip(rng.uniform(), rng.uniform(1.0, 20.0)) if k % 7 == 0 else None
        memory, out = gripped((ONE,), memory, seen, asked, command, 1e-2)
        p, v, kp, _, t = out.grippers[:, 0]
        assert abs(kp * (p - seen[Q, 0])) <= (memory[1, 0] if k else 2.0) * (1 + 1e-12)
        assert (v, t) == (0.0, 0.0)
        assert memory[P, 0] == p


def test_drives_that_are_off_forget_what_was_asked():
    seen = np.array([[0.4], [0.0], [0.0], [0.0], [0.0]])
    memory, out = gripped((ONE,), unasked(1), seen, None, Command(Drive.DISABLE, np.zeros(1)), 1e-3)
    assert memory[[TARGET, P, ASKED], 0].tolist() == [0.4, 0.4, 0.0]
    assert not out.grippers.any()
    memory, out = gripped((ONE,), memory, seen, None, Command(Drive.TORQUE, np.zeros(1)), 1e-3)
    assert out.grippers[0, 0] == 0.4  # it stays where it is


# ---- refusals


def test_what_it_cannot_do_is_refused_in_words():
    with lab(path=OPENARM) as here:
        here.step(Request(grip=Grip(0.5)))
        assert here.memory.refusal == "grip: got it while the drives are off, wanted an arm that is armed"
        here.running()
        for asked, words in (
            (Grip(0.5, 61.0), "grip: gripper: got 61 N, wanted at most 60"),
            (Grip(0.5, 0.0, "hand"), "grip: got hand, wanted one of gripper"),
        ):
            here.step(Request(grip=asked))
            assert here.memory.refusal == words
    with lab() as here:
        here.running()
        here.step(Request(grip=Grip(0.5)))
        assert here.memory.refusal == "grip: this robot has no gripper; [[gripper]] describes one"
        assert here.turns[-1].command.grippers is NO_GRIPPERS or here.turns[-1].command.grippers.size == 0


@pytest.mark.parametrize(
    ("before", "after", "words"),
    [
        ("can_id = 8\n", "can_id = 7\n", r"gripper\[0\].can_id: got 7, wanted one that joint_7 does not have"),
        ("closed_rad = 0.0", "closed_rad = -1.04", r"gripper\[0\].closed_rad: got -1.04, wanted at least 0.05 rad"),
        ("force_max_N = 60.0", "force_max_N = 200.0", r"gripper\[0\].force_max_N: got 200.0, wanted at most 116.7"),
        ("open_rad = -1.05", "open_rad = -13.0", r"gripper\[0\].open_rad: got -13.0, wanted within \+-12.5 rad"),
    ],
)
def test_a_file_that_contradicts_itself_is_refused_by_its_key(tmp_path: Path, before: str, after: str, words: str):
    text = OPENARM.read_text().replace('"openarm.urdf"', f'"{OPENARM.parent / "openarm.urdf"}"')
    assert text.count(before) == 1
    (tmp_path / "arm.toml").write_text(text.replace(before, after))
    with pytest.raises(ConfigError) as refusal:
        cfg.load(tmp_path / "arm.toml")
    assert re.search(words, str(refusal.value))


def test_the_socket_takes_a_share_and_a_force():
    bounds = messages.Bounds((0.0, 0.0, 0.0), 1.0, 1e-3, 1e-2)
    message = messages.decode(b'{"verb": "grip", "closed": 0.4, "force_N": 12.0}')
    assert messages.request_of(message, bounds, lambda: (1, 0, 0, 0)).grip == Grip(0.4, 12.0)
    with pytest.raises(RequestError, match=r"grip.closed: got 1.5, wanted"):
        messages.decode(b'{"verb": "grip", "closed": 1.5}')

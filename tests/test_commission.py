"""`rtctl commission` played against virtual drives by a scripted operator: it ends with the keys of the plant."""

import re
import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from firmware_sim.simulator import Simulator, open_simulator
from rtctl import design as cfg
from rtctl.app.arm_link import link_spec
from rtctl.app.commission import angle, geometry, mounted, straight
from rtctl.app.push import Bench
from rtctl.cli.commission import run
from rtctl.errors import ConfigError, RtctlError
from rtctl.hal.can.handshake import handshake
from rtctl.hal.can.link import CanLink
from rtctl.hal.can.transport import InProcess
from rtctl.spec.edit import with_joint_keys
from tests.test_mounting import ROOT, other_way_round

TURN = 6.283185307179586


class Hand:
    """Somebody who moves joints by hand and reads their true angle off a scale."""

    def __init__(self, simulator: Simulator, joints: Sequence[str], swapped: Sequence[int] | None = None) -> None:
        self.simulator, self.joints = simulator, joints
        self.swapped = list(range(len(joints))) if swapped is None else swapped
        self.lines: list[str] = []
        self.special: dict[str, str] = {}  # question -> answer
        self.moves: Callable[[int], None] = lambda i: self._move(i, 0.25)

    def say(self, text: str) -> None:
        self.lines.append(text)

    def ask(self, text: str) -> str:
        self.lines.append(text)
        for part, answer in self.special.items():
            if part in text:
                return answer
        name = next((n for n in self.joints if n in text), "")
        if "by hand" in text:
            self.moves(self.joints.index(name))
            return ""
        if "that you know" in text:
            return f"{self.simulator.plant.q[self.joints.index(name)]:.5f}"
        return "yes"

    def _move(self, i: int, by: float) -> None:
        """Move a joint; `swapped`: which one really moves."""
        q = np.array(self.simulator.plant.q)
        q[self.swapped[i]] += by
        self.simulator.plant.place(q)
        self.simulator._sense()

    @property
    def text(self) -> str:
        return "\n".join(self.lines)


def bench_of(path: Path, plant: dict[str, Any], start: Sequence[float] | None = None) -> tuple[Bench, Simulator]:
    """Return virtual drives of a robot file, mounted as `plant` says, greeted."""
    simulator = open_simulator(path, {"plant": plant}, start)
    spec = straight(link_spec(cfg.load(path)))
    link = CanLink(spec, InProcess.of(simulator))
    handshake(link, listen=0.0)
    return Bench(link, spec.period, lambda: None), simulator


def panda(folder: Path) -> Path:
    path = folder / "panda.toml"
    path.write_text((ROOT / "configs" / "panda.toml").read_text())
    return path


REST = [0.1, -0.7, -0.3, -2.2, 0.2, 1.5, 0.6]
CHANGED = (
    "panda_joint1",
    "panda_joint2",
    "panda_joint3",
    "panda_joint4",
    "panda_joint5",
    "panda_joint6",
    "panda_joint7",
)
MOUNTED = {
    "encoder_direction": [-1, 1, 1, -1, 1, -1, 1],
    "encoder_zero_rad": [0.0, 0.7, TURN, -1.1 + TURN, -0.4, 0.0, -3.0],
}


def test_joints_that_are_reversed_offset_and_wrapped_end_with_their_keys(tmp_path: Path) -> None:
    path = panda(tmp_path)
    before = path.read_text()
    bench, simulator = bench_of(path, MOUNTED, REST)
    hand = Hand(simulator, [j.name for j in cfg.load(path).robot.joints])
    assert run(path, bench, hand, range(7), True) == 0
    joints = cfg.load(path).robot.joints
    assert [j.direction for j in joints] == MOUNTED["encoder_direction"]
    assert [j.wrap for j in joints] == [False, False, True, True, False, False, False]
    np.testing.assert_allclose([j.zero_rad for j in joints], [0.0, 0.7, 0.0, -1.1, -0.4, 0.0, -3.0], atol=2e-3)
    assert [line for line in hand.lines if "under" in line and "right" not in line] == []
    assert sum(": right" in line for line in hand.lines) == 7
    # the rest of the file is as it was, comments included
    after = path.read_text()
    for key in ("direction = -1", "wrap = true"):
        after = after.replace(f", {key}", "")
    assert re.sub(r", zero_rad = [-\d.]+", "", after) == before
    # what changed was shown
    assert all(f'+    {{ name = "{name}"' in hand.text for name in CHANGED)
    # every drive is disabled in the end
    assert {d.state.name for d in simulator.drives} == {"DISABLED"}
    # a second time nothing is left to do
    again = Hand(simulator, hand.joints)
    assert run(path, bench, again, range(7), False) == 0
    assert again.lines[-1] == f"{path} is right as it is"
    # and the arm is one: the greeting finds every joint where it truly is
    link = CanLink(link_spec(cfg.load(path)), InProcess.of(simulator))
    np.testing.assert_allclose(handshake(link, listen=0.0).q, simulator.plant.q, atol=3e-3)
    simulator.close()


def test_nothing_is_driven_without_a_yes_and_nothing_written_without_another(tmp_path: Path) -> None:
    path = panda(tmp_path)
    before = path.read_text()
    bench, simulator = bench_of(path, MOUNTED, REST)
    hand = Hand(simulator, [j.name for j in cfg.load(path).robot.joints])
    hand.special = {"Stand clear": "", "Write this": "no"}
    enabled: list[bytes] = []
    send = bench.link.transport.send_all
    bench.link.transport.send_all = lambda frames: enabled.extend(f for f in frames if b"\xff\xfc" in f) or send(frames)  # type: ignore[method-assign,func-returns-value]
    assert run(path, bench, hand, range(7), True) == 0
    assert enabled == []
    assert path.read_text() == before
    assert hand.text.count("not tested") == 7
    simulator.close()


def test_identifiers_that_are_mixed_up_are_named(tmp_path: Path) -> None:
    path = other_way_round(tmp_path, False)
    bench, simulator = bench_of(path, {})
    hand = Hand(simulator, ["joint_1", "joint_2", "joint_3", "joint_4"], swapped=[1, 0, 2, 3])
    tries: list[int] = []

    def moves(i: int) -> None:
        tries.append(i)
        if len(tries) > 1:
            raise RtctlError("enough")
        hand._move(i, 0.25)

    hand.moves = moves
    with pytest.raises(RtctlError):
        run(path, bench, hand, [0], True)
    assert "joint_2 (id 2) moved by 0.250 rad: is can_id right?" in hand.text
    simulator.close()


def test_a_torque_that_contradicts_its_reading_is_found_and_nothing_written(tmp_path: Path) -> None:
    path = other_way_round(tmp_path, False)
    before = path.read_text()
    bench, simulator = bench_of(path, {"encoder_zero_rad": 0.3})
    given = simulator.plant.step

    def reversed_phases(torque: Sequence[float], drag: Sequence[float]) -> None:
        given([-torque[0], *torque[1:]], drag)

    simulator.plant.step = reversed_phases  # type: ignore[method-assign]
    hand = Hand(simulator, ["joint_1", "joint_2", "joint_3", "joint_4"])
    assert run(path, bench, hand, range(4), True) == 1
    assert "nothing was written: torque contradicts reading at joint_1" in hand.lines[-1]
    assert path.read_text() == before
    simulator.close()


def test_a_joint_that_does_not_move_is_told(tmp_path: Path) -> None:
    path = other_way_round(tmp_path, False)
    bench, simulator = bench_of(path, {"static_Nm": 60.0, "coulomb_Nm": 60.0})
    bench.period *= 10.0  # of what the ramp takes, a tenth
    hand = Hand(simulator, ["joint_1", "joint_2", "joint_3", "joint_4"])
    assert run(path, bench, hand, [1], True) == 0
    assert "joint_2: did not move under 8 Nm" in hand.text
    simulator.close()


def test_quit_ends_it(tmp_path: Path) -> None:
    path = other_way_round(tmp_path, False)
    bench, simulator = bench_of(path, {})
    hand = Hand(simulator, ["joint_1", "joint_2", "joint_3", "joint_4"])
    hand.special = {"that you know": "quit"}
    with pytest.raises(RtctlError, match="nothing was written"):
        run(path, bench, hand, range(4), True)
    simulator.close()


@pytest.mark.parametrize(
    ("reads", "keys", "wanted"),
    [
        (0.0, {}, (1, 0.0, False)),
        (0.7, {}, (1, 0.7, False)),
        (0.71, {"zero_rad": 0.7}, (1, 0.7, False)),  # the file's, as near as a hand can tell
        (0.7 + TURN, {"zero_rad": 0.7}, (1, 0.7, True)),
        (0.7 - TURN, {"zero_rad": 0.7, "wrap": True}, (1, 0.7, True)),
        (3.5, {}, (1, 3.5 - TURN, True)),
        (3.5, {"zero_rad": 3.5}, (1, 3.5, False)),
        (7.0, {"q_min_rad": -4.0, "q_max_rad": 4.0}, (1, 7.0, False)),  # no turn is told from another
    ],
)
def test_a_zero_and_its_turn(tmp_path: Path, reads: float, keys: dict[str, Any], wanted: tuple[int, float, bool]):
    import msgspec

    joint = msgspec.structs.replace(cfg.load(panda(tmp_path)).robot.joints[2], **keys)
    found = mounted(joint, 1, reads)
    assert (found.direction, found.wrap) == (wanted[0], wanted[2])
    assert found.zero_rad == pytest.approx(wanted[1], abs=1e-4)


@pytest.mark.parametrize(
    ("text", "q"),
    [("", 0.0), ("-0.5", -0.5), ("90 deg", np.pi / 2), ("-45deg", -np.pi / 4), ("x", None), ("inf", None)],
)
def test_an_angle_as_people_type_it(text: str, q: float | None) -> None:
    assert angle(text) == (None if q is None else pytest.approx(q))


def test_axes_and_gravity_are_those_of_the_arm(tmp_path: Path) -> None:
    path = other_way_round(tmp_path, False)
    known = geometry(cfg.load(path), path)
    np.testing.assert_allclose(known.axes, [[0.0, 0.0, 1.0]] * 4, atol=1e-12)
    np.testing.assert_allclose(known.gravity(np.zeros(4)), 0.0, atol=1e-9)


# ---- the file


SECTIONS = """# a robot
[robot]
name = "a"  # { name = "joint_1", can_id = 9 }

[[robot.joints]]
name = 'joint_1'   # the shoulder
can_id = 1
direction = 1      # as delivered

[[robot.joints]]
can_id = 2
name = "joint_2"
# the end
[loop]
servo_hz = 1000
"""


def test_keys_go_into_sections_and_comments_stay() -> None:
    got = with_joint_keys(
        SECTIONS, {"joint_1": {"direction": -1, "zero_rad": 0.5}, "joint_2": {"wrap": True}}, "robot.toml"
    )
    assert got == SECTIONS.replace("direction = 1 ", "direction = -1 ").replace(
        "can_id = 1\n", "can_id = 1\nzero_rad = 0.5\n"
    ).replace("can_id = 2\n", "can_id = 2\nwrap = true\n")


def test_keys_go_into_inline_tables_and_comments_stay() -> None:
    text = """[robot]
joints = [ # { name = "a", can_id = 7 }
    { name = "a", can_id = 1, drive = "}{#", zero_rad = 0.25 }, # the first
    {name="b",can_id=2},
]
"""
    got = with_joint_keys(text, {"a": {"zero_rad": -1.5, "direction": -1}, "b": {"wrap": True}}, "robot.toml")
    assert got == text.replace("zero_rad = 0.25 }", "zero_rad = -1.5, direction = -1 }").replace(
        "can_id=2}", "can_id=2, wrap = true}"
    )
    assert tomllib.loads(got)["robot"]["joints"][0]["drive"] == "}{#"


def test_a_text_that_it_cannot_edit_is_refused() -> None:
    text = 'robot.joints = [{ name = "a", can_id = 1, "zero_rad" = 0.25 }]\n'
    with pytest.raises(ConfigError, match=r"robot\.toml: robot\.joints: got a file that cannot be edited in place"):
        with_joint_keys(text, {"a": {"zero_rad": 1.0}}, "robot.toml")

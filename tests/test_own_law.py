"""Somebody's own law drives the arm: by the plant's account it moves as told, and none that is bad does any harm."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rtctl
from rtctl.app.own_law import OwnLawError, load_law
from rtctl.app.replay import replay
from rtctl.cli import main
from rtctl.errors import EXIT_CONFIG, EXIT_USAGE, UsageError
from rtctl.log.record.requests import decode_request, encode_request
from rtctl.types import F64, Request, State, Verb
from tests.lab import PANDA, Lab, lab, robot, seen, sphere
from tests.rig import Rig

SCENE = f"""
robot = "{PANDA}"
duration_s = 1.2
[[goal]]
at_s = 0.3
position_m = [0.45, 0.15, 0.50]
"""


class Watched:
    """What the plant's arm did: the largest shares of its limits, and the ways of its tip."""

    def __init__(self, here: Lab) -> None:
        self.here, self.tip = here, here.simulator.truth().tip
        self.speed = self.joint_speed = 0.0
        self.low, self.high = np.full(here.robot.n, np.inf), np.full(here.robot.n, -np.inf)

    def step(self, request: Request) -> None:
        """Play a slot."""
        here = self.here
        here.step(request)
        truth = here.simulator.truth()
        self.speed = max(self.speed, float(np.linalg.norm(truth.tip - self.tip)) / here.robot.dt)
        self.joint_speed = max(self.joint_speed, float((np.abs(truth.qd) / here.robot.qd_max).max()))
        self.low, self.high, self.tip = np.minimum(self.low, truth.q), np.maximum(self.high, truth.q), truth.tip

    def harmed_nothing(self) -> None:
        """Judge."""
        here = self.here
        assert here.simulator.truth().contacts == 0
        assert (self.low > here.robot.q_min).all()
        assert (self.high < here.robot.q_max).all()
        assert self.joint_speed < 1.05
        assert self.speed < 1.1 * here.robot.motion.v_max
        assert here.memory.state == State.RUN
        assert not here.servo.faults_seen


def drive(tau: F64) -> Request:
    return Request(drive=tuple(tau.tolist()))


def test_joints_are_accelerated_as_the_law_says_and_gravity_is_given_beside_it():
    """qdd = A^-1 tau, by the plant; and with no torque the arm stays where it is."""
    with lab() as here:
        here.running()
        here.run(0.2)
        truth = here.simulator.truth()
        for _ in range(300):
            here.step(drive(np.zeros(here.robot.n)))
        # nothing damps what the rounding of torques sets going
        assert np.abs(here.simulator.truth().q - truth.q).max() < 0.02
        wanted = np.array([1.0, 0.0, 0.0, -1.5, 0.0, 0.0, 0.0])  # [rad/s2]
        speeds = []
        for _ in range(150):
            here.step(drive(here.memory.model.A @ wanted))
            speeds.append(here.simulator.truth().qd)
        gained = (speeds[-1] - speeds[39]) / (110 * here.robot.dt)  # behind the rise
        np.testing.assert_allclose(gained[[0, 3]], wanted[[0, 3]], rtol=0.1)
        here.run(0.5)  # and now it is this program's again: it stays
        assert np.abs(here.simulator.truth().qd).max() < 0.02


def test_a_law_of_noise_harms_nothing():
    """Torques at random up to all that the motors have, among balls that only the controller sees."""
    rng = np.random.default_rng(1)
    with lab(scenario={"plant": {"payload_kg": 0.3}}) as here:
        here.running()
        ball = here.memory.tip.x + np.array([0.0, 0.18, 0.0])
        here.step(seen(sphere("ball", ball, 0.06)))
        watched, tau = Watched(here), np.zeros(here.robot.n)
        for k in range(2000):
            if k % 80 == 0:
                tau = rng.uniform(-1.0, 1.0, here.robot.n) * here.robot.tau_max
            watched.step(drive(tau))
            assert np.linalg.norm(watched.tip - ball) > 0.06
        watched.harmed_nothing()


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_law_that_pushes_each_joint_to_its_end_harms_nothing(sign: float):
    with lab() as here:
        here.running()
        watched = Watched(here)
        for _ in range(1800):
            watched.step(drive(sign * here.robot.tau_max))
        watched.harmed_nothing()


def test_it_drives_in_run_alone_and_a_stop_is_not_its_own():
    with lab() as here:
        tau = here.robot.tau_max * 0.3
        for _ in range(100):
            here.step(drive(tau))
        assert np.abs(here.simulator.truth().qd).max() < 1e-6  # IDLE
        here.running()
        for _ in range(200):
            here.step(drive(tau))
        assert np.abs(here.simulator.truth().qd).max() > 0.1
        here.step(drive(tau)._replace(verb=Verb.STOP))
        for _ in range(600):
            here.step(drive(tau))
        assert here.memory.state == State.SAFE_STOP
        assert np.abs(here.simulator.truth().qd).max() < 0.02


def test_a_goal_is_known_to_it_and_told_as_reached():
    with lab() as here:
        here.running()
        to = here.memory.tip.x + np.array([0.0, 0.08, 0.0])
        here.ask(to)
        seen_states = set()
        for _ in range(2500):
            m = here.memory
            assert m.goal is not None
            force = 60.0 * (m.goal.position - m.tip.x) - 15.0 * m.tip.xd
            here.step(drive(m.model.A @ np.linalg.pinv(m.model.J[:3]) @ force - m.model.A @ (6.0 * m.joints.qd)))
            seen_states.add(here.memory.status.name)
        assert seen_states == {"MOVING", "ARRIVED"}
        assert np.linalg.norm(here.simulator.truth().tip - to) < 4e-3


@pytest.mark.parametrize("tau", [(0.0,), (np.nan,) * 7, (np.inf,) + (0.0,) * 6])
def test_a_torque_that_is_none_is_refused_and_the_arm_holds(tau: tuple[float, ...]):
    with lab() as here:
        here.running()
        here.run(0.3)
        q = here.simulator.truth().q.copy()
        for _ in range(100):
            here.step(Request(drive=tau))
            assert here.memory.refusal.startswith("drive: got")
        assert np.abs(here.simulator.truth().q - q).max() < 1e-3


def test_a_law_that_raises_stops_the_arm(tmp_path: Path):
    (tmp_path / "scene.toml").write_text(SCENE)
    shown: list[Any] = []

    def law(robot: Any, memory: Any, feedback: Any) -> F64 | None:
        if memory.tick > 500:
            raise ZeroDivisionError("by nothing")
        return None

    with pytest.raises(OwnLawError, match=r"ZeroDivisionError: by nothing \(test_own_law.py, line \d+\)") as caught:
        rtctl.simulate(tmp_path / "scene.toml", law=law, watch=lambda servo, truth, turn: shown.append((servo, truth)))
    assert isinstance(caught.value.__cause__, ZeroDivisionError)
    servo, truth = shown[-1]
    assert servo.memory.state == State.SAFE_STOP
    assert np.abs(truth.qd).max() < 0.02
    assert max(np.abs(each.qd).max() for _, each in shown) > 0.05  # it was under way
    assert ("law", "ZeroDivisionError: by nothing") in [(n, d.partition(" (")[0]) for _, n, d in servo.events]


def test_a_law_that_has_nothing_to_say_leaves_it_to_this_program(tmp_path: Path):
    (tmp_path / "scene.toml").write_text(SCENE)
    own = rtctl.simulate(tmp_path / "scene.toml")
    other = rtctl.simulate(tmp_path / "scene.toml", law=lambda robot, memory, feedback: None)
    assert other["digest"] == own["digest"]


def spoil(value: Any) -> None:
    """Write nonsense into whatever can be reached."""
    if isinstance(value, np.ndarray):
        if value.flags.writeable:
            value.view(np.uint8)[...] = 0x7F
    elif isinstance(value, tuple):
        for part in value:
            spoil(part)
    elif hasattr(value, "__struct_fields__"):
        for name in value.__struct_fields__:
            spoil(getattr(value, name))


def test_a_law_that_writes_into_what_it_is_shown_spoils_nothing(tmp_path: Path):
    (tmp_path / "scene.toml").write_text(SCENE)

    def law(robot: Any, memory: Any, feedback: Any) -> None:
        q = memory.joints.q
        q -= 1.0  # as is soon written
        spoil((robot, memory, feedback))

    spoilt = rtctl.simulate(tmp_path / "scene.toml", law=law)
    assert spoilt["digest"] == rtctl.simulate(tmp_path / "scene.toml")["digest"]


@pytest.mark.parametrize("verb", [Verb.NONE, Verb.FLOAT, Verb.HOLD, Verb.PARK, Verb.STOP])
@pytest.mark.parametrize("error", [ZeroDivisionError, SystemExit])
def test_whatever_is_asked_when_it_raises_the_arm_stops(verb: Verb, error: type[BaseException]):
    with lab() as here:
        here.running()

        def law(robot: Any, memory: Any, feedback: Any) -> F64:
            if memory.tick >= broken:
                raise error
            return 0.3 * robot.tau_max

        broken = here.memory.tick + 300
        here.servo.drive_by(law)
        for k in range(301):
            here.step(Request(verb) if k == 300 else Request())
        assert np.abs(here.simulator.truth().qd).max() > 0.1
        here.run(0.6)
        assert here.memory.state == State.SAFE_STOP
        assert np.abs(here.simulator.truth().qd).max() < 0.02


def test_a_log_of_it_replays_to_the_bit(tmp_path: Path):
    (tmp_path / "scene.toml").write_text(SCENE)
    rng = np.random.default_rng(3)
    found = rtctl.simulate(
        tmp_path / "scene.toml",
        log=tmp_path / "run.mcap",
        law=lambda robot, memory, feedback: 0.1 * rng.standard_normal(robot.n) * robot.tau_max,
    )
    again = replay(rtctl.read(tmp_path / "run.mcap"))
    assert again.identical
    assert again.digest == found["digest"]


def test_a_request_keeps_its_bits():
    asked = Request(drive=(0.1, -1e-300, 1.0 / 3.0))
    assert decode_request(encode_request(7, asked)) == (7, asked)


FILES: list[tuple[str, str, str]] = [
    ("law.py", "", "law.py: got 'move', wanted one of"),
    ("law.py", "def mowe(r, m, f): ...", "got 'move', wanted mowe"),
    ("law.py", "import nothing_like_this", "cannot be run: ModuleNotFoundError"),
    ("law.py", "def (", "cannot be run: SyntaxError"),
    ("law.txt", "move = 1", "wanted one that ends in .py"),
    ("law.py", "move = 1", "got 'move'"),
]


@pytest.mark.parametrize(("name", "text", "told"), FILES)
def test_what_is_no_law_is_told_in_a_line(tmp_path: Path, name: str, text: str, told: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(UsageError) as caught:
        load_law(f"{tmp_path / name}:move")
    assert told in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["law.py", ":move", "law.py:", "nowhere.py:move"])
def test_what_names_no_law_is_told_in_a_line(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["sim", "demo", "--law", text]) == EXIT_USAGE
    assert "FILE.py:NAME" in capsys.readouterr().err


def test_a_rover_takes_none(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "law.py").write_text("def move(robot, memory, feedback): ...")
    from tests.base_lab import ROVER

    assert main(["run", str(ROVER), "--law", f"{tmp_path / 'law.py'}:move"]) == EXIT_CONFIG
    assert "got base, wanted arm" in capsys.readouterr().err


LAW = """
def move(robot, memory, feedback):
    if memory.state.name == "RUN" and memory.tick * robot.dt > {until}:
        return 1 / 0
    tau = 0.0 * robot.tau_max
    tau[0] = 4.0 * (0.3 - memory.joints.q[0]) - 4.0 * memory.joints.qd[0]
    return tau
"""


def test_a_daemon_runs_it_and_stops_when_it_raises(tmp_path: Path) -> None:
    (tmp_path / "law.py").write_text(LAW.format(until=3.0))
    with Rig(tmp_path) as rig:
        rig.drives()
        controller = rig.controller("--law", f"{tmp_path / 'law.py'}:move")
        rig.arm()
        rig.reach("SAFE_STOP")
        report = rig.end_drives()
        assert controller.popen.poll() is None
    assert "law: ZeroDivisionError: division by zero (law.py, line 4)" in controller.text
    assert report["q_rad"][0] > 0.05


def test_the_example_sways_past_a_ball(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The law would take the tip into the ball; the simulator says that it did not touch it."""
    from tests.test_library import EXAMPLES, drawn, example

    monkeypatch.syspath_prepend(str(EXAMPLES))
    script = example("own_controller")
    figures, ticks = script.play(PANDA, tmp_path)
    arm = robot()
    wanted = script.swayed(arm, script.SECONDS / 4)[0]
    assert abs(wanted[0] - arm.home[0]) == pytest.approx(script.SWING)
    assert figures["contacts"] == 0
    assert 0.0 < figures["min_clearance_m"]["ball"] < 0.06
    assert np.ptp(ticks.q[:, 0]) > script.SWING
    script.draw(arm, ticks, tmp_path / "a.png")
    assert drawn(tmp_path / "a.png")

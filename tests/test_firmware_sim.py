"""Drives and plant together, in process and as a process on a bus, spoken to by the controller's own codec."""

import hashlib
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from firmware_sim.__main__ import QUIET_S
from firmware_sim.batch import Batch
from firmware_sim.bus import Hub
from firmware_sim.camera import Camera
from firmware_sim.inject import INTERFACE, KINDS, parse
from firmware_sim.settings import SettingsError
from firmware_sim.simulator import Simulator, open_simulator
from rtctl.app.vehicle import LOCKSTEP_WAIT
from rtctl.protocol import e2e, frame, mit

ROOT = Path(__file__).resolve().parent.parent
PANDA = ROOT / "configs" / "panda.toml"
OVER_HOME = {"name": "ball", "type": "sphere", "radius_m": 0.05, "position_m": [0.6, 0.4, 0.4]}


def scales(simulator: Simulator) -> list[mit.Scale]:
    """Return the controller's view of the drives' scales."""
    return [mit.Scale(*r.scale) for r in simulator.settings.ratings]


class Controller:
    """Holds an arm by gravity compensation and damping, and speaks the protected protocol."""

    def __init__(self, simulator_scales: list[mit.Scale]) -> None:
        self.scales, self.counter = simulator_scales, 0
        full = pin.buildModelFromUrdf(str(open_settings().urdf))
        self.model = pin.buildReducedModel(full, [8, 9], pin.neutral(full))
        self.data = self.model.createData()

    def frames(self, payloads: list[bytes], wanted: int = 1, can_id: int | None = None) -> list[bytes]:
        """Return one frame per joint; all on `can_id` where that is given."""
        self.counter = self.counter + 1 & 0xFF
        ids = [can_id if can_id is not None else k + 1 for k in range(len(payloads))]
        sealed = [e2e.protect(p, self.counter, wanted, i) for p, i in zip(payloads, ids, strict=True)]
        return [frame.pack(i, d, fd=True, brs=True) for i, d in zip(ids, sealed, strict=True)]

    def special(self, payload: bytes) -> list[bytes]:
        """Return a special frame for every joint."""
        return self.frames([payload] * 7, 0)

    def torque(self, tau: Any) -> list[bytes]:
        """Return a torque command for every joint."""
        return self.frames([mit.encode_command(0, 0, 0, 0, t, s) for t, s in zip(tau, self.scales, strict=True)])

    def states(self, replies: list[bytes]) -> list[mit.Reply]:
        """Return the replies of one cycle, in joint order."""
        found = {}
        for raw in replies:
            f = frame.unpack(raw)
            assert (f.fd, f.brs) == (True, True)
            assert e2e.intact(f.data, f.can_id)
            reply = mit.decode_reply(f.data[:8], self.scales[f.can_id - 0x11])
            assert reply is not None
            found[f.can_id - 0x11] = reply
        return [found[k] for k in range(7)]

    def hold(self, replies: list[bytes]) -> list[bytes]:
        """Return commands that hold the arm where it is."""
        states = self.states(replies)
        q, qd = np.array([s.p for s in states]), np.array([s.v for s in states])
        g = pin.computeGeneralizedGravity(self.model, self.data, q)
        return self.torque(g - np.array([4, 4, 4, 4, 0.4, 0.4, 0.4]) * qd)


def open_settings() -> Any:
    """Return the Panda's settings."""
    from firmware_sim.settings import load

    return load(PANDA)


@pytest.fixture
def panda() -> Iterator[Simulator]:
    """A Panda at home with a ball in sight."""
    simulator = open_simulator(str(PANDA), {"obstacle": [OVER_HOME]})
    yield simulator
    simulator.close()


def enabled(simulator: Simulator) -> tuple[Controller, list[bytes]]:
    """Return a controller, and the replies after all drives were enabled."""
    c = Controller(scales(simulator))
    simulator.exchange(c.special(mit.ENABLE))
    replies = simulator.exchange(c.special(mit.ENABLE))
    assert [s.err for s in c.states(replies)] == [1] * 7
    return c, replies


# ---- in process


def test_disabled_arm_rests_on_its_brakes(panda: Simulator) -> None:
    c = Controller(scales(panda))
    for _ in range(300):
        replies = panda.exchange(c.special(mit.DISABLE))
        assert [s.err for s in c.states(replies)] == [0] * 7
    truth = panda.truth()
    assert truth.time == pytest.approx(0.3)
    assert truth.q == pytest.approx(panda.settings.home, abs=1e-4)
    assert truth.qd == pytest.approx(np.zeros(7), abs=1e-6)


def test_arm_is_held_by_torques_over_the_wire(panda: Simulator) -> None:
    c, replies = enabled(panda)
    for _ in range(1000):
        replies = panda.exchange(c.hold(replies))
        assert len(replies) == 7
    truth = panda.truth()
    assert truth.q == pytest.approx(panda.settings.home, abs=0.1)
    assert np.abs(truth.qd).max() < 0.02
    states = c.states(replies)
    steps = [25.0 / 65535, 20.0 / 4095]
    assert [s.p for s in states] == pytest.approx(truth.q, abs=steps[0] + 1e-3 * 0.02)
    assert truth.contacts == 0
    assert truth.clearance["ball"] == panda.truth().clearance["ball"] > 0.0


def test_reply_is_older_than_its_command_by_one_period(panda: Simulator) -> None:
    c, replies = enabled(panda)
    echoes = []
    for k in range(6):
        replies = panda.exchange(c.torque([0.5 * k] * 7))
        echoes.append(c.states(replies)[6].t)
    assert echoes == pytest.approx([0.0, 0.0, 0.5, 1.0, 1.5, 2.0], abs=0.004)


def test_registers_are_answered_and_time_stands(panda: Simulator) -> None:
    c = Controller(scales(panda))
    for rid, wanted in ((9, 400), (10, 1), (8, None), (7, None)):
        replies = panda.exchange(c.frames([mit.read_register(k + 1, rid) for k in range(7)], 0, mit.REGISTER_ID))
        for k, raw in enumerate(replies):
            f = frame.unpack(raw)
            assert e2e.intact(f.data, f.can_id)
            got = mit.decode_register(f.data[:8])
            assert got is not None
            assert (f.can_id, got.motor_id, got.rid, got.write) == (k + 0x11, k + 1, rid, False)
            assert got.number == (wanted if wanted is not None else k + 1 if rid == 8 else k + 0x11)
    replies = panda.exchange(c.frames([mit.read_register(1, 23), mit.read_register(7, 23)], 0, mit.REGISTER_ID))
    assert [mit.decode_register(frame.unpack(r).data[:8]).real for r in replies] == [90.0, 14.0]  # type: ignore[union-attr]
    assert panda.truth().time == 0.0
    replies = panda.exchange(c.frames([mit.write_register(2, 9, 200)], 0, mit.REGISTER_ID))
    assert mit.decode_register(frame.unpack(replies[0]).data[:8]).number == 200  # type: ignore[union-attr]
    assert panda.drives[1].timeout_ns == 10_000_000


def test_an_empty_cycle_lets_time_pass_until_every_watchdog_trips(panda: Simulator) -> None:
    c, replies = enabled(panda)
    for _ in range(50):
        replies = panda.exchange(c.hold(replies))
    for k in range(20):
        assert [d.state.name for d in panda.drives] == ["ENABLED"] * 7, k
        assert panda.exchange([]) == []
    assert [d.fault for d in panda.drives] == [0xD] * 7
    for _ in range(300):
        panda.exchange([])
    truth = panda.truth()
    assert np.abs(truth.qd).max() < 1e-4
    assert np.abs(truth.q - np.array(panda.settings.home)).max() < 0.05
    assert all(d.brake for d in panda.drives)
    states = c.states(panda.exchange(c.torque([0.0] * 7)))
    assert [s.err for s in states] == [0xD] * 7


def test_junk_on_the_bus_is_no_command(panda: Simulator) -> None:
    c, replies = enabled(panda)
    good = c.hold(replies)
    junk = [
        b"short",
        frame.pack(1, bytes(8)),  # classic on an FD link
        frame.pack(0x123, bytes(12), fd=True, brs=True),
        frame.pack(0x40, bytes(8), error=True),
        frame.pack(1, bytes(8), extended=True),
        frame.pack(1, b"", rtr=True),
        frame.pack(1, bytes(8), fd=True, brs=True),
        frame.pack(0x7FF, bytes(4), fd=True, brs=True),
        frame.pack(0x7FF, bytes(12), fd=True, brs=True),
    ]
    assert len(panda.exchange([*junk, *good])) == 7
    assert [d.rejected for d in panda.drives] == [1, 0, 0, 0, 0, 0, 0]


def test_classic_link_works_the_same(tmp_path: Path) -> None:
    text = PANDA.read_text().replace('protocol = "mit+e2e"', 'protocol = "mit"').replace("fd = true", "fd = false")
    (tmp_path / "panda.toml").write_text(text)
    simulator = open_simulator(tmp_path / "panda.toml")
    simulator.exchange([frame.pack(k + 1, mit.ENABLE) for k in range(7)])
    replies = simulator.exchange([frame.pack(k + 1, mit.encode_torque(0.0, 90.0)) for k in range(7)])
    decoded = [mit.decode_reply(frame.unpack(r).data, s) for r, s in zip(replies, scales(simulator), strict=True)]
    simulator.close()
    assert [frame.unpack(r).can_id for r in replies] == list(range(0x11, 0x18))
    assert [d.err for d in decoded if d is not None] == [1] * 7
    assert all(len(r) == 16 for r in replies)


def test_control_rate_can_be_set(tmp_path: Path) -> None:
    simulator = open_simulator(str(PANDA), control_hz=250.0)
    simulator.exchange([])
    assert simulator.time == pytest.approx(0.004)
    simulator.close()


def test_start_and_obstacles_come_from_the_scenario() -> None:
    start = [0.1, -0.5, 0.0, -2.0, 0.0, 1.5, 0.7]
    drifting = {**OVER_HOME, "velocity_m_s": [0.0, -0.1, 0.0], "vanishes_s": 0.005, "rpy_rad": [0.0, 0.0, np.pi / 2]}
    simulator = open_simulator(str(PANDA), {"start_q_rad": start, "obstacle": [drifting], "robot": "panda"})
    assert simulator.truth().q == pytest.approx(start)
    first = simulator.obstacles()
    simulator.exchange([])
    second = simulator.obstacles()
    for _ in range(4):
        simulator.exchange([])
    third, fourth = simulator.obstacles(), simulator.obstacles()
    simulator.close()
    assert [e.name for e in first] == ["ball"]
    assert first[0].shape is not None
    assert second[0].shape is not None
    assert first[0].shape.dims == pytest.approx([0.05, 0, 0, 0])
    assert first[0].shape.wxyz == pytest.approx([np.sqrt(0.5), 0, 0, np.sqrt(0.5)])
    assert second[0].shape.position == pytest.approx([0.6, 0.4 - 1e-4, 0.4])
    assert second[0].shape.velocity == pytest.approx([0.0, -0.1, 0.0])
    assert [(e.name, e.shape) for e in third] == [("ball", None)]
    assert fourth == []
    chosen = open_simulator(str(PANDA), {"start_q_rad": start}, start_q=[0.0, 0.0, 0.0, -1.0, 0.0, 1.0, 0.0])
    assert chosen.truth().q[3] == -1.0
    chosen.close()


@pytest.mark.parametrize(
    ("scenario", "named"),
    [
        ({"start_q_rad": [0.0]}, "start_q_rad"),
        ({"obstacle": [{"name": "x", "type": "blob", "position_m": [0, 0, 0]}]}, "blob"),
        ({"fault": [{"at_s": 0.0, "kind": "gremlin"}]}, "gremlin"),
        ({"fault": [{"at_s": 0.0, "kind": "silent", "joint": 9}]}, "joint 9"),
    ],
)
def test_a_scenario_that_makes_no_sense_is_refused_by_name(scenario: dict[str, Any], named: str) -> None:
    with pytest.raises(SettingsError, match=named):
        open_simulator(str(PANDA), scenario)


PLAY = """
import hashlib, sys
sys.path.insert(0, {root!r})
sys.path.insert(0, {tests!r})
import importlib.util
spec = importlib.util.spec_from_file_location("play", {file!r})
play = importlib.util.module_from_spec(spec)
spec.loader.exec_module(play)
print(play.digest())
"""


def digest() -> str:
    """Return a hash of every byte the drives said while the arm was run into and let fall."""
    scenario = {
        "seed": 5,
        "obstacle": [{**OVER_HOME, "position_m": [0.3, 0.2, 0.6], "velocity_m_s": [0.0, -0.6, 0.0]}],
        "fault": [{"at_s": 0.1, "kind": "drop", "duration_s": 0.05, "joint": 3}],
    }
    simulator = open_simulator(str(PANDA), scenario)
    c = Controller(scales(simulator))
    total = hashlib.sha256()
    simulator.exchange(c.special(mit.ENABLE))
    replies = simulator.exchange(c.special(mit.ENABLE))
    for k in range(400):
        if len(replies) == 7:
            commands = c.hold(replies)
        replies = simulator.exchange(commands if k < 350 else [])
        total.update(b"".join(replies))
        total.update(repr(simulator.truth().clearance).encode())
    assert simulator.truth().contacts > 0
    total.update(repr(simulator.truth()).encode())
    simulator.close()
    return total.hexdigest()


def test_the_same_run_gives_the_same_bytes_in_another_process() -> None:
    here = digest()
    assert digest() == here
    code = PLAY.format(root=str(ROOT), tests=str(ROOT / "tests"), file=__file__)
    environment = {**os.environ, "PYTHONHASHSEED": "77"}
    other = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment)
    assert other.stdout.strip() == here  # and nothing else on stdout


# ---- injected faults


def play(text: str, periods: int = 80) -> tuple[Simulator, list[list[bytes]], Controller]:
    """Return what a held arm's drives said with one fault injected."""
    simulator = open_simulator(str(PANDA), inject=[text])
    c, replies = enabled(simulator)
    commands, said = c.hold(replies), []
    for _ in range(periods):
        replies = simulator.exchange(commands)
        said.append(replies)
        whole = len({frame.unpack(r).can_id for r in replies}) == 7
        good = whole and all(e2e.intact(frame.unpack(r).data, frame.unpack(r).can_id) for r in replies)
        commands = c.hold(replies) if good else c.torque([0.0] * 7)
    simulator.close()
    return simulator, said, c


def test_every_fault_kind_is_playable_and_leaves_the_others_alone() -> None:
    with pytest.raises(SettingsError, match="a push wants link"):
        play("push@0.01:panda_joint3:0.02", 40)  # it has no place in a line of words
    for kind in set(KINDS) - {"push", *INTERFACE}:
        simulator, said, _ = play(f"{kind}@0.01:panda_joint3:0.02", 40)
        assert len(said[5]) == 7, kind
        assert all(d.state.name == "ENABLED" for k, d in enumerate(simulator.drives) if k != 2), kind


@pytest.mark.parametrize(
    ("text", "code"), [("drive_fault@0.02:2", 0xA), ("overheat@0.02:2", 0xC), ("watchdog@0.02:2:0.03", 0xD)]
)
def test_a_faulty_drive_reports_its_nibble_and_stays_so(text: str, code: int) -> None:
    _, said, c = play(text)
    errors = [c.states(r)[2].err for r in said if len(r) == 7]
    assert errors[:15] == [1] * 15
    assert errors[-20:] == [code] * 20


def test_silent_drive_is_heard_again_after_its_time() -> None:
    _, said, _ = play("silent@0.02:panda_joint3:0.01")
    counts = [len(r) for r in said]
    assert counts.count(6) == 10
    assert counts[-1] == 7


def test_corrupt_replies_fail_their_check_and_duplicates_come_twice() -> None:
    _, said, _ = play("corrupt_crc@0.02:0:0.01")
    bad = [[e2e.intact(frame.unpack(x).data, frame.unpack(x).can_id) for x in r].count(False) for r in said]
    assert sum(bad) == 10
    _, said, _ = play("duplicate@0.02:0:0.01")
    assert [len(r) for r in said].count(8) == 10


def test_stuck_encoder_repeats_itself_and_a_jump_is_seen() -> None:
    _, said, c = play("stuck_encoder@0.02:1")
    angles = {c.states(r)[1].p for r in said[25:]}
    assert len(angles) == 1
    _, said, c = play("encoder_jump@0.02:6:0.01", 30)
    q = [c.states(r)[6].p for r in said]
    assert max(abs(b - a) for a, b in pairwise(q)) == pytest.approx(0.5, abs=0.01)


def test_rebooted_drive_is_disabled() -> None:
    _, said, c = play("reboot@0.02:4")
    assert [c.states(r)[4].err for r in said][-1] == 0


def test_an_interface_off_the_bus_says_so_once_and_then_nothing_passes() -> None:
    _, said, _ = play("bus_off@0.02:0:0.01", 60)
    told = [[f for f in map(frame.unpack, replies) if f.error] for replies in said]
    off, on = (k for k, errors in enumerate(told) if errors)
    assert on - off == 10
    assert told[off][0].can_id & frame.ERR_BUSOFF
    assert told[on][0].can_id & frame.ERR_RESTARTED
    assert all(not replies for replies in said[off + 1 : on])
    assert len(said[off]) == 1
    assert len(said[on + 1]) == 7
    _, said, _ = play("error_passive@0.02", 60)
    (report,) = (f for replies in said for f in map(frame.unpack, replies) if f.error)
    assert report.can_id & frame.ERR_CRTL
    assert report.data[1] & frame.CRTL_PASSIVE
    assert [len(replies) for replies in said].count(7) == 59


def test_somebody_elses_commands_are_seen_and_taken_only_by_drives_that_ask_for_no_check() -> None:
    simulator, said, _ = play("foreign@0.02:1:0.01")
    own = simulator.drives[1].rating.motor
    assert [sum(frame.unpack(r).can_id == own for r in replies) for replies in said].count(1) == 10
    assert simulator.drives[1].state.name == "ENABLED"
    plain = open_simulator(str(ROOT / "configs" / "openarm.toml"), inject=["foreign@0:1"])
    of_all = scales(plain)[:7]
    payloads = [mit.ENABLE] * 7, [mit.encode_command(0, 0, 0, 0, 1.0, s) for s in of_all]
    for sent in (payloads[0], payloads[0], *[payloads[1]] * 20):
        replies = plain.exchange([frame.pack(k + 1, data, fd=True, brs=True) for k, data in enumerate(sent)])
    plain.close()
    given = {
        f.can_id: mit.decode_reply(f.data, of_all[f.can_id - 0x11]) for f in map(frame.unpack, replies) if f.can_id > 8
    }
    assert [round(reply.t, 1) for _, reply in sorted(given.items()) if reply] == [1.0, 0.0, 1.0, 1.0, 1.0, 1.0, 1.0]


@pytest.mark.parametrize("text", ["silent", "silent@", "silent@x", "noise@1", "silent@1:nose", "silent@1:0:long"])
def test_malformed_injections_are_refused(text: str) -> None:
    with pytest.raises(SettingsError):
        parse(text, ["a", "b"])


# ---- on a bus


def config_at(folder: Path) -> Path:
    """Return a copy of the Panda's file whose bus is in a folder of its own."""
    path = folder / "panda.toml"
    path.write_text(PANDA.read_text().replace('channel = "panda"', f'channel = "{folder}/bus"'))
    return path


class Process:
    """A simulator process and one peer on its bus."""

    def __init__(self, folder: Path, *options: str) -> None:
        command = [sys.executable, "-m", "firmware_sim", str(config_at(folder)), "--report", str(folder / "r.json")]
        self.popen = subprocess.Popen([*command, *options], stdout=subprocess.PIPE, text=True, cwd=ROOT)
        assert self.popen.stdout is not None
        self.line = self.popen.stdout.readline()
        self.report_path = folder / "r.json"
        self.peer = connect(folder)

    def cycle(self, frames: list[bytes]) -> list[bytes]:
        """Send frames; return seven replies."""
        for raw in frames:
            self.peer.send(raw)
        return [self.peer.recv(80) for _ in range(7)]

    def report(self) -> Any:
        """Return the report as it stands."""
        return json.loads(self.report_path.read_text())

    def end(self) -> Any:
        """Ask it to end; return the final report."""
        self.popen.send_signal(signal.SIGTERM)
        assert self.popen.wait(10) == 0
        assert self.popen.stdout is not None
        self.popen.stdout.close()
        self.peer.close()
        return self.report()


def connect(folder: Path) -> socket.socket:
    """Return a new peer on the bus."""
    peer = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    peer.settimeout(10.0)
    peer.connect(str(folder / "bus"))
    return peer


def test_lockstep_process_says_the_same_as_the_simulator_in_process(tmp_path: Path) -> None:
    process = Process(tmp_path, "--lockstep")
    assert process.line.startswith("drives ready on socketpair")
    inside = open_simulator(str(PANDA))
    c = Controller(scales(inside))
    mine = theirs = b""
    replies: list[bytes] = []
    for k in range(150):
        commands = c.special(mit.ENABLE) if k < 2 else c.hold(replies)
        replies = process.cycle(commands)
        theirs += b"".join(replies)
        mine += b"".join(inside.exchange(commands))
    inside.close()
    report = process.end()
    assert theirs == mine
    assert report["mode"] == "lockstep"
    assert report["frames"] == 7 * 150
    assert report["periods"] >= 150
    assert report["min_self_clearance_m"] > 0.0
    assert not (tmp_path / "bus").exists()


def test_in_lockstep_drives_are_more_patient_than_the_controller_that_waits_for_a_reply() -> None:
    """Else one reply that is lost would trip all watchdogs, and a test of silence measure the rig."""
    assert LOCKSTEP_WAIT + 0.5 < QUIET_S


@pytest.mark.parametrize("options", [("--lockstep",), ()])
def test_a_killed_controller_is_noticed_within_the_watchdog(tmp_path: Path, options: tuple[str, ...]) -> None:
    process = Process(tmp_path, *options)
    c = Controller(scales_of_panda())
    replies = process.cycle(c.special(mit.ENABLE))
    replies = process.cycle(c.special(mit.ENABLE))
    for k in range(60):
        push = c.hold(replies) if k % 2 else c.torque([5.0, -10.0, 0.0, 12.0, 0.0, 2.0, 0.0])
        replies = process.cycle(push)
    process.peer.close()  # as a killed process's socket is
    deadline = time.monotonic() + 20.0
    while time.monotonic() < deadline:
        time.sleep(0.1)
        if process.report_path.exists() and process.report()["stop_s"] is not None:
            break
    report = process.end()
    assert {t["code"] for t in report["trips"]} == {0xD}
    assert report["watchdog_trips"] == 7
    for trip in report["trips"]:
        assert trip["command_to_fault_s"] == pytest.approx(0.020, abs=0.0006)
        assert trip["command_to_rest_s"] < 0.5
    assert set(report["states"].values()) == {"FAULT"}
    assert report["contacts"] == 0


def scales_of_panda() -> list[mit.Scale]:
    """Return the controller's view of the Panda's drives."""
    return [mit.Scale(*r.scale) for r in open_settings().ratings]


def test_real_time_answers_at_once_and_keeps_the_wall_s_pace(tmp_path: Path) -> None:
    process = Process(tmp_path)
    c = Controller(scales_of_panda())
    first, began = process.cycle(c.special(mit.DISABLE)), time.monotonic()
    assert [s.err for s in c.states(first)] == [0] * 7
    for _ in range(50):
        process.cycle(c.special(mit.DISABLE))
    time.sleep(max(0.0, 1.5 - (time.monotonic() - began)))
    report = process.end()
    elapsed = time.monotonic() - began
    lost = report["slipped_steps"] * 0.0005
    assert 1.0 < report["time_s"] + lost < elapsed + 1.0
    assert report["scene_s"] == 0.0  # nobody enabled a drive yet


def test_second_simulator_on_a_bus_and_a_bad_file_are_refused(tmp_path: Path) -> None:
    process = Process(tmp_path)
    command = [sys.executable, "-m", "firmware_sim"]
    second = subprocess.run([*command, str(tmp_path / "panda.toml")], capture_output=True, text=True, cwd=ROOT)
    assert second.returncode == 78
    assert second.stderr.count("\n") == 1
    assert "served already" in second.stderr
    absent = subprocess.run([*command, str(tmp_path / "none.toml")], capture_output=True, text=True, cwd=ROOT)
    assert (absent.returncode, absent.stderr.count("\n")) == (78, 1)
    process.end()


def look(bus: Hub, timeout: float = 0.1) -> list[bytes]:
    """Return the frames that come to the hub in one look."""
    batch = Batch(bus.capacity)
    bus.wait(timeout)
    bus.receive(batch)
    return batch.frames()


def send(bus: Hub, *frames: bytes) -> None:
    """Send frames from the hub."""
    batch = Batch()
    batch.extend(frames)
    bus.send(batch)


def drain(bus: Hub, wanted: int) -> list[bytes]:
    """Return `wanted` frames from the hub, however many looks it takes."""
    frames: list[bytes] = []
    for _ in range(50):
        frames += look(bus)
        if len(frames) >= wanted:
            break
    return frames


def test_hub_forwards_like_a_bus_and_survives_its_peers(tmp_path: Path) -> None:
    hub = Hub(str(tmp_path / "bus"))
    a, b, deaf = (connect(tmp_path) for _ in range(3))
    for _ in range(3):
        look(hub)
    one, two = frame.pack(1, b"one"), frame.pack(2, b"two", fd=True)
    a.send(one)
    a.send(two)
    a.send(b"no frame")
    assert drain(hub, 2) == [one, two]
    assert [b.recv(80), b.recv(80)] == [one, two]
    a.setblocking(False)
    with pytest.raises(BlockingIOError):
        a.recv(80)  # nobody hears himself
    send(hub, two)
    assert a.recv(80) == two
    deaf.send(one)  # it takes part, as a controller does
    assert drain(hub, 1) == [one]
    assert [a.recv(80), b.recv(80), b.recv(80)] == [one, two, one]
    for _ in range(1000):
        send(hub, one)  # a peer that does not read loses frames, nobody waits for it
        a.recv(80)
        b.recv(80)
    assert hub.dropped > 0
    deaf.close()
    a.send(one)
    assert drain(hub, 1) == [one]
    send(hub, two)
    a.close()
    b.close()
    look(hub)
    hub.close()
    assert not (tmp_path / "bus").exists()


def test_who_only_listens_may_be_late(tmp_path: Path) -> None:
    """On a busy machine a bystander is kept from reading for longer than the kernel's usual buffer lasts."""
    hub, frames = Hub(str(tmp_path / "bus")), [frame.pack(1, bytes([k % 256])) for k in range(1000)]
    with connect(tmp_path) as bystander:
        look(hub)
        for each in frames:
            send(hub, each)
        if hub.dropped and os.geteuid():
            pytest.skip("only root may let so much wait")
        assert hub.dropped == 0
        assert [bystander.recv(80) for _ in frames] == frames
    hub.close()


def test_a_peer_that_dies_while_frames_are_forwarded_to_it_is_let_go(tmp_path: Path) -> None:
    hub = Hub(str(tmp_path / "bus"))
    with connect(tmp_path) as a, connect(tmp_path) as b:
        for _ in range(2):
            look(hub)
        a.send(frame.pack(1, b"one"))
        b.send(frame.pack(2, b"two"))
        b.close()
        for _ in range(3):
            look(hub, 0.01)
        send(hub, frame.pack(3, b"three"))
        assert a.recv(80)
    hub.close()


def test_a_dead_simulator_s_socket_is_taken_over_but_a_file_is_not(tmp_path: Path) -> None:
    path = tmp_path / "bus"
    left = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    left.bind(str(path))
    left.close()
    hub = Hub(str(path))
    assert path.stat().st_mode & 0o077 == 0
    hub.close()
    path.write_text("precious")
    with pytest.raises(SettingsError, match="no socket"):
        Hub(str(path))
    assert path.read_text() == "precious"


# ---- the camera


def test_camera_tells_where_things_are_now_and_what_is_gone(tmp_path: Path) -> None:
    specs: list[dict[str, Any]] = [
        {**OVER_HOME, "velocity_m_s": [0.0, -0.1, 0.0]},
        {
            "name": "slab",
            "type": "plane",
            "normal": [0.0, 1.0, 0.0],
            "waypoints": [[0.0, 0.0, -1.0, 0.0], [1.0, 0.0, -0.8, 0.0]],
            "vanishes_s": 0.5,
        },
    ]
    simulator = open_simulator(str(PANDA), {"obstacle": specs})
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    camera = Camera(str(tmp_path / "console"), simulator.plant.solids)
    camera.tick(0, 0)  # nobody there yet: no harm
    listener.bind(str(tmp_path / "console"))
    listener.listen()
    camera.tick(500_000_000, 250_000_000)
    daemon, _ = listener.accept()
    daemon.settimeout(5.0)
    message = json.loads(daemon.recv(65536))
    assert message["verb"] == "obstacles"
    ball, slab = message["set"]
    assert ball["position_m"] == pytest.approx([0.6, 0.375, 0.4])
    assert ball["velocity_m_s"] == [0.0, -0.1, 0.0]
    assert slab["position_m"] == pytest.approx([0.0, -0.95, 0.0])
    assert slab["velocity_m_s"] == pytest.approx([0.0, 0.2, 0.0])
    assert not {"waypoints", "vanishes_s", "appears_s", "normal", "rpy_rad"} & (slab.keys() | ball.keys())
    camera.tick(510_000_000, 260_000_000)  # too early for the next frame
    daemon.send(b'{"ok": false, "error": "too many"}')
    camera.tick(520_000_000, 600_000_000)
    message = json.loads(daemon.recv(65536))
    assert [o["name"] for o in message["set"]] == ["ball"]
    assert message["clear"] == ["slab"]
    assert (camera.sent, camera.refused, camera.refusal) == (2, 1, "too many")
    daemon.close()
    camera.tick(540_000_000, 600_000_000)  # hung up on: no harm
    camera.tick(560_000_000, 600_000_000)
    camera.tick(1_100_000_000, 600_000_000)
    daemon, _ = listener.accept()
    assert json.loads(daemon.recv(65536))["verb"] == "obstacles"
    for s in (daemon, listener):
        s.close()
    camera.close()
    simulator.close()


def test_every_obstacle_type_is_told_as_the_controller_reads_it() -> None:
    from firmware_sim.camera import seen
    from firmware_sim.shapes import shape_at, solid
    from rtctl.spec.obstacles import shape_of
    from rtctl.spec.scenario import parse_obstacle

    at = {"position_m": [0.1, 0.2, 0.3], "rpy_rad": [0.2, -0.4, 1.0], "velocity_m_s": [0.1, 0.0, 0.0], "name": "it"}
    tables: list[dict[str, Any]] = [
        {"type": "sphere", "radius_m": 0.1},
        {"type": "point"},
        {"type": "capsule", "radius_m": 0.1, "length_m": 0.4},
        {"type": "segment", "length_m": 0.4},
        {"type": "cylinder", "radius_m": 0.1, "length_m": 0.4},
        {"type": "box", "size_m": [0.1, 0.2, 0.4]},
        {"type": "plane"},
        {"type": "ellipsoid", "semi_axes_m": [0.1, 0.2, 0.3]},
        {"type": "n_ellipsoid", "semi_axes_m": [0.1, 0.2, 0.3], "n": 4.0},
        {"type": "n_cylinder", "semi_axes_m": [0.1, 0.2, 0.3], "n": 4.0},
        {"type": "cone", "radius_m": 0.2, "height_m": 0.4, "top_radius_m": 0.1},
    ]
    settings = open_settings()
    for table in tables:
        mine = shape_at(solid({**at, **table}, settings), 0.5)
        assert mine is not None
        theirs = shape_of(parse_obstacle({**at, **table}, "test"), 0.5)
        told = shape_of(parse_obstacle(seen(solid({**at, **table}, settings), mine), "test"), 0.0)
        for other in (theirs, told):
            assert (mine.name, mine.type) == (other.name, other.type)
            for key in ("dims", "position", "wxyz", "velocity", "omega"):
                assert getattr(mine, key) == pytest.approx(getattr(other, key), abs=1e-12), (table, key)

"""The drives' protocol as another hand wrote it: the published Python driver of Damiao motors, package damiao-motor.

It speaks with our virtual drives and reads our frames, and it is the other program on the bus of a running arm.
"""

import re
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import can
import numpy as np
import pytest
from damiao_motor import DaMiaoController, DaMiaoMotor
from hypothesis import given
from hypothesis import strategies as st

from firmware_sim import codec
from firmware_sim.simulator import Simulator, open_simulator
from rtctl.protocol import frame, mit
from rtctl.types import Request, State, Verb
from tests.lab import ROOT, Lab

pytestmark = pytest.mark.filterwarnings("ignore:The 'bustype' argument:DeprecationWarning")  # theirs
OPENARM = ROOT / "configs" / "openarm.toml"  # as its maker ships it: plain frames of 8 bytes
THEIRS = {"DM4310": "4310", "DM6006": "6006", "DM8006": "8006", "DM8009": "8009", "DM10010L": "10010L"}
GRIPPER = 8


class Wire(can.BusABC):
    """A python-can bus whose other end is a simulator: what is sent is answered at once."""

    def __init__(self, simulator: Simulator | None) -> None:
        self.channel_info = "wire"
        self.simulator = simulator
        self.sent: list[bytes] = []
        self.waiting: deque[can.Message] = deque()

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Take a frame."""
        fd = self.simulator is not None and self.simulator.settings.fd
        self.sent.append(frame.pack(msg.arbitration_id, bytes(msg.data), fd=fd, brs=fd))
        for raw in [] if self.simulator is None else self.simulator.exchange([self.sent[-1]]):
            self.hear(raw)

    def hear(self, raw: bytes) -> None:
        """Let the driver read a frame."""
        f = frame.unpack(raw)
        self.waiting.append(can.Message(arbitration_id=f.can_id, data=f.data, is_extended_id=False))

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """Return the next frame, None without one."""
        return self.waiting.popleft() if self.waiting else None


class Driver(DaMiaoController):  # type: ignore[misc]
    """The published controller on a wire; it reads by itself in a thread of its own."""

    def __init__(self, wire: Wire) -> None:
        super().__init__(channel="wire", bustype="virtual")
        opened: can.BusABC = self.bus
        opened.shutdown()
        self.bus: can.BusABC = wire


@contextmanager
def driven(simulator: Simulator | None = None) -> Iterator[tuple[Driver, Wire]]:
    """Open the published driver on a wire of its own."""
    wire = Wire(simulator)
    driver = Driver(wire)
    try:
        yield driver, wire
    finally:
        driver._stop_polling()
        wire.shutdown()


def motor(name: str) -> DaMiaoMotor:
    """Return their motor of a type, on no bus."""
    return DaMiaoMotor(1, 0x11, None, motor_type=THEIRS[name])


# ---- bytes


def lsb(bound: float, bits: int) -> float:
    """Return the resolution of a field that spans +-bound."""
    return 2.0 * bound / ((1 << bits) - 1)


@pytest.mark.parametrize("name", THEIRS)
@given(share=st.tuples(*[st.floats(-1.0, 1.0)] * 3), gains=st.tuples(st.floats(0, 500), st.floats(0, 5)))
def test_our_drive_reads_a_command_of_theirs_to_the_resolution(name: str, share, gains):
    scale = mit.DRIVES[name]
    p, v, t = (s * bound for s, bound in zip(share, scale, strict=True))
    data = motor(name).encode_cmd_msg(p, v, t, *gains)
    read = codec.decode_command(data, codec.Scale(*scale))
    if read.special:  # six fields of ones: the protocol itself cannot tell it from a special frame
        return
    assert read.p == pytest.approx(p, abs=1.01 * lsb(scale.p_max, 16))
    assert read.v == pytest.approx(v, abs=1.01 * lsb(scale.v_max, 12))
    assert read.t == pytest.approx(t, abs=1.01 * lsb(scale.t_max, 12))
    assert read.kp == pytest.approx(gains[0], abs=500.0 / 4095)
    assert read.kd == pytest.approx(gains[1], abs=5.0 / 4095)


@pytest.mark.parametrize("name", THEIRS)
@given(share=st.tuples(*[st.floats(-1.0, 1.0)] * 3), err=st.sampled_from(sorted(mit.STATUS)), hot=st.integers(0, 255))
def test_they_read_a_reply_of_our_drive_as_we_do(name: str, share, err: int, hot: int):
    scale = mit.DRIVES[name]
    q, qd, tau = (s * bound for s, bound in zip(share, scale, strict=True))
    data = codec.encode_state(1, err, q, qd, tau, (hot, 30), codec.Scale(*scale))
    theirs = motor(name).decode_sensor_feedback(data)
    assert (theirs["can_id"], theirs["status_code"], theirs["t_mos"]) == (1, err, hot)
    assert theirs["pos"] == pytest.approx(q, abs=0.51 * lsb(scale.p_max, 16))
    assert theirs["vel"] == pytest.approx(qd, abs=0.51 * lsb(scale.v_max, 12))
    assert theirs["torq"] == pytest.approx(tau, abs=0.51 * lsb(scale.t_max, 12))


def test_the_special_frames_are_theirs():
    theirs = DaMiaoMotor
    assert theirs.encode_enable_msg() == mit.ENABLE
    assert theirs.encode_disable_msg() == mit.DISABLE
    assert theirs.encode_save_position_zero_msg() == mit.ZERO
    assert theirs.encode_clear_error_msg() == mit.CLEAR


@pytest.mark.parametrize("name", THEIRS)
def test_the_full_scales_of_a_type_are_theirs(name: str):
    one = motor(name)
    assert mit.DRIVES[name] == (one._p_max, one._v_max, one._t_max)


# ---- their driver, our drives


def test_their_driver_moves_a_joint_of_ours_where_it_wants():
    simulator = open_simulator(OPENARM)
    with driven(simulator) as (driver, _):
        joint = driver.add_motor(5, 0x15, motor_type="4310")
        assert joint.get_register(mit.TMAX) == 10.0
        assert joint.get_register(mit.ESC_ID) == 5
        joint.ensure_control_mode("MIT")
        joint.enable()
        start = simulator.plant.q[4]
        for _ in range(1500):
            joint.send_cmd_mit(start + 0.3, 0.0, 20.0, 0.8, 0.0)
        driver.poll_feedback()
        seen = joint.get_states()
    assert seen["status"] == "ENABLED"
    assert simulator.plant.q[4] == pytest.approx(start + 0.3, abs=0.05)  # kp alone carries the gravity
    assert seen["pos"] == pytest.approx(simulator.plant.q[4], abs=1e-3)
    assert abs(seen["vel"]) < 0.05
    simulator.close()


def test_an_arm_runs_on_while_their_driver_works_a_gripper_on_its_bus(tmp_path: Path):
    """Enabled, polled on 0x7FF and moved every tenth slot, its replies on 0x18: nothing of it is the arm's."""
    text = OPENARM.read_text().replace('"openarm.urdf"', f'"{OPENARM.with_suffix(".urdf")}"')
    without, count = re.subn(r"\[\[gripper\]\].*?(?=\n\[)", "", text, flags=re.DOTALL)  # it is theirs
    assert count == 1
    path = tmp_path / "openarm.toml"
    path.write_text(without)
    simulator = open_simulator(path)
    here = Lab(path, simulator)
    heard = here.link.transport._exchange  # what the arm's own frames are answered with
    scale = codec.Scale(*mit.DRIVES["DM4310"])
    with driven() as (driver, wire):
        gripper = driver.add_motor(GRIPPER, 0x18, motor_type="4310")
        work = [gripper.enable, gripper.request_motor_feedback, lambda: gripper.send_cmd_mit(0.5, 0.0, 10.0, 1.0, 0.0)]

        def shared(frames: list[bytes]) -> list[bytes]:
            wire.sent.clear()
            if here.slot % 10 == 0:
                work[here.slot // 10 % 3]()
            others = [frame.pack(0x18, codec.encode_state(GRIPPER, 1, 0.5, 0.0, 0.1, (30, 30), scale), True, True)]
            return heard([*frames, *wire.sent]) + wire.sent + (others if wire.sent else [])

        here.link.transport._exchange = shared
        here.running()
        here.ask(simulator.truth().tip + np.array([0.03, 0.03, 0.03]))
        here.run(2.5)
        assert len(wire.sent) <= 1
    assert here.memory.state == State.RUN
    assert here.memory.status.name == "ARRIVED"
    assert not here.servo.faults_seen
    here.step(Request(Verb.DISARM))
    simulator.close()

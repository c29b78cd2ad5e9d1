"""The handshake: what it refuses, by name, before any drive could be enabled."""

import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from rtctl.errors import EXIT_CONFIG, HandshakeError
from rtctl.hal.can.handshake import check_interface, handshake
from rtctl.hal.can.link import CanLink, LinkSpec
from rtctl.hal.can.transport import InProcess
from rtctl.protocol import frame, mit
from rtctl.types import Command, Drive, Link
from tests.fake_drives import PERIOD, PROTOCOLS, TIMEOUT_COUNTS, FakeDrives, spec_of

N = 3
Prepare = Callable[[FakeDrives], None]


def link_to(drives: FakeDrives, spec: LinkSpec) -> CanLink:
    return CanLink(spec, InProcess(drives.exchange))


@pytest.fixture(params=PROTOCOLS)
def spec(request: pytest.FixtureRequest) -> LinkSpec:
    return spec_of(N, request.param)


def refused(drives: FakeDrives, spec: LinkSpec, recover: bool = False) -> HandshakeError:
    with pytest.raises(HandshakeError) as caught:
        handshake(link_to(drives, spec), listen=0.0, timeout=0.01, recover=recover)
    assert caught.value.exit_code == EXIT_CONFIG
    assert "\n" not in str(caught.value)
    return caught.value


def test_healthy_drives_are_greeted_without_one_frame_that_enables_or_writes(spec: LinkSpec) -> None:
    drives = FakeDrives(spec)
    drives.codes = [(0x8000 + 1000 * j, 0x800, 0x800) for j in range(N)]
    greeting = handshake(link_to(drives, spec), listen=0.0)
    np.testing.assert_allclose(greeting.q, [1000 * j * 25 / 65535 for j in range(N)], atol=25 / 65535)
    assert greeting.watchdogs_written == ()
    assert drives.written == []
    assert {f.data[:8] for f in drives.seen if f.can_id != 0x7FF} == {mit.DISABLE}
    assert {f.data[2] for f in drives.seen if f.can_id == 0x7FF} == {mit.READ}
    assert [frame.unpack(raw) for raw in greeting.sent] == drives.seen
    assert len(greeting.received) == len(greeting.sent)


def test_the_first_cycle_after_it_is_a_healthy_one(spec: LinkSpec) -> None:
    link = link_to(FakeDrives(spec), spec)
    handshake(link, listen=0.0)
    for slot in range(40, 43):
        feedback = link.read(slot, 0, 0.0, 0.0)
        assert Link(feedback.link) == Link.NONE
        assert feedback.replies.tolist() == [1] * N
        np.testing.assert_allclose(feedback.age, PERIOD)
        link.write(Command(Drive.DISABLE, np.zeros(N)))


def test_it_may_be_repeated_in_the_middle_of_a_session(spec: LinkSpec) -> None:
    drives = FakeDrives(spec)
    link = link_to(drives, spec)
    for slot in range(5):
        link.read(slot, 0, 0.0, 0.0)
        link.write(Command(Drive.TORQUE, np.zeros(N)))
    drives.counters = [200] * N  # rebooted meanwhile
    link.bus_state = Link.BUS_OFF
    handshake(link, listen=0.0)
    feedback = link.read(500, 0, 0.0, 0.0)
    assert Link(feedback.link) == Link.NONE
    assert feedback.replies.tolist() == [1] * N
    np.testing.assert_allclose(feedback.age, PERIOD)


def test_a_lost_reply_is_asked_for_again(spec: LinkSpec) -> None:
    drives, calls = FakeDrives(spec), [0]

    def lose_every_fifth(joint: int, raw: bytes) -> list[bytes]:
        calls[0] += 1
        return [] if calls[0] % 5 == 0 else [raw]

    drives.mischief = lose_every_fifth
    assert len(handshake(link_to(drives, spec), listen=0.0, timeout=0.01).q) == N


def test_a_late_answer_of_the_other_kind_is_not_mistaken(spec: LinkSpec) -> None:
    drives, held = FakeDrives(spec), [b""]

    def late(joint: int, raw: bytes) -> list[bytes]:
        if joint != 1:
            return [raw]
        before, held[0] = held[0], raw
        return [before] if before else []

    drives.mischief = late
    greeting = handshake(link_to(drives, spec), listen=0.0, timeout=0.01)
    np.testing.assert_allclose(greeting.q, 0.0, atol=25 / 65535)


def test_an_absent_joint(spec: LinkSpec) -> None:
    drives = FakeDrives(spec)
    drives.mischief = lambda joint, raw: [] if joint == 2 else [raw]
    error = refused(drives, spec)
    assert error.place == "can0: joint joint3 (id 3)"
    assert (error.got, error.wanted) == (
        "no answer; what came: 0x11 joint1, 0x12 joint2",
        "a reply on id 0x13",
    )


def test_a_drive_that_answers_under_an_identifier_of_its_own_is_named(spec: LinkSpec) -> None:
    drives = FakeDrives(spec)
    drives.replies[2] = 0  # as delivered: MST_ID was never set
    assert refused(drives, spec).got == "no answer; what came: 0x0 (3 frames), 0x11 joint1, 0x12 joint2"


def test_two_motors_of_one_identifier_are_refused_by_name(spec: LinkSpec) -> None:
    drives, twin = FakeDrives(spec), FakeDrives(spec)
    drives.codes[1], twin.codes[1] = (0x8000, 0x800, 0x800), (0x9000, 0x800, 0x800)

    def both(frames: list[bytes]) -> list[bytes]:
        only = [raw for raw in frames if raw[:2] == b"\x02\0"]
        return drives.exchange(frames) + twin.exchange(only)

    with pytest.raises(HandshakeError, match=r"joint joint2 \(id 2\)") as caught:
        handshake(CanLink(spec, InProcess(both)), listen=0.0, timeout=0.01)
    assert caught.value.got == "two answers to one command, 0.0002 rad and 1.5627 rad"
    assert caught.value.wanted == "one motor of this id"


def test_an_answer_that_comes_late_once_is_no_second_motor(spec: LinkSpec) -> None:
    drives, held = FakeDrives(spec), [b""]
    calls = [0]

    def late_once(joint: int, raw: bytes) -> list[bytes]:
        if joint != 1:
            return [raw]
        calls[0] += 1
        if calls[0] == 1:
            held[0] = raw
            return []
        before, held[0] = held[0], b""
        return [before, raw] if before else [raw]

    drives.mischief = late_once
    handshake(link_to(drives, spec), listen=0.0, timeout=0.01)


@pytest.mark.parametrize("fd", [False, True])
def test_another_program_that_polls_its_own_motor_is_let_be(spec: LinkSpec, fd: bool) -> None:
    poll = frame.pack(mit.REGISTER_ID, bytes.fromhex("0800cc0000000000"), fd)
    drives = FakeDrives(spec)
    drives.mischief = lambda joint, raw: [raw, poll, frame.pack(0x18, bytes(8))]
    link = link_to(drives, spec)
    handshake(link, listen=0.0)
    assert Link(link.read(1, 0, 0.0, 0.0).link) == Link.NONE
    link.write(Command(Drive.TORQUE, np.zeros(N)))
    feedback = link.read(2, 0, 0.0, 0.0)
    assert Link(feedback.link) == Link.NONE
    assert feedback.replies.tolist() == [1] * N
    assert link.foreign == 0


def test_a_bus_in_trouble_is_named_with_the_absent_joint(spec: LinkSpec) -> None:
    drives = FakeDrives(spec)
    drives.mischief = lambda joint, raw: [frame.pack(0x40, bytes(8), error=True)]
    assert refused(drives, spec).got == "no answer (BUS_OFF)"


REGISTERS = [
    (mit.MST_ID, "MST_ID", 0x33, "51", "18"),
    (mit.ESC_ID, "ESC_ID", 5, "5", "2"),
    (mit.CTRL_MODE, "CTRL_MODE", 2, "2", "1"),
    (mit.PMAX, "PMAX", 12.0, "12 (-0.5, -4 %)", "12.5"),
    (mit.VMAX, "VMAX", 8.0, "8 (-37, -82.2 %)", "45"),
    (mit.TMAX, "TMAX", 10.0, "10 (-44, -81.5 %)", "54"),
    (mit.TMAX, "TMAX", float("nan"), "nan", "54"),
]


@pytest.mark.parametrize(("rid", "name", "value", "got", "wanted"), REGISTERS)
def test_a_register_that_contradicts_the_config(
    spec: LinkSpec, rid: int, name: str, value: float, got: str, wanted: str
) -> None:
    drives = FakeDrives(spec)
    drives.registers[1][rid] = value
    error = refused(drives, spec)
    assert error.place == f"can0: joint joint2 (id 2): register {rid} {name}"
    assert (error.got, error.wanted) == (got, wanted)


def test_a_scale_is_compared_as_the_drive_holds_it() -> None:
    spec = spec_of(N)
    joints = tuple(joint._replace(scale=mit.Scale(12.3, 45.1, 54.7)) for joint in spec.joints)
    spec = spec._replace(joints=joints)
    drives = FakeDrives(spec)
    for registers in drives.registers:
        registers |= {21: 12.3, 22: 45.1, 23: 54.7}
    assert handshake(link_to(drives, spec), listen=0.0).watchdogs_written == ()


@pytest.mark.parametrize(
    ("holds", "printed"), [(12.566371, 12.5664), (12.566371, 12.56637), (0.1, 0.1), (45.0, 45.0001)]
)
def test_a_scale_that_was_printed_with_six_digits_is_the_same(holds: float, printed: float) -> None:
    spec = spec_of(N)
    joints = tuple(joint._replace(scale=mit.Scale(12.5, printed, 54.0)) for joint in spec.joints)
    spec = spec._replace(joints=joints)
    drives = FakeDrives(spec)
    for registers in drives.registers:
        registers[22] = holds
    handshake(link_to(drives, spec), listen=0.0)
    drives.registers[0][22] = holds * (1.0 + 1e-5)
    assert str(refused(drives, spec).got).endswith(" %)")


def test_a_register_that_is_not_answered(spec: LinkSpec) -> None:
    drives = FakeDrives(spec)
    drives.mischief = lambda joint, raw: [] if raw[10:12] == bytes((0x33, 21)) and joint == 0 else [raw]
    error = refused(drives, spec)
    assert error.place == "can0: joint joint1 (id 1): register 21 PMAX"
    assert error.got == "no answer"


@pytest.mark.parametrize("counts", [0, 399, 2000])
def test_a_watchdog_is_written_only_where_it_differs_and_read_back(spec: LinkSpec, counts: int) -> None:
    drives = FakeDrives(spec)
    drives.registers[1][mit.TIMEOUT] = counts
    greeting = handshake(link_to(drives, spec), listen=0.0)
    assert greeting.watchdogs_written == ("joint2",)
    assert drives.written == [(1, mit.TIMEOUT)]
    assert drives.registers[1][mit.TIMEOUT] == TIMEOUT_COUNTS
    assert handshake(link_to(drives, spec), listen=0.0).watchdogs_written == ()


def test_a_watchdog_that_does_not_take_what_is_written(spec: LinkSpec) -> None:
    drives = FakeDrives(spec)
    drives.registers[1][mit.TIMEOUT], drives.write_works = 0, False
    error = refused(drives, spec)
    assert error.place == "can0: joint joint2 (id 2): register 9 TIMEOUT"
    assert (error.got, error.wanted) == ("0", str(TIMEOUT_COUNTS))


@pytest.mark.parametrize("watchdog", [3 * PERIOD, 0.0, 0.1001])
def test_a_watchdog_too_short_or_too_long_for_the_loop(watchdog: float) -> None:
    spec = spec_of(N, watchdog=watchdog)
    drives = FakeDrives(spec)
    assert refused(drives, spec).place == "can0: watchdog"
    assert drives.seen == []


@pytest.mark.parametrize(("code", "side"), [(0xA000, 1), (0x5FFF, -1)])
def test_a_joint_outside_its_limits_unless_recovering_was_asked_for(spec: LinkSpec, code: int, side: int) -> None:
    drives = FakeDrives(spec)
    drives.codes[2] = (code, 0x800, 0x800)  # +-3.1252 rad: 8192.5 steps of 25 / 65535; limits +-3
    error = refused(drives, spec)
    assert error.place == "can0: joint joint3 (id 3): position"
    assert error.got == f"{side * 3.1252:.4f} rad"
    assert "recover" in error.wanted
    assert handshake(link_to(drives, spec), listen=0.0, recover=True).q[2] == pytest.approx(side * 8192.5 * 25 / 65535)


def test_drives_that_answer_in_classic_frames_where_fd_was_promised() -> None:
    spec = spec_of(N)
    drives = FakeDrives(spec)
    drives.mischief = lambda joint, raw: [frame.pack(0x11 + joint, raw[8:16])]
    error = refused(drives, spec)
    assert error.place == "can0: joint joint1 (id 1): reply"
    assert "classic frame of 8 bytes" in str(error.got)
    assert error.wanted == "a CAN FD frame with bit-rate switch of 12 bytes, CRC right"


def test_drives_that_do_not_switch_the_bit_rate() -> None:
    spec = spec_of(N)
    drives = FakeDrives(spec)
    drives.brs = False
    assert refused(drives, spec).got == "CAN FD without bit-rate switch"


@pytest.mark.parametrize("fd", [False, True])
def test_drives_that_speak_the_other_protocol(fd: bool) -> None:
    spec = spec_of(N, "mit", fd)
    drives = FakeDrives(spec_of(N))  # answers with twelve protected bytes
    error = refused(drives, spec)
    assert error.place == "can0: joint joint1 (id 1): reply"
    assert "12 bytes" in str(error.got)


def test_a_crc_that_does_not_fit() -> None:
    spec = spec_of(N)
    drives = FakeDrives(spec)
    drives.mischief = lambda joint, raw: [raw[:18] + bytes((raw[18] ^ 1,)) + raw[19:]]
    assert "CRC right" in refused(drives, spec).wanted


def test_a_reply_that_names_another_motor() -> None:
    spec = spec_of(N, "mit")
    drives = FakeDrives(spec)
    drives.mischief = lambda joint, raw: [raw[:8] + b"\x07" + raw[9:] if raw[8] == 2 and raw[10] != 0x33 else raw]
    error = refused(drives, spec)
    assert error.place == "can0: joint joint2 (id 2): reply"


@pytest.mark.parametrize("can_id", [1, mit.REGISTER_ID])
def test_a_second_master_heard_while_listening(can_id: int) -> None:
    spec = spec_of(N)
    to_motor_2 = mit.read_register(2, mit.PMAX)
    waiting = [frame.pack(can_id, mit.DISABLE if can_id == 1 else to_motor_2)]
    transport = InProcess(lambda frames: waiting)
    transport.send(b"")
    whom = f"{can_id:#x}" if can_id == 1 else "0x7ff to motor 2"
    with pytest.raises(HandshakeError, match=f"can0: got somebody else's frame on id {whom}, wanted one master"):
        handshake(CanLink(spec, transport), listen=0.01)


def test_a_second_master_heard_in_the_middle(spec: LinkSpec) -> None:
    drives = FakeDrives(spec)
    drives.mischief = lambda joint, raw: [raw, frame.pack(3, mit.ENABLE)] if joint == 1 else [raw]
    assert refused(drives, spec).wanted == "one master"


def test_what_was_on_its_way_before_is_not_taken_for_an_answer() -> None:
    spec = spec_of(N, "mit")
    drives = FakeDrives(spec)
    drives.mischief = lambda joint, raw: [] if joint == 0 else [raw]
    link = link_to(drives, spec)
    link.pending = [frame.pack(0x11, struct.pack(">BHI", 1, 0x8000, 0) + b"\0")]
    with pytest.raises(HandshakeError, match=r"joint1 \(id 1\): got no answer"):
        handshake(link, listen=0.0, timeout=0.01)


@pytest.fixture
def net(tmp_path: Path) -> Path:
    """An interface as /sys/class/net shows a healthy one."""
    at = tmp_path / "can0"
    at.mkdir()
    for name, text in (("flags", "0x400c1"), ("mtu", "72"), ("tx_queue_len", "64")):
        (at / name).write_text(text + "\n")
    return tmp_path


def test_a_healthy_interface_passes(net: Path) -> None:
    check_interface("can0", True, net)
    (net / "can0" / "mtu").write_text("16\n")
    check_interface("can0", False, net)


@pytest.mark.parametrize(
    ("name", "text", "place", "got"),
    [
        ("tx_queue_len", "10", "can0: txqueuelen", "10"),
        ("mtu", "16", "can0: mtu", "16"),
        ("flags", "0x400c0", "can0", "interface down"),
    ],
)
def test_an_interface_that_is_not_fit(net: Path, name: str, text: str, place: str, got: str) -> None:
    (net / "can0" / name).write_text(text)
    with pytest.raises(HandshakeError) as caught:
        check_interface("can0", True, net)
    assert (caught.value.place, str(caught.value.got)) == (place, got)


def test_an_interface_that_does_not_exist(net: Path) -> None:
    with pytest.raises(HandshakeError, match="can7: got no such interface"):
        check_interface("can7", True, net)

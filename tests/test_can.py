"""The link: freshness by one reply of each joint, ages in slots, every fault of the wire a flag, never an exception."""

import errno
import itertools
import select
import signal
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import can
import cantools
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtctl.errors import LinkError
from rtctl.hal.can.datagrams import CAPACITY, Messages
from rtctl.hal.can.link import CanLink, LinkSpec, identifiers
from rtctl.hal.can.transport import InProcess, Seqpacket, open_transport, socket_path
from rtctl.protocol import e2e, frame, mit
from rtctl.types import Command, Drive, Feedback, Link, Transport
from tests.fake_drives import PERIOD, PROTOCOLS, FakeDrives, spec_of

DBC: Any = cantools.database.load_file(Path(__file__).parent.parent / "configs" / "drive.dbc")
N = 3
STOP = Command(Drive.DISABLE, np.zeros(N))
P_STEP = 25.0 / 65535.0


class Wire:
    """A link to fake drives that lets a test add frames to those that come."""

    def __init__(self, spec: LinkSpec) -> None:
        self.drives = FakeDrives(spec)
        self.extra: list[bytes] = []
        self.link = CanLink(spec, InProcess(self.exchange))
        self.slot = -1

    def exchange(self, frames: list[bytes]) -> list[bytes]:
        return self.drives.exchange(frames)

    def cycle(self, command: Command = STOP, missed: int = 0) -> Feedback:
        """One turn of the loop: read at the next slot, then write."""
        self.slot += 1 + missed
        self.link.pending += self.extra
        self.extra = []
        feedback = self.link.read(self.slot, missed, 0.0, 0.0)
        self.link.write(command)
        return feedback


@pytest.fixture(params=PROTOCOLS)
def wire(request: pytest.FixtureRequest) -> Wire:
    wire = Wire(spec_of(N, request.param))
    wire.cycle()  # the first commands go out; nothing has been heard yet
    return wire


@pytest.fixture
def protected() -> Wire:
    wire = Wire(spec_of(N))
    wire.cycle()
    return wire


def flags(feedback: Feedback) -> Link:
    return Link(feedback.link)


def lose(joint: int, n: int = 1) -> Any:
    """Mischief: the next n replies of a joint do not arrive."""
    left = [n]

    def mischief(j: int, raw: bytes) -> list[bytes]:
        if j == joint and left[0]:
            left[0] -= 1
            return []
        return [raw]

    return mischief


def test_nothing_heard_says_so() -> None:
    feedback = CanLink(spec_of(N), InProcess(lambda frames: [])).read(0, 0, 1e-4, 2e-4)
    assert (feedback.drive == -1).all()
    assert (feedback.replies == 0).all()
    assert (feedback.slot, feedback.missed, feedback.lateness, feedback.compute) == (0, 0, 1e-4, 2e-4)


def test_a_healthy_cycle_has_one_reply_of_each_joint_one_slot_old(wire: Wire) -> None:
    wire.drives.codes = [(0x8000 + 4000 * j, 0x800 + 100 * j, 0x800 - 200 * j) for j in range(N)]
    wire.cycle()
    wire.drives.err = [1, 0, 0xD]
    wire.cycle()
    feedback = wire.cycle()
    assert flags(feedback) == Link.NONE
    assert feedback.replies.tolist() == [1] * N
    assert feedback.drive.tolist() == [1, 0, 0xD]
    np.testing.assert_allclose(feedback.age, PERIOD)
    for j in range(N):
        told = DBC.get_message_by_name("DM8009_Reply").decode(wire.link.received[j][8:16])
        assert (feedback.q[j], feedback.qd[j], feedback.tau[j]) == pytest.approx((told["p"], told["v"], told["t"]))


def test_a_lost_reply_leaves_the_last_good_value_and_its_age_grows(wire: Wire) -> None:
    wire.drives.codes[1] = (0x9000, 0x800, 0x800)
    wire.cycle()
    before = wire.cycle()
    wire.drives.codes[1] = (0xA000, 0x800, 0x800)
    wire.drives.mischief = lose(1, 2)
    wire.cycle()
    first, second = wire.cycle(), wire.cycle()
    for feedback, periods in ((first, 2), (second, 3)):
        assert feedback.replies.tolist() == [1, 0, 1]
        np.testing.assert_allclose(feedback.age, [PERIOD, periods * PERIOD, PERIOD])
        assert feedback.q[1] == before.q[1]
    again = wire.cycle()
    assert again.age[1] == pytest.approx(PERIOD)
    assert again.q[1] - before.q[1] == pytest.approx(0x1000 * P_STEP)


def test_slots_that_were_missed_age_the_samples(wire: Wire) -> None:
    wire.cycle()
    feedback = wire.cycle(missed=2)  # the drives answered three periods ago
    np.testing.assert_allclose(feedback.age, 3 * PERIOD)
    np.testing.assert_allclose(wire.cycle().age, PERIOD)


def test_feedback_is_a_value_that_later_reads_do_not_change(wire: Wire) -> None:
    wire.cycle()
    feedback = wire.cycle()
    kept = feedback.q.copy()
    wire.drives.codes = [(0xFFFF, 0, 0)] * N
    wire.cycle()
    wire.cycle()
    np.testing.assert_array_equal(feedback.q, kept)


def test_a_reply_that_comes_twice_is_a_duplicate(wire: Wire) -> None:
    wire.drives.mischief = lambda j, raw: [raw, raw] if j == 0 else [raw]
    wire.cycle()
    assert flags(wire.cycle()) == Link.DUPLICATE


def test_a_repeated_frame_does_not_refresh_the_age(protected: Wire) -> None:
    newest = protected.drives.sealed(0, bytes.fromhex("0180008008002021"))
    protected.drives.mischief = lambda j, raw: [newest] if j == 0 else [raw]
    protected.cycle()
    protected.cycle()
    feedback = protected.cycle()
    assert flags(feedback) == Link.DUPLICATE
    assert feedback.replies[0] == 0
    assert feedback.age[0] == pytest.approx(2 * PERIOD)


@given(bit=st.integers(0, 95))
def test_one_wrong_bit_and_the_reply_counts_as_lost(bit: int) -> None:
    wire = Wire(spec_of(N))
    wire.cycle()
    before = wire.cycle()

    def spoil(j: int, raw: bytes) -> list[bytes]:
        at = 8 + bit // 8
        return [raw[:at] + bytes([raw[at] ^ 1 << bit % 8]) + raw[at + 1 :]] if j == 1 else [raw]

    wire.drives.codes = [(0x1234, 0x567, 0x89A)] * N
    wire.drives.mischief = spoil
    wire.cycle()
    feedback = wire.cycle()
    assert flags(feedback) == Link.CORRUPT
    assert feedback.replies.tolist() == [1, 0, 1]
    assert feedback.q[1] == before.q[1]


def test_a_gap_in_the_counter_is_noted_and_the_newer_frame_used(protected: Wire) -> None:
    protected.drives.mischief = lose(2)
    protected.cycle()
    protected.cycle()
    assert flags(protected.cycle()) == Link.SEQUENCE
    assert flags(protected.cycle()) == Link.NONE


def test_a_frame_that_was_overtaken_is_not_used(protected: Wire) -> None:
    held: list[bytes] = []

    def overtake(j: int, raw: bytes) -> list[bytes]:
        if j != 0:
            return [raw]
        held.append(raw)
        return [] if len(held) == 1 else [held[1], held[0]] if len(held) == 2 else [raw]

    protected.drives.mischief = overtake
    protected.drives.codes[0] = (0x4000, 0x800, 0x800)
    protected.cycle()
    protected.drives.codes[0] = (0x5000, 0x800, 0x800)
    protected.cycle()
    feedback = protected.cycle()
    assert Link.SEQUENCE in flags(feedback)
    assert feedback.replies[0] == 1
    assert feedback.q[0] == pytest.approx(0x5000 * P_STEP - 12.5)


def test_counters_that_keep_jumping_are_disorder(protected: Wire) -> None:
    def skip(j: int, raw: bytes) -> list[bytes]:
        if j == 0:
            protected.drives.counters[0] += 1  # as if every other frame were lost
        return [raw]

    protected.drives.mischief = skip
    seen = [Link.DISORDER in flags(protected.cycle()) for _ in range(8)]
    assert seen.count(False) in (5, 6)
    assert seen[-1]


def test_the_status_byte_of_a_reply_is_kept(protected: Wire) -> None:
    protected.drives.status[1] = e2e.Report.SLEW | e2e.Report.BRAKE
    protected.cycle()
    protected.cycle()
    assert protected.link.status == [0, e2e.Report.SLEW | e2e.Report.BRAKE, 0]
    assert protected.link.temperature[1] == (0x20, 0x21)


def test_a_reply_that_names_another_motor_is_corrupt(wire: Wire) -> None:
    wire.drives.ids[0] = 9  # answers under the identifier of motor 9 ...
    wire.drives.mischief = lambda j, raw: [frame.pack(0x11, *frame.unpack(raw)[1:4])] if j == 0 else [raw]
    wire.extra = wire.drives.exchange([frame.pack(9, mit.DISABLE)])
    assert Link.CORRUPT in flags(wire.cycle())


@pytest.mark.parametrize("length", [0, 7])
def test_a_short_reply_is_corrupt(wire: Wire, length: int) -> None:
    wire.extra = [frame.pack(0x11, bytes(length), fd=wire.link.spec.fd)]
    assert flags(wire.cycle()) & Link.CORRUPT


def test_the_other_kind_of_frame_is_corrupt(wire: Wire) -> None:
    wire.extra = [frame.pack(0x11, bytes(8), fd=not wire.link.spec.fd)]
    assert flags(wire.cycle()) & Link.CORRUPT


def test_extended_remote_and_unknown_frames_are_nothing_to_us(wire: Wire) -> None:
    wire.extra = [
        frame.pack(0x11, bytes(8), extended=True),
        frame.pack(0x11, b"", rtr=True),
        frame.pack(0x300, bytes(8)),
    ]
    feedback = wire.cycle()
    assert flags(feedback) == Link.NONE
    assert wire.link.ignored == 3


@pytest.mark.parametrize("can_id", [1, 2, 3, mit.REGISTER_ID])
def test_our_identifiers_from_somebody_else_are_a_second_master(wire: Wire, can_id: int) -> None:
    wire.extra = [frame.pack(can_id, mit.ENABLE if can_id < mit.REGISTER_ID else mit.read_register(3, mit.PMAX))]
    assert flags(wire.cycle()) == Link.FOREIGN_COMMAND
    assert flags(wire.cycle()) == Link.NONE


def error_frame(kind: int, detail: int = 0) -> bytes:
    return frame.pack(kind, bytes((0, detail, 0, 0, 0, 0, 0, 0)), error=True)


def test_bus_off_lasts_until_the_controller_restarts(wire: Wire) -> None:
    wire.extra = [error_frame(0x40)]
    assert flags(wire.cycle()) == Link.BUS_OFF
    wire.extra = [error_frame(0x04, 0x40)]  # "error active" is no restart
    assert flags(wire.cycle()) == Link.BUS_OFF
    wire.extra = [error_frame(0x100)]
    assert flags(wire.cycle()) == Link.NONE


@pytest.mark.parametrize("passive", [0x10, 0x20, 0x30])
@pytest.mark.parametrize("recovered", [0x40, 0x04, 0x08])
def test_error_passive_lasts_until_another_state_is_reported(wire: Wire, passive: int, recovered: int) -> None:
    wire.extra = [error_frame(0x04, passive)]
    assert flags(wire.cycle()) == Link.ERROR_PASSIVE
    assert flags(wire.cycle()) == Link.ERROR_PASSIVE
    wire.extra = [error_frame(0x04, recovered)]
    assert flags(wire.cycle()) == Link.NONE


@pytest.mark.parametrize("detail", [1, 2])
def test_an_overflow_of_the_controller_is_reported_once(wire: Wire, detail: int) -> None:
    wire.extra = [error_frame(0x04, detail)]
    assert flags(wire.cycle()) == Link.OVERFLOW
    assert flags(wire.cycle()) == Link.NONE


@given(
    protocol=st.sampled_from(PROTOCOLS),
    junk=st.lists(
        st.one_of(
            st.binary(max_size=80),
            st.builds(
                lambda i, size, tail: (frame.HEAD.pack(i, size, 4) + tail)[: 16 if len(tail) < 64 else 72],
                st.sampled_from((0x11, 0x12, 0x13, 1, 0x20000040, 0x20000004, 0x91)),
                st.integers(0, 255),
                st.binary(min_size=10, max_size=66),
            ),
        ),
        max_size=20,
    ),
)
def test_no_bytes_from_the_bus_can_raise_or_leave_a_value_that_is_not_finite(protocol: str, junk: list[bytes]) -> None:
    wire = Wire(spec_of(N, protocol))
    wire.extra = junk
    feedback = wire.cycle()
    for values in (feedback.q, feedback.qd, feedback.tau, feedback.age):
        assert np.isfinite(values).all()
    assert (np.abs(feedback.q) <= 12.5).all()


@pytest.mark.parametrize(("drive", "special"), [(Drive.DISABLE, 0xFD), (Drive.ENABLE, 0xFC), (Drive.CLEAR, 0xFB)])
def test_special_frames_go_to_every_joint(wire: Wire, drive: Drive, special: int) -> None:
    sent = [frame.unpack(raw) for raw in wire.link.write(Command(drive, np.full(N, 5.0)))]
    assert [f.can_id for f in sent] == [1, 2, 3]
    assert all(f.data[:8] == b"\xff" * 7 + bytes((special,)) for f in sent)
    assert all((f.fd, f.brs) == (wire.link.spec.fd, wire.link.spec.fd) for f in sent)


def test_a_torque_command_decodes_to_the_torque_and_nothing_else(wire: Wire) -> None:
    tau = np.array([-20.0, 0.0, 53.3])
    for j, raw in enumerate(wire.link.write(Command(Drive.TORQUE, tau))):
        sent = frame.unpack(raw)
        told = DBC.get_message_by_name("DM8009_Command").decode(sent.data[:8])
        assert (told["kp"], told["kd"]) == (0.0, 0.0)
        assert abs(told["t"] - tau[j]) <= 54.0 / 4095.0 * (1 + 1e-9)


def test_a_torque_that_is_not_finite_goes_out_as_none(wire: Wire) -> None:
    none = [raw[8:16] for raw in wire.link.write(Command(Drive.TORQUE, np.zeros(N)))]
    bad = [raw[8:16] for raw in wire.link.write(Command(Drive.TORQUE, np.array([np.nan, np.inf, -np.inf])))]
    assert bad == none


def test_protected_commands_count_up_and_say_whether_torque_is_wanted(protected: Wire) -> None:
    counters = []
    for k in range(300):
        drive = Drive.TORQUE if k % 2 else Drive.ENABLE
        sent = [frame.unpack(raw) for raw in protected.link.write(Command(drive, np.zeros(N)))]
        assert all(e2e.intact(f.data, f.can_id) for f in sent)
        assert all(f.data[9] == k % 2 for f in sent)
        counters.append(sent[0].data[8])
    assert {(b - a) % 256 for a, b in itertools.pairwise(counters)} == {1}


def test_equal_commands_give_equal_bytes(wire: Wire) -> None:
    tau = np.array([1.0, -2.0, 3.0])
    first = Wire(wire.link.spec).link.write(Command(Drive.TORQUE, tau))
    second = Wire(wire.link.spec).link.write(Command(Drive.TORQUE, tau))
    assert first == second


def test_the_link_listens_to_replies_its_own_identifiers_and_registers() -> None:
    assert sorted(identifiers(spec_of(2).joints)) == [1, 2, 0x11, 0x12, 0x7FF]


# ---- transports


@contextmanager
def served(path: Path, drives: FakeDrives) -> Iterator[None]:
    """Drives behind a Unix socket, in a thread: each frame is answered at once."""
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    listener.bind(str(path))
    listener.listen()
    enough, stop = socket.socketpair()
    peers: list[socket.socket] = []

    def serve() -> None:
        while True:
            ready, _, _ = select.select([enough, listener, *peers], [], [])
            if enough in ready:
                return
            if listener in ready:
                peers.append(listener.accept()[0])
            for peer in (p for p in peers if p in ready):
                raw = peer.recv(80)
                if not raw:
                    peers.remove(peer)
                    peer.close()
                    continue
                for reply in drives.exchange([raw]):
                    peer.send(reply)

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        yield
    finally:
        stop.send(b"!")
        thread.join()
        for sock in (enough, stop, listener, *peers):
            sock.close()


class Doer:
    """Mischief drawn by hypothesis: what becomes of one reply."""

    def __init__(self, data: st.DataObject, calm: bool) -> None:
        self.data, self.calm = data, calm
        self.kept: list[bytes] = []

    def __call__(self, joint: int, raw: bytes) -> list[bytes]:
        if self.calm:
            return [raw]
        what = self.data.draw(st.sampled_from(["pass"] * 8 + ["lose", "twice", "flip", "keep", "old", "cut"]))
        if what == "keep":
            self.kept.append(raw)
        if what == "flip":
            bit = self.data.draw(st.integers(0, 8 * 20 - 1))
            changed = bytearray(raw)
            changed[bit // 8 % len(raw)] ^= 1 << bit % 8
            return [bytes(changed)]
        old = [self.kept.pop(0)] if what == "old" and self.kept else []
        return {"lose": [], "keep": [], "twice": [raw, raw], "old": [*old, raw], "cut": [raw[:12]]}.get(what, [raw])


STRANGERS = (
    frame.pack(0x300, b"hello"),
    frame.pack(2, bytes(8)),  # a command that somebody else sends
    frame.pack(frame.ERR_BUSOFF, bytes(8), error=True),
    frame.pack(frame.ERR_RESTARTED, bytes(8), error=True),
    frame.pack(frame.ERR_CRTL, b"\0" + bytes([frame.CRTL_OVERFLOW]) + bytes(6), error=True),
    b"",
    bytes(100),
)


@pytest.mark.parametrize("protocol", PROTOCOLS)
@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_a_cycle_decoded_at_once_means_what_its_frames_mean_one_by_one(protocol: str, data: st.DataObject) -> None:
    """Lost, doubled, late, corrupt, foreign and error frames between whole cycles, in every order."""
    drives = FakeDrives(spec_of(N, protocol))
    came: list[bytes] = []
    quick, patient = (CanLink(spec_of(N, protocol), InProcess(lambda frames: list(came))) for _ in range(2))
    patient._take_whole = lambda slot, asked: False  # type: ignore[method-assign]
    slot = 0
    for _ in range(data.draw(st.integers(1, 12))):
        calm = data.draw(st.booleans())
        drives.mischief = Doer(data, calm)
        drives.codes = [tuple(data.draw(st.integers(0, top)) for top in (0xFFFF, 0xFFF, 0xFFF)) for _ in range(N)]  # type: ignore[misc]
        drives.status = [data.draw(st.integers(0, 255)) for _ in range(N)]
        came[:] = drives.exchange([quick.encode(j, mit.DISABLE) for j in range(N)])
        if not calm:
            came += data.draw(st.lists(st.sampled_from(STRANGERS), max_size=2))
            came[:] = data.draw(st.permutations(came))
        for link in (quick, patient):
            link.transport.send_all([])
        slot += data.draw(st.integers(1, 3))
        one, other = (link.read(slot, 0, 0.0, 0.0) for link in (quick, patient))
        for field, left, right in zip(Feedback._fields, one, other, strict=True):
            np.testing.assert_array_equal(left, right, err_msg=field)
        for name in ("corrupt", "ignored", "foreign", "bus_state", "status", "temperature"):
            assert getattr(quick, name) == getattr(patient, name)
        assert quick.receivers.last.tolist() == patient.receivers.last.tolist()
        assert quick.receivers.disorder.tolist() == patient.receivers.disorder.tolist()


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_lockstep_over_a_socket_waits_for_each_joint(tmp_path: Path, protocol: str) -> None:
    spec = spec_of(N, protocol)
    with served(tmp_path / "bus", FakeDrives(spec)):
        link = CanLink(spec, open_transport("socketpair", str(tmp_path / "bus")))
        for slot in range(50):
            feedback = link.read(slot, 0, 0.0, 0.0)
            assert flags(feedback) == Link.NONE
            assert slot == 0 or feedback.replies.tolist() == [1] * N
            link.write(STOP)
            assert link.wait_replies(5.0)
        link.close()


def test_waiting_for_a_joint_that_is_silent_ends(tmp_path: Path) -> None:
    spec = spec_of(N)
    drives = FakeDrives(spec)
    drives.mischief = lose(1, 1)
    with served(tmp_path / "bus", drives):
        link = CanLink(spec, Seqpacket(str(tmp_path / "bus"), 1.0))
        link.write(STOP)
        assert not link.wait_replies(0.05)
        assert link.read(0, 0, 0.0, 0.0).replies.tolist() == [1, 0, 1]
        link.close()


def test_a_lockstep_simulator_that_loses_a_reply_does_not_hang(wire: Wire) -> None:
    wire.drives.mischief = lose(1, 1)
    wire.link.read(1, 0, 0.0, 0.0)
    wire.link.write(STOP)
    assert not wire.link.wait_replies(100.0)
    wire.link.write(STOP)
    assert wire.link.wait_replies(100.0)


class Pair(Seqpacket):
    """A Seqpacket transport on one end of a socket pair; `peer` is the other."""

    def __init__(self) -> None:
        self.ends = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.peer = self.ends[1]
        super().__init__("nowhere", 0.0)

    def _connect(self, timeout: float) -> socket.socket:
        return self.ends[0]


@pytest.fixture
def pair() -> Iterator[Pair]:
    pair = Pair()
    yield pair
    pair.close()
    pair.peer.close()


def numbered(count: int) -> list[bytes]:
    return [frame.pack(i % 0x700, i.to_bytes(4, "big"), fd=i % 2 == 1) for i in range(count)]


@pytest.mark.parametrize("count", [1, 7, CAPACITY, CAPACITY + 1, 2 * CAPACITY + 3])
def test_frames_of_both_sizes_arrive_whole_and_in_order(pair: Pair, count: int) -> None:
    frames = numbered(count)
    sent: list[bytes] = []
    for raw in frames:
        sent += pair.send_all([raw])
        assert pair.peer.recv(100) == raw
    assert sent == frames
    for raw in frames:
        pair.peer.send(raw)
    assert pair.receive() == frames
    assert pair.receive() == []
    assert pair.flags() == Link.NONE


def test_a_batch_is_sent_as_single_frames(pair: Pair) -> None:
    frames = numbered(20)
    assert pair.send_all(frames) == frames
    assert [pair.peer.recv(100) for _ in frames] == frames


def test_a_flood_ends_a_drain_in_bounded_time() -> None:
    """A source that always has more must not hold the loop."""
    calls = 0

    class Endless(Messages):
        def _receive_batch(self, count: int, timeout: float) -> list[bytes]:
            nonlocal calls
            calls += 1
            return [b""] * count

    left, right = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with left, right:
        assert len(Endless(left).receive()) == calls * CAPACITY
    assert calls <= 16


def test_a_full_queue_drops_and_says_so(pair: Pair) -> None:
    link = CanLink(spec_of(N), pair)
    went = [link.write(STOP) for _ in range(2000)]
    assert went[0] != []
    assert len(went[0]) == N
    assert went[-1] == []
    assert flags(link.read(0, 0, 0.0, 0.0)) == Link.SEND_FAILED
    queued = sum(len(frames) for frames in went)
    pair.peer.setblocking(False)
    assert [len(pair.peer.recv(100)) for _ in range(queued)] == [72] * queued
    with pytest.raises(BlockingIOError):
        pair.peer.recv(100)
    assert len(link.write(STOP)) == N  # and it sends again, nothing old before it
    assert flags(link.read(1, 0, 0.0, 0.0)) == Link.NONE


def test_a_signal_does_not_end_the_wait_for_replies(pair: Pair) -> None:
    raw = frame.pack(0x11, b"")
    before = signal.signal(signal.SIGALRM, lambda *_: None)
    timer = threading.Timer(0.1, lambda: pair.peer.send(raw))
    try:
        timer.start()
        signal.setitimer(signal.ITIMER_REAL, 0.02)
        assert pair.collect(1, 5.0) == [raw]
    finally:
        timer.join()
        signal.signal(signal.SIGALRM, before)


def test_an_oversize_packet_is_corrupt_not_cut_to_size(pair: Pair) -> None:
    link = CanLink(spec_of(N), pair)
    pair.peer.send(frame.pack(0x11, bytes(12), fd=True) + b"more")
    assert flags(link.read(0, 0, 0.0, 0.0)) == Link.CORRUPT


def test_a_peer_that_is_gone_is_a_link_down(pair: Pair) -> None:
    pair.peer.send(frame.pack(0x300, b""))
    pair.peer.close()
    assert pair.receive() == [frame.pack(0x300, b"")]
    assert pair.send_all(numbered(3)) == []
    assert pair.flags() & Link.DOWN
    assert pair.collect(3, 5.0) == []
    assert pair.flags() & Link.DOWN


def test_a_bus_that_comes_back_is_found_within_a_second(tmp_path: Path) -> None:
    spec = spec_of(N)
    with served(tmp_path / "bus", FakeDrives(spec)):
        link = CanLink(spec, Seqpacket(str(tmp_path / "bus"), 1.0))
    (tmp_path / "bus").unlink()
    assert Link.DOWN in flags(link.read(0, 0, 0.0, 0.0))
    assert link.write(STOP) == []
    with served(tmp_path / "bus", FakeDrives(spec)):
        per_second = round(1.0 / PERIOD)
        assert all(Link.DOWN in flags(link.read(slot, 0, 0.0, 0.0)) for slot in range(1, per_second + 1))
        link.write(STOP)
        assert link.wait_replies(5.0)
        assert flags(link.read(per_second + 1, 0, 0.0, 0.0)) == Link.NONE
        link.close()


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_any_python_can_adapter_carries_the_link(protocol: str) -> None:
    spec = spec_of(N, protocol)
    drives = FakeDrives(spec)
    link = CanLink(spec, open_transport("virtual", f"test-{protocol}", fd=spec.fd, listen=identifiers(spec.joints)))
    with can.Bus(interface="virtual", channel=f"test-{protocol}") as peer:
        link.write(STOP)
        for _ in range(N):
            got = peer.recv(1.0)
            assert got is not None
            asked = frame.pack(got.arbitration_id, bytes(got.data), got.is_fd, got.bitrate_switch)
            for one in map(frame.unpack, drives.exchange([asked])):
                message = can.Message(
                    arbitration_id=one.can_id,
                    data=one.data,
                    is_fd=one.fd,
                    bitrate_switch=one.brs,
                    is_extended_id=False,
                )
                peer.send(message)
        peer.send(can.Message(arbitration_id=0x300, is_extended_id=False))  # filtered out
        assert link.wait_replies(1.0)
        feedback = link.read(0, 0, 0.0, 0.0)
        assert flags(feedback) == Link.NONE
        assert feedback.replies.tolist() == [1] * N
        assert link.ignored == 0
    link.close()


class Sick:
    """A python-can bus on which everything fails."""

    def __init__(self, state: can.BusState) -> None:
        self.state = state

    def send(self, message: can.Message, timeout: float | None = None) -> None:
        raise can.CanOperationError("no")

    def recv(self, timeout: float | None = None) -> can.Message | None:
        raise OSError(errno.ENODEV, "gone")


@pytest.mark.parametrize(
    ("state", "flag"),
    [(can.BusState.ERROR, Link.BUS_OFF), (can.BusState.PASSIVE, Link.ERROR_PASSIVE), (can.BusState.ACTIVE, Link.NONE)],
)
def test_an_adapter_that_fails_is_reported_in_flags(state: can.BusState, flag: Link) -> None:
    from rtctl.hal.can.transport import PythonCan

    transport: Transport = PythonCan(Sick(state))  # type: ignore[arg-type]
    assert transport.send_all(numbered(2)) == []
    assert transport.receive() == []
    assert transport.flags() == Link.SEND_FAILED | Link.DOWN | flag
    assert not transport.reopen()


@pytest.mark.parametrize(
    ("interface", "channel"), [("socketcan", "nocan9"), ("socketpair", "/nowhere/bus"), ("noadapter", "x")]
)
def test_a_bus_that_cannot_be_opened_is_one_line(interface: str, channel: str) -> None:
    with pytest.raises(LinkError, match=channel) as caught:
        open_transport(interface, channel, timeout=0.05)
    assert "\n" not in str(caught.value)


def test_a_bare_channel_name_lives_in_the_run_time_directory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", "/run/user/7")
    assert socket_path("panda") == "/run/user/7/rtctl-panda.can"
    assert socket_path("/a/b.can") == "/a/b.can"
    monkeypatch.delenv("XDG_RUNTIME_DIR")
    assert socket_path("panda") == "/tmp/rtctl-panda.can"

"""The link on real SocketCAN: what only a kernel can do to it."""

import os
import select
import socket
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from rtctl.errors import HandshakeError
from rtctl.hal.can.handshake import handshake
from rtctl.hal.can.link import CanLink, LinkSpec, identifiers
from rtctl.hal.can.transport import SocketCan, open_transport
from rtctl.protocol import frame, mit
from rtctl.types import Command, Drive, Feedback, Link
from tests.fake_drives import PERIOD, PROTOCOLS, FakeDrives, spec_of

N = 7
STOP = Command(Drive.DISABLE, np.zeros(N))


def raw_socket(channel: str) -> socket.socket:
    """A socket of somebody else on the bus."""
    sock = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    sock.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FD_FRAMES, 1)
    sock.bind((channel,))
    return sock


def run(command: str) -> None:
    subprocess.run(command.split(), check=True, timeout=30)


@contextmanager
def drives_on(channel: str, spec: LinkSpec) -> Iterator[FakeDrives]:
    """Drives on the bus, in a thread."""
    drives = FakeDrives(spec)
    bus, (enough, stop) = raw_socket(channel), socket.socketpair()

    def serve() -> None:
        while True:
            ready, _, _ = select.select([enough, bus], [], [])
            if enough in ready:
                return
            try:
                for reply in drives.exchange([bus.recv(80)]):
                    bus.send(reply)
            except OSError:  # the interface went down
                return

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        yield drives
    finally:
        stop.send(b"!")
        thread.join()
        for sock in (bus, enough, stop):
            sock.close()


@contextmanager
def linked(channel: str, spec: LinkSpec, depth: int = 64) -> Iterator[CanLink]:
    transport = open_transport("socketcan", channel, fd=spec.fd, listen=identifiers(spec.joints), depth=depth)
    assert isinstance(transport, SocketCan)
    link = CanLink(spec._replace(place=channel), transport)
    try:
        yield link
    finally:
        link.close()


class Loop:
    """Turns of the loop, in lockstep."""

    def __init__(self, link: CanLink) -> None:
        self.link, self.slot = link, -1

    def read(self) -> Feedback:
        self.slot += 1
        return self.link.read(self.slot, 0, 0.0, 0.0)

    def hear(self) -> Feedback:
        """A read that something has come for: a kernel may deliver a frame a moment after it was sent."""
        assert self.link.transport.wait(5.0), "no frame came"
        return self.read()

    def turn(self) -> Feedback:
        feedback = self.read()
        self.link.write(STOP)
        self.link.wait_replies(1.0)
        return feedback


def flags(feedback: Feedback) -> Link:
    return Link(feedback.link)


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_handshake_and_cycles_on_a_real_bus(vcan: str, protocol: str) -> None:
    spec = spec_of(N, protocol)
    with drives_on(vcan, spec) as drives, linked(vcan, spec) as link:
        drives.registers[2][mit.TIMEOUT] = 0
        drives.codes = [(0x8000 + 1000 * j, 0x800, 0x800) for j in range(N)]
        greeting = handshake(link, listen=0.05, timeout=1.0)
        assert greeting.watchdogs_written == ("joint3",)
        loop = Loop(link)
        for _ in range(100):
            feedback = loop.turn()
            assert flags(feedback) == Link.NONE
            assert feedback.replies.tolist() == [1] * N
            np.testing.assert_allclose(feedback.age, PERIOD)
        np.testing.assert_allclose(feedback.q, [1000 * j * 25 / 65535 for j in range(N)], atol=25 / 65535)
        assert link.foreign == link.ignored == link.corrupt == 0  # nobody hears himself


def test_the_kernel_filters_what_is_not_for_us_before_it_wakes_us(vcan: str) -> None:
    with linked(vcan, spec_of(N)) as link, raw_socket(vcan) as somebody:
        for raw in (frame.pack(0x300, b""), frame.pack(0x11, bytes(8), extended=True), frame.pack(0x11, b"", rtr=True)):
            somebody.send(raw)
        assert link.transport.receive() == []


@pytest.mark.parametrize("can_id", [1, N, mit.REGISTER_ID])
def test_a_second_master_is_seen(vcan: str, can_id: int) -> None:
    data = mit.ENABLE if can_id < mit.REGISTER_ID else mit.read_register(N, mit.PMAX)
    with linked(vcan, spec_of(N)) as link, raw_socket(vcan) as somebody:
        somebody.send(frame.pack(can_id, data))
        assert flags(Loop(link).hear()) == Link.FOREIGN_COMMAND
        timer = threading.Timer(0.05, lambda: somebody.send(frame.pack(can_id, data)))
        timer.start()
        with pytest.raises(HandshakeError, match="one master"):
            handshake(link, listen=5.0)
        timer.join()


def test_bus_off_comes_as_an_error_frame(vcan: str) -> None:
    with linked(vcan, spec_of(N)) as link:
        loop = Loop(link)
        run(f"cansend {vcan} 20000040#0000000000000000")
        assert flags(loop.hear()) == flags(loop.read()) == Link.BUS_OFF
        run(f"cansend {vcan} 20000100#0000000000000000")  # restarted
        assert flags(loop.hear()) == Link.NONE


def test_error_passive_comes_as_an_error_frame(vcan: str) -> None:
    with linked(vcan, spec_of(N)) as link:
        loop = Loop(link)
        run(f"cansend {vcan} 20000004#0030000000000000")
        assert flags(loop.hear()) == flags(loop.read()) == Link.ERROR_PASSIVE
        run(f"cansend {vcan} 20000004#0040000000000000")  # active again
        assert flags(loop.hear()) == Link.NONE


def test_a_receive_queue_that_overflowed_says_so_with_the_next_frame(vcan: str) -> None:
    with linked(vcan, spec_of(N)) as link, raw_socket(vcan) as somebody:
        loop, raw = Loop(link), frame.pack(0x11, bytes(12), fd=True)
        for _ in range(3000):
            somebody.send(raw)
        while len(link.received) or loop.slot < 0:
            loop.read()  # bounded reads, until it is drained
        somebody.send(raw)
        assert Link.OVERFLOW in flags(loop.hear())
        somebody.send(raw)
        assert Link.OVERFLOW not in flags(loop.hear())


def test_a_full_queue_drops_the_rest_of_the_cycle_for_good(vcan: str) -> None:
    with linked(vcan, spec_of(N)) as link, raw_socket(vcan) as somebody:
        run(f"tc qdisc add dev {vcan} root netem delay 60s limit 10")
        assert len(link.write(STOP)) == 7
        assert len(link.write(STOP)) == 3  # ten fit
        loop = Loop(link)
        assert flags(loop.read()) == Link.SEND_FAILED
        run(f"tc qdisc del dev {vcan} root")
        assert len(link.write(STOP)) == 7
        assert flags(loop.read()) == Link.NONE
        somebody.settimeout(5.0)
        # A vcan shows a frame to others as it is queued; what was dropped is not among them.
        assert [somebody.recv(80)[16] for _ in range(17)] == [1] * 7 + [2] * 3 + [3] * 7
        somebody.settimeout(0.2)
        with pytest.raises(TimeoutError):
            somebody.recv(80)


@pytest.mark.parametrize("depth", [14, 28])
def test_a_bus_that_stalls_holds_only_a_few_cycles_of_old_torque(vcan: str, depth: int) -> None:
    with linked(vcan, spec_of(N), depth) as link:
        module = f"/usr/lib/uml/modules/{os.uname().release}/kernel/net/sched/sch_tbf.ko"
        subprocess.run(["insmod", module], check=False, capture_output=True)  # elsewhere the kernel finds it by itself
        run(f"tc qdisc add dev {vcan} root tbf rate 80bit burst 80 limit 1000000")
        queued = sum(len(link.write(STOP)) for _ in range(100))
        assert depth / 2 <= queued <= depth + N
        assert flags(Loop(link).read()) == Link.SEND_FAILED


def test_an_interface_that_goes_down_and_comes_up(vcan: str) -> None:
    spec = spec_of(N)
    with linked(vcan, spec) as link:
        loop = Loop(link)
        with drives_on(vcan, spec):
            loop.turn()
            assert flags(loop.turn()) == Link.NONE
            run(f"ip link set {vcan} down")
        loop.read()
        assert link.write(STOP) == []
        assert Link.DOWN in flags(loop.read())
        with pytest.raises(HandshakeError, match="interface down"):
            handshake(link, listen=0.0)
        run(f"ip link set {vcan} up")
        with drives_on(vcan, spec):
            handshake(link, listen=0.0, timeout=1.0)
            loop.read()
            assert flags(loop.turn()) == Link.NONE


def test_an_interface_that_is_removed_is_opened_anew_within_a_second(vcan: str) -> None:
    spec = spec_of(N)
    with linked(vcan, spec) as link:
        loop = Loop(link)
        run(f"ip link del {vcan}")
        loop.read()
        assert link.write(STOP) == []
        assert Link.DOWN in flags(loop.read())
        for command in (f"add dev {vcan} type vcan", f"set {vcan} mtu 72 txqueuelen 128", f"set {vcan} up"):
            run(f"ip link {command}")
        with drives_on(vcan, spec):
            for _ in range(round(1.0 / PERIOD) + 1):
                loop.read()
                if len(link.write(STOP)) == N:
                    break
            else:
                pytest.fail("the link did not come back")
            assert link.wait_replies(2.0)
            handshake(link, listen=0.0, timeout=1.0)
            assert flags(loop.turn()) == Link.NONE


def test_the_handshake_refuses_a_short_transmit_queue(vcan: str) -> None:
    run(f"ip link set {vcan} txqueuelen 10")
    with linked(vcan, spec_of(N)) as link, pytest.raises(HandshakeError, match="vcan0: txqueuelen: got 10"):
        handshake(link, listen=0.0)


def test_the_handshake_refuses_an_interface_without_fd_frames(vcan: str) -> None:
    for command in ("down", "mtu 16", "up"):
        run(f"ip link set {vcan} {command}")
    with linked(vcan, spec_of(N)) as link, pytest.raises(HandshakeError, match="vcan0: mtu: got 16"):
        handshake(link, listen=0.0)


def test_drives_that_answer_in_classic_frames_are_refused(vcan: str) -> None:
    with drives_on(vcan, spec_of(N)) as drives, linked(vcan, spec_of(N)) as link:
        drives.mischief = lambda joint, raw: [frame.pack(0x11 + joint, raw[8:16])]
        with pytest.raises(HandshakeError, match="classic frame of 8 bytes"):
            handshake(link, listen=0.0, timeout=1.0)

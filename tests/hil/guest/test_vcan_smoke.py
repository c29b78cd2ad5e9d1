"""vcan0 is a CAN bus as rtctl needs it: classic and FD frames as the kernel's own structs, python-can, error frames."""

import socket
import struct
import subprocess
from multiprocessing import shared_memory

import can
import pytest

CAN_FRAME = struct.Struct("=IB3x8s")  # id, length, data: linux/can.h
CANFD_FRAME = struct.Struct("=IBB2x64s")  # id, length, flags, data
CANFD_BRS = 1
CAN_RAW_ERR_FILTER = 2  # linux/can/raw.h; the socket module lacks the name


def raw_socket(channel: str) -> socket.socket:
    """A raw CAN socket that takes FD frames too and gives up in the end."""
    s = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    s.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FD_FRAMES, 1)
    s.settimeout(5.0)
    s.bind((channel,))
    return s


def test_a_classic_frame_crosses_the_bus_as_16_bytes(vcan: str) -> None:
    with raw_socket(vcan) as sender, raw_socket(vcan) as receiver:
        frame = CAN_FRAME.pack(0x123, 8, bytes(range(8)))
        assert sender.send(frame) == 16
        assert receiver.recv(128) == frame


@pytest.mark.parametrize("length", [12, 64])
def test_an_fd_frame_with_rate_switch_crosses_the_bus_as_72_bytes(vcan: str, length: int) -> None:
    with raw_socket(vcan) as sender, raw_socket(vcan) as receiver:
        frame = CANFD_FRAME.pack(0x7FF, length, CANFD_BRS, bytes(range(length)))
        assert sender.send(frame) == 72
        got_id, got_length, flags, data = CANFD_FRAME.unpack(receiver.recv(128))
        assert (got_id, got_length, data[:length]) == (0x7FF, length, bytes(range(length)))
        assert flags & CANFD_BRS


def test_a_sender_does_not_hear_itself(vcan: str) -> None:
    with raw_socket(vcan) as sender, raw_socket(vcan) as receiver:
        sender.send(CAN_FRAME.pack(0x1, 1, b"a"))
        receiver.send(CAN_FRAME.pack(0x2, 1, b"b"))
        assert CAN_FRAME.unpack(sender.recv(128))[0] == 0x2


@pytest.mark.parametrize("fd", [False, True])
def test_python_can_and_a_raw_socket_understand_each_other(vcan: str, fd: bool) -> None:
    payload = bytes(range(12 if fd else 8))
    with can.Bus(interface="socketcan", channel=vcan, fd=True) as bus, raw_socket(vcan) as raw:
        bus.send(can.Message(arbitration_id=0x45, data=payload, is_extended_id=False, is_fd=fd, bitrate_switch=fd))
        received = raw.recv(128)
        assert len(received) == (72 if fd else 16)
        assert received[8 : 8 + len(payload)] == payload
        raw.send(received)
        echo = bus.recv(5.0)
    assert echo is not None
    assert (echo.arbitration_id, bytes(echo.data), echo.is_fd, echo.bitrate_switch) == (0x45, payload, fd, fd)


def test_can_utils_can_inject_a_bus_off(vcan: str) -> None:
    with raw_socket(vcan) as receiver:
        receiver.setsockopt(socket.SOL_CAN_RAW, CAN_RAW_ERR_FILTER, socket.CAN_ERR_MASK)
        subprocess.run(["cansend", vcan, "20000040#0000000000000000"], check=True)
        can_id = CAN_FRAME.unpack(receiver.recv(128))[0]
    assert can_id & socket.CAN_ERR_FLAG
    assert can_id & 0x40  # CAN_ERR_BUSOFF


def test_an_interface_that_goes_down_is_seen_by_its_sockets(vcan: str) -> None:
    with raw_socket(vcan) as s:
        subprocess.run(["ip", "link", "set", vcan, "down"], check=True)
        with pytest.raises(OSError, match="Network is down"):
            s.send(CAN_FRAME.pack(0x1, 0, b""))


def test_shared_memory_works_beside_the_bus() -> None:
    memory = shared_memory.SharedMemory(create=True, size=1 << 20)
    try:
        assert memory.buf is not None
        memory.buf[:4] = b"ring"
        other = shared_memory.SharedMemory(memory.name)
        assert other.buf is not None
        assert bytes(other.buf[:4]) == b"ring"
        other.close()
    finally:
        memory.close()
        memory.unlink()

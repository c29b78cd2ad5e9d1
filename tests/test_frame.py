"""The kernel's frame structs, against hand-made bytes and python-can's own packing."""

import sys

import can
import pytest
from can.interfaces.socketcan.socketcan import build_can_frame
from hypothesis import given
from hypothesis import strategies as st

from rtctl.protocol import frame


def word(value: int) -> bytes:
    return value.to_bytes(4, sys.byteorder)


def test_a_classic_frame_is_sixteen_bytes() -> None:
    # can_id | len | 3 bytes of padding | data
    assert frame.pack(0x123, b"\x01\x02") == word(0x123) + b"\x02\0\0\0" + b"\x01\x02\0\0\0\0\0\0"


def test_an_fd_frame_is_seventy_two_bytes() -> None:
    # can_id | len | flags FDF 0x04, BRS 0x01 | 2 bytes reserved | data
    data = bytes(range(12))
    assert frame.pack(0x7FF, data, fd=True, brs=True) == word(0x7FF) + b"\x0c\x05\0\0" + data + bytes(52)


def test_flags_sit_in_the_top_bits_of_the_identifier() -> None:
    assert frame.pack(0x1ABCDEF0, b"", extended=True)[:4] == word(0x9ABCDEF0)
    assert frame.pack(0x1, b"", rtr=True)[:4] == word(0x40000001)
    assert frame.pack(0x40, bytes(8), error=True)[:4] == word(0x20000040)


@st.composite
def frames(draw: st.DrawFn) -> frame.Frame:
    fd, extended = draw(st.booleans()), draw(st.booleans())
    length = draw(st.sampled_from(frame.FD_LENGTHS if fd else range(9)))
    return frame.Frame(
        can_id=draw(st.integers(0, frame.EFF_MASK if extended else frame.SFF_MASK)),
        data=draw(st.binary(min_size=length, max_size=length)),
        fd=fd,
        brs=fd and draw(st.booleans()),
        extended=extended,
    )


@given(frames())
def test_packing_agrees_with_python_can(one: frame.Frame) -> None:
    message = can.Message(
        arbitration_id=one.can_id, data=one.data, is_extended_id=one.extended, is_fd=one.fd, bitrate_switch=one.brs
    )
    ours, theirs = frame.pack(*one), build_can_frame(message)
    # Byte 7 of a classic frame is len8_dlc, which the kernel reads only for lengths above 8; python-can fills it in.
    assert ours[:7] + ours[8:] == theirs[:7] + theirs[8:]
    assert len(ours) == len(theirs)


@given(frames())
def test_unpacking_undoes_packing(one: frame.Frame) -> None:
    assert frame.unpack(frame.pack(*one)) == one


@given(st.binary(max_size=100))
def test_bytes_that_are_no_frame_are_refused_and_nothing_else_happens(raw: bytes) -> None:
    try:
        one = frame.unpack(raw)
    except ValueError:
        assert len(raw) not in (16, 72) or raw[4] > (8 if len(raw) == 16 else 64)
    else:
        assert one.data == raw[8 : 8 + raw[4]]


@pytest.mark.parametrize(
    ("can_id", "length", "options"),
    [
        (0x800, 0, {}),
        (-1, 0, {}),
        (0x20000000, 0, {"extended": True}),
        (1, 9, {}),
        (1, 8, {"brs": True}),
        (1, 9, {"fd": True}),
        (1, 65, {"fd": True}),
        (1, 0, {"fd": True, "rtr": True}),
    ],
)
def test_what_no_bus_can_carry_is_refused(can_id: int, length: int, options: dict[str, bool]) -> None:
    with pytest.raises(ValueError, match=r"identifier|frame of"):
        frame.pack(can_id, bytes(length), **options)

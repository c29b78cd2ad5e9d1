"""The drive protocol, against bytes made by hand and cantools reading configs/drive.dbc."""

import math
import struct
from pathlib import Path
from typing import Any

import cantools
import pytest
from damiao_motor.core.motor import KD_MAX, KP_MAX, MOTOR_TYPE_PRESETS, REGISTER_TABLE
from hypothesis import given
from hypothesis import strategies as st

from rtctl.protocol import e2e, mit

DBC: Any = cantools.database.load_file(Path(__file__).parent.parent / "configs" / "drive.dbc")
IN_DBC = ("DM8009", "DM4340", "DM4310")
DM8009 = mit.DRIVES["DM8009"]  # +-12.5 rad, +-45 rad/s, +-54 Nm

drives = st.sampled_from(IN_DBC)
any_float = st.floats(width=64)
specials = (mit.ENABLE, mit.DISABLE, mit.ZERO, mit.CLEAR)


def test_zero_is_the_upper_middle_code() -> None:
    # The middle of 65535 codes is 32767.5, rounded up 0x8000; of 4095, 2047.5 and 0x800. kp = kd = 0.
    #   p 8000 | v 800 | kp 000 | kd 000 | t 800
    assert mit.encode_command(0, 0, 0, 0, 0, DM8009).hex() == "8000800000000800"


def test_a_command_at_its_ends_and_middles() -> None:
    # p top, v bottom, kp = 250 of 0..500: 2047.5 -> 800, kd = 2.5 of 0..5: 800, t bottom
    assert mit.encode_command(12.5, -45, 250, 2.5, -54, DM8009).hex() == "ffff000800800000"


def test_a_torque_is_rounded_not_cut_off() -> None:
    # (13.5 + 54) 4095 / 108 = 2559.375 -> 9ff;  (13.51 + 54) 4095 / 108 = 2559.754 -> a00
    assert mit.encode_torque(13.5, 54.0).hex()[-3:] == "9ff"
    assert mit.encode_torque(13.51, 54.0).hex()[-3:] == "a00"


def test_a_reply_by_hand() -> None:
    # err 1, id 3 | p c000 | v c00 | t 800 | 32 degC | 33 degC
    reply = mit.decode_reply(bytes.fromhex("13c000c008002021"), DM8009)
    assert reply is not None
    assert (reply.err, reply.id, reply.t_mos, reply.t_rotor) == (1, 3, 32, 33)
    assert reply.p == pytest.approx(49152 / 65535 * 25 - 12.5)
    assert reply.v == pytest.approx(3072 / 4095 * 90 - 45)
    assert reply.t == pytest.approx(54 / 4095)  # half an LSB of 108 / 4095 Nm above zero


def test_special_frames_by_hand() -> None:
    assert [s.hex() for s in specials] == ["ff" * 7 + end for end in ("fc", "fd", "fe", "fb")]


@given(drives, any_float, any_float, any_float, any_float, any_float)
def test_a_command_decodes_to_what_was_meant_within_half_a_step(
    drive: str, p: float, v: float, kp: float, kd: float, t: float
) -> None:
    scale = mit.DRIVES[drive]
    decoded = DBC.get_message_by_name(f"{drive}_Command").decode(mit.encode_command(p, v, kp, kd, t, scale))
    ends = {
        "p": (p, -scale.p_max, scale.p_max, 65535),
        "v": (v, -scale.v_max, scale.v_max, 4095),
        "kp": (kp, 0.0, 500.0, 4095),
        "kd": (kd, 0.0, 5.0, 4095),
        "t": (t, -scale.t_max, scale.t_max, 4095),
    }
    all_at_top = all(x >= high - (high - low) / steps for x, low, high, steps in ends.values() if math.isfinite(x))
    for name, (x, low, high, steps) in ends.items():
        wanted = min(max(x if math.isfinite(x) else 0.0, low), high)
        step = (high - low) / steps
        # kd gives way by a step where the bytes would be those of a special frame
        allowance = step if name == "kd" and all_at_top else 0.0
        assert abs(decoded[name] - wanted) <= step / 2 + allowance + 1e-9 * high


@given(st.sampled_from(sorted(mit.DRIVES)), any_float)
def test_a_torque_alone_is_the_general_command_with_zeros(drive: str, t: float) -> None:
    scale = mit.DRIVES[drive]
    assert mit.encode_torque(t, scale.t_max) == mit.encode_command(0.0, 0.0, 0.0, 0.0, t, scale)


@pytest.mark.parametrize("drive", sorted(mit.DRIVES))
def test_zero_torque_decodes_within_half_a_step(drive: str) -> None:
    t_max = mit.DRIVES[drive].t_max
    code = struct.unpack(">H", mit.encode_torque(0.0, t_max)[6:])[0]
    assert abs(code * 2 * t_max / 4095 - t_max) <= t_max / 4095 * (1 + 1e-9)


@pytest.mark.parametrize("excess", [1.0, 1.0001, 2.0, 1e6, 1e306])
def test_torque_saturates_and_never_wraps(excess: float) -> None:
    assert mit.encode_torque(54.0 * excess, 54.0).hex()[-3:] == "fff"
    assert mit.encode_torque(-54.0 * excess, 54.0).hex()[-3:] == "000"


@pytest.mark.parametrize("t", [math.nan, math.inf, -math.inf])
def test_a_torque_that_is_not_finite_is_no_torque(t: float) -> None:
    assert mit.encode_torque(t, 54.0) == mit.encode_torque(0.0, 54.0)


@given(any_float, any_float, any_float, any_float, any_float)
def test_no_command_is_a_special_frame(p: float, v: float, kp: float, kd: float, t: float) -> None:
    assert mit.encode_command(p, v, kp, kd, t, DM8009)[:7] != b"\xff" * 7


def test_the_most_extreme_command_is_no_special_frame() -> None:
    for step in range(8):  # the codes FF8..FFF of torque, among them FB..FE
        t = 54.0 - step * 108.0 / 4095.0
        assert mit.encode_command(12.5, 45.0, 500.0, 5.0, t, DM8009)[:7] == bytes.fromhex("ffffffffffffef")


@given(drives, st.binary(min_size=8, max_size=8))
def test_every_reply_decodes_as_cantools_does(drive: str, data: bytes) -> None:
    reply = mit.decode_reply(data, mit.DRIVES[drive])
    message = DBC.get_message_by_name(f"{drive}_Reply")
    expected = message.decode(data, decode_choices=False)
    assert reply is not None
    assert (reply.err, reply.id) == (expected["err"], expected["id"])
    assert (reply.t_mos, reply.t_rotor) == (expected["T_mos"], expected["T_rotor"])
    assert (reply.p, reply.v, reply.t) == pytest.approx(tuple(expected[k] for k in "pvt"), abs=1e-12)


@given(st.sampled_from(range(16)), st.floats(-12.5, 12.5), st.floats(-45, 45), st.floats(-54, 54))
def test_a_drive_that_cantools_plays_is_understood(err: int, p: float, v: float, t: float) -> None:
    fields = {"err": err, "id": 3, "p": p, "v": v, "t": t, "T_mos": 40, "T_rotor": 50}
    reply = mit.decode_reply(DBC.get_message_by_name("DM8009_Reply").encode(fields), DM8009)
    assert reply is not None
    assert (reply.err, reply.id, reply.t_mos, reply.t_rotor) == (err, 3, 40, 50)
    steps = (25 / 65535, 90 / 4095, 108 / 4095)
    for got, sent, step in zip((reply.p, reply.v, reply.t), (p, v, t), steps, strict=True):
        assert abs(got - sent) <= step  # the encoder there may cut off


@given(st.binary(max_size=12).filter(lambda data: len(data) != 8))
def test_a_short_or_long_reply_is_told_not_raised(data: bytes) -> None:
    assert mit.decode_reply(data, DM8009) is None
    assert mit.decode_register(data) is None


def test_status_names_follow_the_dbc() -> None:
    choices = DBC.get_message_by_name("DM8009_Reply").get_signal_by_name("err").choices
    assert set(choices) == set(mit.STATUS)


@pytest.mark.parametrize("drive", IN_DBC)
def test_the_protected_messages_of_the_dbc_fit_the_trailer(drive: str) -> None:
    payload = mit.encode_torque(5.0, mit.DRIVES[drive].t_max)
    message = DBC.get_message_by_name(f"{drive}_Command_E2E")
    decoded = message.decode(e2e.protect(payload, 77, e2e.Wanted.TORQUE, 0x21))
    assert (decoded["counter"], decoded["torque_wanted"]) == (77, 1)
    reply = DBC.get_message_by_name(f"{drive}_Reply_E2E")
    bits = {"watchdog_tripped": 1, "clamped": 2, "slew_limited": 4, "derated": 8, "brake_closed": 16}
    for name, bit in bits.items():
        told = reply.decode(e2e.protect(payload, 5, bit, 0x31), decode_choices=False)
        assert [told[n] for n in bits] == [int(n == name) for n in bits]
    assert [int(report) for report in e2e.Report] == list(bits.values())


def test_register_frames_by_hand() -> None:
    # id 0x0103 low byte first | 33 read | register 21 | nothing
    assert mit.read_register(0x103, mit.PMAX).hex() == "0301331500000000"
    # 55 write | register 9 | 400 = 0x190 little-endian
    assert mit.write_register(3, mit.TIMEOUT, 400).hex() == "0300550990010000"
    # 12.5 = 0x41480000 as float32
    assert mit.write_register(3, mit.PMAX, 12.5).hex() == "0300551500004841"


def test_registers_and_their_names_are_those_of_the_published_driver() -> None:
    ours = mit.REGISTERS | {n: "can_br" for n, name in mit.REGISTERS.items() if name == "BAUD"}  # as it calls the rate
    assert ours == {number: REGISTER_TABLE[number].variable for number in ours}
    assert set(ours) == {7, 8, 9, 10, 21, 22, 23, 35}
    assert {number for number in ours if REGISTER_TABLE[number].data_type == "float"} == mit.FLOATS
    assert (mit.REGISTER_ID, mit.REPLY_OFFSET, mit.MODE_MIT) == (0x7FF, 0x10, 1)
    assert "1 register unit = 50 microseconds" in REGISTER_TABLE[mit.TIMEOUT].description
    assert mit.TIMEOUT_S == 50e-6


@pytest.mark.parametrize("name", mit.DRIVES)
def test_the_spans_of_a_drive_are_those_of_the_published_driver(name: str) -> None:
    theirs = MOTOR_TYPE_PRESETS[name.removeprefix("DM").replace("_48V", "P")]
    wanted = mit.Scale(*(theirs[key] for key in ("p_max", "v_max", "t_max")))
    assert mit.DRIVES[name] == (wanted._replace(v_max=8.0) if name == "DM4340" else wanted)  # the maker's other table
    assert (mit.KP_MAX, mit.KD_MAX) == (KP_MAX, KD_MAX)


def test_a_field_is_rounded_at_its_half() -> None:
    # 4095 steps of 1: a hair below and above k + 1/2
    assert [mit.code(2047.5 + hair, 0.0, 4095.0, 12) for hair in (-0.001, 0.001)] == [2047, 2048]


@given(st.integers(0, 0x7EF), st.sampled_from(sorted(mit.FLOATS)), st.floats(width=32, allow_nan=False))
def test_a_float_register_comes_back_to_the_bit(motor: int, rid: int, x: float) -> None:
    register = mit.decode_register(mit.write_register(motor, rid, x))
    assert register is not None
    assert (register.motor_id, register.write, register.rid, register.real) == (motor, True, rid, x)


@given(st.integers(0, 0x7EF), st.integers(0, 2**32 - 1))
def test_a_number_register_comes_back(motor: int, x: int) -> None:
    register = mit.decode_register(mit.write_register(motor, mit.TIMEOUT, x))
    assert register is not None
    assert (register.motor_id, register.number) == (motor, x)


def test_a_state_is_no_register() -> None:
    assert mit.decode_register(bytes.fromhex("0380008008002021")) is None

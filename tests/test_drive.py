"""The drive's firmware: what it does with a command, and what it does when none comes."""

import binascii
import math
import struct
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_sim import codec, drive
from firmware_sim.drive import Drive, Fault, Rating, State

SCALE = codec.Scale(12.5, 45.0, 54.0)
LSB = 2 * 54.0 / 4095
ENABLE, DISABLE, ZERO, CLEAR = (b"\xff" * 7 + bytes((x,)) for x in (0xFC, 0xFD, 0xFE, 0xFB))
HALF_MS = 500_000


def rating(e2e: bool = False, timeout: int = 400, torque: float = 40.0, rate: float = 1000.0) -> Rating:
    """Return a drive of 40 Nm, 16 rad/s and a watchdog of 20 ms under a 1 kHz controller."""
    return Rating(3, SCALE, torque, rate, 16.0, 1_000_000, timeout, 4, e2e, release_ns=0)


def field(value: float, bound: float, bits: int) -> str:
    """Return a field's bits, from the protocol's words: nearest step of 2^bits - 1 between -bound and bound."""
    return format(round((value + bound) / (2 * bound) * (2**bits - 1)), f"0{bits}b")


def command(t: float, p: float = 0.0, v: float = 0.0, kp: float = 0.0, kd: float = 0.0) -> bytes:
    """Return a command as a string of bits says it."""
    gains = format(round(kp / 500 * 4095), "012b") + format(round(kd / 5 * 4095), "012b")
    bits = field(p, 12.5, 16) + field(v, 45.0, 12) + gains + field(t, 54.0, 12)
    return int(bits, 2).to_bytes(8, "big")


def sealed(data: bytes, counter: int, status: int = 1, can_id: int = 3) -> bytes:
    """Return a protected frame; CRC by the standard library."""
    body = data + bytes((counter & 0xFF, status))
    return body + binascii.crc_hqx(body + struct.pack(">H", can_id), 0xFFFF).to_bytes(2, "big")


def torque_of(reply: bytes) -> float:
    """Return the torque a reply echoes."""
    return ((reply[4] & 0xF) << 8 | reply[5]) * 108.0 / 4095 - 54.0


def state(d: Drive) -> State:
    """Return the drive's state; a call, because it changes behind the type checker's back."""
    return d.state


def run(d: Drive, seconds: float, q: float = 0.0, qd: float = 0.0) -> drive.Actuation:
    """Let time pass on a joint at q, qd; return what it gets at the end."""
    act = drive.Actuation(0.0, 0.0)
    for _ in range(round(seconds * 2000)):
        d.sense(q, qd)
        act = d.actuate(HALF_MS)
    return act


def driving(t: float = 10.0, **kw: float) -> Drive:
    """Return a drive that applies torque t."""
    d = Drive(rating(**kw))  # type: ignore[arg-type]
    d.receive(ENABLE)
    for _ in range(20):
        d.receive(command(t))
        run(d, 0.001)
    return d


# ---- codec


def test_golden_bytes_of_zero_torque() -> None:
    zero = codec.decode_command(bytes.fromhex("8000800000000800"), SCALE)
    assert abs(zero.t) <= LSB / 2 + 1e-12
    assert (zero.kp, zero.kd, zero.special) == (0.0, 0.0, 0)
    assert abs(zero.p) <= 12.5 / 65535 + 1e-12
    assert abs(zero.v) <= 45.0 / 4095 + 1e-12


def test_golden_bytes_of_a_command_and_a_reply() -> None:
    c = codec.decode_command(bytes.fromhex("ffff000fff800fff"), SCALE)
    assert c[1:] == pytest.approx((12.5, -45.0, 500.0, 5.0 * 0x800 / 4095, 54.0))
    assert codec.encode_state(0x13, 0xD, 12.5, -45.0, 54.0, (30, 300), SCALE) == bytes.fromhex("d3ffff000fff1eff")
    assert codec.encode_state(5, 1, -12.5, 45.0, -54.0, (-5, 25), SCALE) == bytes.fromhex("150000fff0000019")


def test_crc_has_the_catalogue_s_check_value() -> None:
    assert codec.crc16(b"123456789") == 0x29B1


@given(st.binary(max_size=40))
def test_crc_agrees_with_the_standard_library(data: bytes) -> None:
    assert codec.crc16(data) == binascii.crc_hqx(data, 0xFFFF)


@given(st.binary(min_size=8, max_size=8), st.integers(0, 255), st.integers(0, 255), st.integers(0, 0x7FF))
def test_trailer_agrees_with_one_made_by_the_standard_library(data: bytes, n: int, status: int, i: int) -> None:
    assert codec.protect(data, n, status, i) == sealed(data, n, status, i)
    assert codec.intact(sealed(data, n, status, i), i)
    assert not codec.intact(sealed(data, n, status, i), i ^ 1)


@given(st.floats(allow_nan=True, allow_infinity=True), st.sampled_from((12, 16)))
def test_quantiser_saturates_and_rounds_to_the_nearest(x: float, bits: int) -> None:
    u = codec.quantise(x, 54.0, bits)
    assert 0 <= u <= 2**bits - 1
    if math.isfinite(x):
        assert abs(codec.restore(u, 54.0, bits) - min(max(x, -54.0), 54.0)) <= 54.0 / (2**bits - 1) + 1e-12


# ---- states


def test_reply_tells_of_the_world_before_the_command() -> None:
    d = driving(10.0)
    before = d.receive(command(-10.0))
    run(d, 0.02)
    after = d.receive(command(-10.0))
    assert before is not None
    assert after is not None
    assert torque_of(before) == pytest.approx(10.0, abs=LSB)
    assert torque_of(after) == pytest.approx(-10.0, abs=LSB)
    d = Drive(rating())
    first, second = d.receive(ENABLE), d.receive(ENABLE)
    assert first is not None
    assert second is not None
    assert (first[0] >> 4, second[0] >> 4) == (0, 1)
    assert first[0] & 0xF == 3


def test_disabled_drive_answers_and_never_drives() -> None:
    d = Drive(rating())
    for data in (command(30.0), DISABLE, CLEAR, command(-30.0)):
        reply = d.receive(data)
        assert reply is not None
        assert reply[0] >> 4 == 0
        act = run(d, 0.005)
        assert act.torque == 0.0
        assert act.drag >= 40.0  # the brake holds more than the motor can give


def test_the_motor_takes_the_load_over_before_the_brake_lets_go() -> None:
    d = Drive(rating()._replace(release_ns=drive.BRAKE_RELEASE_NS))
    d.receive(ENABLE)
    for k in range(110):
        reply = d.receive(command(30.0))
        act = run(d, 0.001)
        if k < 99:
            assert act.torque == 0.0
            assert act.drag > 40.0
        if k == 60:
            assert reply is not None
            assert torque_of(reply) == pytest.approx(30.0, abs=LSB)  # built up against the brake
    assert act.drag == 0.0
    assert act.torque == pytest.approx(30.0, abs=LSB)


def test_brake_opens_with_the_first_torque_command_and_closes_on_disable() -> None:
    d = Drive(rating(e2e=True))
    d.receive(sealed(ENABLE, 1, 0))
    assert run(d, 0.001).drag > 0.0
    d.receive(sealed(command(5.0), 2, 0))  # alive, torque not wanted
    act = run(d, 0.001)
    assert act.torque == 0.0
    assert act.drag > 0.0
    d.receive(sealed(command(5.0), 3, 1))
    act = run(d, 0.010)
    assert act.drag == 0.0
    assert act.torque == pytest.approx(5.0, abs=LSB)
    d.receive(sealed(command(5.0), 4, 0))
    assert run(d, 0.010) == (0.0, 0.0)
    d.receive(sealed(DISABLE, 5, 0))
    act = run(d, 0.0005)
    assert act.torque == 0.0
    assert act.drag > 0.0
    assert state(d) is State.DISABLED


def test_a_command_of_before_is_forgotten_when_enabled_again() -> None:
    d = driving(10.0)
    d.receive(DISABLE)
    d.receive(ENABLE)
    assert run(d, 0.005).torque == 0.0


def test_position_and_speed_gains_make_a_servo() -> None:
    d = driving(0.0)
    d.receive(command(2.0, p=0.5, v=1.0, kp=10.0, kd=2.0))
    act = run(d, 0.015, q=0.2, qd=0.5)
    assert act.torque == pytest.approx(10.0 * 0.3 + 2.0 * 0.5 + 2.0, abs=0.1)


def test_zero_makes_here_the_origin_only_while_disabled() -> None:
    d = driving(0.0)
    d.sense(0.7, 0.0)
    d.receive(ZERO)
    assert d.q == 0.7
    d.receive(DISABLE)
    d.receive(ZERO)
    d.sense(0.9, 0.0)
    assert d.q == pytest.approx(0.2)


# ---- watchdog


@pytest.mark.parametrize(("counts", "steps"), [(400, 40), (100, 10), (61, 7)])
def test_watchdog_trips_in_the_step_after_w(counts: int, steps: int) -> None:
    d = driving(10.0, timeout=counts)
    d.receive(command(10.0))
    for _ in range(steps):
        d.sense(0.0, 0.0)
        assert d.actuate(HALF_MS).torque == pytest.approx(10.0, abs=LSB)
    assert state(d) is State.ENABLED
    d.sense(0.0, 0.0)
    assert d.actuate(HALF_MS).torque == 0.0
    assert (d.state, d.fault) == (State.FAULT, 0xD)
    assert d.watchdog_tripped
    assert [(t.code, t.at - t.last_valid) for t in d.trips] == [(0xD, steps * HALF_MS)]


def test_every_command_feeds_the_watchdog() -> None:
    d = driving(1.0)
    for _ in range(50):
        run(d, 0.019)
        d.receive(command(1.0))
    assert state(d) is State.ENABLED


def test_register_timeout_zero_means_off() -> None:
    d = driving(1.0, timeout=0)
    run(d, 2.0)
    assert state(d) is State.ENABLED


def test_enable_keeps_an_idle_drive_alive_but_never_a_torque() -> None:
    d = Drive(rating())
    d.receive(ENABLE)
    for _ in range(10):
        run(d, 0.015)
        d.receive(ENABLE)
    assert state(d) is State.ENABLED
    d = driving(5.0)
    for _ in range(10):
        run(d, 0.015)
        d.receive(ENABLE)
    assert state(d) is State.FAULT


def test_disabled_drive_has_no_watchdog() -> None:
    d = Drive(rating())
    run(d, 1.0)
    assert state(d) is State.DISABLED
    d.receive(ENABLE)
    run(d, 0.019)
    assert state(d) is State.ENABLED


def test_fault_is_latched_until_cleared_and_the_first_one_stays() -> None:
    d = driving(10.0)
    run(d, 0.05)
    d.trip(Fault.OVER_CURRENT)
    for data in (command(10.0), ENABLE, DISABLE, ENABLE, command(5.0)):
        reply = d.receive(data)
        run(d, 0.001)
        assert reply is not None
        assert reply[0] >> 4 == 0xD
    d.receive(CLEAR)
    assert state(d) is State.DISABLED
    assert not d.watchdog_tripped
    d.receive(ENABLE)
    d.receive(command(3.0))
    assert run(d, 0.01).torque == pytest.approx(3.0, abs=LSB)


def test_fault_drags_a_moving_joint_and_brakes_it_when_slow() -> None:
    d = driving(10.0)
    run(d, 0.025, qd=2.0)
    assert d.fault == 0xD
    fast = run(d, 0.010, qd=2.0)
    assert fast == (0.0, 40.0)  # bounded by the rating
    creep = run(d, 0.010, qd=0.15)
    assert creep.drag == pytest.approx(40.0)
    assert not d.brake
    reply = d.receive(command(0.0))
    assert reply is not None
    assert torque_of(reply) == pytest.approx(-40.0, abs=LSB)  # the echo tells which way the windings pull
    slow = run(d, 0.0005, qd=-0.09)
    assert slow == (0.0, 60.0)
    assert d.brake
    assert run(d, 0.010, qd=2.0).drag == 60.0  # a closed brake stays closed


def test_drag_falls_with_speed() -> None:
    d = driving(10.0, torque=40.0)
    d.trip(Fault.OVER_CURRENT)
    d.brake = False
    d.sense(0.0, 0.12)
    assert d.actuate(HALF_MS).drag == 40.0
    assert Drive(rating()).actuate(HALF_MS).drag == 60.0


def test_brake_closes_after_one_second_whatever_the_speed() -> None:
    d = driving(10.0)
    d.receive(command(10.0))
    run(d, 0.0205, qd=1.0)
    assert state(d) is State.FAULT
    run(d, 0.999, qd=1.0)
    assert not d.brake
    run(d, 0.0015, qd=1.0)
    assert d.brake


# ---- bounds


def test_torque_is_clamped_to_the_rating() -> None:
    d = driving(54.0)
    act = run(d, 0.015)
    assert act.torque == 40.0
    assert d.flags & codec.CLAMPED
    d = driving(-54.0)
    assert run(d, 0.015).torque == -40.0


def test_torque_is_clamped_to_the_wire_s_full_scale() -> None:
    d = driving(0.0, torque=100.0)
    for _ in range(5):
        d.receive(command(0.0, p=12.5, kp=500.0))
        run(d, 0.015)
    assert run(d, 0.001).torque == 54.0


def test_a_command_at_the_limit_is_no_clamp() -> None:
    d = driving(40.0)
    run(d, 0.001)
    assert not d.flags & codec.CLAMPED


def test_step_is_slewed_at_the_stated_rate() -> None:
    d = driving(0.0)
    run(d, 0.002)
    d.receive(command(40.0))
    seen = []
    for _ in range(20):
        d.sense(0.0, 0.0)
        seen.append(d.actuate(HALF_MS).torque)
    assert seen[0] <= 1000.0 * 1.25 * 0.001 + LSB  # at most one period's worth at once
    for a, b in zip(seen, seen[2:], strict=False):
        assert b - a <= 1250.0 * 0.001 + 1e-9
    assert seen[-1] == pytest.approx(1.25 + 19 * 0.625, abs=0.7)
    assert d.flags & codec.SLEWED


def test_a_step_of_one_period_at_the_controller_s_rate_is_not_touched() -> None:
    d = driving(0.0)
    t = 0.0
    for k in range(60):
        t += 1.0 if (k // 15) % 2 == 0 else -1.0  # 1000 Nm/s at 1 kHz
        d.receive(command(t))
        d.sense(0.0, 0.0)
        assert d.actuate(HALF_MS).torque == pytest.approx(t, abs=LSB)
        assert not d.flags & codec.SLEWED
        d.actuate(HALF_MS)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_over_speed_trips(sign: float) -> None:
    d = driving(1.0)
    run(d, 0.001, qd=sign * 23.9)
    assert state(d) is State.ENABLED
    run(d, 0.001, qd=sign * 24.1)  # 1.5 x 16 rad/s
    assert (d.state, d.fault) == (State.FAULT, Fault.OVERLOAD)


def test_a_spinning_joint_trips_a_disabled_drive_too() -> None:
    d = Drive(rating())
    run(d, 0.001, qd=30.0)
    assert d.fault == Fault.OVERLOAD
    assert [(t.at, t.last_valid, t.rest) for t in d.trips] == [(0, 0, -1)]
    run(d, 0.001, qd=0.011)
    assert d.trips[0].rest == -1
    run(d, 0.001, qd=0.009)
    assert d.trips[0].rest == 2_500_000


def test_a_smaller_full_scale_of_speed_lowers_the_trip() -> None:
    d = Drive(rating())
    d.register(register(0x55, 22, struct.pack("<f", 10.0)))
    run(d, 0.001, qd=9.9)
    assert state(d) is State.DISABLED
    run(d, 0.001, qd=10.1)  # the wire could not tell a faster joint from this one
    assert d.fault == Fault.OVERLOAD


def test_slew_starts_afresh_after_a_stop() -> None:
    d = driving(0.0)
    d.receive(command(40.0))
    run(d, 0.005)
    d.receive(DISABLE)
    d.receive(ENABLE)
    d.receive(command(1.2))
    d.sense(0.0, 0.0)
    assert d.actuate(HALF_MS).torque == pytest.approx(1.2, abs=LSB)


def test_fault_codes_are_the_protocol_s() -> None:
    names = ("OVER_VOLTAGE", "UNDER_VOLTAGE", "OVER_CURRENT", "MOS_HOT", "COIL_HOT", "COMMUNICATION", "OVERLOAD")
    assert [Fault[n] for n in names] == [0x8, 0x9, 0xA, 0xB, 0xC, 0xD, 0xE]


@pytest.mark.parametrize("bad", [(math.nan, 0.0), (0.0, math.inf)])
def test_sensor_that_reads_nonsense_trips(bad: tuple[float, float]) -> None:
    d = driving(1.0)
    d.sense(*bad)
    assert d.fault == Fault.OVERLOAD
    reply = d.receive(command(0.0))
    assert reply is not None
    assert all(map(math.isfinite, (d.q, d.qd, torque_of(reply))))


def test_winding_warms_as_a_first_order_system() -> None:
    d = driving(24.0)  # the continuous torque, 0.6 x 40 Nm
    for _ in range(6000):
        d.receive(command(24.0))
        d.sense(0.0, 0.0)
        d.actuate(10_000_000)
    load = torque_of(d.reply()) / 24.0  # what 12 bits made of it
    assert d.temperature == pytest.approx(25.0 + 80.0 * load**2 * (1.0 - math.exp(-1.0)), rel=1e-3)


def test_heat_derates_and_then_trips_and_cannot_be_cleared_while_hot() -> None:
    d = driving(40.0)
    d.temperature = 110.0
    d.receive(command(40.0))
    run(d, 0.019)
    assert run(d, 0.0005).torque == pytest.approx(30.0, rel=0.01)
    assert d.flags & codec.DERATED
    d.temperature = 120.0
    run(d, 0.001)
    assert d.fault == Fault.COIL_HOT
    d.receive(CLEAR)
    assert state(d) is State.FAULT
    d.temperature = 90.0
    d.receive(CLEAR)
    assert state(d) is State.DISABLED
    reply = d.reply()
    assert (reply[6], reply[7]) == (57, 90)  # power stage: half the rise


# ---- protected frames


def protected() -> Drive:
    """Return an enabled drive on protected frames; the last counter was 1."""
    d = Drive(rating(e2e=True))
    d.receive(sealed(ENABLE, 0, 0))
    d.receive(sealed(command(10.0), 1))
    run(d, 0.01)
    return d


def flipped(data: bytes, bit: int) -> bytes:
    """Return data with one bit changed."""
    return (int.from_bytes(data, "big") ^ 1 << bit).to_bytes(len(data), "big")


@pytest.mark.parametrize("bit", [0, 15, 16, 23, 24, 31, 32, 40, 95])
def test_a_corrupt_command_is_answered_and_not_taken(bit: int) -> None:
    d = protected()
    silent = d.silence_ns
    assert d.receive(flipped(sealed(command(-10.0), 2), bit)) is not None
    assert (d.silence_ns, d.rejected) == (silent, 1)
    assert run(d, 0.005).torque == pytest.approx(10.0, abs=LSB)
    assert d.receive(sealed(command(-10.0), 2)) is not None
    assert d.silence_ns == 0


@pytest.mark.parametrize("counter", [1, 0, 255, 129])
def test_a_repeated_or_older_command_is_not_taken(counter: int) -> None:
    d = protected()
    assert d.receive(sealed(command(-10.0), counter)) is not None
    assert d.silence_ns > 0
    assert run(d, 0.005).torque == pytest.approx(10.0, abs=LSB)


@pytest.mark.parametrize("counter", [2, 4, 100, 128])
def test_lost_commands_before_a_newer_one_do_not_matter(counter: int) -> None:
    d = protected()
    d.receive(sealed(command(-10.0), counter))
    assert d.silence_ns == 0
    assert run(d, 0.019).torque < 0.0


def test_counter_wraps() -> None:
    d = protected()
    for k in range(2, 600):
        d.receive(sealed(command(10.0), k))
        run(d, 0.001)
    assert (d.state, d.rejected) == (State.ENABLED, 0)


def test_repeated_commands_let_the_watchdog_trip() -> None:
    d = protected()
    for _ in range(30):
        d.receive(sealed(command(10.0), 1))
        run(d, 0.001)
    assert d.fault == 0xD


def test_a_restarted_controller_is_taken_up_whatever_its_counter() -> None:
    d = protected()
    d.receive(sealed(DISABLE, 2, 0))
    d.receive(sealed(ENABLE, 201, 0))
    assert state(d) is State.ENABLED
    d.receive(sealed(DISABLE, 202, 0))
    d.receive(sealed(ENABLE, 202, 0))  # but never a repetition
    assert state(d) is State.DISABLED


def test_replies_count_and_carry_status_and_crc() -> None:
    d = protected()
    replies = [d.receive(sealed(command(54.0), k)) for k in range(2, 5)]
    assert all(r is not None and codec.intact(r, 0x13) for r in replies)
    counters = [r[8] for r in replies if r is not None]
    assert [b - a & 0xFF for a, b in pairwise(counters)] == [1, 1]
    run(d, 0.002)
    last = d.receive(sealed(command(54.0), 5))
    assert last is not None
    assert last[9] == codec.CLAMPED | codec.SLEWED
    run(d, 0.05)
    last = d.receive(sealed(command(54.0), 6))
    assert last is not None
    assert last[9] == codec.WATCHDOG | codec.BRAKE


@pytest.mark.parametrize(("e2e", "length"), [(False, 12), (False, 7), (True, 8), (True, 0)])
def test_a_frame_of_a_wrong_length_is_not_answered(e2e: bool, length: int) -> None:
    d = Drive(rating(e2e=e2e))
    assert d.receive(bytes(length)) is None
    assert d.register(bytes(length)) is None
    assert d.rejected == 2


# ---- registers


def register(operation: int, number: int, raw: bytes = bytes(4)) -> bytes:
    """Return a register frame for motor 3."""
    return struct.pack("<HBB", 3, operation, number) + raw


@pytest.mark.parametrize(
    ("number", "raw"),
    [
        (7, struct.pack("<I", 0x13)),
        (8, struct.pack("<I", 3)),
        (9, struct.pack("<I", 400)),
        (10, struct.pack("<I", 1)),
        (21, struct.pack("<f", 12.5)),
        (22, struct.pack("<f", 45.0)),
        (23, struct.pack("<f", 54.0)),
        (35, struct.pack("<I", 4)),
    ],
)
def test_registers_read_as_commissioned(number: int, raw: bytes) -> None:
    assert Drive(rating()).register(register(0x33, number)) == b"\x03\x00\x33" + bytes((number,)) + raw


def test_timeout_is_written_takes_effect_and_survives_power_only_when_saved() -> None:
    d = Drive(rating())
    ten_ms = struct.pack("<I", 200)
    assert d.register(register(0x55, 9, ten_ms)) == b"\x03\x00\x55\x09" + ten_ms
    d.receive(ENABLE)
    run(d, 0.0105)
    assert d.fault == 0xD
    d.boot()
    assert d.register(register(0x33, 9)) == b"\x03\x00\x33\x09" + struct.pack("<I", 400)
    d.register(register(0x55, 9, ten_ms))
    assert d.register(register(0xAA, 1)) == b"\x03\x00\xaa\x01" + bytes(4)
    d.register(register(0xAA, 1))
    assert d.flash_writes == 1  # only a change wears the flash
    d.boot()
    assert d.register(register(0x33, 9)) == b"\x03\x00\x33\x09" + ten_ms


def test_a_written_scale_changes_what_the_bytes_mean() -> None:
    d = Drive(rating())
    d.register(register(0x55, 23, struct.pack("<f", 27.0)))
    d.receive(ENABLE)
    d.receive(command(20.0))
    for _ in range(20):
        d.receive(command(20.0))
        run(d, 0.001)
    assert run(d, 0.001).torque == pytest.approx(10.0, abs=LSB)


@pytest.mark.parametrize(
    ("number", "raw"),
    [
        (21, struct.pack("<f", math.nan)),
        (22, struct.pack("<f", math.inf)),
        (23, struct.pack("<f", 0.0)),
        (23, struct.pack("<f", -54.0)),
        (10, struct.pack("<I", 2)),
        (7, struct.pack("<I", 99)),
        (8, struct.pack("<I", 9)),
        (35, struct.pack("<I", 9)),
    ],
)
def test_a_value_the_drive_cannot_work_with_is_answered_with_what_stands(number: int, raw: bytes) -> None:
    d = Drive(rating())
    answer = d.register(register(0x55, number, raw))
    read = d.register(register(0x33, number))
    assert answer is not None
    assert read is not None
    assert answer[4:] == read[4:] != raw


def test_registers_are_fixed_while_enabled() -> None:
    d = Drive(rating())
    d.receive(ENABLE)
    d.register(register(0x55, 9, bytes(4)))
    assert d.timeout_ns == 20_000_000


def test_unknown_registers_and_operations_are_silent_and_refresh_asks_for_the_state() -> None:
    d = Drive(rating())
    assert d.register(register(0x33, 99)) is None
    assert d.register(register(0x12, 9)) is None
    assert d.register(register(0xCC, 0)) == d.reply()


def test_protected_register_frames_are_checked() -> None:
    d = Drive(rating(e2e=True))
    frame = sealed(register(0x33, 9), 0, 0, 0x7FF)
    answer = d.register(frame)
    assert answer is not None
    assert codec.intact(answer, 0x13)
    assert answer[:8] == b"\x03\x00\x33\x09" + struct.pack("<I", 400)
    assert d.register(flipped(frame, 50)) is None


def test_power_cycle_disables_and_restarts_the_counter() -> None:
    d = protected()
    d.boot()
    assert (d.state, d.brake, d.counter_out) == (State.DISABLED, True, 0)


# ---- whatever comes


@given(st.lists(st.tuples(st.binary(min_size=0, max_size=13), st.floats(-60, 60), st.integers(0, 8)), max_size=30))
def test_no_bytes_and_no_motion_make_a_drive_exceed_its_bounds(events: list[tuple[bytes, float, int]]) -> None:
    d = Drive(rating())
    d.receive(ENABLE)
    last = 0.0
    for data, qd, steps in events:
        reply = d.receive(data)
        assert (reply is None) == (len(data) != 8)
        d.register(data)
        for _ in range(steps):
            d.sense(0.1, qd)
            act = d.actuate(HALF_MS)
            assert math.isfinite(act.torque)
            assert abs(act.torque) <= 40.0
            assert 0.0 <= act.drag <= 60.0
            assert act.torque == 0.0 or act.drag == 0.0
            if state(d) is State.ENABLED and act.torque != 0.0:
                assert abs(act.torque - last) <= 1.25 + 1e-9 or abs(last) < 1e-12
            last = act.torque


# ---- what a drive is after power-on and when it is off, and the edges of its bounds, each by its number

OFF = codec.Command(0, 0.0, 0.0, 0.0, 0.0, 0.0)


def hot(temperature: float) -> Drive:
    """Return an enabled drive with a winding of that temperature [degC]."""
    d = driving()
    d.temperature = temperature
    return d


def written(d: Drive, number: int, raw: bytes) -> bytes | None:
    """Write a register and return what the drive says then stands in it."""
    answer = d.register(struct.pack("<HBB", 3, 0x55, number) + raw)
    return None if answer is None else answer[4:8]


def test_after_power_on_nothing_of_before_is_left() -> None:
    d = driving()
    d.state, d.fault, d.watchdog_tripped, d.brake = State.FAULT, 0xE, True, False
    d.flags, d.fault_age_ns, d.strength, d.slew_budget = 7, 9, 0.5, 0.0
    d.boot()
    assert (d.state, int(d.state), d.fault, d.watchdog_tripped, d.brake) == (State.DISABLED, 0, 0, False, True)
    assert (d.release_ns, d.command, d.torque, d.strength, d.flags) == (-1, OFF, 0.0, 1.0, 0)
    assert (d.silence_ns, d.fault_age_ns, d.counter_in, d.counter_out) == (0, 0, -1, 0)
    assert d.slew_budget == d.slew_bound == pytest.approx(1000.0 * 1.25 * 1e-3)
    assert int(State.FAULT) == 2


def test_a_drive_as_its_makers_ship_it() -> None:
    plain = Rating(3, SCALE, 40.0, 1000.0, 16.0, 1_000_000, 400)
    assert (plain.baud, plain.e2e, plain.release_ns, plain.reply) == (4, False, 100_000_000, -1)
    assert Drive(plain).registers[codec.MST_ID] == 0x13
    assert Drive(plain._replace(reply=0)).registers[codec.MST_ID] == 0
    new = Drive(plain)
    assert (new.flash_writes, new.zero, new.q, new.qd, new.rejected) == (0, 0.0, 0.0, 0.0, 0)
    assert (new.temperature, new.uptime_ns, new.last_valid_ns, new.trips) == (25.0, 0, 0, [])


@pytest.mark.parametrize("to", [DISABLE, "trip"])
def test_a_drive_that_is_off_has_forgotten_its_command(to: bytes | str) -> None:
    d = driving()
    if isinstance(to, bytes):
        d.receive(to)
    else:
        d.trip(Fault.OVERLOAD)
        assert (d.fault, d.fault_age_ns) == (0xE, 0)
    assert (d.command, d.torque, d.flags, d.release_ns, d.slew_budget) == (OFF, 0.0, 0, -1, d.slew_bound)


def test_a_command_that_wants_no_torque_gives_none_and_opens_no_brake() -> None:
    d = Drive(rating(e2e=True))
    d.receive(sealed(ENABLE, 1))
    d.receive(sealed(command(10.0), 2, status=0))
    run(d, 0.002)
    assert (d.command, d.release_ns, d.brake, d.torque) == (OFF, -1, True, 0.0)
    d.receive(sealed(command(10.0), 3))
    assert d.release_ns == 0
    run(d, 0.005)
    d.receive(sealed(command(10.0), 4))
    assert d.release_ns == 5_000_000  # it goes on from the first
    d.receive(sealed(command(10.0), 5, status=0))
    run(d, 0.015)
    assert d.torque == 0.0


def test_a_counter_may_begin_anywhere_and_its_zero_is_a_number_as_others() -> None:
    for first in (0, 1, 255):
        d = Drive(rating(e2e=True))
        d.receive(sealed(ENABLE, first))
        assert (state(d), d.rejected) == (State.ENABLED, 0)
        d.receive(sealed(command(1.0), first))
        assert d.rejected == 1


def test_zero_shows_in_the_next_reply() -> None:
    d = Drive(rating())
    d.sense(2.0, 0.0)
    d.receive(ZERO)
    assert d.q == 0.0
    d.sense(2.5, 0.0)
    assert d.q == 0.5


@pytest.mark.parametrize(("temperature", "cleared"), [(99.9, True), (100.0, False)])
def test_a_fault_is_cleared_below_the_temperature_where_derating_begins(temperature: float, cleared: bool) -> None:
    d = hot(temperature)
    d.trip(Fault.OVERLOAD)
    d.watchdog_tripped, d.fault_age_ns = True, 5
    d.receive(CLEAR)
    assert (state(d) is State.DISABLED) == cleared
    if cleared:
        assert (d.fault, d.watchdog_tripped, d.fault_age_ns) == (0, False, 0)


@pytest.mark.parametrize(("temperature", "share"), [(100.0, 1.0), (110.0, 0.75), (119.99, 0.50025)])
def test_torque_falls_linearly_with_heat_to_half(temperature: float, share: float) -> None:
    d = hot(temperature)
    for _ in range(100):
        d.temperature = temperature
        d.receive(command(54.0))
        act = d.actuate(HALF_MS)
    assert act.torque == pytest.approx(40.0 * share, rel=1e-9)
    assert bool(d.flags & codec.DERATED) == (share < 1.0)


def test_the_power_stage_is_told_half_as_warm() -> None:
    assert tuple(hot(75.0).reply()[6:]) == (50, 75)
    assert tuple(hot(120.8).reply()[6:]) == (72, 120)  # 72.9, cut off


@pytest.mark.parametrize(
    ("number", "value", "taken"),
    [
        (codec.PMAX, 0.1, True),  # float32's own is a hair more
        (codec.PMAX, 0.0999, False),
        (codec.PMAX, 1000.0, True),
        (codec.PMAX, 1000.1, False),
        (codec.TIMEOUT, 0, True),  # as the makers ship it
        (codec.CTRL_MODE, 1, True),
        (codec.CTRL_MODE, 0, False),
        (codec.CTRL_MODE, 2, False),
    ],
)
def test_a_register_takes_what_lies_within_its_bounds(number: int, value: float, taken: bool) -> None:
    raw = struct.pack("<f", value) if number == codec.PMAX else struct.pack("<I", int(value))
    d = Drive(rating())
    d.registers[number] = 3.0
    assert (written(d, number, raw) == raw) == taken


def test_a_wire_value_at_the_very_bound_is_taken() -> None:
    d = Drive(rating())
    d._write(codec.PMAX, 0.1)
    assert d.registers[codec.PMAX] == 0.1


def test_a_joint_is_dragged_in_proportion_and_braked_below_its_speed() -> None:
    for speed, brake in ((0.1005, False), (0.1, False), (0.0995, True)):
        d = driving()
        d.trip(Fault.OVERLOAD)
        act = run(d, 0.0005, qd=speed)
        assert d.brake == brake
        assert act.torque == 0.0
        assert act.drag == pytest.approx(60.0 if brake else 40.0)
        assert d.torque == (0.0 if brake else -40.0)  # as the reply tells
    d = driving()
    d.trip(Fault.OVERLOAD)
    d.sense(0.0, 0.05)
    d.brake = False
    d.actuate(HALF_MS)
    assert d.trips[-1].rest == -1


def test_rest_is_told_once_it_is_slow_enough_and_of_the_last_trip_alone() -> None:
    d = driving()
    d.trip(Fault.OVERLOAD)
    for speed in (0.01005, 0.01):
        run(d, 0.0005, qd=speed)
        assert d.trips[-1].rest == -1
    run(d, 0.0005, qd=0.00995)
    first = d.trips[-1].rest
    assert first == d.uptime_ns
    run(d, 0.002)
    assert d.trips[-1].rest == first
    d.receive(CLEAR)
    d.trip(Fault.OVER_VOLTAGE)
    run(d, 0.0005)
    assert [trip.rest for trip in d.trips] == [first, d.uptime_ns]


@pytest.mark.parametrize(("counts", "trips"), [(0, False), (1, True)])
def test_a_watchdog_of_one_count_trips_and_of_none_does_not(counts: int, trips: bool) -> None:
    d = Drive(rating(timeout=counts))
    d.receive(ENABLE)
    d.receive(command(1.0))
    run(d, 0.01)
    assert (state(d) is State.FAULT) == trips


def test_a_brake_closes_at_its_latest_instant() -> None:
    d = driving()
    d.trip(Fault.OVERLOAD)
    d.fault_age_ns = 1_000_000_000
    d.sense(0.0, 5.0)
    d.actuate(HALF_MS)
    assert d.brake


def test_the_permitted_speed_itself_is_permitted() -> None:
    d = driving()
    run(d, 0.0005, qd=24.0)
    assert state(d) is State.ENABLED
    run(d, 0.0005, qd=24.0001)
    assert state(d) is State.FAULT


def test_a_motor_that_is_weak_gives_that_share() -> None:
    d = driving(10.0)
    d.strength = 0.5
    for _ in range(20):
        d.receive(command(10.0))
        run(d, 0.001)
    assert d.torque == pytest.approx(5.0, abs=LSB)


def test_torque_builds_up_against_the_closed_brake_from_the_first_instant() -> None:
    d = Drive(rating()._replace(release_ns=10_000_000))
    d.receive(ENABLE)
    assert d.silence_ns == 0
    d.receive(command(10.0))
    act = d.actuate(HALF_MS)
    assert d.brake
    assert act.torque == 0.0
    assert d.torque > 0.5


def test_enable_feeds_the_watchdog_of_an_idle_drive_with_nothing_but_now() -> None:
    d = Drive(rating())
    run(d, 0.005)
    d.receive(ENABLE)
    assert (d.silence_ns, d.last_valid_ns) == (0, d.uptime_ns)

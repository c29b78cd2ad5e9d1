"""End-to-end protection: what a receiver must notice, and what it makes of it."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_sim import codec
from rtctl.protocol import e2e
from rtctl.protocol.e2e import Check, Receivers, sequence

payloads = st.binary(min_size=8, max_size=8)
identifiers = st.integers(0, 0x7FF)
bytes8 = st.integers(0, 255)


def remainder(data: bytes) -> int:
    """CRC-16/CCITT-FALSE as polynomial long division of the message, start value 0xFFFF."""
    value = int.from_bytes(data, "big") << 16 ^ 0xFFFF << 8 * len(data)
    for bit in range(8 * len(data) + 15, 15, -1):
        if value >> bit & 1:
            value ^= 0x11021 << bit - 16
    return value


def test_the_catalogued_check_value() -> None:
    # The CRC covers the identifier as two bytes more, so "89" stands there as 0x3839.
    assert e2e.crc(b"1234567", 0x3839) == remainder(b"123456789") == 0x29B1


def test_a_protected_frame_by_hand() -> None:
    covered = bytes.fromhex("80008000000008000701")
    data = e2e.protect(covered[:8], 7, 1, 0x123)
    assert data == covered + remainder(covered + b"\x01\x23").to_bytes(2, "big")


@given(payloads, bytes8, bytes8, identifiers)
def test_a_frame_is_intact_as_sent(payload: bytes, counter: int, status: int, can_id: int) -> None:
    data = e2e.protect(payload, counter, status, can_id)
    assert (len(data), data[:8], data[8], data[9]) == (12, payload, counter, status)
    assert e2e.intact(data, can_id)


@given(payloads, bytes8, identifiers, st.integers(0, 95), st.integers(1, 0xFFFF))
def test_every_burst_of_up_to_sixteen_bits_is_noticed(
    payload: bytes, counter: int, can_id: int, at: int, burst: int
) -> None:
    data = e2e.protect(payload, counter, 0, can_id)
    spoilt = (int.from_bytes(data, "big") ^ burst << at) & (1 << 96) - 1
    changed = spoilt.to_bytes(12, "big")
    assert changed == data or not e2e.intact(changed, can_id)


def test_every_pair_of_wrong_bits_is_noticed() -> None:
    data = int.from_bytes(e2e.protect(bytes(range(8)), 9, 1, 3), "big")
    pairs = [1 << i | 1 << j for i in range(96) for j in range(i)]
    assert not any(e2e.intact((data ^ pair).to_bytes(12, "big"), 3) for pair in pairs)


@given(payloads, identifiers, identifiers)
def test_a_frame_under_another_identifier_is_noticed(payload: bytes, sent: int, received: int) -> None:
    assert e2e.intact(e2e.protect(payload, 0, 0, sent), received) == (sent == received)


@given(st.binary(max_size=64).filter(lambda data: len(data) != 12))
def test_a_frame_of_another_length_is_not_intact(data: bytes) -> None:
    assert not e2e.intact(data, 1)


@pytest.mark.parametrize("length", [0, 7, 9])
def test_only_eight_bytes_can_be_protected(length: int) -> None:
    with pytest.raises(ValueError, match="payload"):
        e2e.protect(bytes(length), 0, 0, 1)


@given(bytes8)
def test_the_next_counter_is_in_sequence_also_round_the_end(last: int) -> None:
    assert sequence(last, (last + 1) % 256) == (Check.OK, 0)
    assert sequence(last, last) == (Check.REPEATED, 0)
    assert not sequence(last, last).fresh


def test_the_first_frame_is_taken_whatever_it_counts() -> None:
    assert all(sequence(-1, counter) == (Check.OK, 0) for counter in range(256))


@given(bytes8, st.integers(1, 126))
def test_lost_frames_are_counted_and_the_newer_one_is_used(last: int, lost: int) -> None:
    received = sequence(last, (last + 1 + lost) % 256)
    assert received == (Check.WRONGSEQUENCE, lost)
    assert received.fresh


@given(bytes8, st.integers(1, 128))
def test_an_older_frame_is_not_used(last: int, older: int) -> None:
    received = sequence(last, (last - older) % 256)
    assert received == (Check.WRONGSEQUENCE, -older)
    assert not received.fresh


def test_two_frames_that_overtook_each_other() -> None:
    receiver = Receivers(1)
    verdicts = [receiver.judge(0, counter) for counter in (1, 3, 2, 4)]
    assert [v.fresh for v in verdicts] == [True, True, False, True]
    assert [v.lost for v in verdicts] == [0, 1, -1, 0]


def test_disorder_saturates_and_recedes() -> None:
    receiver = Receivers(1)
    receiver.judge(0, 0)
    for step in range(1, 9):
        receiver.judge(0, 2 * step)  # every other frame lost
        assert receiver.disorder[0] == min(step, e2e.DISORDER_LIMIT)
    for step in range(1, 9):
        receiver.judge(0, 16 + step)
        assert receiver.disorder[0] == max(e2e.DISORDER_LIMIT - step, 0)


def test_a_drive_that_counts_anew_is_followed_again_once_it_was_reported() -> None:
    receiver = Receivers(1)
    receiver.restart(0, 100)
    verdicts = []
    for counter in range(1, 9):
        verdicts.append(receiver.judge(0, counter).fresh)
        if verdicts[-1]:
            break
    assert verdicts == [False] * (e2e.DISORDER_LIMIT + 1) + [True]
    assert receiver.disorder[0] == e2e.DISORDER_LIMIT - 1


@given(st.lists(bytes8, max_size=60))
def test_a_frame_is_never_used_twice_in_a_row_whatever_comes(counters: list[int]) -> None:
    receiver, followed = Receivers(1), -1
    for counter in counters:
        if receiver.judge(0, counter).fresh:
            assert counter != followed
        if receiver.last[0] == counter:  # used, or taken up as the start of a drive that counts anew
            followed = counter
        assert 0 <= receiver.disorder[0] <= e2e.DISORDER_LIMIT


def test_every_counter_after_every_other_is_judged_by_the_shorter_way_round() -> None:
    for last in range(256):
        for ahead in range(256):
            found = sequence(last, (last + ahead) % 256)
            wanted = {0: (Check.REPEATED, 0), 1: (Check.OK, 0)}
            late = (Check.WRONGSEQUENCE, ahead - 1 if ahead < 128 else ahead - 256)
            assert found == wanted.get(ahead, late)
            assert found.fresh == (0 < ahead < 128)


def test_a_new_receiver_takes_any_first_counter() -> None:
    for counter in range(256):
        receiver = Receivers(2)
        assert receiver.judge(1, counter) == (Check.OK, 0)
        assert receiver.last.tolist() == [-1, counter]


def test_a_link_counts_as_disordered_at_five() -> None:
    receiver = Receivers(1)
    for counter in range(0, 100, 2):
        receiver.judge(0, counter)
    assert receiver.disorder[0] == e2e.DISORDER_LIMIT == 5


def test_the_status_bits_are_those_of_the_other_end() -> None:
    assert {bit.name: int(bit) for bit in e2e.Report} == {
        "WATCHDOG": codec.WATCHDOG,
        "CLAMPED": codec.CLAMPED,
        "SLEW": codec.SLEWED,
        "DERATED": codec.DERATED,
        "BRAKE": codec.BRAKE,
    }
    assert {bit.name: int(bit) for bit in e2e.Wanted} == {"TORQUE": codec.TORQUE_WANTED}
    assert (int(e2e.Report.NONE), int(e2e.Wanted.NONE)) == (0, 0)
    assert len(Check) == 5  # none is another's name

"""MAVLink 2 signing, rows 58 to 60: judged before anything parses, against two other implementations."""

import os
import stat

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pamoja import mavlink as pamoja

from rtctl.errors import ConfigError
from rtctl.hal.mavlink.keys import LEASE, Keys
from rtctl.hal.mavlink.message import dialect
from rtctl.protocol import signing
from rtctl.protocol.signing import NOTHING, State, Verdict
from rtctl.spec.base import read_key

KEY = bytes(range(32))
UNIX = 1_790_000_000 * 10**9  # [ns]
NOW = signing.timestamp(UNIX)
EXTRA = dialect.MAVLink_attitude_message.crc_extra


def attitude(system: int = 1) -> bytes:
    """Return an unsigned frame."""
    mav = dialect.MAVLink(None, srcSystem=system, srcComponent=1)
    return bytes(mav.attitude_encode(1000, 0.1, 0.2, 0.3, 0.0, 0.0, 0.1).pack(mav))


def signed(stamp: int = NOW, link: int = 0, key: bytes = KEY, system: int = 1) -> signing.Frame:
    raw, _ = signing.sign(attitude(system), key, link, State({}, stamp - 1), 0, EXTRA)
    return cut(raw)


def cut(raw: bytes) -> signing.Frame:
    frames, rest, junk = signing.split(raw)
    assert (len(frames), rest, junk) == (1, b"", 0)
    return frames[0]


def test_what_another_implementation_signs_is_good_and_the_other_way_round():
    stamp = pamoja.timestamp_from_unix_micros(UNIX // 1000)
    assert stamp == NOW
    header = pamoja.MavlinkHeader(sequence=3, system_id=1, component_id=1)
    frame = cut(pamoja.MavlinkSigner(KEY, 0, NOW).sign(header, 30, attitude()[10:-2], EXTRA).bytes)
    assert signing.verify(frame, KEY, NOTHING, NOW)[0] == Verdict.GOOD
    ours = pamoja.MavlinkFrame.parse_known(signed().raw)
    assert ours.signed
    pamoja.MavlinkVerifier(KEY).verify(ours)  # raises when it is not
    theirs = dialect.MAVLink(None)
    theirs.signing.secret_key, theirs.signing.allow_unsigned_callback = KEY, None
    assert theirs.parse_buffer(signed().raw)[0].get_type() == "ATTITUDE"


def test_the_checksum_is_that_of_another_implementation():
    for data in (b"", b"\x00", bytes(range(256))):
        assert signing.crc(data) == pamoja.mavlink_crc16_mcrf4xx(data)


def test_unsigned_version_1_and_unknown_flags_are_refused_under_a_key():
    assert signing.verify(cut(attitude()), KEY, NOTHING, NOW)[0] == Verdict.UNSIGNED
    old = b"\xfe\x02\x00\x01\x01\x00ab\x00\x00"
    assert signing.verify(cut(old), KEY, NOTHING, NOW)[0] == Verdict.OLD_PROTOCOL
    raw = bytearray(attitude())
    raw[2] = 0x02
    assert signing.verify(cut(bytes(raw)), KEY, NOTHING, NOW)[0] == Verdict.MALFORMED


def test_one_forged_frame_with_a_maximal_stamp_does_not_lock_the_genuine_stream_out():
    _, state = signing.verify(signed(NOW), KEY, NOTHING, NOW)
    forged = signed((1 << 48) - 1, key=bytes(32))
    verdict, after = signing.verify(forged, KEY, state, NOW)
    assert verdict == Verdict.FORGED
    assert after == state
    assert signing.verify(signed(NOW + 1), KEY, after, NOW)[0] == Verdict.GOOD


@given(st.integers(0, 59), st.integers(1, 255))
def test_any_changed_byte_is_a_forgery(at, by):
    raw = bytearray(signed().raw)
    at %= len(raw)
    raw[at] ^= by
    frames, _, _ = signing.split(bytes(raw))
    for frame in frames:
        assert signing.verify(frame, KEY, NOTHING, NOW)[0] != Verdict.GOOD


def test_a_replay_is_refused_also_after_a_restart_and_after_a_kill(tmp_path):
    path = tmp_path / "stamps"
    clock = iter(range(UNIX, UNIX + 10**12, 10**7))
    keys = Keys(KEY, path, unix_ns=lambda: next(clock))
    first, second = signed(NOW), signed(NOW + 5)
    assert [keys.judge(f) for f in (first, second, first, second)] == [Verdict.GOOD] * 2 + [Verdict.REPLAYED] * 2
    keys.keep()  # and then kill -9: what is on the disk is a lease
    again = Keys(KEY, path, unix_ns=lambda: next(clock))
    assert again.judge(first) == again.judge(second) == Verdict.REPLAYED
    assert again.judge(signed(NOW + 5 + LEASE)) == Verdict.REPLAYED  # could have been heard before the kill
    assert again.judge(signed(NOW + 6 + LEASE)) == Verdict.GOOD
    again.keep(last=True)
    assert Keys(KEY, path, unix_ns=lambda: next(clock)).judge(signed(NOW + 7 + LEASE)) == Verdict.GOOD
    assert stat.S_IMODE(os.stat(path).st_mode) == 0o600


def test_our_own_stamps_rise_over_a_restart_with_a_clock_that_went_back(tmp_path):
    first = Keys(KEY, tmp_path / "s", unix_ns=lambda: UNIX)
    sent = [cut(first.signed(attitude(), EXTRA)) for _ in range(3)]
    first.keep()
    second = Keys(KEY, tmp_path / "s", unix_ns=lambda: UNIX - 10**12)
    sent.append(cut(second.signed(attitude(), EXTRA)))
    stamps = [int.from_bytes(f.raw[-12:-6], "little") for f in sent]
    assert stamps == sorted(set(stamps))


def test_streams_are_told_apart_bounded_and_not_taken_when_a_minute_behind():
    state = NOTHING
    for link in range(signing.STREAMS):
        verdict, state = signing.verify(signed(link=link), KEY, state, NOW)
        assert verdict == Verdict.GOOD
    assert signing.verify(signed(link=99), KEY, state, NOW)[0] == Verdict.CROWDED
    minute = signing.NEW_STREAM
    assert signing.verify(signed(NOW - minute), KEY, NOTHING, NOW)[0] == Verdict.GOOD
    assert signing.verify(signed(NOW - minute - 1), KEY, NOTHING, NOW)[0] == Verdict.STALE


@given(st.lists(st.binary(max_size=60), max_size=6))
def test_no_bytes_make_it_raise_and_none_are_good(chunks):
    rest, state = b"", NOTHING
    for chunk in chunks:
        frames, rest, _ = signing.split(rest + chunk)
        for frame in frames:
            verdict, after = signing.verify(frame, KEY, state, NOW)
            assert verdict != Verdict.GOOD
            assert after is state


@given(
    st.lists(st.integers(1, 30), min_size=1, max_size=12), st.binary(max_size=5).filter(lambda b: not b.strip(b"\0"))
)
def test_frames_are_cut_alike_however_the_bytes_are_split(sizes, noise):
    data = noise + b"".join(signed(NOW + k).raw for k in range(3))
    rest, found, at = b"", [], 0
    for size in [*sizes, len(data)]:
        frames, rest, _ = signing.split(rest + data[at : at + size])
        found += [f.raw for f in frames]
        at += size
    assert found == [signed(NOW + k).raw for k in range(3)]


def test_a_key_file_is_for_its_owner_alone(tmp_path):
    path = tmp_path / "key"
    path.write_bytes(KEY)
    path.chmod(0o600)
    assert read_key(path, "f: link.key_file") == KEY
    path.write_text(KEY.hex() + "\n")
    assert read_key(path, "f: link.key_file") == KEY
    for mode in (0o640, 0o604, 0o700):
        path.chmod(mode)
        with pytest.raises(ConfigError, match=r"f: link.key_file: got .*mode 0\d+, wanted mode 0600"):
            read_key(path, "f: link.key_file")
    path.chmod(0o600)
    path.write_bytes(b"short")
    with pytest.raises(ConfigError, match="32 bytes"):
        read_key(path, "f: link.key_file")
    with pytest.raises(ConfigError, match="No such file"):
        read_key(tmp_path / "none", "f: link.key_file")


TOP = (1 << 48) - 1
GOOD_ROWS = [[0, 0, 0, 0], [255, 255, 255, TOP], [1, 190, 3, 17]]


@pytest.mark.parametrize("row", GOOD_ROWS)
@pytest.mark.parametrize("sent", [0, TOP])
def test_a_state_at_its_bounds_is_read_back_as_it_was(row, sent):
    state = State({(row[0], row[1], row[2]): row[3]}, sent)
    assert signing.from_text(signing.to_text(state)) == state


@pytest.mark.parametrize("at", range(4))
@pytest.mark.parametrize("high", [False, True])
def test_a_number_of_the_state_beyond_its_bound_is_refused(at, high):
    row = [1, 1, 1, 1]
    row[at] = (256, 256, 256, 1 << 48)[at] if high else -1
    with pytest.raises(ValueError, match="SYSTEM COMPONENT LINK TIMESTAMP"):
        signing.from_text("sent 1\n" + " ".join(map(str, row)) + "\n")


@pytest.mark.parametrize("text", [f"sent {1 << 48}\n", "sent -1\n"])
def test_our_own_stamp_beyond_48_bits_is_refused(text):
    with pytest.raises(ValueError, match="beyond 48 bits"):
        signing.from_text(text)


@pytest.mark.parametrize("text", ["", "send 1\n", "sent\n", "sent x\n", "sent 1\n1 1 1\n", "sent 1\n1 1 1 1 1\n", "\n"])
def test_what_is_no_state_is_refused(text):
    with pytest.raises(ValueError, match=r"got|invalid|unpack"):
        signing.from_text(text)


def test_as_many_streams_as_are_kept_are_read_and_not_one_more():
    rows = [f"1 1 {k} 5" for k in range(signing.STREAMS + 1)]
    assert len(signing.from_text("\n".join(["sent 1", *rows[:-1]])).streams) == signing.STREAMS
    with pytest.raises(ValueError, match="more streams"):
        signing.from_text("\n".join(["sent 1", *rows]))


# ---- framing, by the bytes of the published frame formats

#       magic len seq sys comp id payload crc
V1 = bytes((0xFE, 2, 11, 12, 13, 14, 0xA1, 0xA2, 0xC1, 0xC2))
#       magic len incompat compat seq sys comp id(3, little-endian) payload crc
V2 = bytes((0xFD, 3, 0, 22, 23, 24, 25, 1, 2, 3, 0xB1, 0xB2, 0xB3, 0xC3, 0xC4))


def test_the_fields_of_a_frame_are_where_the_protocol_puts_them():
    assert cut(V1) == (V1, 1, 0, 11, 12, 13, 14)
    assert cut(V2) == (V2, 2, 0, 23, 24, 25, 0x030201)
    longer = V2[:2] + b"\x01" + V2[3:] + bytes(13)
    assert cut(longer) == (longer, 2, 1, 23, 24, 25, 0x030201)
    assert cut(longer).signed
    assert not cut(V2).signed


@pytest.mark.parametrize("frame", [V1, V2, V2[:2] + b"\x01" + V2[3:] + bytes(13), bytes((0xFE, 0)) + bytes(6)])
def test_a_frame_is_cut_at_its_own_length_and_not_before(frame: bytes):
    for whole in range(len(frame)):
        assert signing.split(frame[:whole]) == ([], frame[:whole], 0)
    one = cut(frame)
    assert signing.split(frame + frame) == ([one, one], b"", 0)
    assert signing.split(b"\x00\x01\x02" + frame + b"\x03\x04" + frame[:1]) == ([one], frame[:1], 5)


def test_the_longest_frame_is_the_published_280_bytes():
    longest = bytes((0xFD, 255, 1)) + bytes(7 + 255 + 2 + 13)
    assert len(cut(longest).raw) == len(longest) == signing.LONGEST == 280


def test_only_an_unsigned_frame_of_version_2_is_signed():
    for raw in (V1, V2[:2] + b"\x01" + V2[3:]):
        with pytest.raises(ValueError, match="unsigned MAVLink 2"):
            signing.sign(raw, KEY, 0, NOTHING, NOW, EXTRA)
    raw, state = signing.sign(V2[:2] + b"\x02" + V2[3:], KEY, 7, NOTHING, NOW, EXTRA)
    assert (raw[2], raw[3], raw[-13]) == (3, 22, 7)  # what else was flagged stays
    assert state.sent == NOW


def test_a_stamp_counts_ten_microseconds_from_2015_and_is_never_below_zero():
    assert signing.timestamp(1_420_070_400 * 10**9) == 0
    assert signing.timestamp(1_420_070_400 * 10**9 + 25_000) == 2
    assert signing.timestamp(0) == 0
    assert signing.timestamp(1_420_070_401 * 10**9) == 100_000


def test_a_new_stream_may_be_a_minute_behind_and_not_more():
    assert signing.verify(signed(NOW - 6_000_000), KEY, NOTHING, NOW)[0] is Verdict.GOOD
    assert signing.verify(signed(NOW - 6_000_001), KEY, NOTHING, NOW)[0] is Verdict.STALE


def test_sixteen_streams_are_kept_and_a_known_one_still_counts():
    sixteen = {(200 + k, 1, 0): 1 for k in range(15)} | {(1, 1, 0): 1}
    assert signing.verify(signed(NOW), KEY, State(sixteen, 0), NOW)[0] is Verdict.GOOD
    assert signing.verify(signed(NOW, system=9), KEY, State(sixteen, 0), NOW)[0] is Verdict.CROWDED
    del sixteen[200, 1, 0]
    assert signing.verify(signed(NOW, system=9), KEY, State(sixteen, 0), NOW)[0] is Verdict.GOOD


def test_verdicts_are_nine_and_nothing_was_sent_or_heard_at_first():
    assert len(Verdict) == 9
    assert State({}, 0) == NOTHING

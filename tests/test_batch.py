"""A whole cycle in one pass is what the codecs say frame by frame, and anything less than whole is not taken."""

import functools
import operator
import random

import numpy as np
import pytest

from rtctl.protocol import batch, e2e, frame, mit
from rtctl.protocol.mounting import Wiring
from rtctl.types import Frames

N = 7
IDS = tuple(range(1, N + 1))
SCALES = (*(mit.DRIVES["DM8009"],) * 3, *(mit.DRIVES["DM4340"],) * 2, *(mit.DRIVES["DM4310"],) * 2)
DRIVES = [Wiring(i, i + mit.REPLY_OFFSET, scale) for i, scale in zip(IDS, SCALES, strict=True)]
KINDS = [(False, False), (False, True), (True, True)]  # protected, CAN FD


def replies(rng: random.Random, protected: bool, fd: bool, counters: list[int]) -> list[bytes]:
    """Random but well-formed replies, a frame for each joint."""
    out = []
    for j, can_id in enumerate(IDS):
        data = bytes((rng.randrange(16) << 4 | can_id, *rng.randbytes(7)))
        if protected:
            data = e2e.protect(data, counters[j], rng.randrange(32), can_id + mit.REPLY_OFFSET)
        out.append(frame.pack(can_id + mit.REPLY_OFFSET, data, fd, fd))
    return out


def receivers_at(last: list[int]) -> e2e.Receivers:
    """Streams of which these counters came last."""
    receivers = e2e.Receivers(len(last))
    receivers.last[:] = last
    return receivers


def decoded(cycle: batch.Cycle, raw: list[bytes], receivers: e2e.Receivers) -> batch.Replies | None:
    """What the batch codec makes of frames, if they have one size."""
    frames = Frames.of(raw)
    return None if frames is None else batch.decode(cycle, frames, receivers, 0.25)


@pytest.mark.parametrize(("protected", "fd"), KINDS)
def test_replies_in_any_order_mean_what_the_codec_of_one_says(protected: bool, fd: bool) -> None:
    rng = random.Random(1)
    cycle = batch.cycle_of(protected, fd, DRIVES)
    for _ in range(200):
        last = [rng.randrange(256) for _ in IDS]
        raw = replies(rng, protected, fd, [(each + 1) & 0xFF for each in last])
        data = [frame.unpack(each).data for each in raw]
        wanted = [mit.decode_reply(each[:8], scale) for each, scale in zip(data, SCALES, strict=True)]
        rng.shuffle(raw)
        receivers = receivers_at(last)
        got = decoded(cycle, raw, receivers)
        assert got is not None
        assert got.state[3].tolist() == [0.25] * N
        assert got.codes[5].tolist() == [1] * N
        for j, one in enumerate(wanted):
            assert one is not None
            assert tuple(got.state[:3, j]) == (one.p, one.v, one.t)
            assert tuple(got.codes[:3, j]) == (one.err, one.t_mos, one.t_rotor)
            if protected:
                assert tuple(got.codes[3:5, j]) == (data[j][8], data[j][9])
                assert receivers.last[j] == data[j][8]
        assert got.report == (functools.reduce(operator.or_, [each[9] for each in data]) if protected else 0)


@pytest.mark.parametrize(("protected", "fd"), KINDS)
def test_commands_are_the_bytes_of_the_codec_of_one(protected: bool, fd: bool) -> None:
    rng = np.random.default_rng(2)
    cycle = batch.cycle_of(protected, fd, DRIVES)
    counters = np.arange(250, 250 + N)
    cases = [rng.normal(size=N) * 30.0 for _ in range(200)]
    cases += [np.zeros(N), np.full(N, 1e300), np.full(N, np.nan), np.full(N, -np.inf), np.full(N, -0.0)]
    for tau in cases:
        before = counters.copy()
        for j, raw in enumerate(batch.encode(cycle, tau, counters)):
            data = mit.encode_torque(float(tau[j]), SCALES[j].t_max)
            if protected:
                assert counters[j] == (before[j] + 1) % 256
                data = e2e.protect(data, int(counters[j]), e2e.Wanted.TORQUE, IDS[j])
            assert raw == frame.pack(IDS[j], data, fd, fd)


def test_what_is_not_whole_is_not_taken() -> None:
    rng = random.Random(3)
    cycle = batch.cycle_of(True, True, DRIVES)
    last = [0] * N

    def taken(raw: list[bytes]) -> bool:
        receivers = receivers_at(last)
        got = decoded(cycle, raw, receivers)
        assert got is not None or receivers.last.tolist() == last  # all or nothing
        return got is not None

    whole = replies(rng, True, True, [1] * N)
    assert taken(whole)
    assert not taken(whole[:-1])  # silence
    assert not taken([*whole, whole[0]])
    assert not taken([*whole[:-1], whole[0]])  # one twice, one missing
    assert not taken([*whole[:-1], whole[-1][:16]])  # another kind of frame
    assert not taken(replies(rng, True, True, [1] * (N - 1) + [2]))  # a frame is missing before it
    assert not taken(replies(rng, True, True, [0] * N))  # repeated
    stranger = frame.pack(IDS[0], bytes(12), True, True)
    assert not taken([*whole[:-1], stranger])
    for bit in range(8 * e2e.LENGTH):
        raw = bytearray(whole[3])
        raw[8 + bit // 8] ^= 1 << bit % 8
        assert not taken([*whole[:3], bytes(raw), *whole[4:]])

"""Bytes that others choose: what once was a failure, and some at random (`python -m tools.fuzz` for as many as wanted).

What every taker of bytes promises stands beside it in tools/fuzz/targets.py.
"""

import pytest

from rtctl.protocol import mit
from tools.fuzz.__main__ import failure, kept, run, shorter
from tools.fuzz.targets import TARGETS, Target

CASES = {"file": 20, "log": 20}  # of the slow ones


@pytest.mark.parametrize("name", TARGETS)
def test_every_taker_of_bytes_keeps_its_promises(name: str):
    limit = CASES.get(name, 200)
    count, data, said = run(TARGETS[name], lambda cases: cases < limit, seed=0)
    assert said == "", data.hex()
    assert count >= limit


def test_what_was_a_failure_is_kept_and_played():
    for name in TARGETS:
        for path in kept(name):
            assert failure(TARGETS[name], path.read_bytes()) == "", path


def test_a_failure_is_found_and_made_short():
    def take(data: bytes) -> None:
        assert mit.decode_reply(data, mit.DRIVES["DM8009"]) is None or data[0] != 0x13

    bad = Target("bad", lambda: [bytes.fromhex("1280008008007f1e")], take)
    count, data, said = run(bad, lambda cases: cases < 20_000, seed=1)
    assert "AssertionError" in said
    assert count < 20_000
    assert shorter(bad, data + b"") == data[:8] == data

    long = Target("long", list, lambda data: None if b"\xfd" not in data else 1 / 0)  # type: ignore[arg-type,return-value]
    assert shorter(long, bytes(50) + b"\xfd" + bytes(70)) == b"\xfd"

"""What takes bytes from outside: each with seeds, and what it promises of any bytes."""

import mmap
import random
import tempfile
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from firmware_sim import codec, drive
from rtctl.errors import ConfigError, LinkError, LogError, RequestError
from rtctl.hal import messages
from rtctl.log.record import ring
from rtctl.protocol import batch, e2e, frame, mit, signing
from rtctl.protocol.mounting import Wiring
from rtctl.spec import base, robot
from rtctl.spec import read as spec
from rtctl.spec.scenario import Scenario
from rtctl.types import Frames
from tools import damage

ROOT = Path(__file__).resolve().parents[2]
SCALE = mit.DRIVES["DM8009"]
KEY = bytes(range(32))
BOUNDS = messages.Bounds((0.0, 0.0, 0.3), 1.2, 0.003, 0.015)
PERIOD_NS = 1_000_000
LARGEST_TORQUE = 40.0  # [Nm] of the drive here


class Target(NamedTuple):
    """One taker of bytes."""

    name: str
    seeds: Callable[[], Sequence[bytes]]  # what it takes gladly
    take: Callable[[bytes], None]  # raises AssertionError or anything else where a promise is not kept
    head: int = 0  # bytes of a seed that are damaged, the others are kept; 0: all


@cache
def folder() -> Path:
    """Return a folder of this process's own."""
    kept = tempfile.TemporaryDirectory(prefix="rtctl-fuzz-")
    _KEPT.append(kept)
    return Path(kept.name)


_KEPT: list[tempfile.TemporaryDirectory[str]] = []


def _file(data: bytes, name: str) -> Path:
    path = folder() / name
    path.write_bytes(data)
    path.chmod(0o600)
    return path


# ---- the bus


def take_reply(data: bytes) -> None:
    """A reply of any bytes is a finite one within its fields, or none."""
    found = mit.decode_reply(data, SCALE)
    assert (found is not None) == (len(data) == 8)
    assert found is None or all(abs(x) <= bound for x, bound in zip(found[2:5], SCALE, strict=True))
    register = mit.decode_register(data)
    assert register is None or len(register.value) == 4


def take_protected(data: bytes) -> None:
    """Only what carries its own CRC is intact, and both ends judge it alike."""
    assert e2e.intact(data, 3) == (len(data) == 12 and codec.intact(data, 3))
    receivers = e2e.Receivers(1)
    before = -1
    for counter in data:
        fresh = receivers.judge(0, counter).fresh
        assert not fresh or counter != before
        before = int(receivers.last[0])


@cache
def _cycle() -> batch.Cycle:
    return batch.cycle_of(True, True, [Wiring(i, i + mit.REPLY_OFFSET, SCALE) for i in (1, 2)])


def take_cycle(data: bytes) -> None:
    """A cycle of frames is taken whole or not at all, and what is taken is finite."""
    receivers = e2e.Receivers(2)
    found = batch.decode(_cycle(), Frames(data, frame.CANFD_MTU), receivers, 0.25)
    if found is None:
        assert receivers.last.tolist() == [-1, -1]
    else:
        assert np.isfinite(found.state).all()


def _cycles() -> list[bytes]:
    data = [e2e.protect(bytes((0x10 | i, 0x80, 0, 0x80, 8, 0, 30, 30)), 1, 0, i + 16) for i in (1, 2)]
    return [b"".join(frame.pack(i + 16, one, True, True) for i, one in zip((1, 2), data, strict=True))]


def take_commands(data: bytes) -> None:
    """A drive whose bus carries any bytes keeps torque, slew and its silence: frames of 12 bytes, a length before."""
    rating = drive.Rating(3, codec.Scale(12.5, 45.0, 54.0), LARGEST_TORQUE, 1000.0, 16.0, PERIOD_NS, 400, 4, True)
    one, torques, at = drive.Drive(rating), [0.0], 0
    while at < len(data) and len(torques) < 200:
        length, kind = data[at] & 0x0F, data[at] >> 4
        raw = data[at + 1 : at + 1 + length]
        at += 1 + length
        if kind & 1:
            one.register(raw)
        else:
            one.receive(raw)
        one.sense(0.1, 0.2)
        torques.append(one.actuate(PERIOD_NS).torque)
    assert all(abs(t) <= LARGEST_TORQUE for t in torques)
    rise = 1000.0 * PERIOD_NS * 1e-9 * 2.0 + 1e-9  # two periods' worth may be saved up
    assert all(abs(b) <= abs(a) + rise for a, b in pairwise(torques))


def _commands() -> list[bytes]:
    enable = codec.protect(b"\xff" * 7 + b"\xfc", 1, 1, 3)
    torque = codec.protect(bytes.fromhex("8000800000000fff"), 2, 1, 3)
    write = codec.protect(codec.encode_register(3, codec.WRITE, codec.TIMEOUT, bytes(4)), 0, 0, codec.REGISTER_ID)
    return [b"".join(bytes((12,)) + one for one in (enable, torque, torque)), bytes((0x1C,)) + write]


def take_mavlink(data: bytes) -> None:
    """Every byte ends up in a frame, in what waits or in what is junk; what nobody signed is never good."""
    frames, rest, junk = signing.split(data)
    assert sum(len(one.raw) for one in frames) + len(rest) + junk == len(data)
    state = signing.NOTHING
    for one in frames:
        verdict, state = signing.verify(one, KEY, state, 0)
        good = verdict is signing.Verdict.GOOD
        assert not good or one.raw[-6:] == signing.digest(KEY, one.raw[:-6])
    with suppress(ValueError):
        kept = signing.from_text(data.decode(errors="replace"))
        assert signing.from_text(signing.to_text(kept)) == kept


def _mavlink() -> list[bytes]:
    plain = bytes((0xFD, 3, 0, 0, 7, 1, 1, 0, 0, 0, 1, 2, 3, 0, 0))
    first, state = signing.sign(plain, KEY, 1, signing.NOTHING, 5, 50)
    second, _ = signing.sign(plain, KEY, 1, state, 6, 50)
    return [first + second, plain, signing.to_text(signing.State({(1, 2, 3): 4}, 5)).encode()]


# ---- people


def take_message(data: bytes) -> None:
    """A message is understood and becomes a request, or is refused as one."""
    with suppress(RequestError):
        message = messages.decode(data)
        messages.request_of(message, BOUNDS, lambda: (1.0, 0.0, 0.0, 0.0), 100.0)


def _messages() -> list[bytes]:
    sphere = b'{"verb":"obstacle","set":{"name":"a","type":"sphere","radius_m":0.1,"position_m":[0.4,0,0.3]}}'
    goal = b'{"verb":"goal","position_m":[0.4,0.1,0.4],"tolerance_m":0.01,"by_s":200.0}'
    cloud = messages.cloud_message(
        {"set": {"name": "c", "type": "cloud", "radius_m": 0.01}, "step_m": 0.001}, bytes(12)
    )
    return [b'{"verb":"arm"}', goal, sphere, cloud]


def take_file(data: bytes) -> None:
    """A file is read or refused with its name and place: as an arm, a base and a scenario."""
    path = _file(data, "any.toml")
    for kind in (robot.Config, base.BaseConfig, Scenario):
        said = ""
        try:
            spec.read(path, kind)
        except ConfigError as error:
            said = str(error)
        assert not said or "any.toml" in said


def _files() -> list[bytes]:
    names = ("planar4.toml", "rover.toml", "scenarios/openarm_e2e.toml")
    return [(ROOT / "configs" / name).read_bytes() for name in names]


# ---- this machine


def take_ring(data: bytes) -> None:
    """A ring file of any bytes is refused, or read without an end: entries that lie in it, or an error of the log."""
    path = _file(data, "any.ring")
    try:
        consumer = ring.attach(path)
    except (LinkError, OSError):
        return
    try:
        for _ in range(3):
            consumer.take(1 << 16)
    except (LinkError, LogError):
        pass
    finally:
        consumer.unmap()


def _rings() -> list[bytes]:
    producer = ring.create("fuzz", 1 << 16, b"blob", [folder()])
    for k in range(20):
        producer.put(1, bytes(40 + k), 1000 * k)
    with producer.path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as view:
        raw = bytes(view)
    producer.unmap()
    producer.path.unlink()
    return [raw]


def take_log(data: bytes) -> None:
    """A log of any bytes is read, mended or refused as a log is."""
    place = folder() / "log"
    place.mkdir(exist_ok=True)
    out = place / "out"
    out.mkdir(exist_ok=True)
    path = place / "damaged.mcap"
    path.write_bytes(data)
    try:
        damage.look(path, out)
    finally:
        for left in [*out.iterdir(), *place.glob("damaged.mcap*")]:
            left.unlink()


def _logs() -> list[bytes]:
    return damage.healthy(folder())


TARGETS = {
    target.name: target
    for target in (
        Target("reply", lambda: [bytes.fromhex("1380008008007f1e"), bytes.fromhex("0300330a00000000")], take_reply),
        Target("protected", lambda: [codec.protect(bytes(8), 1, 1, 3), bytes((1, 2, 3, 9, 4, 4, 5))], take_protected),
        Target("cycle", _cycles, take_cycle),
        Target("commands", _commands, take_commands),
        Target("mavlink", _mavlink, take_mavlink),
        Target("message", _messages, take_message),
        Target("file", _files, take_file),
        Target("ring", _rings, take_ring, 8192),
        Target("log", _logs, take_log),
    )
}


def made(target: Target, seeds: Sequence[bytes], rng: random.Random) -> bytes:
    """Return bytes: a seed that was damaged, two that were joined, or any."""
    kind, one = rng.randrange(10), rng.choice(seeds)
    if kind == 0:
        return rng.randbytes(rng.randrange(80))
    if kind == 1:
        other = rng.choice(seeds)
        return one[: rng.randrange(len(one) + 1)] + other[rng.randrange(len(other) + 1) :]
    if target.head and kind < 9:
        data = bytearray(one)
        for _ in range(rng.randint(1, damage.FLIPS)):
            at, width = rng.randrange(min(target.head, len(data))), rng.choice((1, 4, 8))
            data[at : at + width] = rng.choice((rng.randbytes(width), bytes(width), b"\xff" * width))
        return bytes(data)
    return damage.damaged(one, rng)

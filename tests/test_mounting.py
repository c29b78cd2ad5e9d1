"""Joints as mounted: drives the other way round, from another zero, whole turns off; above the wire nobody notices."""

import random
from pathlib import Path

import numpy as np
import pytest

from firmware_sim import codec
from rtctl import design as cfg
from rtctl.app.arm_link import link_spec
from rtctl.app.sim import simulate
from rtctl.errors import ConfigError, HandshakeError
from rtctl.hal.can.handshake import Greeting, handshake
from rtctl.hal.can.link import CanLink, LinkSpec
from rtctl.hal.can.transport import InProcess
from rtctl.protocol import batch, e2e, frame, mit
from rtctl.protocol.mounting import Mounting, Wiring
from rtctl.types import Command, Drive, Frames, Hold
from tests.fake_drives import FakeDrives, spec_of

ROOT = Path(__file__).resolve().parent.parent
N = 3
TURN = 6.283185307179586
MOUNTINGS = (Mounting(-1, 0.4), Mounting(1, -1.2, 1), Mounting(-1, 0.0, -1))
SCALE = mit.Scale(12.5, 45.0, 54.0)
STEP = (25.0 / 65535.0, 90.0 / 4095.0, 108.0 / 4095.0)


def as_mounted(spec: LinkSpec, mountings: tuple[Mounting, ...], **keys: object) -> LinkSpec:
    rows = zip(spec.joints, mountings, strict=True)
    return spec._replace(joints=tuple(joint._replace(mounting=m, **keys) for joint, m in rows))  # type: ignore[arg-type]


def reading(q: float, m: Mounting) -> int:
    """Return the code of what a drive reads where its joint is at q [rad]."""
    p = m.direction * q + m.zero + TURN * m.turns
    return round((p + 12.5) / STEP[0])


# ---- the codec


@pytest.mark.parametrize("protected", [False, True])
def test_what_the_drives_loops_are_asked_for_is_in_their_own_coordinates(protected: bool) -> None:
    spec = as_mounted(spec_of(N, "mit+e2e" if protected else "mit"), MOUNTINGS)
    link = CanLink(spec, InProcess(lambda frames: []))
    link.turn(tuple(m.turns for m in MOUNTINGS))
    q, qd, tau = np.array([0.5, -1.0, 2.0]), np.array([1.0, -2.0, 0.5]), np.array([3.0, -7.0, 0.0])
    kp, kd = np.array([0.0, 120.0, 500.0]), np.array([5.0, 0.0, 1.25])
    hold = Hold(q, qd, kp, kd, np.array([False, False, True]))
    sent = [frame.unpack(raw) for raw in link.write(Command(Drive.HOLD, tau, hold))]
    assert [f.can_id for f in sent] == [j + 1 for j in range(N)]
    for j, m in enumerate(MOUNTINGS[:2]):  # read by the virtual drives' own codec
        got = codec.decode_command(sent[j].data[:8], codec.Scale(*spec.joints[j].scale))
        wanted = m.direction * q[j] + m.zero + TURN * m.turns, m.direction * qd[j], kp[j], kd[j], m.direction * tau[j]
        steps = (STEP[0], STEP[1], 500.0 / 4095.0, 5.0 / 4095.0, STEP[2])
        assert all(abs(a - b) <= 0.5001 * s for a, b, s in zip(got[1:], wanted, steps, strict=True))
        assert not protected or (codec.intact(sent[j].data, j + 1) and sent[j].data[9] & codec.TORQUE_WANTED)
    assert codec.decode_command(sent[2].data[:8], codec.Scale(*SCALE)).special == codec.DISABLE


@pytest.mark.parametrize("protected", [False, True])
def test_replies_are_in_joint_coordinates_and_both_codecs_agree_to_the_bit(protected: bool) -> None:
    rng = random.Random(1)
    spec = as_mounted(spec_of(N, "mit+e2e" if protected else "mit"), MOUNTINGS)
    link = CanLink(spec, InProcess(lambda frames: []))
    link.turn(tuple(m.turns for m in MOUNTINGS))
    for count in range(1, 200):
        codes = [(rng.randrange(1 << 16), rng.randrange(1 << 12), rng.randrange(1 << 12)) for _ in range(N)]
        raw = []
        for j, (p, v, t) in enumerate(codes):
            data = ((1 << 4 | j + 1) << 56 | p << 40 | v << 28 | t << 16 | 0x2021).to_bytes(8, "big")
            if protected:
                data = e2e.protect(data, count & 0xFF, 0, j + 0x11)
            raw.append(frame.pack(j + 0x11, data, protected, protected))
        frames = Frames.of(raw)
        assert frames is not None
        receivers = e2e.Receivers(N)
        receivers.last[:] = count - 1 & 0xFF
        got = batch.decode(link._cycle, frames, receivers, 0.0)
        assert got is not None
        for j, ((p, v, t), m) in enumerate(zip(codes, MOUNTINGS, strict=True)):
            wanted = (
                m.direction * (p * STEP[0] - 12.5 - m.zero - TURN * m.turns),
                m.direction * (v * STEP[1] - 45.0),
                m.direction * (t * STEP[2] - 54.0),
            )
            np.testing.assert_allclose(got.state[:3, j], wanted, rtol=0.0, atol=1e-12)
            one = link.decode(j, raw[j][8:16])
            assert one is not None
            assert tuple(got.state[:3, j]) == (one.p, one.v, one.t)


def test_a_torque_goes_to_the_drive_as_it_turns_and_comes_back_as_the_joint_turns() -> None:
    drives = [Wiring(j + 1, j + 0x11, SCALE, m) for j, m in enumerate(MOUNTINGS)]
    cycle = batch.cycle_of(False, False, drives)
    for tau in ([5.0, -7.0, 11.0], [0.0, 0.0, 0.0], [-60.0, 60.0, np.nan]):
        raw = batch.encode(cycle, np.array(tau), np.zeros(N, np.int64))
        for one, each, m in zip(raw, tau, MOUNTINGS, strict=True):
            assert one[8:16] == mit.encode_torque(m.direction * each, 54.0)


def test_replies_come_under_the_identifier_that_the_file_says() -> None:
    spec = spec_of(N, "mit+e2e")
    spec = spec._replace(joints=(spec.joints[0]._replace(can_id=0x7F, reply=0x55), *spec.joints[1:]))
    drives = FakeDrives(spec)
    link = CanLink(spec, InProcess(drives.exchange))
    handshake(link, listen=0.0)
    feedback = link.read(1, 0, 0.0, 0.0)
    assert feedback.replies.tolist() == [1] * N


# ---- the handshake


def greeted(q: float, actual: Mounting, wraps: bool = True, limits: tuple[float, float] = (-3.0, 3.0)) -> Greeting:
    """Return the greeting of drives of which the second is mounted so and stands at q [rad]."""
    spec = spec_of(N, "mit")
    joint = spec.joints[1]._replace(mounting=actual._replace(turns=0), wraps=wraps, q_min=limits[0], q_max=limits[1])
    spec = spec._replace(joints=(spec.joints[0], joint, spec.joints[2]))
    drives = FakeDrives(spec)
    drives.codes[1] = (reading(q, actual), 0x800, 0x800)
    link = CanLink(spec, InProcess(drives.exchange))
    greeting = handshake(link, listen=0.0, timeout=0.01, recover=True)
    assert link.turns == (0, actual.turns if wraps else 0, 0)
    feedback = link.read(1, 0, 0.0, 0.0)
    assert feedback.q.tolist() == greeting.q.tolist()
    return greeting


@pytest.mark.parametrize("actual", [Mounting(), Mounting(1, 0.4, 1), Mounting(-1, 0.4, 1), Mounting(-1, -0.4, -1)])
@pytest.mark.parametrize("q", [-2.9, 0.0, 1.7])
def test_an_encoder_that_came_back_turns_off_is_resolved_and_told(q: float, actual: Mounting) -> None:
    greeting = greeted(q, actual)
    assert greeting.q[1] == pytest.approx(q, abs=STEP[0])
    assert len(greeting.told) == abs(actual.turns)
    if actual.turns:
        assert f"joint2: its encoder came back {actual.turns:+d} turn off" in greeting.told[0]
        assert f"taken as {greeting.q[1]:.4f} rad" in greeting.told[0]


def test_a_joint_a_little_outside_its_limits_is_still_known_by_its_turn() -> None:
    assert greeted(1.2, Mounting(1, 0.0, 1), limits=(-1.0, 1.0)).q[1] == pytest.approx(1.2, abs=STEP[0])


def test_a_reading_that_could_be_two_angles_is_refused_with_both() -> None:
    with pytest.raises(HandshakeError, match=r"joint2 \(id 2\): position") as caught:
        greeted(-3.3, Mounting(), limits=(-4.0, 4.0))
    assert "a reading of -3.3000 rad, which is 2.9832 or -3.3000 rad" in str(caught.value.got)
    assert caught.value.wanted.startswith("one angle within -4 to 4 rad")


def test_a_reading_that_can_be_no_angle_is_refused_with_the_nearest() -> None:
    with pytest.raises(HandshakeError) as caught:
        greeted(2.0, Mounting(), limits=(-1.0, 1.0))
    assert "which is 1.9999 or -4.2833 rad" in str(caught.value.got)


def test_an_encoder_that_would_saturate_within_the_limits_is_refused() -> None:
    with pytest.raises(HandshakeError, match=r"at a joint limit would read 13\.2832 rad.*PMAX = 12\.5"):
        greeted(-2.0, Mounting(1, 4.0, 1))


def test_a_whole_turn_is_hinted_at_where_none_is_expected() -> None:
    (told,) = greeted(TURN + 0.5, Mounting(), wraps=False).told
    assert told.endswith("0.5000 rad, a whole turn away, is: wrap = true")


# ---- the whole arm


def other_way_round(folder: Path, keys: bool) -> Path:
    """Write planar4 with drives that turn the other way round, off zero and one of them a turn off; return its file."""
    text = (ROOT / "configs" / "planar4.toml").read_text().replace('"planar4.urdf"', f'"{ROOT}/configs/planar4.urdf"')
    if keys:
        for j, more in enumerate(("direction = -1", "zero_rad = 0.7", "direction = -1, zero_rad = -2.0, wrap = true")):
            text = text.replace(f"can_id = {j + 1},", f"can_id = {j + 1}, {more},")
        text = text.replace("can_id = 4,", "can_id = 0x44, reply_id = 0x24,")
    path = folder / "planar4.toml"
    path.write_text(text)
    return path


def test_an_arm_moves_the_same_however_its_drives_are_mounted(tmp_path: Path) -> None:
    play = "duration_s = 2.5\n[[goal]]\nat_s = 0.5\nposition_m = [1.35, 0.65, 0.0]\n"
    turned = "[plant]\nencoder_zero_rad = [0.0, 0.7, 4.283185307179586, 0.0]\n"
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    figures = []
    for name, plant in (("a", ""), ("b", turned)):
        other_way_round(tmp_path / name, name == "b")
        (tmp_path / name / "s.toml").write_text(f'robot = "planar4.toml"\n{play}{plant}')
        figures.append(simulate(tmp_path / name / "s.toml"))
    straight, other = figures
    assert other["arrived"]
    assert other["faults"] == []
    assert other["time_to_goal_s"] == pytest.approx(straight["time_to_goal_s"], abs=0.02)
    assert other["path_length_m"] == pytest.approx(straight["path_length_m"], abs=0.002)


def test_without_the_keys_such_drives_are_no_arm(tmp_path: Path) -> None:
    other_way_round(tmp_path, False)
    (tmp_path / "s.toml").write_text(
        'robot = "planar4.toml"\nduration_s = 1.5\n[[goal]]\nat_s = 0.3\nposition_m = [1.35, 0.65, 0.0]\n'
        "[plant]\nencoder_direction = [-1, 1, 1, 1]\n"
    )
    assert not simulate(tmp_path / "s.toml")["arrived"]


# ---- the file


@pytest.mark.parametrize(
    ("old", "new", "place"),
    [
        ("can_id = 2,", "can_id = 2, reply_id = 0x11,", r"robot\.joints\[1\]\.reply_id: got 17"),
        ("can_id = 2,", "can_id = 2, reply_id = 3,", r"robot\.joints\[1\]\.reply_id: got 3, .* joint_3"),
        ("can_id = 2,", "can_id = 0x11,", r"robot\.joints\[0\]\.reply_id: got 17, .* joint_2"),
        ("can_id = 2,", "can_id = 0x80,", r"robot\.joints\[1\]\.can_id: got 128"),
        ("can_id = 2,", "can_id = 2, direction = 0,", r"robot\.joints\[1\]\.direction: got 0, wanted one of -1, 1"),
        ("can_id = 2,", "can_id = 2, zero_rad = 10.5,", r"q_max_rad: got 2\.6, .*the drive reads 13\.1 there"),
        ("can_id = 2,", "can_id = 2, zero_rad = 10.5, direction = -1,", r"q_min_rad: got -2\.6, .*reads 13\.1 there"),
    ],
)
def test_what_cannot_be_is_refused_by_name(tmp_path: Path, old: str, new: str, place: str) -> None:
    path = other_way_round(tmp_path, False)
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(ConfigError, match=place):
        cfg.load(path)


def test_the_link_is_told_what_the_file_says(tmp_path: Path) -> None:
    joints = link_spec(cfg.load(other_way_round(tmp_path, True))).joints
    assert [j.mounting[:2] for j in joints] == [(-1, 0.0), (1, 0.7), (-1, -2.0), (1, 0.0)]
    assert [j.wraps for j in joints] == [False, False, True, False]
    assert [(j.can_id, j.reply_id) for j in joints] == [(1, 0x11), (2, 0x12), (3, 0x13), (0x44, 0x24)]

"""`rtctl log ...`: replay to the bit, differences named, other programs' readers agree, no file gives a traceback."""

import contextlib
import csv
import io
import json
import re
import runpy
import shutil
import time
from pathlib import Path
from typing import Any

import can
import cantools
import numpy as np
import pyarrow.parquet as pq
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_protobuf.decoder import DecoderFactory as ProtobufDecoder
from mcap_ros2.decoder import DecoderFactory as Ros2Decoder
from rosbags.typesys import Stores, get_typestore

from rtctl import design as cfg
from rtctl.app import arm as arm_vehicle
from rtctl.app import arm_log, compare
from rtctl.app.arm_log import rebuilt
from rtctl.app.replay import replay
from rtctl.app.sim import simulate
from rtctl.arm.record import record_dtype
from rtctl.cli import main
from rtctl.errors import LogError
from rtctl.log import Kind, McapSink, make_header, read
from rtctl.log.mcap.segment import begin
from rtctl.log.read.fields import FIELDS
from rtctl.log.read.info import info
from rtctl.log.read.run import read_run
from rtctl.log.record import meshes
from rtctl.rover.record import base_dtype
from tests.arms import panda
from tests.lab import PANDA, ROOT, recorded, robot
from tools import crash, golden

SCENE = f"""
robot = "{PANDA}"
duration_s = 1.0
[[goal]]
at_s = 0.3
position_m = [0.45, 0.15, 0.50]
hold = "orientation"
[[obstacle]]
name = "ball"
type = "sphere"
radius_m = 0.05
position_m = [0.55, 0.4, 0.5]
velocity_m_s = [0.0, -0.1, 0.0]
"""


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of `rtctl sim` with everything in it."""
    folder = tmp_path_factory.mktemp("log")
    (folder / "digest").write_text(recorded(folder, SCENE)["digest"])
    return folder / "run.mcap"


def call(*arguments: str) -> tuple[int, str, str]:
    """Return exit code, stdout and stderr of a command."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main(["log", *arguments])
    return code, out.getvalue(), err.getvalue()


def answer(*arguments: str) -> Any:
    code, out, err = call(*arguments, "--json")
    assert code == 0, err
    return json.loads(out)


# ---- replay


def test_a_log_replays_to_the_bit_and_to_the_digest_of_its_run(log: Path):
    found = answer("replay", str(log))
    assert found["identical"]
    assert found["digest"] == (log.parent / "digest").read_text()
    assert found["frames"] == 7 * found["ticks"]


def test_a_log_alone_is_enough_without_the_packages_of_its_meshes(log: Path, monkeypatch: pytest.MonkeyPatch):
    shutil.copy(log, log.with_name("alone.mcap"))
    monkeypatch.setattr("rtctl.spec.urdf.share_folders", list)
    _, arm = rebuilt(read_run(log.with_name("alone.mcap")))
    assert arm.points.local.tobytes() == robot().points.local.tobytes()
    assert arm.constants.tobytes() == robot().constants.tobytes()


@pytest.mark.parametrize("name", golden.scenarios())
def test_the_control_law_has_not_changed_a_bit(name: str):
    verdict = golden.check(name)
    assert verdict.good, verdict.text


def test_a_changed_bit_is_reported_as_tick_joint_field_and_size(log: Path, monkeypatch: pytest.MonkeyPatch):
    def nudged(arm: Any, memory: Any, feedback: Any, request: Any) -> Any:
        memory, command, record = law_tick(arm, memory, feedback, request)
        if memory.tick == 700:
            record = record.copy()
            record["tau_wanted"][0, 3] = np.nextafter(record["tau_wanted"][0, 3], np.inf)
        return memory, command, record

    law_tick = arm_vehicle.tick
    monkeypatch.setattr(arm_vehicle, "tick", nudged)
    monkeypatch.setattr(arm_log, "rebuilt", lambda run: (cfg.load(PANDA), robot()))
    done = replay(read_run(log))
    assert done.divergence is not None
    assert (done.divergence.tick, done.divergence.joint, done.divergence.field) == (700, "panda_joint4", "tau_wanted")
    assert "(+1 ulp)" in done.divergence.size
    assert [d.field for d in done.differences] == ["tau_wanted"]
    assert done.divergence.time == pytest.approx(0.7)
    code, out, _ = call("replay", str(log))
    assert code == 1
    assert "first divergence: tick 700 (0.700 s), panda_joint4, tau_wanted" in out


def test_a_changed_command_byte_is_found_on_the_wire(log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(arm_log, "rebuilt", lambda run: (cfg.load(PANDA), robot()))
    run = read_run(log)
    original = compare._sent_frames

    def flipped(of: Any, span: Any) -> Any:
        for stamps, array in original(of, span):
            array = array.copy()
            row = np.flatnonzero((stamps == 400_000_000) & (array["id"] == 5))
            array["data"][row, 7] ^= 1
            yield stamps, array

    monkeypatch.setattr(compare, "_sent_frames", flipped)
    done = replay(run)
    assert done.divergence is not None
    assert (done.divergence.tick, done.divergence.joint, done.divergence.field) == (400, "panda_joint5", "frame")
    assert done.divergence.size == "bytes 7"


def test_what_if_tells_and_draws_how_another_config_would_command(log: Path, tmp_path: Path):
    softer = tmp_path / "softer.toml"
    softer.write_text(PANDA.read_text().replace("stiffness = 200.0", "stiffness = 100.0"))
    found = answer("replay", str(log), "--config", str(softer), "--plot", str(tmp_path / "if.png"))
    assert not found["identical"]
    assert max(found["max_torque_difference_Nm"]) > 0.1
    assert (tmp_path / "if.png").stat().st_size > 10_000
    code, _, err = call("replay", str(log), "--config", str(golden.GOLDEN / "arm.toml"))
    assert (code, err.count("\n")) == (78, 1)
    assert "loop.servo_hz: got 500" in err


def test_diff_of_a_run_with_itself_and_with_another(log: Path, tmp_path: Path):
    assert answer("diff", str(log), str(log))["identical"]
    code, out, _ = call("diff", str(log), str(golden.log_of("stop")), "--plot", str(tmp_path / "d.png"))
    assert code == 1
    assert "feedback_stale" in out
    assert (tmp_path / "d.png").stat().st_size > 10_000


def test_segments_that_the_recorder_wrote_replay_as_one_run_and_a_missing_one_is_named(tmp_path: Path):
    rig = crash.Rig(tmp_path / "log", folders=[tmp_path], segment_s=0.5)
    for k in range(1500):
        rig.turn()
        if k % 20 == 0:
            time.sleep(0.02)  # the recorder changes files by the clock
    rig.close()
    first, *more = sorted((tmp_path / "log").glob("*.mcap"))
    assert more
    done = replay(read_run(more[-1]))  # whichever of them is named
    assert done.identical
    assert (done.ticks, done.frames) == (1500, 7 * 1500)
    assert read_run(first)["/tick"].tick.tolist() == list(range(1500))
    if len(more) > 1:
        more[0].unlink()
        code, _, err = call("replay", str(first))
        assert (code, "001 are missing" in err) == (1, True)
    first.unlink()
    code, _, err = call("replay", str(more[-1]))
    assert code == 1
    assert err.count("\n") == 1


def test_a_base_replays_to_the_bit_reports_and_lists_its_packets(tmp_path: Path):
    world = (ROOT / "configs" / "worlds" / "disc.toml").read_text()
    rover = json.dumps(str(ROOT / "configs" / "rover.toml"))
    text = re.sub(r"(?m)^duration_s = .*$", "duration_s = 4.0", re.sub(r"(?m)^robot = .*$", f"robot = {rover}", world))
    (tmp_path / "world.toml").write_text(text)
    simulate(tmp_path / "world.toml", log=tmp_path / "rover.mcap")
    found = answer("replay", str(tmp_path / "rover.mcap"))
    assert found["identical"]
    assert found["ticks"] > 100
    assert {row["way"] for row in answer("mavlink", str(tmp_path / "rover.mcap"))} == {"rx", "tx"}
    assert call("report", str(tmp_path / "rover.mcap"))[0] == 0
    assert call("export", str(tmp_path / "rover.mcap"), "--out", str(tmp_path / "a.tlog"))[0] == 0
    assert call("diff", str(tmp_path / "rover.mcap"), str(tmp_path / "rover.mcap"))[0] == 0


def test_meshes_of_urdf_and_config_travel_with_the_log(tmp_path: Path):
    for name in ("arm.stl", "rock.obj"):
        (tmp_path / name).write_bytes(name.encode() * 100)
    urdf = '<robot><link name="a"><collision><geometry><mesh filename="arm.stl"/></geometry></collision></link></robot>'
    config = '[[mesh]]\nname = "rock"\nfile = "rock.obj"\n'
    packed = meshes.archive(urdf, tmp_path, (), ("rock.obj",), tmp_path)
    assert packed == meshes.archive(urdf, tmp_path, (), ("rock.obj",), tmp_path)  # equal logs, equal bytes
    there = tmp_path / "there"
    there.mkdir()
    new_urdf, new_config = meshes.unpacked(urdf, config, {meshes.MESHES: packed}, there)
    for text, name in ((new_urdf, "arm.stl"), (new_config, "rock.obj")):
        (place,) = re.findall(r'"([^"]+there[^"]+)"', text)
        assert Path(place).read_bytes() == (tmp_path / name).read_bytes()
    with pytest.raises(LogError, match=r"meshes\.zip"):
        meshes.unpacked(urdf, config, {meshes.MESHES: packed[:-30]}, there)
    assert meshes.archive(urdf.replace("arm", "none"), tmp_path, ()) == b""  # what is not there cannot be attached


# ---- arrays


def test_every_field_of_a_tick_has_a_unit_and_a_meaning():
    arm, base = record_dtype(7, 64).names or (), base_dtype(8).names or ()
    assert set(FIELDS) == {*arm, *base}


def test_several_fields_in_one_pass_are_what_each_is_alone(log: Path):
    one, two = read(log)["/tick"], read(log)["/tick"].load("q", "rho", "time")
    for name in ("q", "rho", "tau_sent", "force"):
        assert getattr(one, name).tobytes() == getattr(two, name).tobytes()
        assert getattr(one, name).tobytes() == np.ascontiguousarray(one.array[name]).tobytes()
    pieces = list(read_run(log).pieces("/tick"))
    assert np.concatenate([p.q for p in pieces]).tobytes() == one.q.tobytes()


# ---- other people's readers


def test_frames_of_links_are_where_pinocchio_puts_them_and_the_scene_shows_the_ball(log: Path):
    import pinocchio as pin

    ticks = read(log)["/tick"]
    with log.open("rb") as file:
        reader = make_reader(file, decoder_factories=[ProtobufDecoder(), Ros2Decoder()])
        found = [(c.topic, m.log_time, d) for _, c, m, d in reader.iter_decoded_messages(["/tf", "/scene"])]
    frames = [(t, d) for topic, t, d in found if topic == "/tf"]
    assert len(frames) == pytest.approx(30, abs=1)
    body = panda()
    stamp, message = frames[20]
    q = ticks.q[np.searchsorted(ticks.time, stamp)]
    pin.framesForwardKinematics(body.model, body.data, body.configuration(q))
    X = {"world": np.eye(4)}
    for t in message.transforms:
        step = np.eye(4)
        w, v = t.rotation, t.translation
        step[:3, :3] = pin.Quaternion(w.w, w.x, w.y, w.z).toRotationMatrix()
        step[:3, 3] = v.x, v.y, v.z
        X[t.child_frame_id] = X[t.parent_frame_id] @ step
    assert len(X) > 10
    for name in ("panda_link3", "panda_link7", "panda_hand_tcp"):
        np.testing.assert_allclose(X[name], body.data.oMf[body.model.getFrameId(name)].homogeneous, atol=1e-9)
    scenes = [(t, d) for topic, t, d in found if topic == "/scene"]
    stamp, scene = scenes[20]
    (ball,) = [e for e in scene.entities if e.id == "obstacle ball"]
    y = 0.4 - 0.1 * stamp / 1e9
    assert ball.spheres[0].pose.position.y == pytest.approx(y, abs=3e-3)
    assert ball.spheres[0].size.x == pytest.approx(0.1)


def test_joint_states_decode_by_two_ros_libraries(log: Path):
    store = get_typestore(Stores.ROS2_HUMBLE)
    q = read(log)["/tick"].q
    with log.open("rb") as file:
        reader = make_reader(file, decoder_factories=[Ros2Decoder()])
        for k, (schema, _, message, decoded) in enumerate(reader.iter_decoded_messages(["/joint_states"])):
            assert schema is not None
            assert schema.name == "sensor_msgs/msg/JointState"
            other = store.deserialize_cdr(message.data, schema.name)
            assert list(decoded.position) == other.position.tolist() == q[k].tolist()
            assert other.name == list(decoded.name)


def test_rerun_opens_the_file_and_finds_the_topics(log: Path, tmp_path: Path):
    import rerun as rr

    recording = rr.RecordingStream("rtctl_test")
    recording.save(str(tmp_path / "run.rrd"))
    recording.log_file_from_path(str(log))
    recording.flush()
    recording.disconnect()
    raw = (tmp_path / "run.rrd").read_bytes()
    assert len(raw) > 50_000
    assert b"/joint_states" in raw


def test_candump_and_blf_give_every_frame_back(log: Path, tmp_path: Path):
    array, stamps = read(log)["/can/can0"].array, read(log)["/can/can0"].time
    for name, reader in (("run.log", can.CanutilsLogReader), ("run.blf", can.BLFReader)):
        assert call("export", str(log), "--out", str(tmp_path / name))[0] == 0
        with reader(tmp_path / name) as frames:
            found = list(frames)
        assert len(found) == len(array) > 5000
        for row, at, message in zip(array, stamps.tolist(), found, strict=True):
            assert message.arbitration_id == row["id"]
            assert bytes(message.data) == row["data"][: row["dlc"]].tobytes()
            assert (message.is_fd, message.bitrate_switch) == (bool(row["fd"]), bool(row["brs"]))
            assert message.is_rx == (row["direction"] == 0)
            assert message.timestamp == pytest.approx(at / 1e9, abs=1e-6)


def test_csv_and_parquet_hold_the_same_numbers_and_parquet_their_units(log: Path, tmp_path: Path):
    tick = read(log)["/tick"]
    assert call("export", str(log), "--out", str(tmp_path / "t.parquet"))[0] == 0
    table = pq.read_table(tmp_path / "t.parquet")
    assert table.schema.field("q").metadata[b"unit"] == b"rad"
    assert np.array(table["q"].to_pylist()).tobytes() == tick.q.tobytes()
    assert table["status"].to_numpy().tolist() == tick.status.tolist()
    assert call("export", str(log), "--fields", "time,x", "--out", str(tmp_path / "t.csv"))[0] == 0
    rows = list(csv.reader((tmp_path / "t.csv").read_text().splitlines()))
    assert rows[0] == ["log_time_ns", "time", "x.0", "x.1", "x.2"]
    np.testing.assert_array_equal(np.array(rows[1:], float)[:, 2:], tick.x)
    code, _, err = call("export", str(log), "--fields", "qq", "--out", str(tmp_path / "u.csv"))
    assert (code, err.count("\n")) == (2, 1)


def test_can_tells_rates_losses_and_what_the_frames_say(log: Path, tmp_path: Path):
    found = {(row["id"], row["way"]): row for row in answer("can", str(log))}
    tick = read(log)["/tick"]
    assert len(found) == 14
    row = found[0x12, "rx"]
    assert (row["name"], row["lost"], row["length"]) == ("panda_joint2_reply", 0, 12)
    assert row["hz"] == pytest.approx(1000.0, rel=1e-3)
    p = next(s for s in row["signals"] if s["name"] == "p")
    assert (p["smallest"], p["largest"]) == pytest.approx((tick.q[1:, 1].min(), tick.q[1:, 1].max()), abs=1e-9)
    dbc = cantools.database.load_string(str(read(log).header.files["drive.dbc"]), "dbc")
    array = read(log)["/can/can0"].array
    last = array[(array["id"] == 0x12)][-1]
    assert isinstance(dbc, cantools.database.can.Database)
    said = dbc.decode_message(0x12, last["data"][:12].tobytes())
    for signal in row["signals"]:
        assert signal["last"] == pytest.approx(float(getattr(said[signal["name"]], "value", said[signal["name"]])))
    err = next(s for s in row["signals"] if s["name"] == "err")
    assert err["choice"] == "enabled"
    shipped = answer("can", str(log), "--dbc", str(ROOT / "configs" / "drive.dbc"))
    assert {r["name"] for r in shipped} >= {"DM8009_Command", ""} or len(shipped) == 14


def test_lost_frames_are_counted_by_the_holes_of_their_counters(log: Path, tmp_path: Path):
    source = read(log)
    array = source["/can/can0"].array
    sink = McapSink(tmp_path / "holes.mcap", source.header)
    mine = array[array["id"] == 0x13]
    for k, row in enumerate(mine[:300]):
        if k not in (50, 51, 120):
            raw = np.uint32(0x13).tobytes() + bytes([12, 5, 0, 0]) + row["data"].tobytes()
            sink.put(Kind.CAN_RX, raw, k * 1_000_000)
    sink.close()
    (found,) = answer("can", str(tmp_path / "holes.mcap"))
    assert found["lost"] == 3
    assert found["gap_max"] == pytest.approx(3e-3)


# ---- MAVLink


def mavlink_log(path: Path) -> list[bytes]:
    """Write packets of two versions, one of them lost, as raw messages; return them."""
    packets = []
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("mavlink.Packet", "", b"")
        ids = [writer.register_channel(f"/mavlink/usb/{way}", "mavlink", schema) for way in ("rx", "tx")]
        for k in range(20):
            if k == 7:
                continue
            v2 = bytes([0xFD, 2, 0, 0, k, 1, 1, 0, 0, 0]) + bytes([k, 1, 0xAA, 0xBB])
            v1 = bytes([0xFE, 1, k, 255, 190, 76, k, 0xCC, 0xDD])
            for channel, packet in zip(ids, (v2, v1), strict=True):
                writer.add_message(channel, k * 10**9, packet, k * 10**9)
                packets.append(packet)
        writer.finish()
    return packets


def test_mavlink_is_listed_and_written_as_tlog(tmp_path: Path):
    packets = mavlink_log(tmp_path / "rover.mcap")
    rows = answer("mavlink", str(tmp_path / "rover.mcap"))
    assert [(r["way"], r["system"], r["message"], r["packets"], r["lost"]) for r in rows] == [
        ("rx", 1, 0, 19, 1),
        ("tx", 255, 76, 19, 1),
    ]
    assert rows[0]["hz"] == pytest.approx(18 / 19)
    assert call("export", str(tmp_path / "rover.mcap"), "--out", str(tmp_path / "f.tlog"))[0] == 0
    raw, found = (tmp_path / "f.tlog").read_bytes(), []
    while raw:
        size = 12 + raw[9] if raw[8] == 0xFD else 8 + raw[9]  # both without a signature
        found.append((int.from_bytes(raw[:8], "big"), raw[8 : 8 + size]))
        raw = raw[8 + size :]
    assert [p for _, p in found] == packets
    assert found[-1][0] == 19_000_000


# ---- health


def test_doctor_finds_nothing_in_a_good_log_and_names_what_is_wrong_with_a_bad_one(log: Path, tmp_path: Path):
    assert call("doctor", str(log))[0] == 0
    raw = bytearray(log.read_bytes())
    raw[int(read(log)._catalog.chunks.body[2]) + 500] ^= 1
    (tmp_path / "flipped.mcap").write_bytes(raw)
    code, out, _ = call("doctor", str(tmp_path / "flipped.mcap"))
    assert code == 1
    assert "BAD  checksums" in out
    (tmp_path / "cut.mcap").write_bytes(raw[: len(raw) // 3])
    code, out, _ = call("doctor", str(tmp_path / "cut.mcap"))
    assert code == 1
    assert "rtctl log recover" in out


def test_recover_says_by_its_exit_code_what_was_lost(log: Path, tmp_path: Path):
    raw = log.read_bytes()
    (tmp_path / "cut.mcap").write_bytes(raw[: len(raw) // 2])
    code, out, _ = call("recover", str(tmp_path / "cut.mcap"))
    assert code == 3
    assert "bytes and" in out
    with (tmp_path / "cut.recovered.mcap").open("rb") as file:
        count = sum(1 for _ in make_reader(file, validate_crcs=True).iter_messages())
    assert f"another reader finds {count}" in out
    folder = tmp_path / "crashed"
    folder.mkdir()
    segment = begin(folder / "x.000.mcap", read(log).header, (), 0, {})
    segment.close()
    code, out, _ = call("recover", str(folder))
    assert code == 0
    assert "nothing lost" in out
    assert call("doctor", str(folder / "x.000.mcap"))[0] == 0
    (tmp_path / "noise.mcap").write_bytes(bytes(5000))
    code, _, err = call("recover", str(tmp_path / "noise.mcap"))
    assert (code, err.count("\n")) == (1, 1)


def test_tail_tells_events_and_states_and_stops_with_the_log(log: Path):
    lines = [json.loads(line) for line in call("tail", str(log), "--json", "--every", "0.25")[1].splitlines()]
    assert [line["detail"] for line in lines if line.get("name") == "state"] == ["ARMED", "RUN"]
    assert any(line.get("state") == "RUN" and line["error_m"] < 0.5 for line in lines)
    assert lines[-1]["ended"]["reason"] == "end"


VERBS = (
    ["info"],
    ["doctor"],
    ["can"],
    ["mavlink"],
    ["replay"],
    ["report", "--out", "{out}.html"],
    ["plot", "--out", "{out}.png"],
    ["export", "--out", "{out}.csv"],
    ["export", "--out", "{out}.log"],
    ["export", "--out", "{out}.parquet"],
    ["tail", "--for", "0.01"],
    ["diff", "{file}"],
)


def verbs(path: Path, out: Path) -> None:
    """Run every verb: a result, or one line on stderr; anything raised fails the test."""
    for verb, *rest in VERBS:
        words = [word.format(out=out, file=path) for word in rest]
        code, _, err = call(verb, str(path), *words)
        assert code in (0, 1, 2, 78), (verb, code)
        assert err.count("\n") <= 1, (verb, err)
        assert code == 0 or err or verb in ("doctor", "diff"), verb


def test_logs_of_other_programs_and_noise_give_no_traceback(tmp_path: Path):
    out = tmp_path / "out"
    mavlink_log(tmp_path / "rover.mcap")
    with (tmp_path / "can.mcap").open("wb") as file:  # a candump converted by somebody else
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("can_msgs/msg/Frame", "ros2msg", b"uint32 id")
        ids = [
            writer.register_channel(t, e, schema)
            for t, e in (("/can/can0", "cdr"), ("/tick", "json"), ("/event", "json"))
        ]
        for k in range(50):
            writer.add_message(ids[k % 3], k, b'{"name": 3}' if k % 3 else b"\0\1\0\0\2\0\0\0", k)
        writer.finish()
    (tmp_path / "empty.mcap").write_bytes(b"")
    (tmp_path / "noise.mcap").write_bytes(np.random.default_rng(0).bytes(3000))
    (tmp_path / "magic.mcap").write_bytes(b"\x89MCAP0\r\n" + np.random.default_rng(1).bytes(3000))
    header = make_header("arm", ("a",), 1, 1e-3)
    McapSink(tmp_path / "bare.mcap", header).close()
    odd = McapSink(tmp_path / "odd.mcap", header)
    for k in range(3):
        odd.put(Kind.TICK, np.random.default_rng(k).bytes(header.dtype.itemsize), k)
    odd.close()
    with np.errstate(all="ignore"):
        for path in sorted(tmp_path.glob("*.mcap")):
            verbs(path, out)


def test_a_log_cut_at_every_byte_of_its_end_opens_or_says_why_not(tmp_path: Path):
    header = make_header("arm", ("a", "b"), 2, 1e-3)
    sink = McapSink(tmp_path / "short.mcap", header)
    record = np.zeros((), header.dtype)
    for k in range(40):
        record["tick"], record["q"] = k, np.random.default_rng(k).normal(size=2)
        sink.put(Kind.TICK, record.tobytes(), k * 1_000_000)
    raw = sink.close().read_bytes()
    cut = tmp_path / "cut.mcap"
    counts = set()
    for size in {*range(len(raw) - 4096, len(raw)), *range(8, len(raw) - 4096, 97)}:
        cut.write_bytes(raw[:size])
        counts.add(read(cut).counts.get("/tick", (0, 0, 0))[0])
        if size % 16 == 0:
            info(cut)
    assert counts == {0, 40}
    with np.errstate(all="ignore"):
        for size in (len(raw) - 1, len(raw) - 4096, len(raw) // 4, 20):
            cut.write_bytes(raw[:size])
            verbs(cut, tmp_path / "out")


def test_every_verb_explains_itself_with_an_example(capsys: pytest.CaptureFixture[str]):
    for verb in ("info", "doctor", "recover", "report", "plot", "export", "can", "mavlink", "replay", "diff", "tail"):
        with pytest.raises(SystemExit) as ended:
            main(["log", verb, "--help"])
        assert ended.value.code == 0
        assert f"rtctl log {verb}" in capsys.readouterr().out.partition("example:")[2]


def test_the_example_script_runs(log: Path, capsys: pytest.CaptureFixture[str]):
    runpy.run_path(str(ROOT / "docs" / "read_a_log.py"))["main"](str(log))
    said = capsys.readouterr().out
    assert "[rad] joint positions" in said
    assert "14 identifiers" in said

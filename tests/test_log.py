"""The log file: other people's decoders agree with it, and nothing done to it gives a traceback."""

import contextlib
import struct
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from rtctl.errors import LogError
from rtctl.log import Header, Kind, McapSink, make_header, read
from rtctl.log.mcap.recovery import recover
from rtctl.log.read.info import info
from rtctl.log.read.inputs import inputs
from rtctl.log.record.requests import encode_event, encode_request
from rtctl.types import Goal, ObstacleEdit, Request, Shape, Task, Verb

N, SLOTS = 3, 4
JOINTS = ("shoulder", "elbow", "wrist_with_a_longer_name")
CONFIG = 'name = "test" # η\n'
Record = np.ndarray[Any, Any]


@cache
def header(buses: tuple[str, ...] = ("can0", "can1")) -> Header:
    return make_header("test", JOINTS, SLOTS, 1e-3, config=CONFIG, urdf="<robot/>", buses=buses, files={"a.txt": "b"})


def random_record(seed: int, dtype: np.dtype[np.void]) -> Record:
    """Any bits at all, but for the tick; NaN and infinities included."""
    record = np.frombuffer(np.random.default_rng(seed).bytes(dtype.itemsize), dtype).copy()
    record["tick"] = seed
    return record


def frame(can_id: int, data: bytes) -> bytes:
    return struct.pack("=IB3x8s", can_id, len(data), data)


def fd_frame(can_id: int, data: bytes, flags: int) -> bytes:
    return struct.pack("=IBBxx64s", can_id, len(data), flags, data)


GOAL = Goal(
    np.array([0.1, 1 / 3, -2e-17]),
    np.array([1.0, 0, 0, 0]),
    Task.X | Task.DIRECTION,
    0.005,
    0.02,
    np.array([0.6, 0, 0.8]),
    np.array([0.1, 1 / 3]),
)
BALL = Shape(
    "ball", "sphere", np.array([0.1, 0, 0, 0]), np.zeros(3), np.array([1.0, 0, 0, 0]), np.ones(3) / 7, np.zeros(3)
)
ASKED = Request(Verb.ARM, GOAL, (ObstacleEdit("ball", BALL, 0.01), ObstacleEdit("wall", None)))


def write(path: Path, ticks: int = 200) -> Path:
    sink = McapSink(path, header())
    for k in range(ticks):
        time = 1_000_000 * k
        if k == 7:
            sink.put(Kind.REQUEST, encode_request(k, ASKED), time)
        sink.put(Kind.CAN_RX, frame(0x11, bytes([k % 256])), time)
        sink.put(Kind.TICK, random_record(k, header().dtype).tobytes(), time)
        sink.put(Kind.CAN_TX, frame(0x01, bytes(8)), time)
        sink.put(Kind.CAN_TX | 1 << 8, fd_frame(0x01, bytes(range(12)), 1), time)
    sink.put(Kind.EVENT, encode_event(7, 0.007, "fault", "bus off"), 7_000_000)
    return sink.close("end", "of the test")


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("log") / "a.mcap")


def messages(path: Path) -> list[tuple[str, Any, Any]]:
    """Return (topic, schema, message) by mcap's own reader, checksums validated."""
    with path.open("rb") as file:
        found = make_reader(file, validate_crcs=True).iter_messages(log_time_order=False)
        return [(channel.topic, schema, message) for schema, channel, message in found]


def decoder(schema: Any) -> Any:
    """Return the protobuf class that the file's own schema describes."""
    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name))


def test_every_tick_decodes_by_google_protobuf_to_the_record_that_was_put(path: Path) -> None:
    ticks = [(schema, message) for topic, schema, message in messages(path) if topic == "/tick"]
    assert len(ticks) == 200
    assert len({len(message.data) for _, message in ticks}) == 1
    Tick = decoder(ticks[0][0])
    for k, (_, message) in enumerate(ticks):
        tick = Tick.FromString(message.data)
        record = random_record(k, header().dtype)[0]
        for name in record.dtype.names:
            got = np.array(getattr(tick, name), record.dtype[name].base)
            assert got.tobytes() == record[name].tobytes(), name


def test_the_reader_gives_the_same_bits_as_arrays_with_their_shapes(path: Path) -> None:
    log = read(path)
    ticks = log["/tick"]
    assert ticks.q.shape == (200, N)
    assert ticks.force.shape == (200, SLOTS, 3)
    assert ticks.array.tobytes() == b"".join(random_record(k, header().dtype).tobytes() for k in range(200))
    assert ticks.time.tolist() == [1_000_000 * k for k in range(200)]
    assert ticks.sequence.tolist() == list(range(1, 201))
    with pytest.raises(AttributeError, match="got field qq, wanted"):
        _ = ticks.qq


frames = st.tuples(
    st.integers(0, 0x1FFFFFFF),
    st.booleans(),
    st.booleans(),
    st.booleans(),
    st.one_of(st.binary(max_size=8), st.binary(max_size=64)),
    st.integers(0, 3),
    st.booleans(),
)


@given(st.lists(frames, min_size=1, max_size=20))
def test_any_frame_decodes_by_google_protobuf_to_its_fields(
    tmp_path_factory: pytest.TempPathFactory, rows: list[tuple[int, bool, bool, bool, bytes, int, bool]]
) -> None:
    path = tmp_path_factory.mktemp("can") / "a.mcap"
    sink = McapSink(path, header(("can0",)))
    for can_id, extended, rtr, error, data, flags, out in rows:
        raw_id = (can_id if extended or error else can_id & 0x7FF) | extended << 31 | rtr << 30 | error << 29
        raw = frame(raw_id, data) if len(data) <= 8 and flags == 0 else fd_frame(raw_id, data, flags)
        sink.put(Kind.CAN_TX if out else Kind.CAN_RX, raw, 5)
    sink.close()
    got = [(schema, message) for topic, schema, message in messages(path) if topic == "/can/can0"]
    Frame = decoder(got[0][0])
    for (_, message), (can_id, extended, rtr, error, data, flags, out) in zip(got, rows, strict=True):
        decoded = Frame.FromString(message.data)
        fd = not (len(data) <= 8 and flags == 0)
        assert decoded.id == (can_id if extended or error else can_id & 0x7FF)
        assert (decoded.is_extended, decoded.is_rtr, decoded.is_error) == (extended, rtr, error)
        assert (decoded.data, decoded.dlc, decoded.direction) == (data, len(data), int(out))
        assert (decoded.fd, decoded.brs, decoded.esi) == (fd, fd and bool(flags & 1), fd and bool(flags & 2))
    array = read(path)["/can/can0"].array
    assert [bytes(row["data"][: row["dlc"]]) for row in array] == [row[4] for row in rows]


class Cdr:
    """A little-endian CDR decoder of the types that JointState has."""

    def __init__(self, data: bytes) -> None:
        assert data[:4] == b"\x00\x01\x00\x00"
        self.data, self.at = data[4:], 0

    def number(self, format: str) -> Any:
        size = struct.calcsize(format)
        self.at = (self.at + size - 1) // size * size
        (value,) = struct.unpack_from("<" + format, self.data, self.at)
        self.at += size
        return value

    def string(self) -> str:
        size = self.number("I")
        text = self.data[self.at : self.at + size]
        self.at += size
        assert text[-1:] == b"\0"
        return text[:-1].decode()


def test_joint_states_decode_as_cdr_to_positions_speeds_and_torques(path: Path) -> None:
    found = [message for topic, _, message in messages(path) if topic == "/joint_states"]
    for k, message in enumerate(found):
        record = random_record(k, header().dtype)[0]
        cdr = Cdr(message.data)
        assert cdr.number("i") * 10**9 + cdr.number("I") == message.log_time
        assert cdr.string() == ""
        assert tuple(cdr.string() for _ in range(cdr.number("I"))) == JOINTS
        for name in ("q", "qd", "tau_measured"):
            values = [cdr.number("d") for _ in range(cdr.number("I"))]
            assert np.array(values).tobytes() == record[name].tobytes()
        assert cdr.at == len(cdr.data)


def test_wire_order_is_kept_and_each_topic_counts_from_one(path: Path) -> None:
    found = messages(path)
    assert [topic for topic, _, _ in found[:5]] == ["/can/can0", "/tick", "/joint_states", "/can/can0", "/can/can1"]
    for name in {topic for topic, _, _ in found}:
        numbers = [message.sequence for topic, _, message in found if topic == name]
        assert numbers == list(range(1, len(numbers) + 1)), name


def test_mcap_finds_the_texts_and_the_summary(path: Path) -> None:
    with path.open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        attachments = {a.name: a.data for a in reader.iter_attachments()}
        metadata = {m.name: m.metadata for m in reader.iter_metadata()}
    assert attachments == {"config.toml": CONFIG.encode(), "robot.urdf": b"<robot/>", "a.txt": b"b"}
    assert metadata["rtctl"]["config_sha256"] == read(path).header.config_sha256
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == len(messages(path))
    assert read(path).header == header()


def test_an_event_comes_back_as_it_was_put_and_is_told_as_a_foxglove_log(path: Path) -> None:
    log = read(path)
    (event,) = log.events
    evidence = event.pop("evidence")
    assert event == {"tick": 7, "time": 0.007, "name": "fault", "detail": "bus off", "log_time": 7_000_000}
    assert evidence["tick"] == list(range(150, 200))  # the last ticks before it
    q = [[x if np.isfinite(x) else None for x in random_record(k, header().dtype)["q"][0]] for k in range(150, 200)]
    assert evidence["q"] == q
    said = [(decoder(schema).FromString(m.data), m) for topic, schema, m in messages(path) if topic == "/log"]
    assert [(m.level, m.message) for m, _ in said] == [
        (2, "operator: arm"),
        (2, f"goal: {GOAL.position.tolist()}"),
        (4, "fault: bus off"),
    ]
    assert all(m.timestamp.seconds * 10**9 + m.timestamp.nanos == raw.log_time for m, raw in said)


def test_a_replay_gets_every_input_back_to_the_bit(path: Path) -> None:
    ticks = list(inputs([read(path)]))
    assert len(ticks) == 200
    for k, logged in enumerate(ticks):
        record = random_record(k, header().dtype)[0]
        assert logged.feedback.q.tobytes() == record["q"].tobytes()
        assert logged.feedback.tau.tobytes() == record["tau_measured"].tobytes()
        assert logged.feedback.drive.tolist() == record["drive"].tolist()
        assert logged.feedback.link == record["link"]
        assert (logged.request == Request()) == (k != 7)
    asked = ticks[7].request
    assert asked.goal is not None
    assert asked.goal.position.tobytes() == GOAL.position.tobytes()
    ball = asked.obstacles[0].shape
    assert ball is not None
    assert ball.velocity.tobytes() == BALL.velocity.tobytes()
    assert asked.obstacles[1] == ObstacleEdit("wall", None)


def test_a_replay_refuses_a_log_with_a_missing_tick(tmp_path: Path) -> None:
    sink = McapSink(tmp_path / "a.mcap", header())
    for k in (0, 1, 4):
        sink.put(Kind.TICK, random_record(k, header().dtype).tobytes(), k)
    with pytest.raises(LogError, match="ticks 2 to 3 are missing"):
        list(inputs([read(sink.close())]))


def test_equal_runs_write_equal_bytes(tmp_path: Path, path: Path) -> None:
    assert write(tmp_path / "a.mcap").read_bytes() == path.read_bytes()


def test_a_window_holds_what_the_whole_holds_between_its_ends(path: Path) -> None:
    log = read(path)
    part = log.window("/tick", 50_000_000, 60_000_000)
    assert part.time.tolist() == [1_000_000 * k for k in range(50, 60)]
    assert part.q.tobytes() == log["/tick"].q[50:60].tobytes()


def of_two_topics(path: Path) -> dict[str, list[int]]:
    """Write chunks of which some hold one topic, some the other, some both; return the times of each."""
    rng = np.random.default_rng(5)
    times: dict[str, list[int]] = {"/a": [], "/b": []}
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=200)
        writer.start()
        channels = {name: writer.register_channel(name, "json", 0) for name in times}
        for k in range(400):
            name = ("/a", "/b", "/a" if rng.random() < 0.5 else "/b")[k // 20 % 3]
            times[name].append(1000 + 10 * k)
            writer.add_message(channels[name], 1000 + 10 * k, b'{"k": %d}' % k, k)
        writer.finish()  # type: ignore[no-untyped-call]
    return times


def test_any_window_of_many_chunks_holds_exactly_its_messages(tmp_path: Path) -> None:
    path = tmp_path / "two.mcap"
    times = of_two_topics(path)
    log = read(path)
    for start, stop in [
        (0, 1000),
        (0, 1001),
        (4990, 1 << 70),
        (-5, 1 << 63),
        *np.random.default_rng(6).integers(900, 5100, (60, 2)).tolist(),
    ]:
        for name, every in times.items():
            assert log.window(name, start, stop).time.tolist() == [t for t in every if start <= t < stop]
    assert [t for part in log.pieces("/b") for t in part.time.tolist()] == times["/b"]


def test_a_summary_that_points_elsewhere_costs_no_message(tmp_path: Path) -> None:
    path, broken = tmp_path / "two.mcap", tmp_path / "broken.mcap"
    times = of_two_topics(path)
    raw = path.read_bytes()
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    index = summary.chunk_indexes[-2]
    place = struct.pack("<QQ", index.chunk_start_offset, index.chunk_length)
    number, at = next(iter(index.message_index_offsets.items()))
    wrong = [(place, struct.pack("<QQ", x, index.chunk_length)) for x in (len(raw), 1 << 62, 1 << 63, (1 << 64) - 1)]
    wrong += [(place, struct.pack("<QQ", index.chunk_start_offset, n)) for n in (len(raw), (1 << 64) - 1)]
    wrong += [(struct.pack("<HQ", number, at), struct.pack("<HQ", number, x)) for x in (0, len(raw), (1 << 64) - 1)]
    for old, new in wrong:
        assert raw.count(old) == 1
        broken.write_bytes(raw.replace(old, new))
        log = read(broken)
        assert {name: log[name].time.tolist() for name in times} == times
        assert log.damaged == 0


def test_entries_of_a_wrong_size_or_kind_are_counted_and_the_rest_is_written(tmp_path: Path) -> None:
    sink = McapSink(tmp_path / "a.mcap", header())
    for kind, payload in (
        (Kind.TICK, b"short"),
        (99, b"?"),
        (Kind.CAN_TX, b"15 bytes long.."),
        (Kind.CAN_TX | 7 << 8, bytes(16)),
    ):
        sink.put(kind, payload, 1)
    sink.put(Kind.CAN_TX, frame(1, b""), 2)
    log = read(sink.close())
    assert log.sentinel["malformed"] == 4
    assert len(log["/can/can0"]) == 1


def test_info_tells_what_is_in_a_whole_log(path: Path) -> None:
    found = info(path)
    assert found["complete"]
    assert found["sentinel"]["reason"] == "end"
    assert found["duration_s"] == pytest.approx(0.199)
    assert found["topics"]["/tick"] == {"messages": 200, "hz": pytest.approx(1000), "holes": 0, "schema": "rtctl.Tick"}
    assert found["topics"]["/can/can0"]["messages"] == 400
    assert found["dropouts"] == {"messages": 0, "entries": 0}
    assert found["joints"] == list(JOINTS)
    assert found["versions"]["python"]


def look_at_everything(path: Path) -> dict[str, int]:
    """Read whatever can be read; only LogError may come of it."""
    log = read(path)
    info(path)
    for name in log.topics:
        try:
            _ = log[name].array
        except LogError:
            _ = log[name].json
    return {name: len(log[name]) for name in log.topics}


def whole_chunks(raw: bytes, path: Path) -> list[tuple[int, int]]:
    """Return (end of the chunk record, messages up to there) by mcap's own summary."""
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    found, total = [], 0
    for index in sorted(summary.chunk_indexes, key=lambda i: i.chunk_start_offset):
        at = index.chunk_start_offset + index.chunk_length
        while raw[at] == 0x07:  # message indices tell how many messages the chunk has
            total += (struct.unpack_from("<Q", raw, at + 1)[0] - 6) // 16
            at += 9 + struct.unpack_from("<Q", raw, at + 1)[0]
        found.append((index.chunk_start_offset + index.chunk_length, total))
    return found


def test_a_file_cut_anywhere_gives_its_whole_chunks_and_recovers_to_them(tmp_path: Path) -> None:
    path = write(tmp_path / "whole.mcap", 700)
    raw = path.read_bytes()
    chunks = whole_chunks(raw, path)
    assert len(chunks) >= 3
    cut = tmp_path / "cut.mcap.open"
    near = {end + d for end, _ in chunks for d in (-1, 0, 1, 30)} | set(range(len(raw) - 4096, len(raw), 131))
    for size in sorted(near | set(range(0, len(raw), 40009))):
        cut.write_bytes(raw[:size])
        expected = max([0, *(n for end, n in chunks if end <= size)])
        try:
            counts = look_at_everything(cut)
        except LogError:
            assert size < 8
            counts = {}
        assert sum(counts.values()) == expected, size
        whole = recover(cut)
        if size < 8:
            assert whole.path.name.endswith(".bad")
            continue
        assert whole.messages == expected, size
        found = messages(whole.path)
        if "/log/sentinel" in counts:  # else the cut went through the file's start
            assert found.pop()[0] == "/log/sentinel"
        assert len(found) == expected, size
        assert read(whole.path).complete


def test_flipped_and_random_bytes_never_give_a_traceback(tmp_path: Path) -> None:
    raw = bytearray(write(tmp_path / "whole.mcap", 30).read_bytes())
    rng = np.random.default_rng(1)
    path = tmp_path / "broken.mcap"
    for trial in range(300):
        broken = bytearray(raw)
        if trial % 3 == 0:
            at = int(rng.integers(8, len(raw)))
            broken[at : at + 64] = rng.bytes(64)
        elif trial % 3 == 1:
            for at in rng.integers(8, len(raw), 20):
                broken[at] ^= 1 << int(rng.integers(8))
        else:
            broken[8:] = rng.bytes(2000)
        path.write_bytes(broken)
        with contextlib.suppress(LogError):
            look_at_everything(path)


@pytest.mark.parametrize("name", ["absent.mcap", "."])
def test_a_file_that_cannot_be_read_is_named(tmp_path: Path, name: str) -> None:
    with pytest.raises(LogError, match=str(tmp_path)):
        read(tmp_path / name)


@pytest.mark.parametrize("compression", list(CompressionType))
@pytest.mark.parametrize("chunking", [True, False])
def test_the_files_of_another_writer_are_read(tmp_path: Path, compression: CompressionType, chunking: bool) -> None:
    path = tmp_path / "other.mcap"
    with path.open("wb") as file:
        writer = Writer(file, compression=compression, use_chunking=chunking, chunk_size=500)
        writer.start()
        channel = writer.register_channel("/text", "json", writer.register_schema("Text", "jsonschema", b"{}"))
        for k in range(100):
            writer.add_message(channel, k, b'{"k": %d}' % k, k)
        writer.finish()  # type: ignore[no-untyped-call]
    log = read(path)
    assert [m["k"] for m in log["/text"].json] == list(range(100))
    assert info(path)["topics"]["/text"]["messages"] == 100
    with pytest.raises(LogError, match="no header of rtctl"):
        _ = log.header
    with pytest.raises(LogError, match="got topic /tick, wanted one of /text"):
        _ = log["/tick"]

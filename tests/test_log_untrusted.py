"""A log may be written by anybody: what it claims is bounded, what is wrong is said in a line, recovery is checked."""

import contextlib
import io
import json
import struct
import subprocess
import sys
import tracemalloc
import zipfile
import zlib
from pathlib import Path

import lz4.frame  # type: ignore[import-untyped]
import pytest
import zstandard
from mcap.reader import make_reader
from mcap.records import Message, MessageIndex
from mcap.stream_reader import StreamReader

from rtctl.errors import EXIT_FAILED, LogError
from rtctl.log import Kind, McapSink, limits, make_header, read
from rtctl.log.header import dtype_from_json, header_from_json, header_to_json
from rtctl.log.mcap.walk import Damaged, chunk_data, chunk_head
from rtctl.log.read.examine import examine
from rtctl.log.read.info import info
from rtctl.log.read.mend import LOSSLESS, LOSSY, mend
from rtctl.log.read.topic import Held
from rtctl.log.record.meshes import INDEX, MESHES, unpacked
from tests.mcap_conformance import CHANNEL, CHUNK, DATA_END, FOOTER, HEADER, MAGIC, MESSAGE, _File, mapping, text
from tests.rig import ROOT
from tools import damage

MIB = 1 << 20


def message(sequence: int, time: int, data: bytes = b"{}", channel: int = 1) -> bytes:
    body = struct.pack("<HIQQ", channel, sequence, time, time) + data
    return struct.pack("<BQ", MESSAGE, len(body)) + body


def chunk_of(records: bytes, packed: bytes, compression: str = "zstd", size: int | None = None) -> bytes:
    head = struct.pack("<QQQI", 0, 0, len(records) if size is None else size, zlib.crc32(records)) + text(compression)
    return head + struct.pack("<Q", len(packed)) + packed


def file_of(path: Path, *chunks: bytes, topics: tuple[str, ...] = ("/x",)) -> Path:
    """A file of another program: channels 1, 2, ... of JSON, chunks, no summary."""
    file = _File(False)
    file.data += MAGIC
    file.add(HEADER, text("") + text(""))
    for number, topic in enumerate(topics, start=1):
        file.add(CHANNEL, struct.pack("<HH", number, 0) + text(topic) + text("json") + mapping({}))
    for chunk in chunks:
        file.add(CHUNK, chunk)
    file.add(DATA_END, bytes(4))
    file.add(FOOTER, bytes(20))
    path.write_bytes(bytes(file.data) + MAGIC)
    return path


def zstd(data: bytes) -> bytes:
    return zstandard.ZstdCompressor().compress(data)


def finding(path: Path, name: str) -> tuple[bool, str]:
    return next((f.good, f.text) for f in examine(path) if f.name == name)


# ---- counts, sizes and expansions


@pytest.mark.parametrize("claim", [limits.CHUNK + 1, 1 << 30, 1 << 62])
def test_a_chunk_that_says_it_is_huge_is_not_unpacked(tmp_path: Path, claim: int):
    packer = zstandard.ZstdCompressor().compressobj()
    bomb = b"".join([*(packer.compress(bytes(MIB)) for _ in range(80)), packer.flush()])
    path = file_of(tmp_path / "a.mcap", *[chunk_of(b"", bomb, size=claim)] * 4)
    tracemalloc.start()
    log = read(path)
    assert log["/x"].payloads == []
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert log.damaged == 4
    assert peak < 8 * MIB
    assert finding(path, "checksums") == (
        False,
        f"0 of 4 chunks unpack and match, 0 messages; chunk: says {claim} bytes, at most {limits.CHUNK} are unpacked",
    )


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
def test_a_chunk_that_holds_more_than_it_says_is_cut_off_at_its_word(compression: str):
    plain = bytes(32 * MIB)
    packed = lz4.frame.compress(plain, store_size=False) if compression == "lz4" else zstd(plain)
    data = chunk_of(plain, packed, compression, size=1000)
    tracemalloc.start()
    with pytest.raises(Damaged, match="its head says 1000"):
        chunk_data(data, chunk_head(data, 0, len(data)))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < MIB


def test_what_is_held_of_a_topic_is_bounded_but_pieces_are_not(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(limits, "HELD", 2 * MIB)
    monkeypatch.setattr(limits, "UNPACKED", MIB)
    records = b"".join(message(k, k, bytes(1000)) for k in range(1000))
    path = file_of(tmp_path / "a.mcap", *[chunk_of(records, zstd(records))] * 8)
    assert path.stat().st_size * limits.EXPANSION < 8 * MIB
    log = read(path)
    with pytest.raises(LogError, match=r"^/x: more than \d+ MiB at once; take a window of time"):
        _ = log["/x"].payloads
    assert sum(len(piece.payloads) for piece in log.pieces("/x")) == 8000
    assert len(log["/x"]) == 8000


def test_held_counts_what_is_kept():
    held = Held("/x", 10)
    held.add(10)
    with pytest.raises(LogError):
        held.add(1)


def archive_of(members: dict[str, bytes], claim: int | None = None) -> bytes:
    target = io.BytesIO()
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as zipped:
        for name, content in members.items():
            zipped.writestr(name, content)
    data = target.getvalue()
    if claim is not None:  # lie in the directory about the size of the first member
        at = data.index(b"PK\x01\x02")
        data = data[: at + 24] + struct.pack("<I", claim) + data[at + 28 :]
    return data


def test_meshes_that_unpack_to_more_than_any_robot_has_are_refused_before(tmp_path: Path):
    index = json.dumps({f"m{k}": f"{k}.stl" for k in range(4)}).encode()
    bomb = archive_of({**{f"{k}.stl": bytes(20 * MIB) for k in range(4)}, INDEX: index})
    assert len(bomb) < MIB
    with pytest.raises(LogError, match=r"files of \d+ bytes, at most"):
        unpacked("<robot/>", "", {MESHES: bomb}, tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_meshes_are_not_unpacked_beyond_what_their_directory_says(tmp_path: Path):
    bomb = archive_of({"0.stl": bytes(300 * MIB), INDEX: b'{"m": "0.stl"}'}, claim=1000)
    tracemalloc.start()
    with contextlib.suppress(LogError):
        unpacked("<robot/>", "", {MESHES: bomb}, tmp_path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 8 * MIB
    assert sum(p.stat().st_size for p in tmp_path.iterdir()) <= 1000


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("slots", 10**12),
        ("slots", -1),
        ("period", 0.0),
        ("period", float("inf")),
        ("joints", ["j"] * 5000),
        ("buses", ["b"] * 5000),
        ("dtype", json.dumps([["q", "<f8", [10**9]]])),
        ("dtype", json.dumps([["q", "<f8", [-1]]])),
    ],
)
def test_a_header_that_asks_for_more_than_any_robot_is_refused(field: str, value: object):
    raw = json.loads(header_to_json(make_header("r", ("a",), 2, 1e-3)))
    with pytest.raises((ValueError, TypeError, KeyError)):
        header_from_json(json.dumps({**raw, field: value}))


def test_a_record_of_any_size_up_to_the_bound_is_taken():
    assert dtype_from_json(json.dumps([["q", "<f8", [limits.TICK // 8]]])).itemsize == limits.TICK


# ---- healthy files are called healthy


def test_frames_of_zstd_or_lz4_one_behind_another_are_one_chunk(tmp_path: Path):
    first, second = message(0, 1), message(0, 2)
    for name, packed in (
        ("zstd", zstd(first) + zstd(second)),
        ("lz4", lz4.frame.compress(first) + lz4.frame.compress(second)),
    ):
        path = file_of(tmp_path / f"{name}.mcap", chunk_of(first + second, packed, name))
        assert read(path)["/x"].time.tolist() == [1, 2]
        done = mend(path)
        assert (done.code, done.messages, done.independent) == (LOSSLESS, 2, 2)
    assert all(f.good for f in examine(path))


def test_an_empty_error_of_a_decompressor_still_gives_a_text(tmp_path: Path):
    path = file_of(tmp_path / "a.mcap", chunk_of(message(0, 1), b"\x28\xb5\x2f\xfd" + bytes(9)))
    good, said = finding(path, "checksums")
    assert not good
    assert len(said.partition("; ")[2]) > len("chunk: zstd: ")


def test_numbers_that_do_not_count_are_no_holes_and_two_publishers_count_each_for_itself(tmp_path: Path):
    still = b"".join(message(0, k) for k in range(5))
    path = file_of(tmp_path / "zero.mcap", chunk_of(still, zstd(still)))
    assert finding(path, "sequence") == (True, "not numbered one by one: /x")
    both = b"".join(message(k // 2, k, channel=1 + k % 2) for k in range(10))
    path = file_of(tmp_path / "two.mcap", chunk_of(both, zstd(both)), topics=("/x", "/x"))
    assert finding(path, "sequence") == (True, "no hole in any topic")
    assert info(path)["topics"]["/x"]["holes"] == 0
    hole = b"".join(message(k, k) for k in (1, 2, 5))
    path = file_of(tmp_path / "hole.mcap", chunk_of(hole, zstd(hole)))
    assert finding(path, "sequence") == (False, "holes: /x 2")


def test_times_beyond_2_63_are_kept_and_told(tmp_path: Path):
    late = b"".join(message(k, t) for k, t in enumerate((5, 1 << 63, (1 << 64) - 1)))
    path = file_of(tmp_path / "late.mcap", chunk_of(late, zstd(late)))
    assert read(path)["/x"].time.tolist() == [5, (1 << 63) - 1, (1 << 63) - 1]
    assert "2 messages are later than 2^63 ns" in finding(path, "time")[1]
    assert info(path)["beyond_2_63_ns"]
    done = mend(path)
    with done.path.open("rb") as file:
        times = [m.log_time for _, _, m in make_reader(file).iter_messages()]
    assert sorted(times) == [5, 1 << 63, (1 << 64) - 1]


def test_a_name_that_is_not_utf_8_is_an_error_of_one_line(tmp_path: Path):
    sink = McapSink(tmp_path / "a.mcap", make_header("r", ("a",), 2, 1e-3))
    sink.put(Kind.EVENT, b"{}", 1)
    sink.close()
    name = bytes(tmp_path) + b"/\xff\xfe.mcap"
    (tmp_path / "a.mcap").rename(name.decode("utf-8", "surrogateescape"))
    for action in ("info", "doctor", "recover", "report", "plot", "export", "replay", "can", "mavlink", "tail"):
        command = [sys.executable.encode(), b"-m", b"rtctl", b"log", action.encode(), name]
        done = subprocess.run(command, capture_output=True, cwd=ROOT, check=False)
        assert done.returncode == 2, (action, done.stderr)
        assert done.stderr.decode() == f"rtctl: {tmp_path!s}/\\xff\\xfe.mcap: its name is not UTF-8; rename it first\n"


# ---- recovery


def test_recovery_leaves_nothing_behind_when_it_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = file_of(tmp_path / "a.mcap", chunk_of(message(0, 1), zstd(message(0, 1))))
    before = path.read_bytes()
    monkeypatch.setattr(sys.modules["rtctl.log.read.mend"], "independent_count", lambda path: 7)
    for _ in range(2):  # the second time nothing is "there already"
        with pytest.raises(LogError, match="1 messages were written, 1 and 7 are read again"):
            mend(path)
        assert [p.name for p in tmp_path.iterdir()] == ["a.mcap"]
    assert path.read_bytes() == before


def test_the_index_of_a_copy_says_the_times_of_its_messages_whatever_they_are(tmp_path: Path):
    """As another program finds them: no integer of 64 bits may go through a float, or be cut to a signed one."""
    first, second = (message(k, (1 << 63) + 12345 + k) for k in range(2))
    path = file_of(
        tmp_path / "a.mcap", chunk_of(first + second, zstd(first) + zstd(second)), topics=("/x", "/log/sentinel")
    )
    path.write_bytes(path.read_bytes()[:-40])  # cut off: the copy is given a sentinel
    copy = mend(path).path.read_bytes()
    said = [r for r in StreamReader(io.BytesIO(copy), emit_chunks=True).records if isinstance(r, MessageIndex)]
    held = [r for r in StreamReader(io.BytesIO(copy)).records if isinstance(r, Message)]
    assert len(held) == 3
    assert sorted(time for index in said for time, _ in index.records) == sorted(m.log_time for m in held)
    assert max(m.log_time for m in held) == (1 << 63) + 12346


def test_what_is_behind_damage_is_found_again(tmp_path: Path):
    parts = [message(k, k) for k in range(6)]
    path = file_of(tmp_path / "a.mcap", *(chunk_of(part, zstd(part)) for part in parts))
    raw = bytearray(path.read_bytes())
    at = raw.index(zstd(parts[2])[:12], raw.index(zstd(parts[1])) + 4)
    head = raw.rindex(struct.pack("<B", CHUNK) + struct.pack("<Q", len(chunk_of(parts[2], zstd(parts[2])))), 0, at)
    raw[head + 1 : head + 9] = struct.pack("<Q", 1 << 40)  # the record's length
    path.write_bytes(raw)
    done = mend(path)
    assert (done.code, done.messages) == (LOSSY, 5)
    assert sorted(read(done.path)["/x"].time.tolist()) == [0, 1, 3, 4, 5]


def test_messages_of_a_channel_that_is_lost_do_not_spoil_the_rest(tmp_path: Path):
    both = message(0, 1) + message(0, 2, channel=9)
    done = mend(file_of(tmp_path / "a.mcap", chunk_of(both, zstd(both))))
    assert (done.code, done.messages, done.independent) == (LOSSY, 1, 1)


def test_a_chunk_whose_length_has_64_bits_is_not_believed(tmp_path: Path):
    sink = McapSink(tmp_path / "a.mcap", make_header("r", ("a",), 2, 1e-3))
    sink.put(Kind.EVENT, b"{}", 1)
    raw = bytearray(sink.close().read_bytes())
    at = raw.index(b"\x04\0\0\0zstd") - 28 - 9  # of the chunk's record
    assert raw[at] == CHUNK
    raw[at + 8] |= 0x80
    (tmp_path / "b.mcap").write_bytes(raw)
    assert info(tmp_path / "b.mcap")["topics"] == {}
    with pytest.raises(LogError):
        _ = read(tmp_path / "b.mcap")["/nothing"]


def test_damaged_files_give_no_traceback(tmp_path: Path):
    """`python -m tools.damage` does it by the ten thousand."""
    assert damage.campaign(tmp_path, 60, seed=5) == []


def test_a_damaged_file_fails_the_command_in_a_line(tmp_path: Path):
    path = tmp_path / "a.mcap"
    path.write_bytes(MAGIC + b"\x06" * 100)
    command = [sys.executable, "-m", "rtctl", "log", "recover", str(path)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False)
    assert (done.returncode, done.stderr) == (EXIT_FAILED, f"rtctl: {path}: nothing in it can be used\n")

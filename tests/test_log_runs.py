"""Runs that do not end: what belongs to one, in which order, what is deleted for room, and what is said too often."""

import itertools
import os
import stat
import struct
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

import pytest

from rtctl.errors import LogError
from rtctl.log import Kind, McapSink, make_header, read, read_run, segments
from rtctl.log.entry import Batch
from rtctl.log.header import header_to_json
from rtctl.log.mcap.names import Origin, origin_of
from rtctl.log.record import health, recorder, writer
from rtctl.log.record.health import DropWatch, Repeats
from rtctl.log.record.recorder import Recorder
from rtctl.log.record.retention import old_segments
from rtctl.log.record.writer import Options, Session
from tests.mcap_conformance import CHANNEL, DATA_END, FOOTER, HEADER, MAGIC, MESSAGE, METADATA, _File, mapping, text

ARM = make_header("arm", ("a", "b"), 2, 1e-3, config="x = 1\n", urdf="<robot/>")
MONTH = 30 * 24 * 6  # segments of ten minutes
STEP = 600_000_000_000  # [ns]
ABOUT = header_to_json(ARM)


def events(count: int, first: int = 1) -> Batch:
    numbers = list(range(first, first + count))
    return Batch([int(Kind.EVENT)] * count, numbers, [n * 1000 for n in numbers], numbers, [b"{}"] * count)


def session(folder: Path, name: str, parts: int = 1, **more: int) -> Session:
    """Leave the segments of a session as its recorder does."""
    written = Session(ARM, Options(folder, name, segment_bytes=1, **more))
    for k in range(parts):
        written.write(events(2, 1 + 2 * k))
        if k + 1 < parts:
            written._synced = 0.0
            written.poll()
    written.close({"reason": "closed"}, 2 * parts)
    return written


def stamps(folder: Path, times: dict[str, int]) -> None:
    for name, at in times.items():
        os.utime(folder / name, (at, at))


# ---- what belongs to a run


def test_two_runs_named_by_their_years_are_two_runs(tmp_path: Path):
    for year in (2026, 2027):
        sink = McapSink(tmp_path / f"run.{year}.mcap", ARM)
        sink.put(Kind.EVENT, b"{}", year)
        sink.close()
    for year in (2026, 2027):
        run = read_run(tmp_path / f"run.{year}.mcap")
        assert run["/event"].time.tolist() == [year]
        assert segments(run.path) == [run.path]


def test_a_run_is_what_says_so_whatever_its_files_are_called(tmp_path: Path):
    session(tmp_path, "arm", 3)
    session(tmp_path, "other", 2)
    (tmp_path / "arm.001.mcap").rename(tmp_path / "middle.mcap")
    (tmp_path / "other.001.mcap").rename(tmp_path / "arm.001.mcap")
    assert [p.name for p in segments(tmp_path / "middle.mcap")] == ["arm.000.mcap", "middle.mcap", "arm.002.mcap"]
    assert read_run(tmp_path / "arm.002.mcap")["/event"].sequence.tolist() == [1, 2, 3, 4, 5, 6]
    assert [p.name for p in segments(tmp_path / "arm.001.mcap")] == ["other.000.mcap", "arm.001.mcap"]


def test_missing_segments_are_named_in_a_short_line(tmp_path: Path):
    for number in (3, 4, 10, 1_790_000_000, *range(1_790_000_010, 1_790_000_100, 2)):
        small_segment(tmp_path, "arm", number, 1, number)
    with pytest.raises(LogError) as error:
        read_run(tmp_path / "arm.004.mcap")
    said = str(error.value)
    assert "segments 005 to 009, 011 to 1789999999, 1790000001 to 1790000009, 1790000011, 1790000013 and" in said
    assert len(said) < 300 + len(str(tmp_path))


def test_a_copy_of_a_segment_is_named_not_read_twice(tmp_path: Path):
    session(tmp_path, "arm", 3)
    (tmp_path / "copy.mcap").write_bytes((tmp_path / "arm.001.mcap").read_bytes())
    with pytest.raises(LogError, match="several files beside it say they are segment 1 of its session"):
        read_run(tmp_path / "arm.000.mcap")


def small_segment(folder: Path, name: str, number: int, order: int, time: int) -> Path:
    """A segment of a kilobyte: its origin, and one message."""
    file = _File(False)
    file.data += MAGIC
    file.add(HEADER, text("") + text(""))
    file.add(CHANNEL, struct.pack("<HH", 1, 0) + text("/event") + text("json") + mapping({}))
    about = {"header": ABOUT, "session": name, "segment": str(number), "session_order": str(order)}
    file.add(METADATA, text("rtctl") + mapping(about))
    file.add(MESSAGE, struct.pack("<HIQQ", 1, number & 0xFFFFFFFF, time, time) + b"{}")
    file.add(DATA_END, bytes(4))
    file.add(FOOTER, bytes(20))
    path = folder / f"{name}.{number:03d}.mcap"
    path.write_bytes(bytes(file.data) + MAGIC)
    return path


@pytest.fixture(scope="module")
def month(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A month of segments of ten minutes: more than there may be open files, numbers of three and four digits."""
    folder = tmp_path_factory.mktemp("month")
    for number in range(MONTH):
        small_segment(folder, "arm", number, 2, (number + 1) * STEP)
    return folder


def test_a_month_of_segments_is_one_run_in_the_order_of_its_numbers(month: Path):
    run = read_run(month / f"arm.{MONTH - 1}.mcap")
    assert len(run.logs) == MONTH
    assert run["/event"].sequence.tolist() == list(range(MONTH))
    assert run.count("/event") == MONTH
    assert run.span == (STEP, MONTH * STEP)
    part = run.window("/event", 11 * STEP, 13 * STEP)
    assert part.sequence.tolist() == [10, 11]


def test_the_floor_deletes_a_month_from_its_beginning(month: Path):
    """Last: it takes the files away. An older session goes first, whatever its name and the files' times say."""
    for number in (998, 999, 1000):
        small_segment(month, "zzz", number, 1, 0)
    stamps(month, {"arm.000.mcap": 2_000_000_000, "arm.1000.mcap": 1, "zzz.998.mcap": 2_100_000_000})
    gone: list[str] = []
    there = {p.name for p in month.iterdir()}

    def free(folder: Path) -> int:
        while not (folder / wanted[len(gone)]).exists():  # another file gone, and this never ends before all are
            gone.append(wanted[len(gone)])
        return 100 if len(gone) >= 1007 else 0

    wanted = ["zzz.998.mcap", "zzz.999.mcap", "zzz.1000.mcap", *(f"arm.{k:03d}.mcap" for k in range(1100))]
    written = Session(ARM, Options(month, "now", floor_bytes=10), free=free)
    written._synced = 0.0
    written.poll()
    assert not written.degraded
    written.close({"reason": "closed"})
    assert gone == wanted[:1007]
    assert {p.name for p in month.iterdir()} == there - set(gone) | {"now.000.mcap"}


# ---- sessions and clocks


def test_a_turn_that_two_segments_share_has_one_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    offsets = iter([5_000_000_000, 5_000_000_007, 5_000_999_999, 6_000_000_000])
    monkeypatch.setattr(writer, "clock_offset", lambda: next(offsets))
    session(tmp_path, "arm", 4)
    logs = [read(path) for path in segments(tmp_path / "arm.000.mcap")]
    assert [log.offset for log in logs] == [5_000_000_000] * 3 + [6_000_000_000]
    assert logs[1]["/event"].time.tolist() == [5_000_003_000, 5_000_004_000]


def test_a_session_at_1970_is_behind_yesterday_s(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    session(tmp_path, "arm-20260101T120000000Z", 2)
    monkeypatch.setattr("time.time_ns", lambda: 12_000_000_000)
    session(tmp_path, "arm-19700101T000012000Z", 2)
    names = ["arm-20260101T120000000Z.000.mcap", "arm-20260101T120000000Z.001.mcap"]
    names += ["arm-19700101T000012000Z.000.mcap", "arm-19700101T000012000Z.001.mcap"]
    stamps(tmp_path, {names[2]: 12, names[3]: 13})
    assert [p.name for p in old_segments(tmp_path)] == names
    assert origin_of(tmp_path / names[3]) == Origin(2, "arm-19700101T000012000Z", 1)
    assert (log := read(tmp_path / names[2])).complete
    assert log.offset == 0


def test_a_recorder_that_goes_on_keeps_its_session_s_place(tmp_path: Path):
    session(tmp_path, "first")
    session(tmp_path, "second")
    again = Session(ARM, Options(tmp_path, "first"), first=1)
    again.close({"reason": "closed"})
    assert origin_of(tmp_path / "first.001.mcap") == Origin(1, "first", 1)


def test_logs_of_before_there_were_places_go_first_and_other_programs_files_never(tmp_path: Path):
    old = small_segment(tmp_path, "old", 0, 0, 0)
    session(tmp_path, "arm", 2)
    for name in ("run.2026.mcap", "arm.999.mcap"):  # a simulation's, and one that bears another's name
        sink = McapSink(tmp_path / name, ARM)
        sink.close()
    (tmp_path / "noise.000.mcap").write_bytes(b"noise")
    assert [p.name for p in old_segments(tmp_path)] == [old.name, "arm.000.mcap", "arm.001.mcap"]


def test_two_sessions_that_begin_at_one_instant_have_two_names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    class Stopped(datetime):
        @classmethod
        def now(cls, tz: object = None) -> datetime:  # type: ignore[override]
            return datetime(1970, 1, 1, tzinfo=UTC)

    monkeypatch.setattr(recorder, "datetime", Stopped)
    names = []
    for _ in range(3):
        names.append(recorder._session_name(tmp_path, "arm"))
        session(tmp_path, names[-1])
    assert names == ["arm-19700101T000000000Z", "arm-19700101T000000000Z-2", "arm-19700101T000000000Z-3"]


def test_logs_are_for_the_group_at_most(tmp_path: Path):
    before = os.umask(0)
    try:
        session(tmp_path, "arm")
        McapSink(tmp_path / "sim.mcap", ARM).close()
    finally:
        os.umask(before)
    assert {stat.S_IMODE(p.stat().st_mode) for p in tmp_path.glob("*.mcap")} == {0o640}


# ---- what is lost, and what is said too often


def test_drops_above_the_stated_rate_degrade_the_log_and_it_recovers():
    watch = DropWatch()
    assert not watch.update(0.0, 0, 0)
    assert not watch.update(1.0, 10_000, 0)
    assert not watch.update(2.0, 20_000, 100)  # one in a hundred: as stated
    assert watch.update(3.0, 30_000, 201)
    assert watch.update(3.0 + health.HOLD - 0.1, 80_000, 201)
    assert not watch.update(3.0 + health.HOLD, 81_000, 201)


def test_a_recorder_that_does_not_keep_up_makes_the_log_degraded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    log = Recorder.start(tmp_path / "log", ARM, folders=[tmp_path], capacity=1 << 16)
    try:
        ticks = itertools.count(100.0, 1.0)
        monkeypatch.setattr(recorder.time, "monotonic", lambda: next(ticks))
        assert not log.stats().degraded
        while not log._ring.counts().dropped:
            log.put_many(Kind.EVENT, [bytes(1000)] * 200, 1)
        monkeypatch.undo()
        monkeypatch.setattr(recorder.time, "monotonic", lambda: 1000.0)
        assert log.stats().degraded
    finally:
        monkeypatch.undo()
        log.close()


def flood() -> Iterator[tuple[float, list[tuple[str, str]]]]:
    for k in range(20_000):
        yield k * 1e-3, [("rejected", f"goal: {k} m away")] + ([("fault", "bus_off: can0")] if k == 9000 else [])


def test_an_event_that_repeats_is_told_ten_times_and_then_counted():
    repeats = Repeats()
    told = [(now, *event) for now, events in flood() for event in repeats.passed(now, events)]
    assert len(told) == 2 * health.BURST + 2
    assert (9.0, "fault", "bus_off: can0") in told  # another kind is not kept back
    assert (10.0, "repeated", "rejected goal: 9990 more in 10 s") in told

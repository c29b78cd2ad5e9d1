"""The recorder process: nothing that was put is lost, whoever is killed; nothing it meets stops the producer."""

import fcntl
import json
import os
import resource
import signal
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader

from rtctl.errors import LogError
from rtctl.log import Header, Kind, make_header, read, segments
from rtctl.log.entry import Batch
from rtctl.log.mcap.recovery import recover_folder
from rtctl.log.read.info import info
from rtctl.log.record import ring
from rtctl.log.record.leftovers import sweep
from rtctl.log.record.recorder import Recorder, blob_of, rescue
from rtctl.log.record.writer import Options, Session, segment_path

HEADER = make_header("arm", ("a", "b"), 2, 1e-3, config="x = 1\n", urdf="<robot/>")
FRAMES = [struct.pack("=IB3x8s", 1 + i, 8, bytes(8)) for i in range(7)]
Start = Callable[..., Recorder]


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    running: list[Recorder] = []

    def begin(**options: int | float) -> Recorder:
        recorder = Recorder.start(tmp_path / "log", HEADER, folders=[tmp_path], **options)  # type: ignore[arg-type]
        running.append(recorder)
        return recorder

    yield begin
    for recorder in running:
        if recorder.alive:
            os.kill(recorder.pid, signal.SIGKILL)
            recorder._process.wait()  # type: ignore[union-attr]


def put_ticks(recorder: Recorder, ticks: range, pause: float = 0.0) -> None:
    record = np.zeros((), HEADER.dtype)
    for k in ticks:
        record["tick"], now = k, time.monotonic_ns()
        recorder.put_many(Kind.CAN_RX, FRAMES, now)
        recorder.put(Kind.TICK, record.tobytes(), now)
        recorder.put_many(Kind.CAN_TX, FRAMES, now)
        time.sleep(pause)


def logged(folder: Path) -> tuple[list[int], list[int], list[dict[str, object]]]:
    """Return, over all files of a folder: the ticks, the CAN sequence numbers and the sentinels; by mcap's reader."""
    ticks: list[int] = []
    frames: list[int] = []
    sentinels: list[dict[str, object]] = []
    assert not list(folder.glob("*.open"))
    for path in sorted(folder.glob("*.mcap")):
        with path.open("rb") as file:
            for _, channel, message in make_reader(file, validate_crcs=True).iter_messages(log_time_order=False):
                if channel.topic == "/can/can0":
                    frames.append(message.sequence)
                elif channel.topic == "/log/sentinel":
                    sentinels.append(json.loads(message.data))
        ticks += read(path)["/tick"].tick.tolist()
    return ticks, frames, sentinels


def wait_for(condition: Callable[[], bool]) -> None:
    until = time.monotonic() + 30.0
    while not condition():
        assert time.monotonic() < until, "did not happen"
        time.sleep(0.01)


def test_everything_put_is_in_the_file_in_order(start: Start, tmp_path: Path) -> None:
    recorder = start()
    put_ticks(recorder, range(400))
    stats = recorder.close("done", "said the test")
    assert (stats.entries, stats.dropped, stats.lost, stats.degraded) == (400 * 15 + 1, 0, 0, False)
    ticks, frames, (sentinel,) = logged(tmp_path / "log")
    assert ticks == list(range(400))
    assert frames == list(range(1, 400 * 14 + 1))
    assert (sentinel["reason"], sentinel["detail"]) == ("done", "said the test")
    assert stats.path.exists()
    assert not recorder.ring_path.exists()


def test_log_time_is_the_wall_clock_at_one_offset_from_the_monotonic_clock(start: Start) -> None:
    recorder = start()
    before, now = time.time_ns(), time.monotonic_ns()
    for k in range(100):
        recorder.put(Kind.EVENT, b"{}", now + k)
    after = time.time_ns()
    log = read(recorder.close().path)
    assert (np.diff(log["/event"].time) == 1).all()
    assert log["/event"].time[0] - log.offset == now
    assert before - 10_000_000 < log["/event"].time[0] < after + 10_000_000


def test_a_recorder_that_gets_on_is_waited_for_however_slow_the_machine_is(
    start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorder = start()
    put_ticks(recorder, range(50))
    counts, waiting, now = recorder._ring.counts, list(range(1, 41)), [0.0]

    def slow() -> ring.Counts:
        return counts()._replace(backlog=waiting.pop(), finished=False) if waiting else counts()

    def clock() -> float:
        now[0] += 3.0 if waiting else 0.0  # from each look to the next
        return now[0]

    monkeypatch.setattr(recorder._ring, "counts", slow)
    told = SimpleNamespace(monotonic=clock, monotonic_ns=time.monotonic_ns, sleep=time.sleep)
    monkeypatch.setattr("rtctl.log.record.recorder.time", told)
    stats = recorder.close()
    assert not waiting
    assert stats.path.exists()


def test_signals_meant_for_the_group_do_not_end_the_recorder(start: Start, tmp_path: Path) -> None:
    recorder = start()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        os.kill(recorder.pid, number)
    put_ticks(recorder, range(50))
    assert recorder.alive
    recorder.close()
    assert logged(tmp_path / "log")[0] == list(range(50))


def test_a_ring_that_is_full_costs_the_newest_and_the_log_says_how_many_and_when(start: Start, tmp_path: Path) -> None:
    recorder = start(capacity=1 << 16)
    put_ticks(recorder, range(5))
    wait_for(lambda: recorder.stats().backlog == 0)
    os.kill(recorder.pid, signal.SIGSTOP)
    put_ticks(recorder, range(5, 300))
    dropped = recorder.stats().dropped
    assert dropped > 100
    os.kill(recorder.pid, signal.SIGCONT)
    wait_for(lambda: recorder.stats().backlog == 0)
    put_ticks(recorder, range(300, 305))
    stats = recorder.close()
    assert stats.dropped == dropped
    found = info(stats.path)
    assert found["dropouts"]["entries"] == dropped
    topics = found["topics"]
    assert topics["/tick"]["holes"] + topics["/can/can0"]["holes"] == dropped
    assert topics["/tick"]["messages"] + topics["/can/can0"]["messages"] == stats.entries - 1 - dropped
    (first, *_) = read(stats.path)["/log/dropout"].json
    assert first["from_ns"] <= first["to_ns"]


def test_entries_dropped_at_the_very_end_are_told_too(start: Start) -> None:
    recorder = start(capacity=1 << 16)
    os.kill(recorder.pid, signal.SIGSTOP)
    put_ticks(recorder, range(300))
    dropped = recorder.stats().dropped
    os.kill(recorder.pid, signal.SIGCONT)
    wait_for(lambda: recorder.stats().backlog == 0)
    assert info(recorder.close().path)["dropouts"]["entries"] == dropped > 0


def test_a_killed_recorder_loses_nothing_and_doubles_nothing(start: Start, tmp_path: Path) -> None:
    recorder = start()
    for k in range(4):
        put_ticks(recorder, range(300 * k, 300 * k + 300), 0.0005)
        os.kill(recorder.pid, signal.SIGKILL)
        wait_for(lambda: not recorder.alive)
        assert recorder.stats().degraded
        if k < 3:  # the last time `close` has to
            recorder.spawn()
    stats = recorder.close()
    assert not stats.degraded
    ticks, frames, sentinels = logged(tmp_path / "log")
    assert ticks == list(range(1200))
    assert frames == list(range(1, 1200 * 14 + 1))
    assert sentinels[-1]["reason"] == "closed"


PRODUCER = """
import sys, os, time
sys.path[:0] = sys.argv[2:]
import test_recorder as t
from pathlib import Path
from types import SimpleNamespace
from typing import Any
recorder = t.Recorder.start(Path(sys.argv[1]) / "log", t.HEADER, folders=[Path(sys.argv[1])])
os.write(1, recorder.pid.to_bytes(8, "little"))
k = 0
while True:
    t.put_ticks(recorder, range(k, k + 1), 0.0002)
    k += 1
    os.write(1, k.to_bytes(8, "little"))
"""


def test_a_recorder_that_the_system_refuses_is_told_and_started_once_it_may(start: Start, tmp_path: Path) -> None:
    recorder = start()
    put_ticks(recorder, range(100))
    os.kill(recorder.pid, signal.SIGKILL)
    wait_for(lambda: not recorder.alive)
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (3, hard))  # no descriptor is left
    try:
        recorder.spawn()  # as the loop does once a second: it must go on
        assert recorder.refusal == "too many open files"
        assert recorder.stats().degraded
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    recorder.spawn()
    assert recorder.refusal == ""
    assert recorder.close().dropped == 0
    assert logged(tmp_path / "log")[0] == list(range(100))


def killed(folder: Path, ticks: int, both: bool) -> tuple[int, int]:
    """Run a producer for some ticks and kill it, and its recorder too if asked; return (recorder's pid, ticks put)."""
    command = [sys.executable, "-c", PRODUCER, str(folder), str(Path(__file__).parent)]
    with ExitStack() as stack:
        process = stack.enter_context(subprocess.Popen(command, stdout=subprocess.PIPE))
        assert process.stdout is not None
        pid = int.from_bytes(process.stdout.read(8), "little")
        assert pid > 1
        seen = process.stdout.read(8 * ticks)
        if both:
            os.kill(pid, signal.SIGKILL)
        process.kill()
        seen += process.stdout.read()
        return pid, int.from_bytes(seen[-8:], "little")


def test_when_the_producer_is_killed_the_recorder_finishes_the_file(tmp_path: Path) -> None:
    _, put = killed(tmp_path, 400, both=False)
    wait_for(lambda: not list(tmp_path.glob("*.ring")))
    ticks, frames, (sentinel,) = logged(tmp_path / "log")
    assert ticks == list(range(len(ticks)))
    assert len(ticks) >= put
    assert frames == list(range(1, len(frames) + 1))
    assert sentinel["reason"] == "producer died"


@pytest.mark.parametrize("ticks", [3, 150, 700])
def test_when_both_are_killed_the_next_start_rescues_what_was_put(tmp_path: Path, ticks: int) -> None:
    _, put = killed(tmp_path, ticks, both=True)
    rescued = rescue(tmp_path / "log", [tmp_path])
    assert rescued
    assert not list(tmp_path.glob("*.ring"))
    found, frames, sentinels = logged(tmp_path / "log")
    assert found == list(range(len(found)))
    assert len(found) >= put
    assert frames == list(range(1, len(frames) + 1))
    assert sentinels[-1]["reason"] == "producer died"
    assert rescue(tmp_path / "log", [tmp_path]) == []


def held(*paths: Path) -> list[int]:
    """Lock files as a process does that was killed and has not ended yet; closing them lets go."""
    files = [os.open(path, os.O_RDWR) for path in paths]
    for file in files:
        fcntl.flock(file, fcntl.LOCK_EX)
    return files


def test_a_rescue_waits_for_one_that_is_dying_and_leaves_what_one_that_lives_has(tmp_path: Path) -> None:
    _, put = killed(tmp_path, 150, both=True)
    ring, left = *tmp_path.glob("*.ring"), *(tmp_path / "log").glob("*.open")
    files = held(ring, left)
    assert rescue(tmp_path / "log", [tmp_path]) == []
    assert ring.exists()
    assert left.exists()
    for file in files:
        threading.Timer(0.2, os.close, (file,)).start()
    assert rescue(tmp_path / "log", [tmp_path])
    assert not ring.exists()
    assert len(logged(tmp_path / "log")[0]) >= put


def test_a_new_recorder_rescues_the_logs_of_its_folder(start: Start, tmp_path: Path) -> None:
    _, put = killed(tmp_path, 100, both=True)
    recorder = start()
    wait_for(lambda: len(list(tmp_path.glob("*.ring"))) == 1)
    recorder.close()
    assert logged(tmp_path / "log")[0] == list(range(len(logged(tmp_path / "log")[0])))
    assert len(logged(tmp_path / "log")[0]) >= put


def test_a_file_that_reaches_its_limit_is_closed_whole_and_the_producer_goes_on(start: Start, tmp_path: Path) -> None:
    recorder = start()
    resource.prlimit(recorder.pid, resource.RLIMIT_FSIZE, (60_000, resource.RLIM_INFINITY))
    noise = np.random.default_rng(0)
    for _ in range(200):
        recorder.put(Kind.EVENT, json.dumps({"message": noise.bytes(1000).hex()}).encode(), time.monotonic_ns())
        time.sleep(0.002)
    wait_for(lambda: recorder.stats().degraded)
    assert recorder.alive
    assert recorder.put(Kind.EVENT, b"{}", time.monotonic_ns())
    wait_for(lambda: recorder.stats().backlog == 0)
    stats = recorder.close()
    assert stats.degraded
    assert stats.lost > 0
    _, _, (sentinel,) = logged(tmp_path / "log")
    assert str(sentinel["reason"]).startswith("disk")
    assert stats.path.stat().st_size <= 60_000


def test_a_recorder_that_cannot_write_comes_up_degraded(tmp_path: Path) -> None:
    (tmp_path / "log").write_text("a file where the folder should be")
    recorder = Recorder.start(tmp_path / "log", HEADER, folders=[tmp_path])
    put_ticks(recorder, range(10))
    assert recorder.stats().degraded
    assert recorder.close().lost == 150


def test_without_a_recorder_the_start_fails_with_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rtctl.log.record.recorder.sys.executable", "/bin/false")
    with pytest.raises(LogError, match="did not start"):
        Recorder.start(tmp_path / "log", HEADER, folders=[tmp_path])
    assert not list(tmp_path.glob("*.ring"))


def events(count: int, first: int = 1) -> Batch:
    numbers = list(range(first, first + count))
    return Batch([Kind.EVENT] * count, numbers, numbers, numbers, [b"{}"] * count)


def options(folder: Path, header: Header = HEADER, **more: Any) -> Options:
    return Options(folder, header.robot)._replace(**more)


def test_segments_follow_one_another_and_their_numbers_go_on(tmp_path: Path) -> None:
    session = Session(HEADER, options(tmp_path, segment_bytes=1))
    for k in range(3):
        session.write(events(10, 1 + 10 * k))
        session._synced = 0.0
        session.poll()
    session.close({"reason": "closed"}, 30)
    files = segments(segment_path(session.options, 1))
    assert [p.name for p in files] == ["arm.000.mcap", "arm.001.mcap", "arm.002.mcap", "arm.003.mcap"]
    numbers = [n for p in files for n in read(p)["/event"].sequence.tolist()]
    assert numbers == list(range(1, 31))
    assert read(files[0]).sentinel["next"] == files[1].name


def segment_of(folder: Path, session: str, number: int = 0) -> Path:
    """Leave a closed segment as a recorder does."""
    written = Session(HEADER, Options(folder, session), first=number)
    written.write(events(3))
    written.close({"reason": "closed"}, 3)
    return written.path


def test_the_disk_floor_is_kept_by_deleting_the_oldest_unpinned_logs(tmp_path: Path) -> None:
    for name in ("old", "pinned", "newer"):
        segment_of(tmp_path, name)
    (tmp_path / "pinned.000.mcap.pin").touch()
    free = iter([5, 20])
    session = Session(HEADER, options(tmp_path, floor_bytes=10), free=lambda folder: next(free))
    session._synced = 0.0
    session.poll()
    assert not session.degraded
    session.close({"reason": "closed"})
    assert sorted(p.name for p in tmp_path.glob("*.mcap")) == ["arm.000.mcap", "newer.000.mcap", "pinned.000.mcap"]


def test_under_the_floor_the_log_is_closed_whole_and_goes_on_when_there_is_room(tmp_path: Path) -> None:
    free = 1
    session = Session(HEADER, options(tmp_path, floor_bytes=10), free=lambda folder: free)
    session.write(events(5))
    session._synced = 0.0
    session.poll()
    assert session.degraded
    assert read(tmp_path / "arm.000.mcap").sentinel["reason"] == "disk floor"
    session.write(events(5, 6))
    assert session.lost == 5
    free, session._synced = 1 << 40, 0.0
    session.poll()
    assert not session.degraded
    session.write(events(5, 11))
    session.close({"reason": "closed"}, 15)
    log = read(tmp_path / "arm.001.mcap")
    assert log["/event"].sequence.tolist() == [11, 12, 13, 14, 15]
    assert [d["count"] for d in log["/log/dropout"].json] == [5]


def test_a_file_in_use_is_not_recovered_under_its_writer(tmp_path: Path) -> None:
    session = Session(HEADER, options(tmp_path))
    session.write(events(5))
    assert recover_folder(tmp_path) == []
    session.close({"reason": "closed"})
    assert len(read(tmp_path / "arm.000.mcap")["/event"]) == 5


def test_rings_of_simulations_that_were_killed_are_removed_and_no_others(tmp_path: Path) -> None:
    """Each holds 32 MB of memory. One that a log is still to be made of stays, whatever its robot is called."""
    make = (
        "import os, sys; from pathlib import Path; from rtctl.log import make_header; "
        "from rtctl.log.record.recorder import blob_of; from rtctl.log.record.ring import create; "
        "header = make_header('arm', ('a',), 2, 1e-3); "
        "create(sys.argv[1], 4096, blob_of(header, eval(sys.argv[2])), [Path(sys.argv[3])]); os._exit(0)"
    )
    killed, logged_, living_ = (f"rtctl-{name}.ring" for name in ("arm-sim-1", "my-sim-2", "arm-sim-3"))
    log = [str(tmp_path / "log"), "arm", 60.0, 1 << 20, 0]
    for name, options in ((killed, []), (logged_, log)):
        subprocess.run([sys.executable, "-c", make, name, repr(options), str(tmp_path)], check=True)
    mine = ring.create(living_, 4096, blob_of(HEADER), [tmp_path])
    (tmp_path / "rtctl-none.ring").write_bytes(b"no ring")
    sweep([tmp_path])
    assert {path.name for path in tmp_path.glob("*.ring")} == {logged_, living_, "rtctl-none.ring"}
    mine.unmap()

"""The drives' own clock in real time, and the report that must not make it late."""

import json
import threading
import time
from pathlib import Path

import pytest

from firmware_sim import __main__ as main
from firmware_sim.writer import Writer

STEP = 500_000  # [ns]
MS = 1_000_000


class Wall:
    """A wall clock that goes as told [ns]."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 5_000 * MS
        monkeypatch.setattr(time, "monotonic_ns", lambda: self.now)


@pytest.fixture
def wall(monkeypatch: pytest.MonkeyPatch) -> Wall:
    return Wall(monkeypatch)


def steps(clock: main.Clock) -> int:
    """Take all the steps that are due."""
    taken = 0
    while clock.due():
        taken += 1
    return taken


def test_steps_keep_to_the_grid_however_late_they_are_taken(wall: Wall) -> None:
    clock, taken = main.Clock(STEP), 0
    assert not clock.due()
    for wait in (1, 3, 2, 0, 4, 1):
        wall.now += wait * MS + 1000
        taken += steps(clock)
    assert taken == 22  # 11 ms
    assert clock.account()["slipped_steps"] == 0
    assert clock.account()["max_late_s"] == pytest.approx(0.0035, abs=1e-5)


def test_more_than_ten_milliseconds_are_given_up_and_counted(wall: Wall) -> None:
    clock = main.Clock(STEP)
    wall.now += 80 * MS
    taken = steps(clock)
    told = clock.account()
    assert taken <= 21  # no rush that would outrun a watchdog of 20 ms
    assert taken * STEP / 1e9 + told["slipped_s"] == pytest.approx(0.080)
    assert told["max_late_s"] == pytest.approx(0.0795)
    wall.now += MS
    assert steps(clock) == 2  # back on the grid


def test_what_was_late_before_the_arm_was_driven_is_told_apart(wall: Wall) -> None:
    clock = main.Clock(STEP)
    wall.now += 80 * MS
    steps(clock)
    lost = clock.account()["slipped_steps"]
    clock.forget()
    wall.now += MS
    steps(clock)
    assert clock.account() == {"slipped_steps": lost, "slipped_s": 0.0, "max_late_s": pytest.approx(0.0005)}


def test_a_report_is_whole_whenever_it_is_read_and_the_last_one_stays(tmp_path: Path) -> None:
    path = tmp_path / "report.json"
    writer = Writer(str(path))
    writing = True
    seen: list[int] = []

    def read() -> None:
        while writing:
            if path.exists():
                seen.append(len(json.loads(path.read_text())["filling"]))

    reader = threading.Thread(target=read)
    reader.start()
    for size in range(0, 60_000, 500):
        writer.put(json.dumps({"filling": [0] * size}).encode())
        time.sleep(0.002)
    while len(set(seen)) <= 3 and reader.is_alive():
        writer.put(json.dumps({"filling": [0] * (60_000 + len(seen))}).encode())
        time.sleep(0.002)
    writer.put(bytes(1 << 22))  # too long: dropped
    writing = False
    reader.join()
    writer.close(b"{}")
    assert path.read_text() == "{}"
    assert seen == sorted(seen)
    assert len(set(seen)) > 3
    assert [p.name for p in tmp_path.iterdir()] == ["report.json"]

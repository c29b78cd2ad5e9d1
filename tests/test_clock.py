"""The grid: absolute, never bursting, counting what it skipped; and the rights a process asks for."""

import ctypes
import errno
import gc
import os
import signal
import struct
import subprocess
import sys
import time
from itertools import islice, pairwise
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtctl.errors import EXIT_CONFIG, ConfigError
from rtctl.hal import clock
from rtctl.hal.clock import Slot, grid, light_sleep, lockstep, realtime, sleep_until

PERIOD = 0.001
STEP = 1_000_000


class Time:
    """A clock that moves only when told: by sleeping, with a wake-up latency, or by work. [ns]"""

    def __init__(self, latency: int = 0) -> None:
        self.ns, self.latency = 5_000_000_123, latency
        self.sleeps: list[int] = []

    def now(self) -> int:
        return self.ns

    def sleep(self, when: int) -> None:
        self.sleeps.append(when)
        self.ns = max(self.ns, when) + self.latency


def turns(t: Time, works: list[int]) -> list[tuple[Slot, int]]:
    """Return slots and the times they began at; the work of each turn takes so long."""
    out = []
    clock_of = grid(PERIOD, now=t.now, sleep=t.sleep)
    for slot, work in zip(clock_of, works, strict=False):
        out.append((slot, t.ns))
        t.ns += work
    return out


def test_an_idle_loop_wakes_on_the_grid() -> None:
    t = Time(latency=70_000)
    out = turns(t, [100_000] * 50)
    assert [s.slot for s, _ in out] == list(range(50))
    assert {b - a for (_, a), (_, b) in pairwise(out)} == {STEP}  # latency does not add up
    assert all(s.missed == 0 and s.lateness == pytest.approx(70e-6) for s, _ in out)


def test_a_turn_that_takes_too_long_costs_its_slots_and_no_more() -> None:
    t = Time()
    out = turns(t, [100_000, 3_700_000, 100_000, 100_000])
    # work from slot 1 to 4.7: slots 2, 3 and 4 are gone, 5 is on time
    assert [(s.slot, s.missed) for s, _ in out] == [(0, 0), (1, 0), (5, 3), (6, 0)]
    assert out[2][0].lateness == 0.0


def test_a_turn_may_begin_late_within_the_first_half_of_its_slot() -> None:
    t = Time()
    out = turns(t, [1_300_000, 100_000, 1_600_000, 100_000])
    assert [(s.slot, s.missed) for s, _ in out] == [(0, 0), (1, 0), (2, 0), (4, 1)]
    assert out[1][0].lateness == pytest.approx(300e-6)


@given(st.lists(st.integers(0, 12 * STEP), max_size=40), st.integers(0, STEP // 3))
def test_no_burst_and_no_slot_is_lost_count_of(works: list[int], latency: int) -> None:
    out = turns(Time(latency), works)
    begun = 5_000_000_123 + STEP
    for slot, at in out:
        assert slot.lateness * clock.NS == pytest.approx(at - begun - slot.slot * STEP, abs=0.5)
        assert 0 <= at - begun - slot.slot * STEP <= STEP // 2 + latency
    for (before, a), (after, b) in pairwise(out):
        assert after.slot == before.slot + 1 + after.missed
        assert b - a >= STEP // 2 - latency


def test_after_a_long_stop_there_is_one_turn_not_a_thousand() -> None:
    t = Time()
    slots = grid(PERIOD, now=t.now, sleep=t.sleep)
    next(slots)
    t.ns += 1000 * STEP  # SIGSTOP and SIGCONT
    assert next(slots) == Slot(1000, 999, 0.0)
    t.ns += STEP // 10
    assert next(slots) == Slot(1001, 0, 0.0)


def test_a_signal_that_cuts_a_sleep_short_does_not_start_a_turn_early() -> None:
    t = Time()

    def interrupted(when: int) -> None:
        t.sleeps.append(when)
        t.ns += (when - t.ns + 1) // 2  # wakes half way, again and again

    slots = grid(PERIOD, now=t.now, sleep=interrupted)
    start = t.ns
    next(slots)
    assert t.ns == start + STEP
    assert len(t.sleeps) > 10


def test_the_last_part_of_the_wait_may_be_spent_awake() -> None:
    t = Time()

    def ticking() -> int:
        t.ns += 1000
        return t.ns

    slots = grid(PERIOD, spin=200e-6, now=ticking, sleep=t.sleep)
    start = t.ns + 1000 + STEP
    next(slots)
    assert t.sleeps == [start - 200_000]
    assert start <= t.ns <= start + 2000


def test_lockstep_has_the_same_form_and_no_time() -> None:
    assert list(islice(lockstep(), 3)) == [Slot(0, 0, 0.0), Slot(1, 0, 0.0), Slot(2, 0, 0.0)]


def test_sleeping_ends_at_the_monotonic_time_asked_for() -> None:
    when = time.monotonic_ns() + 3_000_000
    sleep_until(when)
    assert time.monotonic_ns() >= when
    sleep_until(0)  # long past: returns


def test_a_handler_runs_during_the_sleep() -> None:
    ran: list[int] = []
    before = signal.signal(signal.SIGALRM, lambda number, _: ran.append(number))
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.01)
        sleep_until(time.monotonic_ns() + 5 * clock.NS)
        assert ran == [signal.SIGALRM]
    finally:
        signal.signal(signal.SIGALRM, before)


def test_an_impossible_time_is_an_error() -> None:
    with pytest.raises(OSError, match=r"Invalid argument") as caught:
        sleep_until(-1)
    assert caught.value.errno == errno.EINVAL


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Every call that would change this process, recorded instead."""
    calls: list[str] = []

    class Libc:
        def mlockall(self, flags: int) -> int:
            calls.append(f"mlockall {flags}")
            return 0

    monkeypatch.setattr(clock, "_libc", Libc())
    monkeypatch.setattr(os, "sched_setscheduler", lambda *a: calls.append(f"scheduler {a[1]} {a[2].sched_priority}"))
    monkeypatch.setattr(os, "sched_setaffinity", lambda pid, cores: calls.append(f"affinity {cores}"))
    monkeypatch.setattr(gc, "freeze", lambda: calls.append("freeze"))
    monkeypatch.setattr(gc, "disable", lambda: calls.append("disable"))
    return calls


def refuse(*arguments: object) -> None:
    raise PermissionError(errno.EPERM, "Operation not permitted")


@pytest.mark.parametrize("mode", ["required", "best-effort"])
def test_what_is_granted_is_reported(asked: list[str], mode: str) -> None:
    assert realtime(mode, cpu=1, priority=42) == (True, True, True, ())
    assert asked == ["affinity {1}", "mlockall 3", f"scheduler {os.SCHED_FIFO} 42", "freeze", "disable"]


def test_any_core_asks_for_none(asked: list[str]) -> None:
    assert realtime("required").affinity
    assert not any(call.startswith("affinity") for call in asked)


def test_required_rights_that_are_refused_end_the_start(asked: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    with pytest.raises(ConfigError, match="SCHED_FIFO priority 80") as caught:
        realtime("required", place="panda.toml: loop.realtime")
    assert caught.value.exit_code == EXIT_CONFIG
    assert caught.value.place == "panda.toml: loop.realtime"
    assert "best-effort" in caught.value.wanted


def test_best_effort_reports_each_refusal_and_goes_on(asked: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    class Libc:
        def mlockall(self, flags: int) -> int:
            ctypes.set_errno(errno.ENOMEM)
            return -1

    monkeypatch.setattr(clock, "_libc", Libc())
    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    monkeypatch.setattr(os, "sched_setaffinity", refuse)
    report = realtime("best-effort", cpu=0)
    assert (report.scheduler, report.memory, report.affinity) == (False, False, False)
    assert len(report.refused) == 3
    assert "Cannot allocate memory" in report.refused[1]
    assert asked == ["freeze", "disable"]


def test_a_real_process_gets_what_it_may_and_says_the_rest() -> None:
    code = (
        "import gc; from rtctl.hal.clock import realtime; r = realtime('best-effort', cpu=0, priority=1);"
        "assert r.affinity, r; assert len(r.refused) == (not r.memory) + (not r.scheduler), r;"
        "assert not gc.isenabled(); assert gc.get_freeze_count() > 0"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


def test_the_wish_for_light_sleep_is_held_as_long_as_it_lasts(tmp_path: Path) -> None:
    device = tmp_path / "latency"
    device.touch()
    with light_sleep(device) as refused:
        assert refused == ""
        assert device.read_bytes() == struct.pack("=i", 0)  # [us]; what the kernel's interface takes
        held = [os.readlink(f"/proc/self/fd/{fd}") for fd in os.listdir("/proc/self/fd") if _open(fd)]
        assert str(device) in held
    assert str(device) not in [os.readlink(f"/proc/self/fd/{fd}") for fd in os.listdir("/proc/self/fd") if _open(fd)]


def _open(fd: str) -> bool:
    return os.path.lexists(f"/proc/self/fd/{fd}")


def test_who_may_not_wish_goes_on_and_says_why(tmp_path: Path) -> None:
    with light_sleep(tmp_path / "absent") as refused:
        assert "absent" in refused
        assert os.strerror(errno.ENOENT) in refused

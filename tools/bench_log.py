"""What logging costs: the turn with and without it, the recorder's share of a core, bytes, and how fast logs load."""

import json
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rtctl import design as cfg
from rtctl.app.arm import header_of
from rtctl.app.replay import rebuilt
from rtctl.app.servo import Servo
from rtctl.app.sim import simulate
from rtctl.hal import clock
from rtctl.hal.can.link import CanLink
from rtctl.log import read
from rtctl.log.mcap.rows import Encoded
from rtctl.log.mcap.segment import begin
from rtctl.log.mcap.walk import chunk_messages
from rtctl.log.read.info import info
from rtctl.log.read.run import read_run
from rtctl.log.record.recorder import Recorder
from rtctl.log.schema import channels
from rtctl.log.view.report import write_report
from rtctl.types import Command, Drive
from tools.bench_rig import CONFIG, Arm, Bus, request, robot_and_spec

DEMO = CONFIG.parent / "demo.toml"
DEMO_S = 60.0
TICK_HZ = os.sysconf("SC_CLK_TCK")
TIMES_AT = 15  # of log_time in a message record; publish_time follows


class Figure(NamedTuple):
    """One figure: [us], and what it says."""

    name: str
    p50: float | None
    p99: float | None
    note: str = ""


class Turns(NamedTuple):
    """A stretch of the servo loop at its own rate."""

    turn: "np.ndarray[Any, np.dtype[np.float64]]"  # [us]
    late: "np.ndarray[Any, np.dtype[np.float64]]"  # [us] of wake-ups


def figures(seconds: float, copies: int) -> Iterator[Figure]:
    """Yield all figures; the log of `seconds` is repeated `copies` times for the load times."""
    with tempfile.TemporaryDirectory(prefix="rtctl-bench-") as name:
        folder = Path(name)
        source = yield from _recording(folder, seconds)
        yield from _loading(folder, source, copies)
        yield from _replaying(folder, DEMO_S if copies > 1 else seconds)


def _recording(folder: Path, seconds: float) -> "Any":
    robot, _ = robot_and_spec()
    count = max(50, round(seconds / robot.dt))
    quiet, logged = [], []
    header = header_of(cfg.load(CONFIG), CONFIG, robot, robot.home)
    recorder = Recorder.start(folder / "log", header, segment_s=3600.0)
    used = _cpu(recorder.pid)
    quiet.append(_turns(None, count // 2))  # before and after: what drifts hits both
    logged.append(_turns(recorder, count))
    quiet.append(_turns(None, count - count // 2))
    busy = count * robot.dt
    time.sleep(0.3)
    share = (_cpu(recorder.pid) - used) / busy
    stats = recorder.close("bench")
    size = stats.path.stat().st_size
    for label, runs in (("turn without log", quiet), ("turn with log", logged)):
        values = np.concatenate([each.turn for each in runs])
        yield Figure(label, *_quantiles(values))
    for label, runs in (("wake-up without log", quiet), ("wake-up with log", logged)):
        yield Figure(label, *_quantiles(np.concatenate([each.late for each in runs])))
    yield Figure(
        "recorder, CPU per s of robot time",
        1e6 * share,
        1e6 * share,
        f"{100 * share:.1f} % of a core, {stats.dropped} dropped",
    )
    yield Figure("log size", None, None, f"{size / busy * 60 / 1e6:.1f} MB per minute, {stats.entries} entries")
    return stats.path


def _turns(recorder: Recorder | None, count: int) -> Turns:
    robot, spec = robot_and_spec()
    turn, late = np.empty(count), np.empty(count)
    with closing(Bus(spec)) as bus:
        arm = Arm(robot)
        servo = Servo(robot, CanLink(spec, bus.transport), recorder, arm.q)
        servo.link.write(Command(Drive.DISABLE, np.zeros(robot.n)))
        for k, slot in zip(range(count), clock.grid(robot.dt)):  # noqa: B905 the grid has no end
            bus.answer(arm.feedback())
            begin = time.perf_counter_ns()
            done = servo.turn(clock.Slot(k, 0, slot.lateness), request(servo.memory, k))
            turn[k] = (time.perf_counter_ns() - begin) * 1e-3
            late[k] = slot.lateness * 1e6
            arm.obey(servo.memory, done.command.drive, done.command.tau)
    return Turns(turn, late)


def _cpu(pid: int) -> float:
    """Return the processor time [s] that a process has used."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / TICK_HZ


def _quantiles(values: Any) -> tuple[float, float]:
    return float(np.median(values)), float(np.percentile(values, 99))


def stretched(source: Path, target: Path, copies: int) -> float:
    """Write a log repeated, each copy later than the one before; return how long it lasts [s]."""
    log = read(source)
    header, span = log.header, log.span[1] - log.span[0] + 1_000_000
    segment = begin(target, header, channels(header), log.span[0], {"segment": "0", "session": target.stem})
    parts = []
    for k in range(len(log._catalog.chunks.body)):
        raw = np.frombuffer(log._chunk(k) or b"", np.uint8)
        parts.append((raw, chunk_messages(raw.tobytes())))
    for k in range(copies):
        for raw, rows in parts:
            data = raw.copy()
            stamps = np.repeat((rows.time + k * span)[:, None], 2, axis=1).astype("<i8").view(np.uint8)
            data[rows.offset[:, None] + TIMES_AT + np.arange(16)] = stamps
            encoded = Encoded(data.tobytes(), rows.channel, rows.sequence, rows.time + k * span, rows.offset)
            segment.add(encoded)
            segment.flush()
    segment.finish()
    return copies * span / 1e9


def _loading(folder: Path, source: Path, copies: int) -> Iterator[Figure]:
    long = folder / "long.mcap"
    seconds = stretched(source, long, copies)
    minutes = f"of {seconds / 60:.1f} min at 1 kHz, {long.stat().st_size / 1e6:.0f} MB"
    middle = read(long).span[0] + int(seconds * 0.5e9)
    width = min(10.0, seconds / 2)
    calls: list[tuple[str, Callable[[], object], int, str]] = [
        ("info", lambda: info(long), 5, f"target below 50 ms, {minutes}"),
        ("load one field", lambda: read(long)["/tick"].q, 3, f"target below 3 s for 10 min, {minutes}"),
        (
            "load eight fields",
            lambda: read(long)["/tick"].load("q", "qd", "tau_sent", "x", "xd", "error", "state", "status"),
            3,
            minutes,
        ),
        (
            f"load a window of {width:g} s",
            lambda: read(long).window("/tick", middle, middle + int(width * 1e9)).q,
            5,
            f"target below 50 ms, {minutes}",
        ),
        (
            "report",
            lambda: write_report(read_run(long), folder / "long.html"),
            1,
            f"target below 15 s for 10 min, {minutes}",
        ),
    ]
    for name, call, times, note in calls:
        took = []
        for _ in range(times):
            begin_ns = time.perf_counter_ns()
            call()
            took.append((time.perf_counter_ns() - begin_ns) * 1e-3)
        yield Figure(name, float(np.median(took)), float(np.max(took)), note)
    yield Figure("report size", None, None, f"{(folder / 'long.html').stat().st_size / 1e6:.2f} MB of HTML")


def _replaying(folder: Path, seconds: float) -> Iterator[Figure]:
    """Replay the demo as people do: by the command, in a process of its own that no realtime class binds to a core."""
    scene, log = folder / "demo.toml", folder / "demo.mcap"
    text = DEMO.read_text().replace('robot = "panda"', f'robot = "{CONFIG}"')
    scene.write_text(re.sub(r"(?m)^duration_s = .*$", f"duration_s = {seconds}", text))
    simulate(scene, log=log)
    begin_ns = time.perf_counter_ns()
    rebuilt(read_run(log))
    took = (time.perf_counter_ns() - begin_ns) * 1e-3
    yield Figure("replay, build the robot", took, took, "once a log")
    command = [sys.executable, "-m", "rtctl", "log", "replay", str(log), "--json"]
    found = json.loads(subprocess.run(command, check=True, capture_output=True).stdout)
    says = "identical" if found["identical"] else "NOT identical"
    each = 1e3 / found["realtime_factor"]  # a tick is a millisecond
    cores = len(os.sched_getaffinity(0))
    note = f"{found['realtime_factor']:.1f} x real time on {cores} cores (target 10), {seconds:g} s of demo, {says}"
    yield Figure("replay, a tick", each, each, note)

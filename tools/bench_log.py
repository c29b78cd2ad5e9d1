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

import numpy as np

from rtctl import design as cfg
from rtctl.app.arm import ARM
from rtctl.app.arm_link import ArmLink, first_feedback
from rtctl.app.arm_log import header_of, rebuilt
from rtctl.app.servo import Servo
from rtctl.app.sim import simulate
from rtctl.hal import clock
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
from tools.bench_rows import Row, row, urgent

DEMO = CONFIG.parent / "demo.toml"
SIMULATED_S = 20.0  # of the demo, for the pace of a simulation
TICK_HZ = os.sysconf("SC_CLK_TCK")
TIMES_AT = 15  # of log_time in a message record; publish_time follows


BLOCK = 50  # turns with and without log, by turns


def recording(seconds: float) -> Iterator[Row]:
    """What the log adds to a turn, and what its recorder costs."""
    with tempfile.TemporaryDirectory(prefix="rtctl-bench-") as name:
        yield from _recording(Path(name), seconds)[1]


def loading(seconds: float) -> Iterator[Row]:
    """How fast logs load: ten minutes, or a little if asked for little."""
    with tempfile.TemporaryDirectory(prefix="rtctl-bench-") as name:
        source, _ = _recording(Path(name), min(seconds, 2.0))
        yield from _loading(Path(name), source, copies=300 if seconds > 1.0 else 1)


def _recording(folder: Path, seconds: float) -> tuple[Path, list[Row]]:
    """Record the bench's arm; return the log, and what it cost."""
    robot, spec = robot_and_spec()
    count = max(2 * BLOCK, round(seconds / robot.dt))
    header = header_of(cfg.load(CONFIG), CONFIG, robot, robot.home)
    recorder = Recorder.start(folder / "log", header, segment_s=3600.0)
    used = _cpu(recorder.pid)
    turn, late, logged = np.empty(count), np.empty(count), np.arange(count) // BLOCK % 2 == 1
    with closing(Bus(spec)) as bus, urgent() as policy:
        arm = Arm(robot)
        servo = Servo(ARM, robot, ArmLink(spec, bus.transport), None, first_feedback(arm.q))
        servo.link.write(Command(Drive.DISABLE, np.zeros(robot.n)))
        for k, slot in zip(range(count), clock.grid(robot.dt)):  # noqa: B905 the grid has no end
            bus.answer(arm.feedback())
            servo.sink = recorder if logged[k] else None
            begin = time.perf_counter_ns()
            done = servo.turn(clock.Slot(k, 0, slot.lateness), request(servo.memory, k))
            turn[k] = time.perf_counter_ns() - begin
            late[k] = slot.lateness * 1e9
            arm.obey(servo.memory, done.command.drive, done.command.tau)
    time.sleep(0.3)
    busy = int(logged.sum()) * robot.dt
    share = 1e6 * (_cpu(recorder.pid) - used) / busy
    stats = recorder.close("bench")
    size, lost = stats.path.stat().st_size, f"{stats.dropped} dropped"
    adds = 1e-3 * float(np.median(turn[logged]) - np.median(turn[~logged]))
    tail = 1e-3 * float(np.percentile(turn[logged], 99) - np.percentile(turn[~logged], 99))
    rows = [
        row("log", "turn without log", turn[~logged], note=policy),
        row("log", "turn with log", turn[logged]),
        Row("log", "log adds to a turn", adds, tail, note="target p50 below 10 us; difference of both, by turns"),
        row("log", "wake-up without log", late[~logged]),
        row("log", "wake-up with log", late[logged]),
        Row("log", "recorder, CPU per s of log", share, share, note=f"{1e-4 * share:.1f} % of a core, {lost}"),
        Row("log", "log size", None, None, note=f"{size / busy * 60 / 1e6:.1f} MB per minute, {stats.entries} entries"),
    ]
    return stats.path, rows


def _cpu(pid: int) -> float:
    """Return the processor time [s] that a process has used."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / TICK_HZ


def stretched(source: Path, target: Path, copies: int) -> float:
    """Write a log repeated, each copy later than the one before; return how long it lasts [s]."""
    log = read(source)
    header, span = log.header, log.span[1] - log.span[0] + 1_000_000
    segment = begin(target, header, channels(header), log.span[0], {"segment": "0", "session": target.stem})
    parts = []
    for k in range(len(log._catalog.chunks.body)):
        raw = np.frombuffer(log._chunks.content(k) or b"", np.uint8)
        parts.append((raw, chunk_messages(raw.tobytes())))
    for k in range(copies):
        for raw, rows in parts:
            data = raw.copy()
            stamps = np.repeat((rows.time + k * span)[:, None], 2, axis=1).astype("<i8").view(np.uint8)
            data[rows.offset[:, None] + TIMES_AT + np.arange(16)] = stamps
            later = (rows.time + k * span).astype(np.uint64)
            segment.add(Encoded(data.tobytes(), rows.channel, rows.sequence, later, rows.offset))
            segment.flush()
    segment.finish()
    return copies * span / 1e9


def _loading(folder: Path, source: Path, copies: int) -> Iterator[Row]:
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
        yield Row("load", name, float(np.median(took)), float(np.max(took)), note=note)
    yield Row("load", "report size", None, None, note=f"{(folder / 'long.html').stat().st_size / 1e6:.2f} MB of HTML")


def _demo(folder: Path, seconds: float) -> Path:
    """Write the demo's scenario, cut to `seconds`."""
    scene = folder / "demo.toml"
    text = DEMO.read_text().replace('robot = "panda"', f'robot = "{CONFIG}"')
    scene.write_text(re.sub(r"(?m)^duration_s = .*$", f"duration_s = {seconds}", text))
    return scene


def replaying(seconds: float) -> Iterator[Row]:
    """Replay the demo as people do: by the command, in a process of its own that no realtime class binds to a core."""
    with tempfile.TemporaryDirectory(prefix="rtctl-bench-") as name:
        log = Path(name) / "demo.mcap"
        simulate(_demo(Path(name), seconds), log=log)
        begin_ns = time.perf_counter_ns()
        rebuilt(read_run(log))
        took = (time.perf_counter_ns() - begin_ns) * 1e-3
        yield Row("replay", "build the robot", took, took, note="once a log")
        command = [sys.executable, "-m", "rtctl", "log", "replay", str(log), "--json"]
        found = json.loads(subprocess.run(command, check=True, capture_output=True).stdout)
    says = "identical" if found["identical"] else "NOT identical"
    each = 1e3 / found["realtime_factor"]  # a tick is a millisecond
    cores = len(os.sched_getaffinity(0))
    note = f"{found['realtime_factor']:.1f} x real time on {cores} cores (target 40), {seconds:g} s of demo, {says}"
    yield Row("replay", "a tick", each, each, note=note)


def simulating(seconds: float) -> Iterator[Row]:
    """Simulate the demo: controller, drives, plant and the oracle's distances in one process."""
    with tempfile.TemporaryDirectory(prefix="rtctl-bench-") as name:
        factor = float(simulate(_demo(Path(name), min(seconds, SIMULATED_S)))["realtime_factor"])
    each = 1e3 / factor
    yield Row("sim", "a tick", each, each, note=f"{factor:.1f} x real time (target 6)")

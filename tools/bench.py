"""`make bench`: the figures of speed on this machine, each beside what it is to be compared with.

Rivals are timed in turns within one run, so that ratios hold where absolute times drift.
"""

import argparse
import gc
import json
import os
import platform
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numba
import numpy as np

from rtctl.app.servo import CAN_RX, TICK, Servo, first_feedback
from rtctl.arm import pipe
from rtctl.arm.law import evaluate_law
from rtctl.arm.osc import operational_space
from rtctl.arm.pipe import initial, tick, warm
from rtctl.arm.robot import Robot
from rtctl.hal import clock
from rtctl.hal.can.link import CanLink, LinkSpec
from rtctl.log.record import ring
from rtctl.types import I64, Command, Drive, Request
from tools.bench_rig import Arm, BoundFloor, Bus, Case, Floor, Null, case, request, robot_and_spec

# The blocks of the tick, in order: function of rtctl.arm.pipe -> name of the row.
STAGES = {
    "_estimated": "estimate",
    "_perceived": "perceive",
    "detected": "detect",
    "supervised": "supervise",
    "_law": "law",
    "_commanded": "command",
    "_diagnosed": "diagnose",
    "_record": "record",
}
PRIORITY = 80
FULL = {"law": 4000, "tick": 10000, "call": 3000, "wake": 5000, "log": 10}
QUICK = {"law": 20, "tick": 60, "call": 20, "wake": 20, "log": 1}


class Row(NamedTuple):
    """One figure [us]; `limit` and `ratio` where there is something to compare with."""

    part: str
    name: str
    p50: float | None
    p99: float | None
    ratio: float | None = None  # to `rival`, of the medians unless the note says otherwise
    rival: str = ""
    note: str = ""


def row(part: str, name: str, ns: "I64 | list[int]", **more: Any) -> Row:
    """Return the row of measured times [ns]."""
    values = np.asarray(ns, np.float64) * 1e-3
    return Row(part, name, float(np.median(values)), float(np.percentile(values, 99)), **more)


def timed(call: Callable[[], object], count: int) -> I64:
    """Return the time [ns] of each of `count` calls."""
    now, out = time.perf_counter_ns, np.empty(count, np.int64)
    for i in range(count):
        begin = now()
        call()
        out[i] = now() - begin
    return out


def machine() -> dict[str, Any]:
    """Return what the figures were measured on."""
    text = Path("/proc/cpuinfo").read_text() if Path("/proc/cpuinfo").exists() else ""
    found = re.search(r"model name\s*: (.*)", text)
    return {
        "cpu": found[1] if found else platform.processor(),
        "cores": os.cpu_count(),
        "kernel": f"{platform.system()} {platform.release()}",
        "load": [round(each, 2) for each in os.getloadavg()],
        "python": platform.python_version(),
        "numba": numba.__version__,
        "numpy": np.__version__,
    }


def difference(floor: BoundFloor, one: Case) -> float:
    """Return by how much [Nm, m/s2] the floor's F*, torque of the field and whole torque differ from the law's."""
    law, n = evaluate_law(*one.arguments), one.robot.n
    floor.run(1)
    F, field, whole = np.split(floor.out, [6, 6 + n])
    parts = (F - law.F, field - one.robot.scratch.tau, whole - law.drive - law.keep)
    return max(float(np.abs(part).max()) for part in parts)


def laws(robot: Robot, floor: Floor | None, why: str, count: int) -> Iterator[Row]:
    """The law, called from Python, against the C++ floor, timed in its own loop: blocks of both by turns."""
    for m in (16, 64):
        for slots in (1, 16, 64):
            one = case(robot, m, slots)
            name = f"law {m} PSP x {slots} obstacles"
            evaluate_law(*one.arguments)
            if floor is None:
                yield row("law", name, timed(lambda a=one.arguments: evaluate_law(*a), count), note=f"no floor: {why}")  # type: ignore[misc]
                continue
            rival = floor.bind(one)
            wrong = difference(rival, one)
            ours, theirs = [], []
            block = max(1, min(50, count // 4))
            for _ in range(count // block):
                ours.append(timed(lambda a=one.arguments: evaluate_law(*a), block))  # type: ignore[misc]
                theirs.append(rival.run(block))
            mine, its = np.concatenate(ours), np.concatenate(theirs)
            ratio = float(np.median(mine) / np.median(its))
            yield row("law", name, mine, ratio=ratio, rival="C++ floor", note=f"largest difference {wrong:.1e} Nm")
            yield row("law", f"floor {m} x {slots}", its)


@contextmanager
def staged() -> Iterator[dict[str, list[int]]]:
    """Time every block of the tick while this lasts."""
    times: dict[str, list[int]] = {name: [] for name in STAGES}
    kept = {name: getattr(pipe, name) for name in STAGES}
    now = time.perf_counter_ns

    def watch(call: Callable[..., Any], into: list[int]) -> Callable[..., Any]:
        def wrapped(*arguments: Any) -> Any:
            begin = now()
            result = call(*arguments)
            into.append(now() - begin)
            return result

        return wrapped

    for name in STAGES:
        setattr(pipe, name, watch(kept[name], times[name]))
    try:
        yield times
    finally:
        for name in STAGES:
            setattr(pipe, name, kept[name])


def ticks(robot: Robot, count: int) -> Iterator[Row]:
    """The whole tick, then its blocks: an arm on its way from goal to goal past five obstacles."""
    ns, due = _session(robot, count)
    yield row("tick", "whole tick", ns)
    if due.any() and not due.all():
        yield row("tick", "whole tick, model due", ns[due])
        yield row("tick", "whole tick, model kept", ns[~due])
    with staged() as times:
        _session(robot, count)
    for name, label in STAGES.items():
        yield row("tick", label, times[name])


def _session(robot: Robot, count: int) -> tuple[I64, np.ndarray]:
    """Return the time [ns] of each tick of a session, and in which of them the model was evaluated."""
    arm = Arm(robot)
    m = initial(robot, first_feedback(arm.q))
    ns, due = np.empty(count, np.int64), np.zeros(count, np.bool_)
    for k in range(count):
        feedback, asked = arm.feedback(), request(m, k)
        begin = time.perf_counter_ns()
        m, command, _ = tick(robot, m, feedback, asked)
        ns[k] = time.perf_counter_ns() - begin
        due[k] = m.evaluated
        arm.obey(m, command.drive, command.tau)
    return ns, due


@contextmanager
def urgent() -> Iterator[str]:
    """Run under SCHED_FIFO as the daemon does, if that is granted; give the policy's name."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    except OSError as error:
        yield f"SCHED_OTHER ({error.strerror})"
        return
    try:
        yield f"SCHED_FIFO {PRIORITY}"
    finally:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def turns(robot: Robot, spec: LinkSpec, count: int) -> Iterator[Row]:
    """The turn at its own rate: bus, tick, bus, record into the ring, digest; the drives answer before, untimed."""
    with ExitStack() as stack:
        bus = stack.enter_context(closing(Bus(spec)))
        record = stack.enter_context(_ring())
        arm = Arm(robot)
        servo = Servo(robot, CanLink(spec, bus.transport), record, arm.q)
        servo.link.write(Command(Drive.DISABLE, np.zeros(robot.n)))
        ns, due = np.empty(count, np.int64), np.zeros(count, np.bool_)
        policy = stack.enter_context(urgent())
        for k, _ in zip(range(count), clock.grid(robot.dt)):  # noqa: B905 the grid has no end
            bus.answer(arm.feedback())
            asked, slot = request(servo.memory, k), clock.Slot(k, 0, 0.0)
            begin = time.perf_counter_ns()
            turn = servo.turn(slot, asked)
            ns[k] = time.perf_counter_ns() - begin
            due[k] = servo.memory.evaluated
            arm.obey(servo.memory, turn.command.drive, turn.command.tau)
            record.words[ring.TAIL] = record.words[ring.HEAD_AT]  # as a recorder that keeps up
    share = float(np.percentile(ns, 99)) / (0.25e9 * robot.dt)
    yield row(
        "turn", "turn with bus and log", ns, ratio=share, rival=f"25 % of {1e3 * robot.dt:g} ms, p99", note=policy
    )
    if due.any() and not due.all():
        yield row("turn", "turn, model due", ns[due])
        yield row("turn", "turn, model kept", ns[~due])
    link, null = CanLink(spec, Null()), Null()
    link.transport = null
    command = Command(Drive.TORQUE, np.linspace(-5.0, 5.0, robot.n))
    yield row("turn", f"encode {robot.n} commands", timed(lambda: link.write(command), count))
    maker = Bus(spec)
    frames = [maker.replies(arm.feedback()) for _ in range(256)]
    maker.close()
    slots = iter(range(count))

    def read() -> None:
        null.waiting = frames[next(slots) % 256]
        link.read(0, 0, 0.0, 0.0)

    yield row("turn", f"decode {robot.n} replies", timed(read, count))


@contextmanager
def _ring() -> Iterator[ring.Producer]:
    producer = ring.create(f"rtctl-bench-{os.getpid()}.ring", 1 << 22, b"{}")
    try:
        yield producer
    finally:
        producer.unmap()
        producer.path.unlink()


def puts(robot: Robot, count: int) -> Iterator[Row]:
    """One entry into the ring."""
    _, _, record = tick(robot, initial(robot, first_feedback(robot.home)), Arm(robot).feedback(), Request())
    with _ring() as producer:
        for name, kind, payload in (("record", TICK, record.tobytes()), ("CAN FD frame", CAN_RX, bytes(72))):

            def put(kind: int = kind, payload: bytes = payload) -> None:
                producer.put(kind, payload, 0)
                producer.words[ring.TAIL] = producer.words[ring.HEAD_AT]

            yield row("ring", f"put {name} ({len(payload)} B)", timed(put, count), note="target p50 below 5 us")


def logs(seconds: int) -> Iterator[Row]:
    """What logging costs and how fast logs load; the load times on ten minutes, or on a little if asked for little."""
    from tools.bench_log import figures

    for figure in figures(seconds, copies=600 // seconds if seconds > 1 else 1):
        yield Row("log", figure.name, figure.p50, figure.p99, note=figure.note)


def models(robot: Robot, count: int) -> Iterator[Row]:
    """Parameter evaluation."""
    q, qd = robot.home, np.zeros(robot.n)
    yield row(
        "model",
        "dynamics, points, own distances",
        timed(lambda: robot.body.evaluate(q, qd, robot.points, robot.own), count),
    )
    m = robot.body.evaluate(q, qd, robot.points, robot.own)
    call = lambda: operational_space(m.J, m.A_inv, m.Lambda_inv, np.eye(6), robot.motion)  # noqa: E731
    yield row("model", "operational space", timed(call, count))


def collections() -> Iterator[Row]:
    """A garbage collection before and after everything loaded was frozen, as the daemon does."""
    yield row("gc", "collection", timed(gc.collect, 3))
    clock.quiet_collector()
    yield row("gc", "collection after freeze", timed(gc.collect, 3))
    gc.unfreeze()
    gc.enable()


def wakes(period: float, floor: Floor | None, why: str, count: int) -> Iterator[Row]:
    """Lateness of wake-ups under SCHED_FIFO: our grid, a bare C loop, cyclictest; by turns."""
    ours, theirs = [], []
    with urgent() as policy:
        for _ in range(4):
            slots = clock.grid(period)
            ours += [round(next(slots).lateness * 1e9) for _ in range(count // 4)]
            if floor is not None:
                theirs += floor.wake(round(period * 1e9), count // 4).tolist()
    if not theirs:
        yield row("wake-up", "our grid", ours, note=f"{policy}; no C loop: {why}")
    else:
        ratio = float(np.percentile(ours, 99) / np.percentile(theirs, 99))
        yield row("wake-up", "our grid", ours, ratio=ratio, rival="bare C loop, p99", note=policy)
        yield row("wake-up", "bare C loop", theirs, note=policy)
    yield _cyclictest(period, count)


def _cyclictest(period: float, count: int) -> Row:
    name = shutil.which("cyclictest")
    if name is None:
        return Row("wake-up", "cyclictest", None, None, note="left out: not installed (rt-tests)")
    command = [name, "-q", "-m", f"-p{PRIORITY}", f"-i{round(period * 1e6)}", f"-l{count}", "-h2000"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    late = [
        int(us) for us, n in re.findall(r"^(\d+)\s+(\d+)", done.stdout, re.MULTILINE) for _ in range(int(n))
    ]  # microseconds, a line for each
    if not late:
        return Row(
            "wake-up", "cyclictest", None, None, note=f"left out: {(done.stderr.splitlines() or ['nothing said'])[0]}"
        )
    return row("wake-up", "cyclictest", [1000 * us for us in late])


def measure(counts: dict[str, int]) -> tuple[dict[str, Any], list[Row]]:
    """Return the machine and every row."""
    floor, why = Floor.build()
    begin = time.perf_counter()
    robot, spec = robot_and_spec()
    warm(robot)
    about = {**machine(), "floor": why, "build_and_warm_s": round(time.perf_counter() - begin, 2)}
    rows = list(collections())
    gc.collect()
    gc.freeze()
    gc.disable()  # as in the daemon
    try:
        rows += laws(robot, floor, why, counts["law"])
        rows += ticks(robot, counts["tick"])
        rows += turns(robot, spec, counts["tick"])
        rows += puts(robot, counts["call"])
        rows += models(robot, counts["call"])
        rows += logs(counts["log"])
        rows += wakes(robot.dt, floor, why, counts["wake"])
    finally:
        gc.enable()
        gc.unfreeze()
    about["load_after"] = [round(each, 2) for each in os.getloadavg()]
    return about, rows


def table(about: dict[str, Any], rows: list[Row]) -> str:
    """Return the figures as text."""
    lines = [f"{key:17s} {value}" for key, value in about.items()]
    lines += ["", f"{'':8s} {'':32s} {'p50 us':>9s} {'p99 us':>9s} {'ratio':>6s}"]
    for r in rows:
        figures = " ".join("        -" if v is None else f"{v:9.2f}" for v in (r.p50, r.p99))
        ratio = "" if r.ratio is None else f"{r.ratio:6.2f}"
        remark = "; ".join(each for each in (f"to {r.rival}" if r.rival else "", r.note) if each)
        lines.append(f"{r.part:8s} {r.name:32s} {figures} {ratio:>6s} {remark}".rstrip())
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> int:
    """Measure and print; the exit code is 0."""
    parser = argparse.ArgumentParser(prog="tools.bench", description="The figures of speed on this machine.")
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    parser.add_argument("--quick", action="store_true", help="a few calls of each: shows that it runs, not how fast")
    chosen = parser.parse_args(arguments)
    about, rows = measure(QUICK if chosen.quick else FULL)
    if chosen.json:
        print(json.dumps({"machine": about, "rows": [r._asdict() for r in rows]}, indent=2))
    else:
        print(table(about, rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())

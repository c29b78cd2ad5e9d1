"""`make bench`: the figures of speed on this machine, each beside what it is to be compared with.

    python -m tools.bench --part turn --part wake --json

Rivals are timed in turns within one run, so that ratios hold where absolute times drift.
"""

import argparse
import gc
import json
import os
import platform
import re
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numba
import numpy as np

from rtctl.app.arm_link import first_feedback
from rtctl.arm import pipe
from rtctl.arm.osc import operational_space
from rtctl.arm.pipe import initial, tick, warm
from rtctl.arm.robot import Robot
from rtctl.hal import clock
from rtctl.hal.can.link import LinkSpec
from rtctl.types import I64
from tools import bench_law, bench_log, bench_turn
from tools.bench_rig import Arm, Floor, request, robot_and_spec
from tools.bench_rows import Row, row, timed

# The parts of the tick: function of rtctl.arm.pipe -> name of the row; all but the first two run when they must.
STAGES = {
    "servo": "servo level, a call",
    "_evaluated": "parameter level",
    "_perceived": "edit obstacles",
    "supervise": "supervise",
    "with_goal": "take goals",
    "_diagnosed": "diagnose",
}
FULL = {"law": 4000, "tick": 10000, "call": 3000, "wake": 5000, "log": 10, "demo": 60}
QUICK = {"law": 20, "tick": 60, "call": 20, "wake": 20, "log": 1, "demo": 1}


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
        if times[name]:
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


class Bench(NamedTuple):
    """What the parts measure on."""

    robot: Robot
    spec: LinkSpec
    floor: Floor | None
    why: str  # there is no floor
    counts: dict[str, int]


PARTS: dict[str, Callable[[Bench], Iterator[Row]]] = {
    "gc": lambda b: collections(),
    "law": lambda b: bench_law.laws(b.robot, b.floor, b.why, b.counts["law"]),
    "tick": lambda b: ticks(b.robot, b.counts["tick"]),
    "turn": lambda b: bench_turn.turns(b.robot, b.spec, b.counts["tick"]),
    "ring": lambda b: bench_turn.puts(b.robot, b.counts["call"]),
    "model": lambda b: models(b.robot, b.counts["call"]),
    "log": lambda b: bench_log.recording(b.counts["log"]),
    "load": lambda b: bench_log.loading(b.counts["log"]),
    "replay": lambda b: bench_log.replaying(b.counts["demo"]),
    "sim": lambda b: bench_log.simulating(b.counts["demo"]),
    "wake": lambda b: bench_turn.wakes(b.robot.dt, b.floor, b.why, b.counts["wake"]),
}


def measure(counts: dict[str, int], parts: list[str]) -> tuple[dict[str, Any], list[Row]]:
    """Return the machine and the rows of these parts."""
    floor, why = Floor.build()
    begin = time.perf_counter()
    robot, spec = robot_and_spec()
    warm(robot)
    about = {**machine(), "floor": why, "build_and_warm_s": round(time.perf_counter() - begin, 2)}
    bench = Bench(robot, spec, floor, why, counts)
    rows = list(PARTS["gc"](bench)) if "gc" in parts else []
    gc.collect()
    gc.freeze()
    gc.disable()  # as in the daemon
    try:
        for name in parts:
            rows += PARTS[name](bench) if name != "gc" else ()
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
    parser.add_argument("--part", action="append", choices=PARTS, help="measure this alone; repeatable")
    parser.add_argument("--quick", action="store_true", help="a few calls of each: shows that it runs, not how fast")
    chosen = parser.parse_args(arguments)
    about, rows = measure(QUICK if chosen.quick else FULL, chosen.part or list(PARTS))
    if chosen.json:
        print(json.dumps({"machine": about, "rows": [r._asdict() for r in rows]}, indent=2))
    else:
        print(table(about, rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""The whole turn of the loop at its own rate, what it puts into the log's ring, and how punctual its grid is."""

import os
import re
import shutil
import subprocess
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager

import numpy as np

from rtctl.app.arm import ARM, CAN_RX
from rtctl.app.arm_link import ArmLink, first_feedback
from rtctl.app.servo import TICK, Servo
from rtctl.arm.pipe import initial, tick
from rtctl.arm.robot import Robot
from rtctl.hal import clock
from rtctl.hal.can.link import CanLink, LinkSpec
from rtctl.log.record import ring
from rtctl.types import Command, Drive, Frames, Request
from tools.bench_rig import Arm, Bus, Floor, Null, request
from tools.bench_rows import PRIORITY, Row, row, timed, urgent


def turns(robot: Robot, spec: LinkSpec, count: int) -> Iterator[Row]:
    """The turn at its own rate: bus, tick, bus, record into the ring, digest; the drives answer before, untimed."""
    with ExitStack() as stack:
        bus = stack.enter_context(closing(Bus(spec)))
        record = stack.enter_context(_ring())
        arm = Arm(robot)
        servo = Servo(ARM, robot, ArmLink(spec, bus.transport), record, first_feedback(arm.q))
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
    share = float(np.percentile(ns, 99)) / 0.26e6
    yield row(
        "turn", "turn with bus and log", ns, ratio=share, rival="260 us, p99", note=f"target p50 below 130 us; {policy}"
    )
    if due.any() and not due.all():
        yield row("turn", "turn, model due", ns[due])
        yield row("turn", "turn, model kept", ns[~due])
    link, null = CanLink(spec, Null()), Null()
    link.transport = null
    command = Command(Drive.TORQUE, np.linspace(-5.0, 5.0, robot.n))
    yield row("turn", f"encode {robot.n} commands", timed(lambda: link.write(command), count))
    maker = Bus(spec)
    frames = [Frames(b"".join(maker.replies(arm.feedback())), maker.size) for _ in range(256)]
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
    """One entry, and the frames of one cycle, into the ring."""
    _, _, record = tick(robot, initial(robot, first_feedback(robot.home)), Arm(robot).feedback(), Request())
    with _ring() as producer:
        cycle = Frames(bytes(72 * robot.n), 72)
        for name, kind, payloads in (("record", TICK, [record.tobytes()]), ("cycle of CAN FD frames", CAN_RX, cycle)):

            def put(kind: int = kind, payloads: Sequence[bytes] = payloads) -> None:
                producer.put_many(kind, payloads, 0)
                producer.words[ring.TAIL] = producer.words[ring.HEAD_AT]

            size = sum(map(len, payloads))
            yield row("ring", f"put {name} ({size} B)", timed(put, count), note="target p50 below 5 us")


def wakes(period: float, floor: Floor | None, why: str, count: int) -> Iterator[Row]:
    """Lateness of wake-ups under SCHED_FIFO: our grid, a bare C loop, cyclictest; by turns."""
    ours: list[int] = []
    bare: list[int] = []
    cyclic: list[int] = []
    refused = ""
    for _ in range(4):
        with urgent() as policy:
            slots = clock.grid(period)
            ours += [round(next(slots).lateness * 1e9) for _ in range(count // 4)]
            if floor is not None:
                bare += floor.wake(round(period * 1e9), count // 4).tolist()
        some, refused = _cyclictest(period, count // 4)
        cyclic += some
    rival, name = (cyclic, "cyclictest, p99; target below 1.2") if cyclic else (bare, "bare C loop, p99")
    ratio = float(np.percentile(ours, 99) / np.percentile(rival, 99)) if rival else None
    yield row("wake", "our grid", ours, ratio=ratio, rival=name if rival else "", note=policy)
    yield (
        row("wake", "bare C loop", bare, note=policy)
        if bare
        else Row("wake", "bare C loop", None, None, note=f"left out: {why}")
    )
    yield (
        row("wake", "cyclictest", cyclic)
        if cyclic
        else Row("wake", "cyclictest", None, None, note=f"left out: {refused}")
    )


def _cyclictest(period: float, count: int) -> tuple[list[int], str]:
    """Return how late [ns] cyclictest was at the same priority, or why it was not asked."""
    name = shutil.which("cyclictest")
    if name is None:
        return [], "not installed (rt-tests)"
    command = [name, "-q", "-m", f"-p{PRIORITY}", f"-i{round(period * 1e6)}", f"-l{count}", "-h2000"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    lines = re.findall(r"^(\d+)\s+(\d+)", done.stdout, re.MULTILINE)  # microseconds, a line for each
    late = [1000 * int(us) for us, n in lines for _ in range(int(n))]
    return late, "" if late else (done.stderr.splitlines() or ["nothing said"])[0]

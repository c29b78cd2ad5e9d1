"""Replay: the pure tick once more on the inputs of a log, from the log alone: the same bits, or where they differ.

The command frames are made anew by the daemon's own encoder, so that what is compared is what went over the bus.
"""

import gc
import hashlib
import multiprocessing
import os
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from itertools import islice
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeAlias

import numpy as np

from rtctl.app.choose import vehicle_named
from rtctl.app.compare import Check, Difference, Divergence, Wire
from rtctl.app.vehicle import C, F, M, R, Rebuilt, Vehicle
from rtctl.errors import LogError
from rtctl.log import schema
from rtctl.log.mcap.walk import I64_MAX
from rtctl.log.read.inputs import EVERYTHING, Logged, inputs
from rtctl.log.read.run import Run
from rtctl.types import F64

BLOCK = 1000  # ticks that are compared at once


class Replay(NamedTuple):
    """What a replay found."""

    robot: str
    ticks: int
    frames: int  # compared
    digest: str  # sha256 of the replayed command frames, as `rtctl sim` prints it
    divergence: Divergence | None
    differences: tuple[Difference, ...]
    ignored: tuple[str, ...]  # fields that only one of log and program knows
    seconds: float  # taken
    duration: float  # [s] of robot time
    time: F64  # (T,) [s]
    logged: F64  # (T, n) [Nm] tau_sent; of a base (T, 2) [m/s] v_world
    replayed: F64  # (T, n)

    @property
    def identical(self) -> bool:
        """Return whether every bit is the same."""
        return self.divergence is None

    @property
    def speed(self) -> float:
        """Return robot time over the time taken."""
        return self.duration / self.seconds if self.seconds > 0.0 else 0.0


class _Subject(NamedTuple, Generic[R, M, F, C]):
    """What is replayed."""

    vehicle: Vehicle[R, M, F, C]
    log: Rebuilt[R, F, C]
    memory: M  # before the first tick
    dry: bool  # the commands were computed but not sent

    def encoded(self, command: C) -> bytes:
        """Return the frames of a command, b'' where they cannot be made again."""
        if self.log.encode is None:
            return b""
        return b"".join(self.log.encode(self.vehicle.harmless(command) if self.dry else command))

    def resumed(self, run: Run, mark: "_Mark") -> tuple[M, tuple[int, ...]]:
        """Return memory and counters of a checkpoint. Raises LogError."""
        kept = self.vehicle.checkpoints
        assert kept is not None
        try:
            return kept.decode(mark.text, self.log.robot, self.memory)
        except ValueError as error:
            raise LogError(f"{run.path}: its checkpoint cannot be used: {error}") from None

    def agrees(self, memory: M, mark: "_Mark | None") -> bool:
        """Return whether a memory and the counters of now are those of a checkpoint, None for any."""
        kept, wire = self.vehicle.checkpoints, self.log.wire
        if mark is None:
            return True
        return kept is not None and wire is not None and kept.encode(memory, wire.counters) == mark.text


_Some: TypeAlias = _Subject[Any, Any, Any, Any]  # chosen by the log


class _Mark(NamedTuple):
    """A checkpoint of the log: a replay can begin behind it, and what it ends with can be held against it."""

    time: int  # [ns] log_time of its tick
    text: bytes


class _Part(NamedTuple):
    """What the replay of a span found; fields as in Replay."""

    ticks: int
    frames: int
    divergence: Divergence | None
    differences: tuple[Difference, ...]
    ignored: tuple[str, ...]
    time: F64
    logged: F64
    replayed: F64
    sent: bytes  # command frames, where they were asked for
    agrees: bool  # with the checkpoint at its end


def replay(run: Run, config: Path | None = None, progress: Callable[[int], None] = lambda n: None) -> Replay:
    """Return how the tick's replay differs from the log; with `config`, how that config's commands would.

    Between the log's checkpoints a span does not depend on the one before, so that all processors replay at once; that
    each span ends in the bits of the next checkpoint makes the whole of them. Where anything differs, and for a
    what-if, all is replayed in order. A log that has lost its beginning is replayed from its first checkpoint on.
    progress: called with the number of ticks done. Raises LogError, ConfigError.
    """
    vehicle = vehicle_named(run.header.extra.get("kind", "arm"))
    log = vehicle.rebuild(run, config)
    start = vehicle.initial(log.robot, log.start)
    subject: _Some = _Subject(vehicle, log, start, run.header.extra.get("dry") == "1")
    marks = _marks(run) if vehicle.checkpoints is not None else []
    begun = time.perf_counter()
    first = _first_tick(run)
    whole = first == 0
    if not whole and not marks:
        raise LogError(f"{run.path}: begins with tick {first}; what was before it is missing")
    gc.freeze()  # robot and kernels will not be garbage: looking through them again costs a twentieth
    digest = hashlib.sha256()
    try:
        done = _at_once(run, subject, marks, whole, progress) if marks and config is None else None
        if done is None:
            span, begin = (EVERYTHING, None) if whole else ((marks[0].time + 1, I64_MAX), marks[0])
            done = [_played(run, subject, span, begin, config is None, digest.update, progress)]
    finally:
        gc.unfreeze()
    for part in done:
        digest.update(part.sent)
    seconds, ticks = time.perf_counter() - begun, sum(part.ticks for part in done)
    full = [part for part in done if part.ticks]
    return Replay(
        log.robot.name,
        ticks,
        sum(part.frames for part in done),
        "" if log.wire is None else digest.hexdigest(),
        done[0].divergence,
        done[0].differences,
        done[0].ignored,
        seconds,
        ticks * log.robot.dt,
        *(np.concatenate([getattr(part, name) for part in full]) for name in ("time", "logged", "replayed")),
    )


def _first_tick(run: Run) -> int:
    for piece in run.pieces(schema.TICK):
        if len(piece):
            return int(piece.array["tick"][0])
    raise LogError(f"{run.path}: no tick in it")


def _marks(run: Run) -> list[_Mark]:
    if schema.CHECKPOINT not in run:
        return []
    found = run[schema.CHECKPOINT]
    return [_Mark(at, text) for at, text in zip(found.time.tolist(), found.payloads, strict=True)]


def _at_once(
    run: Run, subject: _Some, marks: list[_Mark], whole: bool, progress: Callable[[int], None]
) -> list[_Part] | None:
    """Return the spans between the checkpoints, replayed side by side; None unless all of them are as the log says."""
    jobs = min(len(os.sched_getaffinity(0)), len(marks) + whole)
    if jobs < 2:
        return None
    starts: list[_Mark | None] = [*([None] if whole else []), *marks]
    ticks = 0
    # A fork inherits the robot, which takes seconds to build. What it gives back is plain.
    fork = multiprocessing.get_context("fork")
    with ProcessPoolExecutor(jobs, fork, _inherit, (run, subject, [*starts, None])) as pool:
        waiting = [pool.submit(_span, k) for k in range(len(starts))]
        parts = []
        for each in waiting:
            try:
                part = each.result()
            except BrokenProcessPool:  # a process died: in order, it is seen where
                return None
            if part is None or part.divergence is not None or part.differences or not part.agrees:
                pool.shutdown(cancel_futures=True)
                return None
            parts.append(part)
            ticks += part.ticks
            progress(ticks)
    return parts


_inherited: tuple[Run, _Some, list[_Mark | None]]


def _inherit(run: Run, subject: _Some, marks: list[_Mark | None]) -> None:
    global _inherited
    _inherited = run, subject, marks


def _span(k: int) -> _Part | None:
    run, subject, marks = _inherited
    begin, end = marks[k], marks[k + 1]
    sent: list[bytes] = []
    span = (0 if begin is None else begin.time + 1, I64_MAX if end is None else end.time + 1)
    try:
        part = _played(run, subject, span, begin, True, sent.append, lambda n: None, end)
    except LogError:
        return None  # in order, it says which
    return part._replace(sent=b"".join(sent))


def _played(
    run: Run,
    subject: _Subject[R, M, F, C],
    span: tuple[int, int],
    begin: _Mark | None,
    compares: bool,
    sent_on: Callable[[bytes], None],
    progress: Callable[[int], None],
    end: _Mark | None = None,
) -> _Part:
    """Replay the ticks of a span of log_time, from a checkpoint or from the very start, up to one or the very end."""
    log, robot, tick, memory, expected = subject.log, subject.log.robot, subject.vehicle.tick, subject.memory, 0
    wire = None if log.wire is None else Wire(run, log.wire, compares, span)
    if begin is not None:
        memory, counters = subject.resumed(run, begin)
        expected = memory.tick + 1
        if wire is not None:
            wire.go_on(counters)
    check = Check(run, log.shown)
    done = 0
    for block in _blocks(inputs(run.logs, log.feedbacks, span)):
        if not done and int(block[0].record["tick"]) != expected:
            raise LogError(f"{run.path}: goes on with tick {block[0].record['tick']}, wanted {expected}")
        if wire is not None:
            wire.prime(block[0].log_time)
        records, sent = [], []
        for logged in block:
            memory, command, record = tick(robot, memory, logged.feedback, logged.request)
            records.append(record)
            sent.append(subject.encoded(command))
            sent_on(sent[-1])
        ticks = check.compare([logged.record for logged in block], records)
        if wire is not None:
            wire.compare([logged.log_time for logged in block], ticks, robot.dt, sent)
        done += len(block)
        progress(done)
    found = (check.divergence, None if wire is None else wire.divergence)
    first = min((d for d in found if d is not None), key=lambda d: d.tick, default=None)
    time, logged_tau, tau = check.drawn()
    frames = 0 if wire is None else wire.frames
    agrees = subject.agrees(memory, end)
    return _Part(done, frames, first, check.differences(), check.ignored, time, logged_tau, tau, b"", agrees)


def _blocks(ticks: Iterator[Logged]) -> Iterator[list[Logged]]:
    while block := list(islice(ticks, BLOCK)):
        yield block

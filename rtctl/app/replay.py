"""Replay: the pure tick once more on the inputs of a log, from the log alone: the same bits, or where they differ.

The command frames are made anew by the daemon's own encoder, so that what is compared is what went over the bus.
"""

import gc
import hashlib
import multiprocessing
import os
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple, cast

import msgspec
import numpy as np

from rtctl import design as cfg
from rtctl.app.arm import link_spec
from rtctl.app.compare import Check, Difference, Divergence, Wire
from rtctl.app.servo import first_feedback
from rtctl.arm.pipe import initial, tick
from rtctl.arm.robot import Robot
from rtctl.design import Config
from rtctl.errors import ConfigError, LogError
from rtctl.hal.can.link import CanLink
from rtctl.log import schema
from rtctl.log.header import meshes_of
from rtctl.log.mcap.walk import I64_MAX
from rtctl.log.read.inputs import EVERYTHING, Logged, feedbacks_of, inputs
from rtctl.log.read.run import Run
from rtctl.log.read.topic import Structured
from rtctl.log.record.checkpoint import Checkpoint, decode_checkpoint, encode_checkpoint
from rtctl.log.record.meshes import unpacked
from rtctl.spec.urdf import urdf_file
from rtctl.types import F64, Command, Drive, Request, Transport

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


def rebuilt(run: Run) -> tuple[Config, Robot]:
    """Return config and robot as the log's attachments describe them.

    Raises LogError when they are not there, ConfigError when this version refuses them.
    """
    header = run.header
    if not header.config or not header.urdf:
        raise LogError(f"{run.path}: no config.toml or robot.urdf attached: it cannot be replayed alone")
    with tempfile.TemporaryDirectory(prefix="rtctl-replay-") as name:
        folder = Path(name)
        urdf, text = unpacked(header.urdf, header.config, header.files, folder)
        (folder / "config.toml").write_text(text, encoding="utf-8")
        (folder / "robot.urdf").write_text(urdf, encoding="utf-8")
        try:
            config = cfg.load(folder / "config.toml")
            own = msgspec.structs.replace(config.robot, urdf="robot.urdf")
            here = msgspec.structs.replace(config, robot=own)
            robot = cfg.build(here, folder / "config.toml")
            return config, robot._replace(meshes=meshes_of(header))
        except ValueError as error:
            raise LogError(f"{run.path}: a mesh that is attached: {error}") from None
        except ConfigError as error:
            place = error.place.replace(f"{folder}/", f"{run.path}: ")
            raise ConfigError(place, error.got, error.wanted) from None


def other(path: Path, run: Run) -> tuple[Config, Robot]:
    """Return another config and its robot, for what-if. Raises ConfigError when it is not for this log's robot."""
    config = cfg.load(path)
    urdf_file(config.robot.urdf, path)
    header = run.header
    names = tuple(j.name for j in config.robot.joints)
    if names != header.joints:
        raise ConfigError(f"{path}: robot.joints", ", ".join(names), f"the log's {', '.join(header.joints)}")
    if abs(1.0 / config.loop.servo_hz - header.period) > 1e-12:
        raise ConfigError(f"{path}: loop.servo_hz", config.loop.servo_hz, f"the log's {1.0 / header.period:g}")
    return config, cfg.build(config, path)._replace(meshes=meshes_of(run.header))


class _Null:
    """A bus that takes everything."""

    def send_all(self, frames: Sequence[bytes]) -> Sequence[bytes]:
        return frames


class _Subject(NamedTuple):
    """What is replayed: an arm or a base."""

    name: str
    dt: float  # [s]
    memory: Any
    tick: Callable[[Any, Any, Request], tuple[Any, Any, Any]]  # (memory, feedback, request)
    feedbacks: Callable[[Structured], Iterable[Any]]
    link: CanLink | None  # encodes commands again; None: the records alone are compared
    shown: str  # the field of a command that is drawn
    robot: Robot | None = None  # of an arm: its memory is kept in checkpoints


def _arm(run: Run, config: Path | None) -> _Subject:
    what, robot = rebuilt(run) if config is None else other(config, run)
    link = CanLink(link_spec(what), cast(Transport, _Null()))
    memory = initial(robot, first_feedback(_first_q(run)))
    return _Subject(robot.name, robot.dt, memory, partial(tick, robot), feedbacks_of, link, "tau_sent", robot)


def _base(run: Run, config: Path | None) -> _Subject:
    from rtctl.design.rover import build
    from rtctl.rover import pipe
    from rtctl.rover.record import feedback_from
    from rtctl.spec.base import load

    header = run.header
    with tempfile.TemporaryDirectory(prefix="rtctl-replay-") as name:
        path = Path(name) / "config.toml"
        path.write_text(unpacked("", header.config, header.files, path.parent)[1], encoding="utf-8")
        path = path if config is None else config
        base = build(load(path), path)
    try:
        start = feedback_from(np.frombuffer(bytes.fromhex(header.extra.get("start", "")), header.dtype)[0])
    except (ValueError, IndexError):
        raise LogError(f"{run.path}: its header has no feedback of the handshake") from None
    if abs(base.dt - header.period) > 1e-12:
        raise ConfigError(f"{path}: loop.servo_hz", f"{1.0 / base.dt:g}", f"the log's {1.0 / header.period:g}")
    step, rows = partial(pipe.tick, base), partial(map, feedback_from)
    return _Subject(base.name, base.dt, pipe.initial(base, start), step, rows, None, "v_world")


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
    subject = (_base if run.header.extra.get("kind") == "base" else _arm)(run, config)
    marks = _marks(run) if subject.robot is not None else []
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
        subject.name, ticks, sum(part.frames for part in done), "" if subject.link is None else digest.hexdigest(),
        done[0].divergence, done[0].differences, done[0].ignored, seconds, ticks * subject.dt,
        *(np.concatenate([getattr(part, name) for part in full]) for name in ("time", "logged", "replayed")),
    )  # fmt: skip


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
    run: Run, subject: _Subject, marks: list[_Mark], whole: bool, progress: Callable[[int], None]
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


_inherited: tuple[Run, _Subject, list[_Mark | None]]


def _inherit(*given: Any) -> None:
    global _inherited
    _inherited = given


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
    run: Run, subject: _Subject, span: tuple[int, int], begin: _Mark | None, compares: bool,
    sent_on: Callable[[bytes], None], progress: Callable[[int], None], end: _Mark | None = None,
) -> _Part:  # fmt: skip
    """Replay the ticks of a span of log_time, from a checkpoint or from the very start, up to one or the very end."""
    link, memory, expected = subject.link, subject.memory, 0
    dry = run.header.extra.get("dry") == "1"
    wire = None if link is None else Wire(run, link, compares, span)
    if begin is not None:
        start = _start(run, subject, begin)
        memory, expected = start.memory, start.memory.tick + 1
        if wire is not None:
            wire.go_on(start.counters)
    check = Check(run, subject.shown)
    done = 0
    for block in _blocks(inputs(run.logs, subject.feedbacks, span)):
        if not done and int(block[0].record["tick"]) != expected:
            raise LogError(f"{run.path}: goes on with tick {block[0].record['tick']}, wanted {expected}")
        if wire is not None:
            wire.prime(block[0].log_time)
        records, sent = [], []
        for logged in block:
            memory, command, record = subject.tick(memory, logged.feedback, logged.request)
            records.append(record)
            if link is not None:
                sent.append(b"".join(link.write(Command(Drive.DISABLE, command.tau) if dry else command)))
                sent_on(sent[-1])
        ticks = check.compare([logged.record for logged in block], records)
        if wire is not None:
            wire.compare([logged.log_time for logged in block], ticks, subject.dt, sent)
        done += len(block)
        progress(done)
    found = (check.divergence, None if wire is None else wire.divergence)
    first = min((d for d in found if d is not None), key=lambda d: d.tick, default=None)
    agrees = end is None or (link is not None and encode_checkpoint(memory, link.counters) == end.text)
    time, logged_tau, tau = check.drawn()
    frames = 0 if wire is None else wire.frames
    return _Part(done, frames, first, check.differences(), check.ignored, time, logged_tau, tau, b"", agrees)


def _start(run: Run, subject: _Subject, mark: _Mark) -> Checkpoint:
    assert subject.robot is not None
    try:
        return decode_checkpoint(mark.text, subject.robot, subject.memory)
    except ValueError as error:
        raise LogError(f"{run.path}: its checkpoint cannot be used: {error}") from None


def _blocks(ticks: Iterator[Logged]) -> Iterator[list[Logged]]:
    while block := list(islice(ticks, BLOCK)):
        yield block


def _first_q(run: Run) -> F64:
    text = run.header.extra.get("q_handshake", "")
    try:
        q = np.frombuffer(bytes.fromhex(text), np.float64)
    except ValueError:
        q = np.zeros(0)
    if q.shape != (len(run.header.joints),):
        raise LogError(f"{run.path}: its header has no positions of the handshake")
    return q

"""The recorder: a process of its own that drains the ring into MCAP files, and the daemon's end of it.

`python -m rtctl.log.record.recorder RING` is started by `Recorder.start`. It ignores the signals meant for the group:
it ends when the producer has closed the ring, or is gone, and everything committed is on the disk. Started again on the
same ring (after it was killed, or after everything was) it first closes the file that its predecessor left, reads there
how far that one came, and goes on behind it.
"""

import contextlib
import itertools
import json
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

from rtctl.errors import LinkError, LogError
from rtctl.log.entry import Batch, Kind
from rtctl.log.header import Header, header_from_json, header_to_json
from rtctl.log.mcap.names import OPEN, logs_in, plain, session_files
from rtctl.log.mcap.recovery import entries_of, recover, recover_folder
from rtctl.log.mcap.segment import CHUNK_BYTES, locked
from rtctl.log.record import ring as rings
from rtctl.log.record.health import DropWatch
from rtctl.log.record.leftovers import PREFIX, SUFFIX, rings_in, sweep
from rtctl.log.record.ring import Consumer, Producer, attach, create
from rtctl.log.record.writer import Options, Session, segment_path
from rtctl.trust import TrustError, plain_name

CAPACITY = 32 << 20  # [bytes]: some 8 s of a 7-joint arm at 1 kHz
NAP = 0.02  # [s] between looks at the ring
READY_TIMEOUT = 60.0  # [s] a process that lives may take that long to come up on a machine that is busy
LONGEST = 7 * 86400.0  # [s] of a segment
LARGEST = 10**13  # [bytes] of a segment and of the free disk that is kept, as a config may say


class Stats(NamedTuple):
    """What the daemon should know of its log."""

    entries: int  # offered
    dropped: int  # refused because the ring was full
    lost: int  # taken by the recorder but not written, since the disk was full
    backlog: int  # [bytes] not yet safe
    alive: bool  # the recorder runs
    degraded: bool  # nothing is being written, or more than health.DROP_RATE is dropped: refuse to arm
    path: Path  # of the file that is being written (it ends in .open until it is whole)


class Recorder:
    """The daemon's end: owns the ring and the recorder process."""

    def __init__(self, ring: Producer, options: Options) -> None:
        self._ring = ring
        self._options = options
        self._process: subprocess.Popen[bytes] | None = None
        self.refusal = ""  # why it could not be started, the last time that was tried
        self._drops = DropWatch()
        self.put = ring.put
        self.put_many = ring.put_many
        self.beat = ring.beat

    @classmethod
    def start(
        cls,
        directory: Path | str,
        header: Header,
        *,
        capacity: int = CAPACITY,
        segment_s: float = 60.0,
        segment_bytes: int = 1 << 30,
        floor_bytes: int = 256 << 20,
        folders: Sequence[Path] = (),
        config: Path | None = None,
    ) -> "Recorder":
        """Create the ring, start the recorder and wait until it has opened its file.

        directory: of the log files; capacity: of the ring [bytes], a power of two; floor_bytes: of free disk that is
        kept by deleting the oldest logs of the directory; folders: for the ring file, /dev/shm first if not given;
        config: the robot's file, for viewers that look for meshes beside it.
        Raises LogError when the recorder does not come up, LinkError when no ring can be had.
        """
        stem = _session_name(Path(directory), header.robot)
        options = Options(Path(directory).absolute(), stem, segment_s, segment_bytes, floor_bytes)
        blob = blob_of(header, [str(o) for o in options], config)
        ring = create(f"{PREFIX}{options.stem}-{os.getpid()}{SUFFIX}", capacity, blob, folders)
        recorder = cls(ring, options)
        recorder.spawn()
        until = time.monotonic() + READY_TIMEOUT
        while not ring.counts().ready:
            if not recorder.alive or time.monotonic() > until:
                recorder._abandon()
                raise LogError(f"{directory}: the recorder did not start{recorder.refusal and ': '}{recorder.refusal}")
            time.sleep(0.01)
        return recorder

    def spawn(self) -> None:
        """Start the recorder process on the ring; also after it died, which loses nothing. Takes some milliseconds.

        A system that has no descriptor, process or memory left refuses it: then the log stays degraded until it is
        tried again, and the loop goes on.
        """
        if self.alive:
            return
        command = [sys.executable, "-m", "rtctl.log.record.recorder", str(self._ring.path)]
        try:
            self._process = subprocess.Popen(command, stdin=subprocess.DEVNULL, start_new_session=True)
            self.refusal = ""
        except OSError as error:
            self.refusal = f"{error.strerror or error}".lower()

    @property
    def alive(self) -> bool:
        """Return whether the recorder process runs."""
        return self._process is not None and self._process.poll() is None

    @property
    def pid(self) -> int:
        """Return the recorder's process id. Raises LogError when it does not run."""
        if self._process is None or not self.alive:  # no number stands for none: kill(0) and kill(-1) mean many
            raise LogError("the recorder does not run")
        return self._process.pid

    @property
    def ring_path(self) -> Path:
        """Return the ring's file."""
        return self._ring.path

    def stats(self) -> Stats:
        """Return the log's state; a few microseconds."""
        counts = self._ring.counts()
        alive = self.alive
        path = segment_path(self._options, counts.segment)
        losing = self._drops.update(time.monotonic(), counts.number, counts.dropped)
        degraded = counts.degraded or losing or not alive
        return Stats(counts.number, counts.dropped, counts.lost, counts.backlog, alive, degraded, path)

    def close(self, reason: str = "closed", detail: str = "", patience: float = 10.0) -> Stats:
        """Say why the log ends, and wait until it is whole; a recorder that died is started again for that.

        A recorder that gets on is waited for. After `patience` [s] in which it did not, it is left to finish by itself.
        """
        text = json.dumps({"reason": reason, "detail": detail}).encode()
        self._ring.put(Kind.SENTINEL, text, time.monotonic_ns())
        self._ring.finish()
        until, waiting = time.monotonic() + patience, self._ring.counts().backlog
        attempts = 3
        while not self._ring.counts().finished and time.monotonic() < until and (self.alive or attempts > 0):
            if (now := self._ring.counts().backlog) < waiting:  # the machine may be busy
                until, waiting = time.monotonic() + patience, now
            attempts -= not self.alive
            self.spawn()
            time.sleep(0.005)
        stats = self.stats()._replace(degraded=self._ring.counts().degraded)
        if self._process is not None:
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(max(0.0, until - time.monotonic()))
        self._ring.unmap()
        return stats

    def _abandon(self) -> None:
        self._ring.finish()
        if self._process is not None and self.alive:
            self._process.kill()
            self._process.wait()
        self._ring.path.unlink(missing_ok=True)
        self._ring.unmap()


def blob_of(header: Header, options: Sequence[str] = (), config: Path | None = None) -> bytes:
    """Return what a ring tells its consumers: the header, what the recorder is to do, the robot's file."""
    told = {
        "header": header_to_json(header),
        "options": list(options),
        "config": str(config.resolve()) if config else "",
    }
    return json.dumps(told).encode()


def _session_name(directory: Path, robot: str) -> str:
    """Return a name that no session of the folder has, whatever the clock says."""
    stamp = datetime.now(UTC).strftime("%Y%m%dT%H%M%S.%f")[:-3].replace(".", "")
    taken = {plain(path).rpartition(".")[0] for path in logs_in(directory)}
    names = (f"{robot}-{stamp}Z{more}" for more in itertools.chain([""], (f"-{k}" for k in itertools.count(2))))
    return next(name for name in names if name not in taken)


def _options(blob: bytes) -> Options:
    """Return what a ring says of its log, with nothing in it that names another folder or breaks a bound.

    Raises LinkError: a ring that another program wrote, or an older one of ours, is no reason to fail.
    """
    try:
        directory, stem, segment_s, segment_bytes, floor_bytes = json.loads(blob)["options"]
        options = Options(Path(directory), plain_name(stem), float(segment_s), int(segment_bytes), int(floor_bytes))
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError, TrustError) as error:
        raise LinkError(f"a ring whose header is not understood: {error}") from None
    sizes = 0 < options.segment_bytes <= LARGEST and 0 <= options.floor_bytes <= LARGEST
    sane = sizes and 0.0 < options.segment_s <= LONGEST
    if not sane or not options.directory.is_absolute():
        raise LinkError(f"a ring with options out of their bounds: {options}")
    return options


def _predecessor(options: Options) -> tuple[int, int]:
    """Close what an earlier recorder of the same ring left; return the last entry it wrote and the next segment."""
    named = (path for path in logs_in(options.directory) if plain(path).rpartition(".")[0] == options.stem)
    files = session_files(named, options.stem)
    number = 0
    for _, path in files[-2:]:
        found = recover(path, {"reason": "recorder died"}).entries if path.suffix == OPEN else entries_of(path)
        number = max(number, found)
    return number, max((k for k, _ in files), default=-1) + 1


def _without(batch: Batch, number: int) -> tuple[Batch, str, str]:
    """Return the batch without what is written already and without sentinels, and the sentinel's reason and detail."""
    reason = detail = ""
    keep = []
    for index, (kind, count) in enumerate(zip(batch.kind, batch.number, strict=True)):
        if kind == Kind.SENTINEL:
            with contextlib.suppress(ValueError, TypeError, KeyError):
                content = json.loads(bytes(batch.payload[index]))
                reason, detail = str(content["reason"]), str(content["detail"])
        elif count > number:
            keep.append(index)
    if len(keep) == len(batch.kind):
        return batch, reason, detail
    columns = batch.kind, batch.number, batch.time, batch.sequence
    kinds, numbers, times, sequences = ([column[i] for i in keep] for column in columns)
    return Batch(kinds, numbers, times, sequences, [batch.payload[i] for i in keep]), reason, detail


class _Drain:
    """The recorder process's work on one ring."""

    def __init__(self, ring: Consumer) -> None:
        self.ring = ring
        options = _options(ring.blob)
        content = json.loads(ring.blob)
        number, first = _predecessor(options)
        self.skip = max(number, ring.words[rings.CONSUMED])
        self.session = Session(header_from_json(content["header"]), options, self.skip, first)
        self.reason = self.detail = ""
        self._publish()

    def _publish(self) -> None:
        words, session = self.ring.words, self.session
        words[rings.SEGMENT], words[rings.DEGRADED] = session.index, int(session.degraded)
        words[rings.LOST], words[rings.MALFORMED] = session.lost, session.encoder.malformed

    def step(self) -> bool:
        """Move what waits in the ring towards the disk; return whether anything waited."""
        batch = self.ring.take(CHUNK_BYTES)
        if batch.number:
            batch, reason, detail = _without(batch, self.skip)
            self.reason, self.detail = reason or self.reason, detail or self.detail
            self.session.write(batch)
        self.session.poll()
        if self.session.clean:
            self.ring.release()
        self._publish()
        return bool(batch.kind)

    def run(self) -> None:
        """Drain until the producer has closed the ring or is gone, then close the log."""
        died = _Death(self.ring)
        while True:
            ended = bool(self.ring.words[rings.CLOSED]) or died.now()  # before looking: nothing comes after it
            if not self.step() and ended and self.ring.drained:
                break
            if not ended and self.ring.drained:
                died.nap()
        if not self.ring.words[rings.CLOSED]:
            age = (time.monotonic_ns() - self.ring.words[rings.HEARTBEAT]) / 1e9
            self.reason = self.reason or "producer died"
            self.detail = self.detail or f"its process is gone; last heartbeat {age:.3f} s before"
        if self.ring.corrupt:
            self.reason, self.detail = "ring corrupt", f"at {self.ring.position}"
        offered = self.ring.words[rings.NUMBER]
        content = {"reason": self.reason or "closed", "detail": self.detail}
        self.session.close(content, offered - 1 if self.reason_given else offered)
        if not self.session.degraded:
            self.ring.release()
        self._publish()
        self.ring.words[rings.FINISHED] = 1

    @property
    def reason_given(self) -> bool:
        """Return whether the last entry was the producer's sentinel, which is no message of its own."""
        return self.ring.words[rings.CLOSED] == 1 and self.reason != ""


class _Death:
    """Tells when the producer is gone, without asking again and again for a process id that may be reused."""

    def __init__(self, ring: Consumer) -> None:
        self._ring = ring
        self._poll: select.poll | None = None
        with contextlib.suppress(OSError):
            file = os.pidfd_open(ring.words[rings.PRODUCER])
            self._poll = select.poll()
            self._poll.register(file, select.POLLIN)
        self._gone = not ring.producer_alive()

    def now(self) -> bool:
        return self._wait(0.0)

    def nap(self) -> None:
        self._wait(NAP)

    def _wait(self, seconds: float) -> bool:
        if not self._gone and self._poll is not None:
            self._gone = bool(self._poll.poll(seconds * 1e3))
        elif not self._gone:
            time.sleep(seconds)
            self._gone = not self._ring.producer_alive()
        return self._gone


def drain(path: Path) -> bool:
    """Drain a ring to its end and remove it; False when another recorder does so already.

    Raises LinkError when the file is not a ring, OSError when it cannot be opened.
    """
    ring = attach(path)
    if not locked(ring.file):
        ring.unmap()
        return False
    ring.words[rings.CONSUMER], ring.words[rings.CONSUMER_START] = os.getpid(), rings.process_start(os.getpid())
    work = _Drain(ring)
    ring.words[rings.READY] = 1
    rescue(work.session.options.directory, (path.parent,))
    work.run()
    path.unlink(missing_ok=True)
    ring.unmap()
    return True


def rescue(directory: Path | str, folders: Sequence[Path] = ()) -> list[Path]:
    """Finish the logs of `directory` that a crash of both processes left: rings first, then cut files.

    Returns the files that are whole now.
    """
    directory = Path(directory).absolute()
    before = set(directory.glob("*.mcap"))
    for path in rings_in(folders):
        with contextlib.suppress(LinkError, LogError, TrustError, OSError):
            if _orphan(path, directory):
                drain(path)
    sweep(folders)
    recover_folder(directory)
    return sorted(set(directory.glob("*.mcap")) - before)


def _orphan(path: Path, directory: Path) -> bool:
    """Return whether a ring is of a log in `directory` and its producer is gone; raises as `drain` does."""
    ring = attach(path)
    try:
        return _options(ring.blob).directory == directory and not ring.producer_alive()
    finally:
        ring.unmap()


def _detach() -> None:
    """Become an ordinary process that outlives the signals meant for the daemon's group."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGPIPE):
        signal.signal(number, signal.SIG_IGN)
    with contextlib.suppress(OSError):  # the daemon's realtime class and core are not ours
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        os.sched_setaffinity(0, range(os.cpu_count() or 1))
        os.nice(5)


def main(arguments: Sequence[str]) -> int:
    """Drain the ring that is named; the recorder process."""
    _detach()
    try:
        return 0 if drain(Path(arguments[0])) else 1
    except (LinkError, LogError, TrustError, OSError) as error:
        print(f"rtctl recorder: {error}", file=sys.stderr)
        return 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

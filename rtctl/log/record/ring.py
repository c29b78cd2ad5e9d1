"""A ring in shared memory from the servo process to the recorder: one producer, one consumer, nobody waits.

The producer writes an entry behind `head` and then moves `head`; the consumer copies entries up to `head` and, once
they are safe on disk, moves `tail`. Positions count bytes since the start and never wrap. When an entry does not fit,
it is dropped, and it keeps its numbers: the hole tells the consumer how many were lost and where.

A cycle's frames, all of one size, are put as one piece of several parts; each part is an entry for the consumer.

Memory order. Correctness needs two things: the 8-byte stores of `head` and `tail` are not torn, and the entry's bytes
are visible before the `head` that publishes them (and have been copied before the `tail` that frees them).
 * A word is stored by assigning to a `memoryview` cast to "Q", which CPython does with one 8-byte memcpy to an aligned
   address: one store instruction on x86-64 and AArch64. (`struct.pack_into("<Q")` would store it byte by byte.)
 * The compiler cannot reorder the two stores: they happen in different bytecodes, through calls it cannot see into.
 * x86 keeps stores in order among stores, and loads among loads (TSO), so nothing more is needed.
 * Elsewhere (ARM) the processor may reorder. `fence` then releases and takes an uncontended lock: CPython's lock is an
   atomic with release order when given back and acquire order when taken, and a release followed in program order by
   an acquire is ordered on ARMv8, hence what came before is visible before what comes after.
Everything lives in a file that is mapped shared: committed entries outlive a kill -9 of either side.
"""

import contextlib
import mmap
import os
import platform
import struct
import tempfile
import threading
from collections import defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from rtctl.errors import LinkError
from rtctl.log.entry import Batch, Payload, empty, stream
from rtctl.trust import open_file
from rtctl.types import Frames

MAGIC = 0x32474E5254435452  # "RTCTRNG2"
PAGE = 4096
SHM = Path("/dev/shm")
HEAD = struct.Struct("@IIQQII")  # length, kind, number, time, sequence, parts
WRAP_MARK = struct.Struct("@I")
HEAD_SIZE = HEAD.size
PARTS = 512  # frames that one drain of a bus can bring: 8 calls of 64
WRAP = 0xFFFFFFFF  # in place of a length: go on at the start
SLACK = 64  # so that a header can be read at the very end

# Indices of 8-byte words in the first page; each writer's words have a cache line (8 words) to themselves.
MAGIC_AT, CAPACITY, DATA, BLOB, PRODUCER, PRODUCER_START = range(6)
HEAD_AT = 8
NUMBER, DROPPED = 16, 17
HEARTBEAT, CLOSED = 24, 25
TAIL, CONSUMED = 32, 33
CONSUMER, CONSUMER_START, READY, DEGRADED, SEGMENT, LOST, MALFORMED, FINISHED = range(40, 48)


class Counts(NamedTuple):
    """What both ends have told each other through the first page."""

    number: int  # entries offered
    dropped: int  # of these, refused because the ring was full
    backlog: int  # [bytes] not yet safe on disk
    consumed: int  # number of the last entry that is safe
    degraded: bool  # the consumer cannot write
    ready: bool  # the consumer has opened its first file
    finished: bool  # the consumer has closed its last file
    segment: int  # index of the consumer's file
    lost: int  # entries taken but not written, since the disk was full


def process_start(pid: int) -> int:
    """Return the start time of a process [clock ticks since boot]; 0 when there is no such process."""
    try:
        text = Path(f"/proc/{pid}/stat").read_bytes()
    except OSError:
        return 0
    fields = text.rpartition(b")")[2].split()
    return 0 if fields[0] in (b"Z", b"X") else int(fields[19])


def _fence() -> Callable[[], None] | None:
    if platform.machine().lower() in ("x86_64", "amd64", "i386", "i686"):
        return None
    lock = threading.Lock()
    lock.acquire()

    def fence() -> None:
        lock.release()
        lock.acquire()

    return fence


class Ring:
    """The mapped file, common to both ends.

    Layout: one page of words, the producer's blob (a JSON header), the data area of a power-of-two size.
    """

    def __init__(self, path: Path, file: int, access: int = mmap.ACCESS_WRITE) -> None:
        """Map the file; access: mmap.ACCESS_WRITE, or ACCESS_READ for somebody who may only look."""
        self.path = path
        self.file = file
        size = os.fstat(file).st_size
        if size < PAGE:
            raise LinkError(f"{path}: not a ring")
        self.map = mmap.mmap(file, size, access=access)
        self._page = memoryview(self.map)[:PAGE]
        self.words = self._page.cast("Q")
        self.capacity = self.words[CAPACITY]
        self.data_at = self.words[DATA]
        power = self.capacity > 0 and self.capacity & (self.capacity - 1) == 0
        if self.words[MAGIC_AT] != MAGIC or not power or self.data_at + self.capacity + SLACK != size:
            self.release_views()
            raise LinkError(f"{path}: not a ring of this version")
        self.mask = self.capacity - 1
        self._fence = _fence()

    @property
    def blob(self) -> bytes:
        """Return what the producer wrote for its consumers."""
        return bytes(self.map[PAGE : PAGE + self.words[BLOB]])

    def counts(self) -> Counts:
        """Return the state of both ends; safe to call from either."""
        w = self.words
        tail = w[TAIL]  # first: head can only grow, so the backlog is never negative
        return Counts(
            number=w[NUMBER],
            dropped=w[DROPPED],
            backlog=w[HEAD_AT] - tail,
            consumed=w[CONSUMED],
            degraded=bool(w[DEGRADED]),
            ready=bool(w[READY]),
            finished=bool(w[FINISHED]),
            segment=w[SEGMENT],
            lost=w[LOST],
        )

    def producer_alive(self) -> bool:
        """Return whether the process that created the ring still runs."""
        start = process_start(self.words[PRODUCER])
        return start != 0 and start == self.words[PRODUCER_START]

    def release_views(self) -> None:
        """Give the memory back; the descriptor stays open."""
        self.words.release()
        self._page.release()
        with contextlib.suppress(BufferError):  # somebody still holds a payload; it goes with the last of them
            self.map.close()

    def unmap(self) -> None:
        """Give memory and descriptor back; the file stays."""
        self.release_views()
        os.close(self.file)


class Producer(Ring):
    """The end that puts. Not for use by two threads, nor from a signal handler."""

    def __init__(self, path: Path, file: int) -> None:
        super().__init__(path, file)
        self._head = 0
        self._tail = 0  # as last read: the consumer can only have moved it on
        self._limit = 0  # position up to which there is room in one piece, as far as we know
        self._number = 0
        self._dropped = 0
        self._sequence: defaultdict[int, int] = defaultdict(int)

    def put(self, kind: int, payload: Payload, time_ns: int) -> bool:
        """Put one entry; return False (and count) when it did not fit. Never blocks.

        payload: bytes-like of contiguous bytes; time_ns: monotonic clock [ns].
        """
        return self.put_many(kind, (payload,), time_ns)

    def put_many(self, kind: int, payloads: Sequence[Payload], time_ns: int) -> bool:
        """Put several entries of one kind and time, published at once; False when any did not fit."""
        if type(payloads) is Frames and 0 < len(payloads) <= PARTS:
            return self._put_parts(kind, payloads, time_ns)
        position = self._head
        number = self._number
        at_stream = stream(kind)
        sequence = self._sequence[at_stream]
        fitted = True
        area = self.map
        for payload in payloads:
            number += 1
            sequence += 1
            size = len(payload)
            need = (size + HEAD_SIZE + 7) & ~7
            if position + need > self._limit:
                start = self._place(position, need)
                if start < 0:
                    self._dropped += 1
                    fitted = False
                    continue
                position = start
            at = self.data_at + (position & self.mask)
            HEAD.pack_into(area, at, size, kind, number, time_ns, sequence & 0xFFFFFFFF, 1)
            at += HEAD_SIZE
            area[at : at + size] = payload
            position += need
        self._sequence[at_stream] = sequence
        self._publish(position, number, time_ns)
        return fitted

    def _put_parts(self, kind: int, frames: Frames, time_ns: int) -> bool:
        """Put frames in one piece; all of them are dropped when they do not fit."""
        count, size = len(frames), len(frames.data)
        number = self._number
        at_stream = stream(kind)
        sequence = self._sequence[at_stream]
        need = (size + HEAD_SIZE + 7) & ~7
        position = start = self._head
        if position + need > self._limit:
            start = self._place(position, need)
        if start >= 0:
            at = self.data_at + (start & self.mask)
            HEAD.pack_into(self.map, at, size, kind, number + 1, time_ns, (sequence + 1) & 0xFFFFFFFF, count)
            at += HEAD_SIZE
            self.map[at : at + size] = frames.data
            position = start + need
        else:
            self._dropped += count
        self._sequence[at_stream] = sequence + count
        self._publish(position, number + count, time_ns)
        return start >= 0

    def _publish(self, position: int, number: int, time_ns: int) -> None:
        """Show the consumer what was put up to `position`, and how many entries were offered."""
        self._number = number
        self._head = position
        if self._fence is not None:
            self._fence()
        words = self.words
        words[HEAD_AT] = position
        words[NUMBER] = number
        words[HEARTBEAT] = time_ns
        words[DROPPED] = self._dropped

    def _place(self, position: int, need: int) -> int:
        """Return where an entry of `need` bytes starts: here, or after a wrap mark; -1 when there is no room."""
        lap = (position | self.mask) + 1  # where the data area ends
        start = position if position + need <= lap else lap
        self._limit = 0  # look again next time, unless we get through
        if start + need - self._tail > self.capacity:
            self._tail = self.words[TAIL]
            if start + need - self._tail > self.capacity:
                return -1
        if start != position:  # there is room for the mark: everything is aligned to 8
            WRAP_MARK.pack_into(self.map, self.data_at + (position & self.mask), WRAP)
        self._limit = min(self._tail + self.capacity, (start | self.mask) + 1)
        return start

    def beat(self, time_ns: int) -> None:
        """Tell the consumer that the producer lives though it has nothing to say."""
        self.words[HEARTBEAT] = time_ns

    def finish(self) -> None:
        """Tell the consumer that nothing more will come."""
        if self._fence is not None:
            self._fence()
        self.words[CLOSED] = 1


class Consumer(Ring):
    """The end that takes. `take` copies nothing and frees nothing: `release` does, once the entries are safe."""

    def __init__(self, path: Path, file: int) -> None:
        super().__init__(path, file)
        self.position = self.words[TAIL]  # next entry to take
        self.number = self.words[CONSUMED]  # of the last entry taken
        self.corrupt = False  # an entry makes no sense; nothing behind it can be found

    def take(self, limit: int) -> Batch:
        """Return the entries that have been committed, about `limit` [bytes] of them.

        The payloads are views into the ring: valid until `release`.
        """
        batch = empty()
        head = self.words[HEAD_AT]
        if self._fence is not None:
            self._fence()
        view = memoryview(self.map)
        position, stop = self.position, min(head, self.position + limit)
        kinds, numbers, times, sequences, payloads = batch
        while position < stop and not self.corrupt:
            at = position & self.mask
            start = self.data_at + at
            length, kind, number, time, sequence, parts = HEAD.unpack_from(self.map, start)
            if length == WRAP:
                position += self.capacity - at
                continue
            beyond = at + HEAD_SIZE + length > self.capacity or position + HEAD_SIZE + length > head
            if beyond or not 0 < parts <= PARTS or length % parts:
                self.corrupt = True
                break
            size = length // parts
            start += HEAD_SIZE
            kinds += [kind] * parts
            numbers += range(number, number + parts)
            times += [time] * parts
            sequences += [(sequence + k) & 0xFFFFFFFF for k in range(parts)]
            payloads += [view[start + k * size : start + (k + 1) * size] for k in range(parts)]
            position += (length + HEAD_SIZE + 7) & ~7
        self.position = position
        if numbers:
            self.number = numbers[-1]
        return batch

    def release(self) -> None:
        """Free everything taken so far: it is on disk."""
        if self._fence is not None:
            self._fence()
        self.words[CONSUMED] = self.number
        self.words[TAIL] = self.position

    @property
    def drained(self) -> bool:
        """Return whether every committed entry has been taken."""
        return self.corrupt or self.position >= self.words[HEAD_AT]


def create(name: str, capacity: int, blob: bytes, folders: Sequence[Path] = ()) -> Producer:
    """Create the ring file `name` in the first folder that has room (/dev/shm, else the temporary folder).

    capacity: of the data area [bytes], a power of two. The file's blocks are allocated and its pages touched here, so
    that no put meets a full file system or a page fault.
    Raises LinkError when no folder takes it, ValueError for a bad capacity.
    """
    if capacity < PAGE or capacity & (capacity - 1):
        raise ValueError(f"capacity {capacity}: wanted a power of two of at least {PAGE}")
    data_at = (PAGE + len(blob) + PAGE - 1) // PAGE * PAGE
    problem = ""
    for folder in folders or (SHM, Path(tempfile.gettempdir())):
        path = folder / name
        try:
            file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
        except OSError as error:
            problem = str(error)
            continue
        try:
            os.posix_fallocate(file, 0, data_at + capacity + SLACK)
        except OSError as error:
            problem = f"{path}: {error.strerror}"
            os.close(file)
            path.unlink()
            continue
        return _initialised(path, file, capacity, data_at, blob)
    raise LinkError(f"no room for a ring of {capacity >> 20} MiB: {problem}")


def _initialised(path: Path, file: int, capacity: int, data_at: int, blob: bytes) -> Producer:
    pid = os.getpid()
    words = [0] * (PAGE // 8)
    words[CAPACITY], words[DATA], words[BLOB] = capacity, data_at, len(blob)
    words[PRODUCER], words[PRODUCER_START] = pid, process_start(pid)
    words[MAGIC_AT] = MAGIC
    os.pwrite(file, struct.pack(f"@{len(words)}Q", *words) + blob, 0)
    ring = Producer(path, file)
    zeros = bytes(1 << 20)
    for at in range(data_at, data_at + capacity, len(zeros)):  # touch every page
        end = min(at + len(zeros), data_at + capacity)
        ring.map[at:end] = zeros[: end - at]
    return ring


def attach(path: Path) -> Consumer:
    """Open an existing ring of this user's for taking.

    Raises LinkError when it is not a ring, TrustError when another user made it, OSError when it cannot be opened.
    """
    file = open_file(path, os.O_RDWR, (os.geteuid(),), private=True)
    try:
        return Consumer(path, file)
    except LinkError:
        os.close(file)
        raise

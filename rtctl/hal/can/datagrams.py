"""Many datagrams in one system call: sendmmsg and recvmmsg of Linux, over preallocated buffers.

Seven frames each way are fourteen system calls without it and two with it, on any datagram socket.
"""

import ctypes
import errno
import socket
from collections.abc import Sequence

import numpy as np

from rtctl.protocol import frame
from rtctl.types import Frames

SIZE = 80  # above the 72 bytes of the longest frame, so that an oversize packet shows its length
CAPACITY = 64  # frames in one call
_CONTROL = 64  # room for one ancillary message
_SEND_FLAGS = int(socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL)  # the members of an enum are slow to combine
_DONTWAIT = int(socket.MSG_DONTWAIT)
_ROUNDS = 8  # calls of one drain: a flooded socket must not hold the loop


class _Iovec(ctypes.Structure):
    _fields_ = (("base", ctypes.c_void_p), ("length", ctypes.c_size_t))


class _Msghdr(ctypes.Structure):
    _fields_ = (
        ("name", ctypes.c_void_p),
        ("name_length", ctypes.c_uint32),
        ("iov", ctypes.c_void_p),
        ("iov_length", ctypes.c_size_t),
        ("control", ctypes.c_void_p),
        ("control_length", ctypes.c_size_t),
        ("flags", ctypes.c_int),
    )


class _Mmsghdr(ctypes.Structure):
    _fields_ = (("header", _Msghdr), ("length", ctypes.c_uint))


_HEADER_SIZE = ctypes.sizeof(_Mmsghdr)
_WORDS = np.dtype(
    {
        "names": ["control_length", "length"],
        "formats": [np.uint64, np.uint32],
        "offsets": [_Msghdr.control_length.offset, _Mmsghdr.length.offset],
        "itemsize": ctypes.sizeof(_Mmsghdr),
    }
)

_quick = ctypes.PyDLL(None, use_errno=True)  # keeps the interpreter lock: for calls that cannot block
_patient = ctypes.CDLL(None, use_errno=True)
for _library in (_quick, _patient):  # told once, so that plain numbers go over as they are
    _library.sendmmsg.argtypes = (ctypes.c_int, ctypes.c_void_p, ctypes.c_uint, ctypes.c_int)
    _library.recvmmsg.argtypes = (ctypes.c_int, ctypes.c_void_p, ctypes.c_uint, ctypes.c_int, ctypes.c_void_p)


class _Vector:
    """Preallocated headers, buffers and ancillary space of CAPACITY messages of up to `size` bytes."""

    def __init__(self, size: int = SIZE) -> None:
        self.data = bytearray(size * CAPACITY)
        self.control = bytearray(_CONTROL * CAPACITY)
        self.headers = (_Mmsghdr * CAPACITY)()
        self._iovecs = (_Iovec * CAPACITY)()
        data = ctypes.addressof(ctypes.c_char.from_buffer(self.data))
        control = ctypes.addressof(ctypes.c_char.from_buffer(self.control))
        for i in range(CAPACITY):
            self._iovecs[i].base, self._iovecs[i].length = data + i * size, size
            header = self.headers[i].header
            header.iov, header.iov_length = ctypes.addressof(self._iovecs[i]), 1
            header.control = control + i * _CONTROL
        words = np.frombuffer(memoryview(self.headers).cast("B"), dtype=_WORDS)
        self.control_lengths, self.came = words["control_length"], words["length"]  # views, taken once
        self.rows = np.frombuffer(self.data, np.uint8).reshape(CAPACITY, size)
        self.lengths = np.frombuffer(memoryview(self._iovecs).cast("B"), dtype=np.uint64)[1::2]
        self.address = ctypes.addressof(self.headers)


class Messages:
    """Sends and receives batches on one datagram socket; `error` is the errno of the last call that failed, or 0."""

    def __init__(self, sock: socket.socket, ancillary: bool = False) -> None:
        self._socket = sock
        self._in, self._out = _Vector(), _Vector()
        self._whole = {size: _Vector(size) for size in (frame.CAN_MTU, frame.CANFD_MTU)}  # for frames of one size
        self._ancillary = _CONTROL if ancillary else 0
        self._in.control_lengths[:] = self._ancillary
        self._patience = -1.0
        self.error = 0
        self.dropped = 0  # frames that the kernel threw away because nobody read them, as SO_RXQ_OVFL counts

    def send(self, frames: Sequence[bytes]) -> Sequence[bytes]:
        """Send each frame or drop it; return those that went out."""
        if type(frames) is Frames and frames.size in self._whole and len(frames) <= CAPACITY:
            whole = self._whole[frames.size]
            whole.data[: len(frames.data)] = frames.data
            return self._send_batch(frames, whole)
        out = self._out
        went: list[bytes] = []
        for start in range(0, len(frames), CAPACITY):
            batch = frames[start : start + CAPACITY]
            for i, raw in enumerate(batch):
                out.data[i * SIZE : i * SIZE + len(raw)] = raw
            out.lengths[: len(batch)] = [len(raw) for raw in batch]
            went += self._send_batch(batch, out)
        return went

    def _send_batch(self, batch: Sequence[bytes], out: _Vector) -> Sequence[bytes]:
        fd, at, total = self._socket.fileno(), 0, len(batch)
        went: list[bytes] = []
        while at < total:
            count = _quick.sendmmsg(fd, out.address + at * _HEADER_SIZE, total - at, _SEND_FLAGS)
            if count == total:
                return batch
            if count > 0:
                went += batch[at : at + count]
                at += count
                continue
            code = ctypes.get_errno()
            if code == errno.EINTR:
                continue
            self.error = code
            if code != errno.ENOBUFS:  # the next frame would fare no better
                break
            at += 1
        return went

    def receive(self) -> Sequence[bytes]:
        """Return everything that waits, up to a bound that a flood cannot lift; never blocks."""
        batch = self._receive_batch(CAPACITY, 0.0)
        if len(batch) < CAPACITY:
            return batch
        frames = list(batch)
        for _ in range(_ROUNDS - 1):
            batch = self._receive_batch(CAPACITY, 0.0)
            frames += batch
            if len(batch) < CAPACITY:
                break
        return frames

    def collect(self, count: int, timeout: float) -> Sequence[bytes]:
        """Return `count` frames, or those that came until none came for `timeout` [s]."""
        return self._receive_batch(min(count, CAPACITY), max(timeout, 1e-3))

    def _receive_batch(self, count: int, timeout: float) -> Sequence[bytes]:
        if timeout > 0.0 and timeout != self._patience:
            microseconds = int(timeout * 1e6)
            value = np.array([microseconds // 1_000_000, microseconds % 1_000_000], dtype=np.int64).tobytes()
            try:
                self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, value)
            except OSError as error:  # of a bus that is gone: the loop is told as of every other call
                self.error = error.errno or errno.EBADF
                return []
            self._patience = timeout
        into = self._in
        if self._ancillary:
            into.control_lengths[:] = self._ancillary  # the kernel wrote there what it used
        library, flags = (_patient, 0) if timeout > 0.0 else (_quick, _DONTWAIT)
        came: int = library.recvmmsg(self._socket.fileno(), into.address, count, flags, None)
        if came < 0:
            code = ctypes.get_errno()
            if code == errno.EINTR:  # a signal's handler has run; the frames still come
                return self._receive_batch(count, timeout)
            if code != errno.EAGAIN:
                self.error = code
            return []
        lengths = into.came[:came].tolist()
        if self._ancillary:
            self._count_dropped(came)
        size = lengths[0]
        if size and lengths.count(size) == came:
            return Frames(into.rows[:came, :size].tobytes(), size)
        if 0 in lengths:  # the end of a connection: from here on each message is empty
            self.error = errno.ECONNRESET
            lengths = lengths[: lengths.index(0)]
        return [bytes(into.data[i * SIZE : i * SIZE + length]) for i, length in enumerate(lengths)]

    def _count_dropped(self, came: int) -> None:
        """Read the newest overflow count; the kernel sends it only once something was lost."""
        if self._in.control_lengths[came - 1]:
            at = (came - 1) * _CONTROL + 16  # behind struct cmsghdr
            self.dropped = int.from_bytes(self._in.control[at : at + 4], "little")

"""Many datagrams in one system call: sendmmsg and recvmmsg of Linux, over preallocated buffers.

Seven frames each way are fourteen system calls without it and two with it, on any datagram socket.
"""

import ctypes
import errno
import socket

import numpy as np

SIZE = 80  # above the 72 bytes of the longest frame, so that an oversize packet shows its length
CAPACITY = 64  # frames in one call
_CONTROL = 64  # room for one ancillary message
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


class _Vector:
    """Preallocated headers, buffers and ancillary space of CAPACITY messages."""

    def __init__(self) -> None:
        self.data = bytearray(SIZE * CAPACITY)
        self.control = bytearray(_CONTROL * CAPACITY)
        self.headers = (_Mmsghdr * CAPACITY)()
        self._iovecs = (_Iovec * CAPACITY)()
        data = ctypes.addressof(ctypes.c_char.from_buffer(self.data))
        control = ctypes.addressof(ctypes.c_char.from_buffer(self.control))
        for i in range(CAPACITY):
            self._iovecs[i].base, self._iovecs[i].length = data + i * SIZE, SIZE
            header = self.headers[i].header
            header.iov, header.iov_length = ctypes.addressof(self._iovecs[i]), 1
            header.control = control + i * _CONTROL
        self.words = np.frombuffer(memoryview(self.headers).cast("B"), dtype=_WORDS)
        self.lengths = np.frombuffer(memoryview(self._iovecs).cast("B"), dtype=np.uint64)[1::2]
        self.address = ctypes.addressof(self.headers)


class Messages:
    """Sends and receives batches on one datagram socket; `error` is the errno of the last call that failed, or 0."""

    def __init__(self, sock: socket.socket, ancillary: bool = False) -> None:
        self._socket = sock
        self._in, self._out = _Vector(), _Vector()
        self._ancillary = _CONTROL if ancillary else 0
        self._patience = -1.0
        self.error = 0
        self.dropped = 0  # frames that the kernel threw away because nobody read them, as SO_RXQ_OVFL counts

    def send(self, frames: list[bytes]) -> list[bytes]:
        """Send each frame or drop it; return those that went out."""
        out, went = self._out, []
        for start in range(0, len(frames), CAPACITY):
            batch = frames[start : start + CAPACITY]
            for i, raw in enumerate(batch):
                out.data[i * SIZE : i * SIZE + len(raw)] = raw
            out.lengths[: len(batch)] = [len(raw) for raw in batch]
            went += self._send_batch(batch)
        return went

    def _send_batch(self, batch: list[bytes]) -> list[bytes]:
        fd, went, at, flags = self._socket.fileno(), [], 0, socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL
        while at < len(batch):
            address = ctypes.c_void_p(self._out.address + at * ctypes.sizeof(_Mmsghdr))
            count = _quick.sendmmsg(fd, address, len(batch) - at, flags)
            if count == len(batch):
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

    def receive(self) -> list[bytes]:
        """Return everything that waits, up to a bound that a flood cannot lift; never blocks."""
        frames: list[bytes] = []
        for _ in range(_ROUNDS):
            batch = self._receive_batch(CAPACITY, 0.0)
            frames += batch
            if len(batch) < CAPACITY:
                break
        return frames

    def collect(self, count: int, timeout: float) -> list[bytes]:
        """Return `count` frames, or those that came until none came for `timeout` [s]."""
        return self._receive_batch(min(count, CAPACITY), max(timeout, 1e-3))

    def _receive_batch(self, count: int, timeout: float) -> list[bytes]:
        if timeout > 0.0 and timeout != self._patience:
            microseconds = int(timeout * 1e6)
            value = np.array([microseconds // 1_000_000, microseconds % 1_000_000], dtype=np.int64).tobytes()
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, value)
            self._patience = timeout
        into = self._in
        into.words["control_length"] = self._ancillary
        library, flags = (_patient, 0) if timeout > 0.0 else (_quick, socket.MSG_DONTWAIT)
        came: int = library.recvmmsg(self._socket.fileno(), ctypes.c_void_p(into.address), count, flags, None)
        if came < 0:
            code = ctypes.get_errno()
            if code == errno.EINTR:  # a signal's handler has run; the frames still come
                return self._receive_batch(count, timeout)
            if code != errno.EAGAIN:
                self.error = code
            return []
        lengths = into.words["length"][:came].tolist()
        if self._ancillary:
            self._count_dropped(came)
        if 0 in lengths:  # the end of a connection: from here on each message is empty
            self.error = errno.ECONNRESET
            lengths = lengths[: lengths.index(0)]
        return [bytes(into.data[i * SIZE : i * SIZE + length]) for i, length in enumerate(lengths)]

    def _count_dropped(self, came: int) -> None:
        """Read the newest overflow count; the kernel sends it only once something was lost."""
        if self._in.words["control_length"][came - 1]:
            at = (came - 1) * _CONTROL + 16  # behind struct cmsghdr
            self.dropped = int.from_bytes(self._in.control[at : at + 4], "little")

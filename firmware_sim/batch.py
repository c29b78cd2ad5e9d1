"""A cycle's raw frames in one block of memory, and the system calls that move them all at once.

The block is filled by a bus or by the drives and read by the other; nothing is allocated while it goes round. Linux
takes and gives many packets of a socket in one call (recvmmsg, sendmmsg), each row of the block being one packet.
"""

import ctypes
import errno
import socket
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

ROOM = 80  # bytes a frame: above the 72 of the longest, so that an oversize packet shows its length
CAPACITY = 64  # frames that are taken at once: a flooding peer must not starve the clock
SIZES = frozenset((16, 72))  # bytes of a classic and an FD frame
NOW = socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL


class _Iovec(ctypes.Structure):
    """`struct iovec`."""

    _fields_ = (("base", ctypes.c_void_p), ("size", ctypes.c_size_t))


class _Msghdr(ctypes.Structure):
    """`struct msghdr`."""

    _fields_ = (
        ("name", ctypes.c_void_p),
        ("name_size", ctypes.c_uint32),
        ("iov", ctypes.c_void_p),
        ("iov_count", ctypes.c_size_t),
        ("control", ctypes.c_void_p),
        ("control_size", ctypes.c_size_t),
        ("flags", ctypes.c_int),
    )


class _Mmsghdr(ctypes.Structure):
    """`struct mmsghdr`."""

    _fields_ = (("header", _Msghdr), ("length", ctypes.c_uint))


_STRIDE = ctypes.sizeof(_Mmsghdr)
_libc = ctypes.PyDLL(None, use_errno=True)  # calls that never block need not let other threads in
_libc.recvmmsg.argtypes = (ctypes.c_int, ctypes.c_void_p, ctypes.c_uint, ctypes.c_int, ctypes.c_void_p)
_libc.sendmmsg.argtypes = (ctypes.c_int, ctypes.c_void_p, ctypes.c_uint, ctypes.c_int)


class _Vector:
    """Message headers whose packets are the rows of a block."""

    def __init__(self, data: bytearray, capacity: int, room: int) -> None:
        self._iovecs = (_Iovec * capacity)()
        self._headers = (_Mmsghdr * capacity)()
        start = ctypes.addressof(ctypes.c_char.from_buffer(data))
        for k in range(capacity):
            self._iovecs[k].base, self._iovecs[k].size = start + k * room, room
            self._headers[k].header.iov = ctypes.addressof(self._iovecs[k])
            self._headers[k].header.iov_count = 1
        self.address = ctypes.addressof(self._headers)
        words = np.frombuffer(memoryview(self._headers).cast("B"), dtype=np.uint32).reshape(capacity, -1)
        self.lengths = words[:, _Mmsghdr.length.offset // 4]  # of what came
        sizes = np.frombuffer(memoryview(self._iovecs).cast("B"), dtype=np.uint64).reshape(capacity, -1)
        self.sizes = sizes[:, 1]  # of what goes


class Batch:
    """Raw frames in order; `count` of them are valid, the first `lengths[k]` bytes of each row."""

    def __init__(self, capacity: int = CAPACITY, room: int = ROOM) -> None:
        """`room` [bytes] of a row: more than a frame's where packets of any size may come."""
        self.capacity, self.room = capacity, room
        self.data = bytearray(capacity * room)
        self.raw: NDArray[np.uint8] = np.frombuffer(self.data, dtype=np.uint8).reshape(capacity, room)
        self.lengths: NDArray[np.int64] = np.full(capacity, room, dtype=np.int64)
        self.count = 0
        self._coming, self._going = _Vector(self.data, capacity, room), _Vector(self.data, capacity, room)

    def load(self, frames: Sequence[bytes]) -> None:
        """Replace all by frames that fill their rows, in a batch of such rows."""
        self.count = len(frames)
        self.data[: self.count * self.room] = b"".join(frames)

    def unload(self) -> list[bytes]:
        """Return all of them from a batch of rows that frames fill."""
        room = self.room
        data = bytes(self.data[: self.count * room])
        return [data[k : k + room] for k in range(0, len(data), room)]

    def extend(self, frames: Iterable[bytes]) -> None:
        """Add frames; what has no room is left out."""
        room = self.room
        for raw in frames:
            if self.count == self.capacity:
                break
            self.lengths[self.count] = len(raw)
            self.data[self.count * room : (self.count + 1) * room] = raw[:room].ljust(room)
            self.count += 1

    def frame(self, k: int) -> bytes:
        """Return one frame."""
        return bytes(self.data[k * self.room : k * self.room + min(int(self.lengths[k]), self.room)])

    def frames(self) -> list[bytes]:
        """Return all of them."""
        return [self.frame(k) for k in range(self.count)]

    def take(self, fd: int, limit: int = CAPACITY) -> bool:
        """Add the frames that wait on a socket, at most `limit`; return whether its connection stands.

        Packets that are no frames are left out. Raises OSError, but for a socket on which nothing waits.
        """
        start = self.count
        room = min(limit, self.capacity - start)
        came = _libc.recvmmsg(fd, self._coming.address + start * _STRIDE, room, NOW, None)
        if came < 0:
            code = ctypes.get_errno()
            if code in (errno.EAGAIN, errno.EINTR):
                return True
            raise OSError(code, "recvmmsg")
        self.lengths[start : start + came] = self._coming.lengths[start : start + came]
        sizes = self.lengths[start : start + came].tolist()
        if SIZES.issuperset(sizes):
            self.count = start + came
            return True
        return self._sift(start, sizes)

    def _sift(self, start: int, sizes: list[int]) -> bool:
        """Keep what is a frame, up to the end of the connection, which is an empty packet."""
        ended = 0 in sizes
        for k, size in enumerate(sizes[: sizes.index(0)] if ended else sizes):
            if size in SIZES:
                self.raw[self.count], self.lengths[self.count] = self.raw[start + k], size
                self.count += 1
        return not ended

    def give(self, fd: int, first: int = 0) -> int:
        """Send the frames from `first` on through a socket; return how many were lost. Raises OSError.

        A full socket loses all that is left, a full transmit queue the frame that it does not take.
        """
        going, at, lost = self._going, first, 0
        going.sizes[first : self.count] = self.lengths[first : self.count]
        while at < self.count:
            went = _libc.sendmmsg(fd, going.address + at * _STRIDE, self.count - at, NOW)
            if went >= 0:
                at += went
                continue
            code = ctypes.get_errno()
            if code == errno.EAGAIN:
                return lost + self.count - at
            if code == errno.ENOBUFS:
                at, lost = at + 1, lost + 1
            elif code != errno.EINTR:
                raise OSError(code, "sendmmsg")
        return lost

"""The bus the drives sit on: a hub of Unix sockets that needs no kernel support, or SocketCAN.

Both carry whole `struct can_frame` and `struct canfd_frame`, one a packet; both send or drop, and never block but in
`wait`. The frames of a cycle come and go in one system call a peer, see `firmware_sim.batch`.
"""

import errno
import os
import select
import socket
import struct
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Protocol

from firmware_sim.batch import CAPACITY, Batch
from firmware_sim.settings import SettingsError

PEERS_MAX = 16
REOPEN_S = 1.0
LISTENS = 1 << 24  # [bytes] that may wait for a peer that has said nothing yet
SO_SNDBUFFORCE = 32  # sets what SO_SNDBUF does, beyond net.core.wmem_max; needs CAP_NET_ADMIN


class Bus(Protocol):
    """What the drives need of a bus."""

    name: str
    dropped: int
    capacity: int  # frames that can come at once

    def wait(self, timeout: float) -> None: ...  # until a frame comes, at most `timeout` [s]

    def receive(self, into: Batch) -> None: ...  # adds what waits where something did at the end of `wait`

    def send(self, frames: Batch) -> None: ...

    def close(self) -> None: ...


def socket_path(channel: str) -> str:
    """Return a path for `channel`: itself, or a bare name in the user's run-time folder."""
    folder = os.environ.get("XDG_RUNTIME_DIR") or "/tmp"
    return channel if "/" in channel else str(Path(folder) / f"rtctl-{channel}.can")


def open_bus(interface: str, channel: str, ids: Iterable[int]) -> Bus:
    """Open the bus the robot file names; `ids` are those the drives listen to. SettingsError if it cannot be."""
    if interface == "socketpair":
        return Hub(socket_path(channel))
    if interface == "socketcan":
        return SocketCan(channel, ids)
    raise SettingsError(f"link.interface {interface}: drives can be simulated on socketpair or socketcan")


class Hub:
    """Listens at a path; every frame of a peer goes to all other peers, and to the drives."""

    capacity = PEERS_MAX * CAPACITY

    def __init__(self, path: str) -> None:
        self.name, self.dropped = path, 0
        self._claim(path)
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_NONBLOCK)
        old = os.umask(0o177)  # this user only
        try:
            self._listener.bind(path)
        except OSError as error:
            self._listener.close()
            raise SettingsError(f"{path}: {error.strerror or error}") from error
        finally:
            os.umask(old)
        self._listener.listen(PEERS_MAX)
        self._inode = os.stat(path).st_ino
        self._peers: dict[int, socket.socket] = {}
        self._listeners: dict[int, int] = {}  # peers that have said nothing -> what may wait for others [bytes]
        self._sources = [self._listener.fileno()]
        self._ready: list[int] = []

    @staticmethod
    def _claim(path: str) -> None:
        """Remove the socket a dead simulator left behind; refuse one that is served, and anything that is no socket."""
        if not os.path.lexists(path):
            return
        if not Path(path).is_socket():
            raise SettingsError(f"{path}: is there and is no socket")
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_NONBLOCK) as probe:
            if probe.connect_ex(path) in (0, errno.EAGAIN):
                raise SettingsError(f"{path}: this bus is served already")
        os.unlink(path)

    def wait(self, timeout: float) -> None:
        """Wait for frames, at most `timeout` [s]: by `select`, as Python's `epoll` rounds up to whole milliseconds."""
        self._ready = select.select(self._sources, (), (), timeout)[0]

    def receive(self, into: Batch) -> None:
        """Add what waits from those peers that had something, each one's frames in order; the others get it too."""
        for fd in self._ready:
            if fd == self._sources[0]:
                self._accept()
            elif fd in self._peers:  # forwarding may have shown that it is gone
                self._drain(fd, into)
        self._ready = []

    def _accept(self) -> None:
        try:
            peer, _ = self._listener.accept()
        except OSError:
            return
        if len(self._peers) >= PEERS_MAX:
            peer.close()
            return
        peer.setblocking(False)
        self._listeners[peer.fileno()] = peer.getsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF)
        _let_wait(peer, LISTENS)  # who only writes down what is said may be kept from it by a busy machine
        self._peers[peer.fileno()] = peer
        self._sources.append(peer.fileno())

    def _drain(self, fd: int, into: Batch) -> None:
        first = into.count
        try:
            stands = into.take(fd)
        except OSError:
            stands = False
        if fd in self._listeners and into.count > first:  # a controller that was held up must not get old news
            peer = self._peers[fd]
            peer.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, self._listeners.pop(fd) // 2)  # the kernel doubles it
        if not stands:
            self._leave(fd)
        if len(self._peers) > 1 and into.count > first:
            self._spread(into, first, fd)

    def _leave(self, fd: int) -> None:
        self._listeners.pop(fd, None)
        self._sources.remove(fd)
        self._peers.pop(fd).close()

    def send(self, frames: Batch) -> None:
        """Send frames to every peer; one that does not read loses them."""
        if frames.count:
            self._spread(frames, 0, -1)

    def _spread(self, frames: Batch, first: int, source: int) -> None:
        for fd in self._sources[1:]:
            if fd == source:
                continue
            try:
                self.dropped += frames.give(fd, first)
            except OSError:
                self._leave(fd)

    def close(self) -> None:
        """Hang up and take the path away, unless somebody else has taken it over."""
        for fd in list(self._peers):
            self._leave(fd)
        self._listener.close()
        try:
            if os.stat(self.name).st_ino == self._inode:
                os.unlink(self.name)
        except FileNotFoundError:
            pass


def _let_wait(peer: socket.socket, size: int) -> None:
    """Let so many bytes wait for a peer, or what the machine allows of them."""
    try:
        peer.setsockopt(socket.SOL_SOCKET, SO_SNDBUFFORCE, size)
    except OSError:
        peer.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, size)


class SocketCan:
    """A raw CAN socket; opened anew each second after its interface went away."""

    capacity = CAPACITY

    def __init__(self, channel: str, ids: Iterable[int]) -> None:
        self.name, self.dropped = channel, 0
        self._ids = tuple(ids)
        self._retry = 0.0
        self._ready = False
        try:
            self._socket: socket.socket | None = self._open()
        except OSError as error:
            raise SettingsError(f"{channel}: cannot be opened as a SocketCAN interface: {error}") from error

    def _open(self) -> socket.socket:
        if not hasattr(socket, "AF_CAN"):
            raise OSError("this system has no AF_CAN")
        sock = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        try:
            sock.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FD_FRAMES, 1)
            mask = socket.CAN_SFF_MASK | socket.CAN_EFF_FLAG | socket.CAN_RTR_FLAG
            filters = b"".join(struct.pack("=II", i, mask) for i in self._ids)
            sock.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, filters)
            sock.bind((self.name,))
        except OSError:
            sock.close()
            raise
        sock.setblocking(False)
        return sock

    def wait(self, timeout: float) -> None:
        """Wait for frames, at most `timeout` [s]."""
        if self._socket is None:
            self._reopen(timeout)
        else:
            self._ready = bool(select.select([self._socket], (), (), timeout)[0])

    def receive(self, into: Batch) -> None:
        """Add what waits, if something did."""
        if not self._ready or self._socket is None:
            return
        self._ready = False
        try:
            into.take(self._socket.fileno())
        except OSError as error:
            self._fail(error)

    def _fail(self, error: OSError) -> None:
        """Give up a socket whose interface is gone; one that is merely down comes back by itself."""
        if error.errno in (errno.ENODEV, errno.ENXIO, errno.EBADF) and self._socket is not None:
            self._socket.close()
            self._socket = None

    def _reopen(self, timeout: float) -> None:
        time.sleep(timeout)
        if time.monotonic() >= self._retry:
            self._retry = time.monotonic() + REOPEN_S
            try:
                self._socket = self._open()
            except OSError:
                self._socket = None

    def send(self, frames: Batch) -> None:
        """Send frames, or drop what the interface does not take."""
        if self._socket is None:
            self.dropped += frames.count
            return
        try:
            self.dropped += frames.give(self._socket.fileno())
        except OSError as error:
            self.dropped += frames.count
            self._fail(error)

    def close(self) -> None:
        """Close the socket."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

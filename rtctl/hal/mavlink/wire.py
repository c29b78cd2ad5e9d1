"""What moves MAVLink bytes: UDP with its peer pinned, TCP, a serial line, or a simulator. Nothing here blocks.

pymavlink's own connections are not used: on UDP they answer whoever has ever sent, on TCP they spin for ever when the
peer closes.
"""

import contextlib
import errno
import fcntl
import os
import select
import socket
import termios
import time
from collections.abc import Callable
from typing import Protocol, TypeAlias
from urllib.parse import urlsplit

from rtctl.errors import LinkError
from rtctl.types import Link

DATAGRAMS = 256  # read in one go at most: a flood must not hold up the tick
CHUNK = 65536
RETRY = 1.0  # [s] between attempts to open a stream anew
PEER_SILENT = 5.0  # [s] after which another address may take the pinned one's place
Address: TypeAlias = tuple[str | bytes | int, ...] | str | None  # as the socket module has it


class Wire(Protocol):
    """One link to one vehicle."""

    def send(self, packets: list[bytes]) -> list[bytes]: ...  # those that went out; the others are dropped

    def receive(self) -> list[tuple[bytes, Address]]: ...  # everything that waits, and from whom

    def pin(self, address: Address) -> None: ...  # the vehicle is there: talk to it, listen to nobody else

    def now(self) -> float: ...  # [s]

    def rest(self, period: float) -> None: ...  # let `period` [s] pass, outside the servo loop

    def flags(self) -> int: ...

    def close(self) -> None: ...


class _Timed:
    """Real time."""

    def __init__(self) -> None:
        self._flags = int(Link.NONE)

    def now(self) -> float:
        """Return the monotonic time [s]."""
        return time.monotonic()

    def rest(self, period: float) -> None:
        """Sleep."""
        time.sleep(period)

    def pin(self, address: Address) -> None:
        """Streams have one peer."""

    def flags(self) -> int:
        """Return the Link flags since the last call."""
        flags, self._flags = self._flags, int(Link.NONE)
        return flags


class Udp(_Timed):
    """A datagram socket. Before the vehicle is pinned it listens to all and, when it only listens, sends nothing."""

    def __init__(self, host: str, port: int, listen: bool) -> None:
        super().__init__()
        info = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        self._socket = socket.socket(info[0], socket.SOCK_DGRAM | socket.SOCK_NONBLOCK | socket.SOCK_CLOEXEC)
        self._peer: Address = None
        self._heard = 0.0
        self.foreign = 0  # datagrams of other addresses
        if listen:
            self._socket.bind(info[4])
        else:
            self._peer = (info[4][0], info[4][1])

    def pin(self, address: Address) -> None:
        """Talk to this address alone."""
        self._peer, self._heard = address, self.now()

    def receive(self) -> list[tuple[bytes, Address]]:
        """Return the datagrams that wait; those of strangers only while the peer is not known or silent."""
        found: list[tuple[bytes, Address]] = []
        for _ in range(DATAGRAMS):
            try:
                data, address = self._socket.recvfrom(CHUNK)
            except BlockingIOError:
                return found
            except OSError as error:
                if error.errno != errno.ECONNREFUSED:  # the vehicle's port is closed for now: it may come back
                    self._flags |= Link.DOWN
                return found
            if address[:2] == self._peer:
                self._heard = self.now()
            elif self._peer is not None and self.now() - self._heard < PEER_SILENT:
                self.foreign += 1
                continue
            found.append((data, address[:2]))
        self._flags |= Link.OVERFLOW
        return found

    def send(self, packets: list[bytes]) -> list[bytes]:
        """Send each packet as a datagram, or drop it."""
        if self._peer is None:
            return []
        went = []
        for packet in packets:
            try:
                self._socket.sendto(packet, self._peer)
                went.append(packet)
            except OSError as error:
                if error.errno != errno.ECONNREFUSED:
                    self._flags |= Link.SEND_FAILED
        return went

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class Stream(_Timed):
    """A byte stream that is opened anew, without waiting, when it went away."""

    def __init__(self, place: str, opened: Callable[[], int]) -> None:
        """`opened` returns a non-blocking file descriptor, or raises OSError."""
        super().__init__()
        self._open = opened
        self._place = place
        self._tried = -RETRY
        try:
            self._fd = opened()
        except OSError as error:
            raise LinkError(f"{place}: cannot be opened: {error.strerror or error}") from None
        self._waiting = b""  # of a packet that went out in part

    def _lost(self) -> None:
        self._flags |= Link.DOWN
        if self._fd >= 0:
            os.close(self._fd)
        self._fd, self._waiting = -1, b""

    def _usable(self) -> bool:
        if self._fd < 0 and self.now() - self._tried >= RETRY:
            self._tried = self.now()
            with contextlib.suppress(OSError):
                self._fd = self._open()
        if self._fd < 0:
            self._flags |= Link.DOWN
        return self._fd >= 0

    def receive(self) -> list[tuple[bytes, Address]]:
        """Return the bytes that wait. An end of the stream is not read for ever: it is opened anew."""
        if not self._usable():
            return []
        try:
            data = os.read(self._fd, CHUNK)
        except BlockingIOError:
            return []
        except OSError:
            data = b""
        if not data:
            self._lost()
            return []
        return [(data, None)]

    def send(self, packets: list[bytes]) -> list[bytes]:
        """Send packets or drop them whole; what went out in part is finished first."""
        went: list[bytes] = []
        if self._fd < 0:
            return went
        for packet in [b"", *packets]:
            if self._waiting and packet:
                self._flags |= Link.SEND_FAILED
                continue
            data = self._waiting or packet
            if not data:
                continue
            try:
                count = os.write(self._fd, data)
            except BlockingIOError:
                count = 0
            except OSError:
                self._lost()
                return went
            if packet and count:
                went.append(packet)
            elif packet:
                self._flags |= Link.SEND_FAILED
                continue
            self._waiting = data[count:]
        return went

    def close(self) -> None:
        """Close the stream."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1


class InProcess:
    """A simulator: packets of one period go to `exchange`, what the vehicle says waits for the next read."""

    def __init__(self, exchange: Callable[[list[bytes]], list[bytes]], period: float) -> None:
        self._exchange, self._period = exchange, period
        self._cycles = 0
        self._waiting: list[bytes] = []

    def now(self) -> float:
        """Return simulated time [s] since the link was opened."""
        return self._cycles * self._period

    def rest(self, period: float) -> None:
        """Time passes with each exchange."""

    def pin(self, address: Address) -> None:
        """There is one vehicle."""

    def receive(self) -> list[tuple[bytes, Address]]:
        """Return what the vehicle said."""
        packets, self._waiting = self._waiting, []
        return [(packet, None) for packet in packets]

    def send(self, packets: list[bytes]) -> list[bytes]:
        """Hand over what one period has to say, and let it pass."""
        self._waiting += self._exchange(packets)
        self._cycles += 1
        return packets

    def flags(self) -> int:
        """Return no flags."""
        return int(Link.NONE)

    def close(self) -> None:
        """Nothing to close."""


def open_wire(url: str) -> Wire:
    """Open the link of a config's url. LinkError if it cannot be opened."""
    scheme, _, rest = url.partition(":")
    try:
        if scheme in ("udpin", "udpout"):
            parts = urlsplit(f"//{rest}")
            return Udp(parts.hostname or "", parts.port or 0, scheme == "udpin")
        if scheme == "tcp":
            parts = urlsplit(f"//{rest}")
            return Stream(url, lambda: _tcp(parts.hostname or "", parts.port or 0))
    except OSError as error:
        raise LinkError(f"{url}: cannot be opened: {error.strerror or error}") from None
    path, _, baud = rest.rpartition(":")
    return Stream(url, lambda: _serial(path, int(baud)))


def _tcp(host: str, port: int) -> int:
    """Return a connected socket's descriptor; a peer that does not answer at once is given half a second."""
    info = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
    sock = socket.socket(info[0], socket.SOCK_STREAM | socket.SOCK_CLOEXEC | socket.SOCK_NONBLOCK)
    try:
        error = sock.connect_ex(info[4])
        if error == errno.EINPROGRESS:
            if not select.select([], [sock], [], 0.5)[1]:
                raise TimeoutError(errno.ETIMEDOUT, os.strerror(errno.ETIMEDOUT))
            error = sock.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
        if error:
            raise OSError(error, os.strerror(error))
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return sock.detach()
    except OSError:
        sock.close()
        raise


def _serial(path: str, baud: int) -> int:
    """Return the descriptor of a line in raw mode, locked for this process."""
    speed = getattr(termios, f"B{baud}", None)
    if speed is None:
        raise OSError(errno.EINVAL, f"no line speed of {baud}")
    fd = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        mode = termios.tcgetattr(fd)
        mode[0] = mode[1] = mode[3] = 0
        mode[2] = termios.CS8 | termios.CREAD | termios.CLOCAL
        mode[4] = mode[5] = speed
        mode[6][termios.VMIN], mode[6][termios.VTIME] = 0, 0
        termios.tcsetattr(fd, termios.TCSANOW, mode)
    except (OSError, termios.error) as error:
        os.close(fd)
        raise OSError(errno.EIO, str(error)) from None
    return fd

"""What moves frames: SocketCAN, a Unix socket that stands in for a bus, any python-can adapter, or a simulator.

All of them carry the kernel's frame structs, send or drop, and never block but in `wait` and `collect`.
"""

import contextlib
import errno
import os
import select
import socket
import struct
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import can

from rtctl.errors import LinkError
from rtctl.hal.can.datagrams import Messages
from rtctl.protocol import frame
from rtctl.types import Link, Simulator, Transport

_SO_RXQ_OVFL = 40  # Linux; the socket module does not name it
_SO_TIMESTAMPNS = 35
_FRAME_COST = 768  # [byte] of socket memory that a queued CAN frame takes, about
_CONGESTED = (errno.ENOBUFS, errno.EAGAIN, errno.ENOMEM)


class _Socket:
    """Transport over a datagram socket; the base of SocketCan and Seqpacket."""

    def __init__(self, sock: socket.socket, ancillary: bool) -> None:
        self._flags = 0
        self._adopt(sock, ancillary)

    def _adopt(self, sock: socket.socket, ancillary: bool) -> None:
        self._socket, self._messages = sock, Messages(sock, ancillary)
        self._poll = select.poll()
        self._poll.register(sock, select.POLLIN)
        self._dropped = 0

    def _note(self) -> None:
        messages = self._messages
        if not messages.error and messages.dropped == self._dropped:  # nearly always
            return
        error, messages.error = messages.error, 0
        if error:
            self._flags |= Link.SEND_FAILED if error in _CONGESTED else Link.DOWN
        if messages.dropped != self._dropped:
            self._dropped = messages.dropped
            self._flags |= Link.OVERFLOW

    def send(self, raw: bytes) -> bool:
        """Send one frame or drop it; False: dropped."""
        return len(self.send_all([raw])) == 1

    def send_all(self, frames: Sequence[bytes]) -> Sequence[bytes]:
        """Send each frame or drop it; return those that went out."""
        went = self._messages.send(frames)
        if len(went) != len(frames):
            self._note()
            self._flags |= Link.SEND_FAILED
        return went

    def receive(self) -> Sequence[bytes]:
        """Return everything that waits."""
        frames = self._messages.receive()
        self._note()
        return frames

    def collect(self, count: int, timeout: float) -> Sequence[bytes]:
        """Return `count` frames, or those that came until none came for `timeout` [s]."""
        frames = self._messages.collect(count, timeout)
        self._note()
        return frames

    def wait(self, timeout: float) -> bool:
        """True if something can be read within `timeout` [s]."""
        return any(event & select.POLLIN for _, event in self._poll.poll(max(timeout, 0.0) * 1e3))

    def flags(self) -> int:
        """Return the Link flags since the last call."""
        flags, self._flags = self._flags, 0
        return int(flags)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class SocketCan(_Socket):
    """A raw CAN socket that python-can opened; frames then bypass python-can, which costs three times as much.

    Its bus state would say ACTIVE for ever: bus-off and error-passive come as error frames. An overflow is silent
    unless SO_RXQ_OVFL is set. At most `depth` frames may wait in the kernel: a bus that stalls must not be handed old
    torque when it comes back.
    """

    def __init__(self, channel: str, fd: bool, listen: Sequence[int], depth: int) -> None:
        self.channel, self._fd, self._listen, self._depth = channel, fd, tuple(listen), depth
        super().__init__(self._open(), ancillary=True)

    def _open(self) -> socket.socket:
        bus: Any
        try:
            socket.if_nametoindex(self.channel)  # python-can would leave a socket open where there is none
            bus = can.Bus(interface="socketcan", channel=self.channel, fd=self._fd)
        except (OSError, can.CanError) as error:
            raise LinkError(f"{self.channel}: cannot be opened as a SocketCAN interface: {error}") from error
        sock: socket.socket = bus.socket
        self._bus = bus
        mask = frame.SFF_MASK | frame.EFF_FLAG | frame.RTR_FLAG
        filters = b"".join(struct.pack("=II", can_id, mask) for can_id in self._listen)
        sock.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, filters)
        sock.setsockopt(socket.SOL_SOCKET, _SO_RXQ_OVFL, 1)
        # The kernel doubles the value it is given.
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, self._depth * _FRAME_COST // 2)
        # python-can asks for a stamp in wall-clock time with each frame; nothing here may depend on that clock.
        sock.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 0)
        return sock

    def hear_all(self) -> None:
        """Let all data frames in, those of others too: to say what came where an answer is missing."""
        self._socket.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, struct.pack("=II", 0, 0))

    def reopen(self) -> bool:
        """Try once to open the interface anew after it went away; True if that worked."""
        self._bus.shutdown()
        try:
            self._adopt(self._open(), ancillary=True)
        except LinkError:
            return False
        return True

    def close(self) -> None:
        """Close the bus."""
        self._bus.shutdown()


class Seqpacket(_Socket):
    """The bus that needs no kernel support: a Unix socket on which each packet is one frame."""

    def __init__(self, path: str, timeout: float) -> None:
        self._path = path
        super().__init__(self._connect(timeout), ancillary=False)

    def _connect(self, timeout: float) -> socket.socket:
        deadline = time.monotonic() + timeout
        while True:
            sock = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            try:
                sock.connect(self._path)
            except OSError as error:
                sock.close()
                if error.errno not in (errno.ENOENT, errno.ECONNREFUSED, errno.EAGAIN) or time.monotonic() >= deadline:
                    why = os.strerror(error.errno or 0)
                    message = f"{self._path}: nothing serves this bus ({why}); python -m firmware_sim CONFIG does"
                    raise LinkError(message) from error
                time.sleep(0.02)
            else:
                return sock

    def reopen(self) -> bool:
        """Try once to connect anew; True if that worked."""
        self._socket.close()
        try:
            self._adopt(self._connect(0.0), ancillary=False)
        except LinkError:
            return False
        return True


class PythonCan:
    """Any adapter that python-can knows; the portable path, slower than the raw ones."""

    def __init__(self, bus: can.BusABC) -> None:
        self._bus, self._flags = bus, Link.NONE
        self._waiting: list[bytes] = []

    def send(self, raw: bytes) -> bool:
        """Send one frame or drop it; False: dropped."""
        one = frame.unpack(raw)
        message = can.Message(
            arbitration_id=one.can_id,
            data=one.data,
            is_extended_id=one.extended,
            is_fd=one.fd,
            bitrate_switch=one.brs,
            is_remote_frame=one.rtr,
        )
        try:
            self._bus.send(message, timeout=0.0)
        except (can.CanError, OSError):
            self._flags |= Link.SEND_FAILED
            return False
        return True

    def send_all(self, frames: Sequence[bytes]) -> Sequence[bytes]:
        """Send each frame or drop it; return those that went out."""
        return [raw for raw in frames if self.send(raw)]

    def receive(self) -> Sequence[bytes]:
        """Return everything that waits."""
        while self._receive_one(0.0):
            pass
        frames, self._waiting = self._waiting, []
        return frames

    def _receive_one(self, timeout: float) -> bool:
        try:
            message = self._bus.recv(timeout)
        except (can.CanError, OSError):
            self._flags |= Link.DOWN
            return False
        if message is None:
            return False
        with contextlib.suppress(ValueError):  # what no bus can carry is dropped
            self._waiting.append(
                frame.pack(
                    message.arbitration_id,
                    bytes(message.data),
                    fd=message.is_fd,
                    brs=message.bitrate_switch,
                    extended=message.is_extended_id,
                    rtr=message.is_remote_frame,
                    error=message.is_error_frame,
                )
            )
        return True

    def collect(self, count: int, timeout: float) -> Sequence[bytes]:
        """Return `count` frames, or those that came until none came for `timeout` [s]."""
        while len(self._waiting) < count and self._receive_one(timeout):
            pass
        frames, self._waiting = self._waiting, []
        return frames

    def wait(self, timeout: float) -> bool:
        """True if something can be read within `timeout` [s]."""
        return bool(self._waiting) or self._receive_one(max(timeout, 0.0))

    def flags(self) -> int:
        """Return the Link flags since the last call; an adapter may know its state, SocketCAN's does not."""
        flags, self._flags = self._flags, Link.NONE
        if self._bus.state is can.BusState.ERROR:
            flags |= Link.BUS_OFF
        elif self._bus.state is can.BusState.PASSIVE:
            flags |= Link.ERROR_PASSIVE
        return int(flags)

    def hear_all(self) -> None:
        """Let all frames in, see `SocketCan.hear_all`."""
        self._bus.set_filters(None)

    def reopen(self) -> bool:
        """An adapter is not opened twice by the loop: that may take seconds."""
        return False

    def close(self) -> None:
        """Close the adapter."""
        self._bus.shutdown()


class InProcess:
    """Drives in the same process: a cycle of commands goes to `exchange` and its replies wait for the next read."""

    def __init__(self, exchange: Callable[[list[bytes]], list[bytes]], close: Callable[[], None] | None = None) -> None:
        self._exchange, self._close = exchange, close
        self._waiting: list[bytes] = []

    @classmethod
    def of(cls, simulator: Simulator) -> "InProcess":
        """Return the transport that ends in a simulator, and closes it."""
        return cls(simulator.exchange, simulator.close)

    def send(self, raw: bytes) -> bool:
        """Send one frame."""
        return len(self.send_all([raw])) == 1

    def send_all(self, frames: Sequence[bytes]) -> Sequence[bytes]:
        """Send all frames of a cycle at once."""
        self._waiting += self._exchange(list(frames))
        return frames

    def receive(self) -> Sequence[bytes]:
        """Return everything that waits."""
        frames, self._waiting = self._waiting, []
        return frames

    def collect(self, count: int, timeout: float) -> Sequence[bytes]:
        """Return everything that waits: nothing more would come."""
        return self.receive()

    def wait(self, timeout: float) -> bool:
        """True if something can be read."""
        return bool(self._waiting)

    def flags(self) -> int:
        """Return no flags: there is no bus to fail."""
        return int(Link.NONE)

    def reopen(self) -> bool:
        """Return True: it is always there."""
        return True

    def close(self) -> None:
        """Close the simulator."""
        if self._close is not None:
            self._close()


def socket_path(channel: str) -> str:
    """Return the path of a socketpair bus: `channel` itself, or a bare name in the user's run-time directory."""
    if "/" in channel:
        return channel
    return str(Path(os.environ.get("XDG_RUNTIME_DIR") or "/tmp") / f"rtctl-{channel}.can")


def open_transport(
    interface: str,
    channel: str,
    *,
    bitrate: int = 1_000_000,
    fd: bool = False,
    data_bitrate: int = 5_000_000,
    listen: Sequence[int] = (),
    depth: int = 32,
    timeout: float = 5.0,
) -> Transport:
    """Open the bus that a config names.

    `listen` are the 11-bit identifiers wanted (filtered in the kernel where it can), `depth` the frames that may wait
    to be sent, `timeout` [s] how long a socketpair bus may take to appear. On SocketCAN the bit rates are the system's
    business (`ip link`), not ours. LinkError if it cannot be opened.
    """
    if interface == "socketcan":
        return SocketCan(channel, fd, listen, depth)
    if interface == "socketpair":
        return Seqpacket(socket_path(channel), timeout)
    filters: list[Any] = [{"can_id": i, "can_mask": frame.SFF_MASK, "extended": False} for i in listen]
    options: dict[str, Any] = {"fd": True, "data_bitrate": data_bitrate} if fd else {}
    try:
        bus = can.Bus(interface=interface, channel=channel, bitrate=bitrate, can_filters=filters or None, **options)
    except (OSError, ValueError, TypeError, can.CanError) as error:
        raise LinkError(f"{interface}:{channel}: cannot be opened: {error}") from error
    return PythonCan(bus)

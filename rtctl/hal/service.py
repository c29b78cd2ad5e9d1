"""What the daemon owes the machine it runs on: news for systemd, and one instance per bus."""

import errno
import hashlib
import os
import socket
from collections.abc import Container, Mapping
from contextlib import suppress
from types import TracebackType
from typing import Self

from rtctl.errors import ConfigError
from rtctl.trust import peer, user_name

KICKS_PER_WATCHDOG = 4  # a kick may be lost or late thrice before systemd acts


class Service:
    """The notify socket of systemd (sd_notify(3)); every call is a no-op when there is none.

    No call ever blocks: a datagram that the manager does not take at once is dropped, and the next kick carries on.
    """

    def __init__(self, period: float, environ: Mapping[str, str] = os.environ, pid: int | None = None) -> None:
        """Open NOTIFY_SOCKET. `period` [s] of a slot turns WATCHDOG_USEC into a number of slots."""
        self._socket: socket.socket | None = None
        self._address = _address(environ.get("NOTIFY_SOCKET", ""))
        self._last = -1
        self.kick_every = 0  # slots between two kicks; 0 = the manager asked for none
        if not self._address:
            return
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC | socket.SOCK_NONBLOCK)
        watchdog = _watchdog(environ, os.getpid() if pid is None else pid)
        if watchdog > 0.0:
            self.kick_every = max(1, int(watchdog / KICKS_PER_WATCHDOG / period + 1e-6))

    def ready(self, text: str = "") -> None:
        """Tell the manager that the handshake is over and the loop runs."""
        self._send("READY=1", text)

    def status(self, text: str) -> None:
        """Show one line in `systemctl status`."""
        self._send("", text)

    def kick(self, slot: int) -> None:
        """Feed the watchdog from the completed tick of `slot`; most calls do nothing but compare."""
        if self.kick_every and (self._last < 0 or slot - self._last >= self.kick_every):
            self._last = slot
            self._send("WATCHDOG=1")

    def stopping(self, text: str = "") -> None:
        """Tell the manager that the arm is being brought to rest and the process will end."""
        self._send("STOPPING=1", text)

    def close(self) -> None:
        """Close the notify socket; later calls do nothing."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _send(self, line: str, text: str = "") -> None:
        if self._socket is None:
            return
        lines = [line] if line else []
        if text:
            lines.append("STATUS=" + " ".join(text.split()))  # a newline would begin another assignment
        with suppress(OSError):  # a manager that is gone or busy must not disturb the loop; its watchdog then decides
            self._socket.sendto("\n".join(lines).encode(), self._address)


class InstanceLock:
    """This process alone commands this bus, whoever started it and whatever folders it sees.

    The lock is a name in the kernel's table of Unix sockets, no file: nobody can replace or remove it, a private /tmp
    does not hide it, and the kernel drops it with the process, even by SIGKILL. That table belongs to the network
    namespace, as CAN interfaces do: containers that share a bus share the lock. The kernel tells who holds it.
    """

    def __init__(self, resource: str, label: str, ignore: Container[int] = ()) -> None:
        """Take the lock of `resource` at once or refuse; `label` names the setting in the refusal.

        ignore: user ids whose hold does not count (`rtctl run --pass-lock-of`): the name is anybody's to take, so who
        commands nothing could keep the arm from being started. Raises ConfigError when another process holds it,
        naming process and user.
        """
        name = "\0rtctl/" + hashlib.sha256(resource.encode()).hexdigest()[:32]
        self._socket: socket.socket | None = None
        for attempt in (name, name + "/again"):
            self._socket = _bound(attempt)
            if self._socket is not None:
                return
            pid, uid = _holder(attempt)
            if uid not in ignore:
                break
        who = "a process that has just ended: try again" if pid < 0 else f"process {pid} of user {user_name(uid)}"
        raise ConfigError(label, f"{resource!r}, in use by {who}", "one rtctl per bus")

    def close(self) -> None:
        """Give the bus up."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _bound(name: str) -> socket.socket | None:
    """Return a listening socket of that name, None when another has it."""
    lock = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_CLOEXEC | socket.SOCK_NONBLOCK)
    try:
        lock.bind(name)
        lock.listen(1)
    except OSError as error:
        lock.close()
        if error.errno == errno.EADDRINUSE:
            return None
        raise
    return lock


def _holder(name: str) -> tuple[int, int]:
    """Return process id and user id of who listens at a name, -1 and -1 when nobody does any more."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_CLOEXEC | socket.SOCK_NONBLOCK) as link:
        try:
            link.connect(name)
        except BlockingIOError:
            return 0, -2  # its queue of callers is full: somebody holds it
        except OSError:
            return -1, -1
        return peer(link)


def bus_resource(interface: str, channel: str) -> str:
    """Return the name under which the bus of `[link]` is locked.

    A CAN interface lives in a network namespace, so two of those may both have a can0; a socket lives in a folder.
    """
    if interface == "socketpair":
        return f"socketpair:{os.path.realpath(channel)}" if "/" in channel else f"socketpair:{channel}"
    namespace = os.stat("/proc/self/ns/net").st_ino
    return f"{interface}:{channel}@{namespace}"


def _address(text: str) -> str:
    """Return the socket address; systemd writes `@` for the leading zero byte of an abstract one."""
    if text.startswith("@"):
        return "\0" + text[1:]
    return text if text.startswith("/") else ""


def _watchdog(environ: Mapping[str, str], pid: int) -> float:
    """Return the watchdog time-out [s] that the manager asks this process for, 0 = none."""
    microseconds, wanted_pid = environ.get("WATCHDOG_USEC", ""), environ.get("WATCHDOG_PID", "")
    if not microseconds.isdecimal() or (wanted_pid and wanted_pid != str(pid)):
        return 0.0
    return int(microseconds) * 1e-6

"""What the daemon owes the machine it runs on: news for systemd, and one instance per bus."""

import fcntl
import hashlib
import os
import socket
import tempfile
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Self

from rtctl.errors import ConfigError

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
    """An flock: this process alone commands this bus. The kernel drops it with the process, even by SIGKILL."""

    def __init__(self, resource: str, label: str, folder: str | None = None) -> None:
        """Take the lock of `resource` at once or refuse; `label` names the setting in the refusal.

        Raises ConfigError when another process holds it, naming that process.
        """
        self.path = Path(folder or _lock_folder()) / f"rtctl-{_file_name(resource)}.lock"
        self._fd = _open_lock(self.path, label)
        try:
            fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            holder = os.pread(self._fd, 32, 0).decode(errors="replace").strip() or "unknown"
            os.close(self._fd)
            raise ConfigError(label, f"{resource!r}, in use by process {holder}", "one rtctl per bus") from None
        self._note(f"{os.getpid()}\n")

    def close(self) -> None:
        """Give the bus up. The file stays: removing it would let two processes lock two files of one name."""
        if self._fd >= 0:
            self._note("")
            os.close(self._fd)
            self._fd = -1

    def _note(self, text: str) -> None:
        with suppress(OSError):  # another user's file, opened for reading: the lock counts, the note is a courtesy
            os.ftruncate(self._fd, 0)
            os.pwrite(self._fd, text.encode(), 0)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def bus_resource(interface: str, channel: str) -> str:
    """Return the name under which the bus of `[link]` is locked.

    A CAN interface lives in a network namespace, so two of those may both have a can0; a socket lives in a folder.
    """
    if interface == "socketpair":
        return f"socketpair:{os.path.realpath(channel)}" if "/" in channel else f"socketpair:{channel}"
    namespace = os.stat("/proc/self/ns/net").st_ino
    return f"{interface}:{channel}@{namespace}"


def _open_lock(path: Path, label: str) -> int:
    """Open the lock file, whoever made it: an flock needs no right to write."""
    common = os.O_CLOEXEC | os.O_NOFOLLOW
    # O_CREAT comes last: in a sticky folder the kernel refuses it on another user's file, even to root
    for flags in (os.O_RDWR, os.O_RDONLY, os.O_RDWR | os.O_CREAT):
        try:
            return os.open(path, flags | common, 0o644)
        except OSError as error:
            reason = error.strerror
    raise ConfigError(label, f"{path}: {reason}", "a lock file this user may open")


def _lock_folder() -> str:
    return "/run/lock" if os.access("/run/lock", os.W_OK) else tempfile.gettempdir()


def _file_name(resource: str) -> str:
    readable = "".join(c if c.isalnum() else "-" for c in resource)[-40:].strip("-")
    return f"{readable}-{hashlib.sha256(resource.encode()).hexdigest()[:12]}"  # the hash keeps look-alikes apart


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

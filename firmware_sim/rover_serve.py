"""The virtual rover in real time, at the other end of the link that its robot file names: UDP, TCP or a serial line."""

import contextlib
import errno
import json
import math
import os
import pty
import select
import signal
import socket
import time
import tty
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol
from urllib.parse import urlsplit

from firmware_sim.rover import Rover
from firmware_sim.settings import SettingsError

REPORT = 0.5  # [s] between renewals of the report
TRACK = 0.1  # [s] between points of the track


class Port(Protocol):
    """The vehicle's end of a link."""

    name: str

    def receive(self, timeout: float) -> list[bytes]: ...

    def send(self, packets: list[bytes]) -> None: ...

    def close(self) -> None: ...


class UdpPort:
    """Datagrams to the controller that listens, or from one that calls."""

    def __init__(self, host: str, port: int, calls: bool) -> None:
        """`calls`: the vehicle speaks first, to this address; else it waits there for the first datagram."""
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
        self._peer: Any = (host, port) if calls else None
        if not calls:
            self._socket.bind((host, port))
        self.name = f"udp {host}:{port}"

    def receive(self, timeout: float) -> list[bytes]:
        """Return the datagrams that came within `timeout` [s]."""
        found: list[bytes] = []
        if select.select([self._socket], [], [], timeout)[0]:
            with contextlib.suppress(OSError):
                while True:
                    data, self._peer = self._socket.recvfrom(65536)
                    found.append(data)
        return found

    def send(self, packets: list[bytes]) -> None:
        """Send each packet as a datagram; nobody there is no error."""
        for packet in packets if self._peer is not None else ():
            with contextlib.suppress(OSError):
                self._socket.sendto(packet, self._peer)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class StreamPort:
    """A byte stream; packets that are cut wait for their rest."""

    def __init__(self, name: str, accept: Callable[[], int], close: Callable[[], None]) -> None:
        """`accept` returns a descriptor or -1 while nobody is connected."""
        self.name, self._accept, self._close, self._fd, self._rest = name, accept, close, -1, b""

    def receive(self, timeout: float) -> list[bytes]:
        """Return the bytes that came within `timeout` [s], whole packets only."""
        if self._fd < 0:
            self._fd = self._accept()
        if self._fd < 0:
            time.sleep(timeout)
            return []
        if not select.select([self._fd], [], [], timeout)[0]:
            return []
        try:
            data = os.read(self._fd, 65536)
        except OSError as error:
            if error.errno in (errno.EAGAIN, errno.EIO):  # EIO: the other side of the pty is not open
                time.sleep(timeout)
                return []
            data = b""
        if not data:
            os.close(self._fd)
            self._fd = -1
            return []
        self._rest += data
        whole = _whole(self._rest)
        found, self._rest = self._rest[:whole], self._rest[whole:]
        return [found] if found else []

    def send(self, packets: list[bytes]) -> None:
        """Send packets, or drop them when the line is full."""
        if self._fd >= 0:
            for packet in packets:
                with contextlib.suppress(OSError):
                    os.write(self._fd, packet)

    def close(self) -> None:
        """Close the stream."""
        if self._fd >= 0:
            os.close(self._fd)
        self._close()


def _whole(data: bytes) -> int:
    """Return how many bytes hold whole packets."""
    at = 0
    while at < len(data):
        if data[at] != 0xFD:
            at += 1
            continue
        if at + 3 > len(data):
            break
        size = 12 + data[at + 1] + (13 if data[at + 2] & 1 else 0)
        if at + size > len(data):
            break
        at += size
    return at


def open_port(url: str) -> Port:
    """Open the vehicle's end of a controller's url. Raises SettingsError."""
    scheme, _, rest = url.partition(":")
    try:
        if scheme == "serial":
            return _line(Path(rest.rpartition(":")[0]))
        parts = urlsplit(f"//{rest}")
        host, port = parts.hostname or "127.0.0.1", int(parts.port or 0)
        if scheme in ("udpin", "udpout"):
            return UdpPort(host, port, calls=scheme == "udpin")
        if scheme == "tcp":
            return _listener(host, port)
    except (OSError, ValueError) as error:
        raise SettingsError(f"link.url {url}: {error}") from error
    raise SettingsError(f"link.url {url}: not udpin, udpout, tcp or serial")


def _listener(host: str, port: int) -> StreamPort:
    server = socket.create_server((host, port))
    server.setblocking(False)

    def accept() -> int:
        try:
            sock, _ = server.accept()
        except OSError:
            return -1
        sock.setblocking(False)
        return sock.detach()

    return StreamPort(f"tcp {host}:{port}", accept, server.close)


def _line(path: Path) -> StreamPort:
    """Make a pseudo-terminal and lay its far end at `path`."""
    master, slave = pty.openpty()
    tty.setraw(slave)
    os.set_blocking(master, False)
    path.unlink(missing_ok=True)
    path.symlink_to(os.ttyname(slave))

    def close() -> None:
        os.close(slave)
        path.unlink(missing_ok=True)

    return StreamPort(f"serial {path}", lambda: master, close)


class Server:
    """The rover on its grid, until a signal comes."""

    def __init__(self, rover: Rover, report: str | None) -> None:
        self.rover, self.report = rover, report
        rover.autopilot.epoch = time.time() - rover.autopilot.time
        self.stop = False
        self.least: dict[str, float] = {}
        self.track: list[list[float]] = []
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._on_signal)

    def _on_signal(self, *_: object) -> None:
        self.stop = True

    def run(self, port: Port) -> None:
        """Serve in real time; time that was lost is given up."""
        period, due, written = self.rover.period, time.monotonic(), 0.0
        while not self.stop:
            now = time.monotonic()
            if now < due:
                self.rover.hear(port.receive(due - now))
                continue
            due = max(due + period, now - 10.0 * period)
            port.send(self.rover.advance())
            self._observe()
            if self.report and now - written > REPORT:
                written = now
                self._write()

    def _observe(self) -> None:
        truth = self.rover.truth()
        for name, d in truth.clearance.items():
            self.least[name] = min(d, self.least.get(name, math.inf))
        if not self.track or truth.time - self.track[-1][0] >= TRACK:
            self.track.append([round(c, 4) for c in (truth.time, truth.x, truth.y, truth.yaw, truth.v)])

    def _write(self) -> None:
        truth, pilot = self.rover.truth(), self.rover.autopilot
        content = {
            "time_s": truth.time,
            "x_m": truth.x,
            "y_m": truth.y,
            "yaw_rad": truth.yaw,
            "v_m_s": truth.v,
            "contacts": truth.contacts,
            "min_clearance_m": self.least,
            "armed": pilot.armed,
            "mode": pilot.mode,
            "aborted": pilot.aborted,
            "refused": pilot.end.refused,
            "texts": pilot.log,
            "track": self.track,
        }
        assert self.report is not None
        new = Path(self.report + ".new")
        new.write_text(json.dumps(content), encoding="utf-8")
        new.replace(self.report)


def serve(rover: Rover, config: str, report: str | None) -> None:
    """Serve a rover until SIGTERM; write the report at the end."""
    port = open_port(rover.url)
    server = Server(rover, report)
    print(f"rover ready on {port.name} ({rover.autopilot.kind}, real time)", flush=True)
    try:
        server.run(port)
    finally:
        if report:
            server._write()
        port.close()

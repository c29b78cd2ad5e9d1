"""A perfect camera: tells the controller where the scenario's obstacles are, over its control socket, at 50 Hz."""

import json
import socket
import struct
from typing import Any

from firmware_sim.drive import NS
from firmware_sim.shapes import Shape, Solid, reported, shape_at

PERIOD_NS = 20_000_000  # of simulated time
CLOUD_PERIOD_NS = 33_333_333
CLOUD_MARK = b"RTCLOUD1"
RETRY_NS = 500_000_000
DROPPED_KEYS = frozenset(
    (
        "waypoints",
        "appears_s",
        "vanishes_s",
        "rpy_rad",
        "normal",
        "file",
        "scale",
        "hull",
        "voxel_m",
        "position_m",
        "velocity_m_s",
    )
)


def seen(obstacle: Solid, shape: Shape) -> dict[str, Any]:
    """Return an obstacle as a message tells it: where it is now, and how it moves."""
    table = {k: v for k, v in obstacle.spec.items() if k not in DROPPED_KEYS}
    if obstacle.mesh is not None and "mesh" not in table:  # a file that the controller's config does not name
        table |= {"type": "box", "size_m": obstacle.mesh.size.tolist()}
    return table | {
        "position_m": shape.position.tolist(),
        "wxyz": [min(max(float(v), -1.0), 1.0) for v in shape.wxyz],
        "velocity_m_s": shape.velocity.tolist(),
    }


def cloud(obstacle: Solid, shape: Shape) -> bytes:
    """Return a cloud as its binary message: the mark, the length of a JSON header, the header, int16 x y z a point."""
    told = reported(obstacle, shape)
    table = seen(obstacle, told) | {"point_radius_m": float(told.dims[0])}
    header = json.dumps({"verb": "cloud", "set": table, "step_m": float(told.dims[1]), "feed": True}).encode()
    return CLOUD_MARK + struct.pack("<I", len(header)) + header + told.cloud


class Camera:
    """Owns the connection; never blocks, never insists."""

    def __init__(self, path: str, obstacles: list[Solid]) -> None:
        self.path, self.obstacles = path, obstacles
        self.sent = self.refused = 0
        self.refusal = ""  # the controller's last word against a message
        self._socket: socket.socket | None = None
        self._next_ns = self._retry_ns = 0
        self._shown: set[str] = set()
        self._next_cloud_ns = 0

    def tick(self, now_ns: int, scene_ns: int) -> None:
        """Send one frame if it is time; `now_ns` paces, `scene_ns` is the scenario's clock."""
        if now_ns < self._next_ns:
            return
        self._next_ns = now_ns + PERIOD_NS
        if self._socket is None and now_ns >= self._retry_ns:
            self._retry_ns = now_ns + RETRY_NS
            self._connect()
        if self._socket is None:
            return
        self._read()
        shapes = [(o, shape_at(o, scene_ns / NS)) for o in self.obstacles]
        present = [seen(o, s) for o, s in shapes if s is not None and o.scan is None]
        names = {o.name for o, s in shapes if s is not None}
        if now_ns >= self._next_cloud_ns:
            self._next_cloud_ns = now_ns + CLOUD_PERIOD_NS
            for o, s in shapes:
                if o.scan is not None and s is not None:
                    self._send(cloud(o, s))
        message: dict[str, Any] = {"verb": "obstacles", "set": present}
        if self._shown - names:
            message["clear"] = sorted(self._shown - names)
        if self._send(json.dumps(message).encode()):
            self._shown = names

    def _connect(self) -> None:
        link = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_NONBLOCK)
        try:
            link.connect(self.path)
        except OSError:
            link.close()
        else:
            self._socket = link

    def _send(self, data: bytes) -> bool:
        if self._socket is None:
            return False
        try:
            self._socket.send(data)
        except BlockingIOError:
            return False
        except OSError:
            self.close()
            return False
        self.sent += 1
        return True

    def _read(self) -> None:
        """Take the answers; a refusal is kept for the report."""
        while self._socket is not None:
            try:
                raw = self._socket.recv(65536)
            except BlockingIOError:
                return
            except OSError:
                raw = b""
            if not raw:
                self.close()
                return
            try:
                reply = json.loads(raw)
            except ValueError:
                continue
            if isinstance(reply, dict) and not reply.get("ok") and "starting" not in reply:  # else it is told again
                self.refused += 1
                self.refusal = str(reply.get("error", ""))

    def close(self) -> None:
        """Hang up."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

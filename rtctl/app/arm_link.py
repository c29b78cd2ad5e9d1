"""The arm's bus as the loop sees it."""

from collections import deque
from collections.abc import Callable
from pathlib import Path

import numpy as np

from rtctl.app.vehicle import LOCKSTEP_WAIT, Say, never
from rtctl.design import Config, scales
from rtctl.hal.can.handshake import handshake
from rtctl.hal.can.link import CanLink, JointSpec, LinkSpec, identifiers
from rtctl.hal.can.transport import open_transport
from rtctl.protocol.mounting import Mounting
from rtctl.spec.robot import GripperTable
from rtctl.spec.rules import scale_of
from rtctl.types import F64, Feedback, Transport

NOBODY: F64 = np.zeros(0)


class ArmLink(CanLink):
    """A CAN link that greets its drives, as every vehicle's link does."""

    def __init__(self, spec: LinkSpec, transport: Transport, listen: float = 0.0) -> None:
        """`listen` [s] for a second master during the handshake."""
        super().__init__(spec, transport)
        self.listen = listen
        self.said: deque[str] = deque()  # what the handshake found, for people

    def greet(self, lockstep: bool, say: Say | None = None, ended: Callable[[], bool] = never) -> Feedback:
        """Return the feedback that the handshake leaves. Raises HandshakeError."""
        if lockstep:  # a busy machine may take its time: none passes for the drives
            found = handshake(self, listen=0.0, recover=True, timeout=LOCKSTEP_WAIT)
        else:
            found = handshake(self, listen=self.listen, recover=True)
        self.said += found.told
        return first_feedback(found.q[: self.n], found.q[self.n :])

    def settle(self) -> None:
        """Do nothing: drives speak when they are spoken to."""


def first_feedback(q: F64, grippers: F64 = NOBODY) -> Feedback:
    """Return the feedback of a handshake: positions (n,) of joints, (g,) of grippers [rad], all else at rest."""
    n = len(q)
    zero, seen = np.zeros(n), np.zeros((5, len(grippers)))
    seen[0] = grippers
    one, off = np.ones(n, np.int64), np.zeros(n, np.int64)
    return Feedback(-1, 0, q.astype(np.float64), zero, zero, zero, one, off, 0, 0.0, 0.0, seen)


def link_spec(config: Config) -> LinkSpec:
    """Return what the link needs to know."""
    joints = tuple(
        JointSpec(
            j.name,
            j.can_id,
            scale,
            j.q_min_rad,
            j.q_max_rad,
            j.reply_id,
            Mounting(j.direction, j.zero_rad),
            j.wrap,
        )
        for j, scale in zip(config.robot.joints, scales(config), strict=True)
    )
    grippers = tuple(_gripper(config, table) for table in config.gripper)
    return LinkSpec(
        place=config.link.channel,
        joints=(*joints, *grippers),
        protocol=config.link.protocol,
        fd=config.link.fd,
        period=1.0 / config.loop.servo_hz,
        watchdog=1e-3 * config.safety.watchdog_ms,
        grippers=len(grippers),
    )


def _gripper(config: Config, table: GripperTable) -> JointSpec:
    """Return a gripper as the link knows it; a finger that stands anywhere is no reason to refuse it."""
    scale = scale_of(config, table.drive)
    assert scale is not None  # `load` let the config through
    return JointSpec(table.name, table.can_id, scale, -scale.p_max, scale.p_max, table.reply_id)


def open_link(config: Config, path: Path) -> ArmLink:
    """Return the opened bus of a checked config; `path` is its file. Raises RtctlError."""
    spec = link_spec(config)
    return ArmLink(spec, open_bus(config, spec), 1e-3 * config.link.listen_ms)


def open_bus(config: Config, spec: LinkSpec) -> Transport:
    """Return what moves frames on the bus of a config. Raises RtctlError."""
    link = config.link
    return open_transport(
        link.interface,
        link.channel,
        bitrate=link.bitrate,
        fd=link.fd,
        data_bitrate=link.data_bitrate or link.bitrate,
        listen=identifiers(spec.joints),
        timeout=link.handshake_s,
    )

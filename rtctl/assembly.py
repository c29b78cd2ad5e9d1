"""From a checked config to the parts that the daemon and the simulation put together."""

from pathlib import Path

import numpy as np

from rtctl.config import Config, scales
from rtctl.config.urdf import urdf_file
from rtctl.control.robot import Robot
from rtctl.hal.can import JointSpec, LinkSpec
from rtctl.log.header import Header, make_header, meshes_to_files
from rtctl.types import F64


def link_spec(config: Config) -> LinkSpec:
    """Return what the link needs to know."""
    joints = tuple(
        JointSpec(j.name, j.can_id, scale, j.q_min_rad, j.q_max_rad)
        for j, scale in zip(config.robot.joints, scales(config), strict=True)
    )
    return LinkSpec(
        place=config.link.channel,
        joints=joints,
        protocol=config.link.protocol,
        fd=config.link.fd,
        period=1.0 / config.loop.servo_hz,
        watchdog=1e-3 * config.safety.watchdog_ms,
    )


def header_of(config: Config, path: Path, robot: Robot, q: F64, **extra: str) -> Header:
    """Return the header of a log: what replay needs beside the ticks, `q` (n,) [rad] of the handshake included."""
    return make_header(
        robot.name,
        robot.joints,
        robot.slots,
        robot.dt,
        config=path.read_text(encoding="utf-8"),
        urdf=urdf_file(config.robot.urdf, path).read_text(encoding="utf-8"),
        files=meshes_to_files(robot.meshes),
        extra={"q_handshake": np.asarray(q, np.float64).tobytes().hex(), **extra},
    )

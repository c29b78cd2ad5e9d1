"""From a checked config to the parts that the daemon and the simulation put together."""

import json
from pathlib import Path

import numpy as np

from rtctl.arm.robot import Robot
from rtctl.design import Config, scales
from rtctl.design.assets import files_named
from rtctl.hal.can.link import JointSpec, LinkSpec
from rtctl.kernel.rotations import R_of, quat_of
from rtctl.log.header import SCENE_FILE, Header, make_header, meshes_to_files, scene_text
from rtctl.log.record.meshes import MESHES, archive
from rtctl.protocol import mit
from rtctl.protocol.dbc import DBC, dbc_of
from rtctl.protocol.dbc import Joint as DbcJoint
from rtctl.spec.obstacles import quaternion
from rtctl.spec.urdf import package_folders, urdf_file
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


def header_of(config: Config, path: Path, robot: Robot, q: F64, counters: tuple[int, ...] = (), **extra: str) -> Header:
    """Return the header of a log: what replay needs beside the ticks, `q` (n,) [rad] of the handshake included.

    counters: of the link after the handshake.
    """
    urdf = urdf_file(config.robot.urdf, path)
    text = urdf.read_text(encoding="utf-8")
    files: dict[str, str | bytes] = {SCENE_FILE: scene_of(config, robot), DBC: drive_dbc(config)}
    files |= meshes_to_files(robot.meshes)
    if meshes := archive(text, urdf.parent, package_folders(urdf), files_named(config), path.resolve().parent):
        files[MESHES] = meshes
    return make_header(
        robot.name,
        robot.joints,
        robot.slots,
        robot.dt,
        config=path.read_text(encoding="utf-8"),
        urdf=text,
        extra={"q_handshake": np.asarray(q, np.float64).tobytes().hex(), "counters": json.dumps(counters), **extra},
        files=files,
    )


def drive_dbc(config: Config) -> str:
    """Return the DBC of the robot's own identifiers and scales."""
    joints = [DbcJoint(j.name, j.can_id, *scale) for j, scale in zip(config.robot.joints, scales(config), strict=True)]
    return dbc_of(joints, config.link.protocol == "mit+e2e", mit.REPLY_OFFSET, mit.KP_MAX, mit.KD_MAX)


def scene_of(config: Config, robot: Robot) -> str:
    """Return as JSON what the recorder needs to draw the arm and its obstacles without knowing the robot."""
    base = config.robot.base_pose
    wxyz = quat_of(R_of(quaternion(base.rpy_rad, base.wxyz)))
    at = zip(robot.points.link, robot.points.local.tolist(), robot.points.radius.tolist(), strict=True)
    return scene_text(
        [[int(link), *p, radius] for link, p, radius in at],
        robot.obstacles,
        base={"position": list(base.position_m), "wxyz": wxyz.tolist()},
    )

"""The arm in a log: the header that its replay needs, and the arm once more from that header alone."""

import json
import tempfile
from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np

from rtctl import design as cfg
from rtctl.app.arm_link import ArmLink, first_feedback, link_spec
from rtctl.app.vehicle import Rebuilt
from rtctl.arm.memory import Memory
from rtctl.arm.record import record_dtype
from rtctl.arm.robot import Robot
from rtctl.design import Config
from rtctl.design.assets import files_named
from rtctl.errors import ConfigError, LogError
from rtctl.kernel.rotations import R_of, quat_of
from rtctl.log.header import SCENE_FILE, Header, make_header, meshes_of, meshes_to_files, scene_text
from rtctl.log.read.inputs import feedbacks_of
from rtctl.log.read.run import Run
from rtctl.log.record.checkpoint import decode_checkpoint
from rtctl.log.record.meshes import MESHES, archive, unpacked
from rtctl.protocol import mit
from rtctl.protocol.dbc import DBC, dbc_of
from rtctl.protocol.dbc import Joint as DbcJoint
from rtctl.spec.obstacles import quaternion
from rtctl.spec.urdf import package_folders, urdf_file
from rtctl.types import F64, Command, Feedback


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
    header = make_header(
        robot.name,
        robot.joints,
        robot.slots,
        robot.dt,
        config=path.read_text(encoding="utf-8"),
        urdf=text,
        extra={"q_handshake": np.asarray(q, np.float64).tobytes().hex(), "counters": json.dumps(counters), **extra},
        files=files,
    )
    return header._replace(dtype=record_dtype(robot.n, robot.slots, len(robot.grippers)))


def drive_dbc(config: Config) -> str:
    """Return the DBC of the robot's own identifiers and scales."""
    joints = [DbcJoint(j.name, j.can_id, j.reply_id, *j.scale) for j in link_spec(config).joints]
    return dbc_of(joints, config.link.protocol == "mit+e2e", mit.KP_MAX, mit.KD_MAX)


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


def rebuilt(run: Run) -> tuple[Config, Robot]:
    """Return config and robot as the log's attachments describe them.

    Raises LogError when they are not there, ConfigError when this version refuses them.
    """
    header = run.header
    if not header.config or not header.urdf:
        raise LogError(f"{run.path}: no config.toml or robot.urdf attached: it cannot be replayed alone")
    with tempfile.TemporaryDirectory(prefix="rtctl-replay-") as name:
        folder = Path(name)
        urdf, text = unpacked(header.urdf, header.config, header.files, folder)
        (folder / "config.toml").write_text(text, encoding="utf-8")
        (folder / "robot.urdf").write_text(urdf, encoding="utf-8")
        try:
            config = cfg.load(folder / "config.toml")
            own = msgspec.structs.replace(config.robot, urdf="robot.urdf")
            here = msgspec.structs.replace(config, robot=own)
            robot = cfg.build(here, folder / "config.toml")
            return config, robot._replace(meshes=meshes_of(header))
        except ValueError as error:
            raise LogError(f"{run.path}: a mesh that is attached: {error}") from None
        except ConfigError as error:
            place = error.place.replace(f"{folder}/", f"{run.path}: ")
            raise ConfigError(place, error.got, error.wanted) from None


def other(path: Path, run: Run) -> tuple[Config, Robot]:
    """Return another config and its robot, for what-if. Raises ConfigError when it is not for this log's robot."""
    config = cfg.load(path)
    urdf_file(config.robot.urdf, path)
    header = run.header
    names = tuple(j.name for j in config.robot.joints)
    if names != header.joints:
        raise ConfigError(f"{path}: robot.joints", ", ".join(names), f"the log's {', '.join(header.joints)}")
    if abs(1.0 / config.loop.servo_hz - header.period) > 1e-12:
        raise ConfigError(f"{path}: loop.servo_hz", config.loop.servo_hz, f"the log's {1.0 / header.period:g}")
    return config, cfg.build(config, path)._replace(meshes=meshes_of(run.header))


class _Null:
    """A bus that takes everything and says nothing."""

    def send(self, raw: bytes) -> bool:
        return True

    def send_all(self, frames: Sequence[bytes]) -> Sequence[bytes]:
        return frames

    def receive(self) -> Sequence[bytes]:
        return []

    def collect(self, count: int, timeout: float) -> Sequence[bytes]:
        return []

    def wait(self, timeout: float) -> bool:
        return False

    def flags(self) -> int:
        return 0

    def reopen(self) -> bool:
        return True

    def close(self) -> None:
        return


def rebuild(run: Run, path: Path | None) -> Rebuilt[Robot, Feedback, Command]:
    """Return the arm of a log, or with `path` what another config makes of it. Raises LogError, ConfigError."""
    config, robot = rebuilt(run) if path is None else other(path, run)
    link = ArmLink(link_spec(config), _Null())
    return Rebuilt(robot, first_feedback(_first_q(run)), feedbacks_of, "tau_sent", link, link.write)


def decoded(text: bytes, robot: Robot, template: Memory) -> tuple[Memory, tuple[int, ...]]:
    """Return memory and counters of a checkpoint. Raises ValueError."""
    return decode_checkpoint(text, robot, template)


def _first_q(run: Run) -> F64:
    text = run.header.extra.get("q_handshake", "")
    try:
        q = np.frombuffer(bytes.fromhex(text), np.float64)
    except ValueError:
        q = np.zeros(0)
    if q.shape != (len(run.header.joints),):
        raise LogError(f"{run.path}: its header has no positions of the handshake")
    return q

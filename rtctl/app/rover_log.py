"""The rover in a log: the header that its replay needs, and the rover once more from that header alone."""

import tempfile
from functools import partial
from pathlib import Path

import numpy as np

from rtctl.app.vehicle import Rebuilt
from rtctl.design.assets import files_named
from rtctl.design.rover import build
from rtctl.errors import ConfigError, LogError
from rtctl.log.header import SCENE_FILE, Header, make_header, meshes_to_files, scene_text
from rtctl.log.read.run import Run
from rtctl.log.record.meshes import MESHES, archive, unpacked
from rtctl.rover.record import base_dtype, feedback_from, make_base_record
from rtctl.rover.robot import Base
from rtctl.rover.signals import BaseCommand, BaseFeedback
from rtctl.spec.base import BaseConfig, load

LINK = "vehicle"  # the link's name in the log


def header_of(config: BaseConfig, path: Path, base: Base, start: BaseFeedback, **extra: str) -> Header:
    """Return the header of a log: what replay needs beside the ticks, the handshake's pose included."""
    pose = np.array([*start.position, start.yaw])
    whole = start._replace(slot=max(start.slot, 0))  # a record has no slot before the first
    first = make_base_record(base.slots, **whole._asdict()).tobytes().hex()  # all of it, for a replay
    files: dict[str, str | bytes] = {
        SCENE_FILE: scene_text(np.column_stack([base.points, base.point_radius]).tolist(), base.obstacles)
    }
    files |= meshes_to_files(base.meshes)
    if packed := archive("", path.parent, (), files_named(config), path.resolve().parent):
        files[MESHES] = packed
    header = make_header(
        base.name,
        (),
        base.slots,
        base.dt,
        config=path.read_text(encoding="utf-8"),
        buses=(),
        extra={"pose_handshake": pose.tobytes().hex(), "kind": "base", "start": first, **extra},
        files=files,
    )
    return header._replace(dtype=base_dtype(base.slots), links=(LINK,))


def rebuild(run: Run, config: Path | None) -> Rebuilt[Base, BaseFeedback, BaseCommand]:
    """Return the rover of a log, or what another config makes of it. Raises LogError, ConfigError."""
    header = run.header
    with tempfile.TemporaryDirectory(prefix="rtctl-replay-") as name:
        path = Path(name) / "config.toml"
        path.write_text(unpacked("", header.config, header.files, path.parent)[1], encoding="utf-8")
        path = path if config is None else config
        base = build(load(path), path)
    try:
        start = feedback_from(np.frombuffer(bytes.fromhex(header.extra.get("start", "")), header.dtype)[0])
    except (ValueError, IndexError):
        raise LogError(f"{run.path}: its header has no feedback of the handshake") from None
    if abs(base.dt - header.period) > 1e-12:
        raise ConfigError(f"{path}: loop.servo_hz", f"{1.0 / base.dt:g}", f"the log's {1.0 / header.period:g}")
    return Rebuilt(base, start, partial(map, feedback_from), "v_world", None, None)

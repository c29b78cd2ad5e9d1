"""The header of a log: everything that is known before the first tick, enough to replay the log alone."""

import json
import platform
import subprocess
from base64 import b64decode, b64encode
from collections.abc import Mapping, Sequence
from hashlib import sha256
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np

from rtctl.arm.record import record_dtype
from rtctl.log import limits
from rtctl.types import Shape
from rtctl.world.meshes import NONE, Meshes, added

PACKAGES = (
    "rtctl",
    "numpy",
    "numba",
    "pin",
    "coal",
    "mcap",
    "protobuf",
    "zstandard",
    "python-can",
    "pybullet",
    "pymavlink",
)

SCENE_FILE = "scene.json"  # attachment: base pose, points and fixed obstacles, for drawing, see scene_text

MESH = "mesh/"  # before the names of attachments that hold solids
FIXED = {"<f4", "<f8", "<i4", "<i8", "<u4", "<u8"}  # types of a record's fields


class Header(NamedTuple):
    """What each segment of a log carries as metadata and attachments."""

    robot: str
    joints: tuple[str, ...]  # names, in the order of q
    slots: int  # obstacle slots of a record
    period: float  # [s] of the servo
    buses: tuple[str, ...]  # topic names; an entry's `kind >> 8` is the index
    config: str  # the text of the configuration file
    urdf: str  # the text of the URDF
    dtype: np.dtype[np.void]  # of the record
    versions: Mapping[str, str]
    revision: str  # of the program's own repository, "" when it does not run from one
    extra: Mapping[str, str]  # handshake values, realtime settings, ...
    files: Mapping[str, str | bytes]  # further attachments by name (scenario, DBC, meshes)
    links: tuple[str, ...] = ()  # MAVLink; an entry's `kind >> 8` is the index

    @property
    def config_sha256(self) -> str:
        """Return the hash under which the configuration is known."""
        return sha256(self.config.encode()).hexdigest()


def make_header(
    robot: str,
    joints: Sequence[str],
    slots: int,
    period: float,
    config: str = "",
    urdf: str = "",
    buses: Sequence[str] = ("can0",),
    extra: Mapping[str, str] | None = None,
    files: Mapping[str, str | bytes] | None = None,
) -> Header:
    """Return the header of a robot of `joints` and `slots` obstacle slots ticking each `period` [s]."""
    return Header(
        robot=robot,
        joints=tuple(joints),
        slots=slots,
        period=period,
        buses=tuple(buses),
        config=config,
        urdf=urdf,
        dtype=record_dtype(len(joints), slots),
        versions=versions(),
        revision=revision(),
        extra=dict(extra or {}),
        files=dict(files or {}),
    )


def scene_text(points: list[list[float]], obstacles: Sequence[Shape], **more: object) -> str:
    """Return the text of SCENE_FILE.

    points: an arm's (link, x, y, z, radius) [m] in their links' frames, or a base's (x, y, radius).
    """
    shapes = [{k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in s._asdict().items()} for s in obstacles]
    text = msgspec.json.encode({"points": points, "obstacles": shapes, **more})  # which takes a cloud's bytes, too
    return text.decode()


def meshes_to_files(meshes: Meshes) -> dict[str, str]:
    """Return the robot's solids as attachments, so that a log can be replayed without the files they came from."""
    stops = [*meshes.starts[1:], len(meshes.data)]
    parts = zip(meshes.names, meshes.starts, stops, strict=False)
    return {MESH + name: b64encode(meshes.data[start:stop].tobytes()).decode() for name, start, stop in parts}


def meshes_of(header: Header) -> Meshes:
    """Return the solids that `meshes_to_files` attached, for the robot of a replay. Raises ValueError."""
    meshes = NONE
    for name, text in header.files.items():
        if name.startswith(MESH):
            meshes = added(
                meshes, name.removeprefix(MESH), np.frombuffer(b64decode(str(text), validate=True), np.float64)
            )
    return meshes


def versions() -> dict[str, str]:
    """Return the versions of the interpreter, the kernel and the packages that decide the results."""
    found = {"python": platform.python_version(), "kernel": platform.release(), "machine": platform.machine()}
    for package in PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            continue
    return found


def revision() -> str:
    """Return what `git describe` says of the program's own folder, or "" when it cannot say."""
    folder = Path(__file__).resolve().parent
    command = ["git", "-C", str(folder), "describe", "--always", "--dirty", "--abbrev=12"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=5.0, check=False)
    except (OSError, subprocess.SubprocessError):
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""


def dtype_to_json(dtype: np.dtype[np.void]) -> str:
    """Return a record dtype as JSON text: [[name, format] or [name, format, shape], ...]."""
    return json.dumps(dtype.descr)


def dtype_from_json(text: str) -> np.dtype[np.void]:
    """Return the dtype that `dtype_to_json` wrote.

    Raises ValueError, TypeError or KeyError on anything else.
    """
    fields = [(str(f[0]), str(f[1]), tuple(f[2])) if len(f) > 2 else (str(f[0]), str(f[1])) for f in json.loads(text)]
    try:
        dtype = np.dtype(fields)
    except SyntaxError as error:  # numpy evaluates what stands between commas
        raise ValueError(f"no format of numpy: {error}") from None
    if dtype.itemsize > limits.TICK:
        raise ValueError(f"a record of {dtype.itemsize} bytes, at most {limits.TICK} are read")
    if unknown := {f.base.str for f in (dtype[name] for name in dtype.names or ())} - FIXED:
        raise ValueError(f"types {sorted(unknown)}, wanted some of {sorted(FIXED)}")
    return dtype


def header_to_json(header: Header) -> str:
    """Return the header as JSON text, for the ring and for the log's metadata."""
    raw = {**header._asdict(), "dtype": dtype_to_json(header.dtype)}
    return json.dumps({**raw, "files": {name: _to_text(content) for name, content in header.files.items()}})


def _to_text(content: str | bytes) -> str | list[str]:
    return content if isinstance(content, str) else [b64encode(content).decode()]


def _from_text(value: object) -> str | bytes:
    return b64decode(value[0]) if isinstance(value, list) else str(value)


def of_attachment(name: str, data: bytes) -> str | bytes:
    """Return an attachment's content as `Header.files` has it: bytes for archives, text for everything else."""
    return data if name.endswith(".zip") else data.decode("utf-8", "replace")


def header_from_json(text: str) -> Header:
    """Return the header that `header_to_json` wrote.

    Raises ValueError, TypeError or KeyError on anything else.
    """
    raw = json.loads(text)
    slots, period = int(raw["slots"]), float(raw["period"])
    if not 0 <= slots <= limits.SLOTS or not 0.0 < period <= limits.PERIOD:
        raise ValueError(
            f"{slots} slots and a period of {period} s, wanted at most {limits.SLOTS} and {limits.PERIOD:g} s"
        )
    return Header(
        robot=str(raw["robot"]),
        joints=_names(raw["joints"]),
        slots=slots,
        period=period,
        buses=_names(raw["buses"]),
        config=str(raw["config"]),
        urdf=str(raw["urdf"]),
        dtype=dtype_from_json(raw["dtype"]),
        versions={str(k): str(v) for k, v in raw["versions"].items()},
        revision=str(raw["revision"]),
        extra={str(k): str(v) for k, v in raw["extra"].items()},
        files={str(k): _from_text(v) for k, v in raw["files"].items()},
        links=_names(raw.get("links", ())),
    )


def _names(values: list[str]) -> tuple[str, ...]:
    if not isinstance(values, list | tuple) or len(values) > limits.NAMES:
        raise ValueError(f"wanted a list of at most {limits.NAMES} names")
    return tuple(map(str, values))

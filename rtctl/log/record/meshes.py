"""Collision meshes as an attachment: with them a log builds its robot where the packages are not installed."""

import io
import json
import xml.etree.ElementTree as ET
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path

from rtctl.errors import LogError
from rtctl.log import limits

MESHES = "meshes.zip"  # name of the attachment
INDEX = "index.json"  # in it: what the URDF calls a mesh -> its name in the archive
ASSET = "config:"  # before the names that the config gives
LARGEST = 4 << 20  # [bytes] of an archive; larger ones are left out, and replay looks for the packages
_EPOCH = (1980, 1, 1, 0, 0, 0)  # equal meshes make equal bytes


def archive(
    urdf: str, folder: Path, packages: Sequence[Path], assets: Sequence[str] = (), config_folder: Path = Path()
) -> bytes:
    """Return the archive of the collision meshes that a URDF's text names; b"" when there is none, or too much.

    folder: of the URDF, for relative names; packages: what package:// is looked for in; assets: files that the config
    names, relative to its own folder.
    """
    files = {name: _resolve(name, folder, packages) for name in _collision_meshes(urdf)}
    files |= {ASSET + name: _resolve(name, config_folder, ()) for name in assets}
    if not files or None in files.values():
        return b""
    target, index = io.BytesIO(), {}
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as zipped:
        for number, (name, path) in enumerate(files.items()):
            assert path is not None
            index[name] = f"{number}{path.suffix}"
            zipped.writestr(zipfile.ZipInfo(index[name], _EPOCH), path.read_bytes(), zipfile.ZIP_DEFLATED)
        zipped.writestr(zipfile.ZipInfo(INDEX, _EPOCH), json.dumps(index), zipfile.ZIP_DEFLATED)
    data = target.getvalue()
    return data if len(data) <= LARGEST else b""


def unpacked(urdf: str, config: str, files: Mapping[str, str | bytes], folder: Path) -> tuple[str, str]:
    """Write the attached meshes into a folder; return the texts of URDF and config with their places in them.

    Raises LogError when the attachment is damaged.
    """
    data = files.get(MESHES, b"")
    if not isinstance(data, bytes) or not data:
        return urdf, config
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as zipped:
            _bounded(zipped)
            index = {str(k): str(v) for k, v in json.loads(_content(zipped, INDEX)).items()}
            for member in set(index.values()):
                _place(folder, member).write_bytes(_content(zipped, member))
            for name, member in index.items():
                path = _place(folder, member)
                if name.startswith(ASSET):
                    config = _placed(config, name.removeprefix(ASSET), path)
                else:
                    urdf = _placed(urdf, name, path)
    except (
        zipfile.BadZipFile,
        ValueError,
        KeyError,
        AttributeError,
        EOFError,
        NotImplementedError,  # zipfile's, for a compression or an encryption that it does not know
        zlib.error,
        RuntimeError,
    ) as error:
        raise LogError(f"attachment {MESHES}: {error}") from None
    return urdf, config


def _place(folder: Path, member: str) -> Path:
    return folder / Path(member).name  # a name alone: an archive cannot write elsewhere


def _content(zipped: zipfile.ZipFile, member: str) -> bytes:
    """Return a member, no more of it than the archive's directory says: read() without a size unpacks all there is."""
    with zipped.open(member) as file:
        return file.read(zipped.getinfo(member).file_size)


def _bounded(zipped: zipfile.ZipFile) -> None:
    """Raise ValueError for an archive that says it is larger than any robot's meshes; reading holds it to its word."""
    members = zipped.infolist()
    size = sum(member.file_size for member in members)
    if len(members) > limits.MEMBERS or size > limits.ARCHIVE:
        raise ValueError(
            f"{len(members)} files of {size} bytes, at most {limits.MEMBERS} of {limits.ARCHIVE} are unpacked"
        )


def _placed(text: str, name: str, path: Path) -> str:
    return text.replace(f'"{name}"', f'"{path}"').replace(f"'{name}'", f"'{path}'")


def _collision_meshes(urdf: str) -> list[str]:
    try:
        root = ET.fromstring(urdf)
    except ET.ParseError:
        return []
    found = [mesh.get("filename", "") for mesh in root.iterfind("link/collision/geometry/mesh")]
    return sorted({name for name in found if name})


def _resolve(name: str, folder: Path, packages: Sequence[Path]) -> Path | None:
    if name.startswith("package://"):
        places = [base / name.removeprefix("package://") for base in packages]
    else:
        places = [folder / name.removeprefix("file://")]
    return next((place for place in places if place.is_file()), None)

"""Where a robot's description is: a file, or a name from the packages that carry robots; URDF, xacro or MJCF."""

import importlib
import importlib.util
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from rtctl.errors import RtctlError, UsageError
from rtctl.spec.urdf import share_folders
from rtctl.spell import nearest

FETCHED = "robot_descriptions"  # fetches at run time: supported, never needed
PACKAGES = ("example-robot-data", "rtbdata", "pybullet_data", "robosuite")
INSTALL = {"rtbdata": "rtb-data", "pybullet_data": "pybullet"}  # what pip calls them
SHORT = {
    "ur3": "ur3_robot",
    "ur5": "ur5_robot",
    "ur10": "ur10_robot",
    "kinova_j2s6s200": "kinova",
    "so100": "so100",
    "irb140": "irb140",
    "iiwa14": "lbr_iiwa_14_r820",
    "puma560": "puma560_robot",
}
ABOVE = 6  # folders above a description in which its packages may lie


class IntakeError(RtctlError):
    """A robot that cannot be made into a config, and why: one line."""


class Source(NamedTuple):
    """A description that was found."""

    path: Path
    name: str  # what the robot may be called
    origin: str  # for people: package and file
    mjcf: bool


def find(what: str) -> Source:
    """Return the description that a file name or a name means. Raises UsageError, IntakeError."""
    path = Path(what)
    if path.suffix.lower() in (".urdf", ".xacro", ".xml", ".mjcf") or path.is_file():
        if not path.is_file():
            raise UsageError(f"{what}: got no such file, wanted a URDF, xacro or MJCF file, or the name of a robot")
        return Source(path.resolve(), _stem(path), path.name, _is_mjcf(path))
    package, _, name = what.rpartition(":")
    if package == FETCHED:
        return _fetched(name)
    known = {key: places for key, places in index().items() if not package or package in places}
    key = re.sub(r"[^a-z0-9_]", "_", name.lower())
    key = SHORT.get(key, key) if SHORT.get(key) in known else key
    if key not in known:
        alike = [each for each in known if key in each]
        if len(alike) != 1:
            missing = [each for each in PACKAGES if each not in {p for places in index().values() for p in places}]
            more = f"; not installed: {', '.join(INSTALL.get(p, p) for p in missing)}" if missing else ""
            wanted = f"one of {', '.join(sorted(alike))}" if alike else nearest(name, sorted(known))
            raise UsageError(f"ROBOT: got {what!r}, wanted a file, or {wanted}{more}")
        key = alike[0]
    places = known[key]
    chosen = package or next(iter(places))
    found = places[chosen]
    return Source(found, key.removesuffix("_robot"), f"{chosen}: {found.name}", _is_mjcf(found))


def index() -> dict[str, dict[str, Path]]:
    """Return the robots of the installed packages: by name, then by package, in the order of preference."""
    found: dict[str, dict[str, Path]] = {}
    for package in PACKAGES:
        for path in _described(package):
            name = path.parent.name if path.name == "robot.xml" else _stem(path)
            found.setdefault(name.lower(), {}).setdefault(package, path)
    return found


def _described(package: str) -> Iterator[Path]:
    """Yield the descriptions that an installed package carries."""
    if package == "example-robot-data":
        for folder in share_folders():
            yield from sorted((folder / package / "robots").rglob("*.urdf"))
        return
    spec = importlib.util.find_spec(package)
    for folder in [Path(p) for p in spec.submodule_search_locations or ()] if spec else []:
        if package == "robosuite":
            yield from sorted((folder / "models" / "assets" / "robots").glob("*/robot.xml"))
            continue
        for pattern in ("*.urdf", "*.urdf.xacro", "*.xacro"):
            yield from (p for p in sorted(folder.rglob(pattern)) if "macro" not in p.name and "common" not in p.name)


def _fetched(name: str) -> Source:
    """Return a description of the package that fetches them. Raises IntakeError."""
    module = name if name.endswith("_description") else f"{name}_description"
    try:
        found = importlib.import_module(f"{FETCHED}.{module}")
    except ImportError as error:
        raise IntakeError(f"{FETCHED}:{name}: got {error}, wanted that package and a robot of it") from None
    except Exception as error:  # it clones a repository when it is imported
        raise IntakeError(f"{FETCHED}:{name}: could not be fetched: {error}") from None
    path = Path(getattr(found, "URDF_PATH", None) or found.MJCF_PATH)
    return Source(path, module.removesuffix("_description"), f"{FETCHED}: {path.name}", _is_mjcf(path))


def _stem(path: Path) -> str:
    return re.sub(r"[^A-Za-z0-9_]", "_", path.name.split(".")[0])


def _is_mjcf(path: Path) -> bool:
    return path.suffix.lower() in (".xml", ".mjcf") and "<mujoco" in path.read_text(encoding="utf-8", errors="replace")


def urdf_text(path: Path) -> str:
    """Return the URDF of a file, xacro expanded. Raises IntakeError."""
    if not path.name.endswith(".xacro"):
        return path.read_text(encoding="utf-8", errors="replace")
    try:
        import xacro
        from xacro import substitution_args
    except ImportError:
        raise IntakeError(f"{path}: got a xacro file, wanted the package xacro installed: pip install xacro") from None
    before, substitution_args._eval_find = substitution_args._eval_find, lambda name: str(_package(path, name))
    try:
        return str(xacro.process_file(str(path)).toxml())
    except Exception as error:
        ours: BaseException | None = error
        while ours is not None and not isinstance(ours, IntakeError):
            ours = getattr(ours, "exc", None) or ours.__context__  # what xacro wraps, some words twice
        if ours is not None:
            raise ours from None
        words = re.sub(r"<class '[^']*'>: |" + re.escape(f"{path}: "), "", " ".join(str(error).split()))
        raise IntakeError(f"{path.name}: xacro: {words[:200]}") from None
    finally:
        substitution_args._eval_find = before


def _package(path: Path, name: str) -> Path:
    """Return the folder of a package that a description names. Raises IntakeError."""
    for folder in _around(path):
        if (folder / name).is_dir():
            return folder / name
        if folder.name == name:
            return folder
    raise IntakeError(f"{path.name}: got $(find {name}), wanted a folder of that name above the file")


def _around(path: Path) -> list[Path]:
    return [*list(path.resolve().parents)[:ABOVE], *share_folders()]


def mesh_file(name: str, path: Path) -> Path | None:
    """Return where a mesh that a URDF names is; None where it is not."""
    inside = re.sub(r"^(package|model|file)://", "", name)
    if Path(inside).is_absolute() and Path(inside).is_file():
        return Path(inside)
    _, _, rest = inside.lstrip("/").partition("/")
    for folder in (path.parent, *_around(path)):
        for tail in (inside, rest) if name.startswith(("package://", "model://")) else (inside,):
            if tail and (folder / tail).is_file():
                return (folder / tail).resolve()
    return None


def with_meshes(text: str, path: Path) -> tuple[ET.Element, list[str]]:
    """Return the URDF's tree with meshes by absolute path, those that are not there left out, and their names."""
    try:
        root = ET.fromstring(text)
    except ET.ParseError as error:
        raise IntakeError(f"{path}: got a text that is no XML ({error}), wanted a URDF") from None
    lost: list[str] = []
    for link in root.iter("link"):
        for kind in ("visual", "collision"):
            for piece in link.findall(kind):
                mesh = piece.find("geometry/mesh")
                if mesh is None:
                    continue
                found = mesh_file(mesh.get("filename", ""), path)
                if found is None:
                    lost.append(mesh.get("filename", ""))
                    link.remove(piece)
                else:
                    mesh.set("filename", str(found))
    return root, lost

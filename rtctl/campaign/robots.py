"""Robot files of a campaign: their text, with keys changed; and the robots derived of them, once a process."""

import atexit
import hashlib
import shutil
import tempfile
import tomllib
from functools import cache, lru_cache
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

from rtctl.app.choose import vehicle_of
from rtctl.app.vehicle import Setup, SomeVehicle
from rtctl.errors import ConfigError, UsageError
from rtctl.experiment.scene import toml
from rtctl.plain import Json
from rtctl.spec.scenario import Scenario, robot_file
from rtctl.spec.urdf import urdf_file

ROBOTS = 12  # derived ones that a process keeps


class Variant(NamedTuple):
    """One cell of a grid of configs."""

    name: str  # key=value of what is changed, for people
    changes: dict[tuple[str, ...], object]  # by the path of the key


class Ready(NamedTuple):
    """A robot file, read."""

    vehicle: SomeVehicle
    setup: Setup[Any, Any, Any, Any]
    path: Path


def grid(words: list[str]) -> list[Variant]:
    """Return the variants of words like `avoid.clearance_m=0.01,0.02`: every combination. Raises UsageError."""
    axes = []
    for word in words:
        key, equals, text = word.partition("=")
        if not (key and equals and text):
            raise UsageError(f"--grid: got {word!r}, wanted TABLE.KEY=VALUE[,VALUE...]")
        axes.append([(tuple(key.split(".")), value, shown) for value, shown in _values(text)])
    found = []
    for cell in product(*axes):
        name = " ".join(f"{'.'.join(path)}={shown}" for path, _, shown in cell)
        found.append(Variant(name, {path: value for path, value, _ in cell}))
    return found


def _values(text: str) -> list[tuple[object, str]]:
    try:
        values = tomllib.loads(f"x = [{text}]")["x"]
        return [(value, toml(value)) for value in values]
    except tomllib.TOMLDecodeError:  # words without quotes
        return [(_value(word), word) for word in text.split(",")]


def _value(word: str) -> object:
    try:
        return tomllib.loads(f"x = {word}")["x"]
    except tomllib.TOMLDecodeError:
        return word


def found(robot: str, beside: Path) -> Path:
    """Return the config file of a robot, as a scenario `beside` it would find it. Raises ConfigError."""
    return robot_file(Scenario(robot=robot, duration_s=1.0), beside)


def text_of(path: Path, variant: Variant) -> str:
    """Return the text of a robot file with a variant's keys, complete without its folder. Raises ConfigError."""
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ConfigError(str(path), error, "a readable TOML file") from None
    robot = table.get("robot", {})
    if "urdf" in robot and not str(robot["urdf"]).startswith("package://"):
        robot["urdf"] = str(urdf_file(robot["urdf"], path).resolve())
    for part in (*table.get("mesh", ()), *table.get("obstacle", ())):
        if "file" in part:
            part["file"] = str((path.resolve().parent / part["file"]).resolve())
    for keys, value in variant.changes.items():
        _set(table, keys, value, path)
    return "".join(f"{toml(k)} = {toml(v)}\n" for k, v in table.items())


def _set(table: Json, keys: tuple[str, ...], value: object, path: Path) -> None:
    for key in keys[:-1]:
        table = table.setdefault(key, {})
        if not isinstance(table, dict):
            raise ConfigError(f"{path}: {'.'.join(keys)}", "a path through a value", "TABLE.KEY")
    table[keys[-1]] = value


@cache
def _folder() -> Path:
    folder = Path(tempfile.mkdtemp(prefix="rtctl-campaign-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


@lru_cache(ROBOTS)
def ready(robot: str, text: str) -> Ready:
    """Return the robot of a config's text. Raises ConfigError."""
    mark = hashlib.blake2b(text.encode(), digest_size=8).hexdigest()
    path = _folder() / mark / f"{Path(robot).stem}.toml"
    path.parent.mkdir(exist_ok=True)
    path.write_text(text, encoding="utf-8")
    vehicle = vehicle_of(path)
    return Ready(vehicle, vehicle.load(path, None), path)

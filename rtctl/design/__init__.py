"""TOML to checked structs to the derived `Robot`; every refusal a deployment can meet offline.

`load` reads and checks the file alone; `build` adds what needs the URDF; `check` reports the derived robot.
"""

from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from rtctl.plain import Json
from rtctl.spec.base import BaseConfig, is_base
from rtctl.spec.base import load as load_base
from rtctl.spec.read import read
from rtctl.spec.robot import Config
from rtctl.spec.rules import bus_load, refuse, scales

if TYPE_CHECKING:
    from rtctl.arm.robot import Robot
    from rtctl.design.report import Report

__all__ = [
    "BaseConfig",
    "Config",
    "build",
    "bus_load",
    "check",
    "check_base",
    "is_base",
    "json_schema",
    "load",
    "load_base",
    "scales",
]


def load(path: str | Path) -> Config:
    """Return the checked config of a TOML file.

    Raises ConfigError for a key that is missing, unknown, of a wrong type, not finite, out of its bounds, or in
    contradiction with another.
    """
    config: Config = read(Path(path), Config)
    refuse(config, str(path))
    return config


def build(config: Config, path: str | Path) -> "Robot":
    """Return the derived robot; `path` is the config's file. Raises ConfigError where the URDF contradicts it."""
    from rtctl.design.arm import build as derived  # imported when needed: the rigid-body library takes its time

    return derived(config, path)


def check(config: Config, robot: "Robot") -> "Report":
    """Return the report of a config and its derived robot that `rtctl check` prints."""
    from rtctl.design.report import report

    return report(config, robot)


def check_base(path: str | Path) -> "Report":
    """Return the report of a mobile base's file. Raises ConfigError."""
    from rtctl.design.rover import build as derived
    from rtctl.design.rover import key_of
    from rtctl.design.rover import report as told

    config = load_base(path)
    key_of(config, path)
    return told(config, derived(config, path))


def json_schema(kind: type = Config) -> Json:
    """Return the JSON Schema of a config file, from the same structs that check it: an arm's, or `BaseConfig`."""
    schema = msgspec.json.schema(kind)
    named = {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": "rtctl robot config", **schema}
    return dict(msgspec.json.decode(msgspec.json.encode(named)))  # tuples become the lists of JSON

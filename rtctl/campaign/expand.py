"""From what is asked to its cases: sources x configs x plants x faults, made one at a time."""

import json
from collections.abc import Iterator
from functools import cache
from itertools import product
from pathlib import Path
from typing import NamedTuple

from rtctl.campaign.case import Asked, Case, loads, source_of
from rtctl.campaign.robots import Variant, found, ready, text_of
from rtctl.errors import ConfigError
from rtctl.plain import Json
from rtctl.spec.read import convert, parse
from rtctl.spec.scenario import Scenario


class Plan(NamedTuple):
    """A whole campaign."""

    sources: tuple[str, ...]
    asked: Asked
    variants: tuple[Variant, ...]
    plants: tuple[tuple[str, Json], ...]  # name, the scenario's tables that it replaces
    faults: tuple[tuple[str, Json], ...]

    def cases(self) -> Iterator[Case]:
        """Yield every case; equal plans yield equal cases in equal order. Raises ConfigError."""
        configs = cache(_configs)
        for name in self.sources:
            for case in source_of(name).cases(self.asked):
                beside = str(loads(case.body).get("where", "scenario.toml"))
                for variant, (plant, tables), (fault, more) in product(self.variants, self.plants, self.faults):
                    base, text = configs(case.robot, case.config, beside, variant.name, tuple(variant.changes.items()))
                    yield case._replace(
                        config=text,
                        base="" if base == text else base,
                        variant=variant.name,
                        plant=plant,
                        faults=fault,
                        changes=json.dumps({**tables, **more}, sort_keys=True),
                    )


def _configs(
    robot: str, given: str, beside: str, name: str, changes: tuple[tuple[tuple[str, ...], object], ...]
) -> tuple[str, str]:
    """Return the texts of a robot file as it is and with a variant's keys; both are checked once."""
    path = ready(robot, given).path if given else found(robot, Path(beside))
    base, text = text_of(path, Variant("", {})), text_of(path, Variant(name, dict(changes)))
    try:
        ready(Path(path).stem, text)
    except ConfigError as error:
        place = error.place.partition(": ")[2]
        raise ConfigError(f"{path}{f' with {name}' if name else ''}: {place}", error.got, error.wanted) from None
    return base, text


def named(path: str, key: str) -> tuple[tuple[str, Json], ...]:
    """Return the named plants or faults of a TOML file, ('', {}) where no file is given.

    key: the table of a scenario that each stands for. Raises ConfigError.
    """
    if not path:
        return (("", {}),)
    tables = parse(Path(path))
    for name, table in tables.items():
        convert({"robot": "any", "duration_s": 1.0, key: table}, Scenario, f"{path}: {name}")
    return tuple((name, {key: table}) for name, table in tables.items())

"""What a campaign is made of: cases, each of which says all that its run depends on; scenes; rows."""

import hashlib
import json
import os
import sys
from collections.abc import Iterator
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple, Protocol, cast

from rtctl.errors import UsageError
from rtctl.plain import Json

BUILT_IN = {"random": "rtctl.campaign.sources:random", "folder": "rtctl.campaign.sources:folder"}
_TOP = Path(__file__).parents[2]


class Case(NamedTuple):
    """One run, before it is one: small enough to be sent to a worker, which makes the scene itself."""

    source: str  # who makes the scene and plays it, MODULE:NAME
    robot: str
    config: str  # the text of the robot file
    seed: int
    number: int  # of the scene within its seed
    set: str = ""  # a part of the source: a folder's file, a benchmark's set
    base: str = ""  # the text before its keys were changed, which scenes are made for; '' where they were not
    variant: str = ""  # the keys of the config that were changed, for people
    plant: str = ""  # names of what stands in `changes`
    faults: str = ""
    changes: str = "{}"  # JSON: tables of the scenario that are replaced
    body: str = "{}"  # JSON: what the source needs beside

    @property
    def plain_config(self) -> str:
        """The text of the robot file that the scene is made for: the same scenes for all variants."""
        return self.base or self.config

    @property
    def key(self) -> str:
        """A name of the run that no other run has, and that it has on every machine."""
        return hashlib.blake2b(json.dumps(self, sort_keys=True).encode(), digest_size=8).hexdigest()


class Scene(NamedTuple):
    """What is played: the tables of a scenario file."""

    table: Json
    where: Path  # the file that relative paths are looked for beside
    reference_s: float | None = None  # what a certified way to the goal takes under the same limits
    certificate: list[list[float]] | None = None  # (k, n) [rad] that way
    tolerance: tuple[float, float] | None = None  # [m], [rad] within which the end counts, None: the goal's own


class Asked(NamedTuple):
    """What the command line asks of a source of cases."""

    robots: tuple[str, ...]
    seeds: range
    scenes: int  # of all robots together, for each seed
    options: dict[str, str]


class Source(Protocol):
    """Where cases come from. `cases` is called by the client, the rest on workers."""

    def cases(self, asked: Asked) -> Iterator[Case]: ...  # `config` is filled in by the campaign where it is empty
    def scene(self, case: Case) -> Scene: ...
    def play(self, case: Case, scene: Scene, config: Path) -> Json: ...  # columns of the row


def source_of(name: str) -> Source:
    """Return the source of a name: `random`, `folder`, or MODULE:NAME of Python. Raises UsageError.

    MODULE is looked for in the current folder, too.
    """
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())
    module, _, attribute = BUILT_IN.get(name, name).partition(":")
    try:
        return cast(Source, getattr(import_module(module), attribute or "source"))
    except (ImportError, AttributeError) as error:
        known = ", ".join(BUILT_IN)
        raise UsageError(f"campaign: got {name} ({error}), wanted a folder, {known} or MODULE:NAME") from None


def options_within(asked: Asked, known: tuple[str, ...], who: str) -> dict[str, str]:
    """Return the options of a source. Raises UsageError for one that it does not know."""
    for name in asked.options:
        if name not in known:
            raise UsageError(f"campaign: option {name} of {who}: wanted one of {', '.join(known) or 'none'}")
    return asked.options


@cache
def code() -> str:
    """Return a fingerprint of the sources: rows of one code are not those of another."""
    found = hashlib.blake2b(digest_size=8)
    for room in ("rtctl", "firmware_sim", "tools"):
        for file in sorted((_TOP / room).rglob("*.py")):
            found.update(file.relative_to(_TOP).as_posix().encode() + file.read_bytes())
    return found.hexdigest()


def loads(text: str) -> Any:
    """Return the value of a JSON text."""
    return json.loads(text)

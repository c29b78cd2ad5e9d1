"""Keys of a joint changed in the text of a robot file, which keeps its comments and its shape.

A joint is an inline table, `{ name = "elbow", can_id = 3, ... }`, or a section `[[robot.joints]]`. That the new text
means what the old one did, and the new keys, is checked with a parser before it is given out.
"""

import re
import tomllib
from collections.abc import Iterator, Mapping
from typing import Any

from rtctl.errors import ConfigError

_TOKEN = re.compile(
    r'"""(?:\\.|[^\\])*?"""|\'\'\'.*?\'\'\'|"(?:\\.|[^"\\\n])*"|\'[^\'\n]*\'|#[^\n]*|[{}]|[^"\'#{}]+|.', re.DOTALL
)
_SECTION = re.compile(r"^[ \t]*\[\[[ \t]*robot[ \t]*\.[ \t]*joints[ \t]*\]\][^\n]*\n?", re.MULTILINE)
_HEADER = re.compile(r"^[ \t]*\[", re.MULTILINE)


def with_joint_keys(text: str, changes: Mapping[str, Mapping[str, Any]], source: str) -> str:
    """Return the text of a robot file with keys of joints set, by the joints' names; numbers, true and false.

    Raises ConfigError where the text is written in a way that this cannot edit.
    """
    wanted = tomllib.loads(text)
    for joint in wanted["robot"]["joints"]:
        joint |= changes.get(joint["name"], {})
    for name, keys in changes.items():
        for key, value in keys.items():
            text = _set(text, name, key, _written(value), source)
    if not _means(text, wanted):
        raise _unable(source)
    return text


def _means(text: str, wanted: object) -> bool:
    try:
        return tomllib.loads(text) == wanted
    except tomllib.TOMLDecodeError:
        return False


def _unable(source: str) -> ConfigError:
    wanted = 'joints written as { name = "...", ... } or as sections [[robot.joints]]'
    return ConfigError(f"{source}: robot.joints", "a file that cannot be edited in place", wanted)


def _written(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) else repr(value)


def _set(text: str, joint: str, key: str, value: str, source: str) -> str:
    """Return the text with one key of one joint set, where it stands or behind all others."""
    for start, end in (*_tables(text), *_sections(text)):
        part = text[start:end]
        if _name(part) != joint:
            continue
        place = _value_of(part, key)
        if place is not None:
            part = part[: place[0]] + value + part[place[1] :]
        elif part.startswith("{"):
            inside = part[:-1].rstrip()
            comma = "" if inside.endswith(("{", ",")) else ","
            part = f"{inside}{comma} {key} = {value}{part[len(inside) : -1]}}}"
        else:
            can_id = _value_of(part, "can_id")
            at = part.find("\n", 0 if can_id is None else can_id[1])
            at = len(part) if at < 0 else at
            part = f"{part[:at]}\n{key} = {value}{part[at:]}"
        return text[:start] + part + text[end:]
    raise _unable(source)


def _tables(text: str) -> Iterator[tuple[int, int]]:
    """Yield where the inline tables that hold no other are, each with its braces."""
    start = -1
    for token in _TOKEN.finditer(text):
        if token[0] == "{":
            start = token.start()
        elif token[0] == "}" and start >= 0:
            yield start, token.end()
            start = -1


def _sections(text: str) -> Iterator[tuple[int, int]]:
    """Yield where the sections of joints are, without their header."""
    for header in _SECTION.finditer(text):
        after = _HEADER.search(text, header.end())
        yield header.end(), len(text) if after is None else after.start()


def _name(part: str) -> str | None:
    """Return the name in a table's text that is a joint's."""
    try:
        table = tomllib.loads(f"x = {part}")["x"] if part.startswith("{") else tomllib.loads(part)
    except tomllib.TOMLDecodeError:
        return None
    return str(table.get("name")) if "can_id" in table else None


def _value_of(part: str, key: str) -> tuple[int, int] | None:
    """Return where the value of a key is in a table's text: a number, true or false."""
    found = re.compile(rf"(?:^|[{{,\s]){key}[ \t]*=[ \t]*([^\s,}}#]+)")
    for token in _TOKEN.finditer(part):
        if token[0][0] in "\"'#":
            part = part[: token.start()] + "\0" * len(token[0]) + part[token.end() :]
    match = found.search(part)
    return None if match is None else match.span(1)

"""TOML, or JSON already parsed, into checked structs; errors name file, path, what came and what was wanted."""

import math
import re
import tomllib
from datetime import date, time
from functools import cache
from pathlib import Path
from typing import Annotated, Any, TypeVar

import msgspec
from msgspec import inspect

from rtctl.errors import ConfigError
from rtctl.plain import Json
from rtctl.spell import close_to, nearest

T = TypeVar("T")
MAX_BYTES = 1 << 20  # a config is a page or two; anything larger is the wrong file

NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.+-]{0,63}")

DESCRIPTIONS = (".urdf", ".xacro", ".xml", ".mjcf", ".sdf")
UNITS = {  # by the ending of a key, the longest first
    "_Nm_s_rad": "Nm s/rad", "_Nms_rad": "Nm s/rad", "_Nm_rad": "Nm/rad", "_Nm_s": "Nm/s", "_rad_s2": "rad/s²",
    "_rad_s": "rad/s", "_m_s2": "m/s²", "_m_s": "m/s", "_deg": "deg", "_rad": "rad", "_kg": "kg", "_hz": "Hz",
    "_ms": "ms", "_us": "us", "_Nm": "Nm", "_MB": "MB", "_m": "m", "_s": "s",
}  # fmt: skip
TURN_MAX = 6.5  # [rad] what is more is no angle that anybody means in radians
TURNS_DEG = 3600.0  # [deg]

_ABSENT = object()


@cache
def type_info(kind: Any) -> Any:
    """Return msgspec's description of a type; to make one takes milliseconds."""
    return inspect.type_info(kind)


def parse(path: Path) -> Json:
    """Return the file's TOML as dicts and lists.

    Raises ConfigError naming the file, and line and column of a syntax error.
    """
    if path.suffix.lower() in DESCRIPTIONS and path.is_file():
        wanted = f"a TOML file, which rtctl init {path.name} writes"
        raise ConfigError(str(path), "a description of a robot's body", wanted)
    try:
        if path.stat().st_size > MAX_BYTES:
            raise ConfigError(str(path), f"{path.stat().st_size} bytes", f"at most {MAX_BYTES}")
        text = path.read_bytes().decode("utf-8")
    except OSError as error:
        raise ConfigError(str(path), (error.strerror or "an unreadable file").lower(), _readable(path)) from None
    except UnicodeDecodeError as error:
        raise ConfigError(str(path), f"byte {error.object[error.start]:#04x} at {error.start}", "UTF-8 text") from None
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        what, _, where = str(error).partition(" (at ")
        line = where.rstrip(")").replace("end of document", f"line {len(text.splitlines())}, the end")
        raise ConfigError(f"{path}: {line}", f"a syntax error ({what[:1].lower()}{what[1:]})", "TOML") from None
    except (ValueError, RecursionError):  # an integer of thousands of digits, a list nested thousands deep
        raise ConfigError(str(path), "a number too long or a nesting too deep to read", "TOML of a sane size") from None


def _readable(path: Path) -> str:
    """Return what was wanted in place of a file that cannot be read, and the one beside it that is called alike."""
    wanted = "a readable TOML file"
    if path.suffix.lower() in DESCRIPTIONS:
        return f"{wanted}, which rtctl init {path.name} writes"
    try:
        alike = close_to(path.name, [each.name for each in path.parent.glob("*.toml")])
    except OSError:
        alike = ""
    return f"{wanted}; {path.with_name(alike)} is called alike" if alike else wanted


def read(path: Path, kind: Any) -> Any:
    """Return the file as a checked struct of `kind`."""
    data = parse(path)
    _refuse_other_kind(data, kind, str(path))
    return convert(data, kind, str(path))


def refuse_scenario(path: Path) -> None:
    """Refuse a scenario, or no TOML at all, where a robot's file is wanted. Raises ConfigError."""
    robot = parse(path).get("robot")
    if isinstance(robot, str):
        got = f"a name, {robot[:60]!r}: this file is a scenario"
        raise ConfigError(f"{path}: robot", got, "the file of a robot; rtctl sim plays a scenario")


def _refuse_other_kind(data: Json, kind: Any, source: str) -> None:
    """Refuse a scenario where a robot's file is wanted, and the other way round."""
    field = next((f.type for f in type_info(kind).fields if f.encode_name == "robot"), None)
    robot = data.get("robot")
    if field is None:
        return
    if isinstance(field, inspect.StructType) and isinstance(robot, str) and data.keys() & {"duration_s", "goal"}:
        got = f"a name, {robot[:60]!r}: this file is a scenario"
        raise ConfigError(f"{source}: robot", got, "the file of a robot; rtctl sim plays a scenario")
    if not isinstance(field, inspect.StructType) and isinstance(robot, dict) and data.keys() & {"link", "motion"}:
        got = "a table: this file describes a robot"
        raise ConfigError(f"{source}: robot", got, f"a scenario, which names its robot: robot = {Path(source).stem!r}")


def convert(data: object, kind: Any, source: str) -> Any:
    """Return `data` as a checked `kind`; raises ConfigError whose place is `source: path.inside[3].it`."""
    _refuse_odd_names(data, source, "")
    try:
        return msgspec.convert(data, kind)
    except msgspec.ValidationError as error:
        message, _, where = str(error).partition(" - at `")
    raise _explain(data, kind, source, message, where.rstrip("`"))


def _refuse_odd_names(data: object, source: str, path: str) -> None:
    """Refuse a name that no table has, before it gets into a message: line breaks, quotes, a page of text."""
    if isinstance(data, dict):
        for key, value in data.items():
            if not NAME.fullmatch(key):
                raise ConfigError(name_place(source, path), f"the name {_show(key)}", "names of letters, digits, _.+-")
            _refuse_odd_names(value, source, f"{path}.{key}")
    elif isinstance(data, list):
        for i, value in enumerate(data):
            _refuse_odd_names(value, source, f"{path}[{i}]")


def name_place(source: str, path: str) -> str:
    """Return the place of a path inside a source as every error writes it."""
    return f"{source}: {path.lstrip('.')}" if path else source


def _explain(data: object, kind: Any, source: str, message: str, where: str) -> ConfigError:
    """Return msgspec's complaint in our words: the value that came, and everything its place accepts."""
    keys = re.findall(r"\.([^.\[\]]+)|\[(\d+|\.\.\.)\]", where)
    path, unit, node = "", "", type_info(kind)
    value: Any = data
    for name, index in keys:
        key: Any = name or (int(index) if index != "..." else _culprit(value, node))
        path += f".{key}" if isinstance(key, str) else f"[{key}]"
        unit = unit_of(key) if isinstance(key, str) else unit
        node = _inside(node, value, key)
        value = value[key] if isinstance(value, list) or key in value else _ABSENT
    if where.startswith("key"):  # the only names that users invent are those of drives
        return ConfigError(name_place(source, path), f"names {', '.join(value)}", describe(_key(node)))
    named = re.search(r"(missing required|unknown) field `(.*?)`", message)
    if named is None:
        return ConfigError(name_place(source, path), _show(value) + _degrees(value, unit), _wanted(value, node, unit))
    table = _table(node, value)
    place = name_place(source, f"{path}.{named[2]}")
    fields = {f.encode_name: f.type for f in table.fields}
    if table.tag_field:
        fields = {str(table.tag_field): _tags(node)} | fields
    if named[1] != "unknown":
        return ConfigError(place, "nothing", _wanted(None, fields[named[2]], unit_of(named[2])))
    return ConfigError(place, "an unknown name", nearest(named[2], fields))


def unit_of(key: str) -> str:
    """Return the unit that a key's ending names, '' for none."""
    return next((unit for ending, unit in UNITS.items() if key.endswith(ending)), "")


def _degrees(value: object, unit: str) -> str:
    """Return that an angle looks like degrees, '' where it does not."""
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if not number or unit not in ("rad", "rad/s") or not TURN_MAX < abs(float(str(value))) <= TURNS_DEG:
        return ""
    radians = math.radians(float(str(value)))
    return f" (which looks like degrees: {value:g} deg{unit[3:]} is {radians:.4f} {unit})"


def _wanted(value: object, node: inspect.Type, unit: str) -> str:
    """Return what a place accepts: the nearest name for a name, and the unit of a number."""
    names = [str(v) for option in _plain(node) if isinstance(option, inspect.LiteralType) for v in option.values]
    if isinstance(value, str) and close_to(value, names):
        others = ", ".join(name for name in names if name != close_to(value, names))
        return nearest(value, names) + (f", or another of {others}" if others else "")
    text = describe(node)
    return f"{text} {unit}" if unit and re.search(r"number from \S+ to \S+$", text) else text


def _culprit(value: Any, node: inspect.Type) -> str:
    """Return the key of the first entry of a dict that does not convert; msgspec only says [...]."""
    entry = _plain(_member(node, inspect.DictType).value_type)[0]
    kind = entry.cls if isinstance(entry, inspect.StructType) else _number(entry)
    for key, item in value.items():
        try:
            msgspec.convert(item, kind)
        except msgspec.ValidationError:
            return str(key)
    raise AssertionError(f"no fault in {value}")


def _number(node: inspect.Type) -> Any:
    """Return the bounded number that a table's entries are."""
    assert isinstance(node, inspect.FloatType)
    return Annotated[float, msgspec.Meta(ge=node.ge, le=node.le)]


def _plain(node: inspect.Type) -> list[inspect.Type]:
    """Return the alternatives of a type, metadata peeled off and None left out."""
    if isinstance(node, inspect.Metadata):
        return _plain(node.type)
    if isinstance(node, inspect.UnionType):
        return [t for part in node.types for t in _plain(part) if not isinstance(t, inspect.NoneType)]
    return [node]


def _member(node: inspect.Type, kind: type[T]) -> T:
    return next(t for t in _plain(node) if isinstance(t, kind))


def _key(node: inspect.Type) -> inspect.Type:
    key: inspect.Type = _member(node, inspect.DictType).key_type
    return key


def _inside(node: inspect.Type, value: Any, key: Any) -> inspect.Type:
    """Return the type of what is at `key` inside a value of type `node`."""
    if isinstance(key, str):
        options = _plain(node)
        for option in options:
            if isinstance(option, inspect.DictType):
                inner: inspect.Type = option.value_type
                return inner
        table = _table(node, value)
        if key == table.tag_field:
            return _tags(node)
        fields: dict[str, inspect.Type] = {f.encode_name: f.type for f in table.fields}
        return fields[key]
    for option in _plain(node):
        if isinstance(option, inspect.TupleType):
            item: inspect.Type = option.item_types[key]
            return item
        if isinstance(option, inspect.VarTupleType):
            every: inspect.Type = option.item_type
            return every
    raise AssertionError(f"no list in {node}")


def _table(node: inspect.Type, value: Any) -> inspect.StructType:
    """Return the struct meant by a table: the one whose tag it carries where there are several."""
    tables = [t for t in _plain(node) if isinstance(t, inspect.StructType)]
    tag = value.get(tables[0].tag_field) if isinstance(value, dict) else None
    return next((t for t in tables if t.tag == tag), tables[0])


def _tags(node: inspect.Type) -> inspect.LiteralType:
    return inspect.LiteralType(tuple(str(t.tag) for t in _plain(node) if isinstance(t, inspect.StructType)))


def _show(value: object) -> str:
    """Return what came, short enough for one line."""
    if value is _ABSENT:
        return "nothing"
    if isinstance(value, dict):
        return "a table"
    if isinstance(value, bool):
        return str(value).lower()
    text = str(value) if isinstance(value, date | time) else repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def describe(node: inspect.Type) -> str:
    """Return in words everything a type accepts."""
    options = _plain(node)
    if all(isinstance(option, inspect.StructType) and option.tag_field for option in options):
        return f"a table whose type is {describe(_tags(node))}"
    return " or ".join(_describe(option) for option in options)


def _describe(node: inspect.Type) -> str:
    match node:
        case inspect.FloatType():
            return f"a number from {node.ge:g} to {node.le:g}"
        case inspect.IntType():
            return f"an integer from {node.ge} to {node.le}"
        case inspect.BoolType():
            return "true or false"
        case inspect.LiteralType():
            return f"one of {', '.join(str(v) for v in node.values)}"
        case inspect.StrType():
            what = "letters, digits, _.+-" if node.pattern else "characters"
            return f"a text of {node.min_length} to {node.max_length} {what}"
        case inspect.TupleType():
            return f"a list of {len(node.item_types)}, the first {describe(node.item_types[0])}"
        case inspect.VarTupleType():
            return f"a list of {node.min_length or 0} to {node.max_length}, each {describe(node.item_type)}"
        case inspect.StructType():
            return f"a table with {', '.join(f.encode_name for f in node.fields)}"
        case _:
            return "a table"

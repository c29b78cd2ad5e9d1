"""Every leaf of a struct tree and every way to break it, generated from the definitions themselves."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from msgspec import inspect

Path_ = tuple[str | int, ...]


class Leaf(NamedTuple):
    """A value of the tree: where it is, what its type says, and whether it may be absent."""

    path: Path_
    node: inspect.Type
    required: bool
    either: bool = False  # an integer or a text will do


def dotted(path: Path_) -> str:
    """Return the path as an error names it."""
    return "".join(f"[{key}]" if isinstance(key, int) else f".{key}" for key in path).lstrip(".")


def alternatives(node: inspect.Type) -> list[inspect.Type]:
    """Return the alternatives of a type without None and without metadata."""
    if isinstance(node, inspect.Metadata):
        return alternatives(node.type)
    if isinstance(node, inspect.UnionType):
        return [a for part in node.types for a in alternatives(part) if not isinstance(a, inspect.NoneType)]
    return [node]


def bounds(node: inspect.FloatType | inspect.IntType) -> tuple[float, float]:
    """Return the least and the largest value of a number; every number must have both."""
    assert node.ge is not None, "a number without a lower bound"
    assert node.le is not None, "a number without an upper bound"
    return node.ge, node.le


def specimen(node: inspect.Type) -> Any:
    """Return a value that the type accepts, with every key of every table present."""
    options = alternatives(node)
    node = options[-1]  # of "auto" or a list, the list
    match node:
        case inspect.FloatType():
            return 0.5 * sum(bounds(node))
        case inspect.IntType():
            return int(bounds(node)[0]) + 1
        case inspect.BoolType():
            return True
        case inspect.StrType():
            return "x1"
        case inspect.LiteralType():
            return node.values[0]
        case inspect.TupleType():
            return [specimen(item) for item in node.item_types]
        case inspect.VarTupleType():
            kinds = alternatives(node.item_type)
            return [specimen(kind) for kind in kinds]  # one of each kind of obstacle
        case inspect.DictType():
            return {"x1": specimen(node.value_type)}
        case inspect.StructType():
            table = {f.encode_name: specimen(f.type) for f in node.fields}
            return {str(node.tag_field): node.tag} | table if node.tag_field else table
        case _:
            raise AssertionError(f"a type the mutations do not know: {node}")


def leaves(
    node: inspect.Type, value: Any, path: Path_ = (), required: bool = True, seen: frozenset[str] = frozenset()
) -> Iterator[Leaf]:
    """Yield the leaves of a specimen, lists and tables themselves included.

    Once each: of a vector the first of equal coordinates, of kinds of obstacle the keys that none before has (`seen`).
    """
    for option in alternatives(node):
        match option:
            case inspect.StructType() if not option.tag_field or option.tag == value[option.tag_field]:
                yield Leaf(path, option, required)
                for f in option.fields:
                    if repr(f) not in seen:
                        yield from leaves(f.type, value[f.encode_name], (*path, f.encode_name), f.required)
            case inspect.StructType():
                continue
            case inspect.DictType():
                for key, item in value.items():
                    yield from leaves(option.value_type, item, (*path, key), False)
            case inspect.TupleType():
                yield Leaf(path, option, required)
                for i, item in enumerate(option.item_types):
                    if item not in option.item_types[:i]:
                        yield from leaves(item, value[i], (*path, i), False)
            case inspect.VarTupleType():
                yield Leaf(path, option, required)
                kinds = [k for k in alternatives(option.item_type) if isinstance(k, inspect.StructType)]
                for i, item in enumerate(value):
                    known = frozenset(repr(f) for k in kinds[:i] for f in k.fields)
                    yield from leaves(option.item_type, item, (*path, i), False, known)
            case inspect.LiteralType() if isinstance(value, list):
                continue  # the word that a list replaces
            case _:
                yield Leaf(path, option, required, len(alternatives(node)) > 1)


def broken(leaf: Leaf) -> Iterator[tuple[str, Any]]:
    """Yield (name of the mutation, value that must be refused) for a leaf."""
    for name, value in _broken(leaf.node):
        if not (leaf.either and name in ("text", "number")):
            yield name, value


def _broken(node: inspect.Type) -> Iterator[tuple[str, Any]]:
    yield "a date", Raw("1986-03-01")
    match node:
        case inspect.FloatType() | inspect.IntType():
            low, high = bounds(node)
            yield "text", "1.0"
            yield "bool", True
            yield "nan", float("nan")
            yield "inf", float("inf")
            yield "-inf", float("-inf")
            step = 1 if isinstance(node, inspect.IntType) else 1e-6 * max(1.0, abs(low), abs(high))
            yield "below", low - step
            yield "above", high + step
            yield "huge", Raw("1" + "0" * 400)
            if isinstance(node, inspect.IntType):
                yield "fraction", low + 0.5
        case inspect.StrType():
            yield "number", 3
            yield "empty", ""
            yield "long", "x" * (int(node.max_length or 0) + 1)
            if node.pattern:
                yield "odd characters", "a b;"
        case inspect.LiteralType():
            yield "another word", "nonsense"
            yield "number", 3
        case inspect.BoolType():
            yield "text", "yes"
            yield "number", 1
        case inspect.TupleType():
            yield "number", 1.0
            yield "short", [0.0] * (len(node.item_types) - 1)
            yield "long", [0.0] * (len(node.item_types) + 1)
        case inspect.VarTupleType():
            yield "table", {}
            if node.min_length:
                yield "short", []
        case inspect.StructType():
            yield "number", 1.0
            yield "list", []


class Raw(NamedTuple):
    """TOML as it stands."""

    text: str


def replaced(value: Any, path: Path_, new: Any) -> Any:
    """Return a copy of nested values with the one at `path` replaced; `...` removes it."""
    if not path:
        return new
    key, rest = path[0], path[1:]
    if isinstance(value, list):
        assert isinstance(key, int)
        return [*value[:key], replaced(value[key], rest, new), *value[key + 1 :]]
    copy = {k: replaced(v, rest, new) if k == key else v for k, v in value.items()}
    if key not in copy:
        copy[str(key)] = new
    if not rest and new is ...:
        del copy[str(key)]
    return copy


def toml(value: Any) -> str:
    """Return a value as inline TOML."""
    if isinstance(value, Raw):
        return value.text
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(k)} = {toml(v)}" for k, v in value.items() if v is not None) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(toml, value)) + "]"
    if isinstance(value, bool):
        return "true" if value else "false"
    return json.dumps(value) if isinstance(value, str) else repr(value)


def write(path: Path, document: dict[str, Any]) -> Path:
    """Write a document as TOML and return its path."""
    path.write_text("\n".join(f"{json.dumps(k)} = {toml(v)}" for k, v in document.items() if v is not None))
    return path

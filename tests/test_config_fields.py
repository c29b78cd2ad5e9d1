"""Catalogue row 37: any field missing, unknown, of a wrong type, nan, inf or out of bounds is refused by name.

Cases are generated from the struct definitions: a new key is broken in every way without being listed here, and one
without bounds fails.
"""

import difflib
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec import inspect

from rtctl import design
from rtctl.errors import EXIT_CONFIG, ConfigError
from rtctl.spec.read import convert
from rtctl.spec.scenario import Scenario, load_scenario
from tests.config_leaves import Leaf, alternatives, broken, dotted, leaves, replaced, specimen, write

Load = Callable[[Path], Any]
KINDS: tuple[tuple[str, Any, Load], ...] = (
    ("config", design.Config, design.load),
    ("scenario", Scenario, load_scenario),
)


def cases(name: str, kind: Any, load: Load) -> Iterator[Any]:
    """Yield each leaf with a document that has every required table and the one that holds the leaf."""
    info = inspect.type_info(kind)
    assert isinstance(info, inspect.StructType)
    full = specimen(info)
    required = {f.encode_name for f in info.fields if f.required}
    for leaf in leaves(info, full):
        wanted = required | set(leaf.path[:1])
        document = {key: value for key, value in full.items() if key in wanted}
        yield pytest.param(load, document, leaf, id=f"{name}:{dotted(leaf.path) or 'file'}")


CASES = [case for each in KINDS for case in cases(*each)]


def refusal(load: Load, path: Path, document: dict[str, Any]) -> ConfigError:
    """Return the refusal of a document; it is one line."""
    with pytest.raises(ConfigError) as caught:
        load(write(path, document))
    assert caught.value.exit_code == EXIT_CONFIG == 78
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 1000
    return caught.value


@pytest.mark.parametrize(("load", "document", "leaf"), CASES)
def test_each_field_broken_in_each_way_is_refused_by_name(
    load: Load, document: dict[str, Any], leaf: Leaf, tmp_path: Path
) -> None:
    file = tmp_path / "robot.toml"
    for name, value in broken(leaf):
        if not leaf.path:
            continue  # the document itself is always a table in TOML
        error = refusal(load, file, replaced(document, leaf.path, value))
        assert error.place.startswith(f"{file}: {dotted(leaf.path)}"), (name, error)
    if leaf.required and leaf.path and isinstance(leaf.path[-1], str):
        error = refusal(load, file, replaced(document, leaf.path, ...))
        assert (error.place, error.got) == (f"{file}: {dotted(leaf.path)}", "nothing")
    if isinstance(leaf.node, inspect.StructType):
        for field in leaf.node.fields:
            typo = f"{field.encode_name}x"
            error = refusal(load, file, replaced(document, (*leaf.path, typo), 1.0))
            assert error.place == f"{file}: {dotted((*leaf.path, typo))}"
            assert field.encode_name in error.wanted


def test_an_unknown_key_is_answered_with_the_nearest_valid_name(tmp_path: Path) -> None:
    document = specimen(inspect.type_info(design.Config))
    error = refusal(design.load, tmp_path / "r.toml", replaced(document, ("motion", "vmax_m_s"), 0.5))
    assert error.wanted.startswith("v_max_m_s")
    assert difflib.SequenceMatcher(None, "vmax_m_s", error.wanted.split()[0]).ratio() > 0.8


@pytest.mark.parametrize("kind", [kind for _, kind, _ in KINDS])
def test_every_number_has_both_bounds_and_every_text_and_list_a_largest_length(kind: Any) -> None:
    def visit(node: inspect.Type, path: str) -> None:
        for option in alternatives(node):
            match option:
                case inspect.FloatType() | inspect.IntType():
                    assert None not in (option.ge, option.le), path
                    assert (option.gt, option.lt) == (None, None), path
                case inspect.StrType():
                    assert None not in (option.min_length, option.max_length), path
                case inspect.VarTupleType():
                    assert option.max_length is not None, path
                    visit(option.item_type, f"{path}[]")
                case inspect.TupleType():
                    for item in option.item_types:
                        visit(item, f"{path}[]")
                case inspect.DictType():
                    assert option.max_length is not None, path
                    visit(option.key_type, f"{path} key")
                    visit(option.value_type, f"{path}.*")
                case inspect.StructType():
                    assert option.forbid_unknown_fields, path
                    assert option.cls.__struct_config__.frozen, path
                    for f in option.fields:
                        visit(f.type, f"{path}.{f.encode_name}")

    visit(inspect.type_info(kind), "")


@pytest.mark.parametrize(
    ("content", "place", "got"),
    [
        (b"[robot]\nname = \n", "line 2, column 8", "invalid value"),
        (b"a = 1\na = 2\n", "line 2, column 6", "cannot overwrite a value"),
        (b"\xff\xfe", "", "byte 0xff at 0"),
        (b"a = " + b"[" * 5000, "", "too deep"),
        (b"a = " + b"9" * 5000, "", "too long"),
        (b"x" * (1 << 20) + b"x", "", "1048577 bytes"),
        (b"", "robot", "nothing"),
    ],
)
def test_a_file_that_is_no_config_is_refused_with_its_place(
    content: bytes, place: str, got: str, tmp_path: Path
) -> None:
    file = tmp_path / "bad.toml"
    file.write_bytes(content)
    with pytest.raises(ConfigError) as caught:
        design.load(file)
    assert str(caught.value).startswith(str(file))
    assert place in caught.value.place
    assert got in str(caught.value.got)
    assert "\n" not in str(caught.value)


def test_a_file_that_cannot_be_read_is_refused(tmp_path: Path) -> None:
    for path in (tmp_path / "absent.toml", tmp_path):
        with pytest.raises(ConfigError, match="wanted a readable TOML file"):
            design.load(path)


@pytest.mark.parametrize(
    ("table", "place", "got"),
    [
        ({"a\nb": {}}, "drives", r"the name 'a\nb'"),
        ({"x - at `$.q`": {}}, "drives", "the name 'x - at `$.q`'"),
        ({"": {}}, "drives", "the name ''"),
        ({"x" * 40: {"p_max_rad": 1.0, "v_max_rad_s": 1.0, "t_max_Nm": 1.0}}, "drives", "names " + "x" * 40),
        ({"DM.1": {"p_max_rad": 1.0, "v_max_rad_s": 1.0}}, "drives.DM.1.t_max_Nm", "nothing"),
    ],
)
def test_a_name_that_no_drive_can_have_is_refused(table: dict[str, Any], place: str, got: str, tmp_path: Path) -> None:
    document = {**specimen(inspect.type_info(design.Config)), "drives": table}
    error = refusal(design.load, tmp_path / "robot.toml", document)
    assert (error.place, error.got) == (f"{tmp_path / 'robot.toml'}: {place}", got)


JUNK = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=40),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3),
    max_leaves=6,
)
PLACES = [leaf.path for leaf in leaves(inspect.type_info(design.Config), specimen(inspect.type_info(design.Config)))]


@settings(max_examples=150, deadline=None)
@given(st.sampled_from(PLACES), st.text(max_size=12) | st.none(), JUNK)
def test_whatever_stands_in_a_table_the_answer_is_a_struct_or_one_line(path: Any, name: str | None, junk: Any) -> None:
    where = path if name is None or (path and isinstance(path[-1], int)) else (*path[:-1], name)
    document = replaced(specimen(inspect.type_info(design.Config)), where, junk)
    refused = None
    try:
        convert(document, design.Config, "robot.toml")
    except ConfigError as error:
        refused = error
    assert refused is None or ("\n" not in str(refused) and refused.place.startswith("robot.toml"))


def test_the_schema_shipped_for_editors_is_the_one_of_the_structs() -> None:
    shipped = Path(__file__).parents[1] / "configs" / "schema.json"
    assert json.loads(shipped.read_text()) == design.json_schema()

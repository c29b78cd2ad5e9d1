"""The structure of the program, read from its own source: no circle, short parameter lists, few untyped values."""

import ast
import re
import tokenize
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent


def modules(package: str) -> dict[str, Path]:
    """Return the modules of a package by their dotted names."""
    found = {}
    for path in sorted((ROOT / package).rglob("*.py")):
        name = ".".join(path.relative_to(ROOT).with_suffix("").parts)
        found[name.removesuffix(".__init__")] = path
    return found


def imports(known: dict[str, Path], name: str) -> set[str]:
    """Return which known modules a module imports: at the top, in a function, or for type checkers alone."""
    found = set()
    for node in ast.walk(ast.parse(known[name].read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module and not node.level:
            for alias in node.names:
                whole = f"{node.module}.{alias.name}"
                found.add(whole if whole in known else node.module)
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
    return found & set(known) - {name}


def circles(graph: dict[str, set[str]]) -> list[list[str]]:
    """Return every group of modules that reach each other (Tarjan's strongly connected components of more than one)."""
    order: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found: list[list[str]] = []

    def visit(node: str) -> None:
        order[node] = low[node] = len(order)
        stack.append(node)
        for other in sorted(graph[node]):
            if other not in order:
                visit(other)
                low[node] = min(low[node], low[other])
            elif other in stack:
                low[node] = min(low[node], order[other])
        if low[node] == order[node]:
            group = stack[stack.index(node) :]
            del stack[stack.index(node) :]
            if len(group) > 1:
                found.append(sorted(group))

    for node in sorted(graph):
        if node not in order:
            visit(node)
    return found


def test_a_circle_is_found():
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}}) == [["a", "b", "c"]]


@pytest.mark.parametrize("package", ["rtctl", "firmware_sim"])
def test_no_circle_is_hidden_in_a_function_or_from_type_checkers(package):
    known = modules(package)
    assert circles({name: imports(known, name) for name in known}) == []


def walks() -> dict[str, list[tuple[str, str]]]:
    """Return the walks of ARCHITECTURE.md: heading -> (file, function) of each step."""
    text = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8")
    part = text.split("## Three walks", 1)[1].split("\n## ", 1)[0]
    found = {}
    for section in part.split("\n### ")[1:]:
        heading, _, body = section.partition("\n")
        found[heading] = re.findall(r"`([\w/]+\.py):(\w+)`", body)
    return found


@pytest.mark.parametrize(("heading", "steps"), walks().items())
def test_every_step_of_a_walk_exists(heading, steps):
    assert len(steps) >= 5, heading
    for file, function in steps:
        tree = ast.parse((ROOT / file).read_text(encoding="utf-8"))
        defined = {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}
        assert function in defined, f"{file}:{function}"


def test_there_are_three_and_a_frame_needs_at_most_twelve_files():
    assert len(walks()) == 3
    assert len({file for file, _ in walks()["A CAN frame becomes a torque"]}) <= 12


def test_the_map_names_every_room():
    text = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8")
    for path in sorted((ROOT / "rtctl").iterdir()):
        if path.is_dir() and (path / "__init__.py").exists():
            assert f"`rtctl/{path.name}/`" in text, path.name


PARAMETERS_MAX, ANY_MAX, SKIP_MAX = 9, 120, 15


def crowded(source: str) -> list[str]:
    """Return the functions, nested ones and lambdas included, that take more than PARAMETERS_MAX, `self` counted."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            a = node.args
            if len([*a.posonlyargs, *a.args, *a.kwonlyargs]) > PARAMETERS_MAX:
                found.append(f"{getattr(node, 'name', 'lambda')}:{node.lineno}")
    return found


def tokens(path: Path) -> list[tokenize.TokenInfo]:
    with path.open("rb") as file:
        return list(tokenize.tokenize(file.readline))


def test_a_long_parameter_list_is_found():
    nine, ten = (", ".join(f"p{i}" for i in range(n)) for n in (9, 10))
    assert crowded(f"def f({nine}): ...\nclass A:\n  def g(self, {nine}): ...\nasync def h(*, {ten}): ...") == [
        "h:4",
        "g:3",
    ]


def test_no_function_takes_more_than_nine_parameters():
    found = {name: crowded(path.read_text(encoding="utf-8")) for name, path in modules("rtctl").items()}
    assert {name: functions for name, functions in found.items() if functions} == {}


def test_any_stands_only_where_no_type_says_more():
    used = {name: sum(t.string == "Any" for t in tokens(path)) for name, path in modules("rtctl").items()}
    assert sum(used.values()) <= ANY_MAX, sorted((n, name) for name, n in used.items() if n)


def test_the_formatter_is_switched_off_for_tables_alone():
    rooms = ("rtctl", "firmware_sim", "tools", "tests")
    files = [path for room in rooms for path in modules(room).values()]
    comments = [t.string for path in files for t in tokens(path) if t.type == tokenize.COMMENT]
    assert sum(bool(re.search("fmt: (skip|off)", text)) for text in comments) <= SKIP_MAX

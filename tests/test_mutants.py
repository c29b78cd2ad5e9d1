"""The mutation tool: what it changes, and that it finds what a test does not notice."""

import ast
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tools.mutants.__main__ import ROOT, TARGETS, equals
from tools.mutants.change import mutants


def changes(source: str) -> set[tuple[str, str]]:
    return {(m.was, m.becomes) for m in mutants(source)}


@pytest.mark.parametrize(
    ("source", "was", "becomes"),
    [
        ("def f(x):\n    return x < 1", "x < 1", "(x <= 1)"),
        ("def f(x):\n    return x < 1", "x < 1", "(x >= 1)"),
        ("def f(x):\n    return x < 1", "1", "(2)"),
        ("def f(x):\n    return x < 1", "1", "(0)"),
        ("def f(x):\n    return -x", "-x", "(x)"),
        ("def f(x):\n    return x - 2", "x - 2", "(x + 2)"),
        ("def f(x, y):\n    return x and not y", "x and not y", "(x or not y)"),
        ("def f(x, y):\n    return x and not y", "not y", "(y)"),
        ("def f(x):\n    if x:\n        return 1", "x", "(not (x))"),
        ("def f(x):\n    x.y = 'é'; x.z()", "x.z()", "pass"),
        ("def f(x):\n    x += 1.5", "x += 1.5", "x -= 1.5"),
        ("def f(x):\n    return max(x, 0)", "max(x, 0)", "(min(x, 0))"),
        ("T = {A: 1, B: 2}", "A: 1,", ""),
        ("T = (R(1), R(2))", "R(2)", ""),
        ("A, B = R(1), R(2)\nC = 3", "R(2)", ""),  # and what comes next stays a line of its own
    ],
)
def test_every_kind_of_change_is_made(source: str, was: str, becomes: str):
    assert (was, becomes) in changes(source)


def test_words_types_and_what_is_told_are_left_alone():
    assert changes('"""Text."""\nx: "list[1]"\n\n\ndef f(n: int) -> "a[1]":\n    """Text."""\n') == set()
    assert ("1", "(2)") not in changes("def f(x):\n    return f'{x:1} {1}'")


@pytest.mark.parametrize("target", TARGETS, ids=lambda t: t.file)
def test_every_change_is_a_program_and_has_a_name_of_its_own(target):
    source = (ROOT / target.file).read_text(encoding="utf-8")
    made = mutants(source)
    assert len({m.key for m in made}) == len(made) > 40
    for mutant in made:
        ast.parse(mutant.applied(source))
    listed = [row for row in equals() if row.module == target.file]
    for row in listed:
        assert any(row.is_of(target.file, m) for m in made), row
        assert len(row.why) > 10


MODULE = """TOP = 3
KINDS = {"a": 1, "b": 2}


def clipped(x):
    if x > TOP:
        return TOP
    return x


def unused(x):
    return x + 1
"""
TESTS = """from clip import KINDS, clipped


def test_it():
    assert [clipped(1), clipped(5)] == [1, 3]
    assert KINDS["a"] == 1
"""
RUN = """import json, pathlib, sys
from tools.mutants.change import mutants
from tools.mutants.session import Job, run
folder = pathlib.Path(sys.argv[1])
source = (folder / "clip.py").read_text()
trials = run(Job(folder / "clip.py", source, mutants(source), folder / "known.jsonl", 2, print), [str(folder)])
told = [[m.scope, m.was, m.becomes] for m in trials.survivors]
(folder / "told.json").write_text(json.dumps([trials.trouble, told]))
"""


def test_what_no_test_notices_survives_and_all_else_is_killed(tmp_path: Path):
    (tmp_path / "clip.py").write_text(MODULE)
    (tmp_path / "test_clip.py").write_text(TESTS)
    (tmp_path / "pytest.ini").write_text(f"[pytest]\npythonpath = {tmp_path}\n")

    def survivors() -> list[list[str]]:
        command = [sys.executable, "-c", RUN, str(tmp_path)]
        done = subprocess.run(command, cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True)
        assert done.returncode == 0, done.stderr.decode()
        trouble, told = json.loads((tmp_path / "told.json").read_text())
        assert trouble == ""
        return sorted(told)

    wanted = [
        ["", '"b": 2', ""],
        ["", "2", "(1)"],
        ["", "2", "(3)"],
        ["clipped", "x > TOP", "(x >= TOP)"],
        ["unused", "1", "(0)"],
        ["unused", "1", "(2)"],
        ["unused", "return x + 1", "pass"],
        ["unused", "x + 1", "(x - 1)"],
    ]
    assert survivors() == wanted
    before = len((tmp_path / "known.jsonl").read_text().splitlines())
    assert survivors() == wanted  # those that were killed are not made again
    assert len((tmp_path / "known.jsonl").read_text().splitlines()) == before + len(wanted)

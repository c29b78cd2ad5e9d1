"""README and the pages of docs say what the program does."""

import hashlib
import json
import re
from importlib import util
from pathlib import Path

import pytest

from rtctl.cli import main
from tools import arms, site
from tools.faults import PAGES, with_table

ROOT = Path(__file__).parents[1]
TOP = [ROOT / name for name in ("README.md", "ARCHITECTURE.md", "CONTRIBUTING.md", "SECURITY.md", "CHANGELOG.md")]
DOCUMENTS = [*TOP, *sorted((ROOT / "docs").glob("*.md"))]
HOME = ROOT / "docs" / "index.md"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_the_fault_tables_are_those_the_program_has(page):
    text = page.read_text(encoding="utf-8")
    assert text == with_table(text), "run: python -m tools.faults --write"
    assert "| fault |" in text


@pytest.mark.parametrize("page", DOCUMENTS, ids=lambda page: page.name)
def test_every_file_it_links_to_is_there(page):
    for target in re.findall(r"\]\(([^)#]+)\)", page.read_text(encoding="utf-8")):
        assert target.startswith("https://") or (page.parent / target).exists(), target


@pytest.mark.parametrize("page", DOCUMENTS, ids=lambda page: page.name)
def test_every_page_is_reached_from_the_readme(page):
    linked = re.findall(r"\]\(([^)#]+)\)", DOCUMENTS[0].read_text(encoding="utf-8"))
    shown = {ROOT / "docs" / "rates.md", HOME}  # by the page of the experiments; by the site
    assert page == DOCUMENTS[0] or page in shown or page in {ROOT / target for target in linked}


def test_the_readme_is_a_page():
    text = DOCUMENTS[0].read_text(encoding="utf-8")
    assert len(text.split()) < 900
    assert max(map(len, text.splitlines())) < 400  # a row of a table


def test_the_site_shows_every_page():
    nav = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    for page in (ROOT / "docs").glob("*.md"):
        assert f": {page.name}\n" in nav, page.name


@pytest.mark.parametrize("page", DOCUMENTS, ids=lambda page: page.name)
def test_every_module_and_tool_they_run_is_there(page):
    for name in re.findall(r"python -m ((?:tools|firmware_sim|rtctl)[\w.]*)", page.read_text(encoding="utf-8")):
        assert util.find_spec(name) is not None, name


def test_the_equations_become_mathml():
    """Of the page that has them, by the hook that the site is built with."""
    text = site.on_page_markdown((ROOT / "docs" / "concepts.md").read_text(encoding="utf-8"))
    assert text.count("<math") >= 10
    assert "$$" not in text
    assert "\\(" not in text


def test_every_command_they_show_exists(capsys):
    text = "\n".join(page.read_text(encoding="utf-8") for page in DOCUMENTS)
    shown = set(re.findall(r"^ {4,}(?:\.venv/bin/)?rtctl (\w+)", text, re.M))
    assert {"check", "run", "arm", "goal", "sim", "log", "plan", "experiment"} <= shown
    for verb in shown:
        with pytest.raises(SystemExit) as stop:
            main([verb, "--help"])
        assert stop.value.code == 0, verb
    assert "usage" in capsys.readouterr().out


def test_captions_name_the_numbers_of_their_own_pictures():
    """Of the run that is drawn, as `make pictures` wrote them down beside the picture."""
    notes = json.loads((ROOT / "docs" / "pictures.json").read_text(encoding="utf-8"))
    pages = {page: page.read_text(encoding="utf-8") for page in DOCUMENTS}
    assert set(notes) == {path.name for path in (ROOT / "docs").glob("*.png")}
    for name, note in notes.items():
        picture = (ROOT / "docs" / name).read_bytes()
        assert hashlib.sha256(picture).hexdigest() == note["sha256"], f"{name} is not the picture of these numbers"
        captions = [
            " ".join(caption.split())
            for text in pages.values()
            for caption in re.findall(rf"!\[([^\]]*)\]\((?:docs/)?{re.escape(name)}\)", text)
        ]
        assert captions, f"{name} is not shown"
        for caption in captions:
            assert all(phrase in caption for phrase in note["says"]) or not re.search(r"\d", caption), (name, note)
        said = " ".join(captions)
        assert all(phrase in said for phrase in note["says"]), (name, note["says"])


def test_the_table_of_arms_is_of_the_arms_that_the_tool_takes():
    rows = [arms.cells(row) for row in arms.PAGE.read_text(encoding="utf-8").splitlines() if row.startswith("| ")][1:]
    names = [case.name for case in arms.CASES]
    assert [row[0] for row in rows] == [name for name in names if name in {row[0] for row in rows}]
    assert all(len(row) == 11 for row in rows)
    reached = [row for row in rows if row[8:10] == ["2 of 2", "0"] and int(row[10]) > 0]
    assert len(reached) >= 25
    assert f"{len(reached)} of {len(rows)} arms" in arms.PAGE.read_text(encoding="utf-8")
    for row in rows:
        assert row[4] or row in reached, row[0]  # what did not work says why

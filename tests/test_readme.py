"""README and the pages of docs say what the program does."""

import re
from pathlib import Path

import pytest

from rtctl.cli import main
from tools.faults import PAGES, with_table

ROOT = Path(__file__).parents[1]
DOCUMENTS = [ROOT / "README.md", ROOT / "ARCHITECTURE.md", *sorted((ROOT / "docs").glob("*.md"))]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_the_fault_tables_are_those_the_program_has(page):
    text = page.read_text(encoding="utf-8")
    assert text == with_table(text), "run: python -m tools.faults --write"
    assert "| fault |" in text


@pytest.mark.parametrize("page", DOCUMENTS, ids=lambda page: page.name)
def test_every_file_it_links_to_is_there(page):
    for target in re.findall(r"\]\(([^)#]+)\)", page.read_text(encoding="utf-8")):
        assert (page.parent / target).exists(), target


@pytest.mark.parametrize("page", DOCUMENTS, ids=lambda page: page.name)
def test_every_page_is_reached_from_the_readme(page):
    linked = re.findall(r"\]\(([^)#]+)\)", DOCUMENTS[0].read_text(encoding="utf-8"))
    tables = {ROOT / "docs" / "rates.md"}  # shown by the page of the experiments
    assert page == DOCUMENTS[0] or page in tables or page in {ROOT / target for target in linked}


def test_every_command_they_show_exists(capsys):
    text = "\n".join(page.read_text(encoding="utf-8") for page in DOCUMENTS)
    shown = set(re.findall(r"^ +rtctl (\w+)", text, re.M))
    assert {"check", "run", "arm", "goal", "sim", "log", "plan", "experiment"} <= shown
    for verb in shown:
        with pytest.raises(SystemExit) as stop:
            main([verb, "--help"])
        assert stop.value.code == 0, verb
    assert "usage" in capsys.readouterr().out

"""README says what the program does."""

import re
from pathlib import Path

import pytest

from rtctl.cli import main
from tools.faults import README, with_table

ROOT = Path(__file__).parents[1]


def test_the_fault_table_is_the_one_the_program_has():
    text = README.read_text(encoding="utf-8")
    assert text == with_table(text), "run: python -m tools.faults --write"


def test_every_file_it_links_to_is_there():
    for target in re.findall(r"\]\(([^)#]+)\)", README.read_text(encoding="utf-8")):
        assert (ROOT / target).exists(), target


def test_every_command_it_shows_exists(capsys):
    shown = set(re.findall(r"^ +rtctl (\w+)", README.read_text(encoding="utf-8"), re.M))
    assert {"check", "run", "arm", "goal", "sim"} <= shown
    for verb in shown:
        with pytest.raises(SystemExit) as stop:
            main([verb, "--help"])
        assert stop.value.code == 0, verb
    assert "usage" in capsys.readouterr().out

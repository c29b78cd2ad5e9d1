"""A hundred natural mistakes: one line each, in one form, and the page of docs is what is said."""

import re

import pytest

from tools.mistakes import MISTAKES, PAGE, Answer, Mistake, answers, page

RAW = ("Traceback", "$.", "Errno", "Object contains", "Expected `", "Invalid value", "argument ", "NoneType", "<class")


@pytest.fixture(scope="module")
def found() -> list[tuple[Mistake, Answer]]:
    return answers()


def test_there_are_a_hundred_of_them_and_no_two_alike() -> None:
    assert len(MISTAKES) >= 100
    assert len({(m.words, m.files, m.message) for m in MISTAKES}) == len(MISTAKES)


def test_each_is_one_line_that_names_what_came_and_what_was_wanted(found: list[tuple[Mistake, Answer]]) -> None:
    for mistake, said in found:
        assert said.text, mistake
        assert "\n" not in said.text, (mistake, said)
        assert said.code in ((0,) if mistake.message else (1, 2, 78)), (mistake, said)
        assert not [raw for raw in RAW if raw in said.text], (mistake, said)
        assert re.search(r"\bgot\b.*\bwanted\b", said.text) or "no daemon" in said.text, (mistake, said)


def test_the_page_is_what_is_said(found: list[tuple[Mistake, Answer]]) -> None:
    assert PAGE.read_text(encoding="utf-8") == page(found), "run: python -m tools.mistakes --write"

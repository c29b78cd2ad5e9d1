"""What a newcomer types (`python -m tools.tutorial`) is what stands in the tutorial."""

from tools.tutorial import PAGE, ready_word, steps

TEXT = """# Title

    no step yet

## 1. First

Words.

    one
    two

More words
    that are no command.

## And then

    nothing

## 2. Second

    rtctl run arm.toml
    rtctl arm
"""


def test_commands_are_the_indented_lines_of_numbered_sections():
    assert [(step.title, step.commands) for step in steps(TEXT)] == [
        ("1. First", ["one", "two"]),
        ("2. Second", ["rtctl run arm.toml", "rtctl arm"]),
    ]


def test_commands_that_do_not_end_are_told_from_others():
    found = [step.commands for step in steps(PAGE.read_text(encoding="utf-8"))]
    lasting = [command for commands in found for command in commands if ready_word(command)]
    assert [command.split()[:2] for command in lasting] == [
        ["rtctl", "sim"],
        ["python", "-m"],
        ["rtctl", "run"],
        ["rtctl", "view"],
        ["rtctl", "view"],
        ["rtctl", "sim"],
    ]
    assert found[-1][0] == "rtctl init my_arm.urdf"

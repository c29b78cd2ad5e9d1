"""What a newcomer types (`python -m tools.tutorial`) is what stands in the tutorial."""

from tools.tutorial import PAGE, lockstep, ready_word, steps

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
        ["rtctl", "sim"],
        ["python", "-m"],
        ["rtctl", "run"],
        ["rtctl", "view"],
        ["rtctl", "view"],
    ]
    assert found[2][0] == "rtctl init my_arm.urdf"


def test_on_a_busy_machine_drives_and_daemon_are_started_in_lockstep():
    commands = next(step.commands for step in steps(PAGE.read_text(encoding="utf-8")) if "real robot" in step.title)
    assert [lockstep(command) for command in commands[:3]] == [
        "python -m firmware_sim configs/panda.toml --lockstep",
        "rtctl run configs/panda.toml --lockstep",
        "rtctl view",
    ]
    assert [lockstep(command) for command in commands[3:]] == commands[3:]
    assert "`--lockstep`" in PAGE.read_text(encoding="utf-8")

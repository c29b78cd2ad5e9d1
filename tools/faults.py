"""Print the fault table of README.md from the program's own: `python -m tools.faults [--write]`."""

import sys
from pathlib import Path

from rtctl.control.faults import FAULTS

README = Path(__file__).parents[1] / "README.md"
BEGIN, END = "<!-- faults: printed by `python -m tools.faults` -->\n", "<!-- end of faults -->"


def table() -> str:
    """Return the fault table as Markdown."""
    rows = ["| fault | what it means | reaction | clears |", "|---|---|---|---|"]
    rows += [f"| `{f.name}` | {f.text} | {f.severity.name} | {f.clear} |" for f in FAULTS]
    return "\n".join(rows) + "\n"


def with_table(text: str) -> str:
    """Return README's text with the table between its marks."""
    head, _, rest = text.partition(BEGIN)
    _, _, tail = rest.partition(END)
    return head + BEGIN + "\n" + table() + "\n" + END + tail


if __name__ == "__main__":
    if "--write" in sys.argv[1:]:
        README.write_text(with_table(README.read_text(encoding="utf-8")), encoding="utf-8")
    else:
        print(table(), end="")

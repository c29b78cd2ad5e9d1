"""Print the fault tables of the documents from the program's own: `python -m tools.faults [--write]`."""

import sys
from pathlib import Path

from rtctl.arm.faults import FAULTS
from rtctl.control.faults import Fault
from rtctl.rover.faults import FAULTS as BASE_FAULTS

DOCS = Path(__file__).parents[1] / "docs"
PAGES = (DOCS / "faults.md", DOCS / "rover.md")
BEGIN, END = "<!-- faults: printed by `python -m tools.faults` -->\n", "<!-- end of faults -->"
BASE_BEGIN, BASE_END = "<!-- faults of a base: printed by `python -m tools.faults` -->\n", "<!-- end of a base's -->"


def table(faults: tuple[Fault, ...] = FAULTS) -> str:
    """Return a fault table as Markdown."""
    rows = ["| fault | what it means | reaction | clears | untrue then |", "|---|---|---|---|---|"]
    rows += [f"| `{f.name}` | {f.text} | {f.severity.name} | {f.clear} | {', '.join(f.untrue)} |" for f in faults]
    return "\n".join(rows) + "\n"


def with_table(text: str) -> str:
    """Return a page's text with the tables between its marks."""
    for begin, end, faults in ((BEGIN, END, FAULTS), (BASE_BEGIN, BASE_END, BASE_FAULTS)):
        if begin not in text:
            continue
        head, _, rest = text.partition(begin)
        _, _, tail = rest.partition(end)
        text = head + begin + "\n" + table(faults) + "\n" + end + tail
    return text


if __name__ == "__main__":
    if "--write" in sys.argv[1:]:
        for page in PAGES:
            page.write_text(with_table(page.read_text(encoding="utf-8")), encoding="utf-8")
    else:
        print(table() + "\n" + table(BASE_FAULTS), end="")

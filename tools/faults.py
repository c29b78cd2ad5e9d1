"""Print the fault tables of the documents from the program's own: `python -m tools.faults [--write]`."""

import sys
from pathlib import Path

from rtctl.arm import own_loop, servo_level
from rtctl.arm.faults import FAULTS
from rtctl.control.faults import Fault
from rtctl.rover.faults import FAULTS as BASE_FAULTS
from tools import stop_judge

DOCS = Path(__file__).parents[1] / "docs"
PAGES = (DOCS / "faults.md", DOCS / "rover.md")
BEGIN, END = "<!-- faults: printed by `python -m tools.faults` -->\n", "<!-- end of faults -->"
BASE_BEGIN, BASE_END = "<!-- faults of a base: printed by `python -m tools.faults` -->\n", "<!-- end of a base's -->"


def table(faults: tuple[Fault, ...] = FAULTS) -> str:
    """Return a fault table as Markdown."""
    rows = ["| fault | what it means | reaction | clears | untrue then |", "|---|---|---|---|---|"]
    rows += [f"| `{f.name}` | {f.text} | {f.severity.name} | {f.clear} | {', '.join(f.untrue)} |" for f in faults]
    return "\n".join(rows) + "\n"


REACTIONS_BEGIN = "<!-- reactions: printed by `python -m tools.faults` -->\n"
REACTIONS_END = "<!-- end of reactions -->"


def reactions() -> str:
    """Return what each reaction of an arm does, where it ends, and what the plant's truth is held to, as Markdown."""
    s, o, j = servo_level, own_loop, stop_judge
    faster = f"no joint {j.FASTER:g} rad/s faster than at the detection"
    ways = f"{faster}; the tip goes {j.WAY['ideal']:g} m, {j.WAY['slipping']:g} m where brakes slip"
    lowered = f"{faster}, nor that fast {j.SOON:g} s later; the tip is lowered at {j.LOWERED:g} m/s"
    falls = f"{lowered}; what cannot be held falls {j.FREE[0]:g} times and {j.FREE[1]:g} rad of its own fall"
    rest = f"all joints rest for {s.REST_HOLD:g} s, or stop_s is over"
    watched = f"a joint {s.FASTER:g} rad/s faster than at the onset, a new contact, a limit passed, a new lie"
    own = f"own loops of the drives: rest, held {o.HOLD_TIME:g} s, lowered at {o.TIP_SPEED:g} m/s"
    rows = [
        ("reaction", "state", "torque", "cut when", "cut at once by", "the plant is held to"),
        ("---",) * 6,
        ("SS2", "SAFE_STOP", "the law brakes, then holds", "never", "a fault of SS1 or STO", ways),
        ("SS1", "SAFE_STOP", "-(D + decay A) qd + g", rest, watched, ways),
        ("SS1, a measurement lies", "SAFE_STOP", "g of the last posture fades", f"{s.FADE:g} s", "the same", ways),
        ("SS1, no brakes", "SAFE_STOP", own, f"lowered, and rests {o.RESTS:g} s", "STO alone: it would fall", falls),
        ("STO", "FAULT", "none", "at once", "", "brakes hold; without them it falls"),
        ("disarm, SIGTERM", "STOPPING", "the law brakes, then holds", f"rests {s.REST_HOLD:g} s", "SS1, STO", ""),
        ("SIGTERM, no brakes", "STOPPING", f"parked, or {own}", "parked, or lowered", "STO alone", lowered),
    ]
    return "\n".join(f"| {' | '.join(row)} |" for row in rows) + "\n"


def with_table(text: str) -> str:
    """Return a page's text with the tables between its marks."""
    tables = (
        (BEGIN, END, table(FAULTS)),
        (BASE_BEGIN, BASE_END, table(BASE_FAULTS)),
        (REACTIONS_BEGIN, REACTIONS_END, reactions()),
    )
    for begin, end, printed in tables:
        if begin not in text:
            continue
        head, _, rest = text.partition(begin)
        _, _, tail = rest.partition(end)
        text = head + begin + "\n" + printed + "\n" + end + tail
    return text


if __name__ == "__main__":
    if "--write" in sys.argv[1:]:
        for page in PAGES:
            page.write_text(with_table(page.read_text(encoding="utf-8")), encoding="utf-8")
    else:
        print(table() + "\n" + table(BASE_FAULTS) + "\n" + reactions(), end="")

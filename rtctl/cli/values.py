"""Values as people type them: `key=1,2,3`, and the lines of a file of goals."""

import csv
import json
import math
from collections.abc import Iterable, Iterator

from rtctl.errors import UsageError
from rtctl.plain import Json
from rtctl.spell import close_to

COLUMNS = {3: ("x", "y", "z"), 6: ("x", "y", "z", "roll", "pitch", "yaw"), 7: ("x", "y", "z", "qw", "qx", "qy", "qz")}
GROUPS = {
    "position_m": ("x", "y", "z"),
    "rpy_rad": ("roll", "pitch", "yaw"),
    "wxyz": ("qw", "qx", "qy", "qz"),
    "direction": ("dx", "dy", "dz"),
    "latlon_deg": ("lat", "lon"),
    "velocity_m_s": ("vx", "vy", "vz"),
    "velocity_rad_s": ("wx", "wy", "wz"),
}
SINGLE = ("heading_rad", "tolerance_m", "tolerance_rad", "timeout_ms")
WORDS = ("axes", "tool_axis")
KNOWN = tuple(name for group in GROUPS.values() for name in group) + SINGLE + WORDS
NEEDED = ("position_m", "rpy_rad", "wxyz", "direction", "latlon_deg", "hold")  # one of them: where to go
WANTED = "wanted x,y,z; with roll,pitch,yaw or qw,qx,qy,qz or dx,dy,dz; lat,lon; or a JSON object"


def assignments(words: Iterable[str]) -> Json:
    """Return `key=value` words as a dict: numbers, lists of numbers by commas, JSON, or text. Raises UsageError."""
    found: Json = {}
    for word in words:
        key, equals, text = word.partition("=")
        if not (key and equals and text):
            raise UsageError(f"KEY=VALUE: got {word!r}, wanted a key, = and a value")
        if key in found or key in ("name", "type"):
            raise UsageError(f"{key}: got it twice, wanted it once")
        found[key] = _value(key, text)
    return found


def goal_messages(lines: Iterable[str], source: str) -> Iterator[tuple[int, Json]]:
    """Yield (line number, request) for each line of CSV or JSON that is not blank or a comment. Raises UsageError."""
    header: tuple[str, ...] = ()
    for at, line in enumerate(lines, 1):
        text = line.strip()
        if not text or text.startswith("#"):
            continue
        place = f"{source}:{at}"
        if text.startswith("{"):
            yield at, _from_json(text, place)
            continue
        cells = [cell.strip() for cell in next(csv.reader([text]))]
        if not header and not _is_number(cells[0]):
            header = _header(cells, place)
            continue
        yield at, _from_cells(cells, header or COLUMNS.get(len(cells), ()), place)


def _value(key: str, text: str) -> object:
    if text[0] in '["{':
        try:
            return json.loads(text, parse_constant=_refuse_constant)
        except ValueError:
            raise UsageError(f"{key}: got {text!r}, wanted JSON") from None
    if "," in text:
        return [_number(part, key) for part in text.split(",")]
    return _number(text, key) if _is_number(text) else text


def _from_json(text: str, place: str) -> Json:
    try:
        goal = json.loads(text, parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as error:
        raise UsageError(f"{place}: got no JSON ({error}), wanted one JSON object") from None
    if not any(key in goal for key in NEEDED):
        raise UsageError(f"{place}: got no goal, wanted one of {', '.join(NEEDED)}")
    return {**goal, "verb": "goal"}


def _header(cells: list[str], place: str) -> tuple[str, ...]:
    names = tuple(cells)
    odd = [name for name in names if name not in KNOWN]
    if odd or len(set(names)) != len(names):
        near = close_to(odd[0], KNOWN) if odd else ""
        wanted = f"wanted {near} (the nearest valid name)" if near else WANTED
        raise UsageError(f"{place}: got {odd[0] if odd else 'a name twice'}, {wanted}")
    return names


def _from_cells(cells: list[str], names: tuple[str, ...], place: str) -> Json:
    if len(cells) != len(names):
        raise UsageError(f"{place}: got {len(cells)} values, {f'wanted {len(names)}' if names else WANTED}")
    given_cells = {name: cell for name, cell in zip(names, cells, strict=True) if cell}
    row = {name: _number(cell, f"{place}: {name}") for name, cell in given_cells.items() if name not in WORDS}
    message: Json = {"verb": "goal"}
    for key, group in GROUPS.items():
        given = [name for name in group if name in row]
        if given and len(given) != len(group):
            raise UsageError(f"{place}: got {', '.join(given)} alone, wanted {', '.join(group)}")
        if given:
            message[key] = [row[name] for name in group]
    if not any(key in message for key in NEEDED):
        raise UsageError(f"{place}: got no position, {WANTED}")
    if "axes" in given_cells:
        message["axes"] = letters(given_cells["axes"])
    if "tool_axis" in given_cells:
        message["tool_axis"] = given_cells["tool_axis"]
    return message | {key: row[key] for key in SINGLE if key in row}


def goes_on(message: Json) -> bool:
    """Return whether a goal moves: there is nothing to arrive at."""
    return any(any(message.get(key) or ()) for key in ("velocity_m_s", "velocity_rad_s"))


def letters(text: str) -> list[str]:
    """Return the axes of a word like xy, for the daemon to check."""
    return [letter for letter in text if letter not in ", "]


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _number(text: str, place: str) -> float:
    value = float(text) if _is_number(text) else math.nan
    if not math.isfinite(value):
        raise UsageError(f"{place}: got {text!r}, wanted a finite number")
    return value


def _refuse_constant(text: str) -> float:
    raise ValueError(f"{text} is not a number of JSON")


def table(rows: list[list[str]], head: list[str], right: frozenset[int] = frozenset()) -> str:
    """Return rows as text under a head; the columns in `right` are numbers."""
    widths = [max(len(row[i]) for row in [head, *rows]) for i in range(len(head))]

    def line(row: list[str]) -> str:
        cells = [c.rjust(w) if i in right else c.ljust(w) for i, (c, w) in enumerate(zip(row, widths, strict=True))]
        return "  ".join(cells).rstrip()

    return "\n".join(line(row) for row in [head, *rows])

"""Missions that ground stations write, as goals: QGroundControl's .plan and the older .waypoints. Places alone."""

import json
import math

from rtctl.errors import UsageError
from rtctl.plain import Json

WAYPOINT = 16  # MAV_CMD_NAV_WAYPOINT
HEAD = "QGC WPL"
GLOBAL_FRAMES = (0, 3, 5, 6, 10, 11)  # MAV_FRAME whose x and y are latitude and longitude
TOLERANCE_MAX = 10.0  # [m]


def is_mission(text: str) -> bool:
    """Return whether a file's text is a mission and no list of goals."""
    return text.lstrip().startswith(HEAD) or '"fileType"' in text[:4096]


def goals_of(text: str, source: str) -> list[str]:
    """Return a mission's way-points as JSON lines of goals. Raises UsageError for what is no place to drive to."""
    items = _of_lines(text, source) if text.lstrip().startswith(HEAD) else _of_plan(text, source)
    return [json.dumps(_goal(*item, f"{source}: item {k}")) for k, item in enumerate(items, 1)]


Item = tuple[object, object, list[object]]  # command, frame, seven parameters


def _of_plan(text: str, source: str) -> list[Item]:
    try:
        plan = json.loads(text)
        items = plan["mission"]["items"]
        if plan.get("fileType") != "Plan":
            raise UsageError(f"{source}: got fileType {plan.get('fileType')}, wanted Plan")
        return [(item.get("command"), item.get("frame"), list(item["params"])) for item in items]
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise UsageError(f"{source}: no plan of simple items: {error}") from None


def _of_lines(text: str, source: str) -> list[Item]:
    """Return the items of a .waypoints file; its first line is home, no place to go to."""
    rows = [line.split() for line in text.splitlines()[1:] if line.strip()]
    found: list[Item] = []
    for k, row in enumerate(rows):
        try:
            numbers = [float(cell) for cell in row]
        except ValueError:
            numbers = []
        if len(numbers) != 12:
            raise UsageError(f"{source}:{k + 2}: got {len(row)} columns, wanted 12 numbers of {HEAD} 110")
        if numbers[0] != 0.0:
            found.append((int(numbers[3]), int(numbers[2]), [*numbers[4:11]]))
    return found


def _goal(command: object, frame: object, params: list[object], place: str) -> Json:
    if command != WAYPOINT:
        raise UsageError(f"{place}: got command {command}, wanted way-points alone (MAV_CMD_NAV_WAYPOINT, {WAYPOINT})")
    if frame not in GLOBAL_FRAMES:
        raise UsageError(f"{place}: got frame {frame}, wanted latitude and longitude")
    latitude, longitude = (_number(value, place) for value in (params + [None] * 7)[4:6])
    goal: Json = {"latlon_deg": [latitude, longitude]}
    radius = params[1] if len(params) > 1 and params[1] else 0.0
    if radius:
        goal["tolerance_m"] = min(_number(radius, place), TOLERANCE_MAX)
    return goal


def _number(value: object, place: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise UsageError(f"{place}: got {value}, wanted a number")
    return float(value)

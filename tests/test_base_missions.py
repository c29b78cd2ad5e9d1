"""Missions of ground stations become goals: what is read, and what is refused with its place."""

import json

import pytest

from rtctl.cli import missions, values
from rtctl.errors import UsageError

PLAN = {
    "fileType": "Plan",
    "version": 1,
    "groundStation": "QGroundControl",
    "mission": {
        "version": 2,
        "firmwareType": 3,
        "vehicleType": 10,
        "plannedHomePosition": [-35.0, 149.0, 584.0],
        "items": [
            {
                "type": "SimpleItem",
                "autoContinue": True,
                "doJumpId": 1,
                "frame": 3,
                "command": 16,
                "params": [0, 2.5, 0, None, -35.36326, 149.16529, 0],
            },
            {
                "type": "SimpleItem",
                "autoContinue": True,
                "doJumpId": 2,
                "frame": 3,
                "command": 16,
                "params": [0, 0, 0, None, -35.36300, 149.16540, 0],
            },
        ],
    },
    "geoFence": {"circles": [], "polygons": [], "version": 2},
    "rallyPoints": {"points": [], "version": 2},
}
LINES = """QGC WPL 110
0\t1\t0\t16\t0\t0\t0\t0\t-35.0\t149.0\t584\t1
1\t0\t3\t16\t0\t2.5\t0\t0\t-35.36326\t149.16529\t0\t1
2\t0\t3\t16\t0\t0\t0\t0\t-35.36300\t149.16540\t0\t1
"""
GOALS = [
    {"verb": "goal", "latlon_deg": [-35.36326, 149.16529], "tolerance_m": 2.5},
    {"verb": "goal", "latlon_deg": [-35.36300, 149.16540]},
]


@pytest.mark.parametrize("text", [json.dumps(PLAN, indent=4), LINES], ids=["plan", "waypoints"])
def test_a_mission_becomes_the_goals_that_it_means(text: str) -> None:
    assert missions.is_mission(text)
    found = [message for _, message in values.goal_messages(missions.goals_of(text, "m"), "m")]
    assert found == GOALS


def test_a_list_of_latitudes_and_longitudes_is_goals_too() -> None:
    text = "lat,lon,tolerance_m\n-35.36326,149.16529,2.5\n-35.36300,149.16540,\n"
    assert not missions.is_mission(text)
    assert [message for _, message in values.goal_messages(text.splitlines(), "f")] == GOALS
    with pytest.raises(UsageError, match="got lat alone"):
        list(values.goal_messages(["lat,lon", "1,"], "f"))


@pytest.mark.parametrize(
    ("text", "why"),
    [
        (LINES.replace("3\t16\t0\t2.5", "3\t22\t0\t2.5"), "item 1: got command 22, wanted way-points"),
        (LINES.replace("2\t0\t3\t16", "2\t0\t1\t16"), "item 2: got frame 1"),
        (LINES.replace("149.16529\t0\t1", "149.16529"), "m:3: got 10 columns"),
        (json.dumps(PLAN).replace("[0, 0, 0, null, -35.363,", "[0, 0, 0, null, null,"), "item 2: got None"),
        (json.dumps(PLAN).replace('"params"', '"TransectStyleComplexItem"'), "no plan of simple items"),
        ('{"fileType": "Plan"}', "no plan of simple items"),
    ],
)
def test_what_is_no_place_to_drive_to_is_refused_by_its_item(text: str, why: str) -> None:
    with pytest.raises(UsageError, match=why):
        missions.goals_of(text, "m")

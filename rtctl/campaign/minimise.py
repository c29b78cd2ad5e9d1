"""A failing scene made small: fewer obstacles, no more time than it takes, the same failure."""

from collections.abc import Callable
from functools import partial
from typing import Any

from rtctl.campaign.case import Case, Scene, source_of
from rtctl.campaign.play import changed
from rtctl.campaign.robots import ready
from rtctl.errors import RtctlError
from rtctl.plain import Json

AFTER = 0.2  # [s] that a scene goes on behind what is shown
BRIEFER = 0.05  # of the duration: no search for less

Fails = Callable[[Scene], bool]
Told = Callable[[str], None]


def minimised(case: Case, row: Json, told: Told) -> Scene:
    """Return the smallest scene found that ends as the row of the case did.

    Obstacles, faults and goals by delta debugging (Zeller and Hildebrandt, IEEE TSE 28(2), 2002), then the plant, then
    the duration. Raises RtctlError when the run does not end so when it is played again.
    """
    source = source_of(case.source)
    scene = changed(case, source.scene(case))
    bare = case._replace(changes="{}")
    config = ready(case.robot, case.config).path
    seen: list[Json] = []

    def fails(each: Scene) -> bool:
        try:
            found = source.play(bare, each, config)
        except RtctlError:
            return False
        seen[:] = [found]
        return same(found, row)

    if not fails(scene):
        raise RtctlError(f"campaign: {case.key}: played again it does not end {row['outcome']}: nothing to shrink")
    for key in ("obstacle", "fault", "goal"):
        whole = list(scene.table.get(key, ()))
        kept = ddmin(whole, partial(_fails_with, fails, scene, key))
        told(f"{key}s: {len(whole)} -> {len(kept)}")
        scene = _with(scene, key, kept)
    if "plant" in scene.table:
        without = scene._replace(table={k: v for k, v in scene.table.items() if k != "plant"})
        scene = without if fails(without) else scene
    scene = _briefer(scene, fails)
    told(f"duration: {scene.table['duration_s']:g} s")
    return scene


def same(found: Json, row: Json) -> bool:
    """Return whether a run ended as another: by outcome, and by which of the bounds were broken."""
    return found["outcome"] == row["outcome"] and bool(found["failures"]) == bool(row["failures"])


def _fails_with(fails: Fails, scene: Scene, key: str, rows: list[Any]) -> bool:
    return fails(_with(scene, key, rows))


def _with(scene: Scene, key: str, rows: list[Any]) -> Scene:
    table = {**scene.table, key: rows} if rows else {k: v for k, v in scene.table.items() if k != key}
    return scene._replace(table=table)


def ddmin(items: list[Any], fails: Callable[[list[Any]], bool]) -> list[Any]:
    """Return a part of the items that still fails, and of which none can be left out alone."""
    if not items or fails([]):
        return []
    parts = 2
    while len(items) >= 2:
        size = -(-len(items) // parts)
        for at in range(0, len(items), size):
            fewer = items[:at] + items[at + size :]
            if fewer and fails(fewer):
                items, parts = fewer, max(parts - 1, 2)
                break
        else:
            if size == 1:
                break
            parts = min(2 * parts, len(items))
    return items


def _briefer(scene: Scene, fails: Fails) -> Scene:
    """Return the scene with the least duration, by halving, at which it still fails."""
    high = float(scene.table["duration_s"])
    low, least = 0.0, BRIEFER * high
    while high - low > least:
        middle = round(0.5 * (low + high), 3)
        if fails(scene._replace(table={**scene.table, "duration_s": middle})):
            high = middle
        else:
            low = middle
    return scene._replace(table={**scene.table, "duration_s": round(high, 3)})

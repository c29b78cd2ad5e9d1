"""The pictures in docs, each with the numbers that its caption may name.

    python -m tools.pictures                  # every one: `make pictures`
    python -m tools.pictures view rover       # some of them

Beside the pictures it writes docs/pictures.json: for each how it was made, and phrases with the numbers of the very
run that is drawn. A test asks that the page that shows a picture says them. `foxglove` needs npm, `view` a Chromium.
"""

import argparse
import hashlib
import json
import shutil
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image

from rtctl import experiment
from rtctl.app.sim import simulate
from rtctl.errors import RtctlError
from rtctl.log import read_run
from rtctl.log.view.report import gather
from rtctl.log.view.sheet import draw as draw_sheet
from rtctl.plain import Json
from rtctl.spec.scenario import load_scenario
from rtctl.view.follow import Recorded
from rtctl.view.operator import Operator
from rtctl.view.page import Page
from tools import browser, demo_rover, foxglove

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
NOTES = DOCS / "pictures.json"
DEMO, WORLDS = ROOT / "configs" / "demo.toml", ROOT / "configs" / "worlds"
AT, AT_ROVER = 29.4, 15.0  # [s] of what the page is shown: the visitor pushes the elbow; the rover rounds the U
WIDE, PHONE = (1400, 900), (390, 844)
CLOSE = "document.querySelectorAll('.mantine-Notification-root button').forEach(each => each.click())"
PRESS = "[...document.querySelectorAll('button')].find(each => each.innerText.trim() === 'Pause').click()"


class Made(NamedTuple):
    """A picture that was made."""

    by: str  # command that makes what is drawn
    says: list[str]  # phrases with its numbers


@cache
def played(scenario: Path, folder: Path) -> tuple[Json, Path]:
    """Return the figures of a scenario's simulation, and its log."""
    log = folder / f"{scenario.stem}.mcap"
    return simulate(scenario, log), log


def experiments(folder: Path) -> dict[str, Made]:
    """Make the pictures of the paper's experiments, and the table of the rates."""
    made: dict[str, Made] = {}
    for name in experiment.NAMES:
        made |= experiment_of(name, folder)
    shutil.copy(folder / "rates.md", DOCS)
    return made


def forms(folder: Path) -> dict[str, Made]:
    """Make the picture of the repulsion's forms alone."""
    return experiment_of("forms", folder)


def experiment_of(name: str, folder: Path) -> dict[str, Made]:
    """Make the picture of one experiment."""
    figures = experiment.perform(name, folder, lambda part: None)
    shutil.copy(folder / f"{name}.png", DOCS)
    says = []
    if name == "forms":
        says = [
            f"{figures['sum_over_blend']['median']:.1f} times as hard",
            f"{figures['task_to_normal_deg']['median']:.0f} degrees",
        ]
    return {f"{name}.png": Made(f"rtctl experiment {name}", says)}


def report(folder: Path) -> dict[str, Made]:
    """Make the sheet of the demo's log."""
    figures, log = played(DEMO, folder)
    gathered = gather(read_run(log))
    draw_sheet(gathered, DOCS / "report.png")
    spheres = 1e3 * gathered.figures["smallest_clearance_m"]
    oracle = 1e3 * figures["min_clearance_m"]["all"]
    reached = sum(goal["arrived"] for goal in figures["goals"])
    says = [
        f"{reached} of {len(figures['goals'])} goals",
        f"{spheres:.1f} mm by the controller's spheres",
        f"{oracle:.1f} mm by the oracle",
        f"top speed {gathered.figures['top_speed_m_s']:.3f} m/s",
    ]
    return {"report.png": Made("rtctl sim configs/demo.toml --log run.mcap; rtctl log report run.mcap --png", says)}


def rover(folder: Path) -> dict[str, Made]:
    """Draw where the rover went in each world."""
    runs, says = [], []
    for world in demo_rover.WORLDS:
        scenario = WORLDS / f"{world}.toml"
        figures, log = played(scenario, folder)
        ticks = read_run(log)["/tick"].array
        track = np.column_stack(
            [ticks["time"], ticks["x"][:, :2], ticks["heading"], np.linalg.norm(ticks["xd"][:, :2], axis=1)]
        )
        near, time = figures["min_clearance_m"]["all"], figures["time_to_goal_s"]
        runs.append(
            demo_rover.Run(
                world, time, near, figures["contacts"], figures["faults"], track, load_scenario(scenario), log, 0
            )
        )
        says.append(f"{world} {time:.1f} s, {near:.2f} m")
    demo_rover.draw(runs, DOCS / "rover.png")
    return {"rover.png": Made("rtctl sim configs/worlds/NAME.toml", says)}


def view(folder: Path) -> dict[str, Made]:
    """Take pictures of the page: the demo, wide and on a phone; a rover."""
    record = Recorded(read_run(played(DEMO, folder)[1]))
    with shown(record, AT) as chrome:
        taken(chrome, DOCS / "view.png", WIDE, record, AT)
        taken(chrome, DOCS / "view_phone.png", PHONE, record, AT)
    m = record.story.moment
    if m is None:
        raise RtctlError("the demo's log has nothing to see")
    name, near = m.clearances[0]
    push = max(float(np.linalg.norm(force)) for _, force, _ in m.forces)
    says = [f"{m.time:.1f} s", f"the {name} is {1e3 * near:.0f} mm from the controller's spheres", f"{push:.0f} N"]
    base = Recorded(read_run(played(WORLDS / "u.toml", folder)[1]))
    with shown(base, AT_ROVER) as chrome:
        taken(chrome, DOCS / "view_rover.png", WIDE, base, AT_ROVER)
    m = base.story.moment
    way = f"{m.error:.2f} m to the goal" if m is not None else ""
    return {
        "view.png": Made("rtctl sim configs/demo.toml --view", says),
        "view_phone.png": Made("the same at the width of a phone", []),
        "view_rover.png": Made("rtctl sim configs/worlds/u.toml --view", [way]),
    }


@contextmanager
def shown(record: Recorded, at: float) -> Iterator[browser.Browser]:
    """Serve a log's page, paused at a time [s], and yield a browser that can look at it."""
    page, ended = Page(record, Operator(None), "127.0.0.1", 0), threading.Event()
    thread = threading.Thread(target=page.run, args=(ended.is_set,))
    thread.start()
    try:
        with browser.Browser(browser.DRAWS) as chrome:
            chrome.wide(*WIDE)
            chrome.go(page.gate.url)
            chrome.wait("document.body.innerText.includes('Clearance')")
            chrome.run(PRESS)
            record.seek(at)
            yield chrome
    finally:
        ended.set()
        thread.join()
        page.close()


def taken(chrome: browser.Browser, path: Path, size: tuple[int, int], record: Recorded, at: float) -> None:
    """Lay the page out in a size and keep its picture once it shows a time [s] of the log."""
    if size[0] < size[1]:
        chrome.phone(*size)
        chrome.run("location.reload()")
        chrome.wait("document.body.innerText.includes('Clearance')")
    chrome.drawn()
    chrome.wait(f"document.body.innerText.includes('{at:.1f} s')")
    chrome.run(CLOSE)
    chrome.wait("!document.querySelector('.mantine-Notification-root')")
    for _ in range(5):  # a camera and meshes that are still on their way
        chrome.drawn()
    chrome.picture(path)
    with Image.open(path) as image:
        small = image.convert("RGB").reduce(2 if size[0] < size[1] else 1)
    small.save(path, optimize=True)


def in_foxglove(folder: Path) -> dict[str, Made]:
    """Open the demo's log in Foxglove's own core."""
    log = played(DEMO, folder)[1]
    if foxglove.main([str(log), "--at", "26", "--png", str(DOCS / "foxglove.png")]):
        raise RtctlError("Foxglove found problems in the log")
    return {"foxglove.png": Made("python -m tools.foxglove run.mcap --at 26 --png docs/foxglove.png", [])}


PARTS: dict[str, Callable[[Path], dict[str, Made]]] = {
    "experiments": experiments,
    "forms": forms,
    "report": report,
    "rover": rover,
    "view": view,
    "foxglove": in_foxglove,
}


def main(argv: Sequence[str] | None = None) -> int:
    """Make pictures and write down their numbers."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("parts", metavar="PART", nargs="*", help=f"of {', '.join(PARTS)}; default: all")
    arguments = parser.parse_args(argv)
    for part in arguments.parts:
        if part not in PARTS:
            parser.error(f"got {part!r}, wanted some of {', '.join(PARTS)}")
    notes: dict[str, Json] = json.loads(NOTES.read_text(encoding="utf-8")) if NOTES.exists() else {}
    with tempfile.TemporaryDirectory(prefix="rtctl-pictures-") as name:
        for part in arguments.parts or PARTS:
            print(part, flush=True)
            for picture, made in PARTS[part](Path(name)).items():
                notes[picture] = {"sha256": digest(DOCS / picture), "by": made.by, "says": made.says}
            NOTES.write_text(json.dumps(dict(sorted(notes.items())), indent=2) + "\n", encoding="utf-8")
    return 0


def digest(path: Path) -> str:
    """Return the SHA-256 of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


if __name__ == "__main__":
    sys.exit(main())

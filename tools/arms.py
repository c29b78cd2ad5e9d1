"""Twenty-five arms and more of the packages that carry robots, each through init, check and a simulation.

`python -m tools.arms` prints the table of docs/arms.md: what each needed, what was refused, whether both goals were
reached without a touch, by the simulated arm's truth. It needs the extra `robots`. `--write` renews
the page's rows of the arms that were run.
"""

import argparse
import contextlib
import json
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from rtctl.plain import Json

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "arms.md"
LIMIT = 1200.0  # [s] for one step of one arm
HEAD = """# Arms that `rtctl init` has made configs of

Each arm went through `rtctl init`, `rtctl check` and `rtctl sim` of the scenario that init wrote: two goals, a ball
beside the way, a table. Arrived and contacts are those of the simulated arm, not of the controller. The table is
printed by `python -m tools.arms` (extra `robots`); the seconds are those of one busy machine and say little.

| arm | from | options | joints | what was said | init s | check s | sim s | arrived | contacts | nearest mm |
|---|---|---|---|---|---|---|---|---|---|---|
"""


class Case(NamedTuple):
    """An arm: what init is called with."""

    name: str
    robot: str
    options: tuple[str, ...] = ()


def case(name: str, robot: str, options: str = "") -> Case:
    """Return an arm with its options in one text."""
    return Case(name, robot, tuple(options.split()))


CASES = (
    case("UR3", "ur3"),
    case("UR5", "ur5"),
    case("UR10", "ur10"),
    case("UR5e", "robosuite:ur5e"),
    case("Panda", "example-robot-data:panda"),
    case("Panda, MJCF", "robosuite:panda"),
    case("Kinova Jaco 6", "kinova"),
    case("Kinova Jaco 7", "robosuite:jaco", "--repair"),
    case("Kinova Gen3", "robosuite:kinova3"),
    case("xArm 7", "example-robot-data:xarm7"),
    case("xArm 7, MJCF", "robosuite:xarm7"),
    case("xArm 6", "pybullet_data:xarm6_robot", "--repair"),
    case("Unitree Z1", "z1"),
    case("Unitree B1 with Z1", "b1-z1", "--tip gripperStator"),
    case("SO-100", "so100"),
    case("SO-101", "so101"),
    case("KUKA iiwa", "robosuite:iiwa"),
    case("KUKA iiwa 14", "rtbdata:lbr_iiwa_14_r820", "--repair"),
    case("KUKA KR 5", "rtbdata:kr5_arc", "--repair"),
    case("KUKA KR 210", "rtbdata:kr210l150", "--repair"),
    case("ABB IRB 140", "rtbdata:irb140", "--repair --scale 0.2535"),
    case("PUMA 560", "rtbdata:puma560_robot", "--repair"),
    case("Sawyer", "robosuite:sawyer"),
    case("Baxter left", "baxter", "--side left --repair"),
    case("Baxter right", "robosuite:baxter", "--side right"),
    case("Tiago", "tiago"),
    case("Tiago dual right", "robosuite:tiago", "--side right"),
    case("Talos left", "talos_left_arm", "--repair"),
    case("Talos right", "talos_full_v2", "--side right"),
    case("PR2 left", "pr2", "--side left --repair"),
    case("PR2 right", "pr2", "--side right --repair"),
    case("Romeo left", "romeo", "--side left"),
    case("Spot arm", "robosuite:spot_arm"),
    case("Trossen PX100", "rtbdata:px100", "--repair"),
    case("Trossen WX250S", "rtbdata:wx250s", "--repair"),
    case("Trossen VX300S", "rtbdata:vx300s", "--repair"),
    case("Anymal with Kinova", "anymal-kinova"),
    case("OpenArm", str(ROOT / "configs" / "openarm.urdf"), "--drives damiao:8009,8009,4340,4340,4310,4310,4310"),
)


class Row(NamedTuple):
    """What became of an arm."""

    case: Case
    origin: str
    joints: str
    said: str  # a refusal, or what was told
    seconds: tuple[float, float, float]  # of init, check, sim
    goals: str
    contacts: str
    nearest: str
    done: bool


def rtctl(*words: str) -> tuple[int, str, str, float]:
    """Run a command; return exit code, output, errors and seconds."""
    begun = time.perf_counter()
    try:
        out = subprocess.run(
            [sys.executable, "-m", "rtctl", *words],
            capture_output=True,
            text=True,
            cwd=ROOT,
            check=False,
            timeout=LIMIT,
        )
    except subprocess.TimeoutExpired:
        return 1, "", f"not done after {LIMIT:g} s", time.perf_counter() - begun
    return out.returncode, out.stdout, out.stderr, time.perf_counter() - begun


def go(arm: Case, folder: Path) -> Row:
    """Take an arm through init, check and sim."""
    name = "".join(c if c.isalnum() else "_" for c in arm.name.lower())
    code, out, err, init = rtctl("init", arm.robot, "--out", str(folder), "--name", name, *arm.options)
    row = Row(arm, arm.robot.rpartition("/")[2], "", "", (init, 0.0, 0.0), "", "", "", False)
    if code:
        return row._replace(said=_last(err, folder))
    told = [line.strip() for line in out.splitlines() if line.startswith("  ")]
    row = row._replace(joints=out.split(" joints, from")[0].rpartition(" ")[2], said="; ".join(told))
    code, _, err, check = rtctl("check", str(folder / f"{name}.toml"))
    row = row._replace(seconds=(init, check, 0.0))
    if code:
        return row._replace(said=_last(err, folder))
    scenario = folder / f"{name}_first.toml"
    if not scenario.exists():
        return row
    code, out, err, sim = rtctl("sim", str(scenario), "--json", "--log", str(folder / "run.mcap"))
    row = row._replace(seconds=(init, check, sim))
    try:
        figures: Json = json.loads(out)
    except ValueError:
        return row._replace(said=_last(err, folder))
    reached = sum(goal["arrived"] for goal in figures["goals"])
    nearest = figures["min_clearance_m"].get("all")
    ball = "ball" in figures["min_clearance_m"]
    return row._replace(
        goals=f"{reached} of 2",
        contacts=str(figures["contacts"]),
        nearest="" if nearest is None else f"{1e3 * nearest:.0f}",
        done=code == 0 and reached == 2 and ball and not figures["faults"],
        said=row.said + ("".join(f"; {fault}" for fault in figures["faults"])) + ("" if ball else "; no ball"),
    )


def _last(err: str, folder: Path) -> str:
    """Return the last line of what was said, with no place of this machine in it."""
    if not err.strip():
        return "ended without a word"
    said = err.strip().splitlines()[-1].removeprefix("rtctl: ").replace(f"{folder}/", "")
    return re.sub(r"\S*/site-packages/", "", said)


def line(row: Row) -> str:
    """Return a row of the page."""
    options = " ".join(row.case.options)
    seconds = [f"{s:.0f}" if s else "" for s in row.seconds]
    cells = [row.case.name, row.origin, options and f"`{options}`", row.joints, row.said.replace("|", "/"), *seconds]
    return "| " + " | ".join([*cells, row.goals, row.contacts, row.nearest]) + " |"


@contextlib.contextmanager
def somewhere(kept: str) -> Iterator[Path]:
    """Yield the folder for the files: one that is kept, or one of these minutes."""
    if kept:
        yield Path(kept)
        return
    with tempfile.TemporaryDirectory() as folder:
        yield Path(folder)


def run() -> int:
    """Take the arms through, print the table; return 0 when 25 or more did all."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("names", metavar="ARM", nargs="*", help="parts of names; default: all")
    parser.add_argument("--write", action="store_true", help="renew these rows of docs/arms.md")
    parser.add_argument("--keep", metavar="DIR", default="", help="keep the files here")
    arguments = parser.parse_args()
    wanted = [c for c in CASES if not arguments.names or any(n.lower() in c.name.lower() for n in arguments.names)]
    rows = []
    with somewhere(arguments.keep) as folder:
        for arm in wanted:
            rows.append(go(arm, folder))
            print(line(rows[-1]), flush=True)
    done = sum(row.done for row in rows)
    print(f"\n{done} of {len(rows)} arms reached both goals beside the ball without a touch or a fault.\n")
    if arguments.write:
        write(list(map(line, rows)))
    return 0 if done >= min(25, len(wanted)) else 1


def write(lines: list[str]) -> None:
    """Write the page: these rows, and of the page as it is those of other arms."""
    known = {cells(row)[0]: row for row in PAGE.read_text(encoding="utf-8").splitlines()} if PAGE.exists() else {}
    known |= {cells(row)[0]: row for row in lines}
    kept = [known[arm.name] for arm in CASES if arm.name in known]
    done = sum(is_done(row) for row in kept)
    foot = f"\n{done} of {len(kept)} arms reached both goals beside the ball without a touch or a fault.\n"
    PAGE.write_text(HEAD + "\n".join(kept) + "\n" + foot, encoding="utf-8")


def cells(row: str) -> list[str]:
    """Return the cells of a row of the page."""
    return [cell.strip() for cell in row.strip().strip("|").split("|")]


def is_done(row: str) -> bool:
    """Return whether a row of the page says that its arm did all."""
    *_, goals, contacts, nearest = cells(row)
    return goals == "2 of 2" and contacts == "0" and bool(nearest) and "no ball" not in row


if __name__ == "__main__":
    sys.exit(run())

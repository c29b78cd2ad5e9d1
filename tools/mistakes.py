"""The mistakes that people make, and the sentence that each gets: `python -m tools.mistakes` prints docs/mistakes.md.

Each is made for real, in this process and a folder of its own; `--write` writes the page.
"""

import argparse
import contextlib
import io
import os
import re
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from rtctl.cli import main
from rtctl.errors import RequestError
from rtctl.hal.messages import decode

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "mistakes.md"
HEAD = """# Mistakes, and what you are told

Every refusal has one form: **the place, what came, what was wanted**, with the nearest valid name and the unit where
there is one. It is one line on stderr, never a traceback. Exit code 2 is a wrong call, 78 a refused file, 1 anything
else that failed. This page is printed by `python -m tools.mistakes`, which makes each mistake for real.
"""
SECTIONS = (
    "On the command line",
    "In a robot's file",
    "In a scenario",
    "In a file of goals",
    "At the control socket",
    "With files and logs",
)


class Mistake(NamedTuple):
    """A mistake: what people do, and how it is made."""

    section: str
    done: str  # in words, for the page
    words: tuple[str, ...] = ()  # of the command line
    files: tuple[tuple[str, str], ...] = ()  # (name, text) that are there
    message: str = ""  # to the control socket


class Answer(NamedTuple):
    """What came of a mistake."""

    code: int  # exit code; 0 where a message was refused
    text: str  # the sentence


def call(words: str, done: str = "") -> Mistake:
    """Return a mistake on the command line."""
    return Mistake(SECTIONS[0], done or f"`rtctl {words}`", tuple(words.split()))


def robot(old: str, new: str, done: str = "") -> Mistake:
    """Return a mistake in a robot's file: a line of the Panda's, written otherwise."""
    text = (ROOT / "configs" / "panda.toml").read_text(encoding="utf-8")
    assert old in text, old
    shown = done or f"`{new.strip() or old.strip() + ' left out'}`"
    return Mistake(SECTIONS[1], shown, ("check", "robot.toml"), (("robot.toml", text.replace(old, new, 1)),))


def scenario(text: str, done: str = "") -> Mistake:
    """Return a mistake in a scenario."""
    whole = text if "robot" in text or "duration" in text else f'robot = "panda"\nduration_s = 4.0\n{text}'
    return Mistake(
        SECTIONS[2], done or f"`{'; '.join(text.strip().splitlines())}`", ("sim", "s.toml"), (("s.toml", whole),)
    )


def goals(text: str) -> Mistake:
    """Return a mistake in a file of goals."""
    shown = "; ".join(text.splitlines())
    return Mistake(SECTIONS[3], f"`{shown}`", ("goals", "tour.csv"), (("tour.csv", text),))


def told(message: str) -> Mistake:
    """Return a mistake at the control socket."""
    return Mistake(SECTIONS[4], f"`{message}`", message=message)


def file(words: str, done: str, *files: tuple[str, str]) -> Mistake:
    """Return a mistake with a file."""
    return Mistake(SECTIONS[5], done, tuple(words.split()), files)


PANDA = (ROOT / "configs" / "panda.toml").read_text(encoding="utf-8")
BALL = '{"verb":"obstacle","set":{"name":"b","type":"sphere","position_m":[1,0,1],%s}}'
MISTAKES: tuple[Mistake, ...] = (
    call("chekc configs/panda.toml"),
    call("status --wacth"),
    call("arm --timout 5"),
    call("arm now"),
    call("check"),
    call("run"),
    call("sim"),
    call("sim demo.toml --jsn"),
    call("goal"),
    call("goal 0.4 0.2", "`rtctl goal 0.4 0.2`, the height forgotten"),
    call("goal 0,4 0,2 0,5", "`rtctl goal 0,4 0,2 0,5`, commas for points"),
    call("goal 0.4 0.2 nan"),
    call("goal 0.4 0.2 0.5 --rpy 180 0 0", "`rtctl goal 0.4 0.2 0.5 --rpy 180 0 0`, degrees"),
    call("goal 0.4 0.2 0.5 --heading 90", "`rtctl goal 0.4 0.2 0.5 --heading 90`, degrees"),
    call("goal 0.4 0.2 0.5 --rpy 0 0"),
    call("goal 0.4 0.2 0.5 --rpy 0 0 0 --wxyz 1 0 0 0"),
    call("goal 0.4 0.2 0.5 --wxyz 2 0 0 0"),
    call("goal 0.4 0.2 0.5 --direction 0 0 0"),
    call("goal 0.4 0.2 0.5 --tool-axis x"),
    call("goal 0.4 0.2 0.5 --axes xw"),
    call("goal 0.4 0.2 0.5 --axes xx"),
    call("goal 0.4 0.2 0.5 --tolerance 0"),
    call("goal 0.4 0.2 0.5 --timeout soon"),
    call("goal 0.4 0.2 0.5 --latlon -35.3 149.1"),
    call("goal --latlon 149.1 -35.3", "`rtctl goal --latlon 149.1 -35.3`, longitude first"),
    call("goal 0.4 0.2 0.5 --tolerance 500", "`rtctl goal 0.4 0.2 0.5 --tolerance 500`, millimetres"),
    call("obstacle"),
    call("obstacle sett ball sphere"),
    call("obstacle set ball shpere radius_m=0.1 position_m=1,0,1"),
    call("obstacle set ball sphere radius=0.1 position_m=1,0,1"),
    call("obstacle set ball sphere radius_m position_m=1,0,1"),
    call("obstacle set ball sphere radius_m=10cm position_m=1,0,1"),
    call("obstacle set ball sphere radius_m=-0.1 position_m=1,0,1"),
    call("obstacle set ball sphere radius_m=0.1 position_m=1,0"),
    call("obstacle set ball sphere radius_m=0.1"),
    call("obstacle set crate box size=0.1,0.1,0.1 position_m=1,0,1"),
    call("obstacle set crate box size_m=0.1,0.1,0.1 position_m=1,0,1 rpy_rad=90,0,0"),
    call("obstacle clear"),
    call("payload"),
    call("payload -1"),
    call("payload 0.8 0 0"),
    call("payload 800", "`rtctl payload 800`, grams"),
    call("grip"),
    call("grip 40", "`rtctl grip 40`, per cent or millimetres"),
    call("grip 1 --force -5"),
    call("park now"),
    call("float --timeout 0"),
    call("doctor --wakes many"),
    call("doctor --wakes 1"),
    call("schema scenaro"),
    call("stop --socket a --robot b"),
    call("log"),
    call("log inof run.mcap"),
    call("completion csh"),
    robot('kind = "arm"', 'kind = "amr"'),
    robot("v_max_m_s = 0.5", "v_max = 0.5"),
    robot("v_max_m_s = 0.5", "vmax_m_s = 0.5"),
    robot("v_max_m_s = 0.5", "v_max_m_s = 500", "`v_max_m_s = 500`, mm/s"),
    robot("v_max_m_s = 0.5", 'v_max_m_s = "fast"'),
    robot("v_max_m_s = 0.5", "v_max_m_s = nan"),
    robot("v_max_m_s = 0.5", "v_max_m_s = 2.0", "`v_max_m_s = 2.0` with the influence as it is"),
    robot("w_max_rad_s = 1.5", "w_max_rad_s = 90", "`w_max_rad_s = 90`, degrees"),
    robot("servo_hz = 1000", "servo_hz = 8000"),
    robot("model_hz = 250", "model_hz = 2000"),
    robot("model_hz = 250", "model_hz = 250 Hz"),
    robot("fd = true", "fd = yes"),
    robot("fd = true", "fd = false", "`fd = false` with `mit+e2e`"),
    robot('protocol = "mit+e2e"', 'protocol = "mit+e2"'),
    robot('interface = "socketpair"', "interface = socketcan"),
    robot("clearance_m = 0.02", "clearance_m = 20", "`clearance_m = 20`, mm"),
    robot("clearance_m = 0.02", "clearance_m = 0.2", "clearance larger than the influence"),
    robot("self_collision = true", "self_collison = true"),
    robot("watchdog_ms = 20.0", "watchdog_ms = 0.02", "`watchdog_ms = 0.02`, seconds"),
    robot("stale_hold_ms = 3.0", "stale_hold_ms = 50.0"),
    robot('points = "auto"', 'points = "automatic"'),
    robot('drive = "', 'drive = "x', "a drive that is not in the catalogue"),
    robot("can_id = 2", "can_id = 1", "two joints with one `can_id`"),
    robot("[safety]", "[saftey]"),
    robot("[log]", "[log", "a bracket left open"),
    robot("home_rad = [", "home_rad = [0.0, ", "one angle too many in `home_rad`"),
    robot("home_rad = [", "home_deg = ["),
    scenario('robot = "pnada"\nduration_s = 4.0'),
    scenario("duration_s = 4.0"),
    scenario('robot = "panda"\nduration = 4.0'),
    scenario('robot = "panda"\nduration_s = 0'),
    scenario("[[goal]]\nposition_m = [0.4, 0.2, 0.5]"),
    scenario("[[goal]]\nat = 1.0\nposition_m = [0.4, 0.2, 0.5]"),
    scenario("[[goals]]\nat_s = 1.0\nposition_m = [0.4, 0.2, 0.5]"),
    scenario("[[goal]]\nat_s = 1.0\nposition_m = [0.4, 0.2]"),
    scenario("[[goal]]\nat_s = 1.0\nposition_m = [0.4, 0.2, 0.5]\nrpy_rad = [180, 0, 0]"),
    scenario("[[goal]]\nat_s = 2.0\nposition_m = [0.4, 0.2, 0.5]\n[[goal]]\nat_s = 1.0\nposition_m = [0.4, 0, 0.5]"),
    scenario('[[obstacle]]\nname = "b"\ntype = "ball"\nradius_m = 0.1\nposition_m = [1, 0, 1]'),
    scenario('[[obstacle]]\nname = "b"\ntype = "sphere"\nradius_m = 0.1\nposition = [1, 0, 1]'),
    scenario('[[obstacle]]\nname = "a b"\ntype = "sphere"\nradius_m = 0.1\nposition_m = [1, 0, 1]'),
    scenario('[[fault]]\nat = 1.0\nkind = "frame_loss"'),
    goals("0.4,0.2"),
    goals("0.4;0.2;0.5"),
    goals("x,y,zz\n0.4,0.2,0.5"),
    goals("x,y,z,roll\n0.4,0.2,0.5,0"),
    goals("x,y,z\n0.4,0.2,high"),
    goals('{"position_m": [0.4, 0.2, 0.5'),
    goals('{"position": [0.4, 0.2, 0.5]}'),
    goals("0.4,0.2,0.5,180,0,0"),
    told("stop"),
    told('{"verb":"stopp"}'),
    told("{}"),
    told('{"verb":"goal","position":[0.4,0,0.5]}'),
    told('{"verb":"goal","position_m":[0.4,0]}'),
    told('{"verb":"goal","position_m":["0.4",0,0.5]}'),
    told('{"verb":"goal","position_m":[NaN,0,0.5]}'),
    told('{"verb":"goal","position_m":[0.4,0,0.5],"rpy_rad":[0,0,90]}'),
    told(BALL % '"radius":0.1'),
    told(BALL % '"radius_m":0'),
    told(BALL % '"radius_m":0.1,"appears_s":3'),
    file("run demo.toml", "a scenario given to `rtctl run`", ("demo.toml", 'robot = "panda"\nduration_s = 4.0\n')),
    file("check demo.toml", "a scenario given to `rtctl check`", ("demo.toml", 'robot = "panda"\nduration_s = 4.0\n')),
    file("sim panda.toml", "a robot's file given to `rtctl sim`", ("panda.toml", PANDA)),
    file("check arm.urdf", "a URDF given to `rtctl check`", ("arm.urdf", "<robot/>")),
    file("check pnada.toml", "a file name misspelt", ("panda.toml", PANDA)),
    file("check .", "a folder given to `rtctl check`"),
    file("check notes.txt", "a text given to `rtctl check`", ("notes.txt", "Dear arm,\nplease move.\n")),
    file("goals tour.csv", "a file of goals that is not there"),
    file("log info run.mcap", "a log that is not there"),
    file("log info panda.toml", "a robot's file given to `rtctl log info`", ("panda.toml", PANDA)),
    file("log report run.mcap", "a log that is empty", ("run.mcap", "")),
    file("stop", "`rtctl stop` without a daemon"),
    file("status --robot panda", "`rtctl status --robot panda` without a daemon"),
    file("stop --socket none.sock", "`rtctl stop --socket none.sock` without a daemon there"),
)


def answer(mistake: Mistake) -> Answer:
    """Make a mistake in the working directory; return what came of it."""
    if mistake.message:
        try:
            decode(mistake.message.encode())
        except RequestError as error:
            return Answer(0, str(error))
        return Answer(0, "")
    for name, text in mistake.files:
        Path(name).write_text(text, encoding="utf-8")
    with contextlib.redirect_stderr(io.StringIO()) as said, contextlib.redirect_stdout(io.StringIO()):
        code = main(mistake.words)
    for name, _ in mistake.files:
        os.unlink(name)
    return Answer(code, said.getvalue().rstrip("\n"))


@contextlib.contextmanager
def elsewhere() -> Iterator[None]:
    """Be in an empty folder where no daemon is, and back again."""
    before, runtime = os.getcwd(), os.environ.get("XDG_RUNTIME_DIR")
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        os.environ["XDG_RUNTIME_DIR"] = folder
        try:
            yield
        finally:
            os.chdir(before)
            os.environ.pop("XDG_RUNTIME_DIR")
            if runtime is not None:
                os.environ["XDG_RUNTIME_DIR"] = runtime


def answers() -> list[tuple[Mistake, Answer]]:
    """Make every mistake; return what came of each."""
    with elsewhere():
        return [(mistake, answer(mistake)) for mistake in MISTAKES]


def page(found: Sequence[tuple[Mistake, Answer]]) -> str:
    """Return the page of docs; what differs from machine to machine is left out."""
    lines = [HEAD]
    for section in SECTIONS:
        lines += [f"\n## {section}\n", "| what was done | what is said | exit code |", "|---|---|---|"]
        for mistake, said in found:
            if mistake.section == section:
                text = re.sub(
                    r"/[\w/.-]*/(?=rtctl|configs)|/tmp/\w+|/run/user/\d+", "…/", said.text.removeprefix("rtctl: ")
                )
                text = re.sub(r"none answers in .*", "none answers in the folders where daemons listen", text)
                cells = [mistake.done, text, str(said.code or "")]
                lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join(lines) + "\n"


def run() -> int:
    """Print the page, or write it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--write", action="store_true", help="write docs/mistakes.md instead")
    text = page(answers())
    if parser.parse_args().write:
        PAGE.write_text(text, encoding="utf-8")
    else:
        print(text, end="")
    return 0


if __name__ == "__main__":
    sys.exit(run())

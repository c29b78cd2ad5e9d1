"""Seeded faults of sensors, drives and bus while arms move: what the plant does from the detection on.

    rtctl campaign run tools.stop_campaign --count 1000 --out out/stops   # five arms, each fault, each kind of brakes
    python -m tools.stop_campaign out/stops                               # the worst of each, and what broke a bound
    python -m tools.stop_campaign --runs 12 --robots ur5 --brakes none    # without a folder, in this process
    python -m tools.stop_campaign --only 17                               # one run of the thousand again

The plant's truth judges, never what the controller believes (`tools.stop_judge`). Exit code 1 when a bound is broken.
Which joints of an arm without brakes can be held follows from the fault alone: not those whose drive gives nothing or
whose encoder lies. The others may not gather speed, and with all of them held the tip is lowered slowly; one that falls
may not fall further than it would by itself, all others locked.
"""

import argparse
import json
import sys
import tomllib
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from firmware_sim.inject import INTERFACE
from rtctl.app.sim import simulate_setup
from rtctl.arm.robot import Robot
from rtctl.campaign.case import Asked, Case, Scene, options_within
from rtctl.campaign.expand import Plan
from rtctl.campaign.play import played, scenario_of
from rtctl.campaign.robots import Variant, ready, text_of
from rtctl.campaign.store import Store
from rtctl.plain import Json
from rtctl.spec.scenario import Scenario
from tools.stop_judge import Course, Run, judged

ROOT = Path(__file__).resolve().parent.parent
ARMS = ("planar4", "puma560", "panda", "ur5", "openarm_e2e")
BARE = {"openarm_e2e": "openarm"}  # has no brakes as its maker ships it
CORRUPT = ("corrupt_crc", "corrupt_command")  # of its plain frames CAN's own CRC discards what is corrupt: silence
BRAKES = ("ideal", "slipping", "none")
KINDS = (
    "drive_fault",
    "overheat",
    "watchdog",
    "silent",
    "drop",
    "corrupt_crc",
    "corrupt_command",
    "weak",
    "stuck_encoder",
    "dead_encoder",
    "false_velocity",
    "encoder_jump",
    "reboot",
    "duplicate",
    "hot",
    "foreign",
    "error_passive",
    "bus_off",
)
FIRST, LATEST = 0.4, 1.4  # [s] of the goal; of the fault
AFTER = {"ideal": 1.0, "slipping": 1.0, "none": 2.2}  # [s] played after it
SLIPS = 0.6  # of a joint's rating: the torque at which a worn brake slips


class Stops:
    """Faults in motion, on arms whose brakes hold, slip, or are not there."""

    def cases(self, asked: Asked) -> Iterator[Case]:
        """Yield the cases: arms, faults and brakes in turn."""
        words = options_within(asked, ("brakes",), "tools.stop_campaign").get("brakes", ",".join(BRAKES))
        arms, brakes = asked.robots or ARMS, words.split(",")
        for seed in asked.seeds:
            for number in range(asked.scenes):
                arm, kind = arms[number % len(arms)], KINDS[number // len(arms) % len(KINDS)]
                held = brakes[number // (len(arms) * len(KINDS)) % len(brakes)]
                yield case_of(arm, kind, held, seed, number)

    def scene(self, case: Case) -> Scene:
        """Return the scene of a case: joints, instants and goals at random."""
        kind, held = case.set.split()
        known = ready(case.robot, case.config)
        robot: Robot = known.setup.build()
        rng = np.random.default_rng([case.seed, case.number])
        low, high = robot.q_min + 0.35, robot.q_max - 0.35
        posture = np.clip(robot.home + rng.uniform(-0.5, 0.5, robot.n), np.minimum(low, high), np.maximum(low, high))
        tip = robot.body.evaluate(posture, np.zeros(robot.n), robot.points, robot.own).x
        at, joint = float(rng.uniform(FIRST + 0.1, LATEST)), int(rng.integers(-1, robot.n))
        table = {
            "robot": case.robot,
            "duration_s": at + AFTER[held],
            "seed": case.number,
            "goal": [{"at_s": FIRST, "position_m": tip.tolist()}],
            "fault": [{"at_s": at, "kind": kind, "joint": -1 if kind in INTERFACE else joint}],
            "plant": {"brake": (SLIPS * robot.tau_rated).tolist() if held == "slipping" else held},
        }
        return Scene(table, known.path)

    def play(self, case: Case, scene: Scene, config: Path) -> Json:
        """Return the columns of a run; touched or gone on, the same is played without its fault to compare with."""
        fault = scene.table["fault"][0]
        course, digest = self._course(case, scene, fault["at_s"])
        alone = None
        if course.contacts or not course.rows:
            alone, _ = self._course(case, scene._replace(table={**scene.table, "fault": []}), fault["at_s"])
        run = judged(
            ready(case.robot, case.config).setup.build(),
            course,
            alone,
            (fault["kind"], fault["joint"], fault["at_s"]),
            case.set.split()[1],
        )
        return {
            "outcome": "unnoticed" if run.noticed is None else "stopped",
            "arrived": False,
            "failures": "; ".join(run.broken),
            "contacts": run.contacts,
            "finite": True,
            "digest": digest,
            "detail": json.dumps(run._asdict()),
        }

    def _course(self, case: Case, scene: Scene, at: float) -> tuple[Course, str]:
        robot, course = ready(case.robot, case.config), Course(at)
        kept: Any = _Kept(robot.setup)
        found = simulate_setup(robot.vehicle, kept, scenario_of(case, scene), scene.where, watch=course)
        course.whole(kept.play.simulator.drives)
        return course, str(found["digest"])


class _Kept:
    """A robot's setup that lets its last simulation be looked at."""

    def __init__(self, setup: Any) -> None:
        self.setup, self.play = setup, None

    def simulate(self, scenario: Scenario, source: Path) -> Any:
        """Return what plays a scenario."""
        self.play = self.setup.simulate(scenario, source)
        return self.play


def case_of(arm: str, kind: str, brakes: str, seed: int, number: int) -> Case:
    """Return the case of a fault on an arm."""
    robot = BARE.get(arm, arm) if brakes == "none" and kind not in CORRUPT else arm
    return Case("tools.stop_campaign", robot, _text(robot, brakes == "none"), seed, number, f"{kind} {brakes}")


@cache
def _text(arm: str, bare: bool) -> str:
    """Return the text of an arm's file; bare: without its brakes."""
    path = ROOT / "configs" / f"{arm}.toml"
    joints = tomllib.loads(path.read_text(encoding="utf-8"))["robot"]["joints"]
    without: dict[tuple[str, ...], object] = {("robot", "joints"): [{**joint, "brake": False} for joint in joints]}
    return text_of(path, Variant("", without if bare else {}))


def rows_of(cases: Iterator[Case]) -> Iterator[Json]:
    """Play cases in this process."""
    for case in cases:
        row = played(case)
        print(json.dumps({k: row.get(k) for k in ("number", "robot", "set", "outcome", "failures", "detail")}))
        yield row


def table(rows: Sequence[Json], by: str) -> list[str]:
    """Return the worst of each kind of brakes and fault, or arm, as Markdown; by: "fault" or "arm"."""
    out = [
        f"| {by} | brakes | runs | noticed | faster [rad/s] | way [m] | past a limit [rad] | contacts "
        "| held [rad/s] | lowered [m/s] | of a free fall | beyond a bound |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    runs = [(row, Run(**json.loads(row["detail"]))) for row in rows if row["outcome"] != "error"]
    for name in KINDS if by == "fault" else (*ARMS, *BARE.values()):
        for brakes in BRAKES:
            these = [
                (row["number"], run)
                for row, run in runs
                if (run.kind if by == "fault" else row["robot"], run.brakes) == (name, brakes)
            ]
            if not these:
                continue
            most = [max(getattr(r, column) for _, r in these) for column in ("faster", "way", "beyond", "contacts")]
            bare = [max(getattr(r, column) for _, r in these) for column in ("held", "sinks", "falls")]
            figures = f"{most[0]:.2f} | {most[1]:.3f} | {most[2]:.3f} | {most[3]}"
            figures += f" | {bare[0]:.2f} | {bare[1]:.3f} | {bare[2]:.2f}" if brakes == "none" else " | | |"
            noticed = sum(run.noticed is not None for _, run in these)
            bad = " ".join(str(number) for number, run in these if run.broken)
            out.append(f"| {name} | {brakes} | {len(these)} | {noticed} | {figures} | {bad} |")
    return out


def plan(count: int, seed: int, robots: Sequence[str], brakes: str) -> Plan:
    """Return the campaign of so many runs."""
    asked = Asked(tuple(robots), range(seed, seed + 1), count, {"brakes": brakes})
    return Plan(("tools.stop_campaign",), asked, (Variant("", {}),), (("", {}),), (("", {}),))


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return its exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m tools.stop_campaign", description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("folder", nargs="?", help="the --out of a campaign: print its table")
    parser.add_argument("--runs", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--robots", nargs="+", choices=ARMS, default=ARMS)
    parser.add_argument("--brakes", default=",".join(BRAKES))
    parser.add_argument("--only", type=int, nargs="+", help="the numbers of single runs")
    args = parser.parse_args(argv)
    if args.folder:
        rows = sorted(Store(Path(args.folder)).rows.values(), key=lambda row: (row["seed"], row["number"]))
    else:
        todo = plan(args.runs, args.seed, args.robots, args.brakes).cases()
        rows = list(rows_of(c for c in todo if args.only is None or c.number in args.only))
    for by in ("arm", "fault"):
        print("\n".join(table(rows, by)), end="\n\n")
    broken = [row for row in rows if row["failures"]]
    for row in broken:
        print(f"{row['number']}: {row['robot']}, {row['set']}: {row['failures']}")
    print(f"{len(rows)} runs, {len(broken)} beyond a bound")
    return 1 if broken else 0


source = Stops()

if __name__ == "__main__":
    sys.exit(main())

"""Payload and friction, untold and told, for every arm that is shipped: how well and how soon it arrives.

    python -m tools.loads                  # the loads of tests/test_disturbance.py
    python -m tools.loads openarm_e2e panda
    python -m tools.loads --write          # and into docs/loads.md
    python -m tools.loads --hz 225 100     # at other rates, of servo and model, as `rtctl experiment rates` has them

The plant's truth judges: error and angle at the end, the tip's hunting in the last second. The last row of each arm is
told friction that is not there: too much is given.
"""

import argparse
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rtctl.experiment import rates
from rtctl.experiment.scene import variant
from rtctl.kernel.rotations import quat_of
from rtctl.types import Payload, Request
from tests.lab import ROOT, lab
from tests.test_disturbance import CASES
from tests.test_friction import told

PAGE = ROOT / "docs" / "loads.md"
BEGIN, END = "<!-- loads: printed by `python -m tools.loads` -->\n", "<!-- end of loads -->"
HEAD = (
    "| arm | load | arrived after [s] | error [mm] | angle [rad] | hunting [mm] | faults |",
    "|---|---|---|---|---|---|---|",
)
PLAYED, LAST = 4.0, 1.0  # [s] in all, and of it the end in which hunting is looked at


class Arrival(NamedTuple):
    """What the plant says."""

    after: float  # [s], nan never
    error: float  # [m]
    angle: float  # [rad]
    hunting: float  # [m]
    faults: tuple[str, ...]


def arrival(path: Path, name: str, plant: dict[str, Any], payload: float) -> Arrival:
    """Send an arm along the way of its case; payload [kg] is told."""
    with lab(path=path, scenario={"plant": plant}) as here:
        if payload > 0.0:
            here.step(Request(payload=Payload(payload)))
        here.running()
        to, wxyz = here.simulator.truth().tip + np.array(CASES[name].way), quat_of(here.memory.tip.R)
        here.ask(to, wxyz)
        after, tips = np.nan, []
        for k in range(round(PLAYED / here.robot.dt)):
            here.step()
            tips.append(here.simulator.plant.tip_pose()[0])
            after = k * here.robot.dt if np.isnan(after) and here.memory.status.name == "ARRIVED" else after
        truth = here.simulator.truth()
        return Arrival(
            float(after),
            float(np.linalg.norm(truth.tip - to)),
            float(2.0 * np.arccos(min(abs(truth.tip_wxyz @ wxyz), 1.0))),
            float(np.ptp(tips[-round(LAST / here.robot.dt) :], axis=0).max()),
            here.servo.vehicle.names(here.servo.faults_seen),
        )


def judged(name: str, hz: Sequence[int] | None = None) -> tuple[list[str], int]:
    """Return the rows of an arm, as they are printed, and how many of them pass a bound; hz: of servo and model."""
    case, plain, out, bad = CASES[name], ROOT / "configs" / f"{name}.toml", [], 0
    both = {"payload_kg": case.payload, "coulomb_Nm": case.coulomb}
    with tempfile.TemporaryDirectory() as folder, tempfile.TemporaryDirectory() as other:
        file = told(Path(folder), name)
        if hz is not None:
            changes = rates.changes_of(hz[0], hz[1])
            file, plain = variant(file, Path(folder), changes), variant(plain, Path(other), changes)
        rows = [
            ("none", arrival(plain, name, {}, 0.0), 1e-3),
            ("untold", arrival(plain, name, both, 0.0), 3e-3),
            ("told", arrival(file, name, both, case.payload), 1e-3),
            ("friction told, none there", arrival(file, name, {"coulomb_Nm": 0.0}, 0.0), 3e-3),
        ]
    for label, a, most in rows:
        late = not a.after < rows[0][1].after + 2.0
        bad += bool(late or a.error > most or a.angle > 0.01 or a.hunting > 0.5e-3 or a.faults)
        numbers = f"{a.after:.2f} | {1e3 * a.error:.2f} | {a.angle:.4f} | {1e3 * a.hunting:.3f}"
        out.append(f"| {name} | {label} | {numbers} | {', '.join(a.faults) or 'none'} |")
        print(out[-1], flush=True)
    return out, bad


def written(page: str, rows: list[str]) -> str:
    """Return a page's text with the table between its marks."""
    head, _, rest = page.partition(BEGIN)
    _, _, tail = rest.partition(END)
    return head + BEGIN + "\n" + "\n".join(rows) + "\n\n" + END + tail


def main(arguments: list[str] | None = None) -> int:
    """Print a table; exit code 1 where a bound is passed."""
    parser = argparse.ArgumentParser(
        prog="tools.loads", description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("arms", nargs="*", help=f"of {', '.join(CASES)}; default: all")
    parser.add_argument("--write", action="store_true", help="put the table into docs/loads.md")
    parser.add_argument("--hz", type=int, nargs=2, metavar=("SERVO", "MODEL"), help="rates; default: those of the file")
    asked, bad, rows = parser.parse_args(arguments), 0, list(HEAD)
    if asked.write and asked.hz:
        parser.error("--write is for the rates of the files")
    print("\n".join(HEAD))
    for name in asked.arms or list(CASES):
        more, beyond = judged(name, asked.hz)
        rows, bad = rows + more, bad + beyond
    if asked.write:
        PAGE.write_text(written(PAGE.read_text(encoding="utf-8"), rows), encoding="utf-8")
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())

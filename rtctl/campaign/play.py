"""One run of a campaign, on a worker: its scene made, played and put into a row. Nothing that fails ends a worker."""

import json
import os
import socket
import time
import traceback
from pathlib import Path
from typing import Any

import numpy as np

from rtctl.app.sim import simulate_setup
from rtctl.campaign.case import Case, Scene, loads, source_of
from rtctl.campaign.robots import ready
from rtctl.campaign.scenes import toml_of
from rtctl.errors import RtctlError
from rtctl.plain import Json
from rtctl.spec.read import convert
from rtctl.spec.scenario import Scenario
from rtctl.types import F64, Status

KEPT = 0.3  # [s] that a goal is watched when nothing moves any more
REST = 0.012  # [m/s] of the tip: slower, and the arm stands
STEP = 1e-4  # [rad] below what an encoder of a joint tells: a start on a limit is no violation
LIMITS = (  # figure, its bound, what it is called
    ("max_torque_ratio", 1.0 + 1e-9, "torque"),
    ("max_torque_rate_ratio", 1.0 + 1e-6, "torque rate"),
    ("max_joint_speed_ratio", 1.0 + 1e-9, "joint speed"),
)


def played(case: Case) -> Json:
    """Return the row of a run; what went wrong is in it."""
    begun = time.perf_counter()
    row: Json = head(case)
    try:
        source = source_of(case.source)
        scene = changed(case, source.scene(case))
        row["reference_s"] = scene.reference_s
        row |= source.play(case, scene, ready(case.robot, case.config).path)
    except RtctlError as error:
        row |= {"outcome": "error", "failures": f"error: {error}"}
    except Exception as error:  # a row that says so, and the campaign goes on
        last = traceback.extract_tb(error.__traceback__)[-1]
        text = f"error: {type(error).__name__}: {error} ({Path(last.filename).name}:{last.lineno})"
        row |= {"outcome": "error", "failures": " ".join(text.split())}
    return row | {"wall_s": time.perf_counter() - begun, "worker": f"{socket.gethostname()}:{os.getpid()}"}


def head(case: Case) -> Json:
    """Return the columns that name a run."""
    named = {"key": case.key, **case._asdict()}
    return {k: v for k, v in named.items() if k not in ("config", "base", "changes", "body")}


def changed(case: Case, scene: Scene) -> Scene:
    """Return the scene with the plant and the faults of the case."""
    return scene._replace(table={**scene.table, **loads(case.changes)})


def scenario_of(case: Case, scene: Scene) -> Scenario:
    """Return the scenario, checked. Raises ConfigError."""
    scenario: Scenario = convert({**scene.table, "robot": case.robot}, Scenario, f"{case.set or case.source}")
    return scenario


def simulated(case: Case, scene: Scene, watch: Any = None) -> Json:
    """Return the columns of a scene played as `rtctl sim` plays it; it ends with a contact or settled at its goal."""
    robot, scenario, eye = ready(case.robot, case.config), scenario_of(case, scene), Eye(watch)
    still = is_still(scenario)
    figures = simulate_setup(
        robot.vehicle,
        robot.setup,
        scenario,
        scene.where,
        watch=eye,
        over=lambda truth, kept: truth.contacts > 0 or (still and kept > KEPT),
    )
    return row_of(figures, eye, scene)


def is_still(scenario: Scenario) -> bool:
    """Return whether nothing happens in a scenario but its goals."""
    for o in scenario.obstacle:
        if any(o.velocity_m_s) or any(o.omega_rad_s) or o.waypoints or o.appears_s > 0.0 or o.vanishes_s < 1e6:
            return False
    return not scenario.fault


class Eye:
    """What is seen of a run beside its figures: since when the arm stands, and that all are numbers."""

    def __init__(self, also: Any = None) -> None:
        """`also` is shown the same."""
        self.also = also
        self.finite, self.time, self.moved = True, 0.0, 0.0  # [s] now, and when the tip last moved
        self.tip: F64 | None = None

    def __call__(self, servo: Any, truth: Any, turn: Any) -> None:
        """Take a period into account."""
        if self.also is not None:
            self.also(servo, truth, turn)
        tip = getattr(truth, "tip", None)
        if tip is None:  # a rover's
            tip = np.array([truth.x, truth.y, 0.0])
        else:
            sane = np.isfinite(truth.q).all() and np.isfinite(turn.command.tau).all()
            self.finite = self.finite and bool(sane)
        passed = truth.time - self.time
        if self.tip is None or np.linalg.norm(tip - self.tip) > REST * max(passed, servo.robot.dt):
            self.moved = truth.time
        self.tip, self.time = tip.copy(), truth.time


def row_of(figures: Json, eye: Eye, scene: Scene) -> Json:
    """Return the columns of a run's figures."""
    said = [s for s in figures["statuses"] if s[1].upper() in Status.__members__]
    at, status, detail = said[-1] if said else (None, "none", "")
    row = {k: figures.get(k) for k in FIGURES}
    row |= {
        "arrived": _arrived(figures, scene),
        "min_clearance_m": figures["min_clearance_m"]["all"],
        "status": status,
        "diagnosis": detail,
        "stood_s": eye.time - eye.moved,
        "told_after_s": None if at is None else max(0.0, at - eye.moved),
        "duration_s": eye.time,
        "faults_seen": ", ".join(figures["faults"]),
        "finite": eye.finite,
    }
    failures = broken(figures, eye.finite)
    return row | {"failures": "; ".join(failures), "outcome": outcome(row, failures, figures["mode_final"])}


FIGURES = (
    "digest",
    "time_to_goal_s",
    "final_error_m",
    "final_error_rad",
    "path_length_m",
    "line_deviation_m",
    "max_speed_m_s",
    "min_self_clearance_m",
    "min_joint_margin_rad",
    "max_torque_ratio",
    "max_torque_rate_ratio",
    "max_joint_speed_ratio",
    "contacts",
    "plan_time_s",
)


def _arrived(figures: Json, scene: Scene) -> bool:
    if scene.tolerance is None:
        return bool(figures["arrived"])
    error, turn = figures["final_error_m"], figures.get("final_error_rad")
    near, turned = scene.tolerance
    return error is not None and error <= near and (turn is None or turn <= turned)


def broken(figures: Json, finite: bool) -> list[str]:
    """Return what a run broke that none may break, whatever its goal."""
    found = [] if not figures["contacts"] else [f"contact ({figures['contacts']})"]
    if not finite:
        found.append("not a number")
    for name, bound, what in LIMITS:
        value = figures.get(name)
        if value is not None and not value <= bound:
            found.append(f"{what} at {value:.4f} of its limit")
    margin = figures.get("min_joint_margin_rad")
    if margin is not None and margin < -STEP:
        found.append(f"a joint {-margin:.4f} rad beyond its limit")
    return found


def outcome(row: Json, failures: list[str], mode: str) -> str:
    """Return one word for the end of a run."""
    if row["contacts"]:
        return "contact"
    if failures:
        return "limit" if row["finite"] else "nan"
    if row["arrived"]:
        return "arrived"
    return "stopped" if mode not in ("RUN", "IDLE") else str(row["status"])


def written(case: Case, folder: Path) -> tuple[Path, Path]:
    """Write the scenario and the robot file of a run, so that `rtctl sim` plays it; return both files."""
    scene = changed(case, source_of(case.source).scene(case))
    return save(case, scene, folder, case.key)


def save(case: Case, scene: Scene, folder: Path, name: str) -> tuple[Path, Path]:
    """Write a scene under a name; return the files of scenario and robot."""
    folder.mkdir(parents=True, exist_ok=True)
    robot, path = folder / f"{name}_robot.toml", folder / f"{name}.toml"
    robot.write_text(case.config, encoding="utf-8")
    table = {**scene.table, "robot": robot.name}
    for obstacle in table.get("obstacle", ()):
        if "file" in obstacle:
            obstacle["file"] = str((scene.where.resolve().parent / obstacle["file"]).resolve())
    path.write_text(toml_of(table, f"{case.source} {case.set} {case.seed}:{case.number}"), encoding="utf-8")
    if scene.certificate is not None:
        way = {"reference_s": scene.reference_s, "q_rad": scene.certificate}
        (folder / f"{name}_way.json").write_text(json.dumps(way) + "\n", encoding="utf-8")
    return path, robot

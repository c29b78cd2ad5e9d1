"""Arms without brakes: by the plant's truth they do not drop, whatever fails; they park, and fall where they are told.

The arm is the OpenArm as its maker ships it. The oracle is the plant: its joints' true speeds, its tip's true way.
"""

import re
import signal
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from rtctl import design
from rtctl.app.replay import replay
from rtctl.app.sim import simulate
from rtctl.arm.rigid_body import RigidBody
from rtctl.design.arm import rigid_body
from rtctl.log import schema
from rtctl.log.read.run import read_run
from rtctl.types import F64, Drive, Request, State, Truth, Verb
from tests.arms import NO_POINTS
from tests.lab import ROOT, Lab, lab, seen, sphere
from tests.rig import Rig

OPENARM = ROOT / "configs" / "openarm.toml"
AT = 0.6  # [s] of the fault
GOAL = [0.25, -0.30, 0.05]
HELD = 0.3  # [rad/s] of a joint that is held, above its speed at the detection; and from SOON on
SOON = 0.6  # [s] after the detection, in which what moved comes to rest
LOWERED = 0.15  # [m/s] of the tip


class Course(NamedTuple):
    """The true course of a stop, a row a period from the detection on."""

    t: F64  # (T,) [s] since
    q: F64  # (T, n) [rad]
    qd: F64  # (T, n) [rad/s]
    tip: F64  # (T, 3) [m]
    events: list[tuple[str, str]]
    state: State
    off: bool

    @property
    def speed(self) -> F64:
        """Return the speed (T-1,) [m/s] of the tip."""
        return np.asarray(np.linalg.norm(np.diff(self.tip, axis=0), axis=1) / np.diff(self.t))

    def largest(self, joints: list[int], after: float = 0.0) -> float:
        """Return the largest speed [rad/s] of joints from a time [s] on, until then above what each had."""
        above = np.abs(self.qd[:, joints]) - (0.0 if after else np.abs(self.qd[0, joints]))
        return float(above[self.t >= after].max())


def course(
    here: Lab, seconds: float, until: Callable[[Lab], bool] = lambda here: here.memory.state != State.RUN
) -> Course:
    """Play on; return what was from the time on at which something holds."""
    found: list[Truth] = []
    while not until(here):
        here.step()
    begun = here.simulator.time
    while here.simulator.time < begun + seconds and not here.memory.off:
        found.append(here.simulator.truth())
        here.step()
    said = [(name, detail) for _, name, detail in here.servo.events]
    return Course(
        np.array([t.time for t in found]) - begun,
        np.array([t.q for t in found]),
        np.array([t.qd for t in found]),
        np.array([t.tip for t in found]),
        said,
        here.memory.state,
        here.memory.off,
    )


def stopped(inject: str, seconds: float = 2.2) -> Course:
    """Return the stop after a fault on the way to a goal."""
    with lab(path=OPENARM, inject=(inject,)) as here:
        here.running()
        here.ask(GOAL)
        return course(here, seconds)


def told(found: Course) -> list[str]:
    """Return which joints were said to be held by nobody."""
    return [detail.split(":")[0] for name, detail in found.events if name == "cannot_hold"]


@pytest.mark.parametrize("inject", ["silent@0.6:0:0.05", "silent@0.6", "weak@0.6", "weak@0.6:1", "drop@0.6:3:0.4"])
def test_joints_whose_drive_hears_and_whose_encoder_is_true_are_held_then_lowered_slowly(inject: str) -> None:
    found = stopped(inject)
    assert found.state == State.SAFE_STOP
    assert found.largest(list(range(7))) < HELD
    assert found.largest(list(range(7)), SOON) < HELD
    assert found.speed[found.t[1:] > SOON].max() < LOWERED
    assert found.tip[-1, 2] < found.tip[0, 2] - 0.03  # it is on its way down


def test_a_stop_is_predicted_with_the_friction_that_the_file_tells(tmp_path: Path) -> None:
    """Oracle: the plant's accelerations, as torques of each joint's inertia, beside those that the filter is told."""
    coulomb = np.array([1.0, 1.0, 1.0, 1.0, 0.2, 0.2, 0.2])  # [Nm]
    text = OPENARM.read_text().replace('"openarm.urdf"', f'"{OPENARM.with_suffix(".urdf")}"')
    each = iter(coulomb.tolist())
    path = tmp_path / "arm.toml"
    path.write_text(
        re.sub(r"(drive = [^}]*?) }", lambda m: f"{m[1]}, friction = {{ coulomb_Nm = {next(each)} }} }}", text)
    )
    missed: list[F64] = []
    with lab(path=path, scenario={"plant": {"coulomb_Nm": coulomb.tolist()}}, inject=("silent@0.6:0:0.05",)) as here:
        here.running()
        here.ask(GOAL)
        while here.memory.state == State.RUN:
            here.step()
        before = here.simulator.truth().qd
        for _ in range(250):
            predicted, inertia = here.memory.qdd, here.memory.model.A.diagonal()
            here.step()
            now = here.simulator.truth().qd
            slides = np.abs(before) > 0.1  # [rad/s]
            missed.append(np.where(slides, inertia * ((now - before) / here.robot.dt - predicted) / coulomb, 0.0))
            before = now
        said = [detail for _, name, detail in here.servo.events if name == "fault"]
    assert np.median(np.abs(missed)[np.array(missed) != 0.0]) < 0.2  # of the friction; without it all of it
    assert not any("innovation" in detail for detail in said)


@pytest.mark.parametrize(("newton", "direction"), [(60.0, (1.0, 0.0, 0.0)), (150.0, (0.0, 0.0, -1.0))])
def test_an_arm_that_is_struck_at_rest_is_held_although_no_encoder_moved_before(
    newton: float, direction: tuple[float, ...]
) -> None:
    blow = {"kind": "push", "at_s": 0.8, "duration_s": 0.05, "link": "link_5", "newton": newton, "direction": direction}
    with lab(path=OPENARM, scenario={"fault": [blow]}) as here:
        here.running()
        found = course(here, 2.0)
    assert found.state == State.SAFE_STOP
    assert told(found) == []
    assert found.largest(list(range(7)), SOON) < HELD
    assert found.speed[found.t[1:] > SOON].max() < LOWERED


@pytest.mark.parametrize(("inject", "joint"), [("drive_fault@0.6:3", 3), ("stuck_encoder@0.6:1", 1)])
def test_a_joint_that_cannot_be_held_is_named_and_the_others_keep_the_rest_from_following(
    inject: str, joint: int
) -> None:
    found = stopped(inject, 1.0)
    assert f"joint_{joint + 1}" in told(found)
    lands = int(np.argmax(np.abs(found.q[:, joint] - found.q[0, joint]) > 0.6)) or len(found.t)  # from then on it may
    before = found._replace(t=found.t[:lands], qd=found.qd[:lands])
    assert before.largest([j for j in range(7) if j != joint]) < HELD
    free = falling(found.q[0], float(found.qd[0, joint]), joint, found.t[:lands])
    assert (np.abs(found.q[:lands, joint] - found.q[0, joint]) <= 1.1 * free + 0.02).all()
    assert np.abs(found.q[-1, :joint] - found.q[lands - 1, :joint]).max() < 0.15  # whatever its landing did to them


def falling(q: F64, qd: float, joint: int, t: F64) -> F64:
    """Return how far (T,) [rad] a joint falls by itself while all others are locked: A qdd = -g - (dA/dq) qd^2 / 2."""
    body: RigidBody = rigid_body(design.load(OPENARM), OPENARM)
    q, start, way, still = q.copy(), q[joint], np.zeros(len(t)), np.zeros(7)
    for k in range(1, len(t)):
        ahead = q.copy()
        ahead[joint] += 1e-4
        now, then = body.evaluate(q, still, NO_POINTS), body.evaluate(ahead, still, NO_POINTS)
        inertia = now.A[joint, joint]
        slope = (then.A[joint, joint] - inertia) / 1e-4
        qd += (t[k] - t[k - 1]) * (-now.g[joint] - 0.5 * slope * qd * qd) / inertia
        q[joint] += (t[k] - t[k - 1]) * qd
        way[k] = abs(q[joint] - start)
    return way


def test_a_joint_whose_position_alone_lies_is_damped_and_what_that_carries_is_said() -> None:
    found = stopped("encoder_jump@0.6:1")
    assert [detail for name, detail in found.events if name == "cannot_hold"] == [
        "joint_2: damped alone, which carries 1.5 Nm at 0.3 rad/s"
    ]
    assert found.largest(list(range(7))) < HELD
    assert found.speed[found.t[1:] > SOON].max() < LOWERED


def test_it_is_lowered_until_gravity_moves_it_no_more_and_then_let_go() -> None:
    with lab(path=OPENARM, inject=("silent@0.6:0:0.05",)) as here:
        here.running()
        here.ask(GOAL)
        down = course(here, 30.0)
        assert here.memory.off
        assert here.turns[-1].command.drive == Drive.DISABLE
        assert down.largest(list(range(7)), SOON) < HELD
        assert down.speed[down.t[1:] > SOON].max() < LOWERED
        lowest = down.tip[-1]
        here.run(1.0)
        assert np.linalg.norm(here.simulator.truth().tip - lowest) < 0.1  # nothing was left to fall
        assert here.step(Request(Verb.RESET)).record["state"].item() == State.STOPPING
        here.until(State.IDLE)


def test_it_is_not_lowered_onto_what_lies_under_it() -> None:
    where = [0.20, -0.20, -0.37]  # under the forearm of an arm that is lowered
    ball = {"name": "ball", "type": "sphere", "radius_m": 0.05, "position_m": where}
    with lab(path=OPENARM, scenario={"obstacle": [ball]}, inject=("silent@0.6:0:0.05",)) as here:
        here.running()
        here.step(seen(sphere("ball", where, 0.05)))
        here.ask(GOAL)
        down = course(here, 12.0)
        plant = here.simulator.truth()
    assert plant.contacts == 0
    assert plant.clearance["ball"] > 0.01  # 0.028 seen
    assert not down.off  # it is held above it
    assert down.largest(list(range(7)), SOON) < HELD
    assert down.tip[0, 2] - down.tip[-1, 2] > 0.03  # it did come down
    assert np.linalg.norm(down.tip[-1] - down.tip[down.t > down.t[-1] - 1.0][0]) < 1e-3


def test_a_reset_before_that_goes_on_holding_it() -> None:
    with lab(path=OPENARM, inject=("silent@0.6:0:0.05",)) as here:
        here.running()
        here.ask(GOAL)
        course(here, 0.8)
        tip = here.simulator.truth().tip
        here.step(Request(Verb.RESET))
        assert here.memory.state == State.RUN
        here.run(0.5)
        assert np.linalg.norm(here.simulator.truth().tip - tip) < 5e-3


def test_disarm_of_an_arm_that_would_fall_is_refused_but_where_it_is_parked() -> None:
    with lab(path=OPENARM) as here:
        here.running()
        here.step(Request(Verb.DISARM))
        assert "park it first" in here.memory.refusal
        assert here.memory.state == State.RUN
        here.step(Request(Verb.PARK))
        assert not here.memory.refusal
        way = course(here, 0.2, lambda here: here.memory.state == State.IDLE)
        assert np.linalg.norm(way.tip[-1] - way.tip[0]) < 0.02
        here.run(1.0)
        assert np.linalg.norm(here.simulator.truth().tip - way.tip[-1]) < 0.12  # free of friction it swings a little


def test_an_arm_that_is_dropped_falls() -> None:
    with lab(path=OPENARM) as here:
        here.running()
        here.step(Request(Verb.DROP))
        here.until(State.IDLE)
        tip = here.simulator.truth().tip
        here.run(0.5)
        assert here.simulator.truth().tip[2] < tip[2] - 0.05


def test_sigterm_parks_where_that_is_asked_for_and_else_lowers() -> None:
    with lab(path=OPENARM) as here:
        here.running()
        here.ask(GOAL)
        here.run(0.3)
        here.step(Request(Verb.TERM))
        course(here, 0.01, lambda here: here.memory.done)
        assert np.abs(here.simulator.truth().q - here.robot.park).max() < 0.1
    with lab(path=OPENARM) as here:
        here.servo.robot = here.robot._replace(park_on_exit=False)
        here.running()
        here.step(Request(Verb.TERM))
        down = course(here, 1.9, lambda here: here.memory.state == State.STOPPING)
        assert down.largest(list(range(7))) < HELD
        assert down.speed.max() < LOWERED
        assert down.tip[-1, 2] < down.tip[0, 2] - 0.03


def test_what_the_drives_were_asked_for_is_in_the_log_and_replays_to_the_bit(tmp_path: Path) -> None:
    scene = tmp_path / "scene.toml"
    scene.write_text(
        f'robot = "{OPENARM}"\nduration_s = 2.6\n[[goal]]\nat_s = 0.3\nposition_m = {GOAL}\n'
        '[[fault]]\nat_s = 0.6\nkind = "drive_fault"\njoint = 3\n'
    )
    assert simulate(scene, tmp_path / "run.mcap")["mode_final"] == "SAFE_STOP"
    run = read_run(tmp_path / "run.mcap")
    assert int(Drive.HOLD) in run[schema.TICK].array["command"]
    found = replay(run)
    assert found.identical
    assert found.frames > 7 * 1000


def test_the_daemon_parks_it_over_a_bus_and_says_why_it_does_not_disarm(tmp_path: Path) -> None:
    with Rig(tmp_path, robot="openarm") as rig:
        rig.drives()
        controller = rig.controller()
        rig.arm()
        refused = rig.ask("disarm")
        assert not refused["ok"]
        assert "park it first" in refused["error"]
        assert rig.ask("goal", position_m=GOAL)["ok"]
        controller.signal(signal.SIGTERM)
        assert controller.wait() == 0, controller.text
        park = np.array(design.load(OPENARM).robot.park_rad)
        assert np.abs(np.array(rig.end_drives()["q_rad"]) - park).max() < 0.6

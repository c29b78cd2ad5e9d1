"""What the law costs: looped in compiled code as the C++ floor is, and called from Python; blocks of all by turns."""

import time
from collections.abc import Iterator

import numpy as np

from rtctl.arm.field import Field
from rtctl.arm.law import Cover, Motion, _evaluate, evaluate_law
from rtctl.arm.model import Model
from rtctl.arm.osc import OperationalSpace, Twist
from rtctl.arm.robot import Robot
from rtctl.kernel import kernel
from rtctl.types import Record
from rtctl.world.primitives import Obstacles
from tools.bench_rig import BoundFloor, Case, Floor, case
from tools.bench_rows import Row, row, timed

POINTS, OBSTACLES = (16, 64), (1, 16, 64, 256)
BLOCK = 50  # calls between two turns


@kernel
def _loop(
    count: int, constants: Record, cover: Cover, seen: Field, model: Model, space: OperationalSpace,
    obstacles: Obstacles, motion: Motion,
) -> float:  # fmt: skip
    s = 0.0
    for _ in range(count):
        _, torques, _, _, _, _ = _evaluate(constants, cover, seen, model, space, obstacles, motion)
        s += torques[0, 0]
    return s


def running(one: Case) -> Case:
    """Return the case as in a loop that runs: the guards begin at their last answer, A^-1 (tau - load)."""
    law = evaluate_law(*one.arguments)
    qdd = one.model.A_inv @ (law.drive + law.keep - one.model.g - one.model.h)
    return one._replace(arguments=(*one.arguments[:-1], qdd))


def difference(floor: BoundFloor, one: Case) -> float:
    """Return by how much [Nm, m/s2] the floor's F*, torque of the field and whole torque differ from the law's."""
    law, n = evaluate_law(*one.arguments), one.robot.n
    floor.run(1)
    F, field, whole = np.split(floor.out, [6, 6 + n])
    parts = (F - law.F, field - one.robot.scratch.tau, whole - law.drive - law.keep)
    return max(float(np.abs(part).max()) for part in parts)


def laws(robot: Robot, floor: Floor | None, why: str, count: int) -> Iterator[Row]:
    """The law looped, called from Python, and the floor, at each size."""
    for m in POINTS:
        for slots in OBSTACLES:
            yield from _sized(running(case(robot, m, slots)), f"{m} PSP x {slots}", floor, why, count)


def _sized(one: Case, name: str, floor: Floor | None, why: str, count: int) -> Iterator[Row]:
    r, model, space, obstacles, q, qd, xd, omega, e, e_rot, v_ref, w_ref, q_rest, pace, qdd = one.arguments
    motion = Motion(q, qd, Twist(xd, omega), Twist(e, e_rot), Twist(v_ref, w_ref), q_rest, pace, qdd)
    inputs = (r.constants, Cover(r.points.radius, r.points.link), r.scratch, model, space, obstacles, motion)
    rival = floor.bind(one) if floor is not None else None
    block = max(1, min(BLOCK, count // 4))
    _loop(1, *inputs)
    looped, called, theirs = [], [], []
    for _ in range(count // block):
        begin = time.perf_counter_ns()
        _loop(block, *inputs)
        looped.append((time.perf_counter_ns() - begin) // block)
        called.append(timed(lambda: evaluate_law(*one.arguments), block))
        if rival is not None:
            theirs.append(int(rival.run(block).mean()))
    if rival is None:
        yield row("law", f"law {name}", looped, note=f"no floor: {why}")
    else:
        ratio, wrong = float(np.median(looped) / np.median(theirs)), difference(rival, one)
        note = f"largest difference {wrong:.1e} Nm"
        yield row("law", f"law {name}", looped, ratio=ratio, rival="C++ floor", note=note)
        yield row("law", f"floor {name}", theirs)
    yield row("law", f"law {name} from Python", np.concatenate(called))

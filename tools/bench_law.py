"""What the law costs: looped in compiled code as the C++ floor is, and called from Python; blocks of all by turns."""

import time
from collections.abc import Iterator

import numpy as np

from rtctl.arm.field import Field
from rtctl.arm.law import evaluate_law, law
from rtctl.arm.model import Model
from rtctl.arm.osc import OperationalSpace
from rtctl.arm.robot import Robot
from rtctl.arm.terms import Cover, Motion, Outputs, WorkMemory, outputs
from rtctl.kernel import leaf_kernel
from rtctl.types import Record
from rtctl.world.primitives import Obstacles
from tools.bench_rig import BoundFloor, Case, Floor, case
from tools.bench_rows import Row, row, timed

POINTS, OBSTACLES = (16, 64), (1, 16, 64, 256)
BLOCK = 200  # calls between two turns: the call of the loop itself must not count


@leaf_kernel
def _loop(
    count: int,
    constants: Record,
    cover: Cover,
    seen: Field,
    model: Model,
    space: OperationalSpace,
    obstacles: Obstacles,
    motion: Motion,
    work: tuple[WorkMemory, Outputs],
) -> float:
    s = 0.0
    for _ in range(count):
        law(constants, cover, seen, model, space, obstacles, motion, work[0], work[1])
        s += work[1].torques[0, 0]
    return s


def running(one: Case) -> Case:
    """Return the case as in a loop that runs: the guards begin at their last answer, A^-1 (tau - load)."""
    found = evaluate_law(*one)
    qdd = one.model.A_inv @ (found.drive + found.keep - one.model.g - one.model.h)
    return one._replace(motion=one.motion._replace(qdd=qdd))


def difference(floor: BoundFloor, one: Case) -> float:
    """Return by how much [Nm, m/s2] the floor's F*, torque of the field and whole torque differ from the law's."""
    ours, n = evaluate_law(*one), one.robot.n
    floor.run(1)
    F, field, whole = np.split(floor.out, [6, 6 + n])
    parts = (F - ours.F, field - one.robot.scratch.tau, whole - ours.drive - ours.keep)
    return max(float(np.abs(part).max()) for part in parts)


def laws(robot: Robot, floor: Floor | None, why: str, count: int) -> Iterator[Row]:
    """The law looped, called from Python, and the floor, at each size."""
    for m in POINTS:
        for slots in OBSTACLES:
            yield from _sized(running(case(robot, m, slots)), f"{m} PSP x {slots}", floor, why, count)


def _sized(one: Case, name: str, floor: Floor | None, why: str, count: int) -> Iterator[Row]:
    r = one.robot
    inputs = (r.constants, Cover(r.points.radius, r.points.link), r.scratch, *one[1:])
    work = WorkMemory(r.arm.reals, r.arm.wholes), outputs(r.n, len(one.obstacles.active))
    rival = floor.bind(one) if floor is not None else None
    block = max(1, min(BLOCK, count // 4))
    _loop(1, *inputs, work)
    looped, called, theirs = [], [], []
    for _ in range(count // block):
        begin = time.perf_counter_ns()
        _loop(block, *inputs, work)
        looped.append((time.perf_counter_ns() - begin) // block)
        called.append(timed(lambda: evaluate_law(*one), block))
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

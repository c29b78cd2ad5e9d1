"""Compilation ahead of the first run: two processes that share the kernels between them, told as they go.

The caches of the kernels let each be compiled once: who comes second waits and loads it. So both processes go through
the same work, and each begins with another part of it.
"""

import gc
import hashlib
import os
import re
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numba

from rtctl.errors import RtctlError
from rtctl.kernel.cache import folder
from rtctl.spec.base import is_base

POLL = 0.25  # [s] between two looks at what was compiled: a look takes time from the compilers
KEPT = 50  # marks of what was warmed
GARBAGE = 500_000  # objects made between two collections: a compiler keeps what it makes, looking for garbage took 6 %
_ROOT = Path(__file__).resolve().parents[1]
_KERNEL = re.compile(rb"^@(?:ieee_|leaf_)?kernel\b", re.MULTILINE)


def needed(config: str | Path) -> bool:
    """Return whether no robot of a config's kind was warmed with these sources and this numba."""
    return not getattr(numba.config, "DISABLE_JIT", False) and not _mark(Path(config)).exists()


def kernels() -> int:
    """Return how many kernels the sources have: no robot needs all of them."""
    return sum(len(_KERNEL.findall(path.read_bytes())) for path in _ROOT.rglob("*.py"))


def warm(config: str | Path, told: Callable[[int], None]) -> None:
    """Compile what a config's robot needs; `told` is given the number of kernels compiled so far.

    Raises RtctlError where a process failed.
    """
    since = time.time()
    env = {**os.environ, "NUMBA_CACHE_DIR": str(folder())}
    command = [sys.executable, "-m", "rtctl.app.warm", str(config)]
    jobs = [
        subprocess.Popen([*command, part], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, env=env)
        for part in ("0", "1")
    ]
    try:
        while any(job.poll() is None for job in jobs):
            told(_made(since))
            time.sleep(POLL)
    finally:
        for job in jobs:
            if job.poll() is None:
                job.kill()
        errors = [(job.communicate()[1] or b"").decode(errors="replace").strip().splitlines() for job in jobs]
    for job, lines in zip(jobs, errors, strict=True):
        if job.returncode:
            raise RtctlError(f"{config}: compilation failed: {lines[-1] if lines else job.returncode}")
    mark = _mark(Path(config))
    mark.parent.mkdir(exist_ok=True)
    for old in sorted(mark.parent.iterdir(), key=lambda path: path.stat().st_mtime)[:-KEPT]:
        old.unlink(missing_ok=True)
    mark.touch()


def _mark(config: Path) -> Path:
    """Return the file that tells that a robot of this kind was warmed, named by all that decides what is compiled."""
    digest = hashlib.sha256(f"{numba.__version__} {sys.version} {is_base(config)}".encode())
    for path in sorted(_ROOT.rglob("*.py")):
        digest.update(str(path.relative_to(_ROOT)).encode() + b"\0" + path.read_bytes())
    return folder() / "warm" / digest.hexdigest()[:32]


def _made(since: float) -> int:
    """Return how many kernels were written to the caches since a time [s]."""
    count = 0
    for module in _entries(folder()):
        for version in _entries(module.path) if module.name.startswith("rtctl.") else ():
            if _written(version) >= since:  # few are, of what may be hundreds
                count += sum(e.name.endswith(".nbi") and _written(e) >= since for e in _entries(version.path))
    return count


def _entries(path: str | Path) -> list[os.DirEntry[str]]:
    """Return what is in a folder, nothing where another process has cleared it away meanwhile."""
    with suppress(OSError), os.scandir(path) as entries:
        return list(entries)
    return []


def _written(entry: os.DirEntry[str]) -> float:
    """Return when a file or a folder was last written to [s], 0 where it is gone."""
    with suppress(OSError):
        return entry.stat().st_mtime
    return 0.0


def _robot(config: Path, part: int) -> None:
    """Build the robot and let its tick do every kind of work, a part of it first."""
    from rtctl.app.choose import vehicle_of

    vehicle = vehicle_of(config)
    robot = vehicle.load(config, None).build()
    vehicle.compile_part(robot, part)
    vehicle.warm(robot)


def _world() -> None:
    """Measure distances to one obstacle of every type, which needs no robot."""
    import numpy as np

    from rtctl.types import ObstacleEdit, Shape
    from rtctl.world import obstacle_table
    from rtctl.world.primitives import TYPES

    far, upright, size = np.array([0.0, 0.0, 50.0]), np.array([1.0, 0.0, 0.0, 0.0]), np.array([0.1, 0.1, 0.1, 2.0])
    shapes = [Shape(k, k, size, far, upright, np.ones(3), np.ones(3)) for k in TYPES if k not in ("mesh", "cloud")]
    cloud = np.array([0.1, 1e-3, 0.0, 0.0])
    shapes.append(Shape("cloud", "cloud", cloud, far, upright, np.ones(3), np.ones(3), cloud=bytes(600)))
    table, _ = obstacle_table.edited(obstacle_table.empty(), tuple(ObstacleEdit(s.name, s) for s in shapes))
    obstacle_table.distance_from(table, np.zeros(3))
    obstacle_table.advanced(table, 1e-3)
    obstacle_table.oldest(table)


if __name__ == "__main__":
    gc.set_threshold(GARBAGE)
    part = int(sys.argv[2])
    if part == 0:
        _world()
    _robot(Path(sys.argv[1]), part)

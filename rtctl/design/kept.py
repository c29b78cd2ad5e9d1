"""Spheres that were placed before, kept beside the compiled kernels: placing takes longer than all else of a start."""

import hashlib
import json
import os
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from rtctl.arm.points import Coverage, Points
from rtctl.design.solids import Solid
from rtctl.kernel.cache import folder, stamp

KEPT = 200  # placements, the latest made


def place_of(solids: Sequence[Solid], overhang: float, module: str, file: str) -> Path:
    """Return the file of what code of a module makes of these solids and overhang [m]: named by all that decides it."""
    digest = hashlib.sha256(f"{stamp(module, file)} {np.__version__} {overhang!r}".encode())
    for s in solids:
        digest.update(f"\n{s.link} {s.name} {s.corners.shape} {s.faces.shape} {s.planes.shape}\n".encode())
        for part in (s.corners, s.faces, s.planes):
            digest.update(part.tobytes())
    return folder() / "points" / f"{digest.hexdigest()[:32]}.json"


def read(path: Path) -> tuple[Points, Coverage] | None:
    """Return what a file keeps; None where there is none, or a bit of it is another: these spheres protect the arm."""
    with suppress(OSError, ValueError, KeyError, TypeError):
        total, _, text = path.read_bytes().partition(b"\n")
        if total.decode() != hashlib.sha256(text).hexdigest():
            return None
        said = json.loads(text)
        points = Points(
            np.array(said["link"], np.int64),
            np.array(said["local"], np.float64),
            np.array(said["radius"], np.float64),
            tuple(map(str, said["names"])),
        )
        fraction, protrusion, beyond = map(float, said["coverage"])
        found = Coverage(fraction, protrusion, beyond, tuple(map(str, said["bare"])))
        m = len(points.names)
        if m and points.link.shape == points.radius.shape == (m,) and points.local.shape == (m, 3):
            return points, found
    return None


def write(path: Path, points: Points, found: Coverage) -> None:
    """Keep a placement; where nothing can be written, it is placed anew the next time."""
    said = {
        "link": points.link.tolist(),
        "local": points.local.tolist(),  # JSON's decimals give the same bits back
        "radius": points.radius.tolist(),
        "names": points.names,
        "coverage": found[:3],
        "bare": found.bare,
    }
    with suppress(OSError):
        path.parent.mkdir(mode=0o700, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=path.parent)
        text = json.dumps(said).encode()
        with open(handle, "wb") as out:
            out.write(hashlib.sha256(text).hexdigest().encode() + b"\n" + text)
        os.replace(name, path)
        for old in sorted(path.parent.iterdir(), key=lambda entry: entry.stat().st_mtime)[:-KEPT]:
            old.unlink(missing_ok=True)

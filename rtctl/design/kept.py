"""What was made of an arm's shapes before, kept beside the kernels: it takes longer than all else of a start."""

import hashlib
import json
import os
import tempfile
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

import numpy as np

from rtctl.arm.points import Coverage, Points
from rtctl.kernel.cache import folder, stamp
from rtctl.plain import Json
from rtctl.types import F64, I64

KEPT = 200  # of a kind, the latest made


def place_of(kind: str, said: str, parts: Iterable[F64 | I64], module: str, file: str) -> Path:
    """Return the file of what code of a module makes of numbers: named by all that decides it.

    said: what else decides it, such as settings and names.
    """
    digest = hashlib.sha256(f"{stamp(module, file)} {np.__version__} {said}".encode())
    for part in parts:
        digest.update(f"\n{part.shape}\n".encode() + part.tobytes())
    return folder() / kind / f"{digest.hexdigest()[:32]}.json"


def known(path: Path) -> Json | None:
    """Return what a file keeps; None where there is none, or a bit of it is another: what it says protects the arm."""
    with suppress(OSError, ValueError):
        total, _, text = path.read_bytes().partition(b"\n")
        if total.decode() == hashlib.sha256(text).hexdigest():
            said = json.loads(text)
            return said if isinstance(said, dict) else None
    return None


def note(path: Path, said: Json) -> None:
    """Keep something; where nothing can be written, it is made anew the next time. JSON's decimals keep every bit."""
    with suppress(OSError):
        path.parent.mkdir(mode=0o700, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=path.parent)
        text = json.dumps(said).encode()
        with open(handle, "wb") as out:
            out.write(hashlib.sha256(text).hexdigest().encode() + b"\n" + text)
        os.replace(name, path)
        for old in sorted(path.parent.iterdir(), key=lambda entry: entry.stat().st_mtime)[:-KEPT]:
            old.unlink(missing_ok=True)


def read(path: Path) -> tuple[Points, Coverage] | None:
    """Return the spheres that a file keeps, None where it keeps none."""
    said = known(path) or {}
    with suppress(ValueError, KeyError, TypeError):
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
    """Keep spheres."""
    said = {
        "link": points.link.tolist(),
        "local": points.local.tolist(),
        "radius": points.radius.tolist(),
        "names": points.names,
        "coverage": found[:3],
        "bare": found.bare,
    }
    note(path, said)

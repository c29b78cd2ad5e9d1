"""Reactive torque-level motion control in operational space."""

import hashlib
import os
from pathlib import Path

__version__ = "0.1.0"


def _kernel_cache() -> Path:
    """Return a folder for compiled kernels that belongs to exactly these sources.

    numba looks only at the file that defines a function: a kernel cached before a change of a function that it calls
    from another file would go on running the old one. A name made from all the sources rules that out.
    """
    here = Path(__file__).resolve().parent
    digest = hashlib.sha256()
    rooms = ("kernel", "protocol", "world", "control", "arm", "rover", "design")
    for path in sorted(path for room in rooms for path in here.glob(f"{room}/**/*.py")):
        digest.update(str(path.relative_to(here)).encode() + b"\0" + path.read_bytes())
    base = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    return Path(base) / "rtctl" / digest.hexdigest()[:16]


os.environ.setdefault("NUMBA_CACHE_DIR", str(_kernel_cache()))

"""The wall clock of some processes, which a test sets as a person or a time server may."""

import mmap
import os
import shutil
import struct
import subprocess
from pathlib import Path

SOURCE = Path(__file__).with_name("clock.c")
_SECONDS = struct.Struct("=q")


class WallClock:
    """Seconds that processes started with `environment` find added to the kernel's time."""

    def __init__(self, folder: Path) -> None:
        """Raises FileNotFoundError without a C compiler, CalledProcessError where it fails."""
        compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
        if compiler is None:
            raise FileNotFoundError("no C compiler")
        library, path = folder / "clock.so", folder / "clock"
        subprocess.run([compiler, "-shared", "-fPIC", "-O1", "-o", library, SOURCE], check=True, capture_output=True)
        path.write_bytes(_SECONDS.pack(0))
        with path.open("r+b") as file:
            self._seconds = mmap.mmap(file.fileno(), 0)
        self.environment = {**os.environ, "LD_PRELOAD": str(library), "ORDEAL_CLOCK": str(path)}

    def set(self, seconds: int) -> None:
        """Put the clock so many seconds before or after the kernel's, at once and for all."""
        self._seconds[:] = _SECONDS.pack(seconds)

"""The wheel, installed into clean environments of several Pythons, and what a user does first there.

    python -m tools.wheels                    # 3.11, 3.12, 3.13, each where it is found
    python -m tools.wheels 3.13 --sim         # also the demo, played: by MuJoCo where pybullet has no wheel

A Python is found on the path, among pyenv's, or through uv. Exit status 1 when one of them failed or none was found.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PYTHONS = ("3.11", "3.12", "3.13")
EXTRAS = "sim,plan,report,rover,view"
MODULES = "pinocchio, coal, numba, viser, foxglove, pymavlink, matplotlib, pyarrow, rtctl"
IMPORTS = f"import {MODULES}; print(rtctl.__version__)"
FIRST = (
    ("-c", IMPORTS),
    ("-m", "rtctl", "--help"),
    ("-m", "rtctl", "init", "ur5", "--out", "mine"),
    ("-m", "rtctl", "check", "mine/ur5.toml"),
    ("-m", "rtctl", "log", "info", str(ROOT / "tests" / "golden" / "stop.mcap")),
)
DEMO = ("-m", "rtctl", "sim", "demo", "--json")


def found(version: str) -> str:
    """Return the interpreter of a version, '' where there is none."""
    versions = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    places = [sys.executable, shutil.which(f"python{version}"), *map(str, versions.glob(f"{version}.*/bin/python"))]
    if shutil.which("uv"):
        uv = subprocess.run(["uv", "python", "find", version], capture_output=True, text=True, check=False)
        places.append(uv.stdout.strip())
    ask = "import sys; print('{}.{}'.format(*sys.version_info))"
    for place in filter(None, places):
        done = subprocess.run([place, "-c", ask], capture_output=True, text=True, check=False)
        if done.stdout.strip() == version:
            return str(place)
    return ""


def built(folder: Path) -> Path:
    """Return the wheel of this source."""
    call = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
    subprocess.run(call, cwd=ROOT, check=True, capture_output=True)
    return next(folder.glob("*.whl"))


def tried(python: str, wheel: Path, folder: Path, steps: Sequence[Sequence[str]]) -> str:
    """Install into a clean environment and do what a user does first; return what failed, '' for nothing."""
    venv = folder / "venv"
    subprocess.run([python, "-m", "venv", str(venv)], check=True)
    own = str(venv / "bin" / "python")
    environment = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
    install = ("-m", "pip", "install", "--quiet", "--disable-pip-version-check", f"{wheel}[{EXTRAS}]")
    for step in (install, *steps):
        done = subprocess.run([own, *step], cwd=folder, env=environment, capture_output=True, text=True, check=False)
        if done.returncode:
            return f"{' '.join(step)[:100]}: {(done.stderr or done.stdout).strip()[-600:]}"
    return ""


def main(argv: Sequence[str] | None = None) -> int:
    """Try the versions; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("versions", metavar="VERSION", nargs="*", help=f"default: {' '.join(PYTHONS)}")
    parser.add_argument("--sim", action="store_true", help="play the demo, too")
    arguments = parser.parse_args(argv)
    failed = tested = 0
    with tempfile.TemporaryDirectory(prefix="rtctl-wheels-") as name:
        wheel = built(Path(name))
        for version in arguments.versions or PYTHONS:
            python = found(version)
            if not python:
                print(f"{version}: no such Python here; pyenv or uv bring one", flush=True)
                continue
            folder = Path(name) / version
            folder.mkdir()
            begun = time.monotonic()
            why = tried(python, wheel, folder, (*FIRST, *((DEMO,) if arguments.sim else ())))
            tested, failed = tested + 1, failed + bool(why)
            fine = "installed, imported, init, check, log info" + (", demo" if arguments.sim else "")
            print(f"{version}: {why or fine}", end="", flush=True)
            print(f", {time.monotonic() - begun:.0f} s", flush=True)
    return 1 if failed or not tested else 0


if __name__ == "__main__":
    sys.exit(main())

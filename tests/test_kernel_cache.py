"""Compiled kernels are kept by what they are made of: told from numba's own counts of what it loaded and compiled."""

import ast
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from rtctl.app import warm
from rtctl.kernel.cache import VERSIONS, stamp
from tests.test_architecture import ROOT, imports, modules

LOW = "from rtctl.kernel import kernel\n\n@kernel\ndef low(x):\n    return x * 2.0\n"
HIGH = (
    "from rtctl.kernel import kernel\nfrom lab.low import (\n    low,\n)\n\n"
    "@kernel\ndef high(x):\n    return low(x) + 1.0\n"
)
ASIDE = "from rtctl.kernel import kernel\n\n@kernel\ndef aside(x):\n    return -x\n"
LAYOUT = "import numpy as np\n\nSTATE = np.dtype([('x', 'f8'), ('y', 'f8')], align=True)\n"
RECORD = (
    "from rtctl.kernel import kernel\n\n@kernel\ndef inner(s):\n    return s['y']\n\n"
    "@kernel\ndef y_of(s):\n    return inner(s)\n"
)
RUN = """
import ast
import json
import numpy as np
from lab.low import low
from lab.high import high
from lab.aside import aside
from lab.layout import STATE
from lab.record import y_of
state = np.zeros((), STATE)
state['x'], state['y'] = 3.0, 5.0
values = [high(1.0), low(1.0), aside(1.0), y_of(state[()])]
compiled = [f.__name__ for f in (high, low, aside, y_of) if sum(f.stats.cache_misses.values())]
print(json.dumps([values, compiled]))
"""


@pytest.fixture
def lab(tmp_path: Path) -> Path:
    folder = tmp_path / "lab"
    folder.mkdir()
    sources = {"low": LOW, "high": HIGH, "aside": ASIDE, "layout": LAYOUT, "record": RECORD, "__init__": ""}
    for name, text in sources.items():
        (folder / f"{name}.py").write_text(text)
    return folder


def run(lab: Path, **settings: str) -> tuple[list[float], list[str]]:
    """Return what the kernels give in a new process, and which of them were compiled there."""
    env = {k: v for k, v in os.environ.items() if k != "NUMBA_CACHE_DIR"}
    env |= {"PYTHONPATH": f"{lab.parent}:{ROOT}", "XDG_CACHE_HOME": str(lab.parent / "cache"), **settings}
    done = subprocess.run([sys.executable, "-c", RUN], env=env, capture_output=True, text=True, check=True)
    values, compiled = json.loads(done.stdout)
    return values, compiled


def test_a_change_recompiles_what_depends_on_it_and_nothing_else(lab: Path) -> None:
    assert run(lab) == ([3.0, 2.0, -1.0, 5.0], ["high", "low", "aside", "y_of"])
    assert run(lab) == ([3.0, 2.0, -1.0, 5.0], [])
    (lab / "low.py").write_text(LOW.replace("2.0", "7.0"))
    assert run(lab) == ([8.0, 7.0, -1.0, 5.0], ["high", "low"])
    (lab / "low.py").write_text(LOW)  # both versions are there
    assert run(lab) == ([3.0, 2.0, -1.0, 5.0], [])


def test_another_layout_of_a_record_is_another_kernel(lab: Path) -> None:
    """The kernel's module does not import the layout; what numba is called with tells them apart."""
    assert run(lab)[0][3] == 5.0
    for text in (
        LAYOUT.replace("('x'", "('z', 'f8'), ('x'"),
        LAYOUT.replace("('x', 'f8'), ('y', 'f8')", "('y', 'f8'), ('x', 'f8')"),
    ):
        (lab / "layout.py").write_text(text)
        assert run(lab) == ([3.0, 2.0, -1.0, 5.0], ["y_of"])
        assert run(lab) == ([3.0, 2.0, -1.0, 5.0], [])
    (lab / "layout.py").write_text(LAYOUT)
    assert run(lab) == ([3.0, 2.0, -1.0, 5.0], [])


def test_old_versions_are_let_go(lab: Path) -> None:
    home = lab.parent / "cache" / "rtctl" / "lab.low"
    for k in range(VERSIONS + 2):
        (home / f"old{k}").mkdir(parents=True)
        os.utime(home / f"old{k}", (k, k))
    run(lab)
    kept = {path.name for path in home.iterdir()}
    assert len(kept) == VERSIONS
    assert not kept & {"old0", "old1", "old2"}


def test_a_folder_that_another_process_lets_go_of_meanwhile_is_made_again(lab: Path) -> None:
    """The other's part is played at the worst moment: when numba has seen to the folder and is about to write."""
    pruned = (
        "import shutil\nfrom numba.core.caching import IndexDataCacheFile as File\nsave, seen = File.save, set()\n"
        "def pruned(self, *what):\n"
        "    if self._index_path not in seen:\n"
        "        seen.add(self._index_path)\n"
        "        shutil.rmtree(self._cache_path)\n"
        "    save(self, *what)\n"
        "File.save = pruned\n"
    )
    env = {k: v for k, v in os.environ.items() if k != "NUMBA_CACHE_DIR"}
    env |= {"PYTHONPATH": f"{lab.parent}:{ROOT}", "XDG_CACHE_HOME": str(lab.parent / "cache")}
    done = subprocess.run([sys.executable, "-c", pruned + RUN], env=env, capture_output=True, text=True, check=True)
    assert json.loads(done.stdout)[0] == [3.0, 2.0, -1.0, 5.0]
    assert run(lab) == ([3.0, 2.0, -1.0, 5.0], [])


def test_a_folder_that_others_may_write_is_not_taken(lab: Path) -> None:
    (lab.parent / "cache" / "rtctl").mkdir(parents=True)
    (lab.parent / "cache" / "rtctl").chmod(0o777)
    other = lab.parent / "tmp"
    other.mkdir()
    assert run(lab, TMPDIR=str(other))[0][0] == 3.0
    assert not any((lab.parent / "cache" / "rtctl").iterdir())
    assert (other / f"rtctl-kernels-{os.geteuid()}" / "lab.high").is_dir()


def test_a_stamp_follows_every_import_of_the_program() -> None:
    """The imports that a stamp follows are at least those that Python's own parser finds."""
    from rtctl.kernel import cache

    known = modules("rtctl")
    tops = (("rtctl", ROOT),)
    for name in known:
        assert imports(known, name) <= set(cache._source(tops, name)[1]), name
    written = {name: path for name, path in known.items() if path.read_text(encoding="utf-8").strip()}
    alike: dict[str, set[str]] = {}
    for name, path in written.items():
        alike.setdefault(stamp(name, str(path)), set()).add(name)
    for group in alike.values():  # more than one only where each reaches the others, through what their package imports
        assert all(group - {name} <= reached(tops, name) for name in group), group


def reached(tops: tuple[tuple[str, Path], ...], name: str) -> set[str]:
    """Return the modules that a module imports, directly or not."""
    from rtctl.kernel import cache

    found: set[str] = set()
    waiting = [name]
    while waiting:
        new = set(cache._source(tops, waiting.pop())[1]) - found
        found |= new
        waiting += new
    return found


def test_two_processes_share_the_work(lab: Path) -> None:
    """Each kernel is compiled by one of two that start at once; the other loads it."""
    env = {k: v for k, v in os.environ.items() if k != "NUMBA_CACHE_DIR"}
    env |= {"PYTHONPATH": f"{lab.parent}:{ROOT}", "XDG_CACHE_HOME": str(lab.parent / "cache")}
    jobs = [subprocess.Popen([sys.executable, "-c", RUN], env=env, stdout=subprocess.PIPE, text=True) for _ in range(2)]
    told = [json.loads(job.communicate()[0]) for job in jobs]
    assert [values for values, _ in told] == [[3.0, 2.0, -1.0, 5.0]] * 2
    folders = lab.parent / "cache" / "rtctl"
    assert len(list(folders.glob("lab.*/*/*.nbi"))) == len(list(folders.glob("lab.*/*/*.nbc"))) == 5


def test_as_many_kernels_are_announced_as_there_are_decorated_functions():
    trees = [ast.parse(path.read_text(encoding="utf-8")) for path in (ROOT / "rtctl").rglob("*.py")]
    functions = [node for tree in trees for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    names = [d.id for function in functions for d in function.decorator_list if isinstance(d, ast.Name)]
    assert warm.kernels() == sum(name.endswith("kernel") for name in names)


def test_a_kernel_loads_no_linear_algebra_of_scipy_and_one_that_asks_for_it_has_it() -> None:
    script = (
        "import sys, numpy, numba; from rtctl.kernel.reductions import norm; length = norm(numpy.ones(4));"
        "before = 'scipy.linalg' in sys.modules; twice = numba.njit(lambda A: A @ A)(2.0 * numpy.eye(2));"
        "print(length, before, twice.tolist(), 'scipy.linalg' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.split(" ", 2)[:2] == ["2.0", "False"]
    assert done.stdout.strip().endswith("[[4.0, 0.0], [0.0, 4.0]] True")

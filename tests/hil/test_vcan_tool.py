"""tools.vcan runs a command beside vcan0 as if it ran here, and leaves nothing behind."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from rtctl.kernel.cache import stamp
from tools import vcan

ROOT = Path(vcan.__file__).resolve().parent.parent


def processes(token: str) -> list[str]:
    """Command lines of living processes that hold the token."""
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            line = path.read_bytes().replace(b"\0", b" ").decode(errors="replace")
        except OSError:  # it ended meanwhile
            continue
        if token in line and str(os.getpid()) != path.parent.name:
            found.append(line)
    return found


def left(token: str) -> list[str]:
    """Processes with the token that are still there after what a kill takes to be carried out."""
    for _ in range(100):
        if not processes(token):
            return []
        time.sleep(0.1)
    return processes(token)


@pytest.mark.usefixtures("venue")
def test_status_streams_directory_and_environment_come_through() -> None:
    out, err = bytearray(), bytearray()
    script = (
        'cat /sys/class/net/vcan0/mtu; pwd; echo "$WORD"; test -t 1 || echo pipe; printf "\\000\\r\\n" >&2; exit 42'
    )
    env = os.environ | {"WORD": 'it\'s "quoted" $HOME ü\nand two lines'}
    status = vcan.run(["sh", "-c", script], timeout=120, cwd=ROOT, env=env, out=out.extend, err=err.extend)
    assert out.decode() == f"72\n{ROOT}\n{env['WORD']}\npipe\n"
    assert bytes(err) == b"\0\r\n"
    assert status == 42


@pytest.mark.usefixtures("venue")
def test_a_hung_command_is_killed_and_leaves_no_process() -> None:
    token = "1033"
    script = f'trap "" TERM INT HUP; sleep {token}00 & while :; do :; done'
    assert vcan.run(["sh", "-c", script], timeout=6, out=bytes, err=bytes, memory=f"{token}M") == vcan.TIMED_OUT
    assert left(token) == []


@pytest.mark.usefixtures("venue")
def test_nothing_outlives_a_caller_that_is_killed() -> None:
    token = "1034"
    command = [
        sys.executable,
        "-m",
        "tools.vcan",
        "--memory",
        f"{token}M",
        "--",
        "sh",
        "-c",
        f"echo up; sleep {token}00",
    ]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE) as caller:
        assert caller.stdout is not None
        assert caller.stdout.readline() == b"up\n"
        assert processes(token)
        caller.send_signal(signal.SIGKILL)
    assert left(token) == []


def test_a_guest_is_given_the_kernels_of_these_sources_alone(tmp_path: Path) -> None:
    """A cache that many versions filled was larger than a guest's memory, and the guest died of it."""
    source = ROOT / "rtctl/arm/law.py"
    present = tmp_path / "rtctl.arm.law" / stamp("rtctl.arm.law", str(source))[:16]
    for folder in (present, present.with_name("0" * 16), tmp_path / "rtctl.gone" / present.name, tmp_path / "points"):
        folder.mkdir(parents=True)
    assert vcan._present(tmp_path) == [tmp_path / "points", present]


def test_where_it_cannot_run_it_names_the_command_that_helps() -> None:
    script = (
        "from tools import vcan; vcan._af_can = vcan._state_too_large = lambda: False; print(vcan.available().reason)"
    )
    env = {"PATH": "/nonexistent", "PYTHONPATH": str(ROOT)}
    code = f"import tools.vcan; tools.vcan.SBIN = '/nonexistent'; {script}"
    told = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, check=True).stdout
    assert "no AF_CAN" in told
    assert vcan.INSTALL in told

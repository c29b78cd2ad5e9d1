"""The unit of a rover: what it allows, as systemd judges it, and a start where nothing else is allowed."""

import os
import shutil
import signal
import subprocess
import sys
import time
from configparser import ConfigParser
from pathlib import Path

import pytest

from rtctl.errors import EXIT_CONFIG, EXIT_OK, EXIT_USAGE
from rtctl.kernel.cache import folder
from tests.base_lab import CONFIGS, ROVER

ROOT = Path(__file__).parent.parent
UNIT = CONFIGS / "rtctl-rover@.service"
EXPOSURE = 2.0  # of 10, at most
SANDBOX = """
set -e
mount --make-rprivate /
mount --bind / /
for place in "$1" "$2"; do mount --bind "$place" "$place"; done
mount -o remount,bind,ro /
ip link set lo up
shift 2
exec setpriv --no-new-privs --bounding-set=-all --inh-caps=-all "$@"
"""


def service() -> dict[str, list[str]]:
    """Return the keys of the unit's [Service] with all their values."""
    found: dict[str, list[str]] = {}
    for line in UNIT.read_text().splitlines():
        key, equals, value = line.partition("=")
        if equals and not line.startswith("#"):
            found.setdefault(key, []).append(value)
    return found


def test_the_unit_waits_for_the_vehicle_and_tries_again_only_what_trying_can_cure():
    parser = ConfigParser(strict=False, interpolation=None)
    parser.read(UNIT)
    assert parser["Service"]["type"] == "notify"
    keys = service()
    assert keys["TimeoutStartSec"] == ["infinity"]  # ready is told when the vehicle is there
    assert keys["Restart"] == ["on-failure"]
    assert set(keys["RestartPreventExitStatus"][0].split()) == {str(EXIT_CONFIG), str(EXIT_USAGE)}


def test_it_allows_its_link_and_nothing_else():
    keys = service()
    assert set(keys["RestrictAddressFamilies"][0].split()) == {"AF_UNIX", "AF_INET", "AF_INET6"}
    assert keys["IPAddressDeny"] == ["any"]
    assert keys["IPAddressAllow"] == ["localhost"]
    assert keys["SocketBindDeny"] == ["any"]
    ports = {allowed.removeprefix("udp:") for allowed in keys["SocketBindAllow"]}
    shipped = {
        path.read_text().partition('url = "udpin:127.0.0.1:')[2].partition('"')[0]
        for path in (ROVER, CONFIGS / "rover_px4.toml")
    }
    assert ports == shipped
    assert keys["DevicePolicy"] == ["closed"]
    lines = {device.split()[0] for device in keys["DeviceAllow"]}
    assert lines == {f"char-tty{kind}" for kind in ("ACM", "USB", "AMA", "THS", "S")} | {"/dev/cpu_dma_latency"}
    assert keys["CapabilityBoundingSet"] == keys["AmbientCapabilities"] == [""]


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="needs systemd-analyze")
def test_systemd_itself_finds_little_exposed():
    words = ["systemd-analyze", "security", "--offline=true", f"--threshold={round(10 * EXPOSURE)}", str(UNIT)]
    done = subprocess.run(words, capture_output=True, text=True)
    if "nknown option" in done.stderr or "unrecognized" in done.stderr:
        pytest.skip("this systemd-analyze judges no files")
    assert done.returncode == 0, done.stdout[-400:] + done.stderr


def _may_make_namespaces() -> bool:
    if os.geteuid() != 0 or not all(map(shutil.which, ("unshare", "setpriv", "ip", "mount"))):
        return False
    words = ["unshare", "--mount", "--net", "sh", "-c", "mount --make-rprivate /"]
    return subprocess.run(words, capture_output=True).returncode == 0


@pytest.mark.skipif(not _may_make_namespaces(), reason="needs root, unshare and setpriv")
def test_a_rover_starts_where_it_may_write_its_state_alone_and_has_no_capability(tmp_path):
    """A network with the loopback alone, everything read-only but its state and compiled code, no capabilities."""
    config = tmp_path / "rover.toml"
    text = ROVER.read_text().replace('directory = "logs"', f'directory = "{tmp_path / "logs"}"')
    config.write_text(text + f'\n[console]\nsocket = "{tmp_path / "run" / "s"}"\n')
    shutil.copytree(folder(), tmp_path / f"rtctl-kernels-{os.geteuid()}")  # it looks there: home is read-only
    script = (
        f"{sys.executable} -m firmware_sim {config} & double=$!; "
        f"{sys.executable} -m rtctl run {config} & daemon=$!; "
        "trap 'kill -TERM $daemon' TERM; wait $daemon; wait $daemon; code=$?; kill $double; exit $code"
    )
    words = [
        "unshare",
        "--mount",
        "--net",
        "sh",
        "-c",
        SANDBOX,
        "sandbox",
        str(tmp_path),
        str(ROOT),
        "sh",
        "-c",
        script,
    ]
    environment = {**os.environ, "TMPDIR": str(tmp_path), "PYTHONPATH": str(ROOT), "XDG_RUNTIME_DIR": str(tmp_path)}
    child = subprocess.Popen(
        words,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=environment,
        cwd=tmp_path,
        start_new_session=True,
    )
    assert child.stdout is not None
    said = []
    try:
        for line in child.stdout:
            said.append(line)
            if line.startswith("rtctl: ready"):
                break
        assert any(line.startswith("rtctl: ready") for line in said), "".join(said)
        time.sleep(0.5)
        child.send_signal(signal.SIGTERM)
        said += child.stdout.readlines()
        assert child.wait(20.0) == EXIT_OK, "".join(said)
        assert list((tmp_path / "logs").glob("*.mcap"))
    finally:
        if child.poll() is None:
            os.killpg(child.pid, signal.SIGKILL)
        child.stdout.close()
        child.wait()

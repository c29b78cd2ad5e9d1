"""systemd is told the truth without ever delaying the loop, and a bus has one master."""

import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from configparser import ConfigParser
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from rtctl.errors import EXIT_CONFIG, ConfigError
from rtctl.hal.service import InstanceLock, Service, bus_resource
from tests.strangers import STRANGER, stranger

ROOT = Path(__file__).parent.parent


class Manager:
    """The receiving end of the notify socket."""

    def __init__(self, address: str) -> None:
        self.link = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.link.bind(address)
        self.link.setblocking(False)
        name = self.link.getsockname()
        self.name = name if isinstance(name, str) else "@" + name[1:].decode()

    def heard(self) -> list[str]:
        words = []
        while True:
            try:
                words.append(self.link.recv(4096).decode())
            except BlockingIOError:
                return words


@pytest.fixture(params=["path", "abstract"])
def manager(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Manager]:
    name = str(tmp_path / "notify")
    m = Manager(name if request.param == "path" else "\0" + name)
    yield m
    m.link.close()


def environment(manager: Manager, **more: str) -> dict[str, str]:
    return {"NOTIFY_SOCKET": manager.name, **more}


def test_ready_status_and_stopping_reach_the_manager(manager: Manager) -> None:
    service = Service(0.002, environment(manager))
    service.ready("7 drives answer")
    service.status("RUN\nREADY=0")  # a newline must not become an assignment of its own
    service.stopping()
    service.close()
    assert manager.heard() == ["READY=1\nSTATUS=7 drives answer", "STATUS=RUN READY=0", "STOPPING=1"]


def test_the_watchdog_is_fed_four_times_in_its_period_by_completed_ticks_alone(manager: Manager) -> None:
    service = Service(0.002, environment(manager, WATCHDOG_USEC="400000", WATCHDOG_PID=str(os.getpid())))
    assert manager.heard() == []
    for slot in range(1000, 1200):  # one watchdog period of ticks
        service.kick(slot)
    assert manager.heard() == ["WATCHDOG=1"] * 4
    service.kick(5000)  # slots were skipped: the next completed tick says so at once
    assert manager.heard() == ["WATCHDOG=1"]
    service.close()


@pytest.mark.parametrize(
    "more",
    [{}, {"WATCHDOG_USEC": "0"}, {"WATCHDOG_USEC": "x"}, {"WATCHDOG_USEC": "400000", "WATCHDOG_PID": "1"}],
    ids=["none", "zero", "no number", "another process"],
)
def test_a_watchdog_that_is_not_ours_is_not_fed(manager: Manager, more: dict[str, str]) -> None:
    service = Service(0.002, environment(manager, **more))
    for slot in range(1000):
        service.kick(slot)
    assert manager.heard() == []
    service.close()


def test_without_a_manager_nothing_happens() -> None:
    for environ in ({}, {"NOTIFY_SOCKET": ""}, {"NOTIFY_SOCKET": "relative"}, {"NOTIFY_SOCKET": "/nonexistent/notify"}):
        service = Service(0.002, {**environ, "WATCHDOG_USEC": "1000"})
        service.ready()
        service.kick(1)
        service.stopping()
        service.close()
        service.kick(2)


def test_a_manager_that_does_not_read_never_blocks_the_loop(manager: Manager) -> None:
    service = Service(0.002, environment(manager, WATCHDOG_USEC="2000"))
    for slot in range(5000):  # the queue of the socket is full long before; a blocking send would stop here for ever
        service.kick(slot)
    assert 0 < len(manager.heard()) < 5000
    service.close()


def test_a_second_master_of_a_bus_is_refused_by_name(tmp_path: Path) -> None:
    bus, other = f"socketcan:can0@{tmp_path}", f"socketcan:can1@{tmp_path}"
    with InstanceLock(bus, "link.channel"):
        with pytest.raises(ConfigError, match=f"link.channel: .*process {os.getpid()} of user ") as caught:
            InstanceLock(bus, "link.channel")
        InstanceLock(other, "link.channel").close()
    assert caught.value.exit_code == EXIT_CONFIG
    InstanceLock(bus, "link.channel").close()  # free again


HOLD = """
import sys, time
from rtctl.hal.service import InstanceLock
lock = InstanceLock(sys.argv[1], "link.channel")
print("held", flush=True)
time.sleep(60)
"""


@contextmanager
def held(bus: str, **how: Any) -> Iterator[subprocess.Popen[bytes]]:
    """Let another process hold the lock of a bus."""
    child = subprocess.Popen([sys.executable, "-c", HOLD, bus], stdout=subprocess.PIPE, cwd=ROOT, **how)
    assert child.stdout is not None
    try:
        assert child.stdout.readline() == b"held\n"
        yield child
    finally:
        child.kill()
        child.wait()
        child.stdout.close()


def test_the_lock_of_a_killed_process_is_free_at_once(tmp_path: Path) -> None:
    bus = str(tmp_path)
    with held(bus) as child:
        with pytest.raises(ConfigError, match=f"process {child.pid}"):
            InstanceLock(bus, "link.channel")
        child.send_signal(signal.SIGKILL)
        child.wait()
        InstanceLock(bus, "link.channel").close()


def test_a_child_of_the_holder_does_not_inherit_the_lock(tmp_path: Path) -> None:
    lock = InstanceLock(str(tmp_path), "link.channel")
    words = [sys.executable, "-c", "print('up', flush=True); input()"]
    child = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, close_fds=False)
    assert child.stdout is not None
    assert child.stdout.readline() == b"up\n"  # before it runs, the kernel may still be closing what it must not keep
    lock.close()
    InstanceLock(str(tmp_path), "link.channel").close()
    child.communicate(b"\n")


def test_names_that_look_alike_are_locked_apart(tmp_path: Path) -> None:
    with InstanceLock(f"{tmp_path}/a/b", "x"), InstanceLock(f"{tmp_path}/a-b", "x"):
        pass


def test_a_daemon_that_sees_other_folders_takes_the_same_lock(tmp_path: Path) -> None:
    """The unit has a /tmp of its own and may not write /run/lock; a person who starts it by hand has neither bound."""
    bus, private = str(tmp_path / "bus"), tmp_path / "private"
    private.mkdir()
    with held(bus, env={**os.environ, "TMPDIR": str(private)}), pytest.raises(ConfigError, match="in use by process"):
        InstanceLock(bus, "link.channel")


@pytest.mark.skipif(os.geteuid() != 0, reason="takes another user: run as root")
def test_who_holds_the_lock_is_named_and_passed_over_only_when_an_operator_says_so(tmp_path: Path) -> None:
    bus = str(tmp_path)

    def hold(ready: Callable[[], None]) -> None:
        with InstanceLock(bus, "link.channel"):
            ready()
            signal.pause()

    with stranger(hold) as pid:
        with pytest.raises(ConfigError, match=rf"process {pid} of user .*{STRANGER}"):
            InstanceLock(bus, "link.channel")
        with InstanceLock(bus, "link.channel", ignore=(STRANGER,)), pytest.raises(ConfigError, match="root"):
            InstanceLock(bus, "link.channel", ignore=(STRANGER,))  # the second of ours is refused all the same


def test_two_ways_to_write_one_socket_path_are_one_bus_and_namespaces_have_their_own(tmp_path: Path) -> None:
    assert bus_resource("socketpair", f"{tmp_path}/x/../bus") == bus_resource("socketpair", f"{tmp_path}/bus")
    assert bus_resource("socketcan", "can0") != bus_resource("socketcan", "can1")
    namespace = os.readlink("/proc/self/ns/net")  # net:[4026531840]
    assert namespace.removeprefix("net:[").removesuffix("]") in bus_resource("socketcan", "can0")


def test_the_shipped_unit_holds_what_the_daemon_counts_on() -> None:
    unit = ConfigParser(strict=False, interpolation=None)
    unit.optionxform = str  # type: ignore[assignment,method-assign]
    unit.read(ROOT / "configs" / "rtctl@.service")
    service = unit["Service"]
    assert service["Type"] == "notify"
    assert 0 < int(service["WatchdogSec"].removesuffix("ms")) <= 1000
    assert int(service["LimitRTPRIO"]) >= 80
    assert service["LimitMEMLOCK"] == "infinity"
    assert str(EXIT_CONFIG) in service["RestartPreventExitStatus"].split()  # a refused config is not tried again
    assert service["Restart"] == "on-failure"
    assert service["MemoryMax"]
    assert service["RuntimeDirectoryMode"] == "0750"
    assert service.get("MemoryDenyWriteExecute", "no") == "no"  # numba compiles
    assert service.get("RestrictRealtime", "no") == "no"
    assert "AF_CAN" in service["RestrictAddressFamilies"].split()
    assert "AF_UNIX" in service["RestrictAddressFamilies"].split()

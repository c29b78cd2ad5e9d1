"""Run a command where a real SocketCAN interface vcan0 exists, without touching the host's network.

    python -m tools.vcan -- python -m pytest tests/hil/guest
    python -m tools.vcan --where

Where the kernel has AF_CAN the command runs in a network and process namespace of its own with a fresh vcan0. Where
it has none (containers, CI) it runs in a user-mode-linux guest: a whole kernel in one ordinary process that sees the
host's files through hostfs, so the checkout and the virtual environment are used where they are. Either way the working
directory and environment are kept, standard output, standard error and the exit status come through, nothing that the
command started outlives it, and several may run at once. Standard input is empty. A guest works on copies of rtctl/,
firmware_sim/ and numba's cache: what it writes there is lost, what it writes elsewhere in the checkout stays.
"""

import argparse
import functools
import os
import re
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from types import FrameType
from typing import Literal, NamedTuple

from rtctl.kernel.cache import folder as kernel_folder
from rtctl.kernel.cache import stamp
from tools.child import Sink, exit_status, guarded, pipe, pump, writer

ROOT = Path(__file__).resolve().parent.parent
CHANNEL = "vcan0"
MARK = "RTCTL_VCAN"  # set in the environment of a command that runs beside vcan0
INSTALL = "apt-get update && apt-get install -y user-mode-linux kmod iproute2 can-utils"
KERNEL, MODULES = "linux.uml", Path("/usr/lib/uml/modules")
TIMED_OUT, UNAVAILABLE = 124, 125  # as timeout(1) and container runners report them
SBIN = "/usr/local/sbin:/usr/sbin:/sbin"


class VcanError(Exception):
    """vcan0 cannot be had here, or the guest died before the command ended."""


class Venue(NamedTuple):
    """Where a command would meet vcan0: beside an existing one, in a namespace, in a guest or nowhere."""

    kind: Literal["here", "namespace", "guest", "none", "never"]  # never: no install would cure it
    reason: str

    def __bool__(self) -> bool:
        return self.kind not in ("none", "never")


@functools.cache
def available() -> Venue:
    """Where a command would run; falsy with the reason and the install command where it cannot."""
    if os.environ.get(MARK):
        return Venue("here", f"{CHANNEL} is already up around this process")
    native = _af_can()
    if native and _namespace_flags() is not None:
        return Venue("namespace", "this kernel has AF_CAN: a namespace of its own")
    missing = [tool for tool in (KERNEL, "insmod", "ip", "unshare") if _which(tool) is None]
    if not missing and not list(MODULES.glob("*/kernel/drivers/net/can/vcan.ko")):
        missing = [f"{MODULES}/*/kernel/drivers/net/can/vcan.ko"]
    if _state_too_large():
        return Venue(
            "never", f"no AF_CAN here, and a {KERNEL} guest cannot save this processor's AMX registers: it dies"
        )
    if not missing:
        return Venue("guest", f"a {KERNEL} guest")
    why = f"{CHANNEL} may not be created" if native else "this kernel has no AF_CAN"
    return Venue("none", f"{why} and a guest lacks {', '.join(missing)}: as root run `{INSTALL}`")


def _state_too_large() -> bool:
    """Return whether user-mode Linux dies here at its first process: its room for registers ends before AMX tiles."""
    cpuinfo = Path("/proc/cpuinfo")
    return cpuinfo.exists() and " amx_tile" in cpuinfo.read_text()


def run(
    command: Sequence[str],
    *,
    timeout: float = 900.0,
    cwd: Path | None = None,
    env: Mapping[str, str] | None = None,
    out: Sink | None = None,
    err: Sink | None = None,
    memory: str = "2G",
) -> int:
    """Exit status of the command, run beside vcan0; TIMED_OUT if it was killed after `timeout` [s].

    `out` and `err` are called with the bytes it prints, as it prints them (default: this process's own streams).
    Raises VcanError where vcan0 cannot be had or the guest dies.
    """
    venue = available()
    if not venue:
        raise VcanError(venue.reason)
    here = Path.cwd() if cwd is None else cwd.resolve()
    inside = dict(os.environ if env is None else env) | {MARK: CHANNEL}
    inside["PATH"] = f"{inside.get('PATH', os.defpath)}:{SBIN}"
    sinks = (out or writer(1), err or writer(2))
    with tempfile.TemporaryDirectory(prefix="rtctl-vcan-", dir="/tmp") as name:
        scratch = Path(name)
        if venue.kind == "guest":
            return _in_guest(command, timeout, here, inside, sinks, memory, scratch)
        if venue.kind == "namespace":
            inside["XDG_RUNTIME_DIR"] = name
            command = ["unshare", *(_namespace_flags() or []), *ISOLATE, "sh", "-c", BRING_UP_NATIVE, "sh", *command]
        return _beside(command, timeout, here, inside, sinks, scratch)


# Everything the command starts lives in a process namespace and dies with it, stopped and orphaned processes included.
ISOLATE = ["--pid", "--fork", "--kill-child=SIGKILL", "--mount-proc"]

BRING_UP = f"""\
ip link set lo up &&
ip link add dev {CHANNEL} type vcan &&
ip link set {CHANNEL} mtu 72 txqueuelen 128 &&
ip link set {CHANNEL} up || exit {UNAVAILABLE}
"""

# Not exec: as process 1 of its namespace the shell reaps orphans, and the command keeps its default signal handling.
BRING_UP_NATIVE = BRING_UP + '"$@"\nexit $?\n'


def _beside(
    command: Sequence[str], timeout: float, cwd: Path, env: Mapping[str, str], sinks: tuple[Sink, Sink], scratch: Path
) -> int:
    """The command as a child of this process, its streams pumped into the sinks."""
    with ExitStack() as stack:
        ends = [pipe(stack) for _ in sinks]
        child = subprocess.Popen(
            command,
            cwd=cwd,
            env=env,
            stdin=subprocess.DEVNULL,
            stdout=ends[0][1],
            stderr=ends[1][1],
            start_new_session=True,
        )
        stack.enter_context(guarded(child, scratch))
        for _, write_end in ends:
            os.close(write_end)
        ended = pump({ends[0][0]: sinks[0], ends[1][0]: sinks[1]}, time.monotonic() + timeout, child)
        return exit_status(child.wait()) if ended else TIMED_OUT


def _in_guest(
    command: Sequence[str],
    timeout: float,
    cwd: Path,
    env: Mapping[str, str],
    sinks: tuple[Sink, Sink],
    memory: str,
    scratch: Path,
) -> int:
    """The command in a user-mode-linux guest: serial lines carry its two streams and its exit status."""
    copies = _pack(scratch, env)
    init = scratch / "init"
    init.write_bytes(os.fsencode(_init_script(command, cwd, env, copies, scratch)))
    init.chmod(0o700)
    console, status = bytearray(), bytearray()
    with ExitStack() as stack:
        ends = [pipe(stack) for _ in range(4)]  # console, stdout, stderr, status
        kernel = _which(KERNEL) or KERNEL
        arguments = ["root=/dev/root", "rootfstype=hostfs", "rootflags=/", "rw", f"mem={memory}", f"init={init}"]
        arguments += [f"uml_dir={scratch}/", "umid=guest", *QUICK, "con=null", f"con0=null,fd:{ends[0][1]}"]
        arguments += [f"ssl{i}=null,fd:{write_end}" for i, (_, write_end) in enumerate(ends[1:])]
        guest = subprocess.Popen(
            [kernel, *arguments],
            cwd="/",
            env={"PATH": env["PATH"], "HOME": str(scratch), "TMPDIR": _memory_directory(memory, scratch)},
            stdin=subprocess.DEVNULL,
            stdout=ends[0][1],
            stderr=ends[0][1],
            pass_fds=[write_end for _, write_end in ends],
            start_new_session=True,
        )
        stack.enter_context(guarded(guest, scratch))
        for _, write_end in ends:
            os.close(write_end)
        pumps = dict(zip((read_end for read_end, _ in ends), (console.extend, *sinks, status.extend), strict=True))
        ended = pump(pumps, time.monotonic() + timeout, guest, done=lambda: status.endswith(b"\n"))
    if not ended:
        return TIMED_OUT
    if not re.fullmatch(rb"\d+\s*", bytes(status)):
        tail = bytes(console).decode(errors="replace").strip().splitlines()[-15:]
        raise VcanError("\n".join(["the guest died before the command ended; its console:", *tail]))
    return int(status)


def _init_script(
    command: Sequence[str], cwd: Path, env: Mapping[str, str], copies: Sequence[Path], scratch: Path
) -> str:
    """Process 1 of the guest: mounts, modules, vcan0, the command, its status on the third serial line, power off."""
    inside = dict(env) | {"TMPDIR": "/run/tmp", "XDG_RUNTIME_DIR": "/run/user"}
    exports = [f"export {k}={shlex.quote(v)}" for k, v in inside.items() if re.fullmatch(r"[A-Za-z_]\w*", k)]
    binds = [
        f"mkdir -p {shlex.quote(f'/run/copies{path}')} && "
        + shlex.join(["mount", "--bind", f"/run/copies{path}", str(path)])
        for path in copies
    ]
    return "\n".join(
        [
            "#!/bin/sh",
            f"export PATH=/usr/bin:/bin:{SBIN}",
            GUEST_MOUNTS,
            f"tar -xf {scratch}/copies.tar -C /run/copies",
            *binds,
            GUEST_MODULES,
            f"({BRING_UP})",
            "echo $? > /run/status",
            *exports,
            'if [ "$(cat /run/status)" = 0 ]; then',
            shlex.join(["unshare", *ISOLATE, "sh", "-c", RUN_GUEST, "sh", str(cwd), *command]),
            "echo $? > /run/status",
            "fi </dev/null >/run/out 2>/run/err",
            "wait",
            "sync",
            "cat /run/status > /dev/ttyS2",
            "echo o > /proc/sysrq-trigger",
            "sleep 60",
            "",
        ]
    )


# The kernel would time its RAID 6 routines for half of its boot.
QUICK = ["quiet", "initcall_blacklist=raid6_select_algo"]

RUN_GUEST = f'cd "$1" || exit {UNAVAILABLE}\nshift\n' + '"$@"\nexit $?\n'

# Pipes between the command and the serial lines: a program that asks must not find a terminal.
# The short write-back time bounds what a killed guest loses of the files it wrote on the host.
GUEST_MOUNTS = """\
mount -t proc proc /proc
mount -t sysfs sysfs /sys
mkdir -p /dev/shm /dev/pts
mount -t tmpfs shm /dev/shm
mount -t devpts pts /dev/pts
mount -t tmpfs -o mode=0755 run /run
mkdir -m 1777 /run/tmp
mkdir -m 0700 /run/user
mkdir /run/copies
echo 20 > /proc/sys/vm/dirty_writeback_centisecs
echo 50 > /proc/sys/vm/dirty_expire_centisecs
stty -F /dev/ttyS0 raw -echo
stty -F /dev/ttyS1 raw -echo
stty -F /dev/ttyS2 raw -echo
mkfifo /run/out /run/err
cat /run/out > /dev/ttyS0 &
cat /run/err > /dev/ttyS1 &"""

GUEST_MODULES = f"""\
cd {MODULES}/$(uname -r)/kernel
for module in drivers/net/can/dev/can-dev net/can/can net/can/can-raw net/can/can-bcm net/can/can-gw \\
    drivers/net/can/vcan drivers/net/can/vxcan net/sched/sch_netem; do
    insmod $module.ko
done"""


def _pack(scratch: Path, env: Mapping[str, str]) -> list[Path]:
    """Copies of the compiled packages for the guest, which lays them over the originals; their directories.

    hostfs cuts modification times to whole seconds, so numba's on-disk cache would take every file for a changed one
    and, worse, rewrite the host's cache so. A tar archive keeps the nanoseconds.
    """
    kernels = kernel_folder().resolve()
    sources = [ROOT / "rtctl", ROOT / "firmware_sim"]
    names = [str(path.relative_to("/")) for path in (*sources, *_present(kernels))]
    archive = ["tar", "--format=pax", "--warning=none", "-C", "/", "-cf", str(scratch / "copies.tar"), *names]
    if subprocess.run(archive, check=False).returncode > 1:  # 1: a file changed while it was read
        raise VcanError(f"could not pack {', '.join(names)} for the guest")
    return [*sources, kernels]


def _present(kernels: Path) -> list[Path]:
    """What the present sources look for in a cache: one of many versions is larger than a guest's memory."""
    found = []
    for entry in sorted(kernels.iterdir()):
        source = ROOT.joinpath(*entry.name.split(".")).with_suffix(".py")
        if source.is_file():
            ours = stamp(entry.name, str(source))
            found += [version for version in entry.iterdir() if ours.startswith(version.name)]
        elif "." not in entry.name:  # of no module: spheres, marks, and the drives' own
            found.append(entry)
    return found


def _memory_directory(memory: str, scratch: Path) -> str:
    """Directory for the guest's memory file: /dev/shm unless it is small (containers) or forbids execution."""
    need = int(memory[:-1]) << {"K": 10, "M": 20, "G": 30}[memory[-1].upper()]
    with suppress(OSError):
        shm = os.statvfs("/dev/shm")
        if shm.f_bavail * shm.f_frsize > need and not shm.f_flag & os.ST_NOEXEC:
            return "/dev/shm"
    return str(scratch)


def _which(tool: str) -> str | None:
    return shutil.which(tool, path=f"{os.environ.get('PATH', os.defpath)}:{SBIN}")


def _af_can() -> bool:
    """True where this kernel has SocketCAN."""
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError:
        return False
    return True


@functools.cache
def _namespace_flags() -> list[str] | None:
    """Flags with which unshare(1) can make a namespace that has a vcan0; None where it cannot."""
    for flags in (["--net"], ["--user", "--map-root-user", "--net"]):
        command = ["unshare", *flags, *ISOLATE, "sh", "-c", BRING_UP]
        with suppress(OSError, subprocess.TimeoutExpired):
            env = os.environ | {"PATH": f"{os.environ.get('PATH', os.defpath)}:{SBIN}"}
            if subprocess.run(command, capture_output=True, env=env, timeout=10, check=False).returncode == 0:
                return flags
    return None


def _interrupted(number: int, frame: FrameType | None) -> None:
    """Unwinds, so that the guest is killed, on SIGTERM as on SIGINT."""
    raise SystemExit(128 + number)


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line: see the module."""
    parser = argparse.ArgumentParser(
        prog="python -m tools.vcan",
        description=f"Run a command where a real SocketCAN interface {CHANNEL} exists.",
        epilog="example: python -m tools.vcan -- candump -n 1 vcan0",
    )
    parser.add_argument("--where", action="store_true", help="say where a command would run, and stop")
    parser.add_argument(
        "--timeout", type=float, default=900.0, metavar="S", help="kill it after this time (%(default)s)"
    )
    parser.add_argument("--memory", default="2G", help="of a guest, e.g. 512M (%(default)s)")
    parser.add_argument("command", nargs="*", help="command and its arguments, after --")
    asked = parser.parse_args(arguments)
    venue = available()
    if asked.where or not venue:
        print(f"{venue.kind}: {venue.reason}", file=sys.stdout if venue else sys.stderr)
        return 0 if venue else UNAVAILABLE
    if not asked.command or asked.timeout <= 0 or not re.fullmatch(r"[1-9]\d*[KMGkmg]", asked.memory):
        parser.error("give a command after --, a positive time-out and a memory size such as 512M")
    signal.signal(signal.SIGTERM, _interrupted)
    signal.signal(signal.SIGHUP, _interrupted)
    try:
        status = run(asked.command, timeout=asked.timeout, memory=asked.memory)
    except BrokenPipeError:  # whoever read our output is gone, as in `| head`
        return 128 + signal.SIGPIPE
    except VcanError as error:
        print(f"tools.vcan: {error}", file=sys.stderr)
        return UNAVAILABLE
    if status == TIMED_OUT:
        print(f"tools.vcan: killed after {asked.timeout:g} s", file=sys.stderr)
    return status


if __name__ == "__main__":
    sys.exit(main())

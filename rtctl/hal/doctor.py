"""Can this machine do it: rights, wake-up latency, CAN, clock and room, each with what was wanted."""

import os
import resource
import shutil
import socket
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

from rtctl.errors import EXIT_FAILED, EXIT_OK
from rtctl.plain import Json

OK, WARN, FAIL = "ok", "warn", "FAIL"
PRIORITY = 80  # that loop.priority asks for by default
PERIOD = 0.001  # [s] of the wake-ups that are measured
WAKE_GOOD, WAKE_BAD = 0.3e-3, 1.0e-3  # [s] p99: the budget of a 500 Hz loop; a whole period at 1 kHz
TXQUEUELEN = 64
SHARED_MEMORY = 64 << 20  # bytes, of the largest ring
DISK = 1 << 30  # bytes
ARPHRD_CAN = "280"
CAP_IPC_LOCK, CAP_SYS_NICE = 14, 23
MILLION = 1e6

# Runs in a process of its own, so that this one's scheduler stays as it was.
_WAKES = """
import os, sys, time
n, period, priority = int(sys.argv[1]), float(sys.argv[2]), int(sys.argv[3])
fifo = True
try:
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
except OSError:
    fifo = False
late, due = [], time.monotonic() + period
for _ in range(n):
    time.sleep(max(0.0, due - time.monotonic()))
    now = time.monotonic()
    late.append(now - due)
    due = max(due + period, now)
late.sort()
print(int(fifo), late[n // 2], late[min(n - 1, n * 99 // 100)], late[-1])
"""


class Row(NamedTuple):
    """One finding."""

    name: str
    verdict: str  # ok | warn | FAIL
    got: str
    wanted: str


def examine(root: str = "/", wakes: int = 1000) -> list[Row]:
    """Return all findings; files of the kernel are read below `root`, `wakes` wake-ups are measured."""
    base = Path(root)
    return [
        *_rights(base),
        _wake_up(wakes),
        *_kernel(base),
        *_can(base),
        *_room(base),
    ]


def exit_code(rows: list[Row]) -> int:
    """Return 0 if nothing failed."""
    return EXIT_FAILED if any(row.verdict == FAIL for row in rows) else EXIT_OK


def as_dict(rows: list[Row]) -> Json:
    """Return the findings for --json."""
    return {"ok": exit_code(rows) == EXIT_OK, "findings": [row._asdict() for row in rows]}


def render(rows: list[Row]) -> str:
    """Return the findings as a plain table."""
    widths = [max(len(row[k]) for row in rows) for k in range(3)]
    lines = [f"{r.name:{widths[0]}}  {r.verdict:{widths[1]}}  {r.got:{widths[2]}}  {r.wanted}".rstrip() for r in rows]
    failed = sum(row.verdict == FAIL for row in rows)
    warned = sum(row.verdict == WARN for row in rows)
    return "\n".join([*lines, "", f"{failed} failed, {warned} warnings"])


def _text(path: Path) -> str:
    """Return a file of /proc or /sys, empty when it is not there."""
    try:
        return path.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""


def _rights(base: Path) -> list[Row]:
    capabilities = _capabilities(base)
    priority = resource.getrlimit(resource.RLIMIT_RTPRIO)[0]
    nice = bool(capabilities >> CAP_SYS_NICE & 1)
    lock = bool(capabilities >> CAP_IPC_LOCK & 1)
    memory = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
    unlimited = memory == resource.RLIM_INFINITY
    return [
        Row(
            "real-time priority",
            OK if nice or priority >= PRIORITY or priority == resource.RLIM_INFINITY else FAIL,
            "CAP_SYS_NICE" if nice else f"limit {_limit(priority)}",
            f"limit rtprio of {PRIORITY} or CAP_SYS_NICE",
        ),
        Row(
            "locked memory",
            OK if lock or unlimited else FAIL,
            "CAP_IPC_LOCK" if lock else f"limit {_limit(memory)}",
            "limit memlock unlimited or CAP_IPC_LOCK",
        ),
    ]


def _limit(value: int) -> str:
    return "unlimited" if value == resource.RLIM_INFINITY else str(value)


def _capabilities(base: Path) -> int:
    """Return the effective capabilities of this process as bits."""
    for line in _text(base / "proc" / "self" / "status").splitlines():
        if line.startswith("CapEff:"):
            return int(line.split()[1], 16)
    return 0


def _wake_up(wakes: int) -> Row:
    words = [sys.executable, "-c", _WAKES, str(wakes), str(PERIOD), str(PRIORITY)]
    out = subprocess.run(words, capture_output=True, text=True, check=False)
    if out.returncode != 0:
        return Row("wake-up latency", FAIL, "not measured", "a process that can be started")
    fifo, median, high, top = (float(word) for word in out.stdout.split())
    verdict = OK if high <= WAKE_GOOD else WARN if high <= WAKE_BAD else FAIL
    scheduler = "SCHED_FIFO" if fifo else "normal scheduler"
    figures = f"p50 {median * MILLION:.0f}, p99 {high * MILLION:.0f}, max {top * MILLION:.0f} us ({scheduler})"
    return Row("wake-up latency", verdict, figures, f"p99 at most {WAKE_GOOD * MILLION:.0f} us")


def _kernel(base: Path) -> list[Row]:
    source = _text(base / "sys/devices/system/clocksource/clocksource0/current_clocksource") or "unknown"
    quick = source in ("tsc", "kvm-clock", "arch_sys_counter", "hyperv_clocksource_tsc_page")
    version = _text(base / "proc/version")
    preempt = "PREEMPT_RT" in version or _text(base / "sys/kernel/realtime") == "1"
    share = _text(base / "proc/sys/kernel/sched_rt_runtime_us") or "unknown"
    governor = _text(base / "sys/devices/system/cpu/cpu0/cpufreq/scaling_governor") or "none"
    cores = len(os.sched_getaffinity(0))
    return [
        Row("clock source", OK if quick else WARN, source, "tsc or another that is read without a system call"),
        Row("preemption", OK if preempt else WARN, "PREEMPT_RT" if preempt else "no PREEMPT_RT", "PREEMPT_RT"),
        Row("real-time share", OK if share not in ("0", "unknown") else WARN, f"{share} us a second", "-1 or 950000"),
        Row("CPU governor", OK if governor in ("performance", "none") else WARN, governor, "performance, or none"),
        Row("cores", OK if cores >= 2 else WARN, str(cores), "2: the servo and the recorder"),
    ]


def _can(base: Path) -> list[Row]:
    """Return what the kernel knows of CAN, and one row per interface."""
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
        family = Row("CAN sockets", OK, "available", "modules can, can_raw")
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        # the embedded bus needs none of it: a warning, not a failure
        family = Row("CAN sockets", WARN, reason, "modules can, can_raw; or the embedded bus (socketpair)")
    net = base / "sys/class/net"
    names = sorted(path.name for path in net.glob("*") if _text(path / "type") == ARPHRD_CAN)
    if not names:
        return [family, Row("CAN interfaces", WARN, "none", "one that is up; or the embedded bus (socketpair)")]
    return [family, *(_interface(net / name) for name in names)]


def _interface(path: Path) -> Row:
    """Return the state of one CAN interface."""
    flags = int(_text(path / "flags") or "0", 16)
    queue = int(_text(path / "tx_queue_len") or "0")
    mtu = _text(path / "mtu")
    up = bool(flags & 1)
    got = f"{'up' if up else 'down'}, {'CAN FD' if mtu == '72' else 'classic CAN'}, txqueuelen {queue}"
    verdict = OK if up and queue >= TXQUEUELEN else WARN
    return Row(f"CAN interface {path.name}", verdict, got, f"up, txqueuelen of {TXQUEUELEN} or more")


def _room(base: Path) -> list[Row]:
    rows = []
    for name, place, wanted in (("shared memory", "dev/shm", SHARED_MEMORY), ("disk here", "", DISK)):
        try:
            free = shutil.disk_usage(base / place if place else Path.cwd()).free
        except OSError as error:
            rows.append(Row(name, FAIL, (error.strerror or str(error)).lower(), f"{wanted >> 20} MiB free"))
            continue
        rows.append(Row(name, OK if free >= wanted else WARN, f"{free >> 20} MiB free", f"{wanted >> 20} MiB free"))
    return rows

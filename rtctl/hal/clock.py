"""Time: an absolute grid of slots on the monotonic clock, and what a process may do to keep to it.

CLOCK_REALTIME appears nowhere: somebody may set it while the arm moves.
"""

import ctypes
import errno
import gc
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from rtctl.errors import ConfigError

NS = 1_000_000_000
LATENCY = Path("/dev/cpu_dma_latency")  # root's, unless a rule of udev says otherwise
_TIMER_ABSTIME = 1
_MCL_CURRENT, _MCL_FUTURE = 1, 2
_libc = ctypes.CDLL(None, use_errno=True)


class _Timespec(ctypes.Structure):
    _fields_ = (("seconds", ctypes.c_long), ("nanoseconds", ctypes.c_long))


class Slot(NamedTuple):
    """One turn of the loop."""

    slot: int  # index on the grid, from 0
    missed: int  # slots skipped since the previous turn
    lateness: float  # [s] from the slot's time to the wake-up


def sleep_until(when: int) -> None:
    """Sleep until `when` [ns] of CLOCK_MONOTONIC; a signal may run its handler and end the sleep early."""
    at = _Timespec(when // NS, when % NS)
    code = _libc.clock_nanosleep(time.CLOCK_MONOTONIC, _TIMER_ABSTIME, ctypes.byref(at), None)
    if code not in (0, errno.EINTR):
        raise OSError(code, os.strerror(code))


def grid(
    period: float,
    spin: float = 0.0,
    now: Callable[[], int] = time.monotonic_ns,
    sleep: Callable[[int], None] = sleep_until,
) -> Iterator[Slot]:
    """Yield slots k at start + k * period, for ever; `period` and `spin` [s].

    A slot that was missed is skipped and counted, never made up for: a turn begins late only within the first half of
    its slot, so two turns are never closer than half a period. The last `spin` seconds before a slot are spent awake.
    """
    step, awake = round(period * NS), round(spin * NS)
    start = now() + step
    slot, previous = 0, -1
    while True:
        behind = now() - (start + slot * step)
        if behind > 0:
            slot += (behind + step // 2) // step
        when = start + slot * step
        while when - awake > now():
            sleep(when - awake)
        while (lateness := now() - when) < 0:
            pass
        yield Slot(slot, slot - previous - 1, lateness / NS)
        previous, slot = slot, slot + 1


def lockstep() -> Iterator[Slot]:
    """Yield slots as fast as they are taken: time is what the exchange with the simulator makes of it."""
    slot = 0
    while True:
        yield Slot(slot, 0, 0.0)
        slot += 1


class RealTime(NamedTuple):
    """What the operating system granted; `refused` says why the rest was not."""

    scheduler: bool  # SCHED_FIFO
    memory: bool  # locked: no page fault in the loop
    affinity: bool  # bound to the core that was asked for, if one was
    refused: tuple[str, ...]


def realtime(mode: str, cpu: int = -1, priority: int = 80, place: str = "loop.realtime") -> RealTime:
    """Bind this process to a core (`cpu` < 0: any), lock its memory, raise it to SCHED_FIFO, stop the collector.

    Call it last, when everything is loaded and compiled. `mode` "required" makes each refusal a ConfigError;
    "best-effort" reports it.
    """
    refused: list[str] = []
    affinity = cpu < 0 or _granted(refused, f"core {cpu}", lambda: os.sched_setaffinity(0, {cpu}))
    memory = _granted(refused, "locked memory (memlock limit, CAP_IPC_LOCK)", _lock_memory)
    param = os.sched_param(priority)
    scheduler = _granted(
        refused,
        f"SCHED_FIFO priority {priority} (rtprio limit, CAP_SYS_NICE)",
        lambda: os.sched_setscheduler(0, os.SCHED_FIFO, param),
    )
    if refused and mode == "required":
        raise ConfigError(place, "; ".join(refused), 'these rights, or realtime = "best-effort"')
    quiet_collector()
    return RealTime(scheduler, memory, affinity, tuple(refused))


@contextmanager
def light_sleep(device: Path = LATENCY) -> Iterator[str]:
    """Keep the cores from sleep that takes long to wake from, as far as it is allowed; give the reason if it is not.

    An idle core sleeps the deeper the longer it expects to, and a turn then begins up to 0.1 ms late. The kernel keeps
    to the lowest latency [us] that anybody has written to the device and holds open (its quality-of-service interface
    for power management), so the wish ends with the process, however it ends.
    """
    try:
        wish = os.open(device, os.O_WRONLY)
    except OSError as error:
        yield f"light sleep of the cores ({device}): {os.strerror(error.errno or 0)}"
        return
    try:
        os.write(wish, bytes(4))
        yield ""
    finally:
        os.close(wish)


def quiet_collector() -> None:
    """Collect once, then never again: a collection of everything loaded takes 25 to 100 ms."""
    gc.collect()
    gc.freeze()
    gc.disable()


def _granted(refused: list[str], what: str, ask: Callable[[], None]) -> bool:
    try:
        ask()
    except OSError as error:
        refused.append(f"{what}: {os.strerror(error.errno or 0)}")
        return False
    return True


def _lock_memory() -> None:
    if _libc.mlockall(_MCL_CURRENT | _MCL_FUTURE) != 0:
        code = ctypes.get_errno()
        raise OSError(code, os.strerror(code))

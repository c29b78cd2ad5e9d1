"""What can happen to a daemon and its drives, a step each."""

import os
import random
import resource
import signal
import socket
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from tools.ordeal.clock import WallClock
from tools.ordeal.pair import NO_LIMIT, Failed, Pair, break_sockets, descriptors

LEGAL_ENDS = (0, 1)  # a daemon that may end does so with these
SPARE_DESCRIPTORS = 12  # that a daemon may have more than at its start: callers, a segment


class World:
    """A pair, chance, and what the steps remember."""

    def __init__(self, pair: Pair, rng: random.Random, clock: WallClock | None = None) -> None:
        self.pair, self.rng, self.clock = pair, rng, clock
        self.messages = 0  # of logs that were read
        self.lives = 0
        self.open_at_start = 0
        self.callers: list[socket.socket] = []
        self.full = False  # disk
        self.few = False  # descriptors
        self.start()

    @property
    def pid(self) -> int:
        """The daemon's process id."""
        assert self.pair.daemon is not None
        return self.pair.daemon.popen.pid

    def start(self) -> None:
        """Start what is not there."""
        if self.pair.drives is None or not self.pair.drives.alive:
            self.pair.start_drives()
        self.pair.start_daemon()
        self.lives += 1
        self.open_at_start = descriptors(self.pid)
        self.full = self.few = False

    def ended(self) -> None:
        """Hold the end of a daemon to what is promised, and start the next."""
        for caller in self.callers:
            caller.close()
        self.callers.clear()
        if self.pair.drives is not None and self.pair.drives.alive:
            self.pair.becomes_safe()
        self.pair.nobody_left()
        self.messages += self.pair.are_whole(self.pair.logs())
        self.start()

    def alive(self) -> None:
        """See to it that the daemon runs. Raises Failed."""
        daemon = self.pair.daemon
        assert daemon is not None
        if not daemon.alive:
            raise Failed(f"the daemon ended by itself with {daemon.popen.returncode}: {daemon.text[-1500:]}")

    def callable(self) -> bool:
        """Return whether a new caller must be answered."""
        return not self.few


def verb(w: World) -> None:
    """An operator asks for something, sensible or not."""
    asked = w.rng.choice(("arm", "arm", "arm", "disarm", "stop", "reset", "reset", "recover", "clear"))
    w.pair.ask({"verb": asked})


def goal(w: World) -> None:
    """A goal: near, out of reach, or no goal at all."""
    near = [w.rng.uniform(0.3, 0.6), w.rng.uniform(-0.4, 0.4), w.rng.uniform(0.2, 0.7)]
    position: Any = w.rng.choice((near, near, near, [1e9, 0.0, 0.0], [0.5], "there", None))
    reply = w.pair.ask({"verb": "goal", "position_m": position})
    if position is not near and reply.get("ok"):
        raise Failed(f"a goal at {position} was taken")


def obstacle(w: World) -> None:
    """Something is put into the arm's way, or taken out of it."""
    name = f"thing{w.rng.randrange(4)}"
    at = [w.rng.uniform(-1.0, 1.0), w.rng.uniform(-1.0, 1.0), w.rng.uniform(0.0, 1.0)]
    w.pair.ask({"verb": "obstacle", "set": {"name": name, "type": "sphere", "radius_m": 0.05, "position_m": at}})


def status(w: World) -> None:
    """Somebody looks; what is said of the drives must be so."""
    told = w.pair.status()
    if not told.get("ok", True) or "state" not in told:
        raise Failed(f"status: {told}")


def garbage(w: World) -> None:
    """A caller sends what is no message, and goes."""
    raw = w.rng.choice((b"", b"\xff" * 40, b"{", b"[" * 3000, b'{"verb": 1e999}', w.rng.randbytes(200), b"null"))
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as caller, suppress(OSError):
        caller.settimeout(0.2)
        caller.connect(f"{w.pair.folder}/run/ordeal.sock")
        caller.send(raw)
        if w.rng.random() < 0.5:
            caller.recv(65536)


def crowd(w: World) -> None:
    """Callers who connect and say nothing; the oldest go."""
    for _ in range(w.rng.randrange(1, 8)):
        caller = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_NONBLOCK)
        with suppress(OSError):
            caller.connect(f"{w.pair.folder}/run/ordeal.sock")
        w.callers.append(caller)
    while len(w.callers) > 20:
        w.callers.pop(0).close()


def wait(w: World) -> None:
    """Nothing happens for a while."""
    time.sleep(w.rng.uniform(0.0, 0.05))


def pause(w: World, pid: int, longest: float) -> None:
    """Stop a process and let it go on."""
    with suppress(ProcessLookupError):
        os.kill(pid, signal.SIGSTOP)
        time.sleep(w.rng.uniform(0.0, longest))
        os.kill(pid, signal.SIGCONT)


def pause_daemon(w: World) -> None:
    """The daemon does not run for a while."""
    pause(w, w.pid, 0.2)


def pause_drives(w: World) -> None:
    """The drives are silent for a while."""
    if w.pair.drives is not None and w.pair.drives.alive:
        pause(w, w.pair.drives.popen.pid, 0.2)


def pause_recorder(w: World) -> None:
    """The recorder does not run for a while."""
    for pid in w.pair.children():
        pause(w, pid, 0.3)


def disk(w: World) -> None:
    """The disk is full, or it is not any more: the recorder may make no file any longer."""
    w.full = not w.full
    for pid in w.pair.children():
        w.pair.lossy = True
        with suppress(ProcessLookupError):
            resource.prlimit(pid, resource.RLIMIT_FSIZE, (4096 if w.full else NO_LIMIT, NO_LIMIT))


def few_descriptors(w: World) -> None:
    """The daemon gets no descriptor any more, or does again."""
    w.few = not w.few
    now = descriptors(w.pid)
    hard = resource.prlimit(w.pid, resource.RLIMIT_NOFILE)[1]
    resource.prlimit(w.pid, resource.RLIMIT_NOFILE, (now if w.few else min(hard, 1024), hard))


def kill_recorder(w: World) -> None:
    """The recorder dies."""
    for pid in w.pair.children():
        w.pair.lossy = True
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)


def kill_daemon(w: World) -> None:
    """The daemon dies in whatever it was doing: the drives alone must stop the arm."""
    w.pair.children()
    assert w.pair.daemon is not None
    w.pair.daemon.kill()
    w.ended()


def terminate(w: World) -> None:
    """The daemon is asked to end: at rest, without torque, with exit code 0."""
    w.pair.children()
    assert w.pair.daemon is not None
    for _ in range(w.rng.choice((1, 1, 2))):
        with suppress(ProcessLookupError):
            os.kill(w.pid, signal.SIGTERM)
    code = w.pair.daemon.ended()
    if code not in LEGAL_ENDS:
        raise Failed(f"ended with {code} after SIGTERM: {w.pair.daemon.text[-800:]}")
    w.ended()


def drives_vanish(w: World) -> None:
    """The drives lose power and come back: the daemon lives on, and no torque flows until somebody arms."""
    assert w.pair.drives is not None
    w.pair.drives.kill()
    w.alive()
    w.pair.start_drives()
    if w.pair.truth() is not None and not w.pair.later().safe:
        raise Failed("drives that came back drive")


def breaks(w: World) -> None:
    """One of the daemon's connections breaks: its bus or a caller's; it goes on or ends with the arm at rest."""
    break_sockets(w.pid, w.rng.choice)
    w.pair._session = None
    daemon = w.pair.daemon
    assert daemon is not None
    deadline = time.monotonic() + 1.0
    while daemon.alive and time.monotonic() < deadline:
        time.sleep(0.02)
    w.pair.children()
    if daemon.alive:  # whatever it was: the operator begins anew
        daemon.kill()
    elif daemon.popen.returncode not in LEGAL_ENDS or "Traceback" in daemon.text:
        raise Failed(f"a broken connection: ended with {daemon.popen.returncode}: {daemon.text[-1500:]}")
    w.ended()


def set_clock(w: World) -> None:
    """Somebody sets the wall clock: a little, by a summer time, to 1970, by years; nothing is ordered by it."""
    if w.clock is not None:
        w.clock.set(w.rng.choice((0, -2, 2, -3600, 3600, -int(time.time()), -600_000_000, 600_000_000)))


STEPS: dict[Callable[[World], None], float] = {
    verb: 30.0,
    goal: 20.0,
    obstacle: 10.0,
    status: 20.0,
    garbage: 5.0,
    crowd: 2.0,
    wait: 8.0,
    pause_daemon: 0.5,
    pause_drives: 0.5,
    pause_recorder: 0.5,
    disk: 0.2,
    few_descriptors: 0.2,
    set_clock: 0.5,
    kill_recorder: 0.05,
    kill_daemon: 0.05,
    terminate: 0.05,
    drives_vanish: 0.03,
    breaks: 0.03,
}
HEAVY = (kill_recorder, kill_daemon, terminate, drives_vanish, breaks)


def look(w: World) -> None:
    """Hold daemon, drives and plant to what is promised at any time. Raises Failed."""
    w.alive()
    told = w.pair.status()
    if told["state"] in ("IDLE", "FAULT"):
        first = w.pair.later()
        again = w.pair.status()
        if again["state"] == told["state"] and again["tick"] > told["tick"] and not first.safe:
            raise Failed(f"torque or motion in {told['state']}: {first}")
    opened = descriptors(w.pid) - w.open_at_start - len(w.callers)
    if opened > SPARE_DESCRIPTORS:
        raise Failed(f"{opened} descriptors more than at the start")

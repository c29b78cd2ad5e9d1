"""The guide in a process of its own beside the servo: what it is shown, and what it says, as datagrams.

The servo never waits for it. A guide that is slow gives late advice, one that died gives none: a lead ends by itself
when it is not renewed, and advice about a goal that is gone is dropped.
"""

import os
import pickle
import signal
import socket
from contextlib import suppress

from rtctl.app.guide import PERIOD, Guide, seen_of
from rtctl.arm.memory import Memory
from rtctl.arm.robot import Robot
from rtctl.types import Advice, Status

BUFFER = 1 << 20  # [bytes] of the socket: a cloud among the obstacles fits
WATCHED = 0.05  # [s] between two looks at an arm that gets on


class Inline:
    """The guide in the servo's own process: in lockstep nothing is late."""

    def __init__(self, robot: Robot) -> None:
        self.guide = Guide(robot, plans=False)  # a plan may take longer than drives in lockstep wait

    def begin(self) -> None:
        """Take note of a new goal."""
        self.guide.begin()

    def advise(self, memory: Memory) -> Advice | None:
        """Return the guide's advice."""
        return self.guide.advise(seen_of(memory))

    def close(self) -> None:
        """Do nothing."""


class Adviser:
    """The servo's end: shows what is, takes what is advised."""

    def __init__(self, robot: Robot) -> None:
        """Start the process: a fork, so before the bus is open, before real-time rights and locked memory."""
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        for end in (ours, theirs):
            end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, BUFFER)
        self.pid = os.fork()
        if self.pid == 0:
            _serve(robot, theirs)
        theirs.close()
        ours.setblocking(False)
        self._socket, self._dt = ours, robot.dt
        self._goal, self._led_until = 0, 0  # number of the goal; tick

    def begin(self) -> None:
        """Take note of a new goal: what is advised of an older one is dropped."""
        self._goal += 1
        self._led_until = 0

    def advise(self, memory: Memory) -> Advice | None:
        """Return what was advised since; show what is when that is due."""
        tick, often = memory.tick, memory.tick < self._led_until or memory.status != Status.MOVING
        every = max(1, round((PERIOD if often else WATCHED) / self._dt))
        if self._goal and memory.goal is not None and tick % every == 0:
            with suppress(OSError):  # it is behind: it need not see this
                self._socket.send(pickle.dumps((self._goal, seen_of(memory))))
        try:
            goal, advice = pickle.loads(self._socket.recv(BUFFER))
        except (OSError, EOFError, pickle.UnpicklingError):
            return None
        if goal != self._goal:
            return None
        if advice.leads:
            self._led_until = tick + round(0.5 / self._dt)
        return advice if isinstance(advice, Advice) else None

    def close(self) -> None:
        """End the process: it sees that nobody is there."""
        self._socket.close()
        with suppress(ProcessLookupError, ChildProcessError):
            os.kill(self.pid, signal.SIGKILL)
            os.waitpid(self.pid, 0)


def _serve(robot: Robot, link: socket.socket) -> None:
    """Advise until the other end is gone; never return."""
    code = 1
    try:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # of the terminal: the servo ends first
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        os.closerange(3, link.fileno())
        os.closerange(link.fileno() + 1, 4096)
        guide, known = Guide(robot, robot.plans), 0
        while True:
            raw = link.recv(BUFFER)
            while raw and _waits(link):  # only the newest counts
                raw = link.recv(BUFFER)
            if not raw:
                break
            goal, seen = pickle.loads(raw)
            if goal != known:
                known = goal
                guide.begin()
            advice = guide.advise(seen)
            if advice is not None:
                link.send(pickle.dumps((goal, advice)))
        code = 0
    finally:
        os._exit(code)


def _waits(link: socket.socket) -> bool:
    try:
        return bool(link.recv(1, socket.MSG_PEEK | socket.MSG_DONTWAIT))
    except BlockingIOError:
        return False

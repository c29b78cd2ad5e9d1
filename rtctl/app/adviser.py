"""The guide in a process of its own beside the servo: what it is shown, and what it says, over a pair of sockets.

The servo never waits for it. A guide that is slow gives late advice, one that died gives none: a lead ends by itself
when it is not renewed, and advice about a goal that is gone is dropped.
"""

import os
import pickle
import signal
import socket
import struct
import traceback
from contextlib import suppress

from rtctl.app.guide import PERIOD, Guide, seen_of
from rtctl.arm.memory import Memory
from rtctl.arm.robot import Robot
from rtctl.types import Advice, Status
from rtctl.world.primitives import obstacles_empty

WATCHED = 0.05  # [s] between two looks at an arm that gets on
LED = 0.5  # [s] after advice that leads, for which it is looked at more often
SETTLED = 0.2  # [s] after a goal that followed another as fast, before it is looked at: of a stream only the last is
CHUNK = 1 << 16  # [bytes] read at once
LENGTH = struct.Struct("<Q")  # in front of each message [bytes]
NO_CLOUDS = obstacles_empty(0).clouds


class Inline:
    """The guide in the servo's own process: in lockstep nothing is late."""

    def __init__(self, robot: Robot) -> None:
        self.guide = Guide(robot, plans=False)  # a plan may take longer than drives in lockstep wait
        self.events = self.guide.events

    def begin(self) -> None:
        """Take note of a new goal."""
        self.guide.begin()

    def advise(self, memory: Memory) -> Advice | None:
        """Return the guide's advice."""
        return self.guide.advise(seen_of(memory)) if self.guide.due(memory.tick) else None

    def close(self) -> None:
        """Do nothing."""


class Adviser:
    """The servo's end: shows what is, takes what is advised; neither waits."""

    def __init__(self, robot: Robot) -> None:
        """Start the process: a fork, so while this one has a single thread, no real-time rights, no locked memory."""
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
        self.pid = os.fork()
        if self.pid == 0:
            ours.close()
            _serve(robot, theirs)
        theirs.close()
        ours.setblocking(False)
        self._socket, self._dt, self._dead = ours, robot.dt, False
        self._goal, self._led_until = 0, 0  # number of the goal; tick
        self._new, self._begun, self._settled = False, -(1 << 30), 0  # a goal; ticks: of the last, when it is looked at
        self._out, self._in = memoryview(b""), bytearray()  # what is not sent yet, and not yet whole
        self.events: list[tuple[str, str]] = []  # name, detail; whoever tells them takes them out
        self._clouds = NO_CLOUDS  # that it was shown: one may be longer than all else

    def begin(self) -> None:
        """Take note of a new goal: what is advised of an older one is dropped."""
        self._goal += 1
        self._led_until, self._new = 0, True

    def advise(self, memory: Memory) -> Advice | None:
        """Return what was advised since, the newest; show what is when that is due and the last look is taken."""
        if self._dead or not self._goal:
            return None
        tick, often = memory.tick, memory.tick < self._led_until or memory.status != Status.MOVING
        every = max(1, round((PERIOD if often else WATCHED) / self._dt))
        if self._new:
            wait = round(SETTLED / self._dt)
            self._settled, self._begun = tick + wait if tick - self._begun < wait else tick, tick
            self._new = False
        goal = memory.goal
        looked_at = goal is not None and not goal.streams and tick >= self._settled
        if looked_at and tick % every == 0 and not self._out:
            self._out = memoryview(self._shown(memory))
        if self._out:
            with suppress(BlockingIOError, BrokenPipeError, ConnectionResetError):
                self._out = self._out[self._socket.send(self._out) :]
        advice = self._heard()
        if advice is not None and advice.leads:
            self._led_until = tick + round(LED / self._dt)
        return advice

    def close(self) -> None:
        """End the process and wait until it is gone."""
        self._socket.close()
        with suppress(ProcessLookupError, ChildProcessError):
            os.kill(self.pid, signal.SIGKILL)
            os.waitpid(self.pid, 0)

    def _shown(self, memory: Memory) -> bytes:
        """Return the message of what is to be shown, with the clouds only when they are other ones."""
        seen = seen_of(memory)
        clouds = seen.obstacles.clouds
        same = all(a is b for a, b in zip(clouds, self._clouds, strict=True))
        self._clouds = clouds
        bare = seen._replace(obstacles=seen.obstacles._replace(clouds=NO_CLOUDS))
        return _packed(self._goal, (bare, None if same else clouds))

    def _heard(self) -> Advice | None:
        """Return the newest advice about this goal that has come."""
        try:
            got = self._socket.recv(CHUNK)
        except BlockingIOError:
            return None
        except OSError:
            got = b""
        if not got:
            self._dead = True
            self.events.append(("no_guide", "its process ended: goals are pursued without advice"))
        self._in += got
        newest = None
        for body in _whole(self._in):
            goal, (advice, events) = pickle.loads(body)
            if goal == self._goal:
                newest = advice or newest
                self.events += events
        return newest


def _packed(goal: int, what: object) -> bytes:
    body = pickle.dumps((goal, what))
    return LENGTH.pack(len(body)) + body


def _whole(buffer: bytearray) -> list[bytes]:
    """Take the messages that are whole out of a buffer."""
    out = []
    while len(buffer) >= LENGTH.size:
        end = LENGTH.size + LENGTH.unpack_from(buffer)[0]
        if len(buffer) < end:
            break
        out.append(bytes(buffer[LENGTH.size : end]))
        del buffer[:end]
    return out


def _serve(robot: Robot, link: socket.socket) -> None:
    """Advise until the other end is gone; never return."""
    code = 1
    try:
        os.setsid()  # the terminal's signals are for the servo
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        os.closerange(3, link.fileno())  # bus, console and lock are the servo's alone
        os.closerange(link.fileno() + 1, 4096)
        _advise(Guide(robot, robot.plans), link)
        code = 0
    except ConnectionError:
        code = 0
    except BaseException:
        traceback.print_exc()
    finally:
        os._exit(code)


def _advise(guide: Guide, link: socket.socket) -> None:
    """Answer what is shown, of what waits the newest, until the other end is closed."""
    known, clouds, buffer = 0, NO_CLOUDS, bytearray()
    while True:
        got = link.recv(CHUNK)
        if not got:
            return
        buffer += got
        messages = [pickle.loads(body) for body in _whole(buffer)]
        for _, (_, others) in messages:
            clouds = clouds if others is None else others
        if not messages or _waits(link):
            continue
        goal, (seen, _) = messages[-1]
        if goal != known:
            known = goal
            guide.begin()
        advice = guide.advise(seen._replace(obstacles=seen.obstacles._replace(clouds=clouds)))
        if advice is not None or guide.events:
            link.sendall(_packed(goal, (advice, guide.events)))
            guide.events.clear()


def _waits(link: socket.socket) -> bool:
    try:
        return bool(link.recv(1, socket.MSG_PEEK | socket.MSG_DONTWAIT))
    except BlockingIOError:
        return False

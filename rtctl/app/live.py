"""A simulation that people see while it runs: a ring that viewers look into, and a console as the daemon's."""

import os
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from rtctl.app import daemon
from rtctl.app.servo import Servo
from rtctl.hal.client import default_path
from rtctl.hal.console import Console
from rtctl.log.header import Header
from rtctl.log.record.leftovers import PREFIX, SUFFIX, sweep
from rtctl.log.record.recorder import CAPACITY, Stats, blob_of
from rtctl.log.record.ring import attach, create
from rtctl.types import Request


class Live:
    """The ring and the console of one simulation. Nobody drains the ring: it keeps the last seconds."""

    def __init__(self, header: Header, config: Path, log: Path | None) -> None:
        """Raises LinkError when no ring can be had."""
        self._log = log
        sweep()
        self._ring = create(
            f"{PREFIX}{header.robot}-sim-{os.getpid()}{SUFFIX}", CAPACITY, blob_of(header, config=config)
        )
        self._drain = attach(self._ring.path)
        self._console: Console | None = None

    @property
    def ring(self) -> Path:
        """Return the file that viewers map."""
        return self._ring.path

    def put_many(self, kind: int, payloads: Sequence[bytes], time_ns: int) -> bool:
        """Put entries, and forget the oldest before the ring is full."""
        if self._ring.counts().backlog > CAPACITY // 2:
            self._drain.take(CAPACITY // 4)
            self._drain.release()
        self._ring.beat(time.monotonic_ns())
        return self._ring.put_many(kind, payloads, time_ns)

    def serve(self, servo: Servo[Any, Any, Any, Any]) -> None:
        """Open the console of the robot that is simulated. Raises ConfigError when its daemon runs."""
        vehicle, robot = servo.vehicle, servo.robot
        console = Console(default_path(robot.name), robot.dt, vehicle.bounds(robot, servo.link))
        console.publish(
            lambda: daemon.status(servo, self),
            lambda: daemon.world(servo),
            lambda edit: vehicle.misplaced(robot, servo.memory, edit),
        )
        self._console = console

    def asked(self, slot: int, scripted: Request) -> Request:
        """Return the request of a period: what the scenario asks, and people beside it."""
        if self._console is None:
            return scripted
        by_people = self._console.poll(slot)
        return scripted._replace(
            verb=by_people.verb or scripted.verb,
            goal=by_people.goal if by_people.goal is not None else scripted.goal,
            obstacles=(*scripted.obstacles, *by_people.obstacles),
            payload=by_people.payload,
            grip=by_people.grip or scripted.grip,
        )

    def answer(self, refusal: str) -> None:
        """Tell whoever asked what became of it."""
        if self._console is not None:
            self._console.answer(not refusal, refusal)

    def stats(self) -> Stats:
        """Return the log's state, as a recorder's."""
        counts = self._ring.counts()
        return Stats(counts.number, counts.dropped, 0, counts.backlog, True, False, self._log or Path("none"))

    def close(self) -> None:
        """Tell viewers that nothing more will come, and remove ring and socket."""
        if self._console is not None:
            self._console.close()
        self._ring.finish()
        self._drain.unmap()
        self._ring.unmap()
        with suppress(OSError):
            self._ring.path.unlink()

"""What is heard of one vehicle: frames are split, judged, decoded and counted; who it is is told by its heartbeat.

Frames are judged (signature, ids, checksum) before anything parses them.
"""

import struct
from collections import deque
from collections.abc import Callable

from rtctl.errors import HandshakeError
from rtctl.hal.mavlink.keys import Keys
from rtctl.hal.mavlink.message import Message, dialect
from rtctl.hal.mavlink.stacks import AUTOPILOT1, ROVERS, STACKS, MavSpec
from rtctl.hal.mavlink.talk import Talk
from rtctl.hal.mavlink.view import View
from rtctl.hal.mavlink.wire import Address, Wire
from rtctl.protocol import signing

WINDOW = 64  # sequence numbers within which a late message is no loss


class Hearing:
    """Takes what comes over a wire to the vehicle's view and to the answers of a talk with it."""

    def __init__(
        self, spec: MavSpec, wire: Wire, keys: Keys, view: View, talk: Talk, say: Callable[[str], None]
    ) -> None:
        """say: is told what people should read."""
        self.spec, self.wire, self.keys, self.view, self.talk, self.say = spec, wire, keys, view, talk, say
        self.frames: list[bytes] = []  # of this cycle, as they came
        self.refused = self.lost = 0  # in this cycle
        self.counts: dict[str, int] = {}  # what else came, by what it was
        self.vehicle: tuple[int, int] | None = None  # pinned (system, component)
        self._decoder = dialect.MAVLink(None)
        self._rest: dict[Address, bytes] = {}
        self._seen: deque[int] = deque(maxlen=WINDOW)
        self._newest = -1  # sequence number, unwrapped
        self._strangers: set[tuple[int, int]] = set()

    def drain(self) -> None:
        """Take all that came since the last call."""
        self.view.cycle()
        self.frames, self.refused, self.lost = [], 0, 0
        now = self.wire.now()
        for data, address in self.wire.receive():
            frames, rest, junk = signing.split(self._rest.pop(address, b"") + data)
            self._rest = {address: rest[-signing.LONGEST :]} if rest else {}
            self._count("junk", junk)
            for frame in frames:
                self.frames.append(frame.raw)
                self._judge(frame, address, now)

    def _judge(self, frame: signing.Frame, address: Address, now: float) -> None:
        """Let a frame through that is signed (if it must be), the vehicle's, known and whole."""
        verdict = self.keys.judge(frame)
        if verdict == signing.Verdict.GOOD and frame.message not in dialect.mavlink_map:
            verdict = signing.Verdict.UNKNOWN
        if verdict != signing.Verdict.GOOD:
            self.refused += verdict != signing.Verdict.UNKNOWN
            self._count(verdict.name.lower(), 1)
            return
        try:
            message = self._decoder.decode(bytearray(frame.raw))
        except (dialect.MAVError, struct.error, ValueError, TypeError):
            self.refused += 1
            self._count("damaged", 1)
            return
        source = (frame.system, frame.component)
        if self.vehicle is None:
            self._discover(message, source, address)
        if self.vehicle is None or source != self.vehicle:
            if self.vehicle is None or not self.view.sensed(message, source, self.vehicle[0], now):
                self._count("of others", 1)
            return
        if address is not None:
            self.wire.pin(address)
        self._sequence(frame.sequence)
        if message.get_type() == "COMMAND_ACK":
            self._acknowledged(message, now)
            return
        if self.view.sensed(message, source, source[0], now):
            return
        self.view.take(message, now)

    def _acknowledged(self, message: Message, now: float) -> None:
        """Take a COMMAND_ACK that is for us."""
        for_us = message.target_system in (0, self.spec.system) and message.target_component in (0, self.spec.component)
        if for_us and self.talk.answer(int(message.command), int(message.result), now):
            self.view.answered(now)

    def _discover(self, message: Message, source: tuple[int, int], address: Address) -> None:
        """Pin the vehicle by its heartbeat; others are passed over, and told of once.

        HandshakeError when the one that the config names by its id is another kind than it says: a file can cure that.
        """
        spec = self.spec
        if message.get_type() != "HEARTBEAT" or message.autopilot == 8 or source[1] != AUTOPILOT1:
            return
        if spec.vehicle is not None and source[0] != spec.vehicle:
            return
        if message.autopilot != STACKS[spec.autopilot].autopilot:
            names = {stack.autopilot: name for name, stack in STACKS.items()}
            got = names.get(message.autopilot, f"autopilot type {message.autopilot}")
            if spec.vehicle is not None:
                raise HandshakeError(f"{spec.place}: link.autopilot", f"a heartbeat of {got}", spec.autopilot)
            self._pass_over(source, got)
            return
        if message.type not in ROVERS:
            self._pass_over(source, f"a vehicle of MAV_TYPE {message.type}")
            return
        self.vehicle = source
        if address is not None:
            self.wire.pin(address)

    def _pass_over(self, source: tuple[int, int], what: str) -> None:
        if source not in self._strangers:
            self._strangers.add(source)
            self.say(f"{source} is {what}: passed over, an {self.spec.autopilot} rover is waited for")

    def _sequence(self, sequence: int) -> None:
        """Count messages that did not come within a window of later ones; one that is late is no loss."""
        if self._newest < 0:
            self._newest = sequence
            self._seen.extend(range(sequence - WINDOW + 1, sequence + 1))
            return
        ahead = (sequence - self._newest + 128) % 256 - 128
        at = self._newest + ahead
        if ahead <= 0:
            if at not in self._seen and ahead > -WINDOW:
                self._seen.append(at)
                self.lost = max(self.lost - 1, 0)
            return
        self.lost += ahead - 1
        self._newest = at
        self._seen.append(at)

    def _count(self, what: str, by: int) -> None:
        if by:
            self.counts[what] = self.counts.get(what, 0) + by

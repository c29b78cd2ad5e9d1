"""What is asked of the autopilot, and what it is sent for that: its mode, its arming, set-points.

Nothing the vehicle does not confirm is believed: modes and arming are what its heartbeat says.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from rtctl.hal.mavlink.message import Message
from rtctl.hal.mavlink.stacks import Stack
from rtctl.hal.mavlink.talk import Order, Talk
from rtctl.hal.mavlink.view import View, enu
from rtctl.rover.signals import Ask, BaseCommand, Word

ARM, MODE = 400, 176
VELOCITY_YAW_RATE = 0x05C7  # of SET_POSITION_TARGET_LOCAL_NED: velocity and yaw rate count
VELOCITY = 0x0DC7  # velocity alone
LOCAL_NED, BODY_NED = 1, 8
STILL = BaseCommand(Ask.SILENCE, 0.0, 0.0, np.zeros(2))  # nothing is asked for; as a set-point: no motion


class Steering:
    """Brings one vehicle to what a command asks for, and keeps it there."""

    def __init__(
        self, stack: Stack, every: int, view: View, talk: Talk, sender: Any, say: Callable[[str], None]
    ) -> None:
        """every: period in which a set-point goes out; sender: numbers our messages; say: tells people."""
        self.stack, self.every, self.view, self.talk, self.sender, self.say = stack, every, view, talk, sender, say
        self.word = Word.PENDING  # what became of the request for mode and arming
        self._ask = Ask.SILENCE
        self._setpoints_since = -1.0
        self._turn = 0  # periods since set-points are streamed

    def messages(self, command: BaseCommand, vehicle: tuple[int, int], now: float) -> list[Message]:
        """Return what follows from a command: orders for mode and arming, and a set-point while the mode is ours.

        vehicle: system and component. now: [s].
        """
        if command.ask != self._ask:
            self._turned(command.ask)
        ours = self.view.mode == self.stack.ours
        if self._ask == Ask.ENGAGE:
            self._engage(ours, now)
        streams = self._ask in (Ask.DRIVE, Ask.HOLD) and ours
        if self._ask == Ask.ENGAGE:
            streams = ours or self.stack.prestream > 0.0
        if not streams:
            self._setpoints_since = -1.0
            return []
        if self._setpoints_since < 0.0:
            self._setpoints_since, self._turn = now, 0
        self._turn += 1
        if (self._turn - 1) % self.every:
            return []
        return [self._setpoint(command if self._ask == Ask.DRIVE else STILL, vehicle, now)]

    def _turned(self, ask: Ask) -> None:
        """Forget what was asked before, and ask anew."""
        self.talk.drop(("mode", "arm", "hold", "disarm"))
        self._ask, self.word = ask, Word.PENDING
        if ask == Ask.HOLD:
            self.talk.give(Order("hold", MODE, (1.0, *self.stack.hold, 0.0, 0.0, 0.0, 0.0)), first=True)
        elif ask == Ask.DISARM:
            self.talk.give(Order("disarm", ARM, (0.0,) * 7), first=True)

    def _engage(self, ours: bool, now: float) -> None:
        """Mode first, then arming; each asked once, repeated by `Talk`, and ended by a refusal."""
        answers = self.talk.answers
        for name in ("mode", "arm"):
            word = answers.get(name, Word.PENDING)
            if word not in (Word.PENDING, Word.ACCEPTED):
                if self.word == Word.PENDING:
                    self.say(f"{'arming' if name == 'arm' else 'our mode'}: {word.name.lower().replace('_', ' ')}")
                self.word = word
                return
        streamed = self._setpoints_since >= 0.0 and now - self._setpoints_since >= self.stack.prestream
        if (
            not ours
            and "mode" not in answers
            and not self.talk.holds("mode")
            and (streamed or not self.stack.prestream)
        ):
            self.talk.give(Order("mode", MODE, (1.0, *self.stack.enter, 0.0, 0.0, 0.0, 0.0)), first=True)
        if ours and not self.view.armed and "arm" not in answers and not self.talk.holds("arm"):
            self.talk.give(Order("arm", ARM, (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)), first=True)
        if ours and self.view.armed:
            self.word = Word.ACCEPTED

    def _setpoint(self, command: BaseCommand, vehicle: tuple[int, int], now: float) -> Message:
        """Return SET_POSITION_TARGET_LOCAL_NED: forward speed and yaw rate, or for PX4 a velocity in the world."""
        numbers = (command.v, command.w, float(command.velocity[0]), float(command.velocity[1]))
        if not all(map(math.isfinite, numbers)):
            numbers = (0.0, 0.0, 0.0, 0.0)  # a NaN has aborted an autopilot; the tick's own checks have failed by now
        v, w, east, north = numbers
        if self.stack.world:
            frame, mask = LOCAL_NED, VELOCITY
            vx, vy = enu(east, north)
            w = 0.0
        else:
            frame, mask = BODY_NED, VELOCITY_YAW_RATE
            vx, vy = v, 0.0  # not vy: a skid-steer rover takes hypot(vx, vy) as forward speed
        boot = round(now * 1e3) & 0xFFFFFFFF
        message: Message = self.sender.set_position_target_local_ned_encode(
            boot, *vehicle, frame, mask, 0.0, 0.0, 0.0, vx, vy, 0.0, 0.0, 0.0, 0.0, 0.0, -w
        )
        return message

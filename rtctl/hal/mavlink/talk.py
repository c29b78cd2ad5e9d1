"""Commands to the autopilot: one in flight, each matched with its COMMAND_ACK, retried, or given up with the reason."""

from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

from rtctl.rover.signals import Word

TRIES = 3
PATIENCE = 0.7  # [s] for an answer
PAUSE = 0.5  # [s] after "temporarily rejected"
BUSY_TRIES = 10
IN_PROGRESS = 5  # MAV_RESULT
WORDS = {0: Word.ACCEPTED, 1: Word.BUSY, 2: Word.DENIED, 3: Word.UNSUPPORTED, 4: Word.FAILED, 6: Word.FAILED}
SET_MESSAGE_INTERVAL, REQUEST_MESSAGE = 511, 512
RATES = (50.0, 40.0, 25.0, 20.0, 10.0)  # [Hz] asked for in turn: a 50 Hz scheduler takes 40 and denies 50


class Order(NamedTuple):
    """One COMMAND_LONG."""

    name: str
    command: int
    parameters: tuple[float, ...]  # (7,)
    rates: tuple[float, ...] = ()  # [Hz] of a stream, to be tried in turn


class Talk:
    """The orders that wait, the one in flight, and what became of those before."""

    def __init__(self) -> None:
        self.answers: dict[str, Word] = {}  # by name
        self.rates: dict[str, float] = {}  # [Hz] granted, by name
        self._waiting: deque[Order] = deque()
        self._order: Order | None = None
        self._due = 0.0
        self._tries = self._busy = 0

    @property
    def idle(self) -> bool:
        """Return whether nothing waits and nothing is in flight."""
        return self._order is None and not self._waiting

    def holds(self, name: str) -> bool:
        """Return whether an order waits or is in flight."""
        return any(o.name == name for o in self._waiting) or (self._order is not None and self._order.name == name)

    def give(self, order: Order, first: bool = False) -> None:
        """Let an order wait its turn, or go next."""
        self.answers.pop(order.name, None)
        if first:
            self._waiting.appendleft(order)
        else:
            self._waiting.append(order)

    def drop(self, names: Sequence[str]) -> None:
        """Forget orders by name, the one in flight included: their answers mean nothing any more."""
        self._waiting = deque(order for order in self._waiting if order.name not in names)
        if self._order is not None and self._order.name in names:
            self._order = None
        for name in names:
            self.answers.pop(name, None)

    def due(self, now: float) -> tuple[Order, int] | None:
        """Return the order to send now, and how often it was sent before; None when none is."""
        if self._order is None:
            if not self._waiting:
                return None
            self._order = self._waiting.popleft()
            self._tries, self._busy, self._due = 0, 0, now
        if now < self._due:
            return None
        if self._tries >= TRIES:
            self._end(Word.NO_ANSWER)
            return None
        self._tries += 1
        self._due = now + PATIENCE
        return self._order, self._tries - 1

    def answer(self, command: int, result: int, now: float) -> bool:
        """Take a COMMAND_ACK of the vehicle; return whether it answers what is in flight."""
        order = self._order
        if order is None or command != order.command or self._tries == 0:
            return False
        if result == IN_PROGRESS:
            self._due = now + 10.0 * PATIENCE
            return True
        word = WORDS.get(result, Word.FAILED)
        if word == Word.BUSY and self._busy < BUSY_TRIES:
            self._busy, self._tries, self._due = self._busy + 1, self._tries - 1, now + PAUSE
            return True
        if word in (Word.DENIED, Word.FAILED) and len(order.rates) > 1:
            slower = order.rates[1:]
            self._order = order._replace(rates=slower, parameters=interval(order.parameters[0], slower[0]))
            self._tries, self._busy, self._due = 0, 0, now
            return True
        if word == Word.ACCEPTED and order.rates:
            self.rates[order.name] = order.rates[0]
        self._end(word)
        return True

    def _end(self, word: Word) -> None:
        assert self._order is not None
        self.answers[self._order.name] = word
        self._order = None


def interval(message: float, rate: float) -> tuple[float, ...]:
    """Return the parameters of SET_MESSAGE_INTERVAL: message id and period [us]."""
    return (message, round(1e6 / rate), 0.0, 0.0, 0.0, 0.0, 0.0)


def stream(name: str, message: int, rate: float) -> Order:
    """Return the order for a stream of a message at `rate` [Hz], or the next slower one that is granted."""
    rates = tuple(sorted({rate, *(r for r in RATES if r < rate)}, reverse=True))
    return Order(name, SET_MESSAGE_INTERVAL, interval(message, rates[0]), rates)


def request(name: str, message: int) -> Order:
    """Return the order for one message now."""
    return Order(name, REQUEST_MESSAGE, (message, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))

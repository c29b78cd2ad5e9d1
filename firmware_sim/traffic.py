"""A bus that loses replies, brings them late, and carries frames of others, as `[plant]` says."""

import random
from collections.abc import Sequence

from rtctl.protocol import frame


class Traffic:
    """What the bus does to replies all the time; reproducible from its seed. Owns those that are late."""

    def __init__(self, loss: float, late: float, talkers: Sequence[int], fd: bool, seed: int) -> None:
        """See Reality.reply_loss, reply_late, talkers; fd: the form of the frames of others."""
        self.loss, self.late = loss, late
        self.talk = [frame.pack(i, bytes(8), fd=fd, brs=fd) for i in talkers]
        self.quiet = not (self.loss or self.late or self.talk)
        self.random = random.Random(seed)
        self.held: dict[int, list[bytes]] = {}

    def carried(self, k: int, sent: list[bytes]) -> list[bytes]:
        """Return what arrives when drive k replies: what was late before, this reply, and, once a cycle, the others."""
        out = self.held.pop(k, [])
        if self.random.random() >= self.loss:
            if self.random.random() < self.late:
                self.held[k] = sent
            else:
                out = out + sent
        return out + self.talk if k == 0 else out


SILENT = Traffic(0.0, 0.0, (), False, 0)

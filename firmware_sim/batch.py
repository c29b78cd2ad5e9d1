"""A cycle's raw frames in one block of memory: filled by a bus or by the drives, read by the other, never reallocated."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

ROOM = 80  # bytes a frame: above the 72 of the longest, so that an oversize packet shows its length
CAPACITY = 64  # frames that are taken at once: a flooding peer must not starve the clock


class Batch:
    """Raw frames in order; `count` of them are valid, the first `lengths[k]` bytes of each row."""

    def __init__(self, capacity: int = CAPACITY) -> None:
        self.capacity = capacity
        self.data = bytearray(capacity * ROOM)
        self.raw: NDArray[np.uint8] = np.frombuffer(self.data, dtype=np.uint8).reshape(capacity, ROOM)
        self.lengths: NDArray[np.int64] = np.zeros(capacity, dtype=np.int64)
        self.count = 0

    def extend(self, frames: Iterable[bytes]) -> None:
        """Add frames; what has no room is left out."""
        data, lengths, k = self.data, self.lengths, self.count
        for raw in frames:
            if k == self.capacity:
                break
            at, size = k * ROOM, len(raw)
            if size > ROOM:
                raw = raw[:ROOM]
            data[at : at + len(raw)] = raw
            lengths[k] = size
            k += 1
        self.count = k

    def frame(self, k: int) -> bytes:
        """Return one frame."""
        return bytes(self.data[k * ROOM : k * ROOM + min(int(self.lengths[k]), ROOM)])

    def frames(self) -> list[bytes]:
        """Return all of them."""
        data = self.data
        ends = self.lengths[: self.count].tolist()
        return [bytes(data[k * ROOM : k * ROOM + size]) for k, size in enumerate(ends)]

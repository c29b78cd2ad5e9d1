"""`rtctl log tail --foxglove`: what a growing log draws, over Foxglove's websocket, with the times of the log.

A file grows by chunks of a quarter of a second. What is drawn comes as evenly as it was recorded, LAG later.
"""

import math
import time
from collections import deque
from collections.abc import Iterator
from typing import TYPE_CHECKING

from rtctl.errors import UsageError
from rtctl.log import schema
from rtctl.log.mcap.names import OPEN
from rtctl.log.read.follow import Message, Tail

if TYPE_CHECKING:
    import foxglove

TOPICS = (schema.TF, schema.SCENE, schema.LOG)
LAG = 0.6  # [s] behind the newest: two chunks and a look
BEHIND = 2.0  # [s] what is later than that, as the beginning of a run that is joined late, is left out
LOOK = 0.01  # [s] between messages that are due


class Relay:
    """A server that gives viewers the messages of a log; they can send nothing."""

    def __init__(self, tail: Tail, host: str, port: int) -> None:
        """Listen at host and port, 0 for any free one. Raises UsageError where it cannot."""
        import foxglove

        self._tail = tail
        self._channels: dict[str, foxglove.Channel] = {}
        self._waiting: deque[Message] = deque()
        self._live = tail.path.name.endswith(OPEN)  # else it is played from its beginning
        self._offset = math.inf  # [s] of this clock less the log's
        self._context = foxglove.Context()
        try:
            self._server = foxglove.start_server(
                name=f"rtctl {tail.header.robot}", host=host, port=port, context=self._context
            )
        except RuntimeError as error:
            raise UsageError(f"log tail: {host}:{port}: {error}; another --port is free perhaps") from None
        self.url = f"ws://{host}:{self._server.port}"

    def add(self, messages: list[Message], now: float) -> None:
        """Take what a look at the file brought at `now` [s] of the monotonic clock."""
        if messages and (self._live or self._offset == math.inf):
            self._offset = min(self._offset, now - messages[-1 if self._live else 0].time * 1e-9)
        self._waiting.extend(messages)

    @property
    def waits(self) -> bool:
        """Return whether something is still to be sent."""
        return bool(self._waiting)

    def send(self, now: float) -> None:
        """Send what is due at `now` [s] of the monotonic clock."""
        for message in self._due(now):
            self._channel(message.topic).log(message.data, log_time=message.time)

    def _due(self, now: float) -> Iterator[Message]:
        while self._waiting:
            late = now - (self._waiting[0].time * 1e-9 + self._offset + LAG)
            if late < -BEHIND and not self._live:  # a hole in the log, or times that mean nothing, are not waited for
                self._offset += late
                continue
            if late < 0.0:
                return
            message = self._waiting.popleft()
            if late < BEHIND or not self._live:
                yield message

    def _channel(self, topic: str) -> "foxglove.Channel":
        if topic not in self._channels:
            import foxglove

            channel, known = self._tail.schemas[topic]
            described = foxglove.Schema(name=known.name, encoding=known.encoding, data=known.data)
            self._channels[topic] = foxglove.Channel(
                topic, schema=described, message_encoding=channel.message_encoding, context=self._context
            )
        return self._channels[topic]

    def close(self) -> None:
        """End every connection."""
        self._server.stop()


def pause(relay: Relay | None, seconds: float) -> None:
    """Wait before the next look at the file, meanwhile sending what is due."""
    end = time.monotonic() + seconds
    while relay is not None and (now := time.monotonic()) < end:
        relay.send(now)
        time.sleep(LOOK)
    time.sleep(max(0.0, end - time.monotonic()))

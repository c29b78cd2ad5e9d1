"""A MAVLink message as pymavlink decodes it: one class per message, with a field per attribute; and its dialect."""

import os
from typing import Any, Protocol

os.environ["MAVLINK20"] = "1"  # before pymavlink is imported: it starts as MAVLink 1 otherwise
from pymavlink.dialects.v20 import ardupilotmega as dialect

__all__ = ["Message", "dialect"]


class Message(Protocol):
    """What all of pymavlink's messages have in common."""

    crc_extra: int

    def get_type(self) -> str:
        """Return the name of the message's kind."""

    def pack(self, mav: object) -> bytes:
        """Return the frame, numbered by the sender `mav`."""

    def __getattr__(self, field: str) -> Any:
        """Return a field of the message."""

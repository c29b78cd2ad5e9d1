"""Words for whoever started the program, said only where that does not block."""

import os
import select
from contextlib import suppress

OUT, ERR = 1, 2
PIPE_BUF = 4096  # [B] what a writable pipe is sure to take


def say(text: str, to: int = OUT) -> None:
    """Print a line if that does not block: a terminal that is stopped must not stop the arm."""
    line = (text + "\n").encode()
    if select.select([], [to], [], 0.0)[1]:
        with suppress(OSError):
            os.write(to, line[-PIPE_BUF:])

"""Another user of the machine, as a process of its own: forked, since that user may not be able to read this Python."""

import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

STRANGER = 65534  # nobody


@contextmanager
def stranger(act: Callable[[Callable[[], None]], None]) -> Iterator[int]:
    """Let another user do `act(ready)` until it is killed; yields its process id once it has called `ready`."""
    read, write = os.pipe()
    pid = os.fork()
    if pid == 0:
        with suppress(BaseException):
            os.setgroups([])
            os.setresgid(STRANGER, STRANGER, STRANGER)
            os.setresuid(STRANGER, STRANGER, STRANGER)
            act(lambda: (os.write(write, b"up"), None)[1])
        os._exit(1)
    os.close(write)
    try:
        assert os.read(read, 2) == b"up", "the other user could not do its part"
        yield pid
    finally:
        os.close(read)
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)

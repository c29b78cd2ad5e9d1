"""A child process beside this one: its streams pumped into sinks, its whole session killed in any case."""

import os
import selectors
import signal
import subprocess
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

Sink = Callable[[bytes], object]


def pump(
    sinks: Mapping[int, Sink],
    deadline: float,
    child: "subprocess.Popen[bytes]",
    done: Callable[[], bool] = lambda: False,
) -> bool:
    """Moves bytes to the sinks until all descriptors close, the child is gone or `done`; False at the deadline."""
    with selectors.DefaultSelector() as selector:
        for descriptor, sink in sinks.items():
            os.set_blocking(descriptor, False)
            selector.register(descriptor, selectors.EVENT_READ, sink)
        while selector.get_map() and not done():
            if time.monotonic() > deadline:
                return False
            gone = child.poll() is not None
            ready = selector.select(0.0 if gone else 0.2)
            for key, _ in ready:
                if data := os.read(key.fd, 65536):
                    key.data(data)
                else:
                    selector.unregister(key.fd)
            if gone and not ready:
                break
    while time.monotonic() < deadline:
        if done() or child.poll() is not None:
            return True
        time.sleep(0.01)
    return False


@contextmanager
def guarded(child: "subprocess.Popen[bytes]", scratch: Path) -> Iterator[None]:
    """The child's whole session is killed on leaving, and by a guardian when this process itself is killed."""
    read_end, write_end = os.pipe()
    script = 'read -r _; kill -KILL "-$1"; rm -rf -- "$2"'
    guardian = subprocess.Popen(
        ["sh", "-c", script, "sh", str(child.pid), str(scratch)],
        stdin=read_end,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        cwd="/",
        start_new_session=True,
    )
    os.close(read_end)
    try:
        yield
    finally:
        with suppress(ProcessLookupError):
            os.killpg(child.pid, signal.SIGKILL)
        child.wait()
        guardian.kill()  # before its pipe closes: the process group's number may soon be somebody else's
        guardian.wait()
        os.close(write_end)


def exit_status(returncode: int) -> int:
    """Exit status as a shell reports it."""
    return returncode if returncode >= 0 else 128 - returncode


def pipe(stack: ExitStack) -> tuple[int, int]:
    """Read and write end of a pipe; the read end is closed with the stack."""
    read_end, write_end = os.pipe()
    stack.callback(os.close, read_end)
    return read_end, write_end


def writer(descriptor: int) -> Sink:
    """A sink that writes all it is given to a descriptor."""

    def write(data: bytes) -> None:
        while data:
            data = data[os.write(descriptor, data) :]

    return write

"""The error tree: start-up and user mistakes only; run-time faults are values, not exceptions."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec

EXIT_OK = 0
EXIT_FAILED = 1
EXIT_USAGE = 2
EXIT_CONFIG = 78  # sysexits EX_CONFIG: the daemon refuses the file or the robot it finds


class RtctlError(Exception):
    """Root of everything a user can cause; printed as one line, never as a traceback."""

    exit_code = EXIT_FAILED


class ConfigError(RtctlError):
    """A file, or what was found on the bus, contradicts what is needed to run safely.

    `place` is the file and the path inside it (`configs/panda.toml: robot.joints[2].q_min_rad`),
    `got` what came and `wanted` what would have been accepted.
    """

    exit_code = EXIT_CONFIG

    def __init__(self, place: str, got: object, wanted: str) -> None:
        self.place, self.got, self.wanted = place, got, wanted
        super().__init__(f"{place}: got {got}, wanted {wanted}")


class HandshakeError(ConfigError):
    """The bus does not answer as the config says it must; drives were never enabled."""


class AbsentError(RtctlError):
    """What the program waited for did not come in the time that it was given: no file can cure that."""


class StoppedError(RtctlError):
    """Somebody ended the program while it waited; nothing had begun."""

    exit_code = EXIT_OK


class LinkError(RtctlError):
    """A bus or socket could not be opened or died in a way that retrying cannot mend."""


class RequestError(RtctlError):
    """An operator's request is malformed or not allowed now; nothing was changed."""


class UsageError(RtctlError):
    """A wrong call on the command line."""

    exit_code = EXIT_USAGE


class LogError(RtctlError):
    """A log cannot be opened, written, or does not hold what is asked of it."""


class PlanError(RtctlError):
    """The planner found no way: none exists, or it did not find it within its bounds."""


EXTRAS = {  # modules that the core does without, and the extra of the package that brings each
    "mujoco": "sim",
    "pybullet": "sim",
    "pybullet_data": "sim",
    "matplotlib": "report",
    "PIL": "report",
    "pyarrow": "report",
    "pymavlink": "rover",
    "viser": "view",
    "trimesh": "view",
    "foxglove": "view",
    "distributed": "campaign",
    "dask": "campaign",
}
NO_BULLET = "; pybullet has no wheel for Python 3.12 and later: take Python 3.11"


def lacking(error: ModuleNotFoundError) -> str:
    """Return as one line what is to be installed, '' for a module that is no optional one."""
    module = (error.name or "").partition(".")[0]
    extra = EXTRAS.get(module)
    if extra is None:
        return ""
    more = NO_BULLET if module.startswith("pybullet") and sys.version_info >= (3, 12) else ""
    return f"{module} is not installed: this needs rtctl[{extra}]: pip install 'rtctl[{extra}]'{more}"


def needs(extra: str, *modules: str) -> None:
    """Raise UsageError unless the modules of an optional part are installed, and say how to get them."""
    lacking = [name for name in modules if find_spec(name) is None]
    if lacking:
        raise UsageError(
            f"this needs rtctl[{extra}]: pip install 'rtctl[{extra}]' ({', '.join(lacking)} not installed)"
        )


@contextmanager
def until_interrupted() -> Iterator[None]:
    """Leave the block on Ctrl-C without a word; where compiled code ran it comes as the cause of a SystemError."""
    try:
        yield
    except KeyboardInterrupt:
        pass
    except SystemError as error:
        if not isinstance(error.__cause__, KeyboardInterrupt):
            raise

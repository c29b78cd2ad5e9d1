"""Cases played on Dask: local processes, or the workers of a cluster that is there already."""

import logging
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from itertools import islice
from queue import Empty, SimpleQueue
from typing import Any

from rtctl.campaign.case import Case
from rtctl.campaign.play import head, played
from rtctl.errors import RtctlError, UsageError
from rtctl.plain import Json

AHEAD = 3  # runs a worker that the scheduler is given before their turn
DEATHS = 3  # of workers under a run, after which it is held to be the cause
COUNTED = 2.0  # [s] between two counts of the workers
PATIENCE = 60.0  # [s] for the workers of a cluster

Told = Callable[[Json, int], None]  # a row, and how many workers there are


def perform(cases: Iterator[Case], told: Told, workers: int, scheduler: str = "") -> None:
    """Play cases and tell each row as it comes; workers = 0 plays them in this process.

    A case whose worker dies is played on another; one that DEATHS workers died of becomes a row that says so.
    Raises RtctlError when the cluster is lost.
    """
    if workers == 0 and not scheduler:
        for case in cases:
            told(played(case), 1)
        return
    if find_spec("distributed") is None:
        raise UsageError("campaign: distributed is not installed, wanted: pip install 'rtctl[campaign]'")
    with _client(workers, scheduler) as client:
        _perform(client, cases, told)


@contextmanager
def _client(workers: int, scheduler: str) -> Iterator[Any]:
    import dask
    import distributed

    lib: Any = distributed  # untyped
    # A worker that compiles or plans holds Python's lock for seconds: that is no news and no fault.
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    settings = {
        "distributed.scheduler.allowed-failures": DEATHS,
        "distributed.comm.timeouts.connect": f"{PATIENCE:g}s",
        "distributed.worker.memory.terminate": False,
        "distributed.admin.log-format": "",
    }
    with dask.config.set(settings), tempfile.TemporaryDirectory(prefix="rtctl-dask-") as folder:
        if scheduler:
            try:
                client = lib.Client(scheduler, timeout=PATIENCE, set_as_default=False)
            except (OSError, ValueError) as error:
                raise RtctlError(f"--scheduler {scheduler}: {error}") from None
            with client:
                yield client
            return
        with (
            lib.LocalCluster(
                n_workers=workers,
                threads_per_worker=1,
                processes=True,
                dashboard_address="127.0.0.1:0",  # any free port: None is the one that another campaign has
                local_directory=folder,
                silence_logs=logging.CRITICAL,
                memory_limit=0,
            ) as cluster,
            lib.Client(cluster, set_as_default=False) as client,
        ):
            yield client


def _perform(client: Any, cases: Iterator[Case], told: Told) -> None:
    crew = _Crew(client)
    crew.wait()
    suspects = _in_parallel(client, crew, cases, told)
    for case in suspects:  # who died with a neighbour is played again, and who dies alone is the cause
        for killer in _in_parallel(client, crew, iter([case]), told, "alone"):
            told(head(killer) | {"outcome": "died", "failures": f"error: {DEATHS} workers died of it"}, crew.count())


def _in_parallel(client: Any, crew: "_Crew", cases: Iterator[Case], told: Told, prefix: str = "run") -> list[Case]:
    """Play cases and tell their rows; return those whose workers died."""
    coming: SimpleQueue[Any] = SimpleQueue()  # futures that are done
    under_way: dict[str, tuple[Any, Case]] = {}
    suspects = []

    def more() -> None:
        for case in islice(cases, max(0, AHEAD * crew.count() - len(under_way))):
            future = client.submit(played, case, key=f"{prefix}-{case.key}", pure=False)
            under_way[future.key] = (future, case)
            future.add_done_callback(coming.put)

    more()
    while under_way:
        try:
            done = coming.get(timeout=COUNTED)
        except Empty:
            _still_there(client)
            more()
            continue
        future, case = under_way.pop(done.key)
        row = _row(future, case)
        if row is None:
            suspects.append(case)
        else:
            told(row, crew.count())
        del future, done  # the scheduler forgets what nobody holds
        more()
    return suspects


def _row(future: Any, case: Case) -> Json | None:
    """Return the row of a run that is over, None when its workers died."""
    if future.status == "finished":
        row: Json = future.result()
        return row
    if future.status in ("cancelled", "lost"):
        raise RtctlError("campaign: the scheduler is gone; the same command goes on where this one ended")
    error = future.exception()
    if type(error).__name__ == "KilledWorker":
        return None
    return head(case) | {"outcome": "error", "failures": f"error: {type(error).__name__}: {error}"}


def _still_there(client: Any) -> None:
    if client.status not in ("running", "connecting"):
        raise RtctlError("campaign: the scheduler is gone; the same command goes on where this one ended")


class _Crew:
    """How many workers there are: they come and go."""

    def __init__(self, client: Any) -> None:
        self.client, self.counted, self.number = client, -COUNTED, 0

    def count(self) -> int:
        """Return the number of threads of all workers, at least 1."""
        if time.monotonic() - self.counted > COUNTED:
            self.counted = time.monotonic()
            try:
                self.number = sum(self.client.nthreads().values())
            except (OSError, TimeoutError):
                _still_there(self.client)
        return max(1, self.number)

    def wait(self) -> None:
        """Return when there is a worker. Raises RtctlError."""
        try:
            self.client.wait_for_workers(1, timeout=PATIENCE)
        except TimeoutError:
            raise RtctlError(f"campaign: no worker came within {PATIENCE:g} s") from None

"""Two runs side by side: what each did, and from where on they differ."""

from typing import NamedTuple

import numpy as np

from rtctl.errors import LogError
from rtctl.log import schema
from rtctl.log.read.faults import fault_names
from rtctl.log.read.fields import called, unit_of
from rtctl.log.read.run import Run
from rtctl.log.read.topic import Topic
from rtctl.types import F64, Array, State, Status

COMPARED = (
    "q", "qd", "tau_measured", "x", "xd", "wxyz", "goal", "F", "error", "error_rot", "sigma_min", "rho", "tau_motion",
    "tau_obstacles", "tau_limits", "tau_posture", "tau_gravity", "tau_wanted", "tau_sent", "state", "status", "faults",
)  # fmt: skip


class Gap(NamedTuple):
    """How far one field of two runs is apart."""

    field: str
    unit: str
    ticks: int  # in which it differs
    first_s: float  # robot time
    largest: float
    at_s: float


class Diff(NamedTuple):
    """Two runs compared tick by tick, by robot time."""

    ticks: int  # common to both
    identical: bool
    summary: tuple[tuple[str, str, str], ...]  # what, of A, of B
    gaps: tuple[Gap, ...]
    time: F64  # (T,) [s]
    tip: tuple[F64, F64]  # (T, 3) [m]
    error: tuple[F64, F64]  # (T,) [m]
    tau: tuple[F64, F64]  # (T, n) [Nm]


def diff(a: Run, b: Run) -> Diff:
    """Return how two runs of the same robot compare. Raises LogError when they cannot be compared."""
    if a.header.joints != b.header.joints:
        raise LogError(f"{b.path}: joints {', '.join(b.header.joints)}, wanted those of {a.path}")
    known = set(a.header.dtype.names or ()) & set(b.header.dtype.names or ())
    names = [name for name in COMPARED if name in known]
    one, two = (run[schema.TICK].load("time", "slot", *names) for run in (a, b))
    if not len(one) or not len(two):
        raise LogError(f"{(b if len(one) else a).path}: no tick in it")
    _, rows, others = np.intersect1d(one.slot, two.slot, return_indices=True)
    gaps = []
    for name in names:
        x, y = getattr(one, name)[rows], getattr(two, name)[others]
        if x.shape != y.shape:
            continue
        gap = _gap(name, x, y, one.field("time")[rows])
        gaps += [gap] if gap else []
    both = ((a, one, rows), (b, two, others))

    def pick(name: str) -> tuple[F64, F64]:
        left, right = (getattr(topic, name)[chosen] for _, topic, chosen in both)
        return left, right

    shown = "tau_sent" if "tau_sent" in known else "v_world"
    tip, error, tau = pick("x"), pick("error"), pick(shown)
    left, right = (_figures(run, topic) for run, topic, _ in both)
    summary = tuple((key, left.get(key, "-"), right.get(key, "-")) for key in {**left, **right})
    same = not gaps and len(one) == len(two) == len(rows)
    return Diff(len(rows), same, summary, tuple(gaps), one.field("time")[rows], tip, error, tau)


def _gap(name: str, x: Array, y: Array, time: F64) -> Gap | None:
    kind = {8: np.uint64, 4: np.uint32}[x.dtype.itemsize]
    bits = (np.ascontiguousarray(x).view(kind) != np.ascontiguousarray(y).view(kind)).reshape(len(x), -1)
    found = np.flatnonzero(bits.any(axis=1))
    if not len(found):
        return None
    with np.errstate(invalid="ignore"):
        size = np.abs(x[found].astype(np.float64) - y[found].astype(np.float64)).reshape(len(found), -1)
    size = np.where(np.isfinite(size), size, 0.0).max(axis=1)
    k = int(size.argmax())
    return Gap(name, unit_of(name), len(found), float(time[found[0]]), float(size[k]), float(time[found[k]]))


def _figures(run: Run, topic: Topic) -> dict[str, str]:
    """Return what a run did, as text by name."""
    header = run.header
    time, rho = topic.field("time"), topic.rho
    near = rho[np.isfinite(rho)]
    step = np.linalg.norm(np.diff(topic.x, axis=0), axis=1).sum()
    speed = np.linalg.norm(topic.xd, axis=1).max()
    states = "; ".join(called(State, s) for s in _turns(topic.state))
    statuses = _turns(topic.status)
    arrived = sum(s == Status.ARRIVED for s in statuses)
    torque = {"largest torque": f"{np.abs(topic.tau_sent).max():.2f} Nm"} if header.joints else {}
    return {
        "file": run.path.name,
        "config": header.config_sha256[:12],
        "rtctl": " ".join(filter(None, (header.versions.get("rtctl", ""), header.revision))),
        "duration": f"{time[-1] - time[0]:.3f} s",
        "ticks": str(len(time)),
        "states": states if len(states) < 80 else states[:77] + "...",
        "arrivals": str(arrived),
        "path of the tip": f"{step:.3f} m",
        "top speed": f"{speed:.3f} m/s",
        "smallest clearance": f"{near.min() * 1e3:.1f} mm" if len(near) else "-",
        **torque,
        "final error": f"{topic.error[-1] * 1e3:.2f} mm",
        "faults": ", ".join(fault_names(header, int(np.bitwise_or.reduce(topic.faults)))) or "none",
    }


def _turns(values: Array) -> list[int]:
    """Return the values of a sequence without repetitions of neighbours."""
    v = np.asarray(values)
    keep = np.concatenate([[True], v[1:] != v[:-1]])
    return [int(x) for x in v[keep]]

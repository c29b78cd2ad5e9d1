"""Decimation while streaming: of any number of samples the smallest and largest in each of some thousand bins."""

import numpy as np

from rtctl.types import F64, I64

BINS = 2400


class Bins:
    """Smallest and largest value of many series over equal spans of ticks; filled piece by piece, in order."""

    def __init__(self, total: int, bins: int = BINS) -> None:
        self.total = max(total, 1)
        self.count = min(bins, self.total)
        self.time: F64 = np.full(self.count, np.nan)  # [s] of each bin's first sample
        self._low: dict[str, F64] = {}
        self._high: dict[str, F64] = {}
        self._of: I64 = np.zeros(0, np.int64)  # bin of each start in the current piece
        self._starts: I64 = np.zeros(0, np.int64)

    def begin(self, first: int, time: F64) -> None:
        """Begin a piece whose first sample is number `first`; time (m,) [s]."""
        which = np.minimum((first + np.arange(len(time), dtype=np.int64)) * self.count // self.total, self.count - 1)
        self._starts = np.flatnonzero(np.diff(which, prepend=-1))
        self._of = which[self._starts]
        fresh = np.isnan(self.time[self._of])
        self.time[self._of[fresh]] = time[self._starts[fresh]]

    def add(self, name: str, values: F64) -> None:
        """Add a series' samples (m,) of the current piece; what is not finite is left out."""
        if not len(values):
            return
        if name not in self._low:
            self._low[name], self._high[name] = np.full(self.count, np.inf), np.full(self.count, -np.inf)
        good = np.isfinite(values)
        low = np.minimum.reduceat(np.where(good, values, np.inf), self._starts)
        high = np.maximum.reduceat(np.where(good, values, -np.inf), self._starts)
        self._low[name][self._of] = np.minimum(self._low[name][self._of], low)
        self._high[name][self._of] = np.maximum(self._high[name][self._of], high)

    def columns(self, name: str, values: F64, labels: "tuple[str, ...] | list[str]") -> None:
        """Add the columns of (m, k) as `name.label`."""
        for i, label in enumerate(labels):
            self.add(f"{name}.{label}", np.ascontiguousarray(values[:, i]))

    @property
    def names(self) -> list[str]:
        """Return the series that have any number in them."""
        return [name for name, low in self._low.items() if np.isfinite(low).any()]

    def series(self, name: str) -> tuple[F64, F64]:
        """Return (smallest, largest) of each bin, NaN where a bin has no number."""
        low, high = self._low[name].copy(), self._high[name].copy()
        none = ~np.isfinite(low)
        low[none] = high[none] = np.nan
        return low, high


class Histogram:
    """Counts over bins that grow by a factor: times from 1 us to 1 s."""

    def __init__(self) -> None:
        self.edges: F64 = np.logspace(-6.0, 0.0, 73)  # [s]
        self.counts: I64 = np.zeros(len(self.edges) + 1, np.int64)
        self.largest = 0.0

    def add(self, values: F64) -> None:
        """Count values [s]."""
        good = values[np.isfinite(values)]
        if len(good):
            self.counts += np.bincount(np.searchsorted(self.edges, good), minlength=len(self.counts))
            self.largest = max(self.largest, float(good.max()))

    def quantile(self, p: float) -> float:
        """Return the upper edge [s] of the bin in which the p quantile lies."""
        total = int(self.counts.sum())
        if not total:
            return 0.0
        k = int(np.searchsorted(np.cumsum(self.counts), p * total))
        return float(min(self.edges[min(k, len(self.edges) - 1)], self.largest))


class Spectrum:
    """Mean power spectrum of torque, Hann windows of a thousand samples: what chatters shows as a line."""

    SIZE = 1024

    def __init__(self, n: int, rate: float) -> None:
        self.frequency: F64 = np.asarray(np.fft.rfftfreq(self.SIZE, 1.0 / rate), np.float64)
        self.power: F64 = np.zeros((n, len(self.frequency)))
        self.blocks = 0
        self._window = np.hanning(self.SIZE)
        self._norm = 2.0 / (rate * float((self._window**2).sum()))

    def add(self, values: F64) -> None:
        """Take whole blocks of samples (m, n); what is left of a piece is left out."""
        blocks = len(values) // self.SIZE
        if not blocks or values.shape[1] != len(self.power) or not np.isfinite(values).all():
            return
        rows = values[: blocks * self.SIZE].reshape(blocks, self.SIZE, -1)
        centred = (rows - rows.mean(axis=1, keepdims=True)) * self._window[None, :, None]
        power = (np.abs(np.fft.rfft(centred, axis=1)) ** 2).sum(axis=0).T
        self.power = self.power + np.asarray(self._norm * power, np.float64)
        self.blocks += blocks

    @property
    def amplitude(self) -> F64:
        """Return the root of the mean power density (n, f) [Nm/sqrt(Hz)]."""
        return np.asarray(np.sqrt(self.power / max(self.blocks, 1)))

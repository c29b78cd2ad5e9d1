"""Questions to small arrays, one compiled pass each: numpy asks for microseconds a call, this for tenths of one."""

import math

import numpy as np

from rtctl.kernel import kernel
from rtctl.types import B1, F64, I64


@kernel
def any_set(flags: B1) -> bool:
    """Return whether any flag is set."""
    for i in range(flags.shape[0]):
        if flags[i]:
            return True
    return False


@kernel
def any_below(values: F64, bound: float) -> bool:
    """Return whether any value is below the bound; a NaN is not."""
    for i in range(values.shape[0]):
        if values[i] < bound:
            return True
    return False


@kernel
def all_equal(values: I64, wanted: int) -> bool:
    """Return whether every value is the wanted one."""
    for i in range(values.shape[0]):
        if values[i] != wanted:
            return False
    return True


@kernel
def largest(values: F64) -> float:
    """Return the largest value; a NaN is passed over unless it comes first."""
    out: float = values[0]
    for i in range(1, values.shape[0]):
        out = max(out, values[i])
    return out


@kernel
def greater(a: float, b: float) -> float:
    """Return the greater; a NaN that comes first stays, so that it is seen."""
    return b if b > a else a


@kernel
def norm(v: F64) -> float:
    """Return the Euclidean length."""
    s = 0.0
    for i in range(v.shape[0]):
        s += v[i] * v[i]
    return math.sqrt(s)


@kernel
def norms(rows: F64) -> F64:
    """Return the Euclidean length of each row of (r, c)."""
    out = np.empty(rows.shape[0])
    for r in range(rows.shape[0]):
        out[r] = norm(rows[r])
    return out

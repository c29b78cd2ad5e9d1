"""Shortest distance to ellipsoids, n-ellipsoids and n-cylinders, outside and inside, with unit outward normals.

Surface sum (|x_i|/a_i)^p_i = 1 with p_i >= 2 (Khatib 1986, section on analytic primitives): p = (2, 2, 2) ellipsoid,
(2n, 2n, 2n) n-ellipsoid, (2, 2, 2n) n-cylinder. The closest point x of y satisfies y - x = mu grad f(x), which
separates by axis: with t_i = |x_i|/a_i, X_i = |y_i|/a_i, c_i = p_i/a_i^2,

    t_i + mu c_i t_i^(p_i - 1) = X_i,     sum t_i^p_i = 1,     distance = mu |grad f|.

mu > 0 outside, mu < 0 inside. Accuracy (tests): ellipsoid 1e-13 of its size everywhere; others 1e-12 outside and 1e-9
inside. The shortcuts, radial distance and f/|grad f|, are wrong by factors of 40 and 0.01 on thin plates.
"""

import math
from typing import NamedTuple

from rtctl.kernel import kernel

_FLAT = 1e-10  # |sum X^p - 1| below which the first-order distance is exact to 1e-20 of the size
_NONE = 2.0  # "this coordinate would leave the box": any value above 1 reads as outside the surface
_SAMPLES = 12  # per axis, inside: brackets of stationary points; tests hold the result to dense sampling


class PerAxis(NamedTuple):
    """A number for each axis: of the frame's, or these turned round so that the one that is searched along is first."""

    a: float
    b: float
    c: float


@kernel
def ellipsoid(x: float, y: float, z: float, a: float, b: float, c: float) -> tuple[float, float, float, float]:
    """Return (signed distance, unit outward normal) of a local point to the ellipsoid x^2/a^2 + y^2/b^2 + z^2/c^2 = 1.

    Newton on 1/|t(s)| - 1, concave in the multiplier s, from a lower bound of its root: monotone, 3-6 steps. Inside it
    is the root on the far side of the same function, so nothing switches at the surface. The coordinate along the
    shortest semi-axis is kept off zero by 1e-150 of its length: that picks the positive side on the medial disc.
    """
    e = min(a, b, c)
    ra, rb, rc = (a / e) * (a / e), (b / e) * (b / e), (c / e) * (c / e)
    da, db, dc = (a - e) * (a + e) / (e * e), (b - e) * (b + e) / (e * e), (c - e) * (c + e) / (e * e)
    X, Y, Z = abs(x) / a, abs(y) / b, abs(z) / c
    if a == e:
        X = max(X, 1e-150)
    elif b == e:
        Y = max(Y, 1e-150)
    else:
        Z = max(Z, 1e-150)
    s = max(ra * X - da, rb * Y - db, rc * Z - dc)  # 1 + multiplier: each single term is at most 1 here
    for _ in range(100):
        ta, tb, tc = ra * X / (s + da), rb * Y / (s + db), rc * Z / (s + dc)
        S = ta * ta + tb * tb + tc * tc
        slope = ta * ta / (s + da) + tb * tb / (s + db) + tc * tc / (s + dc)
        step = S * (math.sqrt(S) - 1.0) / slope
        if step <= 1e-16 * s:
            break
        s += step
    u, v, w = a * X / (s + da), b * Y / (s + db), c * Z / (s + dc)
    norm = math.sqrt(u * u + v * v + w * w)
    return (
        (s - 1.0) * norm,
        math.copysign(u / norm, x),
        math.copysign(v / norm, y),
        math.copysign(w / norm, z),
    )


@kernel
def _power(t: float, p: float) -> float:
    """Return t^p for t >= 0, p >= 0: by squaring where p is whole (five times faster), else by libm."""
    n = int(p)
    if n != p:
        return math.pow(t, p)
    r = 1.0
    while n > 0:
        if n & 1:
            r *= t
        t *= t
        n >>= 1
    return r


@kernel
def n_surface(
    x: float, y: float, z: float, a: float, b: float, c: float, p: float, pz: float
) -> tuple[float, float, float, float]:
    """Return (signed distance, unit outward normal) of a local point to (x/a)^p + (y/b)^p + (z/c)^pz = 1.

    p = pz = 2n: n-ellipsoid; p = 2, pz = 2n: n-cylinder. p, pz in [2, 100].
    """
    if p == 2.0 and pz == 2.0:
        return ellipsoid(x, y, z, a, b, c)
    X, Y, Z = abs(x) / a, abs(y) / b, abs(z) / c
    f = _NONE
    if X <= 1.5 and Y <= 1.5 and Z <= 1.5:  # beyond that a power could overflow, and the point is outside anyway
        f = _power(X, p) + _power(Y, p) + _power(Z, pz) - 1.0
    if abs(f) <= _FLAT:
        u, v, w = p / a * _power(X, p - 1.0), p / b * _power(Y, p - 1.0), pz / c * _power(Z, pz - 1.0)
        norm = math.sqrt(u * u + v * v + w * w)
        distance = f / norm
    elif f < 0.0:
        distance, u, v, w = _inside(X, Y, Z, a, b, c, p, pz)
        norm = math.sqrt(u * u + v * v + w * w)
    else:
        mu, u, v, w = _outside(X, Y, Z, a, b, c, p, pz)
        norm = math.sqrt(u * u + v * v + w * w)
        distance = mu * norm
    return distance, math.copysign(u / norm, x), math.copysign(v / norm, y), math.copysign(w / norm, z)


@kernel
def _falling(X: float, k: float, p: float) -> float:
    """Return the root t in [0, X] of t + k t^(p-1) = X, k > 0: convex and rising, so Newton from above is monotone."""
    if X == 0.0 or k < 1e-280:
        return X
    if p == 2.0:
        return X / (1.0 + k)
    t = min(X, math.pow(X / k, 1.0 / (p - 1.0)))  # both terms alone bound the root from above
    for _ in range(60):
        r = k * _power(t, p - 2.0)
        lower = t - (t + r * t - X) / (1.0 + (p - 1.0) * r)
        if lower >= t:
            break
        small = t - lower <= 1e-9 * t  # quadratic convergence: this step was the last that counts
        t = lower
        if small:
            break
    return t


@kernel
def _rate(t: float, k: float, p: float) -> float:
    """Return -d(t^p)/d(log mu) of the root of `_falling`, >= 0."""
    if t <= 0.0:
        return 0.0
    r = k * _power(t, p - 2.0)
    return p * _power(t, p) * r / (1.0 + (p - 1.0) * r)


@kernel
def _least_mu(X: float, s: float, c: float, p: float) -> float:
    """Return the mu at which t = X/s, or infinity where the axis carries nothing."""
    t = X / s
    power = _power(t, p - 1.0)
    if power * c < 1e-280:
        return math.inf
    return (X - t) / (c * power)


@kernel
def _start(X: float, Y: float, Z: float, ca: float, cb: float, cc: float, p: float, pz: float) -> float:
    """Return a lower bound of mu from outside, tight near the surface and far away: there every t <= 1 and g >= 1.

    s is a radial scale with sum (X/s)^p >= 1; where all t_i >= X_i/s, g >= 1. Each axis alone gives (X-1)/c.
    """
    top = max(X, Y, Z)
    if p == pz:
        s = top * math.pow(_power(X / top, p) + _power(Y / top, p) + _power(Z / top, p), 1.0 / p)
    else:
        s = max(math.sqrt(X * X + Y * Y), Z)
        if s <= 1.0:  # the corner region: Newton on log sum (X/s)^p, convex and falling in log s, from the left
            s = 1.0
            for _ in range(30):
                round_, flat = (X * X + Y * Y) / (s * s), _power(Z / s, pz)
                step = math.log(round_ + flat) * (round_ + flat) / (2.0 * round_ + pz * flat)
                s *= math.exp(step)
                if step < 1e-14:
                    break
            s = 1.0 + (s - 1.0) * (1.0 - 1e-6)  # stay on the left of the root
    least = min(_least_mu(X, s, ca, p), _least_mu(Y, s, cb, p), _least_mu(Z, s, cc, pz))
    return max(least, (X - 1.0) / ca, (Y - 1.0) / cb, (Z - 1.0) / cc)


@kernel
def _outside(
    X: float, Y: float, Z: float, a: float, b: float, c: float, p: float, pz: float
) -> tuple[float, float, float, float]:
    """Return (mu, gradient at the closest point) of an outside point: Newton on log g over log mu in a bracket."""
    ca, cb, cc = p / (a * a), p / (b * b), pz / (c * c)
    lo, hi = math.log(_start(X, Y, Z, ca, cb, cc, p, pz)), math.inf
    l = lo
    mu = math.exp(l)
    for _ in range(80):
        t, u, v = _falling(X, mu * ca, p), _falling(Y, mu * cb, p), _falling(Z, mu * cc, pz)
        g = _power(t, p) + _power(u, p) + _power(v, pz)
        slope = (_rate(t, mu * ca, p) + _rate(u, mu * cb, p) + _rate(v, mu * cc, pz)) / g
        value = math.log(g)
        if value > 0.0:
            lo = l
        else:
            hi = l
        target = l + value / slope if slope > 1e-300 else math.inf
        if not (lo < target < hi) or (math.isinf(hi) and target > lo + 3.0):
            if abs(value) < 1e-14 or hi - lo < 1e-14:
                break
            target = lo + 1.0 if math.isinf(hi) else 0.5 * (lo + hi)
        step = target - l
        l = target
        mu = math.exp(l)
        if abs(step) < 1e-12:
            break
    t, u, v = _falling(X, mu * ca, p), _falling(Y, mu * cb, p), _falling(Z, mu * cc, pz)
    return (
        mu,
        p / a * _power(t, p - 1.0),
        p / b * _power(u, p - 1.0),
        pz / c * _power(v, pz - 1.0),
    )


@kernel
def _rising(X: float, k: float, p: float) -> float:
    """Return the smaller root t in [X, 1] of t - k t^(p-1) = X, or _NONE: concave, so Newton from below is monotone."""
    if X == 0.0 or k == 0.0:
        return X
    t = X
    for _ in range(60):
        r = k * _power(t, p - 2.0)
        slope = 1.0 - (p - 1.0) * r
        if slope <= 0.0:
            return _NONE
        upper = t + (X - t + r * t) / slope
        if upper > 1.0:
            return _NONE
        small = upper - t <= 1e-12 * upper
        t = max(t, upper)
        if small:
            break
    return t


@kernel
def _excess(t: float, X: PerAxis, k: PerAxis, p: PerAxis) -> tuple[float, float, float]:
    """Return (sum t_i^p_i - 1, t_b, t_c) along the stationary curve on which axis a has coordinate t >= X; k: p/a^2."""
    m = (t - X.a) / (k.a * _power(t, p.a - 1.0))
    u, v = _rising(X.b, m * k.b, p.b), _rising(X.c, m * k.c, p.c)
    if u > 1.0 or v > 1.0:
        return _NONE, u, v
    return _power(t, p.a) + _power(u, p.b) + _power(v, p.c) - 1.0, u, v


@kernel
def _root(lo: float, hi: float, X: PerAxis, k: PerAxis, p: PerAxis) -> tuple[float, float, float]:
    """Return (t_a, t_b, t_c) where `_excess` turns from <= 0 at lo to >= 0 at hi: of the steps, the nearest to zero.

    Regula falsi (Illinois) where both ends have a value, bisection where the upper one has none and every third step.
    """
    low, u, v = _excess(lo, X, k, p)
    high = _excess(hi, X, k, p)[0]
    t, least = lo, abs(low)
    for i in range(80):
        mid = 0.5 * (lo + hi)
        if high < 1.0 and i % 3 != 2:
            mid = lo + (hi - lo) * low / (low - high) if low < 0.0 else lo
        excess, u_mid, v_mid = _excess(mid, X, k, p)
        if abs(excess) < least:
            least, t, u, v = abs(excess), mid, u_mid, v_mid
        if excess > 0.0:
            hi, high, low = mid, excess, 0.5 * low
        else:
            lo, low, high = mid, excess, (0.5 * high if high < 1.0 else high)
        if least < 1e-15 or hi - lo < 4e-16:
            break
    return t, u, v


@kernel
def _scaled(foot: PerAxis, X: PerAxis, size: PerAxis, p: float, pz: float) -> tuple[float, float, float, float]:
    """Return (distance to it, t, u, v) of a candidate pushed radially onto the surface: always an upper bound."""
    t, u, v = foot
    k = 0.0
    for _ in range(40):  # Newton on log sum over log scale: convex and rising
        flat, steep = _power(t, p) + _power(u, p), _power(v, pz)
        step = -math.log(flat + steep) * (flat + steep) / (p * flat + pz * steep)
        k = math.exp(step)
        t, u, v = t * k, u * k, v * k
        if abs(step) < 1e-15:
            break
    e, f, g = size.a * (t - X.a), size.b * (u - X.b), size.c * (v - X.c)
    return math.sqrt(e * e + f * f + g * g), t, u, v


@kernel
def _back(v: PerAxis, order: int) -> PerAxis:
    """Return in x, y, z order what was turned round by `order` places."""
    if order == 0:
        return v
    if order == 1:  # (a, b, c) = (y, z, x)
        return PerAxis(v.c, v.a, v.b)
    return PerAxis(v.b, v.c, v.a)  # (a, b, c) = (z, x, y)


@kernel
def _along(X: PerAxis, size: PerAxis, p: PerAxis, order: int, most: float) -> tuple[float, float, float, float]:
    """Return the best stationary point on the curve of axis a as (distance, t, u, v) in x, y, z order, if below most.

    `order` says how many places (a, b, c) was rotated from (x, y, z). The distance is at least a (t - X), so `most`
    limits the range of t.
    """
    k = PerAxis(p.a / (size.a * size.a), p.b / (size.b * size.b), p.c / (size.c * size.c))
    X_xyz, size_xyz, p_xyz = _back(X, order), _back(size, order), _back(p, order)
    best, bt, bu, bv = most, 0.0, 0.0, 0.0
    floor = max(X.a, 0.02)
    hi = min(1.0, X.a + most / size.a * (1.0 + 1e-9))
    span = hi - floor
    upper = _excess(hi, X, k, p)[0]
    for i in range(1, _SAMPLES + 1):
        lo = floor + span * (_SAMPLES - i) / _SAMPLES
        lower = _excess(lo, X, k, p)[0]
        if lower <= 0.0 and upper >= 0.0 and size.a * (lo - X.a) < best:
            t, u, v = _root(lo, hi, X, k, p)
            # in x, y, z order again: the exponents of x and y are equal, so z must be at its place
            d, t, u, v = _scaled(_back(PerAxis(t, u, v), order), X_xyz, size_xyz, p_xyz.a, p_xyz.c)
            if d < best:
                best, bt, bu, bv = d, t, u, v
        hi, upper = lo, lower
    return best, bt, bu, bv


@kernel
def _to_face(X: float, Y: float, Z: float, a: float, pa: float, pb: float, pc: float) -> tuple[float, float]:
    """Return (distance to the surface along axis a, its coordinate t there): an upper bound of the depth."""
    t = math.pow(max(0.0, 1.0 - _power(Y, pb) - _power(Z, pc)), 1.0 / pa)
    t = max(t, X)
    return a * (t - X), t


@kernel
def _inside(
    X: float, Y: float, Z: float, a: float, b: float, c: float, p: float, pz: float
) -> tuple[float, float, float, float]:
    """Return (negative distance, gradient at the closest point) of an inside point.

    At a local minimum of the distance at most one axis is past the turning point of t - m c t^(p-1) (second-order
    condition on a surface), so three one-dimensional searches, one by axis, see every minimum. What they find is put
    on the surface, hence the depth is never understated; of equal depths the first axis wins. The straight ways along
    the axes bound the search and stand in should it find nothing below them (a point on an axis).
    """
    best, t = _to_face(X, Y, Z, a, p, p, pz)
    u, v = Y, Z
    d, s = _to_face(Y, X, Z, b, p, p, pz)
    if d < best:
        best, t, u, v = d, X, s, Z
    d, s = _to_face(Z, X, Y, c, pz, p, p)
    if d < best:
        best, t, u, v = d, X, Y, s
    d, t1, u1, v1 = _along(PerAxis(X, Y, Z), PerAxis(a, b, c), PerAxis(p, p, pz), 0, best)
    if d < best:
        best, t, u, v = d, t1, u1, v1
    d, t1, u1, v1 = _along(PerAxis(Y, Z, X), PerAxis(b, c, a), PerAxis(p, pz, p), 1, best)
    if d < best:
        best, t, u, v = d, t1, u1, v1
    d, t1, u1, v1 = _along(PerAxis(Z, X, Y), PerAxis(c, a, b), PerAxis(pz, p, p), 2, best)
    if d < best:
        best, t, u, v = d, t1, u1, v1
    return -best, p / a * _power(t, p - 1.0), p / b * _power(u, p - 1.0), pz / c * _power(v, pz - 1.0)

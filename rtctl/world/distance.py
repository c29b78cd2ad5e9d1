"""Signed distance and unit outward normal of many points to one posed primitive, in loops the compiler vectorises.

Every kernel: `P` (3, m) points in the world [m], one row per coordinate; `radius` (m,) [m] of the spheres around them;
slot `k` of the poses `R` (K, 3, 3), `p` (K, 3) and of `dims` (K, 5). Writes `out[k]` (4, m): row 0 rho = distance to
the surface - radius, negative inside; rows 1-3 the normal d rho/d p, unit, outward, also on the surface, inside and on
medial sets (a fixed choice there). Whole arrays and an index, because a view costs as much as eight points.
Selections are written so that a NaN coordinate gives a NaN rho, never a plausible number.
"""

import math

from rtctl.kernel import leaf_kernel
from rtctl.types import F64

_TINY = 1e-200  # [m2] squared length below which a direction is not taken from a vector


@leaf_kernel
def sphere(P: F64, radius: F64, R: F64, p: F64, dims: F64, k: int, out: F64) -> None:
    """Sphere of radius dims[k, 0]; a point is one of radius 0. At the centre the normal is local z."""
    px, py, pz, r = p[k, 0], p[k, 1], p[k, 2], dims[k, 0]
    zx, zy, zz = R[k, 0, 2], R[k, 1, 2], R[k, 2, 2]
    for j in range(radius.shape[0]):
        x, y, z = P[0, j] - px, P[1, j] - py, P[2, j] - pz
        d2 = x * x + y * y + z * z
        d = math.sqrt(d2)
        apart = d2 > _TINY
        s = 1.0 / (d if apart else 1.0)
        out[k, 1, j] = x * s if apart else zx
        out[k, 2, j] = y * s if apart else zy
        out[k, 3, j] = z * s if apart else zz
        out[k, 0, j] = d - r - radius[j]


@leaf_kernel
def capsule(P: F64, radius: F64, R: F64, p: F64, dims: F64, k: int, out: F64) -> None:
    """Capsule (or segment) of radius dims[k, 0], half length dims[k, 1] on local z; the normal on the axis is x."""
    px, py, pz, r, h = p[k, 0], p[k, 1], p[k, 2], dims[k, 0], dims[k, 1]
    xx, xy, xz = R[k, 0, 0], R[k, 1, 0], R[k, 2, 0]
    zx, zy, zz = R[k, 0, 2], R[k, 1, 2], R[k, 2, 2]
    for j in range(radius.shape[0]):
        x, y, z = P[0, j] - px, P[1, j] - py, P[2, j] - pz
        t = x * zx + y * zy + z * zz
        t = h if t > h else (-h if t < -h else t)
        x, y, z = x - t * zx, y - t * zy, z - t * zz
        d2 = x * x + y * y + z * z
        d = math.sqrt(d2)
        apart = d2 > _TINY
        s = 1.0 / (d if apart else 1.0)
        out[k, 1, j] = x * s if apart else xx
        out[k, 2, j] = y * s if apart else xy
        out[k, 3, j] = z * s if apart else xz
        out[k, 0, j] = d - r - radius[j]


@leaf_kernel
def plane(P: F64, radius: F64, R: F64, p: F64, k: int, out: F64) -> None:
    """Half-space below local z = 0; the normal is local z everywhere."""
    px, py, pz = p[k, 0], p[k, 1], p[k, 2]
    zx, zy, zz = R[k, 0, 2], R[k, 1, 2], R[k, 2, 2]
    for j in range(radius.shape[0]):
        out[k, 0, j] = (P[0, j] - px) * zx + (P[1, j] - py) * zy + (P[2, j] - pz) * zz - radius[j]
        out[k, 1, j] = zx
        out[k, 2, j] = zy
        out[k, 3, j] = zz


@leaf_kernel
def box(P: F64, radius: F64, R: F64, p: F64, dims: F64, k: int, out: F64) -> None:
    """Box of half sizes dims[k, :3]; inside, the nearest face, of equal ones the first of x, y, z, positive side."""
    px, py, pz, a, b, c = p[k, 0], p[k, 1], p[k, 2], dims[k, 0], dims[k, 1], dims[k, 2]
    xx, xy, xz = R[k, 0, 0], R[k, 1, 0], R[k, 2, 0]
    yx, yy, yz = R[k, 0, 1], R[k, 1, 1], R[k, 2, 1]
    zx, zy, zz = R[k, 0, 2], R[k, 1, 2], R[k, 2, 2]
    for j in range(radius.shape[0]):
        dx, dy, dz = P[0, j] - px, P[1, j] - py, P[2, j] - pz
        x, y, z = dx * xx + dy * xy + dz * xz, dx * yx + dy * yy + dz * yz, dx * zx + dy * zy + dz * zz
        u, v, w = abs(x) - a, abs(y) - b, abs(z) - c
        # Outside: the part of the offset that sticks out. Inside: the largest (least negative) of u, v, w.
        e, f, g = (0.0 if u <= 0.0 else u), (0.0 if v <= 0.0 else v), (0.0 if w <= 0.0 else w)
        d2 = e * e + f * f + g * g
        d = math.sqrt(d2)
        apart = d2 > _TINY
        s = 1.0 / (d if apart else 1.0)
        side = v if v >= w else w
        first = 1.0 if u >= side else 0.0
        second = 0.0 if u >= side else (1.0 if v >= w else 0.0)
        third = 0.0 if u >= side else (0.0 if v >= w else 1.0)
        e = e * s if apart else first
        f = f * s if apart else second
        g = g * s if apart else third
        e, f, g = (e if x >= 0.0 else -e), (f if y >= 0.0 else -f), (g if z >= 0.0 else -g)
        out[k, 1, j] = xx * e + yx * f + zx * g
        out[k, 2, j] = xy * e + yy * f + zy * g
        out[k, 3, j] = xz * e + yz * f + zz * g
        out[k, 0, j] = (d if apart else (u if u >= side else side)) - radius[j]


@leaf_kernel
def cone(P: F64, radius: F64, R: F64, p: F64, dims: F64, k: int, out: F64) -> None:
    """Truncated cone about local z, or cylinder: radius dims[k, 0] at -h, dims[k, 1] at h = dims[k, 2].

    In the half plane (s, z), s the distance from the axis, it is a convex polygon: caps, and a slanted side whose
    outward normal is (kr, kz). Inside, the nearest of the three; on the axis, the radial direction is local x.
    """
    px, py, pz, ra, rb, h = p[k, 0], p[k, 1], p[k, 2], dims[k, 0], dims[k, 1], dims[k, 2]
    xx, xy, xz = R[k, 0, 0], R[k, 1, 0], R[k, 2, 0]
    yx, yy, yz = R[k, 0, 1], R[k, 1, 1], R[k, 2, 1]
    zx, zy, zz = R[k, 0, 2], R[k, 1, 2], R[k, 2, 2]
    L = math.sqrt((rb - ra) * (rb - ra) + 4.0 * h * h)
    kr, kz = 2.0 * h / L, (ra - rb) / L
    for j in range(radius.shape[0]):
        dx, dy, dz = P[0, j] - px, P[1, j] - py, P[2, j] - pz
        x, y, z = dx * xx + dy * xy + dz * xz, dx * yx + dy * yy + dz * yz, dx * zx + dy * zy + dz * zz
        s2 = x * x + y * y
        s = math.sqrt(s2)
        off = s2 > _TINY
        i = 1.0 / (s if off else 1.0)
        cx, cy = (x * i if off else 1.0), (y * i if off else 0.0)
        # Above the caps (> 0), beyond the side (> 0), and where along the side the foot lies.
        top, bottom = z - h, -z - h
        e, g = s - ra, z + h
        side = e * kr + g * kz
        foot = g * kr - e * kz
        past = foot - L if foot > L else (foot if foot < 0.0 else 0.0)  # beyond an edge: the offset along the side
        de, dg = side * kr - past * kz, side * kz + past * kr
        d2 = de * de + dg * dg
        d = math.sqrt(d2)
        corner = abs(past) > 0.0 and d2 > _TINY
        i = 1.0 / (d if corner else 1.0)
        distance, n, m = (d if corner else side), (de * i if corner else kr), (dg * i if corner else kz)
        inside = side <= 0.0 and top <= 0.0 and bottom <= 0.0
        up = (top > 0.0 and s <= rb) or (inside and top >= side and top >= bottom)
        down = (bottom > 0.0 and s <= ra) or (inside and bottom > top and bottom >= side)
        distance = top if up else (bottom if down else (side if inside else distance))
        n = 0.0 if up or down else (kr if inside else n)
        m = 1.0 if up else (-1.0 if down else (kz if inside else m))
        e, f = n * cx, n * cy
        out[k, 1, j] = xx * e + yx * f + zx * m
        out[k, 2, j] = xy * e + yy * f + zy * m
        out[k, 3, j] = xz * e + yz * f + zz * m
        out[k, 0, j] = distance - radius[j]

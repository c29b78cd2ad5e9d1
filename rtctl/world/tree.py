"""Nearest of many points or triangles: a balanced tree of boxes whose shape follows from their number alone.

A body is one flat float64 array (numba passes one array in a tenth of the time of a structure):

    head          count n, leaves L (a power of two), reach [m] about the frame, floats per item (3 or 9)
    boxes         2 L nodes of 6: least x y z, greatest x y z; node i has children 2i and 2i + 1, leaves are L .. 2L - 1
    items         n of 3 (points) or 9 (corners of triangles) floats; leaf l holds items l n // L .. (l + 1) n // L
    normals       of triangles only, n of 21: of the face, of edges ab, bc, ca, of corners a, b, c

The order of the items decides how fast the search is, never what it finds: the boxes are made from the items as they
stand. So whoever sends a cloud may sort it, and need not be trusted to have done it well.
"""

import math
from typing import NamedTuple

import numpy as np

from rtctl.kernel import kernel
from rtctl.types import F64, I64

HEAD = 4
POINTS_PER_LEAF, TRIANGLES_PER_LEAF = 16, 2
DEPTH = 40  # of the stack: a tree of 2^39 leaves
ON = 1e-9  # [m] nearer to the surface than this, a direction is not taken from the difference of two points
_SLACK = 1e-9  # [m] and relative: far above the rounding errors of any distance


def boxes_of(body: F64, most: int) -> F64:
    """Return the boxes (k, 6) [m] of one level of a body's tree, k at most `most`: together they hold all its items."""
    level = 1
    while 2 * level <= min(most, int(body[1])):
        level *= 2
    boxes = body[HEAD + 6 * level : HEAD + 12 * level].reshape(level, 6)
    return boxes[np.all(boxes[:, :3] <= boxes[:, 3:], axis=1)]  # a leaf without items has none


@kernel
def leaves_for(count: int, per_leaf: int) -> int:
    """Return the least power of two of leaves that hold at most `per_leaf` items each."""
    leaves = 1
    while leaves * per_leaf < count:
        leaves *= 2
    return leaves


@kernel
def _select(X: F64, axis: int, order: I64, low: int, high: int, k: int) -> None:
    """Arrange order[low:high] so that nothing before place k lies above anything from it on (Hoare's selection)."""
    high -= 1
    while low < high:
        pivot = X[order[(low + high) // 2], axis]
        i, j = low, high
        while i <= j:
            while X[order[i], axis] < pivot:
                i += 1
            while X[order[j], axis] > pivot:
                j -= 1
            if i <= j:
                order[i], order[j] = order[j], order[i]
                i += 1
                j -= 1
        if k <= j:
            high = j
        elif k >= i:
            low = i
        else:
            return


@kernel
def ordered(X: F64, per_leaf: int) -> I64:
    """Return the order (n,) of finite points X (n, 3) that makes small boxes: halves along the longest side."""
    n = X.shape[0]
    leaves = leaves_for(n, per_leaf)
    order = np.arange(n)
    nodes = 1
    while nodes < leaves:
        for i in range(nodes):
            low, high = i * n // nodes, (i + 1) * n // nodes
            axis, longest = 0, -1.0
            for d in range(3):
                least, most = math.inf, -math.inf
                for j in range(low, high):
                    least, most = min(least, X[order[j], d]), max(most, X[order[j], d])
                if most - least > longest:
                    axis, longest = d, most - least
            _select(X, axis, order, low, high, (2 * i + 1) * n // (2 * nodes))
        nodes *= 2
    return order


@kernel
def fill_boxes(body: F64) -> None:
    """Make the boxes of a body, and its reach, from its head and its items."""
    n, leaves, width = int(body[0]), int(body[1]), int(body[3])
    items = HEAD + 12 * leaves
    for leaf in range(leaves):
        at = HEAD + 6 * (leaves + leaf)
        for d in range(3):
            least, most = math.inf, -math.inf
            for j in range(items + width * (leaf * n // leaves) + d, items + width * ((leaf + 1) * n // leaves), 3):
                least, most = min(least, body[j]), max(most, body[j])
            body[at + d], body[at + 3 + d] = least, most
    for node in range(leaves - 1, 0, -1):
        at, left = HEAD + 6 * node, HEAD + 12 * node
        for d in range(3):
            body[at + d] = min(body[left + d], body[left + 6 + d])
            body[at + 3 + d] = max(body[left + 3 + d], body[left + 9 + d])
    reach2 = 0.0
    for d in range(3):  # of the box about all: a bound
        far = max(abs(body[HEAD + 6 + d]), abs(body[HEAD + 9 + d]))
        reach2 += far * far
    body[2] = math.sqrt(reach2)


@kernel
def cloud_body(steps: I64, step: float) -> F64:
    """Return the body of points `step` [m] times whole numbers `steps` (3 n,), n >= 1, in the order in which they come.

    15 us for 2,000 points, 60 us for 10,000: what the servo does for a new cloud.
    """
    n = steps.shape[0] // 3
    leaves = leaves_for(n, POINTS_PER_LEAF)
    items = HEAD + 12 * leaves
    body = np.empty(items + 3 * n)
    body[0], body[1], body[3] = n, leaves, 3.0
    for j in range(3 * n):
        body[items + j] = step * steps[j]
    fill_boxes(body)
    return body


@kernel
def _box2(body: F64, at: int, x: float, y: float, z: float) -> float:
    """Return the squared distance to the box at `at`, 0 inside."""
    e, f = body[at] - x, x - body[at + 3]
    d = e if e > 0.0 else (f if f > 0.0 else 0.0)
    e, f = body[at + 1] - y, y - body[at + 4]
    g = e if e > 0.0 else (f if f > 0.0 else 0.0)
    e, f = body[at + 2] - z, z - body[at + 5]
    h = e if e > 0.0 else (f if f > 0.0 else 0.0)
    return d * d + g * g + h * h


@kernel
def _foot(body: F64, at: int, x: float, y: float, z: float) -> tuple[float, float, float, int]:
    """Return the point of a triangle nearest to (x, y, z), and where it lies: 0 face, 1-3 edges ab bc ca, 4-6 corners.

    By the signs of the barycentric coordinates (Ericson, Real-Time Collision Detection, 5.1.5).
    """
    ax, ay, az = body[at], body[at + 1], body[at + 2]
    bx, by, bz = body[at + 3], body[at + 4], body[at + 5]
    cx, cy, cz = body[at + 6], body[at + 7], body[at + 8]
    ux, uy, uz, wx, wy, wz = bx - ax, by - ay, bz - az, cx - ax, cy - ay, cz - az
    px, py, pz = x - ax, y - ay, z - az
    d1, d2 = ux * px + uy * py + uz * pz, wx * px + wy * py + wz * pz
    if d1 <= 0.0 and d2 <= 0.0:
        return ax, ay, az, 4
    px, py, pz = x - bx, y - by, z - bz
    d3, d4 = ux * px + uy * py + uz * pz, wx * px + wy * py + wz * pz
    if d3 >= 0.0 and d4 <= d3:
        return bx, by, bz, 5
    px, py, pz = x - cx, y - cy, z - cz
    d5, d6 = ux * px + uy * py + uz * pz, wx * px + wy * py + wz * pz
    if d6 >= 0.0 and d5 <= d6:
        return cx, cy, cz, 6
    area_c = d1 * d4 - d3 * d2
    if area_c <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        t = d1 / (d1 - d3)
        return ax + t * ux, ay + t * uy, az + t * uz, 1
    area_b = d5 * d2 - d1 * d6
    if area_b <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        t = d2 / (d2 - d6)
        return ax + t * wx, ay + t * wy, az + t * wz, 3
    area_a = d3 * d6 - d5 * d4
    if area_a <= 0.0 and d4 >= d3 and d5 >= d6:
        t = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        return bx + t * (cx - bx), by + t * (cy - by), bz + t * (cz - bz), 2
    whole = area_a + area_b + area_c
    s, t = area_b / whole, area_c / whole
    return ax + s * ux + t * wx, ay + s * uy + t * wy, az + s * uz + t * wz, 0


@kernel
def _in_leaf(body: F64, at: int, stop: int, width: int, x: float, y: float, z: float, best: float) -> tuple[float, int]:
    """Return (squared distance, place) of the nearest item of a leaf if it is nearer than `best`, else (best, -1)."""
    found = -1
    for item in range(at, stop, width):
        if width == 3:
            u, v, w = body[item], body[item + 1], body[item + 2]
        else:
            u, v, w, _ = _foot(body, item, x, y, z)
        d2 = (x - u) * (x - u) + (y - v) * (y - v) + (z - w) * (z - w)
        if d2 < best:
            best, found = d2, item
    return best, found


@kernel
def _nearest(body: F64, o: int, x: float, y: float, z: float, most: float, nodes: I64, keys: F64) -> tuple[float, int]:
    """Return (squared distance, place in `body`) of the nearest item of the body at `o`, (most, -1) if none is nearer.

    most: [m2]. nodes, keys: (DEPTH,) work arrays. Nearer child first, so that the first leaf bounds the rest.
    """
    n, leaves, width = int(body[o]), int(body[o + 1]), int(body[o + 3])
    boxes = o + HEAD
    items = boxes + 12 * leaves
    best, found, top, node = most, -1, 0, 1
    while True:
        if node < leaves:
            left = boxes + 12 * node
            a, b = _box2(body, left, x, y, z), _box2(body, left + 6, x, y, z)
            near, far, step = (a, b, 0) if a <= b else (b, a, 1)
            if far < best:
                nodes[top], keys[top] = 2 * node + 1 - step, far
                top += 1
            if near < best:
                node = 2 * node + step
                continue
        else:
            leaf = node - leaves
            at, stop = items + width * (leaf * n // leaves), items + width * ((leaf + 1) * n // leaves)
            best, item = _in_leaf(body, at, stop, width, x, y, z, best)
            found = item if item >= 0 else found
        while top > 0 and keys[top - 1] >= best:
            top -= 1
        if top == 0:
            return best, found
        top -= 1
        node = nodes[top]


@kernel
def _side(body: F64, o: int, item: int, x: float, y: float, z: float) -> tuple[float, float, float, float]:
    """Return (signed distance, unit outward normal) of a point whose nearest triangle is at `item`.

    Inside or outside is told by the normal of the face, or the angle-weighted one of the edge or corner, that the foot
    lies on: right for every closed surface (Baerentzen and Aanaes 2005).
    """
    n, leaves = int(body[o]), int(body[o + 1])
    items = o + HEAD + 12 * leaves
    u, v, w, place = _foot(body, item, x, y, z)
    at = items + 9 * n + 21 * ((item - items) // 9) + 3 * place
    nx, ny, nz = body[at], body[at + 1], body[at + 2]
    dx, dy, dz = x - u, y - v, z - w
    d = math.sqrt(dx * dx + dy * dy + dz * dz)
    sign = 1.0 if dx * nx + dy * ny + dz * nz >= 0.0 else -1.0
    if d > ON:
        nx, ny, nz = sign * dx / d, sign * dy / d, sign * dz / d
    return sign * d, nx, ny, nz


class Body(NamedTuple):
    """A cloud or a mesh."""

    data: F64  # see above
    at: int  # where it begins there
    grown: float  # [m] thickness of its items


class Search(NamedTuple):
    """Work memory of a walk through a tree."""

    nodes: I64  # (DEPTH,)
    keys: F64  # (DEPTH,)


@kernel
def _exact(body: Body, x: float, y: float, z: float, most: float, search: Search) -> tuple[float, float, float, float]:
    """Return (distance, unit normal) of a point in the body's frame, or `most` [m] and z where all is farther."""
    data, o = body.data, body.at
    d2, item = _nearest(data, o, x, y, z, most * most, search.nodes, search.keys)
    if item < 0:
        return most, 0.0, 0.0, 1.0
    if data[o + 3] != 3.0:
        return _side(data, o, item, x, y, z)
    d = math.sqrt(d2)
    if d > 0.0:
        e, f, g = (x - data[item]) / d, (y - data[item + 1]) / d, (z - data[item + 2]) / d
        size = math.sqrt(e * e + f * f + g * g)  # of a tiny difference the square has lost digits
        if size > 0.0:
            return d, e / size, f / size, g / size
    return d, 0.0, 0.0, 1.0


@kernel
def _local(P: F64, R: F64, p: F64, k: int, j: int) -> tuple[float, float, float]:
    """Return point j in the frame of slot k."""
    dx, dy, dz = P[0, j] - p[k, 0], P[1, j] - p[k, 1], P[2, j] - p[k, 2]
    return (
        dx * R[k, 0, 0] + dy * R[k, 1, 0] + dz * R[k, 2, 0],
        dx * R[k, 0, 1] + dy * R[k, 1, 1] + dz * R[k, 2, 1],
        dx * R[k, 0, 2] + dy * R[k, 1, 2] + dz * R[k, 2, 2],
    )


@kernel
def _boxed(P: F64, radius: F64, R: F64, p: F64, k: int, body: Body, out: F64) -> int:
    """Write the distances to the box about a body, never farther than what is in it; return the nearest point."""
    root, solid, first = body.at + HEAD + 6, body.data[body.at + 3] == 9.0, 0
    for j in range(radius.shape[0]):
        x, y, z = _local(P, R, p, k, j)
        # beside a cloud nothing is farther below 0 than the thickness; in the box of a mesh anything may be
        d2 = _box2(body.data, root, x, y, z)
        out[k, 0, j] = -math.inf if solid and d2 == 0.0 else math.sqrt(d2) - body.grown - radius[j]
        out[k, 0, j] += 0.0 * (x + y + z)  # not a number in, not a number out
        out[k, 1, j], out[k, 2, j], out[k, 3, j] = R[k, 0, 2], R[k, 1, 2], R[k, 2, 2]
        if out[k, 0, j] < out[k, 0, first]:
            first = j
    return first


@kernel
def many(P: F64, radius: F64, R: F64, p: F64, k: int, body: Body, cutoff: float, out: F64) -> None:
    """Distances of points to a cloud or mesh in slot k.

    As the kernels of `distance`, behind a pre-filter: the point nearest to the box about all is made exact first;
    whatever is nearer than the cut-off, or than all points before, is exact, so the least is; an entry left as a lower
    bound is above both.
    """
    if radius.shape[0] == 0:
        return
    first, least = _boxed(P, radius, R, p, k, body, out), math.inf
    search = Search(np.empty(DEPTH, np.int64), np.empty(DEPTH))
    for i in range(-1, radius.shape[0]):
        j = first if i < 0 else i
        if i == first:
            continue
        limit = max(cutoff, least)
        limit += _SLACK * (1.0 + abs(limit))
        if out[k, 0, j] > limit:
            continue
        if out[k, 0, j] == -math.inf or limit + body.grown + radius[j] <= 0.0:
            limit = math.inf
        x, y, z = _local(P, R, p, k, j)
        d, e, f, g = _exact(body, x, y, z, limit + body.grown + radius[j], search)
        out[k, 0, j] = d - body.grown - radius[j] + 0.0 * (x + y + z)  # not a number in, not a number out
        for c in range(3):
            out[k, 1 + c, j] = R[k, c, 0] * e + R[k, c, 1] * f + R[k, c, 2] * g
        if out[k, 0, j] < least:
            least = out[k, 0, j]

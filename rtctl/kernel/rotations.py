"""Rotations: wxyz unit quaternions, rotation matrices and rotation vectors, smooth at 0 and defined at pi.

Compiled, and valid as plain Python; no BLAS, so that bits repeat on every machine.
"""

import math

import numpy as np

from rtctl.kernel import kernel
from rtctl.types import F64

# Below this the series is exact to double precision (next term of order 1e-18), above it the closed form is.
_SMALL = 1e-4


@kernel
def exp3(w: F64) -> F64:
    """Return the rotation matrix of a rotation vector, R = I + s [w] + c [w]^2 (Rodrigues).

    w: (3,) [rad], axis times angle. Returns (3, 3).
    """
    x, y, z = w[0], w[1], w[2]
    angle2 = x * x + y * y + z * z
    if angle2 < _SMALL * _SMALL:
        s = 1.0 - angle2 / 6.0
        c = 0.5 - angle2 / 24.0
    else:
        angle = math.sqrt(angle2)
        s = math.sin(angle) / angle
        half = math.sin(0.5 * angle)
        c = 2.0 * half * half / angle2  # 1 - cos without cancellation
    R = np.empty((3, 3))
    R[0, 0] = 1.0 - c * (y * y + z * z)
    R[1, 1] = 1.0 - c * (x * x + z * z)
    R[2, 2] = 1.0 - c * (x * x + y * y)
    R[0, 1] = c * x * y - s * z
    R[1, 0] = c * x * y + s * z
    R[0, 2] = c * x * z + s * y
    R[2, 0] = c * x * z - s * y
    R[1, 2] = c * y * z - s * x
    R[2, 1] = c * y * z + s * x
    return R


@kernel
def quat_of(R: F64) -> F64:
    """Return the unit quaternion wxyz of a rotation matrix, w >= 0 (Shepperd: divide by the largest component).

    R: (3, 3). Returns (4,).
    """
    q = np.empty(4)
    trace = R[0, 0] + R[1, 1] + R[2, 2]
    if trace >= R[0, 0] and trace >= R[1, 1] and trace >= R[2, 2]:
        q[0] = 1.0 + trace
        q[1] = R[2, 1] - R[1, 2]
        q[2] = R[0, 2] - R[2, 0]
        q[3] = R[1, 0] - R[0, 1]
    elif R[0, 0] >= R[1, 1] and R[0, 0] >= R[2, 2]:
        q[0] = R[2, 1] - R[1, 2]
        q[1] = 1.0 + R[0, 0] - R[1, 1] - R[2, 2]
        q[2] = R[0, 1] + R[1, 0]
        q[3] = R[0, 2] + R[2, 0]
    elif R[1, 1] >= R[2, 2]:
        q[0] = R[0, 2] - R[2, 0]
        q[1] = R[0, 1] + R[1, 0]
        q[2] = 1.0 - R[0, 0] + R[1, 1] - R[2, 2]
        q[3] = R[1, 2] + R[2, 1]
    else:
        q[0] = R[1, 0] - R[0, 1]
        q[1] = R[0, 2] + R[2, 0]
        q[2] = R[1, 2] + R[2, 1]
        q[3] = 1.0 - R[0, 0] - R[1, 1] + R[2, 2]
    norm = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    scale = -1.0 / norm if q[0] < 0.0 else 1.0 / norm
    for i in range(4):
        q[i] *= scale
    return q


@kernel
def R_of(wxyz: F64) -> F64:
    """Return the rotation matrix of a quaternion of any non-zero length.

    wxyz: (4,). Returns (3, 3).
    """
    w, x, y, z = wxyz[0], wxyz[1], wxyz[2], wxyz[3]
    k = 2.0 / (w * w + x * x + y * y + z * z)
    R = np.empty((3, 3))
    R[0, 0] = 1.0 - k * (y * y + z * z)
    R[1, 1] = 1.0 - k * (x * x + z * z)
    R[2, 2] = 1.0 - k * (x * x + y * y)
    R[0, 1] = k * (x * y - w * z)
    R[1, 0] = k * (x * y + w * z)
    R[0, 2] = k * (x * z + w * y)
    R[2, 0] = k * (x * z - w * y)
    R[1, 2] = k * (y * z - w * x)
    R[2, 1] = k * (y * z + w * x)
    return R


@kernel
def log3(R: F64) -> F64:
    """Return the rotation vector of a rotation matrix, 2 atan2(|v|, w) v/|v|; at pi either of the two axes.

    R: (3, 3). Returns (3,) [rad], length in [0, pi].
    """
    q = quat_of(R)
    s2 = q[1] * q[1] + q[2] * q[2] + q[3] * q[3]
    s = math.sqrt(s2)
    scale = 2.0 / q[0] * (1.0 - s2 / (3.0 * q[0] * q[0])) if s < _SMALL else 2.0 * math.atan2(s, q[0]) / s
    w = np.empty(3)
    for i in range(3):
        w[i] = scale * q[1 + i]
    return w


@kernel
def compose(A: F64, B: F64) -> F64:
    """Return the product A B of two (3, 3) matrices, without BLAS."""
    C = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            C[i, j] = A[i, 0] * B[0, j] + A[i, 1] * B[1, j] + A[i, 2] * B[2, j]
    return C


@kernel
def error(R: F64, R_goal: F64) -> F64:
    """Return the rotation vector, in the world frame, that takes R to R_goal: log(R_goal R^T).

    R, R_goal: (3, 3). Returns (3,) [rad].
    """
    D = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            D[i, j] = R_goal[i, 0] * R[j, 0] + R_goal[i, 1] * R[j, 1] + R_goal[i, 2] * R[j, 2]
    return log3(D)


@kernel
def error_to(R: F64, wxyz: F64) -> F64:
    """Return `error` of R (3, 3) against the orientation of a quaternion (4,)."""
    return error(R, R_of(wxyz))


@kernel
def orthonormal(R: F64) -> F64:
    """Return the rotation nearest to a matrix that drifted from SO(3) by rounding (through its quaternion)."""
    return R_of(quat_of(R))

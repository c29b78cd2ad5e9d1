"""Small dense linear algebra in plain loops: the same bits on every processor, no allocation surprises.

BLAS picks its kernels by CPU and so changes last bits between machines; replay needs them equal.
"""

import numpy as np

from rtctl.kernel import kernel
from rtctl.types import F64


@kernel
def matvec(M: F64, v: F64) -> F64:
    """Return M v, (r, c) by (c,)."""
    out = np.empty(M.shape[0])
    for i in range(M.shape[0]):
        s = 0.0
        for j in range(M.shape[1]):
            s += M[i, j] * v[j]
        out[i] = s
    return out


@kernel
def tmatvec(M: F64, v: F64) -> F64:
    """Return M^T v, (r, c) by (r,)."""
    out = np.zeros(M.shape[1])
    for i in range(M.shape[0]):
        for j in range(M.shape[1]):
            out[j] += M[i, j] * v[i]
    return out


@kernel
def matmul(P: F64, Q: F64) -> F64:
    """Return P Q, (r, k) by (k, c)."""
    out = np.zeros((P.shape[0], Q.shape[1]))
    for i in range(P.shape[0]):
        for k in range(P.shape[1]):
            for j in range(Q.shape[1]):
                out[i, j] += P[i, k] * Q[k, j]
    return out


@kernel
def symmetric_eigen(S: F64) -> tuple[F64, F64]:
    """Return eigenvalues (m,) and eigenvectors in columns (m, m) of a symmetric S by cyclic Jacobi.

    Convergence is quadratic; 12 sweeps are far more than a 6x6 needs, so the loop bound is a bound on
    time, not on accuracy. Order follows the diagonal, so eigenvectors move continuously with S.
    """
    m = S.shape[0]
    D = S.copy()
    V = np.eye(m)
    for _ in range(12):
        off = 0.0
        for p in range(m):
            for q in range(p + 1, m):
                off += D[p, q] * D[p, q]
        if off == 0.0:
            break
        for p in range(m):
            for q in range(p + 1, m):
                if D[p, q] == 0.0:
                    continue
                theta = (D[q, q] - D[p, p]) / (2.0 * D[p, q])
                if abs(theta) > 1e150:  # theta^2 would overflow; the rotation is then 1/(2 theta)
                    t = 0.5 / theta
                elif theta >= 0.0:
                    t = 1.0 / (theta + np.sqrt(1.0 + theta * theta))
                else:
                    t = -1.0 / (-theta + np.sqrt(1.0 + theta * theta))
                c = 1.0 / np.sqrt(1.0 + t * t)
                s = t * c
                for k in range(m):
                    a, b = D[k, p], D[k, q]
                    D[k, p], D[k, q] = c * a - s * b, s * a + c * b
                for k in range(m):
                    a, b = D[p, k], D[q, k]
                    D[p, k], D[q, k] = c * a - s * b, s * a + c * b
                    a, b = V[k, p], V[k, q]
                    V[k, p], V[k, q] = c * a - s * b, s * a + c * b
    values = np.empty(m)
    for i in range(m):
        values[i] = D[i, i]
    return values, V

"""What the joints get of what the drives give: torque constant, mounting, brakes; and the friction that holds them.

Coulomb and static friction are a bound on a torque that opposes motion, and that is as large as rest needs:

    (A + J) qdd = tau - bias - B qd - f,    |f_i| <= mu_i,    f_i < mu_i only where qd_i + dt qdd_i = 0

a box-constrained linear complementarity problem of one time step (Stewart and Trinkle 1996), solved here joint by joint
(projected Gauss-Seidel) from the solution of the step before.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from firmware_sim.reality import IDEAL, Reality

F64 = NDArray[np.float64]
CREEP = 0.01  # [rad/s] below it a joint sticks: static friction, not Coulomb's
SWEEPS = 60  # at most, of the joints
ENOUGH = 1e-9  # [Nm] of change in a sweep, below which it is over


def friction(A: F64, free: F64, qd: F64, bound: F64, dt: float, start: F64) -> F64:
    """Return the friction (n,) [Nm] that acts for a step of dt [s].

    A (n, n) [kg m2] with rotors; free (n,) [Nm]: torque less bias and viscous friction; qd (n,) [rad/s] now; bound (n,)
    [Nm]; start (n,) [Nm]: where the search begins, the solution of the step before.
    """
    W = np.linalg.inv(A)
    want = qd / dt + W @ free  # (qd at the end, without friction) / dt
    f = np.clip(start, -bound, bound)
    rows = range(len(f))
    for _ in range(SWEEPS):
        change = 0.0
        for i in rows:
            to = min(max(f[i] + (want[i] - W[i] @ f) / W[i, i], -bound[i]), bound[i])
            change = max(change, abs(to - f[i]))
            f[i] = to
        if change < ENOUGH:
            break
    return f


class Joints:
    """Turns what the drives give into what the joints get. Owns which brakes have opened, and the last friction."""

    def __init__(self, reality: Reality, rated: Sequence[float]) -> None:
        """rated: torque [Nm] of each drive; a drag beyond it is its closed brake, see `drive.actuate`."""
        self.reality, self.rated = reality, tuple(rated)
        n = len(self.rated)
        self.opened = [False] * n  # an arm without brakes lies on its stand until first driven
        self.coulomb, self.static = np.array(reality.coulomb), np.array(reality.static)
        self.last = np.zeros(n)
        self.mounted = any(z != 0.0 for z in reality.encoder_zero) or any(d != 1.0 for d in reality.encoder_direction)
        self.ideal = (
            not self.mounted and all(g == 1.0 for g in reality.torque_gain) and all(b == IDEAL for b in reality.brake)
        )

    @property
    def rubs(self) -> bool:
        """Whether any joint has friction that is not viscous."""
        return bool(self.static.any())

    def given(self, torque: Sequence[float], drag: Sequence[float]) -> tuple[list[float], list[float]]:
        """Return driven torques [Nm] and bounds on a brake's torque [Nm] that the joints really get."""
        r = self.reality
        out = [g * d * t for g, d, t in zip(r.torque_gain, r.encoder_direction, torque, strict=True)]
        return out, [self._brake(k, bound) for k, bound in enumerate(drag)]

    def rub(self, A: F64, free: F64, qd: F64, dt: float, drag: F64) -> tuple[F64, F64]:
        """Return the torques (n,) [Nm] of friction and of brakes in a step; arguments as of `friction`.

        drag (n,) [Nm]: how much the brakes can give. Friction comes first, brakes give what is left of what rest needs.
        """
        bound = np.where(np.abs(qd) < CREEP, self.static, self.coulomb)
        self.last = friction(A, free, qd, bound + drag, dt, self.last)
        rubbing = np.clip(self.last, -bound, bound)
        return rubbing, self.last - rubbing

    def read(self, q: Sequence[float], qd: Sequence[float]) -> tuple[Sequence[float], Sequence[float]]:
        """Return positions [rad] and speeds [rad/s] as the drives' encoders see the joints that are mounted so."""
        if not self.mounted:
            return q, qd
        r = self.reality
        rows = zip(r.encoder_direction, r.encoder_zero, q, qd, strict=True)
        seen = [(d * x + zero, d * v) for d, zero, x, v in rows]
        return [x for x, _ in seen], [v for _, v in seen]

    def _brake(self, k: int, bound: float) -> float:
        closed, brake = bound > self.rated[k], self.reality.brake[k]
        self.opened[k] = self.opened[k] or not closed
        if brake == IDEAL:
            return bound
        if brake == 0.0:  # drives of such arms let go when they trip
            return 0.0 if self.opened[k] else bound
        if not closed:  # the windings, shorted by a drive that tripped
            return bound
        return min(bound, brake)

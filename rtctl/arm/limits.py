"""The permitter: the last thing between the law and the bus. Finite, magnitude, slew; nothing else.

It is small on purpose and knows nothing of goals or obstacles. The drive repeats magnitude and slew with its own code.
"""

from typing import NamedTuple

import numpy as np

from rtctl.arm.model import acceleration
from rtctl.kernel import kernel
from rtctl.kernel.reductions import largest
from rtctl.types import F64, Cut

_NON_FINITE, _MAGNITUDE, _SLEW, _SCALED = (int(c) for c in (Cut.NON_FINITE, Cut.MAGNITUDE, Cut.SLEW, Cut.MOTION_SCALED))


class Permitted(NamedTuple):
    """The torque that may go out, and what was cut."""

    tau_wanted: F64  # (n,) [Nm] the law's sum, before magnitude and slew
    tau: F64  # (n,) [Nm]
    cut: int  # types.Cut bits
    scale: float  # fraction of the driving torque that was left, 1 = all


@kernel
def _finite(v: F64) -> bool:
    # np.isfinite on each element before any comparison: min/max would turn a NaN into full torque
    good = True
    for i in range(v.shape[0]):
        good = good and bool(np.isfinite(v[i]))
    return good


@kernel
def slew_reference(tau_sent: F64, tau_echo: F64, tau_rate: F64, tau_lsb: F64, dt: float, lag: int) -> F64:
    """Return the torque (n,) [Nm] from which this tick may move by tau_rate dt.

    The echo is `lag` periods old and rounded to tau_lsb [Nm], so what was sent since may differ from it by
    lag * tau_rate * dt + tau_lsb and no more. While the drive follows, this is the torque last sent; when it does not
    (clamped, just enabled, a frame lost) it is pulled to what the drive really applies.
    """
    out = np.empty_like(tau_sent)
    for i in range(tau_sent.shape[0]):
        span = lag * tau_rate[i] * dt + tau_lsb[i]
        out[i] = min(max(tau_sent[i], tau_echo[i] - span), tau_echo[i] + span)
    return out


@kernel
def slew_follows_echo(reference: F64, tau_sent: F64, tau_lsb: F64) -> bool:
    """Return whether `slew_reference` left what was sent by more than the rounding of an echo [Nm] on any joint."""
    for i in range(reference.shape[0]):
        if abs(reference[i] - tau_sent[i]) > tau_lsb[i]:
            return True
    return False


@kernel
def _permit(
    drive: F64, keep: F64, qd: F64, reference: F64, tau_max: F64, tau_rate: F64, D: F64, dt: float
) -> tuple[F64, F64, int, float]:
    n = drive.shape[0]
    cut = 0
    scale = 1.0
    wanted = drive + keep
    if not (_finite(drive) and _finite(keep)):
        cut |= _NON_FINITE
        scale = 0.0
        for i in range(n):
            wanted[i] = -D[i] * qd[i] if np.isfinite(qd[i]) else 0.0
    tau = wanted.copy()
    if cut == 0:
        for i in range(n):
            # the largest s in [0, 1] with |keep + s drive| <= tau_max on this joint
            room = tau_max[i] - keep[i] if drive[i] > 0.0 else -tau_max[i] - keep[i]
            if abs(keep[i] + scale * drive[i]) > tau_max[i] and drive[i] != 0.0:
                scale = min(scale, max(0.0, room / drive[i]))
        if scale < 1.0:
            cut |= _SCALED
        tau = keep + scale * drive
    for i in range(n):
        if abs(tau[i]) > tau_max[i]:
            # rounding of the scaled sum may pass the bound by an ulp: that is not a cut worth reporting
            if abs(tau[i]) > tau_max[i] * (1.0 + 1e-9):
                cut |= _MAGNITUDE
            tau[i] = tau_max[i] if tau[i] > 0.0 else -tau_max[i]
    share = 1.0  # of the step that every joint can take: all slow down as one, so that the direction stays
    for i in range(n):
        if np.isfinite(reference[i]):
            step = abs(tau[i] - min(max(reference[i], -tau_max[i]), tau_max[i]))
            if step * share > tau_rate[i] * dt:
                share = tau_rate[i] * dt / step
                cut |= _SLEW
    for i in range(n):
        if not np.isfinite(reference[i]):
            cut |= _NON_FINITE
            tau[i] = 0.0
            continue
        start = min(max(reference[i], -tau_max[i]), tau_max[i])
        step = min(max(share * (tau[i] - start), -tau_rate[i] * dt), tau_rate[i] * dt)
        tau[i] = min(max(start + step, -tau_max[i]), tau_max[i])
    return wanted, tau, cut, scale


def permit(
    drive: F64, keep: F64, qd: F64, reference: F64, tau_max: F64, tau_rate: F64, damping: F64, dt: float
) -> Permitted:
    """Return the torque that may be sent.

    drive (n,) [Nm]: torque that pursues the goal; scaled back as one, so that the direction of the acceleration stays.
    keep (n,) [Nm]: gravity, damping, obstacles, joint limits; clamped per joint only when it alone is too large.
    qd (n,) [rad/s], reference (n,) [Nm] of slew_reference, tau_max (n,) [Nm], tau_rate (n,) [Nm/s],
    damping (n,) [Nms/rad] of the fallback -D qd when anything is not finite, dt [s].
    """
    return Permitted(*_permit(drive, keep, qd, reference, tau_max, tau_rate, damping, dt))


@kernel
def command_torque(
    drive: F64,
    keep: F64,
    qd: F64,
    sent: F64,
    echo: F64,
    age: F64,
    tau_max: F64,
    tau_rate: F64,
    tau_lsb: F64,
    D: F64,
    A_inv: F64,
    h: F64,
    g: F64,
    viscous: F64,
    dt: float,
    torque: bool,
    moving: bool,
) -> tuple[F64, int, float, bool]:
    """Return what goes out this tick, with all that follows from it, in one compiled call.

    drive, keep, qd, tau_max, tau_rate, D: of `permit`. sent: (4, n) [Nm] the last commands, newest first. echo (n,)
    [Nm], age (n,) [s]: what the drives say they apply, and since when. A_inv, h, g, viscous: of `acceleration`.
    torque: whether the drives are asked for torque at all. moving: whether the arm is free to move by it.
    Rows (6, n): tau_wanted, the commands with this one before them, and the acceleration to expect; then Cut bits, the
    scale of `Permitted`, and whether the slew starts from the echo because the drive does not follow.
    """
    n = drive.shape[0]
    lag = max(1, round(largest(age) / dt))
    reference = slew_reference(sent[0], echo, tau_rate, tau_lsb, dt, lag)
    rows = np.zeros((6, n))
    wanted, tau, cut, scale = _permit(drive, keep, qd, reference, tau_max, tau_rate, D, dt)
    rows[0] = wanted
    if torque:
        rows[1] = tau
    rows[2:5] = sent[:3]
    if moving:
        rows[5] = acceleration(A_inv, rows[1], h, g, viscous, qd)
    return rows, cut, scale, slew_follows_echo(reference, sent[0], tau_lsb)

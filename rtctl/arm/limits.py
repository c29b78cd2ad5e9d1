"""The limiter: the last thing between the law and the bus. Finite, magnitude, slew; nothing else.

It is small on purpose and knows nothing of goals or obstacles. The drive repeats magnitude and slew with its own code.
"""

from typing import NamedTuple

import numpy as np

from rtctl.kernel import kernel
from rtctl.kernel.reductions import largest
from rtctl.types import F64, Feedback, LimitFlag

_NON_FINITE, _MAGNITUDE, _SLEW, _SCALED = (
    int(flag) for flag in (LimitFlag.NON_FINITE, LimitFlag.MAGNITUDE, LimitFlag.SLEW, LimitFlag.MOTION_SCALED)
)


class TorqueParts(NamedTuple):
    """The law's torque, sorted by what may be scaled back."""

    drive: F64  # (n,) [Nm] pursues the goal; scaled back as one, so that the direction of the acceleration stays
    keep: F64  # (n,) [Nm] gravity, damping, obstacles, joint limits; clamped per joint only when it alone is too large


class TorqueBounds(NamedTuple):
    """What bounds the torque of the joints, each (n,)."""

    tau_max: F64  # [Nm] that may be sent
    tau_rate: F64  # [Nm/s]
    tau_lsb: F64  # [Nm] rounding of the torque a drive echoes
    damping: F64  # [Nms/rad] D of the fallback -D qd when anything is not finite


class Limited(NamedTuple):
    """The torque that may go out, and what was limited."""

    tau_wanted: F64  # (n,) [Nm] the law's sum, before magnitude and slew
    tau: F64  # (n,) [Nm]
    flags: int  # types.LimitFlag bits
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
    (clamped, just enabled, a frame lost) it is as near to that as what the drive really applies allows.
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
def _limit_magnitude(torque: TorqueParts, tau_max: F64) -> Limited:
    """Scale the driving torque so that the sum (n,) [Nm], which is finite, stays within tau_max (n,) [Nm]."""
    drive, keep = torque
    flags, scale = 0, 1.0
    for i in range(drive.shape[0]):
        # the largest s in [0, 1] with |keep + s drive| <= tau_max on this joint
        margin = tau_max[i] - keep[i] if drive[i] > 0.0 else -tau_max[i] - keep[i]
        if abs(keep[i] + scale * drive[i]) > tau_max[i] and drive[i] != 0.0:
            scale = min(scale, max(0.0, margin / drive[i]))
    if scale < 1.0:
        flags |= _SCALED
    return Limited(drive + keep, keep + scale * drive, flags, scale)


@kernel
def _limit_slew(tau: F64, reference: F64, bounds: TorqueBounds, dt: float) -> int:
    """Bound a torque (n,) [Nm] in place, first each joint's magnitude, then the step from the reference."""
    tau_max, tau_rate = bounds.tau_max, bounds.tau_rate
    n, flags = tau.shape[0], 0
    for i in range(n):
        if abs(tau[i]) > tau_max[i]:
            # rounding of the scaled sum may pass the bound by an ulp: that is not worth reporting
            if abs(tau[i]) > tau_max[i] * (1.0 + 1e-9):
                flags |= _MAGNITUDE
            tau[i] = tau_max[i] if tau[i] > 0.0 else -tau_max[i]
    share = 1.0  # of the step that every joint can take: all slow down as one, so that the direction stays
    for i in range(n):
        if np.isfinite(reference[i]):
            step = abs(tau[i] - min(max(reference[i], -tau_max[i]), tau_max[i]))
            if step * share > tau_rate[i] * dt:
                share = tau_rate[i] * dt / step
                flags |= _SLEW
    for i in range(n):
        if not np.isfinite(reference[i]):
            flags |= _NON_FINITE
            tau[i] = 0.0
            continue
        start = min(max(reference[i], -tau_max[i]), tau_max[i])
        step = min(max(share * (tau[i] - start), -tau_rate[i] * dt), tau_rate[i] * dt)
        tau[i] = min(max(start + step, -tau_max[i]), tau_max[i])
    return flags


@kernel
def limit_torque(torque: TorqueParts, qd: F64, reference: F64, bounds: TorqueBounds, dt: float) -> Limited:
    """Return the torque that may be sent.

    qd (n,) [rad/s] for the fallback, reference (n,) [Nm] of `slew_reference`, dt [s] servo period.
    """
    if _finite(torque.drive) and _finite(torque.keep):
        limited = _limit_magnitude(torque, bounds.tau_max)
    else:
        wanted = np.zeros(qd.shape[0])
        for i in range(qd.shape[0]):
            if np.isfinite(qd[i]):
                wanted[i] = -bounds.damping[i] * qd[i]
        limited = Limited(wanted, wanted.copy(), _NON_FINITE, 0.0)
    flags = _limit_slew(limited.tau, reference, bounds, dt)
    return Limited(limited.tau_wanted, limited.tau, limited.flags | flags, limited.scale)


@kernel
def command_torque(
    torque: TorqueParts, qd: F64, sent: F64, f: Feedback, bounds: TorqueBounds, dt: float
) -> tuple[Limited, bool]:
    """Return what may go out this tick, and whether the slew starts from the echo because the drive does not follow.

    qd (n,) [rad/s]; sent (4, n) [Nm] the last commands, newest first; f: what the drives say they apply, and since
    when; dt [s] servo period.
    """
    lag = max(1, round(largest(f.age) / dt))
    reference = slew_reference(sent[0], f.tau, bounds.tau_rate, bounds.tau_lsb, dt, lag)
    return limit_torque(torque, qd, reference, bounds, dt), slew_follows_echo(reference, sent[0], bounds.tau_lsb)

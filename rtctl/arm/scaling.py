"""Torques that ask for more than the motors have are scaled as a whole: they lose strength, not direction."""

from rtctl.kernel import leaf_kernel
from rtctl.types import F64

SHARE_MIN = 0.2  # of tau_max that a field may use however heavy the arm


@leaf_kernel
def scale_to_limits(tau: F64, load: F64, tau_max: F64) -> float:
    """Return the share in (0, 1] of tau (n,) [Nm] that every joint has room for beside its load, at least SHARE_MIN.

    Clamped joint by joint it would push somewhere else.
    """
    share = 1.0
    for i in range(tau.shape[0]):
        spare = tau_max[i] - load[i] if tau[i] > 0.0 else tau_max[i] + load[i]
        room = max(min(spare, tau_max[i]), SHARE_MIN * tau_max[i])
        if abs(tau[i]) * share > room:
            share = room / abs(tau[i])
    return share


@leaf_kernel
def scale_drive_to_limits(drive: F64, keep: F64, tau_max: F64) -> float:
    """Return the largest share in [0, 1] of drive (n,) [Nm] with which |keep + share drive| <= tau_max at every joint.

    keep (n,) [Nm], load included; a joint that keep alone takes beyond its bound leaves nothing that goes further.
    """
    share = 1.0
    for i in range(drive.shape[0]):
        if drive[i] != 0.0 and abs(keep[i] + share * drive[i]) > tau_max[i]:
            room = tau_max[i] - keep[i] if drive[i] > 0.0 else -tau_max[i] - keep[i]
            share = min(share, max(0.0, room / drive[i]))
    return share

"""FIRAS, the repulsion from a surface: the scalar law, its damping, its parameters, its work arrays (Khatib 1986).

    U = eta/2 (1/rho - 1/rho0)^2,   a = eta (1/rho - 1/rho0) / rho^2   for rho <= rho0, else 0   [m/s2]
    d = -k_d rise^2 rho_dot while rho_dot < 0,   rise = (1/rho - 1/rho0) / (1/rho_min - 1/rho0) <= 1

Both push away from the surface. The damping follows the critical damping of the local stiffness 3 eta/rho^4, is k_d at
the clearance rho_min and below, and has neither a step nor a kink at rho0. Below rho_num a keeps its value there, also
in contact and inside (rho <= 0): the push is then along the outward normal. d is bounded by that same cap.
"""

import math
from typing import NamedTuple

import numpy as np

from rtctl.kernel import leaf_kernel
from rtctl.types import F64, I64
from rtctl.world.rooms import Rooms

ROOM = 6  # numbers of a row of Field.rooms
CAP_SHARE = 0.5  # of the clearance, where the repulsion is capped at the latest
CAPPED, CONTACT = 1, 2  # flags: some counted distance below rho_num; at or below 0
SUM, TASK = 1, 2  # of FieldParams.forms: terms of a link's points added plainly; the whole inertia of a point


class FieldParams(NamedTuple):
    """Gains and bounds of one field."""

    rho0: float  # [m] influence
    rho_min: float  # [m] clearance: where a unit mass that enters at v_max turns
    rho_num: float  # [m] below it the force is capped: at least the bound of a sampled spring
    eta: float  # [m4/s2]
    k_d: float  # [1/s] of the one-sided damping, at rho_min and below
    look_ahead: float  # [s] an obstacle's speed towards the point times this widens rho0
    v_smooth: float  # [m/s] below it that widening starts as a parabola
    m_max: float  # [kg] bound of the effective mass lambda
    forms: float  # SUM and TASK, whichever apply, added; 0: blended, and the mass along the normal
    v_max: float  # [m/s] these were made for, as the next three
    damping_ratio: float
    dt: float  # [s]
    added: float  # how many terms one link may sum
    overhang: float = 0.0  # [m] by which points stand out of links at most


class LimitParams(NamedTuple):
    """Gains and bounds of the joint-limit field, by joint; the same law on q - q_min and q_max - q."""

    rho0: F64  # (n,) [rad or m] zone
    rho_min: F64  # (n,) clearance
    rho_num: F64  # (n,)
    eta: F64  # (n,) [rad4/s2]
    k_d: F64  # (n,) [1/s]


class Field(NamedTuple):
    """Outputs and work arrays of the field of obstacles; every call overwrites them, so copy what must be kept."""

    tau: F64  # (n,) out [Nm]
    rho_min: F64  # (K,) out [m] least distance of any point, infinite for inactive slots
    nearest: I64  # (K,) out that point, -1 for inactive slots
    force: F64  # (K, 3) out [N] that each obstacle exerts, summed over points
    pairs: F64  # (K, 6, m) rho [m] (beyond the influence maybe a lower bound), normal, a [m/s2], lambda (a + d) [N]
    points: F64  # (15, m) position, velocity, mobility xx yy zz xy xz yz, force
    share: F64  # (K, n + 1) sum of a over the points of a link
    rooms: F64  # (K, 6) rho0, rho_min, rho_num, eta, k_d as of FieldParams, and what the guards keep [m]
    leader: I64  # (K,) first near slot of the group, -1 when not near
    near: I64  # (K, m) points within the widest influence of the obstacle, ascending; the first `near_count` are meant
    near_count: I64  # (K,) how many; of slots that are not near: anything


def field_buffers(slots: int, m: int, n: int) -> Field:
    """Return zeroed arrays for K = `slots` obstacles, m points, n joints."""
    z = np.zeros
    whole = np.int64
    return Field(
        z(n),
        z(slots),
        z(slots, whole),
        z((slots, 3)),
        z((slots, 6, m)),
        z((15, m)),
        z((slots, n + 1)),
        z((slots, ROOM)),
        z(slots, whole),
        z((slots, m), whole),
        z(slots, whole),
    )


def eta_of(v_max: float, rho0: float, rho_min: float) -> float:
    """Return eta = (v_max / (1/rho_min - 1/rho0))^2: a unit mass entering at v_max turns at rho_min (energy)."""
    return (v_max / (1.0 / rho_min - 1.0 / rho0)) ** 2


def rho_num_of(eta: float, dt: float) -> float:
    """Return (3 eta dt^2)^(1/4): where the stiffness 3 eta/rho^4 reaches 1/dt^2, the bound of a sampled spring."""
    return float((3.0 * eta * dt * dt) ** 0.25)


def _derived(
    v_max: float, rho0: float, rho_min: float, dt: float, damping_ratio: float, added: int = 1
) -> tuple[float, float, float]:
    """Return (where the cap begins, eta, k_d), or raise ValueError unless 0 < rho_num < rho_min < rho0.

    The cap begins at CAP_SHARE of the clearance or at rho_num, whichever is larger: closer in no motor follows, and a
    force that only grows would drown what other obstacles say. Where so many terms are `added` on one link, its
    stiffness is their sum, and so is its damping: what the rate can hold is bounded for all of them together.
    """
    if not 0.0 < rho_min < rho0:
        raise ValueError(f"wanted 0 < clearance < influence, got {rho_min} and {rho0}")
    eta = eta_of(v_max, rho0, rho_min)
    rho_num = rho_num_of(added * eta, dt)
    if not 0.0 < rho_num < rho_min:
        raise ValueError(f"wanted a clearance above rho_num = {rho_num:.4g} (positive) at this rate, got {rho_min}")
    # 0.5/dt: a damper sampled with one period of delay is calm below it.
    k_d = min(2.0 * damping_ratio * math.sqrt(3.0 * eta) / rho_min**2, 0.5 / (added * dt))
    return max(rho_num, CAP_SHARE * rho_min), eta, k_d


def field_params(
    v_max: float,
    rho0: float,
    rho_min: float,
    dt: float,
    damping_ratio: float,
    look_ahead: float,
    m_max: float,
    forms: int = 0,
    added: int = 1,
) -> FieldParams:
    """Return the parameters that users never tune, from speed, influence and clearance.

    v_max [m/s]; rho0, rho_min [m]; dt [s] the servo period; damping_ratio of the critical damping at rho_min;
    look_ahead [s]; m_max [kg]; forms: SUM, TASK; added: how many terms one link may sum.
    Raises ValueError unless 0 < rho_num < rho_min < rho0.
    """
    rho_num, eta, k_d = _derived(v_max, rho0, rho_min, dt, damping_ratio, added)
    return FieldParams(
        rho0, rho_min, rho_num, eta, k_d, look_ahead, 0.1 * v_max, m_max, float(forms), v_max, damping_ratio, dt, added
    )


def rooms_of(params: FieldParams) -> Rooms:
    """Return what holds for obstacles without numbers of their own, and what the rate can hold of those with some."""
    return Rooms(params.rho0, params.rho_min, math.sqrt(3.0 * params.added) * params.dt * params.v_max)


def limit_params(qd_max: F64, rho0: F64, rho_min: F64, dt: float, damping_ratio: float) -> LimitParams:
    """Return the joint-limit parameters from speed, zone and clearance, as `field_params` does for obstacles.

    qd_max (n,) [rad/s or m/s]; rho0, rho_min (n,) [rad or m]; dt [s]. Raises ValueError naming the joint's index.
    """
    rows = []
    for i, (speed, zone, clearance) in enumerate(zip(qd_max, rho0, rho_min, strict=True)):
        try:
            rows.append(_derived(float(speed), float(zone), float(clearance), dt, damping_ratio))
        except ValueError as error:
            raise ValueError(f"joint {i}: {error}") from None
    rho_num, eta, k_d = np.array(rows).T.copy()
    return LimitParams(np.array(rho0, np.float64), np.array(rho_min, np.float64), rho_num, eta, k_d)


@leaf_kernel
def put_room(params: FieldParams, influence: float, clearance: float, rooms: F64, k: int) -> None:
    """Write row k of Field.rooms for an obstacle of these numbers [m], of the params' own where they are 0.

    As `field_params` derives them. The guards of an obstacle with a clearance of its own keep it between obstacle and
    links: points stand out of links, so that they may come nearer by the overhang.
    """
    rooms[k, 0], rooms[k, 1], rooms[k, 2] = params.rho0, params.rho_min, params.rho_num
    rooms[k, 3], rooms[k, 4], rooms[k, 5] = params.eta, params.k_d, 0.0
    if influence == 0.0:
        return
    slope = params.v_max / (1.0 / clearance - 1.0 / influence)
    eta, dt, added = slope * slope, params.dt, params.added
    rho_num = math.sqrt(math.sqrt(3.0 * added * eta * dt * dt))
    k_d = 2.0 * params.damping_ratio * math.sqrt(3.0 * eta) / (clearance * clearance)
    rooms[k, 0], rooms[k, 1], rooms[k, 2] = influence, clearance, max(rho_num, CAP_SHARE * clearance)
    rooms[k, 3], rooms[k, 4] = eta, min(k_d, 0.5 / (added * dt))
    rooms[k, 5] = max(clearance - params.overhang, 0.0)


# error_model: every divisor is a validated parameter or bounded by one; the check for zero would stop vectorisation.
@leaf_kernel
def firas(
    rho: float, rho_dot: float, rho0: float, rho_min: float, rho_num: float, eta: float, k_d: float
) -> tuple[float, float]:
    """Return (a, d) [m/s2 or rad/s2]: repulsion and one-sided damping, both >= 0 and away from the surface.

    rho, rho0 ... in [m] or [rad]. A NaN distance or speed gives NaN, never zero.
    """
    r = rho_num if rho <= rho_num else rho
    q = 1.0 / r - 1.0 / rho0
    q = 0.0 if q <= 0.0 else q
    a = eta * q / (r * r)
    rise = q / (1.0 / rho_min - 1.0 / rho0)
    rise = 1.0 if rise >= 1.0 else rise
    d = 0.0 if rho_dot >= 0.0 else -k_d * rise * rise * rho_dot
    cap = eta * (1.0 / rho_num - 1.0 / rho0) / (rho_num * rho_num)
    return a, (cap if d >= cap else d)

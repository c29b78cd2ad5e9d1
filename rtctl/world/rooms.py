"""How far an obstacle reaches and how much room it is to be given, where it has numbers of its own.

Of a slot with some, `Obstacles.room` holds influence i and clearance c [m], then those of the config, I and C; zeros
where the config's hold. What asks how much room there is, a posture search or a planner, counts a distance in the
config's: 0 is 0, c is C, i is I, straight in between and beyond. One bound then does for all obstacles.
"""

import math
from typing import NamedTuple

import numpy as np

from rtctl.kernel import leaf_kernel
from rtctl.types import B1, F64

INFLUENCE, CLEARANCE = (5e-3, 1.0), (1e-3, 0.5)  # [m] bounds, those of the config
OWN_INFLUENCE, OWN_CLEARANCE, INFLUENCE_OF_ALL, CLEARANCE_OF_ALL = range(4)  # of a row of `Obstacles.room`


class Rooms(NamedTuple):
    """What holds for obstacles without numbers of their own, and what the servo rate can hold; 0: none may have any.

    rho_num = (3 N eta dt^2)^(1/4) < c of eta = (v_max/(1/c - 1/i))^2 is c (1 - c/i) > `least`.
    """

    influence: float = 0.0  # [m]
    clearance: float = 0.0  # [m]
    least: float = 0.0  # [m] sqrt(3 N) dt v_max, of the N terms that one link may sum


NONE = Rooms()


def room_of(influence: float, clearance: float, rooms: Rooms) -> F64:
    """Return the row (4,) of `Obstacles.room` of an obstacle with these numbers, 0 for one that it does not have."""
    if not influence and not clearance:
        return np.zeros(4)
    return np.array([influence or rooms.influence, clearance or rooms.clearance, rooms.influence, rooms.clearance])


def fault_of_room(influence: float, clearance: float, rooms: Rooms) -> tuple[str, float, str] | None:
    """Return (key, what came, what was wanted) of numbers that an obstacle cannot have, None where it can."""
    if not influence and not clearance:
        return None
    told = (("influence_m", influence, INFLUENCE), ("clearance_m", clearance, CLEARANCE))
    if not rooms.influence:
        key, value, _ = next(row for row in told if row[1])
        return key, value, "nothing: obstacles of an arm alone have their own"
    for key, value, (low, high) in told:
        if value and not low <= value <= high:
            return key, value, f"{low:g} to {high:g}"
    i, c = influence or rooms.influence, clearance or rooms.clearance
    if c >= i and clearance:
        return "clearance_m", c, f"less than influence_m = {i:g}"
    if c >= i:
        return "influence_m", i, f"more than clearance_m = {c:g}"
    if c * (1.0 - c / i) <= rooms.least:
        rho_num = math.sqrt(rooms.least * c / (1.0 - c / i))
        key, value = ("clearance_m", c) if clearance else ("influence_m", i)
        wanted = "a clearance_m above it" if clearance else f"one that clearance_m = {c:g} is above"
        return key, value, f"{wanted}: rho_num = {rho_num:.3g} of this speed and servo_hz"
    return None


@leaf_kernel
def counted(rho: float, room: F64, k: int) -> float:
    """Return a distance [m] from obstacle k as the config's numbers count it."""
    i, c, I, C = room[k, 0], room[k, 1], room[k, 2], room[k, 3]
    if i == 0.0 or rho <= 0.0:
        return rho
    if rho < c:
        inside: float = rho * C / c
        return inside
    beyond: float = C + (rho - c) * (I - C) / (i - c)
    return beyond


@leaf_kernel
def count_rooms(room: F64, rho: F64) -> None:
    """Turn the distances (K, >= 1, m) of `distances_into` into those that the config's numbers count."""
    for k in range(room.shape[0]):
        if room[k, 0] != 0.0:
            for j in range(rho.shape[2]):
                rho[k, 0, j] = counted(rho[k, 0, j], room, k)


@leaf_kernel
def farthest(room: F64, active: B1, reach: float) -> float:
    """Return the largest true distance [m] that may count as less than `reach`."""
    far = reach
    for k in range(room.shape[0]):
        if active[k] and room[k, 0] != 0.0:
            i, c, I, C = room[k, 0], room[k, 1], room[k, 2], room[k, 3]
            true = reach * c / C if reach < C else c + (reach - C) * (i - c) / (I - C)
            far = max(far, true)
    return far


@leaf_kernel
def widest(room: F64, active: B1, influence: float) -> float:
    """Return the largest influence [m] of any active obstacle, `influence` that of those without their own."""
    wide = influence
    for k in range(room.shape[0]):
        if active[k] and room[k, 0] > wide:
            wide = room[k, 0]
    return wide

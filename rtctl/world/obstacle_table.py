"""The obstacles the controller knows of now: a fixed table of slots, edited by name, moved by its own velocities."""

import math
from typing import NamedTuple

import numpy as np

from rtctl.kernel import kernel, reductions
from rtctl.types import B1, F64, ObstacleEdit, Shape
from rtctl.world import meshes, rooms
from rtctl.world.meshes import Meshes
from rtctl.world.primitives import (
    CLOUDS,
    Obstacles,
    advanced_pose,
    cloud_place,
    copied,
    distances_into,
    fault_of,
    fault_of_numbers,
    obstacles_empty,
    put_shape,
)
from rtctl.world.rooms import Rooms

EASE = 0.25  # of its growth with which a margin falls again: given back at once, every observation would be a blow
SLOTS = 64
AGE_MAX = 3600.0  # [s] of an observation; NaN and times to come are none


class World(NamedTuple):
    """Obstacle slots; a name is '' where the slot is free.

    What was observed `age` ago may have come nearer by creep * age in a way its velocity does not tell: the surface is
    taken to be nearer by that. Past `stale` the arm stops, and the margin stops growing: it never fills the world.
    """

    obstacles: Obstacles
    names: tuple[str, ...]  # (K,)
    age: F64  # (K,) [s] since the obstacle was last observed
    moving: B1  # (K,) its observation grows stale: it moves, or somebody keeps observing it
    fixed: B1  # (K,) of the config: nobody clears or replaces it
    unions: tuple[str, ...]  # (K,) the union that each is a part of, '' for none
    known: Meshes
    creep: float  # [m/s] speed that obstacles may have beside the one that is told
    stale: float  # [s] age at which an observation is too old
    of_all: Rooms = rooms.NONE  # influence and clearance of obstacles without their own


def empty(
    slots: int = SLOTS,
    known: Meshes = meshes.NONE,
    creep: float = 0.0,
    stale: float = 0.5,
    of_all: Rooms = rooms.NONE,
) -> World:
    """Return a table without obstacles; `known` are the meshes that obstacles may refer to."""
    no, none = np.zeros(slots, np.bool_), ("",) * slots
    return World(obstacles_empty(slots, known), none, np.zeros(slots), no, no, none, known, creep, stale, of_all)


def with_static(world: World, shapes: tuple[Shape, ...]) -> World:
    """Return the table with the config's own obstacles, which never grow stale."""
    world, refusal = edited(world, tuple(ObstacleEdit(s.name, s) for s in shapes))
    assert not refusal, refusal  # config bounds their number
    fixed = np.array([bool(name) for name in world.names])
    return _with_margins(world._replace(moving=np.zeros_like(world.moving), fixed=fixed))


def edited(world: World, edits: tuple[ObstacleEdit, ...]) -> tuple[World, str]:
    """Return the table after `edits`, and why an edit was refused ('' when none was)."""
    refusal, own = "", False
    for edit in edits:
        slots = [i for i, name in enumerate(world.names) if name] if edit.name == "*" else _slot_of(world, edit.name)
        fault = _refused(world, edit, slots)
        if fault:
            refusal = fault
            continue
        if not own:  # all edits of one tick go into one copy
            own, obstacles = True, copied(world.obstacles)
            world = world._replace(obstacles=obstacles, age=world.age.copy(), moving=world.moving.copy())
        if edit.shape is None:
            for slot in [s for s in slots if not world.fixed[s]]:
                world = _cleared(world, slot)
        else:
            world = _put(world, slots[0] if slots else world.names.index(""), edit, edit.shape)
    return world, refusal


def _slot_of(world: World, name: str) -> list[int]:
    return [world.names.index(name)] if name and name in world.names else []


def _refused(world: World, edit: ObstacleEdit, slots: list[int]) -> str:
    """Return why an edit of what is in `slots` cannot be made, or ""."""
    shape, all_of_them = edit.shape, edit.name == "*"
    if shape is not None and (not edit.name or all_of_them):
        return f"obstacle: got {edit.name!r}, wanted a name"
    if slots and not all_of_them and world.fixed[slots[0]]:
        return f"obstacle {edit.name}: is the config's own"
    if shape is None:
        return "" if slots or all_of_them else f"no obstacle is named {edit.name}"
    if not slots and "" not in world.names:
        return f"obstacle {edit.name}: all {len(world.names)} slots are taken"
    fault = fault_of(shape, world.known, world.of_all)
    if not fault and shape.type == "cloud":
        slot = slots[0] if slots else world.names.index("")
        fault = f"there are {CLOUDS} clouds already" if cloud_place(world.obstacles, slot) < 0 else ""
    if not 0.0 <= edit.age <= AGE_MAX:
        fault = f"age: got {edit.age} s, wanted 0 to {AGE_MAX:g}"
    if not fault:
        fault = fault_of_numbers("position by now", shape.position + edit.age * shape.velocity, 3)
    return f"obstacle {edit.name}: {fault}" if fault else ""


def _put(world: World, slot: int, edit: ObstacleEdit, shape: Shape) -> World:
    """Write a shape without fault, `edit.age` [s] on, into a slot of a table whose arrays are the caller's own."""
    shape = shape._replace(position=shape.position + edit.age * shape.velocity)
    obstacles = put_shape(world.obstacles, slot, shape, world.known, world.of_all)
    world.age[slot] = edit.age
    world.moving[slot] = edit.feed or any(shape.velocity.tolist()) or any(shape.omega.tolist())
    grown = max(world.creep * min(edit.age, world.stale), float(obstacles.margin[slot]))
    obstacles.margin[slot] = grown if world.moving[slot] else 0.0
    names = world.names if world.names[slot] else _at(world.names, slot, edit.name)
    return _joined(world._replace(obstacles=obstacles, names=names), slot, shape.group)


def _at(texts: tuple[str, ...], slot: int, text: str) -> tuple[str, ...]:
    return (*texts[:slot], text, *texts[slot + 1 :])


def _joined(world: World, slot: int, union: str) -> World:
    """Return the table with the slot in a union, '' for none: each part carries the number of the union's first."""
    if not union and not any(world.unions):
        return world
    unions = _at(world.unions, slot, union)
    group = np.array([unions.index(name) if name else k for k, name in enumerate(unions)])
    return world._replace(unions=unions, obstacles=world.obstacles._replace(group=group))


def _cleared(world: World, slot: int) -> World:
    """Clear a slot of a table whose arrays are the caller's own."""
    world.moving[slot] = world.obstacles.active[slot] = False
    world.obstacles.margin[slot] = 0.0
    return _joined(world._replace(names=_at(world.names, slot, "")), slot, "")


def _with_margins(world: World) -> World:
    margin = margins(world.obstacles.margin, world.age, world.moving, world.creep, world.stale, 0.0)
    return world._replace(obstacles=world.obstacles._replace(margin=margin))


@kernel
def margins(margin: F64, age: F64, moving: B1, creep: float, stale: float, dt: float) -> F64:
    """Return the margins (K,) [m] of observations of these ages, dt [s] after the margins given."""
    out = np.zeros_like(margin)
    for k in range(margin.shape[0]):
        if moving[k]:
            out[k] = max(creep * min(age[k], stale), margin[k] - EASE * creep * dt)
    return out


def advanced(world: World, dt: float) -> World:
    """Return the table dt [s] later: poses extrapolated, observations older."""
    if not reductions.any_set(world.moving):
        return world
    p, R, age, margin = _advanced(world.obstacles, world.age, world.moving, world.creep, world.stale, dt)
    return world._replace(obstacles=world.obstacles._replace(p=p, R=R, margin=margin), age=age)


@kernel
def _advanced(
    obstacles: Obstacles, age: F64, moving: B1, creep: float, stale: float, dt: float
) -> tuple[F64, F64, F64, F64]:
    p, R = advanced_pose(obstacles.active, obstacles.p, obstacles.R, obstacles.v, obstacles.w, dt)
    older = age.copy()
    for k in range(age.shape[0]):
        if moving[k]:
            older[k] += dt
    return p, R, older, margins(obstacles.margin, older, moving, creep, stale, dt)


def distance_from(world: World, x: F64) -> F64:
    """Return the distance (K,) [m] of a point x (3,) to each obstacle, negative inside, inf for free slots.

    To where it was seen to be and moves, without the margin of its age.
    """
    return distances_from(world.obstacles, x)


def nearest_of(world: World, edit: ObstacleEdit, P: F64, radius: F64) -> tuple[float, int]:
    """Return the least distance [m] of spheres at P (m, 3) to the shape of an edit, and which sphere's it is.

    inf and -1 where there is no shape, or none that the table would take: `edited` says why.
    """
    there, refusal = edited(empty(1, world.known, of_all=world.of_all), (edit,))
    if refusal or edit.shape is None:
        return math.inf, -1
    rho = np.array([distance_from(there, x)[0] for x in P]) - radius
    return float(rho.min()), int(rho.argmin())


@kernel
def distances_from(obstacles: Obstacles, x: F64) -> F64:
    """Return `distance_from` of a point x (3,) [m]."""
    slots = obstacles.active.shape[0]
    out = np.empty((slots, 4, 1))
    distances_into(x.copy().reshape(3, 1), np.zeros(1), obstacles, math.inf, out)
    return out[:, 0, 0] + obstacles.margin


def oldest(world: World) -> float:
    """Return the age [s] of the oldest observation of a moving obstacle, 0 without any."""
    return _oldest(world.age, world.moving)


@kernel
def _oldest(age: F64, moving: B1) -> float:
    oldest = 0.0
    for k in range(age.shape[0]):
        if moving[k] and age[k] > oldest:
            oldest = age[k]
    return oldest

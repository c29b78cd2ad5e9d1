"""`rtctl init`: from a description to a config, a URDF of the arm and a first scenario, with what was found told."""

import math
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from rtctl.arm.points import no_points
from rtctl.arm.rigid_body import RigidBody
from rtctl.errors import ConfigError
from rtctl.intake import drives as drive_table
from rtctl.intake import text, urdf
from rtctl.intake.body import Arm, Asked, Joint, describe, impossible, take, within
from rtctl.intake.choose import Place, beside, floor_of, home_of, place_of, ways
from rtctl.intake.shapes import Piece, pieces, volume
from rtctl.intake.sources import IntakeError, Source
from rtctl.intake.text import Settings
from rtctl.types import F64

SPEED = 2.0  # [rad/s] of a joint whose description has none
SPEED_MIN = 3.0  # [rad/s] below which a joint's own limit is left as it is
CARRY = 1.15  # an effort that is less than this times gravity's largest torque is taken for a mistake
SPARE = 2.5  # times gravity's largest torque: what is assumed in its place, or what brakes the joint beside gravity
BRAKING = 0.2  # [s] in which it is to be brought to rest from its speed: joint_braking_s of a config
DENSITY = 700.0  # [kg/m3] of links whose inertia is repaired: about that of arms of aluminium and motors
TORQUE_MAX = 2000.0  # [Nm] of a joint, as a config takes it
POSTURES = 300


class Made(NamedTuple):
    """What was written, and what is to be told of it."""

    config: Path
    urdf: Path
    scenario: Path | None
    joints: int
    told: list[str]


def make(source: Source, folder: Path, name: str, asked: Asked, drives: str = "", repair: bool = False) -> Made:
    """Write NAME.toml, NAME.urdf, NAME_meshes/ and NAME_first.toml into a folder. Raises RtctlError."""
    arm = take(describe(source, asked.exclude), asked)
    told = list(arm.told)
    solid = pieces(arm, told, asked.scale)
    if not any(p.joint for p in solid):
        raise IntakeError(f"{source.origin}: no geometry on any moving link: nothing can be kept from obstacles")
    _check_inertias(arm, solid, told, repair)
    names = drive_table.parse(drives, len(arm.joints))
    joints, chosen = _complete(arm, names, told, repair)
    solid = _within_reach(arm, solid)
    folder.mkdir(parents=True, exist_ok=True)
    shutil.rmtree(folder / f"{name}_meshes", ignore_errors=True)
    limits = [urdf.Limits(j.low, j.high, j.speed, j.effort) for j in joints]
    path = urdf.write(folder, name, source.origin, arm, limits, solid)
    low, high = np.array([j.low for j in joints]), np.array([j.high for j in joints])
    zone = min(0.2, 0.2 * float((high - low).min()))
    armature = np.array([d.armature for d in chosen])
    body = _body(path, [j.name for j in joints], arm.tip, armature)
    place = place_of(body, low + 1.05 * zone, high - 1.05 * zone)
    home = home_of(place, np.array([j.effort for j in joints]))
    place = place._replace(floor=round(floor_of(place, home), 3))
    settings = _settings(name, path.name, arm.tip, joints, chosen, place, home, zone)
    config = folder / f"{name}.toml"
    config.write_text(text.config(settings, source.origin, told, arm.locked), encoding="utf-8")
    scenario = _scenario(folder, settings, place, home, told)
    return Made(config, path, scenario, len(joints), told)


def _check_inertias(arm: Arm, solid: Sequence[Piece], told: list[str], repair: bool) -> None:
    """Refuse links that no body can be, or put solid ones in their place and say so."""
    for j in range(1, arm.model.njoints):
        why = impossible(arm.model.inertias[j])
        if not why:
            arm.model.inertias[j] = within(arm.model.inertias[j])
            continue
        name = arm.model.names[j]
        if not repair:
            raise IntakeError(f"{name}: its link has {why}, wanted a possible inertia; --repair puts one in its place")
        arm.model.inertias[j] = _solid(arm.model.inertias[j], [p for p in solid if p.joint == j])
        made = arm.model.inertias[j]
        told.append(f"{name}: its link has {why}: repaired to a solid body of {made.mass:.3g} kg")


def _solid(inertia: pin.Inertia, of: Sequence[Piece]) -> pin.Inertia:
    """Return the inertia of a box about a link's geometry, of its mass or, without one, of a usual density."""
    if not of:
        return pin.Inertia(max(inertia.mass, 0.05), np.array(inertia.lever), 1e-4 * np.eye(3))
    points = np.concatenate(
        [p.corners @ np.array(p.placement.rotation).T + np.array(p.placement.translation) for p in of]
    )
    bulk = max(sum(volume(p.corners, p.faces) for p in of), 1e-6)
    mass = inertia.mass if inertia.mass >= 1e-3 else DENSITY * bulk
    size = points.max(axis=0) - points.min(axis=0)
    moments = (
        mass / 12.0 * np.array([size[1] ** 2 + size[2] ** 2, size[0] ** 2 + size[2] ** 2, size[0] ** 2 + size[1] ** 2])
    )
    return pin.Inertia(mass, 0.5 * (points.max(axis=0) + points.min(axis=0)), np.diag(moments))


def _complete(
    arm: Arm, names: Sequence[str], told: list[str], repair: bool
) -> tuple[list[Joint], list[drive_table.Drive]]:
    """Return joints with nothing missing, and their drives. Raises IntakeError for torques that carry no arm."""
    gravity, inertia = _loads(arm)
    joints, mute, still = [], list[str](), list[str]()
    for joint, load, mass in zip(arm.joints, gravity, inertia, strict=True):
        brakes = mass * (SPEED if math.isnan(joint.speed) else joint.speed) / BRAKING
        assumed = float(f"{max(SPARE * load, min(load + brakes, TORQUE_MAX), 1.0):.2g}")
        if assumed > TORQUE_MAX and not joint.effort >= CARRY * load:
            wanted = f"at most {TORQUE_MAX:g} Nm: no drive on CAN turns that"
            raise IntakeError(f"{joint.name}: got an arm of {load:.3g} Nm by gravity alone, wanted {wanted}")
        if math.isnan(joint.effort):
            mute.append(f"{joint.name} {assumed:g} Nm")
            joint = joint._replace(effort=assumed)
        elif joint.effort < CARRY * load:
            if not repair:
                wanted = f"more than gravity's {load:.3g} Nm; --repair assumes {assumed:g} Nm"
                raise IntakeError(f"{joint.name}: its effort: got {joint.effort:g} Nm, wanted {wanted}")
            told.append(
                f"{joint.name}: {joint.effort:g} Nm do not carry the arm ({load:.3g} Nm): {assumed:g} Nm assumed"
            )
            joint = joint._replace(effort=assumed)
        if math.isnan(joint.speed):
            still.append(joint.name)
            joint = joint._replace(speed=SPEED)
        joints.append(joint)
    if mute:
        told.append(f"no torques are stated; assumed is what carries and brakes the arm: {', '.join(mute)}")
    if still:
        told.append(f"no speeds are stated for {', '.join(still)}: {SPEED:g} rad/s is assumed")
    chosen = drive_table.chosen(names, joints)
    if names:
        joints = [
            j._replace(effort=min(j.effort, d.peak), speed=min(j.speed, d.speed))
            for j, d in zip(joints, chosen, strict=True)
        ]
        for joint, load, drive in zip(joints, gravity, chosen, strict=True):
            if joint.effort < load:
                wanted = f"a drive that carries gravity's {load:.3g} Nm"
                raise IntakeError(f"--drives: {joint.name}: got {drive.name} with {joint.effort:g} Nm, {wanted}")
    elif any(not j.armature for j in joints):
        told.append("inertia of rotors is assumed by torque: state armature_kg_m2 = J G^2 of your drives")
    return joints, chosen


def _loads(arm: Arm) -> tuple[F64, F64]:
    """Return the largest torques of gravity (n,) [Nm] and inertias (n,) [kg m2] about each joint within the limits."""
    model, data = arm.model, arm.model.createData()
    low, high = np.array([j.low for j in arm.joints]), np.array([j.high for j in arm.joints])
    rng = np.random.default_rng(0)
    most, inertia = np.zeros(len(arm.joints)), np.zeros(len(arm.joints))
    for q in rng.uniform(low, high, (POSTURES, len(low))):
        full = pin.neutral(model)
        for k in range(1, model.njoints):
            at = model.idx_qs[k]
            full[at : at + model.nqs[k]] = [np.cos(q[k - 1]), np.sin(q[k - 1])] if model.nqs[k] == 2 else q[k - 1]
        most = np.maximum(most, np.abs(pin.computeGeneralizedGravity(model, data, full)))
        inertia = np.maximum(inertia, np.diag(pin.crba(model, data, full)))
    return 1.1 * most, 1.1 * inertia  # the samples may have missed the worst


def _within_reach(arm: Arm, solid: list[Piece]) -> list[Piece]:
    """Return the pieces less those of the base that the arm can never come near."""
    model = arm.model
    reach = sum(float(np.linalg.norm(model.jointPlacements[k].translation)) for k in range(2, model.njoints))
    reach += 0.5  # what the last link carries, and some
    shoulder = np.array(model.jointPlacements[1].translation)
    kept = []
    for p in solid:
        corners = p.corners @ np.array(p.placement.rotation).T + np.array(p.placement.translation)
        if p.joint or float(np.linalg.norm(corners - shoulder, axis=1).min()) < reach:
            kept.append(p)
    return kept


def _body(path: Path, names: list[str], tip: str, armature: F64) -> RigidBody:
    try:
        return RigidBody.from_urdf(path, names, tip, np.eye(4), armature, [path.parent])
    except ConfigError as error:
        raise IntakeError(
            f"{path}: {error.place.rpartition(': ')[2]}: got {error.got}, wanted {error.wanted}"
        ) from None


def _settings(
    name: str,
    file: str,
    tip: str,
    joints: list[Joint],
    drives: list[drive_table.Drive],
    place: Place,
    home: F64,
    zone: float,
) -> Settings:
    """Return the numbers of a config that fit an arm of this size."""
    size = place.reach
    v_max = float(f"{min(0.5, max(0.1, 0.5 * size)):.2g}")
    body = place.body
    _, t = body.placements(home)
    x = body.evaluate(home, np.zeros(body.n), no_points()).x
    speeds = []
    for k, joint in enumerate(joints):
        away = max(float(np.linalg.norm(x - t[k + 1])), 0.05)
        # a joint that is much faster than the tip needs throws it past a singularity
        speeds.append(math.floor(1e3 * min(joint.speed, max(SPEED_MIN, 5.0 * v_max / away))) / 1e3)
    influence = round(min(0.1, max(0.04, 0.13 * size)), 3)
    return Settings(
        name=name,
        urdf=file,
        tip=tip,
        joints=[j._replace(speed=s) for j, s in zip(joints, speeds, strict=True)],
        drives=drives,
        home=home,
        v_max=v_max,
        a_max=10.0 * v_max,
        influence=influence,
        clearance=round(max(0.01, 0.2 * influence), 3),
        zone=round(zone, 3),
        floor=place.floor,
        light=size < 0.8,
    )


def _scenario(folder: Path, settings: Settings, place: Place, home: F64, told: list[str]) -> Path | None:
    """Write a first scenario: two goals, a ball near the way between them; None, and told, where none was found."""
    found = ways(place, home, 0.01)
    if len(found) < 2:
        told.append("no two goals were found that the tip reaches on straight ways: no scenario is written")
        return None
    radius = round(max(0.03, 0.08 * place.reach), 3)
    ball = beside(place, found, radius, 0.6 * settings.influence + 0.025, settings.influence + 0.03)
    if ball is None:
        told.append("no place for an obstacle beside the way was found: the scenario has the table alone")
    path = folder / f"{settings.name}_first.toml"
    body = text.scenario(settings, [w.goal for w in found], ball, radius)
    path.write_text(body, encoding="utf-8")
    return path

"""A second engine behind the same drives: MuJoCo moves the arm, pybullet measures how near it is to everything.

Friction, rotors and brakes are MuJoCo's own: dry friction is a constraint of its solver, a brake is dry friction that
comes and goes. The arm is the plant's URDF as MuJoCo reads it, or an MJCF by another hand than the robot file's URDF,
`[plant] model`: its masses, friction and shapes then act, whatever the controller believes. Obstacles push the arm as
in `firmware_sim.plant`, but for hollow meshes and clouds, which only the oracle knows.

Equations: (M + J) qdd + c = tau + J_c^T f; dry friction and contacts by the convex problem of Todorov (2014), soft: a
braked joint creeps, by less than 1e-4 rad/s here. Inertia tensors that no body has are replaced by the nearest that one
may have, where pybullet takes them as they are: one more way in which the two differ.
"""

import site
import sys
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import mujoco as mj
import numpy as np
from numpy.typing import NDArray

from firmware_sim.bullet import pb
from firmware_sim.drive import NS
from firmware_sim.friction import CREEP
from firmware_sim.plant import GRAVITY, Plant
from firmware_sim.reality import Reality
from firmware_sim.settings import Settings, SettingsError, resolve
from firmware_sim.shapes import SLAB, THIN, Solid, shape_at
from firmware_sim.urdf import PAYLOAD, PAYLOAD_RADIUS, rewrite, urdf_dynamics

F64 = NDArray[np.float64]
STIFF = (0.9999, 0.9999, 1e-3, 0.5, 2.0)  # impedance of dry friction: the closer to 1 the less a held joint creeps
mj.set_mju_user_warning(lambda text: None)  # else MuJoCo writes a file where the program was called
AWAY = (0.0, 0.0, 1e3)  # [m] where obstacles wait that are not there
LEAST_MASS, LEAST_INERTIA = 1e-6, 1e-9  # [kg], [kg m^2] of bodies that have none: rotors may be all that moves


class SecondPlant(Plant):
    """A plant whose motion is MuJoCo's. Deterministic: one thread, no randomness."""

    def __init__(
        self, settings: Settings, start_q: Sequence[float] | F64, obstacles: Sequence[dict[str, Any]], reality: Reality
    ) -> None:
        """Raises SettingsError for a model that MuJoCo does not read, or whose joints are not the robot file's."""
        self.data: mj.MjData | None = None  # the arm is pybullet's alone until it stands at its start
        urdf = reality._replace(payload_kg=0.0, mass_error={}, inertia_error={}) if reality.model else reality
        super().__init__(settings, start_q, obstacles, urdf)
        self.reality = reality
        spec = _described(settings, reality)
        for obstacle in self.solids:
            _add(spec, obstacle)
        self.model = _compiled(spec, settings, reality)
        self._adopt(settings, reality)
        self.data = mj.MjData(self.model)
        self.shown: dict[str, bool] = {}
        self.place(start_q)
        self._show()

    def _adopt(self, settings: Settings, reality: Reality) -> None:
        """Find the joints, and give them the rotors and the friction of the robot file beside the model's own."""
        model = self.model
        self.at = _joints(model, settings)
        self.dof = model.jnt_dofadr[self.at]
        model.opt.timestep = self.step_ns / NS
        model.opt.gravity = (0.0, 0.0, -GRAVITY)
        model.opt.integrator = mj.mjtIntegrator.mjINT_IMPLICITFAST
        model.opt.tolerance, model.opt.iterations = 1e-10, 100
        model.opt.disableflags |= mj.mjtDisableBit.mjDSBL_AUTORESET  # an arm that breaks does not jump to its zero
        model.dof_solimp[self.dof] = STIFF
        model.dof_solref[self.dof] = (2.0 * self.step_ns / NS, 1.0)
        viscous, _ = urdf_dynamics(settings, reality)
        model.dof_damping[self.dof] += viscous + [j.friction for j in settings.joints]
        own = model.dof_armature[self.dof]
        model.dof_armature[self.dof] = np.where(own > 0.0, own, [j.armature for j in settings.joints])
        self.rubs = model.dof_frictionloss[self.dof].copy()  # [Nm]

    # ---- motion

    def place(self, q: Sequence[float] | F64) -> None:
        """Put the arm at rest at q [rad]."""
        if self.data is not None:
            self.data.qpos[self.model.jnt_qposadr[self.at]] = q
            self.data.qvel[self.dof] = 0.0
            mj.mj_forward(self.model, self.data)
        super().place(q)

    def push(self, forces: Mapping[str, Sequence[float]]) -> None:
        """Let forces [N] in the world act at the centres of mass of links until told otherwise, as `Plant.push`."""
        super().push(forces)
        if self.data is None:
            return
        self.data.xfrc_applied[:] = 0.0
        for name, force in forces.items():
            body = mj.mj_name2id(self.model, mj.mjtObj.mjOBJ_BODY, name)
            if body < 0:
                raise SettingsError(f"push: {name} is no body of {self.reality.model}")
            self.data.xfrc_applied[body, :3] = force

    def step(self, torque: Sequence[float], drag: Sequence[float]) -> None:
        """Advance one physics step under driven torques [Nm] and bounds on opposing torque [Nm], per joint."""
        assert self.data is not None
        if not self.joints.ideal:
            torque, drag = self.joints.given(torque, drag)
        dry = np.where(np.abs(self.data.qvel[self.dof]) < CREEP, self.joints.static, self.joints.coulomb)
        self.model.dof_frictionloss[self.dof] = self.rubs + dry + drag
        self.data.qfrc_applied[self.dof] = torque
        mj.mj_step(self.model, self.data)
        self.time_ns += self.step_ns
        self.q = self.data.qpos[self.model.jnt_qposadr[self.at]].tolist()
        self.qd = self.data.qvel[self.dof].tolist()

    def advance_world(self) -> None:
        """Close a servo period: pybullet's arm to where MuJoCo's is, contacts counted, obstacles to where they are."""
        for index, q, qd in zip(self.index, self.q, self.qd, strict=True):
            pb.resetJointState(self.body, index, q, qd, physicsClientId=self.client)
        pb.performCollisionDetection(physicsClientId=self.client)
        super().advance_world()
        self._show()

    def _show(self) -> None:
        """Put every obstacle that MuJoCo knows where it is now."""
        assert self.data is not None
        for solid in self.solids:
            body = mj.mj_name2id(self.model, mj.mjtObj.mjOBJ_BODY, _name(solid))
            if body < 0 or (solid.still and self.shown.get(solid.name) and solid.vanishes > self.scene_ns / NS):
                continue
            shape, k = shape_at(solid, self.scene_ns / NS), self.model.body_mocapid[body]
            self.shown[solid.name] = shape is not None
            self.data.mocap_pos[k] = AWAY if shape is None else shape.position
            if shape is not None:
                self.data.mocap_quat[k] = shape.wxyz


def _described(settings: Settings, reality: Reality) -> mj.MjSpec:
    """Return the arm, standing where the robot file puts it, as MuJoCo describes it; it touches obstacles alone."""
    spec = _another(settings, reality) if reality.model else _own(settings, reality)
    for geom in spec.geoms:
        shown = geom.contype or geom.conaffinity
        geom.contype, geom.conaffinity = (1 if shown else 0), 0
    return spec


def _own(settings: Settings, reality: Reality) -> mj.MjSpec:
    """Return the plant's URDF."""
    root = ET.fromstring(rewrite(settings, reality))
    options = {
        "balanceinertia": "true",
        "strippath": "false",
        "fusestatic": "false",
        "boundmass": repr(LEAST_MASS),
        "boundinertia": repr(LEAST_INERTIA),
    }
    ET.SubElement(ET.SubElement(root, "mujoco"), "compiler", options)
    try:
        spec = mj.MjSpec.from_string(ET.tostring(root, encoding="unicode"))
    except ValueError as error:
        raise SettingsError(f"{settings.urdf}: MuJoCo: {error}") from error
    for joint in spec.joints:
        joint.damping[:] = 0.0
        joint.frictionloss = 0.0
    return spec


def _another(settings: Settings, reality: Reality) -> mj.MjSpec:
    """Return the MJCF of `[plant] model` with the payload, its masses as wrong as `[plant]` says."""
    path = model_file(settings, reality.model)
    try:
        arm = mj.MjSpec.from_file(str(path))
    except ValueError as error:
        raise SettingsError(f"plant.model: {path}: {error}") from error
    names = {body.name for body in arm.bodies}
    for key, errors in (("mass", reality.mass_error), ("inertia", reality.inertia_error)):
        if unknown := sorted(set(errors) - names - {""}):
            raise SettingsError(f"plant.{key}_error: {unknown[0]} is no body of {path.name}")
        for body in arm.bodies:
            factor = 1.0 + errors.get(body.name, errors.get("", 0.0))
            if key == "mass":
                body.mass *= factor
            else:
                body.inertia = body.inertia * factor
                body.fullinertia = body.fullinertia * factor
    if reality.payload_kg > 0.0:
        _carry(arm, settings, reality, path)
    arm.compiler.balanceinertia = True
    arm.compiler.boundmass, arm.compiler.boundinertia = LEAST_MASS, LEAST_INERTIA
    base, turned = np.array(settings.base_position), np.array(settings.base_wxyz)
    for body in arm.worldbody.bodies:
        at, quat = np.zeros(3), np.zeros(4)
        mj.mju_rotVecQuat(at, body.pos, turned)
        mj.mju_mulQuat(quat, turned, body.quat)
        body.pos, body.quat = base + at, quat
    return arm


def _carry(arm: mj.MjSpec, settings: Settings, reality: Reality, path: Path) -> None:
    """Fix the payload, a ball that nothing touches, to a body: that of the last joint unless one is named."""
    if reality.payload_link:
        holder = arm.body(reality.payload_link)
    else:
        holder = [joint.parent for joint in arm.joints][len(settings.joints) - 1]
    if holder is None:
        raise SettingsError(f"plant.payload_link: {reality.payload_link} is no body of {path.name}")
    i = 0.4 * reality.payload_kg * PAYLOAD_RADIUS**2
    holder.add_body(
        name=PAYLOAD, pos=reality.payload_com, mass=reality.payload_kg, inertia=(i, i, i), explicitinertial=True
    )


def model_file(settings: Settings, name: str) -> Path:
    """Return the file of `[plant] model`: beside the robot file, or `package://` in what pip has installed."""
    installed = (*map(Path, site.getsitepackages()), *(Path(p) for p in sys.path if p.endswith("site-packages")))
    try:
        return resolve(name, settings.folder, (*settings.package_dirs, *dict.fromkeys(installed)))
    except SettingsError as error:
        raise SettingsError(f"plant.model: {error}") from error


def _compiled(spec: mj.MjSpec, settings: Settings, reality: Reality) -> mj.MjModel:
    try:
        return spec.compile()
    except ValueError as error:
        raise SettingsError(f"{reality.model or settings.urdf}: MuJoCo: {error}") from error


def _joints(model: mj.MjModel, settings: Settings) -> list[int]:
    """Return the number of each configured joint: by its name, else all of the model's in their order."""
    names = [model.joint(k).name for k in range(model.njnt)]
    wanted = [j.name for j in settings.joints]
    if set(wanted) <= set(names):
        return [names.index(name) for name in wanted]
    if len(names) == len(wanted):
        return list(range(len(names)))
    raise SettingsError(f"plant.model: has the joints {', '.join(names)}, wanted {', '.join(wanted)}, or as many")


def _name(solid: Solid) -> str:
    return f"obstacle {solid.name}"


def _add(spec: mj.MjSpec, solid: Solid) -> None:
    """Add an obstacle that pushes the arm; none for hollow meshes and clouds."""
    form = _form(spec, solid)
    if form is None:
        return
    body = spec.worldbody.add_body(name=_name(solid), mocap=True, pos=AWAY)
    body.add_geom(contype=0, conaffinity=1, **form)


def _form(spec: mj.MjSpec, solid: Solid) -> dict[str, Any] | None:
    """Return what MuJoCo's geom needs for an obstacle's shape."""
    kind, d = solid.type, solid.dims
    if solid.scan is not None or (solid.mesh is not None and not solid.mesh.hull):
        return None
    if solid.mesh is not None:
        spec.add_mesh(name=_name(solid), file=solid.mesh.path, scale=[solid.mesh.scale] * 3)
        return {"type": mj.mjtGeom.mjGEOM_MESH, "meshname": _name(solid)}
    if len(solid.vertices):
        spec.add_mesh(name=_name(solid), uservert=solid.vertices.ravel().tolist())
        return {"type": mj.mjtGeom.mjGEOM_MESH, "meshname": _name(solid)}
    if kind in ("sphere", "point"):
        return {"type": mj.mjtGeom.mjGEOM_SPHERE, "size": (max(d[0], THIN), 0.0, 0.0)}
    if kind in ("capsule", "segment"):
        return {"type": mj.mjtGeom.mjGEOM_CAPSULE, "size": (max(d[0], THIN), d[1], 0.0)}
    if kind == "cylinder":
        return {"type": mj.mjtGeom.mjGEOM_CYLINDER, "size": (d[0], d[1], 0.0)}
    if kind == "plane":
        return {"type": mj.mjtGeom.mjGEOM_BOX, "size": (SLAB,) * 3, "pos": (0.0, 0.0, -SLAB)}
    return {"type": mj.mjtGeom.mjGEOM_BOX, "size": tuple(d[:3])}

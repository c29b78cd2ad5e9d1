"""What loads the joints of an arm in any posture: weight and inertia over a sample of postures, tool and payload."""

from typing import NamedTuple

import numpy as np

from rtctl.arm.disturbance import GRAVITY
from rtctl.arm.model import Model
from rtctl.arm.points import no_points
from rtctl.arm.rigid_body import NOTHING, Load, RigidBody
from rtctl.spec.robot import Config
from rtctl.types import F64

POSTURES = 256  # sampled for torque and inertia extremes


class Extremes(NamedTuple):
    """Largest values over sampled postures within the joint limits, and those at home."""

    gravity: F64  # (n,) [Nm] largest |g_i|, that of the tool included
    gravity_home: F64  # (n,) [Nm] |g_i|
    inertia: F64  # (n,) [kg m2] largest A_ii
    inertia_home: F64  # (n,) [kg m2] A_ii
    inertia_free: F64  # (n,) [kg m2] least 1 / (A^-1)_ii: of a joint while the others are free
    tool: F64  # (n,) [Nm] largest torque of the tool's weight
    payload: F64  # (n,) [Nm] largest |g_i| with payload_max_kg at the tip
    payload_home: F64  # (n,) [Nm] the same at home


def extremes(config: Config, body: RigidBody) -> Extremes:
    """Return gravity torques and inertias over the same POSTURES every time: seeded, uniform within the limits."""
    low = np.array([j.q_min_rad for j in config.robot.joints])
    high = np.array([j.q_max_rad for j in config.robot.joints])
    still, points = np.zeros(body.n), no_points()
    samples = np.random.default_rng(0).uniform(low, high, (POSTURES, body.n))
    models = [body.evaluate(q, still, points) for q in (np.array(config.robot.home_rad), *samples)]
    g = np.abs([m.g for m in models])
    A = np.array([np.diag(m.A) for m in models])
    free = 1.0 / np.array([np.diag(m.A_inv) for m in models])
    tool, payload = tool_of(config), config.robot.payload_max_kg
    tools = np.array([weight(m, tool.mass, tool.com) for m in models])
    loaded = np.array([np.abs(m.g + weight(m, payload, np.zeros(3))) for m in models])
    most = g.max(axis=0), g[0], A.max(axis=0), A[0], free.min(axis=0)
    return Extremes(*most, np.abs(tools).max(axis=0), loaded.max(axis=0), loaded[0])


def weight(model: Model, mass: float, com: F64) -> F64:
    """Return the torque (n,) [Nm] that carries a mass [kg] whose centre is at com (3,) [m] in the tip's frame."""
    arm = model.R @ com
    lifts = model.J[2] + model.J[3] * arm[1] - model.J[4] * arm[0]  # of the centre, along the world's z
    return np.asarray(GRAVITY * mass * lifts)


def tool_of(config: Config) -> Load:
    """Return the tool of a config."""
    tool = config.tool
    if tool is None:
        return NOTHING
    xx, xy, xz, yy, yz, zz = tool.inertia_kg_m2 or (0.0,) * 6
    return Load(tool.mass_kg, np.array(tool.com_m), np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]))

"""What the arm of a log carries and how it rubs, by least squares: payload at the tip, friction by joint.

    tau - tau_model(q, qd, qdd) = Y_tip(q, qd, qdd) [m, m c] + c_i sign(qd_i) + b_i qd_i

Y_tip: columns of Pinocchio's joint torque regressor for the tip's link (inverse dynamics is linear in a link's ten
parameters; Khalil and Dombre 2002, chapter 12; Swevers, Verdonck and De Schutter 2007). Both sides are smoothed alike.
Joints weigh by what is left unexplained of each; errors that follow each other are counted once.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from scipy.signal import savgol_filter

from rtctl.app.arm_log import rebuilt
from rtctl.arm.rigid_body import UNLOADED, RigidBody
from rtctl.arm.robot import Robot
from rtctl.errors import LogError
from rtctl.log import schema
from rtctl.log.read.inputs import requests_of
from rtctl.log.read.run import Run, read_run
from rtctl.plain import Json
from rtctl.types import F64, Drive, Payload, State

WINDOW = 0.08  # [s] of the polynomial that smooths, and differentiates speeds
SLIDES = 0.03  # [rad/s] a joint that is slower may stick: what holds it then says nothing of its friction
EVERY = 0.01  # [s] between two rows
LEAST = 1.0  # [s] of motion
ROUNDS = 4  # of weighing
PARAMETERS = 4  # of the tip's link: its mass and m c


class Number(NamedTuple):
    """A result and its standard error."""

    value: float
    sigma: float


class Identified(NamedTuple):
    """What a log tells."""

    robot: str
    joints: tuple[str, ...]
    told: tuple[float, ...]  # payload [kg] and centre [m] that the controller had been told
    mass: Number  # [kg] of the payload, that included
    com: tuple[Number, ...]  # (3,) [m] in the tip's frame; NaN where nothing is carried
    coulomb: tuple[Number, ...]  # (n,) [Nm] beside nothing: the whole of it
    viscous: tuple[Number, ...]  # (n,) [Nms/rad] beside friction_Nms_rad
    left: F64  # (n,) [Nm] standard deviation that is unexplained
    seconds: float  # of motion that was used

    def sure(self, number: Number) -> bool:
        """Return whether a number is different from nothing: three standard errors."""
        return bool(abs(number.value) > 3.0 * number.sigma)

    def toml(self) -> str:
        """Return the keys for the robot's file: what is not sure is left out, and said so."""
        lines = []
        if self.sure(self.mass) and self.mass.value > 0.0:
            c = ", ".join(f"{x.value:.4f}" for x in self.com)
            lines += ["# fixed to the tip; of what comes and goes: rtctl payload KG X Y Z", "[tool]"]
            lines += [f"mass_kg = {self.mass.value:.4f}    # +- {self.mass.sigma:.2g}", f"com_m = [{c}]"]
        else:
            lines.append(f"# no payload: {self.mass.value:.3g} +- {self.mass.sigma:.2g} kg")
        for k, name in enumerate(self.joints):
            rub, b = self.coulomb[k], self.viscous[k]
            keys = [f"coulomb_Nm = {rub.value:.4g}"] if self.sure(rub) and rub.value > 0.0 else []
            keys += [f"viscous_Nms_rad = {b.value:.4g}"] if self.sure(b) and b.value > 0.0 else []
            error = f"+- {rub.sigma:.2g} Nm, +- {b.sigma:.2g} Nms/rad"
            key = f"friction = {{ {', '.join(keys)} }}" if keys else "# no friction"
            lines.append(f"# {name}: {key}    {error}" if keys else f"# {name}: none that is sure    {error}")
        return "\n".join(lines)

    def as_dict(self) -> Json:
        """Return everything for --json."""
        plain = {k: v for k, v in self._asdict().items() if k != "left"}
        return {**plain, "left": self.left.tolist()}


def identify(run: Run) -> Identified:
    """Return what the arm of a log carried and how its joints rubbed. Raises LogError, ConfigError."""
    config, robot = rebuilt(run)
    told = _told(run)
    robot.body.carry(told)
    viscous = np.array([j.friction_Nms_rad for j in config.robot.joints])
    q, qd, qdd, tau, moving = _motion(run, robot)
    seconds = float(moving.any(axis=1).sum()) * EVERY
    if seconds < LEAST:
        raise LogError(f"{run.path}: {seconds:.2f} s of motion, wanted {LEAST:g} s and more, in several directions")
    blocks, rights = [], []
    for k in range(len(q)):
        Y, bias = _tip_columns(robot.body, q[k], qd[k], qdd[k])
        blocks.append(np.hstack([Y, np.diag(np.sign(qd[k])), np.diag(qd[k])]))
        rights.append(tau[k] - bias - viscous * qd[k])
    rows, right, used = np.concatenate(blocks), np.concatenate(rights), moving.ravel()
    x, sigma, left = _solved(rows[used], right[used], np.tile(np.arange(robot.n), len(q))[used], robot.n)
    return _named(robot, told, x, sigma, left, seconds)


def _told(run: Run) -> tuple[float, ...]:
    """Return the payload that was told, (4,). Raises LogError where it was told while the arm moved."""
    found: list[Payload] = []
    for log in run.logs:
        found += [r.payload for _, r in sorted(requests_of(log).items()) if r.payload is not None]
    if len(set(found)) > 1:
        raise LogError(f"{run.path}: got {len(found)} payloads one after another, wanted a log with one")
    return tuple(found[-1]) if found else UNLOADED


def _motion(run: Run, robot: Robot) -> tuple[F64, F64, F64, F64, F64]:
    """Return q, qd, qdd and the torque that was given, (T, n) each, and which joints slide, (T, n)."""
    parts = [piece.array for piece in run.pieces(schema.TICK)]
    found = {k: np.concatenate([p[k] for p in parts]) for k in ("q", "qd", "tau_sent", "state", "command")}
    given = (found["state"] == int(State.RUN)) & (found["command"] == int(Drive.TORQUE))
    width = max(5, round(WINDOW / robot.dt) | 1)
    if len(given) <= 4 * width:
        raise LogError(f"{run.path}: {len(given)} ticks, wanted a second of motion at least")
    q, qd = (savgol_filter(found[k], width, 2, axis=0) for k in ("q", "qd"))
    qdd = savgol_filter(found["qd"], width, 2, deriv=1, delta=robot.dt, axis=0)
    # what a record sends acts in the period after the next feedback
    tau = savgol_filter(np.roll(found["tau_sent"], 1, axis=0), width, 2, axis=0)
    whole = np.convolve(given.astype(float), np.ones(width), "same") >= width - 0.5
    slides = (np.abs(qd) > SLIDES) & whole[:, None]
    step = max(1, round(EVERY / robot.dt))
    return q[::step], qd[::step], qdd[::step], tau[::step], slides[::step]


def _tip_columns(body: RigidBody, q: F64, qd: F64, qdd: F64) -> tuple[F64, F64]:
    """Return the columns (n, 4) of the tip's link for [m, m c], c in the tip's frame, and the model's torque (n,)."""
    model, arm = body.model, body.skeleton
    full, v, a = body.configuration(q), np.zeros(model.nv), np.zeros(model.nv)
    v[arm.iv], a[arm.iv] = qd, qdd
    regressor = pin.computeJointTorqueRegressor(model, body.data, full, v, a)
    joint = int(arm.joint[arm.tip])
    of_joint = regressor[arm.iv][:, 10 * (joint - 1) : 10 * joint]
    # m and m c about the tip's frame: a point at c of the tip is at R c + t of the joint
    R, t = arm.tip_R, arm.tip_t
    columns = np.zeros((len(q), PARAMETERS))
    columns[:, 0] = of_joint @ _point(t)
    for k, c in enumerate(R.T):  # linear in c but for the inertia of the point itself, which is small
        columns[:, 1 + k] = of_joint @ (0.5 * (_point(t + c) - _point(t - c)))
    return columns, np.asarray(pin.rnea(model, body.data, full, v, a)[arm.iv])


def _point(at: F64) -> F64:
    """Return the ten parameters of a mass of 1 kg at a place (3,) [m]."""
    return np.asarray(pin.Inertia(1.0, at, np.zeros((3, 3))).toDynamicParameters())


def _solved(rows: F64, right: F64, joint: F64, n: int) -> tuple[F64, F64, F64]:
    """Return the weighted least squares solution, its standard errors, and what is left by joint (n,)."""
    left, x = np.ones(n), np.zeros(rows.shape[1])
    seen = np.array([(joint == i).any() for i in range(n)])
    keep = np.abs(rows).max(axis=0) > 1e-9
    for _ in range(ROUNDS):
        w = 1.0 / left[joint]
        x[keep] = np.linalg.lstsq(rows[:, keep] * w[:, None], right * w, rcond=1e-10)[0]
        e = right - rows @ x
        left = np.array([max(float(e[joint == i].std()), 1e-4) if seen[i] else 1.0 for i in range(n)])
    w = 1.0 / left[joint]
    N = (rows[:, keep] * w[:, None]).T @ (rows[:, keep] * w[:, None])
    together = max(1.0, max(_length(e[joint == i]) for i in range(n) if seen[i]))
    sigma = np.full(len(x), np.inf)
    sigma[keep] = np.sqrt(np.maximum(np.diag(np.linalg.pinv(N, rcond=1e-12)), 0.0) * together)
    return x, sigma, np.where(seen, left, np.nan)


def _length(e: F64) -> float:
    """Return how many rows running err alike: 1 + 2 sum of the autocorrelation up to where it first falls to zero."""
    e = e - e.mean()
    power = float(e @ e)
    if power == 0.0 or len(e) < 8:
        return 1.0
    total = 1.0
    for lag in range(1, len(e) // 4):
        r = float(e[:-lag] @ e[lag:]) / power
        if r <= 0.0:
            break
        total += 2.0 * r
    return total


def _named(robot: Robot, told: tuple[float, ...], x: F64, sigma: F64, left: F64, seconds: float) -> Identified:
    n, numbers = robot.n, [Number(float(a), float(b)) for a, b in zip(x, sigma, strict=True)]
    mass = Number(told[0] + numbers[0].value, numbers[0].sigma)
    com = []
    for k in range(3):
        moment = told[0] * told[1 + k] + numbers[1 + k].value
        sure = abs(mass.value) > 3.0 * mass.sigma
        com.append(
            Number(moment / mass.value, numbers[1 + k].sigma / abs(mass.value)) if sure else Number(np.nan, np.inf)
        )
    at = PARAMETERS
    coulomb, viscous = (tuple(numbers[at + i * n : at + (i + 1) * n]) for i in range(2))
    return Identified(robot.name, robot.joints, told, mass, tuple(com), coulomb, viscous, left, seconds)


def from_file(path: str | Path) -> Identified:
    """Return what the log of a file tells. Raises LogError, ConfigError."""
    return identify(read_run(path))

"""What the benchmark measures on: an arm of ideal double integrators that obeys, its drives on a bus, its cases."""

import ctypes
import shutil
import socket
import subprocess
import tempfile
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np

from rtctl import design as cfg
from rtctl.app.arm_link import link_spec
from rtctl.arm import bounds, least_change, nearby, osc, scaling
from rtctl.arm.law import prepared
from rtctl.arm.memory import Memory
from rtctl.arm.model import Model
from rtctl.arm.osc import OperationalSpace, Twist, operational_space
from rtctl.arm.points import Points
from rtctl.arm.robot import Robot
from rtctl.arm.terms import Motion, nothing_ahead
from rtctl.hal.can.link import LinkSpec
from rtctl.hal.can.transport import Seqpacket
from rtctl.protocol import e2e, frame, mit
from rtctl.types import F64, I64, Drive, Feedback, Goal, ObstacleEdit, Request, Shape, State, Task, Verb
from rtctl.world.primitives import Obstacles, obstacles_empty, with_shape

ROOT = Path(__file__).resolve().parent.parent
CONFIG = ROOT / "configs" / "panda.toml"
FLAGS = ("-O2", "-ftree-vectorize", "-march=native", "-fno-math-errno", "-fno-trapping-math")
UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])
GOALS = ((0.50, 0.35, 0.40), (0.50, -0.35, 0.40), (0.40, -0.25, 0.65), (0.55, 0.25, 0.30))
LEG = 1500  # ticks from goal to goal


@cache
def robot_and_spec() -> tuple[Robot, LinkSpec]:
    """Return the Panda of the demo and its link."""
    config = cfg.load(CONFIG)
    return cfg.build(config, CONFIG), link_spec(config)


def shape(name: str, type_: str, dims: tuple[float, ...], position: F64, velocity: F64 | None = None) -> Shape:
    """Return an upright shape."""
    padded = np.array([*dims, *(1.0,) * (4 - len(dims))])
    return Shape(
        name, type_, padded, np.asarray(position), UPRIGHT, np.zeros(3) if velocity is None else velocity, np.zeros(3)
    )


class Arm:
    """Joints that do what the controller's own model expects of its torque: no simulator's cost in between."""

    def __init__(self, robot: Robot) -> None:
        self.robot, self.slot = robot, 0
        self.q, self.qd, self.tau = robot.home.copy(), np.zeros(robot.n), np.zeros(robot.n)
        self.drive = np.zeros(robot.n, np.int64)

    def feedback(self) -> Feedback:
        """Return what its drives say."""
        n = self.robot.n
        age = np.full(n, self.robot.dt)
        return Feedback(
            self.slot,
            0,
            self.q.copy(),
            self.qd.copy(),
            self.tau.copy(),
            age,
            np.ones(n, np.int64),
            self.drive.copy(),
            0,
            0.0,
            0.0,
        )

    def obey(self, m: Memory, drive: Drive, tau: F64) -> None:
        """Move on by a period under what the tick commanded."""
        dt = self.robot.dt
        self.drive[:] = drive in (Drive.ENABLE, Drive.TORQUE)
        self.tau = tau.copy()
        self.q = self.q + dt * (self.qd + 0.5 * dt * m.qdd)
        self.qd = self.qd + dt * m.qdd
        self.slot += 1


def request(m: Memory, k: int) -> Request:
    """Return the k-th request of a session that arms, goes from goal to goal and sees the demo's five obstacles."""
    if k == 0:
        return Request(Verb.ARM, None, _seen())
    if m.state == State.RUN and k % LEG == 0:
        position = np.array(GOALS[k // LEG % len(GOALS)])
        return Request(goal=Goal(position, np.array([0.0, 1.0, 0.0, 0.0]), Task.POSE, 1e-3, 1e-2))
    if k % 20 == 0:  # a camera at 50 Hz
        ball = np.array([0.45 + 0.2 * np.sin(k / 900.0), 0.3 * np.cos(k / 700.0), 0.75])
        return Request(
            obstacles=(ObstacleEdit("ball", shape("ball", "sphere", (0.07,), ball, np.array([0.1, 0.1, 0.0]))),)
        )
    return Request()


def _seen() -> tuple[ObstacleEdit, ...]:
    shapes = (
        shape("table", "plane", (), np.array([0.0, 0.0, -0.05])),
        shape("post", "capsule", (0.04, 0.25), np.array([0.62, 0.10, 0.02])),
        shape("crate", "box", (0.10, 0.08, 0.10), np.array([0.35, -0.55, 0.10])),
        shape("visitor", "ellipsoid", (0.08, 0.08, 0.16), np.array([0.05, 0.75, 0.65])),
    )
    return tuple(ObstacleEdit(s.name, s) for s in shapes)


class Bus:
    """A Unix socket as the bus: our end is the link's transport, the other answers as the drives would."""

    def __init__(self, spec: LinkSpec) -> None:
        self.spec, self._counter = spec, 0
        self.size = frame.CANFD_MTU if spec.fd else frame.CAN_MTU
        self._folder = tempfile.TemporaryDirectory()
        server = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        server.bind(f"{self._folder.name}/bus")
        server.listen(1)
        self.transport = Seqpacket(f"{self._folder.name}/bus", 1.0)
        self._drives, _ = server.accept()
        server.close()

    def replies(self, f: Feedback) -> list[bytes]:
        """Return one raw frame of each joint."""
        self._counter = (self._counter + 1) & 0xFF
        frames = []
        for j, joint in enumerate(self.spec.joints):
            (p_max, v_max, t_max), can_id = joint.scale, joint.reply_id
            word = int(f.drive[j]) << 60 | (joint.can_id & 0xF) << 56 | mit.code(f.q[j], -p_max, p_max, 16) << 40
            word |= mit.code(f.qd[j], -v_max, v_max, 12) << 28 | mit.code(f.tau[j], -t_max, t_max, 12) << 16 | 0x2021
            data = word.to_bytes(8, "big")
            if self.spec.protocol == "mit+e2e":
                data = e2e.protect(data, self._counter, 0, can_id)
            frames.append(frame.pack(can_id, data, self.spec.fd, self.spec.fd))
        return frames

    def answer(self, f: Feedback) -> None:
        """Take a cycle's commands off the bus and put the replies onto it."""
        for _ in self.spec.joints:
            self._drives.recv(128)
        for raw in self.replies(f):
            self._drives.send(raw)

    def close(self) -> None:
        """Close both ends."""
        self.transport.close()
        self._drives.close()
        self._folder.cleanup()


class Null:
    """A transport that has what it is told to have: the cost of packing and unpacking alone."""

    def __init__(self) -> None:
        self.waiting: Sequence[bytes] = []

    def __getattr__(self, name: str) -> Any:
        return {"receive": lambda: self.waiting, "send_all": lambda frames: frames, "flags": lambda: 0}[name]


class Case(NamedTuple):
    """One size of the law: the arguments of `evaluate_law`, and so those of the floor."""

    robot: Robot
    model: Model
    space: OperationalSpace
    obstacles: Obstacles
    motion: Motion


def case(robot: Robot, m: int, slots: int) -> Case:
    """Return m PSPs against `slots` spheres, each within the influence of some PSP; the arm moves at a fair speed."""
    rng = np.random.default_rng(m * 1000 + slots)
    pick = (
        np.arange(m) % len(robot.points.radius)
        if m > len(robot.points.radius)
        else _spread(len(robot.points.radius), m)
    )
    p = robot.points
    local = p.local[pick] + 0.01 * (np.arange(m) >= len(p.radius))[:, None]
    points = Points(
        p.link[pick].copy(), np.ascontiguousarray(local), p.radius[pick].copy(), tuple(p.names[i] for i in pick)
    )
    q = robot.home + 0.05
    qd = 0.1 * robot.qd_max * np.cos(np.arange(robot.n))
    model = robot.body.evaluate(q, qd, points)
    obstacles = obstacles_empty(slots)
    for k in range(slots):
        j = int(rng.integers(m))
        away = rng.normal(size=3)
        away *= (points.radius[j] + 0.05 + rng.uniform(0.3, 0.9) * robot.avoid.rho0) / np.sqrt((away**2).sum())
        ball = shape(f"ball{k}", "sphere", (0.05,), model.P[j] + away, 0.1 * rng.normal(size=3))
        obstacles = with_shape(obstacles, k, ball)
    small = prepared(robot._replace(points=points, slots=slots))
    space = operational_space(model.J, model.A_inv, model.Lambda_inv, np.eye(6), robot.motion)
    twist = model.J @ qd
    e, e_rot = np.array([0.1, 0.2, -0.05]), np.array([0.1, 0.0, 0.2])
    v_ref, w_ref = np.array([0.05, 0.05, 0.0]), np.array([0.1, 0.0, 0.1])
    motion = Motion(
        q + 0.002,
        qd,
        Twist(twist[:3].copy(), twist[3:].copy()),
        Twist(e, e_rot),
        Twist(v_ref, w_ref),
        robot.q_rest,
        1.0,
        np.zeros(robot.n),
        False,
        np.zeros(robot.n),
        nothing_ahead(robot),
        np.zeros(0),
    )
    return Case(small, model, space, obstacles, motion)


def _spread(total: int, count: int) -> I64:
    out: I64 = np.linspace(0, total - 1, count).round().astype(np.int64)
    return out


class Floor:
    """tools/floor.cpp, compiled now."""

    def __init__(self, library: ctypes.CDLL) -> None:
        self._library = library

    @classmethod
    def build(cls) -> tuple[Self | None, str]:
        """Return the compiled floor, or None and the reason."""
        compiler = shutil.which("g++") or shutil.which("c++") or shutil.which("clang++")
        if compiler is None:
            return None, "no C++ compiler"
        with tempfile.TemporaryDirectory() as folder:
            target = f"{folder}/floor.so"
            done = subprocess.run(
                [compiler, *FLAGS, "-shared", "-fPIC", "-o", target, str(ROOT / "tools" / "floor.cpp")],
                capture_output=True,
                text=True,
                check=False,
            )
            if done.returncode != 0:
                return None, f"{compiler}: {(done.stderr.splitlines() or ['failed'])[0]}"
            return cls(ctypes.CDLL(target)), f"{Path(compiler).name} {' '.join(FLAGS)}"

    def bind(self, case: Case) -> "BoundFloor":
        """Return the floor with a case's numbers."""
        return BoundFloor(self._library, case)

    def wake(self, period: int, count: int) -> I64:
        """Return how late [ns] each of `count` wake-ups on a grid of `period` [ns] was."""
        late = np.zeros(count, np.int64)
        self._library.floor_wake(ctypes.c_int64(period), count, ctypes.c_void_p(late.ctypes.data))
        return late


class BoundFloor:
    """The floor's law on one case."""

    def __init__(self, library: ctypes.CDLL, case: Case) -> None:
        self._library = library
        r, model, space, obstacles, motion = case
        q, qd, (xd, omega), (e, e_rot), (v_ref, w_ref), q_rest, _, qdd, *_ = motion
        p, a, b = r.motion, r.avoid, r.limit
        self._arrays = [
            np.ascontiguousarray(each, np.float64)
            for each in (
                q,
                qd,
                model.q,
                model.A,
                model.A_inv,
                model.h,
                model.g,
                model.J,
                model.Jdqd,
                space.Lambda,
                space.Jbar,
                space.NT,
                model.P,
                model.Jp,
                model.B,
                r.points.radius,
                xd,
                omega,
                e,
                e_rot,
                v_ref,
                w_ref,
                q_rest,
                qdd,
                r.q_min,
                r.q_max,
                r.qd_max,
                r.tau_max,
                r.tau_rate,
                r.braking,
                p.qdd_posture,
                b.rho0,
                b.rho_min,
                b.rho_num,
                b.eta,
                b.k_d,
                obstacles.p,
                obstacles.v,
                obstacles.dims[:, 0],
            )
        ]
        self._scalars = np.array(
            [
                p.k_p,
                p.k_v,
                p.v_max,
                p.a_max,
                p.w_max,
                p.alpha_max,
                p.speed_margin,
                p.k_q,
                p.d_q,
                a.rho0,
                a.rho_min,
                a.rho_num,
                a.eta,
                a.k_d,
                a.look_ahead,
                a.v_smooth,
                a.m_max,
                r.dt,
                bounds.SPEED_BAND,
                bounds.SPEED_HORIZON,
                scaling.SHARE_MIN,
                osc.SPEED_FLOOR,
                bounds.JERK_SHARE,
                bounds.TIP_SLOW,
                bounds.ALIGNED,
                nearby.APPROACH_ZONE,
                nearby.LINK_BAND,
                least_change.STEPS_MAX,
                least_change.ROWS_MAX,
                least_change.SOFTNESS,
                least_change.TURNED,
            ]
        )
        self._link = r.points.link
        self._pointers = (ctypes.c_void_p * len(self._arrays))(*(each.ctypes.data for each in self._arrays))
        self._sizes = (r.n, len(r.points.radius), len(obstacles.active))
        self.out = np.zeros(6 + 2 * r.n)

    def run(self, count: int) -> I64:
        """Return the time [ns] of each of `count` evaluations."""
        ns = np.zeros(count, np.int64)
        address = [ctypes.c_void_p(each.ctypes.data) for each in (self._scalars, self._link, ns, self.out)]
        self._library.floor_law(self._pointers, address[0], address[1], *self._sizes, count, address[2], address[3])
        return ns

"""Where links, points and tip are at many postures: the arm's kinematics compiled, for what asks thousands of times.

    X_k = X_parent(k) X0_k exp(axis_k q_k)

The numbers are Pinocchio's, taken once; tests hold every placement to its own.
"""

from typing import NamedTuple

import numpy as np
import pinocchio as pin

from rtctl.arm.model import spd_inverse
from rtctl.arm.points import Points
from rtctl.arm.rigid_body import RigidBody
from rtctl.arm.task import selection, task_error
from rtctl.kernel import kernel
from rtctl.types import B1, F64, I64, Goal
from rtctl.world.primitives import Obstacles, advanced_pose, distances_into
from rtctl.world.rooms import count_rooms, farthest

STEPS = 80  # of the inverse kinematics
LARGEST = 0.4  # [rad] of a joint in one of them


class Chain(NamedTuple):
    """Joints and links of an arm; link 0 is the base, link k what joint k - 1 carries."""

    parent: I64  # (n + 1,) link
    R: F64  # (n + 1, 3, 3) of each joint in its parent's frame, at zero
    t: F64  # (n + 1, 3) [m]
    axis: F64  # (n + 1, 3) in the joint's own frame
    slides: B1  # (n + 1,) a prismatic joint
    moves: B1  # (n + 1, n) [link, joint]
    tip: int  # link
    tip_R: F64  # (3, 3) the tip's frame in that link
    tip_t: F64  # (3,) [m]


class Target(NamedTuple):
    """A goal as compiled code takes it; fields as in types.Goal."""

    task: int
    axis: F64
    position: F64
    wxyz: F64


def chain_of(body: RigidBody) -> Chain:
    """Return the chain of a rigid body."""
    model, n, skeleton = body.model, body.n, body.skeleton
    R, t, axis, slides = np.tile(np.eye(3), (n + 1, 1, 1)), np.zeros((n + 1, 3)), np.zeros((n + 1, 3)), np.zeros(n + 1)
    data, q = model.createData(), pin.neutral(model)
    pin.computeJointJacobians(model, data, q)
    for k in range(1, n + 1):
        j = int(skeleton.joint[k])
        X = model.jointPlacements[j]
        R[k], t[k] = X.rotation, X.translation
        S = pin.getJointJacobian(model, data, j, pin.ReferenceFrame.LOCAL)[:, int(skeleton.iv[k - 1])]
        slides[k] = float(np.linalg.norm(S[3:]) < 0.5)
        axis[k] = S[:3] if slides[k] else S[3:]
    return Chain(
        body.parent, R, t, axis, slides > 0.5, skeleton.chain, int(skeleton.tip), skeleton.tip_R, skeleton.tip_t
    )


def target_of(goal: Goal) -> Target:
    """Return a goal as compiled code takes it."""
    return Target(int(goal.task), goal.axis, goal.position, goal.wxyz)


@kernel
def placements(chain: Chain, q: F64, R: F64, t: F64) -> None:
    """Write the links' placements (n + 1, 3, 3), (n + 1, 3) [m] at q (n,)."""
    J, A = np.empty((3, 3)), np.empty((3, 3))
    for i in range(3):
        t[0, i] = 0.0
        for j in range(3):
            R[0, i, j] = 1.0 if i == j else 0.0
    for k in range(1, chain.parent.shape[0]):
        p, x = chain.parent[k], q[k - 1]
        for i in range(3):
            t[k, i] = t[p, i]
            for j in range(3):
                t[k, i] += R[p, i, j] * chain.t[k, j]
                A[i, j] = 0.0
                for l in range(3):
                    A[i, j] += R[p, i, l] * chain.R[k, l, j]
        a = chain.axis[k]
        if chain.slides[k]:
            for i in range(3):
                for j in range(3):
                    t[k, i] += A[i, j] * a[j] * x
                    R[k, i, j] = A[i, j]
            continue
        c, s = np.cos(x), np.sin(x)
        for i in range(3):
            for j in range(3):
                J[i, j] = a[i] * a[j] * (1.0 - c) + (c if i == j else 0.0)
        J[0, 1] -= s * a[2]
        J[0, 2] += s * a[1]
        J[1, 0] += s * a[2]
        J[1, 2] -= s * a[0]
        J[2, 0] -= s * a[1]
        J[2, 1] += s * a[0]
        for i in range(3):
            for j in range(3):
                R[k, i, j] = A[i, 0] * J[0, j] + A[i, 1] * J[1, j] + A[i, 2] * J[2, j]


@kernel
def tip_at(chain: Chain, R: F64, t: F64) -> tuple[F64, F64, F64]:
    """Return the tip's position (3,) [m], orientation (3, 3) and Jacobian (6, n) at the links' placements."""
    n, k = chain.moves.shape[1], chain.tip
    x, turn, J = t[k].copy(), np.zeros((3, 3)), np.zeros((6, n))
    for i in range(3):
        for j in range(3):
            x[i] += R[k, i, j] * chain.tip_t[j]
            for l in range(3):
                turn[i, j] += R[k, i, l] * chain.tip_R[l, j]
    z = np.empty(3)
    for d in range(n):
        if not chain.moves[k, d]:
            continue
        for i in range(3):
            z[i] = R[d + 1, i, 0] * chain.axis[d + 1, 0] + R[d + 1, i, 1] * chain.axis[d + 1, 1]
            z[i] += R[d + 1, i, 2] * chain.axis[d + 1, 2]
        if chain.slides[d + 1]:
            for i in range(3):
                J[i, d] = z[i]
            continue
        r0, r1, r2 = x[0] - t[d + 1, 0], x[1] - t[d + 1, 1], x[2] - t[d + 1, 2]
        J[0, d], J[1, d], J[2, d] = z[1] * r2 - z[2] * r1, z[2] * r0 - z[0] * r2, z[0] * r1 - z[1] * r0
        for i in range(3):
            J[3 + i, d] = z[i]
    return x, turn, J


@kernel
def points_at(chain: Chain, link: I64, local: F64, q: F64) -> F64:
    """Return the points (3, m) [m] at q (n,), a row a coordinate; link (m,), local (m, 3) [m]."""
    n, m = q.shape[0], link.shape[0]
    R, t, P = np.empty((n + 1, 3, 3)), np.empty((n + 1, 3)), np.empty((3, m))
    placements(chain, q, R, t)
    for j in range(m):
        k = link[j]
        for i in range(3):
            P[i, j] = t[k, i] + R[k, i, 0] * local[j, 0] + R[k, i, 1] * local[j, 1] + R[k, i, 2] * local[j, 2]
    return P


@kernel
def travels(chain: Chain, link: I64, local: F64, q: F64, Q: F64) -> F64:
    """Return how far (b,) [m] the point that goes farthest is from where it is at q (n,), at postures Q (b, n)."""
    here, out = points_at(chain, link, local, q), np.zeros(Q.shape[0])
    for b in range(Q.shape[0]):
        there = points_at(chain, link, local, Q[b])
        for j in range(link.shape[0]):
            x, y, z = there[0, j] - here[0, j], there[1, j] - here[1, j], there[2, j] - here[2, j]
            out[b] = max(out[b], np.sqrt(x * x + y * y + z * z))
    return out


@kernel
def _least(rho: F64) -> float:
    least = np.inf
    for k in range(rho.shape[0]):
        for j in range(rho.shape[2]):
            least = min(least, rho[k, 0, j])
    return float(least)


@kernel
def clearances(
    chain: Chain, link: I64, local: F64, radius: F64, Q: F64, obstacles: Obstacles, times: F64, cutoff: float
) -> F64:
    """Return the least distance (b,) [m] of the points to any obstacle, at postures Q (b, n).

    Of an obstacle with an influence and a clearance of its own it is that which the config's count (`rooms`).
    times (b,) [s]: how far ahead each is; obstacles are moved on at their speeds. cutoff [m]: what is beyond it may be
    less than true, never below it.
    """
    out, rho = np.empty(Q.shape[0]), np.empty((obstacles.active.shape[0], 4, radius.shape[0]))
    far = farthest(obstacles.room, obstacles.active, cutoff)
    for b in range(Q.shape[0]):
        p, R = obstacles.p, obstacles.R
        if times[b] != 0.0:
            p, R = advanced_pose(obstacles.active, p, R, obstacles.v, obstacles.w, times[b])
        at = Obstacles(
            obstacles.kind,
            obstacles.active,
            R,
            p,
            obstacles.v,
            obstacles.w,
            obstacles.dims,
            obstacles.group,
            obstacles.margin,
            obstacles.room,
            obstacles.mesh,
            obstacles.clouds,
        )
        distances_into(points_at(chain, link, local, Q[b]), radius, at, far, rho)
        count_rooms(at.room, rho)
        out[b] = _least(rho)
    return out


@kernel
def _damped_step(J: F64, e: F64, free: B1, damping: float) -> F64:
    """Return J_f^T (J_f J_f^T + damping I)^-1 e, J_f the columns that are free (n,)."""
    k, n = J.shape
    G, step = np.zeros((k, k)), np.zeros(n)
    for a in range(k):
        for b in range(k):
            for i in range(n):
                if free[i]:
                    G[a, b] += J[a, i] * J[b, i]
        G[a, a] += damping
    G_inv = spd_inverse(G)
    for a in range(k):
        y = 0.0
        for b in range(k):
            y += G_inv[a, b] * e[b]
        for i in range(n):
            if free[i]:
                step[i] += J[a, i] * y
    return step


@kernel
def posture_of(chain: Chain, q0: F64, goal: Target, low: F64, high: F64, far: float, turned: float) -> tuple[F64, bool]:
    """Return a posture (n,) near q0 that has the goal within low and high (n,), and whether it has.

    far: [m], and turned [rad], from the goal, at which it is had.

    Damped least squares (Wampler 1986); a joint that a step takes against its bound is left out of it.
    """
    n = q0.shape[0]
    q, R, t = np.minimum(np.maximum(q0, low), high), np.empty((n + 1, 3, 3)), np.empty((n + 1, 3))
    for _ in range(STEPS):
        placements(chain, q, R, t)
        x, turn, J = tip_at(chain, R, t)
        e, e_rot = task_error(goal.task, goal.axis, goal.position, goal.wxyz, x, turn)
        away, twist = np.sqrt((e * e).sum()), np.sqrt((e_rot * e_rot).sum())
        if away < far and twist < turned:
            return q, True
        S = selection(goal.task, goal.axis, turn)
        k = S.shape[0]
        Js, es = np.zeros((k, n)), np.zeros(k)
        for a in range(k):
            for b in range(3):
                es[a] += S[a, b] * e[b] + S[a, 3 + b] * e_rot[b]
            for b in range(6):
                for i in range(n):
                    Js[a, i] += S[a, b] * J[b, i]
        free = np.ones(n, np.bool_)
        step = np.zeros(n)
        for _again in range(3):
            step = _damped_step(Js, es, free, 1e-5 + 1e-2 * (away * away + twist * twist))
            bound = False
            for i in range(n):
                if free[i] and ((q[i] >= high[i] and step[i] > 0.0) or (q[i] <= low[i] and step[i] < 0.0)):
                    free[i] = False
                    bound = True
            if not bound:
                break
        size = np.abs(step).max()
        share = LARGEST / size if size > LARGEST else 1.0
        for i in range(n):
            q[i] = min(max(q[i] + share * step[i], low[i]), high[i])
    return q, False


@kernel
def postures_of(
    chain: Chain, seeds: F64, goal: Target, low: F64, high: F64, far: float, turned: float
) -> tuple[F64, B1]:
    """Return `posture_of` every seed (s, n): the postures (s, n) and which have the goal (s,)."""
    out, has = np.empty_like(seeds), np.empty(seeds.shape[0], np.bool_)
    for s in range(seeds.shape[0]):
        out[s], has[s] = posture_of(chain, seeds[s], goal, low, high, far, turned)
    return out, has


@kernel
def _each_clearance(chain: Chain, link: I64, local: F64, radius: F64, Q: F64, obstacles: Obstacles) -> F64:
    slots, m = obstacles.active.shape[0], radius.shape[0]
    out, rho = np.empty((Q.shape[0], m)), np.empty((slots, 4, m))
    for b in range(Q.shape[0]):
        distances_into(points_at(chain, link, local, Q[b]), radius, obstacles, np.inf, rho)
        count_rooms(obstacles.room, rho)
        for j in range(m):
            out[b, j] = np.inf
            for k in range(slots):
                out[b, j] = min(out[b, j], rho[k, 0, j])
    return out


def each_clearance(chain: Chain, points: Points, Q: F64, obstacles: Obstacles) -> F64:
    """Return the distance (b, m) [m] of each point to the obstacles of now, at postures Q (b, n); see `clearances`."""
    return _each_clearance(chain, points.link, points.local, points.radius, Q, obstacles)


def clearance_of(chain: Chain, points: Points, Q: F64, obstacles: Obstacles, cutoff: float = np.inf) -> F64:
    """Return `clearances` of postures (b, n) at the obstacles of now."""
    still = np.zeros(len(Q))
    return clearances(chain, points.link, points.local, points.radius, Q, obstacles, still, cutoff)

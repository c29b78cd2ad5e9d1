"""What an oracle sees of the plant: contacts, and how near every obstacle and every link of the arm are.

All distances are pybullet's, between links' collision shapes and obstacles; see `firmware_sim.nearness` for which of
them are measured. Asked for exact distances, the oracle tells them as if all had been measured. Else it measures only
what can be nearer than ever before in the run: the least distances over the run are exact all the same.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from firmware_sim.bullet import pb
from firmware_sim.drive import NS
from firmware_sim.nearness import Nearness
from firmware_sim.obstacles import Obstacles
from firmware_sim.shapes import Solid, shape_at

F64 = NDArray[np.float64]
SIGHT = 0.5  # [m] clearances are measured up to here; farther counts as this
SELF_SIGHT = 0.1  # [m] the same between links of the arm
BEYOND = SIGHT + 0.1  # [m] meshes and clouds are looked for up to here: far ones need not be measured every time
FAR = 3.0  # [m] the same of what has one distance however far it is
SELF_FAR = 0.5  # [m] the same between links
LEVER = 2.0  # [m] no point of the arm is further from the axis of any of its joints
NEAR, TOUCH = 0.1, 1e-3  # [m] see Oracle._pairs


class Contact(NamedTuple):
    """One contact event: when, what touched what, and who ran into whom."""

    time: float  # [s]
    link: str
    other: str
    cause: str  # "arm" | "obstacle" | "self"
    arm_m_s: float = 0.0  # speed with which the arm's own point came towards the obstacle, just before they met
    other_m_s: float = 0.0  # and the obstacle's towards the arm
    row: tuple[float, ...] = ()  # d gap/d q (n,) of the arm's point [m/rad]


class Arm(NamedTuple):
    """A loaded arm, by pybullet's numbers."""

    client: int
    body: int
    joints: tuple[int, ...]  # the number of each configured joint
    links: dict[int, str]  # names of links
    parent: dict[int, int]

    def chain(self, link: int) -> list[int]:
        """Return the moving joints between the base and a link, from the link on."""
        found = []
        while link >= 0:
            if link in self.joints:
                found.append(link)
            link = self.parent[link]
        return found


class State(NamedTuple):
    """The plant's state, as far as an oracle needs it."""

    q: list[float]
    qd: list[float]
    time_ns: int
    scene_ns: int


class Oracle:
    """Keeps the contact events of a run, and what is known of distances."""

    def __init__(self, arm: Arm, obstacles: Obstacles) -> None:
        """The arm stands at home."""
        self.arm, self.obstacles = arm, obstacles
        self.contacts: list[Contact] = []
        self.touching: set[tuple[str, str]] = set()
        self.moving = frozenset(i for i in arm.links if arm.chain(i))
        self.scans = {s.name: s.scan.radius for s in obstacles.solids if s.scan is not None}
        self.cloud_seen: dict[str, tuple[float, float, list[float], int]] = {}  # distance, least so far, q, time [ns]
        shaped = [i for i in sorted(arm.links) if pb.getCollisionShapeData(arm.body, i, physicsClientId=arm.client)]
        self.shaped = [i for i in shaped if i in self.moving]
        self.far_pairs = self._pairs(shaped)
        reach = {i: reach_of(arm, i) for i in shaped}
        self._near = Nearness(np.array([reach[i] for i in self.shaped]), obstacles.moved, SIGHT)
        between = [_between(arm, reach, a, b) for a, b in self.far_pairs]
        self._self = Nearness(np.array(between).reshape(-1, len(arm.joints)), np.zeros(1), SELF_SIGHT)
        self._self.unknown(0, True)
        self._names = [s.name for s in obstacles.solids]
        self._place = {name: k for k, name in enumerate(self._names)}
        self._sight = [BEYOND if s.mesh is not None and not s.mesh.hull else FAR for s in obstacles.solids]

    def forget(self, k: int) -> None:
        """Take note that an obstacle, by its place among the solids, came or went."""
        solid = self.obstacles.solids[k]
        self.cloud_seen.pop(solid.name, None)
        self._near.unknown(k, solid.name in self.obstacles.bodies and solid.scan is None)

    # ---- contacts

    def count_contacts(self, now: State, before: State) -> None:
        """Count rising edges of contact, per link and obstacle; `before` is the state of the period before."""
        arm = self.arm
        selves = {pair for pair in self.touching if pair[1].startswith("self:")} if self.touching else set()
        if not pb.getContactPoints(arm.body, physicsClientId=arm.client):
            self.touching = selves
            return
        touch: set[tuple[str, str]] = set()
        for name, body in self.obstacles.bodies.items():
            if name in self.scans:
                continue  # the engine knows their centres alone; see _cloud_clearance
            for point in pb.getContactPoints(arm.body, body, physicsClientId=arm.client):
                if point[3] not in self.moving or point[8] > 0.0:
                    continue
                pair = (arm.links[point[3]], name)
                if pair not in touch and pair not in self.touching:
                    self.contacts.append(self._met(point, name, now, before))
                touch.add(pair)
        self.touching = touch | selves

    def _met(self, point: tuple[Any, ...], name: str, now: State, before: State) -> Contact:
        """Return the contact: whose surface moved faster along the normal before they met closed the gap."""
        arm = self.arm
        q, qd = before.q, before.qd  # the impact has changed the arm's speed already
        normal = np.array(point[7])  # from the obstacle to the arm
        row = normal @ jacobian(arm, point[3], point[5], q)
        own = -float(row @ np.array(qd))
        shape = shape_at(self._solid(name), now.scene_ns / NS)
        other = 0.0
        if shape is not None:
            other = float(normal @ (shape.velocity + np.cross(shape.omega, np.array(point[6]) - shape.position)))
        cause = "obstacle" if other > own else "arm"
        return Contact(now.time_ns / NS, arm.links[point[3]], name, cause, own, other, tuple(row.tolist()))

    def _solid(self, name: str) -> Solid:
        return next(s for s in self.obstacles.solids if s.name == name)

    # ---- distances

    def clearances(self, now: State, before: State, exact: bool) -> dict[str, float]:
        """Return the smallest distance of any moving link to each obstacle present [m], at most SIGHT.

        Where not exact, a lower bound of those that are above the least of the run so far, and itself above that.
        """
        near, arm, bodies, width = self._near, self.arm, self.obstacles.bodies, len(self.shaped)
        pair = near.begin(now.q, exact)
        while pair >= 0:
            k, link = divmod(pair, width)
            sight = self._sight[k]
            points = pb.getClosestPoints(
                arm.body, bodies[self._names[k]], sight, self.shaped[link], physicsClientId=arm.client
            )
            pair = near.learn(pair, _least(points, sight))
        told, place = near.told(), self._place
        found = {name: told[place[name]] for name in bodies}
        for name in self.scans:
            if name in bodies:
                found[name] = self._cloud_clearance(name, bodies[name], now, before)
        return found

    def _cloud_clearance(self, name: str, body: int, now: State, before: State) -> float:
        """Return the smallest distance of any moving link to the balls of a cloud [m], at most SIGHT.

        Measured when what has moved since could have brought a link nearer than ever before; until then as it was:
        thousands of specks take pybullet milliseconds, and the smallest clearance is missed by nothing.
        """
        radius, arm = self.scans[name], self.arm
        last, least, turned, then = self.cloud_seen.get(name, (0.0, np.inf, now.q, now.time_ns))
        shape = shape_at(self._solid(name), now.scene_ns / NS)
        fast = (
            0.0 if shape is None else float(np.linalg.norm(shape.velocity) + 2.0 * LEVER * np.linalg.norm(shape.omega))
        )
        moved = LEVER * float(np.abs(np.subtract(now.q, turned)).sum()) + fast * (now.time_ns - then) / NS
        if name in self.cloud_seen and last - moved > min(least, SIGHT):
            return min(last, SIGHT)
        points: Sequence[tuple[Any, ...]] = ()
        sight = max(last + 2.0 * moved, 0.02) + radius
        while not points and sight < 2.0 * (BEYOND + radius):  # near first: few specks are within a small sight
            points = pb.getClosestPoints(arm.body, body, min(sight, BEYOND + radius), physicsClientId=arm.client)
            points = [p for p in points if p[3] in self.moving]
            sight *= 2.0
        nearest = min(points, key=lambda p: p[8], default=None)
        distance = BEYOND if nearest is None else float(nearest[8]) - radius
        pair = (arm.links[nearest[3]] if nearest is not None else "", name)
        if distance <= 0.0 and nearest is not None and least > 0.0 and pair not in self.touching:
            self.contacts.append(self._met(nearest, name, now, before))
        self.cloud_seen[name] = distance, min(least, distance), list(now.q), now.time_ns
        return min(distance, SIGHT)

    def self_clearance(self, now: State, exact: bool) -> float:
        """Return the smallest distance between links that are not neighbours [m], at most SELF_SIGHT.

        Where not exact, as `clearances`. Contacts between links are counted by this look.
        """
        near, arm = self._self, self.arm
        touch: set[tuple[str, str]] = set()
        pair = near.begin(now.q, exact)
        while pair >= 0:
            a, b = self.far_pairs[pair]
            points = pb.getClosestPoints(arm.body, arm.body, SELF_FAR, a, b, physicsClientId=arm.client)
            distance = _least(points, SELF_FAR)
            pair = near.learn(pair, distance)
            if distance <= 0.0:
                touch.add((arm.links[a], "self:" + arm.links[b]))
        for link, other in sorted(touch - self.touching):
            self.contacts.append(Contact(now.time_ns / NS, link, other, "self"))
        if touch or self.touching:
            self.touching = {p for p in self.touching if not p[1].startswith("self:")} | touch
        return near.told()[0]

    def _pairs(self, shaped: list[int]) -> list[tuple[int, int]]:
        """Return pairs of links that could meet; the arm stands at home.

        Left out: links of one body, neighbours, what touches at home, and links two joints apart that are near at home:
        they stay near whatever the joint between them does, and their hulls overlap where the links do not.
        """
        arm = self.arm
        chain = {i: arm.chain(i) for i in shaped}
        pairs = []
        for k, a in enumerate(shaped):
            for b in shaped[k + 1 :]:
                apart = len(set(chain[a]) ^ set(chain[b]))  # joints between the two links
                if apart < 2:
                    continue
                sight = NEAR if apart == 2 else TOUCH
                if not pb.getClosestPoints(arm.body, arm.body, sight, a, b, physicsClientId=arm.client):
                    pairs.append((a, b))
        return pairs


def _least(points: Sequence[tuple[Any, ...]], otherwise: float) -> float:
    """Return the least distance among pybullet's closest points."""
    if len(points) == 1:
        return float(points[0][8])
    return min((p[8] for p in points), default=otherwise)


def jacobian(arm: Arm, link: int, place: Sequence[float] | F64, q: Sequence[float]) -> F64:
    """Return how a place [m] of a link, in the world, moves with the joints, (3, n) [m/rad].

    pybullet wants it from the link's own origin, but along the axes of the link's inertia.
    """
    state = pb.getLinkState(arm.body, link, physicsClientId=arm.client)
    local, _ = pb.multiplyTransforms(*pb.invertTransform(state[4], state[1]), place, (0.0, 0.0, 0.0, 1.0))
    rest = [0.0] * len(q)
    return np.array(pb.calculateJacobian(arm.body, link, local, list(q), rest, rest, physicsClientId=arm.client)[0])


def reach_of(arm: Arm, link: int) -> F64:
    """Return for each joint how far a point of a link may be from its axis [m], (n,); 0 for joints that do not move it.

    A bound for every posture: the lengths from joint to joint along the chain, then the ball about the last joint's
    origin that holds the link's shape. A sliding joint lengthens what is before it by its travel; itself it moves the
    link by as much as it moves, a reach of 1.
    """
    chain = arm.chain(link)
    low, high = (np.array(v) for v in pb.getAABB(arm.body, link, physicsClientId=arm.client))
    origins = {i: np.array(pb.getLinkState(arm.body, i, 1, 1, physicsClientId=arm.client)[4]) for i in chain}
    reach: F64 = np.zeros(len(arm.joints))
    if not chain:
        return reach
    length = float(np.linalg.norm(np.maximum(np.abs(low - origins[chain[0]]), np.abs(high - origins[chain[0]]))))
    for inner, outer in zip(chain, (*chain[1:], None), strict=True):
        info = pb.getJointInfo(arm.body, inner, physicsClientId=arm.client)
        slides = info[2] == pb.JOINT_PRISMATIC
        reach[arm.joints.index(inner)] = 1.0 if slides else length
        length += abs(info[9] - info[8]) if slides else 0.0
        if outer is not None:
            length += float(np.linalg.norm(origins[inner] - origins[outer]))
    return reach


def _between(arm: Arm, reach: dict[int, F64], a: int, b: int) -> F64:
    """Return how much each joint may change the distance of two links [m/rad], (n,): those that move both do not."""
    both = {arm.joints.index(i) for i in set(arm.chain(a)) & set(arm.chain(b))}
    change = reach[a] + reach[b]
    change[list(both)] = 0.0
    return np.asarray(change)

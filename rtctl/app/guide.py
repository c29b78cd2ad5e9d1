"""Beside the servo: finds what a goal needs that the law does not see, and says so as advice.

Of a new goal it looks where the tip's own way would end. Where that is short of the goal, or in a limit or a shadow, it
finds a posture that has the goal (`postures`): the null space heads for it, or the joints do, when the tip's way does
not lead there. Where the arm is held all the same it plans a way (`plan`) and leads the joints along it; it yields to
what moves, plans anew on a blocked way, and tries again when something moved. At the goal the arm keeps the posture
that it has, before drifting on takes the tip off again. Counts bound its work, so that in a simulation equal inputs
give equal advice.
"""

from typing import NamedTuple

import numpy as np

from rtctl.app import plan
from rtctl.app.course import NEAR, Course
from rtctl.app.postures import (
    STEP,
    Ending,
    Site,
    endings,
    free_of_all,
    inertia_of,
    links_clear,
    links_keep,
    own_room,
    packed,
    previewed,
    site_of,
    straight_room,
    swept,
)
from rtctl.app.times import LATEST, is_met, joints_take, late, law_takes, missed, tip_takes
from rtctl.app.way import heading, moves, way_of
from rtctl.arm.kinematics import chain_of, clearance_of
from rtctl.arm.memory import Memory
from rtctl.arm.robot import Robot
from rtctl.arm.task import selection
from rtctl.errors import PlanError
from rtctl.kernel.rotations import quat_of
from rtctl.types import F64, Advice, Goal, Shape, State, Status
from rtctl.world.primitives import Obstacles, obstacles_empty, with_shape

PERIOD = 0.01  # [s] between two pieces of advice
LOOK = 0.05  # [s] between two looks at what comes
HELD = frozenset(
    (
        Status.LOCAL_MINIMUM,
        Status.ESCAPING,
        Status.LIMITED,
        Status.SHADOWED,
        Status.SINGULAR,
        Status.UNREACHABLE,
        Status.SATURATED,
    )
)
ZONES = (1.0, 0.4, 0.0)  # of those of joint limits, that a posture keeps free of; tried in this order
SWEPT = ((0.4, 0.8, 1.2, 1.6, 2.0, 2.4), (0.4, 0.8), ())  # [s] ahead, where what moves may not be; tried in this order
AGAIN = 0.4  # [s] between two attempts, longer by this after each where there was no way
WATCH = 0.5  # [s] between two looks whether an arm that moves gets there in time
CREEPS = 0.2  # of its full speed and of its way, that an arm goes between these looks, or it is held
AS_GIVEN = 0.3  # [rad] of a joint, within which the law ends in the posture that it is given
SPARE = 3  # joints that a goal leaves free, with which the tip's own way is kept to one that is as free
SOON = 0.15  # [s] ahead of what pushes, in which joints at the goal are held back
DRIFTED = 0.15  # of what is tolerated, by which an arm that was at its goal is away from it again
PLANS = 8  # for one goal in a world that stands still


class Seen(NamedTuple):
    """What the guide is shown of the memory."""

    tick: int
    state: State
    status: Status
    goal: Goal | None
    q: F64  # (n,) [rad]
    obstacles: Obstacles  # the slots that are in use; without meshes, which belong to the robot


def seen_of(m: Memory) -> Seen:
    """Return what of a memory the guide is shown."""
    mesh = np.zeros(0)
    return Seen(m.tick, m.state, m.status, m.goal, m.joints.q.copy(), packed(m.world.obstacles)._replace(mesh=mesh))


def warm(robot: Robot) -> None:
    """Run what it looks with once, so that nothing is compiled while an arm waits for advice."""
    far = Shape(
        "far", "sphere", np.full(4, 0.1), np.array([0.0, 0.0, 50.0]), quat_of(np.eye(3)), np.ones(3), np.ones(3)
    )
    site = site_of(robot, with_shape(obstacles_empty(1), 0, far), robot.home)
    tip = robot.body.evaluate(robot.home, np.zeros(robot.n), robot.points)
    goal = Goal(tip.x, quat_of(tip.R), robot.axes, robot.tolerance, robot.tolerance_rot)
    endings(site, goal, 0, seeds=1)
    previewed(site, goal, robot.q_rest, inertia_of(site), robot.avoid.rho_min)
    links_clear(swept(site, (0.1,)), robot.home[None], np.array([1e-3]))
    links_keep(site, robot.home)
    heading(site, way_of(site, np.array([robot.home, robot.q_rest + 0.1])), 0, True)
    plan.warm(site)


class Guide:
    """What is known beside the servo of one robot's goal."""

    course: Course | None  # of an arm that is led
    given: Ending | None  # the posture that was advised
    ends: list[Ending]
    look: int  # tick of the next look at what comes
    again: int  # tick of the next attempt
    kept: tuple[int, F64] | None  # tick and posture (n,) [rad] at the goal, of the last look, where nothing pushed
    nearest: float  # the tip was to the goal since it had it, of what is tolerated
    late: int  # tick by which the arm should be there; -1: nothing is known of that
    watch: int  # tick of the next look whether it will
    left: float  # [s] the tip would have taken to the goal, straight, at the last such look
    tries: int
    told: str  # why there was no way
    scene: bytes  # what rests

    def __init__(self, robot: Robot, plans: bool, seed: int = 0, at_once: bool = False) -> None:
        """plans: a planner may lead the arm; at_once: it does so of each goal, before anything held the arm."""
        self.robot, self.plans, self.seed, self.at_once = robot, plans, seed, at_once
        self.chain = chain_of(robot.body)
        self.events: list[tuple[str, str]] = []  # name, detail
        self.fresh = self.taught = False
        self._forget()

    def begin(self) -> None:
        """Take note of a new goal: the memory's."""
        self._forget()
        self.fresh = True

    def due(self, tick: int) -> bool:
        """Return whether it has anything to say after this tick; it need not be shown what the others left."""
        return self.fresh or tick % max(1, round(PERIOD / self.robot.dt)) == 0

    def advise(self, m: Seen) -> Advice | None:
        """Return advice for the next tick, None for nothing new; m: what the last one left."""
        if m.state != State.RUN or m.goal is None or m.status == Status.ARRIVED:
            if m.goal is None:
                self._forget()
            self.course = None
            return self._there(m, m.goal) if m.goal is not None and m.state == State.RUN else None
        if m.goal.streams:  # the next one comes before anything is found, or the arm stops
            self._forget()
            self.fresh, self.taught = False, True
            return None
        if self.fresh:
            self.fresh, self.taught = False, m.goal.posture is not None  # by somebody who knows better
            self.scene = self._scene(m)
            return None if self.taught else self._first(m, m.goal)
        if not self.due(m.tick):
            return None
        changed = m.tick >= self.look and self._scene(m) != self.scene
        if changed:
            self.scene, self.tries = self._scene(m), 0
            self.look = m.tick + round(LOOK / self.robot.dt)
        if self.course is not None:
            return self._along(m, m.goal, self.course, changed)
        if m.status == Status.MOVING and self.nearest < 1.0:
            stays = self._there(m, m.goal)
            if stays is not None:
                return stays
        if changed and not self.taught:
            return self._reviewed(m, m.goal)
        if m.status in HELD and m.tick >= self.again:
            return self._held(m, m.goal)
        if m.status == Status.MOVING and self.late >= 0 and m.tick >= max(self.watch, self.again):
            return self._overdue(m, m.goal)
        return None

    def _scene(self, m: Seen) -> bytes:
        """Return what tells whether what rests is as it was."""
        o = m.obstacles
        rests = ~(o.v.any(axis=1) | o.w.any(axis=1))
        return b"".join(each[rests].tobytes() for each in (o.kind, o.p, o.R, o.dims, o.room))

    def _site(self, m: Seen) -> Site:
        return Site(self.robot, self.chain, m.obstacles._replace(mesh=self.robot.meshes.data), m.q)

    # -- the first look ----------------------------------------------------------------------------------------------

    def _first(self, m: Seen, goal: Goal) -> Advice | None:
        self.given = None
        site = self._site(m)
        if self.at_once and self.plans:
            return self._planned(m, goal, site)
        if not self.robot.postures:
            return None
        for A in (np.eye(self.robot.n), inertia_of(site)):  # the law's own way is more like the second
            Q, there = previewed(site, goal, self.robot.q_rest, A)
            if not there or not free_of_all(site, Q[-1]):
                break
        else:
            return self._sooner(m, goal, site, Q)
        self.ends = self._endings(site, goal)
        for end in self.ends:
            Q, there = previewed(site, goal, end.q, A)
            if there and self._clear(site, Q) and self._ends_well(site, goal, Q[-1], end):
                self._expect(m, STEP * len(Q))
                return self._given(end)
        straight = next((way for end in self.ends if (way := self._straight(site, end)) is not None), None)
        if straight is not None:
            return self._led(m, goal, site, straight)
        if not self.ends:
            self._expect(m, tip_takes(site, goal))  # other starts may find some, though nothing holds the arm yet
            return self._planned(m, goal, site) if not there and self.plans else None
        self.given = self.ends[0]
        planned = self._sooner(m, goal, site, Q) if there else self._planned(m, goal, site) if self.plans else None
        return planned or self._given(self.ends[0])

    def _ends_well(self, site: Site, goal: Goal, q: F64, end: Ending) -> bool:
        """Return whether the law may end at q (n,) when it is given a posture: near it, or as free elsewhere."""
        if np.abs(q - end.q).max() < AS_GIVEN:
            return True
        spare = self.robot.n - len(selection(int(goal.task), goal.axis, np.eye(3)))
        return spare >= SPARE and free_of_all(site, q)

    # -- at the goal ---------------------------------------------------------------------------------------------------

    def _there(self, m: Seen, goal: Goal) -> Advice | None:
        """Return the posture of a moment ago where joints that drift on to another one come to what pushes them.

        Or of now, where that has taken the tip off its goal already.
        """
        if goal.streams or self.fresh or self.taught or not (self.robot.postures and self.due(m.tick)):
            return None
        last, self.kept = self.kept, None
        to = self.robot.q_rest if goal.posture is None else goal.posture
        if np.abs(m.q - to).max() < NEAR:
            return None
        site = self._site(m)
        if moves(site):
            return None
        far, turned = missed(site, goal)
        away = max(far / goal.tolerance, turned / goal.tolerance_rot)
        self.nearest = min(self.nearest, away)
        since = np.inf if last is None else (m.tick - last[0]) * self.robot.dt
        was = last[1] if last is not None and since <= SOON else None  # longer ago it was another motion
        if free_of_all(site, m.q if was is None else m.q + SOON / since * (m.q - was)):
            was, self.kept = None, (m.tick, m.q)
        if (was is None and away < self.nearest + DRIFTED) or m.tick < self.again:
            return None
        keep, self.nearest, self.again = m.q if was is None else was, away, m.tick + round(AGAIN / self.robot.dt)
        rho = self._room(site, keep)
        return self._given(Ending(keep, rho, bool(links_clear(site, keep[None], np.array([rho]))[0]), 0.0))

    # -- what the law would not do in time ---------------------------------------------------------------------------

    def _sooner(self, m: Seen, goal: Goal, site: Site, Q: F64) -> Advice | None:
        """Plan where the law, past what rests, would be held or much later than on the free way Q (k, n)."""
        free = takes = STEP * len(Q)
        if self.plans and is_met(site, Q):
            takes = law_takes(site, goal, self.given)
        self._expect(m, takes if takes < np.inf else free)
        return self._planned(m, goal, site, takes) if takes > late(free) else None

    def _led(self, m: Seen, goal: Goal, site: Site, straight: F64) -> Advice:
        """Lead the joints straight, or along a planned way where that takes much longer than the tip would, and it."""
        takes = joints_take(site, straight)
        if self.plans and takes > late(tip_takes(site, goal)):
            planned = self._planned(m, goal, site, takes)
            if planned is not None:
                return planned
        return self._take(site, straight)

    def _overdue(self, m: Seen, goal: Goal) -> Advice | None:
        """Plan for an arm that moves, where it will be held or late."""
        site = self._site(m)
        self.watch = m.tick + round(WATCH / self.robot.dt)
        left, was = tip_takes(site, goal), self.left
        self.left = left
        if not moves(site) and left > was - min(CREEPS * was, CREEPS * WATCH):
            return self._planned(m, goal, site)
        takes = law_takes(site, goal, self.given)
        if takes < LATEST or m.tick + takes / self.robot.dt < self.late:
            return None
        if takes < np.inf:
            self._expect(m, takes)
        return self._planned(m, goal, site, takes)

    def _expect(self, m: Seen, takes: float) -> None:
        """Take note of when an arm should be there that takes so long [s]."""
        if self.plans:
            self.late = m.tick + round(late(takes) / self.robot.dt)
            self.watch, self.left = m.tick + round(WATCH / self.robot.dt), np.inf

    def _endings(self, site: Site, goal: Goal) -> list[Ending]:
        """Return postures that have the goal, as far from joint limits as there are any."""
        return next((ends for zone in ZONES if (ends := endings(site, goal, self.seed + self.tries, zone))), [])

    def _given(self, end: Ending) -> Advice:
        self.given = end
        return Advice(end.q, clear=end.clear)

    def _reviewed(self, m: Seen, goal: Goal) -> Advice | None:
        """Return what is to be said of the goal when what rests is not as it was."""
        if self.given is not None:
            site, was = self._site(m), self.given
            rho = self._room(site, was.q)
            clear = bool(links_clear(site, was.q[None], np.array([rho]))[0])
            self.given = was._replace(rho=rho, clear=clear)
            if clear or not was.clear:
                return self._given(self.given)
        if m.tick < self.again:
            return None
        self.again = m.tick + round(AGAIN / self.robot.dt)
        return self._first(m, goal)

    def _clear(self, site: Site, Q: F64) -> bool:
        rho = clearance_of(site.chain, self.robot.points, Q, site.obstacles)
        apart = own_room(site, Q) >= self.robot.self_avoid.rho_min
        return apart and bool(rho.min() > min(self.robot.avoid.rho_min, 0.9 * min(rho[0], rho[-1])))

    def _straight(self, site: Site, end: Ending) -> F64 | None:
        """Return the straight way to a posture where it is free."""
        least = 0.9 * min(self.robot.avoid.rho_min, end.rho, self._room(site, site.start))
        free = straight_room(site, site.start, end.q) > max(least, 1e-3)
        return np.array([site.start, end.q]) if free else None

    def _room(self, site: Site, q: F64) -> float:
        return float(clearance_of(site.chain, self.robot.points, q[None], site.obstacles)[0])

    # -- what holds the arm ------------------------------------------------------------------------------------------

    def _held(self, m: Seen, goal: Goal) -> Advice | None:
        site = self._site(m)
        self.again = m.tick + round(AGAIN / self.robot.dt)
        if self.plans:
            return self._planned(m, goal, site)
        if m.status == Status.ESCAPING or self.tries >= PLANS or not self.robot.postures:
            return None
        self.tries += 1
        self.ends = self._endings(site, goal)
        far = [end for end in self.ends if np.abs(end.q - site.start).max() > 3.0 * NEAR]
        straight = next((way for end in far if (way := self._straight(site, end)) is not None), None)
        return None if straight is None else self._take(site, straight)

    def _planned(self, m: Seen, goal: Goal, site: Site, takes: float = np.inf) -> Advice | None:
        """Take a planned way, None where there is none beside which the law, which `takes` so long [s], is late."""
        if self.tries >= PLANS and not moves(site):
            return None
        self.tries += 1
        why = ""
        for times in SWEPT if moves(site) else SWEPT[-1:]:
            try:
                path = plan.plan_joints(swept(site, times), goal, self.seed + self.tries, within=np.inf)
                break
            except PlanError as error:
                why = str(error)
        else:
            if self.told != why:
                self.events.append(("no_plan", why))
            self.told = why
            self.again = m.tick + round(min(self.tries, PLANS) * AGAIN / self.robot.dt)
            return None
        if takes < late(joints_take(site, path)):
            return None
        self.events.append(("planned", f"a way of {len(path)} postures around what holds the arm"))
        return self._take(site, path)

    def _take(self, site: Site, path: F64) -> Advice:
        self.course = Course(site, path)
        return self.course.first(site)

    # -- along a way -------------------------------------------------------------------------------------------------

    def _along(self, m: Seen, goal: Goal, course: Course, changed: bool) -> Advice | None:
        site, dt = self._site(m), self.robot.dt
        course.come(m.tick, m.q)
        if course.ended(site):
            self.course, self.again = None, m.tick + round(AGAIN / dt)
            return self._given(course.way.end)
        if changed or ((course.blocked or moves(site)) and m.tick >= self.look):
            self.look = m.tick + round(LOOK / dt)
            course.look(site)
        if course.blocked:
            return self._yield(m, goal, site, course)
        course.goes()
        if course.stuck(m.tick, dt):
            self.course = None
            return self._planned(m, goal, site) if self.plans else self._given(course.way.end)
        return course.on(site)

    def _yield(self, m: Seen, goal: Goal, site: Site, course: Course) -> Advice | None:
        """Yield to what moves; after a while look for another way."""
        if not course.waits(m.tick):
            self.events.append(("yields", "to what moves across the way"))
        if course.patient(m.tick, self.robot.dt):
            return course.aside(site)
        self.course = None
        return self._planned(m, goal, site) if self.plans else None

    def _forget(self) -> None:
        self.course, self.given, self.ends = None, None, []
        self.look = self.again = self.tries = 0
        self.late, self.watch, self.left, self.nearest, self.kept = -1, 0, np.inf, np.inf, None
        self.told, self.scene = "", b""

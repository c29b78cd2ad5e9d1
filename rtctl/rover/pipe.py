"""One tick of the base: feedback and requests in, a twist and a record out. Pure, as the arm's.

The block diagram is the arm's with a planar model: estimate, supervise, field, law, limits, command.
"""

import math

import numpy as np

from rtctl.kernel import reductions as scans
from rtctl.rover import estimator, law, legs, occupancy, outline, path, turn
from rtctl.rover.faults import BIT, FAULTS, Counters, severity
from rtctl.rover.memory import NO_LOOK, BaseMemory
from rtctl.rover.perception import perceived, surroundings
from rtctl.rover.record import Judged, recorded
from rtctl.rover.robot import SECTORS, Base, Wheels
from rtctl.rover.signals import Ask, BaseCommand, BaseFeedback, Word, at_rest
from rtctl.rover.supervision import detected, driving, supervise, with_goal
from rtctl.types import F64, Goal, ObstacleEdit, Record, Request, Severity, Shape, State, Status, Task
from rtctl.world import obstacle_table

MISSED_MAX = 50  # slots that the estimate coasts through; more is a fault
SLOW = 0.25  # of V_max while the position is reckoned, or the autopilot's own estimator is at its bound
BLIND_SPEED = 0.1  # [m/s] below it the base stands for what it has not seen
BLIND_TURN = 0.05  # [rad/s] below it the base does not turn for what it has not seen
BLIND_TIME = 0.5  # [s] before that is a status
SMOOTH = 1.0  # [s] over which asked and done are compared
ASKED = np.array([0.3, 0.3])  # [m/s, rad/s] that must be asked for before it is asked what came of it
LITTLE = 0.4  # of it
TURN_SPEED = 0.05  # [m/s] of v_ref below which the base turns on the spot
DETOUR = 1.2  # times as long as the straight line, from which on a way is asked whether the outline has a shorter one
PROGRESS = 0.3  # [m] by which the way must become shorter to count
SIGHTLESS = BIT["scan_stale"] | BIT["scan_wrong"]


def tick(
    base: Base, memory: BaseMemory, feedback: BaseFeedback, request: Request
) -> tuple[BaseMemory, BaseCommand, Record]:
    """Return (memory, command, record) of one servo period."""
    m = memory._replace(tick=memory.tick + 1, refusal="")
    elapsed = base.dt * (1 + min(feedback.missed, MISSED_MAX))
    m = _estimated(base, m, feedback, elapsed)
    m = _compared(base, m, elapsed)
    m = perceived(base, m, feedback, request, elapsed)
    m, present = detected(base, m, feedback)
    m = supervise(base, m, feedback, request, present)
    m = with_goal(base, m, request)
    m = _guided(base, m)
    m, judged = _law(base, m, feedback, elapsed)
    m, command = _commanded(base, m, feedback, judged, elapsed)
    m = _diagnosed(base, m)
    m = m._replace(last=feedback)
    return m, command, recorded(base, m, feedback, request, judged, command)


def initial(base: Base, feedback: BaseFeedback) -> BaseMemory:
    """Return the memory before the first tick: IDLE, at rest where the feedback says the base is."""
    table = obstacle_table.with_static(obstacle_table.empty(base.slots, base.meshes), base.obstacles)
    seen = occupancy.empty(feedback.position)
    far = np.full(base.slots, np.inf)
    return BaseMemory(
        tick=-1,
        state=State.IDLE,
        since=-1,
        reaction=Severity.NONE,
        off=False,
        hold_asked=False,
        in_force=0,
        good=np.full(len(FAULTS), 1 << 30),
        counters=Counters(),
        entered=False,
        mine=False,
        leaving=False,
        done=False,
        refusal="",
        here=estimator.start(feedback.position, feedback.yaw, base.noise),
        innovation=0.0,
        unheard=0.0,
        jump=False,
        rest=0,
        last=feedback,
        goal=None,
        goal_rho=far,
        status=Status.NO_GOAL,
        blocker=-1,
        turn=math.nan,
        look=NO_LOOK,
        nearest=np.inf,
        still=0,
        world=table,
        chart=seen,
        free=occupancy.free_distance(seen, table.obstacles, base.margins.height),
        scans=tuple(np.zeros((0, 2)) for _ in base.sensors),
        allowed_seen=0.0,
        blind=0,
        dark=0,
        unfixed=0.0,
        asked=np.zeros(2),
        did=np.zeros(2),
        unanswered=np.zeros(2),
        way=path.NO_WAY,
        due=0,
        rho=far,
        rho_seen=np.inf,
        v_ref=np.zeros(2),
        v=0.0,
        w=0.0,
        sent=np.zeros((law.history(base), 2)),
    )


def _estimated(base: Base, m: BaseMemory, f: BaseFeedback, elapsed: float) -> BaseMemory:
    """Where the base is at this slot; a report that speed cannot explain is a jump, and the frame moves with it.

    Without reports the estimate coasts until the position counts as lost, then it rests where it is: what was seen
    stays where it was, and the next report says how far the base went meanwhile.
    """
    unheard, innovation, jump = m.unheard + elapsed, m.innovation, False
    lost = unheard > base.safety.position_stop
    here = m.here._replace(v=np.zeros(2)) if lost else estimator.predicted(m.here, elapsed, base.noise)
    here = here._replace(yaw=estimator.wrapped(f.yaw + f.attitude_age * f.yaw_rate), yaw_rate=f.yaw_rate)
    seen, points = m.chart, m.scans
    if f.reboots != m.last.reboots:  # another origin, perhaps: nothing of before has a place in it
        seen, points = occupancy.empty(f.position), tuple(np.zeros((0, 2)) for _ in points)
    if f.fresh:
        before, after = here, f.position + f.position_age * (f.velocity - here.b)
        here, innovation = estimator.measured(here, f.position, f.velocity, f.position_age, base.noise)
        jump = innovation > base.safety.jump + base.limits.v_max * unheard
        jump = jump or (f.reset != m.last.reset and innovation > base.safety.jump)
        if jump or lost:
            here = estimator.placed(before, after, f.velocity, base.noise)
        if jump:
            by = here.x - before.x
            seen, points = occupancy.shifted(seen, by), tuple(p + by for p in points)
        unheard = 0.0
    still = math.hypot(*here.v) < 0.1 and abs(here.yaw_rate) < 0.1
    return m._replace(
        here=here,
        unheard=unheard,
        innovation=innovation,
        jump=jump,
        chart=seen,
        scans=points,
        rest=m.rest + 1 if still else 0,
        unfixed=m.unfixed + elapsed if f.fix_lost else 0.0,
    )


def _guided(base: Base, m: BaseMemory) -> BaseMemory:
    """Keep the way to the goal; look for it anew when a scan came or its time has."""
    if m.goal is None or m.state != State.RUN:
        return m
    goal = m.goal.position[:2]
    if m.tick >= m.due:
        m = m._replace(free=occupancy.free_distance(m.chart, m.world.obstacles, base.margins.height))
        m = m._replace(way=_way(base, m, goal), due=m.tick + max(1, round(base.plan_dt / base.dt)))
    else:
        kept = _left(base, m, m.here.x)
        m = m._replace(way=kept, due=m.due if len(kept.corners) else m.tick + 1)
    whole = m.way.length + m.way.short
    gained = whole < m.nearest - PROGRESS
    m = turn.look_around(base, m)
    heading = turn.wanted(base, m)
    heading = m.look.heading if math.isnan(heading) else heading
    heading = turn.onto_leg(base, m) if math.isnan(heading) else heading
    still = 0 if gained or not math.isnan(heading) else m.still + 1
    return m._replace(nearest=whole if gained else m.nearest, still=still, turn=heading)


def _way(base: Base, m: BaseMemory, goal: F64) -> path.Way:
    """Return the way to goal (2,) [m]: of the circle about the outline, or of the outline where that is shorter."""
    x, origin, room = m.here.x, m.chart.origin, base.margins.room
    on_legs = m.way.start is not None
    way = path.way_to(m.free, origin, x, goal, room, path.NO_WAY if on_legs else m.way)
    if not len(base.cover):
        return way
    reaches = way.short == 0.0 and len(way.corners) > 0 and occupancy.at(m.free, origin, x) >= room
    if reaches and way.length <= DETOUR * math.dist(x, goal) + base.margins.hull:
        return way
    pose = np.array([*x, m.here.yaw])
    kept = legs.legs_left(m.free, origin, base.cover, pose, m.way, base.margins.aside) if on_legs else path.NO_WAY
    if not len(kept.corners):
        kept = legs.legs_to(m.free, origin, base.cover, pose, goal, base.margins.aside)
    return kept if len(kept.corners) and (not reaches or kept.length < way.length) else way


def _left(base: Base, m: BaseMemory, x: F64) -> path.Way:
    """Return what is left of the way at x (2,) [m]."""
    if m.way.start is None:
        return path.remaining(m.free, m.chart.origin, x, m.way, base.margins.room)
    return legs.legs_left(m.free, m.chart.origin, base.cover, np.array([*x, m.here.yaw]), m.way, base.margins.aside)


def _towards(base: Base, m: BaseMemory, x: F64) -> F64:
    """Return xd_d (2,) [m/s] at x (2,) [m]: along the leg, or to the corner of the way that is next."""
    if m.way.start is not None:
        place, length = legs.aimed_at(m.way, x)
        return law.desired(base, x, place, length)
    way = path.remaining(m.free, m.chart.origin, x, m.way, base.margins.room)
    way = way if len(way.corners) else m.way  # from where it will be no corner is in sight: head on
    return law.desired(base, x, way.corners[0], way.length)


def _law(base: Base, m: BaseMemory, f: BaseFeedback, elapsed: float) -> tuple[BaseMemory, Judged]:
    """Evaluate field and goal at the state that a set-point sent now will meet."""
    x, yaw = _ahead(base, m)
    seen, now = surroundings(m, f)
    push = law.field(base, m.here.x, m.here.yaw, m.here.v, seen, now, m.world.obstacles)
    moves = driving(m) and m.state == State.RUN and severity(m.in_force) < Severity.SS2
    xd_d, total = np.zeros(2), np.zeros(2)
    if moves:
        rests = m.status == Status.ARRIVED or not math.isnan(m.turn)
        total = _pushed(base, push, rests)
        if m.goal is not None and not rests and len(m.way.corners):
            xd_d = _towards(base, m, x)
    v_ref = law.integrated(base, m.v_ref, xd_d, total, elapsed) if driving(m) else np.zeros(2)
    if m.state == State.RUN and not moves:
        v_ref = np.zeros(2)  # SS2: zero twist, at once
    if not math.isnan(m.turn) and not total.any():
        v_ref = np.zeros(2)  # nothing to wait for
    speed = float(np.hypot(*v_ref))
    direction = v_ref / speed if speed > 1e-6 else np.array([math.cos(yaw), math.sin(yaw)])
    if base.wheels != Wheels.HOLONOMIC and not base.world_velocity:
        sign = 1.0 if law.unicycle(base, v_ref, yaw)[0] >= 0.0 else -1.0
        direction = sign * np.array([math.cos(yaw), math.sin(yaw)])
    coming = float((x - m.here.x) @ direction)
    here, legged = np.array([*m.here.x, m.here.yaw]), m.way.start is not None
    course = law.Course(here, direction, coming, legged)
    allowed = law.allowed_speed(base, course, seen, m.world.obstacles, push)
    allowed = min(allowed, base.limits.v_max * _calm(f))
    by_sight = base.limits.v_max
    if base.safety.scan:
        by_sight = law.seen_speed(base, m.chart, course, m.tick)
        then = law.Course(np.array([*x, yaw]), direction, 0.0, legged)
        by_sight = min(by_sight, law.seen_speed(base, m.chart, then, m.tick))
    dark = by_sight < min(BLIND_SPEED, allowed)
    keeps = m.blind if dark and m.status == Status.BLIND else 0  # a stop to look is no end of it
    blind = m.blind + 1 if dark and speed > 0.05 else keeps
    m = m._replace(rho=push.rho, rho_seen=push.rho_sensed, allowed_seen=by_sight, blind=blind)
    return m, (v_ref, push, xd_d, min(allowed, by_sight))


def _pushed(base: Base, push: law.Push, rests: bool) -> F64:
    """Return the push (2,) [m/s2] of all that is near.

    A base that rests at its goal stays there: it gives way to what comes, or is nearer than rho_min, alone.
    """
    told = np.where(((push.closing > 0.0) | (push.rho < base.field.rho_min))[:, None] | (not rests), push.known, 0.0)
    seen = push.sensed if not rests or push.rho_sensed < base.field.rho_min else np.zeros(2)
    total: F64 = seen + told.sum(axis=0)
    return total


def _calm(f: BaseFeedback) -> float:
    """Return the share of V_max that the position is good for."""
    return SLOW if f.fix_lost else max(f.quality, SLOW)


def _compared(base: Base, m: BaseMemory, elapsed: float) -> BaseMemory:
    """Asked against done: twists as they should take effect now beside those that came, both smoothed alike.

    Where less than LITTLE of what was asked for comes, time runs; `no_effect` is what it leads to.
    """
    if not driving(m):
        return m._replace(asked=np.zeros(2), did=np.zeros(2), unanswered=np.zeros(2))
    h = len(m.sent)
    late = (min(round(base.margins.lag / base.dt), h) - 1, min(round(base.margins.turn_lag / base.dt), h) - 1)
    due = np.array([m.sent[late[0], 0], m.sent[late[1], 1]])
    along = m.here.v @ np.array([math.cos(m.here.yaw), math.sin(m.here.yaw)])
    gain = min(elapsed / SMOOTH, 1.0)
    asked, did = m.asked + gain * (due - m.asked), m.did + gain * (np.array([along, m.here.yaw_rate]) - m.did)
    little = (np.abs(asked) > ASKED) & (did * np.sign(asked) < LITTLE * np.abs(asked))
    if base.world_velocity:
        little[1] = False  # its autopilot turns as it thinks best
    return m._replace(asked=asked, did=did, unanswered=np.where(little, m.unanswered + elapsed, 0.0))


def _ahead(base: Base, m: BaseMemory) -> tuple[F64, float]:
    """Return the pose that a command sent now will meet."""
    if base.world_velocity or base.wheels == Wheels.HOLONOMIC:
        return m.here.x + base.margins.lag * m.here.v, m.here.yaw
    return law.ahead_of(base, m.here.x, m.here.yaw, m.sent)


def _commanded(
    base: Base, m: BaseMemory, f: BaseFeedback, judged: Judged, elapsed: float
) -> tuple[BaseMemory, BaseCommand]:
    """Turn v_ref into what the wheels take, under their limits and the governor's."""
    v_ref, _, _, allowed = judged
    ask = _asked(base, m, f)
    lim = base.limits
    v, w, velocity = 0.0, 0.0, np.zeros(2)
    if not (np.isfinite(v_ref).all() and math.isfinite(allowed)):
        v_ref = np.zeros(2)  # seen by `detected` in the next tick through what was sent
    elif ask == Ask.DRIVE:
        speed = float(np.hypot(*v_ref))
        velocity = v_ref * min(1.0, allowed / speed) if speed > 1e-6 else np.zeros(2)
        v, w = law.unicycle(base, v_ref, _ahead(base, m)[1])
        v = math.copysign(min(abs(v), allowed), v)
        if m.goal is not None and not math.isnan(m.turn) and speed < TURN_SPEED:
            v, w, velocity = 0.0, turn.rate(base, m, _ahead(base, m)[1]), np.zeros(2)
        if m.state == State.RUN:
            v = min(max(v, m.v - 3.0 * lim.a_max * elapsed), m.v + lim.a_max * elapsed) if abs(v) > abs(m.v) else v
            w = min(max(w, m.w - lim.alpha_max * elapsed), m.w + lim.alpha_max * elapsed)
        if len(base.cover):
            m, w = _turned(base, m, f, w)
    if m.state != State.RUN and ask == Ask.DRIVE and m.state != State.STOPPING:
        v, w, velocity = 0.0, 0.0, np.zeros(2)
    sent = np.concatenate([[[v, w]], m.sent[:-1]])
    return m._replace(v_ref=v_ref, v=v, w=w, sent=sent), BaseCommand(ask, v, w, velocity)


def _turned(base: Base, m: BaseMemory, f: BaseFeedback, w: float) -> tuple[BaseMemory, float]:
    """Return the yaw rate [rad/s] whose turn an outline that is no circle can end before it is too near, or unseen."""
    if w == 0.0:
        return m._replace(dark=0), 0.0
    pose, side, most = np.array([*m.here.x, m.here.yaw]), math.copysign(1.0, w), law.way_of_turn(base)
    coming = side * estimator.wrapped(_ahead(base, m)[1] - m.here.yaw)
    free = outline.turn_free(base, pose, side, most, surroundings(m, f)[0], m.world.obstacles)
    held, dark = w if free >= most else law.held_turn(base, w, free, coming), False
    if base.safety.scan:
        free = outline.turn_seen(base, m.chart, pose, side, most, m.tick - round(base.safety.seen / base.dt))
        by_sight = w if free >= most else law.held_turn(base, w, free, coming)
        dark = abs(by_sight) < min(abs(held), BLIND_TURN)
        held = math.copysign(min(abs(held), abs(by_sight)), w)
    return m._replace(dark=m.dark + 1 if dark else 0), held


def _asked(base: Base, m: BaseMemory, f: BaseFeedback) -> Ask:
    """Return what the state asks of the autopilot; nothing is streamed into a mode that is not ours."""
    if m.state == State.ARMED:
        return Ask.ENGAGE
    if m.state in (State.IDLE, State.FAULT):
        resting = m.state == State.IDLE or m.rest * base.dt > 0.5
        return Ask.DISARM if m.mine and f.armed and resting else Ask.SILENCE
    if not f.ours or (m.state == State.SAFE_STOP and m.off):
        return Ask.SILENCE
    if m.state == State.SAFE_STOP and m.hold_asked:
        return Ask.HOLD
    return Ask.DRIVE


def _diagnosed(base: Base, m: BaseMemory) -> BaseMemory:
    """Level of competence: what the base is doing about its goal."""
    if m.goal is None or m.state != State.RUN:
        return m._replace(status=Status.NO_GOAL, blocker=-1)
    error = float(np.hypot(*(m.goal.position[:2] - m.here.x)))
    more = 2.0 if m.status == Status.ARRIVED else 1.0
    there = error <= more * m.goal.tolerance
    there = there and abs(turn.left(m.goal, m.here.yaw)) <= more * m.goal.tolerance_rot
    moves = math.hypot(*m.here.v) >= 0.3 or (turn.heading_of(m.goal) == m.turn and abs(m.here.yaw_rate) >= 0.1)
    if there and (m.status == Status.ARRIVED or not moves):
        return m._replace(status=Status.ARRIVED, blocker=-1, still=0)
    dark = max(m.blind, m.dark) * base.dt >= BLIND_TIME or not math.isnan(m.look.heading)
    if (dark or m.in_force & SIGHTLESS) and math.hypot(*m.here.v) < 0.2:
        return m._replace(status=Status.BLIND, blocker=-1)
    if m.still * base.dt < base.stall:
        return m._replace(status=Status.MOVING, blocker=-1)
    nearest = int(m.goal_rho.argmin())
    if m.goal_rho[nearest] < base.margins.room:
        return m._replace(status=Status.SHADOWED, blocker=nearest)
    if 0.0 < m.way.short < base.margins.room + 2.0 * occupancy.CELL:
        return m._replace(status=Status.SHADOWED, blocker=-1)
    holding = int(m.rho.argmin())
    return m._replace(status=Status.LOCAL_MINIMUM, blocker=holding if m.rho[holding] < base.field.rho0 else -1)


def warm(base: Base) -> None:
    """Run the tick through every kind of work once, so that nothing is compiled or loaded while the base moves."""
    f = at_rest(np.zeros(2), 0.0)
    distances = np.full(SECTORS, np.inf)
    distances[:9] = 3.0
    f = f._replace(
        slot=0,
        fresh=1,
        scan=distances,
        scan_reach=10.0,
        scan_age=0.05,
        known_age=0.05,
        scans=1,
        ours=True,
        armed=True,
        beams=np.full(8, 2.0),
        beam_reach=5.0,
        word=int(Word.ACCEPTED),
    )
    far, upright = np.array([0.0, 0.0, 50.0]), np.array([1.0, 0.0, 0.0, 0.0])
    shape = Shape("warm", "sphere", np.array([0.1, 0.1, 0.1, 2.0]), far, upright, np.ones(3), np.zeros(3))
    m = initial(base, f)._replace(state=State.RUN, entered=True, mine=True, v_ref=np.ones(2))
    goal = Goal(np.array([12.0, 1.0, 0.0]), upright, Task.POSITION, base.tolerance, base.tolerance_rot)
    for _ in range(3):
        m, _, _ = tick(base, m, f, Request(goal=goal, obstacles=(ObstacleEdit("warm", shape),)))
        f = f._replace(slot=f.slot + 1)
    tick(base, m._replace(state=State.SAFE_STOP, reaction=Severity.SS1), f, Request())
    scans.any_below(m.rho, 0.0)

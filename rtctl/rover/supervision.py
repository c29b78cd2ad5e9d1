"""The supervisor's work of one tick of the base: the arm's table of states, with an autopilot in place of drives."""

import math

import numpy as np

from rtctl.control import goals
from rtctl.control.supervisor import Asked, Event, Rules, Session, supervisor_step
from rtctl.kernel import reductions
from rtctl.rover import faults, path, turn
from rtctl.rover.faults import BIT, Evidence
from rtctl.rover.memory import NO_LOOK, BaseMemory
from rtctl.rover.robot import Base
from rtctl.rover.signals import BaseFeedback, Word
from rtctl.types import F64, Goal, Request, Severity, State, Status, Task, Verb
from rtctl.world import obstacle_table
from rtctl.world.obstacle_table import World

SETTLE = 0.2  # [s] in our mode and armed before RUN
REST_HOLD = 0.5  # [s] at rest before set-points end
STOP_TIME = 6.0  # [s] after which a stop is believed over: no feedback says so
HOLD_TIME = 3.0  # [s] for the autopilot to take its hold mode
DISARM_TIME = 3.0  # [s] for it to disarm
NO_EFFECT = 2.0  # [s] of little done; three times that where the autopilot turns before it drives
NOT_ARM = "a base has no joints, wanted disarm"
WITHOUT = {
    Verb.RECOVER: "a base has no joint limits",
    Verb.FLOAT: "a base is not moved by hand",
    Verb.PARK: NOT_ARM,
    Verb.DROP: NOT_ARM,
    Verb.HOLD: "a base has no such verb yet: use stop",
}
RULES = Rules(faults.TABLE, faults.REFUSES_ARMING, WITHOUT)
REFUSALS = (Word.DENIED, Word.UNSUPPORTED, Word.FAILED, Word.NO_ANSWER)


def driving(m: BaseMemory) -> bool:
    """Return whether the state streams set-points."""
    if m.state == State.SAFE_STOP:
        return not m.off
    return m.state in (State.RUN, State.STOPPING)


def detected(base: Base, m: BaseMemory, f: BaseFeedback) -> tuple[BaseMemory, int]:
    """Return the memory with the faults in force, and the bits of those present now."""
    active = driving(m)
    watched = active and not m.hold_asked
    taken = watched and m.entered and not f.ours
    taken = taken or (m.state == State.ARMED and m.entered and not f.ours)
    failed = m.state == State.ARMED and (f.word in REFUSALS or (m.tick - m.since) * base.dt >= base.engage)
    evidence = Evidence(
        active=active,
        engaged=watched and m.mine,
        taken=taken,
        engage_failed=failed,
        jump=m.jump and active,
        not_finite=not (math.isfinite(m.v) and math.isfinite(m.w) and math.isfinite(m.innovation)),
        contact=reductions.any_below(m.rho, 0.0) or m.rho_seen < 0.0,
        goal_inside=m.goal is not None and reductions.any_below(m.goal_rho, 0.0),
        feed_age=obstacle_table.oldest(m.world),
        reboots=m.last.reboots,
        no_effect=bool((m.unanswered > NO_EFFECT * (3.0 if base.world_velocity else 1.0)).any()),
        unfixed=m.unfixed,
    )
    present, counters = faults.detect(f, evidence, m.counters, base.safety)
    # before it is ours to command, what is wrong with the vehicle is news, not a stop that somebody must reset
    kept = m.in_force if m.state != State.IDLE else m.in_force & (faults.TABLE.automatic | faults.TABLE.lasting)
    in_force, good = faults.TABLE.latch(present, kept, m.good)
    return m._replace(counters=counters, in_force=in_force, good=good), present


def supervise(base: Base, m: BaseMemory, f: BaseFeedback, request: Request, present: int) -> BaseMemory:
    """Return the memory after the supervisor's table took this tick's events."""
    before = m.state
    asked = Asked(m.tick, request.verb, present, _timed(base, m, f, present))
    step = supervisor_step(RULES, Session(before, m.since, m.reaction, m.in_force, m.leaving), asked)
    m = m._replace(**step.session._asdict(), refusal=step.refusal or m.refusal)
    if m.state != before:
        m = _entered(m)
    return _followed(base, m, f, present)


def _followed(base: Base, m: BaseMemory, f: BaseFeedback, present: int) -> BaseMemory:
    """Return the memory after what the vehicle did: whose it is, and how far a stop has come."""
    taken = present & (BIT["mode_taken"] | BIT["disarmed"] | BIT["rebooted"])
    if m.state in (State.ARMED, State.RUN) and f.ours:
        m = m._replace(entered=True, mine=m.mine or f.armed)
    if taken or (m.mine and not f.armed):
        m = m._replace(mine=False, entered=False)
    if m.state == State.SAFE_STOP and not m.off:
        elapsed = (m.tick - m.since) * base.dt
        over = m.rest * base.dt >= REST_HOLD or elapsed >= STOP_TIME
        held = m.hold_asked or (m.reaction >= Severity.SS1 and over)
        if held and not f.ours:
            m = m._replace(entered=False)  # our own HOLD gave the mode away: nobody has taken it
        gone = bool(m.in_force & (BIT["mode_taken"] | BIT["disarmed"])) or (held and not f.ours)
        m = m._replace(hold_asked=held, off=gone or (held and elapsed >= STOP_TIME + HOLD_TIME))
    waiting = m.mine and f.armed and (m.tick - m.since) * base.dt < DISARM_TIME
    at_rest = m.state in (State.IDLE, State.FAULT) or (m.state == State.SAFE_STOP and m.off)
    return m._replace(done=m.leaving and at_rest and not waiting)


def _timed(base: Base, m: BaseMemory, f: BaseFeedback, present: int) -> frozenset[Event]:
    """Return the events that come of waiting."""
    elapsed = (m.tick - m.since) * base.dt
    if m.state == State.ARMED:
        if f.ours and f.armed and elapsed >= SETTLE:
            return frozenset((Event.SETTLED,))
        return frozenset((Event.TIMEOUT,) if present & BIT["engage_refused"] else ())
    if m.state == State.STOPPING:
        rested = m.rest * base.dt >= REST_HOLD and elapsed >= REST_HOLD
        return frozenset((Event.RESTED,) if rested or not f.ours or elapsed >= STOP_TIME else ())
    return frozenset()


def _entered(m: BaseMemory) -> BaseMemory:
    """Return the memory on entering a state: every motion begins from rest or from what is."""
    m = m._replace(
        goal=None,
        status=Status.NO_GOAL,
        blocker=-1,
        turn=math.nan,
        look=NO_LOOK,
        still=0,
        off=False,
        hold_asked=False,
        way=path.NO_WAY,
        nearest=np.inf,
        blind=0,
        asked=np.zeros(2),
        did=np.zeros(2),
        unanswered=np.zeros(2),
    )
    if m.state == State.ARMED:
        m = m._replace(v_ref=np.zeros(2), v=0.0, w=0.0, entered=False, mine=False)
    return m


def with_goal(base: Base, m: BaseMemory, request: Request) -> BaseMemory:
    """Return the memory with the request's goal, or with the reason why it was refused."""
    goal = request.goal
    if goal is None:
        return m
    rho = m.goal_rho
    refusal = "" if m.state == State.RUN else f"goal: not possible in state {m.state.name}"
    if not refusal and goal.task & Task.POSITION not in (Task.POSITION, Task.X | Task.Y):
        refusal = "goal: a base goes to a place, wanted x and y"
    if not refusal and goal.streams:
        refusal = "goal: got a velocity or a time-out, wanted " + goals.RESTS
    refusal = refusal or turn.refusal(base, goal)
    if not refusal:
        rho = goal_distance(base, m.world, goal)
        refusal = goals.refusal(goal, np.zeros(3), base.reach, rho, m.world.names)
    if refusal:
        return m._replace(refusal=refusal.replace("from the base", "from the origin").replace("arm's ", ""))
    return m._replace(
        goal=goal,
        goal_rho=rho,
        status=Status.MOVING,
        blocker=-1,
        turn=math.nan,
        look=NO_LOOK,
        still=0,
        way=path.NO_WAY,
        nearest=np.inf,
        due=m.tick,
    )


def goal_distance(base: Base, table: World, goal: Goal) -> F64:
    """Return the distance (K,) [m] of a goal to each known obstacle, at the height these are cut at."""
    return obstacle_table.distance_from(table, np.array([goal.position[0], goal.position[1], base.margins.height]))

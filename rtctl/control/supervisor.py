"""Who may move a vehicle, as a table, and the step of one tick through it: the same for every vehicle.

Events are ranked; the first that the table knows for the state is taken.
SAFE_STOP and FAULT are left only by an operator's reset. Nothing here resumes motion by itself.
"""

from collections.abc import Mapping
from enum import IntEnum
from typing import NamedTuple

from rtctl.control.faults import FaultTable
from rtctl.types import Severity, State, Verb


class Event(IntEnum):
    """What can move the supervisor; smaller is more urgent."""

    STO = 0  # a fault that wants torque off now
    SS1 = 1  # a fault that wants damping, then torque off
    SS2 = 2  # a fault that wants a controlled stop and an operator
    TERM = 3
    STOP = 4
    DISARM = 5
    RESET = 6
    ARM = 7
    TIMEOUT = 8  # the drives did not enable in time
    SETTLED = 9  # drives enabled and the hold torque has built up
    RESTED = 10  # at rest, held long enough
    RESUME = 11  # a reset of what would fall without torque: it goes on being held


EVENT_OF = {
    Verb.ARM: Event.ARM,
    Verb.RECOVER: Event.ARM,
    Verb.DISARM: Event.DISARM,
    Verb.DROP: Event.DISARM,
    Verb.PARK: Event.DISARM,  # at its end: an arm first moves
    Verb.STOP: Event.STOP,
    Verb.RESET: Event.RESET,
}
EVENT_FOR = {Severity.SS2: Event.SS2, Severity.SS1: Event.SS1, Severity.STO: Event.STO}

S, E = State, Event
TABLE: dict[tuple[State, Event], State] = {
    (S.IDLE, E.STO): S.FAULT,
    (S.IDLE, E.ARM): S.ARMED,
    (S.IDLE, E.RESET): S.IDLE,
    (S.IDLE, E.TERM): S.IDLE,
    (S.ARMED, E.STO): S.FAULT,
    (S.ARMED, E.SS1): S.SAFE_STOP,
    (S.ARMED, E.SS2): S.SAFE_STOP,
    (S.ARMED, E.TERM): S.STOPPING,
    (S.ARMED, E.STOP): S.SAFE_STOP,
    (S.ARMED, E.DISARM): S.STOPPING,
    (S.ARMED, E.TIMEOUT): S.IDLE,
    (S.ARMED, E.SETTLED): S.RUN,
    (S.RUN, E.STO): S.FAULT,
    (S.RUN, E.SS1): S.SAFE_STOP,
    (S.RUN, E.SS2): S.SAFE_STOP,
    (S.RUN, E.TERM): S.STOPPING,
    (S.RUN, E.STOP): S.SAFE_STOP,
    (S.RUN, E.DISARM): S.STOPPING,
    (S.STOPPING, E.STO): S.FAULT,
    (S.STOPPING, E.SS1): S.SAFE_STOP,
    (S.STOPPING, E.STOP): S.SAFE_STOP,
    (S.STOPPING, E.RESTED): S.IDLE,
    (S.SAFE_STOP, E.STO): S.FAULT,
    (S.SAFE_STOP, E.SS1): S.SAFE_STOP,  # while it lasts nothing but torque off leaves the damped stop
    (S.SAFE_STOP, E.TERM): S.STOPPING,
    (S.SAFE_STOP, E.RESET): S.STOPPING,
    (S.SAFE_STOP, E.RESUME): S.RUN,
    (S.FAULT, E.RESET): S.IDLE,
    (S.FAULT, E.TERM): S.IDLE,
}


def next_state(state: State, events: set[Event]) -> tuple[State, Event | None]:
    """Return the state after the most urgent event that the table knows for `state`, and that event."""
    for event in sorted(events):
        if (state, event) in TABLE:
            return TABLE[state, event], event
    return state, None


class Rules(NamedTuple):
    """What of the step depends on the kind of vehicle and does not change."""

    table: FaultTable
    refuses_arming: int  # bits of the faults that refuse arming while they are in force
    without: Mapping[Verb, str]  # verbs that mean nothing to this vehicle, and why


class Session(NamedTuple):
    """What the supervisor knows of the past."""

    state: State
    since: int  # tick of entering it
    reaction: Severity  # of SAFE_STOP and FAULT, NONE elsewhere
    in_force: int  # bits of the faults
    leaving: bool  # SIGTERM came


class Asked(NamedTuple):
    """What one tick puts to the supervisor."""

    tick: int
    verb: Verb
    present: int  # bits of the faults seen in this tick
    timed: frozenset[Event]  # that come of waiting in this state
    refusal: str = ""  # of the vehicle's own, before those of the faults
    refusal_last: str = ""  # the same, where no fault refuses
    falls: bool = False  # without torque it would fall, and has not been let go


class Step(NamedTuple):
    """What a tick made of the session."""

    session: Session
    event: Event | None  # that the table took
    refusal: str  # of the operator's verb, '' for none


def supervisor_step(rules: Rules, s: Session, asked: Asked) -> Step:
    """Return the session after the most urgent of the operator's verb, the faults in force and what was waited for."""
    s, events, refusal = _verb(rules, s, asked)
    worst = rules.table.stops(s.in_force)
    if worst >= Severity.SS2:
        events.add(EVENT_FOR[worst])
    state, event = next_state(s.state, events | asked.timed)
    reaction = s.reaction
    if state in (State.SAFE_STOP, State.FAULT):
        reaction = max(reaction, worst, Severity.SS2 if event == Event.STOP else Severity.NONE)
    elif state != s.state:
        reaction = Severity.NONE
    since = asked.tick if state != s.state else s.since
    return Step(s._replace(state=state, since=since, reaction=reaction), event, refusal)


def admits(state: State, verb: Verb) -> bool:
    """Return whether the table knows the event of a verb in a state."""
    return (state, EVENT_OF[verb]) in TABLE


def _verb(rules: Rules, s: Session, asked: Asked) -> tuple[Session, set[Event], str]:
    """Return the event of the operator's verb, or the reason why there is none."""
    verb = asked.verb
    if verb == Verb.NONE:
        return s, set(), ""
    if verb == Verb.TERM:  # the second one does not wait for rest
        return s._replace(leaving=True), {Event.STO if s.leaving else Event.TERM}, ""
    refusal = rules.without.get(verb, "")
    if not refusal and not admits(s.state, verb):
        refusal = f"not possible in state {s.state.name}"
    elif not refusal:
        refuses = 0
        if verb in (Verb.ARM, Verb.RECOVER):
            refuses = s.in_force & rules.refuses_arming
        elif verb == Verb.RESET:
            s = s._replace(in_force=rules.table.cleared(s.in_force, asked.present))
            refuses = s.in_force & ~rules.table.automatic
        refusal = asked.refusal or rules.table.reasons(refuses) or asked.refusal_last
    if refusal:
        return s, set(), f"{verb.name.lower()}: {refusal}"
    return s, {Event.RESUME if verb == Verb.RESET and asked.falls else EVENT_OF[verb]}, ""

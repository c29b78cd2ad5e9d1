"""Who may move the arm, as a table. Events are ranked; the first that the table knows for the state is taken.

SAFE_STOP and FAULT are left only by an operator's reset. Nothing here resumes motion by itself.
"""

from enum import IntEnum

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


EVENT_OF = {
    Verb.ARM: Event.ARM,
    Verb.RECOVER: Event.ARM,
    Verb.DISARM: Event.DISARM,
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
    (S.FAULT, E.RESET): S.IDLE,
    (S.FAULT, E.TERM): S.IDLE,
}


def next_state(state: State, events: set[Event]) -> tuple[State, Event | None]:
    """Return the state after the most urgent event that the table knows for `state`, and that event."""
    for event in sorted(events):
        if (state, event) in TABLE:
            return TABLE[state, event], event
    return state, None

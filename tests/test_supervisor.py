"""The table of states: what it must never allow."""

import itertools

import pytest

from rtctl.control.supervisor import TABLE, Event, next_state
from rtctl.types import State

LATCHED = (State.SAFE_STOP, State.FAULT)


@pytest.mark.parametrize("state", LATCHED)
def test_only_an_operator_leaves_a_latched_state(state):
    for size in range(4):
        for events in itertools.combinations(Event, size):
            after, event = next_state(state, set(events))
            if after not in LATCHED:
                assert event in (Event.RESET, Event.TERM)


def test_run_is_entered_only_through_armed_and_armed_only_by_the_operator():
    assert [k for k, v in TABLE.items() if v == State.RUN] == [(State.ARMED, Event.SETTLED)]
    assert [k for k, v in TABLE.items() if v == State.ARMED] == [(State.IDLE, Event.ARM)]


@pytest.mark.parametrize("state", [State.ARMED, State.RUN])
@pytest.mark.parametrize("event", [Event.STO, Event.SS1, Event.SS2, Event.STOP, Event.TERM, Event.DISARM])
def test_every_way_to_stop_stops_a_driven_arm(state, event):
    after, _ = next_state(state, {event})
    assert after in (*LATCHED, State.STOPPING)


def test_the_worst_event_wins():
    assert next_state(State.RUN, {Event.TERM, Event.STO, Event.SS2})[0] == State.FAULT
    assert next_state(State.RUN, {Event.DISARM, Event.SS1})[0] == State.SAFE_STOP


def test_torque_off_reaches_fault_from_every_state_that_drives():
    for state in (State.ARMED, State.RUN, State.STOPPING, State.SAFE_STOP):
        assert TABLE[state, Event.STO] == State.FAULT


def test_without_events_nothing_changes():
    for state in State:
        assert next_state(state, set()) == (state, None)


# Every row as the published table of states has it: where each event leads; - where it means nothing.
WHERE = """
           STO    SS1        SS2        TERM      STOP       DISARM    RESET     ARM    TIMEOUT  SETTLED  RESTED
IDLE       FAULT  -          -          IDLE      -          -         IDLE      ARMED  -        -        -
ARMED      FAULT  SAFE_STOP  SAFE_STOP  STOPPING  SAFE_STOP  STOPPING  -         -      IDLE     RUN      -
RUN        FAULT  SAFE_STOP  SAFE_STOP  STOPPING  SAFE_STOP  STOPPING  -         -      -        -        -
STOPPING   FAULT  SAFE_STOP  -          -         SAFE_STOP  -         -         -      -        -        IDLE
SAFE_STOP  FAULT  SAFE_STOP  -          STOPPING  -          -         STOPPING  -      -        -        -
FAULT      -      -          -          IDLE      -          -         IDLE      -      -        -        -
"""
ROWS = [line.split() for line in WHERE.strip().splitlines()]
CELLS = [
    (State[row[0]], Event[event], None if to == "-" else State[to])
    for row in ROWS[1:]
    for event, to in zip(ROWS[0], row[1:], strict=True)
]


@pytest.mark.parametrize(("state", "event", "to"), CELLS, ids=lambda value: getattr(value, "name", "-"))
def test_each_event_leads_where_the_published_table_says(state, event, to):
    assert next_state(state, {event}) == ((state, None) if to is None else (to, event))


def test_what_is_more_urgent_is_taken_and_not_only_known():
    """A damped stop that lasts is not left by a reset or a TERM that comes in the same tick."""
    assert next_state(State.SAFE_STOP, {Event.SS1, Event.TERM}) == (State.SAFE_STOP, Event.SS1)
    assert next_state(State.SAFE_STOP, {Event.SS1, Event.RESET}) == (State.SAFE_STOP, Event.SS1)
    assert next_state(State.STOPPING, {Event.SS1, Event.RESTED}) == (State.SAFE_STOP, Event.SS1)
    assert next_state(State.STOPPING, {Event.STOP, Event.RESTED}) == (State.SAFE_STOP, Event.STOP)

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

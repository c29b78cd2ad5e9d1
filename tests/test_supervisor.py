"""The table of states: what it must never allow."""

import itertools
from typing import Any

import pytest

from rtctl.control.faults import Fault, FaultTable
from rtctl.control.supervisor import (
    EVENT_OF,
    TABLE,
    Asked,
    Event,
    Rules,
    Session,
    Step,
    admits,
    next_state,
    supervisor_step,
)
from rtctl.types import Severity, State, Verb

LATCHED = (State.SAFE_STOP, State.FAULT)


@pytest.mark.parametrize("state", LATCHED)
def test_only_an_operator_leaves_a_latched_state(state):
    for size in range(4):
        for events in itertools.combinations(Event, size):
            after, event = next_state(state, set(events))
            if after not in LATCHED:
                assert event in (Event.RESET, Event.RESUME, Event.TERM)


def test_run_is_entered_through_armed_or_by_a_reset_of_what_would_fall_and_armed_only_by_the_operator():
    ways = {k for k, v in TABLE.items() if v == State.RUN}
    assert ways == {(State.ARMED, Event.SETTLED), (State.SAFE_STOP, Event.RESUME)}
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
           STO    SS1        SS2        TERM      STOP       DISARM    RESET     ARM    TIMEOUT  SETTLED  RESTED  RESUME
IDLE       FAULT  -          -          IDLE      -          -         IDLE      ARMED  -        -        -       -
ARMED      FAULT  SAFE_STOP  SAFE_STOP  STOPPING  SAFE_STOP  STOPPING  -         -      IDLE     RUN      -       -
RUN        FAULT  SAFE_STOP  SAFE_STOP  STOPPING  SAFE_STOP  STOPPING  -         -      -        -        -       -
STOPPING   FAULT  SAFE_STOP  -          -         SAFE_STOP  -         -         -      -        -        IDLE    -
SAFE_STOP  FAULT  SAFE_STOP  -          STOPPING  -          -         STOPPING  -      -        -        -       RUN
FAULT      -      -          -          IDLE      -          -         IDLE      -      -        -        -       -
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


# ---- the step of a tick

FAULT_ROWS = FaultTable.of(
    (
        Fault("brake", 1, Severity.SS2, "R", "it brakes"),
        Fault("damp", 2, Severity.SS1, "R", "it is damped"),
        Fault("off", 3, Severity.STO, "R", "it lets go"),
        Fault("heals", 4, Severity.SS1, "A", "it goes by itself"),
        Fault("told", 5, Severity.LOG, "R", "it is only told"),
        Fault("lasts", 6, Severity.SS1, "L", "it wants a restart"),
    )
)
BRAKE, DAMP, OFF, HEALS, TOLD, LASTS = (1 << i for i in range(6))
RULES = Rules(FAULT_ROWS, BRAKE | DAMP | OFF | HEALS | LASTS, {Verb.RECOVER: "there is nothing to recover"})


def session(state: State, in_force: int = 0, reaction: Severity = Severity.NONE, leaving: bool = False) -> Session:
    return Session(state, 7, reaction, in_force, leaving)


def asked(verb: Verb = Verb.NONE, present: int = 0, **more: Any) -> Asked:
    return Asked(50, verb, present, **{"timed": frozenset(), **more})


@pytest.mark.parametrize(
    ("bits", "state", "reaction"),
    [
        (0, State.RUN, Severity.NONE),
        (TOLD, State.RUN, Severity.NONE),
        (HEALS, State.RUN, Severity.NONE),  # its reaction lasts as long as it, and ends RUN for nobody
        (BRAKE, State.SAFE_STOP, Severity.SS2),
        (DAMP, State.SAFE_STOP, Severity.SS1),
        (OFF, State.FAULT, Severity.STO),
        (BRAKE | DAMP, State.SAFE_STOP, Severity.SS1),
        (BRAKE | DAMP | OFF, State.FAULT, Severity.STO),
    ],
)
def test_a_fault_in_force_leaves_run_for_its_stop_at_its_tick(bits: int, state: State, reaction: Severity):
    step = supervisor_step(RULES, session(State.RUN, bits), asked())
    assert step.session == Session(state, 7 if state == State.RUN else 50, reaction, bits, False)
    assert step.refusal == ""


def test_an_operators_stop_is_a_controlled_one_and_a_worse_reaction_stays():
    assert supervisor_step(RULES, session(State.RUN), asked(Verb.STOP)).session.reaction == Severity.SS2
    damped = session(State.SAFE_STOP, 0, Severity.SS1)
    assert supervisor_step(RULES, damped, asked()).session == damped
    worse = supervisor_step(RULES, session(State.SAFE_STOP, DAMP, Severity.SS2), asked())
    assert worse.session == session(State.SAFE_STOP, DAMP, Severity.SS1)  # and since when does not begin anew
    assert worse.event == Event.SS1


def test_a_stop_that_is_left_leaves_no_reaction():
    step = supervisor_step(RULES, session(State.SAFE_STOP, BRAKE, Severity.SS2), asked(Verb.RESET))
    assert step == Step(Session(State.STOPPING, 50, Severity.NONE, 0, False), Event.RESET, "")


def test_what_is_present_or_wants_a_restart_is_not_reset():
    stopped = session(State.SAFE_STOP, BRAKE | DAMP, Severity.SS1)
    step = supervisor_step(RULES, stopped, asked(Verb.RESET, present=DAMP))
    assert step == Step(stopped._replace(in_force=DAMP), Event.SS1, "reset: damp (it is damped)")
    lasting = session(State.SAFE_STOP, LASTS, Severity.SS1)
    assert supervisor_step(RULES, lasting, asked(Verb.RESET)).refusal == "reset: lasts (it wants a restart)"
    healing = session(State.SAFE_STOP, HEALS, Severity.SS2)
    assert supervisor_step(RULES, healing, asked(Verb.RESET, present=HEALS)).session.state == State.STOPPING


@pytest.mark.parametrize("bit", [BRAKE, DAMP, OFF, HEALS, LASTS])
def test_a_fault_in_force_refuses_arming(bit: int):
    step = supervisor_step(RULES, session(State.IDLE, bit), asked(Verb.ARM))
    assert step.session.state in (State.IDLE, State.FAULT)
    assert step.refusal == f"arm: {FAULT_ROWS.reasons(bit)}"
    assert supervisor_step(RULES, session(State.IDLE, TOLD), asked(Verb.ARM)).session.state == State.ARMED


def test_a_verb_that_the_state_does_not_know_is_refused_and_moves_nothing():
    for state in State:
        for verb, event in EVENT_OF.items():
            step = supervisor_step(RULES._replace(without={}), session(state), asked(verb))
            known = (state, event) in TABLE
            assert admits(state, verb) == known
            assert step.refusal == ("" if known else f"{verb.name.lower()}: not possible in state {state.name}")
            assert step.event == (event if known else None)
            assert step.session.state == (TABLE[state, event] if known else state)


def test_arm_and_recover_both_arm_and_each_other_verb_is_its_own_event():
    assert EVENT_OF == {
        Verb.ARM: Event.ARM,
        Verb.RECOVER: Event.ARM,
        Verb.DISARM: Event.DISARM,
        Verb.STOP: Event.STOP,
        Verb.RESET: Event.RESET,
        Verb.DROP: Event.DISARM,
        Verb.PARK: Event.DISARM,
    }


def test_a_reset_of_what_would_fall_goes_on_holding_it_unless_a_fault_is_left():
    held = session(State.SAFE_STOP, BRAKE, Severity.SS2)
    assert supervisor_step(RULES, held, asked(Verb.RESET, falls=True)).session.state == State.RUN
    left = supervisor_step(RULES, held, asked(Verb.RESET, present=BRAKE, falls=True))
    assert left.session.state == State.SAFE_STOP
    assert left.refusal
    for verb in (Verb.DISARM, Verb.STOP, Verb.ARM):  # nothing but a reset is another for it
        there = session(State.RUN)
        one, other = (supervisor_step(RULES, there, asked(verb, falls=falls)) for falls in (False, True))
        assert one == other


def test_reasons_come_in_their_order_what_the_vehicle_lacks_first():
    def said(verb: Verb, in_force: int = 0, **more: str) -> str:
        return supervisor_step(RULES, session(State.IDLE, in_force), asked(verb, **more)).refusal

    assert said(Verb.RECOVER, DAMP, refusal="first") == "recover: there is nothing to recover"
    assert said(Verb.ARM, DAMP, refusal="first", refusal_last="last") == "arm: first"
    assert said(Verb.ARM, DAMP, refusal_last="last") == "arm: damp (it is damped)"
    assert said(Verb.ARM, 0, refusal_last="last") == "arm: last"
    assert said(Verb.DISARM, DAMP, refusal="first") == "disarm: not possible in state IDLE"


def test_term_leaves_at_rest_and_a_second_one_at_once():
    once = supervisor_step(RULES, session(State.RUN), asked(Verb.TERM))
    assert once == Step(Session(State.STOPPING, 50, Severity.NONE, 0, True), Event.TERM, "")
    twice = supervisor_step(RULES, once.session._replace(since=7), asked(Verb.TERM))
    assert twice.session == Session(State.FAULT, 50, Severity.NONE, 0, True)
    assert twice.event == Event.STO


def test_what_is_waited_for_counts_where_nothing_more_urgent_comes():
    rested = asked(timed=frozenset({Event.RESTED}))
    assert supervisor_step(RULES, session(State.STOPPING), rested).session.state == State.IDLE
    assert supervisor_step(RULES, session(State.STOPPING, DAMP), rested).session.state == State.SAFE_STOP

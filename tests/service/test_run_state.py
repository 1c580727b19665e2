"""States of a run: allowed and refused transitions."""

from __future__ import annotations

import errno
import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tdhil.errors import ExitCode, LogError, UsageError
from tdhil.service.run_process import _cut_short
from tdhil.service.run_state import (
    ENDED,
    FOLLOWS,
    UNCHANGED,
    Check,
    Confirmation,
    NotSo,
    State,
    Status,
    Stop,
    Told,
    Watch,
    blocking,
    disk_full,
    end_of,
    iso,
    way_to,
)

AT = "2026-01-01T00:00:00.000Z"
states = st.sampled_from(sorted(State))


@given(st.lists(states, max_size=12))
def test_only_allowed_transitions_occur_and_an_end_is_final(wanted):
    status = Status.begun("run", "rig", AT)
    for state in wanted:
        allowed = not status.ended and state in FOLLOWS[status.state]
        if allowed:
            status = status.to(state, AT)
            assert status.state is state
        else:
            with pytest.raises(NotSo):
                status.to(state, AT)
    assert status.ended == (status.state in ENDED)
    assert Status.of_plain(json.loads(json.dumps(status.plain()))) == status


def test_the_shaft_never_moves_unconfirmed_nor_ends_without_a_stop():
    assert {state for state, after in FOLLOWS.items() if State.MOVING in after} == {
        State.PREFLIGHT, State.AWAITING, State.MOVING}
    assert FOLLOWS[State.MOVING] & ENDED == {State.INTERRUPTED, State.STOP_NOT_CONFIRMED}
    assert {state for state, after in FOLLOWS.items() if State.DONE in after} == {State.IDENTIFYING}


@given(st.sampled_from(sorted(set(State) - ENDED)), st.sampled_from(sorted(ENDED)))
def test_every_end_is_reached_from_any_state(state, end):
    status = Status("run", "rig", (Status.begun("run", "rig", AT).history[0],))
    for one in ("preflight", "awaiting_confirmation", "moving", "stopping", "identifying"):
        if status.state is state:
            break
        status = status.to(State(one), AT)
    if end is State.DONE and state in (State.REQUESTED, State.PREFLIGHT, State.AWAITING):
        with pytest.raises(NotSo):         # no motion and no result
            way_to(status, end, AT)
    elif end in (State.REFUSED, State.STOPPED) and state is State.IDENTIFYING:
        with pytest.raises(NotSo):
            way_to(status, end, AT)
    else:
        assert way_to(status, end, AT).state is end


@pytest.mark.parametrize(("code", "confirmed", "state"), [
    (0, True, "done"), (3, True, "done"), (9, True, "done"), (4, None, "refused"), (4, True, "refused"),
    (130, True, "stopped"), (143, None, "stopped"), (5, True, "failed"), (6, True, "failed"), (7, True, "failed"),
    (1, True, "failed"), (8, False, "stop_not_confirmed"), (0, False, "stop_not_confirmed"), (2, None, "refused"),
])
def test_an_exit_code_is_a_state(code, confirmed, state):
    assert end_of(code, stop_confirmed=confirmed) == state


@pytest.mark.parametrize(("code", "confirmed", "state"), [
    (3, True, "failed"), (9, None, "failed"), (143, True, "stopped"), (4, None, "refused"),
    (3, False, "stop_not_confirmed")])
def test_an_aborted_run_is_never_done(code, confirmed, state):
    assert _cut_short(code, confirmed) == state


def test_every_exit_code_has_its_end():
    assert all(end_of(code, stop_confirmed=True) in ENDED for code in ExitCode)


def test_a_full_status_survives_a_round_trip_by_json():
    status = Status.begun("run", "rig", AT).to(
        State.PREFLIGHT, AT, preflight=(Check("identity", "a", "b", "ok", "1018h"),), simulated=True,
        confirmation=Confirmation("00", "this moves", AT), stop=Stop(asked=AT, by="local"),
        error=Told.of(UsageError("no", where="--x", next_step="Do")), expected_s={"setup": 10.0}, watch=Watch("a", AT),
    )
    assert Status.of_plain(json.loads(json.dumps(status.plain()))) == status
    assert status.error.exit_code == 2
    assert status.watch.gone is None


def test_a_time_is_utc_to_the_millisecond():
    assert iso(1.25) == "1970-01-01T00:00:01.250Z"


@pytest.mark.parametrize("next_step", ["Repeat it", f"{UNCHANGED}changed. Repeat it"])
def test_a_full_disk_is_found_as_the_cause_of_an_error_that_keeps_its_text_and_place(next_step):
    error = LogError("no log", where="run.mcap", next_step=next_step)
    error.__cause__ = OSError(errno.ENOSPC, "No space left on device")
    found = disk_full(error)
    assert (found.what, found.where) == ("no log", "run.mcap")
    assert (found.next_step == next_step) is next_step.startswith(UNCHANGED)
    assert "No space left on device" in disk_full(error.__cause__).what
    assert disk_full(UsageError("no", where="--x", next_step="Do")) is None


def test_an_unconfirmed_stop_blocks_until_it_is_signed_off():
    bad = Status.begun("bad", "rig", AT).to(State.STOP_NOT_CONFIRMED, AT)
    good = Status.begun("good", "rig", AT).to(State.REFUSED, AT)
    assert blocking((good, bad), ()) is bad
    assert blocking((good, bad), ("bad",)) is None

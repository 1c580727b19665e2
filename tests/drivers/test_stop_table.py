"""Table of the bare quick stop: for any readings, it disables no turning shaft and accepts no doubtful standstill.

The tests derive the allowed ends at standstill from the readings alone, backwards from the last one.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.clock import SteppedClock
from drivers.drive import PowerState
from drivers.errors import CommunicationLost, DriveFault, TdhilError
from drivers.quick_stop import (
    LONGEST_STOP_S,
    NO_SLOWER_S,
    PAUSE_S,
    QUIET_S,
    QUIET_UNSAID_S,
    SILENT_S,
    TABLE,
    BareStopReport,
    Ended,
    Seen,
    StopAction,
    StopCourse,
    StopRound,
    StopState,
    bare_stop,
    step,
)

SPEEDS = st.floats(-30.0, 30.0)
READINGS = st.builds(
    Seen, state=st.sampled_from(PowerState), text=st.just("a state"), speed=SPEEDS, unit=st.just("rad/s"),
    near_zero=st.booleans(), standstill=st.booleans(), follows=st.booleans(), blank=st.booleans(),
)
AT_ZERO = st.builds(
    Seen, state=st.sampled_from(PowerState), text=st.just("a state"), speed=st.just(0.0), unit=st.just("rad/s"),
    near_zero=st.just(True), standstill=st.booleans(), follows=st.just(False),
)
ERRORS = st.sampled_from((CommunicationLost("no reply", where="here"), DriveFault("refused", where="here")))
# Readings last for some time, as with a drive. A stop with changing readings only would never end.
PIECES = st.lists(
    st.tuples(st.one_of(AT_ZERO, READINGS, ERRORS), st.floats(0.02, 14.0), st.floats(0.02, 1.0)), min_size=1,
    max_size=12,
)


def rounds(pieces) -> list[StopRound]:
    """Return the pieces as rounds: reading, duration and interval."""
    found, now_s = [], 0.0
    for what, duration_s, every_s in pieces:
        until_s = now_s + duration_s
        while now_s < until_s:
            now_s += every_s
            error = isinstance(what, TdhilError)
            found.append(StopRound(now_s, None if error else what, not isinstance(what, CommunicationLost)))
    return found


def doubted(one: StopRound) -> bool:
    return one.seen is None or one.seen.follows or one.seen.blank


@settings(max_examples=50, deadline=None)
@given(PIECES)
def test_a_turning_or_doubtful_shaft_is_never_disabled_nor_reported_at_standstill(pieces):
    never_released(pieces)


@pytest.mark.heavy
@settings(max_examples=150, deadline=None)
@given(PIECES)
def test_the_same_with_more_sequences(pieces):
    never_released(pieces)


def never_released(pieces):
    course, action = StopCourse.begin(0.0), StopAction.REQUEST
    past: list[StopRound] = []
    for now in rounds(pieces):
        course, action = step(course, now)
        past.append(now)
        assert action in (StopAction.REQUEST, StopAction.WATCH, StopAction.END)      # no action disables
        assert (action is StopAction.END) is (course.ended is not None)
        if action is StopAction.END:
            break
        if doubted(now):
            assert action is StopAction.REQUEST
        else:
            assert action is StopAction.WATCH
    if course.ended is Ended.AT_REST:
        assert not doubted(past[-1])
        still = past[-1].seen.standstill or past[-1].seen.state not in (PowerState.ENABLED, PowerState.QUICK_STOP)
        needed_s = QUIET_S if still else QUIET_UNSAID_S
        begun_s = past[-1].time_s
        for one in reversed(past):
            if doubted(one) or not one.seen.near_zero:
                break
            begun_s = one.time_s
        assert past[-1].time_s - begun_s >= needed_s
    if course.ended is Ended.NO_ANSWER:
        heard = [one.time_s for one in past if one.heard]
        read = any(one.seen is not None for one in past)
        assert past[-1].time_s - (heard[-1] if heard else 0.0) > SILENT_S or not read
    if course.ended is Ended.TURNING:
        assert past[-1].time_s > min(NO_SLOWER_S, LONGEST_STOP_S)


def test_every_state_has_its_row_and_no_row_disables():
    assert set(TABLE) == set(StopState)
    assert {row.action for row in TABLE.values()} == {StopAction.REQUEST, StopAction.WATCH}
    assert {state for state, row in TABLE.items() if row.ended is Ended.AT_REST} == {StopState.QUIET, StopState.STILL}


@dataclass
class Script:
    """Drive with scripted readings that accepts only the two methods of `Target`."""

    clock: SteppedClock
    script: list[StopRound]
    refuses: bool
    calls: list[str] = field(default_factory=list)

    def ask(self, attempt: int) -> None:
        self.calls.append("ask")
        assert attempt == self.calls.count("ask")
        if self.refuses:
            raise DriveFault("refused", where="here")

    def poll(self) -> Seen:
        self.calls.append("poll")
        now = next((one for one in self.script if one.time_s >= self.clock.now_s()), self.script[-1])
        if now.seen is None:
            raise DriveFault("refused", where="here") if now.heard else CommunicationLost("no reply", where="here")
        return now.seen

    def remarks(self) -> tuple[str, ...]:
        return ()

    def __getattr__(self, name: str):
        raise AssertionError(f"a stop used {name}")


@settings(max_examples=40, deadline=None)
@given(PIECES, st.booleans())
def test_the_loop_follows_the_table_and_ends(pieces, refuses):
    clock = SteppedClock()
    drive = Script(clock, rounds(pieces), refuses)
    report = bare_stop(drive, clock, longest_s=20.0)
    assert isinstance(report, BareStopReport)
    assert report.took_s <= 20.0 + 2.0 * PAUSE_S + 1e-6
    assert drive.calls[:2] == ["ask", "poll"] and drive.calls.count("ask") == report.asked
    assert (report.last is None) is (report.first is None)
    if report.ended is Ended.AT_REST:
        assert report.last.near_zero and not report.last.follows and not report.last.blank

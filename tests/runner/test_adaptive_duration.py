"""Adaptive duration of stage 5: the segments, their announcement, the decisions, and an early end."""

import math
import signal
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm

import tdhil.runner.adaptive_duration as enough_room
from drivers.drive import Command, Mode
from tdhil.errors import Interrupted
from tdhil.recording.recording import Excitation, Recording
from tdhil.runner.adaptive_duration import Decision, decide
from tdhil.runner.design import Stopping
from tdhil.runner.design.stopping_rule import MOST_BEHIND, Look, spent_confidence
from tdhil.runner.excitation import MotionLimits, PlanRequest, RigGuess, make_plan
from tdhil.runner.planning import counted_in, pilot_dof
from tdhil.runner.settings import ControlAssumptions
from tdhil.runner.stages.acquire import run_acquire
from tdhil.runner.stages.hold import MeanSpeedControl
from tests.runner import inverter_runs

PLAN = make_plan(MotionLimits(0.5, 10.0, 400.0, 0.9), RigGuess(100.0, 8.0, 60.0), PlanRequest(periods=3))
RULE = Stopping(0.01, 0.95, 20.0, 6, 10, 600.0, True)


class Stub:
    """Decisions with a given number of further periods."""

    at_last = False

    def __init__(self, *wanted):
        self.wanted, self.asked_s = list(wanted), []

    def question(self, spent_s):
        self.asked_s.append(spent_s)
        return lambda: Decision(self.wanted.pop(0), "because", None, 0, 0.95, at_last=self.at_last)

    def decided(self, decision):
        """Discard the decision."""


def acquire(world, stub):
    here = world()
    here.turn(PLAN.segments[0].reference.start_speed_rad_s, Mode.TORQUE)
    told = []
    control = MeanSpeedControl(PLAN.guess, 100.0, ControlAssumptions())

    def run():
        run_acquire(here.bench, here.limits, PLAN, control, told.append, stub)
        return told[-1]

    return here, told, run


@pytest.mark.heavy
def test_an_extension_continues_at_the_last_mean_speed_and_returns_to_the_others(world):
    stub = Stub(4, 2, 0)
    _, _, run = acquire(world, stub)
    excitation = run()
    low, high = (segment.reference.offset_rad_s for segment in PLAN.segments)
    assert [one.offset_rad_s for one in excitation.segments] == [low, high, low, high]
    assert [round((one.end_s - one.start_s) / one.period_s) for one in excitation.segments] == [3, 7, 7, 3]
    assert all(one.settle_periods == 1 for one in excitation.segments)
    for before, behind in zip(excitation.segments, excitation.segments[1:], strict=False):
        assert before.end_s <= behind.start_s
    assert stub.asked_s == sorted(stub.asked_s)
    # an extension takes the time that was planned for it
    assert stub.asked_s[1] - stub.asked_s[0] == pytest.approx(PLAN.extension_s(4), abs=3.0)


@pytest.mark.heavy
def test_a_short_extension_is_run_at_the_last_mean_speed_only(world):
    stub = Stub(4, 0)
    stub.at_last = True
    _, _, run = acquire(world, stub)
    excitation = run()
    assert [round((one.end_s - one.start_s) / one.period_s) for one in excitation.segments] == [3, 7]
    assert stub.asked_s[1] - stub.asked_s[0] == pytest.approx(4.0 * PLAN.segments[0].reference.period_s, abs=0.1)


def test_a_sufficient_pilot_is_the_whole_run(world):
    _, _, run = acquire(world, Stub(0))
    assert [round((one.end_s - one.start_s) / one.period_s) for one in run().segments] == [3, 3]


def test_a_stop_during_an_extension_leaves_a_log_that_can_be_read(world):
    here, told, run = acquire(world, Stub(4, 0))

    def press(stage, cycles):
        if len(told) >= 4:                                   # into the extension of the second segment
            here.stop_request.ask(signal.SIGINT)

    here.display.on_cycle = press
    with pytest.raises(Interrupted):
        run()
    first, second = told[-1].segments
    assert first.end_s <= second.start_s
    assert round((second.end_s - second.start_s) / second.period_s) == 7      # as planned when it was announced


def test_in_real_time_the_motion_continues_during_an_interim_look(world):
    here, _, run = acquire(world, Stub(0))
    here.drive.clock.stepped = False
    commands = len(here.drive.commands)
    segments = run().segments
    assert [round((one.end_s - one.start_s) / one.period_s) for one in segments] == [3, 3]
    assert len(here.drive.commands) > commands
    assert {type(command) for command in here.drive.commands} == {Command}


# -- decisions -----------------------------------------------------------------------------------------------


def recording(counted=6):
    segments = tuple(
        replace(segment, periods=counted + 1).recorded(100.0 * index, 100.0 * index + 10.0 * (counted + 1))
        for index, segment in enumerate(PLAN.segments)
    )
    none, no = np.zeros(0), np.zeros(0, dtype=bool)
    return Recording(none, none, none, no, no, Excitation("multisine", "torque", segments))


@pytest.mark.heavy(but_first=5)
@pytest.mark.parametrize(
    ("interval", "now", "scale", "then", "looks", "seen", "left_s", "periods", "after"),
    [
        (0.008, 0.0080, 1.0, 0.0080, 0, 0, 400.0, 0, 0),      # scatter and interval are both sufficient
        (0.030, 0.0200, 2.0, 0.0095, 0, 0, 400.0, 6, 0),      # the scatter determines the number of periods
        (0.008, 0.0120, 1.2, 0.0095, 0, 0, 400.0, 2, 0),      # a narrow interval alone is no end; a minimum applies
        (0.0101, 0.0080, 1.0, 0.0080, 0, 0, 400.0, 6, 1),     # the interval is too wide: more periods, another look
        (0.030, 0.0080, 1.0, 0.0080, 0, 0, 400.0, 18, 1),     # … in proportion to the excess, at most three times all
        (0.030, 0.0080, 1.0, 0.0080, 0, 0, 70.0, 7, 1),
        (0.008, 0.0080, 1.0, 0.0080, 1, 1, 400.0, 0, 1),
        (0.030, 0.0080, 1.0, 0.0080, 1, 1, 400.0, 18, 2),
        (0.030, 0.0080, 1.0, 0.0080, 0, 0, 15.0, 0, 0),
        (0.030, 0.0080, 1.0, 0.0080, 4, 2, 400.0, 0, 2),      # no more looks
        (0.030, 0.0200, 2.0, 0.0095, 4, 0, 400.0, 0, 0),
        (0.030, 0.0200, 2.0, 0.0095, 0, 0, 30.0, 0, 0),       # no more time
    ],
)
def test_decisions(monkeypatch, interval, now, scale, then, looks, seen, left_s, periods, after):
    monkeypatch.setattr(enough_room, "look", lambda *_: Look(12.0, now, scale, then, True))
    monkeypatch.setattr(enough_room, "interval_of", lambda *_: interval)
    found = decide(recording(), RULE, PLAN, left_s, looks, seen)
    assert (found.periods, found.seen) == (periods, after)
    assert found.why
    assert found.working_confidence == RULE.working(after)
    assert found.plain()["look"]["half_width_now"] == now
    assert found.interval in (None, interval)


@pytest.mark.parametrize(("interval", "looks", "left_s", "periods", "after"), [
    (0.008, 0, 400.0, 0, 0),
    (0.0105, 0, 900.0, 5, 1),             # six periods at ±1.05 %: (1.05·1.05·1.17)² − 1 = 0.68 times as many more
    (0.0099999, 0, 900.0, 0, 0),
    (0.010001, 0, 900.0, 4, 1),           # the next interim look has a wider quantile
    (0.100, 0, 900.0, 18, 1),             # at most three times all before: the next confidence assumes it
    (0.100, 0, 100.0, 4, 1),              # limited by the time left
    (0.011, 4, 900.0, 0, 0),
    (0.011, 0, 50.0, 0, 0),               # no time for two
    (np.inf, 0, 900.0, 0, 0),
])
def test_without_an_estimate_of_the_scatter_the_interval_decides(monkeypatch, interval, looks, left_s, periods, after):
    monkeypatch.setattr(enough_room, "look", lambda *_: None)
    monkeypatch.setattr(enough_room, "interval_of", lambda *_: interval)
    found = decide(recording(), RULE, PLAN, left_s, looks, 0)
    assert (found.periods, found.seen) == (periods, after)
    assert found.working_confidence == RULE.working(after)
    assert found.why
    assert found.plain()["interval"] == (interval if np.isfinite(interval) else None)


def test_with_a_string_the_scatter_of_a_rigid_shaft_is_not_used(monkeypatch):
    monkeypatch.setattr(enough_room, "look", lambda *_: pytest.fail("looked at"))
    monkeypatch.setattr(enough_room, "interval_of", lambda *_: 0.009)
    found = decide(recording(), replace(RULE, by_interval=True), PLAN, 900.0, 0, 0)
    assert (found.periods, found.interval) == (0, 0.009)


def test_a_few_missing_periods_are_run_at_the_last_mean_speed(monkeypatch):
    monkeypatch.setattr(enough_room, "look", lambda *_: Look(12.0, 0.012, 1.3, 0.0095, True, at_last=True))
    found = decide(recording(), RULE, PLAN, 400.0, 0, 0)
    assert (found.periods, found.at_last, found.seen) == (4, True, 0)
    assert "4 more periods here" in found.why


@pytest.mark.heavy
def test_all_interim_looks_together_keep_the_requested_coverage():
    """Signed roots of data that grow as fast as allowed after a look. An interval misses if its root is too large."""
    rng = np.random.default_rng(3)
    root, missed = rng.standard_normal(400_000), np.zeros(400_000, dtype=bool)
    for seen in range(5):
        missed |= np.abs(root) > norm.ppf(0.5 + 0.5 * spent_confidence(0.95, seen))
        assert RULE.working(seen) > spent_confidence(0.95, seen)
        root = (root + math.sqrt(MOST_BEHIND) * rng.standard_normal(root.size)) / math.sqrt(1.0 + MOST_BEHIND)
    assert 0.047 < np.mean(missed) <= 0.05 + 3.0 * math.sqrt(0.05 * 0.95 / root.size)
    assert pilot_dof(PLAN.with_counted(6)) == 20.0


def test_the_periods_that_fit_leave_room_for_one_extension():
    for time_s in (200.0, 321.0, 600.0):
        counted = counted_in(PLAN, time_s)
        pilot = PLAN.with_counted(counted - 2)
        assert pilot.duration_s + PLAN.extension_s(2) <= time_s
        assert pilot.duration_s + PLAN.extension_s(3) > time_s


# -- the whole of it -----------------------------------------------------------------------------------------


@pytest.mark.heavy
def test_a_run_on_the_simulated_inverter_covers_and_is_as_tight_as_asked():
    found = inverter_runs.run(3, 0.03)
    assert found.covers
    assert found.half <= 0.03

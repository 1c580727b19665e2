"""Each condition of standstill alone, while all others hold."""

from __future__ import annotations

from dataclasses import dataclass

import pytest

from drivers import Mode, PowerState, Sample
from tdhil.runner.standstill import CountsOfNoise, Standstill

AT_REST, SETTLE_S, GAP_S, PERIOD_S = 0.05, 1.5, 0.2, 0.02


@dataclass
class Observed:
    """State of the observer that a test sets."""

    reports_trusted: bool = True
    position_quiet: bool = True
    position_stands: bool = False          # with a position that resolves the standstill speed
    blind_s: float = 0.0
    unseen_s: float = 0.0
    coasts_s: float = 0.0
    by_position: float | None = None
    rest_share: float = 1.0
    doubt: object = None

    def speed_rad_s(self, sample):
        return sample.speed_rad_s if self.by_position is None else self.by_position

    def rest_rad_s(self, at_rest_rad_s):
        return self.rest_share * at_rest_rad_s

    def angle_quiet(self, at_rest_rad_s):
        assert at_rest_rad_s == AT_REST
        return self.position_quiet

    def angle_stands(self, at_rest_rad_s):
        assert at_rest_rad_s == AT_REST
        return self.position_stands


def sample(time_s, speed=0.0, state=PowerState.QUICK_STOP, standstill=True):
    return Sample(time_s, 0.0, 0.0, True, speed, 0.0, None, Mode.SPEED, state, standstill, False, 0x27)


def rested_after(observed, seconds=20.0, **report):
    """Return the time until standstill is found, s, or None if it is not found within ``seconds``."""
    rest = Standstill(observed, AT_REST, SETTLE_S, GAP_S)
    for cycle in range(1, round(seconds / PERIOD_S)):
        if rest.see(sample(cycle * PERIOD_S, **report)):
            return (cycle - 1) * PERIOD_S
    return None


@pytest.mark.parametrize("report", [
    {}, {"speed": 0.9 * AT_REST}, {"speed": -0.9 * AT_REST},
    *({"state": state, "standstill": False} for state in (PowerState.OFF, PowerState.READY, PowerState.FAULT)),
    {"state": PowerState.ENABLED},
])
def test_all_conditions_hold(report):
    assert rested_after(Observed(), **report) == pytest.approx(SETTLE_S, abs=2.0 * PERIOD_S)


@pytest.mark.parametrize("report", [
    {"speed": 1.1 * AT_REST}, {"speed": -1.1 * AT_REST}, {"speed": float("nan")}, {"speed": float("inf")},
    *({"state": state, "standstill": False}
      for state in (PowerState.ENABLED, PowerState.QUICK_STOP, PowerState.NOT_READY, PowerState.UNKNOWN)),
])
def test_a_report_that_shows_none(report):
    assert rested_after(Observed(), **report) is None


@pytest.mark.parametrize("observed", [
    Observed(reports_trusted=False), Observed(position_quiet=False), Observed(by_position=1.0),
])
def test_an_observer_that_shows_no_standstill(observed):
    assert rested_after(observed) is None


def test_a_position_that_replaces_a_speed_in_doubt():
    assert rested_after(Observed(by_position=0.0), speed=4.0) is not None


@pytest.mark.parametrize("observed", [
    Observed(blind_s=4.0), Observed(unseen_s=4.0), Observed(blind_s=3.0, unseen_s=4.0),
])
def test_the_watch_lasts_as_long_as_the_observer_requires(observed):
    assert rested_after(observed) == pytest.approx(4.0, abs=2.0 * PERIOD_S)


def test_an_observer_that_requires_less_does_not_shorten_the_watch():
    assert rested_after(Observed(blind_s=0.1, unseen_s=0.1)) == pytest.approx(SETTLE_S, abs=2.0 * PERIOD_S)


def test_a_shaft_that_may_still_coast_is_not_at_standstill():
    assert rested_after(Observed(coasts_s=0.1)) is None


def at_seconds(seconds, *reports):
    """Return the time at which standstill is found; `(time, sample)`: other samples in between."""
    rest, others = Standstill(Observed(), AT_REST, SETTLE_S, GAP_S), dict(reports)
    for cycle in range(1, round(seconds / PERIOD_S)):
        one = others.get(cycle, sample(cycle * PERIOD_S))
        if one is not None and rest.see(one):
            return cycle * PERIOD_S
    return None


def test_one_sample_in_motion_restarts_the_time():
    assert at_seconds(4.0, (50, sample(1.0, speed=0.2))) == pytest.approx(1.0 + SETTLE_S, abs=3.0 * PERIOD_S)


def rests_with(every, factor, observed=None):
    """Return whether standstill is found within 10 s if every ``every``-th sample shows a multiple of its speed."""
    rest = Standstill(observed or Observed(), AT_REST, SETTLE_S, GAP_S)
    return any(rest.see(sample(cycle * PERIOD_S, speed=factor * AT_REST * (cycle % every == 0)))
               for cycle in range(1, 500))


@pytest.mark.parametrize(("every", "factor", "rests"), [
    (20, 1.05, True), (20, -1.9, True), (11, 1.05, True),
    (20, 2.1, False),                  # too large for a count of noise
    (9, 1.05, False), (2, 1.05, False), (1, 1.05, False),      # too often
])
def test_single_counts_of_noise_do_not_hide_standstill(every, factor, rests):
    assert rests_with(every, factor) is rests


@pytest.mark.parametrize(("every", "rests"), [(20, True), (9, False)])
def test_a_constant_position_shows_that_a_larger_count_is_noise(every, rests):
    assert rests_with(every, 3.0, Observed(position_stands=True)) is rests


@pytest.mark.parametrize("observed", [
    Observed(doubt="speed"), Observed(position_quiet=False), Observed(doubt="speed", position_stands=True),
])
def test_after_a_contradiction_or_with_a_position_that_moves_no_count_is_noise(observed):
    assert not rests_with(20, 1.05, observed)


def test_a_count_of_noise_itself_is_no_standstill():
    last = round(SETTLE_S / PERIOD_S) + 1                       # the sample that would end it
    seen_s = at_seconds(4.0, (last, sample(last * PERIOD_S, speed=1.05 * AT_REST)))
    assert seen_s == pytest.approx((last + 1) * PERIOD_S)


def test_a_sample_at_standstill_counts_after_a_contradiction_or_many_counts():
    for observed, counts in ((Observed(doubt="speed"), 0), (Observed(), 50)):
        noise = CountsOfNoise(observed, AT_REST)
        for _ in range(counts):
            noise.explains(1.05 * AT_REST, quiet=False)
        assert noise.explains(0.0, quiet=True)
        assert not noise.explains(1.05 * AT_REST, quiet=False)


def test_a_single_lost_frame_does_not_hide_standstill():
    assert at_seconds(4.0, (50, None)) == pytest.approx(SETTLE_S, abs=3.0 * PERIOD_S)


def test_a_longer_gap_shows_no_standstill():
    lost = [(cycle, None) for cycle in range(50, 65)]
    assert at_seconds(4.0, *lost) == pytest.approx(65 * PERIOD_S + SETTLE_S, abs=3.0 * PERIOD_S)


def test_a_last_sample_without_standstill_state_extends_the_wait():
    """The time at standstill counts. The state must show standstill in the last sample."""
    shown = {"state": PowerState.UNKNOWN, "standstill": False}
    unknown = [(cycle, sample(cycle * PERIOD_S, **shown)) for cycle in range(60, 100)]
    assert at_seconds(4.0, *unknown) == pytest.approx(100 * PERIOD_S, abs=2.0 * PERIOD_S)


def test_a_doubt_at_standstill_cancels_it():
    observed = Observed()
    rest = Standstill(observed, AT_REST, SETTLE_S, GAP_S)
    for cycle in range(1, 60):
        assert not rest.see(sample(cycle * PERIOD_S))
    observed.reports_trusted = False
    assert not rest.see(sample(60 * PERIOD_S))
    observed.reports_trusted = True
    seen = [cycle for cycle in range(61, 200) if rest.see(sample(cycle * PERIOD_S))]
    assert seen[0] * PERIOD_S == pytest.approx(61 * PERIOD_S + SETTLE_S, abs=3.0 * PERIOD_S)

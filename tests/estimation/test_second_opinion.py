"""Momentum cross-checks: each covers with its own interval, rarely disagrees by chance, and finds errors."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import binom

from tdhil.estimation import Compliant, Estimate, Options
from tdhil.estimation.case import Case, Finding
from tdhil.estimation.cross_checks.momentum import BalanceKind, balances, through
from tdhil.estimation.cross_checks.momentum_fit import Delay, Density, Resolution, fit_momentum
from tdhil.estimation.cross_checks.second_opinion import disagreements, second_opinions
from tdhil.estimation.friction_levels import measure_levels
from tdhil.estimation.samples import Samples, stretches, usable_samples
from tdhil.estimation.setpoint_sampling import EXACT_READING, ReadingShare
from tdhil.estimation.spectrum import period_lines
from tdhil.recording.recording import Recording
from tdhil.runner.excitation import PlanRequest
from tests.estimation.planned_motions import planned
from tests.estimation.shaft_bench import Rig, simulate
from tests.estimation.stages_bench import Stages, run_stages, ten_runs, usual_runs

pytestmark = pytest.mark.one_worker("friction")     # both use the same runs

TRUE = 104.0


def around(value, half):
    return Estimate(value, value - half, value + half)


def result(inertia=TRUE, half=0.45, delay=0.25, delay_sd=0.018):
    """Return a result of the lines. ``delay`` None: unknown lags."""
    lag = None if delay is None else around(delay, 1.96 * delay_sd)
    zero = None if delay is None else around(0.0, 0.0)
    return Finding(inertia=around(inertia, half), speed_lag_s=lag, torque_lag_s=zero, skew_s=zero)


def levels_of(recording, samples):
    cut = stretches(samples, recording.excitation.segments)
    fits = tuple(period_lines(stretch, samples) for stretch in cut)
    return measure_levels(cut, fits, samples, recording.levels, TRUE)


def opinions_of(recording, found=None, levels=True):
    samples = usable_samples(recording)
    own = levels_of(recording, samples) if levels else None
    return second_opinions(Case(recording, Options(), samples=samples, levels=own), found or result())


@pytest.fixture(scope="module")
def usual():
    """Return per route (seeds, 4): value, low, high, agrees. J and delay have their stated uncertainty."""
    rng = np.random.default_rng(5)
    rows = {}
    for recording in usual_runs():
        j, delay = TRUE + 0.23 * rng.standard_normal(), 0.25 + 0.018 * rng.standard_normal()
        for opinion in opinions_of(recording, result(j, 1.96 * 0.23, delay)):
            e = opinion.inertia_kg_m2
            rows.setdefault(opinion.route, []).append((e.value, e.low, e.high, opinion.agrees))
    return {route: np.array(found, dtype=float) for route, found in rows.items()}


@pytest.mark.heavy
@pytest.mark.parametrize("route", ["speed change", "coast-down"])
def test_each_interval_covers(usual, route):
    found = usual[route]
    assert len(found) == len(usual_runs())
    covered = int(np.sum((found[:, 1] <= TRUE) & (found[:, 2] >= TRUE)))
    assert covered >= binom.ppf(0.005, len(found), 0.95)
    error = found[:, 0] - TRUE
    assert abs(error.mean()) <= 0.2 + 3.0 * error.std() / math.sqrt(len(error))
    # neither too wide nor far from the true scatter
    half = 0.5 * (found[:, 2] - found[:, 1])
    assert 1.6 < half.mean() / error.std() < 3.0
    assert half.mean() < 0.04 * TRUE


@pytest.mark.heavy
def test_the_lags_are_as_uncertain_at_any_confidence():
    """The half-width of a 50 % interval is not 1.96 standard uncertainties. The delay used to count as too certain."""
    recording = usual_runs()[0]
    samples = usable_samples(recording)
    levels = levels_of(recording, samples)
    half = {}
    for confidence, quantile in ((0.95, 1.95996), (0.5, 0.67449)):
        found = Finding(inertia=around(TRUE, 0.23 * quantile), speed_lag_s=around(0.25, 0.2 * quantile),
                        torque_lag_s=around(0.0, 0.0), skew_s=around(0.0, 0.0))
        case = Case(recording, Options(confidence=confidence), samples=samples, levels=levels)
        estimate = second_opinions(case, found)[0].inertia_kg_m2
        half[confidence] = 0.5 * (estimate.high - estimate.low) / quantile
    assert half[0.5] == pytest.approx(half[0.95], rel=0.05)


@pytest.mark.heavy
def test_disagreement_by_chance_comes_once_in_a_hundred_runs(usual):
    said_no = sum((found[:, 3] == 0.0).astype(int) for found in usual.values())
    runs = len(usual_runs())
    assert np.sum(said_no > 0) <= binom.ppf(0.995, runs, 0.01)


@pytest.mark.heavy
@pytest.mark.parametrize("runs", [8, pytest.param(60, marks=pytest.mark.long)])
def test_without_knowing_the_lags_it_is_wider_and_still_covers(runs):
    recordings = usual_runs()[:runs]
    known = [opinions_of(r)[0].inertia_kg_m2 for r in recordings]
    unknown = [opinions_of(r, result(delay=None))[0].inertia_kg_m2 for r in recordings]
    assert all(u.high - u.low > k.high - k.low for u, k in zip(unknown, known, strict=True))
    assert sum(e.low <= TRUE <= e.high for e in unknown) >= binom.ppf(0.005, runs, 0.95)


@pytest.mark.parametrize("runs", [pytest.param(20, marks=pytest.mark.heavy), pytest.param(60, marks=pytest.mark.long)])
def test_without_excited_segments_the_rows_give_the_scatter(runs):
    """The recording has no operating points, lags or results, as after a refusal or in a foreign trace."""
    nothing = replace(result(delay=None), inertia=None)
    covered = 0
    for recording in usual_runs()[:runs]:
        first, *_ = opinions_of(replace(recording, excitation=None), nothing, levels=False)
        assert first.agrees is None
        covered += first.inertia_kg_m2.low <= TRUE <= first.inertia_kg_m2.high
        assert disagreements((first,), nothing) == ()
    assert covered >= binom.ppf(0.005, runs, 0.95)


@pytest.mark.heavy
def test_a_result_that_is_wrong_is_contradicted():
    recording = ten_runs()[0]
    wrong = result(1.15 * TRUE)
    opinions = opinions_of(recording, wrong)
    assert [opinion.agrees for opinion in opinions] == [False, False]
    warnings = disagreements(opinions, wrong)
    assert len(warnings) == 2
    assert "does not agree" in warnings[0]
    assert "119.6" in warnings[0]


@pytest.mark.heavy
def test_unreported_torque_is_found_by_the_coast_down():
    """The true torque brakes with 10 N·m while the drive reports none."""
    hidden = run_stages(Stages(coast=True, coast_torque=-10.0), list(range(8)))
    verdicts = [{o.route: o.agrees for o in opinions_of(recording)} for recording in hidden]
    assert sum(v["coast-down"] is False for v in verdicts) >= 6
    assert sum(v["speed change"] is True for v in verdicts) >= 6


def test_a_compliant_shaft_is_compared_with_its_total_inertia():
    recording = ten_runs()[1]
    motor_only = result(80.0)
    whole = Compliant(around(TRUE, 0.5), around(24.0, 1.0), None, None, None, None)
    assert {o.agrees for o in opinions_of(recording, motor_only)} == {False}
    assert {o.agrees for o in opinions_of(recording, replace(motor_only, compliant=whole))} == {True}


@pytest.mark.heavy
def test_plateaus_of_a_square_wave_are_torque_steps():
    motion, _ = planned(PlanRequest(kind="step", periods=3))
    found = []
    for recording in simulate(Rig(), motion, list(range(12)), rate_hz=100.0):
        opinions = opinions_of(recording)
        assert [o.route for o in opinions] == ["torque steps"]
        found.append(opinions[0].inertia_kg_m2)
    assert sum(e.low <= TRUE <= e.high for e in found) >= 10
    assert np.mean([e.high - e.low for e in found]) < 0.08 * TRUE


@pytest.mark.parametrize(("speed_lags", "torque_lags"), [((0.4,), (0.15,)), ((0.2, 0.2), (0.15,)), ((), (0.1, 0.2))])
def test_a_balance_between_steady_states_depends_on_the_delay_of_the_reports_only(speed_lags, torque_lags):
    """The balance from 2 to 6 rad/s on a half cosine without noise closes for any filters if B δ is included."""
    dt = 0.002
    time = np.arange(0.0, 20.0, dt)
    u = np.clip((time - 6.0) / 4.0, 0.0, 1.0)
    speed = 4.0 - 2.0 * np.cos(np.pi * u)
    torque = TRUE * np.gradient(speed, dt) + 8.0 * speed + 60.0

    def keep(lag):
        return math.exp(-dt / lag)

    def lagged(x, lags):
        for lag in lags:
            x = lfilter([1.0 - keep(lag)], [1.0, -keep(lag)], x - x[0]) + x[0]
        return x

    def delay_of(lags):
        """Return the delay of these discrete filters: Σ n keepⁿ / Σ keepⁿ steps."""
        return sum(dt * keep(lag) / (1.0 - keep(lag)) for lag in lags)

    row = through(Samples(time, lagged(speed, speed_lags), lagged(torque, torque_lags)), 2.0, 18.0, 1.0)
    delay = delay_of(speed_lags) - delay_of(torque_lags)
    b_part = 8.0 * (row.travel_rad + delay * row.change_rad_s)
    assert (row.impulse_nm_s - b_part - 60.0 * row.time_s) / row.change_rad_s == pytest.approx(TRUE, rel=2e-5)
    assert row.change_rad_s == pytest.approx(4.0, abs=1e-4)
    assert row.energy_s == pytest.approx(14.0 + 2.0 / 3.0)


def test_a_coarse_speed_widens_the_interval():
    recording = ten_runs()[2]
    coarse = replace(
        recording, speed_rad_s=np.round(recording.speed_rad_s / 0.3) * 0.3, speed_resolution_rad_s=0.3
    )
    fine_half, coarse_half = (
        0.5 * (o.inertia_kg_m2.high - o.inertia_kg_m2.low) for o in (opinions_of(recording)[0], opinions_of(coarse)[0])
    )
    assert coarse_half > 1.5 * fine_half


def test_the_same_record_gives_the_same_bits():
    recording = ten_runs()[3]
    assert opinions_of(recording) == opinions_of(recording)


def record(time, speed, torque):
    n = len(time)
    return Recording(np.asarray(time, float), np.asarray(speed, float), np.asarray(torque, float),
                     np.ones(n, bool), np.zeros(n, bool))


def test_without_data_there_is_no_cross_check_and_no_exception():
    time = np.arange(0.0, 40.0, 0.01)
    rng = np.random.default_rng(1)
    ramp = np.clip(time - 15.0, 0.0, 4.0)
    signals = {
        "rest": 0.0 * time, "steady": 3.0 + 0.0 * time, "noise": rng.standard_normal(len(time)), "ramp": 2.0 + ramp,
        "huge": 1e300 * np.ones(len(time)), "reversing": np.sin(time),
    }
    stamps = (time, time[::-1].copy(), np.zeros(len(time)), time * 1e9, time[:12])
    for (name, speed), (_, torque), stamp in itertools.product(signals.items(), signals.items(), stamps):
        recording = record(stamp, speed[: len(stamp)], torque[: len(stamp)])
        samples = Samples(recording.time_s, recording.speed_rad_s, recording.torque_nm)
        with np.errstate(all="ignore"):
            opinions = second_opinions(Case(recording, Options(), samples=samples), result())
        if name != "ramp":
            assert opinions == ()
        assert all(math.isfinite(o.inertia_kg_m2.high) and o.inertia_kg_m2.value > 0.0 for o in opinions)


def test_torque_read_in_step_with_a_speed_setpoint_is_a_separate_unknown():
    """J is too large by a share in rows with a changing speed setpoint, as at 15 cycles per second."""
    plainly, openly = [], []
    for recording in ten_runs():
        found = balances(recording, usable_samples(recording))
        rows = tuple(
            replace(row, stepped_rad_s=row.change_rad_s, impulse_nm_s=row.impulse_nm_s + 0.08 * TRUE * row.change_rad_s)
            if row.second.end_s < 24.0 else replace(row, stepped_rad_s=0.0) for row in found.rows
        )
        assert any(abs(row.change_rad_s) > 3.0 for row in rows if row.stepped_rad_s)
        read = replace(found, rows=rows)
        known, rounding = Delay(0.25, 0.018, True), Resolution(0.0, 0.0)
        plain, open_share, taken_out = (
            fit_momentum(read, BalanceKind.TURNING, Density(10.0, 18.0), known, rounding, 0.95, share)
            for share in (EXACT_READING, ReadingShare(0.0, 0.08), ReadingShare(0.08, 0.0))
        )
        assert taken_out.inertia == pytest.approx(
            fit_momentum(found, BalanceKind.TURNING, Density(10.0, 18.0), known, rounding, 0.95).inertia, abs=0.2)
        assert plain.inertia - TRUE > 0.02 * TRUE
        assert abs(open_share.inertia - TRUE) <= open_share.half_width
        plainly.append(plain.inertia)
        openly.append(open_share.inertia)
    assert abs(np.mean(openly) - TRUE) < 0.5 * (np.mean(plainly) - TRUE)

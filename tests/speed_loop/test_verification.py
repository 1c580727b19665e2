"""Steps compared with their prediction: python-control computes the responses, this file lag and noise."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.special import stdtrit

from tdhil.speed_loop import (
    LoopPlant,
    PiGains,
    Range,
    SpeedLoopCase,
    SpringLoad,
    StepCase,
    StepOutcome,
    StepProgram,
    StepRecord,
    UncertainPlant,
    design_speed_loop,
    step_case_of,
    step_length_s,
    step_pairs,
    verification,
    verify_record,
    verify_steps,
)
from tests.speed_loop.by_control import step as by_control

PERIOD_S = 0.02
PLANT = UncertainPlant(Range(104.0, 99.7, 108.1), Range(8.0, 7.6, 8.4),
                       (Range(0.02, 0.018, 0.022), Range(0.01, 0.009, 0.011)), Range(0.003, 0.0015, 0.0045))
ROW = design_speed_loop(SpeedLoopCase(PLANT, bandwidth_hz=2.0)).tuned
CASE = StepCase("tuned", PLANT, ROW.gains, ROW.overshoot_share, ROW.rise_s, ROW.settling_s, Range(0.3, 0.29, 0.31),
                "tune.json")
PROGRAM = StepProgram(4.0, 4.2, round(step_length_s(CASE) / PERIOD_S) * PERIOD_S, 16)
COUNTS = 10
NOISY = 0.1     # standard deviation of a step, as a share of it: 16 pairs are too few
ROUNDED = replace(PROGRAM, dither_rad_s=(PROGRAM.high_rad_s - PROGRAM.low_rad_s) / COUNTS)
PARAMETERS = pytest.mark.parametrize(("proportional", "integral"), [(1.3, 1.0), (0.7, 0.7)])


def responses(gains: PiGains, noise: float = 0.02, lag_s: float = 0.3, ramp_s: float = 0.0, seed: int = 1,
              plant: LoopPlant = PLANT.believed, program: StepProgram = PROGRAM, period_s: float = PERIOD_S):
    """Return the reported response in each pair: true plant, lag, one cycle of delay, optional ramp, noise."""
    rng = np.random.default_rng(seed)
    fine = 0.002
    time_s = fine * np.arange(round(2.0 * program.half_s / fine))
    speed = by_control(plant, gains, time_s)
    if ramp_s:
        width = round(ramp_s / fine)
        speed = np.convolve(np.r_[np.zeros(width), speed], np.ones(width) / width)[width:][:len(time_s)]
    lagged = np.zeros_like(speed)
    for k in range(1, len(speed)):
        lagged[k] = lagged[k - 1] + (1.0 - np.exp(-fine / lag_s)) * (0.5 * (speed[k] + speed[k - 1]) - lagged[k - 1])
    every = round(period_s / fine)
    seen = np.r_[0.0, lagged[::every]][:-1]
    count = round(program.half_s / period_s) - 1
    one = seen[:count] + 1.0 - seen[round(program.half_s / period_s):][:count]
    return one + noise * rng.standard_normal((program.pairs, count)) / np.sqrt(2.0)


def rounded(gains: PiGains, noise_counts: float, to=np.round, seed: int = 1):
    """Return the reported response in each pair of a drive that rounds its speed. Its set speeds are whole counts."""
    rng = np.random.default_rng(seed)
    counts = COUNTS * responses(gains, noise=0.0)[0]
    halves = [to(sign * counts + noise_counts * rng.standard_normal((ROUNDED.pairs, len(counts)))) for sign in (1, -1)]
    return 0.5 * (halves[0] - halves[1]) / COUNTS


def found(pairs, program=PROGRAM, **said):
    return verify_steps(CASE, pairs, program, PERIOD_S, **said)


def test_typed_gains_agree_and_their_intervals_cover_the_truth():
    result = found(responses(CASE.gains))
    assert result.outcome is StepOutcome.AGREES, result.reason
    rows = {row.name: row for row in result.rows}
    for name, true in (("gain_nm_s_rad", CASE.gains.gain_nm_s_rad), ("integral_nm_rad", CASE.gains.integral_nm_rad),
                       ("overshoot_share", ROW.overshoot_share.value), ("rise_s", ROW.rise_s.value)):
        assert rows[name].measured.low <= true <= rows[name].measured.high, name
    assert rows["gain_nm_s_rad"].measured.high < 1.25 * CASE.gains.gain_nm_s_rad


@pytest.mark.heavy(but_first=1)
@pytest.mark.parametrize("first_s", [0.0001, 0.015, 0.0299])
def test_typed_gains_agree_for_each_split_of_a_measured_sum_of_lags(first_s):
    """With the split of the best estimate alone, P seemed 0.84 to 1.20 times the typed value, and most differed."""
    sum_s, period_s = 0.03, 0.01
    plant = replace(PLANT, lags_s=(Range(0.028, 0.0, sum_s), Range(0.002, 0.0, sum_s)),
                    dead_time_s=Range(0.0, 0.0, 0.0), lag_sum_s=Range(sum_s, 0.98 * sum_s, 1.02 * sum_s))
    row = design_speed_loop(SpeedLoopCase(plant)).tuned
    case = StepCase("tuned", plant, row.gains, row.overshoot_share, row.rise_s, row.settling_s,
                    Range(0.005, 0.0049, 0.0051))
    program = StepProgram(4.0, 4.2, round(step_length_s(case) / period_s) * period_s, 30)
    truth = LoopPlant(104.0, 8.0, (first_s, sum_s - first_s))
    pairs = responses(row.gains, noise=0.003, lag_s=0.005, plant=truth, program=program, period_s=period_s)
    result = verify_steps(step_case_of(case.plain()), pairs, program, period_s)
    assert result.outcome is StepOutcome.AGREES, result.reason
    assert result.rows[3].measured.value == pytest.approx(row.gains.gain_nm_s_rad, rel=0.02)
    wrong = PiGains(1.3 * row.gains.gain_nm_s_rad, row.gains.integral_nm_rad)
    pairs = responses(wrong, noise=0.003, lag_s=0.005, plant=truth, program=program, period_s=period_s)
    assert verify_steps(case, pairs, program, period_s).outcome is StepOutcome.DIFFERS


@pytest.mark.heavy(but_first=1)
@PARAMETERS
def test_gains_with_an_error_of_30_percent_differ_and_are_named(proportional, integral):
    wrong = PiGains(proportional * CASE.gains.gain_nm_s_rad, integral * CASE.gains.integral_nm_rad)
    result = found(responses(wrong))
    assert result.outcome is StepOutcome.DIFFERS
    assert "P is" in result.reason or "I is" in result.reason
    gain = result.rows[3].measured
    assert gain.low <= wrong.gain_nm_s_rad <= gain.high


@pytest.mark.parametrize("to", [np.round, pytest.param(np.floor, marks=pytest.mark.heavy)])
def test_gains_are_unbiased_where_the_report_is_rounded_to_tenths_of_the_step(to):
    # Without the rounding in the model, I is 1.3 times too large: the tail below half a count is not reported.
    errors = []
    for seed in range(1, 5):
        *_, proportional, integral = found(rounded(CASE.gains, 0.15, to, seed), ROUNDED).rows
        for row in (proportional, integral):
            assert row.within, (row, seed)
        errors.append(integral.measured.value / CASE.gains.integral_nm_rad - 1.0)
    assert abs(np.mean(errors)) < 0.03, errors


@pytest.mark.parametrize("to", [np.round, pytest.param(np.floor, marks=pytest.mark.heavy)])
def test_steps_that_are_all_rounded_alike_give_no_result(to):
    for seed in range(1, 4):
        result = found(rounded(CASE.gains, 0.01, to, seed), ROUNDED)
        assert result.outcome is StepOutcome.CANNOT_TELL, seed
    assert "rounded alike" in result.reason or "30 %" in result.reason


@pytest.mark.heavy
def test_slow_noise_is_weighted_by_its_spectrum():
    """Noise of 0.5 s correlation time: with equal weights of all samples, the intervals of I are 1.5 times as wide."""
    widths = []
    for seed in (1, 3, 5):
        rng = np.random.default_rng(seed)
        pairs = responses(CASE.gains, noise=0.005, seed=seed)
        slow, keep = np.zeros(pairs.shape), np.exp(-PERIOD_S / 0.5)
        for at in range(1, pairs.shape[1]):
            slow[:, at] = keep * slow[:, at - 1] + 0.03 * np.sqrt(1.0 - keep**2) * rng.standard_normal(len(pairs))
        *_, proportional, integral = found(pairs + slow).rows
        assert proportional.within and integral.within, seed
        widths.append(integral.measured.high / integral.measured.low)
    assert np.mean(widths) < 3.1, widths          # 4.1 with equal weights


def test_noise_that_hides_30_percent_is_no_agreement():
    assert found(responses(CASE.gains, noise=0.6)).outcome is StepOutcome.CANNOT_TELL


@pytest.mark.heavy
def test_a_ramp_of_the_set_speed_is_no_agreement():
    assert found(responses(CASE.gains, noise=0.002, ramp_s=1.0)).outcome is StepOutcome.DIFFERS


def test_a_response_of_no_gains_at_all_is_named():
    pairs = responses(CASE.gains, noise=0.002)
    vibration = 0.08 * np.sin(2.0 * np.pi * 3.0 * PERIOD_S * np.arange(pairs.shape[1]))
    result = found(pairs + vibration)
    assert result.outcome is StepOutcome.DIFFERS and "a ramp, a filter or another resonance" in result.reason


def test_a_response_that_a_fit_explains_by_a_delay_beyond_its_end_is_judged():
    count = round(PROGRAM.half_s / PERIOD_S) - 1
    grown = np.sin(np.arange(count)) * np.exp(0.02 * np.arange(count))
    assert found(np.tile(grown, (PROGRAM.pairs, 1))).outcome is StepOutcome.DIFFERS
    late = np.zeros(11)
    late[6] = 1e4
    model = verification.StepModel(CASE, PROGRAM, PERIOD_S, count, 0.0, 0.0)
    assert model.reported(late) == pytest.approx(np.ones(count))


def test_an_active_limit_or_too_few_pairs_give_no_result():
    pairs = responses(CASE.gains)
    assert found(pairs, limited=True).outcome is StepOutcome.CANNOT_TELL
    assert found(pairs[:5]).outcome is StepOutcome.CANNOT_TELL
    assert found(pairs[:0]).outcome is StepOutcome.CANNOT_TELL


def test_the_case_is_restored_from_the_log():
    assert step_case_of(json.loads(json.dumps(CASE.plain()))) == CASE
    with pytest.raises((KeyError, TypeError)):
        step_case_of({"plant": {}})


def test_a_coupling_above_the_excited_lines_does_not_bias_the_gains():
    """J is known, and 40 % of it is behind a coupling that the result does not have."""
    rigid, low_hz = PLANT.believed, 8.0 * CASE.gains.gain_nm_s_rad / (2.0 * np.pi * 104.0)
    coupled = replace(rigid, inertia_kg_m2=0.6 * 104.0, spring=SpringLoad(low_hz, low_hz / np.sqrt(0.6), 80.0))
    result = found(responses(CASE.gains, noise=0.003, plant=coupled))
    rows = {row.name: row for row in result.rows}
    for name, true in (("gain_nm_s_rad", CASE.gains.gain_nm_s_rad), ("integral_nm_rad", CASE.gains.integral_nm_rad)):
        assert rows[name].measured.low < true < rows[name].measured.high
        assert rows[name].measured.value == pytest.approx(true, rel=0.06)
    assert result.misfit_p > 0.01


def test_the_fit_from_the_prediction_counts_if_the_other_one_ends_in_another_minimum(monkeypatch):
    """Seed 100113 of `benchmarks/speed_loop_verify.py`: the fit of the whole response led to these parameters."""
    whole = verification._fitted
    elsewhere = np.array([-0.23, -0.26, -6.02, 6.48, 5.36, 0.12, 1.26, 0.22, 3.73, 0.05, -0.33])

    def fitted(model, mean, whiten, theta):
        found, slopes = whole(model, mean, whiten, theta)
        return (elsewhere, slopes) if len(ended) < 2 else (found, slopes)

    ended = []
    monkeypatch.setattr(verification, "_fitted", lambda *known: (fitted(*known), ended.append(known))[0])
    result = found(responses(CASE.gains))
    assert len(ended) == 3 and result.outcome is StepOutcome.AGREES, result.reason


def test_too_few_pairs_state_how_many_are_needed_and_these_are_enough():
    wide = found(responses(CASE.gains, noise=NOISY))
    assert wide.outcome is StepOutcome.CANNOT_TELL and wide.needed_pairs is not None
    assert 1.25 * PROGRAM.pairs <= wide.needed_pairs < 4 * PROGRAM.pairs
    rng = np.random.default_rng(7)
    one = responses(CASE.gains, noise=0.0)[0]
    more = one + NOISY * rng.standard_normal((wide.needed_pairs, len(one))) / np.sqrt(2.0)
    enough = found(more, replace(PROGRAM, pairs=wide.needed_pairs))
    assert enough.outcome is StepOutcome.AGREES and enough.needed_pairs is None


def test_no_number_of_pairs_helps_where_a_limit_acted():
    assert found(responses(CASE.gains, noise=NOISY), limited=True).needed_pairs is None


@pytest.mark.heavy
def test_a_record_gives_the_pairs_of_its_whole_steps():
    program = replace(PROGRAM, pairs=9)
    time_s = PERIOD_S * np.arange(round(program.duration_s / PERIOD_S) + 1)
    halves = np.minimum(np.floor(time_s / program.half_s + 1e-9).astype(int), 2 * program.pairs + 1)
    speed = np.where(halves % 2 == 0, program.high_rad_s, program.low_rad_s)
    starts = [program.half_s * k for k in range(2 * (program.pairs + 1))]
    limited = time_s < 0.0
    record = StepRecord(time_s, speed, ~limited, limited, starts, PERIOD_S)
    assert verify_record(CASE, program, record).pairs == program.pairs
    at_end = replace(record, time_s=time_s[:-1], speed_rad_s=speed[:-1], fresh=~limited[:-1], limited=limited[:-1])
    assert verify_record(CASE, program, at_end).pairs == program.pairs     # as in the run after its last step
    short = replace(record, time_s=time_s[:-9], speed_rad_s=speed[:-9], fresh=~limited[:-9], limited=limited[:-9])
    assert verify_record(CASE, program, short).pairs == program.pairs - 1
    acted = verify_record(CASE, program, replace(record, limited=time_s > 5.0))
    assert acted.reason == "an internal limit of the drive acted during the steps"


def test_pairs_are_free_of_offset_and_drift_and_the_first_is_dropped():
    program = replace(PROGRAM, dither_rad_s=0.01)
    time_s = PERIOD_S * np.arange(round(program.duration_s / PERIOD_S) + 1)
    half = np.floor(time_s / program.half_s + 1e-9).astype(int)
    uppers = np.array([program.speeds_rad_s(pair) for pair in range(program.pairs + 1)]).reshape(-1)
    assert np.ptp(uppers[::2]) > 0.8 * 0.01                 # the parts of a count are spread
    speed = uppers[np.minimum(half, len(uppers) - 1)] + 0.3 + 1e-4 * time_s
    starts = [program.half_s * k for k in range(2 * (program.pairs + 1))]
    pairs = step_pairs(time_s, speed, starts, program, PERIOD_S)
    assert len(pairs) == program.pairs
    np.testing.assert_allclose(pairs, 1.0 - 0.5 * 1e-4 * program.half_s / program.step_rad_s, atol=1e-9)


def test_if_the_response_excludes_all_draws_the_likeliest_ones_count():
    """One draw alone would give figures without a width."""
    kept = verification._possible(np.zeros(2), np.eye(2), lambda one: 1e6 * float(one @ one), 1.0)
    away = np.linalg.norm(kept, axis=1)
    assert len(kept) == 1 + verification._LEAST_KEPT
    assert away[0] == 0.0 and np.all(np.diff(away) >= 0.0)
    assert away[-1] < 1.0      # 40 % of a normal distribution of two parameters


def test_the_intervals_of_all_rows_have_the_confidence_of_p_and_i():
    """Rise time and overshoot of random draws have Student's interval like P and I, for joint coverage of all rows."""
    widths = []
    for number in (8, 60):
        factor = float(stdtrit(number - 1, 1.0 - verification._TAIL))
        wider = (factor / verification._REACH) ** 2
        draws = verification._possible(np.zeros(2), wider * np.eye(2), lambda one: 0.0, 1.0)
        low, high = np.quantile([one[0] for one in draws], (verification._TAIL, 1.0 - verification._TAIL))
        widths.append(0.5 * (high - low) / factor)
    assert widths == [pytest.approx(widths[0])] * 2 and 0.85 < widths[0] < 1.15

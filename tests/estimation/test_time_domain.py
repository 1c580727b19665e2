"""Records without periodic excitation: the interval covers, and unsuitable records are refused with a reason."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from tdhil.estimation import Options, ResidualTest, Verdict, identify
from tdhil.estimation.frequency_domain import Fit
from tdhil.estimation.result import Estimate
from tdhil.estimation.samples import Samples, usable_samples
from tdhil.estimation.time_domain import fit as fitting
from tdhil.estimation.time_domain import solve as solving
from tdhil.estimation.time_domain.equation import PARAMETERS, SPEED_LAG, TORQUE_LAG, evaluate
from tdhil.estimation.time_domain.fit import search
from tdhil.estimation.time_domain.solve import solve
from tdhil.estimation.time_domain.taylor import flat_top
from tdhil.estimation.time_domain.windows import OneWayStretch, joined, measure, place_windows, runs, thinned
from tdhil.recording.recording import LagPrior
from tdhil.studies.coverage import plants
from tdhil.studies.coverage.simulate import simulate as simulate_plan
from tests.estimation.record_bench import FIELD, HEAVY, MOTIONS, SERVO, Machine, Reading, Report, simulate

pytestmark = pytest.mark.one_worker


def found(recording, **options):
    return identify(replace(recording, excitation=None), Options(**options))


def quiet(machine):
    return replace(machine, load_sd=0.0, ripple_sd=0.0, sensor_sd=0.0, speed_noise=0.0, torque_noise=0.0,
                   speed_quantum=1e-9, torque_quantum=1e-9)


def bins_of(recording):
    return joined([measure(window) for window in windows_of(recording)])


def windows_of(recording):
    return place_windows(runs(thinned(usable_samples(recording)), recording.speed_resolution_rad_s, 2.5))


@pytest.fixture(scope="module")
def steps():
    return simulate(FIELD, "speed steps", [1])[0]


# -- the equations -------------------------------------------------------------------------------------------


def test_without_noise_the_true_values_solve_every_bin():
    recording = simulate(quiet(FIELD), "ramp + coast", [1])[0]
    bins = bins_of(recording)
    truth = np.zeros(PARAMETERS)
    truth[:5], truth[7:9] = (104.0, 8.0, 0.40, 0.15, 0.0), (60.0, -60.0)
    low = bins.hertz < 0.5
    error = np.abs(evaluate(truth, bins).error[low])
    assert np.max(error) < 1e-3 * np.max(np.abs(bins.torque[low, 0]))
    wrong = truth.copy()
    wrong[0] *= 1.02
    assert np.sum(np.abs(evaluate(wrong, bins).error[low]) ** 2) > 20.0 * np.sum(error**2)


def test_a_bin_is_the_integral_through_the_window_at_every_frequency(steps):
    window = windows_of(steps)[0]
    part, bins = window.part(0.0, window.length_s), measure(window)
    time = part.time_s - window.start_s
    assert len(bins) > 200
    waves = np.exp(-2j * np.pi * np.outer(bins.hertz, time)) * window.shape(time)[:, 0]
    for seen, signal in ((bins.speed[:, 0], part.speed_rad_s), (bins.torque[:, 0], part.torque_nm)):
        assert np.max(np.abs(seen - np.trapezoid(waves * signal, time, axis=1))) < 1e-11 * np.max(np.abs(seen))


@pytest.mark.parametrize(("rate_hz", "length_s"), [(20.0, 2.0), (10.0, 5.0), (20.0, 12.0), (400.0, 2.0)])
def test_the_true_values_solve_the_bins_of_short_stretches_at_low_rates_too(rate_hz, length_s):
    """With ten samples per taper, sums used to be wrong by several percent of the torque, and J too."""
    rng = np.random.default_rng(3)
    count = int(rate_hz * length_s)
    time = (np.arange(count) + rng.uniform(-0.05, 0.05, count)) / rate_hz
    omega, size, phase = 2.0 * np.pi * np.array([0.17, 0.4, 0.9]), np.array([2.0, 1.0, 0.6]), rng.uniform(0.0, 6.0, 3)
    turned = np.outer(time, omega) + phase
    speed, rise = 12.0 + np.sin(turned) @ size, np.cos(turned) @ (omega * size)
    stretch = OneWayStretch(Samples(time, speed, 104.0 * rise + 8.0 * speed + 60.0), 1.0)
    bins = joined([measure(window) for window in place_windows((stretch,))])
    assert np.max(bins.hertz) < 0.21 * rate_hz
    truth = np.zeros(PARAMETERS)
    truth[:2], truth[7] = (104.0, 8.0), 60.0
    low = bins.hertz < 1.5
    error = np.abs(evaluate(truth, bins).error[low])
    assert np.max(error) < 2e-3 * np.max(np.abs(bins.torque[low, 0]))


@pytest.mark.heavy
def test_windage_follows_the_shaft_s_own_speed_not_the_reported_one():
    """The slope of friction at the mean speed is 17 N·m·s/rad, with a lag of 0.4 s. J used to be 5 kg·m² too large.

    With linear friction only it is 0.2 % too large.
    """
    windy = replace(quiet(FIELD), viscous=2.0, quadratic=1.8)
    said = found(simulate(windy, "torque pulses", [1])[0])
    assert any("friction is not linear in speed" in warning for warning in said.warnings)
    assert said.inertia.value == pytest.approx(104.0, rel=1e-3)
    assert said.inertia.low <= 104.0 <= said.inertia.high


@pytest.mark.heavy
def test_unsupported_lags_do_not_widen_the_interval():
    """With lags of 6 and 5 ms, common lags of 1 s and more used to be accepted: ±3.0 % instead of ±1.2 %."""
    short = replace(FIELD, speed_report=Report((0.006,)), torque_report=Report((0.005,)))
    inertia = found(simulate(short, "up-down ramps", [3])[0]).inertia
    assert inertia.low <= 104.0 <= inertia.high
    assert inertia.high - inertia.low < 0.03 * 104.0


def test_slopes_are_the_derivatives(steps):
    bins = bins_of(steps)
    theta = np.array([104.0, 8.0, 0.4, 0.15, -0.02, 0.2, 0.3, 60.0, -60.0, 0.1])
    for index in range(PARAMETERS):
        step = np.zeros(PARAMETERS)
        step[index] = 1e-6 * max(1.0, abs(theta[index]))
        numeric = (evaluate(theta + step, bins).error - evaluate(theta - step, bins).error) / (2.0 * step[index])
        slope = evaluate(theta, bins).slopes[:, index]
        assert np.max(np.abs(numeric - slope)) <= 1e-6 * max(np.max(np.abs(slope)), 1e-9)


def test_tapers_add_up_to_one():
    time = np.linspace(10.0, 12.0, 101)
    first, second = flat_top(time, 12.0, 2.0), flat_top(time - 10.0, 12.0, 2.0)
    assert np.allclose(first[:, 0] + second[:, 0], 1.0, atol=1e-12)
    assert np.allclose(first[:, 1:] + second[:, 1:], 0.0, atol=1e-9)


# -- the band ------------------------------------------------------------------------------------------------


@pytest.mark.heavy
def test_what_stands_clear_beyond_the_lags_counts():
    """Half of the information on the lags is above one radian of the longer lag. Without it J had ±1.8 kg·m²."""
    inertia = found(simulate(FIELD, "torque pulses", [3])[0]).inertia
    assert inertia.low <= 104.0 <= inertia.high
    assert inertia.high - inertia.low < 0.025 * 104.0


@pytest.mark.long(but_first=2)
@pytest.mark.heavy
@pytest.mark.parametrize("said", [0.5, 0.005, None])
def test_the_wide_band_is_left_where_the_model_is_doubtful_in_it_or_untested(monkeypatch, said):
    recording = simulate(FIELD, "torque pulses", [3])[0]
    bins, placed = bins_of(recording), windows_of(recording)
    wide, narrow = search(bins, (), float(np.ptp(recording.torque_nm)))
    assert len(wide.problem.bins) > 1.5 * len(narrow.problem.bins)

    def tested(problem, theta, factor):
        p_value = said if len(problem.bins) == len(wide.problem.bins) else 0.3
        return None if p_value is None else ResidualTest(1.0, 10.0, p_value)

    monkeypatch.setattr(solving, "local_test", tested)
    solved = solve(bins, placed, (), float(np.ptp(recording.torque_nm)), 0.95)
    assert solved.bins == len((wide if said == 0.5 else narrow).problem.bins)


@pytest.mark.heavy
@pytest.mark.parametrize(("gain", "followed"), [
    (0.0, (0.0, 0.1)), *(
        pytest.param(*case, marks=pytest.mark.heavy) for case in ((5.0, (0.0, 0.2)), (40.0, (0.95, 1.0)))),
])
def test_the_value_follows_a_filter_structure_according_to_its_weight(monkeypatch, gain, followed):
    """Two more shapes that reduce −2 ln L by 5 are not significant. The value used to follow them from 4 on."""
    recording = simulate(FIELD, "torque pulses", [3])[0]
    bins, placed = bins_of(recording), windows_of(recording)
    monkeypatch.setattr(solving, "best_shapes", lambda problem, near: Fit(
        near.theta * np.where(np.arange(PARAMETERS) == 0, 1.01, 1.0), near.objective - gain))
    plain = search(bins, (), float(np.ptp(recording.torque_nm)))[0].fit.theta[0]
    value = solve(bins, placed, (), float(np.ptp(recording.torque_nm)), 0.95).inertia.value
    assert followed[0] <= (value / plain - 1.0) / 0.01 <= followed[1]


@pytest.mark.heavy
def test_if_j_is_unbounded_in_the_wide_band_the_narrow_one_is_used(monkeypatch):
    """With a slow, strong load, one of seventy starts with coasting used to be refused."""
    recording = simulate(FIELD, "torque pulses", [3])[0]
    bins, placed = bins_of(recording), windows_of(recording)
    wide, narrow = search(bins, (), float(np.ptp(recording.torque_nm)))
    profile = solving.profile

    def open_if_wide(problem, best, index, reach, step):
        told = profile(problem, best, index, reach, step)
        return replace(told, high=np.inf) if len(problem.bins) == len(wide.problem.bins) else told

    monkeypatch.setattr(solving, "profile", open_if_wide)
    solved = solve(bins, placed, (), float(np.ptp(recording.torque_nm)), 0.95)
    assert solved.bins == len(narrow.problem.bins)
    assert solved.inertia.bounded


def _shifted(fit, by):
    return replace(fit, theta=fit.theta * np.where(np.arange(PARAMETERS) == 0, by, 1.0))


@pytest.mark.heavy
@pytest.mark.parametrize("by", [0.99, 1.01])
def test_the_interval_joins_that_of_one_pole_filters_in_each_band(monkeypatch, by):
    """With the profile and 2 sd of the narrow band only, intervals of undeclared pulses missed in 5 of 109 records."""
    recording = simulate(FIELD, "torque pulses", [3])[0]
    bins, placed, span = bins_of(recording), windows_of(recording), float(np.ptp(recording.torque_nm))
    wide, narrow = search(bins, (), span)

    def solved(*bands):
        monkeypatch.setattr(solving, "search", lambda *_: bands)
        return solve(bins, placed, (), span, 0.95).inertia

    def holds(inertia, middle, near):
        rounding = 1e-12 * middle
        return inertia.low <= middle - near + rounding and middle + near - rounding <= inertia.high

    apart = replace(narrow, fit=_shifted(narrow.fit, by))
    alone = solved(wide)
    near = min(solving.one_pole_reach(apart, placed, 0.95), 0.5 * (alone.high - alone.low))
    joined = solved(wide, apart)
    assert holds(joined, apart.fit.theta[0], near)
    assert joined.high - joined.low > alone.high - alone.low
    structured = 2.0 - by          # a structure that is better by 40 in −2 ln L, on the other side
    monkeypatch.setattr(solving, "best_shapes", lambda problem, near: replace(
        _shifted(near, structured), objective=near.objective - 40.0))
    monkeypatch.setattr(solving, "profile", lambda problem, best, *_: Estimate(
        *(float(best.theta[0]) * share for share in (1.0, 0.993, 1.007))))
    near = min(solving.one_pole_reach(wide, placed, 0.95), 0.007 * structured * float(wide.fit.theta[0]))
    assert holds(solved(wide), wide.fit.theta[0], near)


@pytest.mark.heavy
def test_the_rounds_leave_a_place_without_lags(monkeypatch):
    """A time offset compensates a short lag, so that descents stall. Reversing ramps used to be refused."""
    recording = simulate(FIELD, "torque pulses", [3])[0]
    bins = bins_of(recording)
    right = search(bins, (), float(np.ptp(recording.torque_nm)))[-1]
    noise = fitting.guessed(bins, 104.0)
    every = replace(right.problem, bins=bins, variance=noise.variance)
    keep = bins.hertz < 0.8
    part = replace(every, bins=bins.chosen(keep), variance=noise.variance[keep])
    without = fitting.minimise(part, right.fit.theta, {SPEED_LAG: 0.0, TORQUE_LAG: 0.0})
    stuck = fitting.minimise(part, without.theta)
    assert stuck.theta[SPEED_LAG] < 1e-3
    assert stuck.theta[0] > 1.1 * 104.0
    monkeypatch.setattr(fitting, "from_residuals", lambda *_: noise)
    monkeypatch.setattr(fitting, "CLEAR", 0.0)
    monkeypatch.setattr(fitting, "_highest", lambda *_: 0.8)
    settled = fitting._settled(every, keep, stuck, 1.2)
    assert settled.fit.theta[SPEED_LAG] == pytest.approx(0.40, abs=0.1)
    assert settled.fit.theta[0] == pytest.approx(104.0, rel=0.02)


@pytest.mark.heavy
def test_a_slow_strong_load_is_no_scatter_over_time():
    """The load has the lowest frequencies, with little weight. In blocks of time it used to double the variance."""
    clean = simulate(quiet(FIELD), "torque pulses", [3], Reading(25.0))[0]
    truth = np.zeros(PARAMETERS)
    truth[:5], truth[7] = (104.0, 8.0, 0.40, 0.15, 0.0), 60.0
    right = search(bins_of(clean), (), float(np.ptp(clean.torque_nm)))[-1]
    keep = bins_of(clean).hertz < 1.0
    rng, step, ratios, loads = np.random.default_rng(5), float(np.median(np.diff(clean.time_s))), [], []
    keeps = np.exp(-step / 8.0)
    for _ in range(8):
        white = 12.0 * np.sqrt(1.0 - keeps**2) * rng.standard_normal(len(clean.time_s) + 5000)
        load = lfilter([1.0], [1.0, -keeps], white)[5000:] + 2.0 * rng.standard_normal(len(clean.time_s))
        loads.append(replace(clean, torque_nm=clean.torque_nm + load))
    every = [bins_of(loaded).chosen(keep) for loaded in loads]
    power = np.mean([np.abs(evaluate(truth, bins).error) ** 2 for bins in every], axis=0)
    for loaded, bins in zip(loads, every, strict=True):
        problem = replace(right.problem, bins=bins, variance=power, free=(0, 1, SPEED_LAG, 7))
        spread, _ = fitting.covariance(problem, truth, problem.free)
        direction = np.zeros(PARAMETERS)
        direction[list(problem.free)] = spread[0]
        scores = solving.block_scores(problem, windows_of(loaded), truth)
        ratios.append(solving.sandwich(scores, direction).variance / spread[0, 0])
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.35)


# -- lags beyond the bound -----------------------------------------------------------------------------------------


def slowed(recording, tau, name):
    """Return the recording with one report behind a further filter of one pole."""
    keep = np.exp(-float(np.median(np.diff(recording.time_s))) / tau)
    signal = getattr(recording, name)
    late, _ = lfilter([1.0 - keep], [1.0, -keep], signal, zi=[keep * signal[0]])
    return replace(recording, **{name: late})


@pytest.fixture(scope="module")
def unfiltered():
    return simulate(replace(FIELD, speed_report=Report((0.02,)), torque_report=Report((0.01,))), "speed steps", [1])[0]


@pytest.mark.heavy(but_first=1)
@pytest.mark.parametrize(("name", "tau"), [("torque", 3.0), ("speed", 2.5)])
def test_a_lag_beyond_the_bound_is_named(unfiltered, name, tau):
    """It used to give J of 70 (torque) and 125 kg·m² (speed): the lag was held at the bound, and not reported."""
    said = found(slowed(unfiltered, tau, {"torque": "torque_nm", "speed": "speed_rad_s"}[name]))
    assert said.verdict is Verdict.NOT_IDENTIFIABLE
    assert f"reported {name} lags" in said.reason
    assert "more than 2 s" in said.reason
    assert f"--{name}-lag-sd" in said.advice


@pytest.mark.heavy
def test_a_lag_at_the_bound_still_gives_j(unfiltered):
    said = found(slowed(unfiltered, 2.0, "torque_nm"))
    assert said.inertia.low <= 104.0 <= said.inertia.high


@pytest.mark.heavy
def test_a_stated_lag_may_be_longer_than_the_bound(unfiltered):
    prior = LagPrior(0.02, 0.01, 3.01, 0.1, "the operator")
    said = found(replace(slowed(unfiltered, 3.0, "torque_nm"), lag_prior=prior))
    assert said.inertia.low <= 104.0 <= said.inertia.high


# -- a torque scale that changes with the motion ---------------------------------------------------------------------


def rising(speed, torque):
    return torque * (1.0 + 0.04 * np.abs(speed))


def falling(speed, torque):
    return torque * (1.0 - 0.04 * np.abs(speed))


def current_above_base_speed(speed, torque):
    return torque * np.maximum(1.0, np.abs(speed) / 3.0)


def strong_braking(speed, torque):
    return np.where(torque * speed < 0.0, 1.25, 1.0) * torque


def current_with_magnetisation(speed, torque):
    return np.sign(torque) * np.sqrt(torque**2 + 120.0**2)


SCALES = [(rising, "speed steps", "low and high speed"), (strong_braking, "speed steps", "in braking"),
          (falling, "up-down ramps", "low and high speed"),
          (current_above_base_speed, "torque pulses", "low and high speed"),
          (current_with_magnetisation, "torque pulses", "in braking")]


@pytest.mark.long(but_first=3)
@pytest.mark.heavy(but_first=1)
@pytest.mark.parametrize(("scale", "motion", "said"), SCALES, ids=lambda value: getattr(value, "__name__", value))
def test_a_torque_scale_that_changes_with_the_motion_is_named(scale, motion, said):
    """The local test fits any smooth gain over frequency. J used to be valid, and wrong by 8 to 40 %."""
    recording = simulate(replace(FIELD, coulomb=30.0, viscous=4.0), motion, [2])[0]
    refused = found(replace(recording, torque_nm=scale(recording.speed_rad_s, recording.torque_nm)))
    assert refused.verdict is Verdict.MODEL_REJECTED
    assert refused.inertia is None
    assert said in refused.reason
    assert "torque signal instead of a current" in refused.advice


@pytest.mark.heavy
@pytest.mark.parametrize("machine", [FIELD, replace(FIELD, quadratic=3.0, viscous=1.0),
                                     replace(FIELD, load_sd=30.0, load_time=5.0)])
def test_friction_and_load_are_no_change_of_the_scale(machine):
    for recording in simulate(machine, "speed steps", [1, 2, 3]):
        bins, placed = bins_of(recording), windows_of(recording)
        braking = joined([measure(solving._braking(window)) for window in placed]).torque
        for band in search(bins, (), float(np.ptp(recording.torque_nm))):
            changes = solving.scale_changes(band.problem, placed, band.fit.theta, braking[band.keep])
            assert not any(change.found for change in changes)
            assert max(abs(change.clear) for change in changes) < 4.0


# -- coverage, a few seeds of many (the rest: benchmarks/record_route_coverage.py) ----------------------------

ROWS = [(FIELD, "foreign"), (SERVO, "up-down ramps"), (HEAVY, "ramp + coast"),
        (Machine("averages", 180.0, 12.0, 70.0, Report((), 0.40), Report((), 0.16), 10.0, 700.0, load_sd=6.0),
         "torque pulses")]


@pytest.mark.heavy(but_first=1)
@pytest.mark.parametrize(("machine", "motion"), ROWS, ids=lambda value: getattr(value, "name", value))
def test_the_interval_covers(machine, motion):
    assert motion in (*MOTIONS, "foreign")
    for recording in simulate(machine, motion, [11]):
        said = found(recording)
        assert said.verdict in (Verdict.VALID, Verdict.VALID_WIDE), said.reason
        inertia = said.inertia
        assert inertia.low <= machine.inertia <= inertia.high
        assert inertia.high - inertia.low < 0.4 * machine.inertia
        notes = {line.source: line.note for line in said.budget}
        assert notes.keys() >= {"noise", "lags", "lag structure", "friction model"}
        assert notes["noise"] == "disturbance of the load and noise of both signals, for known lags"
        assert notes["lags"] == "lags and time offset of the reported signals; none is stated"
        assert notes["friction model"].startswith("friction with and without a term in speed²")


@pytest.mark.heavy
def test_known_lags_narrow_the_interval_and_the_torque_scale_widens_the_total_only():
    recording = simulate(FIELD, "torque pulses", [3])[0]
    alone = found(recording).inertia
    assert (alone.low, alone.high) == (alone.low_total, alone.high_total)
    prior = LagPrior(0.40, 0.01, 0.15, 0.01, "the drive")
    known = found(replace(recording, lag_prior=prior, torque_scale_rel_sd=0.03)).inertia
    assert known.low <= 104.0 <= known.high
    assert known.high - known.low < 0.8 * (alone.high - alone.low)
    assert any("the drive" in condition for condition in known.conditional_on)
    assert known.high_total - known.value >= 1.9 * 0.03 * known.value


@pytest.mark.heavy
def test_holes_and_lost_rows_do_no_harm_and_the_bits_repeat(steps):
    kept = np.random.default_rng(3).random(len(steps.time_s)) > 0.1
    kept &= np.abs(steps.time_s - 50.0) > 4.0
    names = ("time_s", "speed_rad_s", "torque_nm", "fresh", "limited")
    recording = replace(steps, **{name: getattr(steps, name)[kept] for name in names})
    said = found(recording)
    assert said.inertia.low <= 104.0 <= said.inertia.high
    assert said == found(recording)


# -- unsuitable records -------------------------------------------------------------------------------------------


def noise(recording, sd):
    return sd * np.random.default_rng(9).standard_normal(len(recording.time_s))


def constant_speed(r):
    return replace(r, speed_rad_s=5.0 + noise(r, 0.003), torque_nm=100.0 + noise(r, 3.0))


def coasting(r):
    speed = 7.0 * np.exp(-r.time_s / 40.0)
    return replace(r, speed_rad_s=speed + noise(r, 0.003), torque_nm=noise(r, 2.0))


def no_torque(r):
    return replace(r, torque_nm=np.zeros_like(r.torque_nm))


def standing(r):
    return replace(r, speed_rad_s=np.zeros_like(r.speed_rad_s))


def slow_ramp(r):
    speed = 2.0 + 0.05 * r.time_s
    return replace(r, speed_rad_s=speed + noise(r, 0.003), torque_nm=60.0 + 8.0 * speed + 5.2 + noise(r, 3.0))


def only_noise(r):
    return replace(r, speed_rad_s=noise(r, 1.0), torque_nm=noise(r, 50.0)[::-1].copy())


def unrelated(r):
    return replace(r, torque_nm=100.0 + noise(r, 50.0))


def turned_round(r):
    return replace(r, torque_nm=-r.torque_nm)


def at_the_limit(r):
    return replace(r, torque_limit_nm=200.0)


def cut_off_before_its_noise(r):
    return replace(r, torque_nm=np.minimum(r.torque_nm, 150.0) + noise(r, 2.0))


def never_negative(r):
    return replace(r, torque_nm=np.maximum(r.torque_nm, 0.0))


def speed_cut_off(r):
    return replace(r, speed_rad_s=np.minimum(r.speed_rad_s, 5.0) + noise(r, 0.003))


def held(signal, r):
    first, last = np.searchsorted(r.time_s, (30.0, 60.0))
    return np.concatenate([signal[:first], np.full(last - first, signal[first]), signal[last:]])


def torque_frozen(r):
    return replace(r, torque_nm=held(r.torque_nm, r))


def speed_frozen(r):
    return replace(r, speed_rad_s=held(r.speed_rad_s, r))


HOPELESS = [(turned_round, "inverted"), (cut_off_before_its_noise, "torque is cut off"),
            (torque_frozen, "torque was frozen"),
            (speed_frozen, "speed was frozen"), (never_negative, "torque is cut off"),
            (speed_cut_off, "speed is cut off"),
            (constant_speed, "constant"), (coasting, "Coasting"), (no_torque, "torque did not change"),
            (standing, "speed did not change"), (slow_ramp, "one change of speed"), (only_noise, ""), (unrelated, ""),
            (at_the_limit, "limit")]


@pytest.mark.long(but_first=4)
@pytest.mark.heavy
@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(("spoil", "said"), HOPELESS, ids=lambda value: getattr(value, "__name__", ""))
def test_an_unsuitable_record_is_refused_with_a_reason_and_advice(steps, spoil, said):
    refused = found(spoil(steps))
    assert refused.verdict in (Verdict.NOT_IDENTIFIABLE, Verdict.MODEL_REJECTED)
    assert refused.inertia is None
    assert said in refused.reason
    assert refused.advice


@pytest.mark.heavy
def test_bins_beside_a_line_need_not_be_clear():
    """An undeclared multisine in strong noise: just above its last line the speed is noise only.

    Bins there used to count as clear because of their neighbours, and contradicted the model.
    """
    plant = plants.CoveragePlant(
        "lines", "noise of 3 % of the torque limit", 178.0, 5.0, 30.0, (1.0, 11.7), 435.0,
        plants.ReportFilter((0.06, 0.04)), plants.ReportFilter((0.03,)),
        plants.PlantNoise(5.5, 1.0, 14.0, 0.037, 0.0075, 3.5, 0.01, 1.0),
        plants.HostSampling(jitter_s=0.001), lowest_hz=0.2,
    )
    for recording in simulate_plan(plant, [(1, 2, 0), (1, 2, 1)], 20):
        got = found(recording)
        assert got.verdict in (Verdict.VALID, Verdict.VALID_WIDE), got.reason
        assert got.inertia.low <= plant.inertia_kg_m2 <= got.inertia.high

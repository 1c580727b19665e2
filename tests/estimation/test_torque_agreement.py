"""Commanded, demanded and reported torque, speed and angle: contradictory signals give no valid J."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from tdhil.calibration import StoredCalibration
from tdhil.estimation import Options, Verdict, identify, torque_contradiction, torque_ratios
from tdhil.recording.recording import Recording, Stage
from tdhil.report import result_document
from tests.estimation.shaft_bench import DT
from tests.estimation.stages_bench import Stages, run_stages, turn


def heavy(value):
    return pytest.param(value, marks=pytest.mark.heavy)


pytestmark = pytest.mark.one_worker      # its fixture is expensive

FINE_S = 0.002
LAGS = {
    "none": (), "one pole": (0.5,), "two poles": (0.25, 0.15), "average": ("average", 0.4), "dead time": ("late", 0.3),
}


def lagged(signal, lag):
    """Apply a lag by exact sampling, on a finer grid."""
    if lag[:1] == ("average",):
        count = round(lag[1] / FINE_S)
        return lfilter(np.full(count, 1.0 / count), [1.0], signal - signal[0]) + signal[0]
    if lag[:1] == ("late",):
        count = round(lag[1] / FINE_S)
        return np.concatenate([np.full(count, signal[0]), signal[:-count]])
    for tau in lag:
        keep = np.exp(-FINE_S / tau)
        signal = lfilter([1.0 - keep], [1.0, -keep], signal - signal[0]) + signal[0]
    return signal


def record(scale, seed, lag=(0.5,), rate_hz=100.0, offset=4.0, limit=None):
    """Return two minutes in torque mode: a multisine about two means, held from cycle to cycle."""
    rng = np.random.default_rng(seed)
    time = np.arange(round(120.0 / FINE_S)) * FINE_S
    wanted = np.where(time < 60.0, 90.0, 120.0)
    for hertz in (0.1, 0.2, 0.3, 0.5):
        wanted = wanted + 25.0 * np.cos(2.0 * np.pi * (hertz * time + rng.random()))
    each = round(1.0 / (rate_hz * FINE_S))
    held = np.repeat(wanted[::each], each)[: len(time)]
    true = held if limit is None else np.minimum(held, limit)
    told = offset + scale * lagged(true, lag)
    at = slice(None, None, each)
    torque = np.round(told[at] + 2.0 * rng.standard_normal(len(told[at])))
    flags = np.ones(len(torque), dtype=bool)
    limited = ~flags
    if limit is not None:      # and for three more seconds, as drives report it
        limited = np.convolve(held[at] > limit, np.ones(round(3.0 * rate_hz)))[: len(torque)] > 0
    return Recording(
        time[at], np.full(len(torque), 5.0), torque, flags, limited, torque_resolution_nm=1.0,
        torque_scale_rel_sd=0.02, commanded_torque_nm=np.round(held[at], 1),
    )


@pytest.mark.long(but_first=4)
@pytest.mark.heavy
@pytest.mark.parametrize("rate_hz", [100.0, 12.5])
@pytest.mark.parametrize("lag", list(LAGS.values()), ids=list(LAGS))
def test_the_ratio_covers_for_any_lags(lag, rate_hz):
    errors, halves = [], []
    for seed in range(12):
        scale = 0.9 + 0.02 * seed
        (found,) = torque_ratios(record(scale, seed, lag, rate_hz), 0.95)
        errors.append(abs(found.ratio.value - scale))
        halves.append(found.surely)
        assert found.reference == "commanded"
    assert np.all(np.array(errors) <= np.array(halves))
    assert max(halves) < 0.02


def test_samples_at_a_limit_are_left_out():
    (found,) = torque_ratios(record(1.0, 3, (0.15,), limit=150.0), 0.95)
    assert abs(found.ratio.value - 1.0) <= found.surely < 0.02


def test_without_data_there_is_no_ratio():
    one = record(0.5, 1)
    assert torque_ratios(replace(one, commanded_torque_nm=None), 0.95) == ()
    steady = np.full(len(one.time_s), 90.0)
    assert torque_ratios(replace(one, commanded_torque_nm=steady), 0.95) == ()


def test_in_speed_mode_the_demanded_torque_is_the_reference():
    one = record(0.8, 2, (0.15,))
    demanded = replace(one, commanded_torque_nm=None, demanded_torque_nm=one.commanded_torque_nm)
    (found,) = torque_ratios(demanded, 0.95)
    assert (found.reference, found.demanded_ratio) == ("demanded", None)
    said = torque_contradiction((found,), 0.02)
    assert "of the demanded torque" in said.reason
    assert "A run in torque mode shows which of the two is wrong" in said.advice


@pytest.mark.parametrize(("by_demanded", "by_reported", "alone"), [
    (1.0, 0.5, "but the reported torque does not"), (0.5, 0.5, "but the commanded torque does not"),
    (0.75, 0.5, "no two of the three agree"),
])
def test_the_signal_that_disagrees_with_the_others_is_named(by_demanded, by_reported, alone):
    one = record(by_reported, 4, (0.1,))
    three = replace(one, demanded_torque_nm=by_demanded * one.commanded_torque_nm)
    said = torque_contradiction(torque_ratios(three, 0.95), 0.02)
    assert alone in said.reason
    assert "commanded 1" in said.reason
    assert "N·m" in said.reason
    assert "per_lsb" in said.advice


@pytest.fixture(scope="module")
def runs():
    """Return recordings of the bench, with the motor torque as the setpoint."""
    seeds = [1, 2]
    stages = Stages()
    motion, _, given = turn(stages, seeds)
    found = []
    for k, one in enumerate(run_stages(stages, seeds, rate_hz=100.0)):
        commanded = np.interp(one.time_s, np.arange(len(given)) * DT, given[:, k])
        commanded[one.time_s < 24.0] = np.nan
        found.append(replace(one, commanded_torque_nm=commanded, torque_scale_rel_sd=0.02, stages=(
            Stage("speed", 0.0, 24.0, "ok"), Stage("acquire", 43.0, motion.segments[-1].end_s, "ok"))))
    return found


@pytest.mark.heavy
def test_a_sound_run_has_the_same_bits_with_its_setpoints_and_without(runs):
    for one in runs:
        with_them, without = identify(one), identify(replace(one, commanded_torque_nm=None))
        assert len(with_them.torque_ratios) == 1
        assert with_them.inertia == without.inertia
        assert with_them.inertia.low <= 104.0 <= with_them.inertia.high


@pytest.mark.heavy(but_first=1)
@pytest.mark.parametrize("scale", [heavy(0.5), 0.9, 1.1, heavy(2.0)])
def test_a_reported_torque_beyond_its_scale_is_never_valid(runs, scale):
    found = identify(replace(runs[0], torque_nm=scale * runs[0].torque_nm), Options(tolerance=0.2))
    assert (found.verdict, found.inertia) == (Verdict.NOT_IDENTIFIABLE, None)
    assert "contradict each other" in found.reason
    assert found.torque_ratios[0].ratio.value == pytest.approx(scale, rel=0.01)


@pytest.mark.heavy
@pytest.mark.parametrize("scale", [0.97, 1.035])
def test_a_difference_that_the_scale_allows_widens_it_until_both_torques_fit(runs, scale):
    found = identify(replace(runs[0], torque_nm=scale * runs[0].torque_nm), Options(tolerance=0.2))
    assert found.verdict is Verdict.VALID
    assert found.inertia.low_total <= 104.0 <= found.inertia.high_total
    assert any("torque scale was widened from 2.00 %" in warning for warning in found.warnings)


@pytest.mark.heavy(but_first=1)
@pytest.mark.parametrize("scale", [0.975, 1.02])
def test_a_torque_calibration_does_not_make_two_torques_contradict_each_other(runs, scale):
    """It determines the scale of the reported torque only. The ratio to the commanded torque does not change."""
    calibrated = StoredCalibration(1.0 / scale, 0.992 / scale, 1.008 / scale, 0.95, "2026-01-01", {}, {}, True)
    found = identify(calibrated.applied(replace(runs[0], torque_nm=scale * runs[0].torque_nm)), Options(tolerance=0.2))
    assert found.verdict is Verdict.VALID and found.torque_scale_rel_sd == calibrated.rel_sd
    assert found.inertia.low_total <= 104.0 <= found.inertia.high_total
    assert not any("was widened" in warning for warning in found.warnings)
    assert any("the torque calibration is that of the reported torque" in warning for warning in found.warnings)


@pytest.mark.heavy
def test_friction_has_the_torque_scale_of_j(runs):
    """The widened scale is in the total interval of each quantity that contains torque."""
    found = identify(one := replace(runs[0], torque_nm=0.965 * runs[0].torque_nm), Options(tolerance=0.2))
    document = result_document(found, one, {}, "")
    assert document["torque_scale_rel_sd"] > 0.025

    def scale(part):
        total, own = (0.5 * (part[high] - part[low]) / part["value"]
                      for low, high in (("low_total", "high_total"), ("low", "high")))
        return np.sqrt(total**2 - own**2)

    assert scale(document["coulomb_nm"]) == pytest.approx(scale(document["inertia_kg_m2"]), rel=1e-2)


@pytest.mark.heavy
def test_a_larger_stated_uncertainty_of_the_scale_explains_it(runs):
    one = replace(runs[0], torque_nm=0.9 * runs[0].torque_nm, torque_scale_rel_sd=0.06)
    found = identify(one, Options(tolerance=0.3))
    assert found.verdict is Verdict.VALID
    assert found.inertia.low_total <= 104.0 <= found.inertia.high_total


@pytest.mark.heavy
@pytest.mark.parametrize("factor", [heavy(0.5), 0.85, heavy(2.0)])
def test_a_speed_whose_scale_changes_before_stage_5_is_never_valid(runs, factor):
    for one in runs:
        speed = np.where(one.time_s < 43.0, 1.0, factor) * one.speed_rad_s
        found = identify(replace(one, speed_rad_s=speed), Options(tolerance=0.2))
        assert (found.verdict, found.inertia) == (Verdict.MODEL_REJECTED, None)
        assert "two methods contradict each other" in found.reason


@pytest.mark.heavy
def test_the_smallest_detectable_change_of_a_scale_is_reported(runs):
    for one in runs:
        opinion = identify(one).second_opinions[0]
        least = opinion.least_scale_change
        at_stage_5, *at_stage_2 = map(int, re.findall(r"±(\d+) % or more at stage", opinion.note))
        assert round(100.0 * least) == max([at_stage_5, *at_stage_2])
        assert 5 <= at_stage_5 < 25
        speed = np.where(one.time_s < 43.0, 1.0, 1.0 - 0.012 * at_stage_5) * one.speed_rad_s
        assert identify(replace(one, speed_rad_s=speed), Options(tolerance=0.2)).inertia is None


@pytest.fixture(scope="module")
def turned(runs):
    """Add the shaft angle: the counted integral of the true speed, in every fifth sample."""
    (shaft,) = (turn(Stages(), [1])[1],)
    grid = np.arange(len(shaft.speed)) * DT
    angle = np.interp(runs[0].time_s, grid, np.cumsum(shaft.speed[:, 0]) * DT)
    angle = np.floor(angle / 0.002) * 0.002
    angle[np.arange(len(angle)) % 5 != 0] = np.nan
    return replace(runs[0], position_rad=angle)


@pytest.mark.heavy
def test_an_angle_that_fits_changes_nothing(turned):
    with_angle = identify(turned)
    assert with_angle.harmonics == with_angle.backlash == ()
    limits = {"least_harmonics": with_angle.least_harmonics, "backlash_motion": with_angle.backlash_motion}
    assert None not in limits.values()
    without = replace(identify(replace(turned, position_rad=None)), **limits)
    assert replace(with_angle, harmonics=None, backlash=None) == without


@pytest.mark.heavy
@pytest.mark.parametrize(("factor", "said"), [
    (0.9, "contradicts the shaft's angle"), (1.15, "contradicts the shaft's angle"),
    (0.94, "scale of the reported speed changed"),
])
def test_a_speed_that_the_angle_contradicts_is_never_valid(turned, factor, said):
    speed = np.where(turned.time_s < 43.0, 1.0, factor) * turned.speed_rad_s
    found = identify(replace(turned, speed_rad_s=speed, stages=()), Options(tolerance=0.2))
    assert (found.verdict, found.inertia) == (Verdict.MODEL_REJECTED, None)
    assert said in found.reason


@pytest.mark.heavy
@pytest.mark.parametrize("factor", [1.015, heavy(1.05), 1.09, 0.92])
def test_a_speed_scale_that_the_angle_contradicts_a_little_widens_the_total_interval(turned, factor):
    """Up to the tolerance of 10 %. At 1.07 the interval excluded the true J, and the result was valid."""
    plain = identify(turned)
    found = identify(replace(turned, speed_rad_s=factor * turned.speed_rad_s))
    assert found.inertia.value == pytest.approx(plain.inertia.value / factor, rel=2e-3)
    assert found.inertia.low_total < 104.0 < found.inertia.high_total
    # the repeatability is that of the reported speed
    width = found.inertia.high - found.inertia.low
    assert width == pytest.approx((plain.inertia.high - plain.inertia.low) / factor, rel=0.05)
    (line,) = (one for one in found.budget if one.source == "speed scale")
    assert line.half_width_kg_m2 == pytest.approx(abs(factor - 1.0) * found.inertia.value, rel=0.1)
    assert found.budget[-1].source == "torque scale"
    assert any("the angle of the shaft moved" in one for one in found.warnings)
    assert found.calibration_advised is (abs(factor - 1.0) < 0.03) and plain.calibration_advised


@pytest.mark.heavy
def test_turns_that_are_lost_in_a_gap_of_the_angle_contradict_nothing(turned):
    """The counter wraps with each turn. A turn is lost in a gap that is too long for its range."""
    lost = turned.position_rad.copy()
    for gap in (60.0, 75.0, 90.0):
        lost[np.abs(turned.time_s - gap) < 0.2] = np.nan
        lost[turned.time_s > gap] -= 2.0 * np.pi * 3
    broken = replace(turned, position_rad=lost, position_gap_s=0.3)
    assert identify(broken).verdict is Verdict.VALID
    assert identify(replace(broken, position_gap_s=None)).verdict is Verdict.MODEL_REJECTED
    speed = np.where(turned.time_s < 43.0, 1.0, 0.9) * turned.speed_rad_s
    assert identify(replace(broken, speed_rad_s=speed, stages=())).verdict is Verdict.MODEL_REJECTED


@pytest.mark.heavy
@pytest.mark.parametrize("counts", [heavy(0.5), 2.0, heavy(10.0)])
def test_counts_that_the_operator_overrides_contradict_nothing(turned, counts):
    """With --accept-speed-unit the unit of the angle is wrong, not that of speed. A change of scale is still found."""
    wrong = replace(turned, position_rad=counts * turned.position_rad)
    assert identify(wrong).verdict is Verdict.MODEL_REJECTED
    accepted = replace(wrong, speed_unit_accepted=True)
    assert identify(accepted).verdict is Verdict.VALID
    speed = np.where(turned.time_s < 43.0, 1.0, 0.9) * turned.speed_rad_s
    found = identify(replace(accepted, speed_rad_s=speed, stages=()))
    assert (found.verdict, found.inertia) == (Verdict.MODEL_REJECTED, None)
    assert "scale of the reported speed changed" in found.reason

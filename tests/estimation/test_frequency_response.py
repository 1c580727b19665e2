"""Frequency response: intervals compared with exact responses, noise and distortion, exports for other tools."""

from __future__ import annotations

import math
import sys
from dataclasses import replace

import control
import numpy as np
import pytest

from profiles import CodedText, MessageCode, UsageError
from tdhil.estimation import Options, identify, response_columns, unit_of, usable_samples
from tdhil.estimation.case import Case
from tdhil.estimation.frequency_domain.frequency_response import (
    _between_speeds,
    _pooled,
    distortion_warning,
    measure_response,
)
from tdhil.estimation.periodic import measured
from tdhil.estimation.spectrum import SpectralLine
from tests.estimation.analytic import closed_form

J, B, SPEED_LAG, TORQUE_LAG = 104.0, 8.0, 0.40, 0.15


def plant():
    """Return ω/T of `closed_form` as python-control has it."""
    s = control.tf("s")
    return (1 + TORQUE_LAG * s) / ((J * s + B) * (1 + SPEED_LAG * s))


def respond(recording):
    found = identify(recording).frequency_response
    assert found is not None
    return found


def with_torque(recording, extra):
    """Add a torque over time to the report; ``extra`` takes the time and the segment's number."""
    torque = recording.torque_nm.copy()
    for number, segment in enumerate(recording.excitation.segments):
        inside = (recording.time_s >= segment.start_s) & (recording.time_s < segment.end_s)
        torque[inside] += extra(recording.time_s[inside] - segment.start_s, number)
    return replace(recording, torque_nm=torque)


@pytest.fixture(scope="module")
def linear():
    return respond(closed_form(noise=3.0))


def test_the_intervals_contain_the_exact_response_of_python_control(linear):
    exact = control.frequency_response(plant(), 2.0 * np.pi * linear.hertz).frdata[0, 0]
    for line, g in zip(linear.lines, exact, strict=True):
        # twice the half-width of 95 %: one of twelve exceeds it in one case of a thousand
        inertia = (1.0 / g).imag / (2.0 * math.pi * line.hertz)
        for one, truth in ((line.magnitude, abs(g)), (line.phase_rad, np.angle(g)),
                           (line.apparent_inertia_kg_m2, inertia)):
            assert abs(truth - one.value) < 2.0 * (one.high - one.value)
        assert 0.99 < line.coherence <= 1.0
        assert line.magnitude.high / line.magnitude.low < 1.05


@pytest.mark.heavy
def test_the_intervals_cover_as_often_as_stated():
    exact = control.frequency_response(plant(), 2.0 * np.pi * np.array([0.1, 0.2, 0.3, 0.4])).frdata[0, 0]
    missed = lines = 0
    for seed in range(40):
        recording = closed_form(noise=3.0, seed=seed, periods=5, offsets=(4.0,))
        case = measured(Case(recording, Options(), samples=usable_samples(recording)), recording.excitation)
        found = measure_response(case, None, (), "none")       # without the slow fit of a model
        for line, g in zip(found.lines, exact, strict=True):
            lines += 1
            missed += not line.magnitude.low < abs(g) < line.magnitude.high
    # 160 intervals of 95 %: more than 17 misses have a probability of 0.1 %
    assert lines == 160 and missed <= 17


@pytest.mark.heavy
def test_python_control_accepts_the_arrays(linear):
    frd = control.FRD(*linear.to_frd())
    for line in linear.lines:
        omega = 2.0 * math.pi * line.hertz
        assert abs(complex(frd(1j * omega)) - line.magnitude.value * np.exp(1j * line.phase_rad.value)) <= (
            1e-12 * line.magnitude.value)
    # python-control inverts ω/T to T/ω
    assert np.allclose((1 / frd).frdata[0, 0], linear.impedance, rtol=1e-12, atol=0.0)


@pytest.mark.heavy
def test_xarray_has_the_lines_with_their_units(linear):
    found = linear.to_xarray()
    assert found.hertz.values.tolist() == linear.hertz.tolist()
    assert found.magnitude.attrs["units"] == "rad/(s N m)" and found.phase_rad_low.attrs["units"] == "rad"
    assert found.impedance_magnitude_high.attrs["units"] == "N m s/rad"
    assert np.allclose(found.impedance_magnitude.values, np.abs(linear.impedance), rtol=1e-12)
    assert found.coherence.attrs["units"] == "1" and unit_of("hertz") == "Hz"
    g = found.real_rad_s_nm.values + 1j * found.imaginary_rad_s_nm.values
    assert np.allclose(g, linear.response, rtol=1e-15)
    assert found.attrs["distortion_detected"] == 0
    assert set(found.data_vars) | {"hertz"} == set(response_columns(linear))


def test_a_missing_xarray_is_an_error_with_what_to_install(linear, monkeypatch):
    monkeypatch.setitem(sys.modules, "xarray", None)
    with pytest.raises(UsageError, match="xarray is not installed") as raised:
        linear.to_xarray()
    assert "pip install" in raised.value.next_step and raised.value.entry is MessageCode.PACKAGE_MISSING


def test_the_model_is_drawn_through_the_lines_with_its_band(linear):
    assert linear.model == "rigid+lags"
    hertz = [point.hertz for point in linear.curve]
    assert hertz == sorted(hertz) and hertz[0] < 0.1 and hertz[-1] > 0.4
    exact = control.frequency_response(plant(), 2.0 * np.pi * np.array(hertz)).frdata[0, 0]
    inside = [p.magnitude.low <= abs(g) <= p.magnitude.high and p.phase_rad.low <= np.angle(g) <= p.phase_rad.high
              for p, g in zip(linear.curve, exact, strict=True)]
    assert np.mean(inside) > 0.9
    assert all(line.residual_sd < 4.0 for line in linear.lines)


def test_a_linear_shaft_has_no_distortion(linear):
    found = linear.distortion
    assert not found.detected and found.p_value > 0.01
    assert {one.harmonic for one in found.harmonics} == set(range(5, 13))
    assert found.by_harmonics is not None and found.by_speed is not None


@pytest.mark.heavy(but_first=1)
@pytest.mark.parametrize("harmonic, odd", [(5, True), (6, False)])
def test_torque_at_an_unexcited_harmonic_is_distortion(harmonic, odd):
    bent = with_torque(closed_form(noise=3.0), lambda t, _: 2.0 * np.cos(2.0 * np.pi * harmonic * t / 10.0 + 0.4))
    found = respond(bent).distortion
    assert found.detected and found.by_harmonics < 1e-6
    assert (found.odd_share > 0.7) is odd
    seen = {one.harmonic: one for one in found.harmonics}[harmonic]
    assert seen.torque_nm == pytest.approx(2.0, rel=0.1) and seen.p_value < 1e-6


@pytest.mark.heavy
@pytest.mark.parametrize("between_speeds", [False, True])
def test_a_distortion_without_a_named_cause_is_a_warning_of_the_result(between_speeds):
    plain = closed_form(noise=3.0)
    speeds = [plain.speed_rad_s[(plain.time_s >= one.start_s) & (plain.time_s < one.end_s)] - one.offset_rad_s
              for one in plain.excitation.segments]
    bent = with_torque(plain, lambda t, number: 1.5 * number * speeds[number] if between_speeds else
                       2.0 * np.cos(2.0 * np.pi * 0.5 * t + 0.4))
    found = identify(bent)
    (said,) = (one for one in found.warnings if getattr(one, "entry", None) is MessageCode.DISTORTION_FOUND)
    assert ("between the mean speeds" if between_speeds else "Look for backlash") in said
    assert f"p = {found.frequency_response.distortion.p_value:.1g}" in said


def test_a_distortion_with_a_named_cause_and_a_linear_shaft_have_no_such_warning(linear):
    bent = replace(linear, distortion=replace(linear.distortion, detected=True))
    assert distortion_warning(linear, ()) == distortion_warning(None, ()) == ()
    assert len(distortion_warning(bent, ("a plain text",))) == 1
    assert distortion_warning(bent, (CodedText("backlash", MessageCode.BACKLASH_FOUND),)) == ()


@pytest.mark.heavy
def test_detected_distortion_widens_the_intervals(linear):
    bent = respond(with_torque(closed_form(noise=3.0), lambda t, _: 2.0 * np.cos(2.0 * np.pi * 0.5 * t)))
    for wide, narrow in zip(bent.lines, linear.lines, strict=True):
        assert wide.magnitude.high / wide.magnitude.low > narrow.magnitude.high / narrow.magnitude.low
        assert wide.distortion_rel > wide.noise_rel > 0.0


CUBIC_NM_S3 = 6.0          # N·m per (rad/s)³: a tenth of the viscous torque of the strongest line, and more


def bent_by_its_speed(seed, realisations, amplitudes=(1.5, 0.8, 0.25, 0.25)):
    """Return a recording at two mean speeds with a friction cubic in the deviation of speed."""
    phases = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi, (2, realisations, 4))
    phases = np.concatenate(phases if realisations > 1 else [phases[0], phases[0]])
    offsets = (4.0,) * realisations + (7.0,) * realisations
    plain = closed_form(noise=3.0, seed=seed, offsets=offsets, phases_rad=phases, periods=5,
                        amplitudes=amplitudes)
    speeds = [plain.speed_rad_s[(plain.time_s >= one.start_s) & (plain.time_s < one.end_s)] - one.offset_rad_s
              for one in plain.excitation.segments]
    return with_torque(plain, lambda _, number: CUBIC_NM_S3 * speeds[number] ** 3)


def test_realisations_measure_the_distortion_of_the_lines_themselves():
    """Their mean over all phases is 3/4 c a² + 3/2 c Σ b² for a line a with others b. The intervals contain it."""
    a = np.array([1.5, 0.8, 0.25, 0.25])
    shift = CUBIC_NM_S3 * (0.75 * a**2 + 1.5 * (np.sum(a**2) - a**2))
    linear_z = 1.0 / control.frequency_response(plant(), 2.0 * np.pi * np.array([0.1, 0.2, 0.3, 0.4])).frdata[0, 0]
    exact = np.abs(1.0 / (linear_z + shift))
    missed, widths = 0, {1: [], 4: []}
    for realisations in widths:
        for seed in range(12):
            recording = bent_by_its_speed(seed, realisations)
            case = measured(Case(recording, Options(), samples=usable_samples(recording)), recording.excitation)
            found = measure_response(case, None, (), "none")
            assert found.realisations == (2 * realisations if realisations > 1 else 1) and found.distortion.detected
            widths[realisations] += [line.magnitude.high / line.magnitude.low - 1.0 for line in found.lines]
            if realisations == 4:
                missed += sum(not line.magnitude.low < g < line.magnitude.high
                              for line, g in zip(found.lines, exact, strict=True))
    assert missed <= 7                     # of 48 intervals of 95 %: more misses have a probability of 0.5 %
    assert np.median(widths[4]) < 0.7 * np.median(widths[1])


@pytest.mark.heavy
def test_a_response_that_differs_between_mean_speeds_is_distortion():
    plain = closed_form(noise=3.0)
    speeds = [plain.speed_rad_s[(plain.time_s >= one.start_s) & (plain.time_s < one.end_s)] - one.offset_rad_s
              for one in plain.excitation.segments]
    found = respond(with_torque(plain, lambda _, number: 1.5 * number * speeds[number])).distortion
    assert found.detected and found.by_speed < 0.0015


@pytest.mark.heavy
def test_a_constant_friction_and_another_torque_scale_are_no_distortion(linear):
    scaled = closed_form(noise=3.0, coulomb=200.0)
    scaled = replace(scaled, torque_nm=1.1 * scaled.torque_nm)
    found = respond(scaled)
    assert not found.distortion.detected
    assert np.allclose(np.abs(found.response), np.abs(linear.response) / 1.1, rtol=0.01)


def test_one_period_has_no_response_and_two_have():
    assert identify(closed_form(periods=2)).frequency_response is None
    # two usable periods give no J, for lack of degrees of freedom, but still give the lines
    found = respond(closed_form(periods=3, offsets=(4.0,)))
    assert [line.periods for line in found.lines] == [2, 2, 2, 2]
    assert found.model == "none" and found.curve == ()


def test_a_single_sine_has_a_response_without_an_inertia():
    identified = identify(closed_form(lines=(0.1,), amplitudes=(1.5,), noise=3.0))
    found = identified.frequency_response
    assert identified.inertia is None and found is not None
    exact = complex(plant()(2j * math.pi * 0.1))
    assert found.lines[0].magnitude.low < abs(exact) < found.lines[0].magnitude.high
    assert found.lines[0].fitted_magnitude is None and not found.distortion.detected


@pytest.mark.heavy
def test_a_recording_without_periodic_excitation_has_no_response():
    assert identify(replace(closed_form(), excitation=None)).frequency_response is None


def test_a_line_in_the_noise_has_an_open_interval():
    found = respond(closed_form(noise=60.0, amplitudes=(1.5, 0.8, 0.25, 0.0003)))
    assert math.isinf(found.lines[-1].magnitude.high)
    assert found.lines[-1].phase_rad.high - found.lines[-1].phase_rad.value == pytest.approx(math.pi)
    assert math.isfinite(found.lines[0].magnitude.high)


def test_the_signal_with_less_noise_is_the_divisor():
    """The speed at an antiresonance is below the noise, and division by its square would be biased."""
    rng = np.random.default_rng(3)
    z, torque, seen = 200.0 * np.exp(0.3j), 10.0, []
    for _ in range(400):
        w = torque / z + 0.03 * (rng.standard_normal(8) + 1j * rng.standard_normal(8)) / math.sqrt(2.0)
        t = torque + 0.01 * (rng.standard_normal(8) + 1j * rng.standard_normal(8)) / math.sqrt(2.0)
        line = SpectralLine(0.5, np.array([w.mean()]), np.array([t.mean()]), np.array([8.0]), 0.03**2, 0.01**2, 0j, 7.0)
        seen.append(1.0 / _pooled(line).z)
    error = np.array(seen) - 1.0 / z
    assert abs(error.mean()) < 4.0 * np.std(error) / math.sqrt(len(seen))


def test_a_line_beside_an_oscillation_is_wider_and_does_not_show_a_difference_between_mean_speeds():
    """An oscillation that outlasts a period has a mean that scatters more than its scatter over the periods shows."""
    speed, torque = np.array([1.0 + 0j, 1.0]), np.array([100.0 + 0j, 101.0])
    line = SpectralLine(0.3, speed, torque, np.array([6.0, 6.0]), 1e-8, 0.01, 0j, 10.0)
    assert _between_speeds([_pooled(line)]) < 1e-6
    beside, apart = (_pooled(replace(line, oscillation_steps=steps)) for steps in (0.2, 0.9))
    assert _between_speeds([beside]) is None and _between_speeds([apart]) is None
    assert beside.noise_rel > 2.5 * apart.noise_rel and apart.noise_rel == _pooled(line).noise_rel


@pytest.mark.heavy
def test_the_values_are_those_of_the_table_of_lines(linear):
    identified = identify(closed_form(noise=3.0), Options())
    for line, point in zip(identified.frequency_response.lines, identified.lines, strict=True):
        assert line.apparent_inertia_kg_m2.value == pytest.approx(point.apparent_inertia_kg_m2.value, rel=1e-9)
        assert line.residual_sd == pytest.approx(point.residual_sd, rel=1e-6)


@pytest.mark.heavy
def test_thinned_samples_give_the_same_harmonics():
    quick = with_torque(closed_form(noise=0.0, rate_hz=2000.0), lambda t, _: np.cos(2.0 * np.pi * 0.7 * t))
    seen = {one.harmonic: one for one in respond(quick).distortion.harmonics}
    assert seen[7].torque_nm == pytest.approx(1.0, rel=0.01)
    assert max(one.torque_nm for number, one in seen.items() if number != 7) < 1e-3

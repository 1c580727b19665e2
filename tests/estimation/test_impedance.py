"""Impedance of the drive from records in closed form: results, intervals, and refusals."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from sim_bus.inverter import Controller, lag_gain
from sim_bus.params import DriveParams
from tdhil.calibration import StoredCalibration
from tdhil.estimation import Options, Verdict, identify, usable_samples
from tdhil.estimation.case import Case
from tdhil.estimation.impedance import lines_of
from tdhil.estimation.periodic import measured
from tdhil.recording import LagPrior
from tdhil.recording.builder import RecordingBuilder
from tests.estimation import impedance_bench
from tests.estimation.impedance_bench import HARMONICS, PERIOD_S, SETTINGS, ZETA, Machine, command, found

record = partial(impedance_bench.record, counted=12)       # half of a run, for half of the computing time
NAMED = pytest.mark.parametrize("name", SETTINGS)


def machine(name, **others):
    gain, integral = SETTINGS[name]
    return Machine(gain=gain, integral=integral, **others)


def holds(part, truth, times=1.0):
    """Return whether the interval, widened by a factor, contains the true value."""
    return abs(part.value - truth) <= times * 0.5 * (part.high - part.low)


@pytest.mark.heavy(but_first=1)
@pytest.mark.heavy(but_first=2)
@NAMED
@pytest.mark.parametrize("by", ["offset", "reference"])
def test_gains_lags_and_reflection_are_found(name, by):
    drive = machine(name)
    seen = found(record(drive, by, seed=5))
    assert seen.verdict is Verdict.VALID, seen.reason
    # one seed: twice the interval of 95 %; see benchmarks/impedance_coverage.py for the coverage
    assert holds(seen.gain_nm_s_rad, drive.gain, 2.0)
    assert holds(seen.integral_nm_rad, drive.integral, 2.0)
    assert holds(seen.inner_lag_s, drive.inner_lag, 2.0)
    assert holds(seen.inertia_kg_m2, drive.inertia, 2.0)
    hertz = np.array([point.hertz for point in seen.points])
    told = np.array([point.reflection.value for point in seen.points])
    assert np.max(np.abs(told - drive.reflection(hertz))) < 0.012
    z = np.array([point.real_nm_s_rad.value + 1j * point.imaginary_nm_s_rad.value for point in seen.points])
    assert z == pytest.approx(drive.impedance(hertz), rel=0.08)
    measured = {point.hertz: complex(*point.measured_nm_s_rad) for point in seen.points if point.measured_nm_s_rad}
    assert sorted(measured) == pytest.approx(HARMONICS / PERIOD_S)
    for line, one in measured.items():
        # A single line scatters by a tenth or more if a soft loop hardly follows its reference.
        assert one == pytest.approx(drive.impedance(line), rel=0.1 if line < 0.7 or by == "offset" else 0.4)


@pytest.mark.parametrize("integral", [0.0, 30000.0])
def test_a_loop_in_closed_form_is_sampled_as_the_simulated_drive_is(integral):
    # Otherwise the coverage would be stated for a lag that the simulated drive does not have.
    params = DriveParams(speed_gain_nm_s_rad=300.0, speed_integral_gain_nm_rad=integral, torque_limit_nm=1e6)
    drive, step_s = Machine(integral=integral, control=params.control_period_s), params.control_period_s
    control, gain, torque = Controller(params), lag_gain(step_s, params.torque_lag_s), []
    control.speed(0.0)
    omega, turns = 2.0 * np.pi * 0.5, 4
    count = round(2.0 * np.pi * turns / omega / step_s)
    time_s = step_s * np.arange(count + 1000)
    for at_s in time_s:
        last = torque[-1] if torque else 0.0
        torque.append(last + gain * (control.step(np.cos(omega * at_s), step_s) - last))
    held = (1.0 - np.exp(-1j * omega * step_s)) / (1j * omega * step_s)
    found = 2.0 * np.mean(torque[-count:] * np.exp(-1j * omega * time_s[-count:])) * held
    expected = -drive.law(1j * omega) * drive.lag(drive.speed_filter, 1j * omega)
    assert found == pytest.approx(expected, rel=1e-6)
    assert integral or -np.angle(-found) / omega == pytest.approx(drive.inner_lag, rel=0.01)
    assert drive.inner_lag == pytest.approx(0.02905, abs=1e-5)


@pytest.mark.heavy
def test_a_sampled_integral_moves_the_gain_within_its_interval():
    """With P = 1600, I = 800, 2 ms and a fiftieth of the usual noise, the effective gain is P − I h/2 = 1599.2."""
    few = {name: 0.02 * value for name, value in vars(Machine()).items() if name.endswith(("_sd", "noise", "quantum"))}
    few["speed_quantum"] *= 0.05       # the coarse rounding of the bench would change P by 0.1
    drive = Machine(gain=1600.0, integral=800.0, control=0.002, **few)
    seen = found(record(drive, "offset", seed=0))
    assert seen.gain_nm_s_rad.value == pytest.approx(1599.2, abs=0.2)
    assert seen.gain_nm_s_rad.low <= drive.gain <= seen.gain_nm_s_rad.high
    assert holds(seen.integral_nm_rad, drive.integral, 2.0)
    assert width(seen.gain_nm_s_rad) < 2.5
    assert any("integrates every 2 ms" in text for text in seen.conditions)


@pytest.mark.heavy
@NAMED
def test_a_reference_filter_that_nobody_declared_is_refused(name):
    drive = machine(name, reference_filter=0.1)
    seen = found(record(drive, "reference", seed=3))
    assert seen.verdict is Verdict.MODEL_REJECTED
    assert "reference filter" in seen.reason and "--impedance offset" in seen.advice
    assert holds(seen.reference_filter_s, 0.1, 2.0)
    assert seen.gain_nm_s_rad is None and seen.points == ()


@pytest.mark.heavy
def test_a_reference_filter_too_small_to_find_is_within_the_intervals():
    """The filter of 0.03 s is not declared. Without an allowance, the interval of P misses in these two records."""
    drive = machine("the paper's", reference_filter=0.03)
    for seed in (1, 4):
        seen = found(record(drive, "reference", seed=seed, draw=seed + 1))
        assert seen.verdict is Verdict.VALID
        assert seen.gain_nm_s_rad.low <= drive.gain <= seen.gain_nm_s_rad.high


@pytest.mark.heavy
def test_a_declared_reference_filter_is_removed():
    drive = machine("the paper's", reference_filter=0.1)
    seen = found(record(drive, "reference", seed=3, declared=0.1))
    assert seen.verdict is Verdict.VALID
    assert holds(seen.gain_nm_s_rad, drive.gain, 2.0)
    assert "a reference filter of 0.1 s" in seen.conditions


@pytest.mark.heavy
def test_a_wrongly_declared_reference_filter_is_reported_in_full():
    """The filter is declared as 0.2 s and truly 0.3 s. The report names the true one instead of the declared one."""
    drive = machine("the paper's", reference_filter=0.3)
    seen = found(record(drive, "reference", seed=3, declared=0.2))
    assert seen.verdict is Verdict.MODEL_REJECTED
    assert holds(seen.reference_filter_s, 0.3, 2.0)
    assert "the declared reference filter of 0.2 s" in seen.reason and "in place of it" in seen.reason


@pytest.mark.heavy
def test_the_torque_offset_is_independent_of_the_reference_filter():
    seen = found(record(machine("soft, a = 0.25", reference_filter=0.1), "offset", seed=3))
    assert seen.verdict is Verdict.VALID


@pytest.mark.heavy
def test_a_drive_that_ignores_the_offset_is_distinguished_from_one_that_uses_it():
    recording = record(machine("the paper's"), "offset", seed=1, peak=0.6)
    refused = found(recording)
    assert refused.verdict is Verdict.NOT_IDENTIFIABLE
    assert "check that the drive accepts it" in refused.advice


def test_too_few_periods_are_refused():
    refused = found(record(machine("the paper's"), seed=1, counted=4))
    assert refused.verdict is Verdict.NOT_IDENTIFIABLE
    assert "too few" in refused.reason


@pytest.mark.heavy
def test_a_report_that_is_no_first_order_lag_is_refused():
    recording = record(machine("the paper's"), seed=1)
    late = 60                      # samples, 0.24 s, of the speed only
    seen = found(replace(recording, speed_rad_s=np.concatenate([
        recording.speed_rad_s[:5000], np.roll(recording.speed_rad_s[5000:], late)
    ])))
    assert seen.verdict is Verdict.MODEL_REJECTED


@pytest.mark.heavy
@pytest.mark.parametrize("ratio", [0.97, 1.03])
def test_another_scale_of_the_reported_torque_is_within_the_intervals(ratio):
    """If both torques had the same scale, 3 % would give lags of 18 to 22 ms, and P outside of its interval."""
    drive = machine("the paper's", torque_scale=ratio)
    every = [found(record(drive, "offset", seed=seed, scale_sd=0.02)) for seed in range(4)]
    for name, truth in (("inner_lag_s", 0.03), ("gain_nm_s_rad", drive.gain), ("inertia_kg_m2", drive.inertia)):
        parts = [getattr(seen, name) for seen in every]
        assert sum(holds(part, truth) for part in parts) >= 3 and all(holds(part, truth, 1.5) for part in parts), name
    assert any("reported torque over commanded torque 1 ± 2.8 %" in text for text in every[0].conditions)


@pytest.mark.heavy
def test_a_soft_loop_has_a_wide_gain_if_the_torque_scales_may_differ():
    """J − P Στ determines the speed, and 2.8 % of J exceeds P Στ. |r| and I do not depend on it."""
    drive = machine("soft, a = 1", torque_scale=1.03)
    seen = found(record(drive, "offset", seed=1, scale_sd=0.02))
    assert seen.verdict is Verdict.VALID
    assert width(seen.gain_nm_s_rad) > 0.5 * drive.gain
    assert seen.gain_nm_s_rad.low <= drive.gain <= seen.gain_nm_s_rad.high
    assert seen.inner_lag_s.low == 0.0 and drive.inner_lag < seen.inner_lag_s.high
    assert holds(seen.integral_nm_rad, drive.integral, 2.0)
    told = np.array([point.reflection.value for point in seen.points])
    assert np.max(np.abs(told - drive.reflection([point.hertz for point in seen.points]))) < 0.012


@pytest.mark.heavy
def test_by_the_reference_the_gains_of_the_drive_include_the_ratio_and_z_does_not():
    drive = machine("the paper's")
    exact, open_ = (found(record(drive, "reference", seed=2, scale_sd=sd)) for sd in (0.0, 0.02))
    assert open_.inner_lag_s == exact.inner_lag_s and open_.inertia_kg_m2 == exact.inertia_kg_m2
    for name in ("gain_nm_s_rad", "integral_nm_rad"):
        one, other = getattr(exact, name), getattr(open_, name)
        more = 1.96 * 0.02 * np.sqrt(2.0) * one.value
        assert other.high - other.value == pytest.approx(np.hypot(one.high - one.value, more), rel=0.05)


@pytest.mark.heavy
def test_a_calibration_of_the_reported_torque_does_not_move_the_gains_of_the_drive():
    """The report is 1/1.03 of the torque and calibrated. P and the lags keep their values and widths."""
    recording = record(machine("the paper's", torque_scale=1.0 / 1.03), "offset", seed=1, scale_sd=0.02)
    calibrated = StoredCalibration(1.03, 1.028, 1.032, 0.95, "2026-01-01", {}, {}, True).applied(recording)
    plain, seen = found(recording), found(calibrated)
    assert seen.verdict is Verdict.VALID
    assert holds(seen.inner_lag_s, 0.03) and holds(seen.gain_nm_s_rad, 300.0)
    assert width(seen.inner_lag_s) == pytest.approx(width(plain.inner_lag_s), rel=0.2)


@pytest.mark.heavy
def test_a_lag_at_its_bound_has_an_interval_from_0_to_an_upper_limit():
    drive = machine("the paper's", torque_lag=0.002, speed_filter=0.028)
    at_bound, misses = 0, 0
    for seed in range(4, 9):
        seen = found(record(drive, "offset", seed=seed))
        at_bound += seen.torque_lag_s.value == 0.0
        assert seen.torque_lag_s.low == 0.0 and 0.002 < seen.torque_lag_s.high < 0.02
        misses += not seen.speed_filter_s.low <= 0.028 <= seen.speed_filter_s.high
        misses += not seen.inner_lag_s.low <= 0.030 <= seen.inner_lag_s.high
    assert at_bound, "the lag of no seed is at the bound"
    assert misses <= 1


@pytest.mark.heavy
def test_the_torque_scale_counts_in_the_reflection():
    drive = machine("soft, a = 0.25")
    seen = found(record(drive, seed=2, scale_sd=0.02))
    for one in seen.points:
        # |r(κ Z)| with κ = 1 ± 0.02, combined with the width of the interval
        z = complex(one.real_nm_s_rad.value, one.imaginary_nm_s_rad.value)
        moved = [abs((k * z - ZETA) / (k * z + ZETA)) for k in (0.98, 1.02)]
        half = np.hypot(1.96 * 0.5 * (max(moved) - min(moved)), 0.5 * (one.reflection.high - one.reflection.low))
        assert 0.5 * (one.reflection_total.high - one.reflection_total.low) == pytest.approx(half, rel=0.05)


@pytest.mark.heavy
def test_without_a_string_there_is_no_reflection():
    recording = record(machine("the paper's"), seed=1)
    seen = found(replace(recording, impedance=replace(recording.impedance, string_nm_s_rad=0.0)))
    assert seen.verdict is Verdict.VALID
    assert all(point.reflection is None for point in seen.points)
    assert "--string-impedance" in seen.advice


@pytest.mark.heavy
def test_stated_lags_narrow_the_intervals_that_depend_on_them():
    drive = machine("stiff")
    known = LagPrior(0.40, 0.002, 0.15, 0.002, "rig.yaml")
    free, stated = (found(record(drive, seed=4, prior=prior)) for prior in (None, known))
    assert width(stated.inertia_kg_m2) < width(free.inertia_kg_m2)
    assert any("rig.yaml" in text for text in stated.conditions)


def width(part):
    return part.high - part.low


@pytest.mark.heavy
def test_the_identification_has_it_beside_the_inertia_and_a_log_reproduces_it():
    recording = record(machine("the paper's"), seed=6, scale_sd=0.02)
    whole = identify(recording)
    assert whole.verdict in (Verdict.VALID, Verdict.VALID_WIDE)
    assert whole.impedance.verdict is Verdict.VALID
    builder = RecordingBuilder()
    values = np.column_stack([recording.time_s, recording.speed_rad_s, recording.torque_nm])
    builder.add_block(values, recording.fresh, recording.limited)
    builder.excitation(recording.excitation, recording.levels)
    builder.learn(
        impedance=recording.impedance, torque_scale_rel_sd=0.02, torque_resolution_nm=recording.torque_resolution_nm,
        speed_resolution_rad_s=recording.speed_resolution_rad_s,
    )
    assert identify(builder.recording()).impedance == whole.impedance


@pytest.mark.heavy
def test_the_command_is_the_rounded_and_held_setpoint():
    drive = machine("the paper's", torque_quantum=5.0)
    recording = record(drive, seed=1, counted=6)
    case = measured(Case(recording, Options(), samples=usable_samples(recording)), recording.excitation)
    hertz = HARMONICS / PERIOD_S
    sizes, phases = command(drive, "offset", None)
    sent = np.cos(np.outer(np.arange(5000) * 0.004, 2.0 * np.pi * hertz) + phases) @ sizes
    sent = np.round(sent / 5.0) * 5.0
    fine = np.repeat(sent, 50)         # held, and integrated in steps of 80 µs
    middle = (np.arange(len(fine)) + 0.5) * 0.004 / 50
    for line, f in zip(lines_of(case, recording.impedance), hertz, strict=True):
        by_hand = 2.0 * np.mean(fine * np.exp(-2j * np.pi * f * middle))
        assert complex(line.u[0]) == pytest.approx(by_hand, rel=1e-4)

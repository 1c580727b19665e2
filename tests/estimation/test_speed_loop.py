"""Gains of the drive's speed loop from the ramp of stage 2: compared with a simulation; unsuitable drives."""

from dataclasses import replace

import numpy as np
import pytest

from tdhil.estimation.cross_checks.speed_loop import speed_loop
from tdhil.estimation.samples import usable_samples
from tdhil.recording.recording import Level, Ramp, Stage
from tests.estimation.reporting import recorded

FINE_S = 0.001
LOW, HIGH, RATE = 2.9, 7.2, 1.2
RAMP_S, END_S = (8.0, 16.0), 22.0


def ramped(gain=300.0, integral=300.0, rate_hz=15.0, speed_lag_s=0.0, setpoint_lag_s=0.0, seed=1):
    """Return a record with J 104, B 8, T_c 60 and a PI loop; the setpoint steps once per cycle and acts 30 ms later."""
    rng = np.random.default_rng(seed)
    each = round(1.0 / (rate_hz * FINE_S))
    speed, told, total, smoothed = LOW, LOW, 60.0 + 8.0 * LOW, LOW
    rows = []
    steps = round((HIGH - LOW) / RATE * rate_hz)
    first = int(RAMP_S[0] * rate_hz)
    for n in range(round(END_S / FINE_S)):
        cycle = n // each
        setpoint = LOW + (HIGH - LOW) * min(max(cycle - first, 0) / steps, 1.0)
        smoothed += (setpoint - smoothed) * (FINE_S / setpoint_lag_s if setpoint_lag_s else 1.0)
        total += integral * (smoothed - speed) * FINE_S
        torque = gain * (smoothed - speed) + total
        speed += (torque - 60.0 - 8.0 * speed) / 104.0 * FINE_S
        told += (speed - told) * (FINE_S / speed_lag_s if speed_lag_s else 1.0)
        if n % each == 30:
            rows.append((n * FINE_S, told + 0.003 * rng.standard_normal(), torque + 3.0 * rng.standard_normal()))
    time, seen, given = np.array(rows).T
    ends = time[first] + 0.001, time[time >= RAMP_S[1]][0]
    return recorded(
        time, seen, given, levels=(Level(0.0, ends[0]), Level(ends[1], END_S)), ramps=(Ramp(*ends),),
        stages=(Stage("speed", 0.0, END_S, "ok"),),
    )


@pytest.mark.parametrize("speed_lag_s", [0.0, 0.4])
@pytest.mark.parametrize(("gain", "integral"), [(300.0, 300.0), (500.0, 400.0), (200.0, 150.0)])
def test_the_gains_are_found(gain, integral, speed_lag_s):
    recording = ramped(gain, integral, speed_lag_s=speed_lag_s)
    found = speed_loop(recording, usable_samples(recording), speed_lag_s)
    assert abs(found.gain_nm_s_rad - gain) < 1.5 * found.gain_sd_nm_s_rad
    assert found.gain_sd_nm_s_rad < 0.15 * gain
    assert found.integral_gain_nm_rad == pytest.approx(integral, rel=0.15)


def test_a_drive_that_smooths_its_setpoint_is_not_read_as_a_plain_loop():
    recording = ramped(setpoint_lag_s=0.8)
    assert speed_loop(recording, usable_samples(recording), 0.0) is None


def test_without_a_ramp_of_stage_2_there_is_no_result():
    recording = ramped()
    samples = usable_samples(recording)
    for other in (replace(recording, ramps=()), replace(recording, levels=()), replace(recording, stages=())):
        assert speed_loop(other, samples, 0.0) is None
    assert speed_loop(recording, samples.between(0.0, 10.0), 0.0) is None

"""The plants of the coverage benchmark, small to large within each family.

Lags are those that drives state or show: 6.4/3.2 ms (Altivar), 30/8 ms and none (servo drives), a 100 ms average
(Sinamics), 0.5/0.1 s (ACS880), 0.40/0.15 s (what the paper's field slopes ask for). The noise of the field rig is that
of the design's notes and is scaled to the torque and speed of the others.
"""

from __future__ import annotations

from tdhil.studies.coverage.plants import Bend, CoveragePlant, Noise, Reading, Report

RPM = 0.10471975511965977   # rad/s

FIELD_NOISE = Noise(3.0, 0.5, 10.0, 0.02, 0.003, 2.0, 0.1 * RPM, 1.0)


def _lag(*lags_s: float, delay_s: float = 0.0, average_s: float = 0.0) -> Report:
    return Report(lags_s, average_s, delay_s)


FLEET: tuple[CoveragePlant, ...] = (
    CoveragePlant(
        "servo", "bare servo motor, 1 kHz CAN", 0.01, 0.002, 0.05, (20.0, 200.0), 3.0,
        _lag(0.030), _lag(0.008), Noise(0.01, 0.05, 0.05, 0.2, 0.02, 0.005, 0.1 * RPM, 0.003),
        Reading(rate_hz=1000.0, jitter_s=0.0001, command_s=0.001),
        lowest_hz=0.5, step_s=0.0005, motor_lag_s=0.001, model_true=True,
    ),
    CoveragePlant(
        "unfiltered", "servo axis that filters nothing", 0.8, 0.05, 1.5, (10.0, 100.0), 60.0,
        _lag(), _lag(), Noise(0.3, 0.3, 1.0, 0.05, 0.01, 0.1, 0.1 * RPM, 0.05),
        Reading(rate_hz=250.0, command_s=0.004), lowest_hz=0.2, motor_lag_s=0.002, model_true=True, degenerate=True,
    ),
    CoveragePlant(
        "coarse", "speed in whole rpm, torque in percent, one sample in twenty lost", 12.0, 0.6, 10.0, (5.0, 60.0),
        200.0, _lag(0.12), _lag(0.03), Noise(1.0, 0.4, 3.0, 0.05, 0.01, 0.5, 1.0 * RPM, 2.0),
        Reading(rate_hz=100.0, jitter_s=0.002, dropped=0.05), lowest_hz=0.2, model_true=True,
    ),
    CoveragePlant(
        "field", "the notes' field-like rig", 104.0, 8.0, 60.0, (0.5, 10.0), 400.0,
        _lag(0.40), _lag(0.15), FIELD_NOISE, Reading(jitter_s=0.004), model_true=True,
    ),
    CoveragePlant(
        "long_filter", "a speed filter twice as long as the field rig's", 104.0, 8.0, 60.0, (0.5, 10.0), 400.0,
        _lag(0.80), _lag(0.15), FIELD_NOISE, Reading(jitter_s=0.004), model_true=True,
    ),
    CoveragePlant(
        "skewed", "speed 40 ms late besides its lag", 250.0, 15.0, 90.0, (0.5, 12.0), 900.0,
        _lag(0.20, delay_s=0.040), _lag(0.10), Noise(8.0, 0.8, 20.0, 0.02, 0.004, 4.0, 0.1 * RPM, 2.0),
        Reading(rate_hz=250.0, jitter_s=0.001, command_s=0.004), model_true=True,
    ),
    CoveragePlant(
        "paper", "the paper's simulated inertia", 900.0, 74.3, 82.4, (1.0, 11.0), 4500.0,
        _lag(0.25), _lag(0.10), Noise(25.0, 0.5, 60.0, 0.01, 0.003, 10.0, 0.1 * RPM, 5.0),
        Reading(jitter_s=0.004), model_true=True,
    ),
    CoveragePlant(
        "heavy", "large top drive, filters at a drive's defaults", 3000.0, 120.0, 400.0, (0.5, 12.0), 6000.0,
        _lag(0.50), _lag(0.10), Noise(60.0, 1.5, 120.0, 0.01, 0.003, 30.0, 0.1 * RPM, 20.0),
        Reading(rate_hz=50.0, jitter_s=0.005, command_s=0.02), lowest_hz=0.05, model_true=True,
    ),
    CoveragePlant(
        "matched", "equal lags on both reports, 5 ms skew", 104.0, 8.0, 60.0, (0.5, 10.0), 400.0,
        _lag(0.15), _lag(0.15, delay_s=0.005), FIELD_NOISE, Reading(jitter_s=0.004), model_true=True, degenerate=True,
    ),
    CoveragePlant(
        "two_poles", "speed through two unequal poles", 60.0, 4.0, 40.0, (1.0, 20.0), 400.0,
        _lag(0.20, 0.07), _lag(0.10), Noise(3.0, 0.5, 8.0, 0.02, 0.004, 2.0, 0.1 * RPM, 1.0), Reading(jitter_s=0.004),
    ),
    CoveragePlant(
        "average", "speed as a moving average", 180.0, 12.0, 70.0, (0.5, 12.0), 700.0,
        _lag(average_s=0.40), _lag(0.08), Noise(6.0, 0.5, 15.0, 0.02, 0.003, 3.0, 0.1 * RPM, 2.0),
        Reading(jitter_s=0.003),
    ),
    CoveragePlant(
        "average_lag", "speed as a moving average behind a lag", 104.0, 8.0, 60.0, (0.5, 10.0), 400.0,
        _lag(0.10, average_s=0.50), _lag(0.15), FIELD_NOISE, Reading(jitter_s=0.004),
    ),
    CoveragePlant(
        "both_averages", "two moving averages of different length", 30.0, 1.5, 25.0, (2.0, 30.0), 300.0,
        _lag(average_s=0.30), _lag(average_s=0.10), Noise(2.0, 0.4, 5.0, 0.03, 0.004, 1.0, 0.1 * RPM, 0.5),
        Reading(rate_hz=250.0, jitter_s=0.001, command_s=0.004), lowest_hz=0.2,
    ),
    CoveragePlant(
        "modbus", "10 Hz, speed read 40 ms before torque, stamps to 5 ms, command in steps of 0.1 s", 350.0, 20.0,
        150.0, (0.5, 12.0), 1200.0, _lag(0.30), _lag(0.10),
        Noise(10.0, 0.6, 25.0, 0.02, 0.003, 5.0, 0.1 * RPM, 3.0),
        Reading(10.0, 0.010, 0.005, -0.020, 0.020, 0.0, 0.1),
    ),
    CoveragePlant(
        "torque_average", "torque as a moving average, longer than the speed's lag", 104.0, 8.0, 60.0, (0.5, 10.0),
        400.0, _lag(0.20), _lag(average_s=0.60), FIELD_NOISE, Reading(jitter_s=0.004),
    ),
    CoveragePlant(
        "torque_poles", "torque through two equal poles", 104.0, 8.0, 60.0, (0.5, 10.0), 400.0,
        _lag(0.10), _lag(0.25, 0.25), FIELD_NOISE, Reading(jitter_s=0.004),
    ),
    CoveragePlant(
        "long_poles", "speed through two long poles", 104.0, 8.0, 60.0, (0.5, 10.0), 400.0,
        _lag(0.50, 0.30), _lag(0.15), FIELD_NOISE, Reading(jitter_s=0.004),
    ),
    CoveragePlant(
        "three_poles", "speed through three poles, one more than any model has", 104.0, 8.0, 60.0, (0.5, 10.0), 400.0,
        _lag(0.20, 0.20, 0.20), _lag(0.15), FIELD_NOISE, Reading(jitter_s=0.004),
    ),
    CoveragePlant(
        "dead_time", "speed merely late, by 0.3 s", 104.0, 8.0, 60.0, (0.5, 10.0), 400.0,
        _lag(delay_s=0.30), _lag(), FIELD_NOISE, Reading(jitter_s=0.004),
    ),
    CoveragePlant(
        "long_average", "speed as a moving average over 1 s", 104.0, 8.0, 60.0, (0.5, 10.0), 400.0,
        _lag(average_s=1.0), _lag(0.15), FIELD_NOISE, Reading(jitter_s=0.004),
    ),
    CoveragePlant(
        "crossed", "the long lag on torque, a short one on speed", 40.0, 3.0, 30.0, (1.0, 20.0), 300.0,
        _lag(0.10), _lag(0.40), Noise(2.0, 0.5, 6.0, 0.02, 0.004, 1.5, 0.1 * RPM, 0.8), Reading(jitter_s=0.004),
    ),
    CoveragePlant(
        "modbus_poles", "10 Hz, instants 40 ms apart, speed through two poles", 350.0, 20.0, 150.0, (0.5, 12.0), 1200.0,
        _lag(0.30, 0.10), _lag(0.10), Noise(10.0, 0.6, 25.0, 0.02, 0.003, 5.0, 0.1 * RPM, 3.0),
        Reading(10.0, 0.010, 0.005, -0.020, 0.020, 0.0, 0.1),
    ),
    CoveragePlant(
        "stribeck", "friction that falls by 24 N·m from rest to 3 rad/s, then rises", 104.0, 8.0, 60.0, (0.5, 10.0),
        400.0, _lag(0.40), _lag(0.15), FIELD_NOISE, Reading(jitter_s=0.004), bend=Bend(24.0, 1.5),
    ),
    CoveragePlant(
        "fan", "half of the friction's slope goes with the square of speed", 104.0, 4.0, 60.0, (0.5, 10.0), 400.0,
        _lag(0.40), _lag(0.15), FIELD_NOISE, Reading(jitter_s=0.004), bend=Bend(square_nm_s2_rad2=0.6),
    ),
)

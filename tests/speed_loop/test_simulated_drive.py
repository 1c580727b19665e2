"""Predicted step response, compared with the simulated drive, which shares no code with the prediction."""

from __future__ import annotations

import numpy as np
import pytest

from sim_bus.inverter import Inverter
from sim_bus.params import FAITHFUL, QUIET, DriveParams, RigParams
from tdhil.speed_loop import PiGains, Range, SpeedLoopCase, StepFigures, UncertainPlant, design_speed_loop, step_figures

MEAN_RAD_S, STEP_RAD_S = 4.0, 0.1
RIG = RigParams()
KNOWN = UncertainPlant(
    Range(RIG.plant.inertia_kg_m2, 0.99 * RIG.plant.inertia_kg_m2, 1.01 * RIG.plant.inertia_kg_m2),
    Range(RIG.plant.viscous_nm_s_rad, 0.95 * RIG.plant.viscous_nm_s_rad, 1.05 * RIG.plant.viscous_nm_s_rad),
    (Range(0.02, 0.019, 0.021), Range(0.01, 0.0095, 0.0105)), Range(0.001, 0.0, 0.003))


def simulated(gains: PiGains) -> StepFigures:
    """Return the figures of the simulated drive's true speed after a small step under these gains."""
    drive = DriveParams(torque_limit_nm=900.0, speed_gain_nm_s_rad=gains.gain_nm_s_rad,
                        speed_integral_gain_nm_rad=gains.integral_nm_rad)
    inverter = Inverter(RigParams(drive=drive, noise=QUIET, reporting=FAITHFUL), np.random.default_rng(1))
    period_s = drive.control_period_s
    inverter.control.speed(MEAN_RAD_S, 1.0, 1.0)
    for _ in range(round(14.0 / period_s)):
        inverter.step(period_s)
    inverter.control.speed(MEAN_RAD_S + STEP_RAD_S)
    speeds = [inverter.speed_rad_s]
    for _ in range(round(6.0 / period_s)):
        inverter.step(period_s)
        speeds.append(inverter.speed_rad_s)
    assert speeds[0] == pytest.approx(MEAN_RAD_S, abs=1e-4)
    return step_figures(period_s * np.arange(len(speeds)), (np.array(speeds) - MEAN_RAD_S) / STEP_RAD_S)


@pytest.mark.parametrize("bandwidth_hz", [None, 1.5])
def test_the_simulated_drive_steps_as_predicted(bandwidth_hz):
    row = design_speed_loop(SpeedLoopCase(KNOWN, bandwidth_hz=bandwidth_hz)).tuned
    found = simulated(row.gains)
    assert row.overshoot_share.low <= found.overshoot_share <= row.overshoot_share.high
    assert row.rise_s.low <= found.rise_s <= row.rise_s.high
    assert row.settling_s.low - 0.01 <= found.settling_s <= row.settling_s.high + 0.01


@pytest.mark.parametrize("factor", [0.7, 1.3])
def test_gains_with_an_error_of_30_percent_do_not_step_as_predicted(factor):
    row = design_speed_loop(SpeedLoopCase(KNOWN)).tuned
    found = simulated(PiGains(factor * row.gains.gain_nm_s_rad, row.gains.integral_nm_rad))
    assert not row.rise_s.low <= found.rise_s <= row.rise_s.high

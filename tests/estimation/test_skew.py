"""Time offset between speed and torque of a foreign trace: stated by the user, or uncertain within the sampling."""

import numpy as np
import pytest

import tdhil
from tdhil.recording import LagPrior
from tests.estimation.analytic import closed_form

STATED = LagPrior(0.40, 0.005, 0.15, 0.005, "the drive")
TONE = """
kind: sine
segments:
  - {start_s: 0.0, periods: 7, period_s: 10.0, offset_rad_s: 4.0, lines_hz: [0.2]}
"""


@pytest.fixture
def tone(tmp_path):
    """Return a trace of one tone with ten samples per second and torque read 60 ms late, and its excitation."""
    recording = closed_form(offsets=(4.0,), lines=(0.2,), amplitudes=(1.5,), skew=0.060, rate_hz=10.0, noise=1.0)
    rows = np.column_stack([recording.time_s, recording.speed_rad_s, recording.torque_nm])
    np.savetxt(tmp_path / "tone.csv", rows, "%.9g", ",", header="time_s,speed_rad_s,torque_nm", comments="")
    (tmp_path / "excitation.yaml").write_text(TONE)
    return {"path": tmp_path / "tone.csv", "excitation": tmp_path / "excitation.yaml", "lags": STATED}


def test_a_tone_with_late_torque_is_covered_and_the_result_states_the_assumption(tone):
    inertia = tdhil.identify(tdhil.read(**tone)).inertia
    assert inertia.low <= 104.0 <= inertia.high
    assert "speed and torque simultaneous to 100 ms (1 sd)" in inertia.conditional_on


def test_a_known_skew_may_be_stated(tone):
    wide = tdhil.identify(tdhil.read(**tone)).inertia
    sharp = tdhil.identify(tdhil.read(**tone, skew_sd_s=0.005)).inertia
    assert "speed and torque simultaneous to 5 ms (1 sd)" in sharp.conditional_on
    assert sharp.high - sharp.low < 0.5 * (wide.high - wide.low)

"""What a plan should bring, before it is run: the lines and levels that its motion and the noise lead to."""

from __future__ import annotations

import numpy as np

from tdhil.estimation.frequency_domain.friction_levels import Levels
from tdhil.estimation.frequency_domain.signal_filters import SPEED_LAG
from tdhil.estimation.frequency_domain.spectrum import Line
from tdhil.protocol.design.noise import RIGID, Noise
from tdhil.recording.recording import FloatArray, LagPrior
from tdhil.run.design.prediction import Evidence, Fitted, noise_free, safe_half_width
from tdhil.run.excitation import Plan


def predicted(plan: Plan, theta: FloatArray, noise: Noise, prior: LagPrior) -> Evidence:
    """Lines without noise and the covariance to be expected of them.

    In torque mode the disturbance shows in speed alone (torque is what the host commands), in speed mode in torque
    alone; either way T − G W has the variance 4 S/L of `noise`.
    """
    reference = plan.segments[0].reference
    hertz = np.array(reference.lines_hz)
    s = 2j * np.pi * hertz.astype(np.complex128)
    g = RIGID.impedance(theta, s)
    counts = np.array([float(segment.periods - segment.settle_periods) for segment in plan.segments])
    nu = float(np.sum(counts - 1.0))
    variance = 4.0 * noise.error_density(hertz, theta) / reference.period_s
    amplitudes = np.array([segment.reference.amplitudes_rad_s for segment in plan.segments])
    seen = amplitudes / (1.0 + s * theta[RIGID.at(SPEED_LAG)]) * plan.followed(hertz)
    in_speed = plan.mode == "torque"
    lines = []
    for k, line_hz in enumerate(reference.lines_hz):
        gain = float(abs(g[k])) ** 2
        s_ww, s_tt = (variance[k] / gain, 1e-6 * variance[k]) if in_speed else (1e-6 * variance[k] / gain, variance[k])
        lines.append(Line(line_hz, seen[:, k], g[k] * seen[:, k], counts, float(s_ww), float(s_tt), 0j, nu))
    speeds = np.array([segment.reference.offset_rad_s for segment in plan.segments])
    torques = np.array([segment.reference.mean_torque_nm for segment in plan.segments])
    still = float(noise.error_density(np.zeros(1), theta)[0])
    levels = Levels(speeds, torques, np.zeros(len(speeds)), counts * reference.period_s, still, nu)
    return noise_free(Evidence(tuple(lines), levels, prior), Fitted(theta, 0.0))


def expected_half_width(plan: Plan, theta: FloatArray, noise: Noise, prior: LagPrior, confidence: float) -> float:
    """Of J, as a share of J, after the plan as it stands, other lags than the true ones allowed for."""
    return safe_half_width(predicted(plan, theta, noise, prior), confidence)

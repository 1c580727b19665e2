"""A quick figure for the search: the Cramér-Rao bound of J, the structure of the lags being open.

The lines' information about the rigid model's theta = (J, B; τ_w, ρ_w, τ_T, ρ_T, u, d), whose last six are the family
of `identify.reports`: first-order lags, two poles, moving averages, delays. Shapes ρ and averages u are bounded rather
than unknown; here they count as known to about their bounds. So a high line buys little: what it says of J it first has
to say of the structure.
"""

from __future__ import annotations

import math

import numpy as np

from tdhil.estimation.frequency_domain import signal_filters
from tdhil.estimation.frequency_domain.shafts import VISCOUS
from tdhil.protocol.design.noise import RIGID, Noise
from tdhil.recording.recording import FloatArray, LagPrior
from tdhil.run.excitation import Plan

_SKEW_SD_S = 0.3
_AVERAGE_SHARE = 4.0       # u of an average that delays as long as the longest lag τ: (2 τ)²
_CERTAIN = 1e-4


def relative_sd(plan: Plan, theta: FloatArray, noise: Noise, prior: LagPrior) -> float:
    """Least standard deviation of J after the plan, as a share of J; infinite where J can't be told."""
    first = plan.segments[0]
    period = first.reference.period_s
    hertz = np.array(first.reference.lines_hz)
    s = 2j * np.pi * hertz.astype(np.complex128)
    _, columns = RIGID.impedance_jacobian(theta, s)
    variance = 4.0 * noise.error_density(hertz, theta) / period
    counts = np.array([segment.periods - segment.settle_periods for segment in plan.segments], dtype=np.float64)
    nu = float(np.sum(counts - 1.0))
    if nu < 2.0:
        return math.inf
    amplitudes = np.array([segment.reference.amplitudes_rad_s for segment in plan.segments])
    seen = amplitudes * np.abs(plan.followed(hertz) / (1.0 + s * theta[RIGID.at(signal_filters.SPEED_LAG)]))
    weight = 2.0 * (counts @ seen**2) / variance * (nu - 1.0) / nu
    fisher = np.einsum("k,ki,kj->ij", weight, columns.conj(), columns).real
    fisher[VISCOUS, VISCOUS] += _tie(plan, counts * period, float(noise.error_density(np.zeros(1), theta)[0]))
    for index, sd in _known(theta, prior).items():
        fisher[RIGID.at(index), RIGID.at(index)] += sd**-2.0
    scale = 1.0 / np.sqrt(np.maximum(np.diag(fisher), 1e-300))
    try:
        bound = float(np.linalg.inv(fisher * np.outer(scale, scale))[0, 0])
    except np.linalg.LinAlgError:
        return math.inf
    return math.sqrt(bound) * float(scale[0]) / float(theta[0]) if bound > 0.0 else math.inf


def _tie(plan: Plan, durations: FloatArray, density: float) -> float:
    """1/sd² of B from the mean torque at the mean speeds."""
    speeds = np.array([segment.reference.offset_rad_s for segment in plan.segments])
    centred = speeds - np.sum(durations * speeds) / np.sum(durations)
    return float(np.sum(durations * centred**2) / density)


def _known(theta: FloatArray, prior: LagPrior) -> dict[int, float]:
    """Standard deviations to begin with, of the reports' parameters: stated, or about the bounds of the fit."""
    lags = theta[[RIGID.at(signal_filters.SPEED_LAG), RIGID.at(signal_filters.TORQUE_LAG)]]
    longest = max(float(np.max(lags)), 1e-3)
    speed, torque = prior.speed_lag_s is not None, prior.torque_lag_s is not None
    return {
        signal_filters.SPEED_LAG: max(prior.speed_lag_sd_s, _CERTAIN) if speed else signal_filters.LAG_BOUND_S,
        signal_filters.SPEED_SHAPE: _CERTAIN if speed else signal_filters.SHAPE_BOUND,
        signal_filters.TORQUE_LAG: max(prior.torque_lag_sd_s, _CERTAIN) if torque else signal_filters.LAG_BOUND_S,
        signal_filters.TORQUE_SHAPE: _CERTAIN if torque else signal_filters.SHAPE_BOUND,
        signal_filters.AVERAGE: _CERTAIN**2 if speed and torque else _AVERAGE_SHARE * longest**2,
        signal_filters.SKEW: _SKEW_SD_S,
    }

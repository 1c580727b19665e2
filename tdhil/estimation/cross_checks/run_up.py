"""J from the run-up of stage 2, from a low speed to the first steady speed.

The momentum balances leave out the run-up, because friction below the first steady speed is unknown. If the scale of
torque or speed changes right after the run-up, all balances have the new scale and agree with a wrong J. The run-up has
the old scale. At its ends the acceleration changes quickly at a nearly constant speed. So J does not depend much on
friction there.

The torque T passes through the lag of the speed report, and the speed ω through that of the torque report. Both then
have the same lag. Means over blocks give J, B and T_c by least squares:

    T = J Δω/Δt + B ω + T_c.

The variance of a block is the larger of its residual and the disturbance between the periods of stage 5.
"""

import math

import numpy as np

from tdhil.estimation.cross_checks.momentum import block_means, calm_spans, periodic_segments
from tdhil.estimation.cross_checks.momentum_fit import Delay, Density, MomentumFit
from tdhil.estimation.cross_checks.speed_loop import lagged
from tdhil.estimation.frequency_domain import CERTAIN, student_quantile
from tdhil.estimation.samples import Samples, usual_interval
from tdhil.estimation.setpoint_sampling import ReadingShare
from tdhil.recording import FloatArray, Recording

_BLOCK_S = 0.25           # s; length of a block
_FILTER_S = 2.0           # s; time before stage 2 in which the lags forget their first sample
_STEADY_S = 3.0           # s; time at the first steady speed that is used
_LEAST_SPEED = 0.15       # of the first steady speed: below it friction may depend strongly on speed (Stribeck)
_FEWEST = 8               # fewest blocks
_MOST_NOISE = 0.1
"""Largest share of noise in the part of Δω/Δt that determines J. Noise of a regressor makes J too small by this share:
by half on seed 441 of `benchmarks/healthy_runs.py`."""
_MODEL_SD = 0.05
"""Standard uncertainty of J due to nonlinear friction and filters of more than one pole, as a share of J. On 48 healthy
rigs without a string, J of the run-up was at most 1.3 standard uncertainties off (`benchmarks/healthy_runs.py`)."""


def run_up_inertia(
    recording: Recording, samples: Samples, lags_s: tuple[float, float], delay: Delay, levels: Density,
    confidence: float, reading: ReadingShare,
) -> MomentumFit | None:
    """Return J by the run-up of stage 2; None without a run-up, or if it does not determine J well.

    ``lags_s``: lags for torque and speed, s, that make their lags equal. ``delay``: its uncertainty adds to that of J.
    ``levels``: density of the disturbance. ``reading``: share of J that reading in step with a speed setpoint may add,
    all of it as an uncertainty. Raises LinAlgError for a singular system.
    """
    blocks = block_means(samples)
    begun = next((stage.start_s for stage in recording.stages if stage.name == "speed"), None)
    if blocks is None or begun is None:
        return None
    calm = next((span for span in calm_spans(blocks, periodic_segments(recording)) if span.start_s > begun), None)
    if calm is None:
        return None
    part = samples.between(begun - _FILTER_S, min(calm.end_s, calm.start_s + _STEADY_S))
    interval_s = usual_interval(part.time_s)
    steady = float(np.mean(part.speed_rad_s[part.time_s >= calm.start_s]))
    per_block = max(2, round(_BLOCK_S / interval_s))

    def solved(more_s: float) -> tuple[FloatArray, FloatArray, float, int, float] | None:
        """Return J, B and T_c, their covariance for blocks of unit variance, the residual, the number of blocks, and
        the share of noise in Δω/Δt.
        """
        torque = lagged(part.torque_nm, interval_s, lags_s[0] + more_s)
        speed = lagged(part.speed_rad_s, interval_s, lags_s[1])
        slow = np.flatnonzero(
            (part.time_s < begun) | (speed * np.sign(steady) <= _LEAST_SPEED * abs(steady)))
        edges = np.arange(int(slow[-1]) + 1 if len(slow) else 0, len(part), per_block)
        if len(edges) <= _FEWEST:
            return None
        steps, took_s = np.diff(part.time_s), np.diff(part.time_s[edges])
        travel, impulse = (np.diff(np.append(0.0, np.cumsum(0.5 * (signal[1:] + signal[:-1]) * steps))[edges]) / took_s
                           for signal in (speed, torque))
        design = np.column_stack([np.diff(speed[edges]) / took_s, travel, np.ones(len(took_s))])
        spread = np.linalg.inv(design.T @ design)
        x = spread @ design.T @ impulse
        noise = float(np.var(design[part.time_s[edges[:-1]] >= calm.start_s, 0])) * len(took_s) * float(spread[0, 0])
        return x, spread, float(np.sum((impulse - design @ x) ** 2)), len(took_s), noise

    fitted, later = solved(0.0), solved(delay.sd_s)
    if fitted is None or later is None or not fitted[0][0] > 0.0:
        return None
    x, spread, rest, count, noise = fitted
    if not noise <= _MOST_NOISE:
        return None
    dof, block_s = float(count - 3), per_block * interval_s
    density = Density(max(rest / dof * block_s, levels.value), dof)
    inertia = float(x[0])
    shifted = abs(float(later[0][0] - x[0]))
    half = noise * inertia + math.hypot(
        student_quantile(confidence, dof) * math.sqrt(density.value / block_s * float(spread[0, 0])),
        student_quantile(confidence, CERTAIN) * math.hypot(shifted, math.hypot(reading.value, reading.sd) * inertia),
    )
    return MomentumFit(inertia, half, shifted, float(x[1]), 1, density, _MODEL_SD * inertia)

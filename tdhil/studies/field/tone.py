"""Evaluation of one recorded sine: input and output amplitude, and the paper's scatter of torque over acceleration."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from tdhil.estimation import (
    STEP_S,
    LineFit,
    Samples,
    excited_window,
    paper_estimate,
    period_lines,
    stretches,
    usable_samples,
)
from tdhil.recording import FloatArray, Recording
from tdhil.studies.field.bench import FieldBench, FieldRun, part_of
from tdhil.studies.field.settings import AmplitudeSettings, ScatterSettings
from tdhil.studies.study import Progress

if TYPE_CHECKING:
    from matplotlib.axes import Axes


# ---------------------------------------------------------------------------------------------------------------------
# Style of the plots of the field studies: colours, grid, the mark of a published number.


COLOURS = ("#1f5fa8", "#d1642a", "#2e8b57", "#8b3fa0", "#a08020", "#3aa0b5", "#7a7a7a")
PUBLISHED_STYLE: dict[str, Any] = {
    "color": "black", "marker": "D", "linestyle": "none", "markersize": 6, "markerfacecolor": "none"
}
"""Style of published numbers in every plot: hollow black diamonds."""


def tidy(axes: Axes, x: str, y: str, title: str = "") -> None:
    """Set labels and a light grid, and remove the frame."""
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    if title:
        axes.set_title(title, fontsize=10)
    axes.grid(True, color="#dddddd", linewidth=0.6)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def colour(index: int) -> str:
    """Return the colour of an index, the same in every panel."""
    return COLOURS[index % len(COLOURS)]


# ---------------------------------------------------------------------------------------------------------------------

SETTLE_S = 10.0


@dataclass(frozen=True)
class Amplitudes:
    """Amplitudes of the commanded and the reported speed, rad/s; ``sd_rad_s`` is the output's standard deviation."""

    input_rad_s: float
    output_rad_s: float
    sd_rad_s: float
    limited: float                     # share of the samples with the drive at a limit

    @property
    def difference_rad_s(self) -> float:
        """Input minus output amplitude; negative for an overshoot of the output."""
        return self.input_rad_s - self.output_rad_s


@dataclass(frozen=True)
class Scatter:
    """Points (N,) of figure 22, and the straight line through them (equations 7 and 16)."""

    acceleration_rad_s2: FloatArray
    torque_nm: FloatArray
    fit: LineFit


def periods_for(frequency_hz: float, measured_s: float) -> int:
    """Return the number of whole periods: settling, and at least three that count."""
    return max(1, math.ceil(SETTLE_S * frequency_hz - 1e-9)) + max(3, round(measured_s * frequency_hz))


def sine_run(
    settings: AmplitudeSettings | ScatterSettings, hertz: float, kp: float, ki: float, seed: int
) -> FieldRun:
    """Return a run with a sine of the study's amplitude about its mean speed, for its measuring time."""
    return FieldRun(
        settings.rig, hertz, kp, ki, seed, amplitude_rad_s=settings.amplitude_rad_s,
        offset_rad_s=settings.offset_rad_s, periods=periods_for(hertz, settings.measured_s), rate_hz=settings.rate_hz,
        torque_limit_nm=settings.torque_limit_nm,
    )


def swept_amplitudes(
    bench: FieldBench, settings: AmplitudeSettings, runs: Sequence[tuple[float, float, float, str]], progress: Progress
) -> tuple[tuple[Amplitudes, ...], float]:
    """Run each (frequency, P, I, name), each with its own seed. Return the amplitudes and the simulated seconds."""
    found, simulated_s = [], 0.0
    for index, (hertz, kp, ki, text) in enumerate(runs):
        wish = sine_run(settings, hertz, kp, ki, settings.seed + index)
        recording = bench.run(wish, part_of(progress, index, len(runs), text))
        found.append(amplitudes(recording))
        simulated_s += float(recording.time_s[-1] - recording.time_s[0])
    return tuple(found), simulated_s


def excited(recording: Recording) -> Samples:
    """Return the samples after settling, of a recording with one segment."""
    assert recording.excitation is not None
    (segment,) = recording.excitation.segments
    return usable_samples(recording).between(*excited_window(segment))


def amplitudes(recording: Recording) -> Amplitudes:
    """Return the amplitude from the Fourier coefficient of each whole period, averaged over the periods."""
    assert recording.excitation is not None
    samples = usable_samples(recording)
    (stretch,) = stretches(samples, recording.excitation.segments)
    lines = period_lines(stretch, samples).speed[:, 0]
    start, end = excited_window(stretch.segment)
    inside = (recording.time_s >= start) & (recording.time_s < end)
    count = len(lines)
    scatter = float(np.sum(np.abs(lines - lines.mean()) ** 2)) / max(1, count - 1)
    return Amplitudes(
        input_rad_s=stretch.segment.amplitudes_rad_s[0],
        output_rad_s=float(np.abs(lines.mean())),
        sd_rad_s=math.sqrt(0.5 * scatter / count),
        limited=float(np.mean(recording.limited[inside])),
    )


def line_slope(recording: Recording) -> float:
    """Return the slope at the excited frequency, kg·m²: Re T/(jω W) of the Fourier coefficients, mean over the periods.

    Least squares on the scatter tends to this slope without noise in α.
    """
    assert recording.excitation is not None
    samples = usable_samples(recording)
    (stretch,) = stretches(samples, recording.excitation.segments)
    lines = period_lines(stretch, samples)
    omega = 2.0 * math.pi * stretch.segment.lines_hz[0]
    return float((lines.torque[:, 0].mean() / (1j * omega * lines.speed[:, 0].mean())).real)


def scatter(recording: Recording) -> Scatter:
    """Return Δω over 0.1 s against the mean torque of the same 0.1 s, with the line fit of the identification."""
    samples = excited(recording)
    estimate = paper_estimate((samples,))
    assert estimate is not None, "a recorded sine has samples"
    edges = np.arange(samples.time_s[0], samples.time_s[-1], STEP_S)
    at = np.clip(np.searchsorted(samples.time_s, edges - 1e-6), 0, len(samples) - 1)
    width = np.diff(samples.time_s)
    impulse = np.concatenate(([0.0], np.cumsum(0.5 * (samples.torque_nm[1:] + samples.torque_nm[:-1]) * width)))
    length = np.diff(samples.time_s[at])
    return Scatter(np.diff(samples.speed_rad_s[at]) / length, np.diff(impulse[at]) / length, estimate.stepped)

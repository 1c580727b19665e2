"""Figure 23: amplitude of the speed, in and out, over the tone: a low-pass."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tdhil.studies.field.bench import FieldBench, FieldRun, part_of
from tdhil.studies.field.settings import ToneSweepSettings
from tdhil.studies.field.tone import Amplitudes, amplitudes, periods_for
from tdhil.studies.study import Progress, ResultTable, Statement, StudyOutcome
from tdhil.study.field_draw import PUBLISHED, colour, tidy
from tdhil.study.field_loop import gain

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PUBLISHED_OUTPUT = {0.1: 1.3492, 1.0: 0.0992}
"""Tone, Hz: output amplitude, rad/s."""
PUBLISHED_DIFFERENCE = {1.0: 0.8414}


@dataclass
class ToneSweep:
    """`tdhil study figure23`."""

    bench: FieldBench
    name: str = "figure23"
    title: str = "Field rig: input and output amplitude over the tone"

    @property
    def settings_model(self) -> type[ToneSweepSettings]:
        return ToneSweepSettings

    def run(self, settings: ToneSweepSettings, progress: Progress) -> StudyOutcome:
        """One run a tone."""
        tones = sorted(settings.frequencies_hz)
        found, simulated_s = [], 0.0
        for index, hertz in enumerate(tones):
            wish = FieldRun(
                settings.rig, hertz, settings.kp_nm_s_rad, settings.ki_nm_rad, settings.seed + index,
                amplitude_rad_s=settings.amplitude_rad_s, offset_rad_s=settings.offset_rad_s,
                periods=periods_for(hertz, settings.measured_s), rate_hz=settings.rate_hz,
                torque_limit_nm=settings.torque_limit_nm,
            )
            recording = self.bench.run(wish, part_of(progress, index, len(tones), f"{hertz:g} Hz"))
            found.append(amplitudes(recording))
            simulated_s += float(recording.time_s[-1] - recording.time_s[0])
        columns = (
            "frequency_hz", "input_rad_s", "output_rad_s", "difference_rad_s", "output_sd_rad_s",
            "linear_loop_output_rad_s", "published_output_rad_s", "published_difference_rad_s", "share_at_limit",
        )
        rows = tuple(
            (hertz, a.input_rad_s, a.output_rad_s, a.difference_rad_s, a.sd_rad_s,
             a.input_rad_s * float(gain(settings.rig, hertz, settings.kp_nm_s_rad, settings.ki_nm_rad, reported=True)),
             PUBLISHED_OUTPUT.get(round(hertz, 6)), PUBLISHED_DIFFERENCE.get(round(hertz, 6)), a.limited)
            for hertz, a in zip(tones, found, strict=True)
        )
        return StudyOutcome(
            self.name, self.title, (ResultTable("amplitudes", columns, rows),), _statements(settings, tones, found),
            document={"runs": [dict(zip(columns, row, strict=True)) for row in rows]},
            simulated_s=simulated_s,
            draw=lambda figure: _draw(figure, settings, tones, found),
            figure_size_in=(11.0, 4.8),
        )


def closest_loop(settings: ToneSweepSettings) -> tuple[float, float, float, float]:
    """P and I within the published sweeps that come closest to the two published outputs with one input amplitude.

    Returns P, I and the outputs at 0.1 and 1 Hz, rad/s. Closest: least greater error of the two logarithms.
    """
    kp, ki = np.meshgrid(np.geomspace(150.0, 1500.0, 120), np.geomspace(200.0, 2500.0, 120), indexing="ij")
    low, high = (settings.amplitude_rad_s * gain(settings.rig, hertz, kp, ki, reported=True) for hertz in (0.1, 1.0))
    error = np.maximum(np.abs(np.log(low / PUBLISHED_OUTPUT[0.1])), np.abs(np.log(high / PUBLISHED_OUTPUT[1.0])))
    best = np.unravel_index(int(np.argmin(error)), error.shape)
    return float(kp[best]), float(ki[best]), float(low[best]), float(high[best])


def _statements(settings: ToneSweepSettings, tones: list[float], found: list[Amplitudes]) -> tuple[Statement, ...]:
    output = np.array([one.output_rad_s for one in found])
    difference = np.array([one.difference_rad_s for one in found])
    ratio = output / np.array([one.input_rad_s for one in found])
    kp, ki, low, high = closest_loop(settings)
    ends = f"from {tones[0]:g} to {tones[-1]:g} Hz"
    return (
        Statement(
            "the output falls steadily with the tone", "1.3492 to 0.0992 rad/s from 0.1 to 1 Hz",
            f"{output[0]:.4f} to {output[-1]:.4f} rad/s {ends}", bool(np.all(np.diff(output) < 0.0)),
        ),
        Statement(
            "input minus output grows with the tone", "small at low tones, 0.8414 rad/s at 1 Hz",
            f"{difference[0]:.4f} to {difference[-1]:.4f} rad/s {ends}; below zero where the loop overshoots",
            bool(np.all(np.diff(difference) > 0.0)),
        ),
        Statement(
            "it is a low-pass", "'consistent with a low-pass system'",
            f"gain {ratio[0]:.3f} at {tones[0]:g} Hz, {ratio[-1]:.3f} at {tones[-1]:g} Hz",
            bool(ratio[0] > 0.9 and ratio[-1] < 0.5 * ratio[0]),
        ),
        Statement(
            "output 1.3492 rad/s at 0.1 Hz and 0.0992 at 1 Hz", "input at 1 Hz: 0.0992 + 0.8414 = 0.9406 rad/s",
            f"{low:.3f} and {high:.4f} at best (P {kp:.0f}, I {ki:.0f}, linear loop): no loop with P and I in the "
            "published sweeps meets both; the input at 0.1 Hz must have been another, and is not given",
            None,
        ),
    )


def _draw(figure: Figure, settings: ToneSweepSettings, tones: list[float], found: list[Amplitudes]) -> None:
    left, right = figure.subplots(1, 2)
    grid = np.geomspace(min(tones), max(tones), 300)
    loop = settings.amplitude_rad_s * gain(settings.rig, grid, settings.kp_nm_s_rad, settings.ki_nm_rad, reported=True)
    left.plot(tones, [one.input_rad_s for one in found], "s-", color="#444444", markersize=4, label="input (commanded)")
    left.plot(tones, [one.output_rad_s for one in found], "o", color=colour(0), label="output (reported), on the bus")
    left.plot(grid, loop, color=colour(0), linewidth=1.2, label="linear loop")
    left.plot(list(PUBLISHED_OUTPUT), list(PUBLISHED_OUTPUT.values()), label="published output", **PUBLISHED)
    right.plot(tones, [one.difference_rad_s for one in found], "o", color=colour(1), label="on the bus")
    right.plot(grid, settings.amplitude_rad_s - loop, color=colour(1), linewidth=1.2, label="linear loop")
    right.plot(
        list(PUBLISHED_DIFFERENCE), list(PUBLISHED_DIFFERENCE.values()), label="published difference", **PUBLISHED
    )
    right.axhline(0.0, color="#888888", linewidth=0.8)
    title = f"P {settings.kp_nm_s_rad:g}, I {settings.ki_nm_rad:g}: input and output"
    tidy(left, "tone, Hz", "amplitude, rad/s", title)
    tidy(right, "tone, Hz", "input − output, rad/s", "Difference of the amplitudes")
    left.set_ylim(bottom=0.0)
    for axes in (left, right):
        axes.legend(fontsize=8)
    figure.tight_layout()

"""Figure 19: the paper's method at several P and I of the drive's speed loop.

A loop changes torque and acceleration equally. The slope at one frequency is therefore the same for every loop, except
for the reduction by noise in α if the motion is small. One loop is repeated with other seeds, to distinguish a
difference from chance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tdhil.recording import FloatArray
from tdhil.studies.field.bench import FieldBench, part_of
from tdhil.studies.field.settings import LoopPair, ScatterSettings, SimulatedRig, ToneSweepSettings
from tdhil.studies.field.tone import (
    PUBLISHED_STYLE,
    Amplitudes,
    Scatter,
    colour,
    scatter,
    sine_run,
    swept_amplitudes,
    tidy,
)
from tdhil.studies.study import Progress, ResultTable, Statement, StudyOutcome

if TYPE_CHECKING:
    from matplotlib.figure import Figure


# ---------------------------------------------------------------------------------------------------------------------
# Linear model of the drive's speed loop: theoretical amplitudes, for comparison with those from the bus.
#
# ::
#
#     reference ──►(+)──► K_p + K_i/s ──► 1/(1 + t s) ──► 1/(J s + B) ──┬──► speed ──► 1/(1 + τ_w s) ──► reported
#                   ▲(−)                                                │
#                   └────────────── 1/(1 + τ_f s) ◄─────────────────────┘
#
#     speed/reference = C P / (1 + C P F),    C = (K_p + K_i/s)/(1 + t s),  P = 1/(J s + B),  F = 1/(1 + τ_f s)
#
# Coulomb friction is constant while the shaft turns in one direction, and has no effect. K_p in N·m·s/rad, K_i in
# N·m/rad. This model is independent of the simulator, so agreement of the two is evidence.


def gain(
    rig: SimulatedRig, hertz: FloatArray | float, kp: FloatArray | float, ki: FloatArray | float, *, reported: bool
) -> FloatArray:
    """Return output over input amplitude, of the shaft or of the reported speed, broadcast over the arguments."""
    s = 2j * np.pi * np.asarray(hertz, dtype=np.float64)
    control = (np.asarray(kp) + np.asarray(ki) / s) / (1.0 + rig.loop_torque_lag_s * s)
    forward = control / (rig.inertia_kg_m2 * s + rig.viscous_nm_s_rad)
    closed = forward / (1.0 + forward / (1.0 + rig.loop_filter_s * s))
    if reported:
        closed = closed / (1.0 + rig.speed_lag_s * s)
    size: FloatArray = np.abs(np.asarray(closed, dtype=np.complex128))
    return size


def tones_with_steady_rise(rig: SimulatedRig, kp: float, ki_values: tuple[float, ...]) -> tuple[int, int]:
    """Return at how many of how many frequencies from 0.05 to 1 Hz |gain − 1| rises over ``ki_values`` (figure 21)."""
    tones = np.linspace(0.05, 1.0, 96)
    grid = np.linspace(min(ki_values), max(ki_values), 60)
    away = np.abs(gain(rig, tones[:, None], kp, grid[None, :], reported=True) - 1.0)
    return int(np.sum(np.all(np.diff(away, axis=1) > 0.0, axis=1))), len(tones)


def best_kp(rig: SimulatedRig, hertz: float, ki: float, low: float, high: float) -> float:
    """Return the P between ``low`` and ``high`` with the least |gain − 1| of the reported speed; possibly an end."""
    grid = np.geomspace(low, high, 400)
    return float(grid[int(np.argmin(np.abs(gain(rig, hertz, grid, ki, reported=True) - 1.0)))])


# ---------------------------------------------------------------------------------------------------------------------
# Figure 23: amplitude of the speed, input and output, over frequency: a low-pass.


PUBLISHED_OUTPUT = {0.1: 1.3492, 1.0: 0.0992}
"""Published output amplitude, rad/s, by frequency, Hz."""
PUBLISHED_DIFFERENCE = {1.0: 0.8414}


@dataclass
class ToneSweep:
    """Study `tdhil study figure23`."""

    bench: FieldBench
    name: str = "figure23"
    title: str = "Field rig: input and output amplitude over the tone"
    settings_model: type[ToneSweepSettings] = ToneSweepSettings

    def run(self, settings: ToneSweepSettings, progress: Progress) -> StudyOutcome:
        """Do one run for each frequency."""
        tones = sorted(settings.frequencies_hz)
        runs = [(hertz, settings.kp_nm_s_rad, settings.ki_nm_rad, f"{hertz:g} Hz") for hertz in tones]
        found, simulated_s = swept_amplitudes(self.bench, settings, runs, progress)
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
            self.name, self.title, (ResultTable("amplitudes", columns, rows),), _tone_texts(settings, tones, found),
            document={"runs": [dict(zip(columns, row, strict=True)) for row in rows]},
            simulated_s=simulated_s,
            draw=lambda figure: _draw_tones(figure, settings, tones, found),
            figure_size_in=(11.0, 4.8),
        )


def closest_loop(settings: ToneSweepSettings) -> tuple[float, float, float, float]:
    """Return P and I within the published sweeps that fit the two published outputs best, with one input amplitude.

    Returns P, I and the outputs at 0.1 and 1 Hz, rad/s. The best fit has the least larger error of the two logarithms.
    """
    kp, ki = np.meshgrid(np.geomspace(150.0, 1500.0, 120), np.geomspace(200.0, 2500.0, 120), indexing="ij")
    low, high = (settings.amplitude_rad_s * gain(settings.rig, hertz, kp, ki, reported=True) for hertz in (0.1, 1.0))
    error = np.maximum(np.abs(np.log(low / PUBLISHED_OUTPUT[0.1])), np.abs(np.log(high / PUBLISHED_OUTPUT[1.0])))
    best = np.unravel_index(int(np.argmin(error)), error.shape)
    return float(kp[best]), float(ki[best]), float(low[best]), float(high[best])


def _tone_texts(
    settings: ToneSweepSettings, tones: list[float], found: Sequence[Amplitudes]
) -> tuple[Statement, ...]:
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


def _draw_tones(
    figure: Figure, settings: ToneSweepSettings, tones: list[float], found: Sequence[Amplitudes]
) -> None:
    left, right = figure.subplots(1, 2)
    grid = np.geomspace(min(tones), max(tones), 300)
    loop = settings.amplitude_rad_s * gain(settings.rig, grid, settings.kp_nm_s_rad, settings.ki_nm_rad, reported=True)
    left.plot(tones, [one.input_rad_s for one in found], "s-", color="#444444", markersize=4, label="input (commanded)")
    left.plot(tones, [one.output_rad_s for one in found], "o", color=colour(0), label="output (reported), on the bus")
    left.plot(grid, loop, color=colour(0), linewidth=1.2, label="linear loop")
    left.plot(list(PUBLISHED_OUTPUT), list(PUBLISHED_OUTPUT.values()), label="published output", **PUBLISHED_STYLE)
    right.plot(tones, [one.difference_rad_s for one in found], "o", color=colour(1), label="on the bus")
    right.plot(grid, settings.amplitude_rad_s - loop, color=colour(1), linewidth=1.2, label="linear loop")
    right.plot(
        list(PUBLISHED_DIFFERENCE), list(PUBLISHED_DIFFERENCE.values()), label="published difference", **PUBLISHED_STYLE
    )
    right.axhline(0.0, color="#888888", linewidth=0.8)
    title = f"P {settings.kp_nm_s_rad:g}, I {settings.ki_nm_rad:g}: input and output"
    tidy(left, "tone, Hz", "amplitude, rad/s", title)
    tidy(right, "tone, Hz", "input − output, rad/s", "Difference of the amplitudes")
    left.set_ylim(bottom=0.0)
    for axes in (left, right):
        axes.legend(fontsize=8)
    figure.tight_layout()


# ---------------------------------------------------------------------------------------------------------------------

OUTSIDE = 3.0
"""Multiple of the spread of repeats from which slopes differ."""


@dataclass(frozen=True)
class FieldLoopRecord:
    """Result of one run."""

    loop: LoopPair
    seed: int
    points: Scatter
    span_s: float


@dataclass
class LoopScatter:
    """Study `tdhil study figure19`."""

    bench: FieldBench
    name: str = "figure19"
    title: str = "Field rig: torque over acceleration under different P and I"
    settings_model: type[ScatterSettings] = ScatterSettings

    def run(self, settings: ScatterSettings, progress: Progress) -> StudyOutcome:
        """Run every loop once, the first one ``repeats`` times."""
        wanted = [(loop, settings.seed) for loop in settings.loops]
        wanted += [(settings.loops[0], settings.seed + more) for more in range(1, settings.repeats)]
        records = []
        for index, (loop, seed) in enumerate(wanted):
            wish = sine_run(settings, settings.frequency_hz, loop.kp_nm_s_rad, loop.ki_nm_rad, seed)
            report = part_of(progress, index, len(wanted), f"P {loop.kp_nm_s_rad:g}, I {loop.ki_nm_rad:g}")
            recording = self.bench.run(wish, report)
            span_s = float(recording.time_s[-1] - recording.time_s[0])
            records.append(FieldLoopRecord(loop, seed, scatter(recording), span_s))
        loops, repeats = records[: len(settings.loops)], [records[0], *records[len(settings.loops) :]]
        rows = tuple(
            (r.loop.kp_nm_s_rad, r.loop.ki_nm_rad, r.seed, r.points.fit.inertia_kg_m2, r.points.fit.intercept_nm,
             r.points.fit.r2, float(np.std(r.points.acceleration_rad_s2)))
            for r in records
        )
        columns = ("kp_nm_s_rad", "ki_nm_rad", "seed", "slope_kg_m2", "intercept_nm", "r2", "acceleration_rms_rad_s2")
        return StudyOutcome(
            self.name, self.title, (ResultTable("loops", columns, rows),), _statements(settings, loops, repeats),
            document={"runs": [dict(zip(columns, row, strict=True)) for row in rows]},
            simulated_s=sum(record.span_s for record in records),
            draw=lambda figure: _draw(figure, loops, settings.frequency_hz),
            figure_size_in=(11.0, 5.0),
        )


def _statements(
    settings: ScatterSettings, loops: list[FieldLoopRecord], repeats: list[FieldLoopRecord]
) -> tuple[Statement, ...]:
    slopes = np.array([record.points.fit.inertia_kg_m2 for record in loops])
    chance = float(np.std([record.points.fit.inertia_kg_m2 for record in repeats], ddof=1))
    r2 = np.array([record.points.fit.r2 for record in loops])
    spread = float(np.ptp(slopes))
    tone = f"{settings.frequency_hz:g} Hz"
    verdict = spread > OUTSIDE * chance and spread > 0.05 * float(np.mean(slopes))
    return (
        Statement(
            "P and I change the fitted slope, and with it the inertia identified",
            "'distinct slopes'; no figures",
            f"{slopes.min():.1f} to {slopes.max():.1f} kg·m² at {tone}, {100 * spread / float(np.mean(slopes)):.1f} % "
            f"apart (repeats: sd {chance:.2f}); from 0.1 to 1 Hz the tone alone makes 72 %",
            verdict,
        ),
        Statement(
            "P and I change how closely the points cluster", "visible; no figures",
            f"r² {r2.min():.3f} to {r2.max():.3f}", bool(np.ptp(r2) > 0.005),
        ),
        Statement(
            "why distinct slopes can't be met", "no tone, amplitude or slope is given",
            "a loop moves torque and acceleration alike: at one tone T/α is the shaft's and the lags', whatever P and "
            "I are; slopes as in the paper's figure need different tones, or records with the start-up in them",
            None,
        ),
    )


def _draw(figure: Figure, loops: list[FieldLoopRecord], hertz: float) -> None:
    left, right = figure.subplots(1, 2, width_ratios=(1.5, 1.0))
    for index, record in enumerate(loops):
        alpha, fit = record.points.acceleration_rad_s2, record.points.fit
        left.plot(alpha, record.points.torque_nm, ".", color=colour(index), markersize=3, alpha=0.4,
                  rasterized=True)
        ends = np.array([alpha.min(), alpha.max()])
        name = f"P {record.loop.kp_nm_s_rad:g}, I {record.loop.ki_nm_rad:g}"
        label = f"{name}: T = {fit.inertia_kg_m2:.1f} α + {fit.intercept_nm:.1f}"
        left.plot(ends, fit.inertia_kg_m2 * ends + fit.intercept_nm, color=colour(index), linewidth=1.6, label=label)
    low, high = left.get_ylim()
    left.set_ylim(low, high + 0.35 * (high - low))
    left.legend(fontsize=8, loc="upper left")
    tidy(left, "reported acceleration α, rad/s²", "reported torque T, N·m", f"The paper's method at {hertz:g} Hz")
    names = [f"P {record.loop.kp_nm_s_rad:g}\nI {record.loop.ki_nm_rad:g}" for record in loops]
    slopes = [record.points.fit.inertia_kg_m2 for record in loops]
    right.bar(range(len(loops)), slopes, color=[colour(index) for index in range(len(loops))], width=0.6)
    right.set_xticks(range(len(loops)), names, fontsize=8)
    for index, slope in enumerate(slopes):
        right.text(index, slope, f"{slope:.1f}", ha="center", va="bottom", fontsize=8)
    right.set_ylim(0.0, 1.15 * max(slopes))
    tidy(right, "", "slope, kg·m²", "Slope by loop")
    figure.tight_layout()

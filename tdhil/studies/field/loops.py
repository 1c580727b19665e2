"""Figure 19: the paper's method at several P and I of the drive's speed loop.

What a loop does to the shaft, it does to torque and acceleration alike; so the slope at one tone is the same for every
loop, but for what noise in α takes off where the motion is small. One loop is run again with other seeds, to tell a
difference from chance.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tdhil.studies.field.bench import FieldBench, FieldRun, part_of
from tdhil.studies.field.settings import LoopPair, ScatterSettings
from tdhil.studies.field.tone import Scatter, periods_for, scatter
from tdhil.studies.study import Progress, ResultTable, Statement, StudyOutcome
from tdhil.study.field_draw import colour, tidy

if TYPE_CHECKING:
    from matplotlib.figure import Figure

OUTSIDE = 3.0
"""Slopes differ if they are further apart than so many times the spread of repeats."""


@dataclass(frozen=True)
class LoopRecord:
    """One run."""

    loop: LoopPair
    seed: int
    points: Scatter
    span_s: float


@dataclass
class LoopScatter:
    """`tdhil study figure19`."""

    bench: FieldBench
    name: str = "figure19"
    title: str = "Field rig: torque over acceleration under different P and I"

    @property
    def settings_model(self) -> type[ScatterSettings]:
        return ScatterSettings

    def run(self, settings: ScatterSettings, progress: Progress) -> StudyOutcome:
        """Every loop once, the first one ``repeats`` times."""
        wanted = [(loop, settings.seed) for loop in settings.loops]
        wanted += [(settings.loops[0], settings.seed + more) for more in range(1, settings.repeats)]
        records = []
        for index, (loop, seed) in enumerate(wanted):
            wish = FieldRun(
                settings.rig, settings.frequency_hz, loop.kp_nm_s_rad, loop.ki_nm_rad, seed,
                amplitude_rad_s=settings.amplitude_rad_s, offset_rad_s=settings.offset_rad_s,
                periods=periods_for(settings.frequency_hz, settings.measured_s), rate_hz=settings.rate_hz,
                torque_limit_nm=settings.torque_limit_nm,
            )
            report = part_of(progress, index, len(wanted), f"P {loop.kp_nm_s_rad:g}, I {loop.ki_nm_rad:g}")
            recording = self.bench.run(wish, report)
            span_s = float(recording.time_s[-1] - recording.time_s[0])
            records.append(LoopRecord(loop, seed, scatter(recording), span_s))
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
    settings: ScatterSettings, loops: list[LoopRecord], repeats: list[LoopRecord]
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
            f"{slopes.min():.1f} to {slopes.max():.1f} kg·m² at {tone}, {spread / float(np.mean(slopes)):.1%} apart "
            f"(repeats: sd {chance:.2f}); from 0.1 to 1 Hz the tone alone makes 72 %",
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


def _draw(figure: Figure, loops: list[LoopRecord], hertz: float) -> None:
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

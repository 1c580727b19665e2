"""Figures 20 and 21: amplitude of the speed, in and out, over P and over I of the drive's speed loop.

The output is what the drive reports. Where the loop overshoots and the reporting lag takes as much away, input and
output are equal: that is where |difference| is least. Both depend on the tone, which the paper doesn't give.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from tdhil.studies.field.bench import FieldBench, FieldRun, part_of
from tdhil.studies.field.settings import GainSweepSettings, KiSweepSettings, KpSweepSettings
from tdhil.studies.field.tone import Amplitudes, amplitudes, periods_for
from tdhil.studies.study import Progress, ResultTable, Statement, StudyOutcome
from tdhil.study.field_draw_gains import GainPicture, draw_gains
from tdhil.study.field_gains_said import said_of_ki, said_of_kp
from tdhil.study.field_loop import gain


@dataclass(frozen=True)
class GainSweep:
    """What came of a sweep: one run a value. ``loops`` are (P, I)."""

    loops: tuple[tuple[float, float], ...]
    found: tuple[Amplitudes, ...]
    simulated_s: float


@dataclass
class KpSweep:
    """`tdhil study figure20`."""

    bench: FieldBench
    name: str = "figure20"
    title: str = "Field rig: input and output amplitude over P"

    @property
    def settings_model(self) -> type[KpSweepSettings]:
        return KpSweepSettings

    def run(self, settings: KpSweepSettings, progress: Progress) -> StudyOutcome:
        """One run a P."""
        sweep = _swept(self.bench, settings, [(kp, settings.ki_nm_rad) for kp in settings.kp_values_nm_s_rad], progress)
        statements = said_of_kp(settings, settings.kp_values_nm_s_rad, sweep.found)
        return _outcome(self.name, self.title, settings, sweep, 0, statements, published=(300.0, None))


@dataclass
class KiSweep:
    """`tdhil study figure21`."""

    bench: FieldBench
    name: str = "figure21"
    title: str = "Field rig: input and output amplitude over I"

    @property
    def settings_model(self) -> type[KiSweepSettings]:
        return KiSweepSettings

    def run(self, settings: KiSweepSettings, progress: Progress) -> StudyOutcome:
        """One run an I."""
        sweep = _swept(self.bench, settings, [(settings.kp_nm_s_rad, ki) for ki in settings.ki_values_nm_rad], progress)
        statements = said_of_ki(settings, settings.ki_values_nm_rad, sweep.found)
        return _outcome(self.name, self.title, settings, sweep, 1, statements, published=(200.0, 0.0594))


def _swept(
    bench: FieldBench, settings: GainSweepSettings, loops: list[tuple[float, float]], progress: Progress
) -> GainSweep:
    found, simulated_s = [], 0.0
    for index, (kp, ki) in enumerate(loops):
        wish = FieldRun(
            settings.rig, settings.frequency_hz, kp, ki, settings.seed + index,
            amplitude_rad_s=settings.amplitude_rad_s, offset_rad_s=settings.offset_rad_s,
            periods=periods_for(settings.frequency_hz, settings.measured_s), rate_hz=settings.rate_hz,
            torque_limit_nm=settings.torque_limit_nm,
        )
        recording = bench.run(wish, part_of(progress, index, len(loops), f"P {kp:g}, I {ki:g}"))
        found.append(amplitudes(recording))
        simulated_s += float(recording.time_s[-1] - recording.time_s[0])
    return GainSweep(tuple(loops), tuple(found), simulated_s)


def _outcome(
    name: str, title: str, settings: GainSweepSettings, sweep: GainSweep, swept: int,
    statements: tuple[Statement, ...], published: tuple[float, float | None],
) -> StudyOutcome:
    columns = (
        "kp_nm_s_rad", "ki_nm_rad", "input_rad_s", "output_rad_s", "difference_rad_s", "output_sd_rad_s",
        "linear_loop_output_rad_s", "share_at_limit",
    )
    rows = tuple(
        (
            kp, ki, a.input_rad_s, a.output_rad_s, abs(a.difference_rad_s), a.sd_rad_s,
            a.input_rad_s * float(gain(settings.rig, settings.frequency_hz, kp, ki, reported=True)), a.limited,
        )
        for (kp, ki), a in zip(sweep.loops, sweep.found, strict=True)
    )
    other = settings.kp_nm_s_rad if swept else settings.ki_nm_rad
    curves: dict[float, Callable[[np.ndarray], np.ndarray]] = {
        hertz: partial(_curve, settings, hertz, swept, other)
        for hertz in sorted({settings.frequency_hz, *settings.other_tones_hz})
    }
    picture = GainPicture(
        gain_name="PI"[swept], values=tuple(pair[swept] for pair in sweep.loops), found=sweep.found, curves=curves,
        main_hz=settings.frequency_hz, published=published, fixed=f"{'IP'[swept]} {other:g}",
    )
    return StudyOutcome(
        name, title, (ResultTable("amplitudes", columns, rows),), statements,
        document={"runs": [dict(zip(columns, row, strict=True)) for row in rows]},
        simulated_s=sweep.simulated_s,
        draw=lambda figure: draw_gains(figure, picture),
        figure_size_in=(11.0, 4.8),
    )


def _curve(settings: GainSweepSettings, hertz: float, swept: int, other: float, values: np.ndarray) -> np.ndarray:
    kp, ki = (other, values) if swept else (values, other)
    return settings.amplitude_rad_s * gain(settings.rig, hertz, kp, ki, reported=True)

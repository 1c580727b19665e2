"""Figures 20 and 21: amplitude of the speed, input and output, over P and over I of the drive's speed loop.

The output is the speed that the drive reports. If the overshoot of the loop equals the reduction by the reporting lag,
input and output are equal, and |difference| is least. Both depend on the frequency, which the paper does not give.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from tdhil.recording import FloatArray
from tdhil.studies.field.bench import FieldBench
from tdhil.studies.field.loops import best_kp, gain, tones_with_steady_rise
from tdhil.studies.field.settings import FieldKiSweepSettings, FieldKpSweepSettings, GainSweepSettings
from tdhil.studies.field.tone import PUBLISHED_STYLE, Amplitudes, colour, swept_amplitudes, tidy
from tdhil.studies.study import Progress, ResultTable, Statement, StudyOutcome

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


# ---------------------------------------------------------------------------------------------------------------------
# Plots of figures 20 and 21: amplitudes, and their difference, over a gain of the loop.


@dataclass(frozen=True)
class GainPicture:
    """Data of the plot. ``curves``: frequency → output amplitude of the linear loop over the gain; ``published``:
    gain and difference.
    """

    gain_name: str
    values: Sequence[float]
    found: Sequence[Amplitudes]
    curves: Mapping[float, Callable[[np.ndarray], np.ndarray]]
    main_hz: float
    published: tuple[float, float | None]
    fixed: str


def draw_gains(figure: Figure, picture: GainPicture) -> None:
    """Draw input and output on the left, their difference on the right."""
    left, right = figure.subplots(1, 2)
    grid = np.geomspace(min(picture.values), max(picture.values), 300)
    inputs = [one.input_rad_s for one in picture.found]
    outputs = [one.output_rad_s for one in picture.found]
    left.plot(picture.values, inputs, "s-", color="#444444", markersize=4, label="input (commanded)")
    left.plot(picture.values, outputs, "o", color=colour(0), label="output (reported), on the bus")
    left.plot(grid, picture.curves[picture.main_hz](grid), color=colour(0), linewidth=1.2, label="linear loop")
    tidy(left, f"{picture.gain_name} of the speed loop", "amplitude, rad/s",
         f"{picture.main_hz:g} Hz, {picture.fixed}: input and output")
    left.margins(y=0.25)
    left.legend(fontsize=8)
    differences = [abs(one.difference_rad_s) for one in picture.found]
    right.plot(picture.values, differences, "o", color=colour(0), zorder=3, clip_on=False, label="on the bus")
    for index, (hertz, curve) in enumerate(sorted(picture.curves.items(), key=lambda pair: pair[0] != picture.main_hz)):
        main = hertz == picture.main_hz
        right.plot(grid, np.abs(curve(grid) - inputs[0]), color=colour(index), linewidth=1.5 if main else 1.0,
                   linestyle="-" if main else "--", label=f"linear loop, {hertz:g} Hz")
    _published(right, picture)
    right.set_ylim(bottom=0.0)
    tidy(right, f"{picture.gain_name} of the speed loop", "|input − output|, rad/s", "Difference of the amplitudes")
    right.legend(fontsize=8)
    for axes in (left, right):
        axes.set_xscale("log")
        axes.set_xticks(list(picture.values), [f"{value:g}" for value in picture.values])
        axes.minorticks_off()
    figure.tight_layout()


def _published(axes: Axes, picture: GainPicture) -> None:
    at, difference = picture.published
    if difference is None:
        axes.axvline(at, color="black", linewidth=0.9, linestyle=":", label=f"published minimum: {at:g}")
    else:
        axes.plot(at, difference, label=f"published minimum: {difference:g} at {at:g}", **PUBLISHED_STYLE)


# ---------------------------------------------------------------------------------------------------------------------
# Statements of figures 20 and 21, and whether tdhil confirms them.


def said_of_kp(settings: GainSweepSettings, values: Sequence[float], found: Sequence[Amplitudes]) -> tuple[
    Statement, ...
]:
    """Return the statements on figure 20: first falling, then rising, least at 300."""
    away = _away(found)
    best = int(np.argmin(away))
    valley = 0 < best < len(away) - 1 and bool(np.all(np.diff(away[: best + 1]) < 0.0) and np.all(
        np.diff(away[best:]) > 0.0))
    tone, rig = settings.frequency_hz, settings.rig
    low, high = min(values), max(values)
    elsewhere = ", ".join(
        f"{_edge(best_kp(rig, hertz, settings.ki_nm_rad, low, high), low, high)} at {hertz:g} Hz"
        for hertz in settings.other_tones_hz
        if hertz != tone
    )
    own = gain(rig, tone, np.asarray(values), settings.ki_nm_rad, reported=False)
    shaft = settings.amplitude_rad_s * np.abs(own - 1.0)
    return (
        Statement(
            "the difference of the amplitudes first falls, then rises with P", "from 150 to 1500",
            f"{away[0]:.3f} rad/s at {values[0]:g}, {away[best]:.4f} at {values[best]:g}, {away[-1]:.3f} at "
            f"{values[-1]:g}; {tone:g} Hz, I {settings.ki_nm_rad:g}",
            valley,
        ),
        Statement(
            "it is least at P = 300", "300; tone, I and input amplitude are not given",
            f"{values[best]:g} at {tone:g} Hz; but {elsewhere} (linear loop): the tone makes it, and it is not known",
            None,
        ),
        Statement(
            "P = 300 is the best balance of response and tracking", "taken from the minimum",
            f"the shaft itself follows ever better with P ({shaft[0]:.3f} to {shaft[-1]:.3f} rad/s, linear loop); the "
            "minimum is where overshoot and the lag of the reported speed cancel",
            bool(np.argmin(shaft) == best),
        ),
    )


def said_of_ki(settings: GainSweepSettings, values: Sequence[float], found: Sequence[Amplitudes]) -> tuple[
    Statement, ...
]:
    """Return the statements on figure 21: rising throughout, least at 200."""
    away = _away(found)
    best, worst = int(np.argmin(away)), int(np.argmax(away))
    steady = bool(np.all(np.diff(away) > 0.0))
    tone = settings.frequency_hz
    some, tones = tones_with_steady_rise(settings.rig, settings.kp_nm_s_rad, tuple(values))
    shape = "rises throughout" if steady else (
        f"rises to {away[worst]:.3f} rad/s at I = {values[worst]:g}, then falls again as the loop's resonance leaves "
        f"the tone behind; of {tones} tones from 0.05 to 1 Hz {some or 'none'} would give a steady rise (linear loop, "
        f"P {settings.kp_nm_s_rad:g})"
    )
    return (
        Statement(
            "the difference of the amplitudes is least at the lowest I", "I = 200",
            f"{away[best]:.4f} rad/s at I = {values[best]:g}; {tone:g} Hz, P {settings.kp_nm_s_rad:g}", best == 0,
        ),
        Statement(
            "it first grows with I", "'an increase trend'",
            f"from {away[0]:.3f} to {away[worst]:.3f} rad/s between I = {values[0]:g} and {values[worst]:g}",
            worst > 0 and bool(np.all(np.diff(away[: worst + 1]) > 0.0)),
        ),
        Statement("and goes on growing up to 2500", "'an increase trend' from 200 to 2500", shape,
                  True if steady else None),
        Statement(
            "it is 0.0594 rad/s at I = 200", "0.0594; tone, P and input amplitude are not given",
            f"{away[0]:.4f} rad/s for an input of {settings.amplitude_rad_s:g}; no number is claimed", None,
        ),
        Statement(
            "figure 21's trend is similar to figure 20's", "said of both, one falling first, one rising throughout",
            "the two descriptions exclude each other", None,
        ),
    )


def _away(found: Sequence[Amplitudes]) -> FloatArray:
    return np.array([abs(one.difference_rad_s) for one in found])


def _edge(value: float, low: float, high: float) -> str:
    """Return the place of the minimum, or that it lies outside."""
    if value <= 1.001 * low:
        return f"at or below {low:g}"
    return f"at or above {high:g}" if value >= 0.999 * high else f"{value:.0f}"


# ---------------------------------------------------------------------------------------------------------------------

@dataclass
class KpSweep:
    """Study `tdhil study figure20`."""

    bench: FieldBench
    name: str = "figure20"
    title: str = "Field rig: input and output amplitude over P"
    settings_model: type[FieldKpSweepSettings] = FieldKpSweepSettings

    def run(self, settings: FieldKpSweepSettings, progress: Progress) -> StudyOutcome:
        """Do one run for each P."""
        loops = [(kp, settings.ki_nm_rad) for kp in settings.kp_values_nm_s_rad]
        found, simulated_s = _swept(self.bench, settings, loops, progress)
        statements = said_of_kp(settings, settings.kp_values_nm_s_rad, found)
        return _outcome(self, settings, loops, found, simulated_s, 0, statements, published=(300.0, None))


@dataclass
class KiSweep:
    """Study `tdhil study figure21`."""

    bench: FieldBench
    name: str = "figure21"
    title: str = "Field rig: input and output amplitude over I"
    settings_model: type[FieldKiSweepSettings] = FieldKiSweepSettings

    def run(self, settings: FieldKiSweepSettings, progress: Progress) -> StudyOutcome:
        """Do one run for each I."""
        loops = [(settings.kp_nm_s_rad, ki) for ki in settings.ki_values_nm_rad]
        found, simulated_s = _swept(self.bench, settings, loops, progress)
        statements = said_of_ki(settings, settings.ki_values_nm_rad, found)
        return _outcome(self, settings, loops, found, simulated_s, 1, statements, published=(200.0, 0.0594))


def _swept(
    bench: FieldBench, settings: GainSweepSettings, loops: list[tuple[float, float]], progress: Progress
) -> tuple[tuple[Amplitudes, ...], float]:
    runs = [(settings.frequency_hz, kp, ki, f"P {kp:g}, I {ki:g}") for kp, ki in loops]
    return swept_amplitudes(bench, settings, runs, progress)


def _outcome(
    study: KpSweep | KiSweep, settings: GainSweepSettings, loops: list[tuple[float, float]],
    found: tuple[Amplitudes, ...], simulated_s: float, swept: int, statements: tuple[Statement, ...],
    published: tuple[float, float | None],
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
        for (kp, ki), a in zip(loops, found, strict=True)
    )
    other = settings.kp_nm_s_rad if swept else settings.ki_nm_rad
    curves: dict[float, Callable[[np.ndarray], np.ndarray]] = {
        hertz: partial(_curve, settings, hertz, swept, other)
        for hertz in sorted({settings.frequency_hz, *settings.other_tones_hz})
    }
    picture = GainPicture(
        gain_name="PI"[swept], values=tuple(pair[swept] for pair in loops), found=found, curves=curves,
        main_hz=settings.frequency_hz, published=published, fixed=f"{'IP'[swept]} {other:g}",
    )
    return StudyOutcome(
        study.name, study.title, (ResultTable("amplitudes", columns, rows),), statements,
        document={"runs": [dict(zip(columns, row, strict=True)) for row in rows]},
        simulated_s=simulated_s,
        draw=lambda figure: draw_gains(figure, picture),
        figure_size_in=(11.0, 4.8),
    )


def _curve(settings: GainSweepSettings, hertz: float, swept: int, other: float, values: np.ndarray) -> np.ndarray:
    kp, ki = (other, values) if swept else (values, other)
    return settings.amplitude_rad_s * gain(settings.rig, hertz, kp, ki, reported=True)

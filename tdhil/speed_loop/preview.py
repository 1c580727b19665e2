"""Open loop and sensitivity over frequency with the band of all corners, and the loop at the excited frequencies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import pi

import numpy as np

from tdhil.speed_loop.design import LoopDesign
from tdhil.speed_loop.loop import Complexes, PiGains, Reals, controller_response, loop_response

_CURVE_POINTS = 140


@dataclass(frozen=True)
class LoopCurve:
    """|L|, phase and |S| over frequency: nominal plant, and smallest and greatest value over all corners."""

    hertz: Reals
    gain: tuple[Reals, Reals, Reals]
    """|L|. Each tuple has the nominal, smallest and greatest value, also for ``phase_deg`` and ``sensitivity``."""
    phase_deg: tuple[Reals, Reals, Reals]
    sensitivity: tuple[Reals, Reals, Reals]


@dataclass(frozen=True)
class MeasuredShaft:
    """ω/T of the shaft at the excited frequencies: the reported response, without the reporting lags."""

    hertz: Reals
    response: Complexes
    half_rel: Reals
    """Half-width of the 95 % interval: relative in magnitude, rad in phase; infinite for an unbounded interval."""


def curve_range_hz(design: LoopDesign, lowest_hz: float | None = None) -> tuple[float, float]:
    """Return lowest and highest frequency to show, Hz. The range contains ``lowest_hz``."""
    bandwidths = [row.bandwidth_hz.value for row in design.rows if row.bandwidth_hz.value > 0.0]
    spring = design.case.plant.believed.spring
    marks = [] if spring is None else [0.5 * spring.antiresonance_hz, 2.0 * spring.resonance_hz]
    lowest = [] if lowest_hz is None else [0.9 * lowest_hz]
    return min([0.1 * one for one in bandwidths] + marks + lowest), max([8.0 * one for one in bandwidths] + marks)


def loop_curve(design: LoopDesign, gains: PiGains, lowest_hz: float | None = None) -> LoopCurve:
    """Return the curves of these gains for the design's plant, from ``lowest_hz`` or from a tenth of the bandwidth."""
    low, high = curve_range_hz(design, lowest_hz)
    hertz = np.geomspace(low, high, _CURVE_POINTS)
    spring = design.case.plant.believed.spring
    if spring is not None:
        near = np.linspace(0.9, 1.1, 21)
        hertz = np.unique(np.concatenate([hertz, spring.antiresonance_hz * near, spring.resonance_hz * near]))
    plants = (design.case.plant.believed, *design.case.plant.corners())
    loops = np.array([loop_response(plant, gains, 2.0 * pi * hertz) for plant in plants])
    phase = np.degrees(np.unwrap(np.angle(loops), axis=1))
    phase -= 360.0 * np.round((phase[:, :1] + 135.0) / 360.0)
    parts = (np.abs(loops), phase, np.abs(1.0 / (1.0 + loops)))
    return LoopCurve(hertz, *((part[0], part.min(axis=0), part.max(axis=0)) for part in parts))


def measured_shaft(
    hertz: Sequence[float], reported: Sequence[complex], half_rel: Sequence[float],
    speed_lag_s: float, torque_lag_s: float, skew_s: float,
) -> MeasuredShaft:
    """Remove the reporting lags from the reported ω/T. The reported T/ω is Z (1 + τ_w s)/(1 + τ_T s) e^(−d s)."""
    s = 2j * pi * np.asarray(hertz)
    undone = (1.0 + speed_lag_s * s) / (1.0 + torque_lag_s * s) * np.exp(-skew_s * s)
    return MeasuredShaft(np.asarray(hertz, dtype=np.float64), np.asarray(reported) * undone,
                         np.asarray(half_rel, dtype=np.float64))


def loop_at_lines(design: LoopDesign, gains: PiGains, shaft: MeasuredShaft) -> Complexes:
    """Return L at the excited frequencies, from nominal controller and lags and the measured shaft."""
    believed = design.case.plant.believed
    s: Complexes = np.asarray(2j * pi * shaft.hertz, dtype=np.complex128)
    others = believed.without_controller(s) / believed.shaft(s)
    return np.asarray(controller_response(gains, s) * others * shaft.response, dtype=np.complex128)


def deviation_from_model(design: LoopDesign, shaft: MeasuredShaft) -> Reals:
    """Return |G measured / G nominal − 1| at each excited frequency."""
    s: Complexes = np.asarray(2j * pi * shaft.hertz, dtype=np.complex128)
    return np.abs(shaft.response / design.case.plant.believed.shaft(s) - 1.0)

"""The picture of a sweep, as in figures 9, 10, 12 and 13: waveforms, amplitude difference, gain and phase."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tdhil.studies.paper.processing import Response
from tdhil.study.settings import LABELS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FloatArray = NDArray[np.float64]

_SHOWN_PERIODS = 2.0


@dataclass(frozen=True)
class Curve:
    """The settled part of one run; time in periods, so that frequencies share an axis."""

    value: float
    periods: FloatArray
    asked_rad_s: FloatArray
    speed_rad_s: FloatArray


def draw_sweep(figure: Figure, swept: str, curves: Sequence[Curve], responses: Sequence[Response]) -> None:
    """Left the waveforms, the input in red as in the paper; right what is measured on them."""
    grid = figure.add_gridspec(3, 2, width_ratios=(1.25, 1.0))
    waves = figure.add_subplot(grid[:, 0])
    shades = _shades(len(curves))
    for curve, shade in zip(curves, shades, strict=True):
        shown = curve.periods <= _SHOWN_PERIODS
        waves.plot(curve.periods[shown], curve.speed_rad_s[shown], color=shade, lw=1.2, label=f"{curve.value:g}")
    shown = curves[0].periods <= _SHOWN_PERIODS
    waves.plot(curves[0].periods[shown], curves[0].asked_rad_s[shown], color="C3", lw=1.6, ls="--", label="input")
    low, high = waves.get_ylim()
    waves.set_ylim(low, high + 0.32 * (high - low))      # room for the legend
    waves.set(xlabel="time, periods", ylabel="speed, rad/s")
    waves.legend(title=LABELS[swept], fontsize=9, title_fontsize=9, ncols=2, loc="upper right")
    waves.grid(alpha=0.3)
    values = [curve.value for curve in curves]
    panels = (
        ("A$_{in}$ − A$_{out}$, rad/s", [one.amplitude_difference_rad_s for one in responses], None),
        ("gain A$_{out}$/A$_{in}$", [one.gain for one in responses], None),
        ("phase lag, °", [one.lag_fundamental_deg for one in responses], [one.lag_zeros_deg for one in responses]),
    )
    first: Axes | None = None
    for row, (label, main, second) in enumerate(panels):
        axes = figure.add_subplot(grid[row, 1], sharex=first)
        first = first or axes
        axes.plot(values, main, "o-", color="0.15", ms=5, lw=1.1, label="fundamental")
        if second is not None:
            axes.plot(values, second, "x", color="C3", ms=7, label="zero crossing")
            axes.legend(fontsize=8)
        axes.set_ylabel(label, fontsize=9)
        axes.grid(alpha=0.3)
        axes.tick_params(labelsize=8, labelbottom=row == len(panels) - 1)
        if swept == "frequency_hz":
            axes.set_xscale("log")
        axes.set_xticks(values, [f"{value:g}" for value in values])
        axes.minorticks_off()
    axes.set_xlabel(LABELS[swept])
    figure.tight_layout()


def _shades(count: int) -> list[str]:
    """The usual colours without red, which is the input's."""
    usable = ("0.1", "C0", "C2", "C1", "C4", "C5", "C6", "C8", "C9")
    return [usable[index % len(usable)] for index in range(count)]

"""The pictures of figures 20 and 21: amplitudes, and their difference, over a gain of the loop."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tdhil.studies.field.tone import Amplitudes
from tdhil.study.field_draw import PUBLISHED, colour, tidy

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class GainPicture:
    """``curves``: tone → output amplitude of the linear loop over the gain; ``published``: gain and difference."""

    gain_name: str
    values: Sequence[float]
    found: Sequence[Amplitudes]
    curves: Mapping[float, Callable[[np.ndarray], np.ndarray]]
    main_hz: float
    published: tuple[float, float | None]
    fixed: str


def draw_gains(figure: Figure, picture: GainPicture) -> None:
    """Input and output left, their difference right."""
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
        axes.plot(at, difference, label=f"published minimum: {difference:g} at {at:g}", **PUBLISHED)

"""The benchmark in one picture: miss rate with its bounds, and how close the scatter comes to the least possible."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from tdhil.study.coverage_figures import PlantFigures, covers, efficient, not_too_wide
from tdhil.study.field_draw import tidy

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_GOOD, _BAD, _LIMIT = "#1f5fa8", "#c0392b", "#555555"


def draw_coverage(figure: Figure, found: Sequence[PlantFigures], nominal: float) -> None:
    """Plants from top to bottom in both panels; what breaks a bound is red."""
    left, right = figure.subplots(1, 2, sharey=True, gridspec_kw={"width_ratios": [3, 2]})
    names = [one.plant.name + ("" if one.plant.model_true else " *") for one in found]
    _misses(left, found, nominal)
    _ratios(right, found)
    left.set_yticks(range(len(found)), names)
    left.set_ylim(len(found) - 0.4, -0.6)
    figure.text(0.01, 0.01, "* the lags' structure is not the model's", fontsize=8, color=_LIMIT)
    figure.tight_layout(rect=(0.0, 0.03, 1.0, 1.0))


def _misses(axes: Axes, found: Sequence[PlantFigures], nominal: float) -> None:
    highest = 2.0 * nominal
    for row, one in enumerate(found):
        if one.miss_rate is None:
            continue
        fine = covers(one, nominal) is True and not_too_wide(one, nominal) is not False
        colour = _GOOD if fine else _BAD
        axes.plot([100.0 * one.miss_low, 100.0 * one.miss_high], [row, row], color=colour, linewidth=2.0)
        axes.plot(100.0 * one.miss_rate, row, "o", color=colour, markersize=6)
        highest = max(highest, one.miss_high)
    axes.axvline(100.0 * nominal, color=_LIMIT, linestyle="--", linewidth=1.0)
    axes.axvspan(40.0 * nominal, 100.0 * nominal, color="#e8eef5", zorder=0)
    axes.set_xlim(0.0, min(100.0, 105.0 * highest))
    tidy(axes, "intervals that miss the truth, % (99 % bounds)", "", f"Miss rate; nominal {nominal:.0%}")


def _ratios(axes: Axes, found: Sequence[PlantFigures]) -> None:
    highest = 1.5
    for row, one in enumerate(found):
        if one.over_bound is None:
            axes.text(0.03, row, "no bound", va="center", fontsize=8, color=_LIMIT)
            continue
        colour = _GOOD if efficient(one) else _BAD
        axes.barh(row, one.over_bound, height=0.55, color=colour)
        axes.text(one.over_bound + 0.03, row, f"{one.over_bound:.2f}", va="center", fontsize=8)
        highest = max(highest, one.over_bound + 0.35)
    axes.axvline(1.0, color=_LIMIT, linewidth=1.0)
    axes.axvline(1.2, color=_LIMIT, linestyle="--", linewidth=1.0)
    axes.set_xlim(0.0, highest)
    axes.tick_params(axis="y", labelleft=False)
    tidy(axes, "RMSE / Cramér-Rao bound", "", "Scatter; limit 1.2")

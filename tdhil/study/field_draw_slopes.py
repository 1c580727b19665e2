"""The picture of figure 22: left as in the paper, right what the four slopes have in common."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np

from tdhil.estimation.result import Identification
from tdhil.studies.field.tone import Scatter
from tdhil.study.field_draw import PUBLISHED, colour, tidy
from tdhil.study.joint import slope_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


class DrawnRecord(Protocol):
    """What is drawn of one tone."""

    @property
    def hertz(self) -> float: ...

    @property
    def points(self) -> Scatter: ...

    @property
    def published(self) -> tuple[float | None, float | None]: ...


@dataclass(frozen=True)
class SlopePicture:
    """All that is drawn; ``true_inertia`` is the simulated rig's, kg·m²."""

    records: Sequence[DrawnRecord]
    joint: Identification
    true_inertia: float


def draw_slopes(figure: Figure, picture: SlopePicture) -> None:
    """Scatter with its fitted lines; slope over tone with the curve of the joint fit."""
    left, right = figure.subplots(1, 2)
    _scatter(left, picture)
    _slopes(right, picture)
    figure.tight_layout()


def _scatter(axes: Axes, picture: SlopePicture) -> None:
    for index, record in enumerate(picture.records):
        alpha, fit = record.points.acceleration_rad_s2, record.points.fit
        axes.plot(alpha, record.points.torque_nm, ".", color=colour(index), markersize=2.5, alpha=0.35, rasterized=True)
    for index, record in enumerate(picture.records):
        alpha, fit = record.points.acceleration_rad_s2, record.points.fit
        ends = np.array([alpha.min(), alpha.max()])
        label = f"{record.hertz:g} Hz: T = {fit.inertia_kg_m2:.1f} α + {fit.intercept_nm:.1f}"
        axes.plot(ends, fit.inertia_kg_m2 * ends + fit.intercept_nm, color=colour(index), linewidth=1.8, label=label)
    axes.legend(fontsize=8, loc="upper left", framealpha=0.9)
    low, high = axes.get_ylim()
    axes.set_ylim(low, high + 0.28 * (high - low))
    tidy(axes, "reported acceleration α, rad/s²", "reported torque T, N·m", "The paper's method, tone by tone")


def _slopes(axes: Axes, picture: SlopePicture) -> None:
    records, joint = picture.records, picture.joint
    known = [(record.hertz, record.published[0]) for record in records if record.published[0] is not None]
    highest = max(record.hertz for record in records)
    tones = np.linspace(0.02, 1.08 * highest, 300)
    curve = slope_of(joint, tones)
    if curve is not None and joint.inertia is not None:
        lags = ""
        if joint.speed_lag_s is not None and joint.torque_lag_s is not None:
            lags = f", lags {joint.speed_lag_s.value:.2f} and {joint.torque_lag_s.value:.2f} s"
        axes.plot(tones, curve, color="#444444", linewidth=1.6, label=f"joint fit of all records: one J{lags}")
        found = joint.inertia
        axes.axhspan(found.low, found.high, color="#2e8b57", alpha=0.35, linewidth=0)
        label = f"its J: {found.value:.1f} ({found.low:.1f} to {found.high:.1f}) kg·m²"
        axes.axhline(found.value, color="#2e8b57", linewidth=1.2, label=label)
    axes.axhline(picture.true_inertia, color="black", linewidth=0.8, linestyle=":",
                 label=f"the simulated rig's J: {picture.true_inertia:g} kg·m²")
    for index, record in enumerate(records):
        label = "slope of the paper's method, ours" if index == 0 else ""
        axes.plot(record.hertz, record.points.fit.inertia_kg_m2, "o", color=colour(index), markersize=7, label=label)
    if known:
        axes.plot(*zip(*known, strict=True), label="published slope", **PUBLISHED)
    axes.set_xlim(0.0, 1.1 * highest)
    axes.legend(fontsize=8, loc="upper left")
    tidy(axes, "tone, Hz", "slope, kg·m²", "One inertia, seen through two reporting lags")

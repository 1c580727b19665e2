"""Figures 14 and 15: torque over angular acceleration of every run of a design, with its fitted line."""

from __future__ import annotations

from math import ceil, sqrt
from typing import TYPE_CHECKING

import numpy as np

from tdhil.studies.paper.design_runs import DesignResult, DesignRun, run_design
from tdhil.studies.paper.orthogonal_design import DesignSettings
from tdhil.studies.study import Cell, Progress, ResultTable, Statement, StudyOutcome

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


class ScatterStudy:
    """`figure14` (the runs of Table 6) and `figure15` (of Table 7)."""

    def __init__(self, name: str, title: str, model: type[DesignSettings]) -> None:
        self.name = name
        self.title = title
        self._model = model

    @property
    def settings_model(self) -> type[DesignSettings]:
        return self._model

    def run(self, settings: DesignSettings, progress: Progress) -> StudyOutcome:
        result = run_design(settings, lambda share: progress(share, f"{self.name}: {len(settings.rows)} runs"))
        columns = ("run", *result.runs[0].factors, "slope_kg_m2", "intercept_nm", "r2")
        rows: list[tuple[Cell, ...]] = [
            (number, *run.factors.values(), run.line.inertia_kg_m2, run.line.intercept_nm, run.line.r2)
            for number, run in enumerate(result.runs, start=1)
        ]
        lines = [
            {
                **run.factors, "inertia_kg_m2": run.line.inertia_kg_m2, "intercept_nm": run.line.intercept_nm,
                "r2": run.line.r2,
            }
            for run in result.runs
        ]
        progress(1.0, self.name)
        return StudyOutcome(
            name=self.name, title=self.title, tables=(ResultTable(f"{self.name}_lines", columns, tuple(rows)),),
            statements=_statements(result), document={"settings": settings.model_dump(mode="json"), "runs": lines},
            simulated_s=result.simulated_s, simulation_wall_s=result.wall_s,
            draw=lambda figure: draw_scatter(figure, result),
            figure_size_in=(10.0, 7.5) if len(rows) > 9 else (8.0, 6.5),
        )


def _statements(result: DesignResult) -> tuple[Statement, ...]:
    worst = min(run.line.r2 for run in result.runs)
    # T_in less Jα has the mean F_c + B·mean speed once it turns: that is what the intercept can be.
    pairs = [
        (run.line.intercept_nm, run.settings.coulomb_nm + run.settings.viscous_nm_s_rad * run.settings.offset_rad_s)
        for run in result.runs
    ]
    furthest = max(abs(intercept / meant - 1.0) for intercept, meant in pairs if meant != 0.0)
    return (
        Statement(
            "torque and angular acceleration lie on a line in every run", "section 4.4.1, figures 14 and 15",
            f"smallest r² {worst:.4f}", worst > 0.95,
        ),
        Statement(
            "the intercept is the system's damping parameter (section 4.3)", "so called, in N·m",
            f"it is F_c + B·offset, a torque at the mean speed, within {100 * furthest:.0f} % in all runs", None,
        ),
    )


def draw_scatter(figure: Figure, result: DesignResult) -> None:
    """One panel per run: points in blue, the line in red and dashed, its equation above."""
    count = len(result.runs)
    wide = ceil(sqrt(count))
    grid = figure.subplots(ceil(count / wide), wide, squeeze=False)
    for index, axes in enumerate(grid.flat):
        if index >= count:
            axes.set_axis_off()
            continue
        _panel(axes, index + 1, result.runs[index])
    figure.supxlabel("angular acceleration α, rad/s²", fontsize=10)
    figure.supylabel("torque T, N·m", fontsize=10)
    figure.tight_layout(w_pad=1.2, h_pad=0.6)


def _panel(axes: Axes, number: int, run: DesignRun) -> None:
    axes.plot(run.alpha_rad_s2, run.torque_nm, ".", color="C0", ms=2, rasterized=True)
    ends = np.array([run.alpha_rad_s2.min(), run.alpha_rad_s2.max()])
    axes.plot(ends, run.line.inertia_kg_m2 * ends + run.line.intercept_nm, "--", color="C3", lw=1.2)
    axes.set_title(f"{number}: T = {run.line.inertia_kg_m2:.2f} α + {run.line.intercept_nm:.0f}", fontsize=8, pad=3)
    axes.tick_params(labelsize=7)
    axes.ticklabel_format(axis="y", style="sci", scilimits=(-3, 4))
    axes.locator_params(axis="y", nbins=5)
    axes.yaxis.get_offset_text().set_fontsize(7)
    axes.grid(alpha=0.3)

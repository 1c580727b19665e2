"""The picture of a design: J of every run, as the paper identifies it and otherwise."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tdhil.studies.paper.design_runs import DesignResult
from tdhil.studies.paper.published import PublishedDesign
from tdhil.study.settings import LABELS

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def draw_runs(figure: Figure, result: DesignResult, paper: PublishedDesign | None) -> None:
    """J of every run: as the paper identifies it, published, in closed form, and without the start-up."""
    axes = figure.add_subplot()
    numbers = list(range(1, len(result.runs) + 1))
    if paper:
        label = "published, recovered from level means"
        axes.plot(numbers, paper.runs_kg_m2, "s", color="0.15", ms=9, mfc="none", label=label)
    axes.plot(numbers, result.inertias, "o-", color="C0", ms=5, lw=1, label="here, all samples")
    closed = [run.closed_form_kg_m2 or float("nan") for run in result.runs]
    axes.plot(numbers, closed, "_", color="C1", ms=14, mew=2, label="closed form")
    settled = [run.settled.inertia_kg_m2 if run.settled else float("nan") for run in result.runs]
    axes.plot(numbers, settled, "^", color="C2", ms=6, label="here, start-up dropped")
    axes.plot(numbers, [run.settings.inertia_kg_m2 for run in result.runs], "--", color="0.5", lw=1, label="true")
    axes.set(xlabel="run", ylabel="identified " + LABELS["inertia_kg_m2"], xticks=numbers)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=9)
    figure.tight_layout()

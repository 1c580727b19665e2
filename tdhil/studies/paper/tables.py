"""Tables 6 and 7: an orthogonal design, identified run by run, beside the paper's figures.

The paper prints only level means. Its arrays are saturated, so the means determine every run (`published`). Settings
that it does not state are inferred from those runs; many similar values fit nearly as well.
"""

from __future__ import annotations

from math import pi, sqrt
from typing import TYPE_CHECKING, Any

from pydantic import Field

from profiles import NonNegative, Positive
from tdhil.studies.paper.design_runs import DesignResult, DesignRun, OverDesign
from tdhil.studies.paper.loop import LABELS, SamplePeriod
from tdhil.studies.paper.orthogonal_design import DesignSettings, Factor, Rows, ranking
from tdhil.studies.paper.published import PublishedDesign, published
from tdhil.studies.paper.table_statements import design_statements, tdhil_inertia
from tdhil.studies.study import Cell, Progress, ResultTable, StudyOutcome

if TYPE_CHECKING:
    from matplotlib.figure import Figure


# ---------------------------------------------------------------------------------------------------------------------
# Plot of a design: J of every run by the paper's method and by others.


def draw_runs(figure: Figure, result: DesignResult, paper: PublishedDesign | None) -> None:
    """Draw J of every run: by the paper's method, published, in closed form, and without the start."""
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


# ---------------------------------------------------------------------------------------------------------------------

class Table6Settings(DesignSettings):
    """Settings of L16 over the system parameters. B, F_c, σ and the duration (the paper: 10/f in 3.4.2) are
    inferred.
    """

    duration_s: Positive = 25.0
    array: str | Rows = "L16"
    factors: tuple[Factor, ...] = Field(default_factory=lambda: published().design("table6").as_factors)


class Table7Settings(DesignSettings):
    """Settings of L9 over friction and noise. P, I, excitation, duration and sampling are inferred."""

    kp_nm_s_rad: NonNegative = 2500.0
    ki_nm_rad: NonNegative = 1500.0
    frequency_hz: Positive = 0.2
    amplitude_rad_s: Positive = 2.0
    offset_rad_s: float = 2.0 * pi
    duration_s: Positive = 20.0
    sample_period_s: SamplePeriod = 0.0005
    array: str | Rows = "L9"
    factors: tuple[Factor, ...] = Field(default_factory=lambda: published().design("table7").as_factors)


class DesignStudy(OverDesign):
    """Studies `table6` and `table7`; with another array or other factors, without the published columns."""

    def run(self, settings: DesignSettings, progress: Progress) -> StudyOutcome:
        result = self.carried_out(settings, progress)
        paper = published_for(self.name, settings)
        progress(1.0, self.name)
        return StudyOutcome(
            name=self.name, title=self.title,
            tables=(run_table(self.name, result, paper), effect_table(self.name, settings, result, paper)),
            statements=design_statements(settings, result, paper),
            document=_document(settings, result, paper),
            simulated_s=result.simulated_s, simulation_wall_s=result.wall_s,
            draw=lambda figure: draw_runs(figure, result, paper),
        )


def published_for(name: str, settings: DesignSettings) -> PublishedDesign | None:
    """Return the published values for this design; None if its array or its factors differ."""
    paper = published().design(name)
    same = type(settings)(array=paper.array, factors=paper.as_factors).rows == settings.rows
    theirs = [(factor.field, factor.levels) for factor in paper.as_factors]
    return paper if same and theirs == [(factor.field, factor.levels) for factor in settings.factors] else None


def rms_deviation(result: DesignResult, paper: PublishedDesign) -> float:
    """Return the RMS deviation of tdhil's runs from the recovered published ones, kg·m²."""
    pairs = zip(result.inertias, paper.runs_kg_m2, strict=True)
    return sqrt(sum((ours - theirs) ** 2 for ours, theirs in pairs) / len(result.runs))


def run_table(name: str, result: DesignResult, paper: PublishedDesign | None) -> ResultTable:
    """Return one row per run: factors; J by the paper's method, of whole periods, by the closed form, by tdhil."""
    silent = result.runs[0].silent_kg_m2 is not None
    columns = ["run", *result.runs[0].factors, "inertia_kg_m2", "without_start_up_kg_m2", "closed_form_kg_m2"]
    columns.append("tdhil_kg_m2")
    columns += ["without_noise_kg_m2"] if silent else []
    columns += ["published_kg_m2", "deviation_kg_m2"] if paper else []
    rows: list[tuple[Cell, ...]] = []
    for number, run in enumerate(result.runs):
        found = run.line.inertia_kg_m2
        row: list[Cell] = [number + 1, *run.factors.values(), found]
        row += [run.settled.inertia_kg_m2 if run.settled else None, run.closed_form_kg_m2, tdhil_inertia(run)]
        row += [run.silent_kg_m2] if silent else []
        row += [paper.runs_kg_m2[number], found - paper.runs_kg_m2[number]] if paper else []
        rows.append(tuple(row))
    return ResultTable(f"{name}_runs", tuple(columns), tuple(rows))


def effect_table(
    name: str, settings: DesignSettings, result: DesignResult, paper: PublishedDesign | None
) -> ResultTable:
    """Return one row per factor (level means, range, rank), and below it the published values in their own row."""
    most = max(len(effect.means) for effect in result.effects)
    columns = ("factor", "of", *(f"mean_{level}_kg_m2" for level in range(1, most + 1)), "range_kg_m2", "rank")
    theirs = ranking([factor.range_kg_m2 for factor in paper.factors]) if paper else ()
    rows: list[tuple[Cell, ...]] = []
    for index, (factor, effect) in enumerate(zip(settings.factors, result.effects, strict=True)):
        blank = (None,) * (most - len(effect.means))
        rows.append((factor.field, "here", *effect.means, *blank, effect.range, result.ranks[index]))
        if paper:
            printed = paper.factors[index]
            rows.append(
                (factor.field, "published", *printed.mean_inertia_kg_m2, *blank, printed.range_kg_m2, theirs[index])
            )
    return ResultTable(f"{name}_factors", columns, tuple(rows))


def effect_document(settings: DesignSettings, result: DesignResult) -> list[dict[str, Any]]:
    """Return the factors as plain data."""
    return [
        {
            "name": factor.field, "levels": list(factor.levels), "means_kg_m2": list(effect.means),
            "range_kg_m2": effect.range, "rank": rank,
        }
        for factor, effect, rank in zip(settings.factors, result.effects, result.ranks, strict=True)
    ]


def _own(run: DesignRun) -> dict[str, Any] | None:
    """Return tdhil's own result of a run as plain data."""
    found = run.identification
    if found is None:
        return None
    inertia = None if found.inertia is None else {
        "value": found.inertia.value, "low": found.inertia.low, "high": found.inertia.high
    }
    return {"verdict": found.verdict.value, "reason": found.reason, "inertia_kg_m2": inertia}


def _document(settings: DesignSettings, result: DesignResult, paper: PublishedDesign | None) -> dict[str, Any]:
    runs = [
        {
            **run.factors, "inertia_kg_m2": run.line.inertia_kg_m2, "intercept_nm": run.line.intercept_nm,
            "r2": run.line.r2, "without_start_up_kg_m2": run.settled.inertia_kg_m2 if run.settled else None,
            "closed_form_kg_m2": run.closed_form_kg_m2, "true_inertia_kg_m2": run.settings.inertia_kg_m2,
            "tdhil": _own(run),
        }
        for run in result.runs
    ]
    document: dict[str, Any] = {
        "settings": settings.model_dump(mode="json"), "runs": runs, "factors": effect_document(settings, result),
    }
    if paper:
        document["published_runs_kg_m2"] = list(paper.runs_kg_m2)
        document["rms_deviation_kg_m2"] = rms_deviation(result, paper)
    return document

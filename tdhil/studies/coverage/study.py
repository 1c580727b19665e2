"""`tdhil study coverage`: coverage of the interval on plants that are independent of the estimator.

Every plant of the fleet is simulated and identified many times, each run with its own noise and its own rough inertia.
The intervals that miss are counted; bias and scatter are compared with the least possible values.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from pydantic import Field, model_validator

from profiles import DataModel, Finding, refuse_if
from tdhil.estimation import normal_quantile
from tdhil.studies.coverage.bound import Bounds, cramer_rao
from tdhil.studies.coverage.plants import FLEET, CoveragePlant
from tdhil.studies.coverage.simulate import SimulatedRun, run_all, tasks
from tdhil.studies.field import tidy
from tdhil.studies.study import Cell, Progress, ResultTable, Statement, Study, StudyOutcome

if TYPE_CHECKING:
    from matplotlib.figure import Figure


# ---------------------------------------------------------------------------------------------------------------------
# Figures of one plant from its runs, compared with the bounds of the proof.


ONE_SIDED = 0.99          # confidence of each bound of the miss rate
MOST_REFUSED = 0.02
_BIAS_FLOOR = 0.002
_BIAS_ERRORS = 3.0
_OVER_BOUND = 1.2
_OVER_UNKNOWN = 1.3
_LEAST_MISSES = 0.4       # of the nominal miss rate: 2 % of 5 %


@dataclass(frozen=True)
class PlantFigures:
    """Shares of the true inertia, except rates, ratios and counts. None if no run gave a number or nothing applies.

    ``miss_rate`` is over the runs with a number; a refusal is counted separately, as neither hit nor miss.
    """

    plant: CoveragePlant
    runs: int
    refused: int
    misses: int
    miss_rate: float | None
    miss_low: float
    miss_high: float
    bias: float | None
    bias_error: float | None
    rmse: float | None
    half_width: float | None
    bound: float | None             # root of the Cramér-Rao bound for a known structure of the filters
    bound_unknown: float | None     # the same for an unknown structure
    reasons: tuple[tuple[str, int], ...]
    run_seconds: float

    @property
    def answered(self) -> int:
        return self.runs - self.refused

    @property
    def over_bound(self) -> float | None:
        """RMSE over the root of the Cramér-Rao bound, if the model is true and not degenerate; else None."""
        return self.rmse / self.bound if self.rmse is not None and self.bound and self.plant.bound_applies else None

    @property
    def over_unknown(self) -> float | None:
        """RMSE over the root of the bound for an unknown filter structure; None with nonlinear friction."""
        if self.rmse is None or not self.bound_unknown or self.plant.bend is not None:
            return None
        return self.rmse / self.bound_unknown

    def width_over_bound(self, quantile: float) -> float | None:
        """Return the mean half-width over that of an estimator at the bound with known structure and noise."""
        return self.half_width / (quantile * self.bound) if self.half_width is not None and self.bound else None

    def width_over_unknown(self, quantile: float) -> float | None:
        """Return the mean half-width over that of an estimator at the bound with known noise and unknown structure."""
        if self.half_width is None or not self.bound_unknown or self.plant.bend is not None:
            return None
        return self.half_width / (quantile * self.bound_unknown)


def clopper_pearson(hits: int, tries: int, one_sided: float = ONE_SIDED) -> tuple[float, float]:
    """Return the bounds of a share, each exceeded with probability 1 − one_sided: quantiles of the beta
    distribution.
    """
    from scipy.stats import beta

    low = float(beta.ppf(1.0 - one_sided, hits, tries - hits + 1)) if hits > 0 else 0.0
    high = float(beta.ppf(one_sided, hits + 1, tries - hits)) if hits < tries else 1.0
    return low, high


def figures_of(plant: CoveragePlant, runs: Sequence[SimulatedRun], bounds: Bounds) -> PlantFigures:
    """Return the figures, added in the order of the runs' numbers, so that the same runs give the same bits."""
    ordered = sorted(runs, key=lambda run: run.number)
    answered = [
        (run.value, run.low, run.high)
        for run in ordered
        if run.value is not None and run.low is not None and run.high is not None
    ]
    truth = plant.inertia_kg_m2
    misses = sum(not low <= truth <= high for _, low, high in answered)
    low, high = clopper_pearson(misses, len(answered))
    error = np.array([value / truth - 1.0 for value, _, _ in answered])
    reasons = Counter(f"{run.verdict}: {run.reason}" for run in ordered if run.value is None)
    return PlantFigures(
        plant=plant,
        runs=len(ordered),
        refused=len(ordered) - len(answered),
        misses=misses,
        miss_rate=misses / len(answered) if answered else None,
        miss_low=low,
        miss_high=high,
        bias=float(error.mean()) if answered else None,
        bias_error=float(error.std(ddof=1) / np.sqrt(len(answered))) if len(answered) > 1 else None,
        rmse=float(np.sqrt(np.mean(error**2))) if answered else None,
        half_width=float(np.mean([0.5 * (top - bottom) / truth for _, bottom, top in answered])) if answered else None,
        bound=bounds.known / truth if bounds.known is not None else None,
        bound_unknown=bounds.unknown / truth if bounds.unknown is not None else None,
        reasons=tuple(reasons.most_common()),
        run_seconds=float(np.mean([run.seconds for run in ordered])) if ordered else 0.0,
    )


def covers(found: PlantFigures, nominal: float) -> bool | None:
    """Return whether the lower bound of the miss rate is at most the nominal rate."""
    return None if found.miss_rate is None else found.miss_low <= nominal


def not_too_wide(found: PlantFigures, nominal: float) -> bool | None:
    """Return whether the miss rate may be 2 % or more (of a nominal 5 %); None if the model is not true."""
    if found.miss_rate is None or not found.plant.model_true:
        return None
    return found.miss_high >= _LEAST_MISSES * nominal


def answers(found: PlantFigures) -> bool | None:
    """Return whether at most 2 % of the runs give no number (lower 99 % bound); None if the model is not true."""
    if not found.plant.model_true or found.runs == 0:
        return None
    return clopper_pearson(found.refused, found.runs)[0] <= MOST_REFUSED


def unbiased(found: PlantFigures) -> bool | None:
    """Return whether |bias| ≤ max(0.2 %, 3 Monte-Carlo standard errors)."""
    if found.bias is None or found.bias_error is None:
        return None
    return abs(found.bias) <= max(_BIAS_FLOOR, _BIAS_ERRORS * found.bias_error)


def efficient(found: PlantFigures) -> bool | None:
    """Return whether RMSE ≤ 1.2 × the Cramér-Rao bound."""
    return None if found.over_bound is None else found.over_bound <= _OVER_BOUND


def efficient_unknowing(found: PlantFigures) -> bool | None:
    """Return whether RMSE ≤ 1.3 × the bound for an unknown filter structure."""
    return None if found.over_unknown is None else found.over_unknown <= _OVER_UNKNOWN


# ---------------------------------------------------------------------------------------------------------------------
# Figure of the benchmark: miss rate with its bounds, and scatter over the least possible scatter.


_GOOD, _BAD, _LIMIT = "#1f5fa8", "#c0392b", "#555555"


def draw_coverage(figure: Figure, found: Sequence[PlantFigures], nominal: float) -> None:
    """Draw the plants from top to bottom in both panels; a plant that violates a bound is red."""
    left, right = figure.subplots(1, 2, sharey=True, gridspec_kw={"width_ratios": [3, 2]})
    names = [one.plant.name + ("" if one.plant.model_true else " *") for one in found]
    highest = 2.0 * nominal
    for row, one in enumerate(found):
        if one.miss_rate is None:
            continue
        fine = covers(one, nominal) is True and not_too_wide(one, nominal) is not False
        colour = _GOOD if fine else _BAD
        left.plot([100.0 * one.miss_low, 100.0 * one.miss_high], [row, row], color=colour, linewidth=2.0)
        left.plot(100.0 * one.miss_rate, row, "o", color=colour, markersize=6)
        highest = max(highest, one.miss_high)
    left.axvline(100.0 * nominal, color=_LIMIT, linestyle="--", linewidth=1.0)
    left.axvspan(40.0 * nominal, 100.0 * nominal, color="#e8eef5", zorder=0)
    left.set_xlim(0.0, min(100.0, 105.0 * highest))
    tidy(left, "intervals that miss the truth, % (99 % bounds)", "", f"Miss rate; nominal {100 * nominal:.0f} %")
    highest = 1.5
    for row, one in enumerate(found):
        if one.over_bound is None:
            right.text(0.03, row, "no bound", va="center", fontsize=8, color=_LIMIT)
            continue
        right.barh(row, one.over_bound, height=0.55, color=_GOOD if efficient(one) else _BAD)
        right.text(one.over_bound + 0.03, row, f"{one.over_bound:.2f}", va="center", fontsize=8)
        highest = max(highest, one.over_bound + 0.35)
    right.axvline(1.0, color=_LIMIT, linewidth=1.0)
    right.axvline(1.2, color=_LIMIT, linestyle="--", linewidth=1.0)
    right.set_xlim(0.0, highest)
    right.tick_params(axis="y", labelleft=False)
    tidy(right, "RMSE / Cramér-Rao bound", "", "Scatter; limit 1.2")
    left.set_yticks(range(len(found)), names)
    left.set_ylim(len(found) - 0.4, -0.6)
    figure.text(0.01, 0.01, "* the lags' structure is not the model's", fontsize=8, color=_LIMIT)
    figure.tight_layout(rect=(0.0, 0.03, 1.0, 1.0))


# ---------------------------------------------------------------------------------------------------------------------
# Tables and statements of the benchmark.


def plant_table(found: Sequence[PlantFigures], confidence: float) -> ResultTable:
    """Return one row a plant. Shares in percent of the true inertia; rates in percent of the runs with a number."""
    quantile = normal_quantile(confidence)
    columns = (
        "plant", "inertia_kg_m2", "model_true", "runs", "refused_percent", "miss_percent", "miss_low99_percent",
        "miss_high99_percent", "bias_percent", "bias_standard_error_percent", "rmse_percent", "half_width_percent",
        "bound_percent", "rmse_over_bound", "width_over_best", "bound_unknown_percent", "rmse_over_unknown",
        "width_over_unknown",
    )
    return ResultTable("coverage", columns, tuple(_row(one, quantile) for one in found))


def _row(one: PlantFigures, quantile: float) -> tuple[Cell, ...]:
    return (
        one.plant.name,
        one.plant.inertia_kg_m2,
        ("degenerate" if one.plant.degenerate else "yes") if one.plant.model_true else "no",
        one.runs,
        _percent(one.refused / one.runs),
        _percent(one.miss_rate),
        _percent(one.miss_low),
        _percent(one.miss_high),
        _percent(one.bias),
        _percent(one.bias_error),
        _percent(one.rmse),
        _percent(one.half_width),
        _percent(one.bound),
        _figures(one.over_bound),
        _figures(one.width_over_bound(quantile)),
        _percent(one.bound_unknown),
        _figures(one.over_unknown),
        _figures(one.width_over_unknown(quantile)),
    )


def about_table(found: Sequence[PlantFigures]) -> ResultTable:
    """Return the table of the plants' properties."""
    columns = ("plant", "about", "speed_delay_s", "torque_delay_s", "skew_s", "rate_hz", "run_s")
    rows = tuple(
        (
            one.plant.name, one.plant.about, one.plant.speed_report.total_delay_s,
            one.plant.torque_report.total_delay_s, round(one.plant.skew_s, 6), one.plant.reading.rate_hz,
            round(one.run_seconds, 1),
        )
        for one in found
    )
    return ResultTable("plants", columns, rows)


def refusal_table(found: Sequence[PlantFigures]) -> ResultTable:
    """Return the reasons of runs without a number, the most frequent first."""
    rows = tuple((one.plant.name, count, reason) for one in found for reason, count in one.reasons[:5])
    return ResultTable("refusals", ("plant", "runs", "reason"), rows)


def said(found: Sequence[PlantFigures], confidence: float) -> tuple[Statement, ...]:
    """Return the four statements for each plant."""
    return tuple(statement for one in found for statement in _said_of(one, 1.0 - confidence))


def _said_of(one: PlantFigures, nominal: float) -> list[Statement]:
    name = one.plant.name
    count = f"{one.misses} of {one.answered} missed"
    statements = [
        Statement(
            f"{name}: lower 99 % bound of the miss rate",
            f"≤ {nominal:.3g}",
            f"{one.miss_low:.3f} ({count})",
            covers(one, nominal),
        )
    ]
    if one.plant.model_true:
        statements.append(
            Statement(
                f"{name}: the miss rate is not below {0.4 * nominal:.3g} (upper 99 % bound)",
                f"≥ {0.4 * nominal:.3g}",
                f"{one.miss_high:.3f} ({count})",
                not_too_wide(one, nominal),
            )
        )
        statements.append(
            Statement(
                f"{name}: runs refused though the model is the truth",
                f"≤ {100 * MOST_REFUSED:.0f} % (lower 99 % bound)", f"{one.refused} of {one.runs}", answers(one),
            )
        )
    bias = "no run gave a number"
    if one.bias is not None and one.bias_error is not None:
        bias = f"{100 * one.bias:+.3f} % ± {100 * one.bias_error:.3f} %"
    statements.append(
        Statement(f"{name}: |bias|", "≤ max(0.2 %, 3 Monte-Carlo standard errors)", bias, unbiased(one))
    )
    if one.over_bound is not None:
        statements.append(
            Statement(f"{name}: RMSE over the Cramér-Rao bound", "≤ 1.2", f"{one.over_bound:.3f}", efficient(one))
        )
    if one.over_unknown is not None:
        statements.append(
            Statement(
                f"{name}: RMSE over the Cramér-Rao bound, the filters' structure unknown", "≤ 1.3",
                f"{one.over_unknown:.3f}", efficient_unknowing(one),
            )
        )
    return statements


def _percent(share: float | None) -> float | None:
    return None if share is None else round(100.0 * share, 4)


def _figures(value: float | None) -> float | None:
    return None if value is None else round(value, 3)


# ---------------------------------------------------------------------------------------------------------------------

class CoverageSettings(DataModel):
    """Settings: number of runs, plants, duration, confidence."""

    seeds: Annotated[int, Field(ge=1, le=100_000)] = 500
    """Runs of each plant."""
    plants: list[str] = Field(default_factory=list)
    """Names of plants; empty for all plants."""
    periods: Annotated[int, Field(ge=4, le=200)] = 10
    """Periods used at each of two mean speeds."""
    confidence: Annotated[float, Field(ge=0.5, lt=1.0)] = 0.95
    processes: Annotated[int, Field(ge=1, le=64)] = 2
    seed: Annotated[int, Field(ge=0)] = 1

    @property
    def chosen(self) -> tuple[CoveragePlant, ...]:
        """Return the selected plants, in the fleet's order."""
        return tuple(plant for plant in FLEET if not self.plants or plant.name in self.plants)

    @model_validator(mode="after")
    def _known(self) -> CoverageSettings:
        names = [plant.name for plant in FLEET]
        findings: list[Finding] = [
            ("plants", f"no plant '{name[:40]}'; known: {', '.join(names)}")
            for name in self.plants
            if name not in names
        ]
        refuse_if(findings)
        return self


@dataclass
class CoverageStudy:
    """Study `tdhil study coverage`."""

    name: str = "coverage"
    title: str = "Coverage of the interval and closeness to the Cramér-Rao bound, plant by plant"
    settings_model: type[CoverageSettings] = CoverageSettings

    def run(self, settings: CoverageSettings, progress: Progress) -> StudyOutcome:
        """Run every plant; the same settings give the same bits, for any number of processes.

        Ctrl-C ends the study with the figures of the completed runs (``interrupted``). A second Ctrl-C, or one before
        the first completed run, ends it without figures.
        """
        plants = settings.chosen
        wanted = tasks(plants, settings.seeds, settings.seed, settings.periods, settings.confidence)
        runs: dict[str, list[SimulatedRun]] = {plant.name: [] for plant in plants}
        total, done = settings.seeds * len(plants), 0
        progress(0.0, "first runs")
        begun_s, interrupted = time.monotonic(), False
        try:
            for group in run_all(wanted, min(settings.processes, len(wanted))):
                runs[group[0].plant] += group
                done += len(group)
                left_s = (time.monotonic() - begun_s) * (total - done) / done
                of_plant = f"{group[0].plant}: {len(runs[group[0].plant])} of {settings.seeds} runs"
                left = f"{left_s / 60.0:.0f} min" if left_s >= 90.0 else f"{left_s:.0f} s"
                progress(0.98 * done / total, f"{of_plant}; {done} of {total} in all, about {left} left")
        except KeyboardInterrupt:
            done = sum(map(len, runs.values()))     # Ctrl-C may have come between the two
            if done == 0:
                raise
            interrupted = True
        found = []
        some = [plant for plant in plants if runs[plant.name]]
        for index, plant in enumerate(some):
            progress(0.98 + 0.02 * index / len(some), f"{plant.name}: Cramér-Rao bound")
            found.append(figures_of(plant, runs[plant.name], cramer_rao(plant, settings.periods)))
        progress(1.0, "interrupted" if interrupted else "done")
        outcome = outcome_of(self, found, settings)
        return cut_short(outcome, done, total) if interrupted else outcome


def cut_short(outcome: StudyOutcome, done: int, total: int) -> StudyOutcome:
    """Return the outcome, marked everywhere as incomplete."""
    return replace(
        outcome,
        title=f"{outcome.title} (interrupted: {done} of {total} runs)",
        document={**outcome.document, "interrupted": {"runs": done, "of": total}},
        interrupted=True,
    )


def outcome_of(study: CoverageStudy, found: list[PlantFigures], settings: CoverageSettings) -> StudyOutcome:
    """Return the figures as tables, statements, document and plot."""
    nominal = 1.0 - settings.confidence

    def draw(figure: Figure) -> None:
        draw_coverage(figure, found, nominal)

    return StudyOutcome(
        name=study.name,
        title=study.title,
        tables=(plant_table(found, settings.confidence), about_table(found), refusal_table(found)),
        statements=said(found, settings.confidence),
        document={"plants": [_document(one) for one in found], "settings": settings.model_dump(mode="json")},
        simulated_s=sum(one.runs * one.run_seconds for one in found),
        draw=draw,
        figure_size_in=(8.0, 6.0),
    )


def _document(one: PlantFigures) -> dict[str, Any]:
    """Return all figures of a plant, and the plant itself."""
    return {
        **asdict(one), "answered": one.answered, "rmse_over_bound": one.over_bound,
        "rmse_over_unknown": one.over_unknown,
    }


COVERAGE: Study = CoverageStudy()

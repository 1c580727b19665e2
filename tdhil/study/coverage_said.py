"""The benchmark in tables and statements."""

from __future__ import annotations

from collections.abc import Sequence

from tdhil.studies.study import Cell, ResultTable, Statement
from tdhil.study.coverage_figures import MOST_REFUSED, PlantFigures, answers, covers, efficient, not_too_wide, unbiased


def normal_quantile(confidence: float) -> float:
    """Two-sided quantile of the normal distribution."""
    from scipy.stats import norm

    return float(norm.ppf(0.5 + 0.5 * confidence))


def plant_table(found: Sequence[PlantFigures], confidence: float) -> ResultTable:
    """One row a plant. Shares in percent of the true inertia; rates in percent of the runs that gave a number."""
    quantile = normal_quantile(confidence)
    columns = (
        "plant", "inertia_kg_m2", "model_true", "runs", "refused_percent", "miss_percent", "miss_low99_percent",
        "miss_high99_percent", "bias_percent", "bias_standard_error_percent", "rmse_percent", "half_width_percent",
        "bound_percent", "rmse_over_bound", "width_over_best",
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
    )


def about_table(found: Sequence[PlantFigures]) -> ResultTable:
    """What each plant is."""
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
    """Why runs gave no number, the most frequent reasons first."""
    rows = tuple((one.plant.name, count, reason) for one in found for reason, count in one.reasons[:5])
    return ResultTable("refusals", ("plant", "runs", "reason"), rows)


def said(found: Sequence[PlantFigures], confidence: float) -> tuple[Statement, ...]:
    """The four bounds, plant by plant."""
    return tuple(statement for one in found for statement in _said_of(one, 1.0 - confidence))


def _said_of(one: PlantFigures, nominal: float) -> list[Statement]:
    name = one.plant.name
    told = f"{one.misses} of {one.answered} missed"
    statements = [
        Statement(
            f"{name}: lower 99 % bound of the miss rate",
            f"≤ {nominal:.3g}",
            f"{one.miss_low:.3f} ({told})",
            covers(one, nominal),
        )
    ]
    if one.plant.model_true:
        statements.append(
            Statement(
                f"{name}: the miss rate is not below {0.4 * nominal:.3g} (upper 99 % bound)",
                f"≥ {0.4 * nominal:.3g}",
                f"{one.miss_high:.3f} ({told})",
                not_too_wide(one, nominal),
            )
        )
        statements.append(
            Statement(
                f"{name}: runs refused though the model is the truth", f"≤ {MOST_REFUSED:.0%} (lower 99 % bound)",
                f"{one.refused} of {one.runs}", answers(one),
            )
        )
    bias = "no run gave a number"
    if one.bias is not None and one.bias_error is not None:
        bias = f"{one.bias:+.3%} ± {one.bias_error:.3%}"
    statements.append(
        Statement(f"{name}: |bias|", "≤ max(0.2 %, 3 Monte-Carlo standard errors)", bias, unbiased(one))
    )
    if one.over_bound is not None:
        statements.append(
            Statement(f"{name}: RMSE over the Cramér-Rao bound", "≤ 1.2", f"{one.over_bound:.3f}", efficient(one))
        )
    return statements


def _percent(share: float | None) -> float | None:
    return None if share is None else round(100.0 * share, 4)


def _figures(value: float | None) -> float | None:
    return None if value is None else round(value, 3)

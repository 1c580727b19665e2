"""The drive's torque scale, to which J is proportional: what it adds to an interval, and its line of the budget."""

import math

from tdhil.estimation.frequency_domain.inference import student_quantile
from tdhil.estimation.result import BudgetLine, Estimate, InertiaEstimate

_CERTAIN = 1e6      # degrees of freedom: what a data sheet states is taken for normally distributed


def scale_half_width(value: float, rel_sd: float, confidence: float) -> float:
    """Half-width of a quantity in proportion to the scale, from the scale alone."""
    return student_quantile(confidence, _CERTAIN) * rel_sd * abs(value)


def with_total(
    one: Estimate, rel_sd: float, confidence: float, conditional_on: tuple[str, ...]
) -> InertiaEstimate:
    """J with both intervals: as the data have it, and with the scale's uncertainty in quadrature."""
    scale = scale_half_width(one.value, rel_sd, confidence)
    return InertiaEstimate(
        value=one.value,
        low=one.low,
        high=one.high,
        low_total=one.value - math.hypot(one.value - one.low, scale),
        high_total=one.value + math.hypot(one.high - one.value, scale),
        confidence=confidence,
        conditional_on=conditional_on,
    )


def torque_scale_line(value: float, rel_sd: float, confidence: float) -> BudgetLine:
    """The last line of a budget."""
    half = scale_half_width(value, rel_sd, confidence)
    return BudgetLine("torque scale", half, "of the drive; not in repeatability")


def widened_most_by_scale(inertia: InertiaEstimate) -> bool:
    """Is the torque scale more of the total interval than all else together?"""
    repeatable, total = inertia.high - inertia.low, inertia.high_total - inertia.low_total
    return total > 0.0 and total * total > 2.0 * repeatable * repeatable

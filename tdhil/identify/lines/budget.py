"""The error budget of J: what each thing that isn't known adds to the half-width, line by line.

Unknowns are set free one group after another: J alone (noise), then the skew (timing), the lags, the friction, and last
the structure of the lags; a line is what its group adds, in squares: √(h_n² − h_(n−1)²); they add up to the interval.
Friction comes behind the lags since without them a line tells J and B apart by itself (imaginary and real part); it is
lags that mix the two.
"""

import math
from collections.abc import Iterable

from tdhil.estimation.frequency_domain import signal_filters
from tdhil.estimation.frequency_domain.filter_order import Fitted
from tdhil.estimation.frequency_domain.shafts import INERTIA
from tdhil.estimation.result import BudgetLine, Estimate
from tdhil.identify.lines.interval import half_width_first_order
from tdhil.identify.torque_scale import torque_scale_line


def budget_of(
    fitted: Fitted, inertia: Estimate, confidence: float, torque_scale_rel_sd: float
) -> tuple[BudgetLine, ...]:
    """The lines, in the order of the derivation above; the torque scale last, which is in no interval but the total."""
    model = fitted.problem.model
    lags = (model.at(signal_filters.SPEED_LAG), model.at(signal_filters.TORQUE_LAG))
    timing = (model.at(signal_filters.SKEW),)
    friction = tuple(range(1, model.mechanical))
    half = 0.5 * (inertia.high - inertia.low)
    grown = (
        ("noise", half_width_first_order(fitted, INERTIA, confidence, (*lags, *timing, *friction)),
         "scatter from period to period, everything else known"),
        ("timing", half_width_first_order(fitted, INERTIA, confidence, (*lags, *friction)),
         "skew between speed and torque"),
        ("lags", half_width_first_order(fitted, INERTIA, confidence, friction),
         "time constants of the reports' filters"),
        ("friction model", half_width_first_order(fitted, INERTIA, confidence),
         "its slope" + ("" if fitted.problem.tie is None else ", known from the levels of mean torque")),
        ("lag structure", half, "filters of two poles, moving averages"),
    )
    return (*grown_lines(grown, half), torque_scale_line(inertia.value, torque_scale_rel_sd, confidence))


def grown_lines(grown: Iterable[tuple[str, float, str]], half: float) -> tuple[BudgetLine, ...]:
    """What each step adds in squares.

    ``grown`` are (source, half-width reached with it free, note), ``half`` the last of them.
    """
    found, before = [], 0.0
    for source, reached, note in grown:
        total = min(max(reached, before), max(half, before))
        found.append(BudgetLine(source, math.sqrt(max(total**2 - before**2, 0.0)), note))
        before = total
    return tuple(found)

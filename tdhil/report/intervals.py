"""Numbers with the digits that their interval justifies. The ends of an interval are rounded outwards."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from profiles.quantities import plain_number, printed_ends, printed_share

ASYMMETRIC = 1.2
"""Ratio of the longer to the shorter side from which an interval is printed by its ends. Below it ± the longer side is
less than a tenth wider than the interval."""


def coverage_of(document: Mapping[str, Any]) -> float | None:
    """Return the coverage of the intervals of a result's document, as a share; None if it is not stated.

    A result without J, as of a run that measures the drive's impedance, states it with its frequency response.
    """
    for key in ("inertia_kg_m2", "frequency_response"):
        part = document.get(key)
        stated = part.get("confidence") if isinstance(part, Mapping) else None
        if isinstance(stated, int | float) and not isinstance(stated, bool):
            return float(stated)
    return None


def with_interval(value: float, low: float, high: float, unit: str, more: int = 0) -> str:
    """Return ``103.9 (103.1 to 104.8) kg·m²``: decimals for two significant digits of the half-width, and ``more``."""
    half = 0.5 * (high - low)
    if not all(math.isfinite(number) for number in (value, low, high)) or half <= 0.0:
        return f"{plain_number(value, 5 + more)} {unit}"
    return "{} ({} to {}) ".format(*rounded(value, low, high, more)) + unit


def part_with_interval(part: Mapping[str, Any], unit: str) -> str:
    """Return a quantity of a document as `with_interval`."""
    return with_interval(part["value"], part["low"], part["high"], unit)


def table_cell(part: Mapping[str, Any], times: float = 1.0) -> str:
    """Return ``2.31 (2.22 to 2.42)`` without a unit, the value alone where it is exact or without an interval, a dash
    where it is None.
    """
    value, low, high = (None if part[name] is None else times * part[name] for name in ("value", "low", "high"))
    if value is None:
        return "–"
    if low == high:
        return f"{value:.4g}"
    middle, below, above = rounded(value, low, high)
    if low is None or high is None:
        return f"{middle} (no lower limit, to {above})" if low is None else f"{middle} (from {below}, no upper limit)"
    return f"{middle} ({below} to {above})"


def rounded(value: float | None, low: float | None, high: float | None, more: int = 0) -> tuple[str, str, str]:
    """Return the three values as texts, with decimals as in `with_interval`; None, an open side, is ``open``."""
    ends = [number for number in (low, high) if number is not None]
    half = 0.5 * (ends[1] - ends[0]) / 10**more if len(ends) == 2 else 0.0

    if half > 0.0 and math.isfinite(half) and low is not None and high is not None:
        return "open" if value is None else _digits(value, half), *printed_ends(low, high, _decimals(half))
    middle, below, above = ("open" if number is None else plain_number(number) for number in (value, low, high))
    return middle, below, above


def plus_minus(value: float, half_width: float) -> str:
    """Return ``83.9 ± 3.0``, with decimals as in `with_interval`. The half-width covers the rounding of the value."""
    if not (math.isfinite(value) and math.isfinite(half_width)) or half_width <= 0.0:
        return plain_number(value)
    middle = _digits(value, half_width)
    apart = half_width + abs(float(middle) - value)
    return f"{middle} ± {printed_ends(0.0, apart, _decimals(half_width))[1]}"


def percent(half_width: float, value: float) -> str:
    """Return ``±0.80 %`` of the value: two significant digits, rounded up."""
    return printed_share(half_width / abs(value)) if value else "±?"


def interval_and_share(value: float, low: float, high: float, unit: str) -> str:
    """Return ``104.3 (100.1 to 108.4) kg·m²  ±4.0 %``. A clearly asymmetric interval has no ± behind it."""
    ends = with_interval(value, low, high, unit).rstrip()
    return ends if _asymmetric(value, low, high) else f"{ends}  {percent(max(value - low, high - value), value)}"


def plus_minus_part(part: Mapping[str, Any]) -> str:
    """Return ``83.9 ± 3.0``, or ``83.9 (81.0 to 88.2)`` if the interval is clearly asymmetric."""
    value, low, high = part["value"], part["low"], part["high"]
    if _asymmetric(value, low, high):
        return "{} ({} to {})".format(*rounded(value, low, high))
    return plus_minus(value, max(value - low, high - value))


def _decimals(half_width: float) -> int:
    """Return the decimals that end at the second significant digit of the half-width; negative for tens."""
    return 1 - math.floor(math.log10(half_width))


def _digits(number: float, half_width: float) -> str:
    """Round to the second significant digit of the half-width, tens and hundreds included."""
    decimals = _decimals(half_width)
    return f"{round(number, decimals) + 0.0:.{max(0, decimals)}f}"          # avoids −0


def _asymmetric(value: float, low: float, high: float) -> bool:
    """Return whether one side of the interval is clearly longer than the other."""
    shorter, longer = sorted((value - low, high - value))
    return math.isfinite(longer) and longer > ASYMMETRIC * shorter

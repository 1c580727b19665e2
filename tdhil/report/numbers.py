"""Numbers as people read them: as many digits as the interval bears, and no more."""

import math


def with_interval(value: float, low: float, high: float, unit: str) -> str:
    """``103.9 (103.1 to 104.8) kg·m²``: two significant digits of the half-width decide the decimals."""
    half = 0.5 * (high - low)
    if not all(math.isfinite(number) for number in (value, low, high)) or half <= 0.0:
        return f"{value:.5g} {unit}"
    shown = (_digits(number, half) for number in (value, low, high))
    return "{} ({} to {}) ".format(*shown) + unit


def rounded(value: float | None, low: float | None, high: float | None) -> tuple[str, str, str]:
    """The three as texts, with decimals as in `with_interval`; None, an open side, is ``open``."""
    ends = [number for number in (low, high) if number is not None]
    half = 0.5 * (ends[1] - ends[0]) if len(ends) == 2 else 0.0

    def shown(number: float | None) -> str:
        if number is None:
            return "open"
        return _digits(number, half) if half > 0.0 and math.isfinite(half) else f"{number:.4g}"

    return shown(value), shown(low), shown(high)


def plus_minus(value: float, half_width: float) -> str:
    """``83.9 ± 3.0``, decimals as in `with_interval`."""
    if not (math.isfinite(value) and math.isfinite(half_width)) or half_width <= 0.0:
        return f"{value:.4g}"
    return f"{_digits(value, half_width)} ± {_digits(half_width, half_width)}"


def _digits(number: float, half_width: float) -> str:
    """To the second significant digit of the half-width, tens and hundreds included."""
    decimals = 1 - math.floor(math.log10(half_width))
    return f"{round(number, decimals) + 0.0:.{max(0, decimals)}f}"          # no minus zero


def percent(half_width: float, value: float) -> str:
    """``±0.80 %`` of the value: two significant digits."""
    if not value or not math.isfinite(half_width):
        return "±?"
    share = 100.0 * half_width / abs(value)
    return f"±{share:.0f} %" if share >= 9.95 else f"±{share:#.2g} %"


def minutes(seconds: float) -> str:
    """``4:07``, or ``12 s`` under a minute."""
    whole = max(0, round(seconds))
    return f"{whole // 60}:{whole % 60:02d}" if whole >= 60 else f"{whole} s"

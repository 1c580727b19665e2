"""Numbers as people type them on the command line: 1%, 0.01, 5min."""

from __future__ import annotations

import argparse

_SECONDS = {"s": 1.0, "min": 60.0, "h": 3600.0}


def share(text: str) -> float:
    """``1%`` or ``0.01``."""
    number, percent = text.strip(), text.strip().endswith("%")
    try:
        value = float(number.removesuffix("%"))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r}: a share such as 1% or 0.01") from None
    return round(value / 100.0, 15) if percent else value      # 0.35 % is 0.0035, to the last bit


def seconds(text: str) -> float:
    """``300``, ``300s``, ``5min`` or ``1h``."""
    number = text.strip()
    for unit in ("min", "s", "h"):
        if number.endswith(unit):
            number, factor = number.removesuffix(unit), _SECONDS[unit]
            break
    else:
        factor = 1.0
    try:
        return float(number) * factor
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r}: a time such as 300, 300s, 5min or 1h") from None

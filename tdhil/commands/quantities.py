"""Quantities as people type them on the command line: 1%, 0.01, 5min, 40rpm. `profiles.quantities` has the units."""

from __future__ import annotations

import argparse
from collections.abc import Callable

from profiles import quantities
from profiles.quantities import SHARE, Unit


def amount(unit: Unit) -> Callable[[str], float]:
    """For argparse: a number in ``unit``, or with any unit of the same kind, in ``unit``."""

    def read(text: str) -> float:
        try:
            return quantities.read(text, unit)
        except ValueError as error:
            raise argparse.ArgumentTypeError(f"{text[:60]!r}: {error}") from None

    return read


share = amount(SHARE)
"""``1%`` or ``0.01``."""

"""Shares that a study requires: the observed share is judged, without an allowance for chance."""

from __future__ import annotations


def met(name: str, count: int, of: int, *, least: float = 0.0, most: float = 1.0) -> bool:
    """Print a share beside its limit, which is ``least`` or ``most``. Return whether it is within.

    A share of nothing is not within. The studies have the size that the requirement names, and its share is judged:
    a confidence bound would pass 276 of 300 for "at least 95 %".
    """
    good = of > 0 and least <= count / of <= most
    limit = f"at least {100.0 * least:g} %" if least else f"at most {100.0 * most:g} %"
    print(f"    {name}: {count} of {of}{f', {count / of:.1%}' if of else ''} ({limit}){'' if good else ' NOT MET'}",
          flush=True)
    return good

"""How many cycles a second: the profile's, or the next lower that this computer, its adapter and the drive hold.

Tried before anything moves, with the drive disabled, by the cycles themselves: a computer that is busy, a slow adapter
and a slow line show alike, in cycles that begin late and in answers that come late or not at all.
"""

from __future__ import annotations

import gc
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from drivers.drive import Paced, Sample
from drivers.ticks import LOWER_THE_RATE, quantile

SHARE = 0.999
"""Of the cycles must be in time by half a period."""
CYCLES, LONGEST_S = 1000, 4.0
"""Tried at each rate: so many, or for so long where that is less."""
WARM_UP = 10
"""Cycles at each rate before those that count: the first ones load what was never needed before."""


@dataclass(frozen=True)
class Tried:
    """One rate: how many cycles it was tried for, how late ``SHARE`` of them were at most, and whether that will do."""

    rate_hz: float
    cycles: int
    late_s: float
    holds: bool

    @property
    def text(self) -> str:
        """As a person reads it."""
        return f"p99.9 of {1e3 * self.late_s:.2g} ms in {self.cycles} cycles"


@dataclass(frozen=True)
class Choice:
    """The rate that is left set, and what was tried before it, the highest first."""

    tried: tuple[Tried, ...]

    @property
    def taken(self) -> Tried:
        return self.tried[-1]

    @property
    def text(self) -> str:
        """One line for the terminal and the log."""
        taken, first = self.taken, self.tried[0]
        if not taken.holds:
            return (
                f"{taken.rate_hz:g} cycles a second, though this computer doesn't hold them ({taken.text}, "
                f"and half a period is {500.0 / taken.rate_hz:.3g} ms). {LOWER_THE_RATE}, or end what keeps it busy"
            )
        if taken is first:
            return f"{taken.rate_hz:g} cycles a second: this computer holds them ({taken.text}; --rate overrides)"
        return (
            f"{taken.rate_hz:g} cycles a second ({taken.text}) instead of the profile's {first.rate_hz:g}, which this "
            f"computer doesn't hold ({first.text}); --rate overrides, --real-time-priority may help"
        )

    def plain(self) -> list[dict[str, Any]]:
        """As the run's configuration keeps it."""
        return [asdict(one) for one in self.tried]


def quieten() -> None:
    """Whatever would hold a control loop up later is done now: before anything is armed, and before it is measured.

    Reading scipy from the disk takes seconds, in pieces that let no other thread run; and looking through all that is
    loaded, again and again, for garbage that isn't there takes a tenth of one.
    """
    import scipy.optimize
    import scipy.signal
    import scipy.special
    import scipy.stats  # noqa: F401

    import tdhil.estimation  # noqa: F401

    gc.collect()
    gc.freeze()


def choose_rate(drive: Paced, rates_hz: Sequence[float], cycle: Callable[[], Sample]) -> Choice:
    """Go down ``rates_hz`` until one holds; that one, or the last, is set. Raises whatever a cycle raises."""
    tried: list[Tried] = []
    for rate_hz in rates_hz:
        drive.set_rate(rate_hz, measuring=True)
        tried.append(_try(drive, rate_hz, cycle))
        if tried[-1].holds:
            break
    drive.set_rate(tried[-1].rate_hz)
    return Choice(tuple(tried))


def _try(drive: Paced, rate_hz: float, cycle: Callable[[], Sample]) -> Tried:
    half_s, planned = 0.5 / rate_hz, max(1, min(CYCLES, round(LONGEST_S * rate_hz)))
    may_be_late = planned - round(SHARE * planned)
    for _ in range(WARM_UP):
        cycle()
    late_s: list[float] = []
    late = 0
    while len(late_s) < planned and late <= may_be_late:
        answered = cycle().fresh
        late_s.append(max(drive.began_late_s, 0.0 if answered else 1.0 / rate_hz))
        late += late_s[-1] >= half_s
    return Tried(rate_hz, len(late_s), quantile(sorted(late_s), SHARE), late <= may_be_late)

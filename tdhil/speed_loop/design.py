r"""P, I and a notch filter that keep the margins for every plant within the uncertainty intervals.

**Rule.** I = P²/(4 J) with the total J: a rigid shaft without lags is then critically damped (T_I = P/I = 4 J/P), and
the integral part costs 14° of phase. P is the only free number: the largest P that keeps phase margin and gain margin
at all corners, or the P with the requested bandwidth.

**Corners.** J, friction, lags (all together), antiresonance, resonance and the spring's damping, each at both ends of
its 95 % interval. If only the sum of two lags is known well, each sum is split in all ways that matter (`_splits`).
While a backlash is open, the motor side turns alone: its least inertia without friction is a corner too.
`benchmarks/speed_loop_margins.py` measures how often the true loop keeps the margins.

**Notch.** If the shaft has a resonance, notches of several widths and depths at that frequency are tried. A notch is
offered if it multiplies the largest bandwidth by `NOTCH_GAIN` or more, or if no gains fit without it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from math import inf, isfinite, nan, sqrt

import numpy as np

from profiles import MessageCode, TdhilError
from profiles.quantities import printed_bound
from tdhil.speed_loop.loop import (
    Complexes,
    LoopPlant,
    NotchFilter,
    PiGains,
    Reals,
    SpeedLoopMargins,
    SpringLoad,
    controller_response,
    frequency_grid,
    margins_of,
)
from tdhil.speed_loop.step import StepFigures, is_stable_loop, step_figures, step_responses

LOOP_TUNING_REFUSED = 11
"""Exit code: no gains keep the margins, or the requested bandwidth leaves too little."""
INTEGRAL_RATIO = 4.0
"""T_I P/J; 4 gives critical damping."""
NOTCH_GAIN = 1.25
"""Smallest ratio of the bandwidths with and without a notch for which a notch is offered."""
NOTCHES = tuple((depth * width, width) for width in (0.4, 1.0) for depth in (0.1, 0.3))
"""Damping of numerator and denominator of each notch that is tried."""
LEAST_SPLIT = 1.02
"""Smallest ratio of resonance to antiresonance. Below it, the load has practically no inertia."""
_GAINS = np.geomspace(3.0, 1e-3, 70)
"""Values of P that are tried, in units of J/Στ, the largest first."""
_HALVINGS = 8
"""Halvings of the interval between two tried values: P is found within 0.1 %."""
_FINER_HALVINGS = 48
_AT_ONCE = 8
"""Number of corners whose margins are computed together. The test ends with the first group that fails."""
_STEP_SPAN = 30.0
"""Length of a step response, in units of J/P."""


class LoopTuningRefused(TdhilError):
    """Refusal: no gains keep the margins for this machine. The message states the margins found."""

    entry = MessageCode.TUNING_REFUSED

    exit_code = LOOP_TUNING_REFUSED


@dataclass(frozen=True)
class Range:
    """A value and both ends of its 95 % interval."""

    value: float
    low: float
    high: float

    @property
    def ends(self) -> tuple[float, ...]:
        """Both ends of the interval; one value if they are equal."""
        return (self.low,) if self.low == self.high else (self.low, self.high)


@dataclass(frozen=True)
class UncertainPlant:
    """Shaft and lags of the loop, each quantity with its interval, at the motor shaft."""

    inertia_kg_m2: Range
    """J of a rigid shaft, J_r of a shaft with a spring."""
    viscous_nm_s_rad: Range
    lags_s: tuple[Range, ...]
    dead_time_s: Range
    antiresonance_hz: Range | None = None
    """Antiresonance, Hz. For a rigid shaft, antiresonance, resonance and damping are None."""
    resonance_hz: Range | None = None
    damping_nm_s_rad: Range | None = None
    lag_sum_s: Range | None = None
    """Sum of two lags and the dead time, if it is known better than each. None: all lags are at the same end."""
    gap_kg_m2: Range | None = None
    """Inertia of the motor side, which turns alone while a backlash is open. None: not in the worst case."""

    @property
    def believed(self) -> LoopPlant:
        """Plant with the nominal value of every quantity."""
        spring = None
        if self.antiresonance_hz is not None and self.resonance_hz is not None:
            spring = _spring(self.antiresonance_hz.value, self.resonance_hz.value,
                             self.damping_nm_s_rad.value if self.damping_nm_s_rad else 0.0)
        return LoopPlant(self.inertia_kg_m2.value, self.viscous_nm_s_rad.value,
                         tuple(lag.value for lag in self.lags_s), self.dead_time_s.value, spring)

    @property
    def first_lags_s(self) -> tuple[float, float]:
        """Shortest and longest first lag, s, with the nominal sum; (0, 0) if no sum is stated."""
        if self.lag_sum_s is None:
            return 0.0, 0.0
        first, second = self.lags_s
        return _first_lags(first, second, self.lag_sum_s.value)

    def _lag_corners(self) -> Sequence[tuple[tuple[float, ...], float]]:
        """Return the combinations of lags and dead time."""
        if self.lag_sum_s is not None:
            first, second = self.lags_s
            return tuple(dict.fromkeys((pair, dead) for total in self.lag_sum_s.ends for dead in self.dead_time_s.ends
                                       for pair in _splits(first, second, total - dead)))
        return ((tuple(lag.low for lag in self.lags_s), self.dead_time_s.low),
                (tuple(lag.high for lag in self.lags_s), self.dead_time_s.high))

    def gap_corners(self) -> tuple[LoopPlant, ...]:
        """Return the plants of the motor side alone; () if it is not in the worst case.

        The least inertia is the worst one: it has the highest crossover. The corners of J are at the other end.
        """
        if self.gap_kg_m2 is None:
            return ()
        return tuple(LoopPlant(self.gap_kg_m2.low, 0.0, *lags) for lags in self._lag_corners())

    def corners(self) -> tuple[LoopPlant, ...]:
        """Return the plants at all combinations of interval ends, with `gap_corners` at the end."""
        springs: list[SpringLoad | None] = [None]
        if self.antiresonance_hz is not None and self.resonance_hz is not None:
            dampings = self.damping_nm_s_rad.ends if self.damping_nm_s_rad else (0.0,)
            springs = [_spring(*one) for one in product(self.antiresonance_hz.ends, self.resonance_hz.ends, dampings)]
        return tuple(
            LoopPlant(inertia, viscous, late, dead, spring)
            for inertia, viscous, (late, dead), spring in product(
                self.inertia_kg_m2.ends, self.viscous_nm_s_rad.ends, self._lag_corners(), springs)) + self.gap_corners()


def _first_lags(first: Range, second: Range, sum_s: float) -> tuple[float, float]:
    """Return the shortest and the longest first lag of two lags with this sum, within their intervals."""
    return max(first.low, sum_s - second.high), min(first.high, sum_s - second.low)


def _splits(first: Range, second: Range, sum_s: float) -> tuple[tuple[float, float], ...]:
    """Return pairs of lags with this sum: as unequal as their intervals permit, in both directions, and most equal.

    The phase −atan(ω τ₁) − atan(ω τ₂) is greatest for equal lags, which costs gain margin. The gain far above 1/τ is
    greatest for unequal lags, which matters at a resonance.
    """
    sum_s = min(max(sum_s, first.low + second.low), first.high + second.high)
    least, most = _first_lags(first, second, sum_s)
    return tuple((one, sum_s - one) for one in dict.fromkeys((least, most, min(max(0.5 * sum_s, least), most))))


def _spring(antiresonance_hz: float, resonance_hz: float, damping_nm_s_rad: float) -> SpringLoad:
    return SpringLoad(antiresonance_hz, max(resonance_hz, LEAST_SPLIT * antiresonance_hz), damping_nm_s_rad)


@dataclass(frozen=True)
class SpeedLoopCase:
    """Plant, required margins and requests of one tuning."""

    plant: UncertainPlant
    phase_deg: float = 45.0
    """Required phase margin at every corner, degrees; ``gain_db``: required gain margin, dB."""
    gain_db: float = 8.0
    bandwidth_hz: float | None = None
    """Requested bandwidth, Hz; None: the largest with the required margins."""
    present: PiGains | None = None
    try_notch: bool = True


@dataclass(frozen=True)
class LoopRow:
    """Gains, and margins and step response with these gains."""

    kind: str
    """``present`` or ``tuned``."""
    gains: PiGains
    believed: SpeedLoopMargins
    worst: SpeedLoopMargins
    """Smallest value of each margin over all corners; greatest peak of the sensitivity."""
    bandwidth_hz: Range
    """Bandwidth; NaN without a stable loop. Bandwidth and step: without the motor side alone."""
    overshoot_share: Range
    rise_s: Range
    settling_s: Range
    time_s: Reals = field(repr=False)
    speed: Reals = field(repr=False)
    """Response of the nominal plant to a unit step of the speed setpoint."""
    lowest: Reals = field(repr=False)
    highest: Reals = field(repr=False)


@dataclass(frozen=True)
class LoopDesign:
    """Result of a tuning of the speed loop."""

    case: SpeedLoopCase
    rows: tuple[LoopRow, ...]
    """Row of the present gains, if they are known, then row of the tuned gains."""
    without_notch_hz: float | None
    """Largest bandwidth without the notch, Hz, if the gains have one; None: no gains keep the margins without it."""

    @property
    def tuned(self) -> LoopRow:
        """Row of the gains to enter into the drive."""
        return self.rows[-1]


class _GainSearch:
    """Loops of the nominal plant and of all corners, without controller, on one frequency grid."""

    def __init__(self, case: SpeedLoopCase) -> None:
        self.case = case
        self.believed = case.plant.believed
        self.corners = case.plant.corners()
        every = (self.believed, *self.corners)
        self.omega = frequency_grid(every, case.present)
        self.s: Complexes = np.asarray(1j * self.omega, dtype=np.complex128)
        self.without = np.array([plant.without_controller(self.s) for plant in every])
        self.filters = np.array([plant.speed_filter(self.s) for plant in every])
        self._batches = [slice(first, first + _AT_ONCE) for first in range(1, len(every), _AT_ONCE)]
        self.total = self.believed.total_inertia_kg_m2
        self.unit = self.total / self.believed.total_lag_s

    def gains(self, proportional: float, notch: NotchFilter | None) -> PiGains:
        return PiGains(proportional, proportional**2 / (INTEGRAL_RATIO * self.total), notch)

    def margins(self, gains: PiGains) -> tuple[SpeedLoopMargins, ...]:
        """Return the margins of the nominal plant, then of each corner."""
        return margins_of(self.without * controller_response(gains, self.s), self.filters, self.omega)

    def at_believed(self, gains: PiGains) -> SpeedLoopMargins:
        """Return the margins of the nominal plant."""
        return margins_of(self.without[:1] * controller_response(gains, self.s), self.filters[:1], self.omega)[0]

    def bandwidth_hz(self, gains: PiGains) -> float:
        """Return the bandwidth of the nominal plant, Hz."""
        return self.at_believed(gains).bandwidth_hz

    def fits(self, gains: PiGains) -> bool:
        """Return whether all corners keep the margins."""
        asked = self.case.phase_deg, self.case.gain_db
        if not self.at_believed(gains).keeps(*asked):
            return False
        law = controller_response(gains, self.s)
        for number, some in enumerate(self._batches):
            if not all(one.keeps(*asked) for one in margins_of(self.without[some] * law, self.filters[some],
                                                               self.omega)):
                self._batches.insert(0, self._batches.pop(number))      # this group will probably fail first next time
                return False
        return True

    def largest(self, notch: NotchFilter | None) -> PiGains | None:
        """Return the largest gains that keep the margins; None if no gains do."""
        above = None
        for proportional in _GAINS * self.unit:
            if self.fits(self.gains(float(proportional), notch)):
                return self._between(float(proportional), above, notch)
            above = float(proportional)
        return None

    def _between(self, fits: float, above: float | None, notch: NotchFilter | None) -> PiGains:
        if above is not None:
            for _ in range(_HALVINGS):
                middle = sqrt(fits * above)
                if self.fits(self.gains(middle, notch)):
                    fits = middle
                else:
                    above = middle
        return self.gains(fits, notch)

    def with_bandwidth(self, hertz: float, notch: NotchFilter | None) -> PiGains:
        """Return the gains whose bandwidth on the nominal plant is ``hertz``."""
        low, high = float(_GAINS[-1]) * self.unit * 1e-2, float(_GAINS[0]) * self.unit * 1e2
        for _ in range(_FINER_HALVINGS):
            middle = sqrt(low * high)
            if self.bandwidth_hz(self.gains(middle, notch)) < hertz:
                low = middle
            else:
                high = middle
        return self.gains(high, notch)

    def notches(self) -> tuple[NotchFilter, ...]:
        """Return the notches to try; () for a rigid shaft."""
        spring = self.believed.spring
        if spring is None or not self.case.try_notch:
            return ()
        return tuple(NotchFilter(spring.resonance_hz, *damping) for damping in NOTCHES)


def design_speed_loop(case: SpeedLoopCase) -> LoopDesign:
    """Tune the speed loop. Raises LoopTuningRefused if no gains, or none with the requested bandwidth, fit."""
    search = _GainSearch(case)
    plain = search.largest(None)
    without_hz = None if plain is None else search.bandwidth_hz(plain)
    found = plain
    if case.bandwidth_hz is None or without_hz is None or case.bandwidth_hz > without_hz:
        found = _best(search, plain, without_hz)
    if found is None:
        raise LoopTuningRefused(
            f"no gains keep {case.phase_deg:g}° and {case.gain_db:g} dB on every corner of the intervals",
            next_step="Identify again for narrower intervals, state the lags better, or accept thinner margins "
                      "with --phase-margin and --gain-margin")
    if case.bandwidth_hz is not None:
        hertz, largest = case.bandwidth_hz, found
        found = search.with_bandwidth(hertz, largest.notch)
        if not search.fits(found):
            worst = worst_of(search.margins(found))
            if not worst.stable:
                what = f"with a bandwidth of {hertz:g} Hz the loop is unstable in the worst case"
            elif worst.conditional:
                what = (f"with a bandwidth of {hertz:g} Hz, a lower gain makes the loop unstable in the worst case, "
                        "such as at the torque limit")
            else:
                what = (f"a bandwidth of {hertz:g} Hz leaves too little margin: the worst case has "
                        f"{printed_bound(worst.phase_deg, 3)}° and {printed_bound(worst.gain_db, 3)} dB "
                        f"(limits {case.phase_deg:g}° and {case.gain_db:g} dB)")
            raise LoopTuningRefused(
                f"{what}. The largest bandwidth that fits is {search.bandwidth_hz(largest):.3g} Hz",
                next_step=f"Request --bandwidth {printed_bound(search.bandwidth_hz(largest), 2)} or less")
    if not all(is_stable_loop(plant, found) for plant in (search.believed, *search.corners)):
        raise LoopTuningRefused("the poles of the tuned loop contradict its margins",
                                next_step="Request a lower --bandwidth")
    rows = [] if case.present is None else [_row("present", search, case.present)]
    return LoopDesign(case, (*rows, _row("tuned", search, found)), without_hz if found.notch is not None else None)


def _best(search: _GainSearch, plain: PiGains | None, without_hz: float | None) -> PiGains | None:
    """Return the largest gains; with a notch if it raises the bandwidth by `NOTCH_GAIN`."""
    offered = [(search.bandwidth_hz(gains), gains) for notch in search.notches()
               if (gains := search.largest(notch)) is not None]
    if not offered:
        return plain
    hertz, gains = max(offered, key=lambda one: one[0])
    return gains if without_hz is None or hertz >= NOTCH_GAIN * without_hz else plain


def worst_of(margins: tuple[SpeedLoopMargins, ...]) -> SpeedLoopMargins:
    """Return the least favourable value of each margin."""
    return SpeedLoopMargins(
        all(one.stable for one in margins), min(one.phase_deg for one in margins), min(one.gain_db for one in margins),
        min(one.bandwidth_hz for one in margins), max(one.peak_sensitivity for one in margins),
        any(one.conditional for one in margins))


def _row(kind: str, search: _GainSearch, gains: PiGains) -> LoopRow:
    every = search.margins(gains)
    # the motor side alone counts in the margins: a whole step does not fit into an open backlash
    plants = (search.believed, *search.corners[:len(search.corners) - len(search.case.plant.gap_corners())])
    margins = every[:len(plants)]
    stable = [plant for plant, one in zip(plants, margins, strict=True) if one.stable and is_stable_loop(plant, gains)]
    span = _STEP_SPAN * search.total / max(gains.gain_nm_s_rad, 1e-9 * search.unit)
    time_s, speeds = step_responses(stable, gains, span)
    figures = [step_figures(time_s, speed) for speed in speeds]
    whole = len(stable) == len(plants)
    shown = speeds if whole else np.full((1, len(time_s)), np.nan)
    bandwidths = [one.bandwidth_hz for one in margins]
    # an unstable loop has no bandwidth
    value = bandwidths[0] if margins[0].stable else nan
    bandwidth = Range(value, min(bandwidths), max(bandwidths)) if whole else Range(value, nan, nan)
    worst = worst_of(every)
    overshoot, rise, settling = (_spread(figures, name, whole) for name in
                                 ("overshoot_share", "rise_s", "settling_s"))
    return LoopRow(
        kind, gains, replace(margins[0], bandwidth_hz=value),
        worst if worst.stable else replace(worst, bandwidth_hz=nan), bandwidth,
        overshoot, rise, settling, time_s, shown[0], shown.min(axis=0), shown.max(axis=0))


def _spread(figures: list[StepFigures], name: str, whole: bool) -> Range:
    """Return the range of a figure over all corners; infinite if a corner is unstable."""
    values = [float(getattr(one, name)) for one in figures]
    if not whole or not all(isfinite(value) for value in values):
        return Range(inf, min(values, default=inf), inf)
    return Range(values[0], min(values), max(values))



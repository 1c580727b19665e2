r"""From J, with its interval, to gains: stiff, soft, with inertia compensated, broadband; and what J's error costs.

**Soft.** P = ζ/a, I = ω² J. Rotor and I are a tuned absorber on the string: where they swing alone as the string's
lowest mode does, the mode splits into two, and a decides how both are damped. a = 1 matches ζ at that one frequency and
damps least; the a that damps the lesser of the two most (0.19 on the reference case) is looked for here, on the exact
poles with the lags in the loop.

**Compensated.** The part of J that the controller gives back is gone from the absorber: less inertia, more damping. Too
much given back is a rotor with negative inertia behind the lags, which swings by itself. It must be stable for every J
of the interval; of the largest share that is, a reserve is kept.

**Broadband.** Full compensation and P = ζ would be Z = ζ everywhere, and is unstable behind any lag. As far as the
same rule lets it come: the a whose mean |r| from 0.05 to 1.5 Hz is least, with the largest share that it allows; where
that is no more than a soft controller does, it is refused under this name.

**How J's error comes in.** The gains are what they are; J is what moves. Every derived number is taken at some values
of J from end to end of its interval, and its interval is what these span, turning points between them included:
whatever J is in its own, the number is in this one. What else has an interval (lags and gains as measured, a string as
identified) is moved to either end of it, one after the other, and what each does to a number is added in squares.
(Checked by drawing all of them, in the tests.)
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import inf, pi, sqrt

import numpy as np
from numpy.typing import NDArray

from profiles import TdhilError
from tdhil.soft_torque.controller import (
    ClosedSystem,
    Margins,
    NaturalMode,
    SpeedController,
    TopDrive,
    margins,
    reflection_at,
    softest_allowed,
    stiff_controller,
    tuned_controller,
)
from tdhil.soft_torque.drill_string import DrillString
from tdhil.soft_torque.roots import RootsLost
from tdhil.soft_torque.simulation import CriticalSpeeds, Search, critical_speeds, lowest_turning

TUNING_REFUSED = 11
"""Exit code: the gains that were asked for would make the string swing."""
STEPS = 9
"""Values of J, from end to end of its interval, at which what follows from it is worked out; odd."""
RESERVE = 0.8
"""Of the largest stable share of J, so much is compensated at most."""
LAG_RESERVE = 0.9
"""Of the softest a that the lags allow, so much is taken at most."""
BAND_HZ = (0.05, 1.5)
"""Where the mean |r| is taken."""
WRONG_BY = (0.126, 0.76)
"""Errors of J whose cost is told: the paper's method on a simulated field rig, and its own spread of slopes."""
BROADBAND_BELOW = 0.8
"""Mean |r| above which a controller isn't called broadband: a plain soft one has 0.94 on the reference case."""
NEXT_MODE_SHARE = 0.85
"""Of the second mode with the top held, that the whole's second mode stays above: there a top drive is a rotor, or a
wall."""
_LEAST_SOFT, _MOST_SOFT = 0.02, 2.0
_WAVES_SUPPOSED = ("what inertia compensation does to the pipe's waves, and whether their losses keep it stable, is "
                   "not known of a spring alone: the pipe has to be named (string.yaml)")


class TuningRefused(TdhilError):
    """The gains that were asked for can't be recommended for this machine, and the message says why."""

    exit_code = TUNING_REFUSED


@dataclass(frozen=True)
class Interval:
    """A number with the ends of its 95 % interval."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class Moved:
    """All as believed, but for one thing that is at an end of its 95 % interval; None: as believed."""

    inner_lags_s: tuple[float, ...] | None = None
    present: SpeedController | None = None
    string: DrillString | None = None


@dataclass(frozen=True)
class TuneCase:
    """What is tuned for what, all at the main shaft."""

    string: DrillString
    drive: TopDrive
    """With the J that is believed."""
    inertia_kg_m2: Interval
    phase_margin_deg: float = 60.0
    softness: float | None = None
    """a, where it is asked for; None: the one that damps most."""
    compensated_share: float | None = None
    """Share of J, where it is asked for; None: the one that damps most within the reserve."""
    present: SpeedController | None = None
    """What stands in the drive now, as measured (`identify --impedance`); shown beside the others."""
    also: tuple[tuple[Moved, Moved], ...] = ()
    """What else is known to an interval only, none hanging on another: both ends of each."""

    def moved(self, by: Moved) -> TuneCase:
        """The case with that one thing moved."""
        lags = self.drive.inner_lags_s if by.inner_lags_s is None else by.inner_lags_s
        return replace(self, string=by.string or self.string, present=by.present or self.present,
                       drive=replace(self.drive, inner_lags_s=lags))

    def moves(self, *, present: bool) -> tuple[tuple[TuneCase, TuneCase], ...]:
        """Both ends of all that matters to a controller: to the ``present`` one its own gains, too."""
        return tuple((self.moved(low), self.moved(high)) for low, high in self.also
                     if present or low.present is None)

    @property
    def at_inertias(self) -> tuple[TopDrive, ...]:
        """The drive at `STEPS` values of J from end to end of its interval, the believed one in the middle."""
        low, value, high = self.inertia_kg_m2.low, self.inertia_kg_m2.value, self.inertia_kg_m2.high
        half = STEPS // 2
        below = [low + (value - low) * k / half for k in range(half)]
        above = [value + (high - value) * k / half for k in range(half + 1)]
        return tuple(self.drive.with_inertia(one) for one in (*below, *above))


@dataclass(frozen=True)
class WrongInertia:
    """The same recipe with a J that is wrong: ``error`` 0.126 is 12.6 % too large."""

    error: float
    stable: bool
    damping: float | None
    """The least of the lowest modes'; None: not stable."""
    cure_rpm: float | None


@dataclass(frozen=True)
class Tuned:
    """One controller, with all that follows from it. Refused: ``controller`` is None and ``refusal`` says why."""

    kind: str
    controller: SpeedController | None
    refusal: str = ""
    softness: float | None = None
    softest: float | None = None
    """The a at which the lags make Z negative at low frequencies."""
    compensated_share: float = 0.0
    largest_share: float | None = None
    """That is stable for every J of the interval."""
    integral_nm_rad: Interval | None = None
    """I as J's interval has it."""
    reflection: Interval | None = None
    """|r| at the lowest mode."""
    band_reflection: Interval | None = None
    """Mean |r| over `BAND_HZ`."""
    damping: Interval | None = None
    """The least of the lowest modes'."""
    modes: tuple[NaturalMode, ...] = ()
    margins: Margins | None = None
    lag_reserve_s: float | None = None
    """So much more lag in the loop, and it swings; None: more than 1 s."""
    critical: CriticalSpeeds | None = None
    critical_low: CriticalSpeeds | None = None
    """At the lower end of J's interval."""
    critical_high: CriticalSpeeds | None = None
    critical_moved: tuple[tuple[CriticalSpeeds, CriticalSpeeds], ...] = ()
    """At both ends of whatever else has an interval."""
    wrong: tuple[WrongInertia, ...] = ()


@dataclass(frozen=True)
class Tuning:
    """All controllers for one machine on one string."""

    case: TuneCase
    string_modes_hz: tuple[float, ...]
    """With the top held."""
    tuned: tuple[Tuned, ...]
    searched: Search | None
    """How critical speeds were looked for; None: not at all."""


def tune(
    case: TuneCase, search: Search | None = Search(), told: Callable[[str], None] = lambda text: None  # noqa: B008
) -> Tuning:
    """Present, stiff, soft, compensated, broadband. `TuningRefused` where what was asked for explicitly can't be.

    ``search`` None leaves the simulated critical speeds out; ``told`` hears what is being done.
    """
    told("string's modes")
    held = string_modes_hz(case.string)
    present = case.present
    recipes: list[tuple[str, Callable[[], Tuned]]] = [
        *([("present", lambda: Tuned("present", present))] if present is not None else []),
        ("stiff", lambda: _stiff(case)),
        ("soft", lambda: _soft(case, held)),
        ("compensated", lambda: _compensated(case, held)),
        ("broadband", lambda: _broadband(case, held)),
    ]
    found = []
    for kind, recipe in recipes:
        told(f"{kind}: gains")
        tuned = recipe()
        found.append(tuned if tuned.controller is None else _with_figures(case, tuned, held, told))
    tuned_all = tuple(found)
    if search is not None and case.string.bit is not None:
        tuned_all = _with_critical_speeds(case, tuned_all, held, search, told)
    return Tuning(case, held, tuned_all, search if case.string.bit is not None else None)


def string_modes_hz(string: DrillString) -> tuple[float, ...]:
    """The lowest three modes with the top held, Hz."""
    modes = ClosedSystem(string).modes(3.2 / string.echo_s)
    return tuple(mode.frequency_hz for mode in modes[:3])


def lowest_modes_below_hz(held_hz: Sequence[float]) -> float:
    """What swings below is what the string's lowest mode has become; the next, which rotor and P hold, stays above."""
    second = held_hz[1] if len(held_hz) > 1 else 4.0 * held_hz[0]
    return max(sqrt(held_hz[0] * second), NEXT_MODE_SHARE * second)


def lowest_modes(
    case: TuneCase, drive: TopDrive, law: SpeedController, held_hz: Sequence[float]
) -> tuple[NaturalMode, ...]:
    """Those that the string's lowest mode has become."""
    return ClosedSystem(case.string, drive, law).modes(lowest_modes_below_hz(held_hz))


def least_damping(case: TuneCase, drive: TopDrive, law: SpeedController, held_hz: Sequence[float]) -> float:
    """Of `lowest_modes`; 1 where none swings."""
    return min((mode.damping for mode in lowest_modes(case, drive, law, held_hz)), default=1.0)


# ---------------------------------------------------------------------------------------------------------------------
# The four recipes.


def _stiff(case: TuneCase) -> Tuned:
    try:
        return Tuned("stiff", stiff_controller(case.drive, case.phase_margin_deg))
    except ValueError as error:
        return Tuned("stiff", None, str(error))


def _soft(case: TuneCase, held: Sequence[float]) -> Tuned:
    softest = softest_allowed(case.string, case.drive, held[0])
    asked = case.softness
    if asked is not None:
        if asked >= softest:
            raise TuningRefused(_too_soft(case, asked, softest, held), where=f"--a {asked:g}",
                                next_step=f"Ask for less than {LAG_RESERVE * softest:.2g}, or find a shorter loop")
        softness = asked
    else:
        best = _best_softness(case, held, 0.0, LAG_RESERVE * softest)
        if best is None:
            return Tuned("soft", None, _too_soft(case, _LEAST_SOFT, softest, held), softest=softest)
        softness = best
    law = tuned_controller(case.string, case.drive.inertia_kg_m2, softness, held[0])
    if not _stable_everywhere(case, softness, 0.0, held):
        words = (f"with a = {softness:.2g} the whole swings by itself at some J of the interval: "
                 f"{_lag_ms(case)} of lag in the loop are too many for this string")
        if asked is not None:
            raise TuningRefused(words, where=f"--a {asked:g}", next_step="Ask for less, or find a shorter loop")
        return Tuned("soft", None, words, softest=softest)
    return Tuned("soft", law, softness=softness, softest=softest)


def _compensated(case: TuneCase, held: Sequence[float]) -> Tuned:
    asked = case.compensated_share
    if case.string.supposed:
        if asked:
            raise TuningRefused(_WAVES_SUPPOSED, where=f"--compensate {asked:g}", next_step="--string string.yaml")
        return Tuned("compensated", None, _WAVES_SUPPOSED)
    start = case.softness if case.softness is not None else 0.3
    largest = largest_stable_share(case, start, held)
    if asked is not None:
        if asked > largest:
            raise TuningRefused(
                f"{100 * asked:.0f} % of J compensated swings by itself if J is {_worst(case)}; at most "
                f"{100 * largest:.0f} % is stable over J's interval behind {_lag_ms(case)} of lag",
                where=f"--compensate {asked:g}",
                next_step=f"Ask for {RESERVE * largest:.2f} or less, narrow J's interval, or find a shorter loop")
        shares = [asked]
    else:
        shares = [RESERVE * largest * part for part in (0.5, 0.75, 1.0)]
        if largest < 0.05:
            return Tuned("compensated", None, f"not even 5 % of J can be compensated over J's interval behind "
                                              f"{_lag_ms(case)} of lag", largest_share=largest)
    best: tuple[float, float, float, float] | None = None
    for share in shares:
        softest = LAG_RESERVE * softest_allowed(case.string, case.drive, held[0], share)
        softness = case.softness if case.softness is not None else _best_softness(case, held, share, softest)
        if softness is None or softness > softest:
            continue
        # a softer one bears less than `start` does: what is chosen keeps its reserve at its own a
        here = largest_stable_share(case, softness, held)
        if share > (here if asked is not None else RESERVE * here):
            continue
        law = tuned_controller(case.string, case.drive.inertia_kg_m2, softness, held[0], share)
        damping = min(least_damping(case, drive, law, held) for drive in case.at_inertias[:: STEPS // 2])
        if best is None or damping > best[0]:
            best = damping, share, softness, here
    if best is None:
        return Tuned("compensated", None, "no a is stable beside it, with a reserve", largest_share=largest)
    _, share, softness, largest = best
    law = tuned_controller(case.string, case.drive.inertia_kg_m2, softness, held[0], share)
    softest = softest_allowed(case.string, case.drive, held[0], share)
    return Tuned("compensated", law, softness=softness, softest=softest, compensated_share=share, largest_share=largest)


def _broadband(case: TuneCase, held: Sequence[float]) -> Tuned:
    if case.string.supposed:
        return Tuned("broadband", None, _WAVES_SUPPOSED)
    best: tuple[float, float, float, float] | None = None
    largest = 0.0
    softness: float
    for softness in np.geomspace(0.1, 1.0, 7):
        here = largest_stable_share(case, float(softness), held)
        largest = max(largest, here)
        share = RESERVE * here
        if softness > LAG_RESERVE * softest_allowed(case.string, case.drive, held[0], share) or share < 0.05:
            continue
        law = tuned_controller(case.string, case.drive.inertia_kg_m2, float(softness), held[0], share)
        mean = reflections(case, case.drive, law, held[0])[1]
        if best is None or mean < best[0]:
            best = mean, float(softness), share, here
    if best is None:
        words = f"not even 5 % of J can be compensated over J's interval behind {_lag_ms(case)} of lag"
        return Tuned("broadband", None, words, largest_share=largest)
    mean, softness, share, here = best
    if mean > BROADBAND_BELOW:
        words = (f"|r| over {BAND_HZ[0]:g} to {BAND_HZ[1]:g} Hz comes down to {mean:.2f} at best, with "
                 f"{100.0 * share:.0f} % of J compensated, all that {_lag_ms(case)} of lag in the loop and J's "
                 "interval allow; matching needs nearly all of J")
        return Tuned("broadband", None, words, largest_share=here)
    softness = round(float(softness), 3)
    law = tuned_controller(case.string, case.drive.inertia_kg_m2, softness, held[0], share)
    softest = softest_allowed(case.string, case.drive, held[0], share)
    return Tuned("broadband", law, softness=softness, softest=softest, compensated_share=share, largest_share=here)


def _best_softness(case: TuneCase, held: Sequence[float], share: float, most: float) -> float | None:
    """The a that damps the least damped of the lowest modes most; None: none within the lags' bound is stable."""
    top = min(_MOST_SOFT, most)
    if top <= _LEAST_SOFT:
        return None

    def damping(softness: float) -> float:
        law = tuned_controller(case.string, case.drive.inertia_kg_m2, softness, held[0], share)
        return least_damping(case, case.drive, law, held)

    grid = np.geomspace(_LEAST_SOFT, top, 15)
    seen = [damping(float(one)) for one in grid]
    at = int(np.argmax(seen))
    if seen[at] <= 0.0:
        return None
    low, high = float(grid[max(0, at - 1)]), float(grid[min(len(grid) - 1, at + 1)])
    golden = 0.5 * (sqrt(5.0) - 1.0)
    a, b = high - golden * (high - low), low + golden * (high - low)
    of_a, of_b = damping(a), damping(b)
    for _ in range(7):
        if of_a < of_b:
            low, a, of_a = a, b, of_b
            b = low + golden * (high - low)
            of_b = damping(b)
        else:
            high, b, of_b = b, a, of_a
            a = high - golden * (high - low)
            of_a = damping(a)
    return round(0.5 * (low + high), 3)


def largest_stable_share(
    case: TuneCase, softness: float, held_hz: Sequence[float], believed_upper: bool = True
) -> float:
    """The largest share of the believed J that is stable for every J of the interval, to 0.01; 0: none.

    ``believed_upper``: also if J's upper end were believed.
    """
    low, high = 0.0, 1.0
    while high - low > 0.01:
        middle = 0.5 * (low + high)
        stable = _stable_everywhere(case, softness, middle, held_hz, believed_upper)
        low, high = (middle, high) if stable else (low, middle)
    return low


def _stable_everywhere(
    case: TuneCase, softness: float, share: float, held: Sequence[float], believed_upper: bool = True
) -> bool:
    """Stable at both ends of J's interval, with the believed J's gains; and if its upper end is believed.

    And whatever else is moved to an end of its interval, at J's lower end, which bears least compensation.
    """
    inertia = case.inertia_kg_m2
    law = tuned_controller(case.string, inertia.value, softness, held[0], share)
    upper = tuned_controller(case.string, inertia.high, softness, held[0], share)
    wanted = [(inertia.low, law), (inertia.high, law), *([(inertia.value, upper)] if believed_upper else [])]
    ends = [end for pair in case.moves(present=False) for end in pair]
    return all(_is_stable(case.string, case.drive.with_inertia(true), one) for true, one in wanted) and all(
        _is_stable(end.string, end.drive.with_inertia(inertia.low), law) for end in ends)


def _is_stable(string: DrillString, drive: TopDrive, law: SpeedController) -> bool:
    try:
        return ClosedSystem(string, drive, law).is_stable()
    except RootsLost:      # a pole on the axis itself
        return False


def _too_soft(case: TuneCase, softness: float, softest: float, held: Sequence[float]) -> str:
    return (f"a = {softness:.2g} is beyond ζ/(ω² J Στ) = {softest:.2g}: with {_lag_ms(case)} of lag in the loop and "
            f"the string's lowest mode at {held[0]:.3g} Hz the drive would feed slow swings")


def _lag_ms(case: TuneCase) -> str:
    return f"{1e3 * case.drive.total_lag_s:.0f} ms"


def _worst(case: TuneCase) -> str:
    inertia = case.inertia_kg_m2
    return f"{inertia.low:.4g} kg·m², the lower end of its interval, or {inertia.high:.4g} were believed, the upper"


# ---------------------------------------------------------------------------------------------------------------------
# What follows from the gains.


def reflections(case: TuneCase, drive: TopDrive, law: SpeedController, mode_hz: float) -> tuple[float, float]:
    """(|r| at the lowest mode, its mean over the band)."""
    band = np.linspace(*BAND_HZ, 120)
    at = reflection_at(drive, law, case.string, np.append(band, mode_hz))
    return float(at[-1]), float(np.mean(at[:-1]))


def figures_at(
    case: TuneCase, drive: TopDrive, law: SpeedController, held_hz: Sequence[float]
) -> tuple[float, float, float]:
    """(|r| at the lowest mode, mean |r|, least damping), at one J."""
    one, mean = reflections(case, drive, law, held_hz[0])
    return one, mean, least_damping(case, drive, law, held_hz)


def _with_figures(case: TuneCase, tuned: Tuned, held: Sequence[float], told: Callable[[str], None]) -> Tuned:
    law = tuned.controller
    assert law is not None
    told(f"{tuned.kind}: reflection, modes, margins")
    along = np.array([figures_at(case, drive, law, held) for drive in case.at_inertias])
    present = tuned.kind == "present"
    pairs = case.moves(present=present)
    heard = [[held if end.string is case.string else string_modes_hz(end.string) for end in pair] for pair in pairs]
    moved = np.array([
        [figures_at(end, end.drive, (end.present or law) if present else law, modes)
         for end, modes in zip(pair, own, strict=True)]
        for pair, own in zip(pairs, heard, strict=True)
    ]).reshape(len(pairs), 2, 3)
    inertia = case.inertia_kg_m2
    integral = None
    if tuned.kind != "stiff" and not present:
        share = 1.0 - tuned.compensated_share
        of = [[(2.0 * pi * modes[0]) ** 2 * share * inertia.value for modes in own] for own in heard]
        square = (2.0 * pi * held[0]) ** 2 * share
        integral = in_squares(Interval(law.integral_nm_rad, square * inertia.low, square * inertia.high), of)
    system = ClosedSystem(case.string, case.drive, law)
    errors = WRONG_BY if not present else ()       # those gains hang on no J that is believed now
    wrong = tuple(_wrong(case, tuned, error, held) for error in errors)
    return replace(
        tuned, integral_nm_rad=integral, reflection=in_squares(_spanned(along[:, 0]), moved[:, :, 0]),
        band_reflection=in_squares(_spanned(along[:, 1]), moved[:, :, 1]),
        damping=in_squares(_spanned(along[:, 2]), moved[:, :, 2], -inf, 1.0, (along[0, 2], along[-1, 2])),
        modes=system.modes(1.1 * held[min(2, len(held) - 1)]),
        margins=margins(case.drive, law, case.string), lag_reserve_s=_lag_reserve(case, law), wrong=wrong,
    )


def _spanned(along: NDArray[np.float64]) -> Interval:
    """What these values span, and the turning points between them: of the parabola through the nearest three."""
    low, high = float(along.min()), float(along.max())
    for k in range(1, len(along) - 1):
        before, here, after = (float(one) for one in along[k - 1 : k + 2])
        bend = before - 2.0 * here + after
        if (here - before) * (after - here) <= 0.0 and bend != 0.0:
            turning = here - (after - before) ** 2 / (8.0 * bend)
            low, high = min(low, turning), max(high, turning)
    return Interval(float(along[len(along) // 2]), max(low, 0.0) if along.min() >= 0.0 else low, high)


def in_squares(
    by_inertia: Interval, moved: Sequence[Sequence[float]] | NDArray[np.float64], least: float = 0.0, most: float = inf,
    ends: tuple[float, float] | None = None,
) -> Interval:
    """An interval over J, widened by what each other move makes of the value at either of its ends.

    ``ends``: the values at J's own. Where the least of two dampings has its greatest value every single move lowers
    it, and two together may raise it: by no more than the mean of both slopes does, which is half of the difference
    between the ends.
    """
    if not len(moved):
        return by_inertia
    value = by_inertia.value
    below, above = value - by_inertia.low, by_inertia.high - value
    if ends is not None:
        above = max(above, 0.5 * abs(ends[1] - ends[0]))
    below, above = below**2, above**2
    for pair in moved:
        slope = 0.5 * abs(pair[1] - pair[0])
        below += max(slope, value - min(pair)) ** 2
        above += max(slope, max(pair) - value) ** 2
    return Interval(value, max(least, value - sqrt(below)), min(most, value + sqrt(above)))


def _lag_reserve(case: TuneCase, law: SpeedController) -> float | None:
    """How much one more lag in the loop may be; to 1 ms or 2 %."""
    low, high = 0.0, 1.0

    def stable(more_s: float) -> bool:
        lags = (*case.drive.inner_lags_s, more_s)
        return _is_stable(case.string, replace(case.drive, inner_lags_s=lags), law)

    if stable(high):
        return None
    while high - low > max(0.001, 0.02 * high):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if stable(middle) else (low, middle)
    return low


def recipe_with(case: TuneCase, tuned: Tuned, believed_kg_m2: float, held_hz: Sequence[float]) -> SpeedController:
    """The same kind of controller for another J: the stiff one's margin, or a and the compensated share, as before."""
    if tuned.kind == "stiff":
        return stiff_controller(case.drive.with_inertia(believed_kg_m2), case.phase_margin_deg)
    assert tuned.softness is not None
    return tuned_controller(case.string, believed_kg_m2, tuned.softness, held_hz[0], tuned.compensated_share)


def _wrong(case: TuneCase, tuned: Tuned, error: float, held: Sequence[float]) -> WrongInertia:
    law = recipe_with(case, tuned, (1.0 + error) * case.inertia_kg_m2.value, held)
    stable = _is_stable(case.string, case.drive, law)
    return WrongInertia(error, stable, least_damping(case, case.drive, law, held) if stable else None, None)


def _with_critical_speeds(
    case: TuneCase, every: tuple[Tuned, ...], held: Sequence[float], search: Search, told: Callable[[str], None]
) -> tuple[Tuned, ...]:
    inertia = case.inertia_kg_m2
    taken = [one for one in every if one.controller is not None]
    believed = [
        (case.string, case.drive.with_inertia(true), one.controller)
        for one in taken for true in (inertia.value, inertia.low, inertia.high) if one.controller is not None
    ]
    ends = [
        (end.string, end.drive, end.present or one.controller if one.kind == "present" else one.controller)
        for one in taken for pair in case.moves(present=one.kind == "present") for end in pair
        if one.controller is not None
    ]
    told("critical speeds, simulated: cure, start, onset")
    speeds = _critical_speeds([*believed, *ends], search)
    found, moved = speeds[: len(believed)], iter(speeds[len(believed) :])
    wrong = [(one.kind, part.error) for one in taken for part in one.wrong if part.stable]
    by_kind = {one.kind: one for one in taken}
    told("what a wrong J costs, simulated")
    cures = lowest_turning(
        case.string,
        [(case.drive, recipe_with(case, by_kind[kind], (1.0 + error) * inertia.value, held)) for kind, error in wrong],
        "stuck", search,
    ) if wrong else []
    cure = dict(zip(wrong, cures, strict=True))
    done = {
        one.kind: replace(
            one, critical=found[3 * k], critical_low=found[3 * k + 1], critical_high=found[3 * k + 2],
            critical_moved=tuple((next(moved), next(moved)) for _ in case.moves(present=one.kind == "present")),
            wrong=tuple(replace(part, cure_rpm=cure.get((one.kind, part.error))) for part in one.wrong),
        )
        for k, one in enumerate(taken)
    }
    return tuple(done.get(one.kind, one) for one in every)


def _critical_speeds(
    loops: Sequence[tuple[DrillString, TopDrive, SpeedController]], search: Search
) -> list[CriticalSpeeds]:
    """In the order of ``loops``: those on one string at once."""
    found: dict[int, CriticalSpeeds] = {}
    for string in dict.fromkeys(string for string, _, _ in loops):
        at = [k for k, (one, _, _) in enumerate(loops) if one == string]
        found |= zip(at, critical_speeds(string, [loops[k][1:] for k in at], search), strict=True)
    return [found[k] for k in range(len(loops))]

"""Recipes for controllers: stiff, soft, compensated, broadband. Each must keep the margins on every truth.

**Soft** compensates no inertia: every drive can run it. **Compensated** compensates a part of the rotor's inertia.
**Broadband** aims at full compensation and P = ζ, as far as lags and margins allow. If the result is no better than a
soft controller, broadband is refused.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import log

import numpy as np

from tdhil.soft_torque.candidates import (
    OUTER_SOFTNESSES,
    SHARES,
    SOFTNESS_RANGE,
    SOFTNESSES,
    Candidate,
    candidates,
    ranked_speeds,
)
from tdhil.soft_torque.controller import SpeedController, softest_allowed, stiff_controller, tuned_controller
from tdhil.soft_torque.critical_speed import longest_integral_time_s
from tdhil.soft_torque.drill_string import MUD_DRAG_NM_S_RAD_M
from tdhil.soft_torque.stability import StringResponses, is_stable
from tdhil.soft_torque.truth_margins import TruthMargins
from tdhil.soft_torque.tune_case import TuneCase, Tuned, TuningRefused
from tdhil.soft_torque.tuned_figures import BAND_HZ, reflections

RESERVE = 0.8
"""Largest compensated share of J, divided by the largest stable share."""
LAG_RESERVE = 0.9
"""Largest softness a, divided by the largest that the lags allow."""
BROADBAND_BELOW = 0.8
"""Mean |r| up to which a controller counts as broadband. A soft controller has 0.94 on the reference case."""
SEARCH_DRAWS = 6
"""Number of truths on which candidates are ranked and finalists are simulated."""
FINALISTS, MOST_TRIED = 5, 120
"""Number of candidates of one kind that are simulated, and the most that are checked against the margins."""
USUAL_SOFTNESS = 0.3
"""Softness a with which the largest stable share is searched, and that a refusal names as an example."""
_SOFTER = (2.0, 5.0)
"""The same for light drives with long lags, if no share is stable with the usual one."""
_WAVES_SUPPOSED = ("the string is known as a spring only: the effect of inertia compensation on the waves of the pipe "
                   "is unknown. State the pipe in string.yaml")


def stiff(case: TuneCase) -> Tuned:
    """Return the stiffest PI that keeps the stated phase margin on the bare drive."""
    try:
        return Tuned("stiff", stiff_controller(case.drive, case.phase_margin_deg))
    except ValueError as error:
        return Tuned("stiff", None, str(error))


def soft(case: TuneCase, held: Sequence[float], samples: TruthMargins) -> list[Tuned]:
    """Return soft controllers, best first, or one refused row if none keeps the margins.

    Raises `TuningRefused` if the requested softness is too large or leaves too little margin.
    """
    softest = softest_allowed(case.string, case.drive, held[0])
    asked = case.softness
    if asked is not None and asked >= softest:
        raise TuningRefused(
            f"a = {asked:.2g} is beyond ζ/(ω² J Στ) = {softest:.2g}: with {_lag_ms(case)} of lag in the loop and the "
            f"string's lowest mode at {held[0]:.3g} Hz the drive would amplify slow oscillations",
            where=f"--a {asked:g}",
            next_step=f"Ask for less than {LAG_RESERVE * softest:.2g}, or find a shorter loop")
    kept = _searched(case, held, samples, (0.0,))
    if not kept:
        tried = tuned_controller(case.string, case.drive.inertia_kg_m2, asked or USUAL_SOFTNESS, held[0])
        words = _no_margin(case, held, samples, tried)
        if asked is not None:
            others = [one.softness for one in _searched(replace(case, softness=None), held, samples, (0.0,))]
            advice = "No a that tdhil tried keeps the margins. Find a shorter loop"
            if others:
                other = min(others, key=lambda one: abs(log(one / asked)))
                advice = (f"Ask for a {'larger' if other > asked else 'smaller'} a: {other:.2g} keeps the margins. Or "
                          "leave --a out, or find a shorter loop")
            raise TuningRefused(f"a = {asked:g} leaves too little margin: {words}", where=f"--a {asked:g}",
                                next_step=advice)
        low, high = SOFTNESS_RANGE
        return [Tuned("soft", None, f"no a from {low:g} to {high:g} that tdhil tried keeps the margins; "
                      f"a = {USUAL_SOFTNESS:g}, for one: {words}", softest=softest)]
    return [Tuned("soft", one.controller, softness=one.softness, frequency_factor=one.frequency_factor,
                  softest=softest) for one in kept]


def compensated(case: TuneCase, held: Sequence[float], samples: TruthMargins) -> list[Tuned]:
    """Return controllers that compensate a share of J, best first, or one refused row if none keeps the margins.

    Raises `TuningRefused` if the requested share is too large, leaves too little margin, or if the string is only an
    identified spring.
    """
    asked = case.compensated_share
    if case.string.supposed:
        if asked:
            raise TuningRefused(_WAVES_SUPPOSED, where=f"--compensate {asked:g}", next_step="--string string.yaml")
        return [Tuned("compensated", None, _WAVES_SUPPOSED)]
    largest = 0.0
    for softness in (case.softness or USUAL_SOFTNESS, *(_SOFTER if case.softness is None and asked is None else ())):
        largest = max(largest, largest_stable_share(case, softness, held, responses=samples.responses))
        if RESERVE * largest >= SHARES[0]:
            break
    if asked is not None and asked > largest:
        raise TuningRefused(
            f"{100 * asked:.0f} % of J compensated is unstable if J is {_worst(case)}; at most "
            f"{100 * largest:.0f} % is stable over J's interval behind {_lag_ms(case)} of lag{_no_drag(case)}",
            where=f"--compensate {asked:g}",
            next_step=f"Ask for {RESERVE * largest:.2f} or less, narrow J's interval, or find a shorter loop")
    shares = tuple(share for share in SHARES if share <= RESERVE * largest) if asked is None else (asked,)
    kept = _searched(case, held, samples, shares)
    if not kept:
        share = asked if asked is not None else SHARES[0]
        tried = tuned_controller(case.string, case.drive.inertia_kg_m2, softness, held[0], share)
        words = _no_margin(case, held, samples, tried)
        if asked is not None:
            raise TuningRefused(
                f"{100 * asked:.0f} % of J compensated leaves too little margin: {words}",
                where=f"--compensate {asked:g}",
                next_step="Ask for less, allow less margin with --margins, or find a shorter loop")
        return [Tuned("compensated", None, "no share of J that tdhil tried keeps the margins; "
                      f"{100 * share:.0f} %, for one: {words}", largest_share=largest)]
    return [Tuned("compensated", one.controller, softness=one.softness, frequency_factor=one.frequency_factor,
                  softest=softest_allowed(case.string, case.drive, one.frequency_factor * held[0], one.share),
                  compensated_share=one.share, largest_share=largest) for one in kept]


def _searched(
    case: TuneCase, held: Sequence[float], samples: TruthMargins, shares: Sequence[float]
) -> list[Candidate]:
    """Return the best candidates with one of these shares that keep the margins: with the requested a, or with any."""
    asked = case.softness

    def kept(softnesses: Sequence[float]) -> list[Candidate]:
        grid = candidates(case.string, case.drive.inertia_kg_m2, held[0], shares, softnesses)
        allowed = [one for one in grid if (asked is not None and not one.share) or one.softness <= LAG_RESERVE *
                   softest_allowed(case.string, case.drive, one.frequency_factor * held[0], one.share)]
        return _within_margins(case, allowed, samples)

    if asked is not None:
        return kept((asked,))
    found = kept(SOFTNESSES)
    inside = found and all(SOFTNESSES[0] < one.softness < SOFTNESSES[-1] for one in found)
    return found if inside else [*found, *kept(OUTER_SOFTNESSES)]


def _within_margins(case: TuneCase, grid: Sequence[Candidate], samples: TruthMargins) -> list[Candidate]:
    """Return the `FINALISTS` candidates with the best rank among those that keep the margins on every truth."""
    if not grid:
        return []
    speeds = ranked_speeds(samples.truths[:SEARCH_DRAWS], [one.controller for one in grid])
    order = np.argsort(np.mean(np.log(np.maximum(speeds, 1e-3)), axis=1), kind="stable")
    kept = []
    for at in order[:MOST_TRIED]:
        if samples.keeps(grid[at].controller, case.required):
            kept.append(grid[at])
            if len(kept) == FINALISTS:
                break
    return kept


def _no_margin(case: TuneCase, held: Sequence[float], samples: TruthMargins, law: SpeedController) -> str:
    """Return the text that names the failed margins, each with its least value over all truths."""
    failed = (*case.required.failed(samples.every(law)), *_too_slow(law, held))
    return ", ".join(failed or ("too soft for these lags",)) + (
        f" over J's interval, string, bit and {_lag_ms(case)} of lag{_no_drag(case)}")


def _too_slow(law: SpeedController, held: Sequence[float]) -> tuple[str, ...]:
    """Return the text that the integral time is longer than a search can judge, if it is."""
    longest_s = longest_integral_time_s(held[0])
    if law.integral_time_s <= longest_s:
        return ()
    return (f"integral time {law.integral_time_s:.0f} s (limit {longest_s:.0f} s, eight periods of the string)",)


def _no_drag(case: TuneCase) -> str:
    """Return the hint that string.yaml states no drag; empty if any section has drag."""
    if any(line.drag_nm_s_rad_m > 0.0 for line in case.string.lines):
        return ""
    return (". string.yaml states no drag (drag_nm_s_rad_m: 0): nothing takes energy out of the pipe's waves. Mud has "
            f"about {MUD_DRAG_NM_S_RAD_M:g} N·m·s/rad per metre")


def broadband(case: TuneCase, held: Sequence[float], samples: TruthMargins) -> Tuned:
    """Return the controller with the least mean reflection over `BAND_HZ`, or a refused row if it is not broadband."""
    if case.string.supposed:
        return Tuned("broadband", None, _WAVES_SUPPOSED)
    best: tuple[float, float, float, float] | None = None
    largest = 0.0
    softness: float
    for softness in np.geomspace(0.1, 1.0, 7):
        here = largest_stable_share(case, float(softness), held, responses=samples.responses)
        largest = max(largest, here)
        share = RESERVE * here
        if softness > LAG_RESERVE * softest_allowed(case.string, case.drive, held[0], share) or share < 0.05:
            continue
        law = tuned_controller(case.string, case.drive.inertia_kg_m2, float(softness), held[0], share)
        mean = reflections(case, case.drive, law, held[0])[1]
        if best is None or mean < best[0]:
            best = mean, float(softness), share, here
    if best is None:
        words = f"not even 5 % of J can be compensated over J's interval behind {_lag_ms(case)} of lag{_no_drag(case)}"
        return Tuned("broadband", None, words, largest_share=largest)
    mean, softness, share, here = best
    if mean > BROADBAND_BELOW:
        words = (f"|r| over {BAND_HZ[0]:g} to {BAND_HZ[1]:g} Hz comes down to {mean:.2f} at best, with "
                 f"{100.0 * share:.0f} % of J compensated, all that {_lag_ms(case)} of lag in the loop and J's "
                 "interval allow; matching needs nearly all of J")
        return Tuned("broadband", None, words, largest_share=here)
    softness = round(float(softness), 3)
    law = tuned_controller(case.string, case.drive.inertia_kg_m2, softness, held[0], share)
    thin = (*case.required.failed(samples.every(law)), *_too_slow(law, held))
    if thin:
        return Tuned("broadband", None, f"it would leave too little margin: {', '.join(thin)}", largest_share=here)
    softest = softest_allowed(case.string, case.drive, held[0], share)
    return Tuned("broadband", law, softness=softness, softest=softest, compensated_share=share, largest_share=here)


def largest_stable_share(
    case: TuneCase, softness: float, held_hz: Sequence[float], believed_upper: bool = True,
    responses: StringResponses | None = None,
) -> float:
    """Return the largest compensated share of the estimated J that is stable over J's and over each other interval.

    The resolution is 0.01; 0 means that no share is stable. The gains from the estimated J are checked at both ends of
    J's interval. ``believed_upper``: the gains from its upper end are checked at the estimated J. Each other parameter
    is moved to either end of its interval, with J at its lower end, which allows the least compensation.
    ``responses``: of the strings, if some were computed before.
    """
    inertia, low, high = case.inertia_kg_m2, 0.0, 1.0
    responses = responses or StringResponses()
    ends = [end for pair in case.moves(present=False) for end in pair]
    while high - low > 0.01:
        middle = 0.5 * (low + high)
        law = tuned_controller(case.string, inertia.value, softness, held_hz[0], middle)
        upper = tuned_controller(case.string, inertia.high, softness, held_hz[0], middle)
        wanted = [(inertia.low, law), (inertia.high, law), *([(inertia.value, upper)] if believed_upper else [])]
        loops = [(case.string, case.drive.with_inertia(true), one) for true, one in wanted]
        loops += [(end.string, end.drive.with_inertia(inertia.low), law) for end in ends]
        stable = all(is_stable(*loop, responses.of(*loop)) for loop in loops)
        low, high = (middle, high) if stable else (low, middle)
    return low


def _lag_ms(case: TuneCase) -> str:
    return f"{1e3 * case.drive.total_lag_s:.0f} ms"


def _worst(case: TuneCase) -> str:
    inertia = case.inertia_kg_m2
    return (f"{inertia.low:.4g} kg·m², the lower end of its interval, or the gains are for {inertia.high:.4g}, the"
            " upper end")

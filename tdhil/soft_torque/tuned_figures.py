r"""Figures of one controller: reflection, damping and margins. Reflection and damping have an interval.

**Effect of the error of J.** The gains are fixed, and J varies. The figures of the stated string are computed over the
95 % interval of J, with the extrema between its ends. Each other measured quantity (lags, present gains) is moved to
either end of its interval, one after the other. J and the identified string are correlated: the string is moved along
independent axes of their covariance, with J, and J alone only by the rest of its interval. All effects are combined as
the root of the sum of squares.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from math import inf, pi, sqrt

import numpy as np
from numpy.typing import NDArray

from tdhil.soft_torque.candidates import gains
from tdhil.soft_torque.controller import (
    ClosedSystem,
    NaturalMode,
    SpeedController,
    TopDrive,
    margins,
    reflection_at,
    stiff_controller,
)
from tdhil.soft_torque.drill_string import DrillString
from tdhil.soft_torque.stability import is_stable, loop_margins
from tdhil.soft_torque.truth_margins import TruthMargins
from tdhil.soft_torque.tune_case import TuneCase, Tuned, WrongInertia
from tdhil.soft_torque.uncertainty import Interval

BAND_HZ = (0.05, 1.5)
"""Frequency band, Hz, over which the mean |r| is taken."""
WRONG_BY = (0.126, 0.76)
"""Relative errors of J whose effect is shown. The first is that of the acceleration regression (Xu 2026) on a simulated
field rig. The second is the spread of its slopes."""
NEXT_MODE_SHARE = 0.85
"""Lower bound of the second mode of string and top drive, as a share of the second mode with the top held. At this
frequency, a top drive acts as a rotor or as a fixed end."""
GOLDEN_STEPS = 7
"""Number of golden-section steps. Each keeps 0.62 of the range with the extremum; all leave 0.03 of two steps of J."""


def string_modes_hz(string: DrillString) -> tuple[float, ...]:
    """Return the frequencies of the lowest three modes with the top held, Hz."""
    modes = ClosedSystem(string).modes(3.2 / string.echo_s)
    return tuple(mode.frequency_hz for mode in modes[:3])


def lowest_modes_below_hz(held_hz: Sequence[float]) -> float:
    """Return the frequency, Hz, below which a mode belongs to the string's lowest one. Other modes are above it."""
    second = held_hz[1] if len(held_hz) > 1 else 4.0 * held_hz[0]
    return max(sqrt(held_hz[0] * second), NEXT_MODE_SHARE * second)


def lowest_modes(
    case: TuneCase, drive: TopDrive, law: SpeedController, held_hz: Sequence[float]
) -> tuple[NaturalMode, ...]:
    """Return the modes of string and top drive that belong to the string's lowest mode."""
    return ClosedSystem(case.string, drive, law).modes(lowest_modes_below_hz(held_hz))


def least_damping(case: TuneCase, drive: TopDrive, law: SpeedController, held_hz: Sequence[float]) -> float:
    """Return the least damping ratio of `lowest_modes`. 1: none of them oscillates."""
    return min((mode.damping for mode in lowest_modes(case, drive, law, held_hz)), default=1.0)


def reflections(case: TuneCase, drive: TopDrive, law: SpeedController, mode_hz: float) -> tuple[float, float]:
    """Return (|r| at the lowest mode, mean |r| over `BAND_HZ`)."""
    band = np.linspace(*BAND_HZ, 120)
    at = reflection_at(drive, law, case.string, np.append(band, mode_hz))
    return float(at[-1]), float(np.mean(at[:-1]))


def figures_at(
    case: TuneCase, drive: TopDrive, law: SpeedController, held_hz: Sequence[float]
) -> tuple[float, float, float]:
    """Return (|r| at the lowest mode, mean |r| over `BAND_HZ`, least damping ratio) for one drive."""
    one, mean = reflections(case, drive, law, held_hz[0])
    return one, mean, least_damping(case, drive, law, held_hz)


def with_figures(case: TuneCase, tuned: Tuned, held: Sequence[float], samples: TruthMargins) -> Tuned:
    """Return the row with its figures. The row must have gains."""
    law = tuned.controller
    assert law is not None
    along = np.array([figures_at(case, drive, law, held) for drive in case.at_inertias])
    present = tuned.kind == "present"
    pairs = case.moves(present=present)
    heard = [[held if end.string is case.string else string_modes_hz(end.string) for end in pair] for pair in pairs]
    moved = np.array([
        [figures_at(end, end.drive, (end.present or law) if present else law, modes)
         for end, modes in zip(pair, own, strict=True)]
        for pair, own in zip(pairs, heard, strict=True)
    ]).reshape(len(pairs), 2, 3)
    inertia = case.inertia_alone
    integral = None
    if tuned.kind != "stiff" and not present:
        share = 1.0 - tuned.compensated_share
        omega = 2.0 * pi * tuned.frequency_factor
        of = [[(omega * modes[0]) ** 2 * share * end.drive.inertia_kg_m2 for end, modes in zip(pair, own, strict=True)]
              for pair, own in zip(pairs, heard, strict=True)]
        square = (omega * held[0]) ** 2 * share
        integral = in_squares(Interval(law.integral_nm_rad, square * inertia.low, square * inertia.high), of)
    system = ClosedSystem(case.string, case.drive, law)
    errors = WRONG_BY if not present else ()       # the present gains do not depend on the estimated J
    wrong = tuple(_wrong(case, tuned, error, held) for error in errors)
    worst = samples.every(None if present else law)
    damping = _turning_points(along[:, 2], case, lambda drive: least_damping(case, drive, law, held))
    return replace(
        tuned, integral_nm_rad=integral, reflection=in_squares(_spanned(along[:, 0]), moved[:, :, 0]),
        band_reflection=in_squares(_spanned(along[:, 1]), moved[:, :, 1]),
        damping=in_squares(damping, moved[:, :, 2], -inf, 1.0, (along[0, 2], along[-1, 2])),
        modes=system.modes(1.1 * held[min(2, len(held) - 1)]),
        margins=margins(case.drive, law, case.string),
        with_string=loop_margins(case.drive, law, case.string, exact=True),
        worst=worst, failed=case.required.failed(worst), wrong=wrong,
    )


def _turning_points(along: NDArray[np.float64], case: TuneCase, value_at: Callable[[TopDrive], float]) -> Interval:
    """Return the range of a figure over J with its extrema, including kinks at which the least of two values changes.

    The method is a golden-section search between the neighbours of the largest and of the smallest value.
    """
    inertias = case.inertias(len(along))
    ends = [float(along.min()), float(along.max())]
    for side, sign in ((0, -1.0), (1, 1.0)):
        at = int(np.argmax(sign * along))
        if not 0 < at < len(along) - 1:
            continue
        low, high = inertias[at - 1], inertias[at + 1]
        golden = 0.5 * (sqrt(5.0) - 1.0)
        for _ in range(GOLDEN_STEPS):
            a, b = high - golden * (high - low), low + golden * (high - low)
            of_a, of_b = (sign * value_at(case.drive.with_inertia(one)) for one in (a, b))
            ends[side] = sign * max(sign * ends[side], of_a, of_b)
            low, high = (low, b) if of_a > of_b else (a, high)
    return Interval(float(along[len(along) // 2]), *ends)


def _spanned(along: NDArray[np.float64]) -> Interval:
    """Return the range of these values with the extrema between them, from a parabola through three neighbours."""
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
    """Return the interval over J, widened by the effect of each other parameter as the root of the sum of squares.

    ``moved``: values with each other parameter at both ends of its interval. ``least``, ``most``: limits of the result.
    ``ends``: values at both ends of J's interval. They are needed for the least of two dampings: at its maximum, every
    single move lowers it, but two moves together may raise it. The rise is at most that of the mean slope, which is
    half of the difference between the ends.
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


def recipe_with(case: TuneCase, tuned: Tuned, believed_kg_m2: float, held_hz: Sequence[float]) -> SpeedController:
    """Return the controller of the same recipe for another J.

    The stiff controller keeps its phase margin. The others keep a, φ and the compensated share.
    """
    if tuned.kind == "stiff":
        return stiff_controller(case.drive.with_inertia(believed_kg_m2), case.phase_margin_deg)
    assert tuned.softness is not None
    return gains(case.string, believed_kg_m2, held_hz[0], tuned.softness, tuned.frequency_factor,
                 tuned.compensated_share)


def _wrong(case: TuneCase, tuned: Tuned, error: float, held: Sequence[float]) -> WrongInertia:
    law = recipe_with(case, tuned, (1.0 + error) * case.inertia_kg_m2.value, held)
    stable = is_stable(case.string, case.drive, law)
    return WrongInertia(error, stable, least_damping(case, case.drive, law, held) if stable else None, None)

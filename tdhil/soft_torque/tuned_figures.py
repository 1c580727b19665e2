r"""Figures of one controller: reflection, damping, margins, each with its interval.

**How J's error comes in.** The gains are what they are; J is what moves. The figures of one string as it is stated are
told over the 95 % interval of J alone, with the turning points between its ends. What else was measured (lags, present
gains, k and ω as identified) is moved to either end of its interval, one after the other, and what each does is added
in squares.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from math import inf, pi, sqrt

import numpy as np
from numpy.typing import NDArray

from tdhil.soft_torque.candidates import (
    gains,
)
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
from tdhil.soft_torque.stability import (
    is_stable,
    loop_margins,
)
from tdhil.soft_torque.truth_margins import TruthMargins
from tdhil.soft_torque.tune_case import (
    TuneCase,
    Tuned,
    WrongInertia,
)
from tdhil.soft_torque.uncertainty import Interval

BAND_HZ = (0.05, 1.5)
"""Where the mean |r| is taken."""
WRONG_BY = (0.126, 0.76)
"""Errors of J whose cost is told: the paper's method on a simulated field rig, and its own spread of slopes."""
NEXT_MODE_SHARE = 0.85
"""Of the second mode with the top held, that the whole's second mode stays above: there a top drive is a rotor, or a
wall."""
GOLDEN_STEPS = 7
"""Each leaves 0.62 of the range in which a turning point lies: 0.03 of two steps of J."""


def string_modes_hz(string: DrillString) -> tuple[float, ...]:
    """The lowest three modes with the top held, Hz."""
    modes = ClosedSystem(string).modes(3.2 / string.echo_s)
    return tuple(mode.frequency_hz for mode in modes[:3])


def lowest_modes_below_hz(held_hz: Sequence[float]) -> float:
    """Return the frequency below which a mode is the string's lowest one; that of rotor and P is above."""
    second = held_hz[1] if len(held_hz) > 1 else 4.0 * held_hz[0]
    return max(sqrt(held_hz[0] * second), NEXT_MODE_SHARE * second)


def lowest_modes(
    case: TuneCase, drive: TopDrive, law: SpeedController, held_hz: Sequence[float]
) -> tuple[NaturalMode, ...]:
    """Those that the string's lowest mode has become."""
    return ClosedSystem(case.string, drive, law).modes(lowest_modes_below_hz(held_hz))


def least_damping(case: TuneCase, drive: TopDrive, law: SpeedController, held_hz: Sequence[float]) -> float:
    """Return the least damping of `lowest_modes`; 1 where none swings."""
    return min((mode.damping for mode in lowest_modes(case, drive, law, held_hz)), default=1.0)


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


def with_figures(case: TuneCase, tuned: Tuned, held: Sequence[float], samples: TruthMargins) -> Tuned:
    """Return the row with its figures; its gains are known."""
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
    inertia = case.inertia_kg_m2
    integral = None
    if tuned.kind != "stiff" and not present:
        share = 1.0 - tuned.compensated_share
        omega = 2.0 * pi * tuned.frequency_factor
        of = [[(omega * modes[0]) ** 2 * share * inertia.value for modes in own] for own in heard]
        square = (omega * held[0]) ** 2 * share
        integral = in_squares(Interval(law.integral_nm_rad, square * inertia.low, square * inertia.high), of)
    system = ClosedSystem(case.string, case.drive, law)
    errors = WRONG_BY if not present else ()       # those gains hang on no J that is believed now
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
    """Return the span of a figure over J with its turning points, also kinks where the least of two changes sides.

    Golden sections between the neighbours of the largest and of the smallest value.
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
    """Return the span of these values and the turning points between them, by a parabola through the nearest three."""
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


def recipe_with(case: TuneCase, tuned: Tuned, believed_kg_m2: float, held_hz: Sequence[float]) -> SpeedController:
    """The same kind of controller for another J: the stiff one's margin, or a and the compensated share, as before."""
    if tuned.kind == "stiff":
        return stiff_controller(case.drive.with_inertia(believed_kg_m2), case.phase_margin_deg)
    assert tuned.softness is not None
    return gains(case.string, believed_kg_m2, held_hz[0], tuned.softness, tuned.frequency_factor,
                 tuned.compensated_share)


def _wrong(case: TuneCase, tuned: Tuned, error: float, held: Sequence[float]) -> WrongInertia:
    law = recipe_with(case, tuned, (1.0 + error) * case.inertia_kg_m2.value, held)
    stable = is_stable(case.string, case.drive, law)
    return WrongInertia(error, stable, least_damping(case, case.drive, law, held) if stable else None, None)

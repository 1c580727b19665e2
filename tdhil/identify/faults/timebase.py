"""Does the motion repeat with the period that was declared?

If the true period is longer by a share ε, a line of m cycles a period comes back late each time: its phase turns by
−2π m ε a period, at all lines and in all segments by the same ε. That is unlike noise, which turns nothing steadily,
and unlike a transient, which dies out. With R_k(ε) what is left of line k's scatter about its mean once the turning has
been taken out, on ν_k complex degrees of freedom and with the variance of every line unknown, twice the log likelihood
ratio

    Λ(ε) = Σ_k 2 ν_k ln(R_k(0)/R_k(ε))

is about χ² of one degree for ε that isn't there. An inertia from lines at frequencies wrong by ε is wrong by ε, and the
turning counts as scatter besides.
"""

import numpy as np

from tdhil.estimation.frequency_domain.spectrum import ComplexArray, PeriodLines
from tdhil.estimation.result import Refused
from tdhil.estimation.samples import Stretch
from tdhil.recording.recording import FloatArray

_CLEAR = 40.0           # of Λ
_HARMLESS = 5e-4        # of the period: it makes J wrong by as much
_WIDEST = 0.05
_MOST_STEPS = 4001
_STEPS_A_TURN = 32.0
_MOST_PERIODS = 64      # of a segment that are looked at: enough to see a turning that matters
_EQUAL = 1e-6           # of Λ: less is rounding
_FLOOR = 1e-12          # relative: scatter that is the arithmetic's
_CLEAR_LINE = 3.0       # a line that doesn't stand out of its turned scatter says nothing about turning


def check_period(stretches: tuple[Stretch, ...], fits: tuple[PeriodLines, ...]) -> None:
    """Raise Refused, with the period that the data have, where it is another than was declared."""
    found = wrong_period(stretches, fits)
    if found is None or abs(found) <= _HARMLESS:
        return
    declared = stretches[0].segment.period_s
    raise Refused(
        f"the motion repeats every {declared * (1.0 + found):.6g} s, not every {declared:g} s as declared: the time "
        f"base or the declared period is wrong by {abs(found):.2%}",
        "declare the period and the lines as they were run, and check the rate of the time stamps",
    )


def wrong_period(stretches: tuple[Stretch, ...], fits: tuple[PeriodLines, ...]) -> float | None:
    """The share ε by which the true period is longer; None if the data don't show that it is."""
    turning = []
    longest = 0.0
    for stretch, fit in zip(stretches, fits, strict=True):
        if len(fit.speed) < 3:
            continue
        number = np.array(stretch.index[:_MOST_PERIODS], dtype=np.float64)
        number -= number.mean()
        cycles = np.array([round(hertz * stretch.segment.period_s) for hertz in fit.lines_hz], dtype=np.float64)
        turning.append((number, cycles, fit.speed[:_MOST_PERIODS]))
        longest = max(longest, float(np.ptp(number) * np.max(cycles)))
    if not turning:
        return None
    # the likelihood's peak is as wide as half a turn over the whole segment: many steps to a turn
    step = max(1.0 / (_STEPS_A_TURN * longest), 2.0 * _WIDEST / (_MOST_STEPS - 1))
    reach = int(_WIDEST / step)
    trial: FloatArray = np.linspace(-reach * step, reach * step, 2 * reach + 1)
    coarse = _gain(turning, trial)
    # An ε at which no line is clear gains nothing, and so does 0: of equals the smallest, whatever rounding makes of it
    equal = trial[coarse >= np.max(coarse) - _EQUAL]
    best = float(equal[np.argmin(np.abs(equal))])
    fine: FloatArray = np.linspace(best - step, best + step, 81)
    gain = _gain(turning, fine)
    return float(fine[np.argmax(gain)]) if float(np.max(gain)) >= _CLEAR else None


def _gain(turning: list[tuple[FloatArray, FloatArray, ComplexArray]], trial: FloatArray) -> FloatArray:
    """Λ at every trial ε (E,); a line of the same frequency in two segments counts as two."""
    gain = np.zeros(len(trial))
    for number, cycles, speeds in turning:
        for m, speed in zip(cycles, speeds.T, strict=True):
            power = float(np.sum(np.abs(speed) ** 2))
            if power <= 0.0:
                continue
            turned = np.exp(2j * np.pi * m * np.multiply.outer(trial, number)) @ speed
            mean_power = np.abs(turned) ** 2 / len(number)
            left = np.maximum(power - mean_power, _FLOOR * power)
            still = max(power - float(np.abs(np.sum(speed)) ** 2) / len(number), _FLOOR * power)
            clear = mean_power > _CLEAR_LINE * left
            gain += np.where(clear, 2.0 * (len(number) - 1) * np.log(still / left), 0.0)
    return gain

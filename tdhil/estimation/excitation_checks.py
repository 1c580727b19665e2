"""Checks of the spectral lines: a wrong period, a wrong sign, a shaft at rest, other motion than was declared.

The sign comes before the standstill: torque in the place of speed crosses zero too.
"""

import numpy as np

from profiles import CodedText, MessageCode
from tdhil.estimation.case import PeriodicCase
from tdhil.estimation.friction_levels import Levels, warming_warning
from tdhil.estimation.result import Refused
from tdhil.estimation.samples import Samples, Stretch, excited_window, left_out_warnings
from tdhil.estimation.spectrum import ComplexArray, PeriodLines, SpectralLine
from tdhil.recording import BoolArray, FloatArray, Recording, Segment

# ---------------------------------------------------------------------------------------------------------------------
# Signs and columns: does the torque do work on the shaft when it speeds up?
#
# At a line T = G W, and a shaft with inertia has Im G > 0: torque leads speed. Lags turn G by less than a quarter
# turn at the slow lines. Where Im G is negative at every clear line, the reported torque counts the other way round
# (G is −G), or speed and torque stand in each other's place (G is 1/G). A drive's convention tells which: the mean
# torque of a shaft that is driven against friction has the sign of its speed, if both were not exchanged. And where G
# is the same real number at lines that are far apart, torque is a copy of speed: inertia and lags would have to
# cancel exactly.


_CLEAR_SIGN = 5.0      # sd by which Im(T W*) must be below zero at one line at least; at the others it must be below
_COPY = 1e-3      # relative


def check_direction(lines: tuple[SpectralLine, ...], mean_speed: float, mean_torque: float) -> None:
    """Raise Refused if at every one of the excited lines torque trails speed; means in rad/s and N·m."""
    if not lines:
        return
    if _copied(lines):
        raise Refused(
            "the torque is a copy of the speed: their ratio is the same at every line",
            "check which columns hold speed and torque", entry=MessageCode.SIGNALS_SWAPPED,
        )
    clearest = 0.0
    for line in lines:
        cross = (line.torque * np.conj(line.speed)).imag
        # what one period's scatter makes of it
        noise = np.sqrt((line.s_tt * np.abs(line.speed) ** 2 + line.s_ww * np.abs(line.torque) ** 2) / line.periods)
        if np.any(cross >= 0.0):
            return
        clearest = max(clearest, float(np.max(-cross / noise)))
    if clearest < _CLEAR_SIGN:
        return
    if mean_speed * mean_torque < 0.0:
        raise Refused(
            "the torque opposes every acceleration, and the mean speed too: its sign is the wrong way round",
            "count torque positive that drives the speed positive",
            entry=MessageCode.SIGNALS_SWAPPED,
        )
    raise Refused(
        "the torque trails the speed at every line, as for a negative inertia: speed and torque stand in each other's "
        "place, or one of them has the wrong sign",
        "check which column is which, and the sign of the torque",
        entry=MessageCode.SIGNALS_SWAPPED,
    )


def _copied(lines: tuple[SpectralLine, ...]) -> bool:
    """Return whether T/W is the same real number at lines an octave apart or more."""
    if lines[-1].hertz < 2.0 * lines[0].hertz:
        return False
    ratio = np.concatenate([line.torque / line.speed for line in lines])
    return bool(np.max(np.abs(ratio - ratio[0].real)) < _COPY * abs(ratio[0].real))


# ---------------------------------------------------------------------------------------------------------------------
# A shaft that stands still or turns back during the excitation: stick-slip, play, or a mean speed that is too low.
#
# At rest friction takes whatever value holds the shaft, and behind zero it changes its sign: neither is the straight
# line that the levels and the lines are read with, and a jump of friction has lines of its own at the excited
# frequencies.


_NEAR_ZERO = 0.01       # of the speed's largest value counts as rest; at least so many of the signal's steps:
_STEPS = 2.0              # quanta of the signal that count as near
_LEAST_SHARE = 0.02     # of the samples


def check_standstill(parts: list[tuple[Segment, Samples]], quantum: float) -> None:
    """Raise Refused if the speed was at zero, or behind it, for more than a share of a segment that turned."""
    for segment, part in parts:
        if len(part) == 0:
            continue
        speed = part.speed_rad_s
        high, low = float(np.max(speed)), float(np.min(speed))
        direction = 1.0 if high + low >= 0.0 else -1.0
        near = max(_NEAR_ZERO * max(high, -low), _STEPS * quantum)
        behind = np.count_nonzero(speed < -near) if direction > 0.0 else np.count_nonzero(speed > near)
        at_rest = np.count_nonzero(speed <= near) - np.count_nonzero(speed < -near)
        where = f"about {segment.offset_rad_s:.3g} rad/s"
        if at_rest > _LEAST_SHARE * len(part):
            raise Refused(
                f"stick-slip: the shaft stood still for {at_rest / len(part):.1%} of the excitation {where}",
                "turn faster on the mean, or excite with less amplitude, so that the shaft never stops",
                entry=MessageCode.STICK_SLIP_RECORDED,
            )
        if behind > _LEAST_SHARE * len(part):
            raise Refused(
                f"the shaft turned backwards for {behind / len(part):.1%} of the excitation {where}",
                "turn faster on the mean, or excite with less amplitude, for friction jumps at zero speed",
                entry=MessageCode.SHAFT_TURNED_BACK,
            )


# ---------------------------------------------------------------------------------------------------------------------
# Does the motion repeat with the period that was declared?
#
# If the true period is longer by a share ε, a line of m cycles a period comes back late each time: its phase turns by
# −2π m ε a period, at all lines and in all segments by the same ε. That is unlike noise, which turns nothing
# steadily, and unlike a transient, which dies out. With R_k(ε) what is left of line k's scatter about its mean once
# the turning has been taken out, on ν_k complex degrees of freedom and with the variance of every line unknown, twice
# the log likelihood ratio
#
#     Λ(ε) = Σ_k 2 ν_k ln(R_k(0)/R_k(ε))
#
# is about χ² of one degree for ε that isn't there. An inertia from lines at frequencies wrong by ε is wrong by ε, and
# the turning counts as scatter besides.


_CLEAR_TIMEBASE = 40.0           # of Λ
_HARMLESS = 5e-4        # of the period: it makes J wrong by as much
_WIDEST = 0.05            # largest ε that is searched
_MOST_STEPS = 4001        # steps of this search, at most
_STEPS_A_TURN = 32.0      # steps of ε for a turn of the fastest line over the segment
_MOST_PERIODS = 64      # most periods used of a segment: enough to see a turning that matters
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
        entry=MessageCode.EXCITATION_MISDECLARED,
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
    return float(fine[np.argmax(gain)]) if float(np.max(gain)) >= _CLEAR_TIMEBASE else None


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


# ---------------------------------------------------------------------------------------------------------------------
# Undeclared motion: a strong line, in speed or torque, that is none of the excited ones.
#
# A limit cycle, a resonance that noise rings, ripple that sampling folds down, another machine, or other lines than
# excitation.yaml says. It does not bias the declared lines by itself (within whole periods it is orthogonal to them,
# or it turns from period to period and is scatter), but who reads the result should know, and a fold may lie
# anywhere.
#
# The signal is averaged in bins a twentieth of the fastest declared cycle long, less each period's mean and drift and
# the segment's own mean lines; of the rest, the periodogram. Of noise, a bin is exponentially distributed about its
# neighbourhood: forty times the median of the neighbours, at one in 10¹² bins.


_BINS_A_CYCLE = 20.0      # bins of a cycle of the fastest line
_MOST_BINS = 400_000      # bins in all, at most
_NEIGHBOURS = 15          # to either side
_FEWEST = 4               # of a side that count
_CLEAR_UNDECLARED = 40.0             # times the neighbours' median
_STRONG = 0.05            # of the strongest declared line's amplitude, above the declared lines
_STRONG_AMONG = 0.15      # and among them, where the load wanders most
_OWN = 2.0                # bins either side of a declared line that are its own
_LOWEST = 1.0             # cycles a period: below it is wander


def undeclared_warning(stretches: tuple[Stretch, ...], fits: tuple[PeriodLines, ...]) -> tuple[str, ...]:
    """A sentence for each signal that has such a line, with the strongest of them."""
    said = []
    for name, unit in (("speed", "rad/s"), ("torque", "N·m")):
        found = [line for stretch, fit in zip(stretches, fits, strict=True)
                 if (line := strongest_undeclared(stretch, fit, name)) is not None]
        if found:
            hertz, amplitude, declared = max(found, key=lambda line: line[1])
            said.append(CodedText(
                f"undeclared motion: the {name} swings by {amplitude:.2g} {unit} at {hertz:.4g} Hz, which is no line "
                f"of the excitation (the strongest has {declared:.2g} {unit}): a limit cycle, a resonance, ripple "
                "folded down by slow sampling, or other lines than were declared",
                MessageCode.UNDECLARED_MOTION,
            ))
    return tuple(said)


def strongest_undeclared(stretch: Stretch, fit: PeriodLines, name: str) -> tuple[float, float, float] | None:
    """Frequency in Hz, amplitude, and the strongest declared line's amplitude; None where nothing stands out."""
    if len(stretch.periods) < 2:
        return None
    lines = (fit.speed if name == "speed" else fit.torque).mean(axis=0)
    declared = float(np.max(np.abs(lines)))
    length = stretch.segment.period_s
    bins = _bins(stretch)
    if bins < 16 or declared <= 0.0:
        return None
    width = length / bins
    first = min(stretch.index)
    rest = np.zeros(bins * (max(stretch.index) - first + 1))
    filled = 0
    for number, period in zip(stretch.index, stretch.periods, strict=True):
        begin = stretch.segment.start_s + number * length
        value, full = _averaged(period, name, begin, width, bins, stretch.segment.start_s, fit.lines_hz, lines)
        middle = np.arange(bins) - 0.5 * (bins - 1)
        value[full] -= np.polynomial.polynomial.polyval(
            middle[full], np.polynomial.polynomial.polyfit(middle[full], value[full], 1)
        )
        rest[(number - first) * bins : (number - first + 1) * bins] = value
        filled += bins
    power = np.abs(np.fft.rfft(rest)) ** 2
    hertz = np.fft.rfftfreq(len(rest), width)
    candidates = hertz > _LOWEST / length
    for line in fit.lines_hz:
        candidates &= np.abs(hertz - line) > _OWN / (width * len(rest))
    candidates[-1] = False
    amplitude = 2.0 * np.sqrt(power) / filled
    least = np.where(hertz > max(fit.lines_hz), _STRONG, _STRONG_AMONG) * declared
    strong = np.flatnonzero(candidates & (amplitude > least))
    clear = [int(k) for k in strong if power[k] > _CLEAR_UNDECLARED * _neighbourhood(power, int(k))]
    if not clear:
        return None
    best = max(clear, key=lambda k: float(power[k]))
    return float(hertz[best]), float(amplitude[best]), declared


def _bins(stretch: Stretch) -> int:
    """A period's, no finer than the samples allow: two to a bin."""
    length = stretch.segment.period_s
    fewest = min(len(period) for period in stretch.periods)
    spans = max(stretch.index) - min(stretch.index) + 1
    return int(min(_BINS_A_CYCLE * max(stretch.segment.lines_hz) * length, fewest / 2.0, _MOST_BINS / spans))


def _averaged(
    period: Samples,
    name: str,
    begin: float,
    width: float,
    bins: int,
    start: float,
    lines_hz: tuple[float, ...],
    lines: ComplexArray,
) -> tuple[FloatArray, BoolArray]:
    """Means over the bins (bins,) less the lines there, 0 where there is no sample; and which bins have any."""
    signal = period.speed_rad_s if name == "speed" else period.torque_nm
    edges = np.searchsorted(period.time_s, begin + width * np.arange(bins))
    counts = np.diff(np.append(edges, len(period)))
    full = counts > 0
    own = edges[full]
    value, when = np.zeros(bins), np.zeros(bins)
    # whatever lies before the first edge (a sample a rounding early) belongs to the first bin
    value[full] = np.add.reduceat(signal, own) / counts[full]
    when[full] = np.add.reduceat(period.time_s - start, own) / counts[full]
    turned = np.exp(2j * np.pi * np.multiply.outer(when[full], np.asarray(lines_hz)))
    value[full] -= (turned @ lines).real
    return value, full


def _neighbourhood(power: FloatArray, at: int) -> float:
    """Median of the bins on either side of one, its two nearest left out; the greater, for noise rises to low ones."""
    low = power[max(at - 2 - _NEIGHBOURS, 1) : max(at - 2, 1)]
    high = power[at + 3 : at + 3 + _NEIGHBOURS]
    return max((float(np.median(side)) for side in (low, high) if len(side) >= _FEWEST), default=float("inf"))


# ---------------------------------------------------------------------------------------------------------------------

def check_lines(case: PeriodicCase) -> None:
    """Raise Refused for what can't be so; of the pooled lines, those that stand clear tell the direction."""
    check_period(case.stretches, case.fits)
    means = [(fit.speed_mean.mean(), fit.torque_mean.mean()) for fit in case.fits if len(fit.speed_mean)]
    if means:
        speed, torque = np.mean(means, axis=0)
        check_direction(tuple(line for line in case.every if line.excited), float(speed), float(torque))
    parts = [(one.segment, case.samples.between(*excited_window(one.segment))) for one in case.stretches]
    check_standstill(parts, case.recording.speed_resolution_rad_s)


def hints(
    recording: Recording, stretches: tuple[Stretch, ...], fits: tuple[PeriodLines, ...], levels: Levels
) -> tuple[str, ...]:
    """Warnings: what is wrong with the data but leaves a number that stands."""
    return (*left_out_warnings(recording), *undeclared_warning(stretches, fits), *warming_warning(levels.warming))

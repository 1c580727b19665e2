"""Checks of the spectral lines: wrong period, wrong sign, standstill, and motion that was not declared.

The sign is checked before the standstill: if torque and speed are exchanged, the "speed" crosses zero too.
"""

import numpy as np

from profiles import CodedText, MessageCode
from tdhil.estimation.case import PeriodicCase
from tdhil.estimation.friction_levels import Levels, warming_warning
from tdhil.estimation.result import Refused
from tdhil.estimation.samples import Samples, Stretch, excited_window, left_out_warnings
from tdhil.estimation.spectrum import ComplexArray, PeriodLines, SpectralLine, unit_waves
from tdhil.recording import BoolArray, FloatArray, Recording, Segment

# ---------------------------------------------------------------------------------------------------------------------
# Signs and columns: does the torque do work on the shaft when the shaft accelerates?
#
# At a line T = G W, and a shaft with inertia has Im G > 0: torque leads speed. Lags turn G by less than a quarter turn
# at the slow lines. If Im G is negative at every clear line, either the reported torque has the opposite sign (G is
# −G), or speed and torque are exchanged (G is 1/G). The drive's convention distinguishes the two: the mean torque of a
# shaft driven against friction has the sign of its speed, unless both signs were exchanged. If G is the same real
# number at lines that are far apart, torque is a copy of speed: otherwise inertia and lags would have to cancel
# exactly.


_CLEAR_SIGN = 5.0      # sd; Im(T W*) must be this far below zero at one line at least, and below zero at the others
_COPY = 1e-3      # relative deviation below which T/W is the same at all lines


def check_direction(lines: tuple[SpectralLine, ...], mean_speed: float, mean_torque: float) -> None:
    """Raise Refused if torque trails speed at every one of the excited lines; means in rad/s and N·m."""
    if not lines:
        return
    if lines[-1].hertz >= 2.0 * lines[0].hertz:      # an octave apart or more
        ratio = np.concatenate([line.torque / line.speed for line in lines])
        if np.max(np.abs(ratio - ratio[0].real)) < _COPY * abs(ratio[0].real):
            raise Refused(
                "the torque is a copy of the speed: their ratio is the same at every line",
                "check which columns hold speed and torque", entry=MessageCode.SIGNALS_SWAPPED,
            )
    clearest = 0.0
    for line in lines:
        cross = (line.torque * np.conj(line.speed)).imag
        # scatter of Im(T W*) over one period
        noise = np.sqrt((line.s_tt * np.abs(line.speed) ** 2 + line.s_ww * np.abs(line.torque) ** 2) / line.periods)
        if np.any(cross >= 0.0):
            return
        clearest = max(clearest, float(np.max(-cross / noise)))
    if clearest < _CLEAR_SIGN:
        return
    if mean_speed * mean_torque < 0.0:
        raise Refused(
            "the torque opposes every acceleration and the mean speed: its sign is inverted",
            "count torque as positive if it accelerates the shaft in positive direction",
            entry=MessageCode.SIGNALS_SWAPPED,
        )
    raise Refused(
        "the torque trails the speed at every line, as with a negative inertia. Speed and torque are exchanged, "
        "or one of them has the wrong sign",
        "check which column is which, and the sign of the torque",
        entry=MessageCode.SIGNALS_SWAPPED,
    )


# ---------------------------------------------------------------------------------------------------------------------
# A shaft that stands still or reverses during the excitation: stick-slip, play, or a mean speed that is too low.
#
# At standstill friction takes whatever value holds the shaft, and it changes sign when the shaft reverses. Neither is
# the straight line that the levels and the lines assume, and a jump of friction has lines of its own at the excited
# frequencies.


_NEAR_ZERO = 0.01       # share of the largest speed that counts as standstill
_STEPS = 2.0              # resolution steps that count as standstill, if these are more
_LEAST_SHARE = 0.02     # least share of the samples at standstill for a refusal


def check_standstill(parts: list[tuple[Segment, Samples]], quantum: float) -> None:
    """Raise Refused if the speed was at or beyond zero for more than a share of a segment that turned."""
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
                f"stick-slip: the shaft stood still for {100 * at_rest / len(part):.1f} % of the excitation {where}",
                "raise the mean speed or lower the amplitude, so that the shaft never stops",
                entry=MessageCode.STICK_SLIP_RECORDED,
            )
        if behind > _LEAST_SHARE * len(part):
            raise Refused(
                f"the shaft turned backwards for {100 * behind / len(part):.1f} % of the excitation {where}",
                "raise the mean speed or lower the amplitude. Friction jumps at zero speed",
                entry=MessageCode.SHAFT_TURNED_BACK,
            )


# ---------------------------------------------------------------------------------------------------------------------
# Check of the period: does the motion repeat with the declared period?
#
# If the true period is longer by a share ε, a line of m cycles a period comes late in each period: its phase turns by
# −2π m ε a period, with the same ε at all lines and in all segments. Noise does not turn steadily, and a transient dies
# out. Let R_k(ε) be the scatter of line k about its mean after the turning is removed, with ν_k complex degrees of
# freedom and an unknown variance of every line. Then twice the log likelihood ratio
#
#     Λ(ε) = Σ_k 2 ν_k ln(R_k(0)/R_k(ε))
#
# is about χ² of one degree of freedom if the period is right. Frequencies wrong by ε make the inertia wrong by ε, and
# the turning also counts as scatter.


_CLEAR_TIMEBASE = 40.0           # least Λ for a refusal
_HARMLESS = 5e-4        # share of the period: J is then wrong by the same share
_WIDEST = 0.05            # largest ε that is searched
_MOST_STEPS = 4001        # steps of this search, at most
_STEPS_A_TURN = 32.0      # steps of ε per turn of the fastest line over the segment
_MOST_PERIODS = 64      # most periods used of a segment: enough to detect a relevant turning
_EQUAL = 1e-6           # difference of Λ below which it is rounding
_FLOOR = 1e-12          # relative scatter below which it is rounding of the arithmetic
_CLEAR_LINE = 3.0       # power of the mean over that of the scatter, after turning: a weaker line is not used


def check_period(stretches: tuple[Stretch, ...], fits: tuple[PeriodLines, ...]) -> None:
    """Raise Refused with the true period, if it differs from the declared one."""
    found = wrong_period(stretches, fits)
    if found is None or abs(found) <= _HARMLESS:
        return
    declared = stretches[0].segment.period_s
    raise Refused(
        f"the motion repeats every {declared * (1.0 + found):.6g} s, not every {declared:g} s as declared: the time "
        f"base or the declared period is wrong by {100 * abs(found):.2f} %",
        "declare the period and the lines as they were run, and check the rate of the time stamps",
        entry=MessageCode.EXCITATION_MISDECLARED,
    )


def wrong_period(stretches: tuple[Stretch, ...], fits: tuple[PeriodLines, ...]) -> float | None:
    """Return the share ε by which the true period is longer; None if the data do not show one."""
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
    # the peak of the likelihood is as wide as half a turn over the whole segment, so a turn takes many steps
    step = max(1.0 / (_STEPS_A_TURN * longest), 2.0 * _WIDEST / (_MOST_STEPS - 1))
    reach = int(_WIDEST / step)
    trial: FloatArray = np.linspace(-reach * step, reach * step, 2 * reach + 1)
    coarse = _gain(turning, trial)
    # Λ is the same at 0 and at every ε where no line is clear: of equal values take the smallest ε, despite rounding
    equal = trial[coarse >= np.max(coarse) - _EQUAL]
    best = float(equal[np.argmin(np.abs(equal))])
    fine: FloatArray = np.linspace(best - step, best + step, 81)
    gain = _gain(turning, fine)
    return float(fine[np.argmax(gain)]) if float(np.max(gain)) >= _CLEAR_TIMEBASE else None


def _gain(turning: list[tuple[FloatArray, FloatArray, ComplexArray]], trial: FloatArray) -> FloatArray:
    """Return Λ at every trial ε (E,); a line of the same frequency in two segments counts twice."""
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
# Undeclared motion: a strong spectral line, in speed or torque, that is not an excited one.
#
# Causes: a limit cycle, a resonance that noise excites, aliased ripple, another machine, or lines that differ from
# excitation.yaml. It does not bias the declared lines by itself: within whole periods it is orthogonal to them, or its
# phase changes from period to period, so that it is scatter. The report states it nevertheless, because an aliased line
# may be at any frequency. Only reported samples are checked: a torque that was subtracted afterwards, such as that of
# the harmonics of the angle, is no motion.
#
# The signal is averaged in bins of a twentieth of the fastest declared cycle, without each period's mean and drift and
# without the segment's own mean lines. The rest gives the periodogram. For noise, a bin is exponentially distributed
# about its neighbourhood, and exceeds forty times the median of the neighbours in one of 10¹² bins.


_BINS_A_CYCLE = 20.0      # bins a cycle of the fastest line
_MOST_BINS = 400_000      # bins in all, at most
_NEIGHBOURS = 15          # neighbours on either side
_FEWEST = 4               # fewest neighbours of a side that count
_CLEAR_UNDECLARED = 40.0             # power over the neighbours' median
_STRONG = 0.05            # least amplitude over that of the strongest declared line, above the declared lines
_STRONG_AMONG = 0.15      # the same ratio between the declared lines, where the load wanders most
_OWN = 2.0                # bins on either side of a declared line that belong to that line
_LOWEST = 1.0             # cycles a period: lower frequencies are wander


def undeclared_warning(stretches: tuple[Stretch, ...], fits: tuple[PeriodLines, ...]) -> tuple[str, ...]:
    """Return a sentence for each signal that has an undeclared line, with the strongest of them."""
    said = []
    for name, unit in (("speed", "rad/s"), ("torque", "N·m")):
        found = [line for stretch, fit in zip(stretches, fits, strict=True)
                 if (line := strongest_undeclared(stretch, fit, name)) is not None]
        if found:
            hertz, amplitude, declared = max(found, key=lambda line: line[1])
            said.append(CodedText(
                f"undeclared motion: the {name} oscillates by {amplitude:.2g} {unit} at {hertz:.4g} Hz, which is no "
                f"excited line (the strongest line has {declared:.2g} {unit}). Look for a limit cycle, a "
                "resonance, aliased ripple, or lines that were declared wrongly",
                MessageCode.UNDECLARED_MOTION,
            ))
    return tuple(said)


def strongest_undeclared(stretch: Stretch, fit: PeriodLines, name: str) -> tuple[float, float, float] | None:
    """Return frequency in Hz, amplitude, and amplitude of the strongest declared line; None if no line is clear."""
    if len(stretch.periods) < 2:
        return None
    lines = (fit.speed if name == "speed" else fit.torque).mean(axis=0)
    declared = float(np.max(np.abs(lines)))
    length, first = stretch.segment.period_s, min(stretch.index)
    spans, fewest = max(stretch.index) - first + 1, min(len(period) for period in stretch.periods)
    # bins of a period: at least two samples to a bin
    bins = int(min(_BINS_A_CYCLE * max(stretch.segment.lines_hz) * length, fewest / 2.0, _MOST_BINS / spans))
    if bins < 16 or declared <= 0.0:
        return None
    width = length / bins
    rest = np.zeros(bins * spans)
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
    clear = []
    for k in strong.tolist():
        # the median of the bins on one side, without the two nearest: the greater side, as noise rises at low ones
        sides = power[max(k - 2 - _NEIGHBOURS, 1) : max(k - 2, 1)], power[k + 3 : k + 3 + _NEIGHBOURS]
        noise = max((float(np.median(side)) for side in sides if len(side) >= _FEWEST), default=float("inf"))
        if power[k] > _CLEAR_UNDECLARED * noise:
            clear.append(k)
    if not clear:
        return None
    best = max(clear, key=lambda k: float(power[k]))
    return float(hertz[best]), float(amplitude[best]), declared


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
    """Return the means over the bins (bins,) without the lines there, 0 for a bin without a sample; and which bins
    have one.
    """
    signal = period.speed_rad_s if name == "speed" else period.torque_nm
    edges = np.searchsorted(period.time_s, begin + width * np.arange(bins))
    counts = np.diff(np.append(edges, len(period)))
    full = counts > 0
    own = edges[full]
    value, when = np.zeros(bins), np.zeros(bins)
    # samples before the first edge (a sample that is a rounding error early) belong to the first bin
    value[full] = np.add.reduceat(signal, own) / counts[full]
    when[full] = np.add.reduceat(period.time_s - start, own) / counts[full]
    turned = unit_waves(2.0 * np.pi * np.multiply.outer(when[full], np.asarray(lines_hz)))
    value[full] -= (turned @ lines).real
    return value, full


# ---------------------------------------------------------------------------------------------------------------------

def check_lines(case: PeriodicCase) -> None:
    """Raise Refused for impossible data. Of the pooled lines, the clear ones determine the direction."""
    check_period(case.stretches, case.fits)
    means = [(fit.speed_mean.mean(), fit.torque_mean.mean()) for fit in case.fits if len(fit.speed_mean)]
    if means:
        speed, torque = np.mean(means, axis=0)
        check_direction(tuple(line for line in case.every if line.excited), float(speed), float(torque))
    parts = [(one.segment, case.samples.between(*excited_window(one.segment))) for one in case.stretches]
    check_standstill(parts, case.recording.speed_resolution_rad_s)


def hints(recording: Recording, undeclared: tuple[str, ...], levels: Levels) -> tuple[str, ...]:
    """Return the warnings: faults of the data that do not invalidate the result."""
    return (*left_out_warnings(recording), *undeclared, *warming_warning(levels.warming))

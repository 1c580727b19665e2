"""Motion that nobody declared: a strong line, in speed or torque, that is none of the excited ones.

A limit cycle, a resonance that noise rings, ripple that sampling folds down, another machine, or other lines than
excitation.yaml says. It does not bias the declared lines by itself (within whole periods it is orthogonal to them, or
it turns from period to period and is scatter), but who reads the result should know, and a fold may lie anywhere.

The signal is averaged in bins a twentieth of the fastest declared cycle long, less each period's mean and drift and the
segment's own mean lines; of the rest, the periodogram. Of noise, a bin is exponentially distributed about its
neighbourhood: forty times the median of the neighbours, at one in 10¹² bins.
"""

import numpy as np

from tdhil.estimation.frequency_domain.spectrum import ComplexArray, PeriodLines
from tdhil.estimation.samples import Samples, Stretch
from tdhil.recording.recording import BoolArray, FloatArray

_BINS_A_CYCLE = 20.0
_MOST_BINS = 400_000
_NEIGHBOURS = 15          # to either side
_FEWEST = 4               # of a side that count
_CLEAR = 40.0             # times the neighbours' median
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
            said.append(
                f"undeclared motion: the {name} swings by {amplitude:.2g} {unit} at {hertz:.4g} Hz, which is no line "
                f"of the excitation (the strongest has {declared:.2g} {unit}): a limit cycle, a resonance, ripple "
                "folded down by slow sampling, or other lines than were declared"
            )
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
    clear = [int(k) for k in strong if power[k] > _CLEAR * _neighbourhood(power, int(k))]
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

"""How loud the noise is at each frequency, from what the fit leaves over.

Load disturbance, torque noise and speed noise behind the inverse filters add up to a residual whose power per bin is
energy·S(f), S smooth. S is the mean of |e|²/energy over neighbouring frequencies, each residual scaled up by what the
fit has taken from it, 1/(1 − leverage): a fit of few equations always leaves less than the noise.
"""

from dataclasses import dataclass

import numpy as np

from tdhil.estimation.time_domain.taylor import ComplexArray
from tdhil.estimation.time_domain.windows import Bins
from tdhil.recording.recording import FloatArray

_WIDTH = 0.35         # of the frequency, either way
_NEIGHBOURS = 8       # either way, at least
_TOP_SHARE = 0.2      # of the bins, the highest: where a record moves least


@dataclass(frozen=True)
class Noise:
    """``variance`` (M,) of every bin's residual, and ``count`` (M,): over how many bins it was averaged."""

    variance: FloatArray
    count: FloatArray


def smoothed(hertz: FloatArray, power: FloatArray, width: float = _WIDTH) -> tuple[FloatArray, FloatArray]:
    """Mean of ``power`` over neighbouring frequencies, and over how many; (M,) each, any order.

    ``width``: how far neighbours reach, of the frequency; for what is as smooth as noise, unless told otherwise.
    """
    order = np.argsort(hertz, kind="stable")
    f = hertz[order]
    rank = np.arange(len(f))
    first = np.minimum(np.searchsorted(f, f * (1.0 - width), side="left"), rank - _NEIGHBOURS)
    last = np.maximum(np.searchsorted(f, f * (1.0 + width), side="right"), rank + _NEIGHBOURS + 1)
    first, last = np.maximum(first, 0), np.minimum(last, len(f))
    total = np.concatenate([[0.0], np.cumsum(power[order])])
    mean, count = np.empty(len(f)), np.empty(len(f))
    count[order] = last - first
    mean[order] = (total[last] - total[first]) / (last - first)
    return mean, count


def from_residuals(bins: Bins, error: ComplexArray, leverage: FloatArray) -> Noise:
    """The noise that residuals with these leverages speak of."""
    power = np.abs(error) ** 2 / (bins.energy * np.maximum(1.0 - leverage, 0.05))
    mean, count = smoothed(bins.hertz, power)
    floor = 1e-12 * float(np.max(np.abs(bins.torque[:, 0]) ** 2 / bins.energy)) if len(bins) else 0.0
    return Noise(bins.energy * np.maximum(mean, max(floor, 1e-300)), count)


def guessed(bins: Bins, inertia: float) -> Noise:
    """Before any fit: white noise in both signals as at the highest frequencies, and 3 % of the torque."""
    top = bins.hertz >= (1.0 - _TOP_SHARE) * float(np.max(bins.hertz))
    floors = [float(np.median(np.abs(x[top, 0]) ** 2 / bins.energy[top])) for x in (bins.torque, bins.speed)]
    share, count = smoothed(bins.hertz, (0.03 * np.abs(bins.torque[:, 0])) ** 2 / bins.energy)
    power = floors[0] + np.abs(inertia * bins.s) ** 2 * floors[1] + share
    return Noise(bins.energy * np.maximum(power, 1e-300), count)

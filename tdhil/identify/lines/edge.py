"""The speed at the two ends of a period, from which its net change is told (why that is needed: `spectrum`)."""

import numpy as np
from numpy.typing import NDArray

from tdhil.estimation.samples import Samples

_EDGE_S = 0.1             # either side of a period's end, averaged to read the speed there
_EDGE_SAMPLES = 4


class Edge:
    """Speed at an instant, less the periodic motion: the mean of the samples within 0.1 s, or of the nearest few."""

    def __init__(
        self, samples: Samples, start_s: float, lines_hz: tuple[float, ...], wave: NDArray[np.complex128]
    ) -> None:
        self.samples, self.start_s, self.wave = samples, start_s, wave
        self.omega = 2.0 * np.pi * np.asarray(lines_hz)

    def drift(self, begin_s: float, length_s: float) -> float:
        """Net change of speed per second over a period."""
        (begin, speed_begin), (end, speed_end) = self.speed(begin_s), self.speed(begin_s + length_s)
        return (speed_end - speed_begin) / (end - begin)

    def speed(self, at_s: float) -> tuple[float, float]:
        """The mean time of the samples taken, s, and their mean speed."""
        time = self.samples.time_s
        first, last = (int(i) for i in np.searchsorted(time, (at_s - _EDGE_S, at_s + _EDGE_S)))
        while last - first < min(_EDGE_SAMPLES, len(time)):
            first, last = max(first - 1, 0), min(last + 1, len(time))
        turned = np.exp(1j * np.outer(time[first:last] - self.start_s, self.omega))
        speed = float(np.mean(self.samples.speed_rad_s[first:last] - (turned @ self.wave).real))
        return float(np.mean(time[first:last])), speed

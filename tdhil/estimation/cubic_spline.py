"""Natural cubic spline through readings of a signal. Pure.

`scipy.interpolate` takes 0.3 s to load. Each replay would wait for it, and a run may load nothing once its shaft may
move. This spline needs `scipy.linalg` only. `tests/estimation/test_cubic_spline.py` compares it with that of scipy.

::

    s(t) = a y_k + b y_{k+1} + ((a³ − a) m_k + (b³ − b) m_{k+1}) h²/6,
    b = (t − t_k)/h,  a = 1 − b,  h = t_{k+1} − t_k

with the second derivatives m_k from continuous first derivatives, and m = 0 at both ends.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tdhil.recording import FloatArray


@dataclass(frozen=True)
class CubicSpline:
    """Readings ``values`` (N,) at ``times`` (N,), rising, with their second derivatives ``bend`` (N,)."""

    times: FloatArray
    values: FloatArray
    bend: FloatArray

    @classmethod
    def through(cls, times: FloatArray, values: FloatArray) -> CubicSpline:
        """Return the spline through at least two readings."""
        from scipy.linalg import solve_banded

        step = np.diff(times)
        slope = np.diff(values) / step
        bend = np.zeros(len(times))
        if len(times) > 2:
            bands = np.zeros((3, len(times) - 2))
            bands[0, 1:] = step[1:-1]
            bands[1] = 2.0 * (step[:-1] + step[1:])
            bands[2, :-1] = step[1:-1]
            bend[1:-1] = solve_banded((1, 1), bands, 6.0 * np.diff(slope))
        return cls(times, values, bend)

    def at(self, time: FloatArray) -> FloatArray:
        """Return the value at each time."""
        k, h, a, b = self._place(time)
        found: FloatArray = (a * self.values[k] + b * self.values[k + 1]
                             + ((a**3 - a) * self.bend[k] + (b**3 - b) * self.bend[k + 1]) * h**2 / 6.0)
        return found

    def slope(self, time: FloatArray) -> FloatArray:
        """Return the first derivative at each time."""
        k, h, a, b = self._place(time)
        found: FloatArray = ((self.values[k + 1] - self.values[k]) / h
                             + ((3.0 * b**2 - 1.0) * self.bend[k + 1] - (3.0 * a**2 - 1.0) * self.bend[k]) * h / 6.0)
        return found

    def _place(self, time: FloatArray) -> tuple[np.ndarray, FloatArray, FloatArray, FloatArray]:
        k = np.clip(np.searchsorted(self.times, time, side="right") - 1, 0, len(self.times) - 2)
        h = self.times[k + 1] - self.times[k]
        b = (time - self.times[k]) / h
        return k, h, 1.0 - b, b

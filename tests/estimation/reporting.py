"""Reports of a bench: signals of (steps, runs) at a step of ``dt``, and the recording of a run."""

import numpy as np

from tdhil.recording.recording import Recording


def lagged(x: np.ndarray, poles: tuple[float, ...], dt: float) -> np.ndarray:
    """Apply first-order lags in series, exact for an input that is linear between steps and constant before them."""
    from scipy.signal import lfilter

    for tau in poles:
        if tau > 0.0:
            keep = np.exp(-dt / tau)
            late = 1.0 - (1.0 - keep) * tau / dt
            early = (1.0 - keep) * tau / dt - keep
            x, _ = lfilter([late, early], [1.0, -keep], x, axis=0, zi=x[:1] * (1.0 - late))
    return x


def delayed(x: np.ndarray, delay_s: float, dt: float) -> np.ndarray:
    n = round(delay_s / dt)
    return x if n == 0 else np.concatenate([np.repeat(x[:1], n, axis=0), x[:-n]])


def recorded(time_s: np.ndarray, speed_rad_s: np.ndarray, torque_nm: np.ndarray, **facts: object) -> Recording:
    """Return a recording with fresh, unlimited samples, unless ``facts`` state otherwise."""
    every = np.ones(len(time_s), dtype=bool)
    return Recording(time_s, speed_rad_s, torque_nm, **{"fresh": every, "limited": ~every, **facts})

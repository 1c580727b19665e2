"""The paper's simulated runs, identified as this tool does it: whole periods, errors in both signals, no lags.

The paper's fit of T on α finds 0.2 to 1.6 % too little in these very records (`tables_bias` says why).
"""

from __future__ import annotations

import math

import numpy as np

from tdhil.estimation import Identification, Options, identify
from tdhil.recording.recording import Excitation, FloatArray, LagPrior, Recording, Segment
from tdhil.study.settings import LoopSettings

_SETTLE = 1      # periods: the loop settles within J/Kp, below a second


def recording_of(
    settings: LoopSettings, time_s: FloatArray, speed_rad_s: FloatArray, torque_nm: FloatArray
) -> Recording:
    """A run of the paper's loop as a recording: samples of one instant, unfiltered, lags declared absent."""
    period = 1.0 / settings.frequency_hz
    whole = math.floor(float(time_s[-1]) / period + 1e-9)
    segment = Segment(
        start_s=0.0, end_s=whole * period, period_s=period, settle_periods=_SETTLE, offset_rad_s=settings.offset_rad_s,
        lines_hz=(settings.frequency_hz,), amplitudes_rad_s=(settings.amplitude_rad_s,), phases_rad=(0.0,),
    )
    return Recording(
        time_s=time_s,
        speed_rad_s=speed_rad_s,
        torque_nm=torque_nm,
        fresh=np.ones(len(time_s), dtype=np.bool_),
        limited=np.zeros(len(time_s), dtype=np.bool_),
        excitation=Excitation("sine", "speed", (segment,)),
        lag_prior=LagPrior(0.0, 0.0, 0.0, 0.0, "the simulation", skew_sd_s=1e-4),
        simulated=True,
    )


def identified(
    settings: LoopSettings, time_s: FloatArray, speed_rad_s: FloatArray, torque_nm: FloatArray
) -> Identification | None:
    """None for motions that are not a sine."""
    if settings.signal != "sine":
        return None
    return identify(recording_of(settings, time_s, speed_rad_s, torque_nm), Options())

"""A recording: all that identification may see, and nothing else.

Pure data. `tdhil replay` builds it from run.mcap, a live run from its own samples; both must be equal to
the last bit, and so must what is identified from them.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True)
class Segment:
    """A stretch of periodic excitation about one mean speed.

    The reference was ``offset_rad_s + sum(a * cos(2π f (t - start_s) + φ))`` over the lines; every line is a
    whole multiple of ``1 / period_s``. ``end_s`` is where the last whole period ended (earlier if aborted);
    the first ``settle_periods`` periods are transient and not for identification.
    """

    start_s: float
    end_s: float
    period_s: float
    settle_periods: int
    offset_rad_s: float
    lines_hz: tuple[float, ...]
    amplitudes_rad_s: tuple[float, ...]
    phases_rad: tuple[float, ...]


@dataclass(frozen=True)
class Excitation:
    """What stage 5 did. ``kind``: multisine, sine, step, …; ``mode``: speed or torque."""

    kind: str
    mode: str
    segments: tuple[Segment, ...] = ()


@dataclass(frozen=True)
class Level:
    """A stretch of steady speed: its mean torque is friction, free of every lag."""

    start_s: float
    end_s: float


@dataclass(frozen=True)
class Ramp:
    """A stretch in which torque or speed was ramped: a rough inertia can be had from it."""

    start_s: float
    end_s: float


@dataclass(frozen=True)
class LagPrior:
    """A reporting lag as the drive or the rig states it, with a standard deviation; None = nothing known."""

    speed_lag_s: float | None = None
    speed_lag_sd_s: float = 0.0
    torque_lag_s: float | None = None
    torque_lag_sd_s: float = 0.0
    source: str = ""
    skew_sd_s: float = 0.01    # torque and speed are of one frame to within this; used only if the lines can't tell


@dataclass(frozen=True)
class SteppedSetpoint:
    """A speed setpoint that was stepped once in ``period_s``, and how the drive made the shaft follow it:

    H(s) = (1 + zero·s)/(1 + first·s + second·s²) from setpoint to the shaft's speed.
    """

    period_s: float
    zero_s: float
    first_s: float
    second_s2: float


@dataclass(frozen=True)
class Stage:
    """A stage of the protocol as it went. ``outcome``: ok, degraded, aborted."""

    name: str
    start_s: float
    end_s: float
    outcome: str
    detail: str = ""


@dataclass(frozen=True)
class Recording:
    """N samples of one run, SI at the motor shaft, and what must be known to read them.

    ``time_s`` (N,) is the SYNC's control time, rising; ``speed_rad_s`` and ``torque_nm`` (N,) are as reported;
    ``fresh`` (N,) is False where a cycle brought no new feedback (such samples are not for identification);
    ``limited`` (N,) is True where the drive said that an internal limit was active.
    """

    time_s: FloatArray
    speed_rad_s: FloatArray
    torque_nm: FloatArray
    fresh: BoolArray
    limited: BoolArray
    excitation: Excitation | None = None
    levels: tuple[Level, ...] = ()
    ramps: tuple[Ramp, ...] = ()
    stages: tuple[Stage, ...] = ()
    lag_prior: LagPrior = field(default_factory=LagPrior)
    speed_resolution_rad_s: float = 0.0
    torque_resolution_nm: float = 0.0
    torque_limit_nm: float | None = None
    torque_offset_nm: float = 0.0          # reported at standstill, de-energised; subtracted by identification
    torque_scale_rel_sd: float = 0.0       # 1 sd of the drive's torque scale, as a share of the reading
    gear_ratio: float = 1.0                # i = ω_motor / ω_main
    timing_half_width_s: float = 0.0       # usual half-width of a transaction: when in it a sample was taken is open
    stepped_setpoint: SteppedSetpoint | None = None     # in speed mode
    simulated: bool = False
    complete: bool = True                  # False: the log ended before the run did

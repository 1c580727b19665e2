"""Recording: all data that identification may use.

Pure data. `tdhil replay` builds it from run.mcap, a live run from its own samples. Both must be equal to the last bit,
and so must their results on the same machine. On another processor or number of cores, whose linear algebra sums in
another order, the results are equal to 1e-9.
"""

import math
import re
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]

ABORTED: Final = "aborted"
"""Outcome of a stage that did not reach its end."""

_ERROR_CLASS: Final = re.compile(r"^[A-Z][A-Za-z]+: ")
MARGIN_S: Final = 1.0
"""Time before an abort that is also left out, s, because a fault is in the signals before it is detected."""


@dataclass(frozen=True)
class Segment:
    """Stretch of periodic excitation about one mean speed.

    The reference was ``offset_rad_s + sum(a * cos(2π f (t - start_s) + φ))`` over the lines; every line is a whole
    multiple of ``1 / period_s``. ``end_s`` is the end of the last whole period (earlier if aborted); the first
    ``settle_periods`` periods are transient and not for identification.

    With ``torque_amplitudes_nm`` the excitation was a torque offset with these lines and phases, about zero, with a
    constant speed reference ``offset_rad_s``; ``amplitudes_rad_s`` are then the expected amplitudes of the speed.
    """

    start_s: float
    end_s: float
    period_s: float
    settle_periods: int
    offset_rad_s: float
    lines_hz: tuple[float, ...]
    amplitudes_rad_s: tuple[float, ...]
    phases_rad: tuple[float, ...]
    torque_amplitudes_nm: tuple[float, ...] = ()


@dataclass(frozen=True)
class Excitation:
    """Motion of stage 5. ``kind``: multisine, sine, step, …; ``mode``: speed or torque."""

    kind: str
    mode: str
    segments: tuple[Segment, ...] = ()


@dataclass(frozen=True)
class Level:
    """Stretch of steady speed: its mean torque is friction, without an effect of the lags."""

    start_s: float
    end_s: float


@dataclass(frozen=True)
class Ramp:
    """Stretch with a ramp of torque or speed, which gives a rough inertia."""

    start_s: float
    end_s: float


@dataclass(frozen=True)
class LagPrior:
    """Reporting lag as stated by the drive or the rig, with a standard deviation; None: unknown."""

    speed_lag_s: float | None = None
    speed_lag_sd_s: float = 0.0
    torque_lag_s: float | None = None
    torque_lag_sd_s: float = 0.0
    source: str = ""
    skew_sd_s: float = 0.01    # sd of the time offset of torque and speed in one frame; used if the lines leave it open


@dataclass(frozen=True)
class Pipe:
    """Uniform pipe of a drill string by its sizes, at the motor shaft; ``rel_sd`` of inertia and of stiffness."""

    inertia_kg_m2: float               # J_s = ρ I L
    stiffness_nm_rad: float            # k = G I/L, from end to end
    rel_sd: float
    source: str = ""

    @property
    def impedance_nm_s_rad(self) -> float:
        """Characteristic impedance ζ = √(J_s k) of the pipe."""
        return math.sqrt(self.inertia_kg_m2 * self.stiffness_nm_rad)

    @property
    def delay_s(self) -> float:
        """Travel time √(J_s/k) from one end to the other, s."""
        return math.sqrt(self.inertia_kg_m2 / self.stiffness_nm_rad)


@dataclass(frozen=True)
class SteppedSetpoint:
    """Speed setpoint with one step per ``period_s``, and the response of the shaft's speed:

    H(s) = (1 + zero·s)/(1 + first·s + second·s²) from setpoint to the shaft's speed.
    """

    period_s: float
    zero_s: float
    first_s: float
    second_s2: float


@dataclass(frozen=True)
class TorqueAnswer:
    """Response of the reported torque to the commanded one: 1/(1 + lag·s + shape·(lag·s)²), without its delay."""

    lag_s: float
    shape: float


@dataclass(frozen=True)
class ImpedanceInput:
    """Command for the measurement of the drive's impedance: a torque offset or the speed reference.

    ``count``: resolution of the command, N·m or rad/s; commands are rounded to it (0: no rounding). A command is held
    from one sample to the next. ``reference_filter_s``: known first-order filter of the drive's speed reference, s.
    ``string_nm_s_rad``: impedance ζ of the string for |r|, at the motor; 0: unknown. ``torque_ratio``: expected ratio
    of reported to commanded torque. ``torque_ratio_rel_sd``: its relative standard uncertainty. None: it follows from
    the torque scale's.
    """

    by: str                            # offset or reference
    count: float = 0.0
    reference_filter_s: float = 0.0
    string_nm_s_rad: float = 0.0
    torque_ratio: float = 1.0
    torque_ratio_rel_sd: float | None = None


@dataclass(frozen=True)
class Stage:
    """Completed or aborted stage. ``outcome``: ok, degraded, aborted."""

    name: str
    start_s: float
    end_s: float
    outcome: str
    detail: str = ""

    @property
    def cause(self) -> str:
        """Return the detail without the class of an error, which is for the log only."""
        return _ERROR_CLASS.sub("", self.detail)

    @property
    def aborted_text(self) -> str:
        """Return where and why the run ended, as the end of a sentence about the run."""
        return f"aborted in stage {self.name}" + (f" ({self.cause})" if self.detail else "")


@dataclass(frozen=True)
class Recording:
    """N samples of one run, SI at the motor shaft, and the data needed to use them.

    ``time_s`` (N,) is the SYNC's control time, rising; ``speed_rad_s`` and ``torque_nm`` (N,) are as reported;
    ``fresh`` (N,) is False for a cycle without new feedback (such samples are not for identification); ``limited`` (N,)
    is True while the drive reported an active internal limit. Three arrays (N,) are None if the log does not have them,
    and NaN at samples without a value: ``commanded_torque_nm``, the torque setpoint, N·m, only of samples with the
    drive enabled and in torque mode; ``demanded_torque_nm``, the drive's own torque demand (6074h), N·m, only of
    samples with the drive enabled; ``position_rad``, the angle of the motor shaft since the first reading, measured
    independently of the speed, unwrapped.
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
    torque_agreement_rel_sd: float | None = None        # the same of reported over commanded torque; None: equal
    gear_ratio: float = 1.0                # i = ω_motor / ω_main
    timing_half_width_s: float = 0.0       # usual half-width of a transaction, within which a sample was taken
    stepped_setpoint: SteppedSetpoint | None = None     # of speed mode
    impedance: ImpedanceInput | None = None             # if the drive's impedance was measured
    torque_answer: TorqueAnswer | None = None           # of torque mode, if it was checked
    has_drill_string: bool = False         # rig.yaml states load: string
    pipe: Pipe | None = None               # of the drill string on the shaft, if its sizes are known
    simulated: bool = False
    complete: bool = True                  # False: the log ended before the run did
    commanded_torque_nm: FloatArray | None = None
    demanded_torque_nm: FloatArray | None = None
    position_rad: FloatArray | None = None
    position_gap_s: float | None = None    # longest gap in position_rad without a lost turn, s; None: any gap
    speed_unit_accepted: bool = False      # with --accept-speed-unit, although the position contradicted the speed


def aborted_stage(recording: Recording) -> Stage | None:
    """Return the first stage that did not reach its end, or None."""
    return next((stage for stage in recording.stages if stage.outcome == ABORTED), None)


def counts_until_s(recording: Recording) -> float:
    """Return the time at which an aborted run ceases to count, s; infinite for any other run."""
    stage = aborted_stage(recording)
    return stage.end_s - MARGIN_S if stage is not None and math.isfinite(stage.end_s) else math.inf


def before_abort(recording: Recording) -> Recording:
    """Return the part for the identification: up to a moment before the first aborted stage ended, or everything.

    The recording of an aborted run includes the stop: samples of braking and of standstill follow those of the planned
    motion. Segments end with their last whole period.
    """
    end_s = counts_until_s(recording)
    if end_s == math.inf:
        return recording
    # times that do not rise are refused later, by the checks of samples; nothing is sorted or searched here
    kept = recording.time_s < end_s
    excitation = recording.excitation
    return replace(
        recording,
        time_s=recording.time_s[kept],
        speed_rad_s=recording.speed_rad_s[kept],
        torque_nm=recording.torque_nm[kept],
        fresh=recording.fresh[kept],
        limited=recording.limited[kept],
        commanded_torque_nm=_part(recording.commanded_torque_nm, kept),
        demanded_torque_nm=_part(recording.demanded_torque_nm, kept),
        position_rad=_part(recording.position_rad, kept),
        excitation=None if excitation is None else _cut(excitation, end_s),
        levels=tuple(Level(one.start_s, min(one.end_s, end_s)) for one in recording.levels if one.start_s < end_s),
        ramps=tuple(Ramp(one.start_s, min(one.end_s, end_s)) for one in recording.ramps if one.start_s < end_s),
    )


def _part(signal: FloatArray | None, kept: BoolArray) -> FloatArray | None:
    return None if signal is None else signal[kept]


def _cut(excitation: Excitation, end_s: float) -> Excitation | None:
    """Return the excitation until ``end_s``; None if it had not started."""
    kept = tuple(_whole(one, end_s) for one in excitation.segments if one.start_s < end_s)
    return None if excitation.segments and not kept else replace(excitation, segments=kept)


def _whole(segment: Segment, end_s: float) -> Segment:
    if not segment.end_s > end_s or not segment.period_s > 0.0:
        return segment
    periods = math.floor((end_s - segment.start_s) / segment.period_s)
    # a segment without a whole period keeps a part of one, which is not used
    return replace(segment, end_s=segment.start_s + periods * segment.period_s if periods else end_s)

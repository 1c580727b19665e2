"""The conclusion of an identification: numbers with intervals, or the reason why there are none."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum
from importlib import import_module
from statistics import NormalDist
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from profiles import MessageCode
from tdhil.config import MODELS
from tdhil.recording import FloatArray

if TYPE_CHECKING:
    import xarray


def normal_quantile(confidence: float) -> float:
    """Half the width of the two-sided interval of a normal quantity with that confidence, in standard deviations."""
    return NormalDist().inv_cdf(0.5 + 0.5 * confidence)


# ---------------------------------------------------------------------------------------------------------------------
# What may be asked of identification.


@dataclass(frozen=True)
class Options:
    """``confidence`` of every interval; ``tolerance``: relative half-width of J above which a result is `valid_wide`.

    ``model``: rigid, two-mass and string take that shaft, with reporting lags; auto the simplest of these that the
    data do not contradict; paper takes the paper's method at its word (no lags), and lets it stand only where the data
    do not contradict that.
    """

    confidence: float = 0.95
    tolerance: float = 0.02
    model: str = "auto"     # of `tdhil.config.registry.MODELS`

    def __post_init__(self) -> None:
        if not 0.5 <= self.confidence < 1.0:
            raise ValueError(f"confidence must be in [0.5, 1): {self.confidence!r}")
        if not (math.isfinite(self.tolerance) and self.tolerance > 0.0):
            raise ValueError(f"tolerance must be a positive number: {self.tolerance!r}")
        if self.model not in MODELS:
            *first, last = MODELS
            raise ValueError(f"model must be {', '.join(first)} or {last}: {self.model!r}")


# ---------------------------------------------------------------------------------------------------------------------

_OPEN = 0.5     # half-width, of the value, beyond which an interval says nothing worth a number


class Verdict(Enum):
    """Verdict on the inertia."""

    VALID = "valid"                            # stands, within the tolerance
    VALID_WIDE = "valid_wide"                  # stands, but the interval is wider than the tolerance
    NOT_IDENTIFIABLE = "not_identifiable"      # the data can't tell; `reason` names what, `advice` the motion
    MODEL_REJECTED = "model_rejected"          # the data contradict every model tried


@dataclass(frozen=True)
class Estimate:
    """A value with its interval at the identification's confidence; infinite on a side that the data leave open."""

    value: float
    low: float
    high: float

    @property
    def finite(self) -> bool:
        """True if the value and both ends are finite."""
        return all(math.isfinite(x) for x in (self.value, self.low, self.high))

    @property
    def bounded(self) -> bool:
        """True if a positive value has an interval narrow enough to be reported."""
        return self.finite and self.value > 0.0 and 0.5 * (self.high - self.low) <= _OPEN * self.value


@dataclass(frozen=True)
class InertiaEstimate:
    """Moment of inertia at the motor shaft, kg·m².

    ``low_total``/``high_total`` is the interval to quote: it includes the uncertainty of the drive's torque scale.
    ``low``/``high`` (repeatability) hold if that scale is exact and the conditions in ``conditional_on`` are met.
    """

    value: float
    low: float
    high: float
    low_total: float
    high_total: float
    confidence: float
    conditional_on: tuple[str, ...]


@dataclass(frozen=True)
class LineFit:
    """T = inertia·α + intercept, by least squares (paper, equations 7 and 16)."""

    inertia_kg_m2: float
    intercept_nm: float
    r2: float


@dataclass(frozen=True)
class PaperEstimate:
    """The paper's method: over 0.1 s steps, and at the raw rate."""

    stepped: LineFit
    raw_rate: LineFit


@dataclass(frozen=True)
class ResidualTest:
    """Weighted residual sum of squares against its expectation; ``p_value`` small = the model doesn't fit."""

    statistic: float
    degrees_of_freedom: float
    p_value: float


REJECT_P = 0.001
DOUBT_P = 0.01


def rejects(test: ResidualTest | None, least_p: float = REJECT_P) -> bool:
    """Do the data contradict the model? Also where the statistic is no number."""
    return test is not None and not test.p_value >= least_p


def doubtful(test: ResidualTest | None) -> bool:
    """Do the data only just allow the model, if at all?"""
    return rejects(test, DOUBT_P)


@dataclass(frozen=True)
class BudgetLine:
    """One source's share of J's uncertainty, kg·m²: the half-width that it alone leaves, at the result's confidence.

    ``source``: noise, lag structure, lags, friction model, timing, torque scale. Lines add up in squares, about.
    """

    source: str
    half_width_kg_m2: float
    note: str


@dataclass(frozen=True)
class SecondOpinion:
    """J by another route through the same run, with the interval that this route can vouch for.

    ``route``: speed change, coast-down, torque steps. ``agrees``: its interval and the result's overlap as two
    independent ones of this confidence should; None where there is no result to agree with. ``least_scale_change``: the
    least relative change of a signal's scale at stage 5 that would contradict J; None where that is not known.
    """

    route: str
    inertia_kg_m2: Estimate
    agrees: bool | None
    note: str
    least_scale_change: float | None = None


@dataclass(frozen=True)
class TorqueRatio:
    """Reported torque over the ``reference``, commanded (in torque mode) or demanded torque (in speed mode).

    ``surely``: half-width of the ratio's interval at a chance of 1 in 1000 to lie outside. Root mean squares are over
    the samples that were compared. ``demanded_ratio``: demanded over commanded torque, where both are known and the
    ratio is off; else None.
    """

    reference: str
    ratio: Estimate
    surely: float
    reference_rms_nm: float
    demanded_rms_nm: float | None
    reported_rms_nm: float
    demanded_ratio: float | None


@dataclass(frozen=True)
class FrictionPoint:
    """Friction torque (load included) at one steady speed, N·m, with its interval."""

    speed_rad_s: float
    torque_nm: Estimate


@dataclass(frozen=True)
class Compliant:
    """A shaft that is not rigid: what turns behind the spring, kg·m², N·m/rad, N·m·s/rad, Hz.

    ``total_inertia`` is J_r + J_L, known even if the data do not separate them, if only from one side: then it is as
    wide as it is. A quantity that the data leave open is None. ``antiresonance_hz``: √(k/J_L)/2π, where the load swings
    and torque hardly moves the motor; ``resonance_hz``: where little torque moves both much.
    """

    total_inertia: Estimate | None
    load_inertia: Estimate | None
    stiffness_nm_rad: Estimate | None
    damping_nm_s_rad: Estimate | None
    resonance_hz: Estimate | None
    antiresonance_hz: Estimate | None


@dataclass(frozen=True)
class ImpedancePoint:
    """The drive's impedance at one frequency, as its speed loop makes it: N·m·s/rad, real and imaginary part.

    ``reflection``: |r| = |Z − ζ|/|Z + ζ| if the torque scale is exact; ``reflection_total`` with what is open of that.
    None where no ζ is known. ``measured``: what an excited line shows by itself, with the model's lags taken off.
    """

    hertz: float
    real_nm_s_rad: Estimate
    imaginary_nm_s_rad: Estimate
    reflection: Estimate | None
    reflection_total: Estimate | None
    measured_nm_s_rad: tuple[float, float] | None = None


@dataclass(frozen=True)
class DriveImpedance:
    """Impedance of a drive's speed loop as seen by the load on its shaft, Z = J s + B + H(s)(P + I/s), at the motor.

    H = 1/((1 + τ_t s)(1 + τ_f s)) are the lags inside the loop: of its torque, and of the speed that it sees;
    ``inner_lag_s`` is their sum, which is known better than either. P and I are as the drive has them, in the scale of
    its own torque. Estimates are None where the verdict is a refusal.
    """

    verdict: Verdict
    by: str                                    # offset, reference
    reason: str
    advice: str
    string_nm_s_rad: float                     # ζ at the motor; 0: none was known
    gain_nm_s_rad: Estimate | None = None      # P
    integral_nm_rad: Estimate | None = None    # I
    inner_lag_s: Estimate | None = None
    torque_lag_s: Estimate | None = None
    speed_filter_s: Estimate | None = None
    inertia_kg_m2: Estimate | None = None      # as this measurement has it
    viscous_nm_s_rad: Estimate | None = None
    reference_filter_s: Estimate | None = None     # of an undeclared reference filter, where one shows
    residual: ResidualTest | None = None
    points: tuple[ImpedancePoint, ...] = ()    # rising frequency
    conditions: tuple[str, ...] = ()


@dataclass(frozen=True)
class LinePoint:
    """One excited line: what torque over acceleration is at that frequency, and what the model makes of it.

    Apparent inertia is Im(T/ω)/2πf, the slope that a regression of torque on acceleration gives there, lags and all;
    damping is Re(T/ω). ``residual_sd``: root mean square of what the model leaves, in standard deviations.
    """

    hertz: float
    apparent_inertia_kg_m2: Estimate
    fitted_inertia_kg_m2: float
    apparent_damping_nm_s_rad: Estimate
    fitted_damping_nm_s_rad: float
    residual_sd: float


# ---------------------------------------------------------------------------------------------------------------------
# The frequency response, and its lines as a table.


@dataclass(frozen=True)
class ResponseLine:
    """One excited line. ``magnitude``: |ω/T|, rad/(s·N·m); ``phase_rad``: of ω/T, −π to π, its interval beyond.

    Apparent inertia is Im(T/ω)/2πf, kg·m². ``noise_rel`` and ``distortion_rel``: relative standard uncertainty of the
    magnitude, and of the phase in rad, from either. The intervals contain the noise, and the distortion where it was
    detected. ``fitted_magnitude`` and ``fitted_phase_rad``: of the model, None without one; ``residual_sd``: what the
    model leaves, in standard deviations.
    """

    hertz: float
    magnitude: Estimate
    phase_rad: Estimate
    apparent_inertia_kg_m2: Estimate
    noise_rel: float
    distortion_rel: float
    coherence: float
    periods: int
    fitted_magnitude: float | None
    fitted_phase_rad: float | None
    residual_sd: float | None


@dataclass(frozen=True)
class UnexcitedHarmonic:
    """A harmonic that was not excited: the amplitude of T − Z W there, N·m, and the part of it that is noise.

    What an error of Z could explain is left out of the amplitude.
    ``p_value``: how often noise alone would be as large.
    """

    hertz: float
    harmonic: int
    torque_nm: float
    noise_nm: float
    p_value: float


@dataclass(frozen=True)
class DistortionTest:
    """Test for nonlinear distortion, ``detected`` at a p-value below 0.1 %.

    ``p_value``: how often a linear shaft would show as much.
    ``by_harmonics``, ``by_speed``: p-values of its two parts, None where that part was not possible; ``odd_share``: of
    the distortion at unexcited harmonics, by power, None without any.
    """

    detected: bool
    p_value: float | None
    by_harmonics: float | None
    by_speed: float | None
    odd_share: float | None
    harmonics: tuple[UnexcitedHarmonic, ...]


@dataclass(frozen=True)
class CurvePoint:
    """The fitted model at one frequency: |ω/T| and phase of ω/T, with its band."""

    hertz: float
    magnitude: Estimate
    phase_rad: Estimate
    apparent_inertia_kg_m2: Estimate


@dataclass(frozen=True)
class FrequencyResponse:
    """G = ω/T at the excited lines, rising frequency, as speed and torque are reported, their lags included.

    ``realisations``: of the phases, in this recording; ``mean_speeds_rad_s``: of its segments.
    """

    confidence: float
    model: str
    lines: tuple[ResponseLine, ...]
    curve: tuple[CurvePoint, ...]
    distortion: DistortionTest
    mean_speeds_rad_s: tuple[float, ...]
    realisations: int = 1

    @property
    def hertz(self) -> FloatArray:
        """Return the frequencies (K,), Hz."""
        return np.array([line.hertz for line in self.lines])

    @property
    def response(self) -> NDArray[np.complex128]:
        """Return G = ω/T (K,), rad/(s·N·m)."""
        found: NDArray[np.complex128] = np.array([line.magnitude.value for line in self.lines]) * np.exp(
            1j * np.array([line.phase_rad.value for line in self.lines]))
        return found

    @property
    def impedance(self) -> NDArray[np.complex128]:
        """Return Z = T/ω (K,), N·m·s/rad."""
        found: NDArray[np.complex128] = 1.0 / self.response
        return found

    def to_frd(self) -> tuple[NDArray[np.complex128], FloatArray]:
        """Return G = ω/T and the angular frequencies, rad/s: ``control.FRD(*response.to_frd())``."""
        return self.response, 2.0 * np.pi * self.hertz

    def to_xarray(self) -> xarray.Dataset:
        """Return the lines along ``hertz``, each quantity with its unit (extra `notebook`).

        Raises ImportError without xarray, with the command that installs it.
        """
        try:
            library = import_module("xarray")
        except ImportError as error:
            error.add_note("Install it with: pip install '.[notebook]'")
            raise
        columns = response_columns(self)
        hertz = columns.pop("hertz")
        units = {name: unit_of(name) for name in columns}
        found: xarray.Dataset = library.Dataset(
            {name: ("hertz", np.array(values, dtype=np.float64), {"units": units[name]})
             for name, values in columns.items()},
            coords={"hertz": ("hertz", np.array(hertz), {"units": "Hz"})},
            attrs={"confidence": self.confidence, "model": self.model,
                   "distortion_detected": int(self.distortion.detected)},
        )
        return found


_UNITS = (("magnitude", "rad/(s N m)"), ("phase_rad", "rad"), ("apparent_inertia", "kg m2"), ("real_rad_s_nm",
          "rad/(s N m)"), ("imaginary_rad_s_nm", "rad/(s N m)"))


def unit_of(column: str) -> str:
    """Return the unit of a column of `response_columns`; 1 for a ratio or a count."""
    bare = column.removeprefix("fitted_")
    return "Hz" if column == "hertz" else next((unit for name, unit in _UNITS if bare.startswith(name)), "1")


def response_columns(found: FrequencyResponse) -> dict[str, list[float]]:
    """Return the lines as a table: column by name; a value that is not known is NaN."""
    rows = []
    for line, value in zip(found.lines, found.response.tolist(), strict=True):
        row: dict[str, Any] = {"hertz": line.hertz, "real_rad_s_nm": value.real, "imaginary_rad_s_nm": value.imag}
        for name in ("magnitude", "phase_rad", "apparent_inertia_kg_m2"):
            one: Estimate = getattr(line, name)
            row |= {name: one.value, f"{name}_low": one.low, f"{name}_high": one.high}
        for name in ("noise_rel", "distortion_rel", "coherence", "periods", "fitted_magnitude", "fitted_phase_rad",
                     "residual_sd"):
            row[name] = getattr(line, name)
        rows.append({name: math.nan if one is None else float(one) for name, one in row.items()})
    return {name: [row[name] for row in rows] for name in (rows[0] if rows else ())}


# ---------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Refusal:
    """Why there can be no number, and what to do about it; a sentence each."""

    reason: str
    advice: str
    entry: MessageCode = MessageCode.NOT_IDENTIFIABLE


class Refused(Exception):
    """Raised where an estimate can't be had. `identify` alone catches it, and makes it ``not_identifiable``."""

    def __init__(self, reason: str, advice: str, entry: MessageCode = MessageCode.NOT_IDENTIFIABLE) -> None:
        super().__init__(reason)
        self.refusal = Refusal(reason, advice, entry)


@dataclass(frozen=True)
class Identification:
    """The whole conclusion. Estimates are None where the verdict is a refusal or the quantity isn't in the model."""

    verdict: Verdict
    model: str                                  # paper, rigid+lags, two-mass, string, …; which one stands
    reason: str                                 # one sentence: why this verdict and this model
    advice: str                                 # one sentence: what would make it better
    inertia: InertiaEstimate | None
    viscous_nm_s_rad: Estimate | None
    coulomb_nm: Estimate | None                 # constant load included
    speed_lag_s: Estimate | None
    torque_lag_s: Estimate | None
    skew_s: Estimate | None
    paper: PaperEstimate | None
    residual: ResidualTest | None = None
    periods_used: int = 0
    samples_used: int = 0
    warnings: tuple[str, ...] = ()
    budget: tuple[BudgetLine, ...] = ()
    second_opinions: tuple[SecondOpinion, ...] = ()
    friction_curve: tuple[FrictionPoint, ...] = ()      # rising speed; empty where fewer than three speeds were seen
    compliant: Compliant | None = None                  # with the models two-mass and string; ``inertia`` is J_r then
    impedance: DriveImpedance | None = None             # of a run that measured the drive's own
    lines: tuple[LinePoint, ...] = ()                   # rising frequency; for the picture of the report
    torque_ratios: tuple[TorqueRatio, ...] = ()         # of the signals of torque; empty where no setpoint is known
    frequency_response: FrequencyResponse | None = None     # of a periodic excitation with two periods or more
    entry: MessageCode = MessageCode.NOT_IDENTIFIABLE   # entry of verdict, reason and advice in the table of messages

"""Result of an identification: numbers with intervals, or the reason why there are none."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from enum import Enum
from importlib import import_module
from statistics import NormalDist
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from profiles import MessageCode, UsageError
from tdhil.config import MODELS
from tdhil.recording import FloatArray

if TYPE_CHECKING:
    import xarray


def normal_quantile(confidence: float) -> float:
    """Return the half-width of the two-sided interval of a normal quantity, in standard deviations."""
    return NormalDist().inv_cdf(0.5 + 0.5 * confidence)


# ---------------------------------------------------------------------------------------------------------------------
# Options of identification.


@dataclass(frozen=True)
class Options:
    """``confidence`` of every interval; ``tolerance``: relative half-width of J above which a result is `valid_wide`.

    ``model``: rigid, two-mass and string select that shaft, with reporting lags. auto selects the simplest of these
    that the data do not contradict. paper assumes no lags, as the paper's method does, and is valid only if the data do
    not contradict this.
    """

    confidence: float = 0.95
    tolerance: float = 0.02
    model: str = "auto"     # a name in `tdhil.config.registry.MODELS`

    def __post_init__(self) -> None:
        if not 0.5 <= self.confidence < 1.0:
            raise ValueError(f"confidence must be in [0.5, 1): {self.confidence!r}")
        if not (math.isfinite(self.tolerance) and self.tolerance > 0.0):
            raise ValueError(f"tolerance must be a positive number: {self.tolerance!r}")
        if self.model not in MODELS:
            *first, last = MODELS
            raise ValueError(f"model must be {', '.join(first)} or {last}: {self.model!r}")


# ---------------------------------------------------------------------------------------------------------------------

OPEN = 0.5     # half-width over value, beyond which an interval is not reported as a number


class Verdict(Enum):
    """Verdict on the inertia."""

    VALID = "valid"                            # J stands, within the tolerance
    VALID_WIDE = "valid_wide"                  # J stands, but the interval is wider than the tolerance
    NOT_IDENTIFIABLE = "not_identifiable"      # the data do not determine J; `reason` and `advice` explain
    MODEL_REJECTED = "model_rejected"          # the data contradict every model tried


@dataclass(frozen=True)
class Estimate:
    """Value with its interval at the confidence of the identification; infinite on a side that the data leave open."""

    value: float
    low: float
    high: float

    @property
    def finite(self) -> bool:
        """True if the value and both ends are finite."""
        return all(math.isfinite(x) for x in (self.value, self.low, self.high))

    @property
    def bounded(self) -> bool:
        """True if the value is positive and its interval is narrow enough to be reported."""
        return self.finite and self.value > 0.0 and 0.5 * (self.high - self.low) <= OPEN * self.value


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
    """Line T = inertia·α + intercept, by least squares (paper, equations 7 and 16)."""

    inertia_kg_m2: float
    intercept_nm: float
    r2: float


@dataclass(frozen=True)
class PaperEstimate:
    """Results of the paper's method: over 0.1 s steps, and at the raw rate."""

    stepped: LineFit
    raw_rate: LineFit


@dataclass(frozen=True)
class ResidualTest:
    """Weighted residual sum of squares against its expectation. A small ``p_value``: the model does not fit."""

    statistic: float
    degrees_of_freedom: float
    p_value: float


REJECT_P = 0.001
"""Probability of the residuals below which a model is rejected: one correct model in a thousand. A larger value rejects
more correct models; `docs/explanation/models.md` has the rule."""
DOUBT_P = 0.01
"""Probability below which a model is only just allowed. Curved friction is tried then, and the model of a record
without periodic excitation is rejected."""


def rejects(test: ResidualTest | None, least_p: float = REJECT_P) -> bool:
    """Return whether the data contradict the model. True also if the statistic is not a number."""
    return test is not None and not test.p_value >= least_p


def doubtful(test: ResidualTest | None) -> bool:
    """Return whether the data contradict the model, or allow it only just."""
    return rejects(test, DOUBT_P)


@dataclass(frozen=True)
class BudgetLine:
    """Contribution of one source to the uncertainty of J, kg·m²: its half-width alone, at the result's confidence.

    ``source``: noise, lag structure, lags, friction model, timing, torque scale. The contributions add in quadrature,
    approximately.
    """

    source: str
    half_width_kg_m2: float
    note: str


@dataclass(frozen=True)
class SecondOpinion:
    """J from another route through the same run, with the interval of this route.

    ``route``: speed change, coast-down, torque steps. ``agrees``: its interval and that of the result overlap as two
    independent intervals of this confidence should; None without a result to compare with. ``least_scale_change``:
    smallest relative change of a signal's scale during the run that would contradict J in 95 of 100 runs; None if
    unknown. Above a string without a result to compare with, that of the torque scale, from the mean torques.
    """

    route: str
    inertia_kg_m2: Estimate
    agrees: bool | None
    note: str
    least_scale_change: float | None = None


@dataclass(frozen=True)
class TorqueRatio:
    """Ratio of reported torque to the ``reference``: commanded torque (torque mode) or demanded torque (speed mode).

    ``surely``: half-width of the ratio's 99.9 % interval. Root mean squares are over the compared samples.
    ``demanded_ratio``: demanded over commanded torque if both are known and the ratio is wrong; else None.
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
class AngleHarmonic:
    """Torque a·cos(nθ + φ) against positive rotation, θ the angle of the motor shaft since the first reading.

    ``order``: n, periods in one turn. Cogging has the orders of slots and poles, eccentricity has low orders.
    """

    order: int
    amplitude_nm: Estimate
    phase_rad: Estimate


@dataclass(frozen=True)
class LeastHarmonic:
    """Least amplitude of an order that the recording would show in 95 of 100 runs."""

    order: int
    amplitude_nm: float


@dataclass(frozen=True)
class Backlash:
    """Play of a coupling or a gear behind the motor, from flank to flank, at the motor shaft, rad.

    ``at_motor_rad``: the part that the motor moves against a rigid shaft while the load changes its flank, J_L/J of the
    play. Both are None if the angle shows a play, and the model of the flanks does not explain it well enough.
    """

    play_rad: Estimate | None
    at_motor_rad: Estimate | None


@dataclass(frozen=True)
class ShaftCovariance:
    """Covariance of the values of a compliant shaft, by the quadratic approximation of the likelihood.

    ``quantities``: names of rows and columns, with their units. An entry has the unit of its row times that of its
    column. The torque scale is taken as exact.
    """

    quantities: tuple[str, ...]
    matrix: tuple[tuple[float, ...], ...]


@dataclass(frozen=True)
class Compliant:
    """A shaft that is not rigid: the parameters behind the spring, kg·m², N·m/rad, N·m·s/rad, Hz.

    ``total_inertia`` is J_r + J_L. It is given even if the data do not separate the two, or bound it on one side only.
    A quantity that the data leave open is None. ``antiresonance_hz``: √(k/J_L)/2π, where the load oscillates and torque
    hardly moves the motor. ``resonance_hz``: where a small torque moves both strongly.
    """

    total_inertia: Estimate | None
    load_inertia: Estimate | None
    stiffness_nm_rad: Estimate | None
    damping_nm_s_rad: Estimate | None
    resonance_hz: Estimate | None
    antiresonance_hz: Estimate | None
    covariance: ShaftCovariance | None = None


@dataclass(frozen=True)
class ImpedancePoint:
    """Impedance of the drive with its speed loop at one frequency, N·m·s/rad, real and imaginary part.

    ``reflection``: |r| = |Z − ζ|/|Z + ζ| if the torque scale is exact; ``reflection_total`` includes the uncertainty of
    that scale. None if ζ is unknown. ``measured``: value from an excited line alone, with the lags of the model
    removed.
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

    H = 1/((1 + τ_t s)(1 + τ_f s)) are the lags inside the loop: of its torque and of its speed feedback.
    ``inner_lag_s`` is their sum, which is known better than either. P and I are those of the drive. With a torque
    offset all values are in the scale of the commanded torque; with the reference as input, in that of the reported
    torque. The intervals of P, I and lags include the ratio of both scales. Estimates are None if the verdict is a
    refusal.
    """

    verdict: Verdict
    by: str                                    # offset or reference
    reason: str
    advice: str
    string_nm_s_rad: float                     # ζ at the motor shaft; 0: unknown
    gain_nm_s_rad: Estimate | None = None      # P
    integral_nm_rad: Estimate | None = None    # I
    inner_lag_s: Estimate | None = None
    torque_lag_s: Estimate | None = None
    speed_filter_s: Estimate | None = None
    inertia_kg_m2: Estimate | None = None      # from this measurement
    viscous_nm_s_rad: Estimate | None = None
    reference_filter_s: Estimate | None = None     # time constant of an undeclared reference filter; None without one
    residual: ResidualTest | None = None
    points: tuple[ImpedancePoint, ...] = ()    # in order of frequency
    conditions: tuple[str, ...] = ()


@dataclass(frozen=True)
class LinePoint:
    """One excited line: apparent inertia and damping at that frequency, measured and by the model.

    Apparent inertia is Im(T/ω)/2πf, the slope that a regression of torque on acceleration gives at this frequency, with
    the effect of the lags. Damping is Re(T/ω). ``residual_sd``: root mean square of the residuals, in standard
    deviations.
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
    """One excited line. ``magnitude``: |ω/T|, rad/(s·N·m). ``phase_rad``: phase of ω/T, −π to π; its interval may
    exceed ±π.

    Apparent inertia is Im(T/ω)/2πf, kg·m². ``noise_rel`` and ``distortion_rel``: relative standard uncertainty of the
    magnitude, and of the phase in rad, due to noise and to distortion. The intervals contain the noise, and the
    distortion if it was detected. ``fitted_magnitude`` and ``fitted_phase_rad``: values of the model, None without one.
    ``residual_sd``: residual of the model, in standard deviations.
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

    @property
    def impedance_magnitude(self) -> Estimate:
        """Return |T/ω|, N·m·s/rad; its high end is infinite where the interval of |ω/T| reaches down to 0."""
        low, value, high = self.magnitude.low, self.magnitude.value, self.magnitude.high
        return Estimate(1.0 / value, 1.0 / high, 1.0 / low if low > 0.0 else math.inf)

    @property
    def impedance_phase_rad(self) -> Estimate:
        """Return the phase of T/ω, −π to π; its interval may exceed ±π."""
        return Estimate(-self.phase_rad.value, -self.phase_rad.high, -self.phase_rad.low)


@dataclass(frozen=True)
class UnexcitedHarmonic:
    """Harmonic that was not excited: amplitude of T − Z W there, N·m, and the part of it that is noise.

    The amplitude excludes the part that an error of Z can explain. ``p_value``: probability that noise alone is as
    large.
    """

    hertz: float
    harmonic: int
    torque_nm: float
    noise_nm: float
    p_value: float


@dataclass(frozen=True)
class DistortionTest:
    """Test for nonlinear distortion, ``detected`` at a p-value below 0.1 %.

    ``p_value``: probability of as much distortion with a linear shaft. ``by_harmonics``, ``by_speed``: p-values of its
    two parts, None for a part that was not possible. ``odd_share``: share of odd harmonics in the power of the
    distortion at unexcited harmonics, None without distortion.
    """

    detected: bool
    p_value: float | None
    by_harmonics: float | None
    by_speed: float | None
    odd_share: float | None
    harmonics: tuple[UnexcitedHarmonic, ...]


@dataclass(frozen=True)
class CurvePoint:
    """Fitted model at one frequency: |ω/T| and phase of ω/T, with their band."""

    hertz: float
    magnitude: Estimate
    phase_rad: Estimate
    apparent_inertia_kg_m2: Estimate


@dataclass(frozen=True)
class FrequencyResponse:
    """Frequency response G = ω/T at the excited lines, in order of frequency, of the reported signals (lags included).

    ``realisations``: number of different phase sets in this recording. ``mean_speeds_rad_s``: mean speeds of its
    segments.
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

        Raises UsageError without xarray, with the command that installs it.
        """
        try:
            library = import_module("xarray")
        except ImportError as error:
            raise UsageError("xarray is not installed", next_step="Install it with: pip install '.[notebook]'",
                             entry=MessageCode.PACKAGE_MISSING) from error
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


_UNITS = (("impedance_magnitude", "N m s/rad"), ("impedance_phase_rad", "rad"),
          ("magnitude", "rad/(s N m)"), ("phase_rad", "rad"), ("apparent_inertia", "kg m2"), ("real_rad_s_nm",
          "rad/(s N m)"), ("imaginary_rad_s_nm", "rad/(s N m)"))


def unit_of(column: str) -> str:
    """Return the unit of a column of `response_columns`; 1 for a ratio or a count."""
    bare = column.removeprefix("fitted_")
    return "Hz" if column == "hertz" else next((unit for name, unit in _UNITS if bare.startswith(name)), "1")


def response_columns(found: FrequencyResponse) -> dict[str, list[float]]:
    """Return the lines as a table: column by name; an unknown value is NaN."""
    rows = []
    for line, value in zip(found.lines, found.response.tolist(), strict=True):
        row: dict[str, Any] = {"hertz": line.hertz, "real_rad_s_nm": value.real, "imaginary_rad_s_nm": value.imag}
        for name in ("magnitude", "phase_rad", "impedance_magnitude", "impedance_phase_rad", "apparent_inertia_kg_m2"):
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
    """Reason why there is no number, and the advice; one sentence each."""

    reason: str
    advice: str
    entry: MessageCode = MessageCode.NOT_IDENTIFIABLE


class Refused(Exception):
    """Raised if a value cannot be estimated. Only `identify` catches it; the verdict is then ``not_identifiable``."""

    def __init__(self, reason: str, advice: str, entry: MessageCode = MessageCode.NOT_IDENTIFIABLE) -> None:
        super().__init__(reason)
        self.refusal = Refusal(reason, advice, entry)


@dataclass(frozen=True)
class PlayMotion:
    """Ability of the motion to show a play: the load crosses it where the torque on the load reverses.

    ``least_torque_nm``: least torque of the drive along the rotation, by the excited lines. Below 0 the drive brakes
    the shaft, and a load with its share of inertia and friction drives the motor.
    """

    torque_reverses: bool
    least_torque_nm: float


@dataclass(frozen=True, kw_only=True)
class ModelResult:
    """Quantities of one model, which a route finds and the identification reports.

    An estimate is None if the model does not have the quantity, or if the data contradict the model.
    """

    model: str = "none"                                 # paper, rigid+lags[, bent friction], two-mass, string
    viscous_nm_s_rad: Estimate | None = None
    coulomb_nm: Estimate | None = None                  # constant load included
    speed_lag_s: Estimate | None = None
    torque_lag_s: Estimate | None = None
    skew_s: Estimate | None = None
    residual: ResidualTest | None = None
    warnings: tuple[str, ...] = ()
    budget: tuple[BudgetLine, ...] = ()
    second_opinions: tuple[SecondOpinion, ...] = ()
    friction_curve: tuple[FrictionPoint, ...] = ()      # in order of speed; empty with fewer than three speeds
    compliant: Compliant | None = None                  # for the models two-mass and string; ``inertia`` is then J_r
    harmonics: tuple[AngleHarmonic, ...] | None = None  # of the shaft's angle, the largest first; None: not known
    least_harmonics: tuple[LeastHarmonic, ...] | None = None     # detection limits, by order; None: not known
    backlash: tuple[Backlash, ...] | None = None        # of the coupling; empty: none found; None: not known
    backlash_motion: PlayMotion | None = None           # None where ``backlash`` is
    lines: tuple[LinePoint, ...] = ()                   # in order of frequency; for the figure of the report

    def quantities(self) -> dict[str, Any]:
        """Return the fields of this class by name."""
        return {one.name: getattr(self, one.name) for one in fields(ModelResult)}


@dataclass(frozen=True, kw_only=True)
class Identification(ModelResult):
    """Result of an identification: the selected model with its verdict. ``inertia``: None if it is a refusal."""

    verdict: Verdict
    reason: str                                 # one sentence: why this verdict and this model
    advice: str                                 # one sentence: what would improve it
    calibration_advised: bool = False           # the advice is a torque calibration
    inertia: InertiaEstimate | None = None
    paper: PaperEstimate | None = None
    periods_used: int = 0
    samples_used: int = 0
    impedance: DriveImpedance | None = None             # of a run that measured the drive's impedance
    torque_ratios: tuple[TorqueRatio, ...] = ()         # of each torque signal; empty without a known setpoint
    torque_scale_rel_sd: float | None = None            # in the total intervals; None: that of the recording
    frequency_response: FrequencyResponse | None = None     # of a periodic excitation with two or more periods
    entry: MessageCode = MessageCode.NOT_IDENTIFIABLE   # entry of verdict, reason and advice in the table of messages

"""What identification concludes: numbers with intervals, or the reason why there are none."""

from dataclasses import dataclass
from enum import Enum


class Verdict(Enum):
    """Does the number stand?"""

    VALID = "valid"
    VALID_WIDE = "valid_wide"                  # stands, but the interval is wider than was asked for
    NOT_IDENTIFIABLE = "not_identifiable"      # the data can't tell; `reason` names what, `advice` the motion
    MODEL_REJECTED = "model_rejected"          # the data contradict every model tried


@dataclass(frozen=True)
class Estimate:
    """A value with its interval at the identification's confidence."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class InertiaEstimate:
    """Moment of inertia at the motor shaft, kg·m².

    ``low``/``high`` hold if the drive's torque scale is exact and whatever else ``conditional_on`` names;
    ``low_total``/``high_total`` include the uncertainty of the torque scale.
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


@dataclass(frozen=True)
class Identification:
    """The whole conclusion. Estimates are None where the verdict is a refusal or the quantity isn't in the model."""

    verdict: Verdict
    model: str                                  # rigid, rigid+lags, two-mass, …; which one stands
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

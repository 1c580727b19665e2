r"""Torque calibration by a drill string of known sizes, which is a known resistance to waves.

Until an echo returns, a uniform pipe responds to a motion of its top with the torque ζ ω. With its shear modulus G,
density ρ, polar moment of area I and length L,

    ζ = I √(Gρ),        T = L √(ρ/G)   travel time from end to end.

The drive reports its torque over κ, so a run gives ζ/κ and T. G is the least certain input, and is also in T. Therefore
z = ζ T^(−e) is compared: e = −1 gives ρ I L, the inertia of the string, without G; e = 0 gives ζ, without L. The
exponent with the least uncertainty follows from the tolerances (Gauss and Markov): e = Cov(ln ζ, ln T)/Var(ln T).

Tolerances are half-widths of rectangular distributions. A one-sided tolerance, such as wear, is represented by its
middle.
"""

import math
from dataclasses import dataclass

from profiles.quantities import printed_share
from tdhil.calibration.added_body import (
    FactorLine,
    MeasuredValue,
    compared,
    effective_degrees_of_freedom,
    measured_value,
)
from tdhil.estimation import MeasuredString, normal_quantile
from tdhil.estimation.frequency_domain import CERTAIN


@dataclass(frozen=True)
class PipeInput:
    """Size or property of the pipe: between ``low`` and ``high``, as factors on the stated value.

    ``of_impedance`` and ``of_delay``: relative sensitivities of ζ and T.
    """

    source: str
    low: float
    high: float
    of_impedance: float
    of_delay: float

    @property
    def rel_sd(self) -> float:
        """Standard uncertainty of a rectangular distribution, as a share of the stated value."""
        return 0.5 * (self.high - self.low) / math.sqrt(3.0)

    @property
    def middle(self) -> float:
        """Middle of the tolerance, as a factor on the stated value."""
        return 0.5 * (self.low + self.high)


@dataclass(frozen=True)
class KnownPipe:
    """Stated pipe: ``impedance_nm_s_rad`` ζ and ``delay_s`` T at the motor shaft, and the inputs behind them."""

    impedance_nm_s_rad: float
    delay_s: float
    inputs: tuple[PipeInput, ...]

    @property
    def delay_rel_sd(self) -> float:
        """Relative standard uncertainty of T."""
        return math.sqrt(sum((one.of_delay * one.rel_sd) ** 2 for one in self.inputs))

    @property
    def exponent(self) -> float:
        """Exponent e of z = ζ T^(−e) with the least uncertainty; T is assumed to be measured without error."""
        variance = self.delay_rel_sd**2
        if variance <= 0.0:
            return 0.0
        return sum(one.of_impedance * one.of_delay * one.rel_sd**2 for one in self.inputs) / variance

    @property
    def value(self) -> float:
        """Return z for the middle of all tolerances."""
        e = self.exponent
        stated = self.impedance_nm_s_rad * self.delay_s**-e
        return float(stated * math.prod(one.middle ** (one.of_impedance - e * one.of_delay) for one in self.inputs))


@dataclass(frozen=True)
class KnownPipeFit:
    """Result. ``factor`` κ is invalid with a ``refusal``. ``typed_half_width``: of the torque scale stated before."""

    factor: MeasuredValue
    budget: tuple[FactorLine, ...]
    typed_half_width: float
    refusal: str = ""
    advice: str = ""
    warnings: tuple[str, ...] = ()


def calibrate_known_pipe(
    known: KnownPipe, measured: MeasuredString, *, scale_rel_sd: float = 0.02, confidence: float = 0.95
) -> KnownPipeFit:
    """Return κ = z of the stated pipe over z in the drive's unit. ``scale_rel_sd``: stated before the calibration."""
    e = known.exponent
    value = known.value / measured.value.value
    quantile = normal_quantile(confidence)
    reach = max(measured.value.high / measured.value.value, measured.value.value / measured.value.low) - 1.0
    budget = (
        FactorLine("scatter of the run, filters and string", "normal", CERTAIN, reach / quantile),
        *(FactorLine(one.source, "rectangular", CERTAIN,
                     abs(one.of_impedance - e * one.of_delay) * one.rel_sd / one.middle) for one in known.inputs),
    )
    sd = value * math.sqrt(sum(line.of_factor**2 for line in budget))
    dof = effective_degrees_of_freedom([(line.of_factor, line.degrees_of_freedom) for line in budget])
    factor = measured_value(value, sd, dof, confidence)
    typed = quantile * scale_rel_sd
    if factor.half_width_share >= typed:
        worst = max(budget, key=lambda line: line.of_factor)
        return KnownPipeFit(
            factor, budget, typed, f"the pipe gives κ = {value:.3f} to {printed_share(factor.half_width_share)} only, "
            f"which is wider than the torque scale as stated so far (±{100 * typed:.1f} %); "
            f"most comes from: {worst.source}",
            "state the measured sizes of the pipe with their tolerances in string.yaml, or use a body of known inertia")
    reason, warnings = compared(factor, scale_rel_sd, typed, "the sizes of the pipe")
    advice = "compare the diameters in string.yaml with the pipe, and the gear ratio with the drive" if reason else ""
    return KnownPipeFit(factor, budget, typed, reason, advice, warnings)

r"""Speed calibration: the reported speed against a known angle, from counted turns or from the drive's position.

The drive reports Ω = ω/κ_ω, with the *calibration factor* κ_ω of its speed. Over a time t the shaft turns through the
angle θ = 2π N, and the integral of the reported speed is Θ:

    κ_ω = θ/Θ,        with counted turns and a mean reported speed Ω̄:   κ_ω = 2π N/(Ω̄ t),

and independent errors give (dκ/κ)² = (dN/N)² + (dt/t)² + (dΩ̄/Ω̄)². Uncertainties are propagated to first order (GUM
5.2). Bounds of an error are taken as rectangular distributions, half-width over √3 (GUM 4.3.7).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from profiles.quantities import printed_share
from tdhil.calibration.added_body import LARGEST_ERROR, MeasuredValue, measured_value
from tdhil.estimation import RATIOS_ALIKE, AngleRatio, Verdict
from tdhil.estimation.frequency_domain import CERTAIN, student_quantile


@dataclass(frozen=True)
class CountedTurns:
    """Turns of the motor shaft that an operator counted in ``seconds``, and the mean reported speed during this time.

    Each with its standard uncertainty. ``speed_bound_rad_s``: bound of the error of the mean due to lag and rounding of
    the reports. The sign of ``turns`` does not matter: the direction of the speed is used.
    """

    turns: float
    turns_sd: float
    seconds: float
    seconds_sd: float
    speed_rad_s: float
    speed_sd_rad_s: float = 0.0
    speed_bound_rad_s: float = 0.0


@dataclass(frozen=True)
class SpeedBudgetLine:
    """Input quantity: its standard uncertainty in its own unit, and its relative contribution to κ_ω (1 sd)."""

    source: str
    standard_uncertainty: float
    unit: str
    distribution: str
    degrees_of_freedom: float
    of_factor: float


@dataclass(frozen=True)
class SpeedCalibration:
    """Result: ``factor`` κ_ω, true over reported speed; None if refused.

    ``least_turns``: sufficient number of turns at this speed, if too few were counted; else None.
    """

    verdict: Verdict
    reason: str
    advice: str
    method: str
    factor: MeasuredValue | None = None
    budget: tuple[SpeedBudgetLine, ...] = ()
    least_turns: int | None = None


def calibrate_by_turns(counted: CountedTurns, wanted: float, confidence: float = 0.95) -> SpeedCalibration:
    """Return κ_ω from counted turns. Refused beyond a half-width of ``wanted`` (a share). Raises ValueError for no
    motion.
    """
    if not (counted.turns > 0.0 and counted.seconds > 0.0 and counted.speed_rad_s != 0.0):
        raise ValueError("no speed, no turns or no time")
    speed = abs(counted.speed_rad_s)
    value = 2.0 * math.pi * counted.turns / (speed * counted.seconds)
    bound = counted.speed_bound_rad_s / math.sqrt(3.0)
    budget = tuple(line for line in (
        SpeedBudgetLine("counted turns", counted.turns_sd, "turns", "normal", CERTAIN,
                        counted.turns_sd / counted.turns),
        SpeedBudgetLine("time", counted.seconds_sd, "s", "normal", CERTAIN, counted.seconds_sd / counted.seconds),
        SpeedBudgetLine("mean reported speed", counted.speed_sd_rad_s, "rad/s", "normal", CERTAIN,
                        counted.speed_sd_rad_s / speed),
        SpeedBudgetLine("lag and rounding of the reported speed", bound, "rad/s", "rectangular", CERTAIN,
                        bound / speed),
    ) if line.standard_uncertainty > 0.0)
    # Turns that reach ``wanted`` at this speed; None if the uncertainty of the speed prevents it. The bound comes from
    # the ends of the stretch and would shrink with its length; here it stays constant, as rounding does.
    fixed = (counted.speed_sd_rad_s / counted.speed_rad_s) ** 2
    fixed += (counted.speed_bound_rad_s / counted.speed_rad_s) ** 2 / 3.0
    left = (wanted / student_quantile(confidence, CERTAIN)) ** 2 - fixed
    of_ends = math.hypot(counted.turns_sd, counted.seconds_sd * counted.turns / counted.seconds)
    least = None if left <= 0.0 else math.ceil(of_ends / math.sqrt(left))
    return _concluded("turns", value, budget, wanted, confidence, least)


def calibrate_by_position(
    stretches: Sequence[AngleRatio], wanted: float, confidence: float = 0.95
) -> SpeedCalibration:
    """Return κ_ω from angle over integrated speed in stretches of one run. Raises ValueError without stretches.

    Each stretch has the weight 1/half-width². All bounds are taken as bounds of the same error: their mean is used,
    without division by the root of their number.
    """
    if not stretches:
        raise ValueError("no stretch of the recording has a position and a speed")
    weights = [1.0 / max(one.half_width, 1e-12) ** 2 for one in stretches]
    total = sum(weights)
    value = sum(weight * one.value for weight, one in zip(weights, stretches, strict=True)) / total
    bound = sum(weight * one.half_width for weight, one in zip(weights, stretches, strict=True)) / total
    if value == 0.0:
        return SpeedCalibration(
            Verdict.MODEL_REJECTED, "the position shows no travel, although the drive reports speed",
            "check the encoder and its coupling", "position")
    more = len(stretches) - 1
    scatter = 0.0
    if more:
        scatter = math.sqrt(sum(weight * (one.value - value) ** 2
                                for weight, one in zip(weights, stretches, strict=True)) / total / more)
    budget = tuple(line for line in (
        SpeedBudgetLine("counts of the position, lag and rounding of the speed", bound / math.sqrt(3.0), "1",
                        "rectangular", CERTAIN, bound / math.sqrt(3.0) / abs(value) if value else math.inf),
        SpeedBudgetLine(f"scatter of {len(stretches)} stretches", scatter, "1", "Student", float(max(more, 1)),
                        scatter / abs(value) if value else math.inf),
    ) if line.standard_uncertainty > 0.0)
    for one in stretches:
        if abs(one.value - value) > one.half_width + bound + RATIOS_ALIKE * abs(value):
            return SpeedCalibration(
                Verdict.MODEL_REJECTED, f"the scale of the reported speed changed during the run: the factor is"
                f" {one.value:.4g} in {one.where} and {value:.4g} in the mean", "check the encoder, its coupling and"
                " its supply, then measure again", "position", budget=budget)
    return _concluded("position", value, budget, wanted, confidence, None)


def _concluded(
    method: str, value: float, budget: tuple[SpeedBudgetLine, ...], wanted: float, confidence: float, least: int | None,
) -> SpeedCalibration:
    variance = sum(line.of_factor**2 for line in budget)
    slow = sum(line.of_factor**4 / line.degrees_of_freedom for line in budget)
    factor = measured_value(value, math.sqrt(variance) * abs(value), variance**2 / slow if slow else CERTAIN,
                            confidence)
    if factor.half_width_share > wanted:
        advice = "measure for longer, at a steady speed"
        if least is not None:
            advice = f"count {least} turns or more at this speed, or state a smaller uncertainty of what was read"
        return SpeedCalibration(
            Verdict.NOT_IDENTIFIABLE, f"the measurement is too short: it would leave the factor at "
            f"{printed_share(factor.half_width_share)}, and ±{100 * wanted:.2f} % is wanted",
            advice, method, budget=budget, least_turns=least)
    if not abs(value - 1.0) <= LARGEST_ERROR + factor.half_width_share:
        return SpeedCalibration(
            Verdict.MODEL_REJECTED, f"the calibration factor would be {value:.4g}: more than "
            f"{100 * LARGEST_ERROR:.0f} % from 1 is no error of a scale but a wrong unit",
            "check the unit of speed in the profile, the counted turns, and the shaft at which they were counted "
            "(--at motor or main)", method, budget=budget)
    return SpeedCalibration(Verdict.VALID, f"the factor is known to {printed_share(factor.half_width_share)}", "",
                            method, factor, budget)

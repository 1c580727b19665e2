r"""Torque calibration by bodies of known inertia: the line of identified over added inertia.

The drive reports T/κ, with the *calibration factor* κ of its torque. A run with inertia J and an added body b
identifies

    y = (J + b)/κ,        a straight line over b: slope 1/κ, intercept J/κ,

Two runs, without a body (y₁) and with one (y₂), give κ = b/(y₂ − y₁) and J = b y₁/(y₂ − y₁). An equal relative error of
both runs cancels in J. Relative errors x₁ and x₂ of the runs give

    dJ/J = (1 + J/b)(x₁ − x₂),        dκ/κ = (y₁ x₁ − y₂ x₂)/(y₂ − y₁),        plus db/b of the body in either.

One balance and one gauge measure all bodies. So the least of their relative uncertainties, such as the assumed 0.2 %,
is one error δ that all bodies share, dκ/κ = dJ/J = δ for any number of bodies. The rest of a body is its own error.

With more than two runs the line is fitted by generalised least squares with the weights C⁻¹; C is the covariance of the
runs plus that of the bodies. The residuals test whether the line is straight. Uncertainties are propagated to first
order (GUM 5.2), degrees of freedom by Welch and Satterthwaite (GUM G.4); coverage intervals are symmetric with
Student's quantile.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from profiles import CodedText, MessageCode
from profiles.quantities import printed_bound, printed_share
from tdhil.estimation import ResidualTest, Verdict
from tdhil.estimation.frequency_domain import CERTAIN, student_quantile
from tdhil.recording import FloatArray

CONTRADICTED_P = 0.001
"""p-value below which a test contradicts shared filters or a straight line."""
LARGEST_ERROR, LARGEST_IN_SD = 0.15, 5.0
"""Largest plausible error of a torque scale: this share, or this multiple of its stated standard deviation."""
_LIKE_GEAR = 0.25
"""Relative distance from i² within which a factor suggests the wrong shaft."""


@dataclass(frozen=True)
class BodyRun:
    """One run. ``added_kg_m2`` and ``added_sd_kg_m2`` at the motor shaft; 0 without a body. ``name``: in messages."""

    name: str
    added_kg_m2: float
    added_sd_kg_m2: float = 0.0
    noise_share: float = 0.0
    """Relative standard uncertainty of its J for known filters."""

    @property
    def body(self) -> tuple[float, float]:
        """Return inertia and standard uncertainty. Runs with equal values have the same body."""
        return self.added_kg_m2, self.added_sd_kg_m2


@dataclass(frozen=True)
class CalibrationCase:
    """All runs. ``reported_kg_m2`` (n,) in the drive's unit, ``covariance`` (n, n) with its ``degrees_of_freedom``.

    ``covariance_known`` (n, n): for known filters of the reports. ``sharing``: test whether the runs share the filters;
    None: not tested. ``scale_rel_sd``: stated standard uncertainty of the torque scale before this calibration.
    ``gear_ratio`` i = ω_motor/ω_main. ``reading_rel_sd``: relative standard uncertainty that all J share, because the
    torque is read in step with a speed setpoint; it cancels in J without the body, and κ has all of it.
    """

    runs: tuple[BodyRun, ...]
    reported_kg_m2: FloatArray
    covariance: FloatArray
    covariance_known: FloatArray
    degrees_of_freedom: float
    sharing: ResidualTest | None
    sharing_words: str = ""
    scale_rel_sd: float = 0.02
    gear_ratio: float = 1.0
    confidence: float = 0.95
    reading_rel_sd: float = 0.0


@dataclass(frozen=True)
class MeasuredValue:
    """Value with its standard uncertainty, effective degrees of freedom, and coverage interval."""

    value: float
    standard_uncertainty: float
    degrees_of_freedom: float
    coverage_factor: float
    low: float
    high: float

    @property
    def half_width_share(self) -> float:
        """Return half the interval, as a share of the value."""
        return 0.5 * (self.high - self.low) / abs(self.value)


@dataclass(frozen=True)
class CalibrationLine:
    """Input quantity of the budget (GUM 8, EA-4/02): its relative contribution to κ and to J (1 sd)."""

    source: str
    standard_uncertainty_kg_m2: float
    distribution: str
    degrees_of_freedom: float
    of_factor: float
    of_inertia: float


@dataclass(frozen=True)
class FactorLine:
    """Input quantity of the budget of κ: its relative contribution to κ (1 sd)."""

    source: str
    distribution: str
    degrees_of_freedom: float
    of_factor: float


@dataclass(frozen=True)
class FittedPoint:
    """One run on the line. ``residual_kg_m2`` in the drive's unit, with the standard uncertainty of the point."""

    added_kg_m2: float
    reported_kg_m2: float
    standard_uncertainty_kg_m2: float
    fitted_kg_m2: float
    residual_kg_m2: float


@dataclass(frozen=True)
class TorqueCalibration:
    """Result: ``factor`` κ, true over reported torque; ``inertia_kg_m2``, true J without a body. Both None if refused.

    ``least_added_kg_m2``: inertia of a sufficient body, if the used body is too small; else None. ``line``: slope 1/κ
    and intercept J/κ with their covariance (2, 2) as rows, for the figure.
    """

    verdict: Verdict
    reason: str
    advice: str
    factor: MeasuredValue | None = None
    inertia_kg_m2: MeasuredValue | None = None
    budget: tuple[CalibrationLine, ...] = ()
    points: tuple[FittedPoint, ...] = ()
    linearity: ResidualTest | None = None
    sharing: ResidualTest | None = None
    least_added_kg_m2: float | None = None
    slope: float = math.nan
    intercept_kg_m2: float = math.nan
    line_covariance: tuple[tuple[float, ...], ...] = ()
    warnings: tuple[str, ...] = ()


def calibrate_torque(case: CalibrationCase) -> TorqueCalibration:
    """Return κ and J from the runs, or a refusal. Raises ValueError for fewer than two different bodies."""
    added = np.array([run.added_kg_m2 for run in case.runs])
    if len(added) < 2 or float(np.ptp(added)) <= 0.0:
        raise ValueError("two runs with different bodies are needed")
    line = _line(case, added)
    slope, intercept = float(line.beta[1]), float(line.beta[0])
    points = tuple(
        FittedPoint(float(b), float(y), float(math.sqrt(max(c, 0.0))), intercept + slope * float(b),
                    float(y) - intercept - slope * float(b))
        for b, y, c in zip(added, case.reported_kg_m2, np.diag(case.covariance), strict=True)
    )
    refused = TorqueCalibration(
        Verdict.NOT_IDENTIFIABLE, "", "", points=points, sharing=case.sharing, linearity=line.linearity, slope=slope,
        intercept_kg_m2=intercept, line_covariance=tuple(tuple(float(x) for x in row) for row in line.covariance))
    if slope <= 0.0:
        return replace(refused, reason=_falls(points), advice="give the log without the body first, and the inertia of"
                       " the body that was mounted")
    factor, inertia, budget = _propagated(case, line)
    least = _least(case, inertia)
    refused = replace(refused, budget=budget)
    if case.sharing is not None and case.sharing.p_value < CONTRADICTED_P:
        reason = ("the runs do not share the filters of the drive's reports"
                  f" (p = {case.sharing.p_value:.1g}){case.sharing_words}")
        return replace(refused, verdict=Verdict.MODEL_REJECTED, reason=reason, advice="repeat both runs with the same"
                       " drive, the same filters and gear, and a body that is bolted tight")
    if line.linearity is not None and line.linearity.p_value < CONTRADICTED_P:
        worst = max(points, key=lambda point: abs(point.residual_kg_m2))
        reason = ("the identified inertia is no straight line over the known one"
                  f" (p = {line.linearity.p_value:.1g}); the run with {worst.added_kg_m2:.4g} kg·m² is off by"
                  f" {worst.residual_kg_m2:+.2g} kg·m²")
        return replace(refused, verdict=Verdict.MODEL_REJECTED, reason=reason, advice="check the inertia of each body,"
                       " and whether it turned with the shaft; then repeat that run")
    assumed = student_quantile(case.confidence, CERTAIN) * case.scale_rel_sd
    if inertia.half_width_share > assumed:
        reason = (f"the body of {float(np.ptp(added)):.4g} kg·m² is too small: it would leave J at "
                  f"{printed_share(inertia.half_width_share)}, and the stated torque scale leaves "
                  f"±{100 * assumed:.1f} %")
        advice = "measure for longer, and state how well the body's inertia is known (--added-sd)"
        if least is not None:
            body = printed_bound(least, 3, up=True)
            advice = f"use a body of {body} kg·m² or more at the motor, or measure for longer"
        return replace(refused, reason=reason, advice=advice, least_added_kg_m2=least)
    impossible, warnings = compared(factor, case.scale_rel_sd, assumed, "the inertia of the body")
    if impossible:
        return replace(refused, verdict=Verdict.MODEL_REJECTED, advice=_shaft(case, factor.value), reason=impossible)
    reason = (f"the runs give κ to {printed_share(factor.half_width_share)} and J to "
              f"{printed_share(inertia.half_width_share)}")
    return replace(refused, verdict=Verdict.VALID, reason=reason, factor=factor, inertia_kg_m2=inertia,
                   warnings=warnings)


def compared(factor: MeasuredValue, scale_rel_sd: float, stated: float, reference: str) -> tuple[str, tuple[str, ...]]:
    """Return why κ is no error of a torque scale ('' if it can be one), and a warning if the stated scale excludes it.

    Warning: E_n = |κ − 1|/√(U_stated² + U_κ²) > 1 (ISO/IEC 17043). ``stated``: U_stated; ``reference``: what to check.
    """
    error, half = abs(factor.value - 1.0), 0.5 * (factor.high - factor.low)
    most = max(LARGEST_ERROR, LARGEST_IN_SD * scale_rel_sd) + half
    if error > most:
        return (f"the calibration factor would be {factor.value:.3g}: more than {100 * most:.0f} % from 1 is no error"
                " of a torque scale"), ()
    if error <= math.hypot(stated, half):
        return "", ()
    text = (f"the factor differs from 1 by {100.0 * error:.2g} %, and the stated torque scale allows"
            f" {printed_share(stated)}. Check {reference}, or the stated scale")
    return "", (CodedText(text, MessageCode.FACTOR_UNLIKE_SCALE),)


def _falls(points: Sequence[FittedPoint]) -> str:
    small, large = (pick(points, key=lambda point: point.added_kg_m2) for pick in (min, max))
    return (f"the identified inertia falls from {small.reported_kg_m2:.4g} to {large.reported_kg_m2:.4g} kg·m² with"
            f" {large.added_kg_m2 - small.added_kg_m2:.4g} kg·m² more on the shaft: the logs are exchanged, or the body"
            " was not mounted")


def _shaft(case: CalibrationCase, factor: float) -> str:
    square = case.gear_ratio**2
    if square > 1.0 + _LIKE_GEAR:
        for wrong, right, ratio in (("main", "motor", factor * square), ("motor", "main", factor / square)):
            if abs(ratio - 1.0) < _LIKE_GEAR:
                return (f"with the body at the {right} shaft it would be {ratio:.3g}: the inertia seems to have been"
                        f" given at the {wrong} shaft; use --at {right}")
    return ("check the inertia of the body and its shaft (--at motor or main); the body must be mounted in one run"
            " only, and must turn with the shaft")


# ---------------------------------------------------------------------------------------------------------------------
# Line, and the values derived from it.


@dataclass(frozen=True)
class _FittedLine:
    beta: FloatArray                   # intercept, slope
    by_reported: FloatArray            # ∂beta/∂y, (2, n); the derivative by the bodies is −slope times that
    covariance: FloatArray
    linearity: ResidualTest | None
    body_errors: dict[str, FloatArray]
    of_bodies: FloatArray              # their covariance, (n, n), (kg·m²)²


_ROUNDS, _ROUNDING = 10, 1e-6


def _body_errors(case: CalibrationCase) -> dict[str, FloatArray]:
    """Return the independent errors of the bodies by source: the standard uncertainty of each run's body, (n,), kg·m².

    The error of a body does not average out over its runs, nor the error that all bodies share over the bodies.
    """
    bodies = [run.body for run in case.runs]
    added, sd = (np.array(one) for one in zip(*bodies, strict=True))
    shared = float(np.min(sd[added > 0.0] / added[added > 0.0])) * added
    own = np.sqrt(np.maximum(sd**2 - shared**2, 0.0)) * (sd > shared * (1.0 + _ROUNDING))
    errors = [("bodies of " if len({body for body in bodies if body[0] > 0.0}) > 1 else "body of ", "", shared)]
    errors += [("body of ", ", own error", np.where([one == body for one in bodies], own, 0.0))
               for body in dict.fromkeys(bodies)]
    return {what + ", ".join(run.name for run, one in zip(case.runs, sds, strict=True) if one > 0.0) + which: sds
            for what, which, sds in errors if sds.any()}


def _line(case: CalibrationCase, added: FloatArray) -> _FittedLine:
    design = np.column_stack([np.ones_like(added), added])
    errors = _body_errors(case)
    bodies = sum((np.outer(sd, sd) for sd in errors.values()), np.zeros_like(case.covariance))
    slope = 1.0
    for _ in range(_ROUNDS):
        whole = case.covariance + slope**2 * bodies
        weighted = np.linalg.solve(whole, design)
        covariance = np.linalg.inv(design.T @ weighted)
        by = covariance @ weighted.T
        beta = by @ case.reported_kg_m2
        if abs(beta[1] - slope) <= 1e-12 * abs(slope):
            break
        slope = float(beta[1])
    left = case.reported_kg_m2 - design @ beta
    linearity = None
    if len(added) > 2:
        from scipy.special import chdtrc

        statistic, more = float(left @ np.linalg.solve(whole, left)), float(len(added) - 2)
        linearity = ResidualTest(statistic, more, float(chdtrc(more, statistic)))
    return _FittedLine(beta, by, covariance, linearity, errors, bodies)


def _propagated(
    case: CalibrationCase, line: _FittedLine
) -> tuple[MeasuredValue, MeasuredValue, tuple[CalibrationLine, ...]]:
    """Return κ, J, and the budget of both."""
    intercept, slope = line.beta
    factor, inertia = 1.0 / slope, intercept / slope
    of_factor = -(factor**2) * line.by_reported[1]
    of_inertia = factor * line.by_reported[0] - inertia * factor * line.by_reported[1]
    both = np.stack([of_factor / factor, of_inertia / inertia])           # relative, per kg·m² in the drive's unit
    lines = []
    known = np.diag(case.covariance_known)
    for k, run in enumerate(case.runs):
        sd = math.sqrt(max(float(known[k]), 0.0))
        lines.append(CalibrationLine(f"scatter of {run.name}", sd, "Student", case.degrees_of_freedom,
                                     *(abs(float(one)) * sd for one in both[:, k])))
    rest = case.covariance - np.diag(known)
    shared = [math.sqrt(max(float(one @ rest @ one), 0.0)) for one in both]
    scale = math.sqrt(max(float(np.trace(rest)) / len(case.runs), 0.0))
    lines.append(CalibrationLine("filters of the reports", scale, "Student", case.degrees_of_freedom, *shared))
    for source, sds in line.body_errors.items():
        lines.append(CalibrationLine(source, float(sds.max()), "normal", CERTAIN,
                                     *(abs(float(one @ sds)) * slope for one in both)))
    reading = case.reading_rel_sd
    if reading > 0.0:
        lines.append(CalibrationLine(
            "moment of reading", reading * float(intercept), "rectangular", CERTAIN, reading, 0.0))
    found, of_bodies = [], slope**2 * line.of_bodies
    for value, row, shared_sd in ((factor, both[0], reading), (inertia, both[1], 0.0)):
        runs, bodies = float(row @ case.covariance @ row), float(row @ of_bodies @ row) + shared_sd**2
        variance = runs + bodies
        dof = effective_degrees_of_freedom(((math.sqrt(runs), case.degrees_of_freedom), (math.sqrt(bodies), CERTAIN)))
        found.append(measured_value(float(value), math.sqrt(variance) * abs(float(value)), dof, case.confidence))
    return found[0], found[1], tuple(lines)


def effective_degrees_of_freedom(parts: Sequence[tuple[float, float]]) -> float:
    """Return the degrees of freedom by Welch and Satterthwaite (GUM G.2b), at most `CERTAIN`.

    ``parts``: pairs of standard uncertainty and its degrees of freedom. A part with `CERTAIN` counts as infinite and
    drops out of the sum.
    """
    variance = sum(sd**2 for sd, _ in parts)
    uncertain = sum(sd**4 / dof for sd, dof in parts if dof < CERTAIN)
    return min(variance**2 / uncertain, CERTAIN) if uncertain > variance**2 / CERTAIN else CERTAIN


def measured_value(value: float, standard_uncertainty: float, dof: float, confidence: float) -> MeasuredValue:
    """Return the value with its interval by Student's quantile."""
    k = student_quantile(confidence, dof)
    half = k * standard_uncertainty
    return MeasuredValue(value, standard_uncertainty, dof, k, value - half, value + half)


def _least(case: CalibrationCase, inertia: MeasuredValue) -> float | None:
    """Return the body, kg·m², for which J is as certain as with the stated scale; None if no body is sufficient.

    For two runs: half-width = (1 + J/b) w, with w, the half-width of the difference of the runs' relative errors.
    """
    body = max(run.added_kg_m2 for run in case.runs) - min(run.added_kg_m2 for run in case.runs)
    w = inertia.half_width_share / (1.0 + inertia.value / body) if inertia.value > 0.0 else math.inf
    wanted = student_quantile(case.confidence, CERTAIN) * case.scale_rel_sd
    return inertia.value / (wanted / w - 1.0) if w < wanted else None


# ---------------------------------------------------------------------------------------------------------------------
# Plan before a calibration: size of the body, and duration of the runs.


_SIZES = (0.1, 0.2, 0.3, 0.5, 0.75, 1.0, 1.5, 2.0)
"""Bodies of a plan, as shares of J."""


@dataclass(frozen=True)
class RunPlan:
    """Relative half-width of J after two runs like the present one, with a body of ``added_kg_m2`` at the motor shaft.

    ``minutes``: duration of stage 5 in each of two runs for the requested uncertainty of J; None if no duration is
    sufficient.
    """

    added_kg_m2: float
    half_width_share: float
    minutes: float | None


_LONGEST_MIN = 24.0 * 60.0


def plan_bodies(
    inertia_kg_m2: float, noise_share: float, minutes: float, wanted: float, added_sd_share: float, *,
    confidence: float = 0.95, sizes: Sequence[float] = (),
) -> tuple[RunPlan, ...]:
    """Plan two runs with each body. ``noise_share``: relative standard uncertainty of J of a run of ``minutes``.

    ``added_sd_share``: relative standard uncertainty of the body's inertia. ``noise_share`` is for known filters.
    ``sizes``: bodies, kg·m²; default: shares of J.
    """
    k = student_quantile(confidence, CERTAIN)
    plans = []
    for body in sizes or [share * inertia_kg_m2 for share in _SIZES]:
        runs = math.sqrt(2.0) * (1.0 + inertia_kg_m2 / body) * noise_share * k
        fixed = k * added_sd_share
        left = wanted**2 - fixed**2
        needed = minutes * runs**2 / left if left > 0.0 else math.inf
        plans.append(RunPlan(body, math.hypot(runs, fixed), needed if needed <= _LONGEST_MIN else None))
    return tuple(plans)

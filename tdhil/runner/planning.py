"""The plan of stage 5 and of its end: from the request and the results of stages 2 and 3. Pure.

Without a tolerance the motion is planned for a fixed time. With one, a pilot is planned from the expected noise, and
its scatter decides everything after it (`design.stopping_rule`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from typing import Any

from tdhil.config import OPTION
from tdhil.estimation import SAMPLED_SHARE, aliased, least_samples, too_few_a_period
from tdhil.runner.design import (
    MARGIN,
    SOON_COUNTED,
    Choice,
    DesignKnowledge,
    Evidence,
    Stopping,
    choose,
    choose_soonest,
    expected_half_width,
    half_width,
    interval_confidence,
    least_scale,
    longer,
    predicted,
    refuse_unfit,
)
from tdhil.runner.excitation import (
    LEAST_COUNTED,
    MotionLimits,
    PeriodicKind,
    Plan,
    PlanRefused,
    PlanRequest,
    RigGuess,
    SpeedChangeKind,
    SpeedChangePlan,
    excitation_kind,
    fit_following,
    held_back_to,
    make_plan,
    periodic_kind,
    plan_speed_changes,
)
from tdhil.runner.settings import ExcitationRequest
from tdhil.runner.stages import RampCourse, reference_plan

NOT_PREDICTED = "the width of the interval of J is not predicted for this motion; it follows from the recording"
NOTHING_TO_EXPECT = "no interval of J is expected: this motion can't separate the inertia from lags and friction"
_PILOT_SHARE = 0.6        # of the expected periods: the pilot's scatter decides about the rest
_EVER = 1000.0            # factor on the duration: an uncertainty that remains with it can't be reduced by time


@dataclass(frozen=True)
class Planned:
    """The plan (with a stopping rule: its pilot), and the expected relative half-width of J at the end.

    The half-width is infinite if no interval is expected, and NaN if it is not predicted.
    """

    plan: Plan | SpeedChangePlan
    known: DesignKnowledge
    half_width: float
    usual_half_width: float
    stopping: Stopping | None = None
    duration_s: float = 0.0

    def said(self) -> str:
        """Return one line for the display."""
        if not math.isfinite(self.half_width):
            return NOT_PREDICTED if math.isnan(self.half_width) else NOTHING_TO_EXPECT
        noise = f"noise {self.known.noise.source}"
        share = f"±{100.0 * self.half_width:.2g} %"
        expected = f"expected interval of J: {share} after {self.duration_s:.0f} s (repeatability; {noise})"
        if self.stopping is None or self.stopping.reachable:
            return expected
        return f"±{100.0 * self.stopping.tolerance:.3g} % can't be reached: {self.stopping.advice}; {expected}"

    def plain(self) -> dict[str, Any]:
        """Return it as plain data for the run's configuration."""
        return {
            "expected_half_width": _finite(self.half_width),
            "usual_half_width": _finite(self.usual_half_width),
            "duration_s": self.duration_s,
            "noise": asdict(self.known.noise),
            "guess": asdict(self.plan.guess),
        }


def request_of(request: ExcitationRequest, mode: str) -> PlanRequest:
    """Return the request for a periodic plan. Raises PlanRefused if it is not periodic."""
    periodic_kind(request.kind)
    return PlanRequest(
        kind=request.kind,
        mode="speed" if mode == "speed" else "torque",
        frequency_hz=request.frequency_hz,
        amplitude_rad_s=request.amplitude_rad_s,
        offsets_rad_s=None if request.offset_rad_s is None else (request.offset_rad_s,),
        periods=request.periods,
        realisations=request.realisations,
    )


def adaptive(request: ExcitationRequest) -> bool:
    """Return whether the scatter decides the end of stage 5. False with given periods or with one frequency."""
    return request.tolerance is not None and request.periods is None and excitation_kind(request.kind).adaptive


def as_followed(
    guess: RigGuess, limits: MotionLimits, course: RampCourse, speed_lag_s: float
) -> tuple[RigGuess, MotionLimits]:
    """Return rig and limits with the effect of the drive's own speed control, from the ramp of stage 2."""
    signals = course.time_s, course.setpoint_rad_s, course.reported_rad_s
    ramp = held_back_to(*signals)
    following = fit_following(*signals, speed_lag_s, math.inf if ramp is None else ramp)
    within = limits if ramp is None else replace(limits, acceleration_rad_s2=ramp)
    return replace(guess, following=following), within


def plan_acquisition(
    request: ExcitationRequest, mode: str, limits: MotionLimits, guess: RigGuess, known: DesignKnowledge, left_s: float
) -> Planned:
    """Plan stage 5; ``left_s`` remains of the run's time limit. Raises PlanRefused with the reason."""
    if isinstance(excitation_kind(request.kind), SpeedChangeKind):
        return _swings(request, mode, limits, guess, known, left_s)
    wish = request_of(request, mode)
    if request.impedance is not None:
        return _reference(request, limits, guess, wish, known, left_s)
    allowed_s = left_s if request.max_time_s is None else min(left_s, request.max_time_s)
    if not adaptive(request):
        chosen = choose(limits, guess, wish, known, request.confidence, request.max_time_s)
        if (usual_s := chosen.plan.duration_s) > left_s:
            with suppress(PlanRefused):
                chosen = choose(limits, guess, wish, known, request.confidence, left_s)
        if chosen.plan.duration_s > left_s:
            raise PlanRefused(
                f"time: stage 5 takes {usual_s:.0f} s, and {max(0.0, left_s):.0f} s are left of limits.time_s",
                "Raise limits.time_s in rig.yaml, or lower --periods or --max-time")
        return Planned(chosen.plan, known, chosen.half_width, chosen.usual_half_width, None, chosen.plan.duration_s)
    chosen = choose(limits, guess, wish, known, request.confidence)
    if chosen.plan.duration_s > allowed_s:
        chosen = choose(limits, guess, wish, known, request.confidence, allowed_s)
    planned = _with_pilot(request, chosen, known, allowed_s)
    assert request.tolerance is not None
    working = interval_confidence(request.confidence, pilot_dof(chosen.plan.with_counted(min(SOON_COUNTED))), 0)
    soonest = choose_soonest(limits, guess, wish, known, working, request.tolerance / MARGIN, allowed_s)
    if soonest is None:
        return planned
    sooner = _with_pilot(request, replace(chosen, plan=soonest), known, allowed_s, soonest.counted)
    return sooner if sooner.stopping is not None and sooner.stopping.reachable else planned


def refuse_undersampled(request: ExcitationRequest, rate_hz: float) -> None:
    """Raise PlanRefused if samples at the cycle rate can't show the requested spectral lines.

    The rule is the identification's own (`tdhil.estimation.aliased`). Lines that the design chooses are low.
    """
    kind = excitation_kind(request.kind)
    if not isinstance(kind, PeriodicKind) or request.frequency_hz is None or request.impedance is not None:
        return
    harmonics, lowest_hz = kind.shape().harmonics, request.frequency_hz
    highest_hz = harmonics[-1] * lowest_hz
    most_hz = min(SAMPLED_SHARE * rate_hz / harmonics[-1], rate_hz / least_samples(len(harmonics)))
    cure = f"Set --frequency below {most_hz:.3g} Hz, or leave it out"
    if aliased(highest_hz, 1.0 / rate_hz):
        raise PlanRefused(
            f"aliasing: the highest spectral line is {highest_hz:.10g} Hz, and {rate_hz:.4g} cycles per second show"
            f" lines below {SAMPLED_SHARE * rate_hz:.3g} Hz", cure,
        )
    if too_few_a_period(len(harmonics), 1.0 / lowest_hz, 1.0 / rate_hz):
        raise PlanRefused(
            f"{rate_hz / lowest_hz:.3g} samples a period are too few for the {len(harmonics)} spectral lines", cure
        )


_FIXED = ("frequency_hz", "amplitude_rad_s", "offset_rad_s", "periods")
"""Options of a motion that tdhil does not change if the user sets them."""


def refuse_uninformative(
    request: ExcitationRequest, modes: tuple[str, ...], limits: MotionLimits, guess: RigGuess, known: DesignKnowledge
) -> None:
    """Raise PlanRefused if no interval of J is expected on any rig of `RIGS` in any of ``modes``.

    A tone is not refused: the acceleration regression (Xu 2026) uses one, and the user has named it.
    """
    kind = excitation_kind(request.kind)
    if not isinstance(kind, PeriodicKind) or len(kind.shape().harmonics) < 2 or request.impedance is not None:
        return
    named = [OPTION[name].flag for name in _FIXED if getattr(request, name) is not None]
    if not named or known.has_drill_string:
        return
    for rig in _rigs(guess, limits):
        for mode in modes:
            if _informs(replace(request, tolerance=None), mode, limits, rig, known):
                return
    raise PlanRefused(NOTHING_TO_EXPECT, f"Leave out {' and '.join(named)}: tdhil then chooses a motion that can")


@lru_cache(maxsize=32)      # a prediction takes half a second, and a worker process refuses for the same rig again
def _informs(
    request: ExcitationRequest, mode: str, limits: MotionLimits, guess: RigGuess, known: DesignKnowledge
) -> bool:
    """Return whether an interval of J is expected on this rig. The usual motion is predicted first: that is quick."""
    try:
        usual = make_plan(limits, guess, request_of(request, mode))
        width = expected_half_width(usual, known.theta(guess), known.noise, known.prior, request.confidence)
        if math.isinf(width):
            width = plan_acquisition(request, mode, limits, guess, known, math.inf).half_width
    except PlanRefused:
        return False
    return not math.isinf(width)


RIGS = ((1.0, 1.0), (0.1, 0.5), (0.01, 0.0), (1.0, 0.0), (10.0, 0.0))
"""Shares of the assumed inertia and friction: a motion that fits none of these rigs fits no other."""


def refuse_hopeless(
    request: ExcitationRequest, modes: tuple[str, ...], limits: MotionLimits, guess: RigGuess, known: DesignKnowledge
) -> None:
    """Raise PlanRefused, before motion, if the requested motion fits no rig in any of ``modes``.

    The message refers to the assumed rig. Everything that depends on the rig is planned once it is known.
    """
    first: PlanRefused | None = None
    swings = isinstance(excitation_kind(request.kind), SpeedChangeKind)
    for rig in _rigs(guess, limits):
        for mode in modes:
            try:
                if swings:
                    plan_acquisition(request, mode, limits, rig, known, math.inf)
                else:
                    refuse_unfit(limits, rig, request_of(request, mode), known, request.max_time_s)
                return
            except PlanRefused as error:
                first = first or error
    if first is not None:
        raise first


def _rigs(guess: RigGuess, limits: MotionLimits) -> Iterator[RigGuess]:
    for inertia, friction in RIGS:
        yield replace(
            guess, inertia_kg_m2=inertia * guess.inertia_kg_m2, viscous_nm_s_rad=friction * guess.viscous_nm_s_rad,
            coulomb_nm=max(friction * guess.coulomb_nm, 1e-3 * limits.torque_limit_nm),
        )


def _reference(
    request: ExcitationRequest, limits: MotionLimits, guess: RigGuess, wish: PlanRequest, known: DesignKnowledge,
    left_s: float,
) -> Planned:
    """Plan the speed reference for the measurement of the drive's own impedance."""
    if request.impedance != "reference":
        raise PlanRefused(
            "with the torque offset the motion is planned in stage 4, from the response to a small offset",
            "Remove --dry-run",
        )
    plan = reference_plan(limits, guess, wish)
    if plan.duration_s > left_s:
        raise PlanRefused(
            f"time: the motion takes {plan.duration_s:.0f} s, and {max(left_s, 0.0):.0f} s are left",
            "Raise limits.time_s in rig.yaml, or request fewer --periods",
        )
    return Planned(plan, known, math.nan, math.nan, None, plan.duration_s)


def _swings(
    request: ExcitationRequest,
    mode: str,
    limits: MotionLimits,
    guess: RigGuess,
    known: DesignKnowledge,
    left_s: float,
) -> Planned:
    """Plan changes of speed. They have no spectral lines to predict and no periods for a stopping rule."""
    if request.frequency_hz is not None:
        raise PlanRefused(
            f"{request.kind} has no frequency; use --amplitude, --offset, --periods or --max-time",
            "Remove --frequency",
        )
    plan = plan_speed_changes(
        request.kind,
        limits,
        guess,
        "speed" if mode == "speed" else "torque",
        request.amplitude_rad_s,
        request.offset_rad_s,
        request.periods,
        request.max_time_s,
    )
    if plan.duration_s > left_s:
        raise PlanRefused(
            f"time: {request.kind} takes {plan.duration_s:.0f} s, and {max(left_s, 0.0):.0f} s are left",
            "Raise limits.time_s in rig.yaml, or lower --periods or --max-time",
        )
    return Planned(plan, known, math.nan, math.nan, None, plan.duration_s)


def _with_pilot(
    request: ExcitationRequest, chosen: Choice, known: DesignKnowledge, allowed_s: float, fewest: int = LEAST_COUNTED
) -> Planned:
    """Plan the pilot: most of the expected periods, and enough to know the scatter."""
    assert request.tolerance is not None
    if math.isnan(chosen.half_width):     # a string: the scatter of a rigid shaft gives no prediction for it
        plan = chosen.plan
        stopping = Stopping(
            request.tolerance, request.confidence, pilot_dof(plan), plan.counted, plan.counted, allowed_s, True,
            by_interval=True,
        )
        return Planned(plan, known, math.nan, math.nan, stopping, plan.duration_s)
    theta = known.theta(chosen.plan.guess)
    least = chosen.plan.with_counted(fewest)
    evidence = predicted(least, theta, known.noise, known.prior)
    working = interval_confidence(request.confidence, pilot_dof(least), 0)
    most = max(fewest, counted_in(chosen.plan, allowed_s))
    scale, half, enough = least_scale(
        lambda times: half_width(longer(evidence, times), working), request.tolerance / MARGIN, most / fewest
    )
    periods = min(most, math.ceil(scale * fewest - 1e-6))
    pilot = max(fewest, math.floor(_PILOT_SHARE * periods))
    plan = chosen.plan.with_counted(pilot)
    stopping = Stopping(
        tolerance=request.tolerance,
        confidence=request.confidence,
        pilot_dof=pilot_dof(plan),
        pilot_periods=pilot,
        expected_periods=periods,
        allowed_s=allowed_s,
        reachable=enough,
        advice="" if enough else _advice(evidence, working, request.tolerance, known),
    )
    after_pilot = plan.extension_s(periods - pilot) if periods > pilot else 0.0
    return Planned(plan, known, half, chosen.usual_half_width, stopping, plan.duration_s + after_pilot)


def pilot_dof(plan: Plan) -> float:
    """Return the degrees of freedom of a line's variance: two per period except the first of each segment."""
    return 2.0 * sum(segment.periods - segment.settle_periods - 1 for segment in plan.segments)


def counted_in(plan: Plan, time_s: float) -> int:
    """Return the evaluated periods per mean speed that fit into a time, with a pilot and one extension."""
    period = sum(one.reference.period_s for one in plan.segments)
    return math.floor((time_s - plan.with_counted(0).duration_s - plan.extension_s(0)) / period + 1e-9)


def _advice(evidence: Evidence, confidence: float, tolerance: float, known: DesignKnowledge) -> str:
    """Return advice how to reach the tolerance."""
    ever = half_width(longer(evidence, _EVER), confidence)
    if ever > tolerance:
        lags = "state the drive's filters on reported speed and torque (drive_data in rig.yaml)"
        known_lags = known.prior.speed_lag_s is not None and known.prior.torque_lag_s is not None
        what = "state them more exactly" if known_lags else lags
        return f"the lags leave ±{100.0 * ever:.2g} % for any duration; {what}, or set both filters equal"
    return "allow more time (--max-time, limits.time_s), a wider speed window or more torque"


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None

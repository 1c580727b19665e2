"""The plan of a run before it starts, for the assumed rig. Nothing is connected and nothing moves."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

from drivers import PreflightRefused
from profiles import MessageCode
from tdhil.config import Rig, RunOptions
from tdhil.session.task import bench_of, excitation_request, lag_prior, machine_limits
from tdhil.version import __version__

if TYPE_CHECKING:

    from profiles import Profile
    from tdhil.runner import DesignKnowledge, MachineLimits, Planned, excitation
    from tdhil.runner.excitation import RigGuess
    from tdhil.soft_torque import EvaluationCase, SpeedProgram
    from tdhil.speed_loop import StepCase, StepProgram


SPIN_UP_S = 2.5             # assumed J: time in which the torque limit passes the speed window
VISCOUS_SHARE = 0.2         # assumed friction at the highest speed, as a share of the torque limit
COULOMB_SHARE = 0.15        # assumed friction at standstill, as a share of the torque limit
BEFORE_ACQUIRE_S = 90.0     # approximate duration of stages 1 to 4


@dataclass(frozen=True)
class Figure:
    """One value that the plan uses. ``source``: assumed, or its place in rig.yaml."""

    name: str
    value: float
    unit: str
    source: str

    @property
    def text(self) -> str:
        return f"{float(f'{self.value:.4g}'):g} {self.unit}"


def plan_dry(
    options: RunOptions, rig: Rig | None, simulated: bool, profile: Profile
) -> tuple[Planned, tuple[Figure, ...], MachineLimits]:
    """Return the plan, the values that it uses, and the machine's limits.

    Raises PreflightRefused as a run would: no motion fits, or none that was requested can determine J.
    """
    from tdhil.runner import plan_acquisition, refuse_by_plan
    from tdhil.runner.excitation import PlanRefused

    bench = bench_of(simulated, rig, options.highest_speed_rad_s)
    limits = machine_limits(bench)
    # A quick stop that ends with the drive off releases a string.
    refuse_by_plan(limits, excitation_request(options), profile.quick_stop.ends == "off")
    _refuse_undersampled(options, profile)
    guess, known, figures = _assumed(bench, limits)
    left_s = limits.time_s - BEFORE_ACQUIRE_S
    mode, room = _mode(options, _can_torque(profile, limits)), _room(options, limits)
    try:
        planned = plan_acquisition(excitation_request(options), mode, room, guess, known, left_s)
    except PlanRefused as error:
        raise PreflightRefused(
            str(error), where="plan of stage 5", next_step=error.next_step,
            entry=MessageCode.PLAN_NOT_POSSIBLE,
        ) from error
    if math.isinf(planned.half_width):
        _refuse_uninformative(options, (mode,), room, guess, known, profile)
    return planned, figures, limits


def plan_course(
    case: EvaluationCase, rig: Rig | None, simulated: bool, rate_hz: float, highest_speed_rad_s: float | None = None
) -> tuple[SpeedProgram, MachineLimits]:
    """Return the speed program of a virtual string, and the machine's limits. Raises an error if they do not fit."""
    from tdhil.runner import ControlAssumptions, Guard, course_of

    limits = machine_limits(bench_of(simulated, rig, highest_speed_rad_s))
    assumptions = ControlAssumptions().at_period(1.0 / rate_hz)
    return course_of(case, limits, 1.0 / rate_hz, Guard.foresight_s(assumptions)), limits


def plan_dry_steps(
    case: StepCase, rig: Rig | None, simulated: bool, rate_hz: float, highest_speed_rad_s: float | None = None
) -> tuple[StepProgram, MachineLimits]:
    """Return the largest steps of a verification, and the machine's limits. Raises an error if they do not fit.

    Friction is that of the tuning. The resolution of the reported speed is not known before the run.
    """
    from tdhil.runner import plan_steps_before

    limits = machine_limits(bench_of(simulated, rig, highest_speed_rad_s))
    return plan_steps_before(case, limits, 1.0 / rate_hz, 0.0), limits


def plan_document(planned: Planned, figures: tuple[Figure, ...], limits: MachineLimits) -> dict[str, Any]:
    """Return the plan as plain data."""
    plan, stopping = planned.plan, planned.stopping
    return {
        "dry_run": True,
        "excitation": plan.kind,
        "mode": plan.mode,
        **plan.plain(),
        "duration_s": planned.duration_s,
        "speed_rad_s": {"min": plan.speed_min_rad_s, "max": plan.speed_max_rad_s},
        "torque_nm": {"min": plan.torque_min_nm, "max": plan.torque_max_nm},
        "limits": {
            "speed_min_rad_s": limits.speed_min_rad_s,
            "speed_max_rad_s": limits.speed_max_rad_s,
            "torque_nm": limits.torque_nm,
            "time_s": limits.time_s,
        },
        "rests_on": [asdict(figure) for figure in figures],
        "expected_half_width": planned.half_width if math.isfinite(planned.half_width) else None,
        "stopping": None if stopping is None else stopping.plain(),
        "tdhil": __version__,
    }


def refuse_hopeless(options: RunOptions, rig: Rig | None, profile: Profile) -> None:
    """Raise PreflightRefused, before the run touches its drive, if no shaft could do it within the limits.

    The same holds for a motion that can't determine J: the cycle rate is too low for its spectral lines, or no interval
    is expected.

    At this point tdhil knows neither the shaft nor whether it is simulated. A simulated rig needs no limits.
    """
    from tdhil.runner import refuse_hopeless as refuse_hopeless_plan
    from tdhil.runner.excitation import PlanRefused

    bench = bench_of(True, rig, options.highest_speed_rad_s)
    limits = machine_limits(bench)
    modes = (options.mode,) if options.mode else ("torque", "speed") if _can_torque(profile, limits) else ("speed",)
    guess, known, _ = _assumed(bench, limits)
    room = _room(options, limits)
    _refuse_undersampled(options, profile)
    try:
        wish = excitation_request(options)
        wish = replace(wish, max_time_s=min(wish.max_time_s or math.inf, limits.time_s))
        refuse_hopeless_plan(wish, modes, room, guess, known)
    except PlanRefused as error:
        raise PreflightRefused(str(error), where="plan of stage 5", next_step=error.next_step,
                               entry=MessageCode.PLAN_NOT_POSSIBLE) from error
    _refuse_uninformative(options, modes, room, guess, known, profile)


def _refuse_undersampled(options: RunOptions, profile: Profile) -> None:
    from tdhil.runner import refuse_undersampled
    from tdhil.runner.excitation import PlanRefused

    try:
        refuse_undersampled(excitation_request(options), options.rate_hz or profile.usual_rate_hz)
    except PlanRefused as error:
        raise _hopeless(error) from error


def _refuse_uninformative(
    options: RunOptions, modes: tuple[str, ...], room: excitation.MotionLimits, guess: RigGuess,
    known: DesignKnowledge, profile: Profile,
) -> None:
    """Refuse a motion from which no interval is expected, even with the filters that the drive may report."""
    from tdhil.runner import refuse_uninformative
    from tdhil.runner.excitation import PlanRefused

    if profile.filters:
        prior = known.prior
        known = replace(known, prior=replace(prior, speed_lag_s=known.speed_lag_s, torque_lag_s=known.torque_lag_s))
    try:
        refuse_uninformative(excitation_request(options), modes, room, guess, known)
    except PlanRefused as error:
        raise _hopeless(error) from error


def _hopeless(error: excitation.PlanRefused) -> PreflightRefused:
    return PreflightRefused(str(error), where="plan of stage 5", next_step=error.next_step,
                            entry=MessageCode.PLAN_HOPELESS)


def _can_torque(profile: Profile, limits: MachineLimits) -> bool:
    """Return whether a run may use torque mode: the rule of `choose_mode`, before the drive is known."""
    from tdhil.runner import stops_from_torque_mode

    return profile.can_torque and stops_from_torque_mode(limits, profile.quick_stop.decelerates_in_torque_mode)


def _mode(options: RunOptions, can_torque: bool) -> str:
    wanted: str | None = options.mode
    if wanted == "torque" and not can_torque:
        raise PreflightRefused(
            "torque mode is requested, but this drive can't enter a torque mode while the shaft turns, or can't be"
            " stopped from it above a string",
            where=f"profile {options.profile}",
            next_step="Use --mode speed",
            entry=MessageCode.NO_TORQUE_MODE,
        )
    return wanted or ("torque" if can_torque else "speed")


def _room(options: RunOptions, limits: MachineLimits) -> excitation.MotionLimits:
    """Return the part of the limits that a plan may use at the requested rate."""
    from tdhil.runner import ControlAssumptions, Guard

    assumptions = ControlAssumptions()
    if options.rate_hz:
        assumptions = assumptions.at_period(1.0 / options.rate_hz)
    return Guard.room(limits, assumptions)


def _assumed(bench: Rig, limits: MachineLimits) -> tuple[RigGuess, DesignKnowledge, tuple[Figure, ...]]:
    """Return the assumed rig, its noise and its lags, with the source of each."""
    from tdhil.runner import DesignKnowledge, assumed_noise

    guess, figures = _guess(bench, limits)
    stated = bench.expected.load_noise_nm
    noise = assumed_noise(limits.torque_nm, limits.speed_max_rad_s, stated)
    known = DesignKnowledge(noise, lag_prior(bench), limits.has_drill_string)
    return guess, known, (
        *figures,
        Figure("disturbing torque (sd)", noise.load_sd_nm, "N·m", _source(bench, "expected.load_noise_nm")),
        Figure("lag of the reported speed", known.speed_lag_s, "s", _source(bench, "drive_data.speed_lag_s")),
        Figure("lag of the reported torque", known.torque_lag_s, "s", _source(bench, "drive_data.torque_lag_s")),
    )


def _guess(bench: Rig, limits: MachineLimits) -> tuple[RigGuess, tuple[Figure, ...]]:
    """Return the shaft that rig.yaml expects. Missing values describe a shaft that suits its drive."""
    from tdhil.runner.excitation import RigGuess

    expected = bench.expected
    window = limits.speed_max_rad_s - limits.speed_min_rad_s
    inertia = expected.inertia_kg_m2 or SPIN_UP_S * limits.torque_nm / window
    viscous, coulomb = expected.viscous_nm_s_rad, expected.coulomb_nm
    viscous = VISCOUS_SHARE * limits.torque_nm / limits.speed_max_rad_s if viscous is None else viscous
    coulomb = COULOMB_SHARE * limits.torque_nm if coulomb is None else coulomb
    return RigGuess(inertia, viscous, coulomb), (
        Figure("moment of inertia", inertia, "kg·m²", _source(bench, "expected.inertia_kg_m2")),
        Figure("viscous friction", viscous, "N·m·s/rad", _source(bench, "expected.viscous_nm_s_rad")),
        Figure("Coulomb friction", coulomb, "N·m", _source(bench, "expected.coulomb_nm")),
    )


def _source(bench: Rig, at: str) -> str:
    return "assumed" if bench.get(at) is None else bench.source(at) or "rig.yaml"

"""Choice of the excitation: of about a dozen candidates, the one with the narrowest interval of J in the given time.

Values that the user sets stay fixed: `make_plan` follows every request exactly, and a refused plan is no candidate.
The usual multisine is always a candidate, and only a clearly better one replaces it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from tdhil.config import identified_before_echo
from tdhil.estimation.frequency_domain import (
    AVERAGE,
    LAG_BOUND_S,
    SHAPE_BOUND,
    SKEW,
    SPEED_LAG,
    SPEED_SHAPE,
    TORQUE_LAG,
    TORQUE_SHAPE,
    VISCOUS,
)
from tdhil.recording import FloatArray, LagPrior
from tdhil.runner.design.prediction import (
    RIGID,
    SPEED_LAG_S,
    TORQUE_LAG_S,
    NoiseDensity,
    assumed_theta,
    expected_half_width,
    predicted,
    safe_half_width,
)
from tdhil.runner.excitation import (
    LEAST_COUNTED,
    DriveMode,
    MotionLimits,
    Plan,
    PlanRefused,
    PlanRequest,
    RigGuess,
    Shape,
    make_plan,
    periodic_kind,
    settling_periods,
    unit_peak,
)

# ---------------------------------------------------------------------------------------------------------------------
# A quick figure for the search: the Cramér-Rao bound of J, with an unknown structure of the lags.
#
# It uses the lines' information about the rigid model's theta = (J, B; τ_w, ρ_w, τ_T, ρ_T, u, d). The last six are the
# family of `signal_filters`: first-order lags, two poles, moving averages, delays. Shapes ρ and averages u are bounded;
# here they count as known to about their bounds. So a high line adds little: most of its information is used up by the
# structure of the lags.


_SKEW_SD_S = 0.3          # s; standard uncertainty of the time offset between speed and torque in this bound
_AVERAGE_SHARE = 4.0       # u of an average that delays as long as the longest lag τ: (2 τ)²
_CERTAIN = 1e-4
"""Least standard uncertainty of a known lag, s, and of its shape: a bound of zero has no inverse."""


def relative_sd(plan: Plan, theta: FloatArray, noise: NoiseDensity, prior: LagPrior) -> float:
    """Return the least standard deviation of J after the plan, as a share of J; infinite if J is not identifiable."""
    first = plan.segments[0]
    period = first.reference.period_s
    hertz = np.array(first.reference.lines_hz)
    s = 2j * np.pi * hertz.astype(np.complex128)
    _, columns = RIGID.impedance_jacobian(theta, s)
    variance = 4.0 * noise.error_density(hertz, theta) / period
    counts = np.array([segment.periods - segment.settle_periods for segment in plan.segments], dtype=np.float64)
    nu = float(np.sum(counts - 1.0))
    if nu < 2.0:
        return math.inf
    amplitudes = np.array([segment.reference.amplitudes_rad_s for segment in plan.segments])
    seen = amplitudes * np.abs(plan.followed(hertz) / (1.0 + s * theta[RIGID.at(SPEED_LAG)]))
    weight = 2.0 * (counts @ seen**2) / variance * (nu - 1.0) / nu
    fisher = np.einsum("k,ki,kj->ij", weight, columns.conj(), columns).real
    fisher[VISCOUS, VISCOUS] += _tie(plan, counts * period, float(noise.error_density(np.zeros(1), theta)[0]))
    for index, sd in _known(theta, prior).items():
        fisher[RIGID.at(index), RIGID.at(index)] += sd**-2.0
    scale = 1.0 / np.sqrt(np.maximum(np.diag(fisher), 1e-300))
    try:
        bound = float(np.linalg.inv(fisher * np.outer(scale, scale))[0, 0])
    except np.linalg.LinAlgError:
        return math.inf
    return math.sqrt(bound) * float(scale[0]) / float(theta[0]) if bound > 0.0 else math.inf


def _tie(plan: Plan, durations: FloatArray, density: float) -> float:
    """Return 1/sd² of B from the mean torque at the mean speeds."""
    speeds = np.array([segment.reference.offset_rad_s for segment in plan.segments])
    centred = speeds - np.sum(durations * speeds) / np.sum(durations)
    return float(np.sum(durations * centred**2) / density)


def _known(theta: FloatArray, prior: LagPrior) -> dict[int, float]:
    """Return the prior standard deviations of the reporting parameters: stated, or about the bounds of the fit."""
    lags = theta[[RIGID.at(SPEED_LAG), RIGID.at(TORQUE_LAG)]]
    longest = max(float(np.max(lags)), 1e-3)
    speed, torque = prior.speed_lag_s is not None, prior.torque_lag_s is not None
    return {
        SPEED_LAG: max(prior.speed_lag_sd_s, _CERTAIN) if speed else LAG_BOUND_S,
        SPEED_SHAPE: _CERTAIN if speed else SHAPE_BOUND,
        TORQUE_LAG: max(prior.torque_lag_sd_s, _CERTAIN) if torque else LAG_BOUND_S,
        TORQUE_SHAPE: _CERTAIN if torque else SHAPE_BOUND,
        AVERAGE: _CERTAIN**2 if speed and torque else _AVERAGE_SHARE * longest**2,
        SKEW: _SKEW_SD_S,
    }


# ---------------------------------------------------------------------------------------------------------------------
# Candidate multisines: their lines and amplitudes, and the phases that permit the largest motion within the limits.


HIGHEST_TURN = 0.24    # highest line as a share of 1/τ, Hz; τ is the longest plausible lag
LINES_LIMIT_HZ = (0.1, 2.0)
"""Bounds of the highest line, Hz: a lower one would take an hour, a higher one would show structure and backlash."""

SLOPES = (1.0, 1.5, 2.0)                               # amplitude ~ harmonic^−slope
_HARMONICS = ((1, 2, 3, 4), (1, 2, 3, 5), (1, 2, 3, 4, 5), (1, 2, 3, 4, 6), (1, 2, 3, 4, 5, 6), (1, 3, 5, 7, 9))
"""Sets of excited lines that are tried, multiples of the lowest one."""
_REACHES = (0.8, 1.0)                                  # shares of the highest permitted line
_GRID = 128               # points of a period on which the peaks of a candidate are searched
_TURN = 2.0 * np.pi * np.arange(_GRID) / _GRID
_POPULATION, _KEPT, _ROUNDS, _STEP_RAD = 96, 6, 5, 0.8   # search for phases: candidates, survivors, rounds, step in rad


@dataclass(frozen=True)
class Proposal:
    """Proposed lines: lowest frequency and harmonics, with amplitudes ~ harmonic^−slope."""

    lowest_hz: float
    harmonics: tuple[int, ...]
    slope: float

    @property
    def amplitudes(self) -> tuple[float, ...]:
        """Return the amplitudes relative to the first line's."""
        return tuple(float(harmonic) ** -self.slope for harmonic in self.harmonics)


def highest_line_hz(longest_lag_s: float) -> float:
    """Return the highest useful frequency, Hz. Above about 1/(4 τ) the structure of a lag τ has too much effect."""
    return float(np.clip(HIGHEST_TURN / max(longest_lag_s, 1e-3), *LINES_LIMIT_HZ))


def proposals(highest_hz: float, slope: float) -> Iterator[Proposal]:
    """Yield proposals from few lines in a short period to many in a long one, none above ``highest_hz``."""
    for harmonics, reach in product(_HARMONICS, _REACHES):
        yield Proposal(reach * highest_hz / harmonics[-1], harmonics, slope)


def phased(proposal: Proposal, limits: MotionLimits, guess: RigGuess, mode: DriveMode) -> Shape:
    """Return the proposal with phases that allow the largest amplitude within the limits, scaled to peak 1.

    Random phases are searched, then narrowed around the best ones. A fixed seed gives the same rig the same motion.
    """
    fit = _AmplitudeRoom(proposal, limits, guess, mode)
    rng = np.random.default_rng(len(proposal.harmonics))
    phases = rng.uniform(0.0, 2.0 * np.pi, (_POPULATION, len(proposal.harmonics)))
    room = fit.of(phases)
    for turn in range(_ROUNDS):
        best = phases[np.argsort(-room, kind="stable")[:_KEPT]]
        around = np.repeat(best, _POPULATION // _KEPT - 1, axis=0)
        phases = np.concatenate([best, around + rng.normal(0.0, _STEP_RAD * 0.5**turn, around.shape)])
        room = fit.of(phases)
    chosen = phases[int(np.argmax(room))] % (2.0 * np.pi)
    return unit_peak(Shape(proposal.harmonics, proposal.amplitudes, tuple(float(phase) for phase in chosen)))


class _AmplitudeRoom:
    """Amplitude of a proposal that fits within the limits, as a function of its phases."""

    def __init__(self, proposal: Proposal, limits: MotionLimits, guess: RigGuess, mode: DriveMode) -> None:
        harmonics, amplitudes = np.array(proposal.harmonics), np.array(proposal.amplitudes)
        omega = 2.0 * np.pi * proposal.lowest_hz * harmonics
        foresight = limits.foresight_s if mode == "torque" else 0.0
        self._turns = np.exp(1j * np.outer(_TURN, harmonics))
        self._speed = amplitudes.astype(np.complex128)
        self._ahead = amplitudes * (1.0 + 1j * omega * foresight)
        self._torque = amplitudes * (guess.viscous_nm_s_rad + 1j * omega * guess.inertia_kg_m2)
        self._both_ends = mode == "speed" and guess.following is not None
        if self._both_ends and guess.following is not None:     # the shaft's response to the setpoint
            gains = guess.following.shaft(proposal.lowest_hz * harmonics)
            self._ahead, self._torque = amplitudes * gains, self._torque * gains
        steady = max(guess.steady_torque_nm(limits.usable_low_rad_s), guess.steady_torque_nm(limits.usable_high_rad_s))
        self._speed_room = (limits.usable_high_rad_s - limits.usable_low_rad_s) / guess.speed_swing_factor(mode)
        self._torque_room = max(limits.usable_torque_nm - steady, 1e-9) / guess.torque_swing_factor(mode)

    def of(self, phases: FloatArray) -> FloatArray:
        """Return the amplitude that fits, (C,), for phases (C, K)."""
        turned = np.exp(1j * phases.T)
        speed, ahead, torque = (
            (self._turns @ (weights[:, None] * turned)).real for weights in (self._speed, self._ahead, self._torque)
        )
        lowest = np.minimum(ahead.min(axis=0), speed.min(axis=0)) if self._both_ends else speed.min(axis=0)
        span = np.maximum(ahead.max(axis=0), speed.max(axis=0)) - lowest
        room: FloatArray = np.minimum(self._speed_room / span, self._torque_room / np.abs(torque).max(axis=0))
        return room


# ---------------------------------------------------------------------------------------------------------------------

OFFSET_SHARES = (0.2, 0.4)   # candidates for the distance of the mean speeds from the ends, shares of the window
BETTER = 0.95         # share of the usual multisine's half-width that a candidate must not exceed
_SLACK = 1.02         # factor on the usual plan's time, because a transition may take a second longer


@dataclass(frozen=True)
class DesignKnowledge:
    """Assumptions of a design besides limits and rough rig."""

    noise: NoiseDensity
    prior: LagPrior
    has_drill_string: bool = False    # a drill string hangs on the shaft

    def theta(self, guess: RigGuess) -> FloatArray:
        """Return the assumed parameters of the rigid model, (8,)."""
        return assumed_theta(guess.inertia_kg_m2, guess.viscous_nm_s_rad, self.prior)

    @property
    def speed_lag_s(self) -> float:
        """Return the stated lag of the reported speed, else the assumed one, s."""
        return SPEED_LAG_S if self.prior.speed_lag_s is None else self.prior.speed_lag_s

    @property
    def torque_lag_s(self) -> float:
        """Return the stated lag of the reported torque, else the assumed one, s."""
        return TORQUE_LAG_S if self.prior.torque_lag_s is None else self.prior.torque_lag_s


@dataclass(frozen=True)
class Choice:
    """Plan, expected relative half-width of J, and that of the usual excitation in that time; NaN: not predicted."""

    plan: Plan
    half_width: float
    usual_half_width: float


def choose(
    limits: MotionLimits,
    guess: RigGuess,
    wish: PlanRequest,
    known: DesignKnowledge,
    confidence: float,
    time_s: float | None = None,
) -> Choice:
    """Return the plan with the narrowest expected interval of J. Raises PlanRefused if nothing fits.

    ``time_s``: longest duration, transitions included; None: as long as the usual plan. The information matrix selects
    the best candidate for each slope of the amplitudes, and the estimator's own interval decides. It also shows if a
    different set of lags would explain the lines, which happens when amplitudes fall too steeply.
    """
    theta = known.theta(guess)

    def width(plan: Plan) -> float:
        return expected_half_width(plan, theta, known.noise, known.prior, confidence)

    usual = make_plan(limits, guess, wish)
    if identified_before_echo(wish.kind):     # the prediction is for a rigid shaft only
        return Choice(_in_time(usual, wish, time_s), math.nan, math.nan)
    allowed_s = _SLACK * usual.duration_s if time_s is None else time_s
    if known.has_drill_string and _lines_are_free(wish):
        try:
            shape = phased(STRING, limits, guess, wish.mode)
            asked = replace(wish, shape=shape, frequency_hz=STRING.lowest_hz, offset_share=OFFSET_SHARES[0])
            return Choice(_in_time(make_plan(limits, guess, asked), asked, allowed_s), math.nan, math.nan)
        except PlanRefused:        # such as: too long for the available time
            pass
    if _fixed(wish):
        usual = _in_time(usual, wish, time_s)
        found = width(usual)
        return Choice(usual, found, found)
    finalists: list[Plan] = []
    for slope in SLOPES:
        rated = [
            (relative_sd(plan, theta, known.noise, known.prior), number, plan)
            for number, plan in enumerate(_candidates(limits, guess, wish, known, allowed_s, slope))
        ]
        finalists += [plan for sd, _, plan in sorted(rated)[:1] if math.isfinite(sd)]
    try:
        best = _in_time(usual, wish, time_s)
        best_width = usual_width = width(best)
        bar = BETTER * usual_width
    except PlanRefused:
        if not finalists:
            raise
        best, best_width, usual_width, bar = finalists[0], math.inf, math.inf, math.inf
    for plan in finalists:
        found = width(plan)
        if found < bar:
            best, best_width, bar = plan, found, found
    return Choice(best, best_width, usual_width)


def choose_soonest(
    limits: MotionLimits,
    guess: RigGuess,
    wish: PlanRequest,
    known: DesignKnowledge,
    confidence: float,
    tolerance: float,
    time_s: float,
) -> Plan | None:
    """Return the plan that is expected to reach a tolerance soonest if extended as needed, with few periods at first.

    None if no candidate fits into ``time_s``, if the user's values leave nothing to choose, or if a string needs its
    own lines. As in `choose` the information matrix selects for each slope, and the estimator's own interval decides.
    """
    if _fixed(wish) or known.has_drill_string:
        return None
    theta, wish = known.theta(guess), replace(wish, settle_s=SETTLE_SOON_S)
    rated: list[tuple[float, int, Plan]] = []
    for slope in SLOPES:
        fit = [plan.with_counted(count) for plan in _candidates(limits, guess, wish, known, time_s, slope)
               for count in SOON_COUNTED]
        widths = [_WIDTHS_OF_SD * relative_sd(plan, theta, known.noise, known.prior) for plan in fit]
        of_slope = [(_until_s(*one, tolerance), len(rated) + number, one[0])
                    for number, one in enumerate(zip(fit, widths, strict=True))]
        rated += sorted(of_slope)[:_OF_A_SLOPE]
    best, soonest_s = None, math.inf
    for _, _, plan in sorted(rated)[:_FINALISTS]:
        if plan.duration_s < soonest_s:
            width = safe_half_width(predicted(plan, theta, known.noise, known.prior), confidence)
            until_s = _until_s(plan, width, tolerance)
            if until_s < soonest_s:
                best, soonest_s = plan, until_s
    return best


SOON_COUNTED = (5, 6)     # first periods at each mean speed for the shortest run. Four are too few: most runs then need
                          # more, some 14 minutes, because each analysis without success raises the next confidence
SETTLE_SOON_S = 8.0       # s; settling for the shortest run: error of 0.03 % of J at most, with reporting lags of 1 s
_WIDTHS_OF_SD = 2.3       # typical ratio of a plan's half-width to the standard deviation of the bound
_OF_A_SLOPE, _FINALISTS = 4, 8   # candidates kept for each slope, and of all slopes for the exact prediction
_LEAST_MORE = 0.2         # least extension as a share of the first periods: two of ten
_SPREAD = 0.2             # standard deviation of the logarithm of a half-width about the predicted one
_QUANTILES = np.array([-1.5, -0.9, -0.5, -0.2, 0.2, 0.5, 0.9, 1.5])     # equally likely, of a normal distribution


def _until_s(plan: Plan, width: float, tolerance: float) -> float:
    """Return the expected time until the tolerance is reached, s, for this predicted half-width."""
    counted_s = sum(plan.counted * one.reference.period_s for one in plan.segments)
    ratio = width * np.exp(_SPREAD * _QUANTILES) / tolerance
    missing = np.where(ratio > 1.0, np.maximum(ratio**2 - 1.0, _LEAST_MORE), 0.0)
    return plan.duration_s + counted_s * float(np.mean(missing))


def _lines_are_free(wish: PlanRequest) -> bool:
    """Return whether the request leaves the frequencies open."""
    return periodic_kind(wish.kind).tuned and wish.frequency_hz is None


def _fixed(wish: PlanRequest) -> bool:
    """Return whether the request fixes the plan: its frequencies, or its number of periods."""
    return not _lines_are_free(wish) or wish.periods is not None


def refuse_unfit(
    limits: MotionLimits, guess: RigGuess, wish: PlanRequest, known: DesignKnowledge, time_s: float | None
) -> None:
    """Raise PlanRefused if `choose` would find nothing, without comparing candidates."""
    try:
        _in_time(make_plan(limits, guess, wish), wish, time_s)
    except PlanRefused:
        if _fixed(wish) or time_s is None:
            raise
        if not any(True for slope in SLOPES for _ in _candidates(limits, guess, wish, known, time_s, slope)):
            raise


# ---------------------------------------------------------------------------------------------------------------------
# Lines with a drill string: they must separate the motor from the string below, and both from the reporting filters.
#
# A rigid shaft's best lines are few and low, with amplitudes falling as ω^−2. With a string they leave ±3 to 7 % of J
# undetermined, even without noise. Of four such lines on the shipped string, one lies at an antiresonance of the motor;
# two masses, a string and filters of two poles have the same effect on the other three. Ten lines of equal torque, from
# below the lowest mode to above the second, leave 0.2 to 0.4 % in the same time (1.3 % with two masses and every string
# that the data permit), although a line may be at a resonance, which the host's slow control damps. Lines from 0.1 Hz,
# with one line less below the lowest mode, leave twice as much. Torques that rise with frequency add nothing.


STRING = Proposal(0.08, tuple(range(1, 11)), 1.0)


def _candidates(
    limits: MotionLimits, guess: RigGuess, wish: PlanRequest, known: DesignKnowledge, time_s: float, slope: float
) -> Iterator[Plan]:
    speeds = 2 if wish.offsets_rad_s is None else len(wish.offsets_rad_s)
    for proposal in proposals(highest_line_hz(max(known.speed_lag_s, known.torque_lag_s)), slope):
        period_s = 1.0 / proposal.lowest_hz
        if speeds * (LEAST_COUNTED + settling_periods(period_s, wish.settle_s)) * period_s > time_s:
            continue                   # too long: skip the slow evaluation
        shape = phased(proposal, limits, guess, wish.mode)
        for share in OFFSET_SHARES:
            asked = replace(wish, shape=shape, frequency_hz=proposal.lowest_hz, offset_share=share)
            try:
                yield _in_time(make_plan(limits, guess, asked), asked, time_s)
            except PlanRefused:
                continue


def _in_time(plan: Plan, wish: PlanRequest, time_s: float | None) -> Plan:
    """Return the plan with as many whole periods as fit. Raises PlanRefused if those are too few for the scatter."""
    if time_s is None or wish.periods is not None:
        return plan
    segment = plan.segments[0]
    between = plan.duration_s - sum(one.duration_s for one in plan.segments)
    whole = math.floor((time_s - between) / (len(plan.segments) * segment.reference.period_s) + 1e-9)
    counted = whole - segment.settle_periods
    if counted < LEAST_COUNTED:
        needed = len(plan.segments) * (LEAST_COUNTED + segment.settle_periods) * segment.reference.period_s + between
        raise PlanRefused(
            f"time: {time_s:.0f} s are too short: this excitation needs {needed:.0f} s",
            f"Give --max-time {math.ceil(needed)}s or more (or remove it; limits.time_s is a limit, too), or a higher"
            " --frequency",
        )
    return plan.with_counted(counted)

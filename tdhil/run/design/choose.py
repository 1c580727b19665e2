"""Choose the excitation: of some dozen candidates the one that tells the inertia best in the time there is.

What the user fixes stays fixed: `make_plan` takes every wish at its word, and what it refuses is no candidate. The
usual multisine is always one of them, and only a clearly better one replaces it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

from tdhil.protocol.design.information import relative_sd
from tdhil.protocol.design.noise import SPEED_LAG_S, TORQUE_LAG_S, Noise, assumed_theta
from tdhil.protocol.design.predicted import expected_half_width
from tdhil.protocol.design.shapes import SLOPES, highest_line_hz, phased, proposals
from tdhil.recording.recording import FloatArray, LagPrior
from tdhil.run.excitation import (
    LEAST_COUNTED,
    ExcitationWish,
    MachineLimits,
    Plan,
    PlanRefused,
    RigGuess,
    make_plan,
    settling_periods,
)

OFFSET_SHARES = (0.2, 0.4)
BETTER = 0.95         # of the usual multisine's interval: what a candidate must come down to
_SLACK = 1.02         # of the usual plan's time: a transition may take a second longer


@dataclass(frozen=True)
class Knowledge:
    """What a design rests on besides limits and rough rig."""

    noise: Noise
    prior: LagPrior

    def theta(self, guess: RigGuess) -> FloatArray:
        """The rigid model's parameters to be reckoned with, (8,)."""
        return assumed_theta(guess.inertia_kg_m2, guess.viscous_nm_s_rad, self.prior)

    @property
    def speed_lag_s(self) -> float:
        """Stated, else what it may be."""
        return SPEED_LAG_S if self.prior.speed_lag_s is None else self.prior.speed_lag_s

    @property
    def torque_lag_s(self) -> float:
        """Stated, else what it may be."""
        return TORQUE_LAG_S if self.prior.torque_lag_s is None else self.prior.torque_lag_s


@dataclass(frozen=True)
class Choice:
    """The plan, the relative half-width of J to be expected of it, and of the usual excitation in the same time."""

    plan: Plan
    half_width: float
    usual_half_width: float


def choose(
    limits: MachineLimits,
    guess: RigGuess,
    wish: ExcitationWish,
    known: Knowledge,
    confidence: float,
    time_s: float | None = None,
) -> Choice:
    """The plan with the tightest expected interval of J; raises PlanRefused where nothing fits.

    ``time_s``: how long it may take, transitions included; None: as long as the usual plan. The information matrix
    picks the best for each slope of the amplitudes, and the estimator's own interval has the last word: it also sees
    where quite another set of lags would explain the lines, which is where amplitudes fall too steeply.
    """
    theta = known.theta(guess)

    def width(plan: Plan) -> float:
        return expected_half_width(plan, theta, known.noise, known.prior, confidence)

    given = wish.kind != "multisine" or wish.frequency_hz is not None or wish.periods is not None
    usual = make_plan(limits, guess, wish)
    if given:
        usual = _in_time(usual, wish, time_s)
        found = width(usual)
        return Choice(usual, found, found)
    allowed_s = _SLACK * usual.duration_s if time_s is None else time_s
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


def refuse_unfit(
    limits: MachineLimits, guess: RigGuess, wish: ExcitationWish, known: Knowledge, time_s: float | None
) -> None:
    """PlanRefused where `choose` would find nothing, without weighing what it would find."""
    try:
        _in_time(make_plan(limits, guess, wish), wish, time_s)
    except PlanRefused:
        given = wish.kind != "multisine" or wish.frequency_hz is not None or wish.periods is not None
        if given or time_s is None:
            raise
        if not any(True for slope in SLOPES for _ in _candidates(limits, guess, wish, known, time_s, slope)):
            raise


def _candidates(
    limits: MachineLimits, guess: RigGuess, wish: ExcitationWish, known: Knowledge, time_s: float, slope: float
) -> Iterator[Plan]:
    speeds = 2 if wish.offsets_rad_s is None else len(wish.offsets_rad_s)
    for proposal in proposals(highest_line_hz(max(known.speed_lag_s, known.torque_lag_s)), slope):
        period_s = 1.0 / proposal.lowest_hz
        if speeds * (LEAST_COUNTED + settling_periods(period_s)) * period_s > time_s:
            continue                   # too long before it is looked at, which takes its time
        shape = phased(proposal, limits, guess, wish.mode)
        for share in OFFSET_SHARES:
            asked = replace(wish, shape=shape, frequency_hz=proposal.lowest_hz, offset_share=share)
            try:
                yield _in_time(make_plan(limits, guess, asked), asked, time_s)
            except PlanRefused:
                continue


def _in_time(plan: Plan, wish: ExcitationWish, time_s: float | None) -> Plan:
    """As many whole periods as fit; raises PlanRefused if those are too few to know the scatter."""
    if time_s is None or wish.periods is not None:
        return plan
    segment = plan.segments[0]
    between = plan.duration_s - sum(one.duration_s for one in plan.segments)
    whole = math.floor((time_s - between) / (len(plan.segments) * segment.reference.period_s) + 1e-9)
    counted = whole - segment.settle_periods
    if counted < LEAST_COUNTED:
        needed = len(plan.segments) * (LEAST_COUNTED + segment.settle_periods) * segment.reference.period_s + between
        raise PlanRefused(
            f"time: {time_s:.0f} s are too short, this excitation needs {needed:.0f} s",
            f"Give --max-time {math.ceil(needed)} or more (or leave it out; limits.time_s bounds it, too), or a higher"
            " --frequency",
        )
    return plan.with_counted(counted)

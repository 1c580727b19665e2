r"""From J, with its interval, to gains that can be typed in: the lowest critical speed that the margins allow.

**Objective.** The lowest set speed without stick-slip, *cure under bit noise*, as the mean over truths that are drawn
jointly (`uncertainty`): J, string, lags and bit at once. **Subject to** a phase margin, a gain margin and a dead-time
reserve (`stability`) on every one of these truths. **Free** are softness a, frequency factor φ and the share of J that
is compensated: P = ζ/a, I = (φω)² (J − J_c). A grid is ranked without a simulation (`candidates`); the best that keep
the margins are simulated under noise, and the best of those is taken. Without a bit the rank decides.

**Soft** compensates nothing: any drive takes it. **Compensated** gives back a part of the rotor's inertia.
**Broadband** is full compensation and P = ζ as far as lags and margins allow. Where that is no more than a soft
controller does, it is refused under this name. **Stiff** and **present** gains are rows like the others.

**Advice.** The best row is compared with the present gains (without them: with the stiff ones), truth by truth. Where
it isn't better by more than the search resolves, the advice is to keep what there is.

**How J's error comes in.** The gains are what they are; J is what moves. The figures of one string as it is stated are
also told over the 95 % interval of J alone, with the turning points between its ends. What else was measured (lags,
present gains, k and ω as identified) is moved to either end of its interval, one after the other, and what each does
is added in squares.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from math import inf, log, pi, sqrt
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from profiles import MessageCode, TdhilError
from tdhil.soft_torque.candidates import (
    SHARES,
    SOFTNESSES,
    Candidate,
    candidates,
    gains,
    ranked_speeds,
)
from tdhil.soft_torque.controller import (
    ClosedSystem,
    Margins,
    NaturalMode,
    SpeedController,
    TopDrive,
    margins,
    reflection_at,
    softest_allowed,
    stiff_controller,
    tuned_controller,
)
from tdhil.soft_torque.drill_string import MUD_DRAG_NM_S_RAD_M, DrillString
from tdhil.soft_torque.simulation import (
    LOWEST_NOISY_RPM,
    NOISY_RESOLUTION,
    RPM,
    CriticalSpeeds,
    Search,
    coarse_tick_s,
    critical_speeds,
    lowest_turning,
    lowest_turning_with_noise,
)
from tdhil.soft_torque.stability import (
    USUAL_MARGINS,
    LoopMargins,
    RequiredMargins,
    StringResponse,
    highest_crossover,
    is_stable,
    least_of,
    linear_limit,
    loop_margins,
    response_of,
)
from tdhil.soft_torque.uncertainty import DrawnValues, Interval, Truth, draw_truths

TUNING_REFUSED = 11
"""Exit code: the gains that were asked for would be unstable, or leave less margin than is required."""
STEPS = 9
"""Values of J, from end to end of its interval, at which what follows from it is worked out; odd."""
RESERVE = 0.8
"""Of the largest stable share of J, so much is compensated at most."""
LAG_RESERVE = 0.9
"""Of the softest a that the lags allow, so much is taken at most."""
BAND_HZ = (0.05, 1.5)
"""Where the mean |r| is taken."""
WRONG_BY = (0.126, 0.76)
"""Errors of J whose cost is told: the paper's method on a simulated field rig, and its own spread of slopes."""
BROADBAND_BELOW = 0.8
"""Mean |r| above which a controller isn't called broadband: a plain soft one has 0.94 on the reference case."""
NEXT_MODE_SHARE = 0.85
"""Of the second mode with the top held, that the whole's second mode stays above: there a top drive is a rotor, or a
wall."""
DRAWS, SEARCH_DRAWS = 20, 6
"""Truths that a row's figures are taken over, and those on which finalists are simulated."""
FINALISTS, MOST_TRIED = 5, 120
"""Candidates of one kind that are simulated, and that are held against the margins before it is given up."""
GOLDEN_STEPS = 7
"""Each leaves 0.62 of the range in which a turning point lies: 0.03 of two steps of J."""
CRITICAL_STEPS = 5
"""Values of J at which critical speeds of the stated string are simulated."""
NOT_BETTER_SHARE = 2.0 * NOISY_RESOLUTION
"""A critical speed that is lower by less is no reason to change anything."""
_WAVES_SUPPOSED = ("what inertia compensation does to the pipe's waves, and whether their losses keep it stable, is "
                   "not known of a spring alone: the pipe has to be named (string.yaml)")


class TuningRefused(TdhilError):
    """The gains that were asked for can't be recommended for this machine, and the message says why."""

    entry = MessageCode.TUNING_REFUSED

    exit_code = TUNING_REFUSED


@dataclass(frozen=True)
class Moved:
    """All as believed, but for one thing that is at an end of its 95 % interval; None: as believed."""

    inner_lags_s: tuple[float, ...] | None = None
    present: SpeedController | None = None
    string: DrillString | None = None


@dataclass(frozen=True)
class TuneCase:
    """What is tuned for what, all at the main shaft."""

    string: DrillString
    drive: TopDrive
    """With the J that is believed."""
    inertia_kg_m2: Interval
    phase_margin_deg: float = 60.0
    """Of the stiff controller."""
    softness: float | None = None
    """a, where it is asked for; None: the one with the lowest critical speed."""
    compensated_share: float | None = None
    """Share of J, where it is asked for; None: the one with the lowest critical speed."""
    present: SpeedController | None = None
    """The gains in the drive now, measured (`identify --impedance`) or typed; shown beside the others."""
    also: tuple[tuple[Moved, Moved], ...] = ()
    """What else is known to an interval only, each independent of the others: both ends of each."""
    required: RequiredMargins = USUAL_MARGINS
    """On every sampled truth."""
    lag_tolerance: float = 0.1
    """Relative, of each lag, where ``also`` has no lags."""
    string_draws: tuple[DrillString, ...] = ()
    """Strings drawn from the covariance of an identification; (): drawn from the string's own tolerances."""
    draws: int = DRAWS
    seed: int = 1

    def moved(self, by: Moved) -> TuneCase:
        """The case with that one thing moved."""
        lags = self.drive.inner_lags_s if by.inner_lags_s is None else by.inner_lags_s
        return replace(self, string=by.string or self.string, present=by.present or self.present,
                       drive=replace(self.drive, inner_lags_s=lags))

    def moves(self, *, present: bool) -> tuple[tuple[TuneCase, TuneCase], ...]:
        """Both ends of all that matters to a controller: to the ``present`` one its own gains, too."""
        return tuple((self.moved(low), self.moved(high)) for low, high in self.also
                     if present or low.present is None)

    @property
    def at_inertias(self) -> tuple[TopDrive, ...]:
        """The drive at `STEPS` values of J from end to end of its interval, the believed one in the middle."""
        return tuple(self.drive.with_inertia(one) for one in self.inertias(STEPS))

    def inertias(self, steps: int) -> tuple[float, ...]:
        """So many values of J (odd), from end to end of its interval, the believed one in the middle."""
        low, value, high = self.inertia_kg_m2.low, self.inertia_kg_m2.value, self.inertia_kg_m2.high
        half = steps // 2
        below = [low + (value - low) * k / half for k in range(half)]
        return (*below, *(value + (high - value) * k / half for k in range(half + 1)))

    def truths(self) -> tuple[Truth, ...]:
        """Draw `draws` truths from all that is open."""
        lags, gains_open = [], []
        for low, high in self.also:
            if low.inner_lags_s is not None and high.inner_lags_s is not None:
                size = max(len(low.inner_lags_s), len(high.inner_lags_s), len(self.drive.inner_lags_s))
                ends = [np.array((*end, *(0.0,) * (size - len(end)))) for end in (low.inner_lags_s, high.inner_lags_s)]
                lags.append((0.5 * (ends[1] - ends[0])).tolist())
            if low.present is not None and high.present is not None:
                gains_open.append((0.5 * (high.present.gain_nm_s_rad - low.present.gain_nm_s_rad),
                                   0.5 * (high.present.integral_nm_rad - low.present.integral_nm_rad)))
        same = all(len(axis) == len(self.drive.inner_lags_s) for axis in lags)
        return draw_truths(
            self.string, self.drive, self.inertia_kg_m2, count=self.draws, seed=self.seed,
            lag_tolerance=self.lag_tolerance, lag_axes=lags if same else (), present=self.present,
            present_axes=gains_open, string_draws=self.string_draws)


@dataclass(frozen=True)
class WrongInertia:
    """The same recipe with a J that is wrong: ``error`` 0.126 is 12.6 % too large."""

    error: float
    stable: bool
    damping: float | None
    """The least of the lowest modes'; None: not stable."""
    cure_rpm: float | None


@dataclass(frozen=True)
class Tuned:
    """One controller, with all that follows from it. Refused: ``controller`` is None and ``refusal`` says why."""

    kind: str
    controller: SpeedController | None
    refusal: str = ""
    softness: float | None = None
    frequency_factor: float = 1.0
    """φ: I = (φω)² (J − J_c)."""
    softest: float | None = None
    """The a at which the lags make Z negative at low frequencies."""
    compensated_share: float = 0.0
    largest_share: float | None = None
    """That is stable for every J of the interval."""
    integral_nm_rad: Interval | None = None
    """I as J's interval has it."""
    reflection: Interval | None = None
    """|r| at the lowest mode; this and the next two over J's interval, the string as stated."""
    band_reflection: Interval | None = None
    """Mean |r| over `BAND_HZ`."""
    damping: Interval | None = None
    """The least of the lowest modes'."""
    modes: tuple[NaturalMode, ...] = ()
    margins: Margins | None = None
    """Of the bare drive."""
    with_string: LoopMargins | None = None
    """All as believed."""
    worst: LoopMargins | None = None
    """The least of each margin over all sampled truths."""
    failed: tuple[str, ...] = ()
    """Margins that are thinner than required on a sampled truth, with their numbers."""
    critical: CriticalSpeeds | None = None
    """Without noise, the string as stated."""
    critical_along: tuple[CriticalSpeeds, ...] = ()
    """The same at values of J from end to end of its interval."""
    critical_moved: tuple[tuple[CriticalSpeeds, CriticalSpeeds], ...] = ()
    """At both ends of whatever else has an interval."""
    cure: DrawnValues | None = None
    """Under bit noise, rpm, over the sampled truths; so are the next two."""
    start: DrawnValues | None = None
    linear_limit: DrawnValues | None = None
    """Mean speed below which steady rotation is unstable."""
    wrong: tuple[WrongInertia, ...] = ()

    @property
    def lag_reserve_s(self) -> float | None:
        """Smallest further first-order lag in the loop that destabilises it; None: none does."""
        return None if self.with_string is None or self.with_string.lag_s == inf else self.with_string.lag_s

    @property
    def dead_time_reserve_s(self) -> float | None:
        """Smallest further dead time in the loop that destabilises it; None: none does."""
        found = self.with_string
        return None if found is None or found.dead_time_s == inf else found.dead_time_s


@dataclass(frozen=True)
class Advice:
    """What to do."""

    kind: str | None
    """The row whose gains to type in; None: keep what there is, or nothing can be recommended."""
    compared_with: str
    """present, or stiff."""
    keep: bool
    """Nothing that keeps the margins is better than that."""
    better_share: float | None = None
    """Share of the sampled truths on which the critical speed isn't higher; None: not simulated."""


@dataclass(frozen=True)
class Tuning:
    """All controllers for one machine on one string."""

    case: TuneCase
    string_modes_hz: tuple[float, ...]
    """With the top held."""
    tuned: tuple[Tuned, ...]
    searched: Search | None
    """How critical speeds were looked for; None: not at all."""
    advice: Advice
    truths: tuple[Truth, ...] = field(default=(), repr=False)

    def by_kind(self, kind: str) -> Tuned | None:
        """The row of that name."""
        return next((one for one in self.tuned if one.kind == kind), None)


class _TruthMargins:
    """The truths of one case, with each string's response worked out once."""

    def __init__(self, case: TuneCase) -> None:
        self.truths = case.truths()
        self._responses: dict[int, StringResponse] = {}

    def margins(self, number: int, law: SpeedController) -> LoopMargins:
        truth = self.truths[number]
        top = highest_crossover(truth.drive, law)
        known = self._responses.get(number)
        if known is None or known.omega_rad_s[-1] < 0.98 * top:
            known = self._responses[number] = response_of(truth.string, 1.3 * top)
        return loop_margins(truth.drive, law, truth.string, known)

    def every(self, law: SpeedController | None) -> LoopMargins:
        """The least over all truths; ``law`` None: each truth's present gains."""
        return least_of([self.margins(k, law or truth.present or SpeedController(0.0, 0.0))
                         for k, truth in enumerate(self.truths)])

    def keeps(self, law: SpeedController, required: RequiredMargins) -> bool:
        """Whether no truth has a margin that is thinner."""
        return not any(required.failed(self.margins(k, law)) for k in range(len(self.truths)))


def tune(
    case: TuneCase, search: Search | None = Search(), told: Callable[[str], None] = lambda text: None  # noqa: B008
) -> Tuning:
    """Present, stiff, soft, compensated, broadband. `TuningRefused` where what was asked for explicitly can't be.

    ``search`` None leaves the simulated critical speeds out; ``told`` hears what is being done.
    """
    told("string's modes")
    held = string_modes_hz(case.string)
    told("what is open: drawing truths")
    samples = _TruthMargins(case)
    simulated = search is not None and case.string.bit is not None
    found: list[Tuned] = []
    if case.present is not None:
        found.append(Tuned("present", case.present))
    found.append(_stiff(case))
    told("soft, compensated: gains that keep the margins")
    pools = [_soft(case, held, samples), _compensated(case, held, samples)]
    if simulated:
        told("the best of them, simulated under bit noise")
        pools = _chosen_by_simulation(pools, samples, held)
    found += [pool[0] for pool in pools]
    told("broadband: gains")
    found.append(_broadband(case, held, samples))
    for k, one in enumerate(found):
        if one.controller is not None:
            told(f"{one.kind}: reflection, modes, margins")
            found[k] = _with_figures(case, one, held, samples)
    if simulated and search is not None:
        found = _under_noise(found, samples, held, told)
        stated = replace(search, longest_tick_s=coarse_tick_s(case.string))
        found = list(_with_critical_speeds(case, tuple(found), held, stated, told))
    return Tuning(case, held, tuple(found), search if simulated else None, _advice(case, found), samples.truths)


def string_modes_hz(string: DrillString) -> tuple[float, ...]:
    """The lowest three modes with the top held, Hz."""
    modes = ClosedSystem(string).modes(3.2 / string.echo_s)
    return tuple(mode.frequency_hz for mode in modes[:3])


def lowest_modes_below_hz(held_hz: Sequence[float]) -> float:
    """What swings below is what the string's lowest mode has become; the next, which rotor and P hold, stays above."""
    second = held_hz[1] if len(held_hz) > 1 else 4.0 * held_hz[0]
    return max(sqrt(held_hz[0] * second), NEXT_MODE_SHARE * second)


def lowest_modes(
    case: TuneCase, drive: TopDrive, law: SpeedController, held_hz: Sequence[float]
) -> tuple[NaturalMode, ...]:
    """Those that the string's lowest mode has become."""
    return ClosedSystem(case.string, drive, law).modes(lowest_modes_below_hz(held_hz))


def least_damping(case: TuneCase, drive: TopDrive, law: SpeedController, held_hz: Sequence[float]) -> float:
    """Of `lowest_modes`; 1 where none swings."""
    return min((mode.damping for mode in lowest_modes(case, drive, law, held_hz)), default=1.0)


# ---------------------------------------------------------------------------------------------------------------------
# The four recipes.


def _stiff(case: TuneCase) -> Tuned:
    try:
        return Tuned("stiff", stiff_controller(case.drive, case.phase_margin_deg))
    except ValueError as error:
        return Tuned("stiff", None, str(error))


def _soft(case: TuneCase, held: Sequence[float], samples: _TruthMargins) -> list[Tuned]:
    """Best first; one that is refused if there is none. Raises `TuningRefused` where it was asked for."""
    softest = softest_allowed(case.string, case.drive, held[0])
    asked = case.softness
    if asked is not None and asked >= softest:
        raise TuningRefused(_too_soft(case, asked, softest, held), where=f"--a {asked:g}",
                            next_step=f"Ask for less than {LAG_RESERVE * softest:.2g}, or find a shorter loop")
    grid = [one for one in candidates(case.string, case.drive.inertia_kg_m2, held[0], (0.0,),
                                      SOFTNESSES if asked is None else (asked,))
            if asked is not None or one.softness <= LAG_RESERVE * softest_allowed(
                case.string, case.drive, one.frequency_factor * held[0])]
    kept = _within_margins(case, grid, samples)
    if not kept:
        tried = tuned_controller(case.string, case.drive.inertia_kg_m2, asked or 0.3, held[0])
        words = _no_margin(case, samples, tried)
        if asked is not None:
            raise TuningRefused(f"a = {asked:g} leaves too little margin: {words}", where=f"--a {asked:g}",
                                next_step="Ask for another a, leave --a out, or find a shorter loop")
        return [Tuned("soft", None, f"no a keeps the margins; a = 0.3, for one: {words}", softest=softest)]
    return [Tuned("soft", one.controller, softness=one.softness, frequency_factor=one.frequency_factor,
                  softest=softest) for one in kept]


def _compensated(case: TuneCase, held: Sequence[float], samples: _TruthMargins) -> list[Tuned]:
    """As `_soft`."""
    asked = case.compensated_share
    if case.string.supposed:
        if asked:
            raise TuningRefused(_WAVES_SUPPOSED, where=f"--compensate {asked:g}", next_step="--string string.yaml")
        return [Tuned("compensated", None, _WAVES_SUPPOSED)]
    largest = largest_stable_share(case, case.softness if case.softness is not None else 0.3, held)
    if asked is not None and asked > largest:
        raise TuningRefused(
            f"{100 * asked:.0f} % of J compensated swings by itself if J is {_worst(case)}; at most "
            f"{100 * largest:.0f} % is stable over J's interval behind {_lag_ms(case)} of lag{_no_drag(case)}",
            where=f"--compensate {asked:g}",
            next_step=f"Ask for {RESERVE * largest:.2f} or less, narrow J's interval, or find a shorter loop")
    shares = tuple(share for share in SHARES if share <= RESERVE * largest) if asked is None else (asked,)
    softnesses = SOFTNESSES if case.softness is None else (case.softness,)
    grid = [one for one in candidates(case.string, case.drive.inertia_kg_m2, held[0], shares, softnesses)
            if one.softness <= LAG_RESERVE * softest_allowed(case.string, case.drive, one.frequency_factor * held[0],
                                                              one.share)]
    kept = _within_margins(case, grid, samples)
    if not kept:
        share = asked if asked is not None else SHARES[0]
        tried = tuned_controller(case.string, case.drive.inertia_kg_m2, case.softness or 0.3, held[0], share)
        words = _no_margin(case, samples, tried)
        if asked is not None:
            raise TuningRefused(
                f"{100 * asked:.0f} % of J compensated leaves too little margin: {words}",
                where=f"--compensate {asked:g}",
                next_step="Ask for less, allow less margin with --margins, or find a shorter loop")
        return [Tuned("compensated", None, f"no share of J keeps the margins; {100 * share:.0f} %, for one: {words}",
                      largest_share=largest)]
    return [Tuned("compensated", one.controller, softness=one.softness, frequency_factor=one.frequency_factor,
                  softest=softest_allowed(case.string, case.drive, one.frequency_factor * held[0], one.share),
                  compensated_share=one.share, largest_share=largest) for one in kept]


def _within_margins(case: TuneCase, grid: Sequence[Candidate], samples: _TruthMargins) -> list[Candidate]:
    """The `FINALISTS` that rank best of those that keep the margins on every truth."""
    if not grid:
        return []
    speeds = ranked_speeds(samples.truths[:SEARCH_DRAWS], [one.controller for one in grid])
    order = np.argsort(np.mean(np.log(np.maximum(speeds, 1e-3)), axis=1), kind="stable")
    kept = []
    for at in order[:MOST_TRIED]:
        if samples.keeps(grid[at].controller, case.required):
            kept.append(grid[at])
            if len(kept) == FINALISTS:
                break
    return kept


def _no_margin(case: TuneCase, samples: _TruthMargins, law: SpeedController) -> str:
    """What fails on the worst of the truths."""
    worst = samples.every(law)
    return ", ".join(case.required.failed(worst) or ("too soft for these lags",)) + (
        f" over J's interval, string, bit and {_lag_ms(case)} of lag{_no_drag(case)}")


def _no_drag(case: TuneCase) -> str:
    """Words for a string that is stated to lose nothing, if that is why."""
    if any(line.drag_nm_s_rad_m > 0.0 for line in case.string.lines):
        return ""
    return (". string.yaml states no drag (drag_nm_s_rad_m: 0): nothing takes energy out of the pipe's waves. Mud has "
            f"about {MUD_DRAG_NM_S_RAD_M:g} N·m·s/rad per metre")


def _chosen_by_simulation(
    pools: list[list[Tuned]], samples: _TruthMargins, held: Sequence[float]
) -> list[list[Tuned]]:
    """Each pool, the lowest cure speed under noise first, as the mean over the first truths."""
    every = [one for pool in pools for one in pool if one.controller is not None]
    if len(every) < 2:
        return pools
    truths = samples.truths[:SEARCH_DRAWS]
    speeds = _noisy(truths, [one.controller for one in every], held, "stuck")
    score = {id(one): float(np.mean(np.log(np.minimum(row, 1e3)))) for one, row in zip(every, speeds, strict=True)}
    return [sorted(pool, key=lambda one: score.get(id(one), inf)) for pool in pools]


def _noisy(
    truths: Sequence[Truth], laws: Sequence[SpeedController | None], held: Sequence[float],
    how: Literal["stuck", "rest"],
) -> NDArray[np.float64]:
    """Critical speeds, rpm, under bit noise: (laws, truths); a law that is None is each truth's present one."""
    loops = [(truth, law or truth.present) for law in laws for truth in truths]
    found = lowest_turning_with_noise(
        [truth.string for truth, _ in loops],
        [(truth.drive, law) for truth, law in loops if law is not None],
        [truth.seed for truth, _ in loops], how, 1.0 / held[0])
    return found.reshape(len(laws), len(truths))


def _under_noise(
    found: list[Tuned], samples: _TruthMargins, held: Sequence[float], told: Callable[[str], None]
) -> list[Tuned]:
    told("critical speeds under bit noise, simulated on every truth")
    taken = [one for one in found if one.controller is not None]
    laws = [None if one.kind == "present" else one.controller for one in taken]
    cures, starts = (_noisy(samples.truths, laws, held, how) for how in ("stuck", "rest"))
    done = {}
    for one, law, cure, start in zip(taken, laws, cures, starts, strict=True):
        limits = [linear_limit(truth.string, truth.drive, law or truth.present or SpeedController(0.0, 0.0)) / RPM
                  for truth in samples.truths]
        done[one.kind] = replace(one, cure=DrawnValues(tuple(map(float, cure)), LOWEST_NOISY_RPM),
                                 start=DrawnValues(tuple(map(float, start)), LOWEST_NOISY_RPM),
                                 linear_limit=DrawnValues(tuple(limits)))
    return [done.get(one.kind, one) for one in found]


def _advice(case: TuneCase, found: Sequence[Tuned]) -> Advice:
    """The best row that keeps every margin, if it is better than what there is."""
    base = found[0]
    offered = [one for one in found[1:] if one.controller is not None and not one.failed and one.kind != "stiff"]
    if base.kind == "stiff":
        offered = [one for one in offered if one is not base]
    elif found[1].controller is not None and not found[1].failed:
        offered.append(found[1])
    if not offered:
        return Advice(None, base.kind, keep=True)
    if base.cure is None or base.controller is None:
        wanted = "soft" if any(one.kind == "soft" for one in offered) else offered[0].kind
        return Advice(wanted, base.kind, keep=False)

    def mean(one: Tuned) -> float:
        assert one.cure is not None
        return float(np.mean(np.log(np.minimum(one.cure.values, 1e3))))

    offered.sort(key=mean)
    best = offered[0]
    # what any drive can take goes first, if it is as good
    soft = next((one for one in offered if one.kind == "soft"), None)
    if soft is not None and mean(soft) < mean(best) + NOT_BETTER_SHARE:
        best = soft
    assert best.cure is not None
    pairs = list(zip(best.cure.values, base.cure.values, strict=True))
    share = sum(new <= old * (1.0 + NOISY_RESOLUTION) for new, old in pairs) / len(pairs)
    gain = mean(base) - mean(best)
    if base.failed and mean(best) <= mean(base) + NOT_BETTER_SHARE:
        return Advice(best.kind, base.kind, keep=False, better_share=share)
    if gain < log(1.0 + NOT_BETTER_SHARE) or share < 0.8:
        return Advice(None, base.kind, keep=True, better_share=share)
    return Advice(best.kind, base.kind, keep=False, better_share=share)


def _broadband(case: TuneCase, held: Sequence[float], samples: _TruthMargins) -> Tuned:
    if case.string.supposed:
        return Tuned("broadband", None, _WAVES_SUPPOSED)
    best: tuple[float, float, float, float] | None = None
    largest = 0.0
    softness: float
    for softness in np.geomspace(0.1, 1.0, 7):
        here = largest_stable_share(case, float(softness), held)
        largest = max(largest, here)
        share = RESERVE * here
        if softness > LAG_RESERVE * softest_allowed(case.string, case.drive, held[0], share) or share < 0.05:
            continue
        law = tuned_controller(case.string, case.drive.inertia_kg_m2, float(softness), held[0], share)
        mean = reflections(case, case.drive, law, held[0])[1]
        if best is None or mean < best[0]:
            best = mean, float(softness), share, here
    if best is None:
        words = f"not even 5 % of J can be compensated over J's interval behind {_lag_ms(case)} of lag{_no_drag(case)}"
        return Tuned("broadband", None, words, largest_share=largest)
    mean, softness, share, here = best
    if mean > BROADBAND_BELOW:
        words = (f"|r| over {BAND_HZ[0]:g} to {BAND_HZ[1]:g} Hz comes down to {mean:.2f} at best, with "
                 f"{100.0 * share:.0f} % of J compensated, all that {_lag_ms(case)} of lag in the loop and J's "
                 "interval allow; matching needs nearly all of J")
        return Tuned("broadband", None, words, largest_share=here)
    softness = round(float(softness), 3)
    law = tuned_controller(case.string, case.drive.inertia_kg_m2, softness, held[0], share)
    thin = case.required.failed(samples.every(law))
    if thin:
        return Tuned("broadband", None, f"it would leave too little margin: {', '.join(thin)}", largest_share=here)
    softest = softest_allowed(case.string, case.drive, held[0], share)
    return Tuned("broadband", law, softness=softness, softest=softest, compensated_share=share, largest_share=here)


def largest_stable_share(
    case: TuneCase, softness: float, held_hz: Sequence[float], believed_upper: bool = True
) -> float:
    """The largest share of the believed J that is stable for every J of the interval, to 0.01; 0: none.

    ``believed_upper``: also if J's upper end were believed.
    """
    low, high = 0.0, 1.0
    while high - low > 0.01:
        middle = 0.5 * (low + high)
        stable = _stable_everywhere(case, softness, middle, held_hz, believed_upper)
        low, high = (middle, high) if stable else (low, middle)
    return low


def _stable_everywhere(
    case: TuneCase, softness: float, share: float, held: Sequence[float], believed_upper: bool = True
) -> bool:
    """Stable at both ends of J's interval, with the believed J's gains; and if its upper end is believed.

    And whatever else is moved to an end of its interval, at J's lower end, which bears least compensation.
    """
    inertia = case.inertia_kg_m2
    law = tuned_controller(case.string, inertia.value, softness, held[0], share)
    upper = tuned_controller(case.string, inertia.high, softness, held[0], share)
    wanted = [(inertia.low, law), (inertia.high, law), *([(inertia.value, upper)] if believed_upper else [])]
    ends = [end for pair in case.moves(present=False) for end in pair]
    return all(is_stable(case.string, case.drive.with_inertia(true), one) for true, one in wanted) and all(
        is_stable(end.string, end.drive.with_inertia(inertia.low), law) for end in ends)


def _too_soft(case: TuneCase, softness: float, softest: float, held: Sequence[float]) -> str:
    return (f"a = {softness:.2g} is beyond ζ/(ω² J Στ) = {softest:.2g}: with {_lag_ms(case)} of lag in the loop and "
            f"the string's lowest mode at {held[0]:.3g} Hz the drive would feed slow swings")


def _lag_ms(case: TuneCase) -> str:
    return f"{1e3 * case.drive.total_lag_s:.0f} ms"


def _worst(case: TuneCase) -> str:
    inertia = case.inertia_kg_m2
    return f"{inertia.low:.4g} kg·m², the lower end of its interval, or {inertia.high:.4g} were believed, the upper"


# ---------------------------------------------------------------------------------------------------------------------
# What follows from the gains.


def reflections(case: TuneCase, drive: TopDrive, law: SpeedController, mode_hz: float) -> tuple[float, float]:
    """(|r| at the lowest mode, its mean over the band)."""
    band = np.linspace(*BAND_HZ, 120)
    at = reflection_at(drive, law, case.string, np.append(band, mode_hz))
    return float(at[-1]), float(np.mean(at[:-1]))


def figures_at(
    case: TuneCase, drive: TopDrive, law: SpeedController, held_hz: Sequence[float]
) -> tuple[float, float, float]:
    """(|r| at the lowest mode, mean |r|, least damping), at one J."""
    one, mean = reflections(case, drive, law, held_hz[0])
    return one, mean, least_damping(case, drive, law, held_hz)


def _with_figures(case: TuneCase, tuned: Tuned, held: Sequence[float], samples: _TruthMargins) -> Tuned:
    law = tuned.controller
    assert law is not None
    along = np.array([figures_at(case, drive, law, held) for drive in case.at_inertias])
    present = tuned.kind == "present"
    pairs = case.moves(present=present)
    heard = [[held if end.string is case.string else string_modes_hz(end.string) for end in pair] for pair in pairs]
    moved = np.array([
        [figures_at(end, end.drive, (end.present or law) if present else law, modes)
         for end, modes in zip(pair, own, strict=True)]
        for pair, own in zip(pairs, heard, strict=True)
    ]).reshape(len(pairs), 2, 3)
    inertia = case.inertia_kg_m2
    integral = None
    if tuned.kind != "stiff" and not present:
        share = 1.0 - tuned.compensated_share
        omega = 2.0 * pi * tuned.frequency_factor
        of = [[(omega * modes[0]) ** 2 * share * inertia.value for modes in own] for own in heard]
        square = (omega * held[0]) ** 2 * share
        integral = in_squares(Interval(law.integral_nm_rad, square * inertia.low, square * inertia.high), of)
    system = ClosedSystem(case.string, case.drive, law)
    errors = WRONG_BY if not present else ()       # those gains hang on no J that is believed now
    wrong = tuple(_wrong(case, tuned, error, held) for error in errors)
    worst = samples.every(None if present else law)
    damping = _turning_points(along[:, 2], case, lambda drive: least_damping(case, drive, law, held))
    return replace(
        tuned, integral_nm_rad=integral, reflection=in_squares(_spanned(along[:, 0]), moved[:, :, 0]),
        band_reflection=in_squares(_spanned(along[:, 1]), moved[:, :, 1]),
        damping=in_squares(damping, moved[:, :, 2], -inf, 1.0, (along[0, 2], along[-1, 2])),
        modes=system.modes(1.1 * held[min(2, len(held) - 1)]),
        margins=margins(case.drive, law, case.string),
        with_string=loop_margins(case.drive, law, case.string, exact=True),
        worst=worst, failed=case.required.failed(worst), wrong=wrong,
    )


def _turning_points(along: NDArray[np.float64], case: TuneCase, value_at: Callable[[TopDrive], float]) -> Interval:
    """What a figure spans over J, its turning points included, kinks too: where the least of two changes sides.

    Golden sections between the neighbours of the largest and of the smallest value.
    """
    inertias = case.inertias(len(along))
    ends = [float(along.min()), float(along.max())]
    for side, sign in ((0, -1.0), (1, 1.0)):
        at = int(np.argmax(sign * along))
        if not 0 < at < len(along) - 1:
            continue
        low, high = inertias[at - 1], inertias[at + 1]
        golden = 0.5 * (sqrt(5.0) - 1.0)
        for _ in range(GOLDEN_STEPS):
            a, b = high - golden * (high - low), low + golden * (high - low)
            of_a, of_b = (sign * value_at(case.drive.with_inertia(one)) for one in (a, b))
            ends[side] = sign * max(sign * ends[side], of_a, of_b)
            low, high = (low, b) if of_a > of_b else (a, high)
    return Interval(float(along[len(along) // 2]), *ends)


def _spanned(along: NDArray[np.float64]) -> Interval:
    """What these values span, and the turning points between them: of the parabola through the nearest three."""
    low, high = float(along.min()), float(along.max())
    for k in range(1, len(along) - 1):
        before, here, after = (float(one) for one in along[k - 1 : k + 2])
        bend = before - 2.0 * here + after
        if (here - before) * (after - here) <= 0.0 and bend != 0.0:
            turning = here - (after - before) ** 2 / (8.0 * bend)
            low, high = min(low, turning), max(high, turning)
    return Interval(float(along[len(along) // 2]), max(low, 0.0) if along.min() >= 0.0 else low, high)


def in_squares(
    by_inertia: Interval, moved: Sequence[Sequence[float]] | NDArray[np.float64], least: float = 0.0, most: float = inf,
    ends: tuple[float, float] | None = None,
) -> Interval:
    """An interval over J, widened by what each other move makes of the value at either of its ends.

    ``ends``: the values at J's own. Where the least of two dampings has its greatest value every single move lowers
    it, and two together may raise it: by no more than the mean of both slopes does, which is half of the difference
    between the ends.
    """
    if not len(moved):
        return by_inertia
    value = by_inertia.value
    below, above = value - by_inertia.low, by_inertia.high - value
    if ends is not None:
        above = max(above, 0.5 * abs(ends[1] - ends[0]))
    below, above = below**2, above**2
    for pair in moved:
        slope = 0.5 * abs(pair[1] - pair[0])
        below += max(slope, value - min(pair)) ** 2
        above += max(slope, max(pair) - value) ** 2
    return Interval(value, max(least, value - sqrt(below)), min(most, value + sqrt(above)))


def recipe_with(case: TuneCase, tuned: Tuned, believed_kg_m2: float, held_hz: Sequence[float]) -> SpeedController:
    """The same kind of controller for another J: the stiff one's margin, or a and the compensated share, as before."""
    if tuned.kind == "stiff":
        return stiff_controller(case.drive.with_inertia(believed_kg_m2), case.phase_margin_deg)
    assert tuned.softness is not None
    return gains(case.string, believed_kg_m2, held_hz[0], tuned.softness, tuned.frequency_factor,
                 tuned.compensated_share)


def _wrong(case: TuneCase, tuned: Tuned, error: float, held: Sequence[float]) -> WrongInertia:
    law = recipe_with(case, tuned, (1.0 + error) * case.inertia_kg_m2.value, held)
    stable = is_stable(case.string, case.drive, law)
    return WrongInertia(error, stable, least_damping(case, case.drive, law, held) if stable else None, None)


def _with_critical_speeds(
    case: TuneCase, every: tuple[Tuned, ...], held: Sequence[float], search: Search, told: Callable[[str], None]
) -> tuple[Tuned, ...]:
    inertia = case.inertia_kg_m2
    taken = [one for one in every if one.controller is not None]
    believed = [
        (case.string, case.drive.with_inertia(true), one.controller)
        for one in taken for true in case.inertias(CRITICAL_STEPS) if one.controller is not None
    ]
    ends = [
        (end.string, end.drive, end.present or one.controller if one.kind == "present" else one.controller)
        for one in taken for pair in case.moves(present=one.kind == "present") for end in pair
        if one.controller is not None
    ]
    told("critical speeds without noise, the string as stated")
    speeds = _critical_speeds([*believed, *ends], search)
    found, moved = speeds[: len(believed)], iter(speeds[len(believed) :])
    wrong = [(one.kind, part.error) for one in taken for part in one.wrong if part.stable]
    by_kind = {one.kind: one for one in taken}
    told("what a wrong J costs, simulated")
    cures = lowest_turning(
        case.string,
        [(case.drive, recipe_with(case, by_kind[kind], (1.0 + error) * inertia.value, held)) for kind, error in wrong],
        "stuck", search,
    ) if wrong else []
    cure = dict(zip(wrong, cures, strict=True))
    done = {
        one.kind: replace(
            one, critical=found[CRITICAL_STEPS * k + CRITICAL_STEPS // 2],
            critical_along=tuple(found[CRITICAL_STEPS * k : CRITICAL_STEPS * (k + 1)]),
            critical_moved=tuple((next(moved), next(moved)) for _ in case.moves(present=one.kind == "present")),
            wrong=tuple(replace(part, cure_rpm=cure.get((one.kind, part.error))) for part in one.wrong),
        )
        for k, one in enumerate(taken)
    }
    return tuple(done.get(one.kind, one) for one in every)


def _critical_speeds(
    loops: Sequence[tuple[DrillString, TopDrive, SpeedController]], search: Search
) -> list[CriticalSpeeds]:
    """In the order of ``loops``: those on one string at once."""
    found: dict[int, CriticalSpeeds] = {}
    for string in dict.fromkeys(string for string, _, _ in loops):
        at = [k for k, (one, _, _) in enumerate(loops) if one == string]
        found |= zip(at, critical_speeds(string, [loops[k][1:] for k in at], search), strict=True)
    return [found[k] for k in range(len(loops))]

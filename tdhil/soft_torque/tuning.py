"""Tuning of the gains: the lowest critical speed that the margins allow.

**Objective.** The lowest set speed without stick-slip (*cure under bit noise*), as the mean over truths. The truths are
drawn jointly (`uncertainty`): J, string, lags and bit at once. **Constraints.** A phase margin, a gain margin and a
dead-time reserve (`stability`) on each of these truths. **Free parameters.** Softness a, frequency factor φ and the
compensated share of J: P = ζ/a, I = (φω)² (J − J_c). A grid is ranked without a simulation (`candidates`). The best
candidates that keep the margins are simulated under noise, and the best of these is taken. Without a bit, the rank
decides.

**Advice.** The best row is compared with the present gains (without them: with the stiff ones), truth by truth. If it
is not better by more than the search resolves, the advice is to keep the present gains. Without simulated critical
speeds nothing is compared, and no row is recommended. If no row keeps the margins, and another row is better than the
failing present gains in each of them, the advice names it as the less bad one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from math import inf, log

import numpy as np
from numpy.typing import NDArray

from tdhil.soft_torque.controller import SpeedController, TopDrive
from tdhil.soft_torque.critical_speed import (
    LOWEST_NOISY_RPM,
    NOISY_RESOLUTION,
    Search,
    coarse_tick_s,
    lowest_turning,
    lowest_turning_with_noise,
)
from tdhil.soft_torque.drill_string import DrillString
from tdhil.soft_torque.recipes import SEARCH_DRAWS, broadband, compensated, soft, stiff
from tdhil.soft_torque.simulation import RPM, Start
from tdhil.soft_torque.stability import linear_limit
from tdhil.soft_torque.truth_margins import TruthMargins
from tdhil.soft_torque.tune_case import Advice, TuneCase, Tuned, Tuning
from tdhil.soft_torque.tuned_figures import recipe_with, string_modes_hz, with_figures
from tdhil.soft_torque.uncertainty import DrawnValues, Truth

START_DRAWS = 6
"""Number of truths on which the ramp from standstill is simulated. It takes longer than the search for the cure speed,
and no decision depends on it."""
CRITICAL_STEPS = 5
"""Number of values of J at which critical speeds of the stated string are simulated."""
NOT_BETTER_SHARE = 2.0 * NOISY_RESOLUTION
"""Least relative reduction of the critical speed for which new gains are recommended."""
LEAST_BETTER_SHARE = 0.8
"""Least share of the draws in which recommended gains are at or below the compared ones."""


def tune(
    case: TuneCase, search: Search | None = Search(), report: Callable[[str], None] = lambda text: None  # noqa: B008
) -> Tuning:
    """Tune all controllers: present, stiff, soft, compensated, broadband.

    ``search`` None leaves the simulated critical speeds out. ``report`` receives progress texts. Raises `TuningRefused`
    if a requested softness or compensated share is not possible.
    """
    report("string's modes")
    held = string_modes_hz(case.string)
    report("machines and strings at random within their tolerances")
    samples = TruthMargins(case)
    simulated = search is not None and case.string.bit is not None
    found: list[Tuned] = []
    if case.present is not None:
        found.append(Tuned("present", case.present))
    found.append(stiff(case))
    report("soft, compensated: gains that keep the margins")
    pools = [soft(case, held, samples), compensated(case, held, samples)]
    if simulated:
        report("the best of these, simulated with noise of the bit")
        pools = best_by_simulation(pools, samples, held)
    found += [pool[0] for pool in pools]
    report("broadband: gains")
    found.append(broadband(case, held, samples))
    for k, one in enumerate(found):
        if one.controller is not None:
            report(f"{one.kind}: reflection, modes, margins")
            found[k] = with_figures(case, one, held, samples)
    if simulated and search is not None:
        found = _under_noise(found, samples, held, report)
        stated = replace(search, longest_tick_s=coarse_tick_s(case.string))
        found = list(_without_noise(case, tuple(found), held, stated, report))
    return Tuning(case, held, tuple(found), search if simulated else None, advice_of(found), samples.truths)


def best_by_simulation(
    pools: list[list[Tuned]], samples: TruthMargins, held: Sequence[float]
) -> list[list[Tuned]]:
    """Return each pool, sorted by the cure speed under noise (mean over the first truths), lowest first."""
    every = [one for pool in pools for one in pool if one.controller is not None]
    if len(every) < 2:
        return pools
    truths = samples.truths[:SEARCH_DRAWS]
    speeds = _noisy([one.controller for one in every], held, truths)
    score = {id(one): float(np.mean(np.log(np.minimum(row, 1e3)))) for one, row in zip(every, speeds, strict=True)}
    return [sorted(pool, key=lambda one: score.get(id(one), inf)) for pool in pools]


def _noisy(
    laws: Sequence[SpeedController | None], held: Sequence[float], stuck: Sequence[Truth], rest: Sequence[Truth] = ()
) -> NDArray[np.float64]:
    """Return critical speeds under bit noise, rpm, as (laws, truths): from a stuck bit, then from rest.

    None as a law: each truth's present gains. All are simulated together, which takes less time than two searches.
    """
    starts: list[tuple[Start, Truth]] = [("stuck", truth) for truth in stuck]
    starts += [("rest", truth) for truth in rest]
    loops = [(how, truth, law or truth.present) for law in laws for how, truth in starts]
    found = lowest_turning_with_noise(
        [truth.string for _, truth, _ in loops],
        [(truth.drive, law) for _, truth, law in loops if law is not None],
        [truth.seed for _, truth, _ in loops], [how for how, _, _ in loops], 1.0 / held[0])
    return found.reshape(len(laws), len(starts))


def noisy_cures(
    truths: Sequence[Truth], laws: Sequence[SpeedController | None], held: Sequence[float]
) -> list[DrawnValues]:
    """Return the critical speed under bit noise, rpm, of every law. None as a law: each truth's present gains."""
    return [_drawn(row) for row in _noisy(laws, held, truths)]


def _drawn(speeds_rpm: NDArray[np.float64]) -> DrawnValues:
    return DrawnValues(tuple(map(float, speeds_rpm)), LOWEST_NOISY_RPM)


def _under_noise(
    found: list[Tuned], samples: TruthMargins, held: Sequence[float], report: Callable[[str], None]
) -> list[Tuned]:
    report("critical speeds with noise of the bit, simulated on every draw")
    taken = [one for one in found if one.controller is not None]
    laws = [None if one.kind == "present" else one.controller for one in taken]
    draws, done = len(samples.truths), {}
    speeds = _noisy(laws, held, samples.truths, samples.truths[:START_DRAWS])
    for one, law, row in zip(taken, laws, speeds, strict=True):
        limits = [linear_limit(truth.string, truth.drive, law or truth.present or SpeedController(0.0, 0.0)) / RPM
                  for truth in samples.truths]
        done[one.kind] = replace(one, cure=_drawn(row[:draws]), start=_drawn(row[draws:]),
                                 linear_limit=DrawnValues(tuple(limits)))
    return [done.get(one.kind, one) for one in found]


def advice_of(found: Sequence[Tuned]) -> Advice:
    """Return the advice: the best row that keeps every margin, if it is better than the first row.

    Without critical speeds nothing is compared: no row, and no advice to keep the present gains. Gains that are
    unstable on a sampled truth are never kept.
    """
    base = found[0]
    offered = [one for one in found[1:] if one.controller is not None and not one.failed and one.kind != "stiff"]
    if base.kind == "stiff":
        offered = [one for one in offered if one is not base]
    elif found[1].controller is not None and not found[1].failed:
        offered.append(found[1])
    unstable = base.worst is not None and not base.worst.stable
    bad = _less_bad(found)
    if not offered:
        return Advice(None, base.kind, keep=not unstable and bad is None, less_bad=bad)
    if base.cure is None or base.controller is None:
        return Advice(None, base.kind, keep=False)

    def better_share(one: Tuned) -> float:
        assert one.cure is not None and base.cure is not None
        pairs = list(zip(one.cure.values, base.cure.values, strict=True))
        return float(sum(new <= old * (1.0 + NOISY_RESOLUTION) for new, old in pairs) / len(pairs))

    def helps(one: Tuned) -> bool:
        gain = _mean_speed(base) - _mean_speed(one)
        if base.failed:
            return bool(gain >= -NOT_BETTER_SHARE)
        return bool(gain >= log(1.0 + NOT_BETTER_SHARE)) and better_share(one) >= LEAST_BETTER_SHARE

    best = min(offered, key=_mean_speed)
    if not unstable and not helps(best):
        return Advice(None, base.kind, keep=bad is None, better_share=better_share(best), less_bad=bad)
    # the soft controller, which every drive can run, is preferred if it is as good
    soft = next((one for one in offered if one.kind == "soft" and helps(one)), None)
    if soft is not None and _mean_speed(soft) < _mean_speed(best) + NOT_BETTER_SHARE:
        best = soft
    return Advice(best.kind, base.kind, keep=False, better_share=better_share(best))


def _mean_speed(one: Tuned) -> float:
    """Return the mean logarithm of the critical speed over the sampled truths."""
    assert one.cure is not None
    return float(np.mean(np.log(np.minimum(one.cure.values, 1e3))))


def _less_bad(found: Sequence[Tuned]) -> str | None:
    """Return the row that fails a margin, and is better in every margin than the first one, which fails too.

    Its critical speed must not be higher. Without simulated speeds, only an unstable first row has a less bad one.
    """
    base = found[0]
    if not base.failed or base.worst is None:
        return None
    better = []
    for one in found[1:]:
        if not one.failed or one.worst is None or not one.worst.stable:
            continue
        new, old = one.worst, base.worst
        if new.phase_deg > old.phase_deg and new.gain_db > old.gain_db and new.dead_time_s > old.dead_time_s and (
                not base.worst.stable if one.cure is None or base.cure is None
                else _mean_speed(one) <= _mean_speed(base)):
            better.append(one)
    return max(better, key=lambda one: one.worst.modulus if one.worst else 0.0).kind if better else None


def _without_noise(
    case: TuneCase, every: tuple[Tuned, ...], held: Sequence[float], search: Search, report: Callable[[str], None]
) -> tuple[Tuned, ...]:
    """Return the rows with cure speeds of the stated string: over J and each other interval, and for a wrong J."""
    report("critical speeds without noise, and with a wrong J")
    inertia = case.inertia_kg_m2
    loops: list[tuple[DrillString, TopDrive, SpeedController]] = []
    sizes = []
    for one in every:
        law = one.controller
        own: list[tuple[DrillString, TopDrive, SpeedController]] = []
        if law is not None:
            own = [(case.string, case.drive.with_inertia(true), law) for true in case.inertias(CRITICAL_STEPS)]
            own += [(end.string, end.drive, end.present or law if one.kind == "present" else law)
                    for pair in case.moves(present=one.kind == "present") for end in pair]
            own += [(case.string, case.drive, recipe_with(case, one, (1.0 + part.error) * inertia.value, held))
                    for part in one.wrong if part.stable]
        sizes.append(len(own))
        loops += own
    by_loop: dict[int, float | None] = {}
    for string in dict.fromkeys(string for string, _, _ in loops):      # loops on one string are simulated together
        at = [k for k, (one, _, _) in enumerate(loops) if one == string]
        by_loop |= zip(at, lowest_turning(string, [loops[k][1:] for k in at], "stuck", search), strict=True)
    cures = iter([by_loop[k] for k in range(len(loops))])
    done = []
    for one, size in zip(every, sizes, strict=True):
        if not size:
            done.append(one)
            continue
        along = tuple(next(cures) for _ in range(CRITICAL_STEPS))
        moved = tuple((next(cures), next(cures)) for _ in case.moves(present=one.kind == "present"))
        wrong = tuple(replace(part, cure_rpm=next(cures) if part.stable else None) for part in one.wrong)
        done.append(replace(one, quiet_cures=along, quiet_cures_moved=moved, wrong=wrong))
    return tuple(done)

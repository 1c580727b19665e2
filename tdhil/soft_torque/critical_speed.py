"""Search for critical speeds: the lowest set speed at and above which the bit turns in the end.

Always state which critical speed it is (cure or start), and for which bit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import ceil, log

import numpy as np
from numpy.typing import NDArray

from tdhil.soft_torque.drill_string import DrillString
from tdhil.soft_torque.simulation import (
    LONGEST_TICK_S,
    RPM,
    UNSTABLE_LOOPS_GROW,
    Array,
    Begin,
    Loop,
    LoopSimulation,
    Start,
    Strings,
    bit_jumps,
)


@dataclass(frozen=True)
class CriticalSpeeds:
    """Critical speeds of the main shaft without bit noise, rpm. None: above the highest speed that was tried."""

    cure_rpm: float | None
    """Lowest set speed at which a stuck bit (about to break away, the top at full set speed) turns in the end."""
    start_rpm: float | None
    """Lowest set speed at which the bit turns in the end after a ramp from standstill."""


@dataclass(frozen=True)
class Search:
    """Settings of the search for critical speeds."""

    highest_rpm: float = 240.0
    lowest_rpm: float = 0.0
    coarse_rpm: float = 16.0
    resolution_rpm: float = 1.0
    duration_s: float = 100.0
    calm_s: float = 20.0
    """Time at the end of a simulation. The bit counts as turning if it does not stand still in this time. Both times
    are longer for a loop with a long integral time (`ends_turning`)."""
    start_ramp_rpm_s: float = 5.0
    longest_tick_s: float = LONGEST_TICK_S


def critical_speeds(strings: Strings, loops: Sequence[Loop], search: Search = Search()) -> list[CriticalSpeeds]:
    """Return the critical speeds of every loop. Raises ValueError if no bit is stated."""
    cures = lowest_turning(strings, loops, "stuck", search)
    starts = lowest_turning(strings, loops, "rest", search)
    return [CriticalSpeeds(*two) for two in zip(cures, starts, strict=True)]


# A loop with a long integral time Tn = P/I has a slow stick-slip cycle. While the bit sticks, the torque rises by I
# times the set speed. Once free, the top turns (F_s − F_c)/P too fast, and this excess decays with Tn. So a bit that
# will stick again turns for up to three Tn. With a shorter end of the simulation, it counts as turning.
CALM_INTEGRAL_TIMES = 3.0
"""Least `Search.calm_s`, in integral times. Two are too few for P = 373 and I = 16 on the reference string (Tn = 24 s):
33 rpm instead of 34. From three to ten, the result is the same."""
MOST_DOUBLED = 3
"""Largest number of times that `Search.calm_s` is doubled: a simulation is up to four times as long."""


def longest_integral_time_s(mode_hz: float) -> float:
    """Return the longest integral time that a search under bit noise can judge, s: eight periods of the lowest mode."""
    return CALM_PERIODS / mode_hz * 2.0**MOST_DOUBLED / CALM_INTEGRAL_TIMES


def lowest_turning(strings: Strings, loops: Sequence[Loop], how: Start, search: Search) -> list[float | None]:
    """Return for each loop the lowest set speed, rpm, at and above which the bit turns in the end; None: not found.

    The search uses a coarse grid first. Then it divides the step between the highest speed that sticks and the next one
    above, down to the resolution.
    """
    span = search.highest_rpm - search.lowest_rpm
    coarse = np.linspace(search.lowest_rpm, search.highest_rpm, max(1, ceil(span / search.coarse_rpm - 1e-9)) + 1)

    def turn(speeds_rpm: Array) -> NDArray[np.bool_]:
        return ends_turning(strings, loops, how, np.maximum(speeds_rpm, 0.5 * search.resolution_rpm), search)

    found = _lowest(turn, np.tile(coarse, (len(loops), 1)), float(coarse[1] - coarse[0]) / search.resolution_rpm)
    return [None if one == np.inf else float(max(one, 0.5 * search.resolution_rpm)) for one in found]


def _lowest(turn: Callable[[Array], NDArray[np.bool_]], coarse: Array, parts: float) -> Array:
    """Return for each row the lowest value from which on all turn; infinite: none. Resolution: step / ``parts``.

    ``coarse``: evenly spaced values; each row is a loop. A row in which the last value does not turn is refined like
    the others, and its result is not used. All values of a bracket are simulated together: the time that a simulation
    takes depends on its ticks much more than on the number of its speeds.
    """
    first = np.array([_first_of_the_rest(row) for row in turn(coarse)])
    rows, count = np.arange(len(coarse)), ceil(parts - 1e-9)
    found = coarse[rows, np.minimum(first, coarse.shape[1] - 1)]
    if count > 1:
        step = float(coarse[0, 1] - coarse[0, 0])
        between = found[:, None] + step * (np.arange(1, count) / count - 1.0)
        at = [_first_of_the_rest(row) for row in turn(between)]
        found = np.column_stack([between, found])[rows, at]      # the bracket's upper end turns
    return np.where(first < coarse.shape[1], found, np.inf)


def _first_of_the_rest(turns: NDArray[np.bool_]) -> int:
    """Return the index from which on all are true. If the last is false, return the length of ``turns``."""
    sticking = np.flatnonzero(~turns)
    return int(sticking[-1]) + 1 if sticking.size else 0


@UNSTABLE_LOOPS_GROW
def ends_turning(
    strings: Strings, loops: Sequence[Loop], how: Start | Sequence[Start], speeds_rpm: Array, search: Search,
    seeds: Sequence[int] | None = None,
) -> NDArray[np.bool_]:
    """Return for each loop and speed whether the bit turns in the end: no standstill within the last ``calm_s``.

    Both times of ``search`` are lengthened for loops with a long integral time. The duration is at least 2 ``calm_s``.
    All loops are simulated together, each to its own end: a tick of a few loops costs nearly as much as one of many.
    """
    target, ramp = speeds_rpm * RPM, search.start_ramp_rpm_s * RPM
    simulation = LoopSimulation(strings, loops, Begin(how, target), target, ramp, search.longest_tick_s,
                                disturbance=seeds)
    longer = CALM_INTEGRAL_TIMES / search.calm_s * np.array([controller.integral_time_s for _, controller in loops])
    calm_s = search.calm_s * 2.0 ** np.ceil(np.log2(np.clip(longer, 1.0, 2.0**MOST_DOUBLED)) - 1e-9)
    duration_s, rest = np.maximum(search.duration_s, 2.0 * calm_s), np.array(how) == "rest"
    for one in np.unique(calm_s):      # loops with one calm time end together, after the longest ramp from rest
        from_rest = rest & (calm_s == one)
        duration_s[from_rest] += target[from_rest].max(initial=0.0) / ramp
    ends = np.ceil(duration_s / simulation.grid.tick_s)
    running, last_stuck = np.arange(len(loops)), np.zeros(target.shape)
    for end in np.unique(ends):
        goes_on = ends[running] >= end
        simulation.keep(goes_on)
        running = running[goes_on]
        last = last_stuck[running]
        while simulation.ticks < end:
            first = simulation.ticks + 1
            stuck = simulation.advance_together(int(end) - simulation.ticks) == 0.0
            ticks = np.arange(first, simulation.ticks + 1)[:, None, None]
            last = np.maximum(last, np.max(np.where(stuck, ticks, 0), axis=0))
        np.putmask(last, ~np.isfinite(simulation.bit_rad_s), simulation.ticks)      # an unstable loop has no speed
        last_stuck[running] = last
    turned: NDArray[np.bool_] = last_stuck < (ends * (1.0 - calm_s / duration_s))[:, None]
    return turned


# ---------------------------------------------------------------------------------------------------------------------
# Critical speeds under bit noise: many strings, each with its own noise, on a geometric grid of speeds.

TICKS_PER_WAY, LONGEST_NOISY_TICK_S = 30.0, 0.03
"""Limits of the tick in a search over many strings: at most a thirtieth of the travel time down, and at most 0.03 s.
The cure speeds of the reference case are the same for ticks of 0.006 s and 0.03 s."""
COARSE_SPEEDS, FINE_PARTS = 7, 16
"""Number of speeds of the first grid, and number of parts of one of its steps that the search resolves."""
PERIODS, CALM_PERIODS = 12.0, 3.0
"""Length of a simulation, and length of its end in which the bit must not stand still; both in periods of the string's
lowest mode with the top held."""
LOWEST_NOISY_RPM, HIGHEST_NOISY_RPM = 10.0, 240.0
NOISY_RESOLUTION = (HIGHEST_NOISY_RPM / LOWEST_NOISY_RPM) ** (1.0 / ((COARSE_SPEEDS - 1) * FINE_PARTS)) - 1.0
"""Relative resolution of a critical speed under noise: 3 %."""


def coarse_tick_s(string: DrillString) -> float:
    """Return the longest tick, s, for the search for critical speeds of that string; finer for a bit that jumps."""
    tick_s = min(LONGEST_NOISY_TICK_S, 0.5 * string.echo_s / TICKS_PER_WAY)
    return min(tick_s, LONGEST_TICK_S) if bit_jumps(string, tick_s) else tick_s


def lowest_turning_with_noise(
    strings: Sequence[DrillString], loops: Sequence[Loop], seeds: Sequence[int],
    how: Start | Sequence[Start], period_s: float,
) -> Array:
    """Return for each loop the lowest set speed, rpm, at and above which the bit turns in the end; infinite: none.

    ``period_s``: period of the lowest mode with the top held. Every loop has its own string and seed. Raises ValueError
    if a bit is not stated.
    """
    search = Search(duration_s=PERIODS * period_s, calm_s=CALM_PERIODS * period_s,
                    longest_tick_s=coarse_tick_s(strings[0]))
    coarse = np.linspace(log(LOWEST_NOISY_RPM), log(HIGHEST_NOISY_RPM), COARSE_SPEEDS)

    def turn(logs: Array) -> NDArray[np.bool_]:
        return ends_turning(strings, loops, how, np.exp(logs), search, seeds)

    found: Array = np.exp(_lowest(turn, np.tile(coarse, (len(loops), 1)), FINE_PARTS))
    return found

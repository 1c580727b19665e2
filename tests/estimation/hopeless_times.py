"""Faults of the time column, and records with too few data."""

from dataclasses import replace

import numpy as np

from tests.estimation.hopeless_family import families, moment, taken
from tests.estimation.hopeless_shaft import Trouble

TIMES, family, shaft = families()


# -- time ----------------------------------------------------------------------------------------------------


@family("do not rise")
def rows_shuffled(r, rng):
    return taken(r, rng.permutation(len(r.time_s)))


@family("do not rise")
def time_repeats(r, rng):
    return replace(r, time_s=np.floor(r.time_s / rng.uniform(0.02, 2.0)))


@family("do not rise")
def time_backwards(r, rng):
    return replace(r, time_s=-r.time_s)


@family("do not rise")
def time_not_a_number(r, rng):
    time = r.time_s.copy()
    time[rng.integers(len(time))] = np.nan
    return replace(r, time_s=time)


@family("clear", "cut off")
def values_shuffled(r, rng):
    order = rng.permutation(len(r.time_s))
    return replace(r, speed_rad_s=r.speed_rad_s[order], torque_nm=r.torque_nm[order])


@family("aliased", "unit of time", "unit of the time")
def milliseconds(r, rng):
    return replace(r, time_s=r.time_s * 1000.0)


@family("unit of time", "unit of the time", "week")
def microseconds(r, rng):
    return replace(r, time_s=r.time_s * 1e6)


@family("no sample lies within")
def kiloseconds(r, rng):
    return replace(r, time_s=r.time_s / 1000.0)


@family("repeats every")
def clock_wrong(r, rng):
    return replace(r, time_s=r.time_s * (1.0 + rng.choice((-1.0, 1.0)) * rng.uniform(0.003, 0.02)))


@shaft("period_wrong", "repeats every", "clear")
def _(rng):
    return Trouble(stretched=rng.choice((-1.0, 1.0)) * rng.uniform(0.005, 0.03))


# -- number of data -----------------------------------------------------------------------------------------


@family("too few")
def next_to_nothing(r, rng):
    return taken(r, slice(0, int(rng.choice((0, 1, 2, 12, 63)))))


@family("too few", "no sample lies within", "few usable", "not identifiable", "usable whole periods", "usable")
def cut_early(r, rng):
    return taken(r, slice(0, int(rng.integers(64, 2800))))


@family("differ in length")
def lengths_differ(r, rng):
    return replace(r, torque_nm=r.torque_nm[: int(rng.integers(len(r.time_s)))])


@family("nothing new")
def all_stale(r, rng):
    return replace(r, fresh=rng.random(len(r.time_s)) < rng.uniform(0.0, 0.4))


@family("usable")
def holes(r, rng):
    keep = np.ones(len(r.time_s), dtype=bool)
    for _ in range(int(rng.integers(1, 8))):
        at = moment(rng)
        keep &= ~((r.time_s > at) & (r.time_s < at + rng.uniform(1.0, 6.0)))
    return taken(r, keep)


@family("did not change for")
def feedback_stuck(r, rng):
    speed, torque = r.speed_rad_s.copy(), r.torque_nm.copy()
    begin = int(np.searchsorted(r.time_s, moment(rng)))
    end = begin + int(rng.integers(150, 1500))
    speed[begin:end], torque[begin:end] = speed[begin], torque[begin]
    return replace(r, speed_rad_s=speed, torque_nm=torque)


@family("did not change for")
def one_signal_stuck(r, rng):
    signal = r.torque_nm.copy()
    begin = int(np.searchsorted(r.time_s, moment(rng)))
    signal[begin : begin + int(rng.integers(200, 1000))] = signal[begin]
    return replace(r, torque_nm=signal)

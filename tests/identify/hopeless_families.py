"""Ways in which a record can be hopeless, faulty or malformed, by name: each spoils a sound one with a seed.

A family says which words the reason or a warning must have, where the fault can be recognised; those that can only be
refused, or let through with a warning because the interval still covers, have none.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from hopeless_shaft import LEAD_S, LINES, PERIOD_S, PERIODS, Trouble


@dataclass(frozen=True)
class Family:
    """``trouble``: what happens to the shaft; ``spoil``: to the record; ``said``: one of these must be said."""

    name: str
    said: tuple[str, ...]
    spoil: Callable | None = None
    trouble: Callable[[np.random.Generator], Trouble] = lambda rng: Trouble()


FAMILIES: list[Family] = []


def family(*said: str, trouble=None):
    def keep(spoil):
        FAMILIES.append(Family(spoil.__name__, said, spoil, trouble or (lambda rng: Trouble())))
        return spoil

    return keep


def shaft(name: str, *said: str):
    def keep(trouble):
        FAMILIES.append(Family(name, said, None, trouble))
        return trouble

    return keep


def taken(r, index):
    return replace(r, time_s=r.time_s[index], speed_rad_s=r.speed_rad_s[index], torque_nm=r.torque_nm[index],
                   fresh=r.fresh[index], limited=r.limited[index])


def declaring(r, **changes):
    segments = tuple(replace(segment, **changes) for segment in r.excitation.segments)
    return replace(r, excitation=replace(r.excitation, segments=segments))


def moment(rng):
    """A second within the excitation of the first segment, after settling."""
    return LEAD_S + PERIOD_S + rng.uniform(0.0, (PERIODS - 2) * PERIOD_S)


# -- no motion, or next to none ------------------------------------------------------------------------------


@family("did not change")
def flat_speed(r, rng):
    return replace(r, speed_rad_s=np.full_like(r.speed_rad_s, rng.uniform(-5, 5)))


@family("did not change")
def flat_torque(r, rng):
    return replace(r, torque_nm=np.full_like(r.torque_nm, rng.uniform(-50, 50)))


@family("did not change")
def all_zero(r, rng):
    return replace(r, torque_nm=np.zeros_like(r.torque_nm), speed_rad_s=np.zeros_like(r.speed_rad_s))


@family("did not change")
def below_resolution(r, rng):
    return replace(r, speed_resolution_rad_s=rng.uniform(2.0, 5.0))


@family("clear")
def noise_alone(r, rng):
    return replace(r, speed_rad_s=3.0 + rng.standard_normal(len(r.time_s)),
                   torque_nm=90.0 + 20.0 * rng.standard_normal(len(r.time_s)))


@shaft("hardly_excited", "clear", "too weak", "unknowns")
def _(rng):
    return Trouble(size=rng.uniform(0.0, 0.05))


@shaft("one_tone", "equations")
def _(rng):
    return Trouble(only=int(rng.integers(4)))


# -- limits --------------------------------------------------------------------------------------------------


def _cut(signal, share, low):
    part = signal[500:]
    return np.maximum(signal, np.quantile(part, share)) if low else np.minimum(signal, np.quantile(part, 1.0 - share))


@family("cut off flat")
def torque_clipped(r, rng):
    return replace(r, torque_nm=_cut(r.torque_nm, rng.uniform(0.1, 0.4), rng.random() < 0.5))


@family("cut off flat")
def torque_clipped_softly(r, rng):
    return replace(r, torque_nm=_cut(r.torque_nm, rng.uniform(0.02, 0.05), rng.random() < 0.5))


@family("cut off flat")
def speed_clipped(r, rng):
    return replace(r, speed_rad_s=_cut(r.speed_rad_s, rng.uniform(0.1, 0.4), rng.random() < 0.5))


@family("cut off flat")
def speed_clipped_softly(r, rng):
    return replace(r, speed_rad_s=_cut(r.speed_rad_s, rng.uniform(0.02, 0.05), rng.random() < 0.5))


@family("cut off flat")
def clipped_without_noise(r, rng):
    top = np.quantile(r.torque_nm[500:], rng.uniform(0.93, 0.98))
    return replace(r, torque_nm=np.minimum(r.torque_nm, top))


FAMILIES[-1] = replace(FAMILIES[-1], trouble=lambda rng: Trouble(quiet=1.0))


@family("at its limit")
def at_the_torque_limit(r, rng):
    return replace(r, torque_limit_nm=float(np.quantile(r.torque_nm, rng.uniform(0.8, 0.97))))


@family("internal limit")
def limit_flagged(r, rng):
    return replace(r, limited=rng.random(len(r.time_s)) < rng.uniform(0.02, 0.5))


@shaft("motor_at_a_limit_that_nobody_declared")
def _(rng):
    return Trouble(torque_limit=rng.uniform(105.0, 150.0))


# -- numbers that are none -----------------------------------------------------------------------------------


@family("not numbers")
def many_nan(r, rng):
    bad = rng.random(len(r.time_s)) < rng.uniform(0.02, 0.9)
    return replace(r, speed_rad_s=np.where(bad, np.nan, r.speed_rad_s))


@family("not numbers")
def many_infinite(r, rng):
    bad = rng.random(len(r.time_s)) < rng.uniform(0.02, 0.9)
    return replace(r, torque_nm=np.where(bad, rng.choice((np.inf, -np.inf)), r.torque_nm))


@family("not a number")
def a_few_nan(r, rng):
    bad = rng.random(len(r.time_s)) < 0.002
    return replace(r, speed_rad_s=np.where(bad, np.nan, r.speed_rad_s))


@family("no machine", "not numbers")
def huge(r, rng):
    return replace(r, speed_rad_s=r.speed_rad_s * 10.0 ** rng.integers(20, 308))


@family("no machine")
def huge_torque(r, rng):
    return replace(r, torque_nm=r.torque_nm * 10.0 ** rng.integers(20, 300))


@family()
def tiny(r, rng):
    return replace(r, torque_nm=r.torque_nm * 10.0 ** -rng.integers(20, 300), torque_resolution_nm=0.0)


@family("spike")
def spiked(r, rng):
    speed = r.speed_rad_s.copy()
    speed[rng.integers(0, len(speed), rng.integers(1, 20))] = rng.choice((6553.5, -3276.8, 1e9))
    return replace(r, speed_rad_s=speed)


@family("not numbers")
def words(r, rng):
    return replace(r, torque_nm=r.torque_nm.astype(object if rng.random() < 0.5 else str))


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


# -- how much there is ---------------------------------------------------------------------------------------


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


@family("stuck")
def feedback_stuck(r, rng):
    speed, torque = r.speed_rad_s.copy(), r.torque_nm.copy()
    begin = int(np.searchsorted(r.time_s, moment(rng)))
    end = begin + int(rng.integers(150, 1500))
    speed[begin:end], torque[begin:end] = speed[begin], torque[begin]
    return replace(r, speed_rad_s=speed, torque_nm=torque)


@family("stuck")
def one_signal_stuck(r, rng):
    signal = r.torque_nm.copy()
    begin = int(np.searchsorted(r.time_s, moment(rng)))
    signal[begin : begin + int(rng.integers(200, 1000))] = signal[begin]
    return replace(r, torque_nm=signal)


# -- signs and columns ---------------------------------------------------------------------------------------


@family("sign")
def torque_reversed(r, rng):
    return replace(r, torque_nm=-r.torque_nm)


@family("place")
def columns_exchanged(r, rng):
    return replace(r, torque_nm=r.speed_rad_s, speed_rad_s=r.torque_nm, torque_resolution_nm=0.0105,
                   speed_resolution_rad_s=0.5)


@family("copy")
def speed_twice(r, rng):
    return replace(r, torque_nm=r.speed_rad_s)


# -- other motion than was declared --------------------------------------------------------------------------


@family()
def no_excitation_and_no_motion(r, rng):
    """Steady speed with noise: without a word of what was run, there is nothing to go by."""
    count = len(r.time_s)
    return replace(
        r, excitation=None if rng.random() < 0.5 else replace(r.excitation, segments=()),
        speed_rad_s=np.round((3.0 + 0.02 * rng.standard_normal(count)) / 0.0105) * 0.0105,
        torque_nm=np.round(84.0 + 3.0 * rng.standard_normal(count)),
    )


@family("clear", "usable")
def other_lines(r, rng):
    return declaring(r, lines_hz=(0.4, 0.6, 0.7, 0.9))


@family("clear", "repeats every", "undeclared")
def other_period(r, rng):
    period = float(rng.uniform(6.0, 9.0))
    return declaring(r, period_s=period, lines_hz=tuple(round(line * PERIOD_S) / period for line in LINES))


@family("no sample lies within")
def elsewhere(r, rng):
    shift = float(rng.choice((-1e4, 1e4, 1e9)))
    segments = tuple(replace(s, start_s=s.start_s + shift, end_s=s.end_s + shift) for s in r.excitation.segments)
    return replace(r, excitation=replace(r.excitation, segments=segments))


@family("overlap")
def overlapping(r, rng):
    return declaring(r, start_s=LEAD_S, end_s=LEAD_S + 60.0)


@family("segment 1")
def nonsense(r, rng):
    return declaring(r, **dict([list({
        "period_s": float(rng.choice((0.0, -10.0, np.nan, np.inf, 1e-9))),
        "lines_hz": ((), (0.1, 0.1), (0.1, np.nan), (-0.1, 0.2), (0.0, 0.1), (0.13, 0.21))[rng.integers(6)],
        "end_s": float(rng.choice((np.nan, -np.inf, -50.0))),
        "settle_periods": -3,
    }.items())[rng.integers(4)]]))


@shaft("undeclared_tone", "undeclared")
def _(rng):
    return Trouble(undeclared=rng.uniform(0.3, 0.5), undeclared_hz=float(rng.choice((0.15, 0.4, 0.45, 0.7))))


@shaft("hunting", "undeclared", "weak", "clear", "equations")
def _(rng):
    return Trouble(hunting=rng.uniform(90.0, 140.0), hunting_hz=rng.uniform(0.6, 1.2))


# -- sampling ------------------------------------------------------------------------------------------------


@shaft("sampled_slowly", "aliased", "too few")
def _(rng):
    return Trouble(rate_hz=rng.uniform(0.6, 1.1))


@family("aliased")
def thinned(r, rng):
    return taken(r, slice(0, None, int(rng.integers(95, 140))))


@shaft("ripple_folded_down", "undeclared", "contradict", "weak", "clear")
def _(rng):
    return Trouble(ripple=rng.uniform(0.3, 0.6), ripple_hz=100.0 + rng.choice((-1, 1)) * rng.uniform(0.1, 0.6))


# -- friction ------------------------------------------------------------------------------------------------


@shaft("stick_slip", "stick-slip")
def _(rng):
    return Trouble(slow=rng.uniform(0.3, 0.6), fast=rng.uniform(1.5, 3.0), stiction=rng.uniform(0.0, 40.0))


@shaft("turning_back", "backwards", "stick-slip")
def _(rng):
    return Trouble(slow=rng.uniform(-0.2, 0.2), fast=rng.uniform(2.0, 4.0))


@shaft("friction_warms", "drifting")
def _(rng):
    return Trouble(warming=rng.uniform(40.0, 55.0), warming_s=rng.uniform(60.0, 150.0))


@shaft("torque_zero_wanders", "drifting")
def _(rng):
    return Trouble(creep=float(rng.choice((-1.0, 1.0))) * rng.uniform(0.2, 0.4))


# -- what goes with it ---------------------------------------------------------------------------------------


@family("offset")
def offset_unknown(r, rng):
    return replace(r, torque_offset_nm=float(rng.choice((np.nan, np.inf))))


@family("goes with the recording")
def unusable_knowledge(r, rng):
    wrong = float(rng.choice((np.nan, -1.0, np.inf)))
    return (
        replace(r, lag_prior=replace(r.lag_prior, speed_lag_s=wrong, speed_lag_sd_s=0.1)),
        replace(r, speed_resolution_rad_s=wrong),
        replace(r, torque_scale_rel_sd=wrong),
        replace(r, lag_prior=replace(r.lag_prior, torque_lag_s=0.1, torque_lag_sd_s=wrong)),
    )[rng.integers(4)]


RECORD_FAULTS = [f for f in FAMILIES if f.spoil is not None and f.name not in ("words", "lengths_differ", "nonsense")]


@family()
def two_faults(r, rng):
    """Two at random, one upon the other."""
    for number in rng.choice(len(RECORD_FAULTS), 2, replace=False):
        if r.excitation is None or not r.excitation.segments or len(r.time_s) < 3000:
            break
        r = RECORD_FAULTS[number].spoil(r, rng)
    return r

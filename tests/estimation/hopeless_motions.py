"""Columns and signs, motion that differs from the declaration, sampling, friction, and data beside a record."""

from dataclasses import replace

import numpy as np

from tests.estimation.hopeless_family import declaring, families, taken
from tests.estimation.hopeless_shaft import LEAD_S, LINES, PERIOD_S, Trouble

MOTIONS, family, shaft = families()


# -- signs and columns ---------------------------------------------------------------------------------------


@family("sign")
def torque_reversed(r, rng):
    return replace(r, torque_nm=-r.torque_nm)


@family("exchanged")
def columns_exchanged(r, rng):
    return replace(r, torque_nm=r.speed_rad_s, speed_rad_s=r.torque_nm, torque_resolution_nm=0.0105,
                   speed_resolution_rad_s=0.5)


@family("copy")
def speed_twice(r, rng):
    return replace(r, torque_nm=r.speed_rad_s)


# -- motion that differs from the declaration --------------------------------------------------------------------------


@family()
def no_excitation_and_no_motion(r, rng):
    """Steady speed with noise and without a declared motion: there is no information about J."""
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


# -- data beside the record ---------------------------------------------------------------------------------------


@family("offset")
def offset_unknown(r, rng):
    return replace(r, torque_offset_nm=float(rng.choice((np.nan, np.inf))))


@family("of the recording is not a usable number")
def unusable_knowledge(r, rng):
    wrong = float(rng.choice((np.nan, -1.0, np.inf)))
    return (
        replace(r, lag_prior=replace(r.lag_prior, speed_lag_s=wrong, speed_lag_sd_s=0.1)),
        replace(r, speed_resolution_rad_s=wrong),
        replace(r, torque_scale_rel_sd=wrong),
        replace(r, lag_prior=replace(r.lag_prior, torque_lag_s=0.1, torque_lag_sd_s=wrong)),
    )[rng.integers(4)]

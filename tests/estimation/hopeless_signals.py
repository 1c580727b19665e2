"""Signals that hardly change, are cut off at a limit, or are no numbers."""

from dataclasses import replace

import numpy as np

from tests.estimation.hopeless_family import families
from tests.estimation.hopeless_shaft import Trouble

SIGNALS, family, shaft = families()


# -- no motion, or very little --------------------------------------------------------------------------------


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


SIGNALS[-1] = replace(SIGNALS[-1], trouble=lambda rng: Trouble(quiet=1.0))


@family("at its limit")
def at_the_torque_limit(r, rng):
    return replace(r, torque_limit_nm=float(np.quantile(r.torque_nm, rng.uniform(0.8, 0.97))))


@family("internal limit")
def limit_flagged(r, rng):
    return replace(r, limited=rng.random(len(r.time_s)) < rng.uniform(0.02, 0.5))


@shaft("motor_at_a_limit_that_nobody_declared")
def _(rng):
    return Trouble(torque_limit=rng.uniform(105.0, 150.0))


# -- values that are no numbers -----------------------------------------------------------------------------------


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

"""Simulation of a drill string under bit noise as a chain of masses and springs: an oracle independent of the product.

The method is symplectic Euler: spring torques from angles, speeds from torques, angles from speeds. The step of a lag
is exact for a constant input. The chain uses no wave, no transmission line, no delay and no matrix exponential.
"""

from __future__ import annotations

from math import exp, pi, sqrt

import numpy as np
from scipy.signal import lfilter


def lowest_turning_of_chain(
    *, length_m, polar_m4, shear_pa, density, drag, bottom_inertia, bottom_viscous, coulomb_nm, static_nm,
    stribeck_rad_s, noise_nm, noise_correlation_s, inertia, viscous, dry_nm, lags_s, laws, seed, period_s, lumps=30,
    wall_nm=0.0, collars=None, coarse=13, fine=8, lowest=10.0, highest=240.0,
):
    """Return for each law (P, I, J_c, filter) the lowest set speed, rpm, at and above which a stuck bit comes free.

    Infinite: none. A simulation lasts for 12 periods or 12 of the longest integral time P/I, and the bit must turn in
    its last quarter.
    """
    periods = 12.0 * max(1.0, *(gain / integral / period_s for gain, integral, _, _ in laws))
    speeds = np.geomspace(lowest, highest, coarse)

    def turns(rpm):
        return ends_turning(
            length_m=length_m, polar_m4=polar_m4, shear_pa=shear_pa, density=density, drag=drag,
            bottom_inertia=bottom_inertia, bottom_viscous=bottom_viscous, coulomb_nm=coulomb_nm, static_nm=static_nm,
            stribeck_rad_s=stribeck_rad_s, noise_nm=noise_nm, noise_correlation_s=noise_correlation_s,
            inertia=inertia, viscous=viscous, dry_nm=dry_nm, lags_s=lags_s, laws=laws, seed=seed, rpm=rpm,
            period_s=period_s, lumps=lumps, wall_nm=wall_nm, collars=collars, periods=periods, calm=0.25 * periods)

    def first(row):
        sticking = np.flatnonzero(~row)
        return int(sticking[-1]) + 1 if sticking.size else 0

    at = [first(row) for row in turns(np.tile(speeds, (len(laws), 1)))]
    ratio = speeds[1] / speeds[0]
    top = speeds[np.minimum(at, coarse - 1)]
    grid = top[:, None] * ratio ** (np.arange(1, fine + 1) / fine - 1.0)
    found = turns(grid)
    found[:, -1] = True
    return np.array([grid[k, first(found[k])] if at[k] < coarse else np.inf for k in range(len(laws))])


def ends_turning(
    *, length_m, polar_m4, shear_pa, density, drag, bottom_inertia, bottom_viscous, coulomb_nm, static_nm,
    stribeck_rad_s, noise_nm, noise_correlation_s, inertia, viscous, dry_nm, lags_s, laws, seed, rpm, period_s, lumps,
    wall_nm=0.0, collars=None, periods=12.0, calm=3.0, kept=None, keep_every_s=0.02, own_noise=False,
):
    """Return as (laws, speeds) whether the bit turns in the last ``calm`` periods. It is about to break away at first.

    ``collars``: (length in m, polar moment in m⁴, lumps) of a second section below the pipe.
    ``kept``: a list to which (time, torque on the rotor, speed of the top, speed of the bit) are appended; the signals
    have shape (cases,). ``own_noise``: every case has its own bit noise.
    """
    sections = [(length_m, polar_m4, lumps)] + ([collars] if collars else [])
    spring, mass, loss = np.empty((0, 1)), np.zeros(1), np.zeros(1)
    for length, polar, parts in sections:      # half of a cell's mass and loss is at each of its ends
        cell = length / parts
        spring = np.vstack([spring, np.full((parts, 1), shear_pa * polar / cell)])
        ends = np.full(parts + 1, cell)
        ends[[0, -1]] *= 0.5
        mass, loss = (np.append(above, np.zeros(parts)) for above in (mass, loss))
        mass[-parts - 1 :] += density * polar * ends
        loss[-parts - 1 :] += drag * ends
    fastest = max(2.0 / cell for cell in (length / parts for length, _, parts in sections)) * sqrt(shear_pa / density)
    lumps = len(spring)
    wall = np.full(lumps + 1, wall_nm / lumps)
    wall[[0, -1]] *= 0.5
    mass[0] += inertia
    mass[-1] += bottom_inertia
    loss[0] += viscous
    loss[-1] += bottom_viscous
    step = min(0.004, 0.25 / fastest)
    target = (np.asarray(rpm) * pi / 30.0)
    cases = target.size
    laws = np.repeat(np.array(laws, dtype=float), target.shape[1], axis=0)
    gain, integral, back, filter_s = laws.T
    target = target.ravel()
    angle = np.zeros((lumps + 1, cases))
    angle[:-1] = np.cumsum((static_nm / spring)[::-1], axis=0)[::-1]
    speed = np.zeros((lumps + 1, cases))
    speed[0] = target
    summed = np.full(cases, float(static_nm)) + viscous * target + dry_nm
    lag = [summed.copy() for _ in lags_s]
    keep = [exp(-step / tau) for tau in lags_s]
    smooth, keep_filter = target.copy(), np.exp(-step / filter_s)
    random = np.random.default_rng(seed)
    slow = exp(-step / noise_correlation_s)
    noise = random.standard_normal(cases if own_noise else None) * noise_nm
    count = int(periods * period_s / step)
    last = np.zeros(cases)
    per_mass, per_loss = step / mass[:, None], loss[:, None]
    draws = random.standard_normal((count, cases) if own_noise else count) * noise_nm * sqrt(1.0 - slow * slow)
    every = max(1, round(keep_every_s / step))
    for k in range(count):
        noise = slow * noise + draws[k]
        torque = spring * (angle[:-1] - angle[1:])
        top = speed[0]
        error = target - top
        summed += step * integral * error
        demand = gain * error + summed + back * (top - smooth) / filter_s
        smooth = keep_filter * smooth + (1.0 - keep_filter) * top
        for number, one in enumerate(keep):
            lag[number] = demand = one * lag[number] + (1.0 - one) * demand
        net = -per_loss * speed
        net[1:] += torque
        net[:-1] -= torque
        net[0] += demand - dry_nm * np.clip(top / 0.05, -1.0, 1.0)
        if wall_nm:
            net[1:-1] -= wall[1:-1, None] * np.tanh(speed[1:-1] / 0.05)
        bit = speed[-1]
        net[-1] -= noise
        side = np.where(bit != 0.0, np.sign(bit), np.sign(net[-1]))
        holds = (bit == 0.0) & (np.abs(net[-1]) <= static_nm)
        net[-1] -= side * (coulomb_nm + (static_nm - coulomb_nm) * np.exp(-((bit / stribeck_rad_s) ** 2)))
        speed += per_mass * net
        speed[-1, holds | (speed[-1] * side < 0.0)] = 0.0
        angle += step * speed
        last[speed[-1] == 0.0] = k
        if kept is not None and k % every == 0:
            kept.append((step * (k + 1), demand.copy(), speed[0].copy(), speed[-1].copy()))
    return (last < count * (1.0 - calm / periods)).reshape(np.asarray(rpm).shape)


def reference_case(**other):
    """Return the keywords of the reference case: 3,000 m of 5 inch pipe, bit and top drive of cases.py."""
    polar = pi / 32.0 * (0.127**4 - 0.1086**4)
    return {
        "length_m": 3000.0, "polar_m4": polar, "shear_pa": 79.3e9, "density": 7850.0, "drag": 0.005,
        "bottom_inertia": 374.0, "bottom_viscous": 20.0, "coulomb_nm": 2500.0, "static_nm": 5000.0,
        "stribeck_rad_s": 2.5, "noise_nm": 200.0, "noise_correlation_s": 0.2, "inertia": 1500.0, "viscous": 8.0,
        "dry_nm": 60.0, "lags_s": (0.020, 0.010, 0.003), "laws": [(20286.0, 26454.0, 0.0, 0.05)], "seed": 1,
        "period_s": 7.7, "lumps": 20, **other,
    }


def recorded(**said):
    """Return time (N,), and torque on the rotor, speed of the top and speed of the bit, (N, cases) each."""
    kept = []
    ends_turning(**said, kept=kept)
    time, torque, top, bit = zip(*kept, strict=True)
    return np.array(time), np.array(torque), np.array(top), np.array(bit)


def reported(time_s, torque, top, lags_s=(0.1, 0.05), seed=1, noise=(0.01, 40.0), quanta=(0.002, 20.0)):
    """Return time, speed and torque as a drive reports them: first-order lags (speed, torque), noise and resolution."""
    random = np.random.default_rng([seed, 99])
    found = []
    for signal, lag, sd, quantum in zip((top, torque), lags_s, noise, quanta, strict=True):
        keep = exp(-(time_s[1] - time_s[0]) / lag)
        late = lfilter([1.0 - keep], [1.0, -keep], signal, zi=[keep * signal[0]])[0]
        found.append(np.round((late + sd * random.standard_normal(len(late))) / quantum) * quantum)
    return time_s, found[0], found[1]

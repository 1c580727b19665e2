"""Critical speeds of a virtual string on a shaft that is disturbed, by simulation with the torque that was observed.

A bench is disturbed as a rig is: by its load, its sensor, its resolution. A virtual string multiplies these torques by
the ratio of the inertias, 50 on a bench of 30 kg·m². Below the noise-free critical speed, steady rotation is often
stable beside stick-slip. So a disturbance moves the bit from one to the other, and the outcome of a trial is a matter
of chance over a range of set speeds.

The observer of the run estimates the disturbing torque in each cycle. Trials are simulated with this record: shifted in
time and with either sign, so that each trial gets another course of the same spectrum. The range begins at the lowest
set speed at which one of the trials turns, and ends at the highest at which one of them sticks.
"""

from __future__ import annotations

from math import ceil

import numpy as np
from numpy.typing import NDArray

from tdhil.soft_torque.controller import SpeedController, TopDrive
from tdhil.soft_torque.drill_string import DrillString
from tdhil.soft_torque.simulation import RPM, Array, Begin, TopDisturbance, coarse_tick_s, simulate
from tdhil.soft_torque.uncertainty import Interval
from tdhil.soft_torque.virtual_string import SpeedProgram

TRIALS, TRIAL_SEED = 24, 11
"""Number of simulated trials at each set speed, and the seed of their shifts. A set speed with an outcome in 1 of 24
trials is inside the range, so that the range covers about 95 %."""
BELOW_SHARE, STEP_RPM = 0.6, 1.0
"""Lowest simulated set speed as a share of the predicted one; and distance of the set speeds, rpm."""
LONGEST_SAMPLE_S = 0.1
"""Longest sampling time of the disturbance, s. The observer follows within 0.2 s."""


def disturbed_range(
    string: DrillString, drive: TopDrive, law: SpeedController, program: SpeedProgram, predicted_rpm: Interval,
    unknown_nm: Array, period_s: float,
) -> Interval:
    """Return the predicted critical speed, rpm, with the range in which it lies under the disturbance.

    ``unknown_nm``: unknown torque of the observer at each cycle of ``period_s``, N·m at the main shaft. The range
    contains ``predicted_rpm``. Raises ValueError if no bit is stated.
    """
    lowest, highest = BELOW_SHARE * predicted_rpm.low, max(program.highest_rad_s / RPM, predicted_rpm.high)
    speeds_rpm = np.linspace(lowest, highest, ceil((highest - lowest) / STEP_RPM) + 1)
    turns = _turning_trials(string, drive, law, program, speeds_rpm, unknown_nm, period_s)
    turn, stick = speeds_rpm[turns.any(axis=0)], speeds_rpm[~turns.all(axis=0)]
    return Interval(
        predicted_rpm.value,
        min(predicted_rpm.low, float(turn[0]) if turn.size else predicted_rpm.low),
        max(predicted_rpm.high, float(stick[-1]) if stick.size else predicted_rpm.high))


def _turning_trials(
    string: DrillString, drive: TopDrive, law: SpeedController, program: SpeedProgram, speeds_rpm: Array,
    unknown_nm: Array, period_s: float,
) -> NDArray[np.bool_]:
    """Return for each trial and set speed whether the bit turns, by the rule of the run: calm within the trial."""
    random = np.random.default_rng(TRIAL_SEED)
    each = max(1, round(LONGEST_SAMPLE_S / period_s))
    count = max(1, len(unknown_nm) // each)
    means = unknown_nm[: count * each].reshape(count, -1).mean(axis=1)
    means = means - means.mean()
    courses = np.array([random.choice((-1.0, 1.0)) * np.roll(means, int(random.integers(count)))
                        for _ in range(TRIALS)])
    target = np.tile(speeds_rpm * RPM, (TRIALS, 1))
    tick_s = coarse_tick_s(string)
    trace = simulate(string, [(drive, law)] * TRIALS, Begin("stuck", target), target, 1.0, program.trial_s,
                     keep_every_s=tick_s, longest_tick_s=tick_s, disturbance=TopDisturbance(courses, each * period_s))
    at = np.arange(len(trace.time_s))[:, None, None]
    since = at - np.maximum.accumulate(np.where(trace.bit_rad_s == 0.0, at, -1), axis=0)
    calm = program.calm_s / (trace.time_s[1] - trace.time_s[0])
    turned: NDArray[np.bool_] = since.max(axis=0) >= calm
    return turned

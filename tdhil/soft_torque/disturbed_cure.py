"""Critical speeds of a virtual string on a shaft that is disturbed, by simulation with the torque that was observed.

A bench is disturbed as a rig is: by its load, its sensor, its resolution. A virtual string multiplies these torques by
the ratio of the inertias, 50 on a bench of 30 kg·m². Below the noise-free critical speed, steady rotation is often
stable beside stick-slip. So a disturbance moves the bit from one to the other, and the outcome of a trial is a matter
of chance over a range of set speeds.

The observer of the run estimates the disturbing torque in each cycle. Trials are simulated with this record: shifted in
time and with either sign, so that each trial gets another course of the same spectrum. An outcome of the run agrees
with the prediction if it occurs in one of the simulated trials at a set speed nearby.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, inf

import numpy as np
from numpy.typing import NDArray

from tdhil.soft_torque.controller import SpeedController, TopDrive
from tdhil.soft_torque.critical_speed import coarse_tick_s
from tdhil.soft_torque.drill_string import DrillString
from tdhil.soft_torque.simulation import RPM, Array, Begin, TopDisturbance, simulate
from tdhil.soft_torque.uncertainty import Interval
from tdhil.soft_torque.virtual_string import SpeedProgram

TRIALS, TRIAL_SEED = 24, 11
"""Number of simulated trials at each set speed, and the seed of their shifts. An outcome with a probability of 10 %
occurs in one or more of them in 92 % of the cases."""
BELOW_SHARE, STEP_RPM = 0.6, 1.0
"""Lowest simulated set speed as a share of the predicted one; and distance of the set speeds, rpm."""
LONGEST_SAMPLE_S = 0.1
"""Longest sampling time of the disturbance, s. The observer follows within 0.2 s."""
KEPT_EVERY_S = 0.05
"""Shortest distance, s, of the samples in which a standstill of the bit is searched. A bit that sticks stands for some
tenths of a second."""


@dataclass(frozen=True)
class DisturbedTrials:
    """Simulated trials under the observed torque."""

    speeds_rpm: Array
    """Set speeds, (N,)."""
    turning: NDArray[np.int_]
    """Number of the `TRIALS` at each set speed in which the bit turns, (N,)."""

    def distance_rpm(self, critical_rpm: Interval) -> float:
        """Return how far the bracket of a critical speed is from outcomes that occur in the simulation, rpm.

        ``critical_rpm``: the trial at ``low`` stuck, and the trial at ``value`` turned.
        """
        turn, stick = self.speeds_rpm[self.turning > 0], self.speeds_rpm[self.turning < TRIALS]
        return float(max(np.abs(turn - critical_rpm.value).min(initial=inf),
                         np.abs(stick - critical_rpm.low).min(initial=inf)))

    def turning_at(self, speed_rpm: float) -> int:
        """Return the number of trials in which the bit turns, at the simulated set speed nearest to ``speed_rpm``."""
        return int(self.turning[np.argmin(np.abs(self.speeds_rpm - speed_rpm))])


def disturbed_trials(
    string: DrillString, drive: TopDrive, law: SpeedController, program: SpeedProgram, predicted_rpm: Interval,
    unknown_nm: Array, period_s: float,
) -> DisturbedTrials:
    """Return simulated trials at set speeds around the predicted critical speed.

    The bit turns in a trial by the rule of the run: calm within the trial.
    ``unknown_nm``: unknown torque of the observer at each cycle of ``period_s``, N·m at the main shaft. Raises
    ValueError if no bit is stated.
    """
    lowest, highest = BELOW_SHARE * predicted_rpm.low, max(program.highest_rad_s / RPM, predicted_rpm.high)
    speeds_rpm = np.linspace(lowest, highest, ceil((highest - lowest) / STEP_RPM) + 1)
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
                     keep_every_s=max(tick_s, KEPT_EVERY_S), longest_tick_s=tick_s,
                     disturbance=TopDisturbance(courses, each * period_s))
    at = np.arange(len(trace.time_s))[:, None, None]
    since = at - np.maximum.accumulate(np.where(trace.bit_rad_s == 0.0, at, -1), axis=0)
    turned = since.max(axis=0) >= program.calm_s / (trace.time_s[1] - trace.time_s[0])
    return DisturbedTrials(speeds_rpm, turned.sum(axis=0))

"""Check of the mean torque of stage 5 against the torque of the steady levels of stage 2 at the same mean speed.

The mean torque over whole periods is the load at the mean speed, without an effect of the lags. If the torque scale
changes between the stages, equally in every report, the mean torque changes by the same factor as J. Above a drill
string no other check shows this: the ramps of stage 2 give J only to a factor of two there.

A load may also change by itself. Friction falls while oil and bearings warm up, so a smaller torque is weaker evidence
than a larger one. The bounds are therefore wide: they detect a torque scale that halves or doubles, but no small
change. Levels of one speed are not compared with each other. On sound rigs with a slowly changing load, one level had
2.4 times the torque of the other (three of 68 runs of `benchmarks/healthy_runs.py` above 1.7), and neither shows its
own uncertainty.
"""

import math
from dataclasses import dataclass

import numpy as np

from profiles import MessageCode
from tdhil.estimation.case import Case, Finding
from tdhil.estimation.result import Refusal
from tdhil.estimation.samples import Samples, excited_window
from tdhil.recording import Recording

LEAST, MOST = 0.55, 1.7
"""Bounds of the ratio of mean torques; 0.79 to 1.19 over 30 random healthy rigs (`benchmarks/healthy_runs.py`)."""

_BEYOND = 0.25
"""Largest distance of the mean speed from the levels, as a share of their own distance: further out the line is
uncertain.
"""

_CLEAR_SDS = 5.0
"""Least difference of the torques, in standard deviations of the torque's block means."""

_BLOCK_S = 2.0            # s; block of a level. The blocks of a segment are its periods
_FEWEST = 20              # fewest samples of a stretch


@dataclass(frozen=True)
class LevelTorque:
    """Mean torque of an excited segment, and the torque by the levels at its mean speed, N·m."""

    speed_rad_s: float
    torque_nm: float
    by_levels_nm: float
    sd_nm: float

    @property
    def ratio(self) -> float:
        """Return the mean torque over the torque by the levels."""
        return self.torque_nm / self.by_levels_nm if self.by_levels_nm != 0.0 else math.inf


def level_torques(recording: Recording, samples: Samples) -> tuple[LevelTorque, ...]:
    """Compare each excited segment with a mean speed near the levels; () without two levels of different speed."""
    if recording.excitation is None:
        return ()
    steady = (_mean(samples.between(level.start_s, level.end_s), _BLOCK_S) for level in recording.levels)
    levels = [mean for mean in steady if mean is not None]
    if len(levels) < 2:
        return ()
    speeds, torques, sds = (np.array(column) for column in zip(*levels, strict=True))
    span = float(np.ptp(speeds))
    if not span > 0.1 * float(np.max(np.abs(speeds))):
        return ()
    slope, at_zero = np.polyfit(speeds, torques, 1)
    found = []
    for segment in recording.excitation.segments:
        mean = _mean(samples.between(*excited_window(segment)), segment.period_s)
        if mean is None:
            continue
        speed, torque, sd = mean
        if not min(speeds) - _BEYOND * span <= speed <= max(speeds) + _BEYOND * span:
            continue
        found.append(LevelTorque(speed, torque, float(at_zero + slope * speed), math.hypot(sd, float(np.max(sds)))))
    return tuple(found)


def least_torque_scale_change(recording: Recording, samples: Samples) -> float | None:
    """Return the least relative change of the torque scale that the mean torques show; None without a comparison."""
    ratios = [one.ratio for one in level_torques(recording, samples) if one.ratio > 0.0]
    return min((max(ratio / LEAST, MOST / ratio) - 1.0 for ratio in ratios), default=None)


def level_contradiction(recording: Recording, samples: Samples) -> Refusal | None:
    """Return the contradiction if the mean torque is far from the torque by the levels; else None."""
    for one in level_torques(recording, samples):
        apart = abs(one.torque_nm - one.by_levels_nm)
        if LEAST <= one.ratio <= MOST or apart <= _CLEAR_SDS * one.sd_nm:
            continue
        return Refusal(
            f"the mean torque of stage 5 is {one.torque_nm:.4g} N·m at {one.speed_rad_s:.3g} rad/s. The operating "
            f"points of stage 2 give {one.by_levels_nm:.4g} N·m there (ratio {one.ratio:.2f}, limits {LEAST:g} to "
            f"{MOST:g}). The torque scale or the load changed during the run",
            "check that the torque scale and the load stay the same in all stages. Then repeat the run",
            MessageCode.TORQUE_AT_SPEED_CHANGED,
        )
    return None


def level_checked(finding: Finding, case: Case) -> Finding:
    """Return the finding, without its inertia if the mean torque contradicts the levels. Never raises."""
    if finding.inertia is None or not case.sound:
        return finding
    contradiction = level_contradiction(case.recording, case.samples)
    if contradiction is None:
        return finding
    return finding.taken_back(contradiction)


def _mean(samples: Samples, block_s: float) -> tuple[float, float, float] | None:
    """Return mean speed, mean torque and the standard deviation of the mean torque; None for less than two blocks."""
    if len(samples) < _FEWEST:
        return None
    blocks = np.floor((samples.time_s - samples.time_s[0]) / block_s + 1e-9)
    means = np.array([float(np.mean(samples.torque_nm[blocks == block])) for block in np.unique(blocks)])
    if len(means) < 2:
        return None
    sd = float(np.std(means, ddof=1)) / math.sqrt(len(means))
    return float(np.mean(samples.speed_rad_s)), float(np.mean(samples.torque_nm)), sd

"""The torque of steady turning, compared at equal speed: levels with one another, and stage 5 with the levels.

The mean torque over whole periods is the load at the mean speed, free of every lag. Where the torque's scale changes
between the stages, in every report alike, the mean torque changes by the same factor as J does. Above a drill string
nothing else shows it: the ramps of stage 2 give J there to a factor of two at best.

A run returns to a speed that it held before. Where the scale changes within stage 2, the torque of the two differs by
the same factor, and every later report agrees with the wrong scale.

A load may change by itself. Friction falls while oil and bearings warm up, so a smaller torque shows less than a larger
one. The bounds are wide for that reason: they find a torque scale that halves or doubles, and no small change.
"""

import math
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from profiles import MessageCode
from tdhil.estimation.case import Case, Finding
from tdhil.estimation.cross_checks.momentum import block_means, calm_spans, periodic_segments
from tdhil.estimation.result import Refusal
from tdhil.estimation.samples import Samples, excited_window
from tdhil.recording import Recording

LEAST, MOST = 0.55, 1.7
"""Bounds of the ratio of mean torques; 0.79 to 1.19 over 30 random healthy rigs (`benchmarks/healthy_runs.py`)."""

_BEYOND = 0.25
"""How far the mean speed may lie beyond the levels, as a share of their distance: further out a line says little."""

_SAME_SPEED = 0.03
"""Share of the greatest speed: stretches closer than this have the same friction, within some percent."""

_CLEAR_SDS = 5.0
"""Standard deviations of the torque's block means by which the torque must differ."""

_BLOCK_S = 2.0            # of a level; a segment's blocks are its periods
_REPEAT_BLOCK_S, _REPEAT_BLOCKS = 1.0, 3
"""Of a calm stretch, s, and how many it must have: fewer show neither its scatter nor a swing of the load."""
_ADVICE = ("check that torque is reported with one scale in all stages and that the load stays the same; then run it"
           " again")
_FEWEST = 20              # samples of a stretch


@dataclass(frozen=True)
class LevelTorque:
    """Mean torque of an excited segment, and the torque that the levels account for at its mean speed, N·m."""

    speed_rad_s: float
    torque_nm: float
    by_levels_nm: float
    sd_nm: float

    @property
    def ratio(self) -> float:
        """Return the mean torque as a multiple of what the levels account for."""
        return self.torque_nm / self.by_levels_nm if self.by_levels_nm != 0.0 else math.inf


def level_torques(recording: Recording, samples: Samples) -> tuple[LevelTorque, ...]:
    """Compare each excited segment whose mean speed lies among the levels; () without two levels of unlike speed."""
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


def level_contradiction(recording: Recording, samples: Samples) -> Refusal | None:
    """Return the first contradiction between torques at equal speed; None if they agree."""
    return _stage_5_contradiction(recording, samples) or _repeat_contradiction(recording, samples)


def _repeat_contradiction(recording: Recording, samples: Samples) -> Refusal | None:
    """Compare each calm stretch outside of the excitation with the later ones at its speed.

    Not above a drill string: its torque swings by more than friction while the speed is held.
    """
    blocks = None if recording.winds_up else block_means(samples)
    if blocks is None:
        return None
    steady = []
    for span in calm_spans(blocks, periodic_segments(recording)):
        mean = _mean(samples.between(span.start_s, span.end_s), _REPEAT_BLOCK_S, _REPEAT_BLOCKS)
        if mean is not None:
            steady.append((0.5 * (span.start_s + span.end_s), *mean))
    if not steady:
        return None
    fastest = max(abs(speed) for _, speed, _, _ in steady)
    usual_sd = float(np.median([sd for *_, sd in steady]))       # a few blocks may scatter little by chance
    for (time, speed, torque, sd), (later_time, later_speed, later, later_sd) in combinations(steady, 2):
        clear_nm = _CLEAR_SDS * math.hypot(max(sd, usual_sd), max(later_sd, usual_sd))
        ratio = later / torque if torque != 0.0 else math.inf
        alike = abs(later_speed - speed) <= _SAME_SPEED * fastest
        if not alike or LEAST <= ratio <= MOST or abs(later - torque) <= clear_nm:
            continue
        return Refusal(
            f"at {speed:.3g} rad/s the mean torque is {torque:.4g} N·m at {time:.0f} s and {later:.4g} N·m at"
            f" {later_time:.0f} s ({ratio:.2f} times, limits {LEAST:g} to {MOST:g}): the scale of torque or the load"
            " changed during the run",
            _ADVICE, MessageCode.TORQUE_AT_SPEED_CHANGED,
        )
    return None


def _stage_5_contradiction(recording: Recording, samples: Samples) -> Refusal | None:
    for one in level_torques(recording, samples):
        apart = abs(one.torque_nm - one.by_levels_nm)
        if LEAST <= one.ratio <= MOST or apart <= _CLEAR_SDS * one.sd_nm:
            continue
        return Refusal(
            f"the mean torque of stage 5 is {one.torque_nm:.4g} N·m at {one.speed_rad_s:.3g} rad/s, and the levels of"
            f" stage 2 account for {one.by_levels_nm:.4g} N·m there ({one.ratio:.2f} times, limits {LEAST:g} to"
            f" {MOST:g}): the scale of torque or the load changed during the run",
            _ADVICE, MessageCode.TORQUE_AT_SPEED_CHANGED,
        )
    return None


def level_checked(finding: Finding, case: Case) -> Finding:
    """Return the finding, taken back where the mean torque contradicts the levels. Never raises."""
    if finding.inertia is None or not case.sound:
        return finding
    contradiction = level_contradiction(case.recording, case.samples)
    if contradiction is None:
        return finding
    return Finding(
        finding.model, finding.words, finding.residual, lines=finding.lines, samples_used=finding.samples_used,
        warnings=finding.warnings, contradiction=contradiction,
    )


def _mean(samples: Samples, block_s: float, fewest: int = 2) -> tuple[float, float, float] | None:
    """Return mean speed, mean torque and the standard deviation of the latter; None for less than ``fewest`` blocks."""
    if len(samples) < _FEWEST:
        return None
    blocks = np.floor((samples.time_s - samples.time_s[0]) / block_s + 1e-9)
    means = np.array([float(np.mean(samples.torque_nm[blocks == block])) for block in np.unique(blocks)])
    if len(means) < fewest:
        return None
    sd = float(np.std(means, ddof=1)) / math.sqrt(len(means))
    return float(np.mean(samples.speed_rad_s)), float(np.mean(samples.torque_nm)), sd

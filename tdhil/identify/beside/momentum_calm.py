"""Where a run stood calm, and where it coasted: read off half-second means of what was reported, whoever ran it.

Calm is what every reporting lag agrees on: while speed hardly changes, reported and true speed and torque are the same,
whatever filters stand between. Between two calm stretches a momentum balance needs no model of the reports
(`momentum_rows`). Coasting is motion without torque: there the torque's lag has nothing to act on.
"""

from dataclasses import dataclass

import numpy as np

from tdhil.estimation.samples import Samples
from tdhil.recording.recording import BoolArray, FloatArray, Segment

BLOCK_S = 0.5
_MOST_BLOCKS = 1_000_000
_CALM_PER_S = 0.02        # of the range of speed per second: costs a lag of 0.5 s some 1 % of a full change of speed
_DRIFT_PER_S = 0.05       # slow enough to take J times the acceleration off and keep the friction
_POINT_WIDTH = 0.15       # of the fastest: how far the speed may go within one point of a friction curve
_TURNING = 0.05           # of the greatest speed: slower is standstill or creep
_LEAST_CALM = 5           # blocks, the first of which is left to the lags
_LEAST_COAST = 4
_COAST_TORQUE = 0.03      # of the torque that steady turning takes


@dataclass(frozen=True)
class Span:
    """A stretch of time, s."""

    start_s: float
    end_s: float

    @property
    def duration_s(self) -> float:
        return self.end_s - self.start_s


@dataclass(frozen=True)
class Blocks:
    """M means over half a second each, empty ones left out: time of the middle (s), speed, torque, acceleration."""

    time_s: FloatArray
    speed_rad_s: FloatArray
    torque_nm: FloatArray
    acceleration_rad_s2: FloatArray

    def extremes(self, start_s: float, end_s: float) -> tuple[float, float]:
        """Least and greatest speed of the blocks that lie within; (inf, -inf) if none does."""
        half = 0.5 * BLOCK_S
        inside = self.speed_rad_s[(self.time_s >= start_s + half) & (self.time_s <= end_s - half)]
        return (float(inside.min()), float(inside.max())) if len(inside) else (np.inf, -np.inf)


def block_means(samples: Samples) -> Blocks | None:
    """None for too few samples, or times that make no sense as a record."""
    if len(samples) < 16:
        return None
    start, length = float(samples.time_s[0]), float(samples.time_s[-1] - samples.time_s[0])
    if not 4.0 * BLOCK_S <= length < _MOST_BLOCKS * BLOCK_S:
        return None
    edges = start + np.arange(int(length / BLOCK_S) + 1) * BLOCK_S
    first = np.searchsorted(samples.time_s, edges)
    counts = np.diff(np.append(first, len(samples)))
    kept = counts > 0
    if np.any(counts < 0) or np.count_nonzero(kept) < 4:
        return None
    means = [np.add.reduceat(x, first[kept]) / counts[kept] for x in (samples.speed_rad_s, samples.torque_nm)]
    time = (edges + 0.5 * BLOCK_S)[kept].astype(np.float64)
    speed, torque = (mean.astype(np.float64) for mean in means)
    acceleration = np.gradient(speed, time).astype(np.float64)
    return Blocks(time, speed, torque, acceleration)


def calm_spans(blocks: Blocks, excluded: tuple[Segment, ...]) -> tuple[Span, ...]:
    """Stretches of 2 s or more at a steady speed other than zero, outside of the excited segments.

    The first half second is left out: there a lag still brings something of what was before.
    """
    return _slower_than(_CALM_PER_S, blocks, excluded)


def drifting_spans(blocks: Blocks, excluded: tuple[Segment, ...]) -> tuple[Span, ...]:
    """Calm ones, and others of 2 s or more in which speed drifts slowly, cut where it goes too far for one point."""
    fastest = float(np.max(np.abs(blocks.speed_rad_s)))
    found = []
    for span in _slower_than(_DRIFT_PER_S, blocks, excluded):
        inside = np.flatnonzero((blocks.time_s > span.start_s) & (blocks.time_s < span.end_s))
        start, begun = span.start_s, float(blocks.speed_rad_s[inside[0]])
        for at in inside:
            end = float(blocks.time_s[at]) + 0.5 * BLOCK_S
            if abs(float(blocks.speed_rad_s[at]) - begun) > _POINT_WIDTH * fastest:
                found.append(Span(start, end))
                start, begun = end, float(blocks.speed_rad_s[at])
        found.append(Span(start, span.end_s))
    return tuple(span for span in found if span.duration_s >= (_LEAST_CALM - 1) * BLOCK_S)


def _slower_than(rate_per_s: float, blocks: Blocks, excluded: tuple[Segment, ...]) -> tuple[Span, ...]:
    """Runs of blocks in which the speed changes by less than a share of its range per second, from the second on."""
    speed = np.abs(blocks.speed_rad_s)
    fastest, reach = float(np.max(speed)), float(np.ptp(blocks.speed_rad_s))
    calm = (np.abs(blocks.acceleration_rad_s2) <= rate_per_s * reach) & (speed > _TURNING * fastest)
    for segment in excluded:
        calm &= (blocks.time_s < segment.start_s - 0.5 * BLOCK_S) | (blocks.time_s > segment.end_s + 0.5 * BLOCK_S)
    return tuple(Span(span.start_s + BLOCK_S, span.end_s) for span in _runs(calm, blocks.time_s, _LEAST_CALM))


def coasting_spans(blocks: Blocks, calm: tuple[Span, ...], torque_resolution_nm: float) -> tuple[Span, ...]:
    """Stretches of 2 s or more in which the shaft slows down and the drive gives no torque."""
    level = np.zeros(len(blocks.time_s), dtype=np.bool_)
    for span in calm:
        level |= (blocks.time_s >= span.start_s) & (blocks.time_s <= span.end_s)
    if not np.any(level):
        return ()
    usual = float(np.median(np.abs(blocks.torque_nm[level])))
    nothing = np.abs(blocks.torque_nm) <= max(_COAST_TORQUE * usual, torque_resolution_nm)
    turning = np.abs(blocks.speed_rad_s) > _TURNING * float(np.max(np.abs(blocks.speed_rad_s)))
    slowing = blocks.acceleration_rad_s2 * np.sign(blocks.speed_rad_s) < 0.0
    return _runs(nothing & turning & slowing, blocks.time_s, _LEAST_COAST)


def _runs(chosen: BoolArray, time_s: FloatArray, least: int) -> tuple[Span, ...]:
    """Unbroken runs of chosen blocks, as stretches of time."""
    padded = np.concatenate(([False], chosen, [False])).astype(np.int8)
    begins, ends = np.flatnonzero(np.diff(padded) == 1), np.flatnonzero(np.diff(padded) == -1)
    found = []
    for begin, end in zip(begins, ends, strict=True):
        times = time_s[begin:end]
        if end - begin >= least and float(np.max(np.diff(times))) < 1.5 * BLOCK_S:
            found.append(Span(float(times[0]) - 0.5 * BLOCK_S, float(times[-1]) + 0.5 * BLOCK_S))
    return tuple(found)

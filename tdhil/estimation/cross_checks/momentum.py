"""Momentum balances of a run: knots at steady, periodic or coasting motion, and a row from each knot to the next."""

from dataclasses import dataclass, replace
from enum import Enum
from itertools import pairwise

import numpy as np

from tdhil.config import has_plateaus
from tdhil.estimation.samples import Samples
from tdhil.recording import BoolArray, FloatArray, Recording, Segment

# ---------------------------------------------------------------------------------------------------------------------
# Steady and coasting stretches of a run, found from half-second means of the reports, for any recording host.
#
# At steady speed reported and true speed and torque are the same, for any reporting lag. Between two steady stretches a
# momentum balance needs no model of the reports (`balance`). Coasting is motion without torque, so the lag of the
# torque has no effect.


BLOCK_S = 0.5             # s; length of a block
_MOST_BLOCKS = 1_000_000   # blocks of a record, at most
_CALM_PER_S = 0.02        # of the range of speed per second: a lag of 0.5 s then adds an error of 1 % of the range
_DRIFT_PER_S = 0.05       # the same for slow drift: J times the acceleration can be subtracted, and friction remains
_POINT_WIDTH = 0.15       # of the highest speed: largest change of speed within one point of a friction curve
_TURNING = 0.05           # of the highest speed: slower is standstill or creep
_LEAST_CALM = 5           # blocks of a steady stretch; the first is left out because of the lags
_LEAST_COAST = 4          # least number of consecutive blocks of a coasting
_COAST_TORQUE = 0.03      # largest torque of a coasting, over the torque of steady turning


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
    """Means over half a second, M of them, without empty blocks: middle time (s), speed, torque, acceleration."""

    time_s: FloatArray
    speed_rad_s: FloatArray
    torque_nm: FloatArray
    acceleration_rad_s2: FloatArray

    def extremes(self, start_s: float, end_s: float) -> tuple[float, float]:
        """Return the least and greatest speed of the blocks within the span; (inf, -inf) without a block."""
        half = 0.5 * BLOCK_S
        inside = self.speed_rad_s[(self.time_s >= start_s + half) & (self.time_s <= end_s - half)]
        return (float(inside.min()), float(inside.max())) if len(inside) else (np.inf, -np.inf)


def block_means(samples: Samples) -> Blocks | None:
    """Return the block means; None for too few samples, or for times that cannot be a recording."""
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
    """Return stretches of 2 s or more at a steady speed other than zero, outside of the excited segments.

    The first half second is left out, because lagging reports still contain the motion before it.
    """
    return _slower_than(_CALM_PER_S, blocks, excluded)


def drifting_spans(blocks: Blocks, excluded: tuple[Segment, ...]) -> tuple[Span, ...]:
    """Return steady stretches, and those of 2 s or more with slow drift, cut where the speed changes too far for one
    point.
    """
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
    """Return runs of blocks, without their first one, in which the speed changes by less than this share of its
    range per s.
    """
    speed = np.abs(blocks.speed_rad_s)
    fastest, reach = float(np.max(speed)), float(np.ptp(blocks.speed_rad_s))
    calm = (np.abs(blocks.acceleration_rad_s2) <= rate_per_s * reach) & (speed > _TURNING * fastest)
    for segment in excluded:
        calm &= (blocks.time_s < segment.start_s - 0.5 * BLOCK_S) | (blocks.time_s > segment.end_s + 0.5 * BLOCK_S)
    return tuple(Span(span.start_s + BLOCK_S, span.end_s) for span in _runs(calm, blocks.time_s, _LEAST_CALM))


def coasting_spans(blocks: Blocks, calm: tuple[Span, ...], torque_resolution_nm: float) -> tuple[Span, ...]:
    """Return stretches of 2 s or more in which the shaft slows down and the drive gives no torque."""
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
    """Return the unbroken runs of chosen blocks as stretches of time."""
    padded = np.concatenate(([False], chosen, [False])).astype(np.int8)
    begins, ends = np.flatnonzero(np.diff(padded) == 1), np.flatnonzero(np.diff(padded) == -1)
    found = []
    for begin, end in zip(begins, ends, strict=True):
        times = time_s[begin:end]
        if end - begin >= least and float(np.max(np.diff(times))) < 1.5 * BLOCK_S:
            found.append(Span(float(times[0]) - 0.5 * BLOCK_S, float(times[-1]) + 0.5 * BLOCK_S))
    return tuple(found)


# ---------------------------------------------------------------------------------------------------------------------
# Momentum balance between two instants at which reporting lags have no effect.
#
# A knot is a short window in which speed is read; a row is the balance from one knot to the next. With w(t)
# rising from 0 to 1 over the first knot and falling back over the second, J ω̇ = T − B ω − T_c sgn ω − d integrates
# by parts to
#
#     ∫w T = J Δω + B ∫w ω + T_c ∫w sgn ω + ∫w d,        Δx = ∫w ẋ = mean over the second knot − mean over the first.
#
# Reports: T_rep = T − τ_T Ṫ + …, ω_rep = ω − τ_w ω̇ + …, for filters of any kind with delays τ_T and τ_w. Put in,
# with Ṫ = J ω̈ + B ω̇ + ḋ and δ = τ_w − τ_T, to first order
#
#     ∫w T_rep = J (Δω_rep + δ Δα) + B (∫w ω_rep + δ Δω_rep) + T_c ∫w sgn ω + ∫w d.
#
# At calm knots Δα is next to nothing, and so are the terms of higher order, whatever the filters: of everything
# unknown in the reports only B δ is left, some percent of J. Over a knot of one whole period of a periodic motion Δα
# is nothing. A coasting shaft obeys a linear equation without torque, of which every filtered speed is a solution as
# well: δ = 0.
#
# The disturbance d is taken as white of density D, (N·m)²·s: row i has variance D ∫w_i², and neighbours that share a
# knot of length a covary by D a/6, since ∫ u (1 − u) du = 1/6.


LONGEST_GAP_S = 0.3       # s; longest time without a sample
_CHUNK = 65_536           # samples worked on at once, to limit the memory for a long row


class BalanceKind(Enum):
    """Purpose of a row."""

    TURNING = "turning"       # steady or changing speed under torque
    COASTING = "coasting"


@dataclass(frozen=True)
class Knot:
    """Window in which speed is read; ``periodic``: one whole period of an excitation."""

    start_s: float
    end_s: float
    periodic: bool = False
    coasting: bool = False

    @property
    def length_s(self) -> float:
        return self.end_s - self.start_s


@dataclass(frozen=True)
class BalanceRow:
    """One momentum balance: integrals over w(t). Speeds rad/s, times s, torque impulse N·m·s; ``energy_s`` is ∫w².

    ``stepped_rad_s``: the part of ``change_rad_s`` that a speed setpoint with one step a cycle caused.
    """

    first: Knot
    second: Knot
    kind: BalanceKind
    change_rad_s: float
    change_rad_s2: float
    travel_rad: float         # ∫w ω
    time_s: float             # ∫w
    impulse_nm_s: float       # ∫w T
    energy_s: float
    stepped_rad_s: float = 0.0


def balance(samples: Samples, first: Knot, second: Knot) -> BalanceRow | None:
    """Return the row from one knot to the next; None if samples are missing."""
    begin, end = (int(i) for i in np.searchsorted(samples.time_s, (first.start_s - 1e-9, second.end_s - 1e-9)))
    if end - begin < 8:
        return None
    readings = [_reading(samples, knot) for knot in (first, second)]
    totals = np.zeros(3)
    for at in range(begin, end, _CHUNK):
        part = slice(at, min(at + _CHUNK, end))
        time, cells, longest = _cells(samples.time_s, part)
        if longest > LONGEST_GAP_S:
            return None
        weight = cells
        if not first.end_s <= time[0] <= time[-1] <= second.start_s:
            ramps = np.minimum((time - first.start_s) / first.length_s, (second.end_s - time) / second.length_s)
            weight = np.clip(ramps, 0.0, 1.0) * cells
        totals += np.sum(weight), weight @ samples.speed_rad_s[part], weight @ samples.torque_nm[part]
    if None in readings or not float(totals[0]) > 0.0:
        return None
    (mean_a, slope_a), (mean_b, slope_b) = (reading for reading in readings if reading is not None)
    middle = second.start_s - first.end_s
    return BalanceRow(
        first,
        second,
        BalanceKind.COASTING if first.coasting and second.coasting else BalanceKind.TURNING,
        change_rad_s=mean_b - mean_a,
        change_rad_s2=slope_b - slope_a,
        travel_rad=float(totals[1]),
        time_s=float(totals[0]),
        impulse_nm_s=float(totals[2]),
        energy_s=middle + (first.length_s + second.length_s) / 3.0,
    )


def _cells(time_s: FloatArray, part: slice) -> tuple[FloatArray, FloatArray, float]:
    """Return the times of some samples, their durations (half the distance to either neighbour), and the widest gap."""
    low, high = max(part.start - 1, 0), min(part.stop + 1, len(time_s))
    gaps = np.diff(time_s[low:high])
    before = gaps[: part.stop - part.start] if low < part.start else np.append(0.0, gaps)[: part.stop - part.start]
    after = gaps[part.start - low :]
    after = after if high > part.stop else np.append(after, 0.0)
    return time_s[part], 0.5 * (before + after), float(np.max(gaps)) if len(gaps) else np.inf


def _reading(samples: Samples, knot: Knot) -> tuple[float, float] | None:
    """Return mean speed and mean acceleration within a knot; a whole period of a periodic motion has no
    acceleration.
    """
    begin, end = (int(i) for i in np.searchsorted(samples.time_s, (knot.start_s - 1e-9, knot.end_s - 1e-9)))
    if end - begin < 2:
        return None
    time, width, _ = _cells(samples.time_s, slice(begin, end))
    speed, whole = samples.speed_rad_s[begin:end], float(np.sum(width))
    if not whole > 0.0:
        return None
    mean = float(width @ speed) / whole
    if knot.periodic:
        return mean, 0.0
    lever = time - float(width @ time) / whole
    spread = float(width @ lever**2)
    return (mean, float(width @ (lever * speed)) / spread) if spread > 0.0 else None


def overlap_s(earlier: BalanceRow, later: BalanceRow) -> float:
    """Return ∫w_i w_{i+1} of two neighbouring rows, s."""
    return earlier.second.length_s / 6.0 if earlier.second == later.first else 0.0


def through(samples: Samples, start_s: float, end_s: float, knot_s: float, *,
            periodic: bool = False) -> BalanceRow | None:
    """Return the balance over one stretch, from a knot at its start to one at its end; None if samples are missing."""
    return balance(samples, Knot(start_s, start_s + knot_s, periodic), Knot(end_s - knot_s, end_s, periodic))


# ---------------------------------------------------------------------------------------------------------------------

KNOT_S = 1.0              # s; length of a knot
_COAST_KNOT_S = 0.5       # s; length of a knot at either end of a coasting
_SETTLED = ("speed", "hold")      # stages that end at a steady speed
_SETTLING_PER_S = 0.05    # of the range of speed per second: a delay known to 0.02 s is an error of 0.1 % of the range
_APART_S = 5.0            # s; least distance between knots of one steady stretch
_CLOSER_S = 2.5           # s; least distance if only the rows give the scatter: more rows, though less independent
_COAST_ENTRY_S = 1.5      # s; time until the reports no longer contain the earlier torque
_SWITCH_S = 0.25          # s; time on either side of a change of mode, over which the speed is read
_BEYOND = 0.8             # share of the least speed of known friction, down to which friction is taken as known


@dataclass(frozen=True)
class Balances:
    """All rows of a run, in order of time, for rotation in ``direction`` (±1). ``calm``: the steady stretches."""

    rows: tuple[BalanceRow, ...]
    direction: float
    calm: tuple[Span, ...]


def balances(recording: Recording, samples: Samples, *, alone: bool = False) -> Balances | None:
    """Return every possible balance of a run; None if it never turned steadily. ``alone``: only the rows give the
    scatter.
    """
    blocks = block_means(samples)
    if blocks is None:
        return None
    periodic = periodic_segments(recording)
    calm = calm_spans(blocks, periodic)
    knots = []
    for span in calm:      # both ends and every few seconds between; the middle of a short stretch
        count = 1 + int((span.duration_s - KNOT_S) / (_CLOSER_S if alone else _APART_S))
        if count == 1:
            middle = 0.5 * (span.start_s + span.end_s)
            knots.append(Knot(middle - 0.5 * KNOT_S, middle + 0.5 * KNOT_S))
        else:
            starts = np.linspace(span.start_s, span.end_s - KNOT_S, count)
            knots += [Knot(float(start), float(start) + KNOT_S) for start in starts]
    for segment in periodic:      # the first and the last whole period
        start, period = segment.start_s, segment.period_s
        last = start + (int((segment.end_s - start) / period + 1e-6) - 1) * period
        knots += [Knot(at, at + period, periodic=True) for at in (start, last)]
    if not knots:
        return None
    knots += _stage_knots(recording, samples, blocks, knots)
    speeds = np.array([_mean_speed(samples, knot) for knot in knots])
    direction = float(np.sign(np.nansum(speeds)))
    low, high = _seen(blocks, knots, direction)
    for span in coasting_spans(blocks, calm, recording.torque_resolution_nm):
        # from settled reports to the speed where friction is unknown, or to the end of the coasting
        inside = (blocks.time_s > span.start_s) & (blocks.time_s < span.end_s) & (blocks.speed_rad_s * direction >= low)
        start = span.start_s + _COAST_ENTRY_S
        end = float(blocks.time_s[inside][-1]) if np.any(inside) else start
        if end - start >= 3.0 * _COAST_KNOT_S:
            knots += [Knot(at, at + _COAST_KNOT_S, coasting=True) for at in (start, end - _COAST_KNOT_S)]
    knots.sort(key=lambda knot: (knot.start_s, knot.end_s))
    found = []
    for first, second in pairwise(knots):
        least, most = (v * direction for v in blocks.extremes(first.start_s, second.end_s))
        apart = first.end_s <= second.start_s + 1e-6 and first.coasting == second.coasting
        if apart and min(least, most) >= low and max(least, most) <= high:
            row = balance(samples, first, second)
            found += [replace(row, stepped_rad_s=_stepped_rad_s(recording, samples, row))] if row is not None else []
    return Balances(tuple(found), direction, calm) if found else None


def _stepped_rad_s(recording: Recording, samples: Samples, row: BalanceRow) -> float:
    """Return the change of speed in the parts of a row in which this program ran speed mode; 0 for a trace of
    another tool, because its setpoint is unknown.
    """
    if row.kind is BalanceKind.COASTING or not recording.stages:
        return 0.0
    commanded = recording.commanded_torque_nm
    if commanded is None:
        return row.change_rad_s
    first, last = (int(i) for i in np.searchsorted(recording.time_s, (row.first.start_s, row.second.end_s)))
    in_speed = np.concatenate(([False], np.isnan(commanded[first:last]), [False])).astype(np.int8)
    changes = np.flatnonzero(np.diff(in_speed))
    if len(changes) == 2 and changes[0] == 0 and changes[1] == last - first:
        return row.change_rad_s
    times = recording.time_s[first + np.minimum(changes, last - first - 1)]
    speeds = np.array([_mean_speed(samples, Knot(at - _SWITCH_S, at + _SWITCH_S)) for at in times])
    parts = speeds[1::2] - speeds[::2]
    return float(np.sum(parts[np.isfinite(parts)]))


def periodic_segments(recording: Recording) -> tuple[Segment, ...]:
    """Return the segments used by whole periods. Plateaus of a square wave are steady enough to be knots themselves."""
    excitation = recording.excitation
    if excitation is None or has_plateaus(excitation.kind):
        return ()
    return tuple(s for s in excitation.segments if s.period_s > 0.0 and s.end_s - s.start_s >= 2.0 * s.period_s)


def _seen(blocks: Blocks, knots: list[Knot], direction: float) -> tuple[float, float]:
    """Return the speeds along the rotation between which friction is known, slightly widened; never through zero."""
    edges = np.array([[v * direction for v in blocks.extremes(knot.start_s - 0.25, knot.end_s + 0.25)]
                      for knot in knots])
    edges = edges[np.all(np.isfinite(edges), axis=1)]
    ahead = edges[np.all(edges > 0.0, axis=1)] if len(edges) else edges
    if len(ahead) == 0:
        return np.inf, -np.inf
    return _BEYOND * float(ahead.min()), float(ahead.max()) / _BEYOND


def _stage_knots(recording: Recording, samples: Samples, blocks: Blocks, others: list[Knot]) -> list[Knot]:
    """Return knots at the end of stages 2 and 4, where the shaft reached a speed but did not stay there for long.

    The row contains the rest of the change of speed: the acceleration and the known delay correct the reported speed.
    """
    found = []
    for stage in recording.stages:
        knot = Knot(stage.end_s - KNOT_S, stage.end_s)
        inside = (blocks.time_s > knot.start_s) & (blocks.time_s < knot.end_s)
        apart = all(knot.start_s >= one.end_s or knot.end_s <= one.start_s for one in others)
        if stage.name in _SETTLED and apart and np.any(inside) and knot.end_s <= float(samples.time_s[-1]) + BLOCK_S:
            reach = float(np.ptp(blocks.speed_rad_s))
            if np.all(np.abs(blocks.acceleration_rad_s2[inside]) <= _SETTLING_PER_S * reach):
                found.append(knot)
    return found


def _mean_speed(samples: Samples, knot: Knot) -> float:
    inside = samples.between(knot.start_s, knot.end_s).speed_rad_s
    return float(np.mean(inside)) if len(inside) else float("nan")

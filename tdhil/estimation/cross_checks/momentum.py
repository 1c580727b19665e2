"""The balances of a run: knots where it turned calmly, swung or coasted, and a row from each to the next."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from tdhil.estimation.samples import Samples
from tdhil.identify.beside.momentum_calm import Blocks, Span, block_means, calm_spans, coasting_spans
from tdhil.identify.beside.momentum_rows import Knot, Row, balance
from tdhil.recording.recording import Recording, Segment

KNOT_S = 1.0
_COAST_KNOT_S = 0.5
_APART_S = 5.0            # at least, between knots of one calm stretch
_CLOSER_S = 2.5           # the same where the rows alone must tell the scatter: more of them, if less independent
_COAST_ENTRY_S = 1.5      # until the reports have forgotten the torque that was there before
_BEYOND = 0.8             # friction is taken as known down to this share of the least speed that it was seen at


@dataclass(frozen=True)
class Balances:
    """All rows of a run, in order of time, turning in ``direction`` (±1); ``calm`` is where speed was steady."""

    rows: tuple[Row, ...]
    direction: float
    calm: tuple[Span, ...]


def balances(recording: Recording, samples: Samples, *, alone: bool = False) -> Balances | None:
    """Every balance that a run allows; None if it never turned steadily. ``alone``: nothing else tells the scatter."""
    blocks = block_means(samples)
    if blocks is None:
        return None
    periodic = periodic_segments(recording)
    calm = calm_spans(blocks, periodic)
    knots = [knot for span in calm for knot in _calm_knots(span, _CLOSER_S if alone else _APART_S)]
    knots += [knot for segment in periodic for knot in _period_knots(segment)]
    if not knots:
        return None
    speeds = np.array([_mean_speed(samples, knot) for knot in knots])
    direction = float(np.sign(np.nansum(speeds)))
    low, high = _seen(blocks, knots, direction)
    coasts = coasting_spans(blocks, calm, recording.torque_resolution_nm)
    knots += [knot for span in coasts for knot in _coast_knots(span, blocks, direction, low)]
    knots.sort(key=lambda knot: (knot.start_s, knot.end_s))
    found = []
    for first, second in pairwise(knots):
        least, most = (v * direction for v in blocks.extremes(first.start_s, second.end_s))
        apart = first.end_s <= second.start_s + 1e-6 and first.coasting == second.coasting
        if apart and min(least, most) >= low and max(least, most) <= high:
            row = balance(samples, first, second)
            found += [row] if row is not None else []
    return Balances(tuple(found), direction, calm) if found else None


def periodic_segments(recording: Recording) -> tuple[Segment, ...]:
    """Segments taken by whole periods; the plateaus of a square wave are calm enough to be knots themselves."""
    excitation = recording.excitation
    if excitation is None or excitation.kind == "step":
        return ()
    return tuple(s for s in excitation.segments if s.period_s > 0.0 and s.end_s - s.start_s >= 2.0 * s.period_s)


def _seen(blocks: Blocks, knots: list[Knot], direction: float) -> tuple[float, float]:
    """Speeds along the rotation between which friction was seen, a little widened; never through zero."""
    edges = np.array([[v * direction for v in blocks.extremes(knot.start_s - 0.25, knot.end_s + 0.25)]
                      for knot in knots])
    edges = edges[np.all(np.isfinite(edges), axis=1)]
    ahead = edges[np.all(edges > 0.0, axis=1)] if len(edges) else edges
    if len(ahead) == 0:
        return np.inf, -np.inf
    return _BEYOND * float(ahead.min()), float(ahead.max()) / _BEYOND


def _calm_knots(span: Span, apart_s: float) -> list[Knot]:
    """At both ends of a calm stretch and every few seconds between; one in the middle of a short one."""
    count = 1 + int((span.duration_s - KNOT_S) / apart_s)
    if count == 1:
        middle = 0.5 * (span.start_s + span.end_s)
        return [Knot(middle - 0.5 * KNOT_S, middle + 0.5 * KNOT_S)]
    starts = np.linspace(span.start_s, span.end_s - KNOT_S, count)
    return [Knot(float(start), float(start) + KNOT_S) for start in starts]


def _period_knots(segment: Segment) -> list[Knot]:
    """The first and the last whole period of a segment."""
    period = segment.period_s
    last = segment.start_s + (int((segment.end_s - segment.start_s) / period + 1e-6) - 1) * period
    return [Knot(start, start + period, periodic=True) for start in (segment.start_s, last)]


def _coast_knots(span: Span, blocks: Blocks, direction: float, low: float) -> list[Knot]:
    """From where the reports have settled to where friction is no longer known, or the coasting ends."""
    inside = (blocks.time_s > span.start_s) & (blocks.time_s < span.end_s) & (blocks.speed_rad_s * direction >= low)
    start = span.start_s + _COAST_ENTRY_S
    end = float(blocks.time_s[inside][-1]) if np.any(inside) else start
    if end - start < 3.0 * _COAST_KNOT_S:
        return []
    return [Knot(at, at + _COAST_KNOT_S, coasting=True) for at in (start, end - _COAST_KNOT_S)]


def _mean_speed(samples: Samples, knot: Knot) -> float:
    inside = samples.between(knot.start_s, knot.end_s).speed_rad_s
    return float(np.mean(inside)) if len(inside) else float("nan")

"""The points of a friction curve: friction torque over each stretch of steady or slowly drifting speed.

How a point is made of a balance of momentum stands in `tdhil.estimation.cross_checks.friction_curve`.
"""

import math
from dataclasses import dataclass, replace

from tdhil.estimation.cross_checks.momentum import KNOT_S, periodic_segments
from tdhil.estimation.cross_checks.momentum_fit import UNKNOWN_DELAY, Delay
from tdhil.estimation.samples import Samples, excited_window
from tdhil.identify.beside.momentum_calm import block_means, drifting_spans
from tdhil.identify.beside.momentum_rows import Row, through
from tdhil.recording.recording import Recording

_ALIKE = 0.01             # of the fastest: speeds closer than that are one


@dataclass(frozen=True)
class Inertia:
    """What is known of J, kg·m², rough or final, with its standard deviation; and of the delay between the reports."""

    value: float
    sd: float
    delay: Delay = UNKNOWN_DELAY


@dataclass(frozen=True)
class Point:
    """Speed (rad/s) and friction torque (N·m) of one stretch, or of several at one speed."""

    speed: float
    torque: float
    variance: float           # (N·m)²
    swing: float              # var ω, (rad/s)²


def steady_points(recording: Recording, samples: Samples, inertia: Inertia, density: float) -> list[Point]:
    """One for each stretch, in order of kind and time; ``density``: the disturbance's, (N·m)²·s."""
    blocks = block_means(samples)
    if blocks is None:
        return []
    segments = periodic_segments(recording)
    found = []
    for span in drifting_spans(blocks, segments):
        row = through(samples, span.start_s, span.end_s, min(KNOT_S, span.duration_s / 4.0))
        found += [_point(row, inertia, density, 0.0)] if row is not None else []
    for segment in segments:
        start, end = excited_window(segment)
        whole = math.floor((end - start) / segment.period_s + 1e-6)
        if whole < 2:
            continue
        row = through(samples, start, start + whole * segment.period_s, segment.period_s, periodic=True)
        swing = 0.5 * sum(a * a for a in segment.amplitudes_rad_s)
        found += [_point(row, inertia, density, max(swing, 1e-12))] if row is not None else []
    return found


def _point(row: Row, inertia: Inertia, density: float, swing: float) -> Point:
    change = row.change_rad_s + inertia.delay.seconds * row.change_rad_s2
    variances = (
        density * row.energy_s,
        (inertia.sd * change) ** 2,
        (inertia.value * inertia.delay.sd_s * row.change_rad_s2) ** 2,
    )
    torque = (row.impulse_nm_s - inertia.value * change) / row.time_s
    return Point(row.travel_rad / row.time_s, torque, sum(variances) / row.time_s**2, swing)


def merged(points: list[Point]) -> list[Point]:
    """In rising speed; neighbours that are one speed, and both calm or both swung, put together by their weights."""
    ordered = sorted(points, key=lambda point: point.speed)
    fastest = max((abs(point.speed) for point in ordered), default=0.0)
    found: list[Point] = []
    for point in ordered:
        near = [k for k, other in enumerate(found)
                if point.speed - other.speed < _ALIKE * fastest and (other.swing > 0.0) == (point.swing > 0.0)]
        if not near:
            found.append(point)
            continue
        other = found[near[-1]]
        mine, theirs = 1.0 / point.variance, 1.0 / other.variance
        share = mine / (mine + theirs)
        found[near[-1]] = replace(
            other,
            speed=other.speed + share * (point.speed - other.speed),
            torque=other.torque + share * (point.torque - other.torque),
            variance=1.0 / (mine + theirs),
        )
    return sorted(found, key=lambda point: point.speed)

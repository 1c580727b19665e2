"""Check for a reported speed that changes faster than the identified inertia allows, above a drill string.

A reported speed is an average of true speeds with weights ≥ 0. A lag therefore cannot make its slope steeper than the
greatest acceleration of the shaft:

    |dz/dt| ≤ (T_max − T_load,min)/J_low

`tdhil.runner.observer` tests this in every cycle. Above a string the observer has J only to a factor of two at that
time, and does not detect a change of a sensor's scale. Here J is that of the result, so a jump shows that the result is
wrong: if the scale changed during the run, J is wrong by the same factor.

The torques are those commanded and reported within the longest memory of a report. In speed mode nothing is commanded.
There the bound of a true torque T follows from its report T', a first-order lag of at most τ, and the torque limit:

    T = T' + τ dT'/dt ≤ T' + τ_max max(0, dT'/dt)

The load of a string is T − Jα over the time before. It may leave the range of that time by the width of the range, on
either side.

A jump after stage 5 says nothing about J and is not searched.
"""

import math

import numpy as np

from profiles import MessageCode
from tdhil.estimation.case import Case, Finding
from tdhil.estimation.result import Refusal
from tdhil.estimation.samples import LONGEST_LAG_S, acquisitions
from tdhil.recording import FloatArray, Recording

POINT_S = 0.04
"""Time over which samples are averaged to a point, s; a slow line has one sample for each point."""

SLOPE_S = 0.12
"""Time over which a slope of the reported speed is taken, s."""

MEMORY_S = 6.0 * LONGEST_LAG_S
"""Time during which an earlier torque affects the reported slope, s."""

REPORTED_LATER_S = 0.3
"""Longest dead time by which the report of a torque may follow the report of the speed that it causes, s."""

LOAD_BEFORE_S, LOAD_RANGE = 10.0, 1.0
"""Assumed bound of a string's load: range of the torque over the time before (s), and the multiple of it about the
middle.
"""

NOISE_SDS = 6.0
"""Standard deviations that count as the noise of a point's speed."""

NORMAL_MEDIAN = 1.4826
"""Standard deviation of normal noise as a multiple of its median magnitude."""

MOST = 0.9
"""Slope as a share of the bound: 0.76 at most in healthy runs above a string (`benchmarks/healthy_runs.py`); 1.01 if
the scale of a sensor doubled in stage 5, 1.4 if it lost a tenth in stage 4 (`benchmarks/lying_reports.py`)."""

_IN_A_ROW = 2             # points in a row beyond the bound: a single false report is not a change of scale


def jump_checked(finding: Finding, case: Case) -> Finding:
    """Return the finding, without its inertia if the speed jumps. Never raises."""
    inertia = finding.inertia
    if inertia is None or not case.sound or not case.recording.has_drill_string or not inertia.low > 0.0:
        return finding
    contradiction = jump_contradiction(case.recording, inertia.low, inertia.value)
    if contradiction is None:
        return finding
    return finding.taken_back(contradiction)


def jump_contradiction(recording: Recording, inertia_low_kg_m2: float, inertia_kg_m2: float) -> Refusal | None:
    """Return the contradiction if the speed jumps before the end of stage 5; else None.

    Nothing is known of speed mode without a torque limit.
    """
    if len(recording.time_s) < 2:
        return None
    period_s = float(np.median(np.diff(recording.time_s)))
    per_point = max(1, round(POINT_S / period_s))
    point_s = per_point * period_s
    count = len(recording.time_s) // per_point
    back = max(1, round(SLOPE_S / point_s))
    if count <= back:
        return None
    commanded_nm = recording.commanded_torque_nm
    if commanded_nm is None:
        commanded_nm = np.full(len(recording.time_s), math.nan)
    time_s, speed, torque, commanded = (
        array[: count * per_point].reshape(count, per_point)
        for array in (recording.time_s, recording.speed_rad_s, recording.torque_nm, commanded_nm)
    )
    speed = np.mean(speed, axis=1)
    most_nm, least_nm = _bounds_in_speed_mode(recording, np.mean(torque, axis=1), point_s)
    in_speed_mode = np.isnan(commanded).all(axis=1)
    highest = np.where(in_speed_mode, most_nm, np.maximum(torque, commanded).max(axis=1))
    lowest = np.where(in_speed_mode, least_nm, np.minimum(torque, commanded).min(axis=1))
    highest = _past(highest, MEMORY_S / point_s)
    lowest = -_past(-lowest, MEMORY_S / point_s)
    slope = np.full(count, np.nan)
    took_s = time_s[back:, 0] - time_s[:-back, 0]
    whole = took_s < 1.5 * back * point_s                    # no slope across a gap
    slope[back:] = np.where(whole, (speed[back:] - speed[:-back]) / took_s, np.nan)
    load = np.mean(torque, axis=1) - inertia_kg_m2 * slope
    # the load before the slope, without the jump itself
    before = _delayed(load, math.ceil((SLOPE_S + 0.25) / point_s))
    load_high = _past(before, LOAD_BEFORE_S / point_s)
    load_low = -_past(-before, LOAD_BEFORE_S / point_s)
    middle, half = 0.5 * (load_high + load_low), LOAD_RANGE * (load_high - load_low)
    noise = NOISE_SDS * _noise_rad_s(speed) + _count_rad_s(recording)
    blur = 2.0 * noise / (back * point_s)
    faster = np.maximum(0.0, highest - (middle - half)) / inertia_low_kg_m2 + blur
    slower = np.maximum(0.0, (middle + half) - lowest) / inertia_low_kg_m2 + blur
    bound = np.where(slope > 0.0, faster, slower)
    beyond = np.abs(slope) > MOST * bound                    # False if one of them is unknown
    beyond &= time_s[:, 0] < max((stage.end_s for stage in acquisitions(recording)), default=math.inf)
    for shift in range(1, _IN_A_ROW):
        beyond[shift:] &= beyond[:-shift]
    if not np.any(beyond):
        return None
    at = int(np.argmax(beyond))
    return Refusal(
        f"at {time_s[at, 0]:.1f} s the reported speed jumped from {speed[at - back]:.2f} to {speed[at]:.2f} rad/s"
        f" within {back * point_s:.2g} s ({abs(slope[at]):.2g} rad/s²). Torque and string accelerate this shaft by"
        f" {bound[at]:.2g} rad/s² at most. The speed scale changed during the run",
        "check the encoder, its cable and its scale; then run it again", MessageCode.SPEED_JUMPED,
    )


def _bounds_in_speed_mode(recording: Recording, torque_nm: FloatArray, point_s: float) -> tuple[FloatArray, FloatArray]:
    """Return the highest and lowest torque that the shaft may have at each point, N·m; NaN without a torque limit."""
    if recording.torque_limit_nm is None:
        return np.full(len(torque_nm), math.nan), np.full(len(torque_nm), math.nan)
    limit_nm = np.maximum(recording.torque_limit_nm, np.abs(torque_nm))
    change_nm = LONGEST_LAG_S * np.gradient(torque_nm, point_s)
    points = round(REPORTED_LATER_S / point_s)
    most_nm = np.minimum(limit_nm, torque_nm + np.maximum(0.0, change_nm))
    least_nm = np.maximum(-limit_nm, torque_nm + np.minimum(0.0, change_nm))
    return _next(most_nm, points), -_next(-least_nm, points)


def _next(values: FloatArray, points: int) -> FloatArray:
    """Return the greatest of each point and the ``points`` after it, as far as there are any."""
    ahead = np.append(values, np.full(points, -math.inf))
    greatest: FloatArray = np.max(np.lib.stride_tricks.sliding_window_view(ahead, points + 1), axis=1)
    return greatest


def _past(values: FloatArray, points: float) -> FloatArray:
    """Return the greatest of each point and the ``points`` before it; NaN if one of them is NaN."""
    width = min(len(values), 1 + math.ceil(points))
    padded = np.concatenate([np.full(width - 1, np.nan), values])
    greatest: FloatArray = np.max(np.lib.stride_tricks.sliding_window_view(padded, width), axis=1)
    return greatest


def _delayed(values: FloatArray, points: int) -> FloatArray:
    """Return the values shifted later by ``points``; NaN at the beginning."""
    late = np.full(len(values), np.nan)
    late[points:] = values[: len(values) - points]
    return late


def _noise_rad_s(speed: FloatArray) -> float:
    """Return the standard deviation of a point's noise, from the median of the third differences (20 times its
    variance).

    The motion itself has little effect on third differences, even at 10 Hz.
    """
    rough = np.abs(np.diff(speed, 3))
    rough = rough[np.isfinite(rough)]
    return NORMAL_MEDIAN * float(np.median(rough)) / math.sqrt(20.0) if len(rough) else math.inf


def _count_rad_s(recording: Recording) -> float:
    count = recording.speed_resolution_rad_s
    return count if math.isfinite(count) else 0.0

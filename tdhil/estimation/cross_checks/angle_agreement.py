"""Check of the reported speed against the angle of the shaft, stage by stage.

Over a stretch the angle changes by the integral of the true speed. A reported speed with lag τ, for any filter, is late
by τ at both ends:

    ∫ω_rep dt = Δθ/k − τ Δω_rep,

A stretch with equal speed at both ends gives the ratio k of true to reported speed without knowledge of τ. For other
stretches the longest plausible lag bounds the error.

With the true speed k ω_rep, the equation T = J ω' gives J_rep = k J for the reported speed: the true J is J_rep/k if
the angle is right, and J_rep if it is not. The total interval contains both, unless k is so far from 1 that no J is
given.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from profiles import CodedText, MessageCode
from tdhil.config import SPEED_UNIT_TOLERANCE
from tdhil.estimation.case import Case, Finding
from tdhil.estimation.cross_checks.momentum import LONGEST_GAP_S
from tdhil.estimation.result import BudgetLine, Refusal
from tdhil.estimation.samples import LONGEST_LAG_S, Samples, acquisitions, excited_window, usable_samples
from tdhil.recording import Recording

_END_S = 0.5              # s; time at either end of a stretch over which its speed is averaged
_LEAST_S = 2.0            # s; least duration of a stretch
_LEAST_READINGS = 8       # fewest readings of the angle in a stretch
NEGLIGIBLE = 0.005        # difference of angle and speed that widens no interval: an eighth of the usual torque scale
RATIOS_ALIKE = 0.02       # largest relative difference between the ratios of two stages, as both are rounded


@dataclass(frozen=True)
class AngleRatio:
    """Ratio of the angle to the integral of the reported speed in one stretch, with the bound of its error on either
    side.
    """

    where: str
    value: float
    half_width: float


def angle_ratio(recording: Recording, samples: Samples, where: str, start_s: float, end_s: float) -> AngleRatio | None:
    """Return the ratio between the first and the last angle of a stretch; None for too few angles or a gap in the
    speed.
    """
    angle = recording.position_rad
    if angle is None:
        return None
    known = np.isfinite(angle) & recording.fresh & (recording.time_s >= start_s) & (recording.time_s <= end_s)
    time, turned = recording.time_s[known], angle[known]
    if len(time) < _LEAST_READINGS or time[-1] - time[0] < _LEAST_S:
        return None
    begin, end = float(time[0]), float(time[-1])
    inside = samples.between(begin - 1e-9, end + 1e-9)
    if len(inside) < _LEAST_READINGS or float(np.max(np.diff(inside.time_s), initial=0.0)) > LONGEST_GAP_S:
        return None
    way = float(np.trapezoid(inside.speed_rad_s, inside.time_s))
    # a sample may be missing at either end; the speed is taken as constant there
    way += float(inside.speed_rad_s[0]) * (float(inside.time_s[0]) - begin)
    way += float(inside.speed_rad_s[-1]) * (end - float(inside.time_s[-1]))
    ends = [samples.between(at, at + _END_S).speed_rad_s for at in (begin, end - _END_S)]
    steps = np.abs(np.diff(turned))
    count = float(np.min(steps[steps > 0.0], initial=math.inf))
    if not all(len(part) for part in ends) or not math.isfinite(count) or way == 0.0:
        return None
    change = abs(float(np.mean(ends[1])) - float(np.mean(ends[0])))
    ratio = float(turned[-1] - turned[0]) / way
    # for an angle without steps the smallest change is not its resolution; the median change bounds both
    open_rad = 2.0 * min(count, float(np.median(steps))) + LONGEST_LAG_S * change * abs(ratio)
    open_rad += 0.5 * recording.speed_resolution_rad_s * (end - begin)
    return AngleRatio(where, ratio, open_rad / abs(way))


def mean_speed(recording: Recording, start_s: float, end_s: float) -> tuple[float, float] | None:
    """Return the mean reported speed between two times, and a bound of its error, rad/s; None if the speed has a gap.

    The bound covers the longest plausible lag of the reports, their rounding, and missing samples at the ends.
    """
    inside = usable_samples(recording).between(start_s, end_s)
    if len(inside) < _LEAST_READINGS:
        return None
    gaps = np.diff(inside.time_s, prepend=start_s, append=end_s)
    if float(np.max(gaps)) > LONGEST_GAP_S:
        return None
    time, speed = inside.time_s, inside.speed_rad_s
    way = float(np.trapezoid(speed, time)) + float(speed[0]) * float(gaps[0]) + float(speed[-1]) * float(gaps[-1])
    ends = [inside.between(at, at + _END_S).speed_rad_s for at in (float(time[0]), float(time[-1]) - _END_S)]
    change = abs(float(np.mean(ends[1])) - float(np.mean(ends[0])))
    return way / (end_s - start_s), LONGEST_LAG_S * change / (end_s - start_s) + 0.5 * recording.speed_resolution_rad_s


def _unbroken(recording: Recording, where: str, start_s: float, end_s: float) -> list[tuple[str, float, float]]:
    """Return the parts of a stretch without a lost turn of the shaft: no gap is longer than the angle allows."""
    angle, gap_s = recording.position_rad, recording.position_gap_s
    if angle is None or gap_s is None:
        return [(where, start_s, end_s)]
    time = recording.time_s
    reported_s = time[np.isfinite(angle) & (time >= start_s) & (time <= end_s)]
    parts = np.split(reported_s, np.flatnonzero(np.diff(reported_s) > gap_s) + 1)
    return [(where, float(part[0]), float(part[-1])) for part in parts if len(part)]


def angle_ratios(
    recording: Recording, samples: Samples | None = None
) -> tuple[tuple[AngleRatio, ...], tuple[AngleRatio, ...]]:
    """Return the ratios of the steady levels, and those of stage 5: its segments, or the whole stage without
    segments. ``samples``: the usable ones, if they are known.
    """
    if recording.position_rad is None:
        return (), ()
    samples = usable_samples(recording) if samples is None else samples
    steady = [("stage 2", level.start_s, level.end_s) for level in recording.levels]
    segments = () if recording.excitation is None else recording.excitation.segments
    excited = [("stage 5", *excited_window(segment)) for segment in segments] or [
        ("stage 5", stage.start_s, stage.end_s) for stage in acquisitions(recording)
    ]
    found = tuple(
        tuple(one for row in rows for part in _unbroken(recording, *row)
              if (one := angle_ratio(recording, samples, *part)) is not None)
        for rows in (steady, excited)
    )
    return found[0], found[1]


def _contradiction(
    recording: Recording, steady: tuple[AngleRatio, ...], excited: tuple[AngleRatio, ...]
) -> Refusal | None:
    """Return the contradiction between the angle and the speed used for J; None without one, or without an angle."""
    for one in excited:
        if not recording.speed_unit_accepted and abs(one.value - 1.0) > SPEED_UNIT_TOLERANCE + one.half_width:
            return Refusal(
                f"the reported speed contradicts the shaft's angle. In {one.where} the angle moved "
                f"{one.value:.4g} times as far as the integral of the reported speed (±{one.half_width:.2g}, "
                f"tolerance ±{SPEED_UNIT_TOLERANCE:g})",
                "check the unit of speed and the counts per turn in the profile, and the encoder's coupling",
                entry=MessageCode.SPEED_SCALE_DOUBTFUL,
            )
        for other in (*steady, *excited):
            if abs(one.value - other.value) > RATIOS_ALIKE * abs(other.value) + one.half_width + other.half_width:
                return Refusal(
                    "the scale of the reported speed changed during the run. The angle over the integral of the "
                    f"reported speed is {one.value:.4g} ± {one.half_width:.2g} in {one.where} and "
                    f"{other.value:.4g} ± {other.half_width:.2g} in {other.where}",
                    "check the encoder, its coupling and its supply, and which program writes to the drive; then run it"
                    " again", entry=MessageCode.SPEED_SCALE_DOUBTFUL,
                )
    return None


def angle_checked(finding: Finding, case: Case) -> Finding:
    """Return the finding, without its inertia if the angle contradicts the speed. Never raises.

    A smaller difference than the tolerance counts as uncertainty of the speed scale, unless the operator has confirmed
    the unit of speed.
    """
    recording, inertia = case.recording, finding.inertia
    if inertia is None or recording.position_rad is None:
        return finding
    steady, excited = angle_ratios(recording, case.samples)
    contradiction = _contradiction(recording, steady, excited)
    if contradiction is not None:
        return finding.taken_back(contradiction)
    off = [one for one in excited if abs(one.value - 1.0) > max(one.half_width, NEGLIGIBLE)]
    if not off or recording.speed_unit_accepted:
        return finding
    worst = max(off, key=lambda one: abs(1.0 / one.value - 1.0))
    share = abs(1.0 / worst.value - 1.0)
    line = BudgetLine("speed scale", share * inertia.value, "angle against reported speed; not in the repeatability")
    warning = CodedText(
        f"in {worst.where} the angle of the shaft moved {worst.value:.4g} times as far as the integral of the reported "
        f"speed (±{worst.half_width:.2g}): the total intervals were widened by {100.0 * share:.2g} %",
        MessageCode.SPEED_UNLIKE_ANGLE)
    budget = (*finding.budget[:-1], line, *finding.budget[-1:]) if finding.budget else ()    # torque scale stays last
    return replace(finding, speed_scale_share=share, budget=budget, warnings=(*finding.warnings, warning))

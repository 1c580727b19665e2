"""What the excitation says of itself, held against the samples: can it have been so, and was it sampled fast enough?

The lines of a period are fitted side by side, so they must be different whole multiples of 1/period, and there must be
more samples in a period than there are unknowns. A line at or above half the sample rate is seen at another frequency,
and what is seen at a lower line may then be its image: nothing in such a record can be told apart.
"""

import math
from itertools import pairwise

import numpy as np

from tdhil.estimation.result import Refused
from tdhil.estimation.samples import Samples, excited_window, usual_interval
from tdhil.recording.recording import Excitation, Segment

_WHOLE = 2e-3             # of a line that it may be off a whole number of cycles a period
_NYQUIST = 0.9            # of half the sample rate that lines may reach: the last tenth is too near to its image
_SECONDS_NOT = 100.0      # so much slower than the lines need: more likely the unit of time is wrong


def check_declared(excitation: Excitation, samples: Samples) -> None:
    """Raise Refused for segments that can't be, lie outside the record, or whose lines the sampling can't tell."""
    for number, segment in enumerate(excitation.segments, start=1):
        _check_segment(segment, f"segment {number}")
    ordered = sorted(excitation.segments, key=lambda segment: segment.start_s)
    for before, after in pairwise(ordered):
        if after.start_s < before.end_s - 0.01 * before.period_s:
            raise Refused(
                f"two segments overlap: one lasts until {before.end_s:g} s, the next starts at {after.start_s:g} s",
                "correct the times of the segments",
            )
    inside = [samples.between(*excited_window(segment)) for segment in excitation.segments]
    if not any(len(part) for part in inside):
        raise Refused(
            f"no sample lies within the excitation after settling: the record lasts from {samples.time_s[0]:g} to "
            f"{samples.time_s[-1]:g} s",
            "let the excitation run longer, or correct the times of its segments and the unit of time",
        )
    for segment, part in zip(excitation.segments, inside, strict=True):
        _check_rate(segment, part)


def _check_segment(segment: Segment, name: str) -> None:
    numbers = (segment.start_s, segment.end_s, segment.period_s, segment.offset_rad_s, *segment.lines_hz)
    advice = "check how the recording was made"
    if not all(math.isfinite(number) for number in numbers) or segment.settle_periods < 0:
        raise Refused(f"{name}: its times or lines are not usable numbers", advice)
    if not segment.lines_hz or segment.period_s <= 0.0 or segment.end_s <= segment.start_s:
        raise Refused(f"{name}: it has no lines, no period or no length", advice)
    cycles = [line * segment.period_s for line in segment.lines_hz]
    whole = [round(one) for one in cycles]
    off = max(abs(one - near) / max(1.0, near) for one, near in zip(cycles, whole, strict=True))
    if min(whole) < 1 or off > _WHOLE:
        raise Refused(
            f"{name}: its lines are not whole multiples of 1/period (period {segment.period_s:g} s)",
            "declare the period and the lines that were run, in s and Hz",
        )
    if len(set(whole)) < len(whole):
        raise Refused(f"{name}: a line stands there twice", "declare each line once")


def _check_rate(segment: Segment, part: Samples) -> None:
    interval = usual_interval(part.time_s)
    fastest = max(segment.lines_hz)
    if len(part) < 2 or not np.isfinite(interval):
        return
    if fastest * interval >= 0.5 * _NYQUIST:
        slow = fastest * interval > _SECONDS_NOT
        raise Refused(
            f"aliased: one sample every {interval:.3g} s can't tell a line at {fastest:g} Hz from its image",
            "check the unit of the time stamps" if slow else
            f"sample at {5.0 * fastest:.3g} Hz or faster, or excite with lower lines",
        )
    if segment.period_s / interval < 2.0 * (2 * len(segment.lines_hz) + 1):
        raise Refused(
            f"{segment.period_s / interval:.0f} samples a period are too few for {len(segment.lines_hz)} lines",
            "sample faster, or excite with fewer lines",
        )

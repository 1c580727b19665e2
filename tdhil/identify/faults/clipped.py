"""Motion that a limit shaped: the drive's flag, the torque at its limit, and flat tops that nobody declared.

A flat top is many samples at exactly the greatest (or least) value of a segment and few just below it. The crest of a
smooth wave, rounded to q, looks like that too. Of a sine of amplitude A, √(2q/A)/π is at the crest and 0.41 of it one
step below; of a crest as flat as x⁴, which a low-crest multisine may have, one step below is 0.19 of it, and a tenth
if the crest has a dip of just a step. Noise of the size of q thins the last step out to less than the one before. So,
where samples near the top wobble by noise, or leave it steeply, three times the share of the step below is suspect;
where they don't, twenty times. A top cut off by less than that is cut off by less than about a step, or in the noise:
it bends nothing.
"""

import numpy as np

from tdhil.estimation.result import Refused
from tdhil.estimation.samples import Samples
from tdhil.recording.recording import FloatArray, Recording, Segment

LIMIT_SHARE = 0.005       # of the excited samples that may be at a limit: they bend the line fit by about as much
_AT_LIMIT = 0.98          # of the torque limit counts as at it
_LEAST_FLAT = 5           # samples
_NOISY_RATIO, _SMOOTH_RATIO = 3.0, 20.0
_NOISY = 0.8              # steps of second difference on the mean, of the samples that are so many steps from the top:
_NEAR = 4.5               # a slow crest's are a step or none
_PILE = 0.01              # share at the extreme that is worth a look at all
_STEP = 1.5               # steps below the extreme that are one step below
_LOOKED_AT = 50_000       # of them at most
_ADVICE = "use less amplitude, or more torque if the machine allows it"


def check_limited(
    recording: Recording, windows: list[tuple[float, float]], parts: list[tuple[Segment, Samples]], kind: str
) -> None:
    """Raise Refused by the drive's flag and limit over all the excitation, then by each segment's shape."""
    flags = [recording.limited[slice(*np.searchsorted(recording.time_s, window))] for window in windows]
    count = sum(len(flag) for flag in flags)
    flagged = sum(int(np.count_nonzero(flag)) for flag in flags) / count if count else 0.0
    if flagged > LIMIT_SHARE:
        raise Refused(f"the drive was at an internal limit for {flagged:.1%} of the excitation", _ADVICE)
    limit = recording.torque_limit_nm
    if limit is not None and limit > 0.0:
        above, below = _AT_LIMIT * limit - recording.torque_offset_nm, -_AT_LIMIT * limit - recording.torque_offset_nm
        hits = sum(
            int(np.count_nonzero(part.torque_nm >= above) + np.count_nonzero(part.torque_nm <= below))
            for _, part in parts
        )
        saturated = hits / sum(len(part) for _, part in parts)
        if saturated > LIMIT_SHARE:
            reason = f"the torque was at its limit of {limit:g} N·m for {saturated:.1%} of the excitation"
            raise Refused(reason, _ADVICE)
    if kind == "step":
        return
    for segment, part in parts:
        for name, signal, quantum in (
            ("torque", part.torque_nm, recording.torque_resolution_nm),
            ("speed", part.speed_rad_s, recording.speed_resolution_rad_s),
        ):
            share = flat_share(signal, quantum)
            if share is not None:
                where = f"about {segment.offset_rad_s:.3g} rad/s"
                raise Refused(
                    f"the {name} is cut off flat for {share:.1%} of the excitation {where}",
                    f"{_ADVICE}; or widen the range in which the {name} is reported",
                )


def flat_share(signal: FloatArray, quantum: float) -> float | None:
    """Share of the samples (N,) exactly at the greatest or least value, if a rounded wave can't explain it."""
    if len(signal) < 8 * _LEAST_FLAT:
        return None
    found = [share for top in (float(np.max(signal)), float(np.min(signal)))
             if (share := _pile(signal, top, quantum)) is not None]
    return max(found, default=None)


def _pile(signal: FloatArray, top: float, quantum: float) -> float | None:
    at = int(np.count_nonzero(signal == top))
    share = at / len(signal)
    if at < _LEAST_FLAT or share < _PILE:
        return None
    reach = float(np.ptp(signal))
    distance = np.abs(signal - top)
    rest = distance[distance > 1e-9 * reach]
    # the step: declared, or as far as the next value that occurs; next to nothing for values that aren't rounded
    step = max(quantum, float(np.min(rest)) if len(rest) else 0.0)
    below = int(np.count_nonzero(rest <= _STEP * step))
    near = np.flatnonzero((distance[1:-1] > 1e-9 * reach) & (distance[1:-1] <= _NEAR * step))[:_LOOKED_AT] + 1
    wobble = np.abs(signal[near - 1] - 2.0 * signal[near] + signal[near + 1])
    noisy = len(near) == 0 or float(np.mean(wobble)) >= _NOISY * step
    return share if at > (_NOISY_RATIO if noisy else _SMOOTH_RATIO) * max(below, 1) else None

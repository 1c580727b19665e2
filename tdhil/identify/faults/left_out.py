"""Which samples are no measurements although nobody flagged them, and what a user is told of them."""

import numpy as np

from tdhil.identify.faults.frozen import frozen
from tdhil.identify.faults.spikes import spikes
from tdhil.recording.recording import BoolArray, Recording


def good_samples(recording: Recording) -> BoolArray:
    """(N,) True where a sample is fresh and finite, no spike, and doesn't repeat its stuck predecessor."""
    good: BoolArray = np.isfinite(recording.time_s)
    good &= recording.fresh
    good &= np.isfinite(recording.speed_rad_s)
    good &= np.isfinite(recording.torque_nm)
    for bad in (spikes(recording), frozen(recording)):
        if bad is not None:
            good &= ~bad
    return good


def log_warnings(recording: Recording) -> tuple[str, ...]:
    """What the log itself says of its samples: that they are not all, and that some brought nothing new."""
    found = []
    if not recording.complete:
        found.append("the log ended before the run did: partial data")
    stale = float((~recording.fresh).mean())
    if stale > 0.01:
        found.append(f"{stale:.1%} of the samples were stale and left out")
    return tuple(found)


def left_out_warnings(recording: Recording) -> tuple[str, ...]:
    """A sentence for each kind of fault that samples were left out for; stale ones, which were flagged, apart."""
    said = []
    finite = np.isfinite(recording.speed_rad_s)
    finite &= np.isfinite(recording.torque_nm)
    odd = int(np.count_nonzero(recording.fresh & ~finite))
    if odd:
        said.append(f"{_samples(odd)} not a number, and left out")
    jumps = spikes(recording)
    if jumps is not None:
        said.append(f"{_samples(int(np.count_nonzero(jumps)))} a spike far from its neighbours, and left out")
    stuck = frozen(recording)
    if stuck is not None:
        where, share = float(recording.time_s[np.argmax(stuck)]), float(np.mean(stuck))
        said.append(
            f"the feedback stuck although it was called fresh, first at {where:.6g} s: {share:.1%} of the samples were "
            "left out"
        )
    return tuple(said)


def _samples(count: int) -> str:
    return "1 sample was" if count == 1 else f"{count} samples were each"

"""What kind of motion a record holds, in words: a refusal should name what is missing, not only that something is."""

from typing import NoReturn

import numpy as np

from tdhil.estimation.result import Refused
from tdhil.estimation.samples import Samples
from tdhil.identify.record_route.stretches import Run
from tdhil.recording.recording import FloatArray, Recording

_STEADY_SHARE = 0.05       # of the speed: less excursion than this is a constant speed
_IDLE_SHARE = 0.02         # of the torque's span: torque this small is none
_LIMIT_SHARE = 0.005
_AT_LIMIT = 0.98
_FLAT_SHARE = 0.01
_LIVELY = 1.5             # median step between neighbours, in quanta: noise is seen
_ALIKE = 8                # samples in a row that noise would not leave alike
_TURNS = 2                 # changes of acceleration that one ramp has
_BLOCKS = 60

ADVICE = (
    "change the speed quickly and often, up and down, with the torque recorded all the while: steps or ramps of "
    "different steepness between several speeds, or a multisine about two mean speeds"
)


def check_signals(recording: Recording, samples: Samples) -> None:
    """Raise Refused where nothing moves, nothing pushes, or a limit shaped what is seen."""
    speed, torque = samples.speed_rad_s, samples.torque_nm
    if np.ptp(speed) <= 2.0 * recording.speed_resolution_rad_s or np.ptp(speed) == 0.0:
        raise Refused("the speed did not change", ADVICE)
    if np.ptp(torque) <= 2.0 * recording.torque_resolution_nm or np.ptp(torque) == 0.0:
        raise Refused("the torque did not change: a shaft that coasts shows how inertia and friction relate, not "
                       "how large they are", "record the torque, and a motion that the drive's torque causes")
    advice = "use less amplitude, or more torque if the machine allows it"
    flagged = float(np.mean(recording.limited))
    if flagged > _LIMIT_SHARE:
        raise Refused(f"the drive was at an internal limit for {flagged:.1%} of the record", advice)
    limit = recording.torque_limit_nm
    if limit is not None and limit > 0.0:
        at_limit = float(np.mean(np.abs(torque + recording.torque_offset_nm) >= _AT_LIMIT * limit))
        if at_limit > _LIMIT_SHARE:
            raise Refused(f"the torque was at its limit of {limit:g} N·m for {at_limit:.1%} of the record", advice)
    for name, signal, quantum in (("torque", torque, recording.torque_resolution_nm),
                                  ("speed", speed, recording.speed_resolution_rad_s)):
        share = _cut_off(signal, quantum)
        if share is not None:
            raise Refused(f"the {name} is cut off flat for {share:.1%} of the record", advice)


def refuse_open(samples: Samples, found: tuple[Run, ...]) -> NoReturn:
    """Raise Refused, the inertia being open: with which motion it was, and which would do."""
    if not found:
        raise Refused("the shaft never turned one way long enough without holes in the record", ADVICE)
    speed = _blocks(samples.speed_rad_s)
    torque = _blocks(samples.torque_nm)
    middle = float(np.max(np.abs(speed)))
    if np.ptp(speed) <= _STEADY_SHARE * middle:
        raise Refused("the speed was constant: torque at one speed is friction, and tells nothing of the inertia",
                       ADVICE)
    scatter = float(np.median(np.abs(np.diff(samples.torque_nm)))) + 1e-300
    moving = np.abs(speed) > _STEADY_SHARE * middle
    span = float(np.ptp(torque))
    if span <= 5.0 * scatter or np.mean(np.abs(torque[moving]) <= _IDLE_SHARE * span + scatter) > 0.5:
        raise Refused("for most of the motion no torque was reported: a shaft that coasts shows how inertia and "
                       "friction relate, not how large they are",
                       f"add motion that the drive's torque causes: {ADVICE}")
    rates = np.diff(speed)
    fast = rates[np.abs(rates) > 0.25 * float(np.max(np.abs(rates)))]
    if np.count_nonzero(np.diff(np.sign(fast))) < _TURNS:
        raise Refused("one change of speed leaves inertia, friction and the lags of the reported signals open: they "
                       "explain each other", ADVICE)
    raise Refused("torque and speed don't tell the inertia apart from friction, the lags of the reported signals and "
                   "the noise", ADVICE)


def _blocks(signal: FloatArray) -> FloatArray:
    """Means over some tens of parts in a row."""
    return np.array([float(np.mean(part)) for part in np.array_split(signal, min(_BLOCKS, len(signal)))])


def _cut_off(signal: FloatArray, quantum: float) -> float | None:
    """Share of samples at one extreme, where noise would not leave so many in a row alike; standstill is none."""
    steps = np.abs(np.diff(signal))
    if float(np.median(steps)) < _LIVELY * quantum or not np.any(steps):
        return None
    for extreme in (float(signal.max()), float(signal.min())):
        if abs(extreme) <= quantum:
            continue
        there = np.concatenate([[False], signal == extreme, [False]])
        edges = np.flatnonzero(there[1:] != there[:-1])
        share = float(np.mean(there))
        if share > _FLAT_SHARE and int(np.max(edges[1::2] - edges[::2])) >= _ALIKE:
            return share
    return None

"""Four records of one rig, one tone each: every one alone leaves the inertia open, together they tell it.

A tone is two equations for the five unknowns J, B, τ_w, τ_T and skew. The records are laid end to end in time as one
Recording with a segment each, and identified as any other: the same likelihood, on the lines of all four, with the
levels of their mean speeds for the friction.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from tdhil.estimation.result import Identification
from tdhil.recording.recording import Excitation, FloatArray, Recording, Segment

_BETWEEN_S = 10.0      # of nothing, between two records
_AROUND_S = 1.0        # kept before and after a record's segments


def joined(recordings: Sequence[Recording]) -> Recording:
    """One Recording of all: times shifted, each torque less its own offset; levels and ramps are left out."""
    times, speeds, torques, fresh, limited = [], [], [], [], []
    segments: list[Segment] = []
    begin_s = 0.0
    for recording in recordings:
        if recording.excitation is None or not recording.excitation.segments:
            raise ValueError("a record without excitation can't be joined to others")
        own = recording.excitation.segments
        first_s, last_s = own[0].start_s - _AROUND_S, own[-1].end_s + _AROUND_S
        keep = (recording.time_s >= first_s) & (recording.time_s <= last_s)
        shift_s = begin_s - first_s
        times.append(recording.time_s[keep] + shift_s)
        speeds.append(recording.speed_rad_s[keep])
        torques.append(recording.torque_nm[keep] - recording.torque_offset_nm)
        fresh.append(recording.fresh[keep])
        limited.append(recording.limited[keep])
        segments += [replace(part, start_s=part.start_s + shift_s, end_s=part.end_s + shift_s) for part in own]
        begin_s += last_s - first_s + _BETWEEN_S
    kinds = {recording.excitation.kind for recording in recordings if recording.excitation is not None}
    modes = {recording.excitation.mode for recording in recordings if recording.excitation is not None}
    return replace(
        recordings[0],
        time_s=np.concatenate(times),
        speed_rad_s=np.concatenate(speeds),
        torque_nm=np.concatenate(torques),
        fresh=np.concatenate(fresh),
        limited=np.concatenate(limited),
        excitation=Excitation(kinds.pop() if len(kinds) == 1 else "mixed", "+".join(sorted(modes)), tuple(segments)),
        levels=(),
        ramps=(),
        stages=(),
        torque_offset_nm=0.0,
    )


def expected_slope(
    hertz: FloatArray, inertia: float, viscous: float, speed_lag_s: float, torque_lag_s: float, skew_s: float
) -> FloatArray:
    """The slope T = slope·α + b that least squares finds on a tone, kg·m², (K,).

    Of T cos-like and α = dω/dt, both as reported, the slope is Re(T α*)/|α|² = Re(G(s)/s) at s = jω; without skew

        J (1 + ω² τ_w τ_T)/(1 + ω² τ_T²) + B (τ_w − τ_T)/(1 + ω² τ_T²).

    Averaging both over the same 0.1 s changes nothing in it.
    """
    s = (2j * np.pi * np.asarray(hertz, dtype=np.float64)).astype(np.complex128)
    seen = (inertia * s + viscous) * (1.0 + speed_lag_s * s) / (1.0 + torque_lag_s * s) * np.exp(-skew_s * s)
    slope: FloatArray = (seen / s).real
    return slope


def slope_of(identification: Identification, hertz: FloatArray) -> FloatArray | None:
    """The same for a joint fit; None where it gave no number."""
    found = identification
    parts = (found.viscous_nm_s_rad, found.speed_lag_s, found.torque_lag_s, found.skew_s)
    if found.inertia is None or any(part is None for part in parts):
        return None
    viscous, speed_lag, torque_lag, skew = (part.value for part in parts if part is not None)
    return expected_slope(hertz, found.inertia.value, viscous, speed_lag, torque_lag, skew)

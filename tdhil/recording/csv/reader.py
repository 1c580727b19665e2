"""A trace and what else is known of the bench, as a Recording."""

import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from tdhil.record.csv_choice import USUAL, Choices
from tdhil.record.csv_trace import read_trace
from tdhil.recording.csv.excitation import load_excitation
from tdhil.recording.recording import FloatArray, LagPrior, Recording

_LOOKED_AT = 200_000     # samples, for the resolution
_ROUNDING = 1e-9         # of the largest value: differences below it are the arithmetic's


@dataclass(frozen=True)
class Bench:
    """What a trace doesn't say: N·m and 1 at the motor shaft; None where nobody knows."""

    rated_torque_nm: float | None = None
    torque_limit_nm: float | None = None
    torque_scale_rel_sd: float = 0.0
    gear_ratio: float = 1.0
    lag_prior: LagPrior = field(default_factory=LagPrior)


def read_recording(
    path: Path, choices: Choices = USUAL, excitation: Path | None = None, bench: Bench | None = None
) -> tuple[Recording, tuple[str, ...]]:
    """The Recording, and a warning for everything that was assumed or left out.

    Raises what `read_trace` does, and DataFileError for the file of the excitation.
    """
    bench = bench or Bench()
    trace = read_trace(path, choices, bench.rated_torque_nm)
    known, levels = (None, ()) if excitation is None else load_excitation(excitation, trace.time_s)
    count = len(trace.time_s)
    return Recording(
        time_s=trace.time_s,
        speed_rad_s=trace.speed_rad_s,
        torque_nm=trace.torque_nm,
        fresh=np.ones(count, dtype=np.bool_),
        limited=np.zeros(count, dtype=np.bool_),
        excitation=known,
        levels=levels,
        lag_prior=bench.lag_prior,
        speed_resolution_rad_s=resolution(trace.speed_rad_s),
        torque_resolution_nm=resolution(trace.torque_nm),
        torque_limit_nm=bench.torque_limit_nm,
        torque_scale_rel_sd=bench.torque_scale_rel_sd,
        gear_ratio=bench.gear_ratio,
    ), trace.warnings


def resolution(signal: FloatArray) -> float:
    """The smallest step between two values that occur, 0 for a constant: of a quantised signal, its quantum.

    Without it the rounded crest of a small wave would look clipped.
    """
    values = np.unique(signal[:_LOOKED_AT])
    steps = np.diff(values)
    steps = steps[steps > _ROUNDING * float(np.max(np.abs(values)))]
    found = float(steps.min()) if len(steps) else 0.0
    return found if math.isfinite(found) else 0.0

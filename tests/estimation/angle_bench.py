"""Runs of `stages_bench` whose shaft has torque over its angle, and whose drive reports that angle."""

from dataclasses import dataclass, field, replace

import numpy as np

from tdhil.recording import Recording
from tests.estimation.shaft_bench import Rig, recordings
from tests.estimation.stages_bench import Play, Stages, turn

RATED_NM = 400.0
"""Rated torque of the bench's rig: its torque limit."""
COUNTS = 8192
EVERY = 5              # samples of speed and torque per sample of the angle, as with a second TPDO


@dataclass(frozen=True)
class OverAngle:
    """Differences from the usual run of `stages_bench`."""

    rig: Rig = field(default_factory=Rig)
    periods: int = 6
    rate_hz: float = 250.0
    every: int = EVERY
    play: Play | None = None
    static: float = 0.0    # N·m; Stribeck friction at standstill, above Coulomb's


def run_over_angle(bench: OverAngle, seeds: list[int]) -> list[Recording]:
    """Return one recording per seed, with the counted angle once in ``every`` samples."""
    stages = Stages(rig=bench.rig, periods=bench.periods, static=bench.static, play=bench.play)
    motion, shaft, reported = turn(stages, seeds)
    found = recordings(bench.rig, motion, replace(shaft, torque=reported), seeds, rate_hz=bench.rate_hz)
    return [replace(one, position_rad=_counted(one, shaft.angle[:, k], bench.every)) for k, one in enumerate(found)]


def _counted(recording: Recording, angle: np.ndarray, every: int) -> np.ndarray:
    count = 2.0 * np.pi / COUNTS
    steps = np.arange(0, len(angle), len(angle) // len(recording.time_s))[: len(recording.time_s)]
    seen = np.floor(angle[steps] / count) * count
    told = np.full(len(seen), np.nan)
    told[::every] = seen[::every]
    return told

"""When a speed counts as steady, and what is then read off it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from drivers import Command, LimitHit, Sample
from tdhil.recording import FloatArray, Level
from tdhil.run.control_loop import ControlLoop


@dataclass(frozen=True)
class SteadyLevel:
    """Means over a stretch of steady speed, with their scatter; SI at the motor shaft."""

    level: Level
    speed_rad_s: float
    torque_nm: float
    speed_sd_rad_s: float
    torque_sd_nm: float


@dataclass(frozen=True)
class Trace:
    """Samples as arrays (N,), only the fresh ones."""

    time_s: FloatArray
    speed_rad_s: FloatArray
    torque_nm: FloatArray


def trace(samples: Iterable[Sample]) -> Trace:
    """Arrays of the fresh samples."""
    rows = [(sample.time_s, sample.speed_rad_s, sample.torque_nm) for sample in samples if sample.fresh]
    table = np.array(rows, dtype=np.float64).reshape(-1, 3)
    return Trace(table[:, 0].copy(), table[:, 1].copy(), table[:, 2].copy())


def steady_level(samples: Sequence[Sample]) -> SteadyLevel:
    """What a stretch of steady speed says."""
    held = trace(samples)
    return SteadyLevel(
        Level(float(held.time_s[0]), float(held.time_s[-1])),
        float(held.speed_rad_s.mean()),
        float(held.torque_nm.mean()),
        float(held.speed_rad_s.std()),
        float(held.torque_nm.std()),
    )


BLOCK_S = 0.5
BLOCKS = 4


def wait_until_steady(
    loop: ControlLoop, command: Command, target_rad_s: float, tolerance_rad_s: float, timeout_s: float
) -> list[Sample]:
    """Hold a command until the mean speed of four half-second blocks in a row is at the target.

    Raises LimitHit when that doesn't happen in time.
    """
    seen: list[Sample] = []
    good = 0
    for _ in range(max(BLOCKS, round(timeout_s / BLOCK_S))):
        block = loop.hold(command, BLOCK_S)
        seen += block
        mean = sum(sample.speed_rad_s for sample in block) / len(block)
        good = good + 1 if abs(mean - target_rad_s) <= tolerance_rad_s else 0
        if good >= BLOCKS:
            return seen
    torque_nm = sum(sample.torque_nm for sample in block) / len(block)
    torque, helps = loop.guard.torque_told(torque_nm, block[-1].limit_active)
    raise LimitHit(
        f"the speed did not settle at {target_rad_s:.3f} rad/s within {timeout_s:g} s (last {mean:.3f} rad/s);"
        f" {torque}",
        where=f"at {loop.now_s:.1f} s",
        next_step=helps,
    )

"""Stage 3, torque: the bumpless switch, and the ramp to a target torque that the speed window can bear.

The torque target is seeded with the torque that is flowing *before* the switch; the switch must be confirmed. The
target torque T is that of steady rotation at a speed inside the window, T_c + B ω: without load any other torque
would run away to a speed of its own choosing. While the speed drifts from one to the other,

    ∫(T − T_c − B ω) dt = J Δω

gives the inertia a second time, now in torque mode.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drivers.drive import Command, Mode
from tdhil.identify.rough import RoughInertia, rough_inertia
from tdhil.protocol.bench import Bench
from tdhil.protocol.settings import MachineLimits
from tdhil.protocol.stage_speed import SpeedResult
from tdhil.protocol.steady import trace
from tdhil.record.recording import Level, Ramp

DRIFT_S = 8.0
END_S = 0.5
SLOPE_SHARE_PER_S = 0.1
"""The torque is ramped by at most this share of the limit per second."""


@dataclass(frozen=True)
class TorqueResult:
    """``rough`` is the drift's own estimate, None where the speed hardly changed."""

    target_nm: float
    ramp: Ramp
    rough: RoughInertia | None
    speed_rad_s: float                 # where the shaft is when the stage ends


def run_torque(bench: Bench, limits: MachineLimits, speed: SpeedResult, torque_offset_nm: float) -> TorqueResult:
    """Switch, ramp, let the speed drift. Raises ModeNotConfirmed and what the bench raises."""
    flowing_nm = float(np.mean([sample.torque_nm for sample in speed.last])) - torque_offset_nm
    flowing_nm = _within(flowing_nm, limits.torque_nm)
    keep_rad_s = speed.high.speed_rad_s
    # Seeded for a few cycles before the switch, so that the target is there when the mode is.
    bench.hold(Command(Mode.SPEED, keep_rad_s, flowing_nm), 5.0 * bench.period_s)
    bench.switch_mode(Command(Mode.TORQUE, keep_rad_s, flowing_nm))
    bench.log.event(bench.now_s, "mode", f"torque mode confirmed, seeded with {flowing_nm:.1f} N·m")
    target_nm = _within(speed.model.steady_torque_nm(speed.low.speed_rad_s), limits.torque_nm)
    steps = max(1, bench.cycles(abs(target_nm - flowing_nm) / (SLOPE_SHARE_PER_S * limits.torque_nm)))
    start_s = bench.now_s
    samples = [
        bench.cycle(Command(Mode.TORQUE, keep_rad_s, flowing_nm + (target_nm - flowing_nm) * step / steps))
        for step in range(1, steps + 1)
    ]
    samples += bench.hold(Command(Mode.TORQUE, keep_rad_s, target_nm), DRIFT_S)
    drift = trace([*speed.last, *samples])
    end = Level(bench.now_s - END_S, bench.now_s)
    rough = rough_inertia(
        drift.time_s,
        drift.speed_rad_s,
        drift.torque_nm - torque_offset_nm,
        Level(float(drift.time_s[0]), start_s),
        end,
        speed.rough.friction,
    )
    return TorqueResult(target_nm, Ramp(start_s, bench.now_s), rough, float(drift.speed_rad_s[-1]))


def _within(torque_nm: float, limit_nm: float) -> float:
    return max(-limit_nm, min(limit_nm, torque_nm))

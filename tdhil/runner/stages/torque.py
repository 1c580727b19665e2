"""Stage 3, torque: the bumpless switch, the braking probe, and the ramp to a target torque within the speed window.

It begins at the lower speed of stage 2. The torque setpoint starts with the torque that flows *before* the switch,
never below zero; the switch must be confirmed. Then one small braking torque is tried (`braking_probe`). The target
torque T is that of steady rotation at the higher speed, T_c + B ω: without load, any other torque would lead to an
arbitrary speed. While the speed drifts from one to the other,

    ∫(T − T_c − B ω) dt = J Δω

gives the inertia a second time, now in torque mode. The probe's pulse is part of the integral.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from drivers import Command, Mode, Sample
from profiles.quantities import in_nm
from tdhil.estimation import RoughInertia, rough_inertia
from tdhil.recording import Level, Ramp
from tdhil.runner.control_loop import ControlLoop
from tdhil.runner.guard import kept_within
from tdhil.runner.settings import ControlAssumptions, MachineLimits
from tdhil.runner.stages.braking_probe import probe_braking, slow_speed
from tdhil.runner.stages.speed import SpeedResult
from tdhil.runner.stages.steady import trace

DRIFT_S = 8.0             # s; time at the target torque
END_S = 0.5               # s; end of this time, over which the last speed is averaged
SLOPE_SHARE_PER_S = 0.1
"""Steepest torque ramp, share of the limit per second."""


@dataclass(frozen=True)
class TorqueResult:
    """Result of stage 3. ``rough``: estimate from the drift, None if the speed hardly changed."""

    target_nm: float
    ramp: Ramp
    rough: RoughInertia | None
    speed_rad_s: float                 # speed at the end of the stage


def run_torque(
    loop: ControlLoop, limits: MachineLimits, assumptions: ControlAssumptions, speed: SpeedResult,
    slow: Sequence[Sample],
    torque_offset_nm: float, speed_resolution_rad_s: float, setpoint_where: str,
) -> TorqueResult:
    """Run stage 3: switch, braking probe, ramp, drift. ``slow``: samples of steady rotation in speed mode before it.

    ``setpoint_where`` names the drive's torque setpoint. Raises ModeNotConfirmed, PreflightRefused if the drive does
    not brake with a braking torque, and what the bench raises.
    """
    before = trace(slow)
    flowing_nm = kept_within(float(before.torque_nm.mean()) - torque_offset_nm, 0.0, limits.torque_nm)
    keep_rad_s = slow_speed(limits, speed.wander_rad_s)
    # The setpoint is sent a few cycles before the switch, so that it is present when the mode changes.
    samples = [*slow, *loop.hold(Command(Mode.SPEED, keep_rad_s, flowing_nm), 5.0 * loop.period_s)]
    samples.append(loop.switch_mode(Command(Mode.TORQUE, keep_rad_s, flowing_nm)))
    loop.log.event(loop.now_s, "mode", f"torque mode confirmed, seeded with {in_nm(flowing_nm)}")
    samples += probe_braking(
        loop, limits, speed.model, assumptions, slow, flowing_nm, speed_resolution_rad_s, setpoint_where,
        speed.wander_rad_s,
    )
    target_nm = kept_within(speed.model.steady_torque_nm(speed.high.speed_rad_s), 0.0, limits.torque_nm)
    steps = max(1, loop.cycles(abs(target_nm - flowing_nm) / (SLOPE_SHARE_PER_S * limits.torque_nm)))
    start_s = loop.now_s
    samples += [
        loop.cycle(Command(Mode.TORQUE, keep_rad_s, flowing_nm + (target_nm - flowing_nm) * step / steps))
        for step in range(1, steps + 1)
    ]
    samples += loop.hold(Command(Mode.TORQUE, keep_rad_s, target_nm), DRIFT_S)
    drift = trace(samples)
    rough = rough_inertia(
        drift.time_s,
        drift.speed_rad_s,
        drift.torque_nm - torque_offset_nm,
        Level(float(before.time_s[0]), float(before.time_s[-1])),
        Level(loop.now_s - END_S, loop.now_s),
        speed.rough.friction,
    )
    return TorqueResult(target_nm, Ramp(start_s, loop.now_s), rough, float(drift.speed_rad_s[-1]))

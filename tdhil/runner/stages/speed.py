"""Stage 2, speed: go to the first mean speed under the drive's own speed control, settle; then to a second one.

The mean torque at two steady speeds gives Coulomb and viscous friction without any lag. The ramp between them gives a
rough inertia by its momentum balance, in which a lag cancels because both ends are steady.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from drivers import Command, DriveFault, Mode, Sample
from profiles import MessageCode
from tdhil.estimation import (
    RoughFriction,
    RoughInertia,
    Samples,
    rough_friction,
    rough_inertia,
    rough_inertia_before_echo,
)
from tdhil.recording import FloatArray, Level, Ramp
from tdhil.runner.control_loop import ControlLoop
from tdhil.runner.excitation import RigGuess
from tdhil.runner.settings import MEAN_SPEED_SHARES, ControlAssumptions, MachineLimits
from tdhil.runner.speed_check import SpeedUnitCheck, SpeedWitness
from tdhil.runner.stages.steady import (
    SteadyLevel,
    Swing,
    calm_string,
    hold_damped,
    steady_level,
    trace,
    wait_until_steady,
    widest,
)
from tdhil.runner.string_release import SwingDamper

LEVEL_S = 6.0             # s; duration of an operating point
OSCILLATING_LEVEL_S = 24.0
"""Duration of an operating point with a string that keeps oscillating, s: some periods, to average them out."""

FIRST_RAMP_S = 8.0
"""Duration of the first ramp over the whole window, s; a light rig is then ramped faster."""

GOOD_ENOUGH = 0.2
"""Relative uncertainty of the rough inertia that is sufficient for planning."""

STRING_ERROR = 0.75
"""Relative uncertainty of the rough inertia with a drill string. Depending on frequency, the motor moves its own
inertia only, or up to that of the whole string. A plan must leave room for it. A steeper ramp gives no better value."""

ECHO_SHARE, BEFORE_RAMPS_S = 0.75, (6.0, 7.3, 5.2, 8.1, 6.7, 5.6)
"""With a string that keeps oscillating: duration of a ramp between the speeds, as a share of the time before its echo;
and the times between these ramps, s. The times differ so that the remaining oscillations cancel on average."""

RESTLESS_ERROR = 0.5
"""Relative uncertainty of the rough inertia with a drill string, if it follows from the time before an echo: the motor
moves further than its own inertia explains, because the string oscillates too."""

WANDER = 1.25
"""Ratio of the deviation of speed at constant torque to the largest one under a yielding speed control, with an
oscillating string."""

TRIES = 4                 # ramps between the two speeds, until the rough inertia is good enough
NOBODY = SpeedWitness()

_WRONG_TORQUE = "Check sign and scale of the torque. A wider speed window gives a better ramp"
_TOO_RESTLESS = (
    "The string's oscillation hides the ramp. Widen the speed window, lift the bit off bottom, or reduce the weight on"
    " bit"
)


@dataclass(frozen=True)
class RampCourse:
    """Setpoint and reported speed of the ramp between the operating points, with both steady ends, (N,) each."""

    time_s: FloatArray
    setpoint_rad_s: FloatArray
    reported_rad_s: FloatArray


@dataclass(frozen=True)
class SpeedResult:
    """Torque at two speeds, and the model for further planning."""

    low: SteadyLevel
    high: SteadyLevel
    model: RigGuess
    rough: RoughInertia
    ramp: Ramp
    last: tuple[Sample, ...]           # the steady samples at the higher speed, before the switch
    steady: tuple[Samples, ...] = ()   # both operating points, torque without its offset: the disturbances
    course: RampCourse | None = None       # setpoint and report on the ramp
    swing: Swing | None = None         # of a drill string that keeps oscillating

    @property
    def wander_rad_s(self) -> float:
        """Return the deviation from the mean speed that an oscillating string causes at constant torque, rad/s."""
        return 0.0 if self.swing is None else WANDER * self.swing.speed_rad_s

    @property
    def disturbed(self) -> str:
        """Return a description of the disturbance for the guard; empty if there is none."""
        return "" if self.swing is None else self.swing.words

    @property
    def levels(self) -> tuple[Level, ...]:
        return (self.low.level, self.high.level)


def mean_speeds(limits: MachineLimits) -> tuple[float, float]:
    """Return the two mean speeds of the operating points, rad/s."""
    span = limits.speed_max_rad_s - limits.speed_min_rad_s
    low, high = MEAN_SPEED_SHARES
    return limits.speed_min_rad_s + low * span, limits.speed_min_rad_s + high * span


def run_speed(
    loop: ControlLoop,
    limits: MachineLimits,
    assumptions: ControlAssumptions,
    speed_resolution_rad_s: float,
    torque_offset_nm: float,
    witness: SpeedWitness = NOBODY,
) -> SpeedResult:
    """Run both operating points and the ramp between them.

    Raises what the bench raises, LimitHit if a speed does not settle, PreflightRefused if the unit of speed is wrong.
    """
    low_rad_s, high_rad_s = mean_speeds(limits)
    tolerance_rad_s = max(2.0 * speed_resolution_rad_s, 0.01 * high_rad_s)
    rate = (limits.speed_max_rad_s - limits.speed_min_rad_s) / FIRST_RAMP_S
    in_torque = loop.last is not None and loop.last.mode is Mode.TORQUE
    start = loop.switch_mode(Command(Mode.SPEED, 0.0, 0.0)) if in_torque else None
    speed_now = max(0.0, start.speed_rad_s) if start else 0.0
    unit_check = SpeedUnitCheck(loop, limits, assumptions, speed_resolution_rad_s, witness)
    unit_check.ramp(speed_now, low_rad_s, rate)
    low_held = _settle_and_hold(loop, limits, low_rad_s, tolerance_rad_s, assumptions, unit_check.level)
    swing = low_held.swing
    unit_check.conclude(Command(Mode.SPEED, low_rad_s, 0.0))
    good_enough = STRING_ERROR if limits.has_drill_string else GOOD_ENOUGH
    for _ in range(TRIES):
        ramped = ramp_speed(loop, low_rad_s, high_rad_s, rate)
        high_held = _settle_and_hold(loop, limits, high_rad_s, tolerance_rad_s, assumptions)
        # A disturbed string may be calm at one operating point for a time, but not at both.
        swing = widest(swing, high_held.swing)
        low_samples, between, high_samples = low_held.level, [*ramped, *high_held.settling], high_held.level
        low, high = steady_level(low_samples), steady_level(high_samples)
        moved = trace([*low_samples, *between, *high_samples])
        rough = rough_inertia(
            moved.time_s, moved.speed_rad_s, moved.torque_nm - torque_offset_nm, low.level, high.level,
            swinging=limits.has_drill_string,
        )
        if rough is not None and rough.rel_error <= good_enough:
            break
        if swing is not None and limits.echo_s > 0.0:
            friction = rough_friction(
                moved.time_s, moved.speed_rad_s, moved.torque_nm - torque_offset_nm, low.level, high.level
            )
            rough = inertia_before_echo(loop, limits, (low_rad_s, high_rad_s), friction)
            good_enough = RESTLESS_ERROR
            break
        rate *= 4.0
        loop.log.event(loop.now_s, "plan", f"rough inertia is uncertain; ramping again at {rate:.3g} rad/s²")
        ramp_speed(loop, high_rad_s, low_rad_s, rate)
        low_held = _settle_and_hold(loop, limits, low_rad_s, tolerance_rad_s, assumptions)
        swing = widest(swing, low_held.swing)
    if rough is None or not rough.inertia_kg_m2 > 0.0:
        found = "none" if rough is None else f"{rough.inertia_kg_m2:.3g} kg·m²"
        raise DriveFault(
            f"the speed ramp gives no plausible inertia ({found})",
            where="stage speed",
            next_step=_TOO_RESTLESS if limits.has_drill_string else _WRONG_TORQUE,
            entry=MessageCode.NO_PLAUSIBLE_INERTIA,
        )
    friction = rough.friction.opposing(0.5 * (low.speed_rad_s + high.speed_rad_s))
    model = RigGuess(
        rough.inertia_kg_m2,
        friction.viscous_nm_s_rad,
        friction.coulomb_nm,
        min(0.8, max(good_enough, rough.rel_error)),
    )
    result = SpeedResult(
        low,
        high,
        model,
        rough,
        Ramp(low.level.end_s, high.level.start_s),
        tuple(high_samples[-loop.cycles(0.5) :]),
        tuple(_samples(part, torque_offset_nm) for part in (low_samples, high_samples)),
        _course(low_samples, ramped, high_held, mean_speeds(limits)),
        swing,
    )
    loop.guard.know(model)
    loop.guard.disturbed = result.disturbed
    return result


def inertia_before_echo(
    loop: ControlLoop, limits: MachineLimits, speeds_rad_s: tuple[float, float], friction: RoughFriction | None
) -> RoughInertia | None:
    """Estimate the inertia above an oscillating string with a known pipe from quick ramps before the echo."""
    if friction is None:
        return None
    rate = abs(speeds_rad_s[1] - speeds_rad_s[0]) / (ECHO_SHARE * limits.echo_s)
    loop.log.event(loop.now_s, "plan", f"rough inertia from ramps at {rate:.3g} rad/s², before their echo")
    seen, to = [], speeds_rad_s[1]
    for number, between_s in enumerate(BEFORE_RAMPS_S):
        before, asked = hold_damped(loop, _damper(loop, limits, to), between_s)
        to = speeds_rad_s[number % 2]
        ramped = ramp_speed(loop, asked[-1], to, rate)
        after = loop.hold(Command(Mode.SPEED, to, 0.0), limits.echo_s)
        one = trace([*before, *ramped, *after])
        seen.append((one.time_s, one.speed_rad_s, one.torque_nm, before[-1].time_s))
    hold_damped(loop, _damper(loop, limits, to), BEFORE_RAMPS_S[0])
    return rough_inertia_before_echo(seen, limits.echo_s, limits.wave_impedance_nm_s_rad, friction)


def _damper(loop: ControlLoop, limits: MachineLimits, speed_rad_s: float) -> SwingDamper:
    return SwingDamper(limits.torque_nm, limits.speed_max_rad_s, speed_rad_s, loop.period_s)


@dataclass(frozen=True)
class _Held:
    """Settling and operating point at a speed; ``setpoints_rad_s``: one per sample of both."""

    settling: list[Sample]
    level: list[Sample]
    setpoints_rad_s: list[float]
    swing: Swing | None = None


def _course(low: list[Sample], ramp: list[Sample], high: _Held, speeds_rad_s: tuple[float, float]) -> RampCourse:
    low_rad_s, high_rad_s = speeds_rad_s
    setpoint = np.concatenate([
        np.full(len(low), low_rad_s),
        low_rad_s + (high_rad_s - low_rad_s) * np.arange(1, len(ramp) + 1) / len(ramp),
        np.array(high.setpoints_rad_s),
    ])
    after = (*high.settling, *high.level)
    rows = np.array([(one.time_s, one.speed_rad_s, one.fresh) for one in (*low, *ramp, *after)], dtype=np.float64)
    fresh = rows[:, 2] > 0.0
    return RampCourse(rows[fresh, 0], setpoint[fresh], rows[fresh, 1])


def _samples(held: list[Sample], torque_offset_nm: float) -> Samples:
    fresh = trace(held)
    return Samples(fresh.time_s, fresh.speed_rad_s, fresh.torque_nm - torque_offset_nm)


def ramp_speed(loop: ControlLoop, start_rad_s: float, end_rad_s: float, rate_rad_s2: float) -> list[Sample]:
    """Ramp the setpoint linearly in speed mode. Return the samples."""
    steps = loop.cycles(abs(end_rad_s - start_rad_s) / rate_rad_s2)
    span = end_rad_s - start_rad_s
    return [loop.cycle(Command(Mode.SPEED, start_rad_s + span * step / steps, 0.0)) for step in range(1, steps + 1)]


def _settle_and_hold(
    loop: ControlLoop,
    limits: MachineLimits,
    speed_rad_s: float,
    tolerance_rad_s: float,
    assumptions: ControlAssumptions,
    before_level: Callable[[], None] = lambda: None,
) -> _Held:
    """Settle, wait for the reporting lags, then hold the operating point. With a drill string the motor yields."""
    lags_s = 2.0 * assumptions.largest_speed_lag_s
    if limits.has_drill_string:
        calmed = calm_string(loop, limits, speed_rad_s, tolerance_rad_s)
        later, asked_later = hold_damped(loop, calmed.damper, lags_s)
        before_level()
        keeps_oscillating = calmed.swing.keeps_oscillating(limits)
        level, asked = hold_damped(loop, calmed.damper, OSCILLATING_LEVEL_S if keeps_oscillating else LEVEL_S)
        setpoints = [*calmed.setpoints_rad_s, *asked_later, *asked]
        return _Held([*calmed.samples, *later], level, setpoints, calmed.swing if keeps_oscillating else None)
    command = Command(Mode.SPEED, speed_rad_s, 0.0)
    settling = wait_until_steady(loop, command, speed_rad_s, tolerance_rad_s, timeout_s=60.0)
    settling += loop.hold(command, lags_s)
    before_level()
    level = loop.hold(command, LEVEL_S)
    return _Held(settling, level, [speed_rad_s] * (len(settling) + len(level)))

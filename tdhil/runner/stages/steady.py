"""Steady speed: the test for it, and means during it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from drivers import Command, LimitHit, Mode, Sample
from profiles import MessageCode
from profiles.quantities import in_nm
from tdhil.estimation import STICK_SLIP_REGULAR, STICK_SLIP_SHARE, downhole_swing_rad_s, repeats
from tdhil.recording import FloatArray, Level
from tdhil.runner.control_loop import ControlLoop
from tdhil.runner.settings import MachineLimits
from tdhil.runner.string_release import SwingDamper


@dataclass(frozen=True)
class SteadyLevel:
    """Means over a stretch of steady speed, with their scatter; SI at the motor shaft."""

    level: Level
    speed_rad_s: float
    torque_nm: float
    speed_sd_rad_s: float
    torque_sd_nm: float


@dataclass(frozen=True)
class SampleTrace:
    """Samples as arrays (N,), only the fresh ones."""

    time_s: FloatArray
    speed_rad_s: FloatArray
    torque_nm: FloatArray


def trace(samples: Iterable[Sample]) -> SampleTrace:
    """Return arrays of the fresh samples."""
    rows = [(sample.time_s, sample.speed_rad_s, sample.torque_nm) for sample in samples if sample.fresh]
    table = np.array(rows, dtype=np.float64).reshape(-1, 3)
    return SampleTrace(table[:, 0].copy(), table[:, 1].copy(), table[:, 2].copy())


def steady_level(samples: Sequence[Sample]) -> SteadyLevel:
    """Return the means over a stretch of steady speed."""
    held = trace(samples)
    return SteadyLevel(
        Level(float(held.time_s[0]), float(held.time_s[-1])),
        float(held.speed_rad_s.mean()),
        float(held.torque_nm.mean()),
        float(held.speed_rad_s.std()),
        float(held.torque_nm.std()),
    )


BLOCK_S = 0.5             # s; a block whose mean speed is compared with the target
BLOCKS = 4                # blocks in a row that must be at the target
APPROACH_S = 10.0
"""Averaging time of the speed's error, s. Its last mean, and the mean `APPROACH_APART` such times before, show how fast
the speed approaches its target."""
APPROACH_APART = 3        # distance of the two means, in units of `APPROACH_S`
LEAST_APPROACH = 1.05     # ratio of the two errors; below it the error counts as constant
NEAR_SHARE = 0.25         # ratio of the error to the set speed, above which the speed does not count as approaching
SLOWEST_S = 20.0
"""Time constant with which a speed loop should remove a standing error, s: three of them fit into the usual timeout."""


def wait_until_steady(
    loop: ControlLoop, command: Command, target_rad_s: float, tolerance_rad_s: float, timeout_s: float
) -> list[Sample]:
    """Hold a command until the mean speed of four half-second blocks in a row is at the target.

    Raises LimitHit if that takes longer than ``timeout_s``.
    """
    seen: list[Sample] = []
    means: list[float] = []
    good = 0
    for _ in range(max(BLOCKS, round(timeout_s / BLOCK_S))):
        block = loop.hold(command, BLOCK_S)
        seen += block
        mean = sum(sample.speed_rad_s for sample in block) / len(block)
        means.append(mean)
        good = good + 1 if abs(mean - target_rad_s) <= tolerance_rad_s else 0
        if good >= BLOCKS:
            return seen
    torque_nm = sum(sample.torque_nm for sample in block) / len(block)
    torque, helps = loop.guard.torque_words(torque_nm, block[-1].limit_active)
    approach_s = approaching_s(means, target_rad_s)
    if approach_s is not None:
        torque += f". The speed approaches its setpoint with a time constant of {approach_s:.0f} s"
        helps = (
            "The integral gain of the drive's speed loop is small for its proportional gain. tdhil does not continue,"
            " because this loop would also take minutes to bring the shaft to standstill. Raise the integral gain about"
            f" {max(2.0, approach_s / SLOWEST_S):.0f} times, or shorten the loop's reset time as much"
        )
    raise LimitHit(
        f"the speed did not settle at {target_rad_s:.3f} rad/s within {timeout_s:g} s (last {mean:.3f} rad/s);"
        f" {torque}",
        where=f"at {loop.now_s:.1f} s",
        next_step=helps,
        entry=MessageCode.NOT_SETTLED,
    )


def approaching_s(means_rad_s: Sequence[float], target_rad_s: float) -> float | None:
    """Return the time constant with which block means approach a target; None if they do something else.

    A speed loop removes the standing error that friction causes with the time constant (P + B)/I.
    """
    count = round(APPROACH_S / BLOCK_S)
    if len(means_rad_s) < (APPROACH_APART + 1) * count:
        return None
    errors = (target_rad_s - np.array(means_rad_s[-(APPROACH_APART + 1) * count :])).reshape(-1, count).mean(axis=1)
    before, last = float(errors[0]), float(errors[-1])
    falls = bool(np.all(np.diff(np.abs(errors)) < 0.0)) and before * last > 0.0
    if not falls or abs(before) > NEAR_SHARE * abs(target_rad_s) or before / last < LEAST_APPROACH:
        return None
    return APPROACH_APART * APPROACH_S / math.log(before / last)


# ---------------------------------------------------------------------------------------------------------------------
# A drill string is steady when it no longer oscillates, not when the shaft has its speed: behind a stiff speed loop
# waves run up and down for minutes while the top hardly shows it. So the top yields (`SwingDamper`) until the torque is
# calm. A string under load is never quite calm: its bit disturbs it. Once yielding reduces the oscillation no further,
# the rest is accepted, unless the oscillation sustains itself: with stick-slip nothing can be measured.


CALM_SHARE = 0.02
"""Share of the torque limit within which the torque of a calm string oscillates around its mean."""

CALM_S = 6.0
"""Time for which a string must be calm, s: half a period of a string with a period of 12 s."""

WINDOW_S = 12.0           # s; the oscillation of one such window is compared with that of the window before
NO_CALMER = 0.75
"""Ratio to the oscillation of the time before; above it the oscillation counts as not decaying."""

STICK_SLIP_TORQUE_SHARE = 0.5
"""Share of the mean torque that stick-slip reaches. With a known pipe `STICK_SLIP_SHARE` is used instead."""

MOST_CALMING_S = 120.0    # s; longest wait for a string to become calm


@dataclass(frozen=True)
class Swing:
    """Oscillation of a string: half of peak to peak; ``period_s`` and ``regular`` are 0 if it is not periodic."""

    torque_nm: float
    speed_rad_s: float
    period_s: float
    regular: float

    @property
    def words(self) -> str:
        """Return the oscillation in words."""
        every = f" every {self.period_s:.1f} s" if self.regular >= STICK_SLIP_REGULAR else ""
        return (
            f"the string below oscillates with ±{in_nm(self.torque_nm)}{every}, the top with ±{self.speed_rad_s:.2f}"
            " rad/s, and the oscillation does not decay"
        )

    def keeps_oscillating(self, limits: MachineLimits) -> bool:
        """Return whether the string oscillates more than a calm string."""
        return self.torque_nm > CALM_SHARE * limits.torque_nm


@dataclass(frozen=True)
class Calmed:
    """Calmed string: samples, one setpoint per sample, remaining oscillation, and the damper, which can continue."""

    samples: list[Sample]
    setpoints_rad_s: list[float]
    swing: Swing
    damper: SwingDamper


def widest(*swings: Swing | None) -> Swing | None:
    """Return the oscillation with the largest speed; None if there is none."""
    return max((one for one in swings if one is not None), key=lambda one: one.speed_rad_s, default=None)


def swing_of(samples: Sequence[Sample], period_s: float) -> Swing:
    """Return the oscillation, from means over `BLOCK_S`/2, which remove the noise of the reports."""
    width = max(1, round(BLOCK_S / 2.0 / period_s))
    seen = trace(samples)
    blocks = len(seen.time_s) // width
    if blocks < 2:
        return Swing(0.0, 0.0, 0.0, 0.0)
    torque, speed = (part[-blocks * width:].reshape(blocks, width).mean(axis=1)
                     for part in (seen.torque_nm, seen.speed_rad_s))
    after_s, regular = repeats(torque, width * period_s)
    return Swing(0.5 * float(np.ptp(torque)), 0.5 * float(np.ptp(speed)), after_s, regular)


def hold_damped(loop: ControlLoop, damper: SwingDamper, seconds: float) -> tuple[list[Sample], list[float]]:
    """Hold the speed with a yielding motor for a time. Return the samples and the speed setpoints."""
    samples: list[Sample] = []
    setpoints: list[float] = []
    for _ in range(loop.cycles(seconds)):
        last = loop.last
        setpoints.append(damper.step(last.torque_nm if last is not None and last.fresh else math.nan))
        samples.append(loop.cycle(Command(Mode.SPEED, setpoints[-1], 0.0)))
    return samples, setpoints


def calm_string(loop: ControlLoop, limits: MachineLimits, target_rad_s: float, tolerance_rad_s: float) -> Calmed:
    """Turn at a speed, yielding, until the string is calm or its oscillation does not decay further.

    Raises LimitHit if the mean speed is not reached in time, and with stick-slip.
    """
    damper = SwingDamper(limits.torque_nm, limits.speed_max_rad_s, target_rad_s, loop.period_s)
    samples: list[Sample] = []
    setpoints: list[float] = []
    calm, window = loop.cycles(CALM_S), loop.cycles(WINDOW_S)
    for _ in range(round(MOST_CALMING_S / BLOCK_S)):
        seen, asked = hold_damped(loop, damper, BLOCK_S)
        samples += seen
        setpoints += asked
        if len(samples) < calm:
            continue
        last = swing_of(samples[-calm:], loop.period_s)
        there = abs(_mean_speed(samples[-calm:]) - target_rad_s) <= tolerance_rad_s
        if there and last.torque_nm <= CALM_SHARE * limits.torque_nm:
            return Calmed(samples, setpoints, last, damper)
        if len(samples) < 2 * window:
            continue
        now = swing_of(samples[-window:], loop.period_s)
        before = swing_of(samples[-2 * window : -window], loop.period_s)
        if now.torque_nm >= NO_CALMER * before.torque_nm:
            left = swing_of(samples[-2 * window :], loop.period_s)
            mean_nm = float(trace(samples[-2 * window :]).torque_nm.mean())
            if is_stick_slip(left, limits, target_rad_s, mean_nm):
                raise stick_slip(left, target_rad_s, f"at {loop.now_s:.1f} s")
            # The top yields to incoming waves, so its mean may deviate by as much.
            allowed_rad_s = max(2.0 * tolerance_rad_s, 0.5 * left.speed_rad_s)
            if abs(_mean_speed(samples[-window:]) - target_rad_s) <= allowed_rad_s:
                loop.log.event(
                    loop.now_s, "string",
                    f"the string's oscillation does not decay at {target_rad_s:.2f} rad/s:"
                    f" torque ±{in_nm(left.torque_nm)}",
                )
                return Calmed(samples, setpoints, left, damper)
    left = swing_of(samples[-2 * window :], loop.period_s)
    mean = _mean_speed(samples[-window:])
    torque, helps = loop.guard.torque_words(
        float(trace(samples[-window:]).torque_nm.mean()), samples[-1].limit_active, left.keeps_oscillating(limits)
    )
    raise LimitHit(
        f"the string did not settle at {target_rad_s:.3f} rad/s within {MOST_CALMING_S:g} s (mean speed {mean:.3f}"
        f" rad/s, torque oscillation ±{in_nm(left.torque_nm)}"
        + (f" every {left.period_s:.1f} s" if left.regular >= STICK_SLIP_REGULAR else "") + f"); {torque}",
        where=f"at {loop.now_s:.1f} s",
        next_step=helps,
        entry=MessageCode.NOT_SETTLED,
    )


def is_stick_slip(swing: Swing, limits: MachineLimits, speed_rad_s: float, mean_nm: float) -> bool:
    """Return whether a periodic oscillation is as large as stick-slip: judged downhole if the pipe is known."""
    if swing.regular < STICK_SLIP_REGULAR:
        return False
    zeta = limits.wave_impedance_nm_s_rad
    if zeta > 0.0:
        downhole = downhole_swing_rad_s(swing.torque_nm, zeta, 0.5 * limits.echo_s, swing.period_s)
        return downhole >= STICK_SLIP_SHARE * speed_rad_s
    return swing.torque_nm >= STICK_SLIP_TORQUE_SHARE * abs(mean_nm)


def stick_slip(swing: Swing, speed_rad_s: float, where: str) -> LimitHit:
    """Return the error for stick-slip."""
    return LimitHit(
        f"stick-slip at {speed_rad_s:.2f} rad/s: the string's torque oscillates by ±{in_nm(swing.torque_nm)}"
        f" every {swing.period_s:.1f} s, the top by ±{swing.speed_rad_s:.2f} rad/s, and yielding does not end it",
        where=where,
        next_step="Lift the bit off bottom, reduce the weight on bit, or raise limits.speed_min_rad_s above the"
        " critical speed of stick-slip",
        entry=MessageCode.STICK_SLIP,
    )


def _mean_speed(samples: Sequence[Sample]) -> float:
    return math.fsum(sample.speed_rad_s for sample in samples) / len(samples)

"""The braking probe: one small braking torque at low speed, before any motion in torque mode depends on its sign.

The sign probe of stage 1 only pushes forward. A drive (or a profile) that reads a negative torque setpoint as a
positive one passes the sign probe, and would accelerate the shaft instead of braking it. Stage 2 ends at its lower
speed. There, at the beginning of stage 3, tdhil tries a pulse whose worst effect is known in advance (`plan_pulse`),
and waits for the response (`BrakingListener`). Before the pulse, and in the whole run if no pulse is safe, the guard
permits no torque below zero in torque mode.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from drivers import Command, Mode, PreflightRefused, Sample
from profiles import MessageCode
from profiles.quantities import in_nm
from tdhil.runner.control_loop import ControlLoop
from tdhil.runner.excitation import RigGuess
from tdhil.runner.guard import LIGHTEN
from tdhil.runner.settings import ControlAssumptions, MachineLimits
from tdhil.runner.stages.speed import SpeedResult, mean_speeds, ramp_speed
from tdhil.runner.stages.steady import CALM_S, WINDOW_S, calm_string, swing_of, trace, wait_until_steady, widest

# ---------------------------------------------------------------------------------------------------------------------
# The pulse of the braking probe: its torque, duration and worst effect on a drive that inverts it. Pure.
#
# A drive that reads its signed torque setpoint as unsigned turns every braking torque into full torque forward. So one
# braking torque is tried at low speed, for a time that is fixed before it begins: its end does not depend on any report
# of the drive. With
#
#     ω_0 the speed, T_f the flowing torque (friction), T_b the braking torque, t_p its duration,
#     t_r the reaction time, from a setpoint to the torque that follows it (a lost frame included), J_min the smallest
#     plausible inertia from the rough one, T_lim the torque limit that the drive has confirmed in preflight,
#
# the worst effect of a misreading is T_lim forward, without friction, from the first braking setpoint until the one
# after the last has acted, and that must stay well below the speed limit:
#
#     ω_0 + T_lim / J_min · (t_p + t_r)  ≤  ω_0 + 0.8 (ω_max − ω_0)                                            (up)
#
# On a drive that reads it correctly the shaft must stay in its window, and turn forward; t_c is a cycle, which may be
# lost:
#
#     ω_0 − (T_f + T_b) / J_min · (t_p + t_c)  ≥  ω_0 − 0.6 (ω_0 − ω_min)                                      (down)
#
# and the guard, which predicts over t_r and the longest reporting lag τ, must not predict reverse rotation: T_b is
# below the friction at standstill, or too small to stop the shaft within t_r + τ. The change of speed that shows the
# response, (T_f + T_b) t_p / J, must exceed the noise clearly. If that is impossible, the run uses no braking torque.
#
# With a drill string the torque comes down and up again on ramps, of torque_ramp_nm_s or, where friction would stop the
# shaft meanwhile, at most half a second each. That ramp is meant for releasing trapped torque completely; here the
# string keeps its twist, since the shaft neither stops nor turns back.
#
# An oscillating string pushes and brakes by itself. It is damped first. Its remaining oscillation, assumed at its worst
# during the whole pulse, counts as noise of the speed. If this noise hides the response, there is no pulse.


UP_SHARE, DOWN_SHARE = 0.8, 0.6   # shares of the room above and below the speed, in the bounds (up) and (down)
SEEN_SHARE = 0.06
"""Intended change of speed, as a share of the speed limit, unless noise requires more."""

LEAST_SHARE = 0.15
"""Least braking torque as a share of the torque limit, unless the flowing torque is larger."""

LEAST_FLOWING_SHARE = 0.5
"""Share of the flowing torque. Below it, a drive that ignores the sign would slow down almost as much."""

HELD_SHARE = 0.9
"""Share of the friction that holds the shaft at standstill."""

LONGEST_S = 1.0           # s; longest pulse
STRING_EDGE_S = 0.5       # s; longest ramp of the pulse with a string
CLEAR, WANTED_CLEAR = 2.0, 6.0
"""Required and preferred ratio of the change to the noise."""

STRING_CLEAR = 4.0
"""Required ratio of the change of torque to the string's oscillation: the string pushes for about twice the duration of
the pulse until the response is known."""


CLEAR_WANDER, WANTED_WANDER = 1.25, 2.0
"""The ratios `CLEAR` and `WANTED_CLEAR` for the deviation that an oscillating string causes at constant torque: noise
of the report lasts one cycle, but this lasts until the response is known."""


@dataclass(frozen=True)
class Pulse:
    """Braking pulse. ``torque_nm`` is below zero. ``cycles`` at this torque, and ``edge_cycles`` of each ramp.

    ``slowing_rad_s``: expected loss of speed. ``highest_rad_s``: highest speed if the drive inverts it.
    """

    flowing_nm: float
    torque_nm: float
    cycles: int
    edge_cycles: int
    slowing_rad_s: float
    highest_rad_s: float

    def setpoints_nm(self) -> list[float]:
        """Return one setpoint per cycle, from the first below the flowing torque back to the flowing torque."""
        step_nm = (self.torque_nm - self.flowing_nm) / (self.edge_cycles + 1)
        edge = [self.flowing_nm + step_nm * (n + 1) for n in range(self.edge_cycles)]
        return [*edge, *[self.torque_nm] * self.cycles, *reversed(edge), self.flowing_nm]


@dataclass(frozen=True)
class NoPulse:
    """Reason why no pulse is safe and detectable, and the next step."""

    why: str
    next_step: str


@dataclass(frozen=True)
class Before:
    """The steady rotation before the pulse: flowing torque (without its offset), and noise of the reported speed.

    ``swing_nm``: torque amplitude of an oscillating drill string; ``wander_rad_s``: the deviation of the shaft from its
    mean speed that the string causes.
    """

    speed_rad_s: float
    flowing_nm: float
    speed_noise_rad_s: float
    swing_nm: float = 0.0
    wander_rad_s: float = 0.0


def plan_pulse(
    limits: MachineLimits, model: RigGuess, assumptions: ControlAssumptions, before: Before, period_s: float
) -> Pulse | NoPulse:
    """Return the pulse for this shaft with cycles of ``period_s``."""
    lightest = assumptions.smallest_inertia_share * model.inertia_kg_m2
    reaction_s = assumptions.reaction_s
    room_up = UP_SHARE * (limits.speed_max_rad_s - before.speed_rad_s)
    down = before.speed_rad_s - max(0.0, limits.speed_min_rad_s)
    room_down = min(DOWN_SHARE * down, down - before.wander_rad_s)
    ahead_s = reaction_s + assumptions.largest_speed_lag_s
    slowest = before.speed_rad_s - room_down - before.speed_noise_rad_s
    turning_back_nm = slowest * lightest / ahead_s - model.steady_torque_nm(before.speed_rad_s)
    braking_nm = min(
        max(before.flowing_nm, LEAST_SHARE * limits.torque_nm),
        max(HELD_SHARE * model.coulomb_nm, turning_back_nm),
        limits.probe_torque_nm,
        limits.torque_nm,
    )
    change_nm = before.flowing_nm + braking_nm
    up_s = room_up * lightest / limits.torque_nm - reaction_s
    down_s = room_down * lightest / change_nm - period_s
    if up_s < period_s:
        bearable_nm = room_up * lightest / (reaction_s + period_s)
        return NoPulse(
            f"if the drive inverts a braking torque, the torque limit of {limits.torque_nm:g} N·m could accelerate a "
            f"shaft of {model.inertia_kg_m2:.3g} kg·m² to its speed limit within {reaction_s + period_s:.2g} s",
            f"Lower limits.torque_nm to {bearable_nm:.2g} N·m or less, if that moves the shaft; else use --mode speed",
        )
    if down_s < period_s:
        return NoPulse(
            f"friction and {braking_nm:.3g} N·m would take the shaft out of its window within {2.0 * period_s:.2g} s",
            "Use --mode speed",
        )
    wanted_rad_s = max(
        SEEN_SHARE * limits.speed_max_rad_s, WANTED_CLEAR * before.speed_noise_rad_s,
        WANTED_WANDER * before.wander_rad_s,
    )
    wanted_s = wanted_rad_s * model.inertia_kg_m2 / change_nm
    longest_s = min(max(wanted_s, period_s), LONGEST_S, up_s, down_s)
    edge = 0         # cycles of a ramp, none without a string
    if limits.has_drill_string:            # both ramps and a cycle take at most the shorter of both times
        edge_s = change_nm / limits.torque_ramp_nm_s if limits.torque_ramp_nm_s > 0.0 else STRING_EDGE_S
        room = (_whole(min(up_s, down_s), period_s) - 1) // 2
        edge = max(0, min(round(min(edge_s, STRING_EDGE_S) / period_s), room))
    # Both ramps together act like the full torque for the time of one ramp, and the drive may invert both.
    cycles = max(1, min(_whole(longest_s, period_s) - edge, _whole(up_s, period_s) - 2 * edge))
    slowing = change_nm * (cycles + edge) * period_s / model.inertia_kg_m2
    if slowing < CLEAR * before.speed_noise_rad_s or braking_nm < LEAST_FLOWING_SHARE * before.flowing_nm:
        return NoPulse(
            f"{braking_nm:.3g} N·m would slow the shaft by {slowing:.2g} rad/s, too little to detect",
            "Use --mode speed, or raise limits.probe_torque_nm",
        )
    exposed_s = (cycles + 2 * edge) * period_s + reaction_s
    if change_nm < STRING_CLEAR * before.swing_nm:
        return NoPulse(
            f"the string's oscillation of ±{before.swing_nm:.3g} N·m would hide the effect of {change_nm:.3g} N·m",
            "Use --mode speed, or bring the string to standstill: lift the bit off bottom, or reduce the weight on bit",
        )
    if slowing < CLEAR_WANDER * before.wander_rad_s:
        return NoPulse(
            f"the string moves the shaft ±{before.wander_rad_s:.2g} rad/s from its mean speed, which would hide the"
            f" {slowing:.2g} rad/s by which {braking_nm:.3g} N·m would slow it",
            f"{LIGHTEN}. A lower limits.torque_nm would allow a longer pulse. Or use --mode speed",
        )
    highest = before.speed_rad_s + limits.torque_nm / lightest * exposed_s
    return Pulse(before.flowing_nm, -braking_nm, cycles, edge, slowing, highest)


def _whole(time_s: float, period_s: float) -> int:
    """Return the whole cycles in a time."""
    return math.floor(time_s / period_s + 1e-9)


# ---------------------------------------------------------------------------------------------------------------------
# The response of a shaft to a braking torque: slower, faster or none. Pure; it receives one sample per cycle.
#
# The reported speed decides, because it shows the shaft itself: half of the expected change, downwards or upwards,
# whichever comes first. Reported torque and torque demand are quicker: if either clearly rises, the probe ends at once.
# A falling torque proves nothing about the shaft, and is no condition.
#
# A reported demand may still be that of the speed loop when torque mode has just been displayed. It counts once it has
# followed the switch, or should have.


MEAN_S = 0.05
"""Averaging time, s; one sample if a cycle is longer."""

SPEED_SHARE, ANSWER_TORQUE_SHARE = 0.5, 0.3
"""Share of the expected change that counts as a response."""

NOISE_SD, NOISE_QUANTA = 3.0, 1.5
"""Standard deviations, or quanta, that do not count as a change."""


class BrakingAnswer(Enum):
    """The direction of the response."""

    SLOWER = "slower"
    FASTER = "faster"


def speed_noise_rad_s(steady: Sequence[Sample], resolution_rad_s: float) -> float:
    """Return the noise of the reported speed, rad/s, from samples of steady rotation."""
    return max(NOISE_SD * float(trace(steady).speed_rad_s.std()), NOISE_QUANTA * resolution_rad_s)


class BrakingListener:
    """Compares new samples with the steady rotation before; ``why`` describes the last change."""

    def __init__(
        self, pulse: Pulse, steady: Sequence[Sample], period_s: float, reaction_s: float = 0.0,
        demand_nm: float | None = None,
    ) -> None:
        """Start with ``steady`` samples of speed mode; ``demand_nm``: the drive's last torque demand in torque mode."""
        before = trace(steady)
        self.before_rad_s = self.speed_rad_s = float(before.speed_rad_s.mean())
        self.before_nm = self.torque_nm = self.lowest_nm = float(before.torque_nm.mean())
        self._pulse = pulse
        self._change_rad_s = SPEED_SHARE * pulse.slowing_rad_s
        change_nm = ANSWER_TORQUE_SHARE * (pulse.flowing_nm - pulse.torque_nm)
        self._rise_nm = max(change_nm, NOISE_SD * float(before.torque_nm.std()))
        followed = demand_nm is not None and demand_nm < pulse.flowing_nm + self._rise_nm
        self._demand_deaf = 0 if followed else math.ceil(reaction_s / period_s - 1e-9)
        self._recent: deque[tuple[float, float]] = deque(maxlen=max(1, round(MEAN_S / period_s)))
        self.why = ""

    def hear(self, sample: Sample) -> BrakingAnswer | None:
        """Return the response; None while it is not clear."""
        if not sample.fresh:
            return None
        self._recent.append((sample.speed_rad_s, sample.torque_nm))
        self.speed_rad_s, self.torque_nm = (float(mean) for mean in np.mean(self._recent, axis=0))
        self.lowest_nm = min(self.lowest_nm, self.torque_nm)
        full = len(self._recent) == self._recent.maxlen
        self.why = f"the speed went from {self.before_rad_s:.3f} to {self.speed_rad_s:.3f} rad/s"
        if full and self.speed_rad_s >= self.before_rad_s + self._change_rad_s:
            return BrakingAnswer.FASTER
        if full and self.torque_nm >= self.before_nm + self._rise_nm:
            self.why = f"the reported torque went from {in_nm(self.before_nm)} to {in_nm(self.torque_nm)}"
            return BrakingAnswer.FASTER
        demand = sample.torque_demand_nm
        risen = demand is not None and demand >= self._pulse.flowing_nm + self._rise_nm
        # Ignore the demand at most for the reaction time, and only until it has once equalled the flowing torque.
        self._demand_deaf = self._demand_deaf - 1 if risen or demand is None else 0
        if demand is not None and risen and self._demand_deaf <= 0:
            self.why = f"the drive's torque demand went from {in_nm(self._pulse.flowing_nm)} to {in_nm(demand)}"
            return BrakingAnswer.FASTER
        if full and self.speed_rad_s <= self.before_rad_s - self._change_rad_s:
            return BrakingAnswer.SLOWER
        return None


# ---------------------------------------------------------------------------------------------------------------------

NOT_YET = "no braking torque has been tried yet"
"""Reason of the guard until the probe."""

TRIES = 2                 # pulses, if the first one shows nothing clear
STEADY_S = 1.0            # s; steady rotation before the pulse that counts
RAMP_S = 5.0
"""Time to slow down over the whole window, s; longer for a heavy shaft."""

TORQUE_SHARE = 0.25
"""Share of the torque limit that slowing down may use."""


def slow_speed(limits: MachineLimits, wander_rad_s: float = 0.0) -> float:
    """Return the speed of the probe, rad/s: the lower one of stage 2 if the shaft turns forward there.

    It is raised by ``wander_rad_s``, the deviation that a string causes, up to the middle of the window.
    """
    low_rad_s, high_rad_s = mean_speeds(limits)
    if low_rad_s <= 0.0:
        return 0.25 * limits.speed_max_rad_s
    middle_rad_s = 0.5 * (limits.speed_min_rad_s + limits.speed_max_rad_s)
    return min(low_rad_s + wander_rad_s, middle_rad_s, high_rad_s)


def slow_down(
    loop: ControlLoop, limits: MachineLimits, speed: SpeedResult, assumptions: ControlAssumptions,
    speed_resolution_rad_s: float,
) -> tuple[tuple[Sample, ...], SpeedResult]:
    """Slow down to the probe's speed in speed mode. Return the steady samples there, and the updated result of stage 2.

    With a drill string the samples cover its oscillation, and average it out if it does not decay. If it oscillates
    more than before, the probe speed is raised. Raises LimitHit if there is no steady rotation.
    """
    tolerance = max(2.0 * speed_resolution_rad_s, 0.01 * limits.speed_max_rad_s)
    target = _ramp_to(loop, limits, speed, speed.high.speed_rad_s)
    if not limits.has_drill_string:
        command = Command(Mode.SPEED, target, 0.0)
        loop.hold(command, assumptions.largest_speed_lag_s)
        settled = wait_until_steady(loop, command, target, tolerance, timeout_s=60.0)
        return tuple(settled[-loop.cycles(STEADY_S) :]), speed
    while True:
        calmed = calm_string(loop, limits, target, tolerance)
        keeps_oscillating = calmed.swing.keeps_oscillating(limits)
        if keeps_oscillating:
            speed = replace(speed, swing=widest(speed.swing, calmed.swing))
            loop.guard.disturbed = speed.disturbed
        if slow_speed(limits, speed.wander_rad_s) <= target + tolerance:
            return tuple(calmed.samples[-loop.cycles(2.0 * WINDOW_S if keeps_oscillating else CALM_S) :]), speed
        target = _ramp_to(loop, limits, speed, target)


def _ramp_to(loop: ControlLoop, limits: MachineLimits, speed: SpeedResult, from_rad_s: float) -> float:
    """Ramp to the probe's speed, in speed mode. Return that speed, rad/s."""
    target = slow_speed(limits, speed.wander_rad_s)
    span = limits.speed_max_rad_s - max(0.0, limits.speed_min_rad_s)
    rate = min(span / RAMP_S, TORQUE_SHARE * limits.torque_nm / speed.model.inertia_kg_m2)
    ramp_speed(loop, from_rad_s, target, rate)
    return target


def probe_braking(
    loop: ControlLoop, limits: MachineLimits, model: RigGuess, assumptions: ControlAssumptions,
    steady: Sequence[Sample],
    flowing_nm: float, speed_resolution_rad_s: float, where: str, wander_rad_s: float = 0.0,
) -> list[Sample]:
    """Try the pulse in torque mode, at ``flowing_nm`` and the speed of ``steady``. Return its samples; none if not
    safe.

    It is tried once more if the response is not clear. Raises PreflightRefused, with ``where``, for any response but a
    slower shaft, and the errors of the bench.
    """
    samples: list[Sample] = []
    unclear = ""
    # Under speed control the torque shows the string; after the switch it is the commanded torque.
    swing_nm = swing_of(steady, loop.period_s).torque_nm if limits.has_drill_string else 0.0
    steady = steady[-loop.cycles(STEADY_S) :]
    for _ in range(TRIES):
        noise = speed_noise_rad_s(steady, speed_resolution_rad_s)
        before = Before(float(trace(steady).speed_rad_s.mean()), flowing_nm, noise, swing_nm, wander_rad_s)
        pulse = plan_pulse(limits, model, assumptions, before, loop.period_s)
        if isinstance(pulse, NoPulse):
            loop.guard.no_braking, loop.guard.to_brake = pulse.why, pulse.next_step
            loop.log.event(loop.now_s, "probe", f"no braking torque in this run: {pulse.why}")
            return samples
        demand_nm = None if loop.last is None else loop.last.torque_demand_nm
        listener = BrakingListener(pulse, steady, loop.period_s, assumptions.reaction_s, demand_nm)
        answer, seen = _try(loop, pulse, listener, before.speed_rad_s, assumptions)
        samples += seen
        if answer is BrakingAnswer.FASTER:
            raise PreflightRefused(
                f"the drive inverts a negative torque setpoint: on {in_nm(pulse.torque_nm)} {listener.why}",
                where=f"braking probe, {where}",
                next_step="Check that the setpoint is signed in the drive as in the profile (two's complement), and"
                " that no direction bit inverts it. Correct the profile or the drive's settings",
                entry=MessageCode.BRAKING_UNCLEAR,
            )
        if answer is BrakingAnswer.SLOWER:
            loop.log.event(
                loop.now_s, "probe",
                f"the shaft slowed down: {listener.why}, reported torque down to {in_nm(listener.lowest_nm)}",
            )
            return samples
        unclear = f"{in_nm(-pulse.torque_nm)} did not slow it by {pulse.slowing_rad_s:.2f} rad/s: {listener.why}"
        steady = samples[-loop.cycles(STEADY_S / 2.0) :]
    raise PreflightRefused(
        f"a braking torque does not slow the shaft: {unclear}",
        where=f"braking probe, {where}",
        next_step="Check type and direction of the setpoint in the profile and the drive's manual: the drive may ignore"
        " its sign, or its own ramp or limit may hold the torque back",
        entry=MessageCode.BRAKING_UNCLEAR,
    )


def _try(
    loop: ControlLoop, pulse: Pulse, listener: BrakingListener, speed_rad_s: float, assumptions: ControlAssumptions
) -> tuple[BrakingAnswer | None, list[Sample]]:
    """Send the whole pulse, then the flowing torque until the reports have caught up; stop at a faster shaft."""
    loop.log.event(
        loop.now_s, "probe",
        f"braking torque tried at {speed_rad_s:.2f} rad/s: {in_nm(pulse.torque_nm)} for"
        f" {pulse.cycles * loop.period_s:.2g} s (if the drive inverted it, the speed would reach at most"
        f" {pulse.highest_rad_s:.2f} rad/s)",
    )
    loop.guard.no_braking = ""
    answer: BrakingAnswer | None = None
    seen: list[Sample] = []
    late = loop.cycles(2.0 * assumptions.largest_speed_lag_s + assumptions.reaction_s)
    for torque_nm in (*pulse.setpoints_nm(), *[pulse.flowing_nm] * late):
        seen.append(loop.cycle(Command(Mode.TORQUE, speed_rad_s, torque_nm)))
        heard = listener.hear(seen[-1])
        if heard is BrakingAnswer.FASTER:
            return heard, seen
        answer = answer or heard
        if answer is not None and torque_nm == pulse.flowing_nm:
            break
    return answer, seen

"""The braking probe: one small braking torque at low speed, before any motion in torque mode depends on its sign.

The sign probe of stage 1 only ever pushes forward. A drive (or a profile) that takes a torque setpoint below zero for
one above it passes that, and would speed the shaft up where it is to brake it. Stage 2 ends at its lower speed; there,
at the beginning of stage 3, a pulse is tried whose worst is known beforehand (`braking_pulse`), and the answer awaited
(`braking_answer`). Before it has been given, and in the whole run where there is no safe pulse, the guard lets no
torque below zero through in torque mode.
"""

from __future__ import annotations

from collections.abc import Sequence

from drivers.drive import Command, Mode, Sample
from drivers.errors import PreflightRefused
from tdhil.protocol.braking_answer import Answer, Listener, speed_noise_rad_s
from tdhil.protocol.braking_pulse import Before, NoPulse, Pulse, plan_pulse
from tdhil.run.control_loop import Bench
from tdhil.run.excitation import RigGuess
from tdhil.run.settings import ControlAssumptions, MachineLimits
from tdhil.run.stages.speed import mean_speeds
from tdhil.run.stages.steady import trace, wait_until_steady

NOT_YET = "no braking torque has been tried yet"
"""Why the guard lets none through until then."""

TRIES = 2
STEADY_S = 1.0
RAMP_S = 5.0
"""Slowing down over the whole window takes so long, or longer on a heavy shaft."""

TORQUE_SHARE = 0.25
"""Of the torque limit, that slowing down may take."""


def slow_speed(limits: MachineLimits) -> float:
    """The speed of the probe, rad/s: the lower one of stage 2 if the shaft turns forward there."""
    low_rad_s, _ = mean_speeds(limits)
    return low_rad_s if low_rad_s > 0.0 else 0.25 * limits.speed_max_rad_s


def slow_down(
    bench: Bench, limits: MachineLimits, model: RigGuess, assumptions: ControlAssumptions, from_rad_s: float,
    speed_resolution_rad_s: float,
) -> tuple[Sample, ...]:
    """Down to the probe's speed in speed mode; the samples of steady rotation there. LimitHit if it gets none."""
    target = slow_speed(limits)
    span = limits.speed_max_rad_s - max(0.0, limits.speed_min_rad_s)
    rate = min(span / RAMP_S, TORQUE_SHARE * limits.torque_nm / model.inertia_kg_m2)
    steps = bench.cycles(abs(target - from_rad_s) / rate)
    for step in range(1, steps + 1):
        bench.cycle(Command(Mode.SPEED, from_rad_s + (target - from_rad_s) * step / steps, 0.0))
    command = Command(Mode.SPEED, target, 0.0)
    tolerance = max(2.0 * speed_resolution_rad_s, 0.01 * limits.speed_max_rad_s)
    bench.hold(command, assumptions.largest_speed_lag_s)
    settled = wait_until_steady(bench, command, target, tolerance, timeout_s=60.0)
    return tuple(settled[-bench.cycles(STEADY_S) :])


def probe_braking(
    bench: Bench, limits: MachineLimits, model: RigGuess, assumptions: ControlAssumptions, steady: Sequence[Sample],
    flowing_nm: float, speed_resolution_rad_s: float, where: str,
) -> list[Sample]:
    """Try it, in torque mode, at ``flowing_nm`` and the speed of ``steady``; its samples, none if no pulse is safe.

    Where neither slower nor faster is clear it is tried once more. Raises PreflightRefused, naming ``where``, on any
    answer but a slower shaft; and what the bench raises.
    """
    samples: list[Sample] = []
    unclear = ""
    for _ in range(TRIES):
        noise = speed_noise_rad_s(steady, speed_resolution_rad_s)
        before = Before(float(trace(steady).speed_rad_s.mean()), flowing_nm, noise)
        pulse = plan_pulse(limits, model, assumptions, before, bench.period_s)
        if isinstance(pulse, NoPulse):
            bench.guard.no_braking, bench.guard.to_brake = pulse.why, pulse.next_step
            bench.log.event(bench.now_s, "probe", f"no braking torque in this run: {pulse.why}")
            return samples
        listener = Listener(pulse, steady, bench.period_s)
        answer, seen = _try(bench, pulse, listener, before.speed_rad_s, assumptions)
        samples += seen
        if answer is Answer.FASTER:
            raise PreflightRefused(
                f"the drive takes a negative torque for a positive one: on {pulse.torque_nm:.1f} N·m {listener.why}",
                where=f"braking probe, {where}",
                next_step="Is the setpoint signed there as the profile says, in two's complement, and does no direction"
                " bit turn it round? Correct the profile or the drive's settings",
            )
        if answer is Answer.SLOWER:
            bench.log.event(
                bench.now_s, "probe",
                f"the shaft slowed down: {listener.why}, reported torque down to {listener.lowest_nm:.1f} N·m",
            )
            return samples
        unclear = f"{-pulse.torque_nm:.1f} N·m did not slow it by {pulse.slowing_rad_s:.2f} rad/s: {listener.why}"
        steady = samples[-bench.cycles(STEADY_S / 2.0) :]
    raise PreflightRefused(
        f"a braking torque does not slow the shaft: {unclear}",
        where=f"braking probe, {where}",
        next_step="Does the drive take the size of the setpoint without its sign, or does a ramp or limit of its own"
        " hold the torque back? Check type and direction in the profile and the drive's manual",
    )


def _try(
    bench: Bench, pulse: Pulse, listener: Listener, speed_rad_s: float, assumptions: ControlAssumptions
) -> tuple[Answer | None, list[Sample]]:
    """The pulse in full, then what flowed before it until the reports have caught up; cut short by a faster shaft."""
    bench.log.event(
        bench.now_s, "probe",
        f"braking torque tried at {speed_rad_s:.2f} rad/s: {pulse.torque_nm:.1f} N·m for"
        f" {pulse.cycles * bench.period_s:.2g} s (taken for full torque forward it would lead to"
        f" {pulse.highest_rad_s:.2f} rad/s at most)",
    )
    bench.guard.no_braking = ""
    answer: Answer | None = None
    seen: list[Sample] = []
    late = bench.cycles(2.0 * assumptions.largest_speed_lag_s + assumptions.reaction_s)
    for torque_nm in (*pulse.setpoints_nm(), *[pulse.flowing_nm] * late):
        seen.append(bench.cycle(Command(Mode.TORQUE, speed_rad_s, torque_nm)))
        heard = listener.hear(seen[-1])
        if heard is Answer.FASTER:
            return heard, seen
        answer = answer or heard
        if answer is not None and torque_nm == pulse.flowing_nm:
            break
    return answer, seen

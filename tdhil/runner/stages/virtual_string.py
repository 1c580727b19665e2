"""Stage 5 with a virtual string: the drive in torque mode, with string, bit and speed controller in the host; or the
drive in its own speed loop, with the string's torque through its torque offset.

The guard checks speed, torque and time. In addition the stage ends if the shaft does not follow its torque, if the loop
oscillates more than string and bit can, or if the loop's own errors put too much energy into the shaft. However the
stage ends, the string's torque ends first: at a regular end it is faded out, and in every other case the first cycle of
the stop commands no torque.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence

from drivers import Command, LimitHit, Mode, PreflightRefused, Sample
from profiles import MessageCode
from profiles.quantities import in_nm
from tdhil.runner.control_loop import ControlLoop
from tdhil.runner.excitation import RigGuess
from tdhil.runner.guard import kept_within
from tdhil.runner.settings import MachineLimits
from tdhil.soft_torque import (
    RPM,
    EvaluationCase,
    HostLoop,
    Phase,
    RigWindow,
    SpeedProgram,
    check_virtual_string,
    program_for,
)

STRANGE_SHARE, STRANGE_COUNTS, STRANGE_SDS = 0.015, 8.0, 6.0
"""Share of the speed limit, counts of the reported speed, and standard deviations of its noise: the largest of these is
the permitted deviation of the report from the observer's expectation. An error of a tenth in a lag or inertia causes a
fifth of the first. A lost load or torque is detected within a tenth of a second."""
RMS_S = 5.0               # s; window of the rms torque that shows an oscillating loop
ENERGY_SHARE = 0.05
"""Share of the string's energy at breakaway of the bit that loop errors may put in."""
RESERVE_S = 20.0          # s; reserved of the time limit
BEFORE_S = 150.0
"""Approximate duration of stages 1 to 4, s; the rest of the time limit is checked before motion."""

_TOLD = {
    Phase.HOLD: "virtual string: coupled; stick-slip of the bit is expected",
    Phase.RAMP: "virtual string: ramp of the set speed",
    Phase.STEADY: "virtual string: the bit turns",
    Phase.RELEASED: "virtual string: the bit is off bottom",
}

Keep = Callable[[Sequence[float]], None]


def course_of(case: EvaluationCase, limits: MachineLimits, period_s: float, foresight_s: float) -> SpeedProgram:
    """Return the virtual string's speed program within the limits. Raises PreflightRefused or EvaluationRefused."""
    if limits.load != "none":
        raise PreflightRefused(
            f"a virtual string is requested, but load is {limits.load}", where="load in rig.yaml",
            next_step="Evaluate before the string is connected",
            entry=MessageCode.VIRTUAL_STRING_REFUSED,
        )
    check_virtual_string(case, period_s)
    window = RigWindow(limits.speed_min_rad_s, limits.speed_max_rad_s, limits.torque_nm, foresight_s)
    program = program_for(case, window)
    needed_s = program.longest_s + BEFORE_S + RESERVE_S
    if needed_s > limits.time_s:
        raise PreflightRefused(
            f"the virtual string takes up to {needed_s:.0f} s, which is above the limit of {limits.time_s:g} s",
            where="limits.time_s in rig.yaml", next_step="Raise it",
            entry=MessageCode.VIRTUAL_STRING_REFUSED,
        )
    return program


def refuse_other_rig(case: EvaluationCase, model: RigGuess) -> None:
    """Raise PreflightRefused if the turning shaft can't be the one of the result."""
    if model.excludes(case.rig.inertia_kg_m2):
        raise PreflightRefused(
            f"the result says {case.rig.inertia_kg_m2:.4g} kg·m² at the motor, and this shaft has about "
            f"{model.inertia_kg_m2:.4g}",
            where="--controller and --result", next_step="Identify this rig, then tune with that result",
            entry=MessageCode.VIRTUAL_STRING_REFUSED,
        )


def run_virtual_string(
    loop: ControlLoop, limits: MachineLimits, case: EvaluationCase, program: SpeedProgram, keep: Keep,
    say: Callable[[str], None], resolution_rad_s: float, noise_rad_s: float,
) -> None:
    """Run the whole program, from steady rotation at its first speed; ``keep`` receives one row per cycle.

    ``resolution_rad_s``: count of the reported speed; ``noise_rad_s``: its standard deviation.
    Raises LimitHit, and what the bench raises.
    """
    host = HostLoop(case.string, case.meant, case.law, case.rig, program, loop.period_s, limits.torque_nm,
                    case.own_loop)
    ratio, watch = case.rig.gear_ratio, _LoopWatch(loop, limits, case, program, resolution_rad_s, noise_rad_s)
    last = loop.last
    speed = last.speed_rad_s if last is not None else program.start_rad_s * ratio
    torque = case.rig.coulomb_nm + case.rig.viscous_nm_s_rad * speed
    host.begin(speed, torque)
    if case.own_loop:
        torque = 0.0
        loop.guard.allow_torque_offset(limits.torque_nm)
    phase: Phase = host.phase
    clamped = False
    while host.phase is not Phase.DONE:
        wanted = kept_within(host.set_rad_s * ratio, 0.0, limits.speed_max_rad_s)
        command = Command(Mode.SPEED, wanted, 0.0, torque) if case.own_loop else Command(Mode.TORQUE, wanted, torque)
        sample = loop.cycle(command)
        torque = host.step(sample.time_s, sample.speed_rad_s if sample.fresh else None)
        keep(host.row)
        watch.see(host, sample)
        if (host.clamped or (case.own_loop and sample.limit_active)) and not clamped:
            clamped = True
            loop.log.event(loop.now_s, "limits", "virtual string: the torque limit acts; it is faded out")
            say("the torque limit acts: the virtual string was faded out, and there will be no result")
            host.cut()
        if host.phase is not phase:
            phase = host.phase
            text = _TOLD.get(phase, "")
            if phase is Phase.TRIAL:
                text = f"virtual string: trial at {host.set_rad_s / RPM:.1f} rpm whether the bit ends turning"
            if text:
                loop.log.event(loop.now_s, "string", text)
                say(text)


class _LoopWatch:
    """Checks every cycle of the loop, and raises LimitHit."""

    def __init__(
        self, loop: ControlLoop, limits: MachineLimits, case: EvaluationCase, program: SpeedProgram,
        resolution_rad_s: float, noise_rad_s: float,
    ) -> None:
        assert case.string.bit is not None
        self._observer = loop.guard.observer
        self._strange_rad_s = max(
            STRANGE_SHARE * limits.speed_max_rad_s, STRANGE_COUNTS * resolution_rad_s, STRANGE_SDS * noise_rad_s
        )
        self._gear = case.rig.gear_ratio
        self._peak_nm = program.peak_nm
        wound_up_j = 0.5 * case.string.bit.static_nm**2 / case.string.stiffness_nm_rad
        self._most_j = ENERGY_SHARE * wound_up_j
        self._squares: deque[float] = deque(maxlen=loop.cycles(RMS_S))
        self._sum = 0.0

    def see(self, host: HostLoop, sample: Sample) -> None:
        where = f"virtual string at {sample.time_s:.3f} s"
        self._observer.expected(host.innovation_rad_s * self._gear, self._strange_rad_s, sample)
        if not host.put_in_j <= self._most_j:
            raise LimitHit(
                f"the loop's errors have put {host.put_in_j:.0f} J into the shaft (limit {self._most_j:.0f} J)",
                where=where,
                stops=True, next_step="Check the lags of the result: identify again",
                entry=MessageCode.VIRTUAL_STRING_UNSTABLE,
            )
        if len(self._squares) == self._squares.maxlen:
            self._sum -= self._squares[0]
        self._squares.append(host.net_nm**2)
        self._sum += self._squares[-1]
        if len(self._squares) == self._squares.maxlen:
            rms = math.sqrt(max(0.0, self._sum) / len(self._squares))
            if rms > self._peak_nm:
                raise LimitHit(
                    f"the loop oscillates with {in_nm(rms)} rms at the main shaft, above the limit of"
                    f" {in_nm(self._peak_nm)} of string and bit",
                    where=where, stops=True, next_step="Check the lags of the result: identify again",
                    entry=MessageCode.VIRTUAL_STRING_UNSTABLE,
                )

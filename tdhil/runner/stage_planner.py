"""Plan of stage 5, made while the shaft turns. The plan is shown and logged before it is executed."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import Any

from drivers import Command, LimitHit, Mode, PreflightRefused
from profiles import MessageCode
from profiles.quantities import in_nm
from tdhil.config import identified_before_echo
from tdhil.estimation import Samples
from tdhil.recording import FloatArray, LagPrior, RunLog, SteppedSetpoint
from tdhil.runner.adaptive_duration import Decision, Enough
from tdhil.runner.control_loop import ControlLoop
from tdhil.runner.design import DesignKnowledge, NoiseDensity, assumed_noise, measured_noise
from tdhil.runner.excitation import MotionLimits, Plan, PlanRefused, RigGuess, leaves_time_before_echo
from tdhil.runner.guard import LIGHTEN, Guard
from tdhil.runner.interim import Identify
from tdhil.runner.planning import Planned, as_followed, plan_acquisition
from tdhil.runner.settings import ExcitationRequest
from tdhil.runner.stages import RampCourse, SpeedResult
from tdhil.runner.task import Display, Say, Task

MOST_WANDER = 0.8
"""Largest share of the speed window that is reserved for the oscillation of a string under load."""

RESERVE_S = 30.0
"""Time reserved for stage 4 and the transitions when stage 5 is planned, s."""


class StagePlanner:
    """Planner of one run. The cycles continue while it computes."""

    def __init__(self, loop: ControlLoop, log: RunLog, display: Display, say: Say) -> None:
        self._loop = loop
        self._log = log
        self._display = display
        self._say = say

    def plan(self, task: Task, speed: SpeedResult, mode: Mode, prior: LagPrior) -> Planned:
        """Plan from the results of stage 2. Meanwhile the shaft keeps turning.

        Raises LimitHit if no plan fits the shaft within its limits, PreflightRefused if the plan needs a braking torque
        that is not allowed, and the errors of a cycle.
        """
        loop = self._loop
        request, limits, model = task.request, task.limits, speed.model
        # At constant torque a string under load moves the shaft from its mean: both ends keep room for that.
        free = speed.wander_rad_s if mode is Mode.TORQUE else 0.0
        width = limits.speed_max_rad_s - limits.speed_min_rad_s
        if 2.0 * free >= MOST_WANDER * width:
            raise LimitHit(
                f"the speed window of {width:.3g} rad/s leaves no room for an excitation: {loop.guard.disturbed}",
                where="plan of stage 5",
                stops=True, next_step=LIGHTEN,
                entry=MessageCode.NO_ROOM_FOR_MOTION,
            )
        room = Guard.room(limits, task.assumptions, free)
        if speed.swing is not None:     # the oscillation may hide the response to braking, which is then not used
            room = replace(room, least_torque_nm=loop.guard.least_torque_nm)
        course = speed.course if mode is Mode.SPEED else None
        last = loop.last
        speed_now = max(0.0, last.speed_rad_s) if last else 0.0
        keep = Command(mode, speed_now, model.steady_torque_nm(speed_now))
        left_s = loop.guard.left_s(loop.now_s) - RESERVE_S
        assumed = assumed_noise(limits.torque_nm, limits.speed_max_rad_s)
        theta = DesignKnowledge(assumed, prior).theta(model)

        work = partial(_planned_stage, request, mode, room, model, prior, assumed, speed.steady, theta, course,
                       left_s, limits.has_drill_string)
        try:
            planned = loop.compute(work, keep)
        except PlanRefused as error:
            raise LimitHit(
                f"no plan of stage 5 fits the shaft that stages 2 and 3 measured: {error}",
                where="plan of stage 5",
                stops=True, next_step=error.next_step,
                entry=MessageCode.NO_ROOM_FOR_MOTION,
            ) from error
        plan = planned.plan
        # If a missing braking torque limits the amplitude, rounding may leave it just below zero.
        if mode is Mode.TORQUE and plan.torque_min_nm < -1e-9 * limits.torque_nm and loop.guard.no_braking:
            raise PreflightRefused(
                f"the plan needs braking torque, down to {in_nm(plan.torque_min_nm)}: {loop.guard.no_braking}",
                where="plan of stage 5",
                next_step=loop.guard.to_brake,
                entry=MessageCode.BRAKING_UNCLEAR,
            )
        if course is not None:
            following, ramp = plan.guess.following, plan.limits.acceleration_rad_s2
            if math.isfinite(ramp):
                self._report(
                    f"the drive's own speed ramp limits the shaft to {ramp:.3g} rad/s²; stage 5 stays below it")
            if following is None:
                self._report(
                    "the drive's response to its setpoint is not clear; stage 5 assumes that it follows at once")
            else:
                # identification needs them for the effect of a stepped, slowly sampled setpoint on J
                self._log.learn(
                    stepped_setpoint=SteppedSetpoint(
                        loop.period_s, following.zero_s, following.first_s, following.second_s2
                    )
                )
        self._display.planned(plan)
        self._log.event(
            loop.now_s,
            "plan",
            f"{plan.kind} in {plan.mode} mode, {plan.duration_s:.0f} s, speed {plan.speed_min_rad_s:.2f} to "
            f"{plan.speed_max_rad_s:.2f} rad/s, torque {in_nm(plan.torque_min_nm)} to {in_nm(plan.torque_max_nm)}",
        )
        self._report(planned.said())
        before_echo = identified_before_echo(request.kind)
        if speed.swing is not None and not before_echo and leaves_time_before_echo(limits.echo_s):
            self._report(
                "the string's motion will hide some of these frequencies; --excitation prbs uses only the time before"
                " an echo, and is more accurate for J above a bit"
            )
        self._log.configure(plan=planned.plain())
        if planned.stopping is not None:
            self._log.configure(stopping=planned.stopping.plain() | {"decisions": []})
        return planned

    def enough(self, planned: Planned, identify: Identify) -> Enough | None:
        """Return the stopping decisions for a given tolerance; None without one. Each is logged before it is used."""
        rule = planned.stopping
        if rule is None:
            return None
        decisions: list[dict[str, Any]] = []

        def note(decision: Decision) -> None:
            decisions.append(decision.plain())
            self._log.configure(stopping=rule.plain() | {"decisions": list(decisions)})
            self._report(decision.why)

        assert isinstance(planned.plan, Plan)
        return Enough(rule, planned.plan, lambda: self._log.recording(complete=True), note, identify=identify)

    def _report(self, text: str) -> None:
        self._log.event(self._loop.now_s, "plan", text)
        self._say(text)


def _planned_stage(
    request: ExcitationRequest,
    mode: Mode,
    room: MotionLimits,
    model: RigGuess,
    prior: LagPrior,
    assumed: NoiseDensity,
    steady: tuple[Samples, ...],
    theta: FloatArray,
    course: RampCourse | None,
    left_s: float,
    has_drill_string: bool,
) -> Planned:
    """Compute the plan. Arguments and result are plain data, so any process can run it."""
    known = DesignKnowledge(measured_noise(steady, theta, assumed), prior, has_drill_string)
    if course is None:
        return plan_acquisition(request, mode.value, room, model, known, left_s)
    seen, within = as_followed(model, room, course, known.speed_lag_s)
    return plan_acquisition(request, mode.value, within, seen, known, left_s)

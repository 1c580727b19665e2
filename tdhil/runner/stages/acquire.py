"""Stage 5, acquire: the planned excitation, in torque mode or in speed mode.

In torque mode the feed-forward of the plan moves the shaft and a slow host loop keeps its mean speed;
in speed mode the reference goes to the drive's own loop.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

from drivers import Command, Mode, Sample
from tdhil.recording import Excitation, Segment
from tdhil.runner.adaptive_duration import Decision, Enough
from tdhil.runner.control_loop import ControlLoop
from tdhil.runner.excitation import CALM_S, Plan, PlannedSegment, RigGuess, SpeedChange, SpeedChangePlan
from tdhil.runner.guard import kept_within
from tdhil.runner.interim import InertiaWatch
from tdhil.runner.settings import ControlAssumptions, MachineLimits
from tdhil.runner.stages.hold import MeanSpeedControl

# ---------------------------------------------------------------------------------------------------------------------
# A slow small motion added to the excitation in speed mode, if the drive reports speed in coarse steps. Pure.
#
# Under speed control each period repeats the last, and so does the rounding of its reports, such as to whole rpm. This
# pattern adds up at the excited frequencies instead of averaging out, and the scatter between periods does not show it.
# A triangle of a count or two, with a period unrelated to the excitation's, makes each period round differently.


COUNTS = 2.0              # peak of the triangle, in counts of the reported speed
COARSE_SHARE = 0.002      # share of the speed window; finer counts than this need no triangle
MOST_SHARE = 0.015        # largest peak, share of the window: half of the margin that a plan keeps free at either end
PERIODS = (math.sqrt(5.0) - 1.0) / 2.0
"""Ratio of the triangle's period to the excitation's: the golden ratio is farthest from every ratio of integers."""


def dither_peak(resolution_rad_s: float, window_rad_s: float) -> float:
    """Return the peak of the triangle, rad/s; 0 if the reported speed is fine enough."""
    if resolution_rad_s < COARSE_SHARE * window_rad_s:
        return 0.0
    return min(COUNTS * resolution_rad_s, MOST_SHARE * window_rad_s)


def dither(time_s: float, period_s: float, peak_rad_s: float) -> float:
    """Return the addition to the speed setpoint, rad/s. It begins at zero."""
    turn = (time_s / (PERIODS * period_s) + 0.25) % 1.0
    return peak_rad_s * (1.0 - 4.0 * abs(turn - 0.5))


# ---------------------------------------------------------------------------------------------------------------------

Reference = Callable[[float], tuple[float, float]]
Announce = Callable[[Excitation], None]


class Follower:
    """Follows a reference for a time, one command per cycle."""

    def __init__(
        self,
        loop: ControlLoop,
        limits: MachineLimits,
        mode: Mode,
        control: MeanSpeedControl | None,
        dither_rad_s: Callable[[float], float] | None = None,
        after_cycle: Callable[[], None] | None = None,
    ) -> None:
        self._loop = loop
        self._after_cycle = after_cycle
        self._dither_rad_s = dither_rad_s
        self._limits = limits
        self._mode = mode
        self._control = control
        last = loop.last
        self.time_s = last.time_s if last else loop.now_s
        self.reported_rad_s = last.speed_rad_s if last else 0.0
        self.wanted_rad_s = self.reported_rad_s

    def follow(self, reference: Reference, duration_s: float) -> float:
        """Run ``reference`` for a duration from the next cycle on. Return the control time of its start."""
        start_s = self.time_s + self._loop.period_s
        # By time, not by a number of cycles: a slow line keeps its period only on average.
        self.follow_until(reference, start_s, start_s + max(duration_s, self._loop.period_s))
        return start_s

    def follow_until(self, reference: Reference, start_s: float, end_s: float) -> None:
        """Continue a reference that began at ``start_s`` up to the last cycle before ``end_s``."""
        while self.time_s + 1.5 * self._loop.period_s < end_s:
            self.step(reference, start_s)

    def step(self, reference: Reference, start_s: float) -> None:
        """Run one cycle of a reference that began at ``start_s``."""
        self._step(*reference(self.time_s + self._loop.period_s - start_s))

    def _step(self, speed_rad_s: float, torque_nm: float) -> None:
        limits, loop = self._limits, self._loop
        if self._control is not None:
            torque_nm += self._control.update(speed_rad_s - self.reported_rad_s, loop.period_s)
            torque_nm = max(torque_nm, loop.guard.least_torque_nm)
        torque_nm = kept_within(torque_nm, -limits.torque_nm, limits.torque_nm)
        lowest = -limits.speed_max_rad_s if limits.allow_reverse else 0.0
        setpoint = speed_rad_s + (0.0 if self._dither_rad_s is None else self._dither_rad_s(self.time_s))
        wanted = kept_within(setpoint, lowest, limits.speed_max_rad_s)
        self.saw(loop.cycle(Command(self._mode, wanted, torque_nm)), wanted)
        if self._after_cycle is not None:
            self._after_cycle()

    def saw(self, sample: Sample, wanted_rad_s: float) -> None:
        """Note the reported speed after a cycle with this setpoint."""
        self.time_s, self.reported_rad_s, self.wanted_rad_s = sample.time_s, sample.speed_rad_s, wanted_rad_s


def run_acquire(
    loop: ControlLoop,
    limits: MachineLimits,
    plan: Plan,
    control: MeanSpeedControl | None,
    announce: Announce,
    enough: Enough | None = None,
    speed_resolution_rad_s: float = 0.0,
    watch: InertiaWatch | None = None,
) -> None:
    """Run every segment of the plan, with its transitions. ``announce`` receives the excitation at every change.

    A segment is announced with its planned end when it begins, so that a log which ends in it can be read. With
    ``enough`` the plan is a pilot: after it the last segment continues during the interim analysis. Further periods
    follow at its mean speed and then, unless the decision is for this speed only, at the others after settling.
    In speed mode a coarse ``speed_resolution_rad_s`` is dithered (`dither`). ``watch`` shows J after periods.
    """
    begun_s = loop.now_s
    width_rad_s, dither_period_s = plan.limits.width_rad_s, plan.segments[0].reference.period_s
    peak_rad_s = dither_peak(speed_resolution_rad_s, width_rad_s) if plan.mode == Mode.SPEED.value else 0.0
    dither_rad_s: Callable[[float], float] | None = (
        None if peak_rad_s == 0.0 else lambda time_s: dither(time_s - begun_s, dither_period_s, peak_rad_s)
    )
    after_cycle = None if watch is None else watch.look
    follower = Follower(loop, limits, Mode(plan.mode), control, dither_rad_s, after_cycle)
    course = _SegmentCourse(loop, plan, follower, announce, watch)
    course.expect(plan.duration_s)
    for index in range(len(plan.segments)):
        course.go_to(index)
    while enough is not None:
        decision = course.ask(enough.question(loop.now_s - begun_s))
        enough.decided(decision)
        if decision.periods == 0:
            break
        period_s = plan.segments[-1].reference.period_s
        course.expect(decision.periods * period_s if decision.at_last else plan.extension_s(decision.periods))
        course.go_on(decision.periods)
        for index in () if decision.at_last else course.others():
            course.go_to(index, decision.periods)
    announce(course.excitation)


class _SegmentCourse:
    """The progress of stage 5: finished segments, and the present one."""

    def __init__(
        self, loop: ControlLoop, plan: Plan, follower: Follower, announce: Announce, watch: InertiaWatch | None
    ) -> None:
        self._loop, self._plan, self._follower, self._announce, self._watch = loop, plan, follower, announce, watch
        self._done: list[Segment] = []
        self._index = 0
        self._segment: PlannedSegment = plan.segments[0]
        self._start_s = 0.0
        self._end_s = 0.0              # approximate end of all planned segments, s

    def expect(self, duration_s: float) -> None:
        """Note the duration of the planned segments, s."""
        self._end_s = self._loop.now_s + duration_s

    @property
    def excitation(self) -> Excitation:
        """Return the excitation that has been run."""
        return Excitation(self._plan.kind, self._plan.mode, tuple(self._done))

    def go_to(self, index: int, counted: int | None = None) -> None:
        """Go to another mean speed and run its segment: as planned, or with ``counted`` evaluated periods."""
        segment, follower = self._plan.segments[index], self._follower
        if counted is not None:
            segment = replace(segment, periods=segment.settle_periods + counted)
        transition = self._plan.transition(follower.wanted_rad_s, index)
        follower.follow(transition.reference, transition.duration_s)
        self._announce_with(segment.recorded(follower.time_s + self._loop.period_s))
        self._start_s = follower.time_s + self._loop.period_s
        self._index, self._segment = index, segment
        self._run_periods(0)

    def ask(self, work: Callable[[], Decision]) -> Decision:
        """Announce what has been run, then continue the segment during the interim analysis (real time)."""
        self._announce(self.excitation)
        reference = self._segment.reference.reference
        return self._loop.compute_while(work, lambda: self._follower.step(reference, self._start_s))

    def go_on(self, periods: int) -> None:
        """Run more periods at the present mean speed."""
        self._done.pop()
        already = self._segment.periods
        segment = self._segment = replace(self._segment, periods=already + periods)
        self._announce_with(segment.recorded(self._start_s))
        self._run_periods(already)

    def others(self) -> list[int]:
        """Return the other mean speeds, the previous one first."""
        return [index for index in reversed(range(len(self._plan.segments))) if index != self._index]

    def _run_periods(self, already: int) -> None:
        """Run the present segment from its period ``already`` to its end. The watch may ask for J after periods."""
        segment, start_s, follower = self._segment, self._start_s, self._follower
        period_s = segment.reference.period_s
        for number in range(already + 1, segment.periods + 1):
            end_s = start_s + number * period_s
            follower.follow_until(segment.reference.reference, start_s, max(end_s, start_s + self._loop.period_s))
            if self._watch is not None and segment.settle_periods < number < segment.periods:
                motion = Excitation(self._plan.kind, self._plan.mode, (*self._done, self._recorded()))
                self._watch.period_ended(motion, max(0.0, self._end_s - follower.time_s))
        self._done.append(self._recorded())

    def _announce_with(self, planned: Segment) -> None:
        self._announce(Excitation(self._plan.kind, self._plan.mode, (*self._done, planned)))

    def _recorded(self) -> Segment:
        # The last period is complete with its last sample, one cycle before the next period would begin.
        return self._segment.recorded(self._start_s, self._follower.time_s + 1.5 * self._loop.period_s)


# ---------------------------------------------------------------------------------------------------------------------
# Stage 5 with torque pulses or coast-down: every speed change of the plan, and the steady speed after each.
#
# A powered change follows its reference like any other motion. Coasting is zero torque until the shaft is about to
# reach its lower speed, with an allowance for late reports. A fixed time would depend on the rough friction.


_LONGEST = 2.0            # longest coasting, multiple of the planned one: the friction may be overestimated


def run_speed_changes(
    loop: ControlLoop,
    limits: MachineLimits,
    plan: SpeedChangePlan,
    control: MeanSpeedControl | None,
    assumptions: ControlAssumptions,
    announce: Announce,
) -> None:
    """Run the whole plan. Raises what the bench raises. The host's slow control is frozen while the shaft coasts."""
    announce(Excitation(plan.kind, plan.mode))
    follower = Follower(loop, limits, Mode(plan.mode), control)
    follower.follow(_calm(plan.start_rad_s, plan.guess), CALM_S)
    for way in plan.ways:
        if way.coasting:
            _coast(loop, way, follower, assumptions)
            follower.follow(_calm(way.to_rad_s, plan.guess), CALM_S)
        else:
            follower.follow(way.reference, way.duration_s + CALM_S)


def _calm(speed_rad_s: float, guess: RigGuess) -> Callable[[float], tuple[float, float]]:
    steady = speed_rad_s, guess.steady_torque_nm(speed_rad_s)
    return lambda _: steady


def _coast(loop: ControlLoop, way: SpeedChange, follower: Follower, assumptions: ControlAssumptions) -> None:
    """Command zero torque down to the lower speed."""
    command = Command(Mode.TORQUE, way.to_rad_s, 0.0)
    # Reports are late, so the shaft is already slower: half of the longest plausible lag is assumed.
    late_s = 0.5 * assumptions.largest_speed_lag_s + loop.period_s
    stop_at = way.to_rad_s + late_s * way.guess.steady_torque_nm(way.to_rad_s) / way.guess.inertia_kg_m2
    end_s = follower.time_s + _LONGEST * way.duration_s
    while follower.time_s < end_s:
        sample = loop.cycle(command)
        follower.saw(sample, way.to_rad_s)
        if sample.fresh and sample.speed_rad_s <= stop_at:
            return


# ---------------------------------------------------------------------------------------------------------------------

def run_plan(
    loop: ControlLoop,
    limits: MachineLimits,
    plan: Plan | SpeedChangePlan,
    control: MeanSpeedControl | None,
    assumptions: ControlAssumptions,
    announce: Announce,
    enough: Enough | None,
    speed_resolution_rad_s: float,
    watch: InertiaWatch | None = None,
) -> None:
    """Run a plan of either family of excitations. Raises what the bench raises."""
    if isinstance(plan, SpeedChangePlan):
        run_speed_changes(loop, limits, plan, control, assumptions, announce)
    else:
        run_acquire(loop, limits, plan, control, announce, enough, speed_resolution_rad_s, watch)

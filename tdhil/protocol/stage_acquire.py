"""Stage 5, acquire: the planned excitation, in torque mode or in speed mode.

In torque mode the feed-forward of the plan moves the shaft and a slow host loop keeps its mean where it belongs;
in speed mode the reference goes to the drive's own loop.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from drivers.drive import Command, Mode, Sample
from tdhil.protocol.bench import Bench
from tdhil.protocol.control import MeanSpeedControl
from tdhil.protocol.excitation import Plan
from tdhil.protocol.settings import MachineLimits
from tdhil.record.recording import Excitation, Segment

Reference = Callable[[float], tuple[float, float]]
Announce = Callable[[Excitation], None]


@dataclass(frozen=True)
class AcquireResult:
    """What was run, as the recording keeps it."""

    excitation: Excitation


class Follower:
    """Follows a reference for a while, one command a cycle."""

    def __init__(self, bench: Bench, limits: MachineLimits, mode: Mode, control: MeanSpeedControl | None) -> None:
        self._bench = bench
        self._limits = limits
        self._mode = mode
        self._control = control
        last = bench.last
        self.time_s = last.time_s if last else bench.now_s
        self.reported_rad_s = last.speed_rad_s if last else 0.0
        self.wanted_rad_s = self.reported_rad_s

    def follow(self, reference: Reference, duration_s: float) -> float:
        """Run ``reference`` for a duration from the next cycle on; the control time at which it began."""
        period_s = self._bench.period_s
        start_s = self.time_s + period_s
        for _ in range(self._bench.cycles(duration_s)):
            self._step(*reference(self.time_s + period_s - start_s))
        return start_s

    def _step(self, speed_rad_s: float, torque_nm: float) -> None:
        limits = self._limits
        if self._control is not None:
            torque_nm += self._control.update(speed_rad_s - self.reported_rad_s, self._bench.period_s)
        torque_nm = max(-limits.torque_nm, min(limits.torque_nm, torque_nm))
        lowest = -limits.speed_max_rad_s if limits.allow_reverse else 0.0
        wanted = max(lowest, min(limits.speed_max_rad_s, speed_rad_s))
        sample: Sample = self._bench.cycle(Command(self._mode, wanted, torque_nm))
        self.time_s, self.reported_rad_s, self.wanted_rad_s = sample.time_s, sample.speed_rad_s, wanted


def run_acquire(
    bench: Bench, limits: MachineLimits, plan: Plan, control: MeanSpeedControl | None, announce: Announce
) -> AcquireResult:
    """Every segment of the plan, with its transitions. ``announce`` is told the excitation as it grows.

    A segment is announced with its planned end when it begins, so that a log which ends in it can be read.
    """
    mode = Mode(plan.mode)
    follower = Follower(bench, limits, mode, control)
    done: list[Segment] = []
    for index, segment in enumerate(plan.segments):
        transition = plan.transition(follower.wanted_rad_s, index)
        follower.follow(transition.reference, transition.duration_s)
        planned = segment.recorded(follower.time_s + bench.period_s)
        announce(Excitation(plan.kind, plan.mode, (*done, planned)))
        start_s = follower.follow(segment.reference.reference, segment.duration_s)
        # The last period is whole when its last sample is there: the one before the cycle that would begin the next.
        done.append(segment.recorded(start_s, follower.time_s + 1.5 * bench.period_s))
    excitation = Excitation(plan.kind, plan.mode, tuple(done))
    announce(excitation)
    return AcquireResult(excitation)

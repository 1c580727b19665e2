"""Definition of standstill, for the stop and the release. Pure.

A shaft stands still once all of these have held for long enough:

- the reported speed is zero within its resolution, but for single counts of its noise (`CountsOfNoise`),
- the position, where the drive reports one, does not move,
- no report contradicts another, or the contradiction has been refuted (`observer.Observer.reports_trusted`); then the
  torque must be too small to keep the shaft turning,
- the drive shows a state in which the shaft may stand still: a quick stop or speed mode that reports standstill, or no
  torque, or torque mode with zero torque. A statusword without a valid state proves nothing.

"Long enough" is the time in which every lag decays, and in which friction stops a motion that the reports can hide.
After the drive has removed its torque in motion, it is at least the longest time for which the shaft may coast.
"""

from __future__ import annotations

from drivers import STANDSTILL_RAD_S, PowerState, Sample
from tdhil.runner.observer import Observer
from tdhil.runner.settings import MachineLimits

AT_REST_SHARE = 0.005
"""Share of the speed limit below which a speed counts as standstill, at most `STANDSTILL_RAD_S`. Three counts of the
reported speed if that is more."""

NO_TORQUE = (PowerState.OFF, PowerState.READY, PowerState.FAULT)
"""States without torque on the shaft (CiA 402-2, state machine). "Not ready to switch on" is not among them, because
feedback that is all zero shows it too."""

COUNT_SHARE, COUNT_FACTOR = 0.1, 2.0
"""Share of the samples that may show a count beyond the standstill speed, and the largest such count as a multiple of
it. A drive may report coarser than its profile states, and noise then shows a count now and then. Seed 239 of
`benchmarks/healthy_runs.py` has a count of 1.05 times the standstill speed in 3 % of its samples at rest. Seed 1215 has
one of 3 times in 1 %: a count of any size is noise if the position shows standstill."""


def standstill_speed(limits: MachineLimits, speed_resolution_rad_s: float) -> float:
    """Return the highest reported speed that counts as standstill, rad/s."""
    return max(3.0 * speed_resolution_rad_s, min(AT_REST_SHARE * limits.noise_scale_rad_s, STANDSTILL_RAD_S))


class CountsOfNoise:
    """Tells single counts of a noisy and coarse speed report from motion, over one time at standstill.

    After a contradiction no count is noise.
    """

    def __init__(self, observer: Observer, at_rest_rad_s: float) -> None:
        self._observer = observer
        self._at_rest_rad_s = at_rest_rad_s
        self.restart()

    def restart(self) -> None:
        """Begin again with the next sample."""
        self._samples = self._counts = 0

    def explains(self, speed_rad_s: float, *, quiet: bool) -> bool:
        """Add one sample. Return whether it is quiet, or beyond the standstill speed by noise alone."""
        self._samples += 1
        self._counts += not quiet
        if quiet:
            return True
        observer, small = self._observer, abs(speed_rad_s) <= COUNT_FACTOR * self._at_rest_rad_s
        few = self._counts <= max(1.0, COUNT_SHARE * self._samples)
        return few and observer.doubt is None and (small or observer.angle_stands(self._at_rest_rad_s))


class Standstill:
    """Standstill test of one stop. ``settle_s``: least duration, s; ``longest_gap_s``: longest gap in feedback, s."""

    def __init__(self, observer: Observer, at_rest_rad_s: float, settle_s: float, longest_gap_s: float) -> None:
        self._observer = observer
        self._at_rest_rad_s = at_rest_rad_s
        self._settle_s = settle_s
        self._longest_gap_s = longest_gap_s
        self._since_s: float | None = None
        self._heard_s = 0.0
        self._shown = False
        self._noise = CountsOfNoise(observer, at_rest_rad_s)

    @property
    def settle_s(self) -> float:
        """Return the time for which standstill must be reported, s; longer if the motion was never reported."""
        return max(self._settle_s, self._observer.blind_s, self._observer.unseen_s)

    @property
    def denied(self) -> bool:
        """Return whether speed and position have shown standstill for long enough, but the drive's state has not."""
        since_s = self._since_s
        return since_s is not None and not self._shown and self._heard_s - since_s >= self.settle_s

    def quiet(self, sample: Sample) -> bool:
        """Return whether speed and position are zero in this sample, and may be believed."""
        observer = self._observer
        return (
            abs(observer.speed_rad_s(sample)) <= observer.rest_rad_s(self._at_rest_rad_s)
            and observer.angle_quiet(self._at_rest_rad_s)
            and observer.reports_trusted
        )

    def restart(self) -> None:
        """Discard the standstill seen so far."""
        self._since_s = None

    def see(self, sample: Sample, polled_gap_s: float = 0.0, *, without_torque: bool = False) -> bool:
        """Add one sample. Return True once the shaft has been at standstill for long enough.

        ``polled_gap_s``: longest gap between samples that are answers to single requests, if longer, s.
        ``without_torque``: zero torque is commanded, in torque mode.
        """
        # A single lost frame does not undo what the others showed; a longer gap does.
        gap_s, self._heard_s = sample.time_s - self._heard_s, sample.time_s
        gap, quiet, observer = gap_s > max(self._longest_gap_s, polled_gap_s), self.quiet(sample), self._observer
        noise = self._noise.explains(observer.speed_rad_s(sample), quiet=quiet)
        if not quiet:
            if gap or not (noise and observer.reports_trusted and observer.angle_quiet(self._at_rest_rad_s)):
                self._since_s = None
            return False
        if self._since_s is None or gap:
            self._since_s = sample.time_s
            self._noise.restart()
            return False
        self._shown = without_torque or sample.standstill or sample.state in NO_TORQUE
        return self._shown and sample.time_s - self._since_s >= self.settle_s and observer.coasts_s <= 0.0

"""Feedback that repeats its last values. Pure."""

from __future__ import annotations

import math

from drivers import Command, Mode, Sample
from profiles.quantities import in_nm
from tdhil.runner.settings import MachineLimits

FROZEN_S, FROZEN_SHARE = 0.5, 0.1
"""Limits of frozen feedback (row 19): speed and torque stay equal to the last bit for this time, s, while the
setpoint changes by this share of its limit. Such values are repeated, not measured."""

ANSWER_S = 0.25
"""Time for the first effect of a setpoint on the reports, s. A coarse report of a steady shaft may repeat for longer
than `FROZEN_S` before the setpoint moves. This time covers a slow line and one count of the torque; a lag delays the
end of a response, not its begin. `tests/runner/test_guard.py` has the reports that were called frozen without it."""

RAMP_ANSWER_S = 1.0
"""The same for a speed setpoint, if a coarse report of a steady shaft had repeated for `FROZEN_S` before it moved, s.
The drive follows along a ramp of its own, and the report lags. Seed 1472 of `benchmarks/healthy_runs.py` ramps by
3 rad/s², and a step of its report is 0.7 rad/s."""


class RepeatedFeedback:
    """Detection of feedback that repeats its last values, as a gateway does."""

    def __init__(self, limits: MachineLimits, answer_s: float = ANSWER_S) -> None:
        self._limits = limits
        self._answer_s = max(ANSWER_S, answer_s)
        self._seen: tuple[float, float] | None = None
        self._mode: Mode | None = None
        self._since_s = self._lowest = self._highest = 0.0
        self._moved_s: float | None = None

    def see(self, command: Command, sample: Sample, offset_nm: float) -> tuple[str, str] | None:
        """Return cause and next step if the feedback has repeated for long enough; else None."""
        seen, torque_mode = (sample.speed_rad_s, sample.torque_nm), command.mode is Mode.TORQUE
        with_offset = offset_nm > 0.0 and not torque_mode
        setpoint = command.torque_nm if torque_mode else command.speed_rad_s
        limit = self._limits.torque_nm if torque_mode else self._limits.speed_max_rad_s
        if with_offset:
            setpoint, limit = command.torque_offset_nm, offset_nm
        if seen != self._seen or command.mode is not self._mode or sample.limit_active:
            self._seen, self._mode, self._since_s = seen, command.mode, sample.time_s
            self._lowest = self._highest = setpoint
            self._moved_s = None
            return None
        self._lowest, self._highest = min(self._lowest, setpoint), max(self._highest, setpoint)
        if self._highest - self._lowest <= FROZEN_SHARE * limit:
            return None
        if self._moved_s is None:
            self._moved_s = sample.time_s
        coarse = self._moved_s - self._since_s >= FROZEN_S and not (torque_mode or with_offset)
        answer_s = max(self._answer_s, RAMP_ANSWER_S) if coarse else self._answer_s
        if self.repeats_s(sample.time_s) < FROZEN_S or sample.time_s - self._moved_s < answer_s:
            return None
        return self.words("while the setpoint moved")

    def repeats_s(self, now_s: float) -> float:
        """Return the time since the last change of speed or torque, s."""
        return 0.0 if self._seen is None else now_s - self._since_s

    def words(self, besides: str) -> tuple[str, str]:
        """Return cause and next step."""
        speed_rad_s, torque_nm = self._seen or (math.nan, math.nan)
        return (
            f"the feedback has been frozen at {speed_rad_s:.3f} rad/s and {in_nm(torque_nm)} for {FROZEN_S:g} s,"
            f" {besides}",
            "Does a gateway repeat old values? Check the bus and the drive; is the shaft locked?",
        )

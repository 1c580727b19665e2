"""Comparison of reported with commanded torque, in torque mode. Pure."""

from __future__ import annotations

import math
from collections import deque

from drivers import Command, Mode, PowerState, Sample
from profiles.quantities import in_nm
from tdhil.runner.settings import MachineLimits

TORQUE_SHARE, TORQUE_LIMIT_SHARE, TORQUE_WINDOW_S = 0.25, 0.05, 4.0
"""Allowed difference of the means of reported and commanded torque: this share of the command and of the torque
limit, over this time in torque mode, s. The verdict compares them with a coverage interval; this bound ends a run
early."""

CLEARLY = 0.99
"""Share of a bound below which a running sum decides. Its rounding is 1e-6 of the bound after a million points."""


class TorqueFollowing:
    """Mean reported torque compared with mean commanded torque, in torque mode."""

    def __init__(self, limits: MachineLimits, lag_s: float) -> None:
        self._limits = limits
        self._lag_s = lag_s
        self._reset()

    def _reset(self) -> None:
        self._blocks: deque[tuple[float, float, float]] = deque()
        self._seconds = 0.0
        self._apart_nms = 0.0

    def see(self, command: Command, sample: Sample, offset_nm: float, block_s: float) -> tuple[str, str] | None:
        """Return cause and next step if the means differ; else None."""
        enabled = sample.state is PowerState.ENABLED
        if command.mode is not Mode.TORQUE or sample.mode is not Mode.TORQUE or sample.limit_active or not enabled:
            self._reset()
            return None
        reported_nm = sample.torque_nm - offset_nm
        self._blocks.append((block_s, command.torque_nm, reported_nm))
        self._seconds += block_s
        self._apart_nms += block_s * (reported_nm - command.torque_nm)
        if self._seconds < TORQUE_WINDOW_S:
            return None
        while self._seconds - self._blocks[0][0] >= TORQUE_WINDOW_S:
            gone_s, gone_commanded_nm, gone_reported_nm = self._blocks.popleft()
            self._seconds -= gone_s
            self._apart_nms -= gone_s * (gone_reported_nm - gone_commanded_nm)
        # Clearly within the share of the limit, for any exact sums: the usual case, at every point of a run.
        if abs(self._apart_nms) <= CLEARLY * TORQUE_LIMIT_SHARE * self._limits.torque_nm * self._seconds:
            return None
        commanded = math.fsum(part * one for part, one, _ in self._blocks) / self._seconds
        reported = math.fsum(part * one for part, _, one in self._blocks) / self._seconds
        values = [one for _, one, _ in self._blocks]
        size = math.fsum(part * abs(one) for part, one, _ in self._blocks) / self._seconds
        late = self._lag_s * (max(values) - min(values)) / self._seconds
        if abs(reported - commanded) <= TORQUE_SHARE * size + TORQUE_LIMIT_SHARE * self._limits.torque_nm + late:
            return None
        demand = sample.torque_demand_nm
        demanded = "" if demand is None else f", the demanded torque {in_nm(demand)}"
        return (
            f"the reported torque contradicts the commanded torque: over {self._seconds:.1f} s of torque mode"
            f" {in_nm(commanded)} were commanded in the mean and {in_nm(reported)} reported{demanded}",
            "Check the units of torque in the profile (per_lsb of 6071h and 6077h) and the rated torque. J is wrong by"
            " as much as the reported torque",
        )
